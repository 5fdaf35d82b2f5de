"""What the kernels read and write: one struct a group, one line a field.

A line says meaning, unit, type and shape, and the shape is what `allocate` makes. Sizes are named:
nworld worlds; nslice slices of nodes, nelemslice of triangles, nhingeslice of hinges (0 without
bending), ntetslice of tetrahedra (0 but for solids); nslot rows of stiffness blocks; others see
`body`. Nodes lie in slices of eight, the last
axis; `core/simd.h` says how they are read.
"""

import collections
import dataclasses
import enum
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from .device import BLOCK, MAX_BLOCKS, SPLIT, WORDS
from .order import LANES


@dataclasses.dataclass(frozen=True)
class Array:
  """Type and shape of a field."""

  dtype: type
  dims: tuple


def floats(*dims) -> Array:
  """Returns the type of an array of float32."""
  return Array(wp.float32, dims)


def doubles(*dims) -> Array:
  """Returns the type of an array of float64."""
  return Array(wp.float64, dims)


def halves(*dims) -> Array:
  """Returns the type of an array of 16 bits; native code reads them as numbers of eleven digits."""
  return Array(wp.uint16, dims)


def ints(*dims) -> Array:
  """Returns the type of an array of int32."""
  return Array(wp.int32, dims)


def longs(*dims) -> Array:
  """Returns the type of an array of int64."""
  return Array(wp.int64, dims)


def flags(*dims) -> Array:
  """Returns the type of an array of bytes, each 0 or 1."""
  return Array(wp.uint8, dims)


DIMS: dict[str, dict[str, tuple]] = {}  # struct and field -> its shape


def struct(cls) -> Any:
  """Returns a Warp struct whose arrays have the shapes of the annotations."""
  kinds = cls.__annotations__
  if any(isinstance(kind, str) for kind in kinds.values()):
    text = "annotations are text, expected no `from __future__ import annotations` in the module"
    raise TypeError(f"{cls.__module__}.{cls.__qualname__}: {text}")
  arrays = {name: kind for name, kind in kinds.items() if isinstance(kind, Array)}
  DIMS[cls.__name__] = {name: kind.dims for name, kind in arrays.items()}
  cls.__annotations__ = kinds | {
    name: wp.array(dtype=kind.dtype, ndim=len(kind.dims)) for name, kind in arrays.items()
  }
  return wp.struct(cls)


def lent(arrays: dict[str, Array]) -> Callable[[type], Any]:
  """Returns a decorator: a struct has arrays of another library's as well, under these names."""

  def made(cls: type) -> Any:
    cls.__annotations__ = cls.__annotations__ | arrays
    return struct(cls)

  return made


def also(kind: Any, *names: str) -> Callable[[type], type]:
  """Returns a decorator: a struct that is to be has some fields of another one as well."""
  dims = DIMS[kind.key]

  def made(cls: type) -> type:
    for name in names:
      own = kind.vars[name].type
      cls.__annotations__[name] = Array(own.dtype, dims[name]) if name in dims else own
    return cls

  return made


def tuple_of(kind: Any) -> Any:
  """Returns a named tuple of a struct's fields; its `of` makes one of what a struct has there."""
  made = collections.namedtuple(f"Of{kind.__name__}", kind.vars)
  made.of = classmethod(lambda cls, told: cls(*(getattr(told, name) for name in cls._fields)))
  return made


class Stage(enum.IntEnum):
  """What a right-hand side is for, which decides the weight of K v in it.

  FIRST and LATER are Newton iterations. The first stands at x + share h v, share in `State.step`,
  and has the rest of the step ahead in it: h^2 (1 - share) + h damping; later ones are residuals at
  the trial state, where share is 1, h damping; `midpoint` has a share of its own. EXPLICIT has h
  damping, and NEUMANN brings its own. RESPONSE is the answer to impulses alone, with the matrix of
  the last solve.
  """

  FIRST = 0
  LATER = 1
  EXPLICIT = 2
  NEUMANN = 3
  RESPONSE = 4


# Numbers that may change while running, in the order of `Tissue.number`: configuration keys, where
# worlds differ what mu, lambda' (of solids lambda) and the plate's rigidity are multiples of, and
# what of h a step takes off the damping, see `shape.eased`.
NUMBERS = (
  "foundation", "bulk", "pressure", "damping", "tolerance", "iterations", "stiffness",
  "shear", "lame", "plate", "eased", "tension",
)  # fmt: skip

