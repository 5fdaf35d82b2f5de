"""What `dissect` and `tease` share: bonds that come free as they should, or are torn."""

import numpy as np

from .base import Physics, Task

_SEEN = 1e-6  # what rounding may take from a share


class Freeing(Task):
  """An exercise on an organ with bonds.

  Attributes:
    wanted: share of their area that must come free as it should [-]
    limit: of the pull on what the organ is bonded to [N]
    clean: share that came free so far with force and pull under their limits [-]
    torn: share that came free otherwise [-]
    freed: both [-]
    traction: pull on what the organ is bonded to [N]
  """

  wanted: float
  limit: float

  def whole(self, physics: Physics) -> None:
    """Begins with bonds that are whole."""
    self.clean, self.torn, self.traction = 0.0, 0.0, 0.0
    self.freed = physics.organ.bonds.share_freed

  def count(self, physics: Physics, fair: bool = True) -> None:
    """Counts what has come free, as torn where it was not fair, and ends the episode by it."""
    bonds = physics.organ.bonds
    self.traction = float(np.linalg.norm(bonds.force.sum(axis=0)))
    now = bonds.share_freed
    more, self.freed = now - self.freed, now
    if fair and physics.peak_force <= self.force_limit and self.traction <= self.limit:
      self.clean += more
    elif more > 0:
      self.torn += more
      self.event(physics, "slip", more, "torn")
    if self.clean >= self.wanted - _SEEN:
      self.outcome = "success"
    elif self.torn > 1.0 - self.wanted + _SEEN:
      self._harm(physics, f"torn off: {100 * self.torn:.0f} %")
    elif self.traction > 2 * self.limit:
      self._harm(physics, f"torn by a pull of {self.traction:.2f} N")

  def _harm(self, physics: Physics, what: str) -> None:
    self.outcome = "damage"
    self.event(physics, "note", label=what)

  def earned(self, near: float) -> float:
    """Returns the progress, of closeness to where the work begins and of what is clean."""
    if self.outcome == "damage":
      return -1.0
    share = min(self.clean / self.wanted, 1.0)
    return 1.0 if self.outcome == "success" else 0.1 * near + 0.8 * share

  def front(self, physics: Physics) -> np.ndarray:
    """Returns the middle of the bonds that hold, or of all where none does [m]  (3,)."""
    bonds = physics.organ.bonds
    where, holds = bonds.positions, ~bonds.free
    return where[holds if holds.any() else slice(None)].mean(axis=0)

  def recorded(self, physics: Physics) -> dict[str, float]:
    """Returns the share that is clean and the pull."""
    return dict(super().recorded(physics)) | {"freed": self.clean, "traction": self.traction}
