"""Fills a closed surface with tetrahedra that have its triangles as their faces.

Nodes inside are a body-centred cubic lattice, moved where the tetrahedra around them have their
middle (the centroidal relaxation of optimal Delaunay triangulations, Alliez et al. 2005,
doi:10.1145/1073204.1073238), and all nodes are joined by Delaunay's criterion. On a surface of even
triangles that has the surface's triangles among its faces, but for some pairs of which it has the
other diagonal: these serve as well. Where it has neither, there is an error. In a flat patch, as
`refine` makes them, flat tetrahedra lie between the two triangulations and are left out.
"""

import dataclasses
import functools

import numpy as np
import scipy
from scipy import sparse
from scipy.sparse import csgraph, linalg

from .. import keep
from .mesh import Mesh, area_vectors, vertex_normals

MOST = 2  # nodes inside for one on the surface; the plugin state has room for so many
_COARSER = 1.7  # distance of nodes inside to that on the surface
_FINE = 1.2  # the same where triangles are of different sizes: small ones are where forces count
_GRADED = 1.3  # times their mean edge that those are on most of the surface
_CLEAR = 0.8  # least distance of a node inside to the surface's, in mean edges
_BENEATH = 0.2  # least depth, likewise, where triangles are of different sizes
_EVEN = 1.0  # edges beneath the surface to which the distance between nodes stays,
_WIDENS = 0.3  # and by which it grows with depth from there on,
_WIDEST = 3.0  # at most to so many edges of the surface
_ROUNDS = 8
_MOVE = 0.7  # share of the way that a node goes in a round
FLAT = 1e-3  # quality of a tetrahedron that is none
_SHALLOW = 0.02  # that of one between two triangles that fold by some 2 degrees
_KEPT = 16
_VERSION = 6  # of what is kept in files: another one where tetrahedra are made otherwise
_TIE = 1e-6  # of the size's square, by which points on one sphere are told apart

# Faces of a tetrahedron, each opposite the corner of its number.
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


def fill(organ: str, mesh: Mesh) -> Mesh:
  """Returns the surface with its inside: the same vertices and triangles, more vertices after them.

  Args:
    organ: name of the organ, for messages
    mesh: its surface

  Raises:
    ValueError: the surface encloses nothing, its triangles are faces of no Delaunay tetrahedra, or
      it has no room for these.
  """
  if not mesh.closed:
    raise ValueError(f"organ {organ!r}: elements is 'solid', expected a closed surface")
  inner, tet, missing = _fill(mesh.rest.tobytes(), mesh.elem.astype(np.int64).tobytes())
  if missing >= 0:
    raise ValueError(
      f"organ {organ!r}: elements is 'solid', and triangle {missing} (vertices "
      f"{mesh.elem[missing].tolist()}) cannot be the face of a tetrahedron; expected a surface of "
      "even triangles that does not cut itself: `palpate wrap` makes one"
    )
  bare = np.setdiff1d(np.arange(mesh.nvert), tet)
  if bare.size:
    raise ValueError(
      f"organ {organ!r}: elements is 'solid', and at vertex {bare[0]} there is no room for "
      "tetrahedra; expected a surface that is thicker than a hundredth of its edges"
    )
  return joined(mesh, inner, tet)


def joined(mesh: Mesh, inner: np.ndarray, tet: np.ndarray) -> Mesh:
  """Returns a surface with vertices inside and tetrahedra.

  The ring of a vertex then is what edges of tetrahedra lead to, in the order of the vertices.

  Args:
    mesh: the surface
    inner: rest positions of the vertices inside [m]                    (n, 3)
    tet: corners of each tetrahedron, of positive volume, among all     (ntet, 4)
  """
  rest = np.concatenate([mesh.rest, inner])
  edge = tet[:, _EDGES].reshape(-1, 2)
  both = np.unique(np.concatenate([edge, edge[:, ::-1]]), axis=0)
  degree = np.bincount(both[:, 0], minlength=len(rest))
  ring = np.full((len(rest), int(degree.max())), -1)
  ring[both[:, 0], np.arange(len(both)) - (np.cumsum(degree) - degree)[both[:, 0]]] = both[:, 1]
  return dataclasses.replace(
    mesh, rest=rest, ring=ring, ring_elem=np.full_like(ring, -1), degree=degree, tet=tet
  )


