"""The organ's triangle surface: topology, checks, areas, normals, volume."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph


@dataclasses.dataclass(frozen=True)
class Mesh:
  """A consistently wound 2-manifold triangle surface.

  Attributes:
    rest: rest positions [m]                                        (nvert, 3) float64
    elem: corners of each triangle, counter-clockwise from outside  (nelem, 3)
    closed: whether there is no boundary edge
    twin: half-edge on the other side, -1 on the boundary           (3 nelem,)
    ring: neighbours of each vertex in counter-clockwise order, -1  (nvert, most)
    ring_elem: half-edge vertex -> ring[k]; -1 where it has no face (nvert, most)
    degree: number of neighbours                                    (nvert,)
    tet: corners of each tetrahedron, of positive volume, see `fill`(ntet, 4)
    spare: after those on the surface so many vertices may have no triangle yet: room for cuts
    uncut: the mesh before the first cut, None for one that has none
    loose: triangles that were cut free of the foundation, None for none    (nelem,) bool
    of_tet: corner of a tetrahedron that each of triangles is, of solids, see `faces` (nelem, 3)
    mate: faces beside those of tetrahedra before the first cut, see there (4 ntet,)
  """

  rest: np.ndarray
  elem: np.ndarray
  closed: bool
  twin: np.ndarray
  ring: np.ndarray
  ring_elem: np.ndarray
  degree: np.ndarray
  tet: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4), np.int64))
  spare: int = 0
  uncut: Mesh | None = None
  loose: np.ndarray | None = None
  of_tet: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3), np.int64))
  mate: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))

  @property
  def whole(self) -> Mesh:
    """The mesh before the first cut."""
    return self if self.uncut is None else self.uncut

  @functools.cached_property
  def centre(self) -> np.ndarray:
    """Mean of the rest positions before the first cut [m], (3,)."""
    if self.uncut is not None:
      return self.uncut.centre
    return np.delete(self.rest, self.spares, axis=0).mean(axis=0)

  @functools.cached_property
  def edge_length(self) -> float:
    """Mean length of the triangles' edges at rest [m]."""
    return float(
      np.linalg.norm(self.rest[self.elem[:, [1, 2, 0]]] - self.rest[self.elem], axis=2).mean()
    )

  @functools.cached_property
  def home(self) -> np.ndarray:
    """Number of the piece of surface that each triangle is in, (nelem,)."""
    return pieces(self)[self.elem[:, 0]]

  @functools.cached_property
  def interior(self) -> np.ndarray:
    """The half-edges that stand for the edges between two triangles, ascending."""
    return np.flatnonzero((self.twin >= 0) & (np.arange(len(self.twin)) < self.twin))

  @property
  def without_spare(self) -> Mesh:
    """The mesh without vertices that wait for a cut, where there is none yet."""
    if not self.spare:
      return self
    parts = {name: getattr(self, name)[: -self.spare] for name in _BY_VERTEX}
    return dataclasses.replace(self, spare=0, **parts)

  @property
  def unused(self) -> np.ndarray:
    """Whether a vertex waits for a cut, or is no more since one, (nvert,) bool."""
    return (self.degree == 0) & (self.spare > 0)

  @property
  def spares(self) -> slice:
    """The vertices that waited for the first cut: they follow those on the surface."""
    return slice(self.whole.nouter, self.whole.nouter + self.spare)

  @property
  def nskin(self) -> int:
    """Number of vertices that are on the surface or may come there by cuts, which come first."""
    return self.spares.stop

  @functools.cached_property
  def nouter(self) -> int:
    """Number of vertices on the surface, which come first."""
    return int(self.elem.max()) + 1

  @functools.cached_property
  def surface(self) -> Mesh:
    """The surface alone: of a solid, before the first cut, and without neighbours inside."""
    if not len(self.tet):
      return self
    if self.uncut is not None:
      return self.uncut.surface
    ring, ring_elem, degree = _rings("solid", self.elem, self.twin, self.nvert)
    return dataclasses.replace(
      self, ring=ring, ring_elem=ring_elem, degree=degree, tet=self.tet[:0]
    )

  @property
  def nvert(self) -> int:
    """Number of vertices."""
    return len(self.rest)

  @property
  def nelem(self) -> int:
    """Number of triangles."""
    return len(self.elem)


