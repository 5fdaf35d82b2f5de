"""Pictures of all worlds of a batch, by rays against triangles, on the device of the batch."""

from .camera import Camera

__all__ = ["Camera"]
