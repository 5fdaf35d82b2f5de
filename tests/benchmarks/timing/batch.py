"""World-steps a second of batches, a probe in contact in each world, and what a world takes.

    palpate bench batch --device cuda:0

An octahedral sphere of radius 5 cm (E = 30 kPa, t = 2 mm, 0.1 kg, foundation 1e5 Pa/m, h = 1 ms) is
pressed by a ball of 6 mm on a slide, to depths of up to 6 mm that differ from world to world. Then
whole steps are timed, while every ten steps the balls are driven 1 mm up or down. `force_rms` is
the difference of the probe's force from that of the plugin on the CPU over the press of the world
that is pressed deepest, as a share of the greatest. On CUDA the parts of a step are timed by
themselves afterwards: the organ's before and after mujoco_warp's step, and that. Several devices
share the worlds: `--device cuda:0+cuda:1`.

    palpate bench batch --device cuda:0 --nodes 258 --worlds 256 --thread 57

lays a silk 3-0 of so many nodes, 2.5 mm apart, over the sphere in place of the ball.

    palpate bench batch --device cuda:0 --worlds 256 --bend 0 --fls 0.1 3 6.5 8.5

steps the scene of FLS's knots from states of an expert's episode of `suture/knot_easy`, so many
seconds after its start: the held thread settles, is wound, its short tail is taken, and the throw
is drawn down. 20 steps are timed, in which the needle drivers hold still.
"""

from __future__ import annotations

import argparse
import itertools
import pathlib
import time

import mujoco
import numpy as np
import palpate
import palpate.batch
import scenes
import warp as wp
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate.models.meshing import grid
from palpate.tasks import suite
from palpate.tasks.core import performer
from palpate.tasks.core.stage import STATE
from palpate.tasks.domains.suturing import knot

RADIUS, BALL, H, DEEP = 0.05, 0.006, 1e-3, 0.006
EDGE = 2.5e-3  # of a thread [m]
STEPS, FEW = 150, 20  # of the press, and of what is timed together; of FLS's knots


def scene(nodes: int, bend: float, condim: int, tolerance: float, thread: int = 0) -> mujoco.MjSpec:
  """Returns an organ of about `nodes` nodes under a ball, or a thread of some nodes."""
  point, elem = grid.octasphere(max(2, round(np.sqrt((nodes - 2) / 4))))
  keys = {"young": 3e4, "poisson": 0.3, "foundation": 1e5, "bend": bend, "tolerance": tolerance}
  contact = {"condim": condim}
  organ = scenes.organ(RADIUS * np.asarray(point), elem, contact=contact, **keys)
  if thread:
    made = scenes.world(organ, h=H, gravity=(0, 0, -9.81), tolerance=1e-8)
    spec = mujoco.MjSpec.from_string(made)
    lay(spec, thread)
    return spec
  ball = scenes.ball(RADIUS + BALL + 0.0007, BALL)
  drive = '<actuator><position joint="z" kp="500" kv="10"/></actuator>'
  return mujoco.MjSpec.from_string(scenes.world(organ, ball, h=H, tolerance=1e-8, extra=drive))


def lay(spec: mujoco.MjSpec, count: int):
  """Lays a thread over the sphere, its ends hanging."""
  r = RADIUS + 0.0013
  s = EDGE * (np.arange(count) - 0.5 * (count - 1))
  angle = np.clip(s / r, -np.pi / 2, np.pi / 2)
  below = np.abs(s - r * angle)
  palpate.add_thread(spec, np.stack([r * np.sin(angle), 0 * s, r * np.cos(angle) - below], axis=1))


