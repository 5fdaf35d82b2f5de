"""What comes apart of an organ in the worlds of a batch, on any device."""

import abc
from typing import Any

import numpy as np
import warp as wp
from palpate.tissue.cutting.topology import Piece, Report

from .blades import Cutters


class Parting(abc.ABC):
  """Cuts of an organ, in each world its own."""

  name: str
  nvert: int
  batch: Any

  def cut(self, points, mask=None, depth=None, direction=None) -> list[Report | None]:
    """Cuts worlds along the path on the surface that is nearest to points, see `Organ.cut`.

    Args:
      points: the path in the world's axes [m], (n, 3) for all, or one a world
      mask: worlds to cut, (nworld,) of bool; None for all
      depth: of the cut in a solid [m], in all of them; see `Organ.cut`
      direction: in which that goes, in the world, or None

    Returns:
      what was done, one a world; None where it was not cut

    Raises:
      ValueError: the organ has no room for cuts, or a path cannot be cut; nothing is cut then.
    """
    batch, points = self.batch, _paths(self.name, points, self.batch.nworld)
    if not self._spare:
      raise ValueError(
        f"organ {self.name!r}: spare is 0, expected room for cuts: palpate.add_organ(..., spare=)"
      )
    worlds = np.flatnonzero(batch.checked(mask).numpy()).tolist()
    batch._fresh = False
    paths = {world: points[world] for world in worlds}
    return self._cut(paths, depth, direction) if paths else [None] * batch.nworld

  @property
  def cuts(self) -> list[list[Report]]:
    """What cuts did since worlds were reset, a list a world."""
    return [self._told("reports", world) for world in range(self.batch.nworld)]

  @property
  def pieces(self) -> list[list[Piece]]:
    """The parts that hang together, the heaviest first, a list a world."""
    return [self._told("pieces", world) for world in range(self.batch.nworld)]

  @property
  def piece_count(self) -> wp.array:
    """How many pieces there are, (nworld,)."""
    return self._piece_count()

  @property
  def cutters(self) -> Cutters:
    """What the geoms do that cut it."""
    return self._cutters()

  @property
  @abc.abstractmethod
  def _spare(self) -> int:
    """Vertices that wait for a cut."""

  @abc.abstractmethod
  def _cut(self, points: dict[int, np.ndarray], depth, direction) -> list[Report | None]:
    """Cuts worlds along paths, by world."""

  @abc.abstractmethod
  def _told(self, name: str, world: int) -> list:
    """Returns `reports` or `pieces` of a world."""

  @abc.abstractmethod
  def _piece_count(self) -> wp.array: ...

  @abc.abstractmethod
  def _cutters(self) -> Cutters: ...

  @abc.abstractmethod
  def elem_of(self, world: int) -> np.ndarray:
    """Returns the triangles of a world: those of `elem`, with the vertices that cuts have made."""


def _paths(name: str, points, nworld: int) -> list[np.ndarray]:
  """Returns a path a world."""
  given = points if isinstance(points, list | tuple) else np.asarray(points, float)
  same = isinstance(given, np.ndarray) and given.ndim == 2
  rows = [given] * nworld if same or np.ndim(given[0]) == 1 else list(given)
  if len(rows) != nworld:
    raise ValueError(
      f"organ {name!r}: points are of {len(rows)} worlds, expected (n, 3), or one a world, {nworld}"
    )
  paths = [np.asarray(row, float) for row in rows]
  for world, path in enumerate(paths):
    if path.ndim != 2 or path.shape[1] != 3 or len(path) < 2 or not np.isfinite(path).all():
      raise ValueError(
        f"organ {name!r}: points of world {world} have shape {path.shape}, expected (n, 3) of "
        "finite numbers, n >= 2"
      )
  return paths
