"""Places of a surface that are nearest to points, and how far points are from a path."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import functools

import numpy as np
import warp as wp
from scipy.spatial import KDTree

from .kernels import kernel
from .mesh import Mesh, lengths
from .stop import Stops
from .surface import WorkingCopy
from .types import CONSTANTS, doubles, ints, longs, struct

_BOX = 3.0  # edges from points within which a solid's triangles are looked at first
_AROUND = 12  # triangles around a point of a solid's skin among which the nearest is


@struct
class Nearest:
  """A surface, and what is asked of it; see `nearest`."""

  nvert: int
  most: int  # neighbours that a vertex has room for
  nouter: int
  npoint: int
  edge: wp.float64  # mean length of its edges [m]
  elem: longs("nelem", 3)
  spoke: longs("nvert", "most")  # `Mesh.ring_elem`
  degree: longs("nvert")
  x: doubles("nvert", 3)  # where the vertices are [m]
  point: doubles("npoint", 3)
  box: ints("nvert")  # scratch
  spot: doubles("npoint", 5)  # triangle, weights of its corners, distance [m]


_nearest = kernel("find_nearest", "cut.h", Nearest, CONSTANTS)


class Finder:
  """Finds the points of surfaces of one whole that are nearest to points, one after the other.

  Args:
    copy: where the surfaces are
  """

  def __init__(self, copy: WorkingCopy):
    self._copy, whole, there = copy, copy.whole, copy.fields
    self._fields = fields = Nearest()
    fields.nvert, fields.most, fields.edge = whole.nvert, copy.sizes["most"], whole.edge_length
    fields.elem, fields.spoke, fields.degree = there.elem[0], there.spoke[0], there.degree[0]
    self._x, self._box = np.zeros((whole.nvert, 3)), np.zeros(whole.nvert, np.int32)
    fields.x, fields.box = _wrap(self._x), _wrap(self._box)
    self._launch = _nearest.command(fields).launch
    self._make_room(16)

  def _make_room(self, count: int):
    self._point, self._spot = np.zeros((count, 3)), np.zeros((count, 5))
    self._fields.point, self._fields.spot = _wrap(self._point), _wrap(self._spot)

  def nearest(
    self, mesh: Mesh, position: np.ndarray, points: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the points of the surface nearest to points.

    Args:
      mesh: the surface
      position: where its vertices are [m]  (nvert, 3)
      points: some points [m]               (n, 3)

    Returns:
      triangles (n,), weights of their corners (n, 3), distances [m] (n,)
    """
    if len(mesh.tet):
      return nearest(mesh, position, points)
    n = len(points)
    if n > len(self._point):
      self._make_room(2 * n)
    self._copy.put(mesh)
    self._x[:], self._point[:n] = position, points
    self._fields.npoint, self._fields.nouter = n, mesh.nouter
    self._launch()
    spot = self._spot[:n].copy()
    return spot[:, 0].astype(int), spot[:, 1:4], spot[:, 4]

  @functools.cached_property
  def stops(self) -> Stops:
    """What finds where paths end that come apart."""
    return Stops(self._copy)


def _wrap(array: np.ndarray) -> wp.array:
  return wp.array(array, device="cpu", copy=False)


def nearest(
  mesh: Mesh, position: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns what `Finder.nearest` does, once."""
  if len(mesh.tet):
    return _nearest_of(position, mesh.elem[: mesh.whole.nelem], points, mesh.whole.edge_length)
  return Finder(WorkingCopy(mesh)).nearest(mesh, position, points)


def _nearest_of(position: np.ndarray, elem: np.ndarray, points: np.ndarray, edge: float):
  """Returns what `nearest` does of given triangles; `edge`: their edges' mean length [m]."""
  low, high = points.min(axis=0) - _BOX * edge, points.max(axis=0) + _BOX * edge
  corner = position[elem]
  middle = corner.mean(axis=1)
  box = np.flatnonzero(((middle >= low) & (middle <= high)).all(axis=1))
  box = box if len(box) >= _AROUND else np.arange(len(elem))
  near = KDTree(middle[box]).query(points, k=min(_AROUND, len(box)))[1]
  near = box[near.reshape(len(points), -1)]
  a, b, c = np.moveaxis(corner[near], 2, 0)
  weight, far = closest(points[:, None], a, b, c)
  best, row = np.argmin(far, axis=1), np.arange(len(points))
  return near[row, best], weight[row, best], far[row, best]


def closest(p, a, b, c) -> tuple[np.ndarray, np.ndarray]:
  """Returns weights of the point of triangles that is nearest to points, and its distance."""
  ab, ac, ap = b - a, c - a, p - a

  def dot(x, y):
    return np.einsum("...i,...i->...", x, y)

  d11, d12, d22, e1, e2 = dot(ab, ab), dot(ab, ac), dot(ac, ac), dot(ap, ab), dot(ap, ac)
  square, bc2 = dot(ap, ap), np.maximum(d11 - 2 * d12 + d22, 1e-300)
  det = np.maximum(d11 * d22 - d12 * d12, 1e-300)
  v, w = (d22 * e1 - d12 * e2) / det, (d11 * e2 - d12 * e1) / det
  on_ab = np.clip(e1 / np.maximum(d11, 1e-300), 0, 1)
  on_ac = np.clip(e2 / np.maximum(d22, 1e-300), 0, 1)
  on_bc = np.clip((e2 - e1 - d12 + d11) / bc2, 0, 1)
  none = np.zeros_like(v)
  v = np.stack([v, on_ab, none, 1 - on_bc])
  w = np.stack([w, none, on_ac, on_bc])
  u = np.stack([1 - v[0] - w[0], 1 - on_ab, 1 - on_ac, none])
  gap2 = square - 2 * (v * e1 + w * e2) + v * v * d11 + 2 * v * w * d12 + w * w * d22
  outside = (u[0] < 0) | (v[0] < 0) | (w[0] < 0)
  gap2[0, outside] = np.inf
  best = np.argmin(gap2, axis=0)[None]
  weight = np.stack([np.take_along_axis(x, best, 0)[0] for x in (u, v, w)], axis=-1)
  return weight, np.sqrt(np.maximum(np.take_along_axis(gap2, best, 0)[0], 0.0))


def distance(line: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the distances of points from a polyline [m], (n,), and its points there, (n, 3)."""
  a, way = line[:-1], np.diff(line, axis=0)
  arm = points[:, None] - a
  share = (arm * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-300)
  at = a + np.clip(share, 0, 1)[..., None] * way
  far = lengths(points[:, None] - at)
  best, row = np.argmin(far, axis=1), np.arange(len(points))
  return far[row, best], at[row, best]


def check_points(organ: str, points: np.ndarray):
  """Raises ValueError where points of a cut are no path of two finite places or more."""
  if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
    raise ValueError(
      f"organ {organ!r}: points of a cut have shape {points.shape}, expected (n, 3), n >= 2"
    )
  if not np.isfinite(points).all():
    bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
    raise ValueError(f"organ {organ!r}: point {bad} is {points[bad]}, expected finite numbers")
