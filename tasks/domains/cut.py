"""Cut: cut out a marked piece of a sheet of tissue with a scalpel, along its line.

Own observations: `target` (3,), from the tip to the next point of the line, and once 98 % are cut
to the one after the nearest [m]; `ahead` (3, 3), from the tip to points 5, 10 and 15 mm further
along the line [m]; `covered` (1,), share of the line that is cut [-]; `deviation` (1,), largest
distance of the cut from the line so far [m].

Progress: 0.1 * closeness to the line, at its best, + 0.9 * share of the line that is cut. A point
of the line is cut where the edge has gone through the wall within the tolerance of it, slower than
60 mm/s and without dragging: with a pull along the sheet, which its frame holds, of at most twice
what cutting takes. Moving along without cutting counts nothing. Success: 98 % of it, and the piece
is free, or 6 mm more are cut than the line is long: the mesh may hang together by an edge. Failure:
more than 10 mm cut farther from the line than the tolerance, faster or dragging, a pull of twice
its limit, a force above the damage limit, or the time limit.

The sheet is under tension, so that the cut gapes. The line is that of the tissue at rest.

That is the pattern cut of FLS: a circle of 4 cm, and all of the cut within 2 mm of the line (Ritter
and Scott 2007, 10.1177/1553350607302329), with a scalpel in place of scissors and a grasper.
"""

import dataclasses
from typing import Annotated, Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.types import Array, ints

from ..core import rules as r
from ..core.base import Physics, Task
from ..core.performer import Performer, Script
from ..core.scenes import Scene
from ..registry import exercise
from . import sheet

SCENE = Scene(
  organ="sheet", instrument="scalpel", port=(0.0, -0.025, 0.12), camera=(-0.03, -0.07, 0.09)
)
RULE = 0.002  # [m], of FLS
ASTRAY = 0.01  # most that may be cut beyond the tolerance, slashed or dragged [m]
TRACTION = 0.5  # limit of the pull along the sheet, of which cutting takes 0.24 [N]
SLASH = 0.06  # speed from which on a cut is a slash: nobody stops it at the line [m/s]
COVERED = 0.98  # share of the line that is to be cut
CLOSING = 0.006  # length that is cut beyond that of the line where the piece counts as free [m]
STEP = 0.001  # between points of the line [m]
FIRST, SECOND, THIRD = 5, 10, 15  # points further on that are observed
MARKS, ABOVE = 36, 0.0006  # spheres that draw the line, and how far above it [m]
LEAD = 4  # of them that show where to begin or to go on, and which way
LEAP = 10  # points of the line between two control steps that do not follow one another
# Of the expert: how fast it cuts [m/s], and how deep the tip is under the sheet and over it [m].
_SPEED, _DEEP, _OVER = 0.012, 0.0035, 0.012
_BEYOND = 10  # points of the line that it goes on beyond where it began


def line(radius: float, wave: float, start: float) -> tuple[np.ndarray, float]:
  """Returns points of the line around the middle, (n, 3), and its length [m].

  Args:
    radius: mean radius [m]
    wave: by how much that comes and goes, three times around [-]
    start: angle at which it begins [rad]
  """
  angle = start + np.linspace(0, 2 * np.pi, 721)
  far = radius * (1 + wave * np.cos(3 * angle))
  fine = np.stack([far * np.cos(angle), far * np.sin(angle), 0.0 * angle], axis=1)
  arc = np.concatenate([[0.0], np.linalg.norm(np.diff(fine, axis=0), axis=1).cumsum()])
  way = np.linspace(0.0, arc[-1], round(arc[-1] / STEP) + 1)[:-1]
  return np.stack([np.interp(way, arc, column) for column in fine.T], axis=1), float(arc[-1])


class State:
  """State of a world."""

  control_timestep: float  # [s]
  tolerance: float  # [m]
  limit: float  # of the pull along the sheet [N]
  count: int  # points of the line
  curve: Annotated[Any, Array(wp.vec3, ("room",))]  # these [m]
  cut: Annotated[Any, ints("room")]  # whether they are cut
  done: int  # how many are
  next: int  # the first that is not, after those that are; the one to go on to where enough are
  length: float  # of the line [m]
  opened: float  # length that was cut so far [m]
  astray: float  # length of that beyond the tolerance, slashed or dragged [m]
  jagged: float  # length of that more than 2 mm from the line [m]
  excess: float  # area between cut and line [m^2]
  mean: float  # distance of the cut from the line [m]
  farthest: float  # largest [m]
  deepest: float  # how far the tip was under the sheet while it cut [m]
  traction: float  # pull along the sheet [N]
  pulled: float  # the largest so far [N]
  inside: bool  # whether the edge was in the tissue a control step ago
  seat: r.Vector  # where it was then [m]
  travelled: float  # and how far it had come [m]
  distance0: float  # [m]
  nearest: float  # best closeness so far
  target: r.Vector
  ahead: r.Vectors3
  covered: float
  deviation: float


# The rules. What goes over many points is written for numpy, and for many worlds below it.


