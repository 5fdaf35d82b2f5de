"""Pressing in arrays, see `tasks.probe.Press`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import numpy as np
import warp as wp
from palpate.tasks import probe, touch
from palpate.tissue.types import Array, floats, ints, struct

from . import domain
from .fields import RUNNING, SUCCESS, Common, flags
from .kernels import closeness, error, judge, normal, put, reach, vector

presses, progress = wp.func(probe.presses), wp.func(probe.progress)
_SLACK = wp.constant(touch.SLACK)
_PRESSES, _LEAVES = wp.constant(probe.PRESSES), wp.constant(probe.LEAVES)


@struct
class PressState:
  """State of the domain."""

  tolerance: float  # [m]
  low: float  # of the band [N] or [m]
  high: float
  hold: float  # [s]
  by_depth: int  # whether the band is one of depth
  goals: ints("nworld", "nsite")  # triangles to press
  points: Array(wp.vec3, ("nworld", "nsite"))  # their middles at rest [m]
  normals: Array(wp.vec3, ("nworld", "nsite"))
  done: ints("nworld")
  time: floats("nworld")  # in the band [s]
  pressing: flags
  distance0: floats("nworld")  # [m]
  target: floats("nworld", 3)
  normal: floats("nworld", 3)
  level: floats("nworld", 1)
  held: floats("nworld", 1)


@wp.func
def now(o: PressState, w: int):
  """Returns the index of the site to press."""
  return wp.min(o.done[w], o.goals.shape[1] - 1)


@wp.func
def distance(s: Common, o: PressState, w: int):
  """Returns how far the tip is from the site along the surface, or above it [m]."""
  k = now(o, w)
  offset = vector(s.tip_pos, w) - o.points[w, k]
  height = wp.dot(offset, o.normals[w, k])
  above = wp.max(height, 0.0)
  return wp.sqrt(wp.length_sq(offset - height * o.normals[w, k]) + above * above)


@wp.func
def level(s: Common, o: PressState, w: int):
  """Returns the force [N] or the depth below the resting surface [m]."""
  if o.by_depth == 1:
    k = now(o, w)
    return wp.max(0.0, wp.dot(o.points[w, k] - vector(s.tip_pos, w), o.normals[w, k]))
  return wp.length(vector(s.contact_force, w))


@wp.kernel(enable_backward=False)
def begin(s: Common, o: PressState):
  """Begins episodes."""
  w = wp.tid()
  if not s.begun[w]:
    return
  o.done[w] = 0
  o.time[w] = 0.0
  o.pressing[w] = False
  o.distance0[w] = distance(s, o, w)


@wp.kernel(enable_backward=False)
def advance(s: Common, o: PressState):
  """Counts the time in the band."""
  w = wp.tid()
  force = wp.length(vector(s.contact_force, w))
  on = distance(s, o, w) <= o.tolerance
  if force > _PRESSES and not o.pressing[w] and not on:
    error(s, w)
  o.pressing[w] = force > wp.where(o.pressing[w], _LEAVES, _PRESSES)
  if presses(on, level(s, o, w), o.low, o.high, force):
    o.time[w] = o.time[w] + s.dt
  else:
    o.time[w] = 0.0
  if o.time[w] >= o.hold - _SLACK:
    reach(s, w, distance(s, o, w))
    o.done[w] = o.done[w] + 1
    o.time[w] = 0.0
    o.distance0[w] = distance(s, o, w)
  outcome = int(RUNNING)
  near = closeness(distance(s, o, w), o.distance0[w])
  found = progress(float(o.done[w]), near, o.time[w] / o.hold, float(o.goals.shape[1]))
  if o.done[w] == o.goals.shape[1]:
    outcome = SUCCESS
  judge(s, w, found, outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: PressState, beginning: bool):
  """Writes target, normal, level and held."""
  w = wp.tid()
  if beginning and not s.begun[w]:
    return
  k = now(o, w)
  put(o.target, w, o.points[w, k] - vector(s.tip_pos, w))
  put(o.normal, w, normal(s, w, o.goals[w, k]))
  o.level[w, 0] = level(s, o, w) - 0.5 * (o.low + o.high)
  o.held[w, 0] = o.time[w] / o.hold


class Press(domain.Domain):
  """The domain."""

  struct = PressState
  begin, advance, observe = begin, advance, observe
  takes = ("tolerance", "hold")

  @staticmethod
  def constants(task: Any, physics):
    """Returns what else all worlds share."""
    low, high = task.band
    return {"low": low, "high": high, "by_depth": int(task.by_depth)}

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return {"nsite": task.targets}

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    return {"goals": np.array(task.goals), "points": task.points, "normals": task.normals}
