"""The organ's triangle surface: topology, checks, areas, normals, volume."""

from __future__ import annotations

import dataclasses

import numpy as np


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
  """

  rest: np.ndarray
  elem: np.ndarray
  closed: bool
  twin: np.ndarray
  ring: np.ndarray
  ring_elem: np.ndarray
  degree: np.ndarray
  tet: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 4), np.int64))

  @property
  def nouter(self) -> int:
    """Number of vertices on the surface, which come first."""
    return int(self.elem.max()) + 1

  @property
  def nvert(self) -> int:
    """Number of vertices."""
    return len(self.rest)

  @property
  def nelem(self) -> int:
    """Number of triangles."""
    return len(self.elem)


def area_vectors(position: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns the normal of each triangle times its area [m^2], (nelem, 3)."""
  a, b, c = (position[elem[:, k]] for k in range(3))
  return 0.5 * np.cross(b - a, c - a)


def vertex_areas(position: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns a third of the area of the triangles around each vertex [m^2], (nvert,)."""
  area = np.linalg.norm(area_vectors(position, elem), axis=1)
  return np.bincount(elem.ravel(), np.repeat(area / 3, 3), len(position))


def vertex_normals(position: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns area-weighted unit normals, (nvert, 3)."""
  weighted = np.repeat(area_vectors(position, elem), 3, axis=0)
  normal = np.stack(
    [np.bincount(elem.ravel(), weighted[:, k], len(position)) for k in range(3)], axis=1
  )
  return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)


def volume(position: np.ndarray, elem: np.ndarray) -> float:
  """Returns the enclosed volume of a closed surface [m^3]; the winding gives the sign."""
  a, b, c = (position[elem[:, k]] for k in range(3))
  return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def build(organ: str, rest: np.ndarray, elem: np.ndarray) -> Mesh:
  """Returns the topology of a surface.

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
  if isolated.size:
    raise ValueError(
      f"organ {organ!r}: vertex {int(isolated[0])} belongs to no triangle "
      f"({isolated.size} such vertices); remove them"
    )
  twin = _twins(organ, elem, nvert)
  ring, ring_elem, degree = _rings(organ, elem, twin, nvert)
  return Mesh(rest, elem, bool((twin >= 0).all()), twin, ring, ring_elem, degree)


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


def _rings(organ, elem, twin, nvert):
  """Walks around every vertex at once, one step for all of them in each pass."""
  nhalf = elem.size
  half = np.arange(nhalf)
  previous = half - half % 3 + (half + 2) % 3
  start, end, apex = elem.ravel(), elem[:, [1, 2, 0]].ravel(), elem[:, [2, 0, 1]].ravel()
  following = twin[previous]  # the next spoke counter-clockwise
  first = np.full(nvert, nhalf, np.int64)
  np.minimum.at(first, start, half)
  boundary = half[twin < 0]
  first[start[boundary]] = boundary
  spokes = np.bincount(start, minlength=nvert)
  ring, ring_elem = [], []
  current = first.copy()
  walked = np.zeros(nvert, np.int64)
  degree = np.zeros(nvert, np.int64)
  tail = np.full(nvert, -1, np.int64)  # last neighbour on a boundary, reached by no half-edge
  while (current >= 0).any() or (tail >= 0).any():
    on = current >= 0
    ring.append(np.where(on, end[current], tail))
    ring_elem.append(np.where(on, current, -1))
    degree += ring[-1] >= 0
    walked += on
    after = np.where(on, following[current], -1)
    tail = np.where(on & (after < 0), apex[current], -1)
    current = np.where(after == first, -1, after)
  bowtie = np.flatnonzero(walked != spokes)
  if bowtie.size:
    raise ValueError(
      f"organ {organ!r}: vertex {int(bowtie[0])} joins surfaces that share no edge there, "
      "expected a manifold surface; split the vertex"
    )
  return np.stack(ring, axis=1), np.stack(ring_elem, axis=1), degree
