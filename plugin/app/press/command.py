"""`palpate run press`: a probe presses an organ; a table, a CSV, a plot and a film of it."""

import argparse
import contextlib
import dataclasses
import math
import pathlib
import shutil
import sys
import tempfile
from collections.abc import Sequence

import numpy as np
from palpate import register

from .. import console
from ..console import CommandError
from ..draw import film

_NODES, _SEED = 1000, 1  # of the organ that ships
_SIZE = (0.9, 0.7, 0.48)  # flattens the lobed ball
_FPS, _SLOWER = 30, 4  # of the film


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.epilog = "All quantities in SI units. Files go to the output folder as press.*."
  add = parser.add_argument
  add("--scene", metavar="FILE", help="MJCF with an organ and a probe (the scene that ships)")
  add("--organ", metavar="NAME", help="organ to measure (the first)")
  add("--actuator", metavar="NAME", default="probe", help="actuator of the probe (%(default)s)")
  add("--depth", metavar="M", type=float, default=0.01, help="indentation (%(default)s m)")
  add("--speed", metavar="M/S", type=float, default=0.05, help="of the probe (%(default)s m/s)")
  add("--hold", metavar="S", type=float, default=0.5, help="time at that depth (%(default)s s)")
  add("--h", metavar="S", type=float, help="time step (the scene's)")
  add("--nodes", metavar="N", type=int, help="remake the shipped organ with this number of nodes")
  add("--seed", metavar="N", type=int, help="remake the shipped organ with other lobes")
  add(
    "--coupling", choices=("nodal", "window"),
    help="window: MuJoCo has only the nodes near the probe (the scene's)",
  )  # fmt: skip
  add("--device", metavar="DEVICE", help="cpu, cuda:0 or auto (the scene's)")
  add(
    "--set", metavar="KEY=VALUE", action="append", default=[],
    help="an organ's configuration key, as young=8000; may be repeated",
  )  # fmt: skip
  add("--out", metavar="FOLDER", default="out", help="output folder (%(default)s)")
  add(
    "--video", metavar="FILE", nargs="?", const="",
    help=f"film it, {_SLOWER} times slower: .mp4 or .gif (press.mp4 in the output folder)",
  )  # fmt: skip
  add(
    "--picture", metavar="FILE", nargs="?", const="",
    help="draw the scene at its deepest: .png (press_deepest.png in the output folder)",
  )  # fmt: skip


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  _check(args)
  out = console.output_folder("out", args.out)
  video = _file(args, "video", out / "press.mp4", film.FILMS)
  picture = _file(args, "picture", out / "press_deepest.png", film.PICTURES)
  register()
  from . import figures, probe

  with console.Interrupt() as interrupt, _warnings():
    console.Progress().show("loading; the first run takes some seconds longer", always=True)
    model, data, organ = _load(args)
    run = _Run(model, data, organ, probe.find(model, args.actuator), filmed=bool(video))
    failure = run.press(args, out / "press.csv", interrupt)
    print(console.table(_summary(model, organ, run.samples)))
    print(f"\n{out / 'press.csv'}: {len(run.samples)} steps")
    if failure:
      print(f"palpate: {failure}; the data up to there is kept", file=sys.stderr)
      return 1
    if interrupt.seen:
      print("palpate: interrupted; the data up to there is kept", file=sys.stderr)
      return 130
    try:
      name = pathlib.Path(args.scene).name if args.scene else "press"
      title = f"{name}: {1e3 * args.depth:g} mm at {1e3 * args.speed:g} mm/s"
      figures.plot(run.samples, out / "press.png", title)
      print(f"{out / 'press.png'}: force and displacement over time")
    except CommandError as error:
      print(f"palpate: no plot: {error}", file=sys.stderr)
    if picture and run.deepest is not None:
      figures.picture(model, data, run.deepest, picture)
      print(f"{picture}: the organ at its deepest")
    if video:
      print(f"{video}: {figures.shots(model, data, run.states, video, _FPS, interrupt)} frames")
    if interrupt.seen:
      print("palpate: interrupted; the film ends early", file=sys.stderr)
      return 130
    return 0


