"""The inside of a solid: tetrahedra, and means over nodes of their gradients, to sliced arrays."""

import dataclasses
from typing import Any

import numpy as np
import scipy

from . import tets
from .config import Config
from .geometry.fill import vertex_volumes, volumes
from .geometry.mesh import Mesh
from .step import OWN_SHARE
from .types import empty

# Times their own mass that nodes may be heavier in modes that the matrix makes too stiff, before a
# step takes a second Newton iteration, and so on: presses that swung when they were let go.
_HEAVY = (150.0, 400.0, 1e3, 2.5e3, 5e3)


def capsule(config: Config) -> Config:
  """Returns the configuration of an organ's triangles: of a solid those of its skin, if any."""
  if config.elements != "solid":
    return config
  if not config.capsule_young:
    return dataclasses.replace(config, bend=0.0)
  return dataclasses.replace(config, elements="membrane", young=config.capsule_young)


def skin(mesh: Mesh) -> Mesh:
  """Returns a mesh without the walls of cuts in a solid."""
  if not len(mesh.tet) or mesh.uncut is None:
    return mesh
  assert mesh.loose is not None
  n = mesh.whole.nelem
  return dataclasses.replace(mesh, elem=mesh.elem[:n], loose=mesh.loose[:n])


def gradients(mesh: Mesh) -> np.ndarray:
  """Returns the gradient of each corner's share at rest [1/m], (ntet, 4, 3)."""
  corner = mesh.rest[mesh.tet]
  others = np.linalg.inv(corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1)
  return np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)


def young(mesh: Mesh, config: Config) -> np.ndarray:
  """Returns Young's modulus of each tetrahedron [Pa], that of the nearest triangle, (ntet,)."""
  if len(config.young) == 1:
    return np.full(len(mesh.whole.tet), config.young[0])
  return np.asarray(config.young)[nearest_triangle(mesh)]


def nearest_triangle(mesh: Mesh) -> np.ndarray:
  """Returns the triangle nearest to each tetrahedron before the first cut, (ntet,)."""
  mesh = mesh.whole
  middle = scipy.spatial.KDTree(mesh.rest[mesh.elem].mean(axis=1))
  return np.asarray(middle.query(mesh.rest[mesh.tet].mean(axis=1))[1])


def lame_solid(young: np.ndarray, poisson: float) -> tuple[np.ndarray, np.ndarray]:
  """Returns the Lame constants mu, lambda of a solid [Pa].

  mu = E / (2 (1 + nu)), lambda = E nu / ((1 + nu) (1 - 2 nu)).
  """
  return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def moduli(mesh: Mesh, config: Config) -> tuple[np.ndarray, np.ndarray]:
  """Returns mu and lambda of each tetrahedron [Pa], (ntet,) each.

  Those of the energy in `energy.solid`: small strains have the Lame constants 3/4 mu and lambda
  (Smith et al. 2018, section 3.4, where 5/8 mu is counted as part of lambda).
  """
  shear, lame = lame_solid(young(mesh, config), config.poisson)
  return 4 / 3 * shear, lame


def iterations(mesh: Mesh, config: Config, mass: np.ndarray, gain: float) -> int:
  """Returns how many Newton iterations a step of a solid takes at least.

  The matrix has the resistance to a change of volume in each tetrahedron, the energy in means of
  them: in most modes the matrix is stiffer, and a step is as if these were heavier by gain times
  the difference. A solid that is much heavier so swings when it is let go.

  Args:
    mesh: the solid
    config: its configuration
    mass: of each node [kg], (nvert,)
    gain: factor of K in the matrix of a step [s^2]
  """
  lame = lame_solid(young(mesh, config), config.poisson)[1]
  stiffness = lame * volumes(mesh.rest, mesh.tet)
  share = stiffness[:, None] * (gradients(mesh) ** 2).sum(axis=2)
  nodal = np.bincount(mesh.tet.ravel(), share.ravel(), mesh.nvert)
  heavier = gain * np.median((nodal / np.maximum(mass, 1e-300))[mass > 0])
  return 1 + sum(bool(heavier > limit) for limit in _HEAVY)


def arrays(
  mesh: Mesh, config: Config, vert: np.ndarray, node: np.ndarray, slot_adr: np.ndarray
) -> dict[str, Any]:
  """Returns the arrays of tetrahedra, see `types.Shape`, and `Tissue`.

  Args:
    mesh: the solid
    config: its configuration
    vert: vertex of each node, -1 for padding   (nnode,)
    node: node of each vertex                   (nvert,)
    slot_adr: first row of blocks of each slice (nslice + 1,)
  """
  lay = tets.layout(mesh, node, len(vert))
  out = tets.blank(lay, int(slot_adr[-1]), len(slot_adr) - 1)
  writer = tets.Tets(mesh, lay, node, out | {"slot_adr": slot_adr})
  assert writer.write(mesh, moduli(mesh, config), mesh.unused)
  return out


def nodal_moduli(mesh: Mesh, config: Config) -> np.ndarray:
  """Returns what vertices have of mu, and lambda [Pa], (nvert, 2): the means around them."""
  mu, lam = moduli(mesh, config)
  sums = [vertex_volumes(mesh, part) for part in ((1 - OWN_SHARE) * mu, lam)]
  return np.stack(sums, axis=1) / np.maximum(vertex_volumes(mesh), 1e-300)[:, None]


def none(nslice: int) -> dict[str, np.ndarray]:
  """Returns the arrays of `arrays` for a surface."""
  sizes = ("ntetslice", "naround", "nedge", "nedgeslice", "nsolidslice", "nsolidslot")
  return {
    "around_adr": np.zeros(nslice + 1, np.int32),
    "edge_adr": np.zeros(1, np.int32),
    "stiffness": np.zeros(1, np.float32),
  } | empty(sizes)
