"""`palpate wrap`: a mesh or a segmented volume becomes an organ, in a model folder of its own."""

import argparse
import math
import pathlib
import re
import sys

from palpate import register

from .console import CommandError, compile_error, table
from .press import figures

_NODES = 1000


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.epilog = (
    "Parts of the mesh that the organ leaves out or fills are listed with their volume. Then "
    "nothing is written and the exit code is 1, unless --accept-losses or --pieces is given."
  )
  add = parser.add_argument
  add(
    "mesh", metavar="MESH",
    help="OBJ, STL, PLY, glTF; a volume in NIfTI or NRRD; the folder of a DICOM series",
  )  # fmt: skip
  add(
    "-o", "--out", metavar="FOLDER", required=True, help="the model folder to write, new or empty"
  )
  add("--force", action="store_true", help="write into a folder with files, which are replaced")
  add("--nodes", metavar="N", type=int, help=f"nodes of the organ ({_NODES})")
  add("--method", choices=("even", "grid", "direct"), default="even", help="(%(default)s)")
  add("--scale", metavar="X", help="metres per unit of a mesh, or its unit: m, cm, mm, inch (m)")
  add(
    "--label", metavar="K", action="append",
    help="number or name of a label of a volume, or all; may be repeated",
  )  # fmt: skip
  add(
    "--threshold", metavar="X", type=float,
    help="lowest value of the organ in a scan, which need be no label map (CT: Hounsfield units)",
  )  # fmt: skip
  add("--upper", metavar="X", type=float, default=math.inf, help="highest value of the organ")
  add("--pieces", action="store_true", help="make an organ of every separate piece")
  add("--accept-losses", action="store_true", help="write the organ even if it leaves parts out")
  add("--name", help="of the organ (the file's)")
  add("--young", metavar="PA", type=float, help="Young's modulus (the liver's)")
  add("--foundation", metavar="PA/M", type=float, help="foundation (the liver's; of a solid none)")
  add("--solid", action="store_true", help="fill it with tetrahedra instead of a skin")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from palpate.models.meshing import folder, wrap

  figures.need("video", "imageio")
  source = pathlib.Path(args.mesh)
  if not (source.is_file() or source.is_dir()):
    raise CommandError(f"no file {str(source)!r}")
  constants = {k: getattr(args, k) for k in ("young", "foundation") if getattr(args, k) is not None}
  constants["solid"] = args.solid
  nodes = args.nodes or (None if args.method == "direct" else _NODES)
  name = args.name if args.name is not None else _name(source, args.out)
  try:
    _check(args, source)
    wrap.check(nodes, args.method)
    folder.check(args.out, [name], overwrite=args.force, **constants)
    organs = _wrap(args, source, name, nodes)
    lost = _show(organs)
    if lost and not args.accept_losses:
      raise CommandError(_advice(lost, args), code=1)
    paths = folder.write(args.out, organs, overwrite=args.force, **constants)
  except (ValueError, ImportError) as error:
    raise CommandError(_words(str(error))) from None
  except OSError as error:
    raise CommandError(f"cannot write to {args.out!r}: {error.strerror}") from None
  paths.append(picture(paths, next(iter(organs))))
  print("\n".join(str(path) for path in paths))
  return 0


def _name(source: pathlib.Path, out: str) -> str:
  """Returns a name for the organ: the file's, or the folder's if that is the scene's."""
  from palpate.models.meshing import folder

  for text in (source.name.split(".")[0], pathlib.Path(out).absolute().name, "organ"):
    name = _allowed(text)
    if name.strip("_") and name.lower() != folder.SCENE:
      return name
  return "organ"


def _allowed(text: str) -> str:
  return re.sub(r"[^A-Za-z0-9_-]+", "_", text)


