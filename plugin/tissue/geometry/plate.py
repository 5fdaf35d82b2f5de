"""Hinges of a surface and the stiffness that makes them a Kirchhoff plate.

In float64, for energies; what kernels use is `tissue/plate.h`.
"""

import dataclasses

import numpy as np

from .mesh import Mesh, area_vectors, corners, cross, distinct, lengths


@dataclasses.dataclass(frozen=True)
class Hinges:
  """Interior edges with the plate stiffness of the triangles beside them.

  Attributes:
    vert: edge p0, p1 (direction of the left triangle), left apex, right apex  (nhinge, 4)
    elem: left and right triangle                                              (nhinge, 2)
    of_elem: hinge of each triangle's half-edge, -1 on the boundary            (nelem, 3)
    gain: stiffness between the hinges of one triangle [N m]                   (nelem, 3, 3)
    weight: angle of each triangle's hinge by normal displacements of the half-edge's start and end,
      the triangle's apex and the other one [1/m]                              (nelem, 3, 4)
  """

  vert: np.ndarray
  elem: np.ndarray
  of_elem: np.ndarray
  gain: np.ndarray
  weight: np.ndarray


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
  twin = mesh.twin
  mine = np.arange(len(twin)).reshape(-1, 3)
  across = twin[mine]
  half = distinct(np.minimum(mine, across)[across >= 0])
  other = twin[half]
  ends = [corners(mesh, half, k) for k in range(3)]
  vert = np.stack([*ends, corners(mesh, other, 2)], axis=1)
  of_half = np.full(len(twin), -1, np.int64)
  of_half[half] = of_half[other] = np.arange(len(half))
  angle, weight = _angles(mesh)
  size = lengths(area_vectors(mesh.rest, mesh.elem)) * rigidity
  gain = _gain(angle, across >= 0, poisson) * size[:, None, None]
  sides = np.stack([half // 3, other // 3], axis=1)
  return Hinges(vert, sides, of_half[mine], gain, weight)


def _foot(mesh: Mesh, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns where the apexes of half-edges have their feet, as shares of the edges, and heights."""
  start, end, apex = (mesh.rest[corners(mesh, half, k)] for k in range(3))
  edge, arm = end - start, apex - start
  share = (arm * edge).sum(-1) / (edge * edge).sum(-1)
  return share, lengths(arm - share[..., None] * edge)


def _unfolded(mesh: Mesh) -> np.ndarray:
  """Returns the corners of triangles in their own planes, (n, 3, 2)."""
  corner = mesh.rest[mesh.elem]
  x_axis = corner[:, 1] - corner[:, 0]
  x_axis /= lengths(x_axis)[:, None]
  normal = area_vectors(mesh.rest, mesh.elem)
  area = lengths(normal)
  y_axis = cross(normal / area[:, None], x_axis)
  arm = corner - corner[:, :1]
  return np.stack([(arm * x_axis[:, None]).sum(-1), (arm * y_axis[:, None]).sum(-1)], axis=-1)


def _angles(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
  """Returns C, the angles of triangles' hinges by curvature kxx, kyy, kxy, and `Hinges.weight`.

  Those of hinges that are not there mean nothing.
  """
  flat, twin = _unfolded(mesh), mesh.twin

  def modes(point):
    x, y = point[..., 0], point[..., 1]
    return np.stack([x * x / 2, y * y / 2, x * y], axis=-1)

  h = np.arange(len(twin)).reshape(-1, 3)
  p0, p1, inner = flat, flat[:, [1, 2, 0]], flat[:, [2, 0, 1]]
  share, height = _foot(mesh, h)
  share_o, height_o = _foot(mesh, np.where(twin[h] >= 0, twin[h], h))
  share_o = 1 - share_o
  inward = inner - p0 - share[..., None] * (p1 - p0)
  inward /= lengths(inward)[..., None]
  outer = p0 + share_o[..., None] * (p1 - p0) - height_o[..., None] * inward
  ends = modes(p0), modes(p1)

  def bend(apex_point, s, height):
    at_foot = (1 - s)[..., None] * ends[0] + s[..., None] * ends[1]
    return (modes(apex_point) - at_foot) / height[..., None]

  start = (1 - share) / height + (1 - share_o) / height_o
  end = share / height + share_o / height_o
  weight = np.stack([start, end, -1 / height, -1 / height_o], axis=-1)
  return -bend(inner, share, height) - bend(outer, share_o, height_o), weight


def _gain(angle: np.ndarray, present: np.ndarray, poisson: float) -> np.ndarray:
  """Returns (C D^-1 C^T)^-1 for a rigidity of 1, from C and which hinges there are (nelem, 3)."""
  nu = poisson
  compliance = np.linalg.inv(np.array([[1, nu, 0], [nu, 1, 0], [0, 0, 2 * (1 - nu)]]))
  both = present[:, :, None] & present[:, None, :]
  flexibility = np.where(both, angle @ compliance @ angle.transpose(0, 2, 1), 0)
  # Absent hinges have no stiffness: as the least eigenvalues they are told from those of hinges.
  size = np.trace(flexibility, axis1=1, axis2=2)[:, None]
  k = np.arange(3)
  flexibility[:, k, k] -= np.where(present, 0, 1 + size)
  value, vector = np.linalg.eigh(flexibility)
  largest = np.maximum(value[:, -1:], 0)
  absent = (~present).sum(axis=1)[:, None] > k
  stiff = ~absent & (largest > 0)
  inverse = np.where(stiff, 1 / np.where(stiff, np.maximum(value, 0.05 * largest), 1), 0)
  return np.where(both, np.einsum("tik,tk,tjk->tij", vector, inverse, vector), 0)
