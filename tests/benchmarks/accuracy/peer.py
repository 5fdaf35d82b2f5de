"""Run time against error beside MuJoCo's native flex, with every time step and tolerance.

The same icosphere, mass, documented constants, contact and instrument on all sides: a ball of 5 mm
radius is driven 6 mm at 50 mm/s towards a skin on a foundation, a shell that bends, a solid of the
same tetrahedra, or a limp skin without foundation and bending. The flex has
`integrator="discrete"` and the CG solver, with every tolerance and number of iterations of
`THEIRS`; ours has windows, and nodal coupling for skins.

Times are processor times of one thread for a simulated second, the least of several repeats. All
sides take blocks of steps in turn; a block keeps the caches warm. Errors are RMS errors of the
contact force on the instrument, over its peak, against the same side at a quarter of the smallest
step and a tolerance of 1e-6 (ours) or 1e-10 (flex, with right weights of the corners of touched
triangles). A step's force is compared with the reference at its start and at its end, and the
better one counts. The flex's tetrahedra lock at nu = 0.45 in both of its forces, so this is no part
of its error. `--beside PYTHON` adds the flex of another MuJoCo, from that interpreter's packages,
against its own smallest steps.
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
import time
from collections.abc import Iterator

import mujoco
import numpy as np
import palpate
import scenes
from benchmarks import plots, results, scene
from benchmarks.runner import Bench, Case, Row
from benchmarks.scene import Tissue
from palpate.app.console import CommandError
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology
from scenes import RADIUS

KINDS = {
  "skin": Tissue(),  # on a foundation
  "bending": Tissue(foundation=0.0, bend=1),
  "solid": Tissue(5e3, 0.45, foundation=0.0, mass=0.5, elements="solid"),
  "limp": Tissue(foundation=0.0),  # neither: what is left of such a skin's force is 5 mN
}
NODES = {"skin": (642, 2562), "bending": (642, 2562), "solid": (642,), "limp": (642,)}
DURATION = 0.1  # [s]
STEPS = (2.5e-4, 5e-4, 1e-3, 2e-3, 4e-3)  # [s]
FINEST = STEPS[0] / 4  # [s]
LARGE = 1000  # nodes above which the smallest step is left out
EVEN = 1e-3  # step at which sides are compared as well [s]
LEVELS = (0.05, 0.02, 0.01, 0.005, 0.002)
OURS = (1e-4, 1e-2, 1e-1)  # tolerances
THEIRS = ((1e-8, 100), (1e-6, 100), (1e-4, 100), (1e-3, 100), (1e-8, 20))  # and iterations
BLOCK = 10


def model(
  subdivisions: int, side: str, kind: str, tolerance: float = 1e-4, h: float = 1e-3
) -> mujoco.MjModel:
  """Returns the model of `mjcf`, with the tissue's constants on either side."""
  m = mujoco.MjModel.from_xml_string(mjcf(subdivisions, side, kind, tolerance, h))
  if side == "peer":
    scene.finish(m, topology.build("organ", *scenes.sphere(subdivisions)), KINDS[kind])
  return m


def mjcf(subdivisions: int, side: str, kind: str, tolerance: float = 1e-4, h: float = 1e-3) -> str:
  """Returns a sphere of one of `KINDS`, pressed from above, as `peer`, `nodal` or `window`."""
  shape = points, _ = scenes.sphere(subdivisions)
  tissue = KINDS[kind]
  pin = np.flatnonzero(points[:, 2] < -0.9 * RADIUS) if not tissue.foundation else ()
  contact = {"condim": 3, "solref": "0.019 1"}  # the plugin makes those of 0.02 firmer
  keys: dict = tissue.keys() | {"mass": tissue.mass, "tolerance": tolerance, "subgrid": "false"}
  if side == "peer":
    organ = _flex(shape, tissue, pin, contact)
  elif side == "nodal":
    organ = scenes.organ(*shape, pin=pin, contact=contact, **keys)
  else:
    keys["pin"] = " ".join(map(str, pin)) or None
    organ = scenes.windowed(*shape, count="10 8 1", contact=contact, **keys)
  probe = f"""<body pos="0 0 {RADIUS + 0.0056}"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.005" mass="0.05"/></body>"""
  drive = '<actuator><position joint="z" kp="500" kv="10"/></actuator>'
  integrator = "discrete" if side == "peer" else "Euler"
  return scenes.world(
    organ, probe, h=h, integrator=integrator, solver="CG", tolerance=1e-8, memory=2048, extra=drive
  )


