"""Dissect: grasp the gallbladder and pull it out of its bed on the liver, bond by bond.

Own observations: `target` (3,), from the tip to the site to grasp [m]; `front` (3,), from the tip
to the middle of the bonds that still hold [m]; `freed` (1,), share of the bed's area that is free
[-]; `traction` (1,), pull on the liver [N]; `grasped` (1,), whether the jaws hold the site, as in
`grasp`; here it may slip by 6 mm.

What comes free while the site is grasped and pulled slower than 25 mm/s, with the force and the
traction under their limits, is `clean`; the rest is `torn`. Progress: 0.1 * closeness until it is
grasped, 0.1 then, and besides 0.8 * clean / wanted. Success: the wanted share is clean. Failure: a
force above the damage limit, jaws included, a traction above twice its limit, which tears the
liver, so much torn that too little is left, or the time limit.

The bed stands: the liver is what its bonds pull at.
"""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...registry import exercise
from ..grasp import FUNDUS, GRIPS, Held, Hold, distance, follow
from .freeing import COLUMNS, METRICS, Freed, Freeing, count, earned, held, holding

# Stiffness [N/m^3], strength [Pa] and energy [J/m^2] of the bed, and of a tough one. Ours: we know
# of no measurement; the bed bears the organ, and comes away under half a newton or one.
BED, TOUGH = (1e7, 6e3, 8.0), (1e7, 7e3, 10.0)
RIP = 0.025  # speed of a pull from which on what comes free is torn [m/s]
# Of the expert: how far it pulls at most [m], how fast [m/s], and how much towards the trocar.
_FAR, _SPEED, _UP = 0.045, 0.01, 0.5


class State(Held, Freed):
  """State of a world."""

  front: r.Vector
  last: r.Vector  # where the tip was a control step ago [m]


# The rules.


def middle(s):
  """Returns the middle of the bonds that hold, or of all where none does [m]."""
  return held(s).mean(axis=0)


@r.many(middle)
def _middle(s):
  found, total = holding(s), r.vector(0.0, 0.0, 0.0)
  for k in range(r.bonds(s)):
    if found == 0 or not r.is_free(s, k):
      total += r.bond(s, k)
  return total / float(r.bonds(s) if found == 0 else found)


def hold(s, o):
  """Follows the grasp; returns too how close the tip is to it, 1 while it holds."""
  o, lost = follow(s, o)
  if lost:
    r.drop(s, o)
  return o, 1.0 if o.grasped == 1.0 else r.closeness(distance(s, o), o.distance0)


def advance(s, o):
  """Follows the grasp and what comes free."""
  o, near = hold(s, o)
  slow = r.length(r.tip(s) - o.last) < RIP * o.control_timestep
  o.last = r.tip(s)
  o, outcome = count(s, o, o.grasped == 1.0 and slow)
  return o, earned(o, near, outcome), outcome


def observe(s, o):
  """Finds target and front; freed, traction and grasped are up to date."""
  o.target = r.point(s, o.site) - r.tip(s)
  o.front = middle(s) - r.tip(s)
  return o


def mark(s, o, k):
  """Marks the site."""
  return r.point(s, o.site), r.NOW


@exercise("dissect/easy", 30, "easy", asks="Free half of the gallbladder's bed",
          scene=dataclasses.replace(FUNDUS, nodes=250, bonds=BED), wanted=0.5)  # fmt: skip
@exercise("dissect/standard", 40, asks="Free 80 % of it",
          scene=dataclasses.replace(FUNDUS, nodes=250, bonds=BED), wanted=0.8,
          jitter=0.003)  # fmt: skip
@exercise("dissect/hard", 60, "hard",
          asks="Free 85 % of a tough bed with less force, on varying organs",
          scene=dataclasses.replace(FUNDUS, nodes=500, bonds=TOUGH), wanted=0.85, jitter=0.005,
          variants=(None, 1, 2), force_limit=3.4, damage=6.0, traction=1.2)  # fmt: skip
class Dissect(Freeing, Hold):
  """Free an organ from its bed by traction."""

  rules = r.Rules(
    State, advance, observe, ("target", "front", "freed", "traction", "grasped"), METRICS,
    COLUMNS | GRIPS, mark=mark,
  )  # fmt: skip
  slip = 0.006

  def __init__(self, **kwargs):
    """Makes the task, see `Freeing`; the force limit counts the jaws too."""
    limits = {"force_limit": 4.0, "damage": 8.0, "traction": 1.5}
    super().__init__(**{"spread": 0.012, **limits, **kwargs})

  def begin(self, physics: Physics) -> None:
    """Draws the site to grasp."""
    super().begin(physics)
    self.whole(physics)
    self.last = physics.tip_pos()
    self.reference_length = self.distance0 + 0.03  # off the bed

  def instruct(self, physics: Physics) -> str:
    """Says to grasp, or to pull."""
    if not self.grasped:
      return "Open the jaws, go over the marked fold and close them gently"
    if self.traction > self.limit:
      return "Pull less: the liver gives"
    return f"Pull it off its bed: {100 * self.clean:.0f} of {100 * self.wanted:.0f} % are free"

  def expert(self, p: Performer) -> Script:
    """Grasps and pulls away from the bed, and grasps again what slipped."""
    up = p.hand.trocar().mat[:, 2]
    for again in itertools.count():
      if self.outcome is not None:
        return
      yield from p.close(self.site, again)
      yield from p.wait(p.style.delay)
      most = _FAR * (1 + 0.3 * p.style.overshoot)
      yield from self.pull(p, most, lambda contact: self.traction < 0.8 * self.limit)
      yield from p.move(p.tip + 0.02 * up)

  def pull(self, p: Performer, most: float, further: Callable[[float], bool]) -> Script:
    """Pulls what is grasped away from the bed until it is lost or all is done, and lets go.

    Args:
      p: who has grasped it
      most: how far at most [m]
      further: whether to pull on, by the time that it was held [s]
    """
    away = p.physics.point(self.site) - middle(p.physics)
    along = away / np.linalg.norm(away) + _UP * p.hand.trocar().mat[:, 2]
    along /= np.linalg.norm(along)
    start, far, contact = p.tip.copy(), 0.0, 0.0
    while self.grasped and self.outcome is None:
      contact += self.control_timestep
      if further(contact):
        far = min(far + _SPEED * p.style.speed * self.control_timestep, most)
      p.tip = start + far * along
      p.grip(contact)
      yield p.step()
    yield from p.open()
