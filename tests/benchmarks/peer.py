"""Times a whole mj_step in contact against MuJoCo's native flex, interleaved in one run.

    python tests/benchmarks/run.py peer

The same icosphere, mass, documented constants, contact and instrument on all sides, one thread
each: the peer with `integrator="discrete"` and the CG solver, ours with nodal and with window
coupling, at each `--tolerance`. Every side takes `--block` steps in a row in turn, so that it finds
in the caches what it left there, as it does when it runs alone. All of it is repeated, and a step
counts with its least time: other load on the machine takes memory from the peer first.

Errors are those of the contact force on the instrument, RMS of its peak, against the same side with
a time step 16 times smaller (ours to 1e-6) and right weights of the corners of touched triangles.
MuJoCo 3.17 has wrong ones, which are part of the peer's error; what is left without is given too. A
step's force is compared with that of its start and of its end, and the better one counts. The
peer's tolerance is MuJoCo's default; `--peer-tolerance` shows what another one would do. MuJoCo
3.17's `elastic2d="stretch"` reaches a documented (E, nu) with nu' = nu / 2 and
E' = 4 E (1 + nu / 2) / (1 + nu) (fixed in 4.0).

Solids are the same tetrahedra on both sides. Ours take windows alone; the peer's lock at nu = 0.45,
since it averages no volumes, which is no part of its error here.
"""

import argparse
import itertools
import pathlib
import time

import mujoco
import numpy as np
import palpate
import scenes
from benchmarks import plots, results, scene
from benchmarks.runner import Bench, Case, Row
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology
from scenes import RADIUS

YOUNG, POISSON, THICKNESS, MASS, DAMPING = 3e4, 0.3, 0.002, 0.1, 0.002
INSIDE = {"young": 5e3, "poisson": 0.45, "damping": DAMPING}  # of solids
SOLID_MASS = 0.5  # [kg]
H = 1e-3  # [s]
KINDS = ("skin", "bending", "solid")
SIDES = ("peer", "nodal", "window")


def model(
  subdivisions: int, side: str, kind: str, tolerance: float = 1e-4, h: float = H
) -> mujoco.MjModel:
  """Returns the model of `mjcf`."""
  return mujoco.MjModel.from_xml_string(mjcf(subdivisions, side, kind, tolerance, h))


def mjcf(subdivisions: int, side: str, kind: str, tolerance: float = 1e-4, h: float = H) -> str:
  """Returns a sphere of one of `KINDS` pinned below and pressed from above, on one of `SIDES`."""
  shape = points, _ = scenes.sphere(subdivisions)
  pin = np.flatnonzero(points[:, 2] < -0.9 * RADIUS)
  contact = {"condim": 3, "solref": "0.02 1"}
  organ = (_solid if kind == "solid" else _skin)(side, shape, kind, tolerance, pin, contact)
  probe = f"""<body pos="0 0 {RADIUS + 0.0056}"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.005" mass="0.05"/></body>"""
  drive = '<actuator><position joint="z" kp="500" kv="10"/></actuator>'
  integrator = "discrete" if side == "peer" else "Euler"
  return scenes.world(
    organ,
    probe,
    h=h,
    integrator=integrator,
    solver="CG",
    tolerance=1e-8,
    memory=2048,
    extra=drive,
  )


def _skin(side, shape, kind, tolerance, pin, contact) -> str:
  bend = int(kind == "bending")
  keys = {"young": YOUNG, "poisson": POISSON, "thickness": THICKNESS, "damping": DAMPING}
  if side == "peer":
    inside = scene.native(**keys, bend=bend)
    return scenes.flex(*shape, inside, mass=MASS, pin=pin, contact=contact)
  elif side == "nodal":
    keys |= {"bend": bend, "tolerance": tolerance}
    return scenes.organ(*shape, mass=MASS, pin=pin, contact=contact, **keys)
  keys |= {"bend": bend, "tolerance": tolerance, "mass": MASS, "pin": " ".join(map(str, pin))}
  return scenes.windowed(*shape, count="10 8 1", contact=contact, **keys)


