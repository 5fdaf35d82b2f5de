"""What a mesh consists of: bodies apart from each other, and surfaces inside of them.

Bodies that cross are one body. Triangles of surfaces that are not closed belong together, as a
surface in patches.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from . import raster
from .quality import volume

Mesh = tuple[np.ndarray, np.ndarray]

_CELLS = 160  # of the grid, along the diagonal
_CROSSING = 0.01  # of the smaller one's points; with less two surfaces only touch


@dataclasses.dataclass
class Part:
  """A body of a mesh.

  Attributes:
    mesh: its outer surface
    volume: enclosed by that [m^3]
    within: the surfaces inside of it
  """

  mesh: Mesh
  volume: float
  within: list[Part] = dataclasses.field(default_factory=list)

  @property
  def middle(self) -> np.ndarray:
    """The middle of its box [m]  (3,)."""
    points = self.mesh[0]
    return (points.min(axis=0) + points.max(axis=0)) / 2

  @property
  def extent(self) -> float:
    """The diagonal of its box [m]."""
    return float(np.linalg.norm(np.ptp(self.mesh[0], axis=0)))


def split(vertices: np.ndarray, triangles: np.ndarray) -> list[Part]:
  """Returns the bodies of a mesh, the largest first."""
  pieces = _pieces(len(vertices), triangles)
  spacing = float(np.linalg.norm(np.ptp(vertices, axis=0))) / _CELLS
  grid = raster.Grid.around(vertices, spacing)
  bodies: list[_Body] = []
  for piece in sorted(pieces, key=lambda t: -float(np.prod(np.ptp(vertices[t].reshape(-1, 3), 0)))):
    _place(bodies, _Body(vertices, piece, grid))
  parts = [body.part(vertices, grid) for body in bodies]
  return sorted(parts, key=lambda part: -part.volume)


def _pieces(nodes: int, triangles: np.ndarray) -> list[np.ndarray]:
  """Returns the triangles of every closed piece, and of all others together."""
  tail, head = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
  graph = coo_array((np.ones(len(tail)), (tail, head)), shape=(nodes, nodes))
  label = connected_components(graph, directed=False)[1]
  key = np.minimum(tail, head).astype(np.int64) * nodes + np.maximum(tail, head)
  edge, count = np.unique(key, return_counts=True)
  is_open = np.zeros(label.max() + 1, dtype=bool)
  is_open[label[edge[count != 2] // nodes]] = True
  label = np.where(is_open[label], -1, label)[triangles[:, 0]]
  order = np.argsort(label, kind="stable")
  return np.split(triangles[order], np.flatnonzero(np.diff(label[order])) + 1)


class _Body:
  """Pieces that cross each other, and where they are on a grid.

  Attributes:
    pieces: their triangles
    corner: the grid's points nearest to the vertices of the first  (n, 3)
    low: where the box that holds them starts                       (3,)
    filled: which points of that box lie inside
    within: bodies inside of them
  """

  def __init__(self, vertices: np.ndarray, triangles: np.ndarray, grid: raster.Grid):
    self.pieces, self.within = [triangles], []
    self.corner = np.stack(grid.index(vertices[np.unique(triangles)]), axis=1)
    self.low = np.maximum(self.corner.min(axis=0) - 1, 0)
    high = np.minimum(self.corner.max(axis=0) + 2, grid.shape)
    box = raster.Grid(grid.place(self.low), grid.spacing, tuple(high - self.low))
    self.filled = raster.inside((vertices, triangles), box)

  def part(self, vertices: np.ndarray, grid: raster.Grid) -> Part:
    """Returns what others see of it."""
    triangles = np.concatenate(self.pieces)
    used, number = np.unique(triangles, return_inverse=True)
    mesh = vertices[used], number.reshape(-1, 3)
    exact = len(self.pieces) == 1 and raster.closed(triangles)
    size = abs(volume(*mesh)) if exact else float(self.filled.sum()) * grid.spacing**3
    return Part(mesh, size, [body.part(vertices, grid) for body in self.within])

  def holds(self, corner: np.ndarray) -> np.ndarray:
    """Returns which of the grid's points (n, 3) lie inside."""
    at = corner - self.low
    known = ((at >= 0) & (at < self.filled.shape)).all(axis=1)
    return known & self.filled[tuple(np.where(known[:, None], at, 0).T)]

  def shares(self, other: _Body) -> int:
    """Returns how many points lie inside of both."""
    return int(self.holds(np.argwhere(other.filled) + other.low).sum())

  def take(self, other: _Body) -> None:
    """Makes one body of two."""
    low = np.minimum(self.low, other.low)
    high = np.maximum(self.low + self.filled.shape, other.low + other.filled.shape)
    filled = np.zeros(high - low, dtype=bool)
    for one in (self, other):
      start = one.low - low
      filled[tuple(map(slice, start, start + one.filled.shape))] |= one.filled
    self.low, self.filled = low, filled
    self.pieces += other.pieces
    self.within += other.within


def _place(bodies: list[_Body], new: _Body) -> None:
  """Puts a piece that is smaller than all before it with those that it crosses or is inside of."""
  patches = not raster.closed(new.pieces[0])
  crossed = []
  for body in bodies:
    held = body.holds(new.corner)
    if held.all():
      body.within.append(new)
      return
    if body.shares(new) > _CROSSING * new.filled.sum() or (patches and held.any()):
      crossed.append(body)
  for body in crossed:
    bodies.remove(body)
    new.take(body)
  bodies.append(new)
