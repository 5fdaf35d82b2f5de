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

It has no vectorised form: its rules look at the thread beside the needle, and take the needle off.
"""

import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
import palpate
from palpate.models import wrist

from ...core.base import Physics
from ...core.performer import Performer, Script
from ...core.rules import (
  DAMAGED,
  OUTCOMES,
  SUCCESS,
  clamp,
  closeness,
  needle_place,
  pierced,
  pinhole,
  torn_at,
)
from ...core.scenes import Scene
from ...core.stage import Stage
from ...registry import exercise
from . import drain, knot
from .knot import BEYOND, HOLD, Knot, Tie
from .needles import (
  LEFT,
  LOST,
  MARK,
  OUT,
  QUARTER,
  RADIUS,
  RIGHT,
  WIDE,
  Stitching,
  approach,
  arc,
  arrive,
  carry,
  grasped,
  half_angle,
  jaws,
  left_grasp,
  let_go,
  one,
  open_holes,
  park,
  piercing,
  right_grasp,
  take,
  tip_angle,
  turn_on,
)

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
# A needle that is off and let go of for so long [s] is taken away: to there [m].
_TAKEN, _AWAY = 0.1, np.array([0.1, 0.0, -0.05])
# How the needle begins: its tip before the first mark [rad], off its circle through it, and how far
# that is drawn [m]; how the thread does, away from both hands.
_BEFORE, _OVER, _DRAWN = math.radians(10.0), np.array([0.003, 0.0, 0.008]), 0.003
_TAIL = np.array([-0.4, 0.3, 0.85])
# Of the expert: the tip before the first mark, how far it turns at once, and out of the tube [rad];
# how fast a hand tugs at the needle [m/s], and how far it goes aside then [m].
_NEAR, _LOOK, _THROUGH = math.radians(25.0), 0.3, math.radians(185.0)
_TUG, _ASIDE = 0.02, 0.03


@exercise("suture/stitch_easy", 60, "easy", "bimanual")
def easy(**kwargs):
  """Drive a needle through both lips of a slit within 2 mm of its marks, and tie one throw."""
  return Stitch(FIELD, **{"turns": 1, "tolerance": 0.002, **kwargs})


@exercise("suture/stitch_standard", 60, "bimanual")
def standard(**kwargs):
  """Drive it within 1 mm, as FLS asks for, and tie a double throw."""
  return Stitch(FIELD, **{"turns": 2, "tolerance": 0.001, "jitter": 0.002, **kwargs})


class Stitch(Knot, Stitching):
  """Drive a needle through a slit, draw its thread through, and tie a throw.

  Attributes:
    placed: whether the needle is through
    attached: whether it is on its thread
  """

  rules = None
  targets = 2

  def __init__(self, scene: Scene, random=None, *, turns: int, tolerance: float, **kwargs):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      turns: see `Knot`
      tolerance: how far holes may be from their marks [m]
      **kwargs: see Task
    """
    self.tolerance = tolerance
    self.marks = drain.MIDDLE + np.outer([0.5, -0.5], [drain.BITE, 0.0, 0.0])
    super().__init__(scene, random, turns=turns, **kwargs)

  def build(self, variant: int | None, nodes: np.ndarray) -> mujoco.MjSpec:
    """Returns the tube, and the thread with its needle, away from it until an episode begins."""
    line = _AWAY - np.arange(len(nodes))[:, None] * np.array([0.0, 0.0, drain.EDGE])
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
    pos, mat = piercing(self.marks, -half_angle(self.marks) - _BEFORE)
    pos = pos + _OVER + self.random.uniform(-_DRAWN, _DRAWN, 3)
    angle, tilt = RIGHT
    tip = self.take_up(physics, (pos, mat), angle, lean=0.1, along=0.08, side=-1.0, tilt=tilt)
    self.start0 = float(np.linalg.norm(tip - self.marks[0]))
    tail = _TAIL + self.random.uniform(-0.15, 0.15, 3)
    swage = 2.0 * pos - tip
    thread = palpate.Thread(physics.model.ptr, physics.data.ptr, drain.THREAD)
    thread.lay(np.array([swage, swage + tail]))
    left = physics.hands[1]
    place, turn = park(left.trocar())
    place = place + self.random.uniform(-0.005, 0.005, 3)
    left.set_joints(wrist.inverse(left.trocar(), place, turn))
    self.placed, self.attached = False, True
    self.holes, self.misses, self.worst, self.torn = 0, np.zeros(2), 0.0, 0.0

  def still(self, hand: int) -> np.ndarray:
    """Returns what keeps the jaws closed on the needle, or open."""
    return Stitching.still(self, hand)

  def look(self, physics: Physics) -> None:
    """Follows needle and thread through the tube, and who holds what."""
    knot.follow(physics, self)
    count, _ = pierced(physics)
    self.torn = max([self.torn, *(torn_at(physics, k) for k in range(count))])
    _, self.worst = open_holes(physics, self, min(count, 2))
    self.placed = self.placed or (self.whole and pinhole(physics, 1)[1] < 0.0)
    self.whole = self.whole or not self.placed
    self.tied = self.tied and self.placed
    right, left = right_grasp(physics), left_grasp(physics)
    if not self.attached:
      self.loose = 0.0 if right + left else self.loose + self.control_timestep
      if self.loose > _TAKEN:
        joint = physics.data.ptr.joint("needle")
        joint.qpos[:3], joint.qvel[:] = _AWAY, 0.0
      return
    grasped(physics, self, right, left)
    assert physics.thread
    if physics.thread.tension[:_BESIDE].min() > _OFF:
      which = physics.model.ptr.equality(f"needle_{drain.THREAD}").id
      physics.data.ptr.eq_active[which] = 0
      self.attached = False
      self.event(physics, "note", label="needle off its thread")

  def advance(self, physics: Physics) -> float:
    """Follows the stitch; see the module's head."""
    self.look(physics)
    _, progress, outcome = knot.judge(physics, self)
    self.outcome = OUTCOMES[outcome]
    if outcome == DAMAGED:
      self.event(physics, "note", label=self.label("damage"))
    progress = 1.0 if outcome == SUCCESS else progress
    dropped = self.attached and self.loose > LOST
    if self.outcome is None and (dropped or self.worst > self.tolerance):
      self.outcome = "missed"
      self.event(physics, "note", label=self.label("missed"))
    self.show(physics)
    if self.outcome is not None or self.tied:
      return progress
    if self.placed:
      return 0.3 if self.attached else 0.4
    if self.holes == 2:
      along = pinhole(physics, 1)[1]
      return 0.2 + 0.1 * clamp(1.0 - along / (2.0 * QUARTER * RADIUS), 0.0, 1.0)
    far = float(np.linalg.norm(arc(physics, 1.0) - self.marks[self.holes]))
    return 0.1 * (self.holes + closeness(far, drain.BITE if self.holes else self.start0))

  def observe(self, physics: Physics) -> Mapping[str, np.ndarray]:
    """Returns where needle and tails are."""
    middle, end = (needle_place(physics, at) for at in (np.zeros(3), np.array([0.0, 0.0, 1.0])))
    seen: Any = knot.see_tails(physics, self)
    holds = {"right_holds": self.right_holds, "left_holds": self.left_holds}
    return {
      **{name: np.array(getattr(seen, name), float, ndmin=1) for name in Knot.rules.observed},
      **{
        name: np.maximum(float(firm), self.attached * np.array([needle]))
        for (name, needle), firm in zip(holds.items(), self.firm, strict=True)
      },
      "target": self.marks[min(self.holes, 1)] - arc(physics, 1.0),
      "circle": end - middle,
      "needle": middle - physics.tip_pos(),
      "pierced": np.array([float(self.holes)]),
      "attached": np.array([float(self.attached)]),
    }

  def show(self, physics: Physics) -> None:
    """Marks the holes that are left, the next one in yellow."""
    for k, place in enumerate(self.marks):
      place = place + np.array([0.0, 0.0, MARK])
      physics.mark(k, place, k >= self.holes, k == self.holes, self.mark_size(k))

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
    yield from one(p, p, self._drive(p))
    yield from one(p, left, take(left, *LEFT))
    yield from one(p, p, let_go(p))
    yield from one(p, left, self._draw(left))
    yield from tie.catch(1, round(BEYOND / drain.EDGE))
    yield from one(p, left, self._pull_off(left))
    yield from tie.wind(1, self.turns)
    yield from tie.draw(1)
    yield from tie.tighten(1)

  def _drive(self, p: Performer) -> Script:
    """Puts the needle over the first mark, and turns it about its circle through both."""
    yield from approach(p, self.marks, _NEAR)
    while self.holes < 2 or tip_angle(p.physics, self.marks) < OUT - 0.02:
      end = max(OUT, tip_angle(p.physics, self.marks) + 0.2)
      yield from turn_on(p, self.marks, end, _LOOK)

  def _draw(self, p: Performer) -> Script:
    """Turns the needle out of the tube, and draws it up to where its thread is to end."""
    end = half_angle(self.marks) + _THROUGH
    while tip_angle(p.physics, self.marks) < end - 0.05:
      yield from turn_on(p, self.marks, end)
    mat = piercing(self.marks, end)[1]
    pose = self.line()[0] + RADIUS * mat[:, 1], mat
    yield from carry(p, lambda t: pose)
    yield from arrive(p)

  def _pull_off(self, p: Performer) -> Script:
    """Pulls the needle off the thread that the other hand holds, and lets go of it aside."""
    places = self.line()
    up = (places[0] - places[1]) / np.linalg.norm(places[0] - places[1])
    while self.attached:
      p.tip = p.tip + _TUG * p.dt * up
      yield p.step()
    yield from p.line(p.tip - np.array([_ASIDE, 0.0, 0.0]), _ASIDE)
    yield from jaws(p, WIDE)
    yield from jaws(p, HOLD)
