"""Arrays that take long to make, kept in files beside Warp's kernels."""

import functools
import hashlib
import importlib.metadata
import os
import pathlib
import tempfile
import zipfile
from collections.abc import Callable, Mapping

import numpy as np
import warp as wp

from . import device


def arrays(
  name: str, content: bytes, make: Callable[[], Mapping[str, np.ndarray]]
) -> dict[str, np.ndarray]:
  """Returns arrays of a file, or makes them and writes the file where it can.

  Args:
    name: of the kind of arrays, in the file's name
    content: what the arrays follow from
    make: makes them
  """
  device.init()  # which says where
  digest = hashlib.sha256(content).hexdigest()[:32]
  file = pathlib.Path(str(wp.config.kernel_cache_dir)) / f"{name}_{digest}.npz"
  try:
    with np.load(file, allow_pickle=False) as kept:
      return dict(kept)
  except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
    made = {key: np.ascontiguousarray(value) for key, value in make().items()}
  try:
    file.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".part", delete=False) as part:
      np.savez(part, **made)  # pyright: ignore[reportArgumentType]
    os.replace(part.name, file)  # whole or not at all
  except OSError:
    pass  # they are made again then
  return made


@functools.cache
def source(folder: str) -> bytes:
  """Returns what changes with the Python files of a folder and what they compute with."""
  digest = hashlib.sha256()
  for file in sorted(pathlib.Path(folder).rglob("*.py")):
    digest.update(file.read_bytes())
  for package in ("numpy", "scipy", "scikit-image"):
    digest.update(importlib.metadata.version(package).encode())
  return digest.digest()
