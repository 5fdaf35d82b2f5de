"""Models: organs, instruments, and the tools that make them."""

from .catalog import GRIDS, NAMES, RESOLUTIONS
from .scene import INSTRUMENTS, load, organ, path, targets

__all__ = ["GRIDS", "INSTRUMENTS", "NAMES", "RESOLUTIONS", "load", "organ", "path", "targets"]