def volumes(point: np.ndarray, tet: np.ndarray) -> np.ndarray:
  """Returns the volume of each tetrahedron [m^3], (ntet,); the winding gives the sign."""
  corner = point[tet]
  return np.linalg.det(corner[:, 1:] - corner[:, :1]) / 6


def vertex_volumes(mesh: Mesh, value: np.ndarray | float = 1.0) -> np.ndarray:
  """Returns a quarter of the volume of the tetrahedra around each vertex [m^3], (nvert,).

  Args:
    mesh: the solid
    value: by which each tetrahedron's counts, (ntet,) or one for all
  """
  share = np.repeat(value * volumes(mesh.rest, mesh.tet) / 4, 4)
  return np.bincount(mesh.tet.ravel(), share, mesh.nvert)


def quality(point: np.ndarray, tet: np.ndarray) -> np.ndarray:
  """Returns 6 sqrt(2) volume / (RMS edge)^3 of each tetrahedron, 1 for a regular one, (ntet,)."""
  corner = point[tet]
  edge = corner[:, _EDGES[:, 0]] - corner[:, _EDGES[:, 1]]
  length2 = (edge**2).sum(axis=(1, 2)) / 6
  return 6 * np.sqrt(2) * volumes(point, tet) / np.maximum(length2, 1e-300) ** 1.5


def inside(mesh: Mesh, values: np.ndarray) -> np.ndarray:
  """Returns vectors of the surface's vertices, (nouter, 3), with those inside, (nvert, 3).

  A vertex inside has the mean of those around it, one that waits for a cut or is no more has 0.
  """
  n = mesh.nouter
  if not len(mesh.tet):  # what else there is waits for cuts
    return np.concatenate([values, np.zeros((mesh.nvert - n, 3))])
  start, k = np.nonzero(mesh.ring >= 0)
  ones = np.ones(len(start))
  place, size = (start, mesh.ring[start, k]), (mesh.nvert, mesh.nvert)
  share = sparse.csr_array((ones / mesh.degree[start], place), shape=size)
  below = share[n:]
  matrix = sparse.eye_array(mesh.nvert - n) - below[:, n:]
  within = linalg.spsolve(sparse.csc_array(matrix), below[:, :n] @ values)
  return np.concatenate([values, np.asarray(within).reshape(-1, 3)])


@functools.lru_cache(maxsize=_KEPT)
def _fill(rest: bytes, elem: bytes) -> tuple[np.ndarray, np.ndarray, int]:
  """Returns the vertices inside, the tetrahedra and the first triangle that is not among them."""

  def make() -> dict[str, np.ndarray]:
    inner, tet, faulty = _make(rest, elem)
    return {"inner": np.frombuffer(inner), "tet": tet, "faulty": np.array([faulty])}

  found = keep.arrays("fill", f"{_VERSION} {len(rest)} ".encode() + rest + elem, make)
  return found["inner"].reshape(-1, 3), found["tet"], int(found["faulty"][0])


def forget():
  """Forgets the surfaces that this process has filled."""
  _fill.cache_clear()


def _make(rest: bytes, elem: bytes) -> tuple[bytes, np.ndarray, int]:
  surface = np.frombuffer(rest).reshape(-1, 3)
  triangle = np.frombuffer(elem, np.int64).reshape(-1, 3)
  inner = _lattice(surface, triangle)
  best, found, faulty = FLAT, None, -1
  for _ in range(_ROUNDS):
    point = np.concatenate([surface, inner])
    tet, faulty = _inside(point, triangle, len(surface))
    if faulty >= 0:
      break
    used = np.zeros(len(point), bool)
    used[tet] = used[: len(surface)] = True
    tet, point = (np.cumsum(used) - 1)[tet], point[used]
    least = float(quality(point, tet).min(initial=1.0))
    if least > best:
      best, found = least, (point[len(surface) :].tobytes(), tet)
    inner = point + _MOVE * (_middles(point, tet) - point)
    inner = inner[len(surface) :]
  return (*found, -1) if found else (b"", np.zeros((0, 4), int), faulty)


