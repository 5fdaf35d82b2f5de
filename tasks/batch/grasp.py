"""Grasp in arrays, see `tasks.grasp`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import warp as wp
from palpate.tasks.domains import grasp, touch
from palpate.tissue.types import floats

from .fields import RUNNING, SUCCESS, Common, flags, together, vectors
from .hold import Hold, Holding, distance, follow, from_tip, holds, offset, start
from .kernels import closeness, error, judge, point, put

progress = wp.func(grasp.progress)
_SLACK, _REST = wp.constant(touch.SLACK), wp.constant(grasp.REST)
_LOW, _RESTING = wp.constant(grasp.LOW), wp.constant(grasp.RESTING)
_LETTING = wp.constant(grasp.LETTING)


class Lifting:
  """What the domain has besides jaws."""

  lift: float  # [m]
  hold: float  # [s]
  rest: vectors  # the site's place at rest [m]
  up: vectors  # towards the trocar
  time: floats("nworld")  # held [s]
  done: flags  # it was held
  lowered: floats("nworld")  # it rests low [s]
  letting: flags  # the jaws let go
  height: floats("nworld", 1)
  held: floats("nworld", 1)


GraspState = together("GraspState", Holding, Lifting)


@wp.func
def height(s: Common, o: GraspState, w: int):
  """Returns how far the site is above its place at rest, towards the trocar [m]."""
  return wp.dot(point(s, w, o.site[w]) - o.rest[w], o.up[w])


@wp.func
def again(o: GraspState, w: int):
  """Starts the holding again."""
  o.time[w] = 0.0
  o.done[w] = False
  o.lowered[w] = 0.0
  o.letting[w] = False


@wp.func
def count(s: Common, o: GraspState, w: int, share: float):
  """Counts the time that the site is held high, and then at rest low."""
  if not o.done[w]:
    if share < 1.0:
      o.time[w] = 0.0
    elif s.peak_force[w, 0] <= s.force_limit:
      o.time[w] = o.time[w] + s.dt
    if o.time[w] >= o.hold - _SLACK:
      o.done[w] = True
      o.where[w] = from_tip(s, o, w)
  if o.done[w] and _LOW <= share and share <= _RESTING:
    o.lowered[w] = o.lowered[w] + s.dt
  else:
    o.lowered[w] = 0.0


@wp.kernel(enable_backward=False)
def begin(s: Common, o: GraspState):
  """Begins episodes."""
  w = wp.tid()
  if s.begun[w]:
    start(s, o, w)
    again(o, w)


@wp.kernel(enable_backward=False)
def advance(s: Common, o: GraspState):
  """Follows the grasp from closing to release."""
  w = wp.tid()
  share = height(s, o, w) / o.lift
  if follow(s, o, w):
    if o.lowered[w] >= _REST - _SLACK and not o.closing[w]:
      o.letting[w] = True
    else:
      error(s, w)
      again(o, w)
  if o.letting[w] and (share < _LOW or share > _LETTING):
    error(s, w)
    again(o, w)
  outcome = int(RUNNING)
  now = wp.float32(0.0)
  if o.letting[w] and not holds(s, o, w):
    outcome = SUCCESS
  else:
    grasped = o.grasped[w, 0] == 1.0
    if grasped:
      count(s, o, w, share)
    near = closeness(distance(s, o, w), o.distance0[w])
    now = progress(o.done[w], grasped, near, share, o.time[w] / o.hold)
  judge(s, w, now, outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: GraspState, beginning: bool):
  """Writes target, height and held; grasped is kept up to date."""
  w = wp.tid()
  if not beginning or s.begun[w]:
    put(o.target, w, offset(s, o, w))
    o.held[w, 0] = wp.min(o.time[w] / o.hold, 1.0)
    o.height[w, 0] = height(s, o, w) - o.lift


class Grasp(Hold):
  """The domain."""

  struct = GraspState
  begin, advance, observe = begin, advance, observe
  takes = ("lift", "hold", "slip")

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    return Hold.draw(task, physics) | {"rest": task.rest, "up": task.up}
