"""Pictures of all worlds of a batch, drawn on its device."""

from .camera import Camera

__all__ = ["Camera"]
