"""Topology of the organ's triangle surface: checks, fans around nodes, hinges, node order."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from .simd import LANES


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
  """

  rest: np.ndarray
  elem: np.ndarray
  closed: bool
  twin: np.ndarray
  ring: np.ndarray
  ring_elem: np.ndarray
  degree: np.ndarray

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


def node_order(mesh: Mesh, patch: int = 0) -> np.ndarray:
  """Returns vertices in the order of the solver, padded with -1 to whole slices.

  Reverse Cuthill-McKee keeps neighbours close in memory, patches keep most of them in one block of
  threads; sorting by degree within a window keeps the slices full.

  Args:
    mesh: the surface
    patch: nodes of a block of threads that works on a patch of the surface, 0 for no patches
  """
  order = _patches(mesh.rest, patch) if patch else _band(mesh)
  window = np.arange(mesh.nvert) // (8 * LANES)
  order = order[np.lexsort((np.arange(mesh.nvert), -mesh.degree[order], window))]
  return np.concatenate([order, np.full(-mesh.nvert % LANES, -1)])


def _patches(point: np.ndarray, size: int) -> np.ndarray:
  """Returns points in runs of `size` close to each other: halved across their longest extent."""
  out, todo = [], [(np.arange(len(point)), size)]
  while todo:
    part, unit = todo.pop()
    if len(part) <= unit:
      unit = 8 * LANES
    if len(part) <= unit:
      out.append(part)
      continue
    half = unit * max(1, len(part) // unit // 2)
    axis = np.argmax(np.ptp(point[part], axis=0))
    part = part[np.argsort(point[part, axis], kind="stable")]
    todo += [(part[half:], unit), (part[:half], unit)]
  return np.concatenate(out)


def _band(mesh: Mesh) -> np.ndarray:
  start, end = mesh.elem.ravel(), mesh.elem[:, [1, 2, 0]].ravel()
  graph = sparse.coo_matrix(
    (np.ones(2 * len(start)), (np.concatenate([start, end]), np.concatenate([end, start]))),
    shape=(mesh.nvert, mesh.nvert),
  ).tocsr()
  return csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)


@dataclasses.dataclass(frozen=True)
class Hinges:
  """Interior edges with the plate stiffness of the triangles beside them.

  Attributes:
    vert: edge p0, p1 (direction of the left triangle), left apex, right apex  (nhinge, 4)
    elem: left and right triangle                                              (nhinge, 2)
    of_elem: hinge of each triangle's half-edge, -1 on the boundary            (nelem, 3)
    gain: stiffness between the hinges of one triangle [N m]                   (nelem, 3, 3)
    rows: hinge angle per normal displacement at rest [1/m]             sparse (nhinge, nvert)
  """

  vert: np.ndarray
  elem: np.ndarray
  of_elem: np.ndarray
  gain: np.ndarray
  rows: sparse.csr_matrix