_BY_VERTEX = ("rest", "ring", "ring_elem", "degree")


def distinct(*numbers: np.ndarray) -> np.ndarray:
  """Returns the different ones of whole numbers, ascending, as `np.unique` but for short lists."""
  every = np.concatenate([each.ravel() for each in numbers])
  every.sort()
  first = np.empty(len(every), bool)
  first[:1] = True
  np.not_equal(every[1:], every[:-1], out=first[1:])
  return every[first]


def among(count: int, numbers: np.ndarray | list[int]) -> np.ndarray:
  """Returns which of the numbers under `count` are some of these, (count,) bool."""
  out = np.zeros(count, bool)
  out[numbers] = True
  return out


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  """Returns cross products of vectors: `np.cross`, which takes its time over a few of them."""
  return a[..., [1, 2, 0]] * b[..., [2, 0, 1]] - a[..., [2, 0, 1]] * b[..., [1, 2, 0]]


def lengths(vector: np.ndarray) -> np.ndarray:
  """Returns the lengths of vectors, (...) of (..., n)."""
  return np.sqrt(np.einsum("...i,...i->...", vector, vector))


def spread(points: np.ndarray, count: int) -> np.ndarray:
  """Returns up to `count` of the points, each farthest from those before (Gonzalez 1985)."""
  chosen, distance2 = [0], ((points - points[0]) ** 2).sum(axis=1)
  while len(chosen) < min(count, len(points)):
    chosen.append(int(distance2.argmax()))
    distance2 = np.minimum(distance2, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
  return np.array(chosen)


def area_vectors(position: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns the normal of each triangle times its area [m^2], (nelem, 3)."""
  a, b, c = (position[elem[:, k]] for k in range(3))
  return 0.5 * cross(b - a, c - a)


def vertex_areas(position: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns a third of the area of the triangles around each vertex [m^2], (nvert,)."""
  area = np.linalg.norm(area_vectors(position, elem), axis=1)
  return np.bincount(elem.ravel(), np.repeat(area / 3, 3), len(position))


def pieces(mesh: Mesh) -> np.ndarray:
  """Returns the number of the piece that each vertex is in, -1 if unused, (nvert,)."""
  a, b = mesh.elem.T[:2].ravel(), mesh.elem.T[1:].ravel()
  if len(mesh.tet):
    a, b = mesh.tet.T[:3].ravel(), mesh.tet.T[1:].ravel()
  graph = sparse.coo_array((np.ones(len(a), np.int8), (a, b)), shape=(mesh.nvert, mesh.nvert))
  label = csgraph.connected_components(graph, directed=False)[1]
  label[mesh.unused] = -1
  _, first, number = np.unique(label, return_index=True, return_inverse=True)
  order = np.argsort(np.argsort(np.where(label[first] < 0, -1, first)))  # by their first vertices
  return order[number] - int((label < 0).any())


def corners(mesh: Mesh, half: np.ndarray, k: int = 0) -> np.ndarray:
  """Returns where half-edges start; 1 for `k`: where they end; 2: what is opposite to them."""
  return mesh.elem.reshape(-1)[half - half % 3 + (half + k) % 3]


def opened(mesh: Mesh) -> np.ndarray:
  """Returns the half-edges of an organ's own surface that cuts have opened, ascending."""
  half = np.flatnonzero(mesh.whole.twin >= 0)
  other = mesh.whole.twin[half]
  apart = [corners(mesh, half, k) != corners(mesh, other, 1 - k) for k in (0, 1)]
  return half[np.logical_or(*apart)]


def around(mesh: Mesh, vert: np.ndarray) -> np.ndarray:
  """Returns the triangles that have a corner among these vertices, ascending."""
  if len(mesh.tet):
    return np.flatnonzero(among(mesh.nvert, vert)[mesh.elem].any(axis=1))
  half = mesh.ring_elem[vert]
  return distinct(half[half >= 0] // 3)


def held_areas(mesh: Mesh) -> np.ndarray:
  """Returns the areas of the vertices that the foundation holds [m^2], (nvert,)."""
  elem = mesh.elem if mesh.loose is None else mesh.elem[~mesh.loose]
  return vertex_areas(mesh.rest, elem)


def areas_of(mesh: Mesh, vert: np.ndarray, held: bool = False) -> np.ndarray:
  """Returns the areas of some vertices, to the bit as `vertex_areas` and `held_areas` [m^2]."""
  if len(mesh.tet):
    return (held_areas(mesh) if held else vertex_areas(mesh.rest, mesh.elem))[vert]
  around = np.sort(np.where(mesh.ring_elem[vert] >= 0, mesh.ring_elem[vert] // 3, mesh.nelem))
  elem, where = np.unique(around, return_inverse=True)
  size = np.zeros(len(elem))
  there = elem < mesh.nelem
  size[there] = lengths(area_vectors(mesh.rest, mesh.elem[elem[there]])) / 3
  if held and mesh.loose is not None:
    size[there] *= ~mesh.loose[elem[there]]
  out = np.zeros(len(vert))
  for column in size[where].reshape(around.shape).T:  # one after the other, as bincount adds
    out += column
  return out


def vertex_normals(position: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns area-weighted unit normals, (nvert, 3)."""
  weighted = np.repeat(area_vectors(position, elem), 3, axis=0)
  normal = np.stack(
    [np.bincount(elem.ravel(), weighted[:, k], len(position)) for k in range(3)], axis=1
  )
  return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def shortest(mesh: Mesh) -> float:
  """Returns the length of the shortest edge at rest [m], those inside of a solid too."""
  start, k = np.nonzero(mesh.ring >= 0)
  edge = mesh.rest[mesh.ring[start, k]] - mesh.rest[start]
  return float(np.linalg.norm(edge, axis=1).min(initial=np.inf))


def volume(position: np.ndarray, elem: np.ndarray) -> float:
  """Returns the enclosed volume of a closed surface [m^3]; the winding gives the sign."""
  a, b, c = (position[elem[:, k]] for k in range(3))
  return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def crossings(line: np.ndarray, x: np.ndarray) -> list[tuple[float, int, float, float, bool]]:
  """Returns where a line goes through triangles.

  Rays against triangles after Moeller and Trumbore 1997.

  Args:
    line: its points [m]                   (n, 3)
    x: corners of the triangles [m]        (nelem, 3, 3)

  Returns:
    of each place the line's edge plus the share of it, the triangle, the shares of its last two
    corners, and whether one who comes from the line's end goes against its normal
  """
  out = []
  e, g = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
  for k, (start, stop) in enumerate(itertools.pairwise(line)):
    way, r = stop - start, start - x[:, 0]
    p, q = np.cross(way, g), np.cross(r, e)
    det = (e * p).sum(axis=1)
    det = np.where(np.abs(det) > 0, det, np.nan)
    v, w, t = (r * p).sum(axis=1) / det, (q @ way) / det, (g * q).sum(axis=1) / det
    found = (v >= 0) & (w >= 0) & (v + w <= 1) & (t >= 0) & (t <= 1)
    for i in np.flatnonzero(found).tolist():
      out.append((k + float(t[i]), i, float(v[i]), float(w[i]), bool(det[i] < 0)))
  return out


def build(organ: str, rest: np.ndarray, elem: np.ndarray, spare: int = 0) -> Mesh:
  """Returns the topology of a surface.

  Args:
    organ: its name, for messages
    rest: rest positions [m]                  (nvert, 3)
    elem: triangles                           (nelem, 3)
    spare: the last so many vertices are room for cuts and have no triangle

  Raises:
    ValueError: a triangle is degenerate, a vertex is isolated, the winding is inconsistent, or the
      surface is not a 2-manifold; the message names organ, element and what is expected.
  """
  nvert, nelem = len(rest), len(elem)
  if nelem == 0:
    raise ValueError(f"organ {organ!r}: no triangles, expected a dim='2' flexcomp")
  if not np.isfinite(rest).all():
    bad = int(np.flatnonzero(~np.isfinite(rest).all(axis=1))[0])
    raise ValueError(f"organ {organ!r}: vertex {bad} is at {rest[bad]}, expected finite numbers")
  area = np.linalg.norm(area_vectors(rest, elem), axis=1)
  edges = rest[elem[:, [1, 2, 0]]] - rest[elem]
  longest = np.linalg.norm(edges, axis=2).max(axis=1)
  degenerate = np.flatnonzero(area <= 1e-6 * longest**2)
  if degenerate.size:
    t = int(degenerate[0])
    raise ValueError(
      f"organ {organ!r}: triangle {t} (vertices {elem[t].tolist()}) is degenerate, its area is "
      f"{area[t]:.3g} m^2 with a longest edge of {longest[t]:.3g} m; remesh the surface"
    )
  isolated = np.flatnonzero(np.bincount(elem.ravel(), minlength=nvert) == 0)
  isolated = _beside_spare(organ, isolated, nvert, spare)
  if isolated.size:
    raise ValueError(
      f"organ {organ!r}: vertex {int(isolated[0])} belongs to no triangle "
      f"({isolated.size} such vertices); remove them"
    )
  twin = _twins(organ, elem, nvert)
  ring, ring_elem, degree = _rings(organ, elem, twin, nvert)
  if spare:  # a fan that a cut ends in has one more neighbour than triangles
    more = np.full((nvert, 1), -1)
    ring, ring_elem = np.hstack([ring, more]), np.hstack([ring_elem, more])
  return Mesh(rest, elem, bool((twin >= 0).all()), twin, ring, ring_elem, degree, spare=spare)


def _beside_spare(organ: str, isolated: np.ndarray, nvert: int, spare: int) -> np.ndarray:
  """Returns the vertices without a triangle that are not spare."""
  used = np.setdiff1d(np.arange(nvert - spare, nvert), isolated)
  if spare >= nvert or used.size:
    what = f"vertex {used[0]} has triangles" if used.size else f"there are {nvert} vertices"
    raise ValueError(
      f"organ {organ!r}: spare is {spare} and {what}, expected so many vertices without triangles "
      "after the others; palpate.add_organ and palpate.add_spare make them"
    )
  return isolated[isolated < nvert - spare]


def _twins(organ: str, elem: np.ndarray, nvert: int) -> np.ndarray:
  start, end = elem.ravel().astype(np.int64), elem[:, [1, 2, 0]].ravel().astype(np.int64)
  undirected = np.minimum(start, end) * nvert + np.maximum(start, end)
  keys, counts = np.unique(undirected, return_counts=True)
  if counts.max() > 2:
    k = int(np.argmax(counts))
    a, b = divmod(int(keys[k]), nvert)
    raise ValueError(
      f"organ {organ!r}: edge ({a}, {b}) belongs to {counts[k]} triangles, expected at most 2"
    )
  directed = start * nvert + end
  order = np.argsort(directed, kind="stable")
  ordered = directed[order]
  same = np.flatnonzero(ordered[1:] == ordered[:-1])
  if same.size:
    h = order[same[0] : same[0] + 2]
    raise ValueError(
      f"organ {organ!r}: triangles {h[0] // 3} and {h[1] // 3} are wound in opposite directions "
      f"along edge ({start[h[0]]}, {end[h[0]]}); expected one winding for the whole surface"
    )
  reverse = end * nvert + start
  found = np.minimum(np.searchsorted(ordered, reverse), len(ordered) - 1)
  return np.where(ordered[found] == reverse, order[found], -1)


def _rings(organ, elem, twin, nvert, only: tuple[np.ndarray, np.ndarray] | None = None):
  """Walks around vertices at once, one step for all of them in each pass.

  `only` has vertices and the triangles that these have, where not all are meant.
  """
  corner = elem.reshape(-1)
  vert, half = np.arange(nvert), np.arange(elem.size)
  if only is not None:
    vert, half = only[0], (3 * only[1][:, None] + np.arange(3)).ravel()
  start = corner[half]
  first = np.full(nvert, -1, np.int64)  # of a vertex without triangles
  first[start[::-1]] = half[::-1]  # the first one is written last
  boundary = twin[half] < 0
  first[start[boundary]] = half[boundary]
  first = first[vert]
  spokes = np.bincount(start, minlength=nvert)[vert]
  ring, ring_elem = [], []
  current = first.copy()
  walked = np.zeros(len(vert), np.int64)
  degree = np.zeros(len(vert), np.int64)
  tail = np.full(len(vert), -1, np.int64)  # last neighbour on a boundary, reached by no half-edge
  while (current >= 0).any() or (tail >= 0).any():
    on = current >= 0
    base = current - current % 3
    ring.append(np.where(on, corner[base + (current + 1) % 3], tail))
    ring_elem.append(np.where(on, current, -1))
    degree += ring[-1] >= 0
    walked += on
    previous = base + (current + 2) % 3
    after = np.where(on, twin[previous], -1)  # the next spoke counter-clockwise
    tail = np.where(on & (after < 0), corner[previous], -1)
    current = np.where(after == first, -1, after)
  bowtie = np.flatnonzero(walked != spokes)
  if bowtie.size:
    raise ValueError(
      f"organ {organ!r}: vertex {int(vert[bowtie[0]])} joins surfaces that share no edge there, "
      "expected a manifold surface; split the vertex"
    )
  return np.stack(ring, axis=1), np.stack(ring_elem, axis=1), degree


def recut(
  mesh: Mesh, rest: np.ndarray, elem: np.ndarray, loose: np.ndarray | None = None
) -> tuple[Mesh, np.ndarray]:
  """Returns a mesh with other rest positions and other corners, by cuts of the same whole.

  Args:
    mesh: what is like it in most places, of the same whole
    rest: rest positions [m]  (nvert, 3)
    elem: triangles: those of the whole, cut along edges  (nelem, 3)
    loose: see `Mesh`

  Returns:
    the mesh, and the triangles that are not as they were, ascending
  """
  whole = mesh.whole
  if np.array_equal(elem, whole.elem) and np.array_equal(rest, whole.rest):
    elem, rest = whole.elem, whole.rest
  new = whole
  if elem is not whole.elem:
    new = dataclasses.replace(mesh, rest=rest, elem=elem, uncut=whole, loose=loose)
    twin = _joined(new)
    closed = bool((twin >= 0).all())
    new = dataclasses.replace(new, twin=twin, closed=closed)
  before, after = mesh.elem, new.elem
  edges = (mesh.twin != new.twin).reshape(-1, 3).any(axis=1)
  cut = (before != after).any(axis=1) | edges
  moved = (mesh.rest[before] != new.rest[before]) | (mesh.rest[after] != new.rest[after])
  changed = np.flatnonzero(cut | moved.any(axis=(1, 2)))
  if new is whole or not changed.size:
    return (new if new is whole else dataclasses.replace(mesh, loose=loose)), changed
  walk = distinct(before[cut], after[cut])
  ring, ring_elem, degree = mesh.ring.copy(), mesh.ring_elem.copy(), mesh.degree.copy()
  if walk.size:
    only = walk, around(mesh, distinct(before[cut]))
    part, part_elem, degree[walk] = _rings("cut", elem, new.twin, len(rest), only)
    ring[walk], ring_elem[walk] = -1, -1
    ring[walk, : part.shape[1]], ring_elem[walk, : part.shape[1]] = part, part_elem
  return dataclasses.replace(new, ring=ring, ring_elem=ring_elem, degree=degree), changed


def _joined(mesh: Mesh) -> np.ndarray:
  """Returns the half-edges on the other side, of triangles of the whole some of which were cut."""
  half, other = np.arange(len(mesh.whole.twin)), mesh.whole.twin
  joined = (other >= 0) & (corners(mesh, half) == corners(mesh, other, 1))
  joined &= corners(mesh, half, 1) == corners(mesh, other)
  return np.where(joined, other, -1)
