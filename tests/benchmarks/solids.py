"""Run time against error of a solid, beside MuJoCo's tetrahedral flex with the same tetrahedra.

The ball of `peer`, pressed by 6 mm at 50 mm/s, with every time step, scheme and tolerance. Times
are those of a simulated second, in processor time of one thread, least of three repeats that
take turns. Errors are those of the contact force on the instrument, RMS over its peak, against the
same side at h = 62.5 us and a tolerance of 1e-6 (ours) or 1e-10 with right weights of the corners
of touched triangles; a step's force is compared with that of its start and of its end, and the
better one counts. That the flex's tetrahedra lock at nu = 0.45 is in both of its forces, so no part
of its error.
"""

from __future__ import annotations

import argparse
import math
import pathlib

import mujoco
import numpy as np
from benchmarks import peer, plots, results
from benchmarks.peer import Side
from benchmarks.runner import Bench, Case, Row

DURATION = 0.1  # [s]
STEPS = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3)  # [s]
FINEST = 6.25e-5  # [s]
LEVELS = (0.02, 0.01, 0.005, 0.002, 0.001)
TOLERANCES = {"window": (1e-4, 1e-2), "peer": (1e-8, 1e-4)}
REPEATS, BLOCK = 3, 10


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns one case a size."""
  short = {"short": int(args.short)}
  return [[{"case": f"{n}-solid", "nodes": n} | short for n in ((162,) if args.short else (642,))]]


class Run(Side):
  """One side with one setting.

  Args:
    nodes: of the surface
    side: `window` or `peer`
    h: time step [s]
    tolerance: of its solver
    scheme: of ours
    weighs: whether MuJoCo's flex gets right weights
    kind: one of `peer.KINDS`
  """

  def __init__(self, nodes, side, h, tolerance, scheme="implicit", weighs=False, kind="solid"):
    m = peer.model(round(math.log((nodes - 2) / 10, 4)), side, kind, tolerance, h)
    if side == "peer":
      m.opt.tolerance = tolerance
    super().__init__(m, weighs=weighs)
    if self.organ and scheme != "implicit":
      self.organ.configure(integrator=scheme)
    self.h, self.count = h, round(DURATION / h)
    self.about = {"side": side, "scheme": scheme if side == "window" else "discrete", "h": h,
                  "tolerance": tolerance, "weights": "right" if weighs else "as is"}  # fmt: skip

  def go(self, first: int):
    """Takes a block of steps, unless it has come to its end."""
    for step in range(first, min(first + BLOCK, self.count)):
      self.data.ctrl[0] = place(step, self.h)
      self.take()

  def finish(self):
    """Takes all steps."""
    for first in range(0, self.count, BLOCK):
      self.go(first)

  @property
  def force(self) -> np.ndarray:
    """Force at the ends of steps, from 0 on [N], (nstep + 1,)."""
    return np.array([0.0, *self.forces])


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the rows of a size."""
  nodes, steps = case["nodes"], STEPS[2:4] if case["short"] else STEPS
  runs = [
    Run(nodes, "window", h, tolerance, scheme)
    for h in steps
    for tolerance in TOLERANCES["window"]
    for scheme in ("implicit", "midpoint")
  ]
  runs += [Run(nodes, "peer", h, tolerance) for h in steps for tolerance in TOLERANCES["peer"]]
  runs += [Run(nodes, "peer", h, TOLERANCES["peer"][0], weighs=True) for h in steps]
  for _ in range(1 if case["short"] else REPEATS):
    for each in runs:
      each.restart()
    for first in range(0, max(each.count for each in runs), BLOCK):
      for each in runs:
        each.go(first)
  exact = {}
  finest = (4 if case["short"] else 1) * FINEST
  for side, tolerance in (("window", 1e-6), ("peer", 1e-10)):
    exact[side] = Run(nodes, side, finest, tolerance, weighs=side == "peer")
    exact[side].finish()
  return [
    {"nodes": nodes, **each.about, "step_ms": each.time, "second_s": each.time / (1e3 * each.h),
     "error": error(each.force, exact[each.about["side"]].force), "force_N": each.forces[-1]}
    for each in runs
  ]  # fmt: skip


def place(step: float, h: float) -> float:
  """Returns where the instrument is driven in a step [m]."""
  return -0.05 * (step + 0.5) * h - 0.001


def error(force: np.ndarray, exact: np.ndarray) -> float:
  """Returns the RMS error of the forces at the ends of steps over the peak, from 0 on."""
  ends = exact[:: (len(exact) - 1) // (len(force) - 1)]
  off = [force[1:] - theirs for theirs in (ends[1:], ends[:-1])]
  return float(min(np.sqrt(np.mean(each**2)) for each in off) / np.abs(exact).max())


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  sides = {
    "ours": [r for r in rows if r["side"] == "window"],
    "flex": [r for r in rows if r["side"] == "peer" and r["weights"] == "as is"],
    "right": [r for r in rows if r["side"] == "peer"],
  }

  def least(mine: list[Row], level: float) -> Row | None:
    return min((r for r in mine if r["error"] <= level), key=lambda r: r["second_s"], default=None)

  def cell(r: Row | None) -> str:
    if r is None:
      return "-"
    return f"{r['second_s']:.3g} s ({r['scheme']} {1e3 * r['h']:g} ms, {r['tolerance']:g})"

  def faster(theirs: Row | None, ours: Row | None) -> str:
    return f"{theirs['second_s'] / ours['second_s']:.3g}" if theirs and ours else "-"

  table = []
  for level in LEVELS:
    best = {name: least(mine, level) for name, mine in sides.items()}
    ratios = [faster(best[name], best["ours"]) for name in ("flex", "right")]
    table.append([f"{100 * level:g} %", *map(cell, best.values()), *ratios])
  head = ["error", "ours, window", f"flex of mujoco {mujoco.__version__}", "flex, right weights"]
  lines = [str(__doc__).partition("\n\n")[2], "", "## Least time of a simulated second", ""]
  lines += plots.table([*head, "times faster", "than with right weights"], table)
  lines += ["", "## All", ""]
  every = [
    [r["side"].replace("window", "ours").replace("peer", "flex"), r["scheme"], r["weights"],
     f"{1e3 * r['h']:g}", f"{r['tolerance']:g}", f"{r['step_ms']:.3g}", f"{r['second_s']:.3g}",
     f"{100 * r['error']:.2g}"]
    for r in rows
  ]  # fmt: skip
  head = ["side", "scheme", "weights", "h [ms]", "tolerance", "step [ms]", "second [s]"]
  lines += [*plots.table([*head, "error [%]"], every), "", results.link(out / "solids.csv")]
  return [results.page(out / "solids.md", "Run time against error of a solid", about, lines)]


BENCH = Bench("solids", stages, run, report=report)
