"""Any surface made into a shape with an inside: what wrapping starts from.

Nothing here trusts the mesh's winding or connectivity. The surface is sampled, air is let in from
outside, and everywhere the air stays a distance `reach` away; growing the air back by `reach` gives
the closed shape. Gaps narrower than twice the reach are bridged, walls and parts inside vanish.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import scipy
from palpate import meshes
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .field import Field
from .quality import normals
from .raster import Grid, depth, parts

Mesh = tuple[np.ndarray, np.ndarray]

_LEAST_THICKNESS = 1e-2  # of the diagonal; thinner is flat
_AT_ONCE = 5000  # points, whose triangles fit the processor's cache
_MOST_CAP = 0.15  # of the area; a larger hole makes the surface open
SHELL = 0.3  # of the grid's spacing; the inside starts below this, so that sheets have none


def load(mesh, scale: float | str = 1.0) -> tuple[str, np.ndarray, np.ndarray]:
  """Returns a name for messages, vertices (n, 3) [m] and triangles (m, 3), checked and tidied.

  Args:
    mesh: a file that trimesh reads (OBJ, STL, PLY, glTF), a trimesh, or (vertices, triangles)
    scale: metres per unit of the mesh, or the unit: m, cm, mm or inch
  """
  name, vertices, triangles = meshes.read(mesh, scale)
  used = np.unique(triangles)
  size = float(np.linalg.norm(np.ptp(vertices[used], axis=0)))
  centered = vertices[used] - vertices[used].mean(axis=0)
  axes = np.linalg.svd(centered.T @ centered)[0]
  thickness = float(np.ptp(centered @ axes, axis=0).min())
  if thickness < _LEAST_THICKNESS * size:
    raise ValueError(
      f"{name}: flat, {thickness:.3g} m thick and {size:.3g} m across, expected a surface around "
      f"an inside at least {_LEAST_THICKNESS:.0%} as thick as it is large"
    )
  return name, *_tidy(vertices, triangles)


def _tidy(vertices: np.ndarray, triangles: np.ndarray) -> Mesh:
  """Returns the mesh with equal vertices merged, without degenerate or repeated triangles."""
  used, number = np.unique(triangles, return_inverse=True)
  vertices, triangles = vertices[used], number.reshape(-1, 3)
  low, size = vertices.min(axis=0), np.ptp(vertices, axis=0).max()
  cell = np.round((vertices - low) / size * 2**20).astype(np.int64)
  key = (cell[:, 0] << 42) + (cell[:, 1] << 21) + cell[:, 2]
  _, first, merged = np.unique(key, return_index=True, return_inverse=True)
  triangles = merged.ravel()[triangles]
  apart = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
  triangles = triangles[apart]
  _, once = np.unique(np.sort(triangles, axis=1), axis=0, return_index=True)
  triangles = triangles[np.sort(once)]
  used, number = np.unique(triangles, return_inverse=True)
  return vertices[first][used], number.reshape(-1, 3)


def rims(nodes: int, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the edges around the holes of a surface (k, 2), and which hole each is of (k,)."""
  edge = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
  key, count = np.unique(edge[:, 0] * nodes + edge[:, 1], return_counts=True)
  rim = np.stack(np.divmod(key[count == 1], nodes), axis=1)
  graph = coo_array((np.ones(len(rim)), rim.T), shape=(nodes, nodes))
  label = connected_components(graph, directed=False)[1]
  return rim, np.unique(label[rim[:, 0]], return_inverse=True)[1]


def cap(vertices: np.ndarray, triangles: np.ndarray) -> Mesh:
  """Returns the mesh with a fan over every hole that is small beside the surface."""
  n = len(vertices)
  rim, hole = rims(n, triangles)
  if not len(rim):
    return vertices, triangles
  share = np.bincount(hole)[:, None]
  middle = np.stack([np.bincount(hole, x) for x in vertices[rim].mean(axis=1).T], axis=1) / share
  fan = np.column_stack([rim, n + hole])
  vertices = np.concatenate([vertices, middle])
  area = np.bincount(hole, np.linalg.norm(normals(vertices, fan), axis=1))
  whole = np.linalg.norm(normals(vertices, triangles), axis=1).sum()
  return vertices, np.concatenate([triangles, fan[(area < _MOST_CAP * whole)[hole]]])