class _Run:
  """A press, and what is kept of it.

  Attributes:
    samples: of every step
    states: snapshots for the film
    deepest: the last snapshot of the hold, None before
  """

  def __init__(self, model, data, organ, tool, filmed: bool):
    self._model, self._data, self._organ, self._tool = model, data, organ, tool
    self._every = max(round(1 / (_FPS * _SLOWER) / model.opt.timestep), 1) if filmed else 0
    self.samples, self.states, self.deepest = [], [], None

  def press(
    self, args: argparse.Namespace, path: pathlib.Path, interrupt: console.Interrupt
  ) -> str | None:
    """Presses and writes the CSV; returns what went wrong."""
    from . import figures, probe

    model, data, progress = self._model, self._data, console.Progress()
    names = [field.name for field in dataclasses.fields(probe.Sample)]
    steps = probe.press(model, data, self._organ, self._tool, args.depth, args.speed, args.hold)
    with console.csv_rows(path, names) as write:
      for sample in steps:
        self.samples.append(sample)
        write(getattr(sample, name) for name in names)
        if self._every and len(self.samples) % self._every == 1 % self._every:
          self.states.append(figures.snapshot(model, data))
        if args.picture is not None and sample.phase == "hold":
          self.deepest = figures.snapshot(model, data)
        progress.show(
          f"{sample.phase:<8} {sample.time_s:6.3f} s  depth {1e3 * sample.depth_m:5.2f} mm  "
          f"force {sample.force:6.3f} N"
        )
        failure = _failure(data, self._organ, sample)
        if failure or interrupt.seen:
          break
    progress.clear()
    return failure


def _check(args: argparse.Namespace):
  for name, most in (("depth", 1.0), ("speed", 10.0), ("hold", 60.0), ("h", 0.02)):
    value = getattr(args, name)
    low = name == "hold"
    if value is not None and not (math.isfinite(value) and 0 <= value <= most and (low or value)):
      unit = {"depth": "m", "speed": "m/s"}.get(name, "s")
      span = f"{'[' if low else '('}0, {most:g}]"
      raise CommandError(f"{name} is {value:g} {unit}, expected a number in {span}")
  if args.nodes is not None and not 100 <= args.nodes <= 100000:
    raise CommandError(f"nodes is {args.nodes}, expected a number in [100, 100000]")
  if args.seed is not None and not 0 <= args.seed < 2**32:
    raise CommandError(f"seed is {args.seed}, expected a number in [0, 2^32)")
  if args.scene and (args.nodes is not None or args.seed is not None):
    raise CommandError("nodes and seed make the shipped organ anew; they do not go with --scene")


def _file(args, option: str, default: pathlib.Path, suffixes: tuple) -> pathlib.Path | None:
  """Returns the file an option asks for, `default` if it names none, None without the option."""
  name = getattr(args, option)
  if name is None:
    return None
  path = console.output(option, name or default, suffixes)
  film.check(path.suffix)
  return path


def folder() -> pathlib.Path:
  """Returns the folder of the scene that ships."""
  import palpate.models

  return pathlib.Path(palpate.models.__path__[0]) / "press"


def organ_mesh(nodes: int = _NODES, seed: int = _SEED) -> tuple[np.ndarray, np.ndarray]:
  """Returns the shipped organ's vertices [m] (n, 3) and triangles (m, 3), resting on z = 0."""
  from palpate.models import shapes

  vertices, triangles = shapes.lobed(nodes, seed)
  vertices = vertices * _SIZE
  low, high = vertices.min(axis=0), vertices.max(axis=0)
  vertices -= [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]]
  return np.round(vertices, 6), triangles


def write_organ(path: pathlib.Path | str, nodes: int = _NODES, seed: int = _SEED):
  """Writes the shipped organ as an OBJ file."""
  from palpate.models import mjcf

  pathlib.Path(path).write_text(mjcf.obj(*organ_mesh(nodes, seed)), encoding="utf-8")


def _load(args: argparse.Namespace):
  """Returns model, data and organ of the scene with the options applied."""
  with contextlib.ExitStack() as stack:
    if args.scene:
      path = pathlib.Path(args.scene)
      if not path.is_file():
        raise CommandError(f"no scene {args.scene!r}, expected an MJCF file")
    elif args.nodes is None and args.seed is None:
      path = folder() / "scene.xml"
    else:
      copy = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
      shutil.copytree(folder(), copy, dirs_exist_ok=True)
      seed = _SEED if args.seed is None else args.seed
      write_organ(copy / "assets" / "organ.obj", args.nodes or _NODES, seed)
      path = copy / "scene.xml"
    return _compile(path.resolve(), args)