# What native code knows of these, as constexpr.
CONSTANTS: dict[str, int | float] = {
  "LANES": LANES,
  "BLOCK": BLOCK,
  "MAX_BLOCKS": MAX_BLOCKS,
  "WORDS": WORDS,
  "SPLIT": SPLIT,
  **{stage.name: stage.value for stage in Stage},
  "NUMBERS": len(NUMBERS),
  # Whether code for these is compiled; which of them there are is found as it runs.
  **dict.fromkeys(("BENDING", "SPRINGS", "VOLUMES", "TENSIONS", "MESHES"), 1),
  **{name.upper(): k for k, name in enumerate(NUMBERS)},
}

vector = floats("nworld", "nslice", 3, 8)
scalar = floats("nworld", "nslice", 8)


@struct
class Shape:
  """Topology and rest shape.

  A fan is the ring of neighbours of a node, `width` entries, the last one repeated in front and the
  first one behind: entries [k] and [k + 1] are the k-th triangle of the node. Irregular lists are
  sliced ELLPACK (Kreutzer et al. 2014, doi:10.1137/130930352): row k of a slice holds the k-th
  entry of its eight nodes. An offset is where a node's x starts in a vector of slices, in floats.
  """

  nvert: int  # vertices
  nnode: int  # nodes: vertices padded to whole slices
  nslice: int  # slices of nodes
  nused: int  # those that a step goes over: not the last ones, of vertices that wait for a cut
  nelemslice: int  # slices of triangles; 0 without bending
  nhingeslice: int  # slices of hinges; 0 without bending
  ntetslice: int  # slices of tetrahedra; 0 but for solids
  nedgeslice: int  # slices of their edges; 0 but for solids
  nslot: int  # rows of stiffness blocks
  closed: int  # whether the surface encloses a volume
  unheld: int  # whether nothing holds the organ, nor cuts part it, so that it may spin
  stride: int  # words from a mesh to the next, where worlds have their own, see `meshes`
  volume0: float  # rest volume [m^3]; 0 for an open surface
  shortest: float  # no edge is shorter at rest [m]; 0 where cuts may come
  mesh: ints("nmesh")  # which mesh each world has; none where all have the first
  vert: ints("nnode")  # vertex of each node, -1 for padding
  node: ints("nvert")  # node of each vertex
  slot_adr: ints("nslice + 1")  # first row of stiffness blocks
  held_adr: ints("nheld")  # where a block keeps the blocks of each slice in its memory, in floats
  fan_node: ints("nslot + 2 nslice", 8)  # offset of each fan entry's node
  fan_rest: floats("nslot + 2 nslice", 3, 8)  # rest vector to each fan entry [m]
  fan_corner: ints("nslot + nslice", 8)  # offset of each fan triangle's normal
  fan_side: ints("nslot + nslice", 8)  # offset of its corner force at this node
  fan_width: ints("nslice")  # rows of stiffness blocks that some node has a neighbour in
  degree: floats("nslice", 8)  # number of neighbours
  rest: floats("nslice", 3, 8)  # rest position about the centroid [m]
  area: floats("nslice", 8)  # nodal area [m^2]; 0 for padding
  free: floats("nslice", 8)  # 1 for nodes that move, 0 pinned or padding
  elem_node: ints("nelemslice", 3, 8)  # offset of each corner's node
  elem_rest: floats("nelemslice", 6, 8)  # rest vectors corner 0 -> 1, 0 -> 2 [m]
  elem_hinge: ints("nelemslice", 3, 8)  # hinge opposite each corner
  hinge_node: ints("nhingeslice", 4, 8)  # offset of p0, p1, left, right apex
  hinge_rest: floats("nhingeslice", 9, 8)  # rest vectors p0 -> p1, left, right [m]
  hinge_elem: ints("nhingeslice", 2, 8)  # offset of left and right triangle
  hinge_near: ints("nhingeslice", 4, 8)  # the four other hinges of both triangles
  hinge_angle0: floats("nhingeslice", 8)  # rest angle 2 sin(theta / 2) [-]
  bend_adr: ints("nslice + 1")  # first row of the bending matrix
  bend_node: ints("nbend", 8)  # node of each entry
  bend_width: ints("nbendslice")  # rows of it that some node has an entry in
  fan_slope: floats("nsolidslot", 3, 8)  # of a neighbour's share in a node's mean gradient [1/m]
  tet_node: ints("ntetslice", 4, 8)  # offset of each corner's node
  tet_gradient: floats("ntetslice", 9, 8)  # of the shares of corners 1, 2, 3 at rest [1/m]
  around_adr: ints("nslice + 1")  # first row of each slice below, for solids
  around_corner: ints("naround", 8)  # number of its corner there
  edge_adr: ints("nedgeslice + 1")  # first row of each slice of edges in the two below
  edge_from: ints("nedge", 8)  # of each tetrahedron around an edge, its corner at the first end
  edge_to: ints("nedge", 8)  # its corner at the other
  edge_node: ints("nedgeslice", 2, 8)  # its ends
  edge_slot: ints("nedgeslice", 2, 8)  # where the blocks of both ends start; -1 for padding
  ncapsule: int  # rows of blocks of the skin of a solid, 0 without one; its fans are as those above
  capsule_adr: ints("ncapsuleslice + 1")  # first row of these
  capsule_node: ints("ncapsule + 2 ncapsuleslice", 8)  # see `fan_node`
  capsule_rest: floats("ncapsule + 2 ncapsuleslice", 3, 8)  # see `fan_rest`
  capsule_corner: ints("ncapsule + ncapsuleslice", 8)  # see `fan_corner`
  capsule_side: ints("ncapsule + ncapsuleslice", 8)  # see `fan_side`
  capsule_degree: floats("ncapsuleslice", 8)  # number of neighbours on the surface


