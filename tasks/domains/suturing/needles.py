"""Shared by exercises with a curved needle: which hand holds it, and an expert's motions.

The needle is the one that `palpate.add_needle` makes by default, half a circle of 26 mm. Shares of
it count from the swage, angles along its arc from the middle. It begins in the right hand's jaws.
"""

import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import mujoco
import numpy as np
import warp as wp
from palpate.engine.model.flexes import matrix
from palpate.models import trocar, wrist
from palpate.tissue.types import Array, floats

from ...core import rules as r
from ...core.base import Physics, Task
from ...core.performer import Performer, Script

RADIUS = 0.026 / math.pi  # of the needle's circle [m]
QUARTER = 0.5 * math.pi
PIECES = 16  # that the needle is looked at in
HELD, NEAR = 1.0, 0.008  # of jaws that hold the needle: least force [N], farthest from it [m]
LOST = 0.5  # how long nobody may hold it [s]
MEETS = 8  # bit of what meets the needle, besides bit 1 of what meets the organ
WIDE = 0.15  # action of the jaws: open
# Where along the needle's arc, from its middle, two hands hold it, short of its taper, and how
# their jaws are tilted, off the wall [rad].
RIGHT, LEFT = (math.radians(-72.0), math.radians(-30.0)), (math.radians(58.0), math.radians(30.0))
# Angle of the tip that comes out at which the left one takes it, as high as the right one then is
# [rad], and most that an expert turns the needle before it looks at it again [rad].
OUT, LOOK = math.radians(92.5), 0.6
MARK = 0.0008  # radius of a mark, and how far above the wall it is [m]
# Energy that it takes to open an area of the wall [J/m^2], and friction in it [N/m]; skin takes
# 2500, liver 75 to 185 (10.1007/978-3-540-70521-5_18).
TOUGH, FRICTION = 800.0, 15.0
WALL = {"young": 4e5, "thickness": 0.0015, "tension": 20.0, "damping": 0.005, "foundation": 5e4}
# MuJoCo's solver stops where a step gains less than this share of the mean inertia. Its usual 1e-8
# leaves a needle of 0.08 g between jaws unsolved: it creeps, and rounding grows fortyfold in 20 ms.
_SOLVED = 1e-12
_OPENING = 0.056  # of each jaw, just off the wire [rad]
_BITE = 0.0036  # from the tip of the jaws to the wire between them [m]
_SPEED, _TURN, _CLOSE = 0.03, 1.2, 3.0  # of an expert's hand [m/s, rad/s] and jaws [1/s]
_BACK, _UP, _HIGH = 0.01, 0.008, 0.006  # of hands off a needle, and of one over its mark [m]
# Of a teacher: width of the cone over a goal, at its tip [m] and by height [-], how far a frame may
# be turned there [rad], height of the cone and that jaws close from, how far off a hand has let go,
# off a needle that is still turned on, and how far back one is put right before it goes in [m].
NARROW, TURNED = 0.0015, 0.2
_CONE, _TALL, _CLOSES, _CLEAR, _FAR_OFF, _FREE = 0.2, 0.032, 0.002, 0.02, 0.026, 0.002

Pose = tuple[np.ndarray, np.ndarray]  # place [m] (3,), and frame in columns (3, 3)


class Hands:
  """State of the hands that hold a needle."""

  control_timestep: float  # [s]
  right_holds: float
  left_holds: float
  loose: float  # how long nobody has held it [s]
  regrasps: float


class Driving(Hands):
  """State of who drives it through marks of a wall, see `Stitching`."""

  tolerance: float  # how far holes may be from their marks [m]
  marks: Annotated[Any, Array(wp.vec3, ("targets",))]  # where they are at rest [m]
  misses: Annotated[Any, floats("targets")]  # how far the holes are from them [m]
  start0: float  # how far the tip was from the first one at the start [m]
  holes: int
  target: r.Vector
  circle: r.Vector
  pierced: float


class Taking(Hands):
  """State of hands that take it from each other."""

  circle: r.Vector  # axis of the needle's circle
  hand_target: r.Vector  # in the frame of the hand that is to take it: where it may be taken [m]
  hand_circle: r.Vector  # axis of its circle
  hand_along: r.Vector  # way along it


# The rules.


def arc(s, share):
  """Returns where a share of the needle from the swage on ends [m]."""
  angle = 2.0 * QUARTER * (share - 0.5)
  return r.needle_place(s, r.vector(RADIUS * r.sine(angle + QUARTER), RADIUS * r.sine(angle), 0.0))