def _solid(side, shape, kind, tolerance, pin, contact) -> str:
  if side == "peer":
    mesh = fill.fill("organ", topology.build("organ", *shape))
    keys = " ".join(f'{key}="{value}"' for key, value in INSIDE.items())
    inside = f"<elasticity {keys}/>"
    return scenes.flex(
      mesh.rest, mesh.tet, inside, mass=SOLID_MASS, pin=pin, contact=contact, dim=3
    )
  keys = INSIDE | {"elements": "solid", "tolerance": tolerance, "mass": SOLID_MASS}
  keys["pin"] = " ".join(map(str, pin))
  return scenes.windowed(*shape, count="10 8 1", contact=contact, **keys)


def measure(nodes: int, kind: str, args: argparse.Namespace) -> list[dict]:
  """Returns a row of results for each tolerance; times are medians after the first 20 steps."""
  subdivisions = round(np.log((nodes - 2) / 10) / np.log(4))
  sides, count = {}, args.steps + 20
  couplings = SIDES[2:] if kind == "solid" else SIDES[1:]
  for name, tolerance in [("peer", 0.0), *itertools.product(couplings, args.tolerance)]:
    start = time.perf_counter()
    m = model(subdivisions, name, kind, tolerance or 1e-4)
    if name == "peer":
      m.opt.tolerance = args.peer_tolerance
    sides[name, tolerance] = Side(m, time.perf_counter() - start)
  for _ in range(args.repeats):
    for side in sides.values():
      side.restart()
    for first in range(0, count, args.block):
      for side in sides.values():
        for step in range(first, min(first + args.block, count)):
          side.step(step)
  exact, right = {}, None
  if args.refine:
    for name in ("peer", *couplings):
      exact[name] = refined(model(subdivisions, name, kind, 1e-6, H / args.refine), count)
    right = Side(sides["peer", 0.0].model, weighs=True)
    for step in range(count):
      right.step(step)
  peer, rows = sides["peer", 0.0], []
  for tolerance in args.tolerance:
    row = {"nodes": nodes, "kind": kind, "tolerance": tolerance, "peer_ms": peer.time}
    ours = {name: sides[name, tolerance] for name in couplings}
    row |= {f"{name}_ms": side.time for name, side in ours.items()}
    row |= {f"{name}_ratio": peer.time / side.time for name, side in ours.items()}
    for name, side in {"peer": peer, **ours}.items():
      row[f"{name}_error"] = error(side.forces, exact[name]) if exact else float("nan")
      row |= {f"{name}_force_N": side.forces[-1], f"{name}_contacts": side.data.ncon}
    row["peer_right_error"] = error(right.forces, exact["peer"]) if right else float("nan")
    for name, side in ours.items():
      row[f"{name}_iterations"] = float(np.mean(side.iterations[20:]))
    row["residual_max"] = max(ours["window"].residuals[20:])
    row["compile_s"] = ours["window"].made
    rows.append(row)
  return rows


def refined(m: mujoco.MjModel, count: int) -> np.ndarray:
  """Returns the forces at start and end of `count` steps of H, taken in parts  (count, 2)."""
  parts = round(H / m.opt.timestep)
  side = Side(m, weighs=True)
  for step in range(count):
    side.step(step, parts)
  return np.reshape(side.forces, (count, parts))[:, [0, -1]]


def error(forces: list[float], exact: np.ndarray) -> float:
  """Returns the RMS error of forces (n,) against those at start and end of a step (n, 2)."""
  off = np.array(forces)[:, None] - exact
  return float(np.sqrt((off**2).mean(axis=0)).min() / np.abs(exact).max())


