"""Coarser meshes of a surface and the weights between them, for the multilevel preconditioner.

A mesh is coarsened by half-edge collapses of vertices that share no edge, a round of them at once
(the vertex removal of Hoppe 1996 without attributes): a removed vertex moves onto a neighbour, the
ring around it is divided into triangles anew, and its displacement is interpolated where it lies
in them. Vertices that stay do not move, so a coarse mesh follows the deformed one by sampling it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse

from . import mesh as topology
from .mesh import Mesh

_RATIO = 0.25  # of the nodes, from one level to the next: edges twice as long
_QUALITY = 0.25  # least shape of a new triangle; an equilateral one has 1
_MOST_DEGREE = 10  # of a vertex that others moved onto
_ROUNDS = 12
_ENTRIES = 4  # weights of a vertex


@dataclasses.dataclass(frozen=True)
class Coarse:
  """A coarse mesh.

  Attributes:
    mesh: the mesh
    vert: its vertices among those of the finest mesh   (nvert,)
    weight: displacement of each vertex of the next finer mesh from these, sparse (nfiner, nvert)
  """

  mesh: Mesh
  vert: np.ndarray
  weight: sparse.csr_array


def build(mesh: Mesh, least: int) -> list[Coarse]:
  """Returns coarser and coarser meshes, down to `least` vertices or where nothing can be removed.

  Args:
    mesh: the finest mesh
    least: vertices of the coarsest mesh
  """
  levels = []
  vert = np.arange(mesh.nvert)
  while mesh.nvert > least:
    start = mesh.nvert
    weight = sparse.csr_array(sparse.eye_array(start))
    for _ in range(_ROUNDS):
      if mesh.nvert <= max(_RATIO * start, least):
        break
      removed = mesh.nvert
      mesh, keep, step = _round(mesh, int(max(_RATIO * start, least)))
      vert = vert[keep]
      weight = sparse.csr_array(weight @ step)
      if mesh.nvert > 0.97 * removed:
        break
    if mesh.nvert > 0.7 * start:
      break
    levels.append(Coarse(mesh, vert, _prune(weight)))
  return levels


def _round(mesh: Mesh, target: int) -> tuple[Mesh, np.ndarray, sparse.csr_array]:
  """Returns the mesh after one round, the vertices kept, and the weights (nvert, nkept)."""
  nvert, rest, ring, degree = mesh.nvert, mesh.rest, mesh.ring, mesh.degree
  own = np.arange(nvert)
  closed = mesh.ring_elem[own, degree - 1] >= 0
  area = topology.vertex_areas(rest, mesh.elem)
  key = area * np.random.RandomState(0).uniform(0.9, 1.1, nvert)
  chosen = _independent(ring, key, closed & (degree <= 8) & (degree >= 3))
  chosen = chosen[np.argsort(key[chosen], kind="stable")]
  onto, triangle, weight = _collapse(mesh, chosen)
  ok = onto >= 0
  chosen, onto, triangle, weight = chosen[ok], onto[ok], triangle[ok], weight[ok]
  # Two collapses must not make the same edge, nor one vertex the centre of too many.
  first = np.ones(len(chosen), bool)
  added = _new_edges(mesh, chosen, onto)
  flat = added.ravel()
  which = np.repeat(np.arange(len(chosen)), added.shape[1])[flat >= 0]
  _, where, inverse = np.unique(flat[flat >= 0], return_index=True, return_inverse=True)
  first[which[np.arange(len(which)) != where[inverse]]] = False
  chosen, onto, triangle, weight = chosen[first], onto[first], triangle[first], weight[first]
  order = np.argsort(onto, kind="stable")
  begin = np.searchsorted(onto[order], onto[order])
  grown = np.cumsum(degree[chosen[order]] - 4)
  before = np.where(begin > 0, grown[begin - 1], 0)
  fits = np.zeros(len(chosen), bool)
  fits[order] = degree[onto[order]] + grown - before <= _MOST_DEGREE
  fits = np.flatnonzero(fits)[: nvert - target]
  chosen, onto, triangle, weight = chosen[fits], onto[fits], triangle[fits], weight[fits]

  keep = np.ones(nvert, bool)
  keep[chosen] = False
  moved = own.copy()
  moved[chosen] = onto
  elem = moved[mesh.elem]
  elem = elem[(elem != elem[:, [1, 2, 0]]).all(axis=1)]
  number = np.cumsum(keep) - 1
  kept = np.flatnonzero(keep)
  row = np.concatenate([kept, np.repeat(chosen, 3)])
  col = number[np.concatenate([kept, triangle.ravel()])]
  value = np.concatenate([np.ones(len(kept)), weight.ravel()])
  step = sparse.csr_array((value, (row, col)), shape=(nvert, len(kept)))
  step.eliminate_zeros()
  return topology.build("coarse", rest[kept], number[elem]), kept, step


def _independent(ring: np.ndarray, key: np.ndarray, allowed: np.ndarray) -> np.ndarray:
  """Returns vertices without common edges, of small keys (Luby 1986, doi:10.1137/0215074)."""
  state = np.where(allowed, 0, -1)  # 0 undecided, 1 chosen, -1 out
  neighbour = np.where(ring >= 0, ring, len(key))
  for _ in range(8):
    value = np.append(np.where(state == 0, key, np.inf), np.inf)
    best = (state == 0) & (value[:-1] < value[neighbour].min(axis=1))
    if not best.any():
      break
    state[best] = 1
    near = neighbour[best].ravel()
    near = near[near < len(key)]
    state[near] = np.where(state[near] == 0, -1, state[near])
  return np.flatnonzero(state == 1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  return np.stack(
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
  )


def _shape(a: np.ndarray, b: np.ndarray, c: np.ndarray, normal: np.ndarray) -> np.ndarray:
  """Returns the shape of triangles, 1 for an equilateral one, -1 where turned from `normal`.

  Vectors are (3, n) here and in `_collapse`: numpy is slow on short last axes.
  """
  u, v, w = b - a, c - a, c - b
  area = _cross(u, v)
  size = np.sqrt(_dot(area, area))
  length2 = np.maximum(_dot(u, u) + _dot(v, v) + _dot(w, w), 1e-300)
  return np.where(_dot(area, normal) > 0.5 * size, 2 * np.sqrt(3) * size / length2, -1)


def _collapse(mesh: Mesh, vert: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns where each vertex moves to, -1 if nowhere, and where it lies in the new triangles.

  Args:
    mesh: the mesh
    vert: vertices with a closed fan, (n,)
  """
  n, degree, most = len(vert), mesh.degree[vert], int(mesh.degree[vert].max(initial=3))
  ring = mesh.ring[vert, :most].T  # (most, n)
  rest = np.ascontiguousarray(mesh.rest.T)
  at = rest[:, np.where(ring >= 0, ring, vert)] - rest[:, None, vert]  # (3, most, n)
  index = np.arange(most)[:, None]
  after = np.where(index + 1 == degree, 0, np.minimum(index + 1, most - 1))
  row = np.arange(n)
  following, beyond = ring[after, row], at[:, after, row]
  valid = ring >= 0
  normal = np.where(valid, _cross(at, beyond), 0).sum(axis=1)
  normal /= np.maximum(np.sqrt(_dot(normal, normal)), 1e-300)
  edges = np.sort(np.stack([mesh.elem.ravel(), mesh.elem[:, [1, 2, 0]].ravel()]), axis=0)
  edges = np.unique(edges[0] * mesh.nvert + edges[1])
  best = np.full(n, _QUALITY)
  onto = np.full(n, -1)
  choice = np.zeros(n, np.int64)
  for j in range(most):
    quality = np.where(valid[j], np.inf, -np.inf)
    for i in range(most):
      use = valid[i] & (i != j) & (after[i] != j)
      shape = _shape(at[:, j], at[:, i], beyond[:, i], normal)
      quality = np.where(use, np.minimum(quality, shape), quality)
    better = np.flatnonzero(quality > best)
    # The link condition: no new edge may be there already.
    free = np.ones(len(better), bool)
    for i in range(most):
      use = valid[i] & (i != j) & (after[i] != j) & (after[j] != i)
      low, high = np.minimum(ring[j], ring[i])[better], np.maximum(ring[j], ring[i])[better]
      code = low * mesh.nvert + high
      found = edges[np.minimum(np.searchsorted(edges, code), len(edges) - 1)] == code
      free &= ~(use[better] & found)
    better = better[free]
    best[better], onto[better], choice[better] = quality[better], ring[j, better], j
  # Barycentric coordinates in the triangle that holds the vertex best; it is the origin here.
  triangle = np.zeros((3, n), np.int64)
  weight = np.zeros((3, n))
  inside = np.full(n, -np.inf)
  centre, target = at[:, choice, row], ring[choice, row]
  for i in range(most):
    use = (onto >= 0) & valid[i] & (i != choice) & (after[i] != choice)
    corner = (centre, at[:, i], beyond[:, i])
    share = np.stack([_dot(_cross(corner[k - 2], corner[k - 1]), normal) for k in range(3)])
    total = share.sum(axis=0)
    share /= np.where(total != 0, total, 1)
    least = share.min(axis=0)
    better = use & (total > 0) & (least > inside)
    inside = np.where(better, least, inside)
    weight = np.where(better, share, weight)
    triangle = np.where(better, np.stack([target, ring[i], following[i]]), triangle)
  onto = np.where(np.isfinite(inside), onto, -1)
  weight = np.maximum(weight, 0)
  weight /= np.maximum(weight.sum(axis=0), 1e-300)
  return onto, triangle.T, weight.T


