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

from . import contacts, coupling, graphs
from .bind import bind
from .coupling import Phases
from .cutting.cutters import Cutters
from .cutting.solid_cuts import Cuts, cuts_of
from .forces import declare_attachments, declare_bonds
from .forces.attachments import Ties
from .forces.cohesive_bonds import Bonds
from .forces.passive import Beside, Hold
from .forces.relaxation import Creep
from .forces.supports import Rests
from .layout import FLAG, HEAD
from .model import declare, inertia, mjstruct, prepare, skin
from .model.declare import Declaration
from .penetration import Watch
from .windows import declare_windows, windowed
from .windows.model_lock import Turn
from .windows.resident import Resident

_ALLOWED = int(mujoco.mjtSleepPolicy.mjSLEEP_AUTO_ALLOWED)
_RK4 = int(mujoco.mjtIntegrator.mjINT_RK4)
_ASTRAY = 1e-9  # distance of a slot from its node that rounding does not explain [m]


@dataclasses.dataclass
class Workspace:
  """One organ in one mjData.

  Attributes:
    organ: constants
    config: configuration in force, which may differ from the compiled one
    body: shape, tissue and state on the organ's device
    host: the arrays of its state that MuJoCo's side reads and writes, on the CPU
    lagged: external and lagged contact force [N]  (nodes or slots, 3)
    data: address of the mjData
    instance: the plugin instance
    model: address of the mjModel the views are of
    identity: tells that model from others
    chosen: whether the configuration was changed here, not by a copy
    turn: this mjData's part in the model's windows, or None
    before: recorded graph of a step's forces before the solve
    solve: recorded graphs of the solve and what is around it, each on one device
    after: recorded graph of the forces after it where the motion is on a device, else part of it
    leave: recorded graph that takes the contact forces after MuJoCo's step
    respond: recorded graphs of the organ's response to their change; none where the scheme has none
    advance, end: recorded graphs of the plugin state's step after that, or without a response
    place: recorded graph that puts the windows where the state says, or None
    hold, creep: springs that hold nodes; its stress relaxation
    ties, bonds, rests: what the organ is tied to, has grown on to, and rests on
    cuts, cutters: its mesh as it is now, and what cuts it
    resident: keeper of a motion that stays on the device, or None
    stiff: whether the response is needed, see `inertia.stiffness`
    heaviest: most times its inertia that a node in contact may have, see there  (1,)
    computed: whether forces were computed for the step that ends
    flags: what the coupling reports, see `layout.FLAG`
    policy, counts: MuJoCo's sleep policy of the windows' bodies, and the number of vertices that it
      sees of a windowed organ, come first
    status: iterations, relative residual, norm, failure  (4,)
    error: what went wrong since the last reset, or None
    missed: most nodes and triangles that the windows had no room for in a step
    warning: last index and count of each of MuJoCo's warnings, one after the other
    strange: whether the plugin state is not one of this organ
    noticed: whether it was said that windows came without their state
    watch: looks whether tools come through the surface
    nbad: MuJoCo's warnings of bad states that were looked at since the last reset
    model_step, time_step: the model's time step comes first, and the armature's [s]
    integrator, nefc: MuJoCo's, and the number of its constraints, come first
    static: places of the bodies that the organ hangs on, and what they were
    qpos, stood: numbers of qpos that the slots have, as bytes; after the last step, or None
    plugin_state: the organ's own numbers
    signature: the last of them, see `Declaration`
    views: what a coupling keeps when its graphs are recorded anew
    skin: what is drawn for it, or None
    boxes: blocks of the plugin state and of what crosses in a step, see `layout`; windows
    phases: what the graphs launch
  """

  organ: Declaration
  config: Config
  body: Body
  host: dict[str, wp.array]
  lagged: wp.array
  data: int
  instance: int
  model: int = 0
  identity: Any = None
  chosen: bool = False
  turn: Turn | None = None
  before: Any = None
  solve: list = dataclasses.field(default_factory=list)
  after: Any = None
  leave: Any = None
  respond: list = dataclasses.field(default_factory=list)
  end: Any = None
  advance: Any = None
  place: Any = None
  hold: Hold = dataclasses.field(init=False)
  ties: Ties = dataclasses.field(init=False)
  bonds: Bonds = dataclasses.field(init=False)
  rests: Rests = dataclasses.field(init=False)
  creep: Creep = dataclasses.field(init=False)
  cuts: Cuts = dataclasses.field(init=False)
  cutters: Cutters = dataclasses.field(init=False)
  resident: Resident | None = None
  stiff: bool = False
  heaviest: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(1))
  computed: bool = False
  policy: memoryview = dataclasses.field(default_factory=lambda: np.zeros(1, np.int32).data)
  counts: memoryview = dataclasses.field(default_factory=lambda: np.zeros(1, np.int32).data)
  error: str | None = None
  missed: tuple[int, int] = (0, 0)
  strange: bool = False
  noticed: bool = False
  watch: Watch = dataclasses.field(default_factory=Watch)
  # Views that every step looks at: an item of a memoryview costs a tenth of one of an array.
  flags: memoryview = dataclasses.field(default_factory=lambda: np.zeros(len(FLAG), np.int32).data)
  status: memoryview = dataclasses.field(default_factory=lambda: np.zeros(4, np.float32).data)
  warning: memoryview = dataclasses.field(default_factory=lambda: memoryview(b""))
  nefc: memoryview = dataclasses.field(default_factory=lambda: memoryview(b"\0"))
  nbad: int = 0
  model_step: memoryview = dataclasses.field(default_factory=lambda: memoryview(b"\0"))
  time_step: float = 0.0
  integrator: memoryview = dataclasses.field(default_factory=lambda: memoryview(b"\0"))
  static: list = dataclasses.field(default_factory=list)
  qpos: memoryview = dataclasses.field(default_factory=lambda: memoryview(b""))
  stood: bytes | None = None
  plugin_state: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
  signature: Any = dataclasses.field(default_factory=lambda: memoryview(b"\0"))
  views: dict = dataclasses.field(default_factory=dict)
  skin: skin.Skin | None = None
  boxes: dict = dataclasses.field(default_factory=dict)
  phases: Phases = dataclasses.field(init=False)

  def __post_init__(self):
    self.hold, self.ties = Hold(self), Ties(self)
    self.bonds, self.rests, self.creep = Bonds(self), Rests(self), Creep(self)
    self.cuts, self.cutters = cuts_of(self), Cutters(self)

  @property
  def beside(self) -> tuple[Beside, ...]:
    """What acts on the organ beside its tissue, in the order in which it does."""
    return self.ties, self.bonds, self.rests, self.creep, self.cutters

  def run(self):
    """Computes the step's forces and adds them to qfrc_passive."""
    self._check_model()
    self.strange = self.signature[0] != self.organ.signature
    if self.strange:
      coupling.check_state(self.organ, self.plugin_state)
      self.strange = False
    changed = bool(self.cuts) and self.cuts.renewed()
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
    """Runs an organ that may be cut: the model's triangles must be its own."""
    with self.cuts.lock:
      others = self.cuts.show()
      if changed or others:
        windowed.find_contacts_again(self)
      self._run()

  def _run(self):
    if self.turn is not None:
      # The model's windows may not be those of this state, which was set from outside or shares the
      # model with another: contacts must be found again with the windows in place.
      if self._is_astray() or not self.turn.mine:
        self._find_contacts_again()
    wp.capture_launch(self.before)
    if self.turn is not None:
      if self.flags[FLAG.stale]:
        self._find_contacts_again()
        wp.capture_launch(self.before)
      if not self.asleep and self.policy[0] == _ALLOWED:
        windowed.let_sleep(self, False)
    if not self.asleep:  # what `after` does was done with `before`
      self._solve()
    if self.flags[FLAG.weighed]:
      contacts.project(self.model, self.data)  # with the inertia that is in the model now
    self.computed = True

  def _solve(self):
    """Solves for the step, and tells MuJoCo."""
    if self.ties.aims:
      self.ties.aim()
    if self.resident:
      self.resident.send()
      graphs.launch_all(self.resident.left_to_do())
      self.resident.look()
      wp.capture_launch(self.after)
    else:
      graphs.launch_all(self.solve)

  def _check_model(self):
    """Makes sure that nothing has changed in the model that may not change while running.

    Raises:
      ValueError: something has.
    """
    if self.integrator[0] == _RK4:
      raise ValueError(declare.NO_RK4)
    for place, was in self.static:
      if place.tobytes() != was:
        declare.check_frame(mjstruct.Model.from_address(self.model), self.organ)

  def _is_astray(self) -> bool:
    """Returns whether qpos was set without the plugin state: slots are not on their nodes."""
    if self.qpos.tobytes() == self.stood:
      return False
    far = windowed.find_astray(self)
    if far > _ASTRAY and not self.noticed and self.error is None:  # else a step was not whole
      self.noticed = True
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
    if self.resident:
      self.resident.fetch()
    wp.capture_launch(self.place)
    if self.turn is not None:
      self.turn.take()

  def step(self):
    """Steps the plugin state after MuJoCo has moved."""
    if self.strange:
      return
    if self.computed:
      self.signature[0] = self.organ.signature
    if self.turn is None:
      self._step()
    else:
      with self.turn.lock:
        self._step()
        self.turn.end()
        self.stood = self.qpos.tobytes()

  def _step(self):
    computed = self.computed
    if self.asleep:
      self.computed = False
      if self.nefc[0]:  # contacts of a window that was left behind wake the organ
        wp.capture_launch(self.leave)
      if self.counts[0]:
        windowed.hide(self)
      if self.policy[0] != _ALLOWED:
        windowed.let_sleep(self, True)
      return
    responds = bool(self.respond) and self.stiff and computed
    if responds or self.turn is not None:
      wp.capture_launch(self.leave)
    if self.turn is not None:
      windowed.hide(self)
    responds = responds and bool(self.flags[FLAG.changed])
    self.flags[FLAG.answered] = responds
    if responds:
      self._answer()
    wp.capture_launch(self.advance if responds else self.end)
    if self.resident:
      self.resident.step(computed)
    self.computed = False

  def _answer(self):
    """Ends the step with the organ's own response to the change of the contact forces."""
    if self.turn is not None:
      self.boxes["inbox"].head.numpy()[HEAD.answered] = 1.0
    graphs.launch_all(self.respond)
    if self.resident:
      self.flags[FLAG.pending] = 0
      self.resident.look()

  @property
  def declared(self) -> Declaration:
    """The organ before the first cut."""
    return self.cuts.declared if self.cuts else self.organ

  @property
  def asleep(self) -> bool:
    """Whether the organ is at rest and its solve was skipped."""
    return bool(self.flags[FLAG.asleep])

  @property
  def slots(self) -> np.ndarray:
    """Node of each slot in the model, -1 for none, (nslot,)."""
    return self.views["placed"].numpy()

  def inertia(self, model: int) -> np.ndarray:
    """Returns the inertia that contacts meet at each vertex [kg], (nvert,)."""
    if self.organ.windows:
      return self.views["inertia"].numpy().copy()
    return inertia.of_dofs(mjstruct.Model.from_address(model), self.organ)

  def note(self, text: str):
    """Keeps the first error and says it."""
    if self.error is None:
      self.error = f"organ {self.organ.name!r}: {text}"
      mjstruct.warn(self.error)

  def forget(self):
    """Forgets what went wrong."""
    self.error, self.watch = None, Watch()


