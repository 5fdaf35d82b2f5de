"""A run of the stability bench: pressed or started wild, let go, and judged."""

from __future__ import annotations

import dataclasses
import math
import pathlib
import time

import mujoco
import numpy as np
import scenes
from benchmarks import runner, scene
from benchmarks.runner import Case, Row
from palpate.organ import Organ
from palpate.tissue import config as configuration
from palpate.tissue import energy
from palpate.tissue.config import Config
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry import plate
from palpate.tissue.geometry.mesh import Mesh

DEPTH = 0.008  # of the press [m]
CLEARANCE = 2e-4  # between probe and organ at first [m]
# Most steps of a stroke of the probe, of holding it and of the free motion after it: a run of many
# nodes and small steps presses less deep and is watched for less long.
STEPS = {162: 600, 642: 600, 2562: 300, 10242: 120}
# How a run may end; those of FAILURES have failed. The colours differ for the colour-blind too
# (Okabe and Ito 2008): failures dark or warm, the rest blue to grey.
VERDICTS = {
  "not finite": "#000000",
  "energy grows": "#d55e00",
  "chatters": "#cc79a7",
  "penetrates": "#f0e442",
  "too slow": "#8c8c8c",
  "tunnels": "#009e73",
  "elsewhere": "#d9d9d9",
  "moving": "#a6d4f2",
  "rest": "#0072b2",
}
FAILURES = ("not finite", "energy grows", "chatters", "penetrates")
GROWTH = 1.05  # most that the energy of the free organ may be over its first
EXCESS = 0.1  # most energy that it may have beyond the contacts' work, of that work without signs
LITTLE = 1e-4  # energies under this share of what the pressed organ had do not count
FLEX = 2.0  # growth of MuJoCo's flex, whose hinge energy is not the plate energy counted here
FLEX_EXCESS = 1.0  # excess of the same
CHATTER = 0.1  # most that the held force may jump from step to step, of its mean
SUNK = 0.5 * scene.PROBE  # that the held probe may have sunk in [m], where contacts are hard
GIVE = 2.0  # most that it may have sunk in over what MuJoCo's contact gives by itself
_AWAY = 1.0  # height of the probe when it must not touch [m]
SECONDS = 120.0  # of wall time for a run; the caps of STEPS keep them far below


JUDGEMENT = f"""\
Each run presses the organ with a probe whose motion is given, holds it, goes back and lets the
organ be; wild starts are let go at once. It fails by the first of these that holds.

- *not finite*: a number is not, the organ reports a diverged step, or a node is 100 radii away.
- *energy grows*: elastic plus kinetic energy of the free organ is over {GROWTH:g} times its first;
  or, while the probe moves or holds, the organ has more energy than it had and the contacts' work
  (force times motion of every node, step by step) gave it, by over {EXCESS:g} of that work without
  signs. {FLEX:g} and {FLEX_EXCESS:g} for MuJoCo's flex, whose hinge energy is not the plate energy
  counted here. Energies under 1e-7 E t depth^2 do not count, and for the free organ those under
  {LITTLE:g} of what it had under the probe.
- *penetrates*: the probe sinks in by more than its radius; or an organ that was held for two
  periods, or is at rest, carries no force, or has the probe {1e3 * SUNK:g} mm deep and {GIVE:g}
  times as deep as a contact of MuJoCo's gives by itself under that force, f (1 - d) T^2 / m with an
  impedance d <= 0.9999 and a time constant T >= 3 h for a node of mass m: much, for light and stiff
  tissue. Where the probe moves by more than half its radius in a step, or that give is more than
  the probe's radius, it is called *tunnels* and no failure: collisions are found once a step, and
  MuJoCo has no stiffer contact.
- *chatters*: such an organ carries a force that jumps by more than {CHATTER:g} of its mean from
  step to step.

Others end at `rest` (5 % of the energy at most is left), still `moving` with the energy falling, or
at rest `elsewhere`, another equilibrium of the shell. `too slow`: given up after {SECONDS:g} s, no
verdict. Runs of many nodes and small steps have fewer steps and press less deep: at most {STEPS}
steps (by nodes) for a stroke, for holding it and for the motion after it."""