def following(o):
  """Returns the first point of the line that is not cut, after those that are."""
  for k in range(o.count):
    if o.cut[k] == 0 and o.cut[(k + o.count - 1) % o.count] == 1:
      return k
  return 0


def nearest(o, place):
  """Returns the point of the line nearest to a place from above, and how far that is [m]."""
  far = np.linalg.norm(o.curve[:, :2] - place[:2], axis=1)
  k = int(far.argmin())
  return k, float(far[k])


@r.many(nearest)
def _nearest(o, place):
  found, least = int(0), float(r.FAR)
  for k in range(o.count):
    x, y = o.curve[k][0] - place[0], o.curve[k][1] - place[1]
    far = r.root(x * x + y * y)
    if far < least:
      least = far
      found = k
  return found, least


def distance(s, o):
  """Returns how far the tip is from the next point of the line [m]."""
  return r.length(o.curve[o.next] - r.tip(s))


def cover(o, first, last):
  """Counts the points between two that the edge went by as cut, where it did not leap."""
  half = o.count // 2
  way = (last - first + half + o.count) % o.count - half
  low, high = min(way, 0), max(way, 0)
  if abs(way) > LEAP:
    low = way
    high = way
  for i in range(low, high + 1):
    k = (first + i + o.count) % o.count
    if o.cut[k] == 0:
      o.cut[k] = 1
      o.done = o.done + 1
  o.covered = float(o.done) / float(o.count)
  o.next = following(o)
  return o


def pull(s):
  """Returns the pull along the sheet, which lies in z = 0 [N]."""
  force = r.tissue_force(s)
  return r.root(force[0] * force[0] + force[1] * force[1])


def proceed(s, o, start, end, way):
  """Counts a piece of the cut, between two places at rest [m]."""
  first, before = nearest(o, start)
  last, off = nearest(o, end)
  if off > o.tolerance and (before <= o.tolerance or not o.inside):
    r.miss(s, o, off)
  o.opened = o.opened + way
  o.excess = o.excess + off * way
  o.mean = o.excess / o.opened
  o.farthest = max(o.farthest, off)
  if off > RULE:
    o.jagged = o.jagged + way
  if off > o.tolerance or way > SLASH * o.control_timestep or o.traction > o.limit:
    o.astray = o.astray + way
  else:
    o = cover(o, first, last)
  return o


def advance(s, o):
  """Follows the edge through the tissue."""
  o.traction = pull(s)
  o.pulled = max(o.pulled, o.traction)
  inside, travelled, seat = r.cutter(s)
  if inside and travelled > o.travelled:
    o = proceed(s, o, o.seat if o.inside else seat, seat, travelled - o.travelled)
    o.deepest = max(o.deepest, -r.tip(s)[2])
  o.inside = inside
  o.seat = seat
  o.travelled = travelled
  if o.astray > ASTRAY or o.traction > 2.0 * o.limit:
    return o, -1.0, r.DAMAGED
  if o.covered >= COVERED:
    if o.opened > o.length + CLOSING or r.pieces(s) > 1:
      return o, 1.0, r.SUCCESS
    here, _ = nearest(o, r.tip(s))  # the piece hangs together still: the cut goes on
    o.next = (here + 1) % o.count
  o.nearest = max(o.nearest, r.closeness(distance(s, o), o.distance0))
  return o, 0.1 * o.nearest + 0.9 * o.covered, r.RUNNING


def observe(s, o):
  """Finds target, ahead and deviation; covered is up to date."""
  k, n, here = o.next, o.count, r.tip(s)
  o.target = o.curve[k] - here
  o.ahead = r.rows(
    o.curve[(k + FIRST) % n] - here,
    o.curve[(k + SECOND) % n] - here,
    o.curve[(k + THIRD) % n] - here,
  )
  o.deviation = o.farthest
  return o


def mark(s, o, k):
  """Marks the line where it is not cut: there are the lips of the cut."""
  at = k * o.count // MARKS
  further = (at - o.next + o.count) % o.count
  look = r.NOW if MARKS * further < LEAD * o.count else r.LATER
  return o.curve[at] + r.vector(0.0, 0.0, ABOVE), r.HIDDEN if o.cut[at] > 0 else look


@exercise("cut/easy", 40, "easy", asks="Cut out a circle of 24 mm within 3 mm of its line",
          scene=dataclasses.replace(SCENE, nodes=400), radius=0.012, tolerance=0.003)  # fmt: skip
@exercise("cut/standard", 60, asks="Cut out a circle of 40 mm within 2 mm, as FLS asks for",
          scene=dataclasses.replace(SCENE, nodes=600), radius=0.02, jitter=0.003)  # fmt: skip
@exercise("cut/hard", 80, "hard", asks="Cut out a clover of 36 mm within 1.5 mm",
          scene=dataclasses.replace(SCENE, nodes=1000), radius=0.018, wave=0.2, tolerance=0.0015,
          jitter=0.005)  # fmt: skip
