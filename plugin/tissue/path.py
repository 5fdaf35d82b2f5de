"""A path on a surface, and the chain of edges near it along which the mesh may be cut."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy import sparse, spatial
from scipy.sparse import csgraph

from .mesh import Mesh, corners, distinct, lengths

_STEP = 0.25  # between samples of the path, in edges
_OFF = 2.0  # edges from the surface from which a point is off it
_WAY = 8.0  # edges between vertices that the chain must pass
_RIM = 0.5  # edges: a cut that ends closer to a boundary opens it
_ALONG = 0.2  # edges from an older cut within which a path goes along it
_BOX = 3.0  # edges from the path within which they are found sooner
_FEW = 20_000  # pairs that are all compared
_AROUND = 12  # triangles around a point of a solid's skin among which the nearest is
_NEAR = 6  # vertices nearest to a point around which its triangle is looked for


@dataclasses.dataclass
class Run:
  """A part of a path without gaps.

  Attributes:
    at: samples at rest [m]      (n, 3)
    elem: their triangles        (n,)
    open: whether they lie along an older cut, so that there is nothing to cut
    chain: the vertices along which it is cut
  """

  at: np.ndarray
  elem: np.ndarray
  open: bool = False
  chain: list[int] = dataclasses.field(default_factory=list)

  @property
  def closes(self) -> bool:
    """Whether the chain ends where it begins."""
    return len(self.chain) > 3 and self.chain[0] == self.chain[-1]


def trace(organ: str, mesh: Mesh, position, points, edge: float) -> list[Run]:
  """Returns the parts of the path on the surface, in the rest shape."""
  _check_points(organ, points)
  gap = lengths(np.diff(points, axis=0))
  steps = np.maximum(np.ceil(gap / (_STEP * edge)).astype(int), 1)
  share = np.concatenate([np.arange(n) / n for n in steps] + [[0.0]])
  k = np.append(np.repeat(np.arange(len(steps)), steps), len(steps) - 1)
  share[-1] = 1.0
  sample = points[k] + share[:, None] * (points[k + 1] - points[k])
  elem, weight, far = nearest(mesh, position, sample)
  given = np.append(np.cumsum(steps) - steps, len(sample) - 1)
  off = np.flatnonzero(far[given] > _OFF * edge)
  if off.size:
    raise ValueError(
      f"organ {organ!r}: point {off[0]} of the path is {far[given[off[0]]]:.3g} m from the "
      f"surface, expected at most {_OFF * edge:.3g} m"
    )
  at = np.einsum("nk,nkj->nj", weight, mesh.rest[mesh.elem[elem]])
  # Where the path crosses an older cut, or leaps, it begins anew.
  leap = lengths(np.diff(at, axis=0)) > 2 * edge
  is_open = _is_open(mesh, elem, at, edge)
  new = leap | (_crosses(mesh, elem) & ~is_open[1:]) | (is_open[1:] != is_open[:-1])
  parts = np.split(np.arange(len(elem)), np.flatnonzero(new) + 1)
  runs = [Run(at[part], elem[part], bool(is_open[part[0]])) for part in parts]
  return [run for run in runs if len(run.at) > 1]


def _check_points(organ: str, points: np.ndarray):
  if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
    raise ValueError(
      f"organ {organ!r}: points of a cut have shape {points.shape}, expected (n, 3), n >= 2"
    )
  if not np.isfinite(points).all():
    bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
    raise ValueError(f"organ {organ!r}: point {bad} is {points[bad]}, expected finite numbers")


def _crosses(mesh: Mesh, elem: np.ndarray) -> np.ndarray:
  """Returns where neighbouring samples were neighbours before the first cut, and are no more."""
  whole = mesh.whole
  if mesh is whole:
    return np.zeros(len(elem) - 1, bool)
  a, b = elem[:-1], elem[1:]

  def shares(m):
    return (m.elem[a][:, :, None] == m.elem[b][:, None]).any(axis=(1, 2))

  return (a != b) & shares(whole) & ~shares(mesh)


def _is_open(mesh: Mesh, elem: np.ndarray, at: np.ndarray, edge: float) -> np.ndarray:
  """Returns which samples go along an edge that came apart before, more than across it, (n,)."""
  out = np.zeros(len(elem), bool)
  half = 3 * elem[:, None] + np.arange(3)
  is_cut = (mesh.twin[half] < 0) & (mesh.whole.twin[half] >= 0)
  which, k = np.nonzero(is_cut)
  if not which.size:
    return out
  ends = [mesh.rest[corners(mesh, half[which, k], c)] for c in (0, 1)]
  way, arm = ends[1] - ends[0], at[which] - ends[0]
  share = np.clip((arm * way).sum(1) / (way * way).sum(1), 0.0, 1.0)
  out[which[lengths(arm - share[:, None] * way) < _ALONG * edge]] = True
  for part in np.split(np.arange(len(out)), np.flatnonzero(np.diff(out)) + 1):
    out[part] &= len(part) * _STEP >= 1.0
  return out


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
  if len(mesh.tet):
    return nearest_of(position, mesh.elem[: mesh.whole.nelem], points, mesh.whole.edge_length)
  near = _nearest_vertices(mesh, position[: mesh.nouter], points)
  around = mesh.ring_elem[near].reshape(len(points), -1)
  elem = np.where(around >= 0, around // 3, around.max(axis=1, keepdims=True) // 3)
  corner = position[mesh.elem[elem]]
  weight, far = closest(points[:, None], corner[:, :, 0], corner[:, :, 1], corner[:, :, 2])
  best = np.argmin(far, axis=1)
  row = np.arange(len(points))
  return elem[row, best], weight[row, best], far[row, best]


def nearest_of(position: np.ndarray, elem: np.ndarray, points: np.ndarray, edge: float):
  """Returns what `nearest` does of given triangles; `edge`: their edges' mean length [m]."""
  low, high = points.min(axis=0) - _BOX * edge, points.max(axis=0) + _BOX * edge
  corner = position[elem]
  middle = corner.mean(axis=1)
  box = np.flatnonzero(((middle >= low) & (middle <= high)).all(axis=1))
  box = box if len(box) >= _AROUND else np.arange(len(elem))
  near = box[_neighbours(middle[box], points, min(_AROUND, len(box)))[0]]
  a, b, c = np.moveaxis(corner[near], 2, 0)
  weight, far = closest(points[:, None], a, b, c)
  best, row = np.argmin(far, axis=1), np.arange(len(points))
  return near[row, best], weight[row, best], far[row, best]