class Energy:
  """Elastic and kinetic energy of a run, the constant parts computed once."""

  def __init__(self, mesh: Mesh, config: Config, mass: float, by_area: bool):
    self.mesh, self.config = mesh, config
    area = topology.vertex_areas(mesh.rest, mesh.elem)
    share = area / area.sum() if by_area else np.full(mesh.nvert, 1 / mesh.nvert)
    self.mass = mass * share[:, None]
    self.hinge = plate.hinges(mesh, configuration.rigidity(config, mesh.nelem), config.poisson)
    self.angle0 = energy.hinge_angles(mesh, self.hinge, np.zeros_like(mesh.rest))

  def __call__(self, u: np.ndarray, v: np.ndarray) -> tuple[float, float]:
    """Returns elastic and kinetic energy [J]."""
    mesh, config = self.mesh, self.config
    with np.errstate(all="ignore"):
      others = (term for name, term in energy.TERMS.items() if name != "bending")
      whole = sum(term(mesh, config, u) for term in others)
      change = energy.hinge_angles(mesh, self.hinge, u) - self.angle0
      each = np.where(self.hinge.of_elem >= 0, change[self.hinge.of_elem], 0.0)
      bending = 0.5 * np.einsum("ti,tij,tj->", each, self.hinge.gain, each)
      return float(whole + bending), float(0.5 * (self.mass * v * v).sum())


class SolidEnergy:
  """Elastic and kinetic energy of a solid as it is now, that of what is inside too."""

  def __init__(self, organ: Organ):
    self.space = scenes.workspace(organ)

  def __call__(self, *_) -> tuple[float, float]:
    """Returns elastic and kinetic energy [J]."""
    w = self.space
    u, v = w.motion()
    with np.errstate(all="ignore"):
      kinetic = 0.5 * (w.organ.mass[:, None] * v * v).sum()
      return float(energy.total(w.organ.mesh, w.config, u)), float(kinetic)


def start_state(mesh: Mesh, start: str) -> np.ndarray:
  """Returns the displacement of a wild start [m], (nvert, 3)."""
  x = mesh.rest
  if start == "flattened":
    return x * [0, 0, -0.999]
  if start == "crushed":
    return -0.95 * x
  if start == "folded":  # one half laid over the other
    return np.where(x[:, :1] > 0, x * [-2, 0, 0], 0.0)
  if start == "inverted":
    return -2 * x
  if start == "scattered":
    random = np.random.RandomState(runner.SEED % 2**32)
    return random.uniform(-1, 1, x.shape) * scene.RADIUS - x
  return np.zeros_like(x)


@dataclasses.dataclass
class Watch:
  """What is seen of a run as it goes."""

  growth: float = 0.0
  excess: float = 0.0
  work: float = 0.0
  gross: float = 0.0
  penetration: float = 0.0
  sunk: float = 0.0
  overflow: int = 0
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
    **{k: case[k] for k in ("elements", "poisson") if k in case},
  )
  config = Config(
    **{k: v for k, v in tissue.keys().items() if k != "young"}, young=(case["young"],)
  )
  top = mesh.rest[np.argmax(mesh.rest[:, 2])]
  probe = top + np.array([0, 0, scene.PROBE + CLEARANCE])
  contact = _contact(case)[0]
  window = case["coupling"] == "window"
  model = scene.build(
    mesh, tissue, case["scheme"], case["h"],
    probe=probe, contact=contact, window=window, heavy=True, mj_tolerance=1e-12,
  )  # fmt: skip
  data = mujoco.MjData(model)
  row = Run(case, mesh, config, model, data, began).judge(foundation)
  names = ("side", "set", "scheme", "coupling", "shape", "start", "h", "young", "thickness")
  row |= {k: case[k] for k in (*names, "damping", "mass", "bulk", "speed")}
  row |= {"foundation": foundation, "nodes": mesh.nvert}
  # h^2 k / m of a node under membrane stiffness: far over one where an explicit step breaks.
  row["stiff"] = case["h"] ** 2 * case["young"] * case["thickness"] * mesh.nvert / case["mass"]
  return [row]


