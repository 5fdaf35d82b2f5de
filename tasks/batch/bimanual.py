"""Bimanual in arrays, see `tasks.bimanual`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# mujoco ships its bindings without type stubs:
# pyright: reportAttributeAccessIssue=false
from typing import Any

import mujoco as mj
import numpy as np
import warp as wp
from palpate.tasks.domains import bimanual
from palpate.tissue.types import floats

from . import dissect
from .dissect import Dissect, Seen, hold, show
from .fields import DAMAGED, RUNNING, Common, together, vectors
from .freeing import Freed, count, earned, front, place, whole
from .hold import Holding, start
from .kernels import judge, point, put, vector

_AWAY, _REACH = wp.constant(bimanual.AWAY), wp.constant(bimanual.REACH)
_RATE, _TOUCHING = wp.constant(bimanual.RATE), wp.constant(bimanual.TOUCHING)
_BURN = wp.constant(bimanual.BURN)


class Dividing:
  """What the domain has besides jaws and bonds."""

  toe: wp.vec3  # other end of the hook's wire, in the frame of its tip [m]
  rest: vectors  # the site's place at rest [m]
  away: vectors  # from the bed
  time: floats("nworld")  # how long the current has burnt what the hook touches [s]
  burning: floats("nworld", "nbond")  # what the current adds to the damage of each bond
  hook_front: floats("nworld", 3)
  retracted: floats("nworld", 1)
  burnt: floats("nworld", 1)


BimanualState = together("BimanualState", Holding, Freed, Seen, Dividing)


@wp.func
def far(s: Common, o: BimanualState, hook: Common, w: int, k: int):
  """Returns how far a bond is from the wire [m]; a free one is far away."""
  q = wp.quat(hook.tip_quat[w, 1], hook.tip_quat[w, 2], hook.tip_quat[w, 3], hook.tip_quat[w, 0])
  along = wp.quat_rotate(q, o.toe)
  offset = place(s, o, w, k) - vector(hook.tip_pos, w)
  share = wp.clamp(wp.dot(offset, along) / wp.length_sq(along), 0.0, 1.0)
  return wp.where(o.broken[w, k] >= 1.0, wp.inf, wp.length(offset - share * along))


@wp.func
def retracted(s: Common, o: BimanualState, w: int):
  """Returns how far the site is from its place at rest, away from the bed [m]."""
  return wp.dot(point(s, w, o.site[w]) - o.rest[w], o.away[w])


@wp.kernel(enable_backward=False)
def divide(s: Common, o: BimanualState, hook: Common):
  """Finds what the current does to bonds, or burns."""
  w = wp.tid()
  live = s.action[w, s.action.shape[1] - 1] > 0.0
  any = wp.bool(False)
  for k in range(o.area.shape[0]):
    near = live and far(s, o, hook, w, k) < _REACH
    any = any or near
    o.burning[w, k] = wp.where(near, _RATE * s.dt, 0.0)
  if live and not any and wp.length(vector(hook.contact_force, w)) > _TOUCHING:
    o.time[w] = o.time[w] + s.dt


@wp.kernel(enable_backward=False)
def begin(s: Common, o: BimanualState):
  """Begins episodes."""
  w = wp.tid()
  if s.begun[w]:
    start(s, o, w)
    whole(o, w)
    o.time[w] = 0.0
    o.rest[w] = point(s, w, o.site[w])
    o.away[w] = wp.normalize(o.rest[w] - front(s, o, w))


@wp.kernel(enable_backward=False)
def advance(s: Common, o: BimanualState):
  """Follows the grasp, what comes free, and what is burnt."""
  w = wp.tid()
  near = hold(s, o, w)
  outcome = count(s, o, w, o.grasped[w, 0] == 1.0 and retracted(s, o, w) > _AWAY)
  if o.time[w] > _BURN and outcome == RUNNING:
    outcome = DAMAGED
  judge(s, w, earned(o, w, near, outcome), outcome)


@wp.kernel(enable_backward=False)
def observe(s: Common, o: BimanualState, hook: Common, beginning: bool):
  """Writes target, front, hook_front, retracted and burnt."""
  w = wp.tid()
  if beginning and not s.begun[w]:
    return
  show(s, o, w)
  nearest = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  least = wp.float32(wp.inf)
  for k in range(o.area.shape[0]):
    distance = far(s, o, hook, w, k)
    if distance < least:
      least = distance
      nearest = k
  put(o.hook_front, w, place(s, o, w, nearest) - vector(hook.tip_pos, w))
  o.retracted[w, 0] = retracted(s, o, w) / _AWAY
  o.burnt[w, 0] = wp.min(o.time[w] / _BURN, 1.0)


class Bimanual(Dissect):
  """The domain."""

  struct = BimanualState
  begin, advance, observe = begin, advance, observe
  takes = dissect.Dissect.takes

  @staticmethod
  def constants(task: Any, physics):
    """Returns what all worlds share."""
    model, data, hook = physics.model.ptr, physics.data.ptr, physics.second
    heel, toe = (data.site_xpos[model.site(hook.prefix + name).id] for name in ("tip", "toe"))
    local, back = np.zeros(3), np.zeros(4)
    mj.mju_negQuat(back, hook.tip_quat())
    mj.mju_rotVecQuat(local, toe - heel, back)
    return Dissect.constants(task, physics) | {"toe": wp.vec3(*local)}

  @staticmethod
  def act(worlds: Any) -> None:
    """Sends the current through the hook."""
    own = worlds.own
    worlds.launch(divide, worlds.nworld, [worlds.fields, own, worlds.other])
    worlds.organ.bonds.weaken(own.burning)
