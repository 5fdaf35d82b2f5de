"""Threads: rods whose nodes are MuJoCo's degrees of freedom, and what each needs in an mjData.

A flex of dim 1 with `elements="rod"` is a thread. It has a step (`solver/rod_step.h`) and a
coupling (`coupling/rod.h`) of its own, in doubles on the CPU.
"""

import dataclasses
import functools
import zlib

import numpy as np
import warp as wp
from palpate.tissue import config as configuration
from palpate.tissue import device as devices
from palpate.tissue import rod
from palpate.tissue.kernels import kernel
from palpate.tissue.types import Array, Views, doubles, fill, ints, struct, zeros

from . import contacts, coupling, graphs, layout
from .coupling import Mujoco
from .layout import RodState
from .model import declare, flexes, mjstruct, prepare
from .workspace import Report, Seen

_MOST_ROWS = 48  # of MuJoCo's constraints, for one node
# Nodes that stand for bodies which yield, three of their coordinates each, and for vertices of
# organs, where it may meet some.
_MOST_BODIES, _MOST_VERTICES = 12, 48
# Centre lines come no nearer than this share of the diameter; neighbours along the thread, with no
# more than this many radii between them, are not looked at.
CORE, NEIGHBOURS = 0.5, 3.5
# Edges within so many radii of a node that an equality holds are in what holds it and do not meet
# it: half of what jaws of a needle driver have between them.
GRIP = 24.0
_MOST_PAIRS = 32  # of edges near each other, for one node
_SOFT = 0.05  # modulus across a thread over that along it, an estimate
_SLOW = 1e-6  # velocity below which friction within a thread is viscous [m/s]
_MUJOCOS = (
  *("jacobian", "flex_margin", "flex_dim", "qvel", "qacc", "qacc_warmstart", "qfrc_smooth"),
  *("qfrc_actuator", "body_invweight0", "M_rowadr", "M_rownnz", "M_colind", "dof_damping"),
)
_WRITTEN = (
  *("start", "vel", "external", "aim", "place", "turn", "force", "move", "trial", "gradient"),
  *("pull", "matrix", "inverse", "rank", "near", "ranked", "first", "start_of_row", "last"),
  *("below", "status", "count", "smooth", "reach", "listed", "pair", "pressure", "touch", "stands"),
  *("row_kind", "row_node", "row_efc", "row_tree", "row_yields", "row_body"),
  *("row_value", "grip", "known", "speed"),
)
_MEASURED = "length", "along", "stretch", "bend", "drag", "mass"  # where nodes move along a thread
_HUGE = 1e6  # more than any twist [rad]


