"""Elastic energy of a surface in float64: the definition that the kernels' forces are gradients of.

Numpy on (nvert, 3) arrays, for reports and as the reference of the tests; nothing here runs inside
a step. The energy of solids is native, since cuts in solids need it too.
"""

import numpy as np
import warp as wp

from . import config as configuration
from . import solid as solids
from .config import Config
from .geometry import fill, plate
from .geometry import mesh as topology
from .geometry.mesh import Mesh
from .kernels import kernel
from .step import OWN_SHARE
from .types import CONSTANTS, doubles, struct


@struct
class Densities:
  """See `of_gradients`."""

  slope: doubles("n", 9)
  mu: doubles("n")
  lam: doubles("n")
  density: doubles("n")
  stress: doubles("n", 9)


_find = kernel("find_densities", "tissue/neohookean.h", Densities, CONSTANTS)


def membrane(mesh: Mesh, config: Config, u: np.ndarray) -> float:
  """Returns the St. Venant-Kirchhoff plane stress energy [J].

  Sum over triangles of A t (lambda'/2 (tr E)^2 + mu E : E), E the Green strain; under a tension T
  of the rest shape A T (tr E + T / (2 t (lambda' + mu))) more, which makes it 0 in slack tissue.

  Args:
    mesh: the surface at rest
    config: material
    u: displacement from rest [m], (nvert, 3)
  """
  config = solids.capsule(config)
  if config.elements != "membrane":
    return 0.0
  rest, u = mesh.rest[mesh.elem], u[mesh.elem]
  r1, r2 = rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]
  p1, p2 = u[:, 1] - u[:, 0], u[:, 2] - u[:, 0]

  def dot(x, y):
    return np.einsum("ij,ij->i", x, y)

  g11, g12, g22 = dot(r1, r1), dot(r1, r2), dot(r2, r2)
  det = g11 * g22 - g12 * g12
  e11 = dot(r1, p1) + 0.5 * dot(p1, p1)
  e22 = dot(r2, p2) + 0.5 * dot(p2, p2)
  e12 = 0.5 * (dot(r1, p2) + dot(r2, p1) + dot(p1, p2))
  # Of the strain with one index raised: its trace, and that of its square by its determinant.
  trace = (g22 * e11 - 2 * g12 * e12 + g11 * e22) / det
  square = trace**2 - 2 * (e11 * e22 - e12 * e12) / det
  lam, mu = configuration.lame(config, mesh.nelem)
  area, taut = 0.5 * np.sqrt(det), 0.5 * config.tension / (config.thickness * (lam + mu))
  stretched = area * config.thickness * (0.5 * lam * trace**2 + mu * square)
  return float((stretched + config.tension * area * (trace + taut)).sum())


def springs(mesh: Mesh, config: Config, u: np.ndarray) -> float:
  """Returns the energy of the edge springs k/2 (l - r)^2 [J], thesis eq. 5.1."""
  if config.elements != "spring":
    return 0.0
  i, j, half = _edges(mesh)
  rest = np.linalg.norm(mesh.rest[j] - mesh.rest[i], axis=1)
  x = mesh.rest + u
  length = np.linalg.norm(x[j] - x[i], axis=1)
  share = np.where((mesh.twin[half] < 0) & (mesh.whole.twin[half] >= 0), 0.5, 1.0)  # where cut
  return float(0.5 * config.stiffness * (share * (length - rest) ** 2).sum())


def _edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  half = np.arange(len(mesh.twin))
  once = (mesh.twin < 0) | (half < mesh.twin)
  return mesh.elem.ravel()[once], mesh.elem[:, [1, 2, 0]].ravel()[once], half[once]


def hinge_angles(mesh: Mesh, hinge: plate.Hinges, u: np.ndarray) -> np.ndarray:
  """Returns 2 sin(theta / 2) of each hinge, (nhinge,)."""
  x = mesh.rest + u
  normal = topology.area_vectors(x, mesh.elem)
  normal /= np.linalg.norm(normal, axis=1, keepdims=True)
  left, right = normal[hinge.elem[:, 0]], normal[hinge.elem[:, 1]]
  edge = x[hinge.vert[:, 1]] - x[hinge.vert[:, 0]]
  sine = (np.cross(left, right) * edge).sum(1) / np.linalg.norm(edge, axis=1)
  half_sine = np.sqrt(np.maximum(0.5 - 0.5 * (left * right).sum(1), 0.0))
  return 2 * np.copysign(half_sine, sine)


