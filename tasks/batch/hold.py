"""What exercises with jaws share in arrays, see `tasks.grasp.Hold`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import numpy as np
import warp as wp
from palpate.tasks import instrument
from palpate.tasks.domains import grasp
from palpate.tissue.types import floats, ints

from . import domain
from .fields import Common, flags, vectors
from .kernels import error, point, reach, vector

_CLOSING, _GRIPPING = wp.constant(instrument.CLOSING), wp.constant(instrument.GRIPPING)
_FOLD, _FORCE = wp.constant(instrument.FOLD), wp.constant(instrument.HELD_FORCE)
_REACH = wp.constant(grasp.REACH)


class Holding:
  """State of jaws that hold a site, of a domain's struct."""

  slip: float  # [m]
  site: ints("nworld")  # triangle to grasp
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
  return wp.min(s.inner[w, 0], s.inner[w, 1]) > _FORCE and s.gripper[w, 0] > _FOLD


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


class Hold(domain.Domain):
  """What the domains share."""

  @staticmethod
  def draw(task: Any, physics) -> dict[str, Any]:
    """Returns the rows of a world."""
    return {"site": np.array(task.site)}
