"""Places of a surface that are nearest to points, and how far points are from a path."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import numpy as np
import numpy.typing as npt
import warp as wp

from ..geometry.mesh import Mesh, lengths
from ..kernels import aim, kernel
from ..types import CONSTANTS, doubles, ints, longs, struct
from .surface import WorkingCopy


@struct
class Nearest:
  """A surface, and what is asked of it; see `nearest`."""

  nvert: int
  nelem: int
  solid: int  # whether it is the skin of a solid, whose rings are others
  most: int  # neighbours that a vertex has room for
  nouter: int
  npoint: int
  edge: wp.float64  # mean length of its edges [m]
  elem: longs("nelem", 3)
  spoke: longs("nvert", "most")  # `Mesh.ring_elem`
  degree: longs("nvert")
  x: doubles("nvert", 3)  # where the vertices are [m]
  point: doubles("npoint", 3)
  box: ints("nvert + nelem")  # scratch
  rest: doubles("nvert", 3)  # of a solid [m]
  spot: doubles("npoint", 8)  # triangle, weights of its corners, distance [m], a solid's normal


_nearest = kernel("find_nearest", "cutting/cut.h", Nearest, CONSTANTS)


class Finder:
  """Finds the points of surfaces of one whole that are nearest to points, one after the other.

  Args:
    copy: where the surfaces are
  """

  def __init__(self, copy: WorkingCopy):
    self._copy, whole, there = copy, copy.whole, copy.fields
    self._elem, self._rest = whole.elem, whole.rest
    self._fields = fields = Nearest()
    fields.nvert, fields.nelem, fields.solid = whole.nvert, whole.nelem, int(len(whole.tet) > 0)
    fields.most, fields.edge = copy.sizes["most"], whole.edge_length
    fields.elem, fields.spoke, fields.degree = there.elem, there.spoke, there.degree
    self._x, self._box = np.zeros((whole.nvert, 3)), np.zeros(whole.nvert + whole.nelem, np.int32)
    fields.x, fields.box = _wrap(self._x), _wrap(self._box)
    self._launch = _nearest.command(fields).launch
    self._make_room(16)

  def _make_room(self, count: int):
    self._point, self._spot = np.zeros((count, 3)), np.zeros((count, 8))
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
    n = len(points)
    if n > len(self._point):
      self._make_room(2 * n)
    if self._fields.solid:
      self._elem, self._rest = mesh.elem, mesh.rest  # which native code reads
      aim(self._fields, elem=mesh.elem, rest=mesh.rest)
    else:
      self._copy.put(mesh)
    self._x[:], self._point[:n] = position, points
    self._fields.npoint, self._fields.nouter = n, mesh.nouter
    self._launch()
    spot = self._spot[:n].copy()
    return spot[:, 0].astype(int), spot[:, 1:4], spot[:, 4]

  def inward(self, mesh: Mesh, position: np.ndarray, points: np.ndarray) -> tuple:
    """Returns what `nearest` does of a solid, and the normals inward there at rest, (n, 3).

    These are even across edges: means by area around vertices.
    """
    return *self.nearest(mesh, position, points), -self._spot[: len(points), 5:]


def _wrap(array: np.ndarray) -> wp.array:
  return wp.array(array, device="cpu", copy=False)


def nearest(
  mesh: Mesh, position: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns what `Finder.nearest` does, once."""
  return Finder(WorkingCopy(mesh)).nearest(mesh, position, points)


def distance(line: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the distances of points from a polyline [m], (n,), and its points there, (n, 3)."""
  a, way = line[:-1], np.diff(line, axis=0)
  arm = points[:, None] - a
  share = (arm * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-300)
  at = a + np.clip(share, 0, 1)[..., None] * way
  far = lengths(points[:, None] - at)
  best, row = np.argmin(far, axis=1), np.arange(len(points))
  return far[row, best], at[row, best]


def check_points(organ: str, points: npt.ArrayLike) -> np.ndarray:
  """Returns points of a cut, (n, 3); ValueError where they are no path of two finite places."""
  try:
    points = np.asarray(points, float)
  except (TypeError, ValueError):
    said = f"points of a cut are {points!r:.80}, expected numbers (n, 3), n >= 2"
    raise ValueError(f"organ {organ!r}: {said}") from None
  if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
    raise ValueError(
      f"organ {organ!r}: points of a cut have shape {points.shape}, expected (n, 3), n >= 2"
    )
  if not np.isfinite(points).all():
    bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
    raise ValueError(f"organ {organ!r}: point {bad} is {points[bad]}, expected finite numbers")
  return points
