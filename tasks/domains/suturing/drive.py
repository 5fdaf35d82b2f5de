"""Drive: drive a needle through two marked points of a wall, in and out, with a wristed driver.

A needle of 26 mm, half a circle, starts in the jaws. It enters at the first mark, follows its own
circle under the wall, and leaves at the second mark, 12 mm on. The wall dents under the tip until
it is pierced; then the needle slides through its hole, see `palpate.add_organ(needles=)`.

Own observations, in the world: `target` (3,), from the needle's tip to the mark whose turn it is
[m]; `way` (3,), from the first mark to the second one [-]; `circle` (3,), axis of the needle's
circle [-]; `middle` (3,), from the first mark to the middle of that circle [m]; `pierced` (1,),
holes that the needle has made in their turn [-]; `out` (1,), how far the tip has come out, as a
share of what is wanted [-]; `holds` (1,), whether the jaws hold the needle.

Progress: 0.3 * closeness of the tip to the first mark; 0.4 + 0.2 * closeness to the second one once
it is in; 0.7 + 0.3 * out once it is through both. Success: both holes within the tolerance of their
marks, and the tip out by 5 mm. Failure: a hole farther from its mark, a needle that nobody holds
for half a second, a force of the needle on the wall above the damage limit, or the time limit.
"""

import math

import mujoco
import numpy as np
import palpate

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...core.scenes import Scene
from ...registry import exercise
from .. import sheet
from . import needles as n

BITE = 0.012  # between the marks [m]; FLS: 5 mm on either side of a slit
WANTED = 0.005  # how far the tip is to come out [m]
FIELD = Scene(
  organ="sheet", instrument="psm", port=(-0.035, 0.1, 0.07), camera=(0.04, 0.06, 0.06), nodes=400
)
_MASS, _SLOTS = 0.004, 120  # of the wall [kg], and of its window
_HELD_AT = math.radians(-65.0)  # along the arc from its middle [rad]
# How high over the wall it begins, and of the expert the tip's way out at the end beyond that [m].
_OVER, _MORE = 0.012, 0.0015


class State(n.Driving):
  """State of a world."""

  damage: float  # [N]
  pull: float  # of the needle on the wall [N]
  pulled: float  # the largest so far [N]
  deepest: float  # how far the needle was under the wall [m]
  way: r.Vector
  middle: r.Vector
  out: float
  holds: float


# The rules.


def advance(s, o):
  """Follows the needle through the wall."""
  o = n.grasped(s, o, n.right_grasp(s), 0.0)
  count, pull = r.pierced(s)
  o.pull = pull
  o.pulled = max(o.pulled, pull)
  o, worst = n.open_holes(s, o, min(count, 2))
  if o.holes > 0:
    o.deepest = max(o.deepest, -n.lowest(s))
  o.out = 0.0
  if o.holes == 2:
    _, along = r.pinhole(s, 1)
    o.out = r.clamp((2.0 * n.QUARTER * n.RADIUS - along) / WANTED, 0.0, 1.0)
  if o.pull > o.damage:
    return o, -1.0, r.DAMAGED
  far = r.length(n.arc(s, 1.0) - o.marks[min(o.holes, 1)])
  progress = 0.3 * r.closeness(far, o.start0)
  if o.holes == 1:
    progress = 0.4 + 0.2 * r.closeness(far, BITE)
  if o.holes == 2:
    progress = 0.7 + 0.3 * o.out
  if worst > o.tolerance or o.loose > n.LOST:
    return o, progress, r.MISSED
  return o, progress, r.SUCCESS if o.out >= 1.0 else r.RUNNING


def observe(s, o):
  """Finds where the needle is."""
  middle = r.needle_place(s, r.vector(0.0, 0.0, 0.0))
  o.target = o.marks[min(o.holes, 1)] - n.arc(s, 1.0)
  o.circle = r.needle_place(s, r.vector(0.0, 0.0, 1.0)) - middle
  o.middle = middle - o.marks[0]
  o.pierced = float(o.holes)
  o.holds = o.right_holds
  return o