class Cut(Task):
  """Cut out a marked piece."""

  watch = ("miss", "unintended_contact")
  mark_radius = 0.0009
  targets = MARKS
  rules = r.Rules(
    State,
    advance,
    observe,
    ("target", "ahead", "covered", "deviation"),
    {
      "cut_deviation": "mean",
      "cut_farthest": "farthest",
      "cut_excess": "excess",
      "cut_jagged": "jagged",
      "cut_depth": "deepest",
      "peak_traction": "pulled",
    },
    {
      "deviation": "mean",
      "farthest": "farthest",
      "excess": "excess",
      "jagged": "jagged",
      "depth": "deepest",
      "traction": "traction",
    },
    mark=mark,
  )

  def __init__(
    self,
    *,
    name: str,
    radius: float,
    wave: float = 0.0,
    tolerance: float = RULE,
    traction: float = TRACTION,
    **kwargs,
  ):
    """Makes the task.

    Args:
      name: domain and task
      radius: of the line [m]
      wave: by how much that comes and goes, three times around [-]
      tolerance: largest distance of the cut from the line [m]
      traction: limit of the pull along the sheet [N]
      **kwargs: see Task
    """
    if not 0.005 <= radius * (1 + abs(wave)) <= 0.024:
      raise ValueError(
        f"{name}: radius is {radius} and wave {wave}, expected a line from 5 to 24 mm of the middle"
      )
    if not 0 < tolerance < radius:
      raise ValueError(f"{name}: tolerance is {tolerance}, expected a number in (0, {radius})")
    if not traction > 0:
      raise ValueError(f"{name}: traction is {traction}, expected a number > 0 [N]")
    self.radius, self.wave, self.tolerance, self.limit = radius, wave, tolerance, traction
    self.room = len(line(radius, wave, 0.0)[0]) + 4  # another may have a point or two more
    super().__init__(name=name, **{"force_limit": 0.8, "damage": 2.0, **kwargs})

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene, which has no other shapes."""
    return sheet.build(self._scene(variant))

  def place_of_work(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the triangles, and the middle of the sheet [m]."""
    return np.arange(len(physics.organ.elem)), np.zeros(3)

  def begin(self, physics: Physics) -> None:
    """Draws the line, which begins anywhere on it."""
    self.curve, self.length = line(self.radius, self.wave, self.random.uniform(0, 2 * np.pi))
    self.count, self.cut = len(self.curve), np.zeros(len(self.curve), bool)
    self.opened = self.astray = self.jagged = self.excess = self.mean = self.farthest = 0.0
    self.deepest = self.traction = self.pulled = 0.0
    self.inside, self.travelled, self.seat = r.cutter(physics)
    self.done, self.next, self.covered, self.nearest = 0, 0, 0.0, 0.0
    self.distance0 = distance(physics, self)
    self.reference_length = self.length + self.distance0

  def label(self, kind: str) -> str:
    """Returns what damage is."""
    if kind != "damage":
      return super().label(kind)
    if self.astray > ASTRAY:
      return f"{1e3 * self.astray:.0f} mm are cut beside the line, slashed or dragged"
    return f"torn by a pull of {self.traction:.2f} N"

  def instruct(self, physics: Physics) -> str:
    """Says to begin, or to go on."""
    if not self.opened:
      return "Push the tip of the blade through the line"
    return f"Cut along the line: {100 * self.covered:.0f} % done"

  def constants(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns the line to cut [m]."""
    return {"line": self.curve}

  def _goes_on(self, physics: Physics) -> bool:
    """Returns whether somebody else was cutting along the line."""
    inside, _, seat = r.cutter(physics)
    off = r.length(self.curve[self.next] - seat)
    return inside and off < 2 * self.tolerance

  def expert(self, p: Performer) -> Script:
    """Goes through the sheet and around, a little beyond where it began."""
    physics, up, count = p.physics, np.array([0.0, 0.0, 1.0]), len(self.curve)
    port = physics.trocar().pos

    def under(place: np.ndarray, deep: float) -> np.ndarray:
      """Returns where the tip is when the blade goes through a place [m]."""
      return place + deep / np.linalg.norm(place - port) * (place - port)

    while self.outcome is None:
      start = self.next
      if not self._goes_on(physics):
        yield from p.move(self.curve[start] + _OVER * up)
      yield from p.line(under(self.curve[start], _DEEP), speed=0.02)
      for _ in range(100):  # the sheet gives before it is pierced
        if r.cutter(physics)[0]:
          break
        p.tip = p.tip - 0.01 * self.control_timestep * up
        yield p.step()
      yield from p.line(under(self.curve[start], _DEEP), speed=0.02)
      at, time = float(start), 0.0
      while self.outcome is None and at < start + count + _BEYOND:
        time += self.control_timestep
        at += _SPEED * p.style.speed * self.control_timestep / STEP
        k, share = int(at), at % 1
        rest = (1 - share) * self.curve[k % count] + share * self.curve[(k + 1) % count]
        out = rest / np.linalg.norm(rest)
        wander = p.style.detour * 0.002 * np.sin(2.5 * time)
        wander += p.style.overshoot * 0.003 * np.sin(4 * time)
        deep = _DEEP * (1 + 0.3 * (p.style.force - 1))
        p.tip = under(rest + wander * out, deep)
        yield p.step()
      yield from p.move(p.tip + (_OVER + _DEEP) * up, speed=0.03)
