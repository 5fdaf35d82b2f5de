"""The inside of a solid: tetrahedra to sliced arrays."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from . import config as configuration
from . import rows
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
EDGES = 2  # by which cuts may divide edges, for one spare vertex
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
  mesh = mesh.whole
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


def order(mesh: Mesh, node: np.ndarray) -> np.ndarray:
  """Returns tetrahedra in the order of their nodes before the first cut.

  Who gathers from them finds them near each other.
  """
  return np.lexsort(np.sort(node[mesh.whole.tet], axis=1).T[::-1])


def arrays(mesh: Mesh, config: Config, vert: np.ndarray, node: np.ndarray) -> dict[str, Any]:
  """Returns the arrays of tetrahedra, see `types.Shape`, and `Tissue`.

  Args:
    mesh: the solid
    config: its configuration
    vert: vertex of each node, -1 for padding   (nnode,)
    node: node of each vertex                   (nvert,)
  """
  which = order(mesh, node)
  tet, volume = mesh.tet[which], volumes(mesh.rest, mesh.tet)[which]
  mu, lam, averaged = moduli(mesh, config)
  at = node[tet]
  own = np.arange(len(vert)).reshape(-1, LANES)
  entry, room = np.arange(tet.size), None
  if mesh.spare:
    room = _around_room(mesh, node, len(vert))
  blank = np.full_like(own, tet.size)
  width, entry, weight = ellpack(at.ravel(), entry, np.repeat(volume / 4, 4), blank, room)
  values = pad(np.stack([volume, mu[which], lam[which], averaged[which]], axis=1), least=1)
  values[len(tet) :, 1] = 1.0  # padding has no volume, but quotients
  gradient = gradients(mesh)[which, 1:].reshape(-1, 9)
  gain = np.where(vert >= 0, pressure_gain(mesh, averaged)[vert], 0.0)
  return {
    "tet_node": to_slices(pad(at, least=1)).astype(np.int32),
    "tet_gradient": to_slices(pad(gradient, least=1)).astype(np.float32),
    "tet_moduli": to_slices(values).astype(np.float32),
    "around_adr": addresses(width),
    "around_tet": (entry // 4).astype(np.int32),
    "around_corner": corner_number(entry // 4, entry % 4),
    "around_share": weight,
    "pressure_gain": to_slices(gain).astype(np.float32),
    **_edges(dataclasses.replace(mesh, tet=tet), vert, node),
  }


def pressure_gain(mesh: Mesh, averaged: np.ndarray) -> np.ndarray:
  """Returns the averaged part of lambda over the volume of each vertex [Pa/m^3], (nvert,)."""
  total = vertex_volumes(mesh)
  return np.where(total > 0, vertex_volumes(mesh, averaged) / np.where(total > 0, total**2, 1), 0.0)


def _around_room(mesh: Mesh, node: np.ndarray, nnode: int):
  """Returns what says the rows of each slice of lists of tetrahedra: a cut adds none to a list."""
  count = np.bincount(node[mesh.whole.tet].ravel(), minlength=nnode)
  count[node[mesh.spares]] = count.max()
  return lambda _: count.reshape(-1, LANES).max(axis=1)


def corner_number(tet: np.ndarray | int, corner: np.ndarray | int) -> np.ndarray:
  """Returns the number of a corner of a tetrahedron; a slice has eight times four."""
  return np.asarray(tet // LANES * 4 * LANES + corner * LANES + tet % LANES, np.int32)


@dataclasses.dataclass(frozen=True)
class Pairs:
  """The edges of tetrahedra: six pairs of corners each, one tetrahedron after the other.

  Attributes:
    first, last: corner of the end of the lower vertex number, and the other  (6 ntet,)
    edge: the vertices of each edge                                           (nedge, 2)
    which: the edge of each pair                                              (6 ntet,)
    place: where each edge lies                                               (nedge,)
    most: tetrahedra around an edge, at most
  """

  first: np.ndarray
  last: np.ndarray
  edge: np.ndarray
  which: np.ndarray
  place: np.ndarray
  most: int


def pairs(mesh: Mesh, node: np.ndarray) -> Pairs:
  """Returns the edges of the tetrahedra of a mesh, in the order that these have there."""
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
  return Pairs(first, last, edge, which.ravel(), place, int(count.max()))


def _edges(mesh: Mesh, vert: np.ndarray, node: np.ndarray) -> dict[str, np.ndarray]:
  """Returns the tetrahedra around each edge, and where its blocks are among those of the nodes."""
  own = pairs(mesh, node)
  size, number = len(own.edge), len(own.which)
  more = -(-EDGES * mesh.spare // LANES)
  absent = np.full((-(-size // LANES) + more, LANES), number)  # of corners of the padding

  def room(count):
    width = count.reshape(-1, LANES).max(axis=1)
    width[len(width) - more :] = own.most
    return width

  entry = own.place[own.which], np.arange(number), np.ones(number)
  width, pair, _ = ellpack(*entry, absent, room if more else None)
  first, last = np.append(own.first, 0), np.append(own.last, 0)
  slots = np.empty((size, 2), np.int64)
  row = slot_rows(mesh, vert)
  for k, edge in enumerate((own.edge, own.edge[:, ::-1])):
    slots[own.place, k] = slot(mesh, row, node, edge)
  slots = np.concatenate([pad(slots, -1), np.full((more * LANES, 2), -1)])
  return {
    "edge_adr": addresses(width),
    "edge_from": corner_number(pair // 6, first[pair]),
    "edge_to": corner_number(pair // 6, last[pair]),
    "edge_slot": to_slices(slots).astype(np.int32),
  }


def slot_rows(mesh: Mesh, vert: np.ndarray) -> np.ndarray:
  """Returns the first row of blocks of each slice, as `Shape.slot_adr`."""
  degree = rows.room(mesh) if mesh.spare else mesh.degree
  return addresses(np.where(vert >= 0, degree[vert], 0).reshape(-1, LANES).max(axis=1))


def slot(mesh: Mesh, row: np.ndarray, node: np.ndarray, edge: np.ndarray) -> np.ndarray:
  """Returns where the block of each edge's first end starts, in floats; `row`: `slot_rows`."""
  start, end = edge.T
  entry = (mesh.ring[start] == end[:, None]).argmax(axis=1)
  return (row[node[start] // LANES] + entry) * 9 * LANES + node[start] % LANES


def none(nslice: int) -> dict[str, np.ndarray]:
  """Returns the arrays of `arrays` for a surface."""
  sizes = ("ntetslice", "naround", "nedge", "nedgeslice", "nsolidslice")
  return {
    "around_adr": np.zeros(nslice + 1, np.int32),
    "edge_adr": np.zeros(1, np.int32),
  } | empty(sizes)
