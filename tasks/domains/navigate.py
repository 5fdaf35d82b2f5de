"""Navigate: hold the laparoscope; find marks in order, and show each centred, level and near.

The optics look along the shaft at easy, and 30 degrees past it at standard and hard, where a pin
stands on each mark: it is to be looked along, for which the scope has to be rolled, and the camera
turned back against it. At hard an instrument moves about, and is kept in the picture's middle in
the end.

Own observations, in the axes of the picture (right, up, back): `target` (3,), from the lens to what
is to be shown [m]; `side` (3,), the direction that it is to be seen from, or zero [-]; `horizon`
(1,), angle of the picture against the horizon [rad]; `held` (1,), share of the time done [-].

Progress: (done + 0.5 * closeness + 0.4 * held) / number, closeness being of the sum of the angle
from the middle [rad], a fifth of the angle against the horizon, 10 / m by what it is too near or
too far, and what the cosine to the pin is short of its limit. A mark is shown while all four are
within their limits, and done after the holding time; what is lost begins anew, but for the
instrument at the end, whose time adds up. Success: all of them. Failure: a force above the damage
limit, or the time limit.
"""

import dataclasses
import math
from typing import Annotated, Any

import numpy as np
import warp as wp
from palpate.models import laparoscope, trocar
from palpate.tissue.types import Array, ints

from ..core import rules as r
from ..core.base import Physics, Task
from ..core.performer import Performer, Script
from ..core.scenes import Scene
from ..registry import exercise
from .touch import SLACK, draw_apart

FOVY = math.radians(50.0)  # of the laparoscope
ABOVE, PIN = 0.004, 0.014  # of a mark over the surface, and of the end of its pin over the mark [m]
FIELD = Scene(instrument="laparoscope", port=(-0.02, 0.15, 0.12))
_ROLLS = 2.4  # of the scope to look along a pin, at most about [rad]
_TURN = 1.5  # of scope and camera by the expert [rad/s]
_SWING, _RATE = (0.14, 0.14, 0.006), (0.5, 0.9)  # of the instrument [rad, m], [rad/s]
_HOVER = 0.03  # of its tip over the place of work [m]


class State:
  """State of a world."""

  centre: float  # how far from the picture's middle, as a share of half its height
  tilt: float  # largest angle against the horizon [rad]
  low: float  # of the distance from the lens [m]
  high: float
  facing: float  # least cosine between the way back to the lens and the pin, -1 for none
  hold: float  # [s]
  follow: float  # how long the instrument is to be shown, 0 for not at all [s]
  half: float  # of the picture's height at a distance of 1
  per: int  # pictures' marks of a mark: 2 with a pin
  control_timestep: float  # [s]
  goals: Annotated[Any, ints("marks")]  # triangles under the marks
  sides: Annotated[Any, Array(wp.vec3, ("marks",))]  # that they are to be seen from
  middle: r.Vector  # of the instrument's joints pitch, yaw, insertion
  swing: r.Vector
  rate: r.Vector  # [rad/s]
  phase: r.Vector  # [rad]
  clock: float  # [s]
  done: int
  time: float  # shown [s]
  error0: float  # at the start
  seen: bool  # whether the picture has it
  centred: bool
  horizon: float  # [rad]
  total: float  # time that is measured so far [s]
  tilted: float  # and its sums
  beside: float
  outside: float
  target: r.Vector
  side: r.Vector
  held: float
  horizon_angle: float  # metrics so far
  off_centre: float
  out_of_view: float


# The rules.


def count(o):
  """Returns how much there is to show."""
  return o.goals.shape[0] + (1 if o.follow > 0.0 else 0)


def follows(o):
  """Returns whether it is the instrument's turn."""
  return o.done >= o.goals.shape[0] and o.follow > 0.0


def mark_place(s, o, k):
  """Returns where a mark is [m]."""
  return r.point(s, o.goals[k]) + ABOVE * r.normal(s, o.goals[k])


