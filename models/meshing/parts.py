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
  """Returns the bodies of a mesh, the largest first.

  Every point of a grid has the number of the body that fills it, so that a piece is compared with
  those that are where it is, and not with all others.
  """
  spacing = float(np.linalg.norm(np.ptp(vertices, axis=0))) / _CELLS
  grid = raster.Grid.around(vertices, spacing)
  owner = np.full(grid.shape, -1)
  groups: dict[int, list[np.ndarray]] = {}  # pieces that cross each other, by number
  within: dict[int, list[Part]] = {}
  pieces = _pieces(len(vertices), triangles)
  pieces.sort(key=lambda t: -float(np.prod(np.ptp(vertices[t].reshape(-1, 3), axis=0))))
  for number, piece in enumerate(pieces):
    corner = grid.index(vertices[np.unique(piece)])
    low = np.array([max(k.min() - 1, 0) for k in corner])
    box = tuple(slice(k, int(c.max()) + 2) for k, c in zip(low, corner, strict=True))
    here = owner[box]
    filled = raster.inside((vertices, piece), raster.Grid(grid.place(low), spacing, here.shape))
    held = owner[corner]
    if held[0] >= 0 and (held == held[0]).all():
      within[held[0]].append(_part(vertices, [piece], float(filled.sum()) * spacing**3, []))
      continue
    crossed, count = np.unique(here[filled], return_counts=True)
    crossed = crossed[count > _CROSSING * filled.sum()]
    if not raster.closed(piece):
      crossed = np.union1d(crossed, held)
    groups[number], within[number] = [piece], []
    here[filled & (here < 0)] = number
    for k in crossed[crossed >= 0]:
      groups[number] += groups.pop(k)
      within[number] += within.pop(k)
      owner[owner == k] = number
  size = np.bincount(owner[owner >= 0], minlength=len(pieces)) * spacing**3
  parts = [_part(vertices, group, float(size[k]), within[k]) for k, group in groups.items()]
  return sorted(parts, key=lambda part: -part.volume)


def _part(vertices: np.ndarray, pieces: list[np.ndarray], size: float, within: list[Part]) -> Part:
  """Returns a body of pieces; `size` is its volume [m^3] unless they enclose one exactly."""
  triangles = np.concatenate(pieces)
  used, number = np.unique(triangles, return_inverse=True)
  mesh = vertices[used], number.reshape(-1, 3)
  exact = len(pieces) == 1 and raster.closed(triangles)
  return Part(mesh, abs(volume(*mesh)) if exact else size, within)


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