def place(w: Workspace, model: int):
  """Puts the windows of a model where the plugin state says."""
  attach(w, model)
  if w.turn is not None:
    with w.turn.lock:
      w.put_windows()
      w.stood = w.qpos.tobytes()


def rebind(w: Workspace):
  """Records the graphs of a workspace anew."""
  bind(w, w.model)


def attach(w: Workspace, model: int):
  """Makes a workspace fit a living model, which need not be the one that it last ran with."""
  if not w.identity.is_of(model):
    bind(w, model)


def make(model: int, data: int, instance: int) -> Workspace:
  """Returns the workspace of an organ in a fresh mjData; makes the model fit the organ."""
  has_windows = bool(mjstruct.config(model, instance, "window"))
  with graphs.lock:
    organ = (declare_windows if has_windows else declare).read(model, instance)
    m = mjstruct.Model.from_address(model)
    body = bodies.worlds(organ.still)
    s = body.shape
    host = {}
    for field, array in coupling.on_body(body).items():
      if body.device.is_cuda:
        array = wp.zeros(array.shape, dtype=float, device="cpu", pinned=True)
      host[field] = array
    size = organ.windows.nslot if organ.windows else s.nnode
    lagged = wp.zeros((size, 3), dtype=wp.float64, device="cpu")
    w = Workspace(organ, organ.config, body, host, lagged, data, instance, model)
    _view(w, mjstruct.Data.from_address(data), m)
    prepare.fit(m, organ, body)
    # Padding nodes have a mass so that nothing divides by zero.
    mass = np.where(s.vert.numpy() >= 0, 0.0, 1.0).reshape(1, -1, 8)
    host["mass"].assign(mass)
    if organ.windows:
      w.turn = Turn()
    w.skin = skin.read(m, organ)
    declare_attachments.declare(w)
    declare_bonds.declare(w)
    w.cutters.declare()
    bind(w, model)
    w.plugin_state = w.views["plugin_state"].numpy()
    w.signature = w.plugin_state[coupling.spans(organ)["signature"]].data
    if w.turn is not None:
      windowed.settle(w, model)
    feel(w, m)
    return w