@struct
class Rod:
  """A rod in its solver's arrays, of one world; node i begins edge i."""

  nnode: int  # nodes
  newton: int  # most iterations of a step
  twists: int  # whether its edges turn about themselves
  yields: int  # whether it keeps bends
  most_rows: int  # MuJoCo's rows that there is room for
  most_nodes: int  # nodes that there is room for, with those that stand for bodies and vertices
  most_vertices: int  # vertices of organs that there is room for
  collides: int  # whether it meets itself
  most_pairs: int  # pairs of its edges that there is room for
  shortest: float  # length of its shortest edge [m]
  longest: float  # of its longest one, or what that may be [m]
  radius: float  # of its section [m]
  hardness: float  # of its section, of the barrier between edges [N/m]
  friction: float  # of the thread on itself
  strength: float  # tension at which an edge breaks; 0: none does [N]
  slow: float  # velocity below which friction is viscous [m/s]
  length: doubles("nnode")  # rest length of an edge [m]
  along: doubles("nnode")  # rest length up to a node [m]
  stretch: doubles("nnode")  # E A / length of an edge [N/m]
  bend: doubles("nnode")  # E I over the length of a node [N m]
  torsion: doubles("nnode")  # G J over the length of a node [N m]
  most_bent: doubles("nnode")  # curvature less that at rest, see `Bent`, beyond which a node yields
  mass: doubles("nnode")  # of a node [kg]
  drag: doubles("nnode")  # force against a node by its velocity [N s/m]
  spin: doubles("nnode")  # inertia of an edge about itself [kg m^2]
  body: doubles("nnode")  # mass of its body [kg]
  held: ints("nheld")  # whether an unknown does not change
  # Where nodes move along it:
  refine: float  # length of edges where it touches itself; 0: none do [m]
  mean: float  # length of an edge, by nodes [m]
  axial: float  # E A [N]
  flexural: float  # E I [N m^2]
  viscous: float  # drag by length and velocity [N s/m^2]
  drawn: doubles("nnode")  # rest length up to a node as these begin [m]
  # A step:
  start: doubles("nnode", 3)  # place as it begins, in the slides' axes [m]
  vel: doubles("nnode", 3)  # velocity then [m/s]
  external: doubles("nnode", 3)  # force besides elasticity and constraints [N]
  aim: doubles("nnode", 3)  # place where it would end without these [m]
  place: doubles("nplace", 3)  # place as it ends [m]
  turn: doubles("nnode")  # turn of an edge about itself in the step [rad]
  force: doubles("nunknown")  # force of the constraints in the rod's step, negative [N]
  move: doubles("nunknown")  # change of the unknowns
  trial: doubles("nunknown")  # scratch
  gradient: doubles("nunknown")  # of what a step makes least
  pull: doubles("nnode")  # tension of an edge that the last iteration led to expect [N]
  matrix: doubles("nentry")  # its second derivative, and the factors of that, see `Envelope`
  inverse: doubles("nentry")  # of the matrix without constraints, there
  rank: ints("nplace")  # of a node in the matrix
  near: ints("nplace + 1", "nword_node")  # a bit for each two nodes: neighbours in the matrix
  ranked: doubles("nunknown", 5)  # scratch
  first: ints("nunknown")  # first column of each row
  start_of_row: ints("nunknown")  # where it is
  last: ints("nunknown")  # scratch, see `Envelope`
  below: ints("nunknown")  # scratch
  status: ints(1)  # iterations; -1: not finite; more than `newton`: not solved
  count: ints(4)  # rows of constraints that act on the rod; pairs of edges listed; entries; nodes
  # that stand for bodies
  smooth: doubles(1)  # velocity below which friction is viscous in this step [m/s]
  reach: doubles(1)  # how far these may be apart before they touch [m]
  listed: doubles("nnode", 3)  # place where these were listed [m]
  pair: ints("npair", 2)  # the two edges
  pressure: doubles("npair")  # force between them as the step begins [N]
  touch: doubles("npair", 5)  # where and how it acts, see `TOUCH`
  row_kind: ints("nrow")  # see `RowKind`
  row_node: ints("nrow")  # the first of the two nodes
  row_efc: ints("nrow")  # its number in MuJoCo
  row_tree: ints("nrow")  # tree of bodies that it reaches, -1 for none, -3 if these do not yield,
  # -4 for vertices of an organ
  row_yields: ints("nrow", 4)  # nodes that stand for what yields, then -1
  stands: ints("nplace")  # first dof of the vertex of an organ that a node stands for, or -1
  row_body: doubles("nrow", 12)  # J of these
  row_value: doubles("nrow", 9)  # J of their dofs; J a of other bodies less aref; D; friction
  grip: ints("nnode")  # tree of bodies that holds a node or one near it, or -1
  known: doubles("nv")  # force on MuJoCo's dofs: applied, passive and of actuators [N]
  speed: doubles("nv")  # their velocity as the step begins [m/s]
  tie_count: ints(1)  # what holds it, see `coupling.Ties`
  tie_edge: ints("ntie")  # the edge that is held
  tie_value: doubles("ntie", len(layout.TIE))  # see TIE
  own: RodState


@coupling.memory(*_MUJOCOS)
class Bound:
  """A rod and MuJoCo's arrays."""

  rod: Rod
  flex: int  # its flex
  rest: doubles("nnode", 3)  # rest position in the slides' axes [m]
  dofadr: ints("nnode")  # first dof of a node, -1 for pinned ones
  qposadr: ints("nnode")  # its first number in qpos
  bodyid: ints("nnode")  # its body
  massadr: ints("nnode", 3)  # where M has the diagonals of its dofs
  own_dof: ints("nv")  # number of a dof in the rod: three times the node, and the axis; or -1
  dof_tree: ints("nv")  # tree of bodies that a dof is of
  dof_first: ints("nv")  # the first dof of its body
  dof_vertex: ints("nv")  # body of the vertex of an organ that it is of; 0 of others
  geom_tree: ints("ngeom")  # and a geom, -1 if it does not move
  frame: doubles(3, 3)  # rotation from the slides' axes to the world
  mj: Mujoco
  nv: int
  memory: Array(wp.uint64, ("nword",))  # the mjData itself