def now(o):
  """Returns the number of the mark to show, the last one when all are done."""
  return min(o.done, o.goals.shape[0] - 1)


def place(s, o):
  """Returns where that is which is to be shown [m]."""
  if follows(o):
    return r.guided_tip(s)
  return mark_place(s, o, now(o))


def in_picture(s, way):
  """Returns a direction of the world in the axes of the picture."""
  axes = r.picture(s)
  return r.vector(r.dot(axes[0], way), r.dot(axes[1], way), r.dot(axes[2], way))


def aside(v):
  """Returns how far from the picture's axis a place is that `in_picture` tells [m]."""
  return r.root(v[0] * v[0] + v[1] * v[1])


def short(o, v, side):
  """Returns what the cosine to the pin is short of its limit; nothing for the instrument."""
  if follows(o):
    return 0.0
  return max(o.facing + r.dot(v, side) / max(r.length(v), 1e-6), 0.0)


def error(o, v, side):
  """Returns how far what is shown is from how it is to be shown, see the head."""
  far = r.length(v)
  off = r.angle(aside(v), -v[2])
  beyond = max(max(o.low - far, far - o.high), 0.0)
  return off + 0.2 * abs(o.horizon) + 10.0 * beyond + short(o, v, side)


def look(s, o):
  """Sees whether what is to be shown is in the picture, in its middle, and level."""
  axes = r.picture(s)
  v = in_picture(s, place(s, o) - r.lens(s))
  depth = -v[2]
  size = o.half * max(depth, 1e-6)
  o.seen = depth > 0.0 and abs(v[1]) <= size and abs(v[0]) <= 4.0 / 3.0 * size
  o.centred = depth > 0.0 and aside(v) <= o.centre * size
  o.horizon = r.angle(axes[0][2], axes[1][2])
  return o, v


def measure(o, span):
  """Adds to the sums of the metrics, by the trapezoidal rule: half of a control step each time."""
  o.tilted = o.tilted + span * abs(o.horizon)
  if not o.centred:
    o.beside = o.beside + span
  if not o.seen:
    o.outside = o.outside + span
  o.total = o.total + span
  return o


def advance(s, o):
  """Looks what is shown, and how."""
  half = 0.5 * o.control_timestep
  had = o.seen
  o = measure(o, half)
  o, v = look(s, o)
  if follows(o) and had and not o.seen:
    r.drop(s, o)
  side = in_picture(s, o.sides[now(o)])
  far = r.length(v)
  near = o.low <= far and far <= o.high and short(o, v, side) == 0.0
  if o.centred and near and abs(o.horizon) <= o.tilt:
    o.time = o.time + o.control_timestep
  elif not follows(o):
    o.time = 0.0
  wanted = o.follow if follows(o) else o.hold
  if o.time >= wanted - SLACK:
    o.done = o.done + 1
    o.time = 0.0
    if o.done < count(o):
      o, v = look(s, o)
      side = in_picture(s, o.sides[now(o)])
      o.error0 = error(o, v, side)
      wanted = o.follow if follows(o) else o.hold
  o = measure(o, half)
  o.horizon_angle = o.tilted / o.total
  o.off_centre = 100.0 * o.beside / o.total
  o.out_of_view = 100.0 * o.outside / o.total
  held = 0.4 * o.time / wanted
  close = 0.5 * r.closeness(error(o, v, side), o.error0)
  progress = (float(o.done) + close + held) / float(count(o))
  return o, progress, r.SUCCESS if o.done == count(o) else r.RUNNING


def act(s, o):
  """Moves the instrument on."""
  if o.follow > 0.0:
    o.clock = o.clock + o.control_timestep
    r.guide(s, joints(o))
  return o


def joints(o):
  """Returns where the instrument's pitch, yaw and insertion are to be."""
  turn = o.clock * o.rate + o.phase
  return o.middle + r.vector(
    o.swing[0] * r.sine(turn[0]), o.swing[1] * r.sine(turn[1]), o.swing[2] * r.sine(turn[2])
  )


