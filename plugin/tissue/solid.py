"""The inside of a solid: tetrahedra, and means over nodes of their gradients, to sliced arrays."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from . import config as configuration
from .config import Config
from .fill import vertex_volumes, volumes
from .mesh import Mesh
from .order import LANES, addresses, ellpack, offset, pad, to_slices
from .step import OWN_SHARE
from .types import empty

_WINDOW = 8 * LANES  # edges that are sorted by the number of their tetrahedra
# Times their own mass that nodes may be heavier in modes that the matrix makes too stiff, before a
# step takes a second Newton iteration, and a third.
_HEAVY = (500.0, 4e3)


def capsule(config: Config) -> Config:
  """Returns the configuration of an organ's triangles: of a solid those of its skin, if any."""
  if config.elements != "solid":
    return config
  if not config.capsule_young:
    return dataclasses.replace(config, bend=0.0)
  return dataclasses.replace(config, elements="membrane", young=config.capsule_young)


def gradients(mesh: Mesh) -> np.ndarray:
  """Returns the gradient of each corner's share at rest [1/m], (ntet, 4, 3)."""
  corner = mesh.rest[mesh.tet]
  others = np.linalg.inv(corner[:, 1:] - corner[:, :1]).transpose(0, 2, 1)
  return np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)


def young(mesh: Mesh, config: Config) -> np.ndarray:
  """Returns Young's modulus of each tetrahedron [Pa], that of the nearest triangle, (ntet,)."""
  if len(config.young) == 1:
    return np.full(len(mesh.tet), config.young[0])
  middle = KDTree(mesh.rest[mesh.elem].mean(axis=1))
  return np.asarray(config.young)[middle.query(mesh.rest[mesh.tet].mean(axis=1))[1]]


def moduli(mesh: Mesh, config: Config) -> tuple[np.ndarray, np.ndarray]:
  """Returns mu and lambda of each tetrahedron [Pa], (ntet,) each.

  Those of the energy in `energy.solid`: small strains have the Lame constants 3/4 mu and lambda
  (Smith et al. 2018, section 3.4, where 5/8 mu is counted as part of lambda).
  """
  shear, lame = configuration.lame_solid(young(mesh, config), config.poisson)
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
  lame = configuration.lame_solid(young(mesh, config), config.poisson)[1]
  stiffness = lame * volumes(mesh.rest, mesh.tet)
  share = stiffness[:, None] * (gradients(mesh) ** 2).sum(axis=2)
  nodal = np.bincount(mesh.tet.ravel(), share.ravel(), mesh.nvert)
  heavier = gain * np.median((nodal / np.maximum(mass, 1e-300))[mass > 0])
  return 1 + sum(bool(heavier > limit) for limit in _HEAVY)