def _lattice(surface: np.ndarray, triangle: np.ndarray) -> np.ndarray:
  """Returns the points of a lattice inside, (n, 3); some that are outside may be among them.

  It is half as wide wherever the surface's triangles are half as large, and widens inward.
  """
  normal = vertex_normals(surface, triangle)
  length = np.linalg.norm(surface[triangle[:, [1, 2, 0]]] - surface[triangle], axis=2).mean(axis=1)
  area = np.linalg.norm(area_vectors(surface, triangle), axis=1)
  edge, widest = length.mean(), (area * length).sum() / area.sum()
  corners = triangle.ravel()
  local = np.bincount(corners, np.repeat(length, 3)) / np.bincount(corners)
  low, high = surface.min(axis=0), surface.max(axis=0)
  graded = widest > _GRADED * edge
  coarser = _FINE if graded else _COARSER
  tree = scipy.spatial.KDTree(surface)
  side = coarser * edge * 2 / np.sqrt(3)  # neighbours: half a diagonal
  ends = np.array([local.min(), 2.83 * _WIDEST * widest]) / edge
  levels = range(*np.rint(np.log2(ends)).astype(int))
  while True:
    parts = []
    for level in levels:
      scale = 2.0**level
      count = np.ceil((high - low) / (scale * side)).astype(int) + 1
      corner = low + scale * side * np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), -1)
      point = np.concatenate([corner.reshape(-1, 3), corner.reshape(-1, 3) + scale * side / 2])
      distance, nearest = tree.query(point)
      near = local[nearest]
      height = ((point - surface[nearest]) * normal[nearest]).sum(axis=1)
      wanted = np.minimum(near + _WIDENS * np.maximum(distance - _EVEN * near, 0), _WIDEST * widest)
      here = np.clip(np.rint(np.log2(wanted / edge)), levels[0], levels[-1]) == level
      clear = scale * edge
      if graded:  # a point near the middle of a large triangle can be far from all vertices
        clear = np.maximum(clear, near)
        height += _BENEATH * near
      parts.append(point[(height < 0) & here & (distance > _CLEAR * clear)])
    point = np.concatenate(parts)
    if len(point) <= MOST * len(surface):
      return point
    side *= max(1.05, (len(point) / (MOST * len(surface))) ** (1 / 3))


def _middles(point: np.ndarray, tet: np.ndarray) -> np.ndarray:
  """Returns the middle of the tetrahedra around each point, weighted by volume, (n, 3)."""
  weight = np.repeat(volumes(point, tet), 4)
  middle = np.repeat(point[tet].mean(axis=1), 4, axis=0)
  total = np.bincount(tet.ravel(), weight, len(point))
  sums = [np.bincount(tet.ravel(), weight * middle[:, k], len(point)) for k in range(3)]
  return np.stack(sums, axis=1) / np.maximum(total, 1e-300)[:, None]


