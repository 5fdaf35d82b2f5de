"""What organs of a batch have grown on to, in all worlds."""

from __future__ import annotations

import abc
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from palpate.forces import cohesive_bonds
from palpate.tissue.types import fill

from .base import on_device
from .kernels import HELD, BondLists, share_freed, show_bonds, weaken_bonds

if TYPE_CHECKING:
  from .organ.organ import Organ


class Bonds(abc.ABC):
  """The bonds of an organ in all worlds, those that the model declares; arrays as of `Batch`.

  A bond that a cut has divided has the damage of the part that holds best, and the mean stretch.

  Attributes:
    vertices: vertex of each, (n,)
    area: area that each stands for [m^2], (n,)
  """

  vertices: np.ndarray
  area: np.ndarray

  def __init__(self, nworld: int, device: Any):
    self._device, n = device, len(self.vertices)
    self._damage = wp.zeros((nworld, n), dtype=float, device=device)
    self._force, self._stretch = (
      wp.zeros((nworld, n, 3), dtype=float, device=device) for _ in range(2)
    )
    self._share = wp.zeros(nworld, dtype=float, device=device)
    self._each = wp.array(self.area, dtype=float, device=device)

  def __len__(self) -> int:
    return len(self.vertices)

  @property
  def damage(self) -> wp.array:
    """Of each: 0 while it is whole, 1 when it is free, (nworld, n)."""
    self._tell()
    return self._damage

  @property
  def force(self) -> wp.array:
    """Force of each on its vertex in the last step, in the world [N], (nworld, n, 3)."""
    self._tell()
    return self._force

  @property
  def stretch(self) -> wp.array:
    """How far each was from what it leads to as the last step began [m], (nworld, n, 3).

    It is 0 in a world that was reset, until that steps.
    """
    self._tell()
    return self._stretch

  @property
  def share_freed(self) -> wp.array:
    """Share of the area whose bonds have broken, (nworld,); 0 where there are none."""
    inputs = [self.damage, self._each, self._share]
    wp.launch(share_freed, dim=self._share.shape, inputs=inputs, device=self._device)
    return self._share

  def weaken(self, amount):
    """Adds damage, as a hook's current does; what a bond had stored of energy goes with it.

    Args:
      amount: what is added to the damage of each bond in each world, (nworld, n) >= 0
    """
    if tuple(np.shape(amount)) != self._damage.shape:
      raise ValueError(
        f"amount has shape {tuple(np.shape(amount))}, expected {self._damage.shape}, one a bond of "
        "each world"
      )
    self._weaken(on_device(amount, wp.float32, self._device))

  @abc.abstractmethod
  def _tell(self):
    """Brings damage, force and stretch up to date."""

  @abc.abstractmethod
  def _weaken(self, amount: wp.array):
    """Adds damage."""


class OfThreads(Bonds):
  """Bonds of worlds that are mjData of the plugin.

  Args:
    batch: the worlds
    handles: the organ in each
  """

  def __init__(self, batch, handles: list):
    self.batch, self._alone = batch, [handle.bonds for handle in handles]
    self.vertices, self.area = self._alone[0].vertices, self._alone[0].area
    super().__init__(len(handles), batch.device)

  def _tell(self):
    damage, force, stretch = self._damage.numpy(), self._force.numpy(), self._stretch.numpy()
    for world, alone in enumerate(self._alone):
      made, part = alone.made, np.where(alone.free, 1.0, np.minimum(alone.damage, HELD))
      damage[world], force[world], stretch[world] = 1.0, 0.0, 0.0
      np.minimum.at(damage[world], made, part.astype(np.float32))
      np.add.at(force[world], made, alone.force.astype(np.float32))
      share = (alone.area / self.area[made])[:, None]
      np.add.at(stretch[world], made, (share * alone.stretch).astype(np.float32))

  def _weaken(self, amount: wp.array):
    rows = amount.numpy().astype(float)
    for world in np.flatnonzero(rows.any(axis=1)):
      alone = self._alone[world]
      alone.weaken(rows[world][alone.made])


class Gathered(Bonds):
  """Bonds of worlds of several batches.

  Args:
    batch: the batch of batches
    parts: the bonds in each
  """

  def __init__(self, batch, parts: list[Bonds]):
    self.batch, self._parts = batch, parts
    self.vertices, self.area = parts[0].vertices, parts[0].area
    super().__init__(batch.nworld, batch.device)

  def _tell(self):
    self.batch.gather([part.damage for part in self._parts], self._damage)
    self.batch.gather([part.force for part in self._parts], self._force)
    self.batch.gather([part.stretch for part in self._parts], self._stretch)

  def _weaken(self, amount: wp.array):
    rows = amount.numpy()
    for at, part in zip(self.batch.slices, self._parts, strict=True):
      part.weaken(rows[at])


class Grown(Bonds):
  """Bonds of an organ of `Worlds`.

  Args:
    organ: the organ
  """

  def __init__(self, organ: Organ):
    groups, self.batch = organ.forces.of(cohesive_bonds.Bonds).groups, organ.batch
    made = [group.now for group in groups]
    self.vertices = np.concatenate([np.zeros(0, int), *(now["vert"] for now in made)])
    self.area = np.concatenate([np.zeros(0), *(now["area"] for now in made)])
    first = np.cumsum([0, *(len(now["vert"]) for now in made)])
    names = "row", "count", "made", "slot", "area", "state", "pull", "stretch"
    super().__init__(organ.batch.nworld, organ.batch.device)
    self._groups = []
    for group, k in zip(groups, first, strict=False):
      values = {name: getattr(group.fields, name) for name in names}
      self._groups.append(fill(BondLists, None, values | {"before": int(k), "whole": self._each}))

  def _over(self, what: Any, *values: wp.array):
    for lists in self._groups:
      dim = lists.pull.shape[:2]
      wp.launch(what, dim=dim, inputs=[lists, *values], device=self._device)

  def _tell(self):
    self._damage.fill_(1.0)
    self._force.zero_()
    self._stretch.zero_()
    self._over(show_bonds, self._damage, self._force, self._stretch)

  def _weaken(self, amount: wp.array):
    self._over(weaken_bonds, amount)
