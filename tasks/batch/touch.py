"""Touch in arrays, see `tasks.touch`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import numpy as np
import warp as wp
from palpate.tasks import touch
from palpate.tissue.types import floats, ints, struct

from . import domain
from .fields import RUNNING, SUCCESS, Common, flags
from .kernels import closeness, error, judge, normal, point, put, reach, vector

follow, progress = wp.func(touch.follow), wp.func(touch.progress)
_DWELL, _SLACK = wp.constant(touch.DWELL), wp.constant(touch.SLACK)
_CONTACT = wp.constant(touch.CONTACT)


@struct
class TouchState:
  """State of the domain."""

  tolerance: float  # [m]
  goals: ints("nworld", "npoint")  # triangles to touch
  done: ints("nworld")
  time: floats("nworld")  # of the touch [s]
  pressing: flags
  spoilt: flags
  distance0: floats("nworld")  # [m]
  target: floats("nworld", 3)
  normal: floats("nworld", 3)
  held: floats("nworld", 1)


@wp.func
def goal(s: Common, o: TouchState, w: int):
  """Returns the triangle to touch next; the last one when all are done."""
  return o.goals[w, wp.min(o.done[w], o.goals.shape[1] - 1)]


@wp.func
def distance(s: Common, o: TouchState, w: int):
  """Returns how far the tip is from the point to touch [m]."""
  return wp.length(point(s, w, goal(s, o, w)) - vector(s.tip_pos, w))


@wp.kernel(enable_backward=False)
def begin(s: Common, o: TouchState):
  """Begins episodes."""
  w = wp.tid()
  if not s.begun[w]:
    return
  o.done[w] = 0
  o.time[w] = 0.0
  o.pressing[w] = False
  o.spoilt[w] = False
  o.distance0[w] = distance(s, o, w)


@wp.kernel(enable_backward=False)
def advance(s: Common, o: TouchState):
  """Counts touches."""
  w = wp.tid()
  force = s.peak_force[w, 0]
  on = distance(s, o, w) <= o.tolerance
  if force > _CONTACT and not o.pressing[w] and not on:
    error(s, w)
  pressing, spoilt, time = follow(o.spoilt[w], o.time[w], force, on, s.force_limit, s.dt)
  o.pressing[w] = pressing
  o.spoilt[w] = spoilt
  o.time[w] = time
  if time >= _DWELL - _SLACK:
    reach(s, w, distance(s, o, w))
    o.done[w] = o.done[w] + 1
    o.time[w] = 0.0
    o.spoilt[w] = True
    o.distance0[w] = distance(s, o, w)
  outcome = int(RUNNING)
  points = float(o.goals.shape[1])
  near = closeness(distance(s, o, w), o.distance0[w])
  now = progress(float(o.done[w]), near, o.time[w], points)
  if o.done[w] == o.goals.shape[1]:
    outcome = SUCCESS
  judge(s, w, now, outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: TouchState, beginning: bool):
  """Writes target, normal and held."""
  w = wp.tid()
  if beginning and not s.begun[w]:
    return
  triangle = goal(s, o, w)
  put(o.target, w, point(s, w, triangle) - vector(s.tip_pos, w))
  put(o.normal, w, normal(s, w, triangle))
  o.held[w, 0] = o.time[w] / _DWELL


class Touch(domain.Domain):
  """The domain."""

  struct = TouchState
  begin, advance, observe = begin, advance, observe
  takes = ("tolerance",)

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return {"npoint": task.targets}

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    return {"goals": np.array(task.goals)}
