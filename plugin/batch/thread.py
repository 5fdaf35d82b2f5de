"""What a thread is in every batch: arrays of its nodes, and what holds it."""

from __future__ import annotations

import abc
from collections.abc import Mapping

import numpy as np
import warp as wp
from palpate.engine import rods
from palpate.thread import no_hold


class Thread(abc.ABC):
  """One thread in all worlds of a batch; arrays as those of `Batch`, in world coordinates.

  Attributes:
    name: name of the flexcomp
    nworld: number of worlds
    holds: equalities by which bodies can hold it, numbers by name
    space: its workspace in one mjData
  """

  name: str
  nworld: int
  holds: Mapping[str, int]
  space: rods.Workspace

  @property
  @abc.abstractmethod
  def xpos(self) -> wp.array:
    """Positions of the nodes [m], (nworld, nnode, 3)."""

  @property
  @abc.abstractmethod
  def tension(self) -> wp.array:
    """Tension of each edge [N], (nworld, nnode - 1); negative where it is compressed."""

  @property
  @abc.abstractmethod
  def broken(self) -> wp.array:
    """1 where an edge has broken, of float64 (nworld, nnode); the last one is of no edge."""

  @abc.abstractmethod
  def lay(self, places: np.ndarray, mask=None):
    """Puts the nodes of worlds at positions, at rest; twist and breaks stay.

    Args:
      places: [m]  (nworld, nnode, 3)
      mask: worlds, (nworld,) of bool; None for all
    """

  def hold(self, by: str, node, anchor, firm):
    """Lets a body hold a node in each world, or release it, see `palpate.Thread.hold`.

    Resets and states release all.

    Args:
      by: name of the equality
      node: number of the node to hold, -1 releases  (nworld,)
      anchor: point of the body that holds it [m]  (nworld, 3)
      firm: whether the equality carries force  (nworld,) of bool

    Raises:
      ValueError: the scene has no such equality, or an array has a wrong shape.
    """
    if by not in self.holds:
      raise no_hold(self.name, by, self.holds)
    nworld = self.nworld
    given = {"node": (node, (nworld,)), "anchor": (anchor, (nworld, 3)), "firm": (firm, (nworld,))}
    for name, (value, shape) in given.items():
      if tuple(np.shape(value)) != shape:
        raise ValueError(
          f"thread {self.name!r}: {name} has shape {tuple(np.shape(value))}, expected {shape}"
        )
    self._hold(by, node, anchor, firm)

  @abc.abstractmethod
  def _hold(self, by: str, node, anchor, firm):
    """Lets a body hold a node."""
