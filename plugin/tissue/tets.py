"""What the inside of a solid has in `Shape` and `Tissue`, as `tissue/tets.h` writes it.

`solid` makes the arrays of all of it so, and `cutting.refill` writes those that a cut has changed.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from .geometry.mesh import Mesh
from .kernels import aim, kernel
from .order import LANES, addresses, pad
from .rows import Filling, typed
from .step import OWN_SHARE
from .types import CONSTANTS, also, doubles, flags, halves, ints, longs, struct

EDGES = 2  # by which cuts may divide edges, for one spare vertex
_WINDOW = 8 * LANES  # edges that are sorted by the number of their tetrahedra
OF_SHAPE = (
  "fan_node", "fan_rest", "fan_width", "degree", "rest", "free", "area", "tet_node", "tet_gradient",
  "around_corner", "fan_slope", "edge_from", "edge_to", "edge_node", "edge_slot",
)  # fmt: skip
OF_TISSUE = ("tet_moduli", "node_moduli", "stiffness")
NAMES = (*OF_SHAPE, *OF_TISSUE)
ADDRESSES = ("slot_adr", "around_adr", "edge_adr")


@struct
@typed(OF_SHAPE, OF_TISSUE)
@also(Filling, "nchanged", "nint", "nreal", "skip", "centre", "pinned", "node", "slot_adr")
@also(Filling, "found", "ints", "reals")
class Within:
  """A solid, what its rows are made of, and what they are written to, under the names there."""

  nvert: int
  ntet: int
  nskin: int
  nelem: int  # triangles
  most: int  # neighbours that a vertex has room for
  most_around: int  # tetrahedra around an edge, at most
  nedge: int  # before the first cut
  nplace: int  # places of edges
  nwait: int  # the last so many wait for edges that cuts divide
  every: int  # whether all is written, but what a surface has too
  clears: int  # whether blocks of former neighbours are in `half`
  own: wp.float64  # share of mu that tetrahedra have by themselves
  mesh_rest: doubles("nvert", 3)  # see `Mesh`, with those that follow
  ring: longs("nvert", "most")
  mesh_degree: longs("nvert")
  elem: longs("nelem", 3)
  loose: flags("nelem")
  tet: ints("ntet", 4)  # in the order of the arrays, as all that is by tetrahedron
  whole_tet: ints("ntet", 4)
  begin: ints("nvert + 1")  # of the corners around each vertex of the whole
  around: ints("ncorner")  # these
  mu: doubles("ntet")  # [Pa]
  lam: doubles("ntet")  # [Pa]
  steep: doubles("ntet")  # volume times the square of the steepest gradient [m]
  changed: ints("ntet")  # tetrahedra that are not as they were
  before: ints("ntet", 4)  # corners that they had
  around_adr: ints("nslice + 1")
  edge_adr: ints("nedgeslice + 1")
  which: ints("npair")  # the edge of each pair of corners before the first cut
  first: ints("npair")  # its corner of the lower vertex number then, and the other
  last: ints("npair")
  edge_begin: ints("nedge + 1")  # of the pairs of each edge
  edge_pair: ints("npair")  # these
  place: ints("nedge")  # where each edge lies
  half: halves("nhalf")  # see `System`


_fill = kernel("fill_solid", "tissue/tets.h", Within, CONSTANTS)


@dataclasses.dataclass(frozen=True)
class Layout:
  """Where the tetrahedra of a solid and their edges lie, cut or not.

  Attributes:
    order: tetrahedra in the order of the arrays      (ntet,)
    first, last, which, place: see `Within`
    most: tetrahedra around an edge, at most
    waits: places of edges that wait
    around_adr: see `types.Shape`
    edge_adr: see there
  """

  order: np.ndarray
  first: np.ndarray
  last: np.ndarray
  which: np.ndarray
  place: np.ndarray
  most: int
  waits: int
  around_adr: np.ndarray
  edge_adr: np.ndarray


def order(mesh: Mesh, node: np.ndarray) -> np.ndarray:
  """Returns tetrahedra in the order of the arrays: that of their nodes before the first cut.

  Who gathers from them finds them near each other.
  """
  return np.lexsort(np.sort(node[mesh.whole.tet], axis=1).T[::-1])


def layout(mesh: Mesh, node: np.ndarray, nnode: int) -> Layout:
  """Returns where tetrahedra and edges lie; `node`: of each vertex, of `nnode`."""
  mesh = mesh.whole
  which_tet = order(mesh, node)
  tet = mesh.tet[which_tet]
  a, b = np.triu_indices(4, 1)
  ends = np.sort(tet[:, np.stack([a, b], axis=1)].reshape(-1, 2), axis=1)
  # The first end is that of the lower number.
  swap = (tet[:, a] > tet[:, b]).ravel()
  first, last = np.tile(a, len(tet)), np.tile(b, len(tet))
  first, last = np.where(swap, last, first), np.where(swap, first, last)
  edge, which, count = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
  # Near ones near each other; within a window those of as many tetrahedra, so that slices are full.
  near = np.lexsort(np.sort(node[edge], axis=1).T[::-1])
  window = np.arange(len(edge)) // _WINDOW
  by = near[np.lexsort((np.arange(len(edge)), -count[near], window))]
  place = np.empty(len(edge), np.int64)
  place[by] = np.arange(len(edge))
  most, more = int(count.max()), -(-EDGES * mesh.spare // LANES)
  width = np.append(pad(count[by]).reshape(-1, LANES).max(axis=1), np.full(more, most))
  around = np.bincount(node[mesh.tet].ravel(), minlength=nnode)
  if mesh.spare:  # a cut adds none to a list
    around[node[mesh.spares]] = around.max()
  around_adr = addresses(around.reshape(-1, LANES).max(axis=1))
  return Layout(
    which_tet, first, last, which.ravel(), place, most, LANES * more, around_adr, addresses(width)
  )


def blank(lay: Layout, nslot: int, nslice: int) -> dict[str, np.ndarray]:
  """Returns the arrays of tetrahedra as those of padding, see `types.Shape` and `Tissue`."""
  ntet, nedge = len(lay.order), len(lay.edge_adr) - 1
  slices = ntet // LANES + 1  # one at least is padding
  none = corner_number(ntet)
  moduli = np.zeros((slices, 3, LANES), np.float32)
  moduli[:, 1] = 1.0  # padding has no volume, but quotients
  return {
    "tet_node": np.zeros((slices, 4, LANES), np.int32),
    "tet_gradient": np.zeros((slices, 9, LANES), np.float32),
    "tet_moduli": moduli,
    "stiffness": np.zeros(1, np.float32),
    "around_adr": lay.around_adr,
    "around_corner": np.full((lay.around_adr[-1], LANES), none),
    "fan_slope": np.zeros((nslot, 3, LANES), np.float32),
    "node_moduli": np.zeros((nslice, 2, LANES), np.float32),
    "edge_adr": lay.edge_adr,
    "edge_from": np.full((lay.edge_adr[-1], LANES), none),
    "edge_to": np.full((lay.edge_adr[-1], LANES), none),
    "edge_node": np.zeros((nedge, 2, LANES), np.int32),
    "edge_slot": np.full((nedge, 2, LANES), -1, np.int32),
  }


def corner_number(tet: int) -> np.int32:
  """Returns the number of the first corner of a tetrahedron; a slice has eight times four."""
  return np.int32(tet // LANES * 4 * LANES + tet % LANES)


class Tets:
  """Writes rows of solids of one whole.

  Args:
    mesh: one of these
    lay: where what is
    node: node of every vertex
    arrays: those that `Within` has of `Shape` and `Tissue`, on the CPU; others are left out
  """

  def __init__(self, mesh: Mesh, lay: Layout, node: np.ndarray, arrays: Mapping[str, Any]):
    whole = mesh.whole
    self._order = lay.order
    self._place = np.argsort(lay.order)
    ntet, nvert, npair = len(whole.tet), whole.nvert, len(lay.which)
    self._fields = fields = Within()
    self.put(arrays)
    self._mesh: Mesh | None = None  # what the arrays were last
    self._tet = whole.tet[lay.order].astype(np.int32)
    self._steep = np.zeros(ntet)
    self._changed, self._before = np.zeros(ntet, np.int32), np.zeros((ntet, 4), np.int32)
    self._pinned = np.zeros(nvert, np.uint8)
    corner, edges = self._tet.ravel(), len(lay.place)
    nint, nreal = 6 * nvert + 2 * edges + 2 * lay.most, nvert + 3 * whole.ring.shape[1]
    self._set(
      nvert=nvert, ntet=ntet, nskin=whole.nskin, most=whole.ring.shape[1], most_around=lay.most,
      nedge=edges, nplace=LANES * (len(lay.edge_adr) - 1), nwait=lay.waits, own=OWN_SHARE,
      nint=nint, nreal=nreal, centre=whole.centre, tet=self._tet, whole_tet=self._tet.copy(),
      around=np.argsort(corner, kind="stable"), changed=self._changed, before=self._before,
      begin=addresses(np.bincount(corner, minlength=nvert)), steep=self._steep, node=node,
      which=lay.which, first=lay.first, last=lay.last, place=lay.place, pinned=self._pinned,
      edge_pair=np.argsort(lay.which, kind="stable"), edge_begin=addresses(np.bincount(lay.which)),
      found=np.zeros(1), ints=np.zeros(nint), reals=np.zeros(nreal),
      half=np.zeros(0),
    )  # fmt: skip
    assert npair == 6 * ntet
    self._found = fields.found.numpy()
    self._launch = _fill.command(fields).launch

  def put(self, arrays: Mapping[str, Any]):
    """Writes into these arrays from now on."""
    self._set(**{name: arrays[name] for name in (*NAMES, *ADDRESSES) if name in arrays})

  def clear(self, half: wp.array):
    """Clears the blocks of former neighbours, on the CPU."""
    self._set(half=half.flatten(), clears=1)

  def _set(self, **values):
    for name, value in values.items():
      if isinstance(value, np.ndarray):
        kind = Within.vars[name].type.dtype
        value = np.ascontiguousarray(value, wp.dtype_to_numpy(kind))
        value = wp.array(value, dtype=kind, device="cpu", copy=False)
      setattr(self._fields, name, value)

  def write(
    self,
    mesh: Mesh,
    moduli: tuple[np.ndarray, np.ndarray] | None,
    pinned: np.ndarray,
    changed: np.ndarray | None = None,
    before: Mesh | None = None,
    skip: int = 0,
  ) -> bool:
    """Writes the rows of a solid; returns False where there is no room for its edges.

    Nothing was written then.

    Args:
      mesh: the solid
      moduli: mu and lambda of each tetrahedron [Pa], None for those before
      pinned: vertices that do not move, (nvert,) bool
      changed: tetrahedra that are not as in the arrays, None for all
      before: the solid that the arrays are of
      skip: words by which what is written to lies after the arrays
    """
    every = changed is None
    which = np.arange(len(self._order)) if changed is None else np.sort(self._place[changed])
    n = len(which)
    new = mesh.tet[self._order[which]]
    if every:  # an edge that was divided is so whatever was there before
      self._tet[:] = new
    elif before is not None and before is not self._mesh:  # of another world
      self._tet[:], self._steep[:] = before.tet[self._order], 0.0
    self._changed[:n], self._before[:n], self._tet[which] = which, self._tet[which], new
    self._pinned[:] = pinned
    if moduli is not None:
      self._set(mu=moduli[0][self._order], lam=moduli[1][self._order])
    loose = np.zeros(mesh.nelem, bool) if mesh.loose is None else mesh.loose
    self._set(nelem=mesh.nelem, nchanged=n, every=int(every), skip=skip)
    aim(self._fields, mesh_rest=mesh.rest, ring=mesh.ring, mesh_degree=mesh.degree,
        elem=mesh.elem, loose=loose)  # fmt: skip
    self._launch()
    self._mesh = mesh if self._found[0] else None
    return bool(self._found[0])
