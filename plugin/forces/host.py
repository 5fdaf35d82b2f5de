"""What a passive force knows of its organ: a host, with the organ in one world or in many.

The plugin's host has one world, in MuJoCo's own memory (`palpate.engine.host`); that of a batch has
rows of worlds, in mujoco_warp's (`palpate.batch.host`). A force is written once, over structs whose
arrays have worlds in front: a kernel begins by moving what worlds have of their own to its world.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import abc
import contextlib
import functools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp
from palpate.engine.coupling import CONSTANTS
from palpate.engine.model import mjstruct
from palpate.tissue.config import Config
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.kernels import Kernel, kernel
from palpate.tissue.order import LANES
from palpate.tissue.step import SCHEMES
from palpate.tissue.types import DIMS, Array, doubles, fill, floats, ints, struct, vector

if TYPE_CHECKING:
  from palpate.engine.model.declare import Declaration

numbers = doubles("nnumber")  # of a tissue, see `NUMBERS`; in a batch a row a world


@struct
class Bodies:
  """MuJoCo's own memory, under its own names."""

  timestep: doubles(1)
  qpos0: doubles("nq")
  body_parentid: ints("nbody")
  body_rootid: ints("nbody")
  body_dofnum: ints("nbody")
  body_dofadr: ints("nbody")
  geom_bodyid: ints("ngeom")
  geom_type: ints("ngeom")
  geom_size: doubles("ngeom", 3)
  geom_aabb: doubles("ngeom", 6)
  qpos: doubles("nq")
  qvel: doubles("nv")
  ctrl: doubles("nu")
  xpos: doubles("nbody", 3)
  xmat: doubles("nbody", 9)
  cvel: doubles("nbody", 6)
  cdof: doubles("nv", 6)
  qacc_warmstart: doubles("nv")
  subtree_com: doubles("nbody", 3)
  geom_xpos: doubles("ngeom", 3)
  geom_xmat: doubles("ngeom", 9)
  qfrc_passive: doubles("nv")


@struct
class WorldBodies:
  """Bodies of mujoco_warp, a row a world."""

  timestep: doubles(1)
  body_parentid: ints("nbody")
  body_rootid: ints("nbody")
  body_dofnum: ints("nbody")
  body_dofadr: ints("nbody")
  geom_bodyid: ints("ngeom")
  geom_type: ints("ngeom")
  geom_size: doubles("ngeom", 3)
  geom_aabb: doubles("ngeom", 6)
  ctrl: floats("nworld", "nu")
  xpos: floats("nworld", "3 nbody")
  xmat: floats("nworld", "9 nbody")
  cvel: floats("nworld", "6 nbody")
  cdof: floats("nworld", "6 nv")
  qacc_warmstart: floats("nworld", "nv")
  subtree_com: floats("nworld", "3 nbody")
  geom_xpos: floats("nworld", "3 ngeom")
  geom_xmat: floats("nworld", "9 ngeom")
  qfrc_passive: floats("nworld", "nv")


@struct
class Nodes:
  """Where an organ's vertices are: in MuJoCo's memory, or with windows in the plugin state."""

  windowed: int  # whether it is in the plugin state
  rest: doubles("nvert", 3)  # rest position [m]
  disp: doubles("nvert", 3)  # displacement, of an organ with windows [m]
  vel: doubles("nvert", 3)  # velocity, of one with windows [m/s]
  qposadr: ints("nvert")  # first qpos, of one without; -1 for pinned ones
  dofadr: ints("nvert")  # first dof
  frame: doubles(3, 3)  # rotation from the organ's axes to the world
  origin: doubles(3)  # position of its frame [m]


@struct
class WorldNodes:
  """Where an organ's vertices are in a batch: in the solver's own vectors."""

  node: ints("nvert")  # node of each vertex
  mesh: ints("nworld")  # which mesh each world has
  rest: doubles("nmesh", "nnode", 3)  # rest position of each node [m]
  disp: vector
  vel: vector
  frame: doubles(3, 3)  # rotation from the organ's axes to the world
  origin: doubles(3)  # position of its frame [m]


@struct
class Input:
  """What an organ's solver is given, and what it finds."""

  node: ints("nvert")  # node of each vertex
  quiet: doubles("nworld")  # how long it has been at rest [s]
  hold: floats("nworld", "nholdslice", 6, 8)
  force_ext: vector
  vel: vector
  dvel: vector
  status: floats("nworld", 4)


