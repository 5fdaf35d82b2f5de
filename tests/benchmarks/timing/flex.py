"""World-steps a second against force error, beside mujoco_warp's own flex on the same device.

    palpate bench flex --device cuda:0

The shell that bends and the solid of `peer`, 642 nodes at the surface, pinned below, a ball pressed
6 mm into it at 50 mm/s: the same mesh, mass, constants, contacts and drive for mujoco_warp's flex
(`discrete`, CG) and for a batch of ours (a window). Errors are those of the contact force on the
ball in one world, RMS over its peak, against the same side at h = 62.5 us and a tolerance of 1e-6:
mujoco_warp's flex in one world, ours on the CPU in float64. A step's force is compared with that of
its start and of its end, and the better one counts. Then all worlds go on from the press, each ball
moved by 0.9 to 1 mm every five steps, and whole steps are timed, as replays of a CUDA graph.

On CUDA the first run compiles mujoco_warp's collision of flexes and tools for minutes.
"""

from __future__ import annotations

import argparse
import functools
import math
import pathlib
import time

import mujoco
import mujoco_warp as mjw
import numpy as np
import palpate.batch
import warp as wp
from benchmarks import plots, results
from benchmarks.accuracy import peer
from benchmarks.runner import Bench, Case, Row
from benchmarks.timing import batch

TOLERANCES = {"flex": (1e-6, 1e-4), "ours": (1e-3, 1e-2)}  # float32 has no finer ones
STEPS = (1e-3, 2e-3, 4e-3)  # [s]
KINDS = ("bending", "solid")  # of `peer`
LEVELS = (0.05, 0.02, 0.01)  # of the errors that rates are compared at
TIMED, BLOCK = 20, 5  # steps
# Of a world of mujoco_warp's. The ball has 6 candidates, of which 1 or 2 become contacts.
ROOM = {"nconmax": 64, "nccdmax": 4, "njmax": 128, "njmax_nnz": 128 * 16}
_SLOW = mjw.OverflowType.ITERATIONS | mjw.OverflowType.LS_ITERATIONS  # solvers that gave up
_COLUMNS = ("side", "kind", "nodes", "h", "tolerance", "nworld", "step_ms", "rate", "error",
            "force_N", "world_kB", "failures", "made_s")  # fmt: skip


class Flex:
  """Worlds of mujoco_warp's flex.

  Args:
    kind: of tissue, one of `KINDS`
    nodes: of the surface
    h: time step [s]
    tolerance: of the solver
    nworld: number of worlds
    device: as of `palpate.batch`
  """

  def __init__(self, kind: str, nodes: int, h: float, tolerance: float, nworld: int, device: str):
    self.h, self.nworld, self.device = h, nworld, wp.get_device(device)
    model = peer.model(_level(nodes), "peer", kind, tolerance, h)
    model.opt.tolerance = tolerance
    with wp.ScopedDevice(self.device):
      self.model = mjw.put_model(model)
      self.data = mjw.make_data(model, nworld=nworld, **ROOM)
      self.graph = None
      mjw.step(self.model, self.data)  # compiles
      if self.device.is_cuda:
        with wp.ScopedCapture() as capture:
          mjw.step(self.model, self.data)
        self.graph = capture.graph
      mjw.reset_data(self.model, self.data)

  def step(self, places: np.ndarray, count: int = 1):
    """Takes steps with the balls driven to `places` (nworld,) [m]."""
    self.data.ctrl.assign(places[:, None].astype(np.float32))
    with wp.ScopedDevice(self.device):
      for _ in range(count):
        wp.capture_launch(self.graph) if self.graph else mjw.step(self.model, self.data)

  def follow(self, other: Flex):
    """Puts all worlds where the first of `other` is."""
    for name in ("qpos", "qvel", "qacc_warmstart"):
      first = getattr(other.data, name).numpy()[0]
      getattr(self.data, name).assign(np.tile(first, (self.nworld, 1)))

  @property
  def force(self) -> float:
    """The force on the ball of the first world [N]."""
    return float(self.data.qfrc_constraint.numpy()[0, -1])

  @property
  def failures(self) -> int:
    """How many worlds have numbers that are not finite.

    Raises:
      RuntimeError: there was no room for something; it is named.
    """
    lost = mjw.OverflowType(int(np.bitwise_or.reduce(self.data.overflow.numpy()))) & ~_SLOW
    if lost:
      raise RuntimeError(f"mujoco_warp has no room: {lost.name}, with {ROOM} a world")
    return int((~np.isfinite(self.data.qpos.numpy()).all(axis=1)).sum())


