"""`palpate bench stability`: where each scheme breaks, over a thousand runs and more.

Each run presses an organ (or starts it from a wild state), lets it go and is judged: finite, energy
not growing without input, penetration bounded, back to rest.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import pathlib
import time

import mujoco
import numpy as np

from .. import config as configuration
from .. import energy
from .. import mesh as topology
from ..config import Config
from ..mesh import Mesh
from . import plots, runner, scene
from .runner import Bench, Case, Row

H = (5e-4, 1e-3, 2e-3, 3e-3, 5e-3, 8e-3, 12.5e-3, 2e-2)  # [s]
YOUNG = (1e2, 1e3, 1e4, 1e5, 1e6, 1e7)  # [Pa]
NODES = (162, 642, 2562, 10242)
SCHEMES = ("implicit", "neumann", "explicit", scene.NATIVE)
STARTS = ("flattened", "folded", "inverted", "scattered")
DRAWS = 1000
DEPTH = 0.008  # of the press [m]
CLEARANCE = 0.001  # between probe and organ at first [m]

# Span of each factor of the hypercube, drawn evenly on a logarithmic scale.
SPANS = {
  "h": (5e-4, 2e-2),
  "young": (1e2, 1e7),
  "thickness": (5e-4, 1e-2),
  "damping": (1e-4, 1e-2),
  "mass": (1e-3, 1e1),
  "speed": (2e-2, 2.0),
  "share": (0.1, 10.0),  # foundation over young thickness / RADIUS^2
}
USUAL = {
  "thickness": 2e-3,
  "damping": 2e-3,
  "mass": 0.1,
  "speed": 0.1,
  "share": 4.0,
  "bulk": 0.0,
  "shape": "sphere",
  "start": "rest",
  "nodes": 642,
}
# How a run may end; those of FAILURES have failed.
VERDICTS = {
  "not finite": "#a50026",
  "energy grows": "#f46d43",
  "chatters": "#dd1c77",
  "penetrates": "#fdae61",
  "too slow": "#bbbbbb",
  "elsewhere": "#c6dbef",
  "moving": "#6baed6",
  "rest": "#08519c",
}
FAILURES = ("not finite", "energy grows", "chatters", "penetrates")
GROWTH = 1.05  # most that the energy may be over the phase's first
WORK = 2.0  # most that it may have gained over the probe's work
CHATTER = 0.1  # most that the held force may jump from step to step, of its mean
_AWAY = 1.0  # height of the probe when it must not touch [m]
_SECONDS = 90.0  # of wall time for a run
_COLUMNS = (
  *("set", "scheme", "coupling", "shape", "start", "nodes", "h", "young", "thickness", "damping"),
  *("mass", "foundation", "bulk", "speed", "stiff", "verdict", "steps", "simulated_s", "wall_s"),
  *("growth", "growth_held", "gain_over_work", "penetration_mm", "chatter", "left", "force_N"),
  *("iterations", "residual"),
)


def stages(short: bool) -> list[list[Case]]:
  """Returns the cases: maps of h and E for every scheme, wild starts, slivers and a hypercube."""
  cases = []
  shapes = scene.SHAPES[:2] if short else scene.SHAPES
  for scheme in ("implicit", scene.NATIVE) if short else SCHEMES:
    for h in H[1::3] if short else H:
      for young in YOUNG[1::3] if short else YOUNG:
        nodes = 162 if short else 642
        cases.append(USUAL | _of("map", scheme=scheme, h=h, young=young, nodes=nodes))
  for start in ("flattened", "scattered") if short else (*STARTS, "sliver"):
    for shape in shapes[:1] if short else shapes:
      for h in (2e-3,) if short else (1e-3, 5e-3, 2e-2):
        for young in (1e4,) if short else (1e3, 1e5, 1e7):
          for scheme in ("implicit", scene.NATIVE):
            if start == "sliver" and shape != "sphere":
              continue
            what = _of("start", scheme=scheme, h=h, young=young, shape=shape)
            what |= {"start": start, "nodes": 162 if short else 642}
            if start == "sliver":
              what |= {"shape": "sliver", "start": "rest"}
            what["case"] += f"-{start}"
            cases.append(USUAL | what)
  for number, draw in enumerate(_draws(8 if short else DRAWS)):
    if short:
      draw["nodes"] = min(draw["nodes"], 642)
    for scheme in ("implicit", scene.NATIVE):
      most = 162 if short else 642  # larger ones take the native flex minutes a run
      if scheme == scene.NATIVE and (draw["bulk"] or draw["nodes"] > most):
        if draw["bulk"] or draw["nodes"] > 2562 or number % 8:
          continue
      cases.append(draw | _of("hypercube", scheme=scheme, **{k: draw[k] for k in ("h", "young")}))
      cases[-1]["case"] += f"-{number}"
  # Slow ones first, so that no process is left alone with them at the end.
  return [sorted(cases, key=lambda case: -_effort(case))]


def _effort(case: Case) -> float:
  return case["nodes"] * (20 if case["scheme"] == scene.NATIVE else 1) / case["h"] / case["speed"]


def _of(group: str, **what) -> Case:
  words = "-".join(f"{v:g}" if isinstance(v, float) else str(v) for v in what.values())
  start = {"set": group, "case": f"{group}-{words}"}
  return start | what


def _draws(count: int) -> list[Case]:
  """Returns a Latin hypercube over SPANS, nodes, shapes and volume preservation."""
  from scipy.stats import qmc

  names = (*SPANS, "nodes", "shape", "bulk")
  unit = qmc.LatinHypercube(len(names), rng=np.random.default_rng(runner.SEED)).random(count)
  cases = []
  for row in unit:
    case = dict(USUAL)
    for name, u in zip(names, row, strict=True):
      if name in SPANS:
        low, high = SPANS[name]
        case[name] = float(f"{low * (high / low) ** u:.4g}")
    case["nodes"] = NODES[int(u_of(row, names, "nodes") * len(NODES))]
    case["shape"] = scene.SHAPES[int(u_of(row, names, "shape") * len(scene.SHAPES))]
    case["bulk"] = 3 * case["young"] if u_of(row, names, "bulk") > 0.5 else 0.0
    cases.append(case)
  return cases


def u_of(row: np.ndarray, names: tuple[str, ...], name: str) -> float:
  """Returns the draw of a factor."""
  return float(row[names.index(name)])


class Energy:
  """Elastic and kinetic energy of a run, the constant parts computed once."""

  def __init__(self, mesh: Mesh, config: Config, mass: float):
    self.mesh, self.config, self.mass = mesh, config, mass / mesh.nvert
    self.hinge = topology.hinges(mesh, configuration.rigidity(config, mesh.nelem), config.poisson)
    self.angle0 = energy.hinge_angles(mesh, self.hinge, np.zeros_like(mesh.rest))

  def __call__(self, u: np.ndarray, v: np.ndarray) -> tuple[float, float]:
    """Returns elastic and kinetic energy [J]."""
    mesh, config = self.mesh, self.config
    with np.errstate(all="ignore"):
      whole = energy.membrane(mesh, config, u) + energy.foundation(mesh, config, u)
      whole += energy.enclosed(mesh, config, u)
      change = energy.hinge_angles(mesh, self.hinge, u) - self.angle0
      each = np.where(self.hinge.of_elem >= 0, change[self.hinge.of_elem], 0.0)
      bending = 0.5 * np.einsum("ti,tij,tj->", each, self.hinge.gain, each)
      return float(whole + bending), float(0.5 * self.mass * (v * v).sum())


def start_state(mesh: Mesh, start: str) -> np.ndarray:
  """Returns the displacement of a wild start [m], (nvert, 3)."""
  x = mesh.rest
  if start == "flattened":
    return x * [0, 0, -0.999]
  if start == "folded":  # one half laid over the other
    return np.where(x[:, :1] > 0, x * [-2, 0, 0], 0.0)
  if start == "inverted":
    return -2 * x
  if start == "scattered":
    random = np.random.RandomState(runner.SEED % 2**32)
    return random.uniform(-1, 1, x.shape) * scene.RADIUS - x
  return np.zeros_like(x)


@dataclasses.dataclass
class _Watch:
  """What is seen of a run as it goes."""

  growth: float = 0.0
  growth_held: float = 0.0
  gain_over_work: float = 0.0
  penetration: float = 0.0
  steps: int = 0
  iterations: int = 0
  residual: float = 0.0


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Runs a case and returns its row."""
  began = time.perf_counter()
  mesh = scene.shape(case["shape"], case["nodes"])
  foundation = case["share"] * case["young"] * case["thickness"] / scene.RADIUS**2
  tissue = scene.Tissue(
    **{k: case[k] for k in ("young", "thickness", "damping", "mass", "bulk")},
    foundation=foundation,
    bend=1,
  )
  config = Config(
    **{k: v for k, v in tissue.keys().items() if k != "young"}, young=(case["young"],)
  )
  top = mesh.rest[np.argmax(mesh.rest[:, 2])]
  probe = top + np.array([0, 0, scene.PROBE + CLEARANCE])
  contact = _contact(case)
  model = scene.build(mesh, tissue, case["scheme"], case["h"], probe=probe, contact=contact)
  data = mujoco.MjData(model)
  row = _Run(case, mesh, config, model, data, began).judge(foundation)
  names = ("set", "scheme", "shape", "start", "nodes", "h", "young", "thickness", "damping")
  row |= {k: case[k] for k in (*names, "mass", "bulk", "speed")}
  row |= {"coupling": "nodal", "foundation": foundation, "nodes": mesh.nvert}
  # h^2 k / m of a node under membrane stiffness: far over one where an explicit step breaks.
  row["stiff"] = case["h"] ** 2 * case["young"] * case["thickness"] * mesh.nvert / case["mass"]
  return [row]