class Target:
  """A surface to measure distances to.

  Attributes:
    vertices: its vertices                       (n, 3)
    triangles: its triangles                     (m, 3)
    points: samples about `spacing` apart        (k, 3)
    triangle: the triangle each sample lies on   (k,)
  """

  def __init__(self, vertices: np.ndarray, triangles: np.ndarray, spacing: float):
    self.vertices, self.triangles = vertices, triangles
    inner, triangle = _thin_out(*_sample(vertices, triangles, spacing), spacing / 2)
    owner = np.zeros(len(vertices), dtype=np.int64)
    owner[triangles.ravel()] = np.repeat(np.arange(len(triangles)), 3)
    used = np.unique(triangles)
    corner, corner_triangle = _thin_out(vertices[used], owner[used], spacing)
    self.points = np.concatenate([corner, inner])
    self.triangle = np.concatenate([corner_triangle, triangle])
    self._tree = scipy.spatial.KDTree(self.points)

  def distance(self, points: np.ndarray) -> np.ndarray:
    """Returns the distance to the nearest sample [m], (n,)."""
    return self._tree.query(points)[0]

  def closest(self, points: np.ndarray) -> np.ndarray:
    """Returns the closest points of the surface, (n, 3)."""
    some = np.array_split(points, len(points) // _AT_ONCE + 1)
    return np.concatenate([self._closest(each) for each in some])

  def _closest(self, points: np.ndarray) -> np.ndarray:
    """Returns the same, on the triangles of the nearest samples: inside of one or on its edges."""
    near = self._tree.query(points, k=min(8, len(self.points)))[1].reshape(len(points), -1)
    corner, point = self.vertices[self.triangles[self.triangle[near]]], points[:, None, None]
    edge = np.roll(corner, -1, axis=2) - corner
    along = _dot(point - corner, edge) / np.maximum(_dot(edge, edge), 1e-300)
    on_edge = corner + np.clip(along, 0, 1)[..., None] * edge
    normal = np.cross(edge[:, :, :1], edge[:, :, 1:2])
    height = _dot(point - corner[:, :, :1], normal) / np.maximum(_dot(normal, normal), 1e-300)
    on_plane = point - height[..., None] * normal
    inward = _dot(np.cross(normal, edge), on_plane - corner).min(axis=2)
    on_plane = np.where(inward[..., None, None] > 0, on_plane, np.inf)
    found = np.concatenate([on_edge, on_plane], axis=2).reshape(len(points), -1, 3)
    squared = ((found - points[:, None]) ** 2).sum(axis=2)
    return found[np.arange(len(points)), squared.argmin(axis=1)]


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  return np.einsum("...d,...d->...", a, b)


def _sample(
  vertices: np.ndarray, triangles: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
  """Returns points inside the triangles, in rows along their longest edges, and whose they are."""
  corner = vertices[triangles]
  length = np.linalg.norm(np.roll(corner, -1, axis=1) - corner, axis=2)
  turn = (length.argmax(axis=1)[:, None] + np.arange(3)) % 3
  a, b, c = np.take_along_axis(corner, turn[:, :, None], axis=1).transpose(1, 0, 2)
  longest = length.max(axis=1)
  height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / np.maximum(longest, 1e-300)
  across = np.maximum(np.ceil(height / spacing), 1).astype(np.int64)
  triangle, row = _ranges(across)
  up = (row + 0.5) / across[triangle]
  along = np.maximum(np.ceil((1 - up) * longest[triangle] / spacing), 1).astype(np.int64)
  line, column = _ranges(along)
  triangle, s = triangle[line], up[line][:, None]
  u = ((column + 0.5) / along[line])[:, None]
  a, b, c = a[triangle], b[triangle], c[triangle]
  return (1 - s) * (a + u * (b - a)) + s * c, triangle


def _ranges(count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns i repeated count[i] times for every i, and the numbers 0..count[i]-1 beside it."""
  owner = np.repeat(np.arange(len(count)), count)
  return owner, np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)


def _thin_out(
  points: np.ndarray, label: np.ndarray, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
  """Returns one point, with its label, of every cell of a grid."""
  cell = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
  key = (cell[:, 0] << 42) + (cell[:, 1] << 21) + cell[:, 2]
  _, first = np.unique(key, return_index=True)
  first = np.sort(first)
  return points[first], label[first]


@dataclasses.dataclass(frozen=True)
class Solid:
  """The closed shape found in a surface.

  Attributes:
    field: the shape
    reach: half the width of the widest gap bridged [m]
    covered: share of the samples that lie on or in the shape
    exposed: samples of the target that the shape's surface should pass through  (k, 3)
  """

  field: Field
  reach: float
  covered: float
  exposed: np.ndarray

  @property
  def shell(self) -> float:
    """How far under the surface the inside starts [m]."""
    return SHELL * self.field.spacing

  @property
  def grid(self) -> Grid:
    """The points of its field."""
    return Grid(self.field.origin, self.field.spacing, self.field.value.shape)

  def without(self, region: np.ndarray) -> Solid:
    """Returns the shape less a region, a mask of its grid's points  (nx, ny, nz)."""
    spacing = self.field.spacing
    away = depth(~region) * spacing
    value = np.maximum(self.field.value, 0.5 * spacing - away)
    label, _ = parts(value < -self.shell)
    kept = np.bincount(label.ravel())[1:].argmax() + 1
    value[(label > 0) & (label != kept)] = spacing
    left = away[self.grid.index(self.exposed)] > 1.5 * spacing
    return dataclasses.replace(
      self, field=Field(value, self.field.origin, spacing), exposed=self.exposed[left]
    )


def solidify(target: Target, spacing: float, reach: float) -> Solid | None:
  """Returns the shape that air kept `reach` away from the surface leaves; None if it has no inside.

  Args:
    target: the surface
    spacing: of the grid [m]
    reach: distance kept from the surface [m], over half the spacing
  """
  origin = target.points.min(axis=0) - reach - 3 * spacing
  count = np.ceil((target.points.max(axis=0) + reach + 3 * spacing - origin) / spacing) + 1
  place = np.round((target.points - origin) / spacing).astype(int)
  empty = np.ones(count.astype(int), dtype=bool)
  empty[tuple(place.T)] = False
  distance = depth(empty) * spacing
  near = np.argwhere(np.abs(distance - reach) < 2 * spacing)
  distance[tuple(near.T)] = target.distance(origin + near * spacing)
  label, _ = parts(distance > reach)
  air = label == label[0, 0, 0]
  rim = Field(np.where(air | (distance <= reach), distance, 0.0) - reach, origin, spacing)
  tree = scipy.spatial.KDTree(rim.surface()[0])
  value = np.where(air, reach + spacing * depth(air), reach - spacing * depth(~air))
  near = np.argwhere(np.abs(value) < reach + 4 * spacing)
  away = tree.query(origin + near * spacing)[0]
  value[tuple(near.T)] = reach + np.where(air[tuple(near.T)], away, -away)

  inside = value < -SHELL * spacing
  label, pieces = parts(inside)
  if not pieces:
    return None
  kept = np.bincount(label.ravel())[1:].argmax() + 1
  away, nearest = scipy.ndimage.distance_transform_edt(~inside, return_indices=True)  # pyright: ignore
  covered = away[tuple(place.T)] <= 2.5
  own = label[tuple(nearest[(slice(None), *place.T)])] == kept
  value[inside & (label != kept)] = spacing
  field = Field(value, origin, spacing)
  exposed = covered & own & (field.at(target.points) > -0.5 * reach - spacing)
  points, _ = _thin_out(target.points[exposed], np.flatnonzero(exposed), spacing / 2)
  return Solid(field, reach, float(covered.mean()), points)
