"""Writes what a cut has changed of a solid into the arrays of its body, in place, as `refill`.

Tetrahedra and the places of edges stay. What an edge becomes beside itself goes to places that
wait, so only lists of what has a tetrahedron near the cut are written.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from . import mesh as topology
from . import solid
from .body import Body, arrays
from .config import Config
from .fill import volumes
from .mesh import Mesh, among, distinct
from .order import LANES, addresses, offset


class SolidRefill:
  """The arrays of a solid's body that has room for cuts, on the host.

  Args:
    body: the body, with a `Shape` and a `Tissue` of its own
    mesh: what its arrays are of
  """

  def __init__(self, body: Body, mesh: Mesh):
    self._body, self.mesh = body, mesh
    self._arrays = arrays(body)
    self._host: dict[str, np.ndarray] = {}
    node = self._node = body.shape.node.numpy()
    self._start = body.shape.slot_adr.numpy()
    self._order = solid.order(mesh, node)
    self._pos = np.argsort(self._order)
    self._pairs = solid.pairs(dataclasses.replace(mesh, tet=mesh.tet[self._order]), node)
    self._around = body.shape.around_adr.numpy()
    self._edge_adr = body.shape.edge_adr.numpy()
    self._row = solid.slot_rows(mesh, body.shape.vert.numpy())
    self._steep = solid.steepness(mesh, mesh.tet)
    # Pairs by edge, the edge that has each place, and places that wait.
    self._by_edge = np.argsort(self._pairs.which, kind="stable")
    self._begin = addresses(np.bincount(self._pairs.which))
    count = LANES * (len(self._edge_adr) - 1)
    self._owner = np.full(count, -1)
    waits = -(-solid.EDGES * mesh.spare // LANES) * LANES
    self._owner[: count - waits] = count  # never free

  def forget(self):
    """Forgets what the arrays hold: others have written into them."""
    self._host = {}

  def write(self, mesh: Mesh, changed: np.ndarray, config: Config, pinned: np.ndarray):
    """Makes the body that of another mesh.

    Args:
      mesh: of the same whole
      changed: tetrahedra that are not as in the mesh so far
      config: configuration in force
      pinned: vertices that do not move, (nvert,) bool

    Raises:
      ValueError: there is no room for the edges; nothing has changed then.
    """
    if not changed.size:
      return
    old = self.mesh
    touched = distinct(old.tet[changed], mesh.tet[changed])
    apart = changed[(old.tet[changed] != mesh.tet[changed]).any(axis=1)]
    # Where a vertex has another number, the blocks of all that are beside it lie elsewhere.
    ends = distinct(old.tet[apart], mesh.tet[apart])
    near = np.flatnonzero(among(mesh.nvert, ends)[mesh.tet].any(axis=1))
    puts = self._edges(mesh, near) | self._fans(mesh, touched, pinned)
    puts |= self._tets(mesh, changed, config) | self._lists(mesh, touched, config)
    for name, parts in puts.items():
      array = self._arrays[name]
      if name not in self._host:
        self._host[name] = array.numpy()
      for where, values in parts:
        self._host[name][where] = values
      if self._body.device.is_cuda:
        array.assign(self._host[name])
    self._body.system.half.zero_()  # of neighbours that are none any more
    self.mesh = mesh

  def _fans(self, mesh: Mesh, touched: np.ndarray, pinned: np.ndarray) -> dict[str, list]:
    """Returns neighbours, places, and whether nodes move."""
    own = self._node[touched]
    s, lane = own // LANES, own % LANES
    width = np.diff(self._start)[s] + 2
    i, k = np.nonzero(np.arange(width.max()) < width[:, None])
    ring = np.pad(mesh.ring[touched], ((0, 0), (1, 2)), constant_values=-1)
    ring = np.pad(ring, ((0, 0), (0, max(0, width.max() - ring.shape[1]))), constant_values=-1)
    ring = ring[i, k]
    there = ring >= 0
    node = np.where(there, self._node[ring], own[i])
    here = mesh.rest[touched] - mesh.centre
    toward = np.where(there[:, None], mesh.rest[ring] - mesh.centre - here[i], 0.0)
    row = self._start[s[i]] + 2 * s[i] + k
    moves = np.where(pinned | mesh.unused, 0.0, 1.0)[touched]
    which = touched if self.mesh.loose is mesh.loose else np.arange(mesh.nskin)
    area = topology.held_areas(mesh)[which]
    at = self._node[which]
    most = np.zeros(len(self._start) - 1, int)
    np.maximum.at(most, self._node // LANES, mesh.degree)
    return {
      "fan_node": [((row, lane[i]), offset(node))],
      "fan_rest": [((row, slice(None), lane[i]), toward)],
      "degree": [((s, lane), mesh.degree[touched])],
      "fan_width": [(s, most[s])],
      "rest": [((s, slice(None), lane), here)],
      "free": [((s, lane), moves)],
      "area": [((at // LANES, at % LANES), area)],
    }

  def _tets(self, mesh: Mesh, changed: np.ndarray, config: Config) -> dict[str, list]:
    own, tet = self._pos[changed], mesh.tet[changed]
    self._steep[changed] = solid.steepness(mesh, tet)
    gradient = solid.gradients(dataclasses.replace(mesh, tet=tet))[:, 1:].reshape(-1, 9)
    at = own // LANES, own % LANES
    return {
      "tet_node": [((at[0], slice(None), at[1]), offset(self._node[tet]))],
      "tet_gradient": [((at[0], slice(None), at[1]), gradient)],
      "tet_moduli": [((at[0], 0, at[1]), volumes(mesh.rest, tet))],
      "stiffness": [(slice(None), solid.stiffness(mesh, config, self._steep))],
    }

  def _lists(self, mesh: Mesh, touched: np.ndarray, config: Config) -> dict[str, list]:
    """Returns the tetrahedra around nodes, and what they have of these."""
    tet = mesh.tet[self._order]
    corner = np.flatnonzero(among(mesh.nvert, touched)[tet.ravel()])
    vert = tet.ravel()[corner]
    by = np.argsort(vert, kind="stable")
    corner, vert = corner[by], vert[by]
    within = np.arange(len(vert)) - np.searchsorted(vert, vert)
    node = self._node[vert]
    row, lane = self._around[node // LANES] + within, node % LANES
    own = self._node[touched]
    width = np.diff(self._around)[own // LANES]
    i, k = np.nonzero(np.arange(width.max()) < width[:, None])
    blank = self._around[own[i] // LANES] + k, own[i] % LANES
    moduli = solid.nodal_moduli(mesh, config, touched)
    width = np.diff(self._start)[own // LANES]
    i, k = np.nonzero(np.arange(width.max()) < width[:, None])
    empty = self._start[own[i] // LANES] + k, slice(None), own[i] % LANES
    at, which, slope = solid.slopes(mesh, self._row, self._node, touched)
    return {
      "around_corner": [
        (blank, solid.corner_number(len(tet), 0)),
        ((row, lane), solid.corner_number(corner // 4, corner % 4)),
      ],
      "node_moduli": [((own // LANES, slice(None), own % LANES), moduli)],
      "fan_slope": [(empty, 0.0), ((at, slice(None), which), slope)],
    }

  def _edges(self, mesh: Mesh, near: np.ndarray) -> dict[str, list]:
    """Returns the tetrahedra around the edges of some, and where the blocks of these are.

    Raises:
      ValueError: there is no room for the edges; nothing has changed then.
    """
    if not near.size:
      return {}
    own, tet = self._pairs, mesh.tet[self._order]
    edge = distinct(own.which[6 * self._pos[near][:, None] + np.arange(6)])
    count = np.diff(self._begin)[edge]
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    pair = self._by_edge[np.repeat(self._begin[edge], count) + within]
    a, b = (tet[pair // 6, corner[pair]] for corner in (own.first, own.last))
    order = np.lexsort((pair, b, a, own.which[pair]))
    pair, a, b = pair[order], a[order], b[order]
    which = own.which[pair]
    new = np.append(True, (np.diff(which) != 0) | (np.diff(a) != 0) | (np.diff(b) != 0))
    part = np.cumsum(new) - 1
    head = np.flatnonzero(new)
    # The first part has the edge's own place, others one that waits.
    first = np.append(True, np.diff(which[head]) != 0)
    place = own.place[which[head]]
    gone = np.flatnonzero(among(len(own.edge) + 1, edge)[np.minimum(self._owner, len(own.edge))]
                          & (self._owner >= 0) & (self._owner < len(own.edge)))  # fmt: skip
    free = np.concatenate([gone, np.flatnonzero(self._owner < 0)])
    wanted = int((~first).sum())
    if wanted > len(free):
      raise ValueError("cuts leave no room for edges; give the organ more spare vertices")
    place[~first] = free[:wanted]
    self._owner[gone] = -1
    self._owner[place[~first]] = which[head[~first]]
    blank = distinct(place, gone)
    s, width = blank // LANES, np.diff(self._edge_adr)[blank // LANES]
    i, k = np.nonzero(np.arange(width.max(initial=0)) < width[:, None])
    void = self._edge_adr[s[i]] + k, blank[i] % LANES
    within = np.arange(len(pair)) - head[part]
    at = self._edge_adr[place[part] // LANES] + within, place[part] % LANES
    none = solid.corner_number(len(tet), 0)
    ends = np.stack([a[head], b[head]], axis=1)
    slots = [solid.slot(mesh, self._row, self._node, e) for e in (ends, ends[:, ::-1])]
    return {
      "edge_from": [(void, none), (at, solid.corner_number(pair // 6, own.first[pair]))],
      "edge_to": [(void, none), (at, solid.corner_number(pair // 6, own.last[pair]))],
      "edge_slot": [
        ((s, slice(None), blank % LANES), -1),
        ((place // LANES, slice(None), place % LANES), np.stack(slots, axis=1)),
      ],
      "edge_node": [((place // LANES, slice(None), place % LANES), self._node[ends])],
    }