def _contact(case: Case) -> str:
  """Returns contact parameters whose own give is some 5 % of the tissue's, as far as MuJoCo goes.

  Its contacts give by f (1 - d) T^2 / m for a node of mass m: light and stiff tissue needs an
  impedance d close to one, which MuJoCo cuts at 0.9999; T is at least two time steps.
  """
  constant = max(0.004, 2 * case["h"])
  node = case["mass"] / case["nodes"]
  give = 0.05 * node / (case["young"] * case["thickness"] * constant**2)
  impedance = 1 - min(max(give, 1e-4), 0.05)
  return f'solref="{constant:g} 1" solimp="{impedance:.6f} {impedance:.6f} 0.001"'


class _Run:
  """One run: its phases and its verdict."""

  def __init__(self, case, mesh, config, model, data, began):
    self.case, self.mesh, self.model, self.data, self.began = case, mesh, model, data, began
    self.h = case["h"]
    self.nodes = scene.node_dofs(model, mesh.nvert)
    self.probe = scene.probe_dofs(model)
    self.organ = None if case["scheme"] == scene.NATIVE else scene.handle(model, data)
    self.energy = Energy(mesh, config, case["mass"])
    self.watch = _Watch()
    self.long = self.settled = False  # whether the organ had time to come to rest while held
    self.state_held = np.zeros((0, 3)), np.zeros((0, 3))
    self.floor = 1e-7 * case["young"] * case["thickness"] * DEPTH**2  # of energies that count [J]

  def state(self) -> tuple[np.ndarray, np.ndarray]:
    return self.data.qpos[self.nodes], self.data.qvel[self.nodes]

  def total(self) -> float:
    return sum(self.energy(*self.state()))

  def fails(self) -> str | None:
    """Returns why the run must end here, or None."""
    if scene.bad(self.data) or not np.isfinite(self.data.qvel).all():
      return "not finite"
    if self.organ is not None and self.organ.error:
      return "not finite"
    if np.abs(self.data.qpos[self.nodes]).max() > 100 * scene.RADIUS:
      return "not finite"
    if time.perf_counter() - self.began > _SECONDS:
      return "too slow"
    return None

  def step(self, place: float, speed: float):
    """Makes a step with the probe at height `place` and speed `speed`."""
    scene.put(self.data, self.probe, np.array([0, 0, place]), np.array([0, 0, speed]))
    mujoco.mj_step(self.model, self.data)
    self.watch.steps += 1
    if self.organ is not None:
      self.watch.iterations = max(self.watch.iterations, self.organ.iterations)
      self.watch.residual = max(self.watch.residual, self.organ.residual)
    if self.data.ncon:
      deepest = -float(self.data.contact.dist.min())
      self.watch.penetration = max(self.watch.penetration, deepest)

  def free(self, steps: int) -> tuple[str | None, float, float]:
    """Lets the organ move with the probe away: (failure, share of energy left, share it moves)."""
    start = self.total()
    least = max(start, self.floor)
    every = max(1, steps // 40)
    energies = [start]
    for n in range(steps):
      self.step(_AWAY, 0.0)
      reason = self.fails()
      if reason:
        return reason, math.nan, math.nan
      if n % every == every - 1:
        energies.append(self.total())
        self.watch.growth = max(self.watch.growth, energies[-1] / least)
    late = energies[-max(2, len(energies) // 4)]
    return None, energies[-1] / least, abs(late - energies[-1]) / max(energies[-1], self.floor)

  def press(self, hold: int) -> tuple[str | None, float, float]:
    """Presses, holds, goes back: (failure, mean force held, its jumps over that)."""
    speed, h = self.case["speed"], self.h
    depth = CLEARANCE + DEPTH
    path = -np.minimum(np.arange(1, math.ceil(depth / speed / h) + 1) * speed * h, depth)
    path = np.concatenate([[0.0], path, np.full(hold, -depth), path[::-1], [0.0]])
    pressed = 1 + (len(path) - 2 - hold) // 2  # places before the hold
    first, last = pressed, pressed + hold
    work, begin = 0.0, self.total()
    forces, early, late = [], 0.0, 0.0
    every = max(1, len(path) // 60)
    for n in range(len(path) - 1):
      velocity = (path[n + 1] - path[n]) / h
      self.step(path[n], velocity)
      force = float(self.data.qfrc_constraint[self.probe[2]])
      work -= force * velocity * h
      reason = self.fails()
      if reason:
        return reason, math.nan, math.nan
      held = first < n < last
      if held:
        forces.append(force)
        self.state_held = self.state()
      if n % every == 0 or (held and n % max(1, hold // 30) == 0):
        total = self.total()
        if work > self.floor:
          # A probe that jumped in has also loaded the contacts' springs.
          gained = (total - begin) / (work + abs(force) * self.watch.penetration)
          self.watch.gain_over_work = max(self.watch.gain_over_work, gained)
        if held and n < first + hold // 2:
          early = max(early, total)
        elif held:
          late = max(late, total)
    self.watch.growth_held = late / max(early, self.floor)
    elastic, kinetic = self.energy(*self.state_held)
    self.settled = self.long or kinetic < 0.01 * elastic
    f = np.array(forces[len(forces) // 2 :])
    mean = float(f.mean())
    jump = f[1:-1] - 0.5 * (f[:-2] + f[2:])  # twice the amplitude of a swing of two steps
    return None, mean, float(0.5 * np.sqrt(np.mean(jump**2)) / max(abs(mean), 1e-12))

  def judge(self, foundation: float) -> Row:
    """Runs all phases and returns the row."""
    case = self.case
    area = topology.vertex_areas(self.mesh.rest, self.mesh.elem).sum()
    slowest = math.sqrt(foundation * area / case["mass"])  # [rad/s]
    period = 2 * math.pi / slowest
    most = {162: 600, 642: 600, 2562: 300}.get(case["nodes"], 120)
    if case["scheme"] == scene.NATIVE:
      most = min(most, 300)
    rest = int(np.clip(8 * period / self.h, 40, most))
    hold = int(np.clip(3 * period / self.h, 20, most))
    self.long = hold * self.h >= 2 * period
    force = chatter = left = moving = math.nan
    if case["start"] == "rest":
      reason, force, chatter = self.press(hold)
    else:
      self.data.qpos[self.nodes] = start_state(self.mesh, case["start"])
      reason = None
    if reason is None:
      reason, left, moving = self.free(rest)
    w = self.watch
    if reason is None:
      if w.growth > GROWTH or w.growth_held > GROWTH or w.gain_over_work > WORK:
        reason = "energy grows"
      elif self.settled and chatter > CHATTER:
        reason = "chatters"
      elif w.penetration > scene.PROBE or (self.settled and not force > 0):
        reason = "penetrates"
      elif left <= 0.05:
        reason = "rest"
      else:
        reason = "moving" if moving > 0.01 else "elsewhere"
    return {
      "verdict": reason,
      "steps": w.steps,
      "simulated_s": w.steps * self.h,
      "wall_s": time.perf_counter() - self.began,
      "growth": w.growth,
      "growth_held": w.growth_held,
      "gain_over_work": w.gain_over_work,
      "penetration_mm": 1e3 * w.penetration,
      "chatter": chatter,
      "left": left,
      "force_N": force,
      "iterations": w.iterations,
      "residual": w.residual,
    }


def draw(rows: list[Row], out: pathlib.Path) -> list[pathlib.Path]:
  """Draws a map of h and E for each scheme, the hypercube, and the wild starts."""
  rows = [row for row in rows if row["status"] == "ok"]
  written = []
  maps = [row for row in rows if row["set"] == "map"]
  schemes = [s for s in SCHEMES if any(row["scheme"] == s for row in maps)]
  if schemes:
    figure, axes = plots.grid(1, len(schemes), width=3.1 * len(schemes), height=3.6)
    for ax, scheme in zip(axes, schemes, strict=True):
      _map(ax, [row for row in maps if row["scheme"] == scheme])
      ax.set_title("MuJoCo flex" if scheme == scene.NATIVE else scheme, loc="left", fontsize=10)
    axes[0].set_ylabel("Young's modulus [Pa]")
    _legend(figure, 8 if len(schemes) > 2 else 4)
    nodes = maps[0]["nodes"]
    about = f"Sphere of {nodes} nodes, t = 2 mm, 0.1 kg, pressed 8 mm at 0.1 m/s"
    written.append(plots.save(figure, out / "stability_map.png", about))
  cube = [row for row in rows if row["set"] == "hypercube"]
  if cube:
    figure, axes = plots.grid(2, 2, width=9.0, height=7.4)
    for line, scheme in zip(axes, ("implicit", scene.NATIVE), strict=True):
      mine = [row for row in cube if row["scheme"] == scheme]
      name = "MuJoCo flex" if scheme == scene.NATIVE else scheme
      line[0].set_title(f"{name}, {len(mine)} runs", loc="left", fontsize=10)
      if not mine:
        continue
      for ax, (x, y, label, title) in zip(
        line,
        (("h", "stiff", "time step [ms]", "h² E t / nodal mass [-]"),
         ("speed", "mass", "probe speed [m/s]", "mass [kg]")),
        strict=True,
      ):  # fmt: skip
        factor = 1e3 if x == "h" else 1.0
        for verdict, colour in reversed(VERDICTS.items()):
          at = [row for row in mine if row["verdict"] == verdict]
          fails = verdict in FAILURES
          ax.plot([factor * r[x] for r in at], [r[y] for r in at], "X" if fails else "o",
                  ms=6 if fails else 3, mec="none", color=colour)  # fmt: skip
        ax.set(xscale="log", yscale="log", xlabel=label, ylabel=title)
        span = [[k * r[axis] for r in cube] for axis, k in ((x, factor), (y, 1.0))]
        ax.set_xlim(0.8 * min(span[0]), 1.25 * max(span[0]))
        ax.set_ylim(0.5 * min(span[1]), 2 * max(span[1]))
    _legend(figure)
    about = "Draws over h, E, thickness, damping, mass, speed, foundation, volume, nodes, shapes"
    written.append(plots.save(figure, out / "stability_hypercube.png", about))
  return written


def _map(ax, rows: list[Row]):
  hs, youngs = sorted({r["h"] for r in rows}), sorted({r["young"] for r in rows})
  for row in rows:
    at = hs.index(row["h"]), youngs.index(row["young"])
    ax.add_patch(plots.cell(at, VERDICTS[row["verdict"]]))
  ax.set_xlim(-0.5, len(hs) - 0.5)
  ax.set_ylim(-0.5, len(youngs) - 0.5)
  ax.set_xticks(range(len(hs)), [f"{1e3 * h:g}" for h in hs])
  ax.set_yticks(range(len(youngs)), [f"1e{round(math.log10(y))}" for y in youngs])
  ax.set_xlabel("time step [ms]")


def _legend(figure, columns: int = 8):
  from matplotlib.patches import Patch

  handles = [Patch(color=colour, label=verdict) for verdict, colour in VERDICTS.items()]
  figure.legend(handles=handles, loc="outside lower center", ncols=columns, fontsize=8,
                frameon=False)  # fmt: skip


def summarize(rows: list[Row], about: dict) -> str:
  """Returns the page: counts of verdicts and a list of every failure of ours."""
  good = [row for row in rows if row["status"] == "ok"]
  lines = ["# Where each scheme breaks", "", runner.caption(about), ""]
  lines += [f"    palpate bench stability{' --short' if about.get('short') else ''}", ""]
  lines += [
    "A run fails if numbers stop being finite (or nodes fly away 100 radii), if elastic plus "
    f"kinetic energy exceeds {GROWTH:g} times its value at the start of a phase without input "
    f"(held or free), if it gained more than {WORK:g} times the probe's work and what its contacts "
    f"store, if the held force jumps from step to step by more than {CHATTER:g} of its mean, if "
    "the probe sinks in by more than its radius or, held for two of the organ's periods, meets no "
    "resistance. The rest ends at `rest` (5 % of the energy is left), still `moving` with the "
    "energy falling, or at rest `elsewhere` (another equilibrium of the shell). `too slow`: given "
    "up after "
    f"{_SECONDS:g} s; no verdict.",
    "",
  ]
  sides = (("implicit", "ours"), (scene.NATIVE, "MuJoCo flex"))
  for group in ("map", "start", "hypercube"):
    here = [row for row in good if row["set"] == group]
    schemes = [s for s in SCHEMES if any(row["scheme"] == s for row in here)]
    table = []
    for scheme in schemes:
      for low, high, span in ((0, 5.001e-3, "h <= 5 ms"), (5.001e-3, 1, "h > 5 ms")):
        mine = [r for r in here if r["scheme"] == scheme and low <= r["h"] < high]
        if mine:
          counts = [sum(r["verdict"] == v for r in mine) for v in VERDICTS]
          table.append([scheme, span, len(mine), *counts])
    if table:
      lines += [f"## {group}", "", *plots.table(["scheme", "", "runs", *VERDICTS], table), ""]
  both: dict[tuple, dict] = {}
  names = ("set", "shape", "start", "nodes", "h", "young", "thickness", "damping", "mass", "speed")
  for row in good:
    both.setdefault(tuple(row[k] for k in names), {})[row["scheme"]] = row["verdict"]
  pairs = [p for p in both.values() if "implicit" in p and scene.NATIVE in p]
  if pairs:
    fails = {s: sum(p[s] in FAILURES for p in pairs) for s, _ in sides}
    lines += [
      f"Run on both sides: {len(pairs)} cases; failed: ours {fails['implicit']}, MuJoCo flex "
      f"{fails[scene.NATIVE]}; only ours: "
      f"{sum(p['implicit'] in FAILURES and p[scene.NATIVE] not in FAILURES for p in pairs)}, only "
      f"MuJoCo flex: "
      f"{sum(p['implicit'] not in FAILURES and p[scene.NATIVE] in FAILURES for p in pairs)}.",
      "",
    ]
  failed = [r for r in good if r["scheme"] == "implicit" and r["verdict"] in FAILURES]
  if failed:
    lines += [f"## Failures of the implicit scheme ({len(failed)})", ""]
    head = ["case", "verdict", "h [ms]", "E [Pa]", "nodes", "mass [kg]", "speed [m/s]", "h²Et/m"]
    head += ["growth", "held", "gain/work", "chatter", "sunk [mm]", "residual"]
    body = [
      [r["case"], r["verdict"], 1e3 * r["h"], r["young"], r["nodes"], r["mass"], r["speed"]]
      + [r[k] for k in ("stiff", "growth", "growth_held", "gain_over_work", "chatter")]
      + [r["penetration_mm"], r["residual"]]
      for r in sorted(failed, key=lambda r: r["h"])[:60]
    ]
    lines += [*plots.table(head, body), ""]
    if len(failed) > 60:
      lines += [f"and {len(failed) - 60} more; see stability.csv.", ""]
  rest = [row for row in rows if row["status"] != "ok"]
  if rest:
    lines += ["Not run to an end: " + ", ".join(f"{r['case']} ({r['status']})" for r in rest), ""]
  return "\n".join(lines)


BENCH = Bench("stability", __name__, _COLUMNS, stages, run, draw, summarize, limit=150.0)


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  runner.add_arguments(parser, BENCH)


def main(args: argparse.Namespace) -> int:
  """Runs the bench."""
  return runner.main(BENCH, args)
