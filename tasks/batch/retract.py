"""Retract in arrays, see `tasks.retract`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import warp as wp
from palpate.tasks.domains import retract, touch
from palpate.tissue.types import Array, floats

from .fields import RUNNING, SUCCESS, Common, together
from .hold import Hold, Holding, distance, follow, offset, start
from .kernels import closeness, error, judge, node, put, vector

progress = wp.func(retract.progress)
_SLACK, _SEEN = wp.constant(touch.SLACK), wp.constant(retract.SEEN)


class Seeing:
  """What the domain has besides jaws."""

  wanted: float  # share of the disc
  hold: float  # [s]
  eye: wp.vec3  # of the laparoscope [m]
  disc: Array(wp.vec3, ("nworld", "nsample"))  # points of it [m]
  covered: Array(wp.bool, ("nworld", "nsample"))  # whether the organ hides them
  time: floats("nworld")  # held [s]
  hidden: floats("nworld", 3)
  visible: floats("nworld", 1)
  held: floats("nworld", 1)


RetractState = together("RetractState", Holding, Seeing)


@wp.kernel(enable_backward=False)
def hide(s: Common, o: RetractState):
  """Finds which points of the disc the organ hides: rays against triangles, as `Physics.hidden`."""
  w, k = wp.tid()
  covered = wp.bool(False)
  ray = o.disc[w, k] - o.eye
  for i in range(s.elem.shape[0]):
    a = node(s, w, s.elem[i, 0])
    e1, e2 = node(s, w, s.elem[i, 1]) - a, node(s, w, s.elem[i, 2]) - a
    out = o.eye - a
    across = wp.cross(out, e1)
    size = wp.dot(ray, wp.cross(e2, e1))
    side = wp.sign(size)
    size = side * size
    u = side * wp.dot(ray, wp.cross(e2, out))
    v = side * wp.dot(ray, across)
    far = side * wp.dot(e2, across)
    if u >= 0.0 and v >= 0.0 and u + v <= size and far > 0.0 and far < 0.999 * size:
      covered = True
  o.covered[w, k] = covered


@wp.kernel(enable_backward=False)
def begin(s: Common, o: RetractState):
  """Begins episodes."""
  w = wp.tid()
  if s.begun[w]:
    start(s, o, w)
    o.time[w] = 0.0
    o.visible[w, 0] = 0.0


@wp.kernel(enable_backward=False)
def advance(s: Common, o: RetractState):
  """Follows the grasp and what is seen."""
  w = wp.tid()
  if follow(s, o, w):
    error(s, w)
  seen = wp.float32(0.0)
  for k in range(o.disc.shape[1]):
    if not o.covered[w, k]:
      seen += 1.0
  seen = seen / float(o.disc.shape[1])
  o.visible[w, 0] = seen
  grasped = o.grasped[w, 0] == 1.0
  if not (seen >= o.wanted - _SEEN and grasped):
    o.time[w] = 0.0
  elif s.peak_force[w, 0] <= s.force_limit:
    o.time[w] = o.time[w] + s.dt
  outcome = int(RUNNING)
  near = closeness(distance(s, o, w), o.distance0[w])
  now = progress(grasped, near, seen / o.wanted, o.time[w] / o.hold)
  if o.time[w] >= o.hold - _SLACK:
    outcome = SUCCESS
  judge(s, w, now, outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: RetractState, beginning: bool):
  """Writes target, hidden and held; visible and grasped are kept up to date."""
  w = wp.tid()
  if not beginning or s.begun[w]:
    put(o.target, w, offset(s, o, w))
    o.held[w, 0] = wp.min(o.time[w] / o.hold, 1.0)
    put(o.hidden, w, o.disc[w, 0] - vector(s.tip_pos, w))


class Retract(Hold):
  """The domain."""

  struct = RetractState
  begin, advance, observe = begin, advance, observe
  takes = ("wanted", "hold", "slip")

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return Hold.sizes(task, physics) | {"nsample": len(task.disc)}

  @staticmethod
  def constants(task: Any, physics):
    """Returns what all worlds share."""
    return Hold.constants(task, physics) | {"eye": wp.vec3(*physics.camera()[0])}

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    return Hold.draw(task, physics) | {"disc": task.disc}

  @staticmethod
  def sense(worlds: Any) -> None:
    """Measures what the jaws have between them, and what is hidden."""
    Hold.sense(worlds)
    worlds.launch(hide, worlds.own.disc.shape, [worlds.fields, worlds.own])
