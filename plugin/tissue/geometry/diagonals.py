"""Makes alternating diagonals of rectangles parallel.

Where diagonals alternate ("union jack"), vertices have four and eight neighbours in turn. No energy
of hinges that lets those of one triangle act on each other is both stable and right there: bent as
a sphere, vertices of four neighbours give way until at most (1 - nu) / (1 + nu) of the plate's
stiffness is left. The same points with parallel diagonals have six neighbours each and are exact.
"""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from . import mesh as topology
from .mesh import Mesh

_NEAR = 0.05  # of a diagonal, by which a rectangle's differ in length and miss each other's middle
_PAYS = 0.5  # of the squares of degree less six, that a patch of rectangles may keep


def parallel(organ: str, mesh: Mesh, young: np.ndarray) -> Mesh:
  """Returns the surface with its rectangles' diagonals parallel where they alternate.

  Triangles keep the places of their pairs: what a pair has in common it has still.

  Args:
    organ: its name, for messages
    mesh: the surface
    young: Young's modulus; pairs of triangles that differ in it are left  (1,) or (nelem,)
  """
  quad = _rectangles(mesh, np.broadcast_to(young, mesh.nelem))
  if not len(quad):
    return mesh
  flip = _alternating(mesh, quad)
  elem = mesh.elem.copy()
  a, b, c, d = _corners(mesh, quad[flip])
  elem[quad[flip] // 3] = np.stack([a, d, c], axis=1)
  elem[mesh.twin[quad[flip]] // 3] = np.stack([d, b, c], axis=1)
  return topology.build(organ, mesh.rest, elem) if flip.any() else mesh


def _corners(mesh: Mesh, half: np.ndarray) -> tuple[np.ndarray, ...]:
  """Returns a, b, c, d of the triangles (a, b, c) and (b, a, d) beside half-edges a -> b."""
  elem, other = mesh.elem.ravel(), mesh.twin[half]
  return tuple(
    elem[h - h % 3 + (h + k) % 3] for h, k in ((half, 0), (half, 1), (half, 2), (other, 2))
  )


def _rectangles(mesh: Mesh, young: np.ndarray) -> np.ndarray:
  """Returns the half-edges that are diagonals of rectangles whose other one is no edge."""
  half = mesh.interior
  a, b, c, d = _corners(mesh, half)
  x = mesh.rest
  one, two = np.linalg.norm(x[a] - x[b], axis=1), np.linalg.norm(x[c] - x[d], axis=1)
  apart = np.linalg.norm(x[a] + x[b] - x[c] - x[d], axis=1)
  fits = (np.abs(one - two) < _NEAR * one) & (apart < _NEAR * one)
  fits &= young[half // 3] == young[mesh.twin[half] // 3]
  edge, across = (np.minimum(*ends) * mesh.nvert + np.maximum(*ends) for ends in ((a, b), (c, d)))
  return half[fits & ~np.isin(across, edge)]


def _alternating(mesh: Mesh, quad: np.ndarray) -> np.ndarray:
  """Returns which diagonals to turn, (nquad,) bool."""
  of_elem = np.full(mesh.nelem, -1)
  of_elem[quad // 3] = of_elem[mesh.twin[quad] // 3] = np.arange(len(quad))
  start, end = _corners(mesh, quad)[:2]
  side = mesh.interior
  one, two = of_elem[side // 3], of_elem[mesh.twin[side] // 3]
  keep = (one >= 0) & (two >= 0) & (one != two)
  one, two, side = one[keep], two[keep], side[keep]
  # Parallel ones end at different ends of the side between them.
  at = mesh.elem.ravel()[side]
  meets = (at == start[one]) | (at == end[one])
  turned = (meets == ((at == start[two]) | (at == end[two]))).astype(float)
  n = len(quad)
  ends = np.concatenate([one, two]), np.concatenate([two, one])
  graph = sparse.csr_matrix((np.tile(turned + 1, 2), ends), shape=(n, n))
  count, patch = csgraph.connected_components(graph, directed=False)
  flip = np.zeros(n, bool)
  for first in np.unique(patch, return_index=True)[1]:
    order, before = csgraph.breadth_first_order(graph, first, directed=False)
    weight = np.asarray(graph[before[order[1:]], order[1:]]).ravel() if len(order) > 1 else []
    for q, w in zip(order[1:], weight, strict=True):
      flip[q] = flip[before[q]] ^ (w > 1.5)
    if flip[order].sum() > len(order) / 2:
      flip[order] ^= True
  return flip & _pays(mesh, quad, flip, patch, count)


def _pays(mesh: Mesh, quad, flip, patch, count: int) -> np.ndarray:
  """Returns whether turning the diagonals of a patch brings its vertices near six neighbours."""
  corner = np.stack(_corners(mesh, quad))
  change = np.zeros(mesh.nvert, np.int64)
  for ends, by in ((corner[:2], -1), (corner[2:], 1)):
    np.add.at(change, ends[:, flip].ravel(), by)
  inside = np.ones(mesh.nvert, bool)
  open_ = mesh.twin < 0
  inside[mesh.elem.ravel()[open_]] = False
  vert, home = np.unique(np.stack([corner.ravel(), np.tile(patch, 4)]), axis=1)
  off = [np.bincount(home, inside[vert] * (mesh.degree[vert] + by - 6) ** 2, count)
         for by in (0, change[vert])]  # fmt: skip
  return (off[1] <= _PAYS * off[0])[patch] & (off[0] > 0)[patch]
