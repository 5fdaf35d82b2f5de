"""A path on a surface, and the chain of edges near it along which the mesh may be cut."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
from scipy import sparse, spatial
from scipy.sparse import csgraph

from .mesh import Mesh

_STEP = 0.25  # between samples of the path, in edges
_OFF = 2.0  # edges from the surface from which a point is off it
_WAY = 8.0  # edges between vertices that the chain must pass
_RIM = 0.5  # edges: a cut that ends closer to a boundary opens it
_NEAR = 6  # vertices nearest to a point around which its triangle is looked for


@dataclasses.dataclass
class Run:
  """A part of a path without gaps: samples at rest (n, 3), their triangles, chain of vertices."""

  at: np.ndarray
  elem: np.ndarray
  chain: list[int] = dataclasses.field(default_factory=list)

  @property
  def closes(self) -> bool:
    """Whether the chain ends where it begins."""
    return len(self.chain) > 3 and self.chain[0] == self.chain[-1]


def trace(organ: str, mesh: Mesh, position, points, edge: float) -> list[Run]:
  """Returns the parts of the path on the surface, in the rest shape."""
  _check_points(organ, points)
  gap = np.linalg.norm(np.diff(points, axis=0), axis=1)
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
  leap = np.linalg.norm(np.diff(at, axis=0), axis=1) > 2 * edge
  parts = np.flatnonzero(leap | _crosses(mesh, elem)) + 1
  runs = [Run(a, e) for a, e in zip(np.split(at, parts), np.split(elem, parts), strict=True)]
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
  used = mesh.nouter
  _, near = spatial.KDTree(position[:used]).query(points, k=min(_NEAR, used))
  around = mesh.ring_elem[near].reshape(len(points), -1)
  elem = np.where(around >= 0, around // 3, around.max(axis=1, keepdims=True) // 3)
  corner = position[mesh.elem[elem]]
  weight, far = closest(points[:, None], corner[:, :, 0], corner[:, :, 1], corner[:, :, 2])
  best = np.argmin(far, axis=1)
  row = np.arange(len(points))
  return elem[row, best], weight[row, best], far[row, best]


def closest(p, a, b, c) -> tuple[np.ndarray, np.ndarray]:
  """Returns weights of the point of triangles that is nearest to points, and its distance."""
  ab, ac, ap = b - a, c - a, p - a
  d11, d12, d22 = (ab * ab).sum(-1), (ab * ac).sum(-1), (ac * ac).sum(-1)
  e1, e2 = (ap * ab).sum(-1), (ap * ac).sum(-1)
  det = np.maximum(d11 * d22 - d12 * d12, 1e-300)
  v, w = (d22 * e1 - d12 * e2) / det, (d11 * e2 - d12 * e1) / det
  found = [np.stack([1 - v - w, v, w], -1)]
  inside = (found[0] >= 0).all(axis=-1)
  # On the edges.
  t = np.clip(e1 / np.maximum(d11, 1e-300), 0, 1)
  found.append(np.stack([1 - t, t, 0 * t], -1))
  t = np.clip(e2 / np.maximum(d22, 1e-300), 0, 1)
  found.append(np.stack([1 - t, 0 * t, t], -1))
  bc, bp = c - b, p - b
  t = np.clip((bp * bc).sum(-1) / np.maximum((bc * bc).sum(-1), 1e-300), 0, 1)
  found.append(np.stack([0 * t, 1 - t, t], -1))
  weight = np.stack(found, -2)  # (..., 4, 3)
  at = weight @ np.stack([a, b, c], -2)
  far = np.linalg.norm(at - p[..., None, :], axis=-1)
  far[..., 0] = np.where(inside, far[..., 0], np.inf)
  best = np.argmin(far, axis=-1)[..., None]
  return (
    np.take_along_axis(weight, best[..., None], -2)[..., 0, :],
    np.take_along_axis(far, best, -1)[..., 0],
  )


def distance(line: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the distances of points from a polyline, and its points there (n,), (n, 3)."""
  a, d = line[:-1], np.diff(line, axis=0)
  t = ((points[:, None] - a) * d).sum(-1) / np.maximum((d * d).sum(-1), 1e-300)
  at = a + np.clip(t, 0, 1)[..., None] * d
  far = np.linalg.norm(points[:, None] - at, axis=-1)
  best = np.argmin(far, axis=1)
  row = np.arange(len(points))
  return far[row, best], at[row, best]


# The chain of edges near it.


def chain(mesh: Mesh, run: Run, edge: float) -> list[int]:
  """Returns vertices near a path, each a neighbour of the one before."""
  near = np.unique(mesh.elem[run.elem])
  ring = mesh.ring[near]
  band = np.unique(np.append(ring[ring >= 0], near))
  far, _ = distance(run.at, mesh.rest[band])
  band, far = band[far < 1.5 * edge], far[far < 1.5 * edge]
  if len(band) < 2:
    return []
  number = np.full(mesh.nvert, -1)
  number[band] = np.arange(len(band))
  ring = mesh.ring[band]
  a, k = np.nonzero((ring >= 0) & (number[ring] >= 0))
  b = number[ring[a, k]]
  size = np.linalg.norm(mesh.rest[band[a]] - mesh.rest[band[b]], axis=1)
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
  along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(run.at, axis=0), axis=1))])
  parts = max(1, round(along[-1] / (_WAY * edge)))
  closes = along[-1] > 3 * edge and np.linalg.norm(run.at[-1] - run.at[0]) < _STEP * edge
  parts = max(parts, 3) if closes else parts
  where = np.searchsorted(along, np.linspace(0, along[-1], parts + 1)).clip(0, len(along) - 1)
  rest = mesh.rest[band]
  far = np.linalg.norm(run.at[where][:, None] - rest, axis=2)
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
