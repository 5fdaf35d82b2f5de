"""What vertices, triangles and hinges have in `Shape` and `Tissue`, as `tissue/rows.h` writes it.

`shape` makes the arrays of all of them so, and `refill` writes those that a cut has changed.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import warp as wp

from . import config as configuration
from .config import Config
from .cutting.surface import Surface, WorkingCopy
from .geometry import faces
from .geometry.mesh import Mesh
from .kernels import kernel
from .types import CONSTANTS, Shape, Tissue, doubles, flags, ints, struct

OF_SHAPE = (
  "fan_node", "fan_rest", "fan_corner", "fan_side", "fan_width", "degree", "rest", "area", "free",
  "elem_node", "elem_rest", "elem_hinge", "hinge_node", "hinge_rest", "hinge_elem", "hinge_near",
  "bend_node", "bend_width",
)  # fmt: skip
OF_TISSUE = ("fan_metric", "fan_spring", "hinge_gain", "bend_gain", "bend_diag")
NAMES = (*OF_SHAPE, *OF_TISSUE)
ADDRESSES = ("slot_adr", "bend_adr")


def typed(*names: tuple[str, ...]) -> Callable[[type], type]:
  """Returns what gives a struct arrays of `Shape`, and of `Tissue`, of the types that they have."""

  def give(cls: type) -> type:
    for kind, some in zip((Shape, Tissue), names, strict=True):
      cls.__annotations__ |= {name: kind.vars[name].type for name in some}
    return cls

  return give


@struct
@typed(OF_SHAPE, OF_TISSUE)
class Filling:
  """A surface, what its rows are made of, and what they are written to, under the names there."""

  surface: Surface
  every: int  # whether all is written
  loosened: int  # whether areas of all vertices are written
  coarse: int  # whether it is a mesh for preconditioning alone, see `tissue/plate.h`
  bends: int  # whether there is bending
  springs: int  # whether edges are springs, not triangles a membrane
  nhinge: int  # hinges before the first cut
  nchanged: int
  nint: int  # whole numbers of scratch
  nreal: int  # others
  thickness: wp.float64  # [m]
  stiffness: wp.float64  # of an edge's spring [N/m]
  poisson: wp.float64
  skip: wp.int64  # words by which what is written to lies after the arrays
  centre: doubles(3)  # that rest positions are about [m]
  lame: doubles("nelem")  # of triangles [Pa]
  shear: doubles("nelem")  # [Pa]
  young: doubles("nelem")  # [Pa]
  rigidity: doubles("nelem")  # of their plates [N m]
  pinned: flags("nvert")  # whether a vertex does not move
  changed: ints("nelem")  # triangles that are not as they were
  before: ints("nelem", 3)  # corners that they had
  hinge_of: ints("nhalf")  # number of each half-edge's hinge before the first cut
  node: ints("nvert")
  slot_adr: ints("nslice + 1")
  bend_adr: ints("nslice + 1")
  count: ints("nvert")  # entries of rows of the bending matrix
  found: ints(1)  # whether there was room for these
  ints: ints("nint")
  reals: doubles("nreal")


_count = kernel("count_bends", "tissue/rows.h", Filling, CONSTANTS)
_fill = kernel("fill_rows", "tissue/rows.h", Filling, CONSTANTS)
_PLATE = 21  # doubles of a triangle's plate


class Rows:
  """Writes rows of the surfaces of one whole.

  Args:
    copy: where these are
    arrays: those that `Filling` has of `Shape` and `Tissue`, on the CPU; others are left out
    node: node of every vertex
    coarse: whether it is a mesh for preconditioning alone
  """

  def __init__(
    self, copy: WorkingCopy, arrays: Mapping[str, Any], node: np.ndarray, coarse: bool = False
  ):
    whole, sizes = copy.whole, copy.sizes
    self._copy, self._config, self.fields = copy, None, Filling()
    self.put(arrays)
    hinge_of = np.full(3 * whole.nelem, -1, np.int32)
    hinge_of[whole.interior] = np.arange(len(whole.interior))
    hinge_of[whole.twin[whole.interior]] = np.arange(len(whole.interior))
    nint = 5 * sizes["nvert"] + 4 * sizes["nelem"] + 16 * sizes["most"]
    nreal = 8 * sizes["most"] + _PLATE * sizes["nelem"]
    scratch = {"ints": np.empty(nint, np.int32), "reals": np.empty(nreal)}
    self._changed = np.zeros(whole.nelem, np.int32)
    self._before = np.zeros((whole.nelem, 3), np.int32)
    self._pinned = np.zeros(whole.nvert, np.uint8)
    self._put(
      **scratch, nint=nint, nreal=nreal, nhinge=len(whole.interior), hinge_of=hinge_of,
      centre=whole.centre, node=node.astype(np.int32), found=np.zeros(1, np.int32),
      count=np.zeros(sizes["nvert"], np.int32), changed=self._changed, before=self._before,
      pinned=self._pinned,
    )  # fmt: skip
    self.fields.surface, self.fields.coarse = copy.fields, int(coarse)
    self._fill, self._found = _fill.command(self.fields).launch, self.fields.found.numpy()

  def put(self, arrays: Mapping[str, Any]):
    """Writes into these arrays from now on."""
    for name in (*NAMES, *ADDRESSES):
      if name in arrays:
        setattr(self.fields, name, _array(name, arrays[name]))

  def _put(self, **values):
    for name, value in values.items():
      setattr(self.fields, name, _array(name, value) if isinstance(value, np.ndarray) else value)

  def widths(self, mesh: Mesh) -> np.ndarray:
    """Returns the entries of each vertex's row of the bending matrix, (nvert,)."""
    self._copy.put(mesh)
    _count.launch("cpu", 1, 1, 0, self.fields)
    return self.fields.count.numpy().copy()

  def write(
    self,
    mesh: Mesh,
    config: Config,
    pinned: np.ndarray,
    changed: np.ndarray | None = None,
    before: np.ndarray | None = None,
    loosened: bool = True,
    skip: int = 0,
  ) -> bool:
    """Writes the rows of a surface; returns False where the bending matrix has no room for them.

    Nothing was written then.

    Args:
      mesh: the surface
      config: its configuration
      pinned: vertices that do not move, (nvert,) bool
      changed: triangles that are not as in the arrays, None for all
      before: corners that these have there, (n, 3)
      loosened: whether what the foundation holds may be other triangles too
      skip: words by which what is written to lies after the arrays
    """
    self._copy.put(mesh)
    self._put_material(config)
    self.fields.every, self.fields.loosened = int(changed is None), int(loosened)
    self.fields.skip = skip
    changed = np.arange(mesh.nelem) if changed is None else changed
    self.fields.nchanged = n = len(changed)
    self._changed[:n], self._pinned[:] = changed, pinned
    self._before[:n] = mesh.elem[changed] if before is None else before
    self._fill()
    return bool(self._found[0])

  def _put_material(self, config: Config):
    if config is self._config or config == self._config:
      return
    nelem, springs = self._copy.whole.nelem, config.elements == "spring"
    lame, shear = configuration.lame(config, nelem)
    self._put(
      bends=int(config.bend > 0),
      springs=int(springs),
      thickness=config.thickness,
      stiffness=config.stiffness,
      poisson=config.poisson,
      lame=0 * lame if springs else lame,
      shear=0 * shear if springs else shear,
      young=np.array(np.broadcast_to(np.asarray(config.young, float), (nelem,))),
      rigidity=configuration.rigidity(config, nelem),
    )
    self._config = config


def _array(name: str, value: Any) -> wp.array:
  if not isinstance(value, np.ndarray):
    return value
  return wp.array(value, dtype=Filling.vars[name].type.dtype, device="cpu", copy=False)


def room(mesh: Mesh) -> np.ndarray:
  """Returns the most neighbours that each vertex can have, cut or not, (nvert,).

  A cut takes triangles from a fan and adds none; an open one has a neighbour more than triangles.
  """
  mesh = mesh.whole
  if len(mesh.tet):
    return faces.room(mesh)
  closes = mesh.ring_elem[np.arange(mesh.nvert), np.maximum(mesh.degree - 1, 0)] >= 0
  most = mesh.degree + (closes & (mesh.degree > 0))
  most[mesh.spares] = most.max()
  return most
