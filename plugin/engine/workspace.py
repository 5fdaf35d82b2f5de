"""Everything one organ needs in one mjData: state, views of MuJoCo's arrays, recorded graphs."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue import body as bodies
from palpate.tissue.body import Body
from palpate.tissue.config import Config

from ..forces import declare_attachments, declare_bonds, supports
from ..forces.attachments import Attachments
from ..forces.cohesive_bonds import Bonds
from ..forces.cutters import Cutters
from ..forces.needles import Needles
from ..forces.passive import Forces
from ..forces.supports import Supports
from ..forces.table import FORCES
from ..forces.tears import Tears
from . import contacts, coupling, graphs
from .bind import bind
from .coupling import Phases
from .cutting import cuts
from .cutting.cuts import Cuts
from .host import Host
from .layout import FLAG, HEAD, Topology
from .model import declare, flexes, inertia, mjstruct, prepare, shared, skin
from .model.declare import Declaration
from .penetration import Watch
from .windows import declare_windows, windowed
from .windows.resident import Resident

_ALLOWED = int(mujoco.mjtSleepPolicy.mjSLEEP_AUTO_ALLOWED)
_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_STAYS = ("disp", "vel", "bond", *Topology.vars)  # of the plugin state, where a motion is set
_ASTRAY = 1e-9  # distance of a slot from its node that rounding does not explain [m]

# An item of a memoryview costs a tenth of one of an array; this stands for those not yet there.
_NONE = memoryview(bytes(4)).cast("i")


@dataclasses.dataclass
class Graphs:
  """Recorded graphs of a step, see `bind`.

  Attributes:
    phases: what they launch
    stiff: whether the response is needed, see `inertia.stiffness`
    before: the forces before the solve
    solve: the solve and what is around it, each on one device
    after: the forces after it where the motion is on a device, else part of it
    leave: takes the contact forces after MuJoCo's step
    respond: the organ's response to their change; none where the scheme has none
    advance, end: the plugin state's step after that, or without a response
    place: puts the window where the state says, or None
    resident: keeper of a motion that stays on the device, or None
  """

  phases: Phases = dataclasses.field(default_factory=Phases)
  stiff: bool = False
  before: Any = None
  solve: list = dataclasses.field(default_factory=list)
  after: Any = None
  leave: Any = None
  respond: list = dataclasses.field(default_factory=list)
  advance: Any = None
  end: Any = None
  place: Any = None
  resident: Resident | None = None


@dataclasses.dataclass
class Seen:
  """What of a model and its data every step looks at, as views; their first number unless said.

  Attributes:
    instance: number of the plugin instance
    identity: tells the model from others
    model_step, time_step: the model's time step, and the armature's [s]
    integrator: MuJoCo's
    static: places of the bodies that the organ hangs on, and what they were
    policy, counts: MuJoCo's sleep policy of the window's bodies, and the number of vertices that it
      sees of a windowed organ
    status: iterations, relative residual, norm, failure  (4,)
    warning: last index and count of each of MuJoCo's warnings, one after the other
    nefc: number of MuJoCo's constraints
    signature: the last number of the plugin state, see `Declaration`
  """

  instance: int
  identity: Any = None
  model_step: memoryview = _NONE
  time_step: float = 0.0
  integrator: memoryview = _NONE
  static: list = dataclasses.field(default_factory=list)
  policy: memoryview = _NONE
  counts: memoryview = _NONE
  status: memoryview = _NONE
  warning: memoryview = _NONE
  nefc: memoryview = _NONE
  signature: Any = _NONE


@dataclasses.dataclass
class Report:
  """What happened in an mjData.

  Attributes:
    flags: what the coupling reports, see `layout.FLAG`
    computed: whether forces were computed for the step that ends
    strange: whether the plugin state is not one of this organ
    error: what went wrong since the last reset, or None
    missed: most nodes and triangles that the window had no room for in a step
    noticed: whether it was said that the window came without its state
    nbad: MuJoCo's warnings of bad states that were looked at since the last reset
    watch: looks whether tools come through the surface
    chosen: whether the configuration was changed here, not by a copy
  """

  flags: memoryview
  computed: bool = False
  strange: bool = False
  error: str | None = None
  missed: tuple[int, int] = (0, 0)
  noticed: bool = False
  nbad: int = 0
  watch: Watch = dataclasses.field(default_factory=Watch)
  chosen: bool = False


@dataclasses.dataclass
class Workspace:
  """One organ in one mjData.

  Attributes:
    host: the organ as it is now, its body, and the memory that all share
    seen: what a step looks at of the mjData and the mjModel
    report: what came of it
    graphs: what it launches
    forces: what acts on the organ beside its tissue
    cuts: its mesh as it is now
    opens: forces that let it come apart
    triangles: those of the mjData where this organ changes them, or None
    turn: this mjData's part in the model's window, or None
    skin: what is drawn for it, or None
    views: what a coupling keeps when its graphs are recorded anew
  """

  host: Host
  seen: Seen
  report: Report
  graphs: Graphs = dataclasses.field(default_factory=Graphs)
  forces: Forces = dataclasses.field(init=False)
  cuts: Cuts = dataclasses.field(init=False)
  opens: tuple[Tears, Cutters] = dataclasses.field(init=False)
  triangles: shared.Triangles | None = None
  turn: shared.Turn | None = None
  skin: skin.Skin | None = None
  views: dict = dataclasses.field(default_factory=dict)

  def __post_init__(self):
    self.cuts = Cuts(self.organ, self.body, self.model)
    self.forces = Forces(self.host, FORCES)
    self.opens = self.forces.of(Tears), self.cutters

  @property
  def organ(self) -> Declaration:
    """Constants of the organ as it is now."""
    return self.host.organ

  @property
  def config(self) -> Config:
    """Configuration in force, which may differ from the compiled one."""
    return self.host.config

  @property
  def body(self) -> Body:
    """Shape, tissue and state on the organ's device."""
    return self.host.body

  @property
  def data(self) -> int:
    """Address of the mjData."""
    return self.host.data

  @property
  def model(self) -> int:
    """Address of the mjModel that views are of."""
    return self.host.model

  @property
  def attachments(self) -> Attachments:
    """Springs that hold vertices."""
    return self.forces.of(Attachments)

  @property
  def bonds(self) -> Bonds:
    """What the organ has grown on to."""
    return self.forces.of(Bonds)

  @property
  def cutters(self) -> Cutters:
    """What cuts it."""
    return self.forces.of(Cutters)

  @property
  def needles(self) -> Needles:
    """What goes through it."""
    return self.forces.of(Needles)

  @property
  def supports(self) -> Supports:
    """What it rests on."""
    return self.forces.of(Supports)

  def share(self, values: np.ndarray, vert: Any = slice(None)) -> np.ndarray:
    """Returns what cuts have made of values by mass of vertices, some or all, (n,)."""
    return self.cuts.share(values, vert) if self.cuts else values[vert]

  @property
  def plugin_state(self) -> np.ndarray:
    """The organ's own numbers."""
    return self.host.state.numpy()

  def motion(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns displacement and velocity of the vertices, in the organ's frame, (nvert, 3) each."""
    return self.graphs.phases.motion()

  def run(self):
    """Computes the step's forces and adds them to qfrc_passive."""
    self._check_model()
    self.report.strange = self.seen.signature[0] != self.organ.signature
    if self.report.strange:
      coupling.check_state(self.organ, self.plugin_state)
      self.report.strange = False
    cuts.follow(self)
    changed = self.cuts.renewed()
    if self.triangles:
      self.triangles.enter()
    if self.turn is None:
      if self.cuts:
        self._run_cut(changed)
      else:
        self._run()
    else:
      with self.turn.lock:
        if changed:
          self._find_contacts_again()
        self._run()

  def _run_cut(self, changed: bool):
    """Runs an organ that may be cut: contacts must be with its own triangles."""
    if self.cuts.show() or changed:
      windowed.find_contacts_again(self)
    self._run()

  def _run(self):
    self.needles.lead()
    if self.turn is not None:
      # The model's windows may not be those of this state, which was set from outside or shares the
      # model with another: contacts must be found again with the windows in place.
      if self._is_astray(self.turn) or not self.turn.mine:
        self._find_contacts_again()
    wp.capture_launch(self.graphs.before)
    if self.turn is not None:
      if self.report.flags[FLAG.stale]:
        self._find_contacts_again()
        wp.capture_launch(self.graphs.before)
      if not self.asleep and self.seen.policy[0] == _ALLOWED:
        windowed.let_sleep(self, False)
    if not self.asleep:  # what `after` does was done with `before`
      self._solve()
    if self.report.flags[FLAG.weighed]:
      contacts.project(self.model, self.data)  # with the inertia that is in the model now
    self.report.computed = True

  def _solve(self):
    """Solves for the step, and tells MuJoCo."""
    if self.graphs.resident:
      self.graphs.resident.send()
      graphs.launch_all(self.graphs.resident.left_to_do(self.graphs.solve))
      self.graphs.resident.look()
      wp.capture_launch(self.graphs.after)
    else:
      graphs.launch_all(self.graphs.solve)

  def _check_model(self):
    """Makes sure that nothing has changed in the model that may not change while running.

    Raises:
      ValueError: something has.
    """
    if self.seen.integrator[0] == _RK4:
      raise ValueError(declare.NO_RK4)
    for place, was in self.seen.static:
      if place.tobytes() != was:
        declare.check_frame(mjstruct.model(self.model), self.organ)

  def _is_astray(self, turn: shared.Turn) -> bool:
    """Returns whether qpos was set without the plugin state: slots are not on their nodes."""
    if turn.qpos.tobytes() == turn.stood:
      return False
    far = windowed.find_astray(self)
    report = self.report
    if far > _ASTRAY and not (report.noticed or report.error):  # by which a step is not whole
      report.noticed = True
      mjstruct.warn(
        f"organ {self.organ.name!r}: qpos of its windows was set without plugin_state, which has "
        "its motion and is kept; save and set mjSTATE_FULLPHYSICS"
      )
    return far > _ASTRAY

  def _find_contacts_again(self):
    self.put_windows()
    windowed.find_contacts_again(self)

  def put_windows(self):
    """Puts the windows where the plugin state says."""
    if self.graphs.resident:
      self.graphs.resident.fetch()
    wp.capture_launch(self.graphs.place)
    if self.turn is not None:
      self.turn.take()

  def step(self):
    """Steps the plugin state after MuJoCo has moved."""
    if self.report.strange:
      return
    if self.report.computed:
      self.seen.signature[0] = self.organ.signature
    if self.turn is None:
      self._step()
    else:
      with self.turn.lock:
        self._step()
        self.turn.end()
        self.turn.stood = self.turn.qpos.tobytes()

  def _step(self):
    computed = self.report.computed
    if self.asleep:
      self.report.computed = False
      if self.seen.nefc[0]:  # contacts of a window that was left behind wake the organ
        wp.capture_launch(self.graphs.leave)
      if self.seen.counts[0]:
        windowed.hide(self)
      if self.seen.policy[0] != _ALLOWED:
        windowed.let_sleep(self, True)
      return
    responds = bool(self.graphs.respond) and self.graphs.stiff and computed
    if responds or self.turn is not None:
      wp.capture_launch(self.graphs.leave)
    if self.turn is not None:
      windowed.hide(self)
    responds = responds and bool(self.report.flags[FLAG.changed])
    self.report.flags[FLAG.answered] = responds
    if responds:
      self._answer()
    wp.capture_launch(self.graphs.advance if responds else self.graphs.end)
    if self.graphs.resident:
      self.graphs.resident.step(computed)
    self.report.computed = False

  def _answer(self):
    """Ends the step with the organ's own response to the change of the contact forces."""
    if self.turn is not None:
      self.graphs.phases.boxes["inbox"].head.numpy()[HEAD.answered] = 1.0
    graphs.launch_all(self.graphs.respond)
    if self.graphs.resident:
      self.report.flags[FLAG.pending] = 0
      self.graphs.resident.look()

  @property
  def declared(self) -> Declaration:
    """The organ before the first cut."""
    return self.cuts.declared if self.cuts else self.organ

  @property
  def asleep(self) -> bool:
    """Whether the organ is at rest and its solve was skipped."""
    return bool(self.report.flags[FLAG.asleep])

  @property
  def slots(self) -> np.ndarray:
    """Node of each slot in the model, -1 for none, (nslot,)."""
    return self.views["placed"].numpy()

  def inertia(self, model: int) -> np.ndarray:
    """Returns the inertia that contacts meet at each vertex [kg], (nvert,)."""
    if self.organ.windows:
      return self.views["inertia"].numpy().copy()
    return inertia.of_dofs(mjstruct.model(model), self.organ)

  def note(self, text: str):
    """Keeps the first error and says it."""
    if self.report.error is None:
      self.report.error = f"organ {self.organ.name!r}: {text}"
      mjstruct.warn(self.report.error)

  def forget(self):
    """Forgets what went wrong."""
    self.report.error, self.report.watch = None, Watch()


def place(w: Workspace, model: int):
  """Puts the windows of a model where the plugin state says."""
  attach(w, model)
  if w.turn is not None:
    with w.turn.lock:
      w.put_windows()
      w.turn.stood = w.turn.qpos.tobytes()


def set_motion(w: Workspace, model: int, u: np.ndarray | None, v: np.ndarray | None):
  """Sets the motion of the vertices that move, and forgets forces of the past.

  Args:
    w: the workspace
    model: address of the mjModel
    u: displacement in the organ's frame [m], (nvert, 3); None for what it is
    v: velocity there [m/s], (nvert, 3); None for what it is
  """
  sync(w)
  state, where = w.plugin_state, coupling.spans(w.organ)
  kept = {name: state[where[name]].copy() for name in _STAYS if name in where}
  state[:] = 0.0
  for name, values in kept.items():
    state[where[name]] = values
  w.graphs.phases.put(np.flatnonzero(w.organ.free), u, v)
  if w.turn is not None:
    place(w, model)


def attach(w: Workspace, model: int):
  """Makes a workspace fit a living model, which need not be the one that it last ran with."""
  if not w.seen.identity.is_of(model):
    bind(w, model)


def make(model: int, data: int, instance: int) -> Workspace:
  """Returns the workspace of an organ in a fresh mjData; makes the model fit the organ."""
  m = mjstruct.model(model)
  has_windows = bool(mjstruct.config(m, instance, "window"))
  with graphs.lock:
    organ = (declare_windows if has_windows else declare).read(m, instance)
    body = bodies.worlds(organ.still)
    host = Host(organ, body, data, model, instance)
    w = Workspace(host, Seen(instance), Report(host.flags().numpy().data))
    if organ.windows:
      w.turn = shared.Turn()
    _view(w)
    prepare.fit(m, organ, body)
    # Padding nodes have a mass so that nothing divides by zero.
    mass = np.where(body.shape.vert.numpy() >= 0, 0.0, 1.0).reshape(1, -1, 8)
    host.arrays["mass"].assign(mass)
    w.skin = skin.read(m, organ)
    declare_attachments.declare(w.attachments, host)
    supports.check(host)
    declare_bonds.declare(w.bonds, host)
    w.cutters.declare()
    w.needles.declare()
    bind(w, model)
    w.seen.signature = w.plugin_state[coupling.spans(organ)["signature"]].data
    if w.turn is not None:
      windowed.settle(w, model)
    feel(w, m)
    return w


def _view(w: Workspace):
  """Takes views of an mjData that every step looks at."""
  fields = mjstruct.Data
  w.seen.status = w.host.arrays["status"].numpy()[0].data
  w.seen.warning = mjstruct.warnings(w.data)
  w.seen.nefc = mjstruct.view(w.data + fields.nefc.offset, 1, np.int32).data
  if w.turn is not None:
    first, last = int(w.organ.qposs.min()), int(w.organ.qposs.max()) + 1
    w.turn.qpos = w.host.d.qpos[first:last].view(np.uint8).data


def join(spaces: list[Workspace]) -> list[Workspace]:
  """Lets the organs of an mjData have what leads from one to another, as their keys say.

  Args:
    spaces: workspaces of the organs that there are so far, the one that has come last

  Returns:
    those whose graphs have to be recorded anew, in this order
  """
  changed: dict[int, Workspace] = {}
  for one, other, row in flexes.named(spaces, lambda c: [(a[0], a) for a in c.attach]):
    declare_attachments.declare_between(one.attachments, other.attachments, row)
    changed |= {id(w): w for w in (one, other)}
  for one, other, row in flexes.named(spaces, lambda c: [(b.to, b) for b in c.bonds or ()]):
    declare_bonds.declare_between(one.bonds, other.bonds, row)
    changed |= {id(w): w for w in (one, other)}
  for one, other, _ in flexes.named(spaces, lambda c: [(name, None) for name in c.support]):
    if other is not one:
      one.supports.put(other.supports)
      changed |= {id(w): w for w in (one, other)}
  return list(changed.values())


def feel(w: Workspace, m: mjstruct.Struct):
  """Notes how stiff the organ is for the present time step, and what its step takes for it."""
  nodal = w.inertia(w.model)
  w.graphs.stiff, heaviest = inertia.stiffness(m, w.declared, w.body, w.config, nodal)
  w.host.arrays["heaviest"].numpy()[0] = heaviest
  newton = inertia.iterations(m, w.declared, w.config)
  if newton != w.body.newton:
    w.body.newton = newton
    bind(w, w.model)


def sync(w: Workspace):
  """Brings a motion that is on a device into the plugin state."""
  if w.graphs.resident:
    w.graphs.resident.fetch()


def refresh(w: Workspace):
  """Renews the effective inertia after the time step or the material changed; see `inertia`."""
  m = mjstruct.model(w.model)
  with graphs.lock:
    if w.organ.windows is None:
      prepare.give_armature(m, w.declared, w.body, w.config)
      w.graphs.phases.reshape()
    else:
      windowed.set_inertia(w, m)
      if w.turn is not None and w.turn.mine:
        place(w, w.model)
    feel(w, m)
    contacts.tell(w, w.model)
    w.cutters.refresh([w.config.thickness])
    w.needles.refresh()
    w.seen.time_step = float(m.opt.timestep)