class Twin(NamedTuple):
  """A kernel over one world of the plugin, and the same over rows of worlds."""

  one: Kernel
  many: Kernel


def kernels(header: str, kind: Any, *names: str) -> list[Twin]:
  """Returns the kernels of a header that take a struct, for both hosts."""
  return [
    Twin(kernel(name, header, kind, CONSTANTS), world_kernel(name, header, for_worlds(kind)))
    for name in names
  ]


def world_kernel(name: str, header: str, kind: Any) -> Kernel:
  """Returns a kernel of a header that takes a struct of `for_worlds`."""
  return kernel(name, header, kind, CONSTANTS, tag=".worlds")


def for_worlds(
  kind: Any, rows: tuple[str, ...] = (), others: tuple[tuple[str, Any], ...] = ()
) -> Any:
  """Returns the struct of many worlds that stands for one of the plugin's.

  Args:
    kind: the struct of one world
    rows: its arrays that lack an axis of worlds and get one
    others: fields that are of another type, and that type
  """
  return _for_worlds(kind.key, kind, rows, others)


@functools.cache
def _for_worlds(key: str, kind: Any, rows: tuple[str, ...], others: tuple) -> Any:
  known = {Nodes.key: WorldNodes, Bodies.key: WorldBodies}
  fields: dict[str, Any] = {}
  for name, var in kind.vars.items():
    dims = DIMS[kind.key].get(name)
    if dims == numbers.dims:
      fields[name] = floats("nworld", *dims)
    elif dims is not None:
      fields[name] = Array(var.type.dtype, ("nworld", *dims) if name in rows else dims)
    elif isinstance(var.type, type(kind)) and var.type.key != Input.key:
      fields[name] = known.get(var.type.key) or for_worlds(var.type)
    else:
      fields[name] = var.type
  own = {"__annotations__": fields | dict(others), "__module__": __name__}
  return struct(type(f"{key}InWorlds", (), own))


class Host(abc.ABC):
  """An organ in its worlds, and what differs between one world of the plugin and many of a batch.

  Attributes:
    alone: whether it is one world, in which forces come and go while it runs
    nworld: number of worlds
    device: where forces are computed
    instance: number of the plugin instance
    organ: its declaration; where it is alone, as it is now
    config: its configuration in force
    model: address of the compiled mjModel
    arrays: the solver's vectors, by the names of `coupling.Crossing`
  """

  alone: bool
  nworld: int
  device: Any
  instance: int
  organ: "Declaration"
  config: Config
  model: int
  arrays: dict[str, wp.array]

  # What kernels take of it.

  @property
  @abc.abstractmethod
  def bodies(self) -> Any:
    """`Bodies`, or `WorldBodies`."""

  @property
  @abc.abstractmethod
  def nodes(self) -> Any:
    """`Nodes`, or `WorldNodes`."""

  @property
  @abc.abstractmethod
  def input(self) -> Any:
    """`Input` of its solver."""

  @property
  @abc.abstractmethod
  def number(self) -> wp.array:
    """Its `NUMBERS`."""

  @property
  @abc.abstractmethod
  def flags(self) -> wp.array:
    """What its coupling reports, see `layout.FLAG`."""

  @property
  @abc.abstractmethod
  def springs(self) -> wp.array | None:
    """What springs weigh on nodes, `State.hold`; None until it is needed."""

  @abc.abstractmethod
  def need_springs(self):
    """Makes `springs`."""

  @abc.abstractmethod
  def rows(self, block: str, width: int) -> wp.array:
    """Returns a block of the plugin state, (nworld, n, width), as worlds keep it."""

  @property
  def nnode(self) -> int:
    """Number of nodes in the solver's vectors, padding among them."""
    return self.arrays["mass"].shape[1] * LANES

  # What follows its mesh.

  @abc.abstractmethod
  def mesh(self, world: int) -> Mesh:
    """Returns the mesh that a world has now."""

  @abc.abstractmethod
  def which_rows(self, others: Sequence["Host"] = ()) -> "Rows":
    """Returns which row of lists a world has that follow its mesh, and those of other organs."""

  # Where bodies are.

  def body_number(self, body: int) -> int:
    """Returns the number in `bodies` of a body of the compiled model."""
    return body

  @property
  def m(self) -> Any:
    """The compiled mjModel's struct."""
    return mjstruct.Model.from_address(self.model)

  def may_move(self, body: Any) -> bool:
    """Returns whether one of these bodies may move: all but what is welded to the world."""
    m = self.m
    return bool(mjstruct.view(m.body_weldid, m.nbody, np.int32)[body].any())

  # Structs and launches.

  def struct(self, kind: Any) -> Any:
    """Returns the struct that this host has for one of the plugin's."""
    known = {Nodes.key: WorldNodes, Bodies.key: WorldBodies, Input.key: Input}
    return kind if self.alone else known.get(kind.key) or for_worlds(kind)

  def fill(self, kind: Any, values: dict[str, Any], into: Any = None) -> Any:
    """Returns a struct, or fills it anew in place.

    The solver's arrays by their names, and `own`, `solve`, `mj`, `number`, `flags`, `ahead` and
    `gain`, the share of the step's way at which the scheme takes forces and how much of a step's
    stiffness it has on dv, need not be given.

    Args:
      kind: the struct, that of one world
      values: its other fields
      into: the struct that kernels have been recorded with, None for none
    """
    scheme = SCHEMES[self.config.integrator]
    known: dict[str, Any] = {
      "own": lambda: self.nodes,
      "solve": lambda: self.input,
      "mj": lambda: self.bodies,
      "number": lambda: self.number,
      "flags": lambda: self.flags,
      "ahead": lambda: float(scheme.ahead),
      "gain": lambda: scheme.gain(1.0, 0.0),
    }
    kind = self.struct(kind)
    given = {name: array for name, array in self.arrays.items() if name in kind.vars}
    given |= {name: get() for name, get in known.items() if name in kind.vars.keys() - values}
    return fill(kind, self.device, given | values, into=into)

  def zeros(self, *shape: int, dtype: Any = wp.float64) -> wp.array:
    """Returns an array with worlds in front."""
    return wp.zeros((self.nworld, *shape), dtype=dtype, device=self.device)

  @abc.abstractmethod
  def load(self, kernel: Twin):
    """Loads the module of a kernel."""

  @abc.abstractmethod
  def launch(self, kernel: Twin, fields: Any, count: int = 0, arg: int = 0):
    """Launches a kernel in all worlds.

    Args:
      kernel: the kernel
      fields: its struct
      count: items that threads of a world share; 0 where one thread has a whole world
      arg: what to do
    """