def _nearest_vertices(mesh: Mesh, position: np.ndarray, points: np.ndarray) -> np.ndarray:
  """Returns the few positions nearest to points, looked for in a box around them first."""
  count, room = min(_NEAR, len(position)), _BOX * mesh.whole.edge_length
  low, high = points.min(axis=0) - room, points.max(axis=0) + room
  inside = (position >= low) & (position <= high)
  box = np.flatnonzero(inside[:, 0] & inside[:, 1] & inside[:, 2])
  if len(box) >= count:
    near, far = _neighbours(position[box], points, count)
    if far.max() <= room:
      return box[near]
  return _neighbours(position, points, count)[0]


def _neighbours(position: np.ndarray, points: np.ndarray, count: int):
  """Returns which positions are nearest to points, and how far they are, (n, count) each."""
  if len(position) * len(points) > _FEW:
    far, near = spatial.KDTree(position).query(points, k=count)
    return tuple(np.reshape(each, (len(points), count)) for each in (near, far))
  far = lengths(points[:, None] - position)
  near = np.argpartition(far, count - 1, axis=1)[:, :count]
  return near, np.take_along_axis(far, near, 1)


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
  """Returns the distances of points from a polyline of dense samples, and its points there.

  Only what is beside the nearest sample is looked at.

  Returns:
    distances (n,), points (n, 3)
  """
  near = _neighbours(line, points, 1)[0]
  begin = np.clip(near + np.array([-1, 0]), 0, len(line) - 2)
  a, way = line[begin], line[begin + 1] - line[begin]
  arm = points[:, None] - a
  t = (arm * way).sum(-1) / np.maximum((way * way).sum(-1), 1e-300)
  at = a + np.clip(t, 0, 1)[..., None] * way
  far = lengths(points[:, None] - at)
  best, row = np.argmin(far, axis=1), np.arange(len(points))
  return far[row, best], at[row, best]


# The chain of edges near it.


def chain(mesh: Mesh, run: Run, edge: float) -> list[int]:
  """Returns vertices near a path, each a neighbour of the one before."""
  near = distinct(mesh.elem[run.elem])
  ring = mesh.ring[near]
  band = distinct(ring[ring >= 0], near)
  far, _ = distance(run.at, mesh.rest[band])
  band, far = band[far < 1.5 * edge], far[far < 1.5 * edge]
  if len(band) < 2:
    return []
  number = np.full(mesh.nvert, -1)
  number[band] = np.arange(len(band))
  ring = mesh.ring[band]
  a, k = np.nonzero((ring >= 0) & (number[ring] >= 0))
  b = number[ring[a, k]]
  size = lengths(mesh.rest[band[a]] - mesh.rest[band[b]])
  cost = size * (0.05 + (far[a] ** 2 + far[b] ** 2) / edge**2)
  graph = sparse.csr_array((cost, (a, b)), shape=(len(band), len(band)))
  way = _ways(mesh, run, band, edge)
  out = [way[0]]
  for begin, end in itertools.pairwise(way):
    before = csgraph.dijkstra(graph, indices=begin, return_predecessors=True)[1]
    part = [end]
    while part[-1] != begin and before[part[-1]] >= 0:
      part.append(int(before[part[-1]]))
    if part[-1] == begin:
      out += part[-2::-1]
  return _without_spikes([int(band[k]) for k in out])


def _ways(mesh: Mesh, run: Run, band: np.ndarray, edge: float) -> list[int]:
  """Returns numbers of vertices of the band that the chain passes, its ends among them."""
  along = np.concatenate([[0], np.cumsum(lengths(np.diff(run.at, axis=0)))])
  parts = max(1, round(along[-1] / (_WAY * edge)))
  closes = along[-1] > 3 * edge and np.linalg.norm(run.at[-1] - run.at[0]) < _STEP * edge
  parts = max(parts, 3) if closes else parts
  where = np.searchsorted(along, np.linspace(0, along[-1], parts + 1)).clip(0, len(along) - 1)
  rest = mesh.rest[band]
  far = lengths(run.at[where][:, None] - rest)
  way = [int(k) for k in np.argmin(far, axis=1)]
  if closes:
    return [*way[:-1], way[0]]
  rim = mesh.ring_elem[band, np.maximum(mesh.degree[band] - 1, 0)] < 0
  for end in (0, -1):
    other = way[-1 - end]
    at_rim = np.where(rim & (np.arange(len(band)) != other), far[end], np.inf)
    if at_rim.min(initial=np.inf) < _RIM * edge:
      way[end] = int(np.argmin(at_rim))
  return way


def _without_spikes(chain: list[int]) -> list[int]:
  out: list[int] = []
  for v in chain:
    if out and out[-1] == v:
      continue
    if len(out) > 1 and out[-2] == v:
      out.pop()
    else:
      out.append(v)
  return out


def pairs(chain: list[int]) -> list[tuple[int, int]]:
  """Returns the edges of a chain of vertices."""
  return list(itertools.pairwise(chain))
