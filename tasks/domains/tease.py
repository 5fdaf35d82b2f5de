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

from ..base import Physics
from ..core.rules import closeness
from ..performer import Performer, Script
from ..registry import exercise
from ..scenes import Scene
from . import adhesion
from .freeing import Freeing

# Stiffness [N/m^3], strength [Pa] and energy [J/m^2]: ours, we know of no measurement.
FILMY, DENSE = (1e7, 6e3, 6.0), (1e7, 8e3, 12.0)
SCENE = Scene(
  organ="adhesion",
  nodes=250,
  port=(0.0, -0.13, 0.065),
  camera=(-0.07, -0.06, 0.06),
)
# Of the expert: where the tip is over the bed and behind the front before a stroke, how far a
# stroke goes beyond the front, how wide a lane is [m], and how fast a stroke and the way back are
# [m/s]. Back faster, the tip leaves what it held up, and the strip falls on the shaft behind it.
_OVER, _BEHIND, _BEYOND, _LANE = 0.002, 0.006, 0.006, 0.006
_SPEED, _BACK = 0.03, 0.012
_UNDER, _LOW = 0.02, 0.005  # from the front and the bed at most, of who is under the strip [m]
ROW = 0.5 * _LANE  # bonds of the front are no farther from the first of them [m]


@exercise("tease/easy", 40, "easy")
def easy(**kwargs):
  """Free 40 % of a filmy adhesion."""
  return Tease(SCENE, **{"wanted": 0.4, "law": FILMY, **kwargs})


@exercise("tease/standard", 60)
def standard(**kwargs):
  """Free half of it."""
  kwargs = {"wanted": 0.5, "law": FILMY, "jitter": 0.003, **kwargs}
  return Tease(SCENE, **kwargs)


@exercise("tease/hard", 80, "hard")
def hard(**kwargs):
  """Free 60 % of a dense one with less force."""
  kwargs = {"wanted": 0.6, "law": DENSE, "jitter": 0.005, "force_limit": 1.2, **kwargs}
  return Tease(SCENE, **kwargs)


class Tease(Freeing):
  """Free a strip by blunt strokes."""

  watch = ("unintended_contact",)

  touched = 24

  def __init__(
    self,
    scene: Scene,
    random=None,
    *,
    wanted: float,
    law: tuple[float, float, float],
    traction: float = 2.0,
    **kwargs,
  ):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      wanted: share of the strip that must come free cleanly [-]
      law: stiffness [N/m^3], strength [Pa] and energy [J/m^2] of what holds it
      traction: limit of the pull on what is under it [N]
      **kwargs: see Task
    """
    kwargs |= {"wanted": wanted, "traction": traction}
    super().__init__(dataclasses.replace(scene, bonds=law), random, **kwargs)

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene, which has no other shapes."""
    return adhesion.build(self._scene(variant))

  def place_of_work(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the triangles, and where the strip begins to hold [m]."""
    return np.arange(len(physics.organ.elem)), self.front(physics)

  def begin(self, physics: Physics) -> None:
    """Marks the front."""
    self.whole(physics)
    self._goal = self.front(physics)
    self.distance0 = self.distance(physics)
    self.nearest = 0.0
    physics.mark(0, self._goal, now=True)

  def front(self, physics: Physics) -> np.ndarray:
    """Returns the middle of the first row of bonds that hold [m]  (3,)."""
    bonds = physics.organ.bonds
    holds = ~bonds.free
    where = bonds.positions[holds if holds.any() else slice(None)]
    row = where[where[:, 1] < where[:, 1].min() + ROW]
    return np.array([0.0, row[:, 1].min(), row[:, 2].mean()])

  def distance(self, physics: Physics) -> float:
    """Returns how far the tip is from the front [m]."""
    return float(np.linalg.norm(self._goal - physics.tip_pos()))

  def advance(self, physics: Physics) -> float:
    """Follows what comes free."""
    self.count(physics)
    self._goal = self.front(physics)
    physics.mark(0, self._goal, now=True)
    near = closeness(self.distance(physics), self.distance0)
    self.nearest = max(self.nearest, near)
    return self.earned(self.nearest)

  def instruct(self, physics: Physics) -> str:
    """Says to stroke."""
    share = f"{100 * self.clean:.0f} of {100 * self.wanted:.0f} % are free"
    return f"Go under the flap and push gently along, side by side: {share}"

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns target, freed and traction."""
    return {
      "target": self._goal - physics.tip_pos(),
      "freed": np.array([self.freed]),
      "traction": np.array([self.traction]),
    }

  def reference_length(self) -> float:
    """Returns the way to the strip and there and back along its lanes [m]."""
    return self.distance0 + 2 * self.wanted * adhesion.LENGTH * adhesion.WIDTH / _LANE

  def expert(self, p: Performer) -> Script:
    """Strokes under the strip, lane by lane, a little beyond where it holds."""
    physics, sides = p.physics, (0.0, -_LANE, _LANE)
    along, far = np.array([0.0, 1.0, 0.0]), _BEHIND + _BEYOND * (1 + p.style.overshoot)
    # Where somebody else was under the strip it begins with their lane.
    under = self.distance(physics) < _UNDER and p.tip[2] < _LOW
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
