"""Stitch: close a slit with one stitch by two wristed needle drivers: drive, pull and tie.

FLS task 5 up to its first throw, from the needle on. A needle with its thread begins in the right
hand's jaws. It goes in through the first mark of a slit tube and out through the second one, where
the left hand takes it and draws it up, until a short tail of the thread is left. The right hand
takes the long tail, and the left one pulls the needle off: needles of interrupted stitches are made
to come off their thread. Then both tie a throw as in `knot`.

The tube has the shape of the drain of `drain`, but it is of silicone, 1 mm thick, and filled with
foam, as suture pads are: under a needle the drain's lips would give way to where the second mark
is. There is no gravity: needle and thread float, the thread as in water.

Own observations beside those of `knot`: `target` (3,), from the needle's tip to the mark whose turn
it is [m]; `circle` (3,), axis of the needle's circle [-]; `needle` (3,), from the right tip to the
middle of that circle [m]; `pierced` (1,), holes that are made [-]; `attached` (1,), whether the
needle is on its thread. `right_holds` and `left_holds` tell of needle and thread.

Success: as in `knot`, with both holes within the tolerance of their marks. Progress: 0.1 *
closeness of the tip to the first mark; 0.1 + 0.1 * closeness to the second one; 0.2 + 0.1 * the
share of the needle that is through both; 0.3 once that is through, 0.4 once it is off; then that of
`knot`. Failure: a hole farther from its mark, a needle that nobody holds for half a second while it
is on its thread, and what fails in `knot`.
"""

import math

import mujoco
import numpy as np
from palpate.models import wrist

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...core.scenes import Scene
from ...core.stage import Stage
from ...registry import exercise
from . import drain, knot
from . import needles as n
from .drain import BITE
from .knot import BEYOND, Knot, follow, judge, see_tails
from .tie import HOLD, Tie

FIELD = Scene(
  instrument="psm", second="psm", port=(0.06, -0.1, 0.08), second_port=(-0.06, -0.1, 0.08),
  camera=(0.0, -0.1, 0.06), nodes=400,
)  # fmt: skip
# Soft silicone on foam, how tough it is, and friction in it; ours.
_WALL = {"young": 5e5, "thickness": 0.001, "damping": 0.003, "foundation": 3e6}
_TOUGH, _FRICTION = 1200.0, 100.0  # [J/m^2], [N/m]
_MEETS = 64  # bit of what meets the needle, beside bit 1 of the tube
_DRAG = 2e-3  # of the thread, as in water [N s/m^2]
# Pull at which the needle comes off [N], and edges of the thread beside it that it is read from.
# Needles that are made for it do so with 0.3 to 7 N (1 to 26 oz, patent CA 1042301).
_OFF, _BESIDE = 1.0, 6
# A needle that is off and let go of for so long [s] is taken away: as far right and down [m].
_TAKEN, _RIGHT, _DOWN = 0.1, 0.1, 0.05
# How the needle begins: its tip before the first mark [rad], off its circle through it, and how far
# that is drawn [m]; how the thread does, away from both hands.
_BEFORE, _OVER, _DRAWN = math.radians(10.0), np.array([0.003, 0.0, 0.008]), 0.003
_TAIL = np.array([-0.4, 0.3, 0.85])
# Of the expert: the tip before the first mark, how far it turns at once, and out of the tube [rad];
# how fast a hand tugs at the needle [m/s], and how far it goes aside then [m].
_NEAR, _LOOK, _THROUGH = math.radians(25.0), 0.3, math.radians(185.0)
_TUG, _ASIDE = 0.02, 0.03


class State(knot.State, n.Driving):
  """State of a world."""

  worst: float  # how far a hole is from its mark at most [m]
  torn: float  # how far a hole has torn at most [m]
  placed: bool  # whether the needle is through
  right_needle: float  # whether a hand holds the needle; right_holds tells of the thread too
  left_needle: float
  needle: r.Vector
  attached: float  # whether the needle is on its thread


# The rules.


def begin(s, o):
  """Lets the hands hold no thread, and the needle be on it."""
  for hand in range(2):
    r.hold(s, hand, -1, o.anchors[hand], False)
  r.fasten(s, o, True)
  return o


