"""Bimanual: hold the gallbladder away from its bed with one hand, divide it with the other's hook.

The action has the grasper's components, then those of the hook: `hook_pitch`, `hook_yaw`,
`hook_roll`, `hook_insertion`, and `hook_current`, which is on above 0.

Own observations: those of `dissect`, and `hook_front` (3,), from the hook's tip to the bond to
divide next, which was nearest to it when the last one came free [m]; `hook_gap` (1,), how far
the nearest strand that holds is from the current's reach, negative within it, 2 mm at most [m];
`retracted` (1,), how far the site is from its place at rest, away from the bed, as a share of what
is needed [-]; `burnt` (1,), share of the burn that is damage [-].

A current frees the bonds whose strands the hook's wire touches in 0.2 s: a strand goes from the bed
to the organ and is as thick as its skin, and a spark leaps 0.3 mm to it. What comes free while the
site is grasped and retracted by 5 mm, with the pull on the liver under its limit and the hook's
force under 1.5 N, is `clean`; the rest is `torn`: what is not held away is not seen. A current that
divides nothing burns what the hook touches, which cools in 1.8 s; half a second of that is damage,
and so is a hook that presses with 3 N. Progress, success and failure are those of `dissect`; the
bed is too strong to be pulled off.
"""

import dataclasses
import itertools

import mujoco
import numpy as np
from palpate.engine.cutting.trails import SPARK

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...registry import exercise
from ..grasp import FUNDUS
from . import dissect
from .dissect import Dissect, hold, middle
from .dissect import observe as look
from .freeing import METRICS, count, earned, ruined

# Stiffness [N/m^3], strength [Pa] and energy [J/m^2] of the bed; ours, we know of no measurement. A
# pull within the limits does not free it.
BED = (1e7, 2.5e4, 40.0)
AWAY = 0.005  # least way of the site from the bed, for what is divided to count [m]
RATE = 5.0  # damage that the current does to bonds [1/s]
WIRE = "hook_toe"  # geom of the hook that has it
TOUCHING, BURN = 0.03, 0.5  # force with which the hook touches [N], time that it may burn [s]
# Of that time, what is forgotten in a second: a millimetre of tissue cools in d^2 / (4 a), with the
# a = 1.4e-7 m^2/s of water (van Gemert and Welch 1989, 10.1002/lsm.1900090414; Niemz 2007, Laser-
# Tissue Interactions, 3.2). Hands are late by 0.1 s.
COOLING = BURN / (1e-3**2 / (4 * 1.4e-7))
HOOK_LIMIT, HOOK_DAMAGE = 1.5, 3.0  # of its force, as of other tips without jaws [N]
ASIDE = 0.002  # how far a strand that is not near is said to be, at most [m]
SCENE = dataclasses.replace(
  FUNDUS, nodes=250, bonds=BED, second="hook", second_port=(-0.05, -0.01, 0.12)
)
_BURNING = 0.2  # share of that time after which somebody should step in
# Of the expert: how far it pulls at most [m], how much further than it has to, the share of the
# largest traction it keeps under, how far above a bond the hook aims and begins [m], at what share
# of the reach it stops, and at what share where others learn of it, who are less exact.
_FAR, _MORE, _SHARE, OFF, _WAITS, NEAR, _NEARER = 0.03, 0.3, 0.7, 0.0005, 0.01, 0.92, 0.8


class State(dissect.State):
  """State of a world."""

  heel: r.Vector  # end of the axis of the hook's wire, in the frame of its tip [m]
  toe: r.Vector  # the other end [m]
  reach: float  # of the current from that axis [m]
  rest: r.Vector  # the site's place at rest [m]
  away: r.Vector  # from the bed
  live: bool  # whether the current is on
  time: float  # how long it has burnt what the hook touches, less what has cooled [s]
  powered: float  # how long it was on [s]
  wasted: float  # with no bond in reach [s]
  aim: int  # bond to divide next
  hook_front: r.Vector
  hook_gap: float
  retracted: float
  burnt: float


# The rules. What goes over all bonds is written for numpy, and for many worlds below it.


def retraction(s, o):
  """Returns how far the site is from its place at rest, away from the bed [m]."""
  return r.dot(r.point(s, o.site) - o.rest, o.away)


