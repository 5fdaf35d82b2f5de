"""Trace in arrays, see `tasks.trace`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import numpy as np
import warp as wp
from palpate.tasks.domains import trace
from palpate.tissue.types import Array, floats, ints, struct

from . import domain
from .fields import RUNNING, SUCCESS, Common, flags
from .kernels import closeness, error, judge, node, put, vector

follow = wp.func(trace.follow)
_CONTACT, _STEP = wp.constant(trace.CONTACT), wp.constant(trace.STEP)
_WINDOW = wp.constant(trace.WINDOW)


@struct
class TraceState:
  """State of the domain."""

  tolerance: float  # [m]
  ahead_by: Array(wp.int32, (len(trace.AHEAD),))  # points
  count: ints("nworld")  # points of the curve
  triangles: ints("nworld", "npoint")  # they lie in
  weights: Array(wp.vec3, ("nworld", "npoint"))
  arc: floats("nworld", "npoint")  # how far along the curve they are [m]
  traced: floats("nworld")  # [m]
  skipped: floats("nworld")  # [m]
  tracing: flags
  touching: flags
  distance0: floats("nworld")  # [m]
  target: floats("nworld", 3)
  ahead: floats("nworld", len(trace.AHEAD), 3)


@wp.func
def point(s: Common, o: TraceState, w: int, k: int):
  """Returns where a point of the curve is [m]."""
  triangle = o.triangles[w, k]
  share = o.weights[w, k]
  a, b = node(s, w, s.elem[triangle, 0]), node(s, w, s.elem[triangle, 1])
  return share[0] * a + share[1] * b + share[2] * node(s, w, s.elem[triangle, 2])


@wp.func
def done(o: TraceState, w: int):
  """Returns the number of points that are traced."""
  found = wp.int32(0)
  if o.traced[w] > 0.0:
    for k in range(o.count[w]):
      if o.arc[w, k] <= o.traced[w]:
        found = k + 1
  return found


@wp.func
def distance(s: Common, o: TraceState, w: int):
  """Returns how far the tip is from the next point of the curve [m]."""
  k = wp.min(done(o, w), o.count[w] - 1)
  return wp.length(point(s, o, w, k) - vector(s.tip_pos, w))


@wp.func
def project(s: Common, o: TraceState, w: int):
  """Returns how far along the curve the tip is, near what is traced, and how far off it [m]."""
  tip, middle = vector(s.tip_pos, w), wp.max(done(o, w) - 1, 0)
  first = wp.max(middle - _WINDOW, 0)
  last = wp.min(middle + _WINDOW, o.count[w] - 1)
  place, off = wp.float32(0.0), wp.float32(wp.inf)
  for k in range(first, last):
    start = point(s, o, w, k)
    along = point(s, o, w, k + 1) - start
    share = wp.clamp(wp.dot(tip - start, along) / wp.length_sq(along), 0.0, 1.0)
    far = wp.length(tip - start - share * along)
    if far < off:
      off = far
      place = o.arc[w, k] + share * (o.arc[w, k + 1] - o.arc[w, k])
  return place, off


@wp.func
def aside(s: Common, o: TraceState, w: int):
  """Returns how far the tip is from the nearest point of the curve [m]."""
  off = wp.float32(wp.inf)
  for k in range(o.count[w]):
    off = wp.min(off, wp.length(point(s, o, w, k) - vector(s.tip_pos, w)))
  return off


@wp.kernel(enable_backward=False)
def begin(s: Common, o: TraceState):
  """Begins episodes."""
  w = wp.tid()
  if not s.begun[w]:
    return
  o.traced[w] = 0.0
  o.skipped[w] = 0.0
  o.tracing[w] = False
  o.touching[w] = False
  o.distance0[w] = distance(s, o, w)


@wp.kernel(enable_backward=False)
def advance(s: Common, o: TraceState):
  """Follows the tip along the curve, which moves with the organ."""
  w = wp.tid()
  length = o.arc[w, o.count[w] - 1]
  place, off = project(s, o, w)
  touching = wp.length(vector(s.contact_force, w)) > _CONTACT
  on = touching and off <= o.tolerance
  tracing, traced, skipped = follow(
    o.tracing[w], o.traced[w], o.skipped[w], place, on, o.tolerance, length
  )
  o.tracing[w] = tracing
  o.traced[w] = traced
  o.skipped[w] = skipped
  if o.touching[w] and not touching and traced > 0.0:
    error(s, w)
  if touching and not o.touching[w] and aside(s, o, w) > o.tolerance:
    error(s, w)
  o.touching[w] = touching
  outcome = int(RUNNING)
  now = 0.1 + 0.9 * traced / length
  if traced == 0.0:
    now = 0.1 * closeness(distance(s, o, w), o.distance0[w])
  if traced >= length - _STEP:
    outcome = SUCCESS
  judge(s, w, now, outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: TraceState, beginning: bool):
  """Writes target and ahead."""
  w = wp.tid()
  if beginning and not s.begun[w]:
    return
  tip, far, last = vector(s.tip_pos, w), done(o, w), o.count[w] - 1
  put(o.target, w, point(s, o, w, wp.min(far, last)) - tip)
  for k in range(o.ahead_by.shape[0]):
    offset = point(s, o, w, wp.min(far + o.ahead_by[k], last)) - tip
    for i in range(3):
      o.ahead[w, k, i] = offset[i]


class Trace(domain.Domain):
  """The domain."""

  struct = TraceState
  begin, advance, observe = begin, advance, observe
  takes = ("tolerance",)

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return {"npoint": trace.DRAWN}

  @staticmethod
  def constants(task: Any, physics):
    """Returns what all worlds share."""
    return {"ahead_by": np.array(trace.AHEAD)}

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    count = len(task.arc)
    rows = {"triangles": task.triangles, "weights": task.weights, "arc": task.arc}
    more = trace.DRAWN - count
    padded = {k: np.pad(v, [(0, more)] + [(0, 0)] * (v.ndim - 1)) for k, v in rows.items()}
    return padded | {"count": np.array(count)}
