"""What `dissect` and `tease` share: bonds that come free as they should, or are torn."""

import math

import numpy as np

from ..base import Physics, Task
from ..scenes import Scene

SEEN = 1e-6  # what rounding may take from a share


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

  def __init__(self, scene: Scene, random=None, *, wanted: float, traction: float, **kwargs):
    """Makes the task.

    Args:
      scene: what it plays in, with bonds
      random: see Task
      wanted: share of their area that must come free as it should [-]
      traction: limit of the pull on what the organ is bonded to [N]
      **kwargs: see Task
    """
    if not 0 < wanted <= 1:
      raise ValueError(f"wanted is {wanted}, expected a share in (0, 1]")
    if not 0 < traction < math.inf:
      raise ValueError(f"traction is {traction}, expected a number > 0 [N]")
    self.wanted, self.limit = wanted, traction
    super().__init__(scene, random, **kwargs)

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
    if self.clean >= self.wanted - SEEN:
      self.outcome = "success"
    elif self.torn > 1.0 - self.wanted + SEEN:
      self.harm_done(physics, f"torn off: {100 * self.torn:.0f} %")
    elif self.traction > 2 * self.limit:
      self.harm_done(physics, f"torn by a pull of {self.traction:.2f} N")

  def harm_done(self, physics: Physics, what: str) -> None:
    """Ends the episode with damage, and says by what."""
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
