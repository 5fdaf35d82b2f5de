"""Palpation in arrays, see `tasks.palpation.Palpate`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import warp as wp
from palpate.models import shapes
from palpate.tasks import palpation, scenes
from palpate.tissue.types import Array, floats, struct

from . import domain
from .fields import MISSED, RUNNING, SUCCESS, Common
from .kernels import error, judge, put, reach, vector

_FEELING, _FELT = wp.constant(palpation.FEELING), wp.constant(palpation.FELT)
_REPORT = wp.constant(palpation.REPORT)


@struct
class PalpateState:
  """State of the domain."""

  tolerance: float  # of the report [m]
  center: wp.vec3  # of the field [m]
  places: Array(wp.vec3, ("nfield",))  # middles of its triangles [m]
  inclusion: Array(wp.vec3, ("nworld",))  # where it is [m]
  touched: Array(wp.bool, ("nworld", "nfield"))
  field: floats("nworld", 3)
  felt: floats("nworld", 1)


@wp.kernel(enable_backward=False)
def begin(s: Common, o: PalpateState):
  """Begins episodes."""
  w = wp.tid()
  if not s.begun[w]:
    return
  o.felt[w, 0] = 0.0
  for k in range(o.places.shape[0]):
    o.touched[w, k] = False


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
  """Writes field; `advance` wrote felt."""
  w = wp.tid()
  if not beginning or s.begun[w]:
    put(o.field, w, o.center - vector(s.tip_pos, w))


class Palpate(domain.Domain):
  """The domain."""

  struct = PalpateState
  begin, advance, observe = begin, advance, observe
  takes = ("tolerance",)
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
    return {"places": task.places, "center": wp.vec3(*task.center)}

  @staticmethod
  def draw(task: Any, physics):
    """Returns the rows of a world."""
    scene, place = task.scene, task.inclusion
    vertices, triangles = scenes.surface(scene.organ, scene.nodes, task.variants[0])
    young = scenes.TISSUES[scene.organ].young
    stiff = task.factor * young
    lump = shapes.inclusion_young(vertices, triangles, place, task.radius, young, stiff)
    return {"inclusion": place, "young": lump}
