"""Writing files whole or not at all, and none over another."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any


def free(folder: Path, name: str, ending: str) -> Path:
  """Returns a path that is not taken; in the order of names, later ones follow."""
  path, k = folder / f"{name}{ending}", 1
  while path.exists():
    path, k = folder / f"{name}_{k}{ending}", k + 1
  return path


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], mode: str = "w") -> Iterator[IO[Any]]:
  """Opens a file that takes the place of `path` once it is complete and on the disk.

  Args:
    path: the file; its folder must exist
    mode: `w` (UTF-8) or `wb`
  """
  path = Path(os.path.realpath(path))  # a link goes on pointing there
  encoding = None if "b" in mode else "utf-8"
  if path.exists() and not path.is_file():  # a device or a pipe cannot be replaced
    with path.open(mode, encoding=encoding) as file:
      yield file
    return
  part = path.with_name(f".{path.name}.{os.getpid()}.part")
  try:
    with part.open(mode, encoding=encoding) as file:
      yield file
      file.flush()
      os.fsync(file.fileno())
    os.replace(part, path)
  finally:
    part.unlink(missing_ok=True)