@struct
class Tissue:
  """Material on a shape; `number` may change while running, without a graph recorded anew."""

  number: floats("nworld", "nnumber")  # see NUMBERS
  fan_metric: floats("nslot + nslice", 5, 8)  # rest metric [1/m^2]; mu, lambda' times volume [N m]
  fan_spring: floats("nslot", 8)  # spring that stands for an edge, for `neumann` [N/m]
  hinge_gain: floats("nhingeslice", 5, 8)  # stiffness to itself and to `hinge_near` [N m]
  bend_gain: floats("nbend", 8)  # bending matrix [N/m]
  bend_diag: floats("nbendslice", 8)  # its diagonal [N/m]
  stiffness: floats(1)  # of the stiffest tetrahedron at rest, the unit of solids' blocks [N/m]
  tet_moduli: floats("ntetslice", 3, 8)  # volume [m^3]; mu, lambda [Pa]
  node_moduli: floats("nsolidslice", 2, 8)  # mu, lambda of its mean gradient [Pa]
  capsule_metric: floats("ncapsule + ncapsuleslice", 5, 8)  # see `fan_metric`


@struct
class State:
  """Motion of the organs of nworld worlds, and what acts on them."""

  step: floats("nworld", 4)  # h, h^2 + h damping, floor of the residual, share of h v looked ahead
  disp: vector  # displacement from rest [m]
  vel: vector  # velocity [m/s]
  mass: scalar  # mass [kg]
  force_ext: vector  # external and lagged contact force [N]
  hold: floats("nworld", "nholdslice", 6, 8)  # what springs in `force_ext` weigh on dv [kg]
  paired: ints("nworld")  # whether springs there are between two nodes each
  pair_node: ints("nworld", "npairslice", 8)  # offset of the other one
  pair_hold: floats("nworld", "npairslice", 6, 8)  # what such a spring weighs on their dv [kg]
  dvel: vector  # change of velocity in this step [m/s]
  dvel_warm: vector  # what those of the last steps lead to, where PCG starts [m/s]
  expected: floats("nworld")  # b^T Mhat^-1 b, for the impulses b that a response is to [J]


