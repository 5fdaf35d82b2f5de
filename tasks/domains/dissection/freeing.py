"""What `dissect` and `tease` share: bonds that come free as they should, or are torn."""

import math

import numpy as np

from ...core import rules as r
from ...core.base import Physics, Task
from ...core.scenes import FILM, RAW, films

SEEN = 1e-5  # what rounding may take from a share, in float32 too


class Freed:
  """State of bonds that are to come free."""

  wanted: float  # share of their area that must come free as it should
  limit: float  # of the pull on what the organ is bonded to [N]
  force_limit: float  # [N]
  clean: float  # share that came free with force and pull under their limits
  torn: float  # share that came free otherwise
  freed: float  # both
  traction: float  # pull on what the organ is bonded to [N]
  pulled: float  # the largest so far [N]


METRICS = {"share_freed": "clean", "peak_traction": "pulled"}
COLUMNS = {"freed": "clean", "traction": "traction"}


# The rules.


def ruined(o):
  """Returns whether so much is torn that too little is left, or the pull tears what is under it."""
  return o.torn > 1.0 - o.wanted + SEEN or o.traction > 2.0 * o.limit


def count(s, o, fair):
  """Counts what came free, as torn where it was not fair; returns too what outcome that makes."""
  o.traction = r.traction(s)
  o.pulled = max(o.pulled, o.traction)
  now = r.share_freed(s)
  more = now - o.freed
  o.freed = now
  if fair and r.peak(s) <= o.force_limit and o.traction <= o.limit:
    o.clean = o.clean + more
  elif more > 0.0:
    o.torn = o.torn + more
    r.tear(s, o, more)
  outcome = r.RUNNING
  if o.clean >= o.wanted - SEEN:
    outcome = r.SUCCESS
  elif ruined(o):
    outcome = r.DAMAGED
  return o, outcome


def earned(o, near, outcome):
  """Returns the progress, of closeness to where the work begins and of what is clean."""
  if outcome == r.DAMAGED:
    return -1.0
  if outcome == r.SUCCESS:
    return 1.0
  return 0.1 * near + 0.8 * min(o.clean / o.wanted, 1.0)


def held(s) -> np.ndarray:
  """Returns where the bonds that hold are, or all where none does [m]  (n, 3)."""
  holds = ~s.organ.bonds.free
  return s.organ.bonds.positions[holds if holds.any() else slice(None)]


def holding(s):
  """Returns how many bonds hold."""
  found = int(0)
  for k in range(r.bonds(s)):
    if not r.is_free(s, k):
      found += 1
  return found


class Freeing(Task):
  """An exercise on an organ with bonds, of a state that is `Freed`."""

  wanted: float
  limit: float

  def __init__(self, *, wanted: float, traction: float, **kwargs):
    """Makes the task.

    Args:
      wanted: share of their area that must come free as it should [-]
      traction: limit of the pull on what the organ is bonded to [N]
      **kwargs: see Task
    """
    if not 0 < wanted <= 1:
      raise ValueError(f"wanted is {wanted}, expected a share in (0, 1]")
    if not 0 < traction < math.inf:
      raise ValueError(f"traction is {traction}, expected a number > 0 [N]")
    self.wanted, self.limit = wanted, traction
    super().__init__(**kwargs)

  def whole(self, physics: Physics) -> None:
    """Begins with bonds that are whole."""
    self.clean, self.torn, self.traction, self.pulled = 0.0, 0.0, 0.0, 0.0
    self.freed = r.share_freed(physics)
    self._films = films(physics.model.ptr, physics.organ.bonds.vertices)[1]

  def show(self, physics: Physics) -> None:
    """Shows the film of bonds that hold, and the raw bed where they did."""
    super().show(physics)
    if len(self._films):
      free = physics.organ.bonds.free[:, None]
      physics.model.site_rgba[self._films] = np.where(free, RAW, FILM)

  def harsh(self, physics: Physics) -> bool:
    """Returns whether a force is over its limit, or the pull."""
    return super().harsh(physics) or self.traction > self.limit

  def label(self, kind: str) -> str:
    """Returns what damage is."""
    if kind != "damage":
      return super().label(kind)
    if self.torn > 1.0 - self.wanted + SEEN:
      return f"torn off: {100 * self.torn:.0f} %"
    return f"torn by a pull of {self.traction:.2f} N"