def _inside(point: np.ndarray, triangle: np.ndarray, nsurface: int) -> tuple[np.ndarray, int]:
  """Returns the tetrahedra inside of a surface, and the first triangle that is no face, or -1.

  Args:
    point: all vertices, the surface's first        (n, 3)
    triangle: the surface                           (nelem, 3)
    nsurface: number of its vertices
  """
  tet, neighbour = _joined(point)
  face = tet[:, FACES]
  has = (face < nsurface).all(axis=2)
  known = np.where(has, key_of(np.minimum(face, nsurface - 1), nsurface), -1)
  wanted, faulty = _flipped(triangle, np.unique(known), nsurface)
  if faulty >= 0:
    return tet, faulty
  # What no triangle parts lies on one side.
  through = ~np.isin(known, wanted) & (neighbour >= 0)
  start = np.broadcast_to(np.arange(len(tet))[:, None], neighbour.shape)
  ends = (start[through], neighbour[through])
  graph = sparse.coo_matrix((np.ones(len(ends[0])), ends), shape=(len(tet), len(tet)))
  count, part = csgraph.connected_components(graph, directed=False)
  # The side of a triangle on which the corner is that its tetrahedron has beside it.
  which, corner = np.nonzero(np.isin(known, wanted))
  order = np.argsort(wanted)
  at = order[np.searchsorted(wanted, known[which, corner], sorter=order)]
  side = point[tet[which, corner]] - point[triangle[at, 0]]
  height = (side * area_vectors(point, triangle)[at]).sum(axis=1)
  sure = wanted[at] == key_of(triangle[at], nsurface)  # others were flipped
  within = np.bincount(part[which], np.where(sure, np.sign(height), 0), count)[part] < 0
  tet = np.where((volumes(point, tet) < 0)[:, None], tet[:, [0, 2, 1, 3]], tet)
  # A flat one has a pair of the surface's triangles; without it they have the other diagonal.
  even = quality(point, tet)
  outer = np.bincount(which, minlength=len(tet))
  while (flat := within & (outer > 1) & (even <= np.where(outer == 2, _SHALLOW, FLAT))).any():
    within &= ~flat
    beneath = neighbour[flat]
    np.add.at(outer, beneath[beneath >= 0], 1)
  return tet[within], -1


def _joined(point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the tetrahedra between points, and their neighbours opposite each corner or -1, (n, 4).

  Delaunay's are the lower hull of the points lifted to a paraboloid. Points on one sphere are told
  apart by heights that are a little off it, at random: four in a plane make no tetrahedron so.
  """
  at = (point - point.mean(axis=0)) / np.ptp(point, axis=0).max()
  height = (at**2).sum(axis=1) + _TIE * np.random.RandomState(0).uniform(-1, 1, len(at))
  hull = scipy.spatial.ConvexHull(np.column_stack([at, height]))
  low = hull.equations[:, 3] < 0
  number = np.append(np.where(low, np.cumsum(low) - 1, -1), -1)
  return hull.simplices[low].astype(np.int64), number[hull.neighbors[low]]


def key_of(corner: np.ndarray, n: int) -> np.ndarray:
  """Returns a number for the three vertices of each triangle, of n."""
  a, b, c = np.moveaxis(np.sort(corner.astype(np.int64), axis=-1), -1, 0)
  return (a * n + b) * n + c


def _flipped(triangle: np.ndarray, known: np.ndarray, n: int) -> tuple[np.ndarray, int]:
  """Returns the triangles as keys that are all known, and the first one that cannot be, or -1.

  Where two that share an edge are not, the two across the other diagonal may be.
  """
  key = key_of(triangle, n)
  missing = np.flatnonzero(~np.isin(key, known))
  if not missing.size:
    return key, -1
  left, faces = set(missing.tolist()), set(known.tolist())
  for s, t, others in flips(triangle, missing):
    flipped = key_of(others, n)
    if {s, t} <= left and faces >= set(flipped.tolist()):
      key[[s, t]] = flipped
      left -= {s, t}
  return key, min(left, default=-1)


def flips(elem: np.ndarray, some: np.ndarray):
  """Yields pairs of triangles that share an edge, and the two across the other diagonal."""
  beside: dict[frozenset, tuple[int, int]] = {}
  for t in some:
    for k in range(3):
      a, b, p = (int(elem[t, (k + i) % 3]) for i in range(3))
      s, q = beside.setdefault(frozenset((a, b)), (int(t), p))
      if s != t:
        yield s, int(t), np.array([[p, q, a], [p, q, b]])