class Ours:
  """Worlds of a batch; see `Flex`."""

  def __init__(self, kind: str, nodes: int, h: float, tolerance: float, nworld: int, device: str):
    self.h, self.nworld = h, nworld
    spec = mujoco.MjSpec.from_string(peer.mjcf(_level(nodes), "window", kind, tolerance, h))
    self.batch = palpate.batch.make(spec, nworld, device)

  def step(self, places: np.ndarray, count: int = 1):
    """Takes steps with the balls driven to `places` (nworld,) [m]."""
    self.batch.ctrl = places[:, None].astype(np.float32)
    self.batch.step(count)

  def follow(self, other: Ours):
    """Presses all worlds."""
    press(self)

  @property
  def force(self) -> float:
    """The force on the ball of the first world [N]."""
    return -float(self.batch.organ("organ").contact_force.numpy()[0, :, 2].sum())

  @property
  def failures(self) -> int:
    """How many worlds had numbers that are not finite, or no room for contacts."""
    lost = self.batch.overflow.numpy() + self.batch.failures.numpy()
    return int(np.count_nonzero(lost))


SIDES = {"flex": Flex, "ours": Ours}


def _level(nodes: int) -> int:
  return round(math.log((nodes - 2) / 10, 4))


def press(worlds: Flex | Ours) -> np.ndarray:
  """Presses the balls in; returns the force at the ends of steps, from 0 on [N]."""
  forces = [0.0]
  for k in range(round(peer.DURATION / worlds.h)):
    worlds.step(np.full(worlds.nworld, peer.place(k, worlds.h)))
    forces.append(worlds.force)
  return np.array(forces)


@functools.cache
def exact(side: str, kind: str, nodes: int, device: str, h: float) -> np.ndarray:
  """Returns the force that this side's smallest steps have [N]."""
  if side == "flex":
    return press(Flex(kind, nodes, h, TOLERANCES["flex"][0], 1, device))
  run = peer.Run(kind, nodes, "window", h, 1e-6)
  run.finish()
  return run.force