def _view(w: Workspace, d, m):
  """Takes views of an mjData that every step looks at."""
  fields, count = mjstruct.Data, len(d.warning)
  w.status = w.host["status"].numpy()[0].data
  w.warning = mjstruct.view(w.data + fields.warning.offset, 2 * count, np.int32).data
  w.nefc = mjstruct.view(w.data + fields.nefc.offset, 1, np.int32).data
  if w.organ.windows:
    first, last = int(w.organ.qposs.min()), int(w.organ.qposs.max()) + 1
    w.qpos = mjstruct.view(d.qpos + 8 * first, 8 * (last - first), np.uint8).data


def feel(w: Workspace, m):
  """Notes how stiff the organ is for the present time step, and what its step takes for it."""
  nodal = w.inertia(w.model)
  w.stiff, w.heaviest[0] = inertia.stiffness(m, w.declared, w.body, w.config, nodal)
  newton = inertia.iterations(m, w.declared, w.config)
  if newton != w.body.newton:
    w.body.newton = newton
    bind(w, w.model)


def sync(w: Workspace):
  """Brings a motion that is on a device into the plugin state."""
  if w.resident:
    w.resident.fetch()


def refresh(w: Workspace):
  """Renews the effective inertia after the time step or the material changed; see `inertia`."""
  m = mjstruct.Model.from_address(w.model)
  with graphs.lock:
    if w.organ.windows is None:
      prepare.give_armature(m, w.declared, w.body, w.config)
      w.phases.reshape()
    else:
      windowed.set_inertia(w, m)
      if w.turn is not None and w.turn.mine:
        place(w, w.model)
    feel(w, m)
    contacts.tell(w, w.model)
    w.cutters.refresh()
    w.time_step = float(m.opt.timestep)