def away(s, place):
  """Returns how far a place is from the needle's nearest piece [m]."""
  least = float(1.0)
  for k in range(PIECES + 1):
    least = min(least, r.length(arc(s, float(k) / float(PIECES)) - place))
  return least


def in_jaws(s, o, hand, share, step):
  """Finds the needle in the frame of a hand that is to take it; returns o.

  Args:
    s: the world
    o: see `Taking`; its circle is known
    hand: 0 for the right one, 1 for the left one
    share: where it may be taken
    step: a small share, by its sign the way along the needle
  """
  place = arc(s, share)
  o.hand_target = r.in_hand(s, hand, place)
  o.hand_circle = r.in_hand(s, hand, place + o.circle) - o.hand_target
  along = r.in_hand(s, hand, arc(s, share + step)) - o.hand_target
  o.hand_along = along / r.length(along)
  return o


def right_grasp(s):
  """Returns 1 where the first hand, the right one, holds the needle, otherwise 0."""
  return 1.0 if r.pinch(s) > HELD and away(s, r.tip(s)) < NEAR else 0.0


def left_grasp(s):
  """Returns the same of the other hand."""
  return 1.0 if r.other_pinch(s) > HELD and away(s, r.other_tip(s)) < NEAR else 0.0


def grasped(s, o, right, left):
  """Follows which hands hold the needle, and how long none does."""
  o.regrasps = o.regrasps + max(right - o.right_holds, 0.0) + max(left - o.left_holds, 0.0)
  if right + left == 0.0 and o.right_holds + o.left_holds > 0.0:
    r.drop(s, o)
  o.right_holds = right
  o.left_holds = left
  o.loose = o.loose + o.control_timestep if right + left == 0.0 else 0.0
  return o


def open_holes(s, o, count):
  """Compares holes that are new with their marks; returns how far one is off at most [m]."""
  for k in range(o.holes, count):
    place, _ = r.pinhole(s, k)
    off = place - o.marks[k]
    o.misses[k] = r.root(off[0] * off[0] + off[1] * off[1])
    r.reach(s, o, o.misses[k])
  o.holes = count
  worst = float(0.0)
  for k in range(count):
    worst = max(worst, o.misses[k])
  return o, worst


def mark_hole(s, o, k):
  """Marks the holes that are left to make, the next one in yellow."""
  return o.marks[k] + r.vector(0.0, 0.0, MARK), r.shown(k, o.holes)


def lowest(s):
  """Returns the height of the needle's lowest piece over the wall [m]."""
  least = float(r.FAR)
  for k in range(PIECES + 1):
    least = min(least, float(arc(s, float(k) / float(PIECES))[2]))
  return least


class Needlework(Task):
  """An exercise with a needle; a domain that derives from it has the state `Hands`."""

  watch = ("drop", "unintended_contact")
  right_holds, left_holds = 1.0, 0.0  # as an episode begins

  def meet(self, spec: mujoco.MjSpec, bit: int = MEETS) -> None:
    """Lets geoms with a contact bit touch instruments, and solves contacts of a light needle."""
    spec.option.tolerance = _SOLVED
    # By islands the Newton method of MuJoCo 4.0 leaves single steps unsolved, by up to 16 N.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    hands = tuple(prefix for prefix in (self.prefix, self.second) if prefix)
    for geom in spec.geoms:
      if geom.parent.name.startswith(hands) and geom.contype & 1:
        geom.contype, geom.conaffinity = geom.contype | bit, geom.conaffinity | bit

  def take_up(
    self,
    physics: Any,
    pose: Pose,
    angle: float,
    lean: float,
    along: float,
    side: float = 1.0,
    tilt: float = 0.0,
  ) -> np.ndarray:
    """Puts the needle into the right hand's jaws, as an episode begins.

    Args:
      physics: see `Physics`
      pose: of the needle
      angle: where the jaws hold it, along its arc [rad]
      lean: most that it is turned about each axis of the world, drawn [rad]
      along: most that the jaws are off the angle, drawn [rad]
      side: 1 where the jaws point against the circle's axis, -1 along it
      tilt: see `grasp`

    Returns:
      Where its tip is [m]  (3,).
    """
    place, mat = pose
    turned = self.random.uniform(-lean, lean, 3)
    for axis in (2, 1, 0):
      mat = trocar.about(axis, turned[axis]) @ mat
    angle = angle + self.random.uniform(-along, along)
    port = physics.trocar()
    held = grasp(port, place, mat * (1, 1, side), angle, tilt=tilt)
    physics.set_joints(wrist.inverse(port, *held))
    self.joints = {"needle": np.concatenate([place, trocar.orientation(mat)])}
    self.joints |= {f"{self.prefix}jaw_{side}": np.array([_OPENING]) for side in ("left", "right")}
    self.right_holds, self.left_holds, self.loose, self.regrasps = 1.0, 0.0, 0.0, 0.0
    return place + RADIUS * mat[:, 1]

  def still(self, hand: int) -> np.ndarray:
    """Returns what keeps the jaws closed on the needle, or open."""
    return np.array([-1.0 if (self.left_holds if hand else self.right_holds) else WIDE])

  def label(self, kind: str) -> str:
    """Returns what a drop is, or why an exercise failed."""
    if kind == "missed":
      return "the needle was dropped"
    return "needle" if kind == "drop" else super().label(kind)


