"""The inside of a solid: tetrahedra to sliced arrays."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from . import config as configuration
from .config import Config
from .fill import vertex_volumes, volumes
from .mesh import Mesh
from .order import LANES, addresses, ellpack, pad, to_slices
from .types import empty

# Poisson's ratio up to which the resistance to a change of volume is each tetrahedron's own. What
# is above is averaged over nodes: linear tetrahedra would lock (Bonet and Burton 1998,
# doi:10.1002/(SICI)1099-0887(199805)14:5<437::AID-CNM162>3.0.CO;2-W), and averages alone let
# neighbours shrink and grow in turn (Puso and Solberg 2006, doi:10.1002/nme.1457).
_OWN_POISSON = 0.3
_WINDOW = 8 * LANES  # edges that are sorted by the number of their tetrahedra


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


def moduli(mesh: Mesh, config: Config) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns mu, lambda and its averaged part of each tetrahedron [Pa], (ntet,) each.

  Those of the energy in `energy.solid`, with which small strains have the Lame constants
  mu' = 3/4 mu, lambda' = lambda - 5/8 mu (Smith et al. 2018, section 3.4).
  """
  shear, lame = configuration.lame_solid(young(mesh, config), config.poisson)
  own = configuration.lame_solid(young(mesh, config), min(config.poisson, _OWN_POISSON))
  part = own[1] * shear / own[0]
  mu = 4 / 3 * shear
  return mu, part + 5 / 8 * mu, lame - part


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
  mu, lam, averaged = moduli(mesh, config)
  at = node[tet]
  own = np.arange(len(vert)).reshape(-1, LANES)
  share = np.repeat(volume / 4, 4)
  entry = np.arange(tet.size)
  width, entry, weight = ellpack(at.ravel(), entry, share, np.full_like(own, tet.size))
  total = vertex_volumes(mesh)
  gain = np.where(vert >= 0, (vertex_volumes(mesh, averaged) / total**2)[vert], 0.0)
  values = pad(np.stack([volume, mu, lam, averaged], axis=1), least=1)
  values[len(tet) :, 1] = 1.0  # padding has no volume, but quotients
  gradient = gradients(mesh)[:, 1:].reshape(-1, 9)
  return {
    "tet_node": to_slices(pad(at, least=1)).astype(np.int32),
    "tet_gradient": to_slices(pad(gradient, least=1)).astype(np.float32),
    "tet_moduli": to_slices(values).astype(np.float32),
    "around_adr": addresses(width),
    "around_tet": (entry // 4).astype(np.int32),
    "around_corner": _corner(entry // 4, entry % 4),
    "around_share": weight,
    "pressure_gain": to_slices(gain).astype(np.float32),
    **_edges(mesh, vert, node),
  }


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
  sizes = ("ntetslice", "naround", "nedge", "nedgeslice", "nsolidslice")
  return {
    "around_adr": np.zeros(nslice + 1, np.int32),
    "edge_adr": np.zeros(1, np.int32),
  } | empty(sizes)
