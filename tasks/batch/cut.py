"""Cut in arrays, see `tasks.cut`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import numpy as np
import warp as wp
from palpate.tasks.domains import cut
from palpate.tissue.types import Array, floats, ints, struct

from . import domain
from .fields import DAMAGED, RUNNING, SUCCESS, Common, flags, vectors
from .kernels import closeness, error, judge, put, vector

_RULE, _ASTRAY, _COVERED = (wp.constant(x) for x in (cut.RULE, cut.ASTRAY, cut.COVERED))
_CLOSING, _LEAP = wp.constant(cut.CLOSING), wp.constant(cut.LEAP)
_ROOM = 4  # points of the line that it may have more than another


@struct
class CutState:
  """State of the domain."""

  tolerance: float  # [m]
  ahead_by: Array(wp.int32, (len(cut.AHEAD),))  # points
  inside: floats("nworld", 1)  # of the edge, see `palpate.batch.parting.Cutters`
  travelled: floats("nworld", 1)  # [m]
  place: floats("nworld", 1, 3)  # [m]
  pieces: ints("nworld")
  count: ints("nworld")  # points of the line
  line: Array(wp.vec3, ("nworld", "npoint"))  # [m]
  length: floats("nworld")  # of it [m]
  done: Array(wp.bool, ("nworld", "npoint"))  # which points are cut
  opened: floats("nworld")  # [m]
  astray: floats("nworld")  # [m]
  jagged: floats("nworld")  # [m]
  excess: floats("nworld")  # [m^2]
  farthest: floats("nworld")  # [m]
  mean: floats("nworld")  # deviation [m]
  seated: flags  # the edge was inside after the last step
  seat: vectors  # where [m]
  last: floats("nworld")  # what it had travelled [m]
  distance0: floats("nworld")  # [m]
  nearest: floats("nworld")  # best closeness so far
  target: floats("nworld", 3)
  ahead: floats("nworld", len(cut.AHEAD), 3)
  covered: floats("nworld", 1)
  deviation: floats("nworld", 1)


@wp.func
def next_of(o: CutState, w: int):
  """Returns the first point of the line that is not cut, after those that are."""
  n = o.count[w]
  for k in range(n):
    before = wp.where(k == 0, n - 1, k - 1)
    if not o.done[w, k] and o.done[w, before]:
      return k
  return 0


@wp.func
def share(o: CutState, w: int):
  """Returns the share of the line that is cut."""
  many = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  for k in range(o.count[w]):
    if o.done[w, k]:
      many += 1
  return float(many) / float(o.count[w])


@wp.func
def distance(s: Common, o: CutState, w: int):
  """Returns how far the tip is from the next point of the line [m]."""
  return wp.length(o.line[w, next_of(o, w)] - vector(s.tip_pos, w))


@wp.func
def on_line(o: CutState, w: int, place: wp.vec3):
  """Returns the point of the line that is nearest, seen from above, and how far it is [m]."""
  best = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  least = wp.float32(wp.inf)
  for k in range(o.count[w]):
    off = o.line[w, k] - place
    far = off[0] * off[0] + off[1] * off[1]
    if far < least:
      least = far
      best = k
  return best, wp.sqrt(least)


@wp.func
def open_piece(s: Common, o: CutState, w: int, start: wp.vec3, end: wp.vec3, length: float):
  """Counts a piece of the cut."""
  first, before = on_line(o, w, start)
  last, off = on_line(o, w, end)
  beside = off > o.tolerance
  if beside and before <= o.tolerance:
    error(s, w)
  o.opened[w] = o.opened[w] + length
  o.excess[w] = o.excess[w] + off * length
  o.farthest[w] = wp.max(o.farthest[w], off)
  if off > _RULE:
    o.jagged[w] = o.jagged[w] + length
  if beside:
    o.astray[w] = o.astray[w] + length
    return
  n = o.count[w]
  way = (last - first + n // 2 + n) % n - n // 2
  if wp.abs(way) > _LEAP:
    o.done[w, last] = True
    return
  low, high = wp.min(way, 0), wp.max(way, 0)
  for k in range(low, high + 1):
    o.done[w, (first + k + n) % n] = True


@wp.kernel(enable_backward=False)
def begin(s: Common, o: CutState):
  """Begins episodes."""
  w = wp.tid()
  if not s.begun[w]:
    return
  for k in range(o.done.shape[1]):
    o.done[w, k] = False
  o.opened[w] = 0.0
  o.astray[w] = 0.0
  o.jagged[w] = 0.0
  o.excess[w] = 0.0
  o.farthest[w] = 0.0
  o.mean[w] = 0.0
  o.seated[w] = False
  o.last[w] = o.travelled[w, 0]
  o.nearest[w] = 0.0
  o.distance0[w] = distance(s, o, w)


@wp.kernel(enable_backward=False)
def advance(s: Common, o: CutState):
  """Follows the edge through the tissue."""
  w = wp.tid()
  more = o.travelled[w, 0] - o.last[w]
  o.last[w] = o.travelled[w, 0]
  now = wp.vec3(o.place[w, 0, 0], o.place[w, 0, 1], o.place[w, 0, 2])
  inside = o.inside[w, 0] > 0.0
  if more > 0.0 and inside:
    open_piece(s, o, w, wp.where(o.seated[w], o.seat[w], now), now, more)
  o.seated[w] = inside
  o.seat[w] = now
  if o.opened[w] > 0.0:
    o.mean[w] = o.excess[w] / o.opened[w]
  covered = share(o, w)
  o.nearest[w] = wp.max(o.nearest[w], closeness(distance(s, o, w), o.distance0[w]))
  progress = 0.1 * o.nearest[w] + 0.9 * covered
  outcome = int(RUNNING)
  closed = o.opened[w] > o.length[w] + _CLOSING
  if o.astray[w] > _ASTRAY:
    outcome = DAMAGED
    progress = -1.0
  elif covered >= _COVERED and (closed or o.pieces[w] > 1):
    outcome = SUCCESS
  judge(s, w, progress, outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: CutState, beginning: bool):
  """Writes target, ahead, covered and deviation."""
  w = wp.tid()
  if beginning and not s.begun[w]:
    return
  tip, first = vector(s.tip_pos, w), next_of(o, w)
  put(o.target, w, o.line[w, first] - tip)
  for k in range(o.ahead_by.shape[0]):
    offset = o.line[w, (first + o.ahead_by[k]) % o.count[w]] - tip
    for i in range(3):
      o.ahead[w, k, i] = offset[i]
  o.covered[w, 0] = share(o, w)
  o.deviation[w, 0] = o.farthest[w]


def _points(task: Any) -> int:
  """Returns how many points there is room for: some more than one line has."""
  return len(cut.line(task.radius, task.wave, 0.0)[0]) + _ROOM


class Cut(domain.Domain):
  """The domain."""

  struct = CutState
  begin, advance, observe = begin, advance, observe
  takes = ("tolerance",)
  metrics = {  # noqa: RUF012
    "cut_deviation": "mean", "cut_farthest": "farthest", "cut_excess": "excess",
    "cut_jagged": "jagged",
  }  # fmt: skip

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return {"npoint": _points(task)}

  @staticmethod
  def constants(task: Any, physics):
    """Returns what all worlds share."""
    return {"ahead_by": np.array(cut.AHEAD)}

  @staticmethod
  def attach(worlds: Any) -> None:
    """Lets the tip feel the edge."""
    worlds.batch.feel(f"{worlds.task.prefix}tip_force", worlds.task.organ)

  @staticmethod
  def read(worlds: Any) -> None:
    """Brings the edge up to date."""
    found, own = worlds.organ.cutters, worlds.own
    own.inside, own.travelled, own.place = found.inside, found.length, found.seat
    own.pieces = worlds.organ.piece_count

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    count = len(task.curve)
    most = _points(task)
    line = np.pad(task.curve, [(0, most - count), (0, 0)])
    return {"line": line, "count": np.array(count), "length": np.array(task.length)}