def fair(s, o):
  """Returns whether what comes free now is held away from the bed, and divided gently."""
  return o.grasped == 1.0 and retraction(s, o) > AWAY and r.other_force(s) <= HOOK_LIMIT


def distances(s, o) -> np.ndarray:
  """Returns how far the bonds that hold are from the wire [m]  (n,); free ones are far away."""
  far = s.organ.bonds.distance(r.other_point(s, o.heel), r.other_point(s, o.toe))
  return np.where(s.organ.bonds.free, np.inf, far)


def divide(s, o):
  """Weakens the bonds in reach of the wire; returns whether there are any."""
  near = distances(s, o) < o.reach
  if near.any():
    s.organ.bonds.weaken(RATE * o.control_timestep * near)
  return bool(near.any())


@r.many(divide)
def _divide(s, o):
  found = int(0)
  for k in range(r.bonds(s)):
    far = r.strand_distance(s, k, r.other_point(s, o.heel), r.other_point(s, o.toe))
    if far < o.reach and not r.is_free(s, k):
      r.weaken(s, k, RATE * o.control_timestep)
      found += 1
  return found > 0


def gap(s, o):
  """Returns how far the nearest strand that holds is from the reach of the wire [m]."""
  return min(float(distances(s, o).min()) - o.reach, ASIDE)


@r.many(gap)
def _gap(s, o):
  least = float(ASIDE)
  for k in range(r.bonds(s)):
    if not r.is_free(s, k):
      far = r.strand_distance(s, k, r.other_point(s, o.heel), r.other_point(s, o.toe)) - o.reach
      least = min(least, far)
  return least


def nearest(s):
  """Returns which bond of those that hold is nearest to the hook's tip."""
  far = np.linalg.norm(s.organ.bonds.positions - r.other_tip(s), axis=1)
  return int(np.where(s.organ.bonds.free, np.inf, far).argmin())


@r.many(nearest)
def _nearest(s):
  found, least = int(0), float(r.FAR)
  for k in range(r.bonds(s)):
    far = r.length(r.bond(s, k) - r.other_tip(s))
    if far < least and not r.is_free(s, k):
      least = far
      found = k
  return found


def act(s, o):
  """Sends the current through the hook: it divides, or burns what the hook touches."""
  o.live = r.last_component(s, o) > 0.0
  burns = False
  if o.live:
    o.powered = o.powered + o.control_timestep
    if not divide(s, o):
      o.wasted = o.wasted + o.control_timestep
      burns = r.other_force(s) > TOUCHING
  o.time = max(o.time + o.control_timestep * (1.0 if burns else -COOLING), 0.0)
  return o


def advance(s, o):
  """Follows the grasp, what comes free, and what is burnt."""
  o, near = hold(s, o)
  o, outcome = count(s, o, fair(s, o))
  if r.is_free(s, o.aim):
    o.aim = nearest(s)
  if outcome == r.RUNNING and (o.time > BURN or r.other_force(s) > HOOK_DAMAGE):
    outcome = r.DAMAGED
  return o, earned(o, near, outcome), outcome


def observe(s, o):
  """Finds what `dissect` does, hook_front, hook_gap, retracted and burnt."""
  o = look(s, o)
  o.hook_front = r.bond(s, o.aim) - r.other_tip(s)
  o.hook_gap = gap(s, o)
  o.retracted = retraction(s, o) / AWAY
  o.burnt = min(o.time / BURN, 1.0)
  return o


@exercise("bimanual/easy", 40, "easy", "bimanual",
          asks="Hold the gallbladder and divide half of its bed with a hook",
          scene=SCENE, wanted=0.5)  # fmt: skip
@exercise("bimanual/standard", 60, "bimanual", asks="Divide 80 % of it",
          scene=SCENE, wanted=0.8, jitter=0.003)  # fmt: skip
@exercise("bimanual/hard", 80, "hard", "bimanual",
          asks="Divide 90 % of it with less force, on varying organs",
          scene=dataclasses.replace(SCENE, nodes=500), wanted=0.9, jitter=0.005,
          variants=(None, 1, 2), force_limit=3.4, damage=6.0, traction=1.2)  # fmt: skip
