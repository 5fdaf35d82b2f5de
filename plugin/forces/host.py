"""What a passive force knows of its organ: a host, with the organ in one world or in many.

The plugin's host has one world, in MuJoCo's own memory (`palpate.engine.host`); that of a batch has
rows of worlds, in mujoco_warp's (`palpate.batch.organ.host`). A force is written once, over structs
whose arrays have worlds in front, and a kernel gets the rows of its world.
"""

import abc
import contextlib
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp
from palpate.tissue.config import Config
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.kernels import Kernel, kernel
from palpate.tissue.order import LANES
from palpate.tissue.step import SCHEMES
from palpate.tissue.types import DIMS, Array, doubles, fill, floats, ints, struct, vector

from ..engine.coupling import CONSTANTS, Ties, memory
from ..engine.model import mjstruct

if TYPE_CHECKING:
  from ..engine.model.declare import Declaration

numbers = doubles("nnumber")  # of a tissue, see `NUMBERS`; in a batch a row a world


@memory(
  *("timestep", "qpos0", "body_parentid", "body_rootid", "body_dofnum", "body_dofadr"),
  *("geom_bodyid", "geom_type", "geom_size", "geom_aabb", "qpos", "qvel", "ctrl", "xpos"),
  *("xmat", "cvel", "cdof", "qacc_warmstart", "subtree_com", "geom_xpos", "geom_xmat"),
  *("qfrc_passive", "M", "M_rowadr", "M_rownnz", "qLD", "qLDiagInv"),
)
class Bodies:
  """What forces read and write of MuJoCo's own memory."""


@struct
class Nodes:
  """Where an organ's vertices are: in MuJoCo's memory, or with windows in the plugin state."""

  windowed: int  # whether all is in the plugin state
  inner: int  # the first vertex inside of a solid, which are there anyway
  rest: doubles("nvert", 3)  # rest position [m]
  disp: doubles("nstate", 3)  # displacement, of what is there [m]
  vel: doubles("nstate", 3)  # velocity, of that [m/s]
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


def _in_rows(kind: Any) -> Any:
  """Returns `Bodies` of mujoco_warp: of its data floats, a row a world."""
  fields: dict[str, Any] = {}
  for name, dims in DIMS[kind.key].items():
    rows = hasattr(mjstruct.Data, name)
    fields[name] = floats("nworld", f"n{name}") if rows else Array(kind.vars[name].type.dtype, dims)
  return struct(type("WorldBodies", (), {"__annotations__": fields, "__module__": __name__}))


WorldBodies = _in_rows(Bodies)
_KNOWN = {"Nodes": WorldNodes, "Bodies": WorldBodies, "Input": Input}


class Twin(NamedTuple):
  """A kernel over one world of the plugin, and the same over rows of worlds."""

  one: Kernel
  many: Kernel


def kernels(header: str, kind: Any, *names: str) -> list[Twin]:
  """Returns the kernels of a header that take a struct, for both hosts."""
  return [
    Twin(
      kernel(name, header, kind, CONSTANTS, own=True),
      kernel(name, header, for_worlds(kind), CONSTANTS, tag=".worlds", own=True),
    )
    for name in names
  ]