def look(s, o):
  """Follows needle and thread through the tube, and who holds what."""
  o = follow(s, o)
  count, _pull = r.pierced(s)
  for k in range(count):
    o.torn = max(o.torn, r.torn_at(s, k))
  o, worst = n.open_holes(s, o, min(count, 2))
  o.worst = worst
  if o.whole and not o.placed:
    _, along = r.pinhole(s, 1)
    o.placed = along < 0.0
  if not o.placed:
    o.whole = True
    o.tied = 0.0
  right, left = n.right_grasp(s), n.left_grasp(s)
  if o.attached > 0.0:
    o.right_holds = o.right_needle
    o.left_holds = o.left_needle
    o = n.grasped(s, o, right, left)
    o.right_needle = right
    o.left_needle = left
    if r.tugged(s, 0, _BESIDE) > _OFF:
      r.fasten(s, o, False)
      o.attached = 0.0
  else:
    o.loose = o.loose + o.control_timestep if right + left == 0.0 else 0.0
    if o.loose > _TAKEN:
      r.put_away(s, r.vector(_RIGHT, 0.0, -_DOWN))
  return o


def advance(s, o):
  """Follows the stitch; see the module's head."""
  o = look(s, o)
  o, progress, outcome = judge(s, o)
  dropped = o.attached > 0.0 and o.loose > n.LOST
  if outcome == r.RUNNING and (dropped or o.worst > o.tolerance):
    outcome = r.MISSED
  if outcome != r.RUNNING or o.tied > 0.0:
    return o, progress, outcome
  if o.placed:
    return o, 0.3 if o.attached > 0.0 else 0.4, outcome
  if o.holes == 2:
    _, along = r.pinhole(s, 1)
    return o, 0.2 + 0.1 * r.clamp(1.0 - along / (2.0 * n.QUARTER * n.RADIUS), 0.0, 1.0), outcome
  far = r.length(n.arc(s, 1.0) - o.marks[o.holes])
  start = BITE if o.holes > 0 else o.start0
  return o, 0.1 * (float(o.holes) + r.closeness(far, start)), outcome


def observe(s, o):
  """Finds where needle and tails are, and who holds one."""
  o = see_tails(s, o)
  o.right_holds = max(float(o.firm[0]), o.attached * o.right_needle)
  o.left_holds = max(float(o.firm[1]), o.attached * o.left_needle)
  middle = r.needle_place(s, r.vector(0.0, 0.0, 0.0))
  o.target = o.marks[min(o.holes, 1)] - n.arc(s, 1.0)
  o.circle = r.needle_place(s, r.vector(0.0, 0.0, 1.0)) - middle
  o.needle = middle - r.tip(s)
  o.pierced = float(o.holes)
  return o


@exercise(
  "suture/stitch_easy", 60, "easy", "bimanual",
  asks="Drive a needle through both lips of a slit within 2 mm of its marks, and tie one throw",
  scene=FIELD, turns=(1,), tolerance=0.002,
)  # fmt: skip
@exercise("suture/stitch_standard", 60, "bimanual",
          asks="Drive it within 1 mm, as FLS asks for, and tie a double throw",
          scene=FIELD, turns=(2,), tolerance=0.001, jitter=0.002)  # fmt: skip
