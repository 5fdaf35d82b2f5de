"""What exercises with jaws share in arrays, see `tasks.grasp.Hold`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import numpy as np
import warp as wp
from palpate.batch.threads import Threads
from palpate.tasks import instrument, jaws
from palpate.tasks.domains import grasp
from palpate.tissue.types import Array, floats, ints, struct

from . import domain
from .fields import Common, flags, vectors
from .kernels import error, point, reach, vector

_CLOSING, _GRIPPING = wp.constant(instrument.CLOSING), wp.constant(instrument.GRIPPING)
_FOLD, _FORCE = wp.constant(instrument.FOLD), wp.constant(instrument.HELD_FORCE)
_REACH, _FACING = wp.constant(grasp.REACH), wp.constant(jaws.FACING)


class Holding:
  """State of jaws that hold a site, of a domain's struct."""

  slip: float  # [m]
  side: floats("nside")  # of a geom, see `Jaws`
  site: ints("nworld")  # triangle to grasp
  inner: floats("nworld", 2)  # force of the jaws' inner faces [N]
  closing: flags
  where: vectors  # the site in the frame of the tip, where it was grasped [m]
  distance0: floats("nworld")  # [m]
  target: floats("nworld", 3)
  grasped: floats("nworld", 1)


@wp.func
def distance(s: Common, o: Any, w: int):
  """Returns how far the tip is from the site [m]."""
  return wp.length(point(s, w, o.site[w]) - vector(s.tip_pos, w))


@wp.func
def holds(s: Common, o: Any, w: int):
  """Returns whether tissue is between the jaws, see `Physics.holds`."""
  return wp.min(o.inner[w, 0], o.inner[w, 1]) > _FORCE and s.gripper[w, 0] > _FOLD


@wp.func
def from_tip(s: Common, o: Any, w: int):
  """Returns the site in the frame of the tip [m]."""
  q = wp.quat(s.tip_quat[w, 1], s.tip_quat[w, 2], s.tip_quat[w, 3], s.tip_quat[w, 0])
  return wp.quat_rotate_inv(q, point(s, w, o.site[w]) - vector(s.tip_pos, w))


@wp.func
def follow(s: Common, o: Any, w: int):
  """Finds out whether the site is grasped; returns whether it was until now, and is no more."""
  before = o.grasped[w, 0] == 1.0
  closing = s.gripper[w, 1] < wp.min(s.gripper[w, 0] - _CLOSING, _GRIPPING)
  pressed = closing and holds(s, o, w)
  now = wp.bool(False)
  if before:
    now = pressed and wp.length(from_tip(s, o, w) - o.where[w]) < o.slip
  elif pressed and distance(s, o, w) < _REACH:
    now = True
    o.where[w] = from_tip(s, o, w)
    reach(s, w, distance(s, o, w))
    s.grasps[w] = s.grasps[w] + 1
  if closing and not o.closing[w] and distance(s, o, w) >= 2.0 * _REACH:
    error(s, w)
  if before and not now and closing:
    s.slips[w] = s.slips[w] + 1
  o.closing[w] = closing
  o.grasped[w, 0] = wp.where(now, 1.0, 0.0)
  return before and not now


@wp.func
def start(s: Common, o: Any, w: int):
  """Begins an episode."""
  o.grasped[w, 0] = 0.0
  o.closing[w] = False
  o.distance0[w] = distance(s, o, w)


@wp.func
def offset(s: Common, o: Any, w: int):
  """Returns the way from the tip to the site [m]."""
  return point(s, w, o.site[w]) - vector(s.tip_pos, w)


@struct
class Between:
  """What the jaws touch."""

  side: floats("nside")  # see `Holding`
  inner: floats("nworld", 2)
  left: Array(wp.mat33, ("nworld",))  # axes of the jaws
  right: Array(wp.mat33, ("nworld",))
  geom: ints("nworld", "ncontact")  # see `palpate.batch.Contacts`
  normal: floats("nworld", "ncontact", 3)
  force: floats("nworld", "ncontact")  # [N]


@wp.kernel(enable_backward=False)
def press(b: Between):
  """Adds up the force of the jaws' inner faces on the organ, see `Jaws.inner_force`."""
  w = wp.tid()
  both = wp.vec2(0.0, 0.0)
  for k in range(b.geom.shape[1]):
    g = b.geom[w, k]
    if g >= 0 and b.side[g] != 0.0:
      n = -wp.vec3(b.normal[w, k, 0], b.normal[w, k, 1], b.normal[w, k, 2])
      jaw = int(0)  # noqa: RUF046, UP018 - a variable to Warp
      axes = b.left[w]
      if b.side[g] < 0.0:
        jaw = 1
        axes = b.right[w]
      along = b.side[g] * (n[0] * axes[0, 0] + n[1] * axes[1, 0] + n[2] * axes[2, 0])
      if along > _FACING:
        both[jaw] = both[jaw] + b.force[w, k] * along
  b.inner[w, 0] = both[0]
  b.inner[w, 1] = both[1]


class Hold(domain.Domain):
  """What the domains share."""

  nodes = 24

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return {"nside": physics.model.ngeom + 1}

  @staticmethod
  def constants(task: Any, physics) -> dict[str, Any]:
    """Returns what all worlds share."""
    return {"side": jaws.Jaws(physics.model.ptr, task.prefix).side}

  @staticmethod
  def draw(task: Any, physics) -> dict[str, Any]:
    """Returns the rows of a world."""
    return {"site": np.array(task.site)}

  @staticmethod
  def sense(worlds: Any) -> None:
    """Measures what the jaws have between them."""
    batch, own = worlds.batch, worlds.own
    found = jaws.Jaws(batch.model, worlds.task.prefix)
    if not isinstance(batch, Threads):
      between: Any = Between()
      between.left, between.right = (batch.xmat(name) for name in found.names)
      between.geom, between.normal, between.force = worlds.organ.contacts
      between.side, between.inner = own.side, own.inner
      worlds.launch(press, worlds.nworld, [between])
      return
    inner = own.inner.numpy()

    def work(world: int):
      inner[world] = found.inner_force(batch.models[world], batch.datas[world])

    batch.each(work)
