"""Places of a surface that are nearest to points, and paths on it."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from ..geometry.mesh import Mesh, lengths
from ..kernels import aim, kernel
from ..types import CONSTANTS, doubles, ints, longs, struct

SAMPLE = 0.25  # edges of the mesh between samples of a path, as in cutting/path.h
_OFF = 2.0  # edges from the surface from which a point is off it


@struct
class Nearest:
  """A surface, and what is asked of it; see `nearest`."""

  nelem: int
  normals: int  # whether normals are asked for
  npoint: int
  edge: wp.float64  # mean length of its edges [m]
  elem: longs("nelem", 3)
  x: doubles("nvert", 3)  # where the vertices are [m]
  rest: doubles("nvert", 3)  # where they are at rest [m]
  point: doubles("npoint", 3)
  box: ints("nelem")  # scratch
  middle: doubles("nelem", 3)  # scratch
  spot: doubles("npoint", 8)  # triangle, weights of its corners, distance [m], normal at rest


_nearest = kernel("find_nearest", "cutting/cut.h", Nearest, CONSTANTS)


class Finder:
  """Finds the points of surfaces of one whole that are nearest to points, one after the other.

  Args:
    whole: the mesh before the first cut
  """

  def __init__(self, whole: Mesh):
    self._fields = fields = Nearest()
    fields.nelem, fields.edge = whole.nelem, whole.edge_length
    self._box, self._middle = np.zeros(whole.nelem, np.int32), np.zeros((whole.nelem, 3))
    self._make_room(32)
    self._launch = _nearest.command(fields).launch

  def _make_room(self, n: int):
    self._spot = np.zeros((n, 8))
    aim(self._fields, box=self._box, middle=self._middle, spot=self._spot)

  def _find(
    self, mesh: Mesh, position: np.ndarray, points: np.ndarray, normals: bool
  ) -> np.ndarray:
    n = len(points)
    if n > len(self._spot):
      self._make_room(2 * n)
    x, rest, point = (np.ascontiguousarray(each, float) for each in (position, mesh.rest, points))
    elem = np.ascontiguousarray(mesh.elem, np.int64)
    aim(self._fields, x=x, rest=rest, point=point, elem=elem)
    self._fields.npoint, self._fields.normals = n, normals
    self._launch()
    return self._spot[:n].copy()

  def nearest(
    self, mesh: Mesh, position: np.ndarray, points: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the points of the surface nearest to points; of a solid, of its skin.

    Args:
      mesh: the surface
      position: where its vertices are [m]  (nvert, 3)
      points: some points [m]               (n, 3)

    Returns:
      triangles (n,), weights of their corners (n, 3), distances [m] (n,)
    """
    spot = self._find(mesh, position, points, normals=False)
    return spot[:, 0].astype(int), spot[:, 1:4], spot[:, 4]

  def trace(
    self, organ: str, mesh: Mesh, position: np.ndarray, points: npt.ArrayLike, normals: bool = False
  ) -> "Traced":
    """Returns the path on a surface that is nearest to points.

    Args:
      organ: its name, for messages
      mesh: the surface
      position: where its vertices are [m]          (nvert, 3)
      points: the path, in the same frame [m]       (n, 3)
      normals: whether to find the normals inward

    Raises:
      ValueError: these are no points, or one is off the surface.
    """
    points, edge = check_points(organ, points), mesh.whole.edge_length
    gap = lengths(points[1:] - points[:-1])
    steps = np.maximum(np.ceil(gap / (SAMPLE * edge)).astype(int), 1)
    given = np.append(0, np.cumsum(steps))
    at = np.interp(np.arange(given[-1] + 1), given, np.arange(len(points)))
    k = np.minimum(at.astype(int), len(points) - 2)
    sample = points[k] + (at - k)[:, None] * (points[k + 1] - points[k])
    spot = self._find(mesh, position, sample, normals)
    elem, far = spot[:, 0].astype(int), spot[given, 4]
    off = np.flatnonzero(far > _OFF * edge)
    if off.size:
      raise ValueError(
        f"organ {organ!r}: point {off[0]} of the path is {far[off[0]]:.3g} m from the surface, "
        f"expected at most {_OFF * edge:.3g} m"
      )
    rest = np.einsum("nk,nkj->nj", spot[:, 1:4], mesh.rest[mesh.elem[elem]])
    return Traced(at, rest, elem, -spot[:, 5:])


class Traced(NamedTuple):
  """A path on a surface, in dense samples.

  Attributes:
    at: which of the points each is, or between which   (n,)
    rest: where they are at rest [m]                    (n, 3)
    elem: triangles that they are in                    (n,)
    inward: unit normals at rest, even across edges: means by area around vertices; see `trace`
  """

  at: np.ndarray
  rest: np.ndarray
  elem: np.ndarray
  inward: np.ndarray


def nearest(
  mesh: Mesh, position: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns what `Finder.nearest` does, once."""
  return Finder(mesh.whole).nearest(mesh, position, points)


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