class Stitching(Needlework):
  """An exercise that drives a needle through marks of a wall.

  Attributes:
    pull: on the wall [N]
    tolerance: how far holes may be from their marks [m]
    misses: how far they are [m]
  """

  pull: float
  tolerance: float
  misses: np.ndarray
  mark_radius = MARK

  def place_of_work(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns all of the wall, and its middle."""
    return np.arange(len(physics.organ.elem)), np.zeros(3)

  def label(self, kind: str) -> str:
    """Returns what an event of the rules is called."""
    if kind == "damage":
      return f"torn by a pull of {self.pull:.2f} N"
    if kind == "missed" and self.misses.max() > self.tolerance:
      return "a hole is too far from its mark"
    return "hole" if kind == "target" else super().label(kind)


# Where the needle is, and how it is held.


def needle(physics: Any) -> Pose:
  """Returns the needle's pose: the middle of its circle, z along the circle's axis."""
  places = [r.needle_place(physics, place) for place in (np.zeros(3), *np.eye(3))]
  return places[0], np.column_stack([place - places[0] for place in places[1:]])


def grasp(
  port: Any,
  pos: np.ndarray,
  mat: np.ndarray,
  angle: float,
  like: np.ndarray | None = None,
  tilt: float = 0.0,
) -> Pose:
  """Returns the tip's pose that has the needle across the jaws at an angle along its arc [rad].

  Of the two ways round it is the one that turns the shaft less, from a pose or from zero. Jaws may
  be tilted by an angle in their plane, their back towards the needle's tip [rad].
  """
  radial = math.cos(angle) * mat[:, 0] + math.sin(angle) * mat[:, 1]
  along = math.cos(angle) * mat[:, 1] - math.sin(angle) * mat[:, 0]
  back = math.cos(tilt) * mat[:, 2] + math.sin(tilt) * along
  place = pos + RADIUS * radial - _BITE * back
  across = np.cross(back, radial)
  ways = [np.column_stack([s * radial, s * across, back]) for s in (1, -1)]
  roll = 0.0 if like is None else float(wrist.inverse(port, place, like)[2])
  turned = [abs(float(wrist.inverse(port, place, turn)[2]) - roll) for turn in ways]
  return place, ways[int(np.argmin(turned))]


def between(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
  """Returns a frame a share of the way from one to another."""
  quat, spin = trocar.orientation(a.T @ b), np.zeros(3)
  mujoco.mju_quat2Vel(spin, quat, 1.0)
  angle = float(np.linalg.norm(spin))
  if angle < 1e-9:
    return b
  mujoco.mju_axisAngle2Quat(quat, spin / angle, t * angle)
  return a @ matrix(quat)


def apart(a: np.ndarray, b: np.ndarray) -> float:
  """Returns the angle between two frames [rad]."""
  return math.acos(float(np.clip((np.trace(a.T @ b) - 1) / 2, -1.0, 1.0)))


# An expert's motions.


def one(p: Performer, hand: Performer, script: Script) -> Script:
  """Runs the script of one of two hands while the other stays."""
  still: Iterator[np.ndarray] = iter(())
  yield from p.both(*((script, still) if hand is p else (still, script)))


def jaws(p: Performer, goal: float) -> Script:
  """Opens or closes the jaws to an action: `WIDE`, or -1 on the needle."""
  while p.extra[0] != goal:
    p.extra[0] = np.clip(goal, p.extra[0] - _CLOSE * p.dt, p.extra[0] + _CLOSE * p.dt)
    yield p.step()


def arrive(p: Performer) -> Script:
  """Waits for a hand that is late."""
  if p.style.reaction:
    yield from p.wait(p.style.reaction + 0.1)


def move_tip(p: Performer, goal: np.ndarray, turn: np.ndarray) -> Script:
  """Moves the tip of a hand to a pose."""
  start, before = p.tip.copy(), p.turn.copy()
  for t in p.shares(_steps(p, goal - start, apart(before, turn))):
    p.tip, p.turn = start + t * (goal - start), between(before, turn, t)
    yield p.step()


def carry(
  p: Performer, path: Callable[[float], Pose], angle: float | None = None, pushes: bool = False
) -> Script:
  """Moves the needle with the hand that holds it.

  Args:
    p: of the hand
    path: returns the needle's pose at a share of the way, or at its end alone
    angle: by which it turns on the way [rad]; None for a straight line to the end
    pushes: whether a teacher keeps the push of the policy that had the hand before
  """
  (pos, mat), tip, turned = needle(p.physics), p.hand.tip_pos(), matrix(p.hand.tip_quat())
  if pushes and p.hasty:
    tip, turned = p.tip, p.turn
  held, frame = mat.T @ (tip - pos), mat.T @ turned
  end, turn = path(1.0)
  for t in p.shares(_steps(p, end - pos, apart(mat, turn) if angle is None else abs(angle))):
    if angle is None:
      place, now_turned = pos + t * (end - pos), between(mat, turn, t)
    else:  # what it is off the path at the start is made up on the way
      goal, aim = path(t)
      start, first = path(0.0)
      place = goal + (1 - t) * (pos - start)
      now_turned = aim @ between(first.T @ mat, np.eye(3), t)
    p.tip, p.turn = place + now_turned @ held, now_turned @ frame
    yield p.step()


def approach(p: Performer, ends: np.ndarray, before: float) -> Script:
  """Puts the needle over the first of two marks (2, 3), its tip by an angle before it [rad]."""
  up, goal = np.array([0.0, 0.0, 1.0]), piercing(ends, -half_angle(ends) - before)

  def begun() -> bool:
    return p.hasty and _turns_in(p, ends, before)

  if begun():
    return
  high = goal[0] + min(height(p, needle(p.physics), goal, up), _HIGH) * up
  yield from come(
    carry(p, lambda t: (high, goal[1])), lambda: over(p, needle(p.physics), goal, up)
  )
  yield from arrive(p)
  yield from come(carry(p, lambda t: goal), begun)
  yield from arrive(p)


def turn_on(p: Performer, ends: np.ndarray, end: float, most: float = LOOK) -> Script:
  """Turns the needle about its circle through two marks (2, 3), towards an angle of its tip [rad].

  It goes no further than an angle, since the needle's place in the jaws is looked at as it begins.
  """
  start = tip_angle(p.physics, ends)
  stop = min(start + most, end)

  def way(t: float) -> Pose:
    return piercing(ends, start + t * (stop - start))

  yield from carry(p, way, stop - start, pushes=True)
  yield from arrive(p)


def take(p: Performer, angle: float, tilt: float) -> Script:
  """Takes the needle from behind, at an angle along its arc, with tilted jaws."""
  pos, mat = needle(p.physics)
  goal = grasp(p.trocar, pos, mat * (1, 1, -1), angle, p.turn, tilt)
  yield from close_on(p, goal, _away(goal[1]))


def close_on(p: Performer, goal: Pose, off: np.ndarray) -> Script:
  """Brings open jaws to a pose from where they are off it by a way [m]  (3,), and closes them."""
  place, turn = goal
  up = off / np.linalg.norm(off)

  def there() -> bool:
    return over(p, (p.tip, p.turn), goal, up)

  p.extra[:] = p.share() if there() and (p.tip - place) @ up < _CLOSES else WIDE
  yield from come(move_tip(p, place + off, turn), there)
  yield from arrive(p)
  yield from move_tip(p, place, turn)
  yield from arrive(p)
  yield from jaws(p, -1.0)
  yield from p.wait(0.2)


def let_go(p: Performer) -> Script:
  """Opens the jaws and takes the hand back and aside."""
  yield from leave(p, _away(p.turn), (park(p.trocar)[0], p.turn), _FAR_OFF)


def leave(p: Performer, off: np.ndarray, end: Pose, clear: float = _CLEAR) -> Script:
  """Opens the jaws, takes the hand off by a way [m]  (3,), and brings it to a pose.

  A teacher's hand that is clear of the needle [m] has gone far enough.
  """
  if p.hasty:  # from where another has come to
    p.extra[:] = p.share()
  yield from jaws(p, WIDE)

  def gone() -> bool:
    return p.hasty and not lingers(p, clear)

  yield from come(move_tip(p, p.tip + off, p.turn), gone)
  yield from come(move_tip(p, *end), gone)


def park(port: Any) -> Pose:
  """Returns a pose of a tip beside the wall, on the side of its port, jaws away from that."""
  side, front = (math.copysign(1.0, x) for x in port.pos[:2])
  back, across = np.array([0.0, front, 0.0]), np.array([0.0, 0.0, -1.0])
  frame = np.column_stack([across, np.cross(back, across), back])
  return np.array([side * 0.03, front * 0.03, 0.02]), frame


def _away(turn: np.ndarray) -> np.ndarray:
  """Returns the way of open jaws off the needle: back, and up from the wall [m]."""
  return _BACK * turn[:, 2] + np.array([0.0, 0.0, _UP])


def _steps(p: Performer, way: np.ndarray, angle: float) -> int:
  """Returns how many control steps a hand takes for a way [m] and a turn [rad]."""
  duration = max(float(np.linalg.norm(way)) / _SPEED, angle / _TURN) / p.style.speed
  return max(2, round(duration / p.dt))


def half_angle(ends: np.ndarray) -> float:
  """Returns half of the angle between two marks (2, 3) on the needle's circle [rad]."""
  return math.asin(min(0.5 * float(np.linalg.norm(ends[1] - ends[0])) / RADIUS, 0.9))


def facing(ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the way from one of two marks (2, 3) to the other, and what is up across it  (3,)."""
  way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
  up = np.array([0.0, 0.0, 1.0]) - way[2] * way
  return way, up / np.linalg.norm(up)


def piercing(ends: np.ndarray, tip: float) -> Pose:
  """Returns the needle's pose with its circle through two marks (2, 3), by the angle of its tip.

  The angle is that at the middle of the circle, from straight down towards the second mark [rad].
  """
  way, up = facing(ends)
  axis = np.cross(way, up)  # about which it turns: down goes to `way`
  middle = 0.5 * (ends[0] + ends[1]) + RADIUS * math.cos(half_angle(ends)) * up
  angle = tip - QUARTER  # the tip is a quarter turn ahead of the middle of the arc
  x = -math.cos(angle) * up + math.sin(angle) * way
  return middle, np.column_stack([x, np.cross(axis, x), axis])


def tip_angle(physics: Any, ends: np.ndarray) -> float:
  """Returns the angle of the needle's tip, see `piercing`, from -90 to 270 degrees [rad]."""
  (way, up), tip = facing(ends), arc(physics, 1.0) - needle(physics)[0]
  angle = math.atan2(float(tip @ way), -float(tip @ up))
  return angle if angle > -QUARTER else angle + 4.0 * QUARTER


# What a teacher leaves out: two who come to one place by different ways go on alike from there.


def come(script: Script, there: Callable[[], bool]) -> Script:
  """Does a script until something is so."""
  while not there() and (action := next(script, None)) is not None:
    yield action


def over(p: Performer, pose: Pose, goal: Pose, up: np.ndarray) -> bool:
  """Returns whether a teacher's pose is in the cone over a goal, in which it may descend."""
  off = pose[0] - goal[0]
  high = float(off @ up)
  aside = float(np.linalg.norm(off - high * up))
  far = aside > NARROW + _CONE * max(high, 0.0) or apart(pose[1], goal[1]) > TURNED
  return p.hasty and -2 * NARROW < high < _TALL and not far


def height(p: Performer, pose: Pose, goal: Pose, up: np.ndarray) -> float:
  """Returns the height over a goal at which a pose is corrected [m].

  A teacher goes back no further than it must. A policy taught by one that always goes all of the
  way back, or never, moves to and fro before the goal.
  """
  off = pose[0] - goal[0]
  aside = float(np.linalg.norm(off - (off @ up) * up))
  turned = apart(pose[1], goal[1]) / TURNED
  return max(aside - NARROW, 0.0) + _FREE * max(turned, 1.0) if p.hasty else math.inf


def lingers(p: Performer, clear: float = _CLEAR) -> bool:
  """Returns whether a teacher's hand that let go is still at the needle, nearer than so [m]."""
  return p.hasty and away(p.physics, p.hand.tip_pos()) < clear


def _turns_in(p: Performer, ends: np.ndarray, before: float) -> bool:
  """Returns whether a needle may turn through two marks (2, 3) from where it is."""
  (pos, mat), angle = needle(p.physics), tip_angle(p.physics, ends)
  place, turned = piercing(ends, angle)
  there = float(np.linalg.norm(pos - place)) < NARROW and apart(mat, turned) < TURNED
  return there and -before - TURNED < angle + half_angle(ends) < 2 * half_angle(ends)