def observe(s, o):
  """Finds target, side and held; horizon is up to date."""
  o.target = in_picture(s, place(s, o) - r.lens(s))
  o.side = r.vector(0.0, 0.0, 0.0)
  if o.facing > -1.0 and not follows(o):
    o.side = in_picture(s, o.sides[now(o)])
  o.held = o.time / (o.follow if follows(o) else o.hold)
  return o


def mark(s, o, k):
  """Marks what is left, and the ends of the pins."""
  of = k // o.per
  at = mark_place(s, o, of)
  if k % o.per == 1:
    at = at + PIN * o.sides[of]
  return at, r.shown(of, o.done)


@exercise("navigate/easy", 40, "easy",
          asks="Show two marks with optics of 0 degrees, centred and level",
          scene=dataclasses.replace(FIELD, nodes=250, optics=0.0), marks=2, centre=0.3, tilt=15.0,
          band=(0.05, 0.1))  # fmt: skip
@exercise("navigate/standard", 80,
          asks="Show three marks along their pins with optics of 30 degrees, centred and level",
          scene=dataclasses.replace(FIELD, nodes=250), marks=3, centre=0.25, tilt=10.0,
          band=(0.05, 0.08), lean=12.0, jitter=0.005)  # fmt: skip
@exercise(
  "navigate/hard", 120, "hard",
  asks="Show three marks along their pins, then follow an instrument for 8 s, on varying livers",
  scene=dataclasses.replace(FIELD, nodes=500, guided="probe"), marks=3, centre=0.2, tilt=7.0,
  band=(0.05, 0.075), lean=10.0, follow=8.0, jitter=0.01, variants=(None, 1, 2),
)  # fmt: skip
class Navigate(Task):
  """Show marks with a laparoscope."""

  rules = r.Rules(
    State,
    advance,
    observe,
    ("target", "side", "horizon", "held"),
    metrics={name: name for name in ("horizon_angle", "off_centre", "out_of_view")},
    columns={"visible": "seen", "centred": "centred", "horizon": "horizon"},
    act=act,
    mark=mark,
  )
  watch = ("drop", "unintended_contact")
  clearance = (0.085, 0.105)

  def __init__(
    self,
    *,
    marks: int,
    centre: float,
    tilt: float,
    band: tuple[float, float],
    lean: float = 180.0,
    hold: float = 1.0,
    follow: float = 0.0,
    **kwargs,
  ):
    """Makes the task.

    Args:
      marks: how many to show
      centre: how far from the picture's middle, as a share of half its height
      tilt: largest angle against the horizon [deg]
      band: of the distance from the lens [m]
      lean: largest angle between the view and the pin [deg], 180 for no pins
      hold: how long each is to be shown [s]
      follow: how long the instrument is to be shown in the end [s]
      **kwargs: see Task
    """
    self.marks, self.centre, self.tilt = marks, centre, math.radians(tilt)
    self.low, self.high = band
    self.facing, self.per = math.cos(math.radians(lean)), 1 if lean >= 180 else 2
    self.hold, self.follow, self.half = hold, follow, math.tan(FOVY / 2)
    self.targets = marks * self.per
    super().__init__(**{"spread": 0.045, "force_limit": 0.5, **kwargs})

  def begin(self, physics: Physics) -> None:
    """Draws the marks, the sides that they are seen from, and the instrument's way."""
    place_of_work, center = self.place_of_work(physics)
    self.goals = np.array(draw_apart(self.random, physics, place_of_work, self.marks, 0.025))
    self.done, self.time, self.clock = 0, 0.0, 0.0
    port, rolls = physics.trocar(), self.random.uniform(-_ROLLS, _ROLLS, self.marks)
    sides = np.sin(rolls)[:, None] * port.mat[:, 0] + np.cos(rolls)[:, None] * port.mat[:, 1]
    poses = [self.pose(physics, k, side) for k, side in enumerate(sides)]
    views = [laparoscope.view(port, each, physics.optics) for each in poses]
    self.sides = np.array([axes[:, 2] for _, axes in views])
    stations = np.array([physics.tip_pos(), *(pos for pos, _ in views)])
    way = float(np.linalg.norm(np.diff(stations, axis=0), axis=1).sum())
    self.reference_length = None if self.follow else way
    self.middle = self.swing = self.rate = self.phase = np.zeros(3)
    if physics.guided:
      hand = physics.guided.trocar()
      away = (hand.pos - center) / np.linalg.norm(hand.pos - center)
      self.middle = trocar.inverse(hand, center + _HOVER * away)
      self.swing, self.rate = np.array(_SWING), self.random.uniform(*_RATE, 3)
      self.phase = self.random.uniform(0, 2 * math.pi, 3)
      pitch, yaw, insertion = joints(self)
      physics.guided.set_joints(np.array([pitch, yaw, 0.0, insertion]))
    _, way = look(physics, self)
    self.error0 = error(self, way, in_picture(physics, self.sides[0]))
    self.total = self.tilted = self.beside = self.outside = 0.0
    self.horizon_angle = self.off_centre = self.out_of_view = 0.0

  def pose(self, physics: Physics, k: int, side: np.ndarray) -> laparoscope.Pose:
    """Returns the joints that show a mark from a side as it is to be shown."""
    far = 0.5 * (self.low + self.high)
    return laparoscope.show(
      physics.trocar(), mark_place(physics, self, k), far, side, physics.optics
    )

  def mark_size(self, k: int) -> float:
    """Returns the radius of a mark, or of the end of its pin [m]."""
    return 0.0015 if k % self.per else 0.003

  def instruct(self, physics: Physics) -> str:
    """Says what is wrong with the picture, the worst first."""
    what = "the instrument" if follows(self) else "the yellow mark"
    way = in_picture(physics, place(physics, self) - r.lens(physics))
    far, number = r.length(way), f"{min(self.done + 1, count(self))} of {count(self)}"
    if not self.seen:
      return f"Find {what}, {number}"
    if not self.centred:
      return f"Bring {what} into the middle, {number}"
    if not self.low <= far <= self.high:
      return "Go nearer" if far > self.high else "Go back"
    if short(self, way, in_picture(physics, self.sides[now(self)])) > 0:
      return "Roll the scope until you look along the pin"
    if abs(self.horizon) > self.tilt:
      return "Turn the camera until the picture is level"
    wanted = self.follow if follows(self) else self.hold
    return f"Hold it there for {max(wanted - self.time, 0.0):.1f} s more"

  def expert(self, p: Performer) -> Script:
    """Shows the marks one by one, then the instrument."""
    physics = p.physics
    while self.done < self.marks:
      done, pose = self.done, self.pose(physics, self.done, self.sides[self.done])
      lens_to = laparoscope.view(physics.trocar(), pose, physics.optics)[0]
      for action in p.move(lens_to):
        yield action
        _turn(p, pose)
      for _ in range(round(4 / p.dt)):
        _turn(p, pose)
        yield p.step()
        if self.done > done:
          break
    far = 0.5 * (self.low + self.high)
    while self.outcome is None and self.follow:
      # From where it looks already: the scope need not be rolled.
      side, goal = r.picture(physics)[2], r.guided_tip(physics)
      pose = laparoscope.show(physics.trocar(), goal, far, side, physics.optics)
      way = laparoscope.view(physics.trocar(), pose, physics.optics)[0] - p.tip
      most = 0.05 * p.style.speed * p.dt
      p.tip = p.tip + way * min(most / max(float(np.linalg.norm(way)), 1e-9), 1.0)
      _turn(p, pose)
      yield p.step()


def _turn(p: Performer, pose: laparoscope.Pose) -> None:
  """Turns scope and camera on towards a pose."""
  most = _TURN * p.style.speed * p.dt
  p.roll += float(np.clip(pose.roll - p.roll, -most, most))
  head = math.pi * p.extra[0]
  p.extra[0] = (head + float(np.clip(pose.head - head, -most, most))) / math.pi
