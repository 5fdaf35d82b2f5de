"""Faces between tetrahedra, and what comes apart where some of them are opened.

A corner has the number 4 t + k, of tetrahedron t; a face that of the corner opposite. Tetrahedra
keep their numbers. A vertex becomes as many as there are parts of the tetrahedra around it that
hang together by faces. Those of the skin come first, those inside last; what comes on to the
surface takes the numbers between, of spare vertices, and its old ones are used no more.
"""

import dataclasses

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from .fill import FACES, flips, joined, key_of
from .mesh import Mesh, among, build, distinct

MORE = 6  # neighbours beyond those of any vertex that one may have by cuts
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def cuttable(surface: Mesh, solid: Mesh) -> Mesh:
  """Returns a solid with room for cuts: its triangles are faces of tetrahedra that it knows.

  `fill` lets a pair of triangles have the other diagonal; here it has that of the tetrahedra.

  Args:
    surface: a surface with spare vertices
    solid: the same without them, with its inside
  """
  first, spare = solid.nouter, surface.spare
  tet = np.where(solid.tet < first, solid.tet, solid.tet + spare)
  mesh, elem = joined(surface, solid.rest[first:], tet), surface.elem
  mate = _mates(tet)
  corner = corners(np.flatnonzero(mate < 0))
  known = key_of(tet.ravel()[corner], mesh.nvert)
  order = np.argsort(known)

  def find(triangle):
    key = key_of(triangle, mesh.nvert)
    at = order[np.searchsorted(known, key, sorter=order).clip(0, len(order) - 1)]
    return np.where(known[at] == key, at, -1)

  at = find(elem)
  for s, t, others in flips(elem, np.flatnonzero(at < 0)):
    found = find(others)
    if (found >= 0).all() and at[s] < 0 and at[t] < 0:
      at[[s, t]] = found
  left = np.setdiff1d(np.arange(len(known)), at)
  face = tet.ravel()[corner[left]]
  for part in _patches(elem, np.flatnonzero(at < 0)):
    fits = left[np.isin(face, elem[part]).all(axis=1)]
    if len(fits) != len(part):
      raise ValueError(
        f"spare is {spare}, and triangle {part[0]} (vertices {elem[part[0]].tolist()}) is the face "
        "of no tetrahedron, expected a surface of even triangles: `palpate wrap` makes one"
      )
    at[part] = fits
  corner = corner[at]
  more = np.full((len(mesh.ring), MORE), -1)
  rings = {name: np.hstack([getattr(mesh, name), more]) for name in ("ring", "ring_elem")}
  mesh = dataclasses.replace(mesh, **rings)
  # The first corner stays, where it can.
  turn = (tet.ravel()[corner] == elem[:, :1]).argmax(axis=1)
  corner = np.take_along_axis(corner, (turn[:, None] + np.arange(3)) % 3, axis=1)
  elem = tet.ravel()[corner]
  twin = build("solid", surface.rest, elem, spare).twin
  return dataclasses.replace(mesh, elem=elem, twin=twin, of_tet=corner, mate=mate)


def room(mesh: Mesh) -> np.ndarray:
  """Returns the most neighbours that each vertex of a solid can have, cut or not, (nvert,).

  At the end of a cut one has those on both of its sides around it: it becomes a spare one then.
  """
  most = mesh.whole.degree.copy()
  most[mesh.spares] = most.max() + MORE
  return most


def _mates(tet: np.ndarray) -> np.ndarray:
  """Returns the face on the other side of each face, -1 for none, (4 ntet,)."""
  key = key_of(tet[:, FACES].reshape(-1, 3), int(tet.max(initial=0)) + 1)
  order = np.argsort(key, kind="stable")
  same = np.flatnonzero(key[order][1:] == key[order][:-1])
  out = np.full(len(key), -1)
  a, b = order[same], order[same + 1]
  out[a], out[b] = b, a
  return out


def _patches(elem: np.ndarray, some: np.ndarray) -> list[np.ndarray]:
  """Returns triangles in the parts in which they share edges."""
  edge = np.sort(np.stack([elem[some], elem[some][:, [1, 2, 0]]], axis=2).reshape(-1, 2), axis=1)
  _, number = np.unique(edge, axis=0, return_inverse=True)
  own = np.repeat(np.arange(len(some)), 3)
  ends = own, len(some) + number.ravel()
  size = len(some) + len(edge)
  graph = sparse.coo_array((np.ones(len(own), np.int8), ends), shape=(size, size))
  label = csgraph.connected_components(graph, directed=False)[1][: len(some)]
  return [some[label == k] for k in np.unique(label)]


def corners(face: np.ndarray) -> np.ndarray:
  """Returns the corners of faces, as their triangles have them, (n, 3)."""
  return face[:, None] // 4 * 4 + FACES[face % 4]


def opened(mesh: Mesh) -> np.ndarray:
  """Returns the faces that were opened, in the order of their triangles, both of each pair."""
  return corner_face(mesh.of_tet[mesh.whole.nelem :])