@exercise("suture/drive_easy", 20, "easy",
          asks="Drive a needle through two marks 12 mm apart, within 3 mm",
          scene=FIELD, tolerance=0.003, turn=10.0)  # fmt: skip
@exercise("suture/drive_standard", 25, asks="Drive it within 2 mm, in changing directions",
          scene=FIELD, tolerance=0.002, turn=25.0, jitter=0.003)  # fmt: skip
@exercise("suture/drive_hard", 30, "hard",
          asks="Drive it within 1 mm, as FLS asks for, through a tougher wall",
          scene=FIELD, tolerance=0.001, turn=25.0, jitter=0.005, tough=1200.0)  # fmt: skip
class Drive(n.Stitching):
  """Drive a needle through two marks."""

  rules = r.Rules(
    State,
    advance,
    observe,
    ("target", "way", "circle", "middle", "pierced", "out", "holds"),
    metrics={"peak_traction": "pulled", "bite_depth": "deepest"},
    columns={"traction": "pull", "bite": "deepest"},
    mark=n.mark_hole,
  )
  targets = 2

  def __init__(self, *, tolerance: float, turn: float, tough: float = n.TOUGH, **kwargs):
    """Makes the task.

    Args:
      tolerance: largest distance of holes from their marks [m]
      turn: largest rotation of the bite about the vertical [deg]
      tough: energy that opens an area of the wall [J/m^2]
      **kwargs: see Task
    """
    self.tolerance, self.turn, self.tough = tolerance, math.radians(turn), tough
    super().__init__(**{"force_limit": 2.0, "damage": 6.0, **kwargs})

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene: a wall in a frame, and the needle."""
    law = {"needles": f"needle {self.tough:g} {n.FRICTION:g}"}
    spec = sheet.stretched(self._scene(variant), n.WALL | law, _MASS, slots=_SLOTS)
    self.meet(spec)
    apart = (0.1, 0.0, -0.05)  # until an episode begins
    meets = {"contype": 1 | n.MEETS, "conaffinity": 1 | n.MEETS}
    palpate.add_needle(spec, pos=apart, quat=(1, 1, 0, 0), contact=meets)
    return spec

  def begin(self, physics: Physics) -> None:
    """Draws the marks and how the jaws hold the needle."""
    angle = self.random.uniform(-self.turn, self.turn)
    middle = np.array([*self.random.uniform(-0.005, 0.005, 2), 0.0])
    self.way = -np.array([math.cos(angle), math.sin(angle), 0.0])
    self.marks = middle + np.outer([-0.5, 0.5], BITE * self.way)
    place, mat = n.piercing(self.marks, -n.half_angle(self.marks) - math.radians(20.0))
    place = place + np.array([0.0, 0.0, _OVER]) + self.random.uniform(-0.003, 0.003, 3)
    tip = self.take_up(physics, (place, mat), _HELD_AT, lean=0.15, along=0.1)
    self.holes, self.misses = 0, np.zeros(2)
    self.out = self.deepest = self.pull = self.pulled = self.pierced = 0.0
    self.holds, self.target, self.circle, self.middle = 1.0, *np.zeros((3, 3))
    self.start0 = float(np.linalg.norm(tip - self.marks[0]))

  def instruct(self, physics: Physics) -> str:
    """Says what is next."""
    return (
      "Bring the needle's tip to the yellow mark, and turn it in",
      "Turn the needle about its circle, to the yellow mark",
      "Turn it on until the tip is out",
    )[self.holes]

  def expert(self, p: Performer) -> Script:
    """Puts the needle over the first mark, and turns it about its circle through both."""
    end = n.half_angle(self.marks) + (WANTED + _MORE) / n.RADIUS
    if not self.holes:
      yield from n.approach(p, self.marks, math.radians(12.0))
    while n.tip_angle(p.physics, self.marks) <= end - 0.01:
      yield from n.turn_on(p, self.marks, end)