class Side:
  """One side's simulation, and what it took.

  Args:
    m: its model
    made: seconds that this took
    weighs: whether a flex of MuJoCo's own gets the right weights of corners
  """

  def __init__(self, m: mujoco.MjModel, made: float = 0.0, weighs: bool = False):
    self.model, self.data, self.made = m, mujoco.MjData(m), made
    self.organ = palpate.Organ(m, self.data, "organ") if m.nplugin else None
    weigh = scene.weigher(m, self.data) if weighs and not self.organ else None
    self.passive = (lambda *_: weigh()) if weigh else None
    self.repeats = []
    self.restart()

  def restart(self):
    """Starts over."""
    mujoco.mj_resetData(self.model, self.data)
    self.times, self.forces, self.iterations, self.residuals = [], [], [], []
    self.repeats.append(self.times)

  def step(self, step: int, parts: int = 1):
    """Moves the instrument on and takes a step of `H`, in parts."""
    self.data.ctrl[0] = -0.05 * H * step - 0.001
    for _ in range(parts):
      self.take()

  def take(self):
    """Takes a step of the model."""
    m, d = self.model, self.data
    mujoco.set_mjcb_passive(self.passive)
    start = time.thread_time()
    mujoco.mj_step(m, d)
    self.times.append(time.thread_time() - start)
    mujoco.set_mjcb_passive(None)
    self.forces.append(float(d.qfrc_constraint[m.nv - 1]))
    if self.organ:
      self.iterations.append(self.organ.iterations)
      self.residuals.append(self.organ.residual)

  @property
  def time(self) -> float:
    """Median time of a step [ms]."""
    least = np.min([times for times in self.repeats if times], axis=0)
    return 1e3 * float(np.median(least[20:]))


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--nodes", type=int, nargs="*", default=[642, 2562, 10242])
  # With bending MuJoCo takes minutes to compile the peer of 10,242 nodes.
  add("--bent-nodes", type=int, nargs="*", default=[642, 2562])
  add("--solid-nodes", type=int, nargs="*", default=[642, 2562])
  add("--tolerance", type=float, nargs="+", default=[1e-4, 1e-3, 1e-2])
  add("--peer-tolerance", type=float, default=1e-8)
  add("--steps", type=int, default=100)
  add("--block", type=int, default=10)
  add("--repeats", type=int, default=3)
  add("--refine", type=int, default=16, help="of the reference; 0 for no errors (%(default)s)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a size and kind."""
  names = ("tolerance", "peer_tolerance", "steps", "block", "repeats", "refine")
  keys = {name: getattr(args, name) for name in names}
  of_kind = zip(KINDS, (args.nodes, args.bent_nodes, args.solid_nodes), strict=True)
  sizes = [(n, kind) for kind, counts in of_kind for n in (counts[:1] if args.short else counts)]
  return [[{"case": f"{n}-{kind}", "nodes": n, "kind": kind} | keys for n, kind in sizes]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the rows of a case."""
  return measure(case["nodes"], case["kind"], argparse.Namespace(**case))


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""

  def percent(value) -> str:
    return f"{100 * float(value):.2g} %"

  table = []
  for row in rows:
    ours = []
    for side in SIDES[1:]:
      if row.get(f"{side}_ms", "") == "":
        ours += 3 * ["-"]
        continue
      ours += [f"{row[f'{side}_ms']:.3g} ms", f"{row[f'{side}_ratio']:.3g}"]
      ours.append(percent(row[f"{side}_error"]))
    limit = f"{row['tolerance']:.0e}".replace("e-0", "e-")
    table.append([row["nodes"], row["kind"], limit,
                  f"{row['peer_ms']:.3g} ms", percent(row["peer_error"]),
                  percent(row["peer_right_error"]), *ours,
                  f"{row['window_iterations']:.0f}"])  # fmt: skip
  head = ["nodes", "kind", "tolerance", "native flex", "error", "with right weights"]
  head += ["organ, nodal", "times faster", "error", "organ, window", "times faster", "error"]
  lines = [
    "A whole `mj_step` in contact, one thread each, interleaved in one run: the ratios are the "
    "result. Both sides have the same mesh and the same documented E = 30 kPa, nu, t = 2 mm and "
    "mass of 0.1 kg, solids E = 5 kPa, nu = 0.45 and 0.5 kg, at h = 1 ms. Errors are of the "
    "contact force, RMS in % of its peak, against "
    "the same side at h / 16 with right weights of the corners of touched triangles. The flex's "
    f"`error` is what users of mujoco {mujoco.__version__} get: 3.17 weighs corners by inverse "
    "distance, which this includes. `with right weights` is what the time step alone makes, as in "
    "MuJoCo 4.0. `tolerance` is that of the organ; the flex has MuJoCo's default of 1e-8. "
    + results.link(out / "peer_cpu.csv"),
    "",
    *plots.table([*head, "PCG iterations"], table),
  ]
  return [results.page(out / "peer.md", "A step beside MuJoCo's native flex", about, lines)]


BENCH = Bench("peer", stages, run, report=report, arguments=arguments, file="peer_cpu")