def knots(seconds: float):
  """Returns the scene of FLS's knots, and what puts worlds where an expert's episode is then."""
  kwargs = {"random": 0, "surroundings": "none"}
  environment = suite.load("suture", "knot_easy", task_kwargs=kwargs)
  expert, step = performer.make(environment, seed=0), environment.reset()
  while environment.physics.time() < seconds:
    step = environment.step(expert(step))
  task, physics = environment.task, environment.physics
  state = np.empty(mujoco.mj_stateSize(physics.model.ptr, STATE))
  mujoco.mj_getState(physics.model.ptr, physics.data.ptr, state, STATE)

  def begin(batch):
    data = mujoco.MjData(batch.model)
    mujoco.mj_setState(batch.model, data, state, STATE)
    mujoco.mj_forward(batch.model, data)
    batch.start(data)
    batch.reset()
    batch.ctrl = np.tile(data.ctrl.astype(np.float32), (batch.nworld, 1))
    (thread,) = batch.threads.values()
    for k, hand in enumerate(physics.hands):
      place = task.anchors[k] + batch.model.site(f"{hand.prefix}tip").pos
      same = (np.full(batch.nworld, task.held[k]), np.tile(place, (batch.nworld, 1)))
      thread.hold(f"{hand.prefix}{thread.name}", *same, np.full(batch.nworld, task.firm[k]))

  return task.dressed(task.variants[0]), begin


def depths(nworld: int) -> np.ndarray:
  """Returns how deep the ball of each world is driven, the first one deepest [m]."""
  return np.linspace(DEEP, 0.5 * DEEP, nworld)


def press(batch, record: bool = False) -> np.ndarray:
  """Drives the balls down; returns the force on the first world's in each step [N]."""
  forces = []
  for k in range(STEPS):
    if batch.model.nu == 1:
      batch.ctrl = -(depths(batch.nworld) * min(1.0, 1.5 * k / STEPS))[:, None]
    batch.step()
    if record:
      forces.append(batch.organ("organ").contact_force.numpy()[0].sum(axis=0)[2])
  return np.array(forces)


def alone(spec: mujoco.MjSpec) -> np.ndarray:
  """Returns the forces of `press` that the plugin finds."""
  return press(palpate.batch.make(spec, 1), record=True)


