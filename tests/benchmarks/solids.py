"""Run time against error of a solid, beside MuJoCo's tetrahedral flex with the same tetrahedra.

The ball of `peer`, pressed by 6 mm at 50 mm/s, with every time step, scheme and tolerance. Times
are those of a simulated second, in processor time of one thread, least of three repeats that
take turns. Errors are those of the contact force on the instrument, RMS over its peak, against the
same side at h = 62.5 us and a tolerance of 1e-6 (ours) or 1e-10 with right weights of the corners
of touched triangles; a step's force is compared with that of its start and of its end, and the
better one counts. That the flex's tetrahedra lock at nu = 0.45 is in both of its forces, so no part
of its error. `--beside PYTHON` has the flex of another MuJoCo, of that interpreter's packages, take
its blocks of steps in turn with the others, against its own smallest steps.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import pathlib
import subprocess
import sys
from collections.abc import Iterator

import mujoco
import numpy as np
from benchmarks import peer, plots, results
from benchmarks.peer import Side
from benchmarks.results import BenchError
from benchmarks.runner import Bench, Case, Row

DURATION = 0.1  # [s]
STEPS = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3)  # [s]
FINEST = 6.25e-5  # [s]
LEVELS = (0.02, 0.01, 0.005, 0.002, 0.001)
TOLERANCES = {"window": (1e-4, 1e-2, 1e-1), "peer": (1e-8, 1e-4, 1e-2)}
REPEATS, BLOCK = 3, 10


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns one case a size."""
  keys = {"short": int(args.short), "beside": str(args.beside or "")}
  return [[{"case": f"{n}-solid", "nodes": n} | keys for n in ((162,) if args.short else (642,))]]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--beside", metavar="PYTHON", type=pathlib.Path, help="with this package, another MuJoCo")


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
    self.about = {"side": side, "mujoco": mujoco.__version__,
                  "scheme": scheme if side == "window" else "discrete", "h": h,
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


class Beside:
  """A `Run` in another interpreter.

  Args:
    process: `serve` there
    keys: of the `Run`
  """

  def __init__(self, process: subprocess.Popen, keys: dict):
    self._process, self.h = process, keys["h"]
    self._number, self.about, self.count = self._ask("make", keys)

  def _ask(self, word: str, *values):
    process = self._process
    assert process.stdin and process.stdout
    process.stdin.write(json.dumps([word, *values]) + "\n")
    process.stdin.flush()
    line = process.stdout.readline()
    if not line:
      raise BenchError("the other interpreter has ended; expected this package there", code=1)
    return json.loads(line)

  def restart(self):
    """Starts over."""
    self._ask("restart", self._number)

  def go(self, first: int):
    """Takes a block of steps."""
    self._ask("go", self._number, first)

  def finish(self):
    """Takes all steps."""
    self._ask("finish", self._number)

  @property
  def time(self) -> float:
    """Median time of a step [ms]."""
    return self._ask("time", self._number)

  @property
  def force(self) -> np.ndarray:
    """Force at the ends of steps, from 0 on [N], (nstep + 1,)."""
    return np.array(self._ask("force", self._number))


def serve():
  """Makes and takes runs as lines of JSON on the standard input say, and answers on the output."""
  say, runs = os.fdopen(os.dup(1), "w", buffering=1), []
  os.dup2(2, 1)  # what libraries print
  for line in sys.stdin:
    word, about, *values = json.loads(line)
    if word == "make":
      runs.append(Run(**about))
      answer = len(runs) - 1, runs[-1].about, runs[-1].count
    else:
      found = getattr(runs[about], word)
      answer = found(*values) if callable(found) else found
    say.write(json.dumps(answer, default=np.ndarray.tolist) + "\n")


@contextlib.contextmanager
def another(python: str) -> Iterator[subprocess.Popen | None]:
  """Starts `serve` in another interpreter, if one is given."""
  if not python:
    yield None
    return
  paths = [str(pathlib.Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]
  env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
  command = [python, "-m", "benchmarks.solids"]
  try:
    with subprocess.Popen(
      command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env
    ) as process:
      yield process
  except OSError as error:
    raise BenchError(f"beside is {python!r}, expected an interpreter: {error.strerror}") from None


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the rows of a size."""
  with another(case["beside"]) as other:
    return measure(case["nodes"], bool(case["short"]), other)


def measure(nodes: int, short: bool, other: subprocess.Popen | None) -> list[Row]:
  """Returns a row a side and setting."""
  steps, finest = (STEPS[2:4], 4 * FINEST) if short else (STEPS, FINEST)
  runs = [
    Run(nodes, "window", h, tolerance, scheme)
    for h in steps
    for tolerance in TOLERANCES["window"]
    for scheme in ("implicit", "midpoint")
  ]
  theirs = [{"nodes": nodes, "side": "peer", "h": h, "tolerance": tolerance}
            for h in steps for tolerance in TOLERANCES["peer"]]  # fmt: skip
  runs += [Run(**keys) for keys in theirs]
  runs += [Run(nodes, "peer", h, TOLERANCES["peer"][0], weighs=True) for h in steps]
  runs += [Beside(other, keys) for keys in theirs if other]
  for _ in range(1 if short else REPEATS):
    for each in runs:
      each.restart()
    for first in range(0, max(each.count for each in runs), BLOCK):
      for each in runs:
        each.go(first)
  exact = {}
  for side, tolerance in (("window", 1e-6), ("peer", 1e-10)):
    one = exact[side, mujoco.__version__] = Run(
      nodes, side, finest, tolerance, weighs=side == "peer"
    )
    one.finish()
  if other:
    keys = {"nodes": nodes, "side": "peer", "h": finest, "tolerance": 1e-10}
    one = Beside(other, keys)
    exact["peer", one.about["mujoco"]] = one
    one.finish()
  forces = {key: one.force for key, one in exact.items()}
  rows = []
  for each in runs:
    force, time = each.force, each.time
    off = error(force, forces[each.about["side"], each.about["mujoco"]])
    rows.append({"nodes": nodes, **each.about, "step_ms": time, "second_s": time / (1e3 * each.h),
                 "error": off, "force_N": force[-1]})  # fmt: skip
  return rows


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
  here = next(str(r["mujoco"]) for r in rows if r["side"] == "window")
  sides = {"ours, window": [r for r in rows if r["side"] == "window"]}
  for version in sorted({str(r["mujoco"]) for r in rows}):
    theirs = [r for r in rows if r["side"] == "peer" and str(r["mujoco"]) == version]
    sides[f"flex of mujoco {version}"] = [r for r in theirs if r["weights"] == "as is"]
    if version == here:
      sides[f"flex of {version}, right weights"] = theirs

  def least(mine: list[Row], level: float) -> Row | None:
    return min((r for r in mine if r["error"] <= level), key=lambda r: r["second_s"], default=None)

  def cell(r: Row | None, ours: Row | None) -> str:
    if r is None:
      return "-"
    times = f", {r['second_s'] / ours['second_s']:.3g} times ours" if ours and ours != r else ""
    return f"{r['second_s']:.3g} s ({r['scheme']} {1e3 * r['h']:g} ms, {r['tolerance']:g}){times}"

  table = []
  for level in LEVELS:
    ours, *best = [least(mine, level) for mine in sides.values()]
    table.append([f"{100 * level:g} %", *(cell(r, ours) for r in (ours, *best))])
  lines = [str(__doc__).partition("\n\n")[2], "", "## Least time of a simulated second", ""]
  lines += [*plots.table(["error", *sides], table), "", "## All", ""]
  every = [
    [r["side"].replace("window", "ours").replace("peer", f"flex of {r['mujoco']}"), r["scheme"],
     r["weights"], f"{1e3 * r['h']:g}", f"{r['tolerance']:g}", f"{r['step_ms']:.3g}",
     f"{r['second_s']:.3g}", f"{100 * r['error']:.2g}", f"{r['force_N']:.3g}"]
    for r in rows
  ]  # fmt: skip
  head = ["side", "scheme", "weights", "h [ms]", "tolerance", "step [ms]", "second [s]"]
  head += ["error [%]", "force [N]"]
  lines += [*plots.table(head, every), "", results.link(out / "solids.csv")]
  return [results.page(out / "solids.md", "Run time against error of a solid", about, lines)]


BENCH = Bench("solids", stages, run, report=report, arguments=arguments)

if __name__ == "__main__":
  serve()
