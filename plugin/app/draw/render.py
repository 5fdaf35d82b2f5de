"""`palpate render`: a picture or a film of a scene, without a screen."""

import argparse
import math
from collections.abc import Iterator

import numpy as np
from palpate import register

from ..console import CommandError, Interrupt, Progress, output
from . import film

_FORCE = 0.1  # length of an arrow that is a newton [m]
_WIDTH = 0.0015  # of an arrow [m]
_ARROW = np.array([1.0, 0.85, 0.2, 1.0], np.float32)
_INK = np.array([0.12, 0.05, 0.05, 1.0], np.float32)  # of edges


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  from . import scenes

  scenes.add_arguments(parser)
  add = parser.add_argument
  add("-o", "--out", metavar="FILE", required=True, help="ends in .png, .webp, .jpg, .mp4 or .gif")
  add("--camera", metavar="NAME", help="camera of the scene, or free (laparoscope, else the first)")
  add("--size", metavar="WxH", default="1280x960", help="pixels (%(default)s)")
  add(
    "--seconds", metavar="S", type=float,
    help="simulated time: a picture shows its end, a film all of it (0, 2); in an exercise its "
    "expert acts, until the episode ends at most",
  )  # fmt: skip
  add("--fps", metavar="N", type=int, default=25, help="frames a second of a film (%(default)s)")
  add("--slower", metavar="X", type=float, default=1.0, help="slow motion (%(default)s)")
  add("--edges", action="store_true", help="draw the organ's edges over its surface")
  add("--wireframe", action="store_true", help="draw edges instead of surfaces")
  add(
    "--forces", action="store_true", help="draw contact forces on the instruments, 10 cm a newton"
  )
  add("--sites", action="store_true", help="draw the targets")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  width, height = _check(args)
  out = output("out", args.out, (*film.PICTURES, *film.FILMS))
  film.check(out.suffix)
  register()
  from . import scenes

  moving = out.suffix.lower() in film.FILMS
  seconds = args.seconds if args.seconds is not None else (2.0 if moving else 0.0)
  model, data, step = scenes.load(args, handle=False)
  with Interrupt() as interrupt, film.renderer(model, width, height) as renderer:
    shots = _shots(args, model, data, step, renderer, seconds, moving)
    progress = Progress()
    frames = 0
    with film.write(out, args.fps) as write:
      for image in shots:
        write(image)
        frames += 1
        progress.show(f"{data.time:.2f} of {seconds:g} s")
        if interrupt.seen:
          break
    progress.clear()
  print(f"{out}: {frames} frame{'s' * (frames != 1)} of {width} x {height}")
  return 130 if interrupt.seen else 0


def _check(args: argparse.Namespace) -> tuple[int, int]:
  """Returns width and height."""
  size = film.size(args.size)
  for name, most in (("seconds", 600.0), ("slower", 100.0)):
    value = getattr(args, name)
    if value is not None and not (math.isfinite(value) and 0 <= value <= most):
      raise CommandError(f"{name} is {value:g}, expected a number in [0, {most:g}]")
  if not args.slower:
    raise CommandError("slower is 0, expected a number in (0, 100]")
  if not 1 <= args.fps <= 240:
    raise CommandError(f"fps is {args.fps}, expected a whole number in [1, 240]")
  return size


def _camera(model, name: str | None) -> int | str:
  from . import scenes

  names = [model.camera(i).name for i in range(model.ncam)]
  if name == "free":
    return -1
  if name is None:
    return scenes.first_camera(model)
  if name not in names:
    raise CommandError(f"camera is {name!r}, expected one of {', '.join([*names, 'free'])}")
  return name


def _shots(args, model, data, step, renderer, seconds: float, moving: bool) -> Iterator[np.ndarray]:
  """Yields the pictures while the scene runs."""
  import mujoco

  camera = _camera(model, args.camera)
  option = mujoco.MjvOption()
  if args.sites:
    option.sitegroup[3] = 1
  renderer.scene.flags[mujoco.mjtRndFlag.mjRND_WIREFRAME] = args.wireframe
  nframe = max(round(seconds * args.fps * args.slower), 1) if moving else 1
  start = data.time
  for k in range(nframe):
    running = step(seconds * k / nframe if moving else seconds)
    if not np.isfinite(data.qpos).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
      raise CommandError(f"the motion diverged before {data.time:.3g} s", code=1)
    if data.time == start:
      mujoco.mj_forward(model, data)
    renderer.update_scene(data, camera, option)
    if args.edges:
      _draw_edges(model, data, renderer.scene, option)
    if args.forces:
      _draw_forces(model, data, renderer.scene)
    yield renderer.render()
    if not running:
      return


def _draw_edges(model, data, scene, option):
  """Adds the edges of every flex surface that is drawn, as lines just above its skin."""
  import mujoco
  from palpate.tissue.geometry.mesh import vertex_normals

  for flex in range(model.nflex):
    first, count = model.flex_vertadr[flex], model.flex_vertnum[flex]
    adr, nelem = model.flex_elemdataadr[flex], model.flex_elemnum[flex]
    skin = f"{mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, flex)}_skin"
    covered = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SKIN, skin) >= 0
    shown = covered or option.flexgroup[model.flex_group[flex]]
    if model.flex_dim[flex] != 2 or not shown:
      continue
    pos = data.flexvert_xpos[first : first + count]
    elem = model.flex_elem[adr : adr + 3 * nelem].reshape(nelem, 3)
    above = pos + 1.2 * model.flex_radius[flex] * vertex_normals(pos, elem)
    adr = model.flex_edgeadr[flex]
    for a, b in above[model.flex_edge[adr : adr + model.flex_edgenum[flex]]]:
      _connect(scene, mujoco.mjtGeom.mjGEOM_LINE, 1.5, a, b, _INK)


def _draw_forces(model, data, scene):
  """Adds an arrow for the contact force on every geom, and makes the geoms see-through for them."""
  import mujoco

  for geom in scene.geoms[: scene.ngeom]:
    if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and model.geom_bodyid[geom.objid]:
      geom.rgba[3] *= 0.35
      geom.transparent = 1
  total: dict[int, np.ndarray] = {}  # of each geom: force, force times position, sum of weights
  wrench = np.zeros(6)
  for i, contact in enumerate(data.contact[: data.ncon]):
    mujoco.mj_contactForce(model, data, i, wrench)
    force = contact.frame.reshape(3, 3).T @ wrench[:3]  # on the second of the two
    weight = np.linalg.norm(force)
    row = np.concatenate([force, weight * contact.pos, [weight]])
    for geom, sign in zip(contact.geom, (-1, 1), strict=True):
      if geom >= 0 and weight:
        total[geom] = total.get(geom, 0) + row * np.repeat([sign, 1], [3, 4])
  for row in total.values():
    start = row[3:6] / row[6]
    end = start + _FORCE * row[:3]
    _connect(scene, mujoco.mjtGeom.mjGEOM_ARROW, _WIDTH, start, end, _ARROW)


def _connect(scene, kind, width: float, start, end, rgba):
  """Adds a line or an arrow to the scene, where there is room for it."""
  import mujoco

  if scene.ngeom < scene.maxgeom:
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), rgba)
    mujoco.mjv_connector(geom, kind, width, start, end)
    geom.emission = 0.5
    scene.ngeom += 1
