"""What holds an organ's vertices, or leads to its surface, follows it where it is cut.

A vertex is the corner of some triangles, and these keep their numbers: what became of it is what
these corners are now. So it follows from the mesh alone, whichever way that came to be.
"""

import dataclasses

import numpy as np
from palpate.tissue.cutting import path as paths
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh


@dataclasses.dataclass(frozen=True)
class Held:
  """What became of some vertices.

  Attributes:
    row: which of them, ascending                  (m,)
    vert: a vertex that it is now                  (m,)
    share: of its area, which add up to 1          (m,)
    shift: how far it was moved at rest [m]        (m, 3)
  """

  row: np.ndarray
  vert: np.ndarray
  share: np.ndarray
  shift: np.ndarray


class Grip:
  """Some vertices of a mesh.

  Args:
    mesh: the mesh
    vert: the vertices  (n,)
  """

  def __init__(self, mesh: Mesh, vert: np.ndarray):
    self.vert, self._rest = vert, mesh.rest[vert]
    if len(mesh.tet):  # whose triangles keep their numbers too, those on its skin
      elem = mesh.elem[: mesh.whole.nelem].reshape(-1)
      number = np.full(mesh.nvert, -1)
      number[vert] = np.arange(len(vert))
      self._corner = np.flatnonzero(number[elem] >= 0)
      self._row = number[elem[self._corner]]
      return
    half = mesh.ring_elem[vert]
    self._row, k = np.nonzero(half >= 0)
    self._corner = half[self._row, k]

  def now(self, mesh: Mesh) -> Held:
    """Returns what they are in a mesh of the same whole."""
    if not mesh.spare:  # it is never cut
      n = len(self.vert)
      return Held(np.arange(n), self.vert, np.ones(n), np.zeros((n, 3)))
    now = mesh.elem.reshape(-1)[self._corner]
    apart = topology.among(len(self.vert), self._row[now != self.vert[self._row]])
    there = apart[self._row]
    of, corner, now = self._row[there], self._corner[there], now[there]
    area = topology.lengths(topology.area_vectors(mesh.rest, mesh.elem[corner // 3]))
    key, number = np.unique(of * mesh.nvert + now, return_inverse=True)
    parts = key // mesh.nvert
    share = np.bincount(number, area) / np.bincount(of, area, len(self.vert))[parts]
    whole = np.flatnonzero(~apart)
    row = np.append(whole, parts)
    order = np.argsort(row, kind="stable")
    row, vert = row[order], np.append(self.vert[whole], key % mesh.nvert)[order]
    share = np.append(np.ones(len(whole)), share)[order]
    return Held(row, vert, share, mesh.rest[vert] - self._rest[row])


class Spots:
  """Points of the triangles of a mesh.

  Args:
    mesh: the mesh
    elem: triangles                (n,)
    weight: of their corners       (n, 3)
  """

  def __init__(self, mesh: Mesh, elem: np.ndarray, weight: np.ndarray):
    self._elem, self._weight, self._rest = elem, weight, mesh.rest[mesh.elem[elem]]

  def now(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns where they are in a mesh of the same whole.

    Returns:
      vertices (n, 3) and their weights (n, 3), and what turns the axes of the triangles that they
      were in to those of the ones that they are in now (n, 3, 3)
    """
    elem, weight = found_again(mesh, self._elem, self._weight, self._rest)
    corner = mesh.elem[elem]
    was, now = axes(self._rest), axes(mesh.rest[corner])
    return corner, weight, now @ was.transpose(0, 2, 1)


def found_again(
  mesh: Mesh, elem: np.ndarray, weight: np.ndarray, rest: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Returns triangles and weights of points that were in triangles of the same whole.

  Args:
    mesh: the mesh
    elem: the triangles            (n,)
    weight: of their corners       (n, 3)
    rest: where these were [m]     (n, 3, 3)
  """
  elem, weight = elem.copy(), weight.copy()
  moved = (mesh.rest[mesh.elem[elem]] != rest).any(axis=(1, 2))
  if moved.any():
    at = np.einsum("nk,nkj->nj", weight[moved], rest[moved])
    elem[moved], weight[moved], _ = paths.nearest(mesh, mesh.rest, at)
  return elem, weight


def axes(corner: np.ndarray) -> np.ndarray:
  """Returns axes of triangles (n, 3, 3), as `set_axes` in forces/cohesive_bonds.h, row by row."""
  edge = corner[:, 1] - corner[:, 0]
  area = topology.cross(edge, corner[:, 2] - corner[:, 0])
  x, z = (a / np.maximum(topology.lengths(a)[:, None], 1e-300) for a in (edge, area))
  return np.stack([x, topology.cross(z, x), z], axis=1)


def pairs(mine: Held, theirs: Held) -> tuple[np.ndarray, np.ndarray]:
  """Returns what of two lists has the same row: places in the first and in the second one."""
  count = np.bincount(theirs.row)
  start, many = np.cumsum(count) - count, count[mine.row]
  a = np.repeat(np.arange(len(mine.row)), many)
  within = np.arange(len(a)) - np.repeat(np.cumsum(many) - many, many)
  return a, start[mine.row[a]] + within