def _new_edges(mesh: Mesh, vert: np.ndarray, onto: np.ndarray) -> np.ndarray:
  """Returns codes of the edges that the collapses make, -1 for none, (n, most)."""
  ring = mesh.ring[vert]
  most = ring.shape[1]
  j = np.argmax(ring == onto[:, None], axis=1)
  degree = mesh.degree[vert]
  index = np.arange(most)
  gap = (index - j[:, None]) % degree[:, None]
  use = (ring >= 0) & (gap > 1) & (gap < degree[:, None] - 1)
  low, high = np.minimum(ring, onto[:, None]), np.maximum(ring, onto[:, None])
  return np.where(use, low * mesh.nvert + high, -1)


def _prune(weight: sparse.csr_array) -> sparse.csr_array:
  """Returns `weight` with the largest entries of each row, scaled to the same sum."""
  begin, data = np.asarray(weight.indptr), np.asarray(weight.data)
  row = np.repeat(np.arange(len(begin) - 1), np.diff(begin))
  order = np.lexsort((np.negative(data), row))
  keep = order[np.arange(len(row)) - begin[row] < _ENTRIES]
  row, col, value = row[keep], np.asarray(weight.indices)[keep], data[keep]
  value = value / np.bincount(row, value, len(begin) - 1)[row]
  return sparse.csr_array((value, (row, col)), shape=weight.shape)