def _check(args: argparse.Namespace, source: pathlib.Path):
  """Refuses options that would do nothing, and a folder that the mesh itself is in danger in."""
  from palpate.models.meshing import images

  volume, scan = images.is_volume(source), args.threshold is not None
  if volume and args.scale is not None:
    raise CommandError("--scale goes with a mesh; a volume has its own units")
  if not volume and (args.label or scan):
    option = "--threshold" if scan else "--label"
    kinds = ", ".join(images.KINDS)
    raise CommandError(f"{option} goes with a volume ({kinds}, or the folder of a DICOM series)")
  if source.is_dir() and not scan:
    raise CommandError(f"{str(source)!r} is a folder, and a DICOM series needs --threshold")
  if scan and args.label:
    raise CommandError("--label goes with a label map, --threshold with a scan; expected one")
  if not scan and args.upper != math.inf:
    raise CommandError("--upper goes with --threshold")
  inside = (source.resolve(), *source.resolve().parents)
  if args.force and pathlib.Path(args.out).resolve() in inside:
    raise CommandError(f"{str(source)!r} is in the folder that --force writes into")


def _wrap(args: argparse.Namespace, source: pathlib.Path, name: str, nodes: int | None) -> dict:
  """Returns what was wrapped, by name."""
  from palpate.models.meshing import images, volume, wrap

  if not images.is_volume(source):
    options = {"method": args.method, "scale": args.scale or 1.0}
    if args.pieces:
      return _named(name, wrap.wrap_pieces(source, nodes, **options))
    return _named(name, [wrap.wrap(source, nodes, **options)])
  labels = volume.read(source, args.threshold, args.upper)
  print(labels)
  if args.label == ["all"]:
    chosen = list(labels.segments)
  else:
    chosen = [labels.segment(label) for label in args.label or [None]]
  organs = {}
  for segment in chosen:
    made = volume.wrap_label(labels, segment, nodes, method=args.method, pieces=args.pieces)
    own = name if len(chosen) == 1 else f"{name}_{_allowed(segment.name or str(segment.value))}"
    organs |= _named(own if own not in organs else f"{own}_{segment.value}", made)
  return organs


def _named(name: str, made: list) -> dict:
  if len(made) == 1:
    return {name: made[0]}
  return {f"{name}_{k + 1}": each for k, each in enumerate(made)}


def _show(organs: dict) -> list[str]:
  """Prints the reports; returns a line for everything that is left out or filled."""
  lost = []
  for name, (_, _, report) in organs.items():
    print(table([("organ", name), *(row for row in report.rows() if row[0] != "loss")]))
    for loss in report.losses:
      print(f"{name}: {loss}", file=sys.stderr)
      lost.append(loss.kind)
  return lost


def _advice(lost: list[str], args: argparse.Namespace) -> str:
  options = ["--accept-losses writes it as it is"]
  if "piece" in lost and not args.pieces:
    options.append("--pieces makes an organ of every separate piece")
  if {"part", "filled", "rest"} & set(lost) and args.method != "direct":
    options.append("--nodes with a larger number may follow more")
  return f"nothing is written, for parts are left out or filled: {'; '.join(options)}"


def _words(message: str) -> str:
  """Returns a message of Python's in the words of the command."""
  message = re.sub(r"\b(scale|method)='(\w+)'", r"--\1 \2", message)
  message = message.replace("needs a threshold", "needs --threshold")
  return message.replace("and nothing in it is to be lost", "--force writes into it")


def picture(paths: list[pathlib.Path], name: str) -> pathlib.Path:
  """Returns the picture of the scene that was written, which shows that it loads and steps."""
  import imageio.v2 as imageio
  import mujoco

  register()
  scene = paths[0]
  try:
    model = mujoco.MjModel.from_xml_path(str(scene))
  except ValueError as error:
    raise CommandError(f"{scene} does not compile: {compile_error(error)}", code=1) from None
  data = mujoco.MjData(model)
  mujoco.mj_step(model, data)
  out = scene.parent / f"{name}.png"
  out.unlink(missing_ok=True)  # a link is replaced, not followed
  with mujoco.Renderer(model, 480, 640) as renderer:
    renderer.update_scene(data, camera="overview")
    imageio.imwrite(out, renderer.render())
  return out