def measure(
  device: str,
  nodes: int,
  nworld: int,
  slots: int | None,
  bend: float,
  condim: int,
  tolerance: float,
  repeat: bool,
  thread: int = 0,
  fls: float | None = None,
) -> dict:
  """Returns what steps of a batch take."""
  if fls is None:
    spec, begin = scene(nodes, bend, condim, tolerance, thread), None
  else:
    spec, begin = knots(fls)
  names = device.split("+")
  start, target = time.perf_counter(), wp.get_device(names[0] if "cuda" in names[0] else "cpu")
  free = target.free_memory if target.is_cuda else 0
  where = names if len(names) > 1 else device
  batch = palpate.batch.make(spec, nworld, where, nodes=slots, deterministic=repeat)
  made, rms = time.perf_counter() - start, float("nan")
  steps = STEPS
  if begin:
    (own,) = batch.threads.values()
    steps, thread = FEW, own.xpos.shape[1]
    begin(batch)
    batch.step(FEW)
    begin(batch)
  elif nworld <= 1024 and condim == 1 and not thread:
    found, expected = press(batch, record=True), alone(scene(nodes, bend, condim, tolerance))
    rms = float(np.sqrt(np.mean((found - expected) ** 2)) / np.abs(expected).max())
  else:
    press(batch)
  wp.synchronize()
  here = nworld / len(names)
  used = (free - target.free_memory) / here if target.is_cuda else float("nan")
  before = time.perf_counter()
  for k in range(steps // 10):
    if batch.model.nu == 1:
      batch.ctrl = -(depths(nworld) - 0.001 * (k % 2))[:, None]
    batch.step(10)
  wp.synchronize()
  step = (time.perf_counter() - before) / (steps // 10 * 10)
  tissue = batch.organ("organ")
  residual, iterations = tissue.residual.numpy(), tissue.iterations.numpy()
  force = tissue.contact_force.numpy().sum(axis=1)[:, 2] if nworld <= 4096 else [float("nan")]
  return {
    "device": device,
    "nodes": tissue.nvert,
    "nworld": nworld,
    "slots": slots or 0,
    "bend": bend,
    "condim": condim,
    "tolerance": tolerance,
    "repeat": repeat,
    "thread": thread,
    "step_ms": 1e3 * step,
    "rate": nworld / step,
    "world_kB": used / 1e3,
    "iterations": float(np.mean(iterations)),
    "residual": float(np.median(residual)),
    "force_N": float(np.median(force)),
    "force_rms": rms,
    "overflow": int(batch.overflow.numpy().max()),
    "failures": int(batch.failures.numpy().sum()),
    "make_s": made,
  } | (parts(batch) if where == device and target.is_cuda else dict.fromkeys(_PARTS, float("nan")))


PUBLISHED = (
  "Published by others, on other machines, and not run here: FF-SRL, 545 nodes and 1717",
  "tetrahedra, 8 substeps of one iteration a frame: 21,662 frames a second in 32 worlds on an",
  "RTX 2060 Mobile (arXiv:2503.18616; no residual is given); mujoco_warp's nightly `cloth` of",
  "902 nodes: 7,589 steps of 5 ms a second in 32 worlds on an RTX 6000 Ada.",
)
_PARTS = ("before_ms", "mujoco_warp_ms", "after_ms")


def parts(batch) -> dict[str, float]:
  """Returns what parts of a step take on a GPU, in ms."""
  works = (batch.begin, batch.step_tools, batch.end)
  out = {}
  for name, work in zip(_PARTS, works, strict=True):
    with wp.ScopedDevice(batch.device), wp.ScopedCapture(batch.device) as capture:
      work()
    times = []
    for _ in range(20):
      start, end = (wp.Event(batch.device, enable_timing=True) for _ in range(2))
      stream = batch.device.stream
      stream.record_event(start)
      wp.capture_launch(capture.graph, stream=stream)
      stream.record_event(end)
      times.append(wp.get_event_elapsed_time(start, end))
    out[name] = float(np.median(times))
  return out


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--device", default="cpu", help="cpu, cuda:0, or several, cuda:0+cuda:1 (%(default)s)")
  add("--nodes", type=int, nargs="+", default=[258, 678, 1026])
  add("--worlds", type=int, nargs="+", help="8 on the CPU; 1024, 4096 and 16384 on CUDA")
  add("--bend", type=float, nargs="+", default=[0.0, 1.0])
  add("--condim", type=int, nargs="+", default=[1])
  add("--tolerance", type=float, default=1e-3)
  add("--slots", type=int, nargs="+", help="nodes that the ball may touch, one a size or for all")
  add("--thread", type=int, default=0, help="nodes of a thread in place of the ball")
  add(
    "--fls",
    type=float,
    nargs="+",
    metavar="SECONDS",
    help="the scene of FLS's knots, so long into an expert's episode",
  )
  add("--repeat", action="store_true", help="runs that repeat to the bit whatever the GPU does")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a size, number of worlds, and kind of tissue and contact."""
  keys = {name: getattr(args, name) for name in ("device", "tolerance", "repeat", "thread")}
  sizes = [knot.FIELD.nodes] if args.fls else args.nodes
  slots = args.slots or [None]
  slots = dict(zip(sizes, slots * (len(sizes) // len(slots)), strict=True))
  worlds = args.worlds or ([8] if args.device == "cpu" else [1024, 4096, 16384])
  kind = "-repeat" * args.repeat + f"-thread{args.thread}" * bool(args.thread)
  many = f"-x{args.device.count('+') + 1}" * ("+" in args.device)
  cases = []
  for bend, c, n, w, t in itertools.product(
    args.bend, args.condim, sizes, worlds, args.fls or [None]
  ):
    at = "" if t is None else f"-fls{t:g}"
    name = f"{n}-{w}-{bend:g}-{c}-{slots[n] or 0}{kind}{at}{many}"
    own = {"nodes": n, "nworld": w, "bend": bend, "condim": c, "slots": slots[n], "fls": t}
    cases.append({"case": name} | own | keys)
  return [cases[:1] if args.short else cases]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  return [measure(**{key: value for key, value in case.items() if key != "case"})]


def table(out: pathlib.Path) -> list[str]:
  """Returns the lines of the page."""
  lines = [
    "From batch_cpu.csv and batch_cuda.csv; `palpate bench batch --help` says how they were",
    "measured. What a world takes is from the GPU's free memory before and after, which earlier",
    "cases that give theirs back blur: good to some tens of kB.",
    "",
    "| device | nodes | bend | condim | worlds | step | world-steps/s | a world | iterations | "
    "residual | force against the CPU | organ, mujoco_warp, organ |",
    "|" + "---|" * 12,
  ]
  for path in sorted(out.glob("batch_c*.csv")):
    for row in results.read(path):
      if row["status"] != "ok":
        continue
      rms = row["force_rms"]
      split = [f"{row[name]:.2f}" for name in _PARTS if row[name] == row[name]]
      same = " (repeats)" if str(row["repeat"]) in ("True", "1") else ""
      sewn = f", a thread of {row['thread']:g}" if row.get("thread") else ""
      cells = [
        row["device"] + same,
        f"{row['nodes']}{sewn}",
        row["bend"],
        row["condim"],
        row["nworld"],
      ]
      cells += [
        f"{row['step_ms']:.3g} ms",
        f"{row['rate']:.3g}",
        f"{row['world_kB']:.0f} kB" if row["nworld"] >= 4096 and row["world_kB"] > 0 else "-",
      ]
      solved = row["residual"] == row["residual"]
      cells += [f"{row['iterations']:.1f}", f"{row['residual']:.1e}"] if solved else ["-", "-"]
      cells += [
        f"{100 * rms:.2g} %" if rms == rms else "-",
        " + ".join(split) + " ms" if split else "-",
      ]
      lines.append(f"| {' | '.join(map(str, cells))} |")
  return lines


def draw(out: pathlib.Path) -> pathlib.Path:
  """Draws world-steps a second over the number of worlds on a GPU."""
  figure, (axes,) = plots.grid(1, 1, 6.4, 3.6)
  path = out / "batch_cuda.csv"
  found = [row for row in results.read(path) if row["status"] == "ok"] if path.exists() else []
  for bend, line in ((0, "o-"), (1, "s--")):
    for nodes in sorted({row["nodes"] for row in found}):
      mine = [r for r in found if (r["nodes"], r["bend"], r["device"]) == (nodes, bend, "cuda:0")]
      if not mine:
        continue
      mine.sort(key=lambda row: row["nworld"])
      label = f"{nodes} nodes{', bending' * bend}"
      axes.plot([r["nworld"] for r in mine], [r["rate"] / 1e6 for r in mine], line, label=label)
  axes.set(xlabel="worlds", ylabel="million world-steps a second")
  if axes.lines:
    axes.set(xscale="log", yscale="log")
    plots.plain(axes.xaxis)
    plots.plain(axes.yaxis)
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
  return plots.save(figure, out / "batch.png", "Batches on one GPU")


def finding(out: pathlib.Path) -> list[str]:
  """Returns what the page begins with."""
  rows = [r for path in sorted(out.glob("batch_c*.csv")) for r in results.read(path)]
  rows = [r for r in rows if r["status"] == "ok"]
  lines = []
  for device in dict.fromkeys(r["device"] for r in rows if r["device"].startswith("cuda")):
    best = max((r for r in rows if r["device"] == device), key=lambda r: r["rate"])
    lines.append(
      f"{1 + device.count('+')} GPU{'s' * ('+' in device)}: up to {best['rate'] / 1e6:.3g} "
      f"million world-steps a second ({best['nodes']} nodes, {best['nworld']} worlds)."
    )
  off = [r["force_rms"] for r in rows if r["device"] != "cpu" and r["force_rms"] >= 0]
  if off:
    lines.append(f"Forces differ from the CPU's by at most {100 * max(off):.1g} % of their peak.")
  return lines[-3:]


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page, of all devices that there are results of."""
  out, title = path.parent, "How many worlds a batch steps a second"
  return results.Page(title, finding(out), [*table(out), "", *PUBLISHED], [draw(out)])


BENCH = Bench("batch", stages, run, report=report, arguments=arguments, file="batch_{device}")