def arrays(mesh: Mesh, config: Config, vert: np.ndarray, node: np.ndarray) -> dict[str, Any]:
  """Returns the arrays of tetrahedra, see `types.Shape`, and `Tissue`.

  Args:
    mesh: the solid
    config: its configuration
    vert: vertex of each node, -1 for padding   (nnode,)
    node: node of each vertex                   (nvert,)
  """
  # In the order of their nodes, so that who gathers from them finds them near each other.
  order = np.lexsort(np.sort(node[mesh.tet], axis=1).T[::-1])
  mesh = dataclasses.replace(mesh, tet=mesh.tet[order])
  tet = mesh.tet
  volume = volumes(mesh.rest, tet)
  mu, lam = moduli(mesh, config)
  at = node[tet]
  absent = np.full((len(vert) // LANES, LANES), tet.size)
  width, entry, _ = ellpack(at.ravel(), np.arange(tet.size), np.ones(tet.size), absent)
  values = pad(np.stack([volume, mu, lam], axis=1), least=1)
  values[len(tet) :, 1] = 1.0  # padding has no volume, but quotients
  gradient = gradients(mesh)[:, 1:].reshape(-1, 9)
  nodal = np.where((vert >= 0)[:, None], nodal_moduli(mesh, config)[vert], 0.0)
  return {
    "tet_node": to_slices(pad(offset(at), least=1)).astype(np.int32),
    "tet_gradient": to_slices(pad(gradient, least=1)).astype(np.float32),
    "stiffness": _stiffness(mesh, values),
    "tet_moduli": to_slices(values).astype(np.float32),
    "around_adr": addresses(width),
    "around_corner": _corner(entry // 4, entry % 4),
    "fan_slope": _slopes(mesh, vert, node),
    "node_moduli": to_slices(nodal).astype(np.float32),
    **_edges(mesh, vert, node),
  }


def _stiffness(mesh: Mesh, values: np.ndarray) -> np.ndarray:
  """Returns that of a corner of the stiffest tetrahedron at rest [N/m], (1,)."""
  volume, mu, lam = values[: len(mesh.tet)].T
  size2 = (gradients(mesh) ** 2).sum(axis=2).max(axis=1)
  return np.array([(volume * (mu + lam) * size2).max()], np.float32)


def _slopes(mesh: Mesh, vert: np.ndarray, node: np.ndarray) -> np.ndarray:
  """Returns `fan_slope`: with it the mean of the gradients around a node is a sum over its fan.

  That of neighbour b is the sum of V g_b / sum V over the tetrahedra around the node, g_b the
  gradient of the share of b in each.
  """
  pairs = np.array([(a, b) for a in range(4) for b in range(4) if a != b])
  start, end = (mesh.tet[:, pairs[:, k]].ravel() for k in (0, 1))
  weighed = volumes(mesh.rest, mesh.tet)[:, None, None] / 4 * gradients(mesh)
  value = weighed[:, pairs[:, 1]].reshape(-1, 3) / vertex_volumes(mesh)[start, None]
  degree = np.where(vert >= 0, mesh.degree[vert], 0).reshape(-1, LANES)
  first = addresses(degree.max(axis=1))
  out = np.zeros((first[-1], LANES, 3))
  entry = (mesh.ring[start] == end[:, None]).argmax(axis=1)
  np.add.at(out, (first[node[start] // LANES] + entry, node[start] % LANES), value)
  return np.ascontiguousarray(out.transpose(0, 2, 1)).astype(np.float32)


def nodal_moduli(mesh: Mesh, config: Config) -> np.ndarray:
  """Returns what vertices have of mu, and lambda [Pa], (nvert, 2): the means around them."""
  mu, lam = moduli(mesh, config)
  sums = [vertex_volumes(mesh, part) for part in ((1 - OWN_SHARE) * mu, lam)]
  return np.stack(sums, axis=1) / np.maximum(vertex_volumes(mesh), 1e-300)[:, None]


def _corner(tet: np.ndarray, corner: np.ndarray) -> np.ndarray:
  """Returns the number of a corner of a tetrahedron; a slice has eight times four."""
  return (tet // LANES * 4 * LANES + corner * LANES + tet % LANES).astype(np.int32)


def _edges(mesh: Mesh, vert: np.ndarray, node: np.ndarray) -> dict[str, np.ndarray]:
  """Returns the tetrahedra around each edge, and where its blocks are among those of the nodes."""
  a, b = np.triu_indices(4, 1)
  ends = np.sort(mesh.tet[:, np.stack([a, b], axis=1)].reshape(-1, 2), axis=1)
  # The first end is that of the lower number.
  swap = (mesh.tet[:, a] > mesh.tet[:, b]).ravel()
  first, last = np.tile(a, len(mesh.tet)), np.tile(b, len(mesh.tet))
  first, last = np.where(swap, last, first), np.where(swap, first, last)
  edge, which, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
  # Near ones near each other; within a window those of as many tetrahedra, so that slices are full.
  near = np.lexsort(np.sort(node[edge], axis=1).T[::-1])
  window = np.arange(len(edge)) // _WINDOW
  order = near[np.lexsort((np.arange(len(edge)), -count[near], window))]
  place = np.empty(len(edge), np.int64)
  place[order] = np.arange(len(edge))
  absent = np.full((-(-len(edge) // LANES), LANES), len(ends))  # of corners of the padding
  width, pair, _ = ellpack(place[which.ravel()], np.arange(len(ends)), np.ones(len(ends)), absent)
  tet = pair // len(a)
  first, last = np.append(first, 0), np.append(last, 0)
  slots = [_slot(mesh, vert, node, edge[order]), _slot(mesh, vert, node, edge[order][:, ::-1])]
  return {
    "edge_adr": addresses(width),
    "edge_from": _corner(tet, first[pair]),
    "edge_to": _corner(tet, last[pair]),
    "edge_node": to_slices(pad(node[edge[order]])).astype(np.int32),
    "edge_slot": to_slices(pad(np.stack(slots, axis=1), -1)).astype(np.int32),
  }


def _slot(mesh: Mesh, vert: np.ndarray, node: np.ndarray, edge: np.ndarray) -> np.ndarray:
  """Returns where the block of each edge's first end starts, in floats."""
  start, end = edge.T
  entry = (mesh.ring[start] == end[:, None]).argmax(axis=1)
  degree = np.where(vert >= 0, mesh.degree[vert], 0).reshape(-1, LANES)
  row = addresses(degree.max(axis=1))[node[start] // LANES] + entry
  return row * 9 * LANES + node[start] % LANES


def none(nslice: int) -> dict[str, np.ndarray]:
  """Returns the arrays of `arrays` for a surface."""
  sizes = ("ntetslice", "naround", "nedge", "nedgeslice", "nsolidslice", "nsolidslot")
  return {
    "around_adr": np.zeros(nslice + 1, np.int32),
    "edge_adr": np.zeros(1, np.int32),
    "stiffness": np.zeros(1, np.float32),
  } | empty(sizes)