def _contact(case: Case) -> tuple[dict, float]:
  """Returns contact parameters whose own give is some 5 % of the tissue's, as far as MuJoCo goes.

  And that give [m/N]: MuJoCo's contacts give by f (1 - d) T^2 / m for a node of mass m. Light and
  stiff tissue needs an impedance d close to one, which MuJoCo cuts at 0.9999. T is at least three
  time steps (at two, MuJoCo's least, contacts of its own flex chatter as those of ours), and where
  tissue is soft as long as d = 0.95 allows.
  """
  node, stretch = case["mass"] / case["nodes"], case["young"] * case["thickness"]
  longest = 0.5 * scene.PROBE / case["speed"]  # so that the probe does not go through meanwhile
  constant = max(0.004, 3 * case["h"], min(math.sqrt(node / stretch), longest))
  rest = min(max(0.05 * node / (stretch * constant**2), 1e-4), 0.05)
  impedance = f"{1 - rest:.6f}"
  contact = {"solref": f"{constant:g} 1", "solimp": f"{impedance} {impedance} 0.001"}
  return contact, rest * constant**2 / node


class Run:
  """One run: its phases and its verdict."""

  def __init__(self, case, mesh, config, model, data, began):
    self.case, self.mesh, self.model, self.data, self.began = case, mesh, model, data, began
    self.h = case["h"]
    self.probe = scene.probe_dofs(model)
    self.organ = None if case["scheme"] == scene.NATIVE else scene.handle(model, data)
    self.nodes = scene.Nodes(model, data, mesh, self.organ)
    window = case["coupling"] == "window"
    self.energy = Energy(mesh, config, case["mass"], by_area=window)
    if config.elements == "solid":
      self.energy = SolidEnergy(self.organ)
    self.most = STEPS[case["nodes"]]  # see there
    self.watch = Watch()
    self.long = self.settled = False  # whether the organ had time to come to rest while held
    self.held = 0.0, 0.0  # elastic and kinetic energy at the end of the hold [J]
    self.before = self.state()[0]
    # Their velocity is that of the middle of a step: its energy belongs to both ends.
    self.between = case["scheme"] in ("midpoint", "explicit")
    self.most_energy = 0.0  # seen under the probe [J]
    self.floor = 1e-7 * case["young"] * case["thickness"] * DEPTH**2  # of energies that count [J]

  def state(self) -> tuple[np.ndarray, np.ndarray]:
    return self.nodes.state()

  def total(self) -> float:
    """Returns elastic and kinetic energy [J]."""
    u, v = self.state()
    elastic, kinetic = self.energy(u, v)
    if self.between:
      elastic = 0.5 * (elastic + self.energy(self.before, v)[0])
    return elastic + kinetic

  def depth(self) -> float:
    """Returns how deep the probe is sunk in [m]."""
    return max(0.0, -float(self.data.contact.dist.min())) if self.data.ncon else 0.0

  def fails(self) -> str | None:
    """Returns why the run must end here, or None."""
    if scene.bad(self.data) or not np.isfinite(self.data.qvel).all():
      return "not finite"
    if self.organ is not None and self.organ.error:
      return "not finite"
    if self.watch.steps % 10 == 0 and not np.abs(self.state()[0]).max() < 100 * scene.RADIUS:
      return "not finite"
    if time.perf_counter() - self.began > SECONDS:
      return "too slow"
    return None

  def step(self, place: float, speed: float):
    """Makes a step with the probe at height `place` and speed `speed`."""
    self.before = self.state()[0]
    scene.put(self.data, self.probe, np.array([0, 0, place]), np.array([0, 0, speed]))
    mujoco.mj_step(self.model, self.data)
    self.watch.steps += 1
    if self.data.ncon:
      # MuJoCo moves x by h v, so this is what contacts do to the organ, to the last digit.
      work = self.nodes.contact_force() * (self.state()[0] - self.before)
      self.watch.work += float(work.sum())
      self.watch.gross += float(np.abs(work).sum())
    if self.organ is not None:
      self.watch.iterations = max(self.watch.iterations, self.organ.iterations)
      self.watch.residual = max(self.watch.residual, self.organ.residual)
      self.watch.overflow = max(self.watch.overflow, *self.organ.window_overflow)
    self.watch.penetration = max(self.watch.penetration, self.depth())

  def free(self, steps: int) -> tuple[str | None, float, float]:
    """Lets the organ move with the probe away: (failure, share of energy left, share it moves)."""
    start = self.total()
    least = max(start, self.floor, LITTLE * self.most_energy)
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
    depth = min(CLEARANCE + DEPTH, max(1, self.most) * speed * h)
    path = -np.minimum(np.arange(1, math.ceil(depth / speed / h) + 1) * speed * h, depth)
    path = np.concatenate([[0.0], path, np.full(hold, -depth), path[::-1], [0.0]])
    pressed = 1 + (len(path) - 2 - hold) // 2  # places before the hold
    first, last = pressed, pressed + hold
    begin, w = self.total(), self.watch
    forces, depths = [], []
    every = max(1, len(path) // 60)
    for n in range(len(path) - 1):
      self.step(path[n], (path[n + 1] - path[n]) / h)
      reason = self.fails()
      if reason:
        return reason, math.nan, math.nan
      held = first < n < last
      if held:
        forces.append(float(self.data.qfrc_constraint[self.probe[2]]))
        depths.append(self.depth())
      if n == last - 1:
        self.held = self.energy(*self.state())
      if n % every == 0 or (held and n % max(1, hold // 30) == 0):
        whole = self.total()
        self.most_energy = max(self.most_energy, whole)
        beyond = whole - begin - w.work
        w.excess = max(w.excess, beyond / max(w.gross, self.floor))
    w.sunk = float(np.mean(depths[len(depths) // 2 :]))
    elastic, kinetic = self.held
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
    most = min(self.most, 300) if case["scheme"] == scene.NATIVE else self.most
    rest = int(np.clip(8 * period / self.h, 40, most))
    hold = int(np.clip(3 * period / self.h, 20, most))
    self.long = hold * self.h >= 2 * period
    force = chatter = left = moving = math.nan
    if case["start"] == "rest":
      reason, force, chatter = self.press(hold)
    else:
      self.nodes.put(start_state(self.mesh, case["start"]))
      reason = None
    if reason is None:
      reason, left, moving = self.free(rest)
    w = self.watch
    if reason is None:
      native = case["scheme"] == scene.NATIVE
      # Where the probe passes its own radius in a step, MuJoCo may see no contact in between, and
      # its stiffest contact may give by more than that.
      give = GIVE * abs(force) * _contact(case)[1] if case["start"] == "rest" else 0.0
      fast = case["speed"] * self.h > 0.5 * scene.PROBE
      through = "tunnels" if fast or give > scene.PROBE else "penetrates"
      if w.growth > (FLEX if native else GROWTH) or w.excess > (FLEX_EXCESS if native else EXCESS):
        reason = "energy grows"
      elif w.penetration > scene.PROBE:
        reason = through
      elif self.settled and chatter > CHATTER:
        reason = "chatters"
      elif self.settled and not (force > 0 and w.sunk < max(SUNK, give)):
        reason = through
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
      "excess": w.excess,
      "penetration_mm": 1e3 * w.penetration,
      "sunk_mm": 1e3 * w.sunk,
      "chatter": chatter,
      "left": left,
      "force_N": force,
      "overflow": w.overflow,
      "iterations": w.iterations,
      "residual": w.residual,
    }
