"""Models: organs, instruments, and the tools that make them."""

from .catalog import GRIDS, NAMES, RESOLUTIONS
from .scene import INSTRUMENTS, load, organ, path, targets
from .situs import abdomen

__all__ = [
  "GRIDS", "INSTRUMENTS", "NAMES", "RESOLUTIONS", "abdomen", "load", "organ", "path", "targets",
]  # fmt: skip