def hinges(mesh: Mesh, rigidity: np.ndarray, poisson: float) -> Hinges:
  """Returns the hinges of a surface and the stiffness that makes them a Kirchhoff plate.

  The three angles of a triangle's hinges fix a constant curvature (kxx, kyy, kxy) of the patch of
  the triangle and its three neighbours, unfolded at rest: angles = C curvature. So the plate
  energy area/2 curvature^T D curvature becomes 1/2 angles^T G angles, G = area (C D^-1 C^T)^-1,
  exact for every quadratic deflection on every mesh. With fewer hinges (a boundary) the formula
  gives the curvature of least energy, a free edge. Patches whose six points nearly lie on a conic
  would be far too stiff; the small eigenvalues of C D^-1 C^T are raised there.

  Args:
    mesh: the surface
    rigidity: plate bending rigidity [N m], (nelem,)
    poisson: Poisson's ratio [-]
  """
  rest, elem, twin = mesh.rest, mesh.elem, mesh.twin
  half = np.flatnonzero((twin >= 0) & (np.arange(len(twin)) < twin))
  other = twin[half]
  start, end, apex = elem.ravel(), elem[:, [1, 2, 0]].ravel(), elem[:, [2, 0, 1]].ravel()
  vert = np.stack([start[half], end[half], apex[half], apex[other]], axis=1)
  nhinge = len(half)
  of_half = np.full(len(twin), -1, np.int64)
  of_half[half] = of_half[other] = np.arange(nhinge)

  def foot(h):
    """Returns (share along the edge, height) of the apex of half-edges h, seen from `start`."""
    edge, arm = rest[end[h]] - rest[start[h]], rest[apex[h]] - rest[start[h]]
    share = (arm * edge).sum(-1) / (edge * edge).sum(-1)
    return share, np.linalg.norm(arm - share[..., None] * edge, axis=-1)

  share_l, height_l = foot(half)
  share_r, height_r = foot(other)
  share_r = 1 - share_r
  weight = np.stack(
    [
      (1 - share_l) / height_l + (1 - share_r) / height_r,
      share_l / height_l + share_r / height_r,
      -1 / height_l,
      -1 / height_r,
    ],
    axis=1,
  )
  index = np.repeat(np.arange(nhinge), 4)
  rows = sparse.csr_matrix((weight.ravel(), (index, vert.ravel())), shape=(nhinge, mesh.nvert))

  # Unfolded patch of each triangle, in its own plane.
  corner = rest[elem]
  x_axis = corner[:, 1] - corner[:, 0]
  x_axis /= np.linalg.norm(x_axis, axis=1, keepdims=True)
  normal = area_vectors(rest, elem)
  area = np.linalg.norm(normal, axis=1)
  y_axis = np.cross(normal / area[:, None], x_axis)
  arm = corner - corner[:, :1]
  flat = np.stack([(arm * x_axis[:, None]).sum(-1), (arm * y_axis[:, None]).sum(-1)], axis=-1)

  def modes(point):
    x, y = point[..., 0], point[..., 1]
    return np.stack([x * x / 2, y * y / 2, x * y], axis=-1)

  angle = np.zeros((mesh.nelem, 3, 3))
  present = np.zeros((mesh.nelem, 3), bool)
  for c in range(3):
    h = 3 * np.arange(mesh.nelem) + c
    present[:, c] = twin[h] >= 0
    p0, p1, inner = flat[:, c], flat[:, (c + 1) % 3], flat[:, (c + 2) % 3]
    share, height = foot(h)
    share_o, height_o = foot(np.where(twin[h] >= 0, twin[h], h))
    share_o = 1 - share_o
    inward = inner - p0 - share[:, None] * (p1 - p0)
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    outer = p0 + share_o[:, None] * (p1 - p0) - height_o[:, None] * inward

    def bend(apex_point, s, height, p0=p0, p1=p1):
      at_foot = (1 - s)[:, None] * modes(p0) + s[:, None] * modes(p1)
      return (modes(apex_point) - at_foot) / height[:, None]

    angle[:, c] = -bend(inner, share, height) - bend(outer, share_o, height_o)
  nu = poisson
  compliance = np.linalg.inv(np.array([[1, nu, 0], [nu, 1, 0], [0, 0, 2 * (1 - nu)]]))
  both = present[:, :, None] & present[:, None, :]
  flexibility = np.where(both, angle @ compliance @ angle.transpose(0, 2, 1), 0)
  value, vector = np.linalg.eigh(flexibility)
  largest = value[:, -1:]
  # Absent hinges have eigenvalue 0 and no stiffness.
  raised = np.where(value > 1e-12 * largest, np.maximum(value, 0.05 * largest), np.inf)
  absent = (~present).sum(axis=1)[:, None] > np.arange(3)
  inverse = np.where(absent | (largest <= 0), 0, 1 / np.maximum(raised, 1e-300))
  degenerate = ~absent & (value <= 1e-12 * largest) & (largest > 0)
  inverse = np.where(degenerate, 20 / np.maximum(largest, 1e-300), inverse)
  gain = np.einsum("tik,tk,tjk->tij", vector, inverse, vector)
  gain = np.where(both, gain, 0) * (area * rigidity)[:, None, None]
  return Hinges(vert, np.stack([half // 3, other // 3], axis=1), of_half.reshape(-1, 3), gain, rows)


def bending_matrix(mesh: Mesh, hinge: Hinges) -> sparse.csr_matrix:
  """Returns the plate stiffness on normal displacements at rest [N/m], (nvert, nvert)."""
  h = hinge.of_elem
  row, col = np.repeat(h, 3, axis=1).ravel(), np.tile(h, (1, 3)).ravel()
  keep = (row >= 0) & (col >= 0)
  nhinge = len(hinge.vert)
  gain = sparse.csr_matrix(
    (hinge.gain.ravel()[keep], (row[keep], col[keep])), shape=(nhinge, nhinge)
  )
  return sparse.csr_matrix(hinge.rows.T @ gain @ hinge.rows)