def corner_face(corner: np.ndarray) -> np.ndarray:
  """Returns the faces that have these corners of a tetrahedron, (n,) of (n, 3)."""
  return corner[:, 0] // 4 * 4 + 6 - (corner % 4).sum(axis=1)


def around(tet: np.ndarray, mate: np.ndarray, vert: np.ndarray, nvert: int):
  """Returns what is around vertices, in parts that hang together.

  Args:
    tet: tetrahedra                             (ntet, 4)
    mate: the face on the other side of each    (4 ntet,)
    vert: some vertices
    nvert: number of all

  Returns:
    their corners, ascending (n,), the part that each is in (n,), and of each part its vertex and
    its first corner, ascending by these
  """
  flat = tet.ravel()
  corner = np.flatnonzero(among(nvert, vert)[flat])
  own = flat[corner]
  face = corner[:, None] // 4 * 4 + _OTHERS[corner % 4]
  other = mate[face]
  i, j = np.nonzero(other >= 0)
  t = other[i, j] // 4
  ends = i, np.searchsorted(corner, 4 * t + (tet[t] == own[i, None]).argmax(axis=1))
  graph = sparse.coo_array((np.ones(len(i), np.int8), ends), shape=(len(corner), len(corner)))
  label = csgraph.connected_components(graph, directed=False)[1]
  _, first, part = np.unique(label, return_index=True, return_inverse=True)
  order = np.lexsort((first, own[first]))
  rank = np.empty(len(order), int)
  rank[order] = np.arange(len(order))
  first = first[order]
  return corner, rank[part], own[first], corner[first]


def grown(mesh: Mesh, rest: np.ndarray, tet: np.ndarray, of_tet: np.ndarray):
  """Returns a solid with other rest positions, corners and triangles, of the same whole.

  Returns:
    the solid, and the tetrahedra that are not as they were, ascending

  Raises:
    ValueError: vertices have no room for their neighbours.
  """
  whole = mesh.whole
  apart = (tet != mesh.tet).any(axis=1)
  moved = (rest != mesh.rest).any(axis=1)
  changed = np.flatnonzero(apart | moved[tet].any(axis=1) | moved[mesh.tet].any(axis=1))
  if len(of_tet) == whole.nelem:
    return whole, changed
  elem = tet.ravel()[of_tet]
  loose = np.ones(len(elem), bool)
  loose[: whole.nelem] = False if mesh.loose is None else mesh.loose[: whole.nelem]
  vert = distinct(tet[apart], mesh.tet[apart])
  ring, degree = mesh.ring.copy(), mesh.degree.copy()
  near, degree[vert] = _rings(tet, vert, mesh.nvert)
  if (degree > room(mesh)).any():
    raise ValueError("vertices have no room for their neighbours")
  ring[vert] = -1
  ring[vert, : near.shape[1]] = near
  changes = dict(rest=rest, elem=elem, tet=tet, of_tet=of_tet, ring=ring, degree=degree)
  return dataclasses.replace(mesh, **changes, loose=loose, uncut=whole), changed


def _rings(tet: np.ndarray, vert: np.ndarray, nvert: int):
  """Returns the vertices that edges lead to from some, ascending, and how many they are."""
  corner = np.flatnonzero(among(nvert, vert)[tet.ravel()])
  own = np.repeat(tet.ravel()[corner], 3)
  key = distinct(own * nvert + tet[corner[:, None] // 4, _OTHERS[corner % 4]].ravel())
  own = np.searchsorted(vert, key // nvert)
  degree = np.bincount(own, minlength=len(vert))
  ring = np.full((len(vert), int(degree.max(initial=0))), -1)
  ring[own, np.arange(len(key)) - (np.cumsum(degree) - degree)[own]] = key % nvert
  return ring, degree


def restored(whole: Mesh, rest: np.ndarray, face: np.ndarray, seat: np.ndarray) -> np.ndarray:
  """Returns the tetrahedra of a solid some of whose faces are open.

  Args:
    whole: the solid before the first cut
    rest: rest positions [m]            (nvert, 3)
    face: the open ones, both of each pair  (n,)
    seat: a corner of each spare vertex that is used, in their order (m,)

  Raises:
    ValueError: these do not fit together.
  """
  mate, first = whole.mate.copy(), whole.nouter
  closed = (face < 0) | (face >= len(mate))
  if closed.any() or (mate[face] < 0).any() or not np.isin(mate[face], face).all():
    raise ValueError("faces that are none")
  if ((seat < 0) | (seat >= len(mate))).any() or len(seat) > whole.spare:
    raise ValueError("corners that are none")
  mate[face] = -1
  corner, part, vert, _ = around(whole.tet, mate, whole.tet.ravel()[seat], whole.nvert)
  name = vert.copy()
  name[part[np.searchsorted(corner, seat)]] = first + np.arange(len(seat))
  tet = whole.tet.copy()
  tet.ravel()[corner] = name[part]
  if (name >= whole.nskin).any():
    raise ValueError("vertices without a number")
  return tet
