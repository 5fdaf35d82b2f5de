"""The inside of a solid: tetrahedra, and means over nodes of their gradients, to sliced arrays."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from . import config as configuration
from . import rows
from .config import Config
from .fill import vertex_volumes, volumes
from .mesh import Mesh, among
from .order import LANES, addresses, ellpack, offset, pad, to_slices
from .step import OWN_SHARE
from .types import empty

EDGES = 2  # by which cuts may divide edges, for one spare vertex
_WINDOW = 8 * LANES  # edges that are sorted by the number of their tetrahedra
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
  mesh = mesh.whole
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
  which = order(mesh, node)
  tet, volume = mesh.tet[which], volumes(mesh.rest, mesh.tet)[which]
  mu, lam = moduli(mesh, config)
  at = node[tet]
  absent = np.full((len(vert) // LANES, LANES), tet.size)
  room = _around_room(mesh, node, len(vert)) if mesh.spare else None
  entry = np.arange(tet.size)
  width, entry, _ = ellpack(at.ravel(), entry, np.ones(tet.size), absent, room)
  values = pad(np.stack([volume, mu[which], lam[which]], axis=1), least=1)
  values[len(tet) :, 1] = 1.0  # padding has no volume, but quotients
  gradient = gradients(mesh)[which, 1:].reshape(-1, 9)
  nodal = np.where((vert >= 0)[:, None], nodal_moduli(mesh, config)[vert], 0.0)
  row = slot_rows(mesh, vert)
  slope = np.zeros((row[-1], LANES, 3))
  at_row, lane, value = slopes(mesh, row, node)
  slope[at_row, lane] = value
  return {
    "tet_node": to_slices(pad(offset(at), least=1)).astype(np.int32),
    "tet_gradient": to_slices(pad(gradient, least=1)).astype(np.float32),
    "stiffness": stiffness(mesh, config, steepness(mesh, mesh.tet)),
    "tet_moduli": to_slices(values).astype(np.float32),
    "around_adr": addresses(width),
    "around_corner": corner_number(entry // 4, entry % 4),
    "fan_slope": np.ascontiguousarray(slope.transpose(0, 2, 1)).astype(np.float32),
    "node_moduli": to_slices(nodal).astype(np.float32),
    **_edges(dataclasses.replace(mesh, tet=tet), vert, node),
  }


def steepness(mesh: Mesh, tet: np.ndarray) -> np.ndarray:
  """Returns volume times the square of the steepest gradient of tetrahedra at rest [m], (n,)."""
  gradient = gradients(dataclasses.replace(mesh, tet=tet))
  return volumes(mesh.rest, tet) * (gradient**2).sum(axis=2).max(axis=1)


def stiffness(mesh: Mesh, config: Config, steep: np.ndarray) -> np.ndarray:
  """Returns that of a corner of the stiffest tetrahedron [N/m], (1,); steep: `steepness` of all."""
  mu, lam = moduli(mesh, config)
  return np.array([(steep * (mu + lam)).max()], np.float32)


def order(mesh: Mesh, node: np.ndarray) -> np.ndarray:
  """Returns tetrahedra in the order of their nodes before the first cut.

  Who gathers from them finds them near each other.
  """
  return np.lexsort(np.sort(node[mesh.whole.tet], axis=1).T[::-1])


def _around_room(mesh: Mesh, node: np.ndarray, nnode: int):
  """Returns what says the rows of each slice of lists of tetrahedra: a cut adds none to a list."""
  count = np.bincount(node[mesh.whole.tet].ravel(), minlength=nnode)
  count[node[mesh.spares]] = count.max()
  return lambda _: count.reshape(-1, LANES).max(axis=1)


def slopes(mesh: Mesh, row: np.ndarray, node: np.ndarray, which: np.ndarray | None = None):
  """Returns `fan_slope`: with it the mean of the gradients around a node is a sum over its fan.

  That of neighbour b is the sum of V g_b / sum V over the tetrahedra around the node, g_b the
  gradient of the share of b in each.

  Args:
    mesh: the solid
    row: see `slot_rows`
    node: node of each vertex   (nvert,)
    which: vertices, ascending, None for all

  Returns:
    rows and lanes of entries (n,), their slopes [1/m] (n, 3)
  """
  tet = mesh.tet
  if which is not None:
    mine = among(mesh.nvert, which)
    tet = tet[mine[tet].any(axis=1)]
  pairs = np.array([(a, b) for a in range(4) for b in range(4) if a != b])
  start, end = (tet[:, pairs[:, k]].ravel() for k in (0, 1))
  part = dataclasses.replace(mesh, tet=tet)
  weighed = volumes(mesh.rest, tet)[:, None, None] / 4 * gradients(part)
  value = weighed[:, pairs[:, 1]].reshape(-1, 3)
  if which is not None:
    keep = mine[start]
    start, end, value = start[keep], end[keep], value[keep]
  key, number = np.unique(start * mesh.nvert + end, return_inverse=True)
  sums = [np.bincount(number, column, len(key)) for column in value.T]
  start = np.asarray(key // mesh.nvert, int)
  total = vertex_volumes(part)[start]  # all that is around these is there
  entry = np.arange(len(key)) - np.searchsorted(start, start)
  return row[node[start] // LANES] + entry, node[start] % LANES, np.stack(sums, 1) / total[:, None]


def nodal_moduli(mesh: Mesh, config: Config, which: np.ndarray | None = None) -> np.ndarray:
  """Returns what vertices, or some, have of mu, and lambda [Pa], (n, 2): the means around them."""
  mu, lam = moduli(mesh, config)
  if which is not None:
    near = among(mesh.nvert, which)[mesh.tet].any(axis=1)
    mesh, mu, lam = dataclasses.replace(mesh, tet=mesh.tet[near]), mu[near], lam[near]
  sums = [vertex_volumes(mesh, part) for part in ((1 - OWN_SHARE) * mu, lam)]
  out = np.stack(sums, axis=1) / np.maximum(vertex_volumes(mesh), 1e-300)[:, None]
  return out if which is None else out[which]


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
  ends = np.zeros((size, 2), np.int64)
  ends[own.place] = node[own.edge]
  slots = np.concatenate([pad(slots, -1), np.full((more * LANES, 2), -1)])
  ends = np.concatenate([pad(ends), np.zeros((more * LANES, 2), np.int64)])
  return {
    "edge_adr": addresses(width),
    "edge_from": corner_number(pair // 6, first[pair]),
    "edge_to": corner_number(pair // 6, last[pair]),
    "edge_node": to_slices(ends).astype(np.int32),
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
  sizes = ("ntetslice", "naround", "nedge", "nedgeslice", "nsolidslice", "nsolidslot")
  return {
    "around_adr": np.zeros(nslice + 1, np.int32),
    "edge_adr": np.zeros(1, np.int32),
    "stiffness": np.zeros(1, np.float32),
  } | empty(sizes)