class Rows:
  """Which row of lists worlds have that follow their meshes: the first until they are cut.

  Args:
    host: the host
    parts: whether worlds get a row of their own
  """

  def __init__(self, host: Host, parts: bool):
    self.count = 1 + host.nworld * parts
    self.which = host.zeros(dtype=int)

  def take(self, world: int) -> int:
    """Gives a world a row of its own, where there are any, and returns it."""
    if self.count == 1:
      return 0
    which = self.which.numpy()
    which[world] = 1 + world
    self.which.assign(which)
    return 1 + world

  def at(self, world: int) -> int:
    """Returns which row a world has."""
    return int(self.which.numpy()[world])


class Lists:
  """Fields of a struct that follow meshes, with room for what cuts add.

  Args:
    host: the host
    kind: the struct
    rows: which rows there are
    values: the lists of the first meshes
    room: for how many more entries there is room, of all lists or by name
  """

  def __init__(
    self, host: Host, kind: Any, rows: Rows, values: dict[str, np.ndarray],
    room: int | dict[str, int] = 0,
  ):  # fmt: skip
    self.rows = rows
    self.arrays: dict[str, wp.array] = {"row": rows.which}
    for name, value in values.items():
      more = room.get(name, 0) if isinstance(room, dict) else room
      more = 0 if DIMS[kind.key][name][1] == 1 else more  # a number
      whole = np.zeros((rows.count, len(value) + more, *np.shape(value)[1:]))
      whole[0, : len(value)] = value
      self.arrays[name] = wp.array(whole, dtype=kind.vars[name].type.dtype, device=host.device)

  def put(self, world: int, values: dict[str, np.ndarray]):
    """Gives a world the lists of the meshes that it has now."""
    row = self.rows.take(world)
    for name, value in values.items():
      if len(value):
        with edited(self.arrays[name], row) as there:
          there[: len(value)] = value


@contextlib.contextmanager
def edited(array: wp.array, row: int) -> Iterator[np.ndarray]:
  """Yields a row of an array, and keeps what is written to it."""
  values = array[row].numpy()
  yield values
  if array.device.is_cuda:
    array[row].assign(values)
