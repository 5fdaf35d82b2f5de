"""Tease in arrays, see `tasks.tease`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
import warp as wp
from palpate.tasks.domains import tease
from palpate.tissue.types import floats

from .fields import Common, together, vectors
from .freeing import Freed, Freeing, count, earned, holding, place, whole
from .kernels import closeness, judge, put, vector

_ROW = wp.constant(tease.ROW)


class Stroking:
  """What the domain has besides bonds."""

  goal: vectors  # the front [m]
  distance0: floats("nworld")  # [m]
  nearest: floats("nworld")  # best closeness so far
  target: floats("nworld", 3)


TeaseState = together("TeaseState", Freed, Stroking)


@wp.func
def edge(s: Common, o: TeaseState, w: int):
  """Returns the middle of the first row of bonds that hold [m]."""
  every = holding(o, w) == 0
  low = wp.float32(wp.inf)
  for k in range(o.area.shape[0]):
    if every or o.broken[w, k] < 1.0:
      low = wp.min(low, place(s, o, w, k)[1])
  high = wp.float32(0.0)
  many = wp.float32(0.0)
  for k in range(o.area.shape[0]):
    at = place(s, o, w, k)
    if (every or o.broken[w, k] < 1.0) and at[1] < low + _ROW:
      high += at[2]
      many += 1.0
  return wp.vec3(0.0, low, high / many)


@wp.func
def distance(s: Common, o: TeaseState, w: int):
  """Returns how far the tip is from the front [m]."""
  return wp.length(o.goal[w] - vector(s.tip_pos, w))


@wp.kernel(enable_backward=False)
def begin(s: Common, o: TeaseState):
  """Begins episodes."""
  w = wp.tid()
  if s.begun[w]:
    whole(o, w)
    o.goal[w] = edge(s, o, w)
    o.distance0[w] = distance(s, o, w)
    o.nearest[w] = 0.0


@wp.kernel(enable_backward=False)
def advance(s: Common, o: TeaseState):
  """Follows what comes free."""
  w = wp.tid()
  outcome = count(s, o, w, True)
  o.goal[w] = edge(s, o, w)
  o.nearest[w] = wp.max(o.nearest[w], closeness(distance(s, o, w), o.distance0[w]))
  judge(s, w, earned(o, w, o.nearest[w], outcome), outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: TeaseState, beginning: bool):
  """Writes target; freed and traction are kept up to date."""
  w = wp.tid()
  if not beginning or s.begun[w]:
    put(o.target, w, o.goal[w] - vector(s.tip_pos, w))


class Tease(Freeing):
  """The domain."""

  struct = TeaseState
  begin, advance, observe = begin, advance, observe
