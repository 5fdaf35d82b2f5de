"""Places of a surface that are nearest to points, and how far points are from a path."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import numpy as np
import warp as wp

from .kernels import kernel
from .mesh import Mesh, lengths
from .types import CONSTANTS, doubles, ints, longs, struct


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


def nearest(
  mesh: Mesh, position: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns the points of the surface nearest to points.

  Args:
    mesh: the surface
    position: where its vertices are [m]  (nvert, 3)
    points: some points [m]               (n, 3)

  Returns:
    triangles (n,), weights of their corners (n, 3), distances [m] (n,)
  """
  values = {"elem": mesh.elem, "spoke": mesh.ring_elem, "degree": mesh.degree, "x": position}
  values |= {"point": points, "box": np.empty(mesh.nvert, np.int32)}
  values |= {"spot": np.empty((len(points), 5))}
  fields = Nearest()
  fields.nvert, fields.most = mesh.ring.shape
  fields.nouter, fields.npoint, fields.edge = mesh.nouter, len(points), mesh.whole.edge_length
  for name, value in values.items():
    dtype = Nearest.vars[name].type.dtype
    array = np.ascontiguousarray(value, wp.dtype_to_numpy(dtype))
    setattr(fields, name, wp.array(array, dtype=dtype, device="cpu", copy=False))
  _nearest.launch("cpu", 1, 1, 0, fields)
  spot = fields.spot.numpy()
  return spot[:, 0].astype(int), spot[:, 1:4], spot[:, 4]


def distance(line: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the distances of points from a polyline [m], (n,), and its points there, (n, 3)."""
  a, way = line[:-1], np.diff(line, axis=0)
  arm = points[:, None] - a
  share = (arm * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-300)
  at = a + np.clip(share, 0, 1)[..., None] * way
  far = lengths(points[:, None] - at)
  best, row = np.argmin(far, axis=1), np.arange(len(points))
  return far[row, best], at[row, best]
