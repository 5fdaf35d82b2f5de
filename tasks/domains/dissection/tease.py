"""Tease: free a strip of tissue from what it has grown on to, by blunt strokes under it.

Own observations: `target` (3,), from the tip to the front of what still holds, in the middle of its
width [m]; `freed` (1,), share of the strip's area that is free [-]; `traction` (1,), pull on what
is under it [N].

What comes free while the force is under its limit is `clean`; the rest is `torn`. Progress: 0.1 *
closeness to the first front, at its best, + 0.8 * clean / wanted. Success: the wanted share is
clean. Failure: a force above the damage limit, so much torn that too little is left, or the time
limit.
"""

import dataclasses
import itertools

import mujoco
import numpy as np

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...core.scenes import Scene
from ...registry import exercise
from . import adhesion
from .freeing import COLUMNS, METRICS, Freed, Freeing, count, earned, held, holding

# Stiffness [N/m^3], strength [Pa] and energy [J/m^2]: ours, we know of no measurement.
FILMY, DENSE = (1e7, 6e3, 6.0), (1e7, 8e3, 12.0)
SCENE = Scene(organ="adhesion", nodes=250, port=(0.0, -0.13, 0.065), camera=(-0.07, -0.06, 0.06))
# Of the expert: where the tip is over the bed and behind the front before a stroke, how far a
# stroke goes beyond the front, how wide a lane is [m], and how fast a stroke and the way back are
# [m/s]. Back faster, the tip leaves what it held up, and the strip falls on the shaft behind it.
_OVER, _BEHIND, _BEYOND, _LANE = 0.002, 0.006, 0.006, 0.006
_SPEED, _BACK = 0.03, 0.012
_UNDER, _LOW = 0.02, 0.005  # from the front and the bed at most, of a tip under the strip [m]
ROW = 0.5 * _LANE  # bonds of the front are no farther from the first of them [m]


class State(Freed):
  """State of a world."""

  front: r.Vector  # of what holds [m]
  distance0: float  # [m]
  nearest: float  # best closeness so far
  target: r.Vector


# The rules.


def front(s):
  """Returns the middle of the first row of bonds that hold, or of all where none does [m]."""
  where = held(s)
  row = where[where[:, 1] < where[:, 1].min() + ROW]
  return np.array([0.0, row[:, 1].min(), row[:, 2].mean()])


@r.many(front)
def _front(s):
  every, low, high, found = holding(s) == 0, float(r.FAR), float(0.0), float(0.0)
  for k in range(r.bonds(s)):
    if every or not r.is_free(s, k):
      low = min(low, r.bond(s, k)[1])
  for k in range(r.bonds(s)):
    if (every or not r.is_free(s, k)) and r.bond(s, k)[1] < low + ROW:
      high += r.bond(s, k)[2]
      found += 1.0
  return r.vector(0.0, low, high / found)


def distance(s, o):
  """Returns how far the tip is from the front [m]."""
  return r.length(o.front - r.tip(s))


def advance(s, o):
  """Follows what comes free."""
  o, outcome = count(s, o, True)
  o.front = front(s)
  o.nearest = max(o.nearest, r.closeness(distance(s, o), o.distance0))
  return o, earned(o, o.nearest, outcome), outcome


def observe(s, o):
  """Finds target; freed and traction are up to date."""
  o.target = o.front - r.tip(s)
  return o


def mark(s, o, k):
  """Marks the front."""
  return o.front, r.NOW


@exercise("tease/easy", 40, "easy", asks="Free 40 % of a filmy adhesion",
          scene=SCENE, wanted=0.4, law=FILMY)  # fmt: skip
@exercise("tease/standard", 60, asks="Free half of it",
          scene=SCENE, wanted=0.5, law=FILMY, jitter=0.003)  # fmt: skip
@exercise("tease/hard", 80, "hard", asks="Free 60 % of a dense one with less force",
          scene=SCENE, wanted=0.6, law=DENSE, jitter=0.005, force_limit=1.2)  # fmt: skip
class Tease(Freeing):
  """Free a strip by blunt strokes."""

  watch = ("unintended_contact",)
  rules = r.Rules(
    State, advance, observe, ("target", "freed", "traction"), METRICS, COLUMNS, mark=mark
  )
  slots = 24

  def __init__(self, *, scene: Scene, law: tuple[float, float, float], **kwargs):
    """Makes the task.

    Args:
      scene: of the exercise
      law: stiffness [N/m^3], strength [Pa] and energy [J/m^2] of what holds it
      **kwargs: see `Freeing`
    """
    super().__init__(scene=dataclasses.replace(scene, bonds=law), **{"traction": 2.0, **kwargs})

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene, which has no other shapes."""
    return adhesion.build(self._scene(variant))

  def place_of_work(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the triangles, and where the strip begins to hold [m]."""
    return np.arange(len(physics.organ.elem)), front(physics)

  def begin(self, physics: Physics) -> None:
    """Marks the front."""
    self.whole(physics)
    self.front, self.nearest = front(physics), 0.0
    self.distance0 = distance(physics, self)
    lanes = self.wanted * adhesion.LENGTH * adhesion.WIDTH / _LANE
    self.reference_length = self.distance0 + 2 * lanes  # there and back

  def instruct(self, physics: Physics) -> str:
    """Says to stroke."""
    share = f"{100 * self.clean:.0f} of {100 * self.wanted:.0f} % are free"
    return f"Go under the flap and push gently along, side by side: {share}"

  def expert(self, p: Performer) -> Script:
    """Strokes under the strip, lane by lane, a little beyond where it holds."""
    physics, sides = p.physics, (0.0, -_LANE, _LANE)
    along, far = np.array([0.0, 1.0, 0.0]), _BEHIND + _BEYOND * (1 + p.style.overshoot)
    # Where somebody else was under the strip it begins with their lane.
    under = distance(physics, self) < _UNDER and p.tip[2] < _LOW
    here = [abs(p.tip[0] - x) for x in sides] if under else []
    first = int(np.argmin(here)) if here else 0
    for turn in itertools.count(first):
      if self.outcome is not None:
        return
      x = sides[turn % len(sides)]
      bonds = physics.organ.bonds
      where = bonds.positions[~bonds.free]
      lane = where[np.abs(where[:, 0] - x) < 0.75 * _LANE]
      if not len(lane):
        continue
      front = lane[:, 1].min()
      start = np.array([x, front - _BEHIND, _OVER])
      if not turn and not here:
        yield from p.move(start - 0.025 * along)
      yield from p.move(start)
      yield from p.move(start + far * along, speed=_SPEED)
      yield from p.move(start, speed=_BACK)
