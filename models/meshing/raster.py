"""Which points of a grid lie inside a surface, counted by rays along the three axes.

A ray that enters a surface that is wound outward counts one up, and one down where it leaves: a
point's winding number is 1 inside, 0 outside and in a cavity, 2 where two bodies overlap. Three
rays vote, so that a crack hurts one of them at most.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy

Mesh = tuple[np.ndarray, np.ndarray]

# Rays pass beside the grid's points by so much of its spacing: no ray meets an edge or a node.
_BESIDE = np.array([3.1e-4, 1.7e-4, 2.3e-4])
_MARGIN = 2  # points around what is asked for


@dataclasses.dataclass(frozen=True)
class Grid:
  """Points in rows.

  Attributes:
    origin: the first point [m]        (3,)
    spacing: between points [m]
    shape: how many along x, y and z
  """

  origin: np.ndarray
  spacing: float
  shape: tuple[int, int, int]

  @staticmethod
  def around(points: np.ndarray, spacing: float) -> Grid:
    """Returns a grid that holds the points (n, 3)."""
    low, high = points.min(axis=0), points.max(axis=0)
    count = np.ceil((high - low) / spacing).astype(int) + 1 + 2 * _MARGIN
    return Grid(low - _MARGIN * spacing, spacing, tuple(count))

  def index(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Returns the indices of the grid's points nearest to points (n, 3), which it clips."""
    cell = np.round((points - self.origin) / self.spacing).astype(int)
    return tuple(np.clip(cell, 0, np.array(self.shape) - 1).T)

  def place(self, index: np.ndarray) -> np.ndarray:
    """Returns the points [m] with indices (n, 3)."""
    return self.origin + self.spacing * np.asarray(index)


def depth(mask: np.ndarray, spacing: float | np.ndarray = 1.0) -> np.ndarray:
  """Returns the distance of every true point of a grid to the nearest false one."""
  return np.asarray(scipy.ndimage.distance_transform_edt(mask, np.broadcast_to(spacing, 3)))


def parts(mask: np.ndarray) -> tuple[np.ndarray, int]:
  """Returns the connected part, from 1, that every true point of a grid is in, and their count."""
  return scipy.ndimage.label(mask)  # pyright: ignore


def closed(triangles: np.ndarray) -> bool:
  """Returns whether every edge has two triangles, run through in opposite directions."""
  n = int(triangles.max(initial=0)) + 1
  tail, head = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
  one, other = tail.astype(np.int64) * n + head, head.astype(np.int64) * n + tail
  return bool(np.array_equal(np.sort(one), np.sort(other)))


def inside(mesh: Mesh, grid: Grid) -> np.ndarray:
  """Returns which points of a grid lie inside a surface, whatever its winding, (nx, ny, nz)."""
  if closed(mesh[1]):
    return winding(mesh, grid) != 0
  odd = [_count(mesh, grid, axis, np.ones(len(mesh[1]), np.int32)) % 2 for axis in range(3)]
  return np.sum(odd, axis=0) >= 2


def winding(mesh: Mesh, grid: Grid) -> np.ndarray:
  """Returns the winding number at the points of a grid, (nx, ny, nz)."""
  a, b, c = (mesh[0][mesh[1][:, k]] for k in range(3))
  normal = np.cross(b - a, c - a)
  votes = [_count(mesh, grid, axis, -np.sign(normal[:, axis])) for axis in range(3)]
  low, high = np.minimum(votes[0], votes[1]), np.maximum(votes[0], votes[1])
  return np.maximum(low, np.minimum(high, votes[2]))  # the middle one


def _count(mesh: Mesh, grid: Grid, axis: int, weight: np.ndarray) -> np.ndarray:
  """Returns the sum of weights of the triangles below every point along an axis."""
  turn = [(axis + 1) % 3, (axis + 2) % 3, axis]
  beside = grid.origin + _BESIDE * grid.spacing
  points = ((mesh[0] - beside) / grid.spacing)[:, turn]
  nu, nv, nw = (grid.shape[k] for k in turn)
  owner, u, v = _columns(points[:, :2][mesh[1]], (nu, nv))
  a, b, c = (points[mesh[1][owner, k]] for k in range(3))
  at = np.stack([u, v], axis=1)
  share = np.stack([_side(q, r, at) for q, r in ((b, c), (c, a), (a, b))], axis=1)
  twice = share.sum(axis=1)
  hit = ((share > 0).all(axis=1) | (share < 0).all(axis=1)) & (twice != 0)
  share = share[hit] / twice[hit, None]
  height = sum(share[:, k] * p[hit, 2] for k, p in enumerate((a, b, c)))
  above = np.clip(np.ceil(height), 0, nw).astype(int)
  total = np.zeros((nu, nv, nw + 1), np.int32)
  np.add.at(total, (u[hit], v[hit], above), weight[owner[hit]].astype(np.int32))
  return np.moveaxis(np.cumsum(total, axis=2)[:, :, :nw], (0, 1, 2), turn)


def _side(q: np.ndarray, r: np.ndarray, at: np.ndarray) -> np.ndarray:
  """Returns twice the area of the triangles q, r, at in the plane across the ray."""
  return (q[:, 0] - at[:, 0]) * (r[:, 1] - at[:, 1]) - (q[:, 1] - at[:, 1]) * (r[:, 0] - at[:, 0])


def _columns(corner: np.ndarray, count: tuple[int, int]) -> tuple[np.ndarray, ...]:
  """Returns triangle and column of every ray through a box around a triangle.

  Args:
    corner: the triangles across the rays, in spacings  (m, 3, 2)
    count: of rays along both directions
  """
  most = np.array(count) - 1
  low = np.clip(np.ceil(corner.min(axis=1)), 0, most + 1).astype(int)
  high = np.clip(np.floor(corner.max(axis=1)), -1, most).astype(int)
  size = np.maximum(high - low + 1, 0)
  number = size.prod(axis=1)
  owner = np.repeat(np.arange(len(corner)), number)
  rank = np.arange(len(owner)) - np.repeat(np.cumsum(number) - number, number)
  return owner, low[owner, 0] + rank // size[owner, 1], low[owner, 1] + rank % size[owner, 1]