class Stitch(Knot, n.Stitching):
  """Drive a needle through a slit, draw its thread through, and tie a throw.

  Attributes:
    placed: whether the needle is through
    attached: whether it is on its thread
  """

  rules = r.Rules(
    State,
    advance,
    observe,
    (*Knot.rules.observed, "target", "circle", "needle", "pierced", "attached"),
    metrics={**Knot.rules.metrics, "tearing": "torn", "regrasps": "regrasps"},
    begin=begin,
    shared=("turns", "lips", "wall", "marks"),
    mark=n.mark_hole,
  )
  targets = 2

  def __init__(self, *, tolerance: float, **kwargs):
    """Makes the task.

    Args:
      tolerance: largest distance of holes from their marks [m]
      **kwargs: see `Knot`
    """
    self.tolerance = tolerance
    self.marks = drain.MIDDLE + np.outer([0.5, -0.5], [drain.BITE, 0.0, 0.0])
    super().__init__(**kwargs)

  def build(self, variant: int | None, nodes: np.ndarray) -> mujoco.MjSpec:
    """Returns the tube, and the thread with its needle, away from it until an episode begins."""
    down = -_DOWN - drain.EDGE * np.arange(len(nodes))
    line = np.stack([np.full(len(nodes), _RIGHT), np.zeros(len(nodes)), down], axis=1)
    spec = drain.build(
      self._scene(variant), line, friction=_FRICTION, tough=_TOUGH, wall=_WALL, needle=1 | _MEETS,
      drag=_DRAG,
    )  # fmt: skip
    spec.option.gravity = np.zeros(3)
    self.meet(spec, _MEETS)
    return spec

  def label(self, kind: str) -> str:
    """Returns what an event of the rules is called: holes come before the throw."""
    return "hole" if kind == "target" and self.holes < 2 else super().label(kind)

  def _stage(self, spec: mujoco.MjSpec) -> Stage:
    """Returns the stage, whose thread is not sewn."""
    return super(Knot, self)._stage(spec)

  def place(self, physics: Physics) -> None:
    """Puts the needle into the right hand's jaws, its thread away from both."""
    pos, mat = n.piercing(self.marks, -n.half_angle(self.marks) - _BEFORE)
    pos = pos + _OVER + self.random.uniform(-_DRAWN, _DRAWN, 3)
    angle, tilt = n.RIGHT
    tip = self.take_up(physics, (pos, mat), angle, lean=0.1, along=0.08, side=-1.0, tilt=tilt)
    self.start0 = float(np.linalg.norm(tip - self.marks[0]))
    tail = _TAIL + self.random.uniform(-0.15, 0.15, 3)
    swage = 2.0 * pos - tip
    thread = physics.thread
    assert thread
    thread.lay(np.array([swage, swage + tail]))
    self.threads = {thread.name: thread.positions}
    left = physics.hands[1]
    place, turn = n.park(left.trocar())
    place = place + self.random.uniform(-0.005, 0.005, 3)
    left.set_joints(wrist.inverse(left.trocar(), place, turn))
    self.placed, self.attached, self.pierced = False, 1.0, 0.0
    self.holes, self.misses, self.worst, self.torn = 0, np.zeros(2), 0.0, 0.0
    self.right_needle, self.left_needle = 1.0, 0.0
    self.target, self.circle, self.needle = np.zeros((3, 3))

  def still(self, hand: int) -> np.ndarray:
    """Returns what keeps the jaws closed on the needle, or open."""
    return n.Stitching.still(self, hand)

  def show(self, physics: Physics) -> None:
    """Marks the holes that are left, the next one in yellow."""
    super(Knot, self).show(physics)

  def recorded(self, physics: Physics) -> dict[str, float]:
    """Returns how far a hole is torn and how often the needle was grasped anew as well."""
    return {**super().recorded(physics), "torn": self.torn, "regrasped": self.regrasps}

  def instruct(self, physics: Physics) -> str:
    """Says what is next."""
    if not self.attached:
      return super().instruct(physics)
    if self.placed:
      if self.firm[0]:
        return "Pull the needle off its thread"
      return "Draw the thread up until 2 cm are left, and take it 1 cm below the needle"
    return (
      "Bring the needle's tip to the yellow mark, and turn it in",
      "Turn the needle about its circle, to the yellow mark",
      "Take the needle's tip with the left hand, and draw it through",
    )[self.holes]

  def expert(self, p: Performer) -> Script:
    """The right hand drives the needle, the left one draws it through; both tie."""
    assert p.other
    tie, left = Tie(self, p), p.other
    yield from n.one(p, p, self._drive(p))
    yield from n.one(p, left, n.take(left, *n.LEFT))
    yield from n.one(p, p, n.let_go(p))
    yield from n.one(p, left, self._draw(left))
    yield from tie.catch(1, round(BEYOND / drain.EDGE))
    yield from n.one(p, left, self._pull_off(left))
    yield from tie.wind(1, self.turns[0])
    yield from tie.draw(1)
    yield from tie.tighten(1)

  def _drive(self, p: Performer) -> Script:
    """Puts the needle over the first mark, and turns it about its circle through both."""
    yield from n.approach(p, self.marks, _NEAR)
    while self.holes < 2 or n.tip_angle(p.physics, self.marks) < n.OUT - 0.02:
      end = max(n.OUT, n.tip_angle(p.physics, self.marks) + 0.2)
      yield from n.turn_on(p, self.marks, end, _LOOK)

  def _draw(self, p: Performer) -> Script:
    """Turns the needle out of the tube, and draws it up to where its thread is to end."""
    end = n.half_angle(self.marks) + _THROUGH
    while n.tip_angle(p.physics, self.marks) < end - 0.05:
      yield from n.turn_on(p, self.marks, end)
    mat = n.piercing(self.marks, end)[1]
    pose = self.line()[0] + n.RADIUS * mat[:, 1], mat
    yield from n.carry(p, lambda t: pose)
    yield from n.arrive(p)

  def _pull_off(self, p: Performer) -> Script:
    """Pulls the needle off the thread that the other hand holds, and lets go of it aside."""
    places = self.line()
    up = (places[0] - places[1]) / np.linalg.norm(places[0] - places[1])
    while self.attached:
      p.tip = p.tip + _TUG * p.dt * up
      yield p.step()
    yield from p.line(p.tip - np.array([_ASIDE, 0.0, 0.0]), _ASIDE)
    yield from n.jaws(p, n.WIDE)
    yield from n.jaws(p, HOLD)
