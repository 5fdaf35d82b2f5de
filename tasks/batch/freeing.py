"""What exercises on bonds share in arrays, see `tasks.freeing`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
from typing import Any

import numpy as np
import warp as wp
from palpate.tasks.domains import freeing
from palpate.tissue.types import doubles, floats, ints

from . import domain
from .fields import DAMAGED, RUNNING, SUCCESS, Common
from .kernels import node

_SEEN = wp.constant(wp.float64(freeing.SEEN))


class Freed:
  """State of an organ's bonds, of a domain's struct."""

  wanted: wp.float64  # share of their area that must come free as it should
  limit: float  # of the pull on what the organ is bonded to [N]
  vert: ints("nbond")  # vertex of each
  area: doubles("nbond")  # share of the area
  broken: floats("nworld", "nbond")  # damage of each
  pull: floats("nworld", "nbond", 3)  # force of each on the organ [N]
  clean: doubles("nworld")  # share that came free with force and pull under their limits
  torn: doubles("nworld")  # share that came free otherwise
  now: doubles("nworld")  # both
  freed: floats("nworld", 1)
  traction: floats("nworld", 1)  # [N]
  best: floats("nworld")  # what is clean, for the metrics
  pulled: floats("nworld")  # largest traction so far [N]


@wp.func
def share(o: Any, w: int):
  """Returns the share of the area that is free."""
  free = wp.float64(0.0)
  for k in range(o.area.shape[0]):
    if o.broken[w, k] >= 1.0:
      free += o.area[k]
  return free


@wp.func
def whole(o: Any, w: int):
  """Begins with bonds that are whole."""
  o.clean[w] = wp.float64(0.0)
  o.torn[w] = wp.float64(0.0)
  o.now[w] = share(o, w)
  o.freed[w, 0] = float(o.now[w])
  o.traction[w, 0] = 0.0
  o.best[w] = 0.0
  o.pulled[w] = 0.0


@wp.func
def count(s: Common, o: Any, w: int, fair: bool):
  """Counts what has come free, as torn where it was not fair; returns the outcome so far."""
  sum = wp.vec3()
  for k in range(o.area.shape[0]):
    sum += wp.vec3(o.pull[w, k, 0], o.pull[w, k, 1], o.pull[w, k, 2])
  traction = wp.length(sum)
  now = share(o, w)
  more = now - o.now[w]
  o.now[w] = now
  o.freed[w, 0] = float(now)
  o.traction[w, 0] = traction
  o.pulled[w] = wp.max(o.pulled[w], traction)
  if fair and s.peak_force[w, 0] <= s.force_limit and traction <= o.limit:
    o.clean[w] = o.clean[w] + more
  else:
    o.torn[w] = o.torn[w] + wp.max(more, wp.float64(0.0))
  o.best[w] = float(o.clean[w])
  outcome = int(RUNNING)
  if o.clean[w] >= o.wanted - _SEEN:
    outcome = SUCCESS
  elif o.torn[w] > wp.float64(1.0) - o.wanted + _SEEN or traction > 2.0 * o.limit:
    outcome = DAMAGED
  return outcome


@wp.func
def earned(o: Any, w: int, near: float, outcome: int):
  """Returns the progress, of closeness to where the work begins and of what is clean."""
  if outcome == DAMAGED:
    return -1.0
  return 0.1 * near + 0.8 * wp.min(float(o.clean[w] / o.wanted), 1.0)


@wp.func
def place(s: Common, o: Any, w: int, k: int):
  """Returns where a bond is [m]."""
  return node(s, w, o.vert[k])


@wp.func
def holding(o: Any, w: int):
  """Returns how many bonds hold."""
  many = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  for k in range(o.area.shape[0]):
    if o.broken[w, k] < 1.0:
      many += 1
  return many


@wp.func
def front(s: Common, o: Any, w: int):
  """Returns the middle of the bonds that hold, or of all where none does [m]."""
  many = holding(o, w)
  sum = wp.vec3()
  for k in range(o.area.shape[0]):
    if many == 0 or o.broken[w, k] < 1.0:
      sum += place(s, o, w, k)
  return sum / float(wp.where(many == 0, o.area.shape[0], many))


class Freeing(domain.Domain):
  """What the domains share."""

  takes = ("wanted", "limit")
  metrics = {"share_freed": "best", "peak_traction": "pulled"}  # noqa: RUF012

  @staticmethod
  def sizes(task: Any, physics):
    """Returns the named sizes of its arrays."""
    return {"nbond": len(physics.organ.bonds)}

  @staticmethod
  def constants(task: Any, physics) -> dict[str, Any]:
    """Returns what all worlds share."""
    bonds = physics.organ.bonds
    return {"vert": bonds.vertices, "area": bonds.area / bonds.area.sum()}

  @staticmethod
  def draw(task: Any, physics) -> dict[str, np.ndarray]:
    """Returns the rows of a world."""
    return {}

  @staticmethod
  def read(worlds: Any) -> None:
    """Brings the bonds up to date."""
    bonds = worlds.organ.bonds
    worlds.own.broken, worlds.own.pull = bonds.damage, bonds.force