def _compile(path: pathlib.Path, args: argparse.Namespace):
  import mujoco
  from palpate import windows as author
  from palpate.engine.model.mjstruct import NAME
  from palpate.organ import Organ, instances
  from palpate.tissue import config

  changes = {}
  for text in [*args.set, *([f"device={args.device}"] if args.device else [])]:
    key, equals, value = text.partition("=")
    if not equals or key not in config.KEYS:
      raise CommandError(f"--set {text!r}, expected KEY=VALUE with one of {', '.join(config.KEYS)}")
    changes[key] = value
  try:
    spec = mujoco.MjSpec.from_file(str(path))
    if args.coupling:
      _couple(spec, args.coupling, author)
    ours = {b.plugin.name for b in spec.bodies if b.plugin.plugin_name == NAME}
    for plugin in spec.plugins:
      if plugin.name in ours:
        plugin.config = {**plugin.config, **changes}
    if args.h is not None:
      spec.option.timestep = args.h
    model = spec.compile()
    data = mujoco.MjData(model)
  except (ValueError, mujoco.FatalError) as error:
    raise CommandError(f"scene {path.name}: {console.compile_error(error)}") from None
  if model.nkey:
    mujoco.mj_resetDataKeyframe(model, data, 0)
  if not (names := list(instances(model))):
    raise CommandError(f"no organ in {path.name}, expected a flexcomp with plugin {NAME!r}")
  with console.one_line(before=f"scene {path.name}: "):
    return model, data, Organ(model, data, args.organ or names[0])


def _couple(spec, coupling: str, author):
  """Gives every nodal organ a window, where that is asked for."""
  for organ, windowed in author.organs(spec).items():
    if coupling == "window" and not windowed:
      author.add_windows(spec, organ)
    elif coupling == "nodal" and windowed:
      raise CommandError(f"coupling is 'nodal', organ {organ!r} is declared with windows")


@contextlib.contextmanager
def _warnings():
  """Shows each of MuJoCo's warnings once, on one line, instead of a log file."""
  import mujoco

  shown = set()

  def show(text):
    line = text.decode(errors="replace") if isinstance(text, bytes) else str(text)
    if line not in shown:
      shown.add(line)
      print(f"palpate: MuJoCo warns: {' '.join(line.split())}", file=sys.stderr)

  mujoco.set_mju_user_warning(show)
  try:
    yield
  finally:
    mujoco.set_mju_user_warning(None)


def _failure(data, organ, sample) -> str | None:
  import mujoco

  if sample.pierced:
    return (
      f"the probe went through the surface at t = {sample.time_s:.3f} s, "
      f"{1e3 * sample.depth_m:.1f} mm deep: no force from there on is that of a press"
    )
  if organ.error:
    return organ.error
  kind = mujoco.mjtWarning
  for bad in (kind.mjWARN_BADQPOS, kind.mjWARN_BADQVEL, kind.mjWARN_BADQACC):
    if data.warning[bad].number:
      return f"organ {organ.name!r}: the motion diverged and MuJoCo reset it; try a smaller --h"
  return None


def _summary(model, organ, samples: Sequence) -> list[tuple[str, str]]:
  steps = np.array([s.step_s for s in samples]) if samples else np.full(1, np.nan)
  force = np.array([s.force for s in samples])
  held = np.array([s.force for s in samples if s.phase == "hold"])
  static = float(held[-max(len(held) // 5, 1) :].mean()) if held.size else math.nan
  iterations = [s.iterations for s in samples] or [0]
  # A step at rest may keep a large share of next to nothing, within a few iterations.
  most, tolerance = organ.config.iterations, organ.config.tolerance
  ended = [s.residual for s in samples if s.iterations >= most and s.residual > tolerance]
  h = model.opt.timestep
  return [
    ("device", organ.device),
    ("nodes", str(organ.nvert)),
    ("elements", str(len(organ.elem))),
    ("h", f"{1e3 * h:g} ms"),
    ("step time, median", f"{1e3 * np.median(steps):.3f} ms"),
    ("step time, 99th percentile", f"{1e3 * np.percentile(steps, 99):.3f} ms"),
    ("real-time factor", f"{h * len(steps) / steps.sum():.2f}"),
    ("contact force, peak", f"{force.max(initial=0):.4f} N"),
    ("contact force, static", f"{static:.4f} N" if held.size and not samples[-1].pierced else "-"),
    ("indentation", f"{1e3 * max([s.depth_m for s in samples], default=0):.2f} mm"),
    ("contacts, most", str(max([s.contacts for s in samples], default=0))),
    ("PCG iterations a step, mean", f"{np.mean(iterations):.1f}"),
    ("PCG iterations a step, most", str(max(iterations))),
    (f"steps that hit a solve's limit, {most}", str(len(ended))),
    *([("largest residual of those", f"{max(ended):.1e}")] if ended else []),
  ]
