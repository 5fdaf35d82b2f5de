"""`palpate wrap`: a mesh or a segmented volume becomes an organ, in a model folder of its own."""

from __future__ import annotations

import argparse
import pathlib

from palpate import register

from . import figures
from .console import CommandError

_VOLUMES = (".nii", ".nii.gz", ".nrrd")


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("mesh", metavar="MESH", help="OBJ, STL, PLY, glTF, or a label map in NIfTI or NRRD")
  add("-o", "--out", metavar="FOLDER", required=True, help="the model folder to write")
  add("--nodes", metavar="N", type=int, default=1000, help="nodes of the organ (%(default)s)")
  add("--method", choices=("even", "grid", "direct"), default="even", help="(%(default)s)")
  add("--scale", metavar="X", type=float, default=1.0, help="file units to m: 0.001 for mm")
  add("--label", metavar="K", type=int, help="label of a volume to take")
  add("--name", help="of the organ (the file's)")
  add("--young", metavar="PA", type=float, help="Young's modulus (the liver's)")
  add("--foundation", metavar="PA/M", type=float, help="Winkler foundation (the liver's)")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from palpate.models import folder, volume
  from palpate.models import wrap as wrapping

  figures.need("video", "imageio")
  source = pathlib.Path(args.mesh)
  if not source.is_file():
    raise CommandError(f"no file {str(source)!r}")
  name = args.name or source.name.split(".")[0]
  constants = {k: getattr(args, k) for k in ("young", "foundation") if getattr(args, k) is not None}
  try:
    if source.name.lower().endswith(_VOLUMES):
      made = volume.wrap_volume(source, args.nodes, label=args.label, method=args.method)
    else:
      made = wrapping.wrap(source, args.nodes, method=args.method, scale=args.scale)
    vertices, triangles, report = made
    paths = folder.write(args.out, name, vertices, triangles, report, **constants)
  except ValueError as error:
    raise CommandError(str(error)) from None
  paths.append(_picture(paths, name))
  print(report)
  print("\n".join(str(path) for path in paths))
  return 0


def _picture(paths: list[pathlib.Path], name: str) -> pathlib.Path:
  """Returns the picture of the scene that was written, which shows that it loads and steps."""
  import imageio.v2 as imageio
  import mujoco

  register()
  scene = next(path for path in paths if path.name == "scene.xml")
  model = mujoco.MjModel.from_xml_path(str(scene))
  data = mujoco.MjData(model)
  mujoco.mj_step(model, data)
  out = scene.parent / f"{name}.png"
  with mujoco.Renderer(model, 480, 640) as renderer:
    renderer.update_scene(data, camera="overview")
    imageio.imwrite(out, renderer.render())
  return out
