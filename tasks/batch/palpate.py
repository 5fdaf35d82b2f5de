"""Palpation in arrays, see `tasks.palpation.Palpate`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import warp as wp
from palpate.models import shapes
from palpate.tasks import scenes
from palpate.tasks.domains import feeling, palpation
from palpate.tissue.types import Array, floats, ints, struct

from . import domain
from .fields import MISSED, RUNNING, SUCCESS, Common
from .kernels import error, judge, put, reach, vector

_FEELING, _FELT = wp.constant(palpation.FEELING), wp.constant(palpation.FELT)
_REPORT = wp.constant(palpation.REPORT)
_LEFT, _DEEP, _SOFT = (wp.constant(x) for x in (feeling.LEFT, feeling.DEEP, feeling.SOFT))
_APART, _NEAR = wp.constant(feeling.APART), wp.constant(feeling.NEAR)
_STIFF, _WIDTH = wp.constant(feeling.STIFF), wp.constant(feeling.WIDTH)
_LEAST = wp.constant(1e-9)
_NOISE = wp.constant(feeling.NOISE)


@struct
class PalpateState:
  """State of the domain."""

  tolerance: float  # of the report [m]
  radius: float  # of inclusions [m]
  center: wp.vec3  # of the field [m]
  places: Array(wp.vec3, ("nfield",))  # middles of its triangles [m]
  inclusion: Array(wp.vec3, ("nworld",))  # where it is [m]
  outward: Array(wp.vec3, ("nfield",))  # normals there
  beside: ints("nfield", 4)  # see `feeling.Notes`
  touched: Array(wp.bool, ("nworld", "nfield"))
  noted: floats("nworld", "nfield")  # stiffness, 0 where nothing was felt [N/m]
  near: Array(wp.bool, ("nworld", "nfield"))  # what was felt
  last: ints("nworld")  # that was noted
  depth: floats("nworld")  # there [m]
  next: ints("nworld")  # to feel, -1 without one
  likely: Array(wp.vec3, ("nworld",))  # where the inclusion is to be expected [m]
  field: floats("nworld", 3)
  felt: floats("nworld", 1)
  left: floats("nworld", 1)
  target: floats("nworld", 3)
  normal: floats("nworld", 3)


@wp.func
def nearest(o: PalpateState, point: wp.vec3):
  """Returns the place nearest to a point."""
  k = wp.int32(0)
  for i in range(o.places.shape[0]):
    if wp.length_sq(o.places[i] - point) < wp.length_sq(o.places[k] - point):
      k = i
  return k


@wp.func
def press(o: PalpateState, w: int, tip: wp.vec3, force: float):
  """Follows a press, see `feeling.Notes.press`; returns whether it noted something."""
  if force < _LEFT:
    o.depth[w] = 0.0
    return False
  k = nearest(o, tip)
  depth = wp.dot(o.places[k] - tip, o.outward[k])
  if depth <= wp.max(o.depth[w], _DEEP):
    return False
  if o.depth[w] > 0.0:
    o.noted[w, o.last[w]] = 0.0
  o.last[w] = k
  o.depth[w] = depth
  o.noted[w, k] = force / depth
  return True


@wp.func
def soft(o: PalpateState, w: int, count: int):
  """Returns what counts as soft among so many places that were felt [N/m]."""
  rank = int(wp.floor(_SOFT * float(count - 1)))
  for i in range(o.places.shape[0]):
    below = wp.int32(0)
    for j in range(o.places.shape[0]):
      own, other = o.noted[w, i], o.noted[w, j]
      if other > 0.0 and (other < own or (other == own and j < i)):
        below += 1
    if o.noted[w, i] > 0.0 and below == rank:
      return o.noted[w, i]
  return wp.float32(0.0)


@wp.func
def far(o: PalpateState, w: int):
  """Returns of the places far from all that was felt the nearest to the last, -1 without one."""
  found, least = wp.int32(-1), wp.float32(0.0)
  for k in range(o.places.shape[0]):
    away = wp.length_sq(o.places[k] - o.places[o.last[w]])
    if not o.near[w, k] and (found < 0 or away < least):
      found = k
      least = away
  return found


@wp.func
def side(o: PalpateState, w: int, top: int):
  """Returns a place beside the stiffest that is left to feel, -1 without one."""
  for i in range(4):
    k = o.beside[top, i]
    new = k >= 0
    for j in range(o.places.shape[0]):
      if o.noted[w, j] > 0.0 and j != top and new:
        new = wp.length(o.places[j] - o.places[k]) >= _NEAR
    if new:
      return k
  return wp.int32(-1)


@wp.func
def gain(o: PalpateState, w: int, k: int, soft: float):
  """Returns by how much an inclusion under a place explains what was felt, see `feeling.chance`."""
  both, square = wp.float32(0.0), wp.float32(_LEAST)
  for j in range(o.places.shape[0]):
    if o.noted[w, j] > 0.0:
      ratio = wp.length(o.places[j] - o.places[k]) / (_WIDTH * o.radius)
      bell = wp.exp(-ratio * ratio)
      both += bell * (o.noted[w, j] - soft)
      square += bell * bell
  both = wp.max(both, 0.0)
  return both * both / square


@wp.func
def summarise(o: PalpateState, w: int):
  """Finds what follows from what is noted."""
  count, top = wp.int32(0), wp.int32(0)
  for i in range(o.places.shape[0]):
    o.near[w, i] = False
    if o.noted[w, i] > 0.0:
      count += 1
    if o.noted[w, i] > o.noted[w, top]:
      top = i
  for j in range(o.places.shape[0]):
    if o.noted[w, j] > 0.0:
      for i in range(o.places.shape[0]):
        if wp.length(o.places[i] - o.places[j]) < _APART:
          o.near[w, i] = True
  least = soft(o, w, count)
  o.next[w] = wp.int32(-1)
  if o.noted[w, top] <= _STIFF * least:
    o.next[w] = far(o, w)
  if o.next[w] < 0:
    o.next[w] = side(o, w, top)
  best = wp.float32(0.0)
  for k in range(o.places.shape[0]):
    best = wp.max(best, gain(o, w, k, least))
  mass, middle = wp.float32(0.0), wp.vec3()
  for k in range(o.places.shape[0]):
    chance = wp.exp((gain(o, w, k, least) - best) / (2.0 * _NOISE * _NOISE))
    mass += chance
    middle += chance * o.places[k]
  o.likely[w] = middle / mass


@wp.kernel(enable_backward=False)
def begin(s: Common, o: PalpateState):
  """Begins episodes."""
  w = wp.tid()
  if not s.begun[w]:
    return
  o.felt[w, 0] = 0.0
  o.depth[w] = 0.0
  middle = wp.vec3()
  for k in range(o.places.shape[0]):
    o.touched[w, k] = False
    o.near[w, k] = False
    o.noted[w, k] = 0.0
    middle += o.places[k] / float(o.places.shape[0])
  o.likely[w] = middle
  o.last[w] = nearest(o, middle)
  o.next[w] = o.last[w]


@wp.kernel(enable_backward=False)
def advance(s: Common, o: PalpateState):
  """Follows what was felt, and judges the report."""
  w = wp.tid()
  force, tip = wp.length(vector(s.contact_force, w)), vector(s.tip_pos, w)
  outcome = int(RUNNING)
  found = wp.float32(0.0)
  if s.action[w, 4] > 0.5:
    outcome = MISSED
    off = wp.length(tip - o.inclusion[w])
    if off <= o.tolerance and force >= _REPORT:
      outcome = SUCCESS
      reach(s, w, off)
    else:
      error(s, w)
  else:
    if press(o, w, tip, force):
      summarise(o, w)
    count = wp.int32(0)
    for k in range(o.places.shape[0]):
      if force >= _FEELING and wp.length(o.places[k] - tip) < _FELT:
        o.touched[w, k] = True
      if o.touched[w, k]:
        count += 1
    o.felt[w, 0] = float(count) / float(o.places.shape[0])
    found = 0.3 * o.felt[w, 0]
  judge(s, w, found, outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: PalpateState, beginning: bool):
  """Writes field, left, target and normal; `advance` wrote felt."""
  w = wp.tid()
  if beginning and not s.begun[w]:
    return
  tip = vector(s.tip_pos, w)
  put(o.field, w, o.center - tip)
  left = o.next[w] >= 0
  o.left[w, 0] = wp.where(left, 1.0, 0.0)
  goal = wp.where(left, o.places[wp.max(o.next[w], 0)], o.likely[w])
  put(o.target, w, goal - tip)
  put(o.normal, w, o.outward[nearest(o, goal)])


class Palpate(domain.Domain):
  """The domain."""

  struct = PalpateState
  begin, advance, observe = begin, advance, observe
  takes = ("tolerance", "radius")
  tissue = ("young",)

  @staticmethod
  def prepare(task: Any):
    """Lets the worlds' tissue have the inclusions, not the scene."""
    task.leave_out()

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return {"nfield": len(task.places)}

  @staticmethod
  def constants(task: Any, physics):
    """Returns what else all worlds share."""
    beside = feeling.beside(task.places, task.up)
    told = {"places": task.places, "outward": task.outward, "beside": beside}
    return told | {"center": wp.vec3(*task.center)}

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    scene, place = task.scene, task.inclusion
    vertices, triangles = scenes.surface(scene.organ, scene.nodes, task.variants[0])
    young = scenes.TISSUES[scene.organ].young
    stiff = task.factor * young
    lump = shapes.inclusion_young(vertices, triangles, place, task.radius, young, stiff)
    return {"inclusion": place, "young": lump}
