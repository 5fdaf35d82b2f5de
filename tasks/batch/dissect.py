"""Dissect in arrays, see `tasks.dissect`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import warp as wp
from palpate.tissue.types import floats

from .fields import Common, together
from .freeing import Freed, Freeing, count, earned, front, whole
from .hold import Hold, Holding, distance, follow, offset, start
from .kernels import closeness, error, judge, put, vector


class Seen:
  """What the domain observes besides."""

  front: floats("nworld", 3)


DissectState = together("DissectState", Holding, Freed, Seen)


@wp.func
def hold(s: Common, o: Any, w: int):
  """Follows the grasp; returns how close it is, 1 while it holds."""
  if follow(s, o, w):
    error(s, w)
  return wp.where(o.grasped[w, 0] == 1.0, 1.0, closeness(distance(s, o, w), o.distance0[w]))


@wp.func
def show(s: Common, o: Any, w: int):
  """Writes target and front."""
  put(o.target, w, offset(s, o, w))
  put(o.front, w, front(s, o, w) - vector(s.tip_pos, w))


@wp.kernel(enable_backward=False)
def begin(s: Common, o: DissectState):
  """Begins episodes."""
  w = wp.tid()
  if s.begun[w]:
    start(s, o, w)
    whole(o, w)


@wp.kernel(enable_backward=False)
def advance(s: Common, o: DissectState):
  """Follows the grasp and what comes free."""
  w = wp.tid()
  near = hold(s, o, w)
  outcome = count(s, o, w, o.grasped[w, 0] == 1.0)
  judge(s, w, earned(o, w, near, outcome), outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: DissectState, beginning: bool):
  """Writes target and front; freed, traction and grasped are kept up to date."""
  w = wp.tid()
  if not beginning or s.begun[w]:
    show(s, o, w)


class Dissect(Freeing, Hold):
  """The domain."""

  struct = DissectState
  begin, advance, observe = begin, advance, observe
  takes = (*Freeing.takes, "slip")

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return Freeing.sizes(task, physics)

  @staticmethod
  def constants(task: Any, physics):
    """Returns what all worlds share."""
    return Freeing.constants(task, physics)

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    return Hold.draw(task, physics)