CONSTANTS = contacts.CONSTANTS | {"CORE": CORE, "NEIGHBOURS": NEIGHBOURS, "GRIP": GRIP}
begin, end = (
  kernel(name, "coupling/mujoco_rod.h", Bound, CONSTANTS) for name in ("begin_rod", "end_rod")
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Declaration(declare.Vertices):
  """A thread that a model declares.

  Attributes:
    radius: of the thread [m]
    rest: rest positions in the slides' axes [m]  (nvert, 3)
    most_vertices: vertices of organs that there is room for in its step
  """

  radius: float
  rest: np.ndarray
  most_vertices: int

  @functools.cached_property
  def signature(self) -> float:
    """Marks plugin states of this thread; over 2^50."""
    return float(2**50 + zlib.crc32(self.rest.tobytes() + self.free.tobytes()))

  def sizes(self, nv: int) -> dict[str, int]:
    """Returns the sizes of its `RodState` among nv dofs."""
    return layout.rod_sizes(len(self.rest), nv, self.config.refine, self.config.yield_strain)

  @property
  def length(self) -> np.ndarray:
    """Lengths of the edges as they begin [m], (nvert - 1,)."""
    return np.linalg.norm(np.diff(self.rest, axis=0), axis=1)

  @property
  def clamped(self) -> np.ndarray:
    """Edges that neither move nor turn: between two pinned vertices, (nvert - 1,) bool."""
    return ~(self.free[1:] | self.free[:-1])


def read(m: mjstruct.Struct, instance: int) -> Declaration:
  """Returns the thread that plugin instance `instance` of an mjModel declares.

  Raises:
    ValueError: the declaration is not one this plugin can run.
  """
  devices.init()
  flex = declare.flex_of(m, instance)
  name = flexes.name(m, flex)
  _check(m, flex, name)
  body, rest, free, frame, origin = declare.places(m, instance, flex, name)
  edge = flexes.element_data(m, flex, 2)
  if len(rest) < 2 or not np.array_equal(edge, np.arange(len(rest) - 1)[:, None] + (0, 1)):
    raise ValueError(
      f"thread {name!r}: its {len(edge)} edges do not join its {len(rest)} vertices in order, "
      "expected edges 0 1, 1 2, ... of two vertices or more"
    )
  radius = float(m.flex_radius[flex])
  length = np.linalg.norm(np.diff(rest, axis=0), axis=1)
  rod.check_edges(name, length, radius)
  rod.check_apart(name, rest, radius, NEIGHBOURS * radius, 2 * CORE * radius)
  texts = declare.keys(m, instance)
  try:
    config = configuration.parse(name, texts, len(edge), closed=False)
  except ValueError as error:
    raise ValueError(str(error).replace("organ ", "thread ", 1)) from None
  rod.check_refine(name, config, length, radius, ~(free[1:] | free[:-1]))
  dofadr, qposadr = declare.addresses(m, name, body, free)
  kind, aims, dim = m.flex_contype, m.flex_conaffinity, m.flex_dim
  meets = (kind[flex] & aims | kind & aims[flex]) * (dim > 1)
  most = _MOST_VERTICES if meets.any() else 0
  return Declaration(
    name=name, flex=flex, config=config, radius=radius, rest=rest, free=free, body=body,
    dofadr=dofadr, qposadr=qposadr, frame=frame, origin=origin, most_vertices=most,
  )  # fmt: skip


def settings(organ: Declaration, friction: float) -> dict:
  """Returns the fields of `Rod` that say what a thread is beside `rod.constants`."""
  n = len(organ.rest)
  held = np.repeat(~organ.free, 4).reshape(n, 4)
  held[:, 3] = np.append(organ.clamped, True)
  return dict(
    newton=organ.config.iterations,
    most_rows=_MOST_ROWS * n,
    most_nodes=n + _MOST_BODIES + organ.most_vertices,
    most_vertices=organ.most_vertices,
    most_pairs=_MOST_PAIRS * n,
    collides=1,
    radius=organ.radius,
    hardness=_SOFT * float(np.mean(organ.config.young)) * organ.radius,
    friction=friction,
    strength=organ.config.strength,
    slow=_SLOW,
    held=held.ravel(),
  )


def vertices(m) -> dict[str, np.ndarray]:
  """Returns the fields of `Bound` that say which dofs of a model are of vertices of organs."""
  of, vertex = m.dof_bodyid, m.flex_vertbodyid
  count = np.diff(np.append(m.flex_vertadr, len(vertex)))  # those that wait for cuts too
  vertex = vertex[np.repeat(m.flex_dim, count) > 1]
  vertex = vertex[m.body_dofnum[vertex] == 3]
  return {"dof_first": m.body_dofadr[of], "dof_vertex": np.where(np.isin(of, vertex), of, 0)}


def scratch(organ: Declaration, nv: int) -> dict[str, np.ndarray]:
  """Returns the fields of `Rod` that a step of a thread among nv dofs writes."""
  n = len(organ.rest)
  most = n + _MOST_BODIES + organ.most_vertices
  names = (*_WRITTEN, *(_MEASURED if organ.config.refine else ()))
  sizes = {"nnode": n, "nplace": most, "nunknown": 4 * most, "npair": _MOST_PAIRS * n}
  sizes |= {"nrow": _MOST_ROWS * n, "nentry": 2 * most * (4 * most + 1), "nv": nv}
  return zeros(names, sizes | {"nword_node": -(-most // 32)}, (Rod,))


def state_of(state: np.ndarray, organ: Declaration, nv: int) -> Views:
  """Returns `RodState` of a thread, as views of its part of a plugin state."""
  array = wp.array(state, dtype=wp.float64, device="cpu", copy=False)
  return Views(layout.carve(RodState, array, organ.sizes(nv)))


def _check(m, flex: int, name: str):
  """Raises ValueError where a flex cannot be a thread."""
  dim = m.flex_dim[flex]
  if dim != 1:
    raise ValueError(
      f"organ {name!r}: elements is 'rod' and flexcomp dim is {dim}, expected dim='1' (a line)"
    )
  declare.check_integrator(m, name)
  declare.check_flex(m, flex, name)
  if m.flex_selfcollide[flex]:
    raise ValueError(
      f"thread {name!r}: selfcollide is set, expected 'none': the plugin handles a thread's "
      "contacts with itself"
    )


class Workspace:
  """One thread in one mjData.

  Args:
    organ: its constants
    model: address of the mjModel
    data: address of the mjData
    instance: number of the plugin instance

  Attributes:
    fields: what its kernels take
    constants: those of them that follow from configuration and shape, see `rod.constants`
    mass: of its nodes [kg]  (nvert,)
    friction: on itself
    own: its numbers in mjData.plugin_state
    ties: what organs hold it by
    seen, report: as of an organ
  """

  def __init__(self, organ: Declaration, model: int, data: int, instance: int):
    self.organ, self.data, self.instance = organ, data, instance
    self.seen, self.report = Seen(instance), Report(memoryview(b""))
    self.bind(model)

  def bind(self, model: int):
    """Takes the arrays of an mjModel and of the mjData, and records the launches."""
    self._model = model
    m, organ = mjstruct.model(model), self.organ
    dofs = np.maximum(organ.dofadr, 0)[:, None] + np.arange(3)
    sizes = organ.sizes(m.nv)
    size = layout.size(RodState, sizes)
    self.state = coupling.plugin_state(model, self.data, self.instance, size)
    found = coupling.mujoco_arrays(model, self.data, Bound)
    own_dof = np.full(m.nv, -1)
    own_dof[organ.dofs] = (3 * np.flatnonzero(organ.free)[:, None] + np.arange(3)).ravel()
    mass = m.body_mass[organ.body]
    self.mass = mass = np.where(organ.free, mass, mass[organ.free].mean())
    self.friction = float(m.flex_friction[organ.flex, 0])
    self.constants = self._constants(organ.length)
    self.own = layout.carve(RodState, self.state, sizes)
    values = self.constants | settings(organ, self.friction) | {"mass": mass, "body": mass}
    values |= scratch(organ, m.nv)
    self.ties = coupling.ties(self.data, organ.flex)
    self.ties.lead, self.ties.again = self._lead, self._again
    self._moved = self.ties.track(len(organ.rest)).numpy() if organ.config.refine else None
    values |= {"own": self.own} | {name: array[0] for name, array in self.ties.arrays.items()}
    own = fill(Rod, "cpu", values)
    values = dict(
      rod=own,
      flex=organ.flex,
      rest=organ.rest,
      dofadr=organ.dofadr,
      qposadr=organ.qposadr,
      bodyid=organ.body,
      massadr=np.where(organ.free[:, None], coupling.mass_addresses(m, dofs), -1),
      own_dof=own_dof,
      dof_tree=m.dof_treeid,
      **vertices(m),
      geom_tree=m.body_treeid[m.geom_bodyid],
      frame=organ.frame,
      mj=coupling.mujoco_arrays(model, self.data),
      nv=m.nv,
      memory=coupling.wrap(self.data, mjstruct.size(mjstruct.Data) // 8, wp.uint64),
      **{name: getattr(found, name) for name in _MUJOCOS},
    )
    with graphs.lock:
      cpu = wp.get_device("cpu")
      self.fields = fill(Bound, cpu, values)
      for each in (begin, end):
        each.load(cpu)
      self._begin, self._end = begin.command(self.fields), end.command(self.fields)
    self._status = own.status.numpy().data
    self._passive = mjstruct.both(model, self.data)[1].qfrc_passive
    self._dofs = organ.dofs
    self.seen.signature = self.own.signature.numpy().data
    self.seen.identity = mjstruct.Identity(model)
    self.seen.warning = mjstruct.warnings(self.data)

  def _constants(self, length: np.ndarray) -> dict:
    organ = self.organ
    return rod.constants(length, organ.radius, organ.config, self.mass, organ.clamped)

  def measured(self) -> dict:
    """Returns `constants`, of edges as long as they are now."""
    if not self.organ.config.refine:
      return self.constants
    return self._constants(np.diff(self.constants["drawn"] + self.own.moved.numpy()))

  @property
  def plugin_state(self) -> np.ndarray:
    """The thread's own numbers."""
    return self.state.numpy()

  def run(self):
    """Takes the thread's step and adds it to qfrc_passive."""
    if self.seen.signature[0] != self.organ.signature:
      if self.seen.signature[0] or not (np.abs(self.plugin_state) < _HUGE).all():
        raise ValueError(
          "plugin_state is not one of this thread, but saved from another model or damaged; reset "
          "the data, or set a state that was saved from it"
        )
    if self.ties.led:
      self.ties.led = False
      return
    if self._moved is not None:
      self._moved[0] = self.own.moved.numpy()
    self.ties.aim()
    mjstruct.library().mj_fwdActuation(self._model, self.data)  # MuJoCo does so later
    self._before = self._passive[self._dofs]
    self._take()

  def _take(self):
    self._begin.launch()
    self.report.computed = True
    if self._status[0] < 0:
      self.note("the step has no finite solution: the motion diverged")
    elif self._status[0] > self.organ.config.iterations:
      self.note(
        f"a step was not solved in {self.organ.config.iterations} iterations: its forces are out "
        "of balance; a smaller time step or more of the key iterations may help"
      )

  def _again(self, instance: int):
    """Takes the step anew that it has taken before an organ's: its contacts have other rows now."""
    if self.report.computed and (self.instance < instance or self.ties.led):
      self._passive[self._dofs] = self._before
      self._take()

  def _lead(self, instance: int):
    """Takes the step before that of an organ that holds it, where it does not anyway."""
    if self.instance > instance and not self.ties.led:
      self.run()
      self.ties.led = True

  def step(self):
    """Ends the step after MuJoCo has moved."""
    if self.report.computed:
      self._end.launch()
      self.seen.signature[0] = self.organ.signature
    self.report.computed = False

  def note(self, text: str):
    """Keeps the first error and says it."""
    if self.report.error is None:
      self.report.error = f"thread {self.organ.name!r}: {text}"
      mjstruct.warn(self.report.error)

  def forget(self):
    """Forgets what went wrong."""
    self.report.error = None


def make(model: int, data: int, instance: int) -> Workspace:
  """Returns a thread in a fresh mjData; makes the model fit it."""
  m = mjstruct.model(model)
  with graphs.lock:
    organ = read(m, instance)
    prepare.fit_thread(m, organ.flex, organ.body[organ.free])
    return Workspace(organ, model, data, instance)