@struct
class System:
  """The linear system of a step and the vectors of its solve."""

  change: floats("nworld")  # largest (rate of an edge's ends over its length)^2 [1/s^2]
  disp_trial: vector  # displacement of the present Newton iteration [m]
  vel_trial: vector  # velocity of the present Newton iteration [m/s]
  block: floats("nworld", "nskinslot", 9, 8)  # off-diagonal blocks of A [kg]
  half: halves("nworld", "nsolidslot", 9, 8)  # of solids, in `stiffness` times h^2 + h damping
  diag: scalar  # inertia and foundation on the diagonal [kg]
  inverse: floats("nworld", "nslice", 6, 8)  # inverse of the diagonal blocks [1/kg]
  rhs: vector  # right-hand side [N s]
  areavec: floats("nworld", "nareaslice", 3, 8)  # area vector of a node, 6 dV/dx [m^2]
  normal: floats("nworld", "nbendslice", 3, 8)  # unit normal of a node
  elem_normal: floats("nworld", "nelemslice", 4, 8)  # unit normal; stiffness of its edges [N/m]
  elem_corner: floats("nworld", "nelemslice", 3, 8)  # force on each corner along it [N s]
  hinge_angle: floats("nworld", "nhingeslice", 8)  # strain impulse angle of a hinge
  hinge_half: floats("nworld", "nhingeslice", 8)  # cos(theta / 2)
  hinge_moment: floats("nworld", "nhingeslice", 8)  # moment impulse [N m s]
  hinge_rough: floats("nworld", "nhingeslice", 8)  # what the bending matrix may leave out [N m]
  node_motion: floats("nworld", "nsolidslice", 12, 8)  # shared vectors, of both trials [m, m/s]
  node_stress: floats("nworld", "nsolidslice", 12, 8)  # three shared vectors, rows [Pa s]
  tet_impulse: floats("nworld", "ntetslice", 16, 8)  # impulse on each corner [N s]
  tet_arm: floats("nworld", "ntetslice", 16, 8)  # turned gradient of each corner [kg^(1/2)], moduli
  capsule_block: floats("nworld", "ncapsule", 9, 8)  # off-diagonal blocks of a solid's skin [kg]
  total: floats("nworld", 2)  # volume difference [m^3], areavec . vel
  sol: vector  # PCG solution [m/s]
  r: vector  # PCG residual
  p: vector  # PCG direction
  q: vector  # A times direction
  z: vector  # preconditioned residual
  zn: floats("nworld", "nbendslice", 16)  # that along the normals, with turns on CUDA
  quad: floats("nworld", "nquadslice", 12, 8)  # z of a node side by side
  e: floats("nworld", "ncycleslice", 3, 8)  # as z, between smoothing steps
  en: floats("nworld", "ncyclebendslice", 8)  # that along the normals
  t: vector  # A times z; smoother's direction and residual
  partial: floats("nworld", "nword", 4)  # what the blocks of a world exchange
  status: floats("nworld", 4)  # PCG iterations, relative residual, norm of rhs, 1 if not finite
  ratio: floats("nworld")  # b^T Mhat^-1 b over b^T A^-1 b, see `relaxation`


@struct
class Lump:
  """Factors on Young's modulus of the triangles of each world; empty where worlds do not differ.

  There are factors of a fan's triangles and of a hinge's two, and the bending matrix with them.
  Those of a solid's tetrahedra follow from the nearest triangles.
  """

  fan: floats("nlump", "nskinslot + nskinslice", 8)
  hinge: floats("nlump", "nhingeslice", 2, 8)
  hinge_left: floats("nhingeslice", 8)  # stiffness to itself by the left triangle [N m]
  bend_gain: floats("nlump", "nbend", 8)  # as in `Tissue` [N/m]
  bend_diag: floats("nlump", "nbendslice", 8)  # as in `Tissue` [N/m]
  tet_moduli: floats("nlump", "ntetslice", 2, 8)  # as in `Tissue`, without the volume [Pa]
  node_moduli: floats("nlump", "nsolidslice", 2, 8)  # as in `Tissue` [Pa]


@struct
class Fields:
  """What every kernel of a body takes."""

  shape: Shape
  tissue: Tissue
  state: State
  system: System
  lump: Lump