def bending(mesh: Mesh, config: Config, u: np.ndarray) -> float:
  """Returns the plate energy of the hinges 1/2 d^T G d [J], d the angles less those at rest."""
  config = solids.capsule(config)
  if config.bend == 0:
    return 0.0
  hinge = plate.hinges(mesh, configuration.rigidity(config, mesh.nelem), config.poisson)
  change = hinge_angles(mesh, hinge, u) - hinge_angles(mesh, hinge, np.zeros_like(u))
  each = np.where(hinge.of_elem >= 0, change[hinge.of_elem], 0.0)
  return float(0.5 * np.einsum("ti,tij,tj->", each, hinge.gain, each))


def foundation(mesh: Mesh, config: Config, u: np.ndarray) -> float:
  """Returns the energy of the Winkler foundation, 1/2 foundation area |u|^2 [J]; 0 if carried."""
  if config.carrier:
    return 0.0
  area = topology.held_areas(mesh)
  return float(0.5 * config.foundation * (area[:, None] * u * u).sum())


def enclosed(mesh: Mesh, config: Config, u: np.ndarray) -> float:
  """Returns bulk/2 (V - V0)^2 / V0 - pressure (V - V0) [J]."""
  if (config.bulk == 0 and config.pressure == 0) or not mesh.closed:
    return 0.0
  centre = mesh.rest.mean(axis=0)
  rest = topology.volume(mesh.rest - centre, mesh.elem)
  change = topology.volume(mesh.rest + u - centre, mesh.elem) - rest
  return float(0.5 * config.bulk * change**2 / rest - config.pressure * change)


def solid(mesh: Mesh, config: Config, u: np.ndarray) -> float:
  """Returns the energy of the tetrahedra and of their means over nodes [J], see tissue/solid.h."""
  if config.elements != "solid":
    return 0.0
  volume, total = fill.volumes(mesh.rest, mesh.tet), fill.vertex_volumes(mesh)
  slope = np.einsum("tki,tkj->tij", u[mesh.tet], solids.gradients(mesh))
  parts = [fill.vertex_volumes(mesh, part) for part in slope.reshape(-1, 9).T]
  mean = np.stack(parts, axis=1).reshape(-1, 3, 3) / np.maximum(total, 1e-300)[:, None, None]
  mu, _ = solids.moduli(mesh, config)
  own = OWN_SHARE * of_gradients(slope, mu, 0.0)[0]
  nodal = of_gradients(mean, *solids.nodal_moduli(mesh, config).T)[0]
  return float((volume * own).sum() + (total * nodal).sum())


def of_gradients(slope: np.ndarray, mu: np.ndarray, lam: np.ndarray | float):
  """Returns the density of stable neo-Hookean energy and its derivative, of `neohookean.h`.

  Args:
    slope: gradients of the displacement    (n, 3, 3)
    mu: [Pa]                                (n,)
    lam: [Pa]                               (n,)

  Returns:
    density [J/m^3]                         (n,)
    first Piola-Kirchhoff stress [Pa]       (n, 3, 3)
  """
  n = len(slope)
  given = {"slope": np.reshape(slope, (n, 9)), "mu": mu, "lam": np.broadcast_to(lam, n)}
  made = {"density": np.empty(n), "stress": np.empty((n, 9))}
  fields = Densities()
  for name, value in (given | made).items():
    value = np.ascontiguousarray(value, float)
    setattr(fields, name, wp.array(value, dtype=wp.float64, device="cpu", copy=False))
  if n:
    _find.launch("cpu", n, 1, 0, fields)
  return fields.density.numpy(), fields.stress.numpy().reshape(n, 3, 3)


# The terms of the energy: (mesh, config, displacement) -> [J], 0 where a term is off.
TERMS = {
  "membrane": membrane,
  "springs": springs,
  "solid": solid,
  "bending": bending,
  "foundation": foundation,
  "enclosed": enclosed,
}


def total(mesh: Mesh, config: Config, u: np.ndarray) -> float:
  """Returns the elastic energy [J], the sum of `TERMS`."""
  return sum(term(mesh, config, u) for term in TERMS.values())