@functools.cache
def for_worlds(kind: Any) -> Any:
  """Returns the struct of many worlds that stands for one of the plugin's."""
  if kind.key in _KNOWN:
    return _KNOWN[kind.key]
  fields: dict[str, Any] = {}
  for name, var in kind.vars.items():
    dims = DIMS[kind.key].get(name)
    if dims is None:
      fields[name] = for_worlds(var.type) if isinstance(var.type, type(kind)) else var.type
    else:
      own = dims == numbers.dims
      fields[name] = floats("nworld", *dims) if own else Array(var.type.dtype, dims)
  known = {"__annotations__": fields, "__module__": __name__}
  return struct(type(f"{kind.key}InWorlds", (), known))


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
    springs: what springs weigh on nodes, `State.hold`; None until it is needed
    bodies: `Bodies`, or `WorldBodies`
    nodes: `Nodes`, or `WorldNodes`
    input: `Input` of its solver
    number: its `NUMBERS`
  """

  alone: bool
  nworld: int
  device: wp.Device
  instance: int
  organ: "Declaration"
  config: Config
  model: int
  arrays: dict[str, wp.array]
  springs: wp.array | None = None
  bodies: Any
  nodes: Any
  input: Any
  number: wp.array

  @abc.abstractmethod
  def bind(self, model: int):
    """Points at the arrays of a model, and at the springs that there are by now."""

  @abc.abstractmethod
  def need_springs(self):
    """Makes `springs`."""

  @abc.abstractmethod
  def need_pairs(self):
    """Adds to `arrays` those of springs between nodes, see `palpate.tissue.body.pairs`."""

  @abc.abstractmethod
  def flags(self) -> wp.array:
    """Returns what its coupling reports, see `layout.FLAG`."""

  @abc.abstractmethod
  def rows(self, block: str, width: int) -> wp.array:
    """Returns a block of the plugin state, (nworld, n, width), as worlds keep it."""

  @abc.abstractmethod
  def mesh(self, world: int) -> Mesh:
    """Returns the mesh that a world has now."""

  @abc.abstractmethod
  def surface(self) -> dict[str, Any]:
    """Returns fields with the meshes: `mesh`, `elem`, `tet`, `flat`, and what numbers are of."""

  @abc.abstractmethod
  def lifted(self) -> wp.array:
    """Returns where forces say what does not touch the organ, see `contacts.lifted`, by world."""

  @abc.abstractmethod
  def open_contacts(self):
    """Opens those of contacts that are found before forces say so."""

  @abc.abstractmethod
  def ties(self, flex: int) -> Ties:
    """Returns what holds the thread of a flex."""

  @abc.abstractmethod
  def tools(self, name: str) -> np.ndarray:
    """Returns `ctrl`, `geom_xpos` or `geom_xmat` as they are now, a row a world."""

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

  def command(self, kernel: Twin, fields: Any, count: int = 0, arg: int = 0) -> Callable[[], None]:
    """Returns what launches a kernel as `launch` does, as often as is wanted."""
    return functools.partial(self.launch, kernel, fields, count, arg)

  def which(self, others: Sequence["Host"]) -> wp.array:
    """Returns which row of lists each world has that follow its mesh, and those of others."""
    return self.zeros(dtype=int)

  def body_number(self, body: int) -> int:
    """Returns the number in `bodies` of a body of the compiled model."""
    return body

  @property
  def m(self) -> Any:
    """The compiled mjModel's struct."""
    return mjstruct.model(self.model)

  @property
  def nnode(self) -> int:
    """Number of nodes in the solver's vectors, padding among them."""
    return self.arrays["mass"].shape[1] * LANES

  def may_move(self, body: int | np.ndarray) -> bool:
    """Returns whether one of these bodies may move: all but what is welded to the world."""
    m = self.m
    return bool(m.body_weldid[body].any())

  def zeros(self, *shape: int, dtype: Any = wp.float64) -> wp.array:
    """Returns an array with worlds in front."""
    return wp.zeros((self.nworld, *shape), dtype=dtype, device=self.device)

  def struct(self, kind: Any) -> Any:
    """Returns the struct that this host has for one of the plugin's."""
    return kind if self.alone else for_worlds(kind)

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
    scheme, kind = SCHEMES[self.config.integrator], self.struct(kind)
    known = self.arrays | dict(
      own=self.nodes,
      solve=self.input,
      mj=self.bodies,
      number=self.number,
      flags=self.flags(),
      ahead=float(scheme.ahead),
      gain=scheme.gain(1.0, 0.0),
    )
    return fill(kind, self.device, known | values, into=into)


class Lists:
  """Fields of a struct that follow meshes, with room for what cuts add.

  A row is of the first meshes. With many worlds, each gets a row of its own as it is cut.

  Args:
    host: the host
    kind: the struct
    others: hosts of other organs whose meshes they follow
    values: the lists of the first meshes
    room: for how many more entries there is room, of all lists or by name

  Attributes:
    arrays: the lists, (nrow, n, ...), and `row`, which of them a world has
  """

  def __init__(
    self, host: Host, kind: Any, others: Sequence[Host], values: dict[str, np.ndarray],
    room: int | dict[str, int] = 0,
  ):  # fmt: skip
    cuts = not host.alone and any(each.organ.mesh.spare for each in (host, *others))
    self.arrays: dict[str, wp.array] = {"row": host.which(others)}
    for name, value in values.items():
      more = room.get(name, 0) if isinstance(room, dict) else room
      more = 0 if DIMS[kind.key][name][1] == 1 else more  # a number
      whole = np.zeros((1 + host.nworld * cuts, len(value) + more, *np.shape(value)[1:]))
      whole[0, : len(value)] = value
      self.arrays[name] = wp.array(whole, dtype=kind.vars[name].type.dtype, device=host.device)
    self._cuts = cuts

  def put(self, world: int, values: dict[str, np.ndarray]):
    """Gives a world the lists of the meshes that it has now."""
    if self._cuts:
      which = self.arrays["row"].numpy()
      which[world] = 1 + world
      self.arrays["row"].assign(which)
    for name, value in values.items():
      if len(value):
        with edited(self.arrays[name], (1 + world) * self._cuts) as there:
          there[: len(value)] = value

  def of(self, world: int, *names: str) -> list[np.ndarray]:
    """Returns lists that a world has, without the room."""
    row = int(self.arrays["row"].numpy()[world])
    count = int(self.arrays["count"][row].numpy()[0])
    return [self.arrays[name][row].numpy()[:count].copy() for name in names]


@contextlib.contextmanager
def edited(array: wp.array, row: int) -> Iterator[np.ndarray]:
  """Yields a row of an array, and keeps what is written to it."""
  values = array[row].numpy()
  yield values
  if wp.get_device(array.device).is_cuda:
    array[row].assign(values)
