"""Writes the files under models/<organ>/: `python -m palpate.models.build [NAME ...]`.

The files are those of the default resolution and the mean shape; the same source gives the same
bytes.
"""

import argparse
import pathlib
from collections.abc import Sequence

from . import scene
from .catalog import NAMES

INSTRUMENTS = ("probe", "grasper")  # of the committed scenes


def files(name: str) -> dict[pathlib.Path, str]:
  """Returns the content of every file of an organ, by path."""
  shape = scene.body(name)
  at = scene.path(name, scene=False)
  mesh = f"{shape.entry.shape}.obj"
  return {
    at.parent / "assets" / mesh: scene.obj(shape),
    at: scene.organ_xml(shape, name, mesh),
    scene.path(name): scene.scene_xml(shape, name, INSTRUMENTS),
  }


def main(arguments: Sequence[str] | None = None):
  """Writes the files of the organs named, or of all."""
  parser = argparse.ArgumentParser(description=__doc__)
  parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
  for name in parser.parse_args(arguments).names or NAMES:
    for path, text in files(name).items():
      path.parent.mkdir(parents=True, exist_ok=True)
      path.write_text(text)
      print(path)


if __name__ == "__main__":
  main()
