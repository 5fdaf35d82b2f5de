"""Moves vertices of a solid onto a sheet in the rest shape, as far as its tetrahedra allow."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from .fill import quality
from .mesh import Mesh, among, area_vectors, cross, distinct, lengths
from .path import closest
from .path import distance as along_path
from .sheet import Where

_LEAST = 0.15  # quality of a tetrahedron that is moved, or so much of what it had
_KEEP = 0.9
_TURN = 0.95  # least cosine between a triangle's normals before and after
_TRIES = 10
_RISE = 1.005  # times its energy that the tissue around a vertex may have when it was moved
_LESS = 0.7
_GIVES = 0.1  # share of its way down to which a vertex inside gives way to one of the skin
_MOUTH = 0.75  # edges from the path within which a vertex of the skin goes to it
_VOLUME = 3  # times that the volume is put right

# Energy of tetrahedra [J], (n,), from their corners at rest and the displacements of these,
# (n, 4, 3) each, and their numbers (n,).
Energy = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Moves:
  """How vertices were moved.

  Attributes:
    rest: rest positions of all vertices [m]                        (nvert, 3)
    vert: those that were moved                                     (n,)
    corner: where they lie in the mesh before: corners of a tetrahedron (n, 4)
    weight: and their weights                                       (n, 4)
  """

  rest: np.ndarray
  vert: np.ndarray
  corner: np.ndarray
  weight: np.ndarray


def move(
  mesh: Mesh,
  vert: np.ndarray,
  where: Where,
  path: np.ndarray,
  pinned: np.ndarray,
  u: np.ndarray,
  energies: tuple[Energy | None, float],
) -> Moves:
  """Moves vertices onto a sheet.

  Those on the skin stay on it, and go to the path where that is near; those on the walls of older
  cuts and pinned ones stay. A vertex gets the displacement of where it goes to.

  Args:
    mesh: the solid
    vert: vertices
    where: where all vertices are beside the sheet
    path: samples of the path on the skin [m]   (n, 3)
    pinned: vertices that do not move           (nvert,) bool
    u: displacement of the vertices [m]         (nvert, 3)
    energies: of tetrahedra, or None, and by how much that around a vertex may rise [J]
  """
  wall = among(mesh.nvert, mesh.elem[mesh.whole.nelem :].ravel())
  vert = vert[~(wall | pinned)[vert]]
  goal = where.at[vert]
  outer = vert < mesh.nskin
  if outer.any():
    goal[outer] = _on_skin(mesh, vert[outer], goal[outer], path)
  tets = _Around(mesh, vert)
  corner, weight, own = tets.weights(goal)
  share = _shares(mesh, tets, vert, goal, corner, weight, u, energies)
  weight = own + share[:, None] * (weight - own)
  moved = share > 0
  rest = mesh.rest.copy()
  rest[vert] += share[:, None] * (goal - rest[vert])
  _keep_volume(mesh, rest, vert[outer & moved])
  return Moves(rest, vert[moved], corner[moved], weight[moved])


def _on_skin(mesh: Mesh, vert: np.ndarray, goal: np.ndarray, path: np.ndarray) -> np.ndarray:
  """Returns where vertices of the skin go on it."""
  far, at = along_path(path, mesh.rest[vert])
  near = far < _MOUTH * mesh.whole.edge_length
  goal = np.where(near[:, None], at, goal)
  skin = mesh.elem[: mesh.whole.nelem]
  tri, k = np.nonzero(among(mesh.nvert, vert)[skin])
  own = np.searchsorted(vert, skin[tri, k])
  a, b, c = np.moveaxis(mesh.rest[skin[tri]], 1, 0)
  weight, far = closest(goal[own], a, b, c)
  order = np.lexsort((far, own))
  best = order[np.append(True, np.diff(own[order]) != 0)]
  return np.einsum("nk,nkj->nj", weight[best], mesh.rest[skin[tri[best]]])


class _Around:
  """The tetrahedra around some vertices.

  Args:
    mesh: the solid
    vert: vertices, ascending
  """

  def __init__(self, mesh: Mesh, vert: np.ndarray):
    self._mesh, self._vert = mesh, vert
    number = np.full(mesh.nvert, -1)
    number[vert] = np.arange(len(vert))
    self.tet = np.flatnonzero(among(mesh.nvert, vert)[mesh.tet].any(axis=1))
    self.mover = number[mesh.tet[self.tet]]
    self.skin = np.flatnonzero(among(mesh.nvert, vert)[mesh.elem].any(axis=1))
    self.skin_mover = number[mesh.elem[self.skin]]

  def weights(self, goal: np.ndarray):
    """Returns the corners of the tetrahedron of each goal, its weights, and those before."""
    mesh, vert = self._mesh, self._vert
    i, k = np.nonzero(self.mover >= 0)
    own, corner = self.mover[i, k], mesh.tet[self.tet[i]]
    x = mesh.rest[corner]
    arm = np.linalg.inv(x[:, 1:] - x[:, :1])
    part = np.einsum("nj,njk->nk", goal[own] - x[:, 0], arm)
    weight = np.concatenate([1 - part.sum(axis=1, keepdims=True), part], axis=1)
    order = np.lexsort((-weight.min(axis=1), own))
    best = order[np.append(True, np.diff(own[order]) != 0)] if len(order) else order
    corner, weight = corner[best], weight[best]
    return corner, weight, (corner == vert[:, None]).astype(float)


def _shares(mesh: Mesh, tets: _Around, vert, goal, corner, weight, u, energies) -> np.ndarray:
  """Returns how far of its way each vertex goes, (n,).

  So far that no tetrahedron gets thin and the skin does not turn, and that the energy around none
  rises.
  """
  energy, given = energies
  energy = energy if energy is not None and u.any() else None
  ids, sides = mesh.tet[tets.tet], mesh.elem[tets.skin]
  way = goal - mesh.rest[vert]
  lead = np.einsum("nk,nkj->nj", weight, u[corner]) - u[vert]
  before, normal = quality(mesh.rest, ids), _normals(mesh.rest[sides])
  least = np.minimum(_LEAST, _KEEP * before)
  had = np.zeros(0) if energy is None else energy(mesh.rest[ids], u[ids], tets.tet)
  share, inner = np.ones(len(vert)), vert >= mesh.nskin
  for k in range(_TRIES + 1):
    rest = mesh.rest.copy()
    rest[vert] += share[:, None] * way
    bad = quality(rest, ids) < least
    turned = (_normals(rest[sides]) * normal).sum(axis=1) < _TURN
    # Those inside give way to those of the skin, where the path is seen.
    movers = np.where(bad[:, None], tets.mover, -1)
    gives = (movers >= 0) & inner[movers] & (share[movers] > _GIVES)
    movers = np.where(gives | ~gives.any(axis=1, keepdims=True), movers, -1)
    less = distinct(movers, tets.skin_mover[turned])
    if energy is not None:
      moved = u.copy()
      moved[vert] += share[:, None] * lead
      has, fine = had.copy(), ~bad
      has[fine] = energy(rest[ids[fine]], moved[ids[fine]], tets.tet[fine])
      old, new = (
        np.bincount(tets.mover.ravel() + 1, np.repeat(e, 4), len(vert) + 1)[1:] for e in (had, has)
      )
      less = distinct(less, np.flatnonzero(new > _RISE * old + given))
    less = less[less >= 0]
    less = less[share[less] > 0]
    if not less.size:
      break
    share[less] *= _LESS if k + 1 < _TRIES else 0.0
  return share


def _normals(corner: np.ndarray) -> np.ndarray:
  area = cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
  return area / np.maximum(lengths(area), 1e-300)[:, None]


def _keep_volume(mesh: Mesh, rest: np.ndarray, vert: np.ndarray):
  """Moves vertices of the skin along its normals by so little that what it encloses stays."""
  if not vert.size:
    return
  skin = mesh.elem[among(mesh.nvert, vert)[mesh.elem].any(axis=1)]

  def enclosed(x):
    a, b, c = np.moveaxis(x[skin] - mesh.rest[vert[0]], 1, 0)
    return (a * cross(b, c)).sum() / 6

  for _ in range(_VOLUME):
    lost = enclosed(mesh.rest) - enclosed(rest)
    area = np.zeros_like(rest)
    np.add.at(area, skin, area_vectors(rest, skin)[:, None] / 3)
    area = area[vert]
    rest[vert] += lost * area / (area**2).sum()


def keep_spin(mass: np.ndarray, was: np.ndarray, now: np.ndarray, v: np.ndarray) -> np.ndarray:
  """Returns velocities with which nodes, some of them moved, keep momentum and angular momentum.

  That is `v` and a slow rotation of them all about their centre.
  """
  if len(mass) < 3:
    return v
  spin = (mass[:, None] * cross(was - now, v)).sum(axis=0)
  arm = now - (mass[:, None] * now).sum(axis=0) / mass.sum()
  inertia = (mass * (arm**2).sum(axis=1)).sum() * np.eye(3) - (mass * arm.T) @ arm
  omega = np.linalg.lstsq(inertia, spin, rcond=1e-6)[0]
  return v + cross(omega[None], arm)