def _flex(shape, tissue: Tissue, pin, contact) -> str:
  young, poisson, damping = tissue.young, tissue.poisson, tissue.damping
  keys = {"mass": tissue.mass, "pin": pin, "contact": contact}
  if tissue.elements == "solid":
    mesh = fill.fill("organ", topology.build("organ", *shape))
    inside = f'<elasticity young="{young}" poisson="{poisson}" damping="{damping}"/>'
    return scenes.flex(mesh.rest, mesh.tet, inside, dim=3, **keys)
  inside = scene.native(young, poisson, tissue.thickness, damping, tissue.bend)
  points, elem = shape
  return scenes.flex(points, elem, inside, **keys)


class Run:
  """One side with one setting.

  Args:
    kind: one of `KINDS`
    nodes: of the surface
    side: `window`, `nodal` or `peer`
    h: time step [s]
    tolerance: of its solver
    iterations: most that MuJoCo's solver takes
    scheme: of ours
    weighs: whether MuJoCo's flex gets right weights
  """

  def __init__(
    self, kind, nodes, side, h, tolerance, iterations=100, scheme="implicit", weighs=False
  ):
    m = self.model = model(round(math.log((nodes - 2) / 10, 4)), side, kind, tolerance, h)
    if side == "peer":
      m.opt.tolerance, m.opt.iterations = tolerance, iterations
    self.data, self.h, self.count = mujoco.MjData(m), h, round(DURATION / h)
    self.organ = palpate.Organ(m, self.data, "organ") if m.nplugin else None
    if self.organ and scheme != "implicit":
      self.organ.configure(integrator=scheme)
    weigh = scene.weigher(m, self.data) if weighs else None
    self.passive = (lambda *_: weigh()) if weigh else None
    self.repeats = []
    self.restart()
    self.about = {"kind": kind, "nodes": nodes, "side": side, "mujoco": mujoco.__version__,
                  "scheme": "discrete" if side == "peer" else scheme, "h": h,
                  "tolerance": tolerance, "iterations": iterations if side == "peer" else "",
                  "weights": "right" if weighs else "as is"}  # fmt: skip

  def restart(self):
    """Starts over."""
    mujoco.mj_resetData(self.model, self.data)
    self.times, self.forces = [], []
    self.repeats.append(self.times)

  def go(self, first: int):
    """Takes a block of steps, unless it has come to its end."""
    m, d = self.model, self.data
    mujoco.set_mjcb_passive(self.passive)
    for step in range(first, min(first + BLOCK, self.count)):
      d.ctrl[0] = place(step, self.h)
      start = time.thread_time()
      mujoco.mj_step(m, d)
      self.times.append(time.thread_time() - start)
      self.forces.append(float(d.qfrc_constraint[m.nv - 1]))
    mujoco.set_mjcb_passive(None)

  def finish(self):
    """Takes all steps."""
    for first in range(0, self.count, BLOCK):
      self.go(first)

  @property
  def time(self) -> float:
    """Median time of a step, each with its least of all repeats [ms]."""
    least = np.min([times for times in self.repeats if times], axis=0)
    return 1e3 * float(np.median(least[self.count // 5 :]))

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
      raise CommandError("the other interpreter has ended; expected this package there", code=1)
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
  paths = [str(pathlib.Path(__file__).parents[2]), os.environ.get("PYTHONPATH", "")]
  env = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
  command = [python, "-m", "benchmarks.accuracy.peer"]
  try:
    with subprocess.Popen(
      command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env
    ) as process:
      yield process
  except OSError as error:
    raise CommandError(f"beside is {python!r}, expected an interpreter: {error.strerror}") from None


def measure(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns a row a side and setting."""
  with another(case["beside"]) as other:
    return _measure(case["kind"], case["nodes"], case["short"], case["repeats"], other)


def _measure(kind: str, nodes: int, short: int, repeats: int, other) -> list[Row]:
  def keys(side: str, h: float, tolerance: float, **more) -> dict:
    return {"kind": kind, "nodes": nodes, "side": side, "h": h, "tolerance": tolerance} | more

  steps = STEPS[2:4] if short else STEPS[nodes > LARGE :]
  couplings = ("window",) if kind == "solid" else ("window", "nodal")
  ours = [
    keys(side, h, tolerance, scheme=scheme)
    for h in steps
    for side in couplings
    for tolerance in OURS
    for scheme in ("implicit", "midpoint")
  ]
  theirs = [keys("peer", h, tolerance, iterations=n) for h in steps for tolerance, n in THEIRS]
  right = [keys("peer", h, THEIRS[0][0], weighs=True) for h in steps]
  runs = [Run(**one) for one in (*ours, *theirs, *right)]
  runs += [Beside(other, one) for one in theirs if other]
  for _ in range(repeats):
    for each in runs:
      each.restart()
    for first in range(0, max(each.count for each in runs), BLOCK):
      for each in runs:
        each.go(first)
  exact = [Run(**keys(side, steps[0] / 4, 1e-6)) for side in couplings]
  last = keys("peer", steps[0] / 4, 1e-10)
  exact += [Run(**last, weighs=True), *([Beside(other, last)] if other else [])]
  forces = {}
  for one in exact:
    one.finish()
    forces[one.about["side"], one.about["mujoco"]] = one.force
  rows = []
  for each in runs:
    force, step = each.force, each.time
    off = error(force, forces[each.about["side"], each.about["mujoco"]])
    rows.append({**each.about, "step_ms": step, "second_s": step / (1e3 * each.h), "error": off,
                 "force_N": force[-1]})  # fmt: skip
  return rows


def place(step: float, h: float) -> float:
  """Returns where the instrument is driven in a step [m]."""
  return -0.05 * (step + 0.5) * h - 0.001


def error(force: np.ndarray, exact: np.ndarray) -> float:
  """Returns the RMS error of the forces at the ends of steps over the peak, from 0 on."""
  ends = exact[:: (len(exact) - 1) // (len(force) - 1)]
  off = [force[1:] - theirs for theirs in (ends[1:], ends[:-1])]
  return float(min(np.sqrt(np.mean(each**2)) for each in off) / np.abs(exact).max())


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--beside", metavar="PYTHON", type=pathlib.Path, help="with this package, another MuJoCo")
  add("--nodes", type=int, nargs="+", help="of every kind (`NODES`)")
  add("--repeats", type=int, default=2)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a size and kind."""
  keys = {"short": int(args.short), "beside": str(args.beside or ""), "repeats": args.repeats}
  counts = {kind: args.nodes or NODES[kind] for kind in KINDS}
  sizes = [(n, kind) for kind in KINDS for n in counts[kind][: 1 if args.short else None]]
  return [[{"case": f"{n}-{kind}", "nodes": n, "kind": kind} | keys for n, kind in sizes]]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for kind in dict.fromkeys(r["kind"] for r in rows):
    told = []
    for nodes in sorted({r["nodes"] for r in rows if r["kind"] == kind}):
      mine = [r for r in rows if (r["kind"], r["nodes"]) == (kind, nodes)]
      ours = _least([r for r in mine if r["side"] == "window"], 0.02)
      flex = _least([r for r in mine if (r["side"], r["weights"]) == ("peer", "as is")], 0.02)
      if ours and flex:
        ratio = flex["second_s"] / ours["second_s"]
        told.append(f"{ratio:.0f} times ({nodes} nodes, flex of {flex['mujoco']})")
    if told and kind != "limp":
      lines.append(f"{kind}, force error up to 2 %: the fastest flex takes {', '.join(told)} as "
                   "long as an organ with a window.")  # fmt: skip
  return lines


def draw(rows: list[Row], out: pathlib.Path) -> pathlib.Path:
  """Draws the least time to each error, for the smaller meshes."""
  panels: dict = {}
  for kind in dict.fromkeys(r["kind"] for r in rows):
    least = min(r["nodes"] for r in rows if r["kind"] == kind)
    mine = [r for r in rows if (r["kind"], r["nodes"], r["weights"]) == (kind, least, "as is")]
    lines: dict = {}
    for side, version in sorted({(r["side"], str(r["mujoco"])) for r in mine}, reverse=True):
      if side != "peer" and version != max(str(r["mujoco"]) for r in mine if r["side"] == side):
        continue
      here = [r for r in mine if (r["side"], str(r["mujoco"])) == (side, version)]
      front = sorted(
        (r for r in here if r == _least(here, r["error"])), key=lambda r: r["second_s"]
      )
      name = f"flex of {version}" if side == "peer" else f"organ, {side}"
      lines[name] = [r["second_s"] for r in front], [100 * r["error"] for r in front]
    panels[f"{kind}, {least} nodes"] = lines
  title = "Below and left is better"
  return plots.curves(out / "peer.png", title, panels, "CPU time of a simulated second [s]",
                      "force error [% of peak]")  # fmt: skip


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  sides: dict = {"organ, window": {"side": "window"}, "organ, nodal": {"side": "nodal"}}
  for version in sorted({r["mujoco"] for r in rows}, key=str):
    sides[f"flex of {version}"] = {"side": "peer", "mujoco": version, "weights": "as is"}
  least, steps = [], []
  for kind, nodes in dict.fromkeys((r["kind"], r["nodes"]) for r in rows):
    mine = [r for r in rows if (r["kind"], r["nodes"]) == (kind, nodes)]
    each = [[r for r in mine if key.items() <= r.items()] for key in sides.values()]
    for level in LEVELS:
      ours, *others = [_least(side, level) for side in each]
      if ours or any(others):
        cells = (_cell(r, ours, r["second_s"], "s") if r else "-" for r in (ours, *others))
        least.append([kind, nodes, f"{100 * level:g} %", *cells])
    each = [[r for r in side if r["h"] == EVEN] for side in each]
    ours, *others = [
      _least(side, 1.1 * min((r["error"] for r in side), default=0.0)) for side in each
    ]
    cells = (_cell(r, ours, r["step_ms"], "ms") if r else "-" for r in (ours, *others))
    steps.append([kind, nodes, *cells])
  lines = [str(__doc__).partition("\n\n")[2], "", "## Least time of a simulated second", ""]
  lines += ["In brackets scheme, time step, tolerance and error; `-`: no setting is as exact. "
            "Errors of MuJoCo 3.17 have its wrong weights of corners.", ""]  # fmt: skip
  lines += [*plots.table(["tissue", "nodes", "error", *sides], least), ""]
  lines += [f"## A step of {1e3 * EVEN:g} ms", ""]
  lines += ["The cheapest setting whose error is at most 1.1 times the least at this step.", ""]
  lines += [*plots.table(["tissue", "nodes", *sides], steps), ""]
  lines += ["Every setting, with its force: [peer.csv](peer.csv)."]
  title = "Run time against error beside MuJoCo's flex"
  return results.Page(title, finding(rows), lines, [draw(rows, path.parent)])


def _least(rows: list[Row], level: float) -> Row | None:
  fit = (r for r in rows if r["error"] <= level)
  return min(fit, key=lambda r: r["second_s"], default=None)


def _cell(r: Row, ours: Row | None, value: float, unit: str) -> str:
  how = f"{r['scheme']} {1e3 * r['h']:g} ms, {r['tolerance']:g}"
  how += f", {r['iterations']} iterations" if r["iterations"] not in ("", 100) else ""
  times = f", {r['second_s'] / ours['second_s']:.3g} times ours" if ours and ours != r else ""
  return f"{value:.3g} {unit} ({how}: {100 * r['error']:.2g} %){times}"


BENCH = Bench("peer", stages, measure, report=report, arguments=arguments)

if __name__ == "__main__":
  serve()