@struct
class Transfer:
  """What lies between a mesh and the coarser ones, whose nodes follow one another.

  Each level has whole slices. Offsets are those of a node's x component in floats, on the finest
  mesh or among all coarse nodes; `ncoarse` is the number of their slices.
  """

  nlevel: int  # number of coarse meshes
  nodes: int  # moving nodes of the finest mesh
  threshold: float  # condition number from which cycles are used [-]
  slice_adr: ints("nlevel + 1")  # first slice of each level
  source: ints("ncoarse", 8)  # offset of each coarse node on the finest mesh
  share: floats("ncoarse", 8)  # nodes of the finest that one stands for
  # Of each level, the finest first: stiffness of a node times g / mass where g / mass is one [N/m],
  # ends of the smoother's interval (high, low), its degree, the finest's nodes for one of its own.
  rate: floats("nlevel + 1", 5)
  down_adr: ints("ncoarse + 1")  # first row of each slice in `down_node`
  down_node: ints("ndown", 8)  # offset on the next finer mesh
  down_weight: floats("ndown", 8)  # what it gives to the coarse node [-]
  up_adr: ints("nslice + ncoarse + 1")  # first row of each slice in `up_node`, the finest's first
  up_node: ints("nup", 8)  # offset on the next coarser mesh
  up_weight: floats("nup", 8)  # share of the coarse node [-]


@struct
class Cycle:
  """What the kernels of the multilevel preconditioner take."""

  fine: Fields
  coarse: Fields
  transfer: Transfer


def allocate(kind: Any, device, sizes: dict[str, int], spare: tuple[str, ...] = ()):
  """Returns a struct of zeroed arrays.

  Args:
    kind: the struct
    device: where they are
    sizes: named sizes of their shapes
    spare: fields that are empty, their first size 0
  """
  out = kind()
  for name, dims in DIMS[kind.key].items():
    shape = tuple(_extent(dim, sizes) for dim in dims)
    shape = (0, *shape[1:]) if name in spare else shape
    setattr(out, name, wp.zeros(shape, dtype=kind.vars[name].type.dtype, device=device))
  return out


class Views:
  """The arrays of a struct that is on the CPU as numpy has them, each looked up once.

  Args:
    fields: the struct, whose arrays stay
  """

  def __init__(self, fields: Any):
    self._fields = fields

  def __getattr__(self, name: str) -> np.ndarray:
    self.__dict__[name] = found = getattr(self._fields, name).numpy()
    return found


def blank(kind: Any, name: str, device) -> wp.array:
  """Returns an array without elements for a field of a struct."""
  own = kind.vars[name].type
  return wp.zeros((0,) * own.ndim, dtype=own.dtype, device=device)


def fill(
  kind: Any, device, values: dict[str, Any], sizes: dict[str, int] | None = None, into: Any = None
):
  """Returns a struct with its fields from `values`, arrays copied to the device.

  Args:
    kind: the struct
    device: where the arrays are put
    values: numbers and arrays by field; others are left out
    sizes: named sizes that the arrays must have, or None where it has none
    into: struct to fill anew, which graphs on the CPU may have recorded; None makes one
  """
  out = kind() if into is None else into
  for name, var in kind.vars.items():
    value = values[name]
    if isinstance(value, np.ndarray):
      if sizes is not None:
        expected = tuple(_extent(dim, sizes) for dim in DIMS[kind.key][name])
        assert value.shape == expected, (kind.key, name, value.shape, expected)
      value = wp.array(np.ascontiguousarray(value), dtype=var.type.dtype, device=device)
    setattr(out, name, value)
  return out


def zeros(
  names: tuple[str, ...], sizes: dict[str, int], kinds: tuple = (Shape, Tissue)
) -> dict[str, np.ndarray]:
  """Returns arrays of structs of zeros, of the sizes that their shapes name."""
  return {
    name: np.zeros([_extent(dim, sizes) for dim in dims], _dtype(kind, name))
    for kind in kinds
    for name, dims in DIMS[kind.key].items()
    if name in names
  }


def empty(sizes: tuple[str, ...]) -> dict[str, np.ndarray]:
  """Returns the arrays of `Shape` and `Tissue` whose first axis is one of `sizes`, empty."""
  return {
    name: np.zeros((0, *dims[1:]), _dtype(kind, name))
    for kind in (Shape, Tissue)
    for name, dims in DIMS[kind.key].items()
    if dims[0] in sizes
  }


def _dtype(kind: Any, name: str):
  return wp.dtype_to_numpy(kind.vars[name].type.dtype)


def _extent(dim: int | str, sizes: dict[str, int]) -> int:
  """Returns a size from the text of an annotation, for example `nslot + 2 nslice`."""
  if isinstance(dim, int):
    return dim
  total = 0
  for term in dim.split(" + "):
    *factor, name = term.split()
    total += int(name) if name.isdigit() else int(factor[0] if factor else 1) * sizes[name]
  return total