class Bimanual(Dissect):
  """Retract with one hand, dissect with the other."""

  rules = r.Rules(
    State,
    advance,
    observe,
    (*Dissect.rules.observed, "hook_front", "hook_gap", "retracted", "burnt"),
    METRICS | {"current_time": "powered", "current_wasted": "wasted"},
    {**Dissect.rules.columns, "current": "powered", "idle_current": "wasted"},
    act=act,
    mark=Dissect.rules.mark,
  )
  slots = 36

  @property
  def other(self) -> tuple[str, ...]:
    """See `Task`."""
    return ("current",)

  def begin(self, physics: Physics) -> None:
    """Draws the site to grasp."""
    super().begin(physics)
    self.time, self.powered, self.wasted, self.live = 0.0, 0.0, 0.0, False
    model, data = physics.model, physics.data
    wire, tip = data.geom(f"{self.second}{WIRE}"), data.site(f"{self.second}tip")
    width, half, _ = model.geom(f"{self.second}{WIRE}").size
    ends = wire.xpos + half * np.array([[-1], [1]]) * wire.xmat.reshape(3, 3)[:, 2]
    self.heel, self.toe = (ends - tip.xpos) @ tip.xmat.reshape(3, 3)
    flex = mujoco.mj_name2id(model.ptr, mujoco.mjtObj.mjOBJ_FLEX, physics.organ_name)
    self.reach = float(width + model.flex_radius[flex] + SPARK)
    self.aim = nearest(physics)
    self.rest = physics.point(self.site)
    away = self.rest - middle(physics)
    self.away = away / np.linalg.norm(away)

  def harsh(self, physics: Physics) -> bool:
    """Returns whether a force is over its limit, or the hook burns what it touches."""
    pressed = r.other_force(physics) > HOOK_LIMIT
    return super().harsh(physics) or pressed or self.time > _BURNING * BURN

  def label(self, kind: str) -> str:
    """Returns what damage is."""
    if kind == "damage" and not ruined(self):
      burnt = self.time > BURN
      return f"burnt for {self.time:.2f} s" if burnt else "the hook's force"
    return super().label(kind)

  def instruct(self, physics: Physics) -> str:
    """Says to grasp, to pull, or to divide."""
    if not self.grasped:
      return super().instruct(physics)
    if self.traction > self.limit:
      return "Pull less: the liver gives"
    if not fair(physics, self):
      return "Pull it further from its bed"
    if self.live and not np.isfinite(distances(physics, self)).any():
      return "Current off"
    share = f"{100 * self.clean:.0f} of {100 * self.wanted:.0f} % are free"
    return f"Hold it so, and divide its bed with the hook: {share}"

  def expert(self, p: Performer) -> Script:
    """Grasps and pulls with one hand; the other divides, bond by bond from its side."""
    assert p.other
    yield from p.both(self._pull(p), self._divide(p.other))

  def _pull(self, p: Performer) -> Script:
    """Grasps and pulls away from the bed, and holds it so."""

    def further(contact: float) -> bool:
      near = retraction(p.physics, self) < (1 + _MORE) * p.excess(contact) * AWAY
      return near and self.traction < _SHARE * self.limit

    for again in itertools.count():
      if self.outcome is not None:
        return
      yield from p.close(self.site, again)
      yield from self.pull(p, _FAR, further)

  def _divide(self, p: Performer) -> Script:
    """Waits for the pull, and goes from bond to bond."""
    physics, up = p.physics, p.hand.trocar().mat[:, 2]
    enough = (_NEARER if p.hasty else NEAR) * self.reach
    while self.outcome is None:
      p.extra[:] = -1.0
      if not fair(physics, self):
        yield p.step()
        continue
      goal, aim = physics.organ.bonds.positions[self.aim], self.aim
      if distances(physics, self)[aim] > self.reach:
        yield from p.above(goal, _WAITS, up)
      while self.outcome is None and fair(physics, self) and aim == self.aim:
        p.extra[:] = 1.0 if gap(physics, self) < 0.0 else -1.0
        if distances(physics, self)[aim] > enough:
          step = r.bond(physics, aim) + OFF * up - p.tip
          most = 0.02 * p.style.speed * self.control_timestep
          p.tip = p.tip + step * min(1.0, most / max(float(np.linalg.norm(step)), 1e-9))
        yield p.step()
