"""Writes the files under models/<organ>/: `python -m palpate.models.build [NAME ...]`.

The files are those of the default resolution and the mean shape; the same source gives the same
bytes.
"""

import argparse
import pathlib
from collections.abc import Sequence

import trimesh

from . import markup, mjcf, organs, scene
from .catalog import NAMES

INSTRUMENTS = ("probe", "grasper")  # of the committed scenes


def files(name: str) -> dict[pathlib.Path, str]:
  """Returns the content of every file of an organ, by path."""
  build = organs.build(name)
  at = scene.path(name, scene=False)
  mesh = f"{build.entry.shape}.obj"
  assets = at.parent / "assets"
  made = {
    assets / mesh: mjcf.obj(build.vertices, build.triangles),
    at: markup.catalogued(build, name, mesh),
    scene.path(name): markup.scene(build, name, INSTRUMENTS),
  }
  if build.entry.backdrop is not None:  # drawn only, and as a mesh
    other = organs.build(build.entry.backdrop[0])
    soft = trimesh.Trimesh(other.vertices, other.triangles, process=False)
    trimesh.smoothing.filter_laplacian(soft, iterations=5)  # MuJoCo draws sharp creases in shards
    made[assets / f"{build.entry.backdrop[0]}.obj"] = mjcf.obj(soft.vertices, other.triangles)
  return made


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