def measure(
  side: str, kind: str, nodes: int, h: float, tolerance: float, nworld: int, device: str
) -> Row:
  """Returns how exact a press is, and what a step of `nworld` worlds takes after it."""
  start, target = time.perf_counter(), wp.get_device(device)
  few = SIDES[side](kind, nodes, h, tolerance, min(nworld, 4), device)
  made = time.perf_counter() - start
  force = press(few)
  smallest = (1 if nodes > 162 else 8) * peer.FINEST
  off = peer.error(force, exact(side, kind, nodes, device, smallest))
  free = target.free_memory if target.is_cuda else math.nan
  worlds = SIDES[side](kind, nodes, h, tolerance, nworld, device)
  worlds.follow(few)
  wp.synchronize_device(target)
  used = free - target.free_memory if target.is_cuda else math.nan
  deep = peer.place(peer.DURATION / h, h)
  times = []
  for k in range(TIMED // BLOCK):
    back = 0.001 * (k % 2 == 0) * np.linspace(1.0, 0.9, nworld)
    begin = time.perf_counter()
    worlds.step(deep + back, BLOCK)
    wp.synchronize_device(target)
    times.append((time.perf_counter() - begin) / BLOCK)
  step = float(np.median(times[1:]))
  return {
    "side": side, "kind": kind, "nodes": nodes, "h": h, "tolerance": tolerance,
    "nworld": nworld, "step_ms": 1e3 * step, "rate": nworld / step,
    "error": off, "force_N": force[-1],
    "world_kB": used / nworld / 1e3, "failures": worlds.failures, "made_s": made,
  }  # fmt: skip


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--device", default="cpu", help="cpu, or cuda:0 (%(default)s)")
  add("--worlds", type=int, nargs="+", default=[32, 256, 1024, 4096])
  add("--kinds", nargs="+", choices=KINDS, default=KINDS)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a setting in 1024 worlds, then a case a number of worlds with the first."""
  nodes, many, steps = (162, 2, (4e-3,)) if args.short else (642, 1024, STEPS)
  tried = [
    (side, kind, h, tolerance, many)
    for kind in (args.kinds[:1] if args.short else args.kinds)
    for h in steps
    for side, tolerances in TOLERANCES.items()
    for tolerance in tolerances[: 1 if args.short else None]
  ]  # fmt: skip
  counts = [] if args.short else [w for w in args.worlds if w != many]
  tried += [
    (side, kind, STEPS[0], t[0], w)
    for w in counts
    for kind in args.kinds
    for side, t in TOLERANCES.items()
  ]
  return [[
    {"case": f"{kind}-{side}-{1e3 * h:g}-{tolerance:g}-{w}", "side": side, "kind": kind,
     "nodes": nodes, "h": h, "tolerance": tolerance, "nworld": w, "device": args.device}
    for side, kind, h, tolerance, w in tried
  ]]  # fmt: skip


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  return [measure(**{key: value for key, value in case.items() if key != "case"})]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for kind in dict.fromkeys(r["kind"] for r in rows):
    most = max(r["nworld"] for r in rows if r["kind"] == kind)
    here = [r for r in rows if (r["kind"], r["nworld"]) == (kind, most)]
    for level in LEVELS:
      ours, flex = (
        max((r["rate"] * r["h"] for r in here if r["side"] == side and r["error"] <= level),
            default=0.0)
        for side in ("ours", "flex")
      )  # fmt: skip
      if ours and flex:
        lines.append(f"{kind}, {most} worlds, error up to {100 * level:g} %: ours simulates "
                     f"{ours / flex:.2g} times as much time a second.")  # fmt: skip
        break
  return lines


def draw(rows: list[Row], out: pathlib.Path) -> pathlib.Path:
  """Draws simulated time a second over the force error, of settings that none beats in both."""
  panels: dict = {}
  rate = lambda r: r["rate"] * r["h"]  # noqa: E731
  for key in dict.fromkeys((r["kind"], r["nworld"], r["side"]) for r in rows):
    mine = [r for r in rows if (r["kind"], r["nworld"], r["side"]) == key]
    mine = [
      r for r in mine if not any(o["error"] <= r["error"] and rate(o) > rate(r) for o in mine)
    ]
    mine.sort(key=lambda r: r["error"])
    line = [100 * r["error"] for r in mine], [rate(r) for r in mine]
    panels.setdefault(key[0], {})[f"{key[2]}, {key[1]} worlds"] = line
  title = "The best settings of each; above and left is better"
  return plots.curves(out / "flex.png", title, panels, "force error [%]", "simulated s a second")


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  order = ("kind", "nworld", "side", "h", "tolerance")
  table = [
    [row["kind"], row["nworld"], row["side"].replace("flex", "mujoco_warp's flex"),
     f"{1e3 * row['h']:g}", f"{row['tolerance']:g}", f"{row['step_ms']:.3g}", f"{row['rate']:.3g}",
     f"{row['rate'] * row['h']:.3g}", f"{100 * row['error']:.2g}", f"{row['force_N']:.3g}",
     f"{row['world_kB']:.0f}" if row["world_kB"] > 0 else "-"]
    for row in sorted(rows, key=lambda row: [row[key] for key in order])
  ]  # fmt: skip
  head = ["kind", "worlds", "side", "h [ms]", "tolerance", "step [ms]", "world-steps/s",
          "simulated s/s", "error [%]", "force [N]", "a world [kB]"]  # fmt: skip
  lines = [str(__doc__).split("\n\n", 2)[2], "", *plots.table(head, table), ""]
  for kind, count in sorted({(row["kind"], row["nworld"]) for row in rows}):
    here = [row for row in rows if (row["kind"], row["nworld"]) == (kind, count)]
    for level in LEVELS:
      fastest = [
        max((r["rate"] * r["h"] for r in here if r["side"] == side and r["error"] <= level),
            default=0.0)
        for side in ("ours", "flex")
      ]  # fmt: skip
      if all(fastest):
        lines.append(f"{kind}, {count} worlds, error up to {100 * level:g} %: ours simulates "
                     f"{fastest[0] / fastest[1]:.3g} times as much time a second.\n")  # fmt: skip
  lines += [*batch.PUBLISHED, "", results.link(path)]
  title = "Batches beside mujoco_warp's flex"
  return results.Page(title, finding(rows), lines, [draw(rows, path.parent)])


BENCH = Bench("flex", stages, run, _COLUMNS, report, arguments, file="flex_{device}")
