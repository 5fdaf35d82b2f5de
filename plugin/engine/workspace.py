"""Everything one organ needs in one mjData: state, views of MuJoCo's arrays, recorded graphs."""

from __future__ import annotations

import dataclasses
import itertools
import threading
import weakref
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue import body as bodies
from palpate.tissue import config as configuration
from palpate.tissue import shape, step
from palpate.tissue.body import Body
from palpate.tissue.config import Config

from . import (
  coupling,
  declare,
  declare_windows,
  inertia,
  mjstruct,
  prepare,
  window,
  window_nodes,
  window_slots,
)
from .coupling import ANSWERED, ASLEEP, CHANGED, NFLAG, PENDING, STALE
from .declare import Declaration
from .resident import Resident

_ALLOWED = int(mujoco.mjtSleepPolicy.mjSLEEP_AUTO_ALLOWED)
_lock = threading.RLock()


@dataclasses.dataclass
class Workspace:
  """One organ in one mjData.

  Attributes:
    organ: constants
    config: configuration in force, which may differ from the compiled one
    body: shape, tissue and state on the organ's device
    host: the arrays of its state that MuJoCo's side reads and writes, on the CPU
    ext: external and lagged contact force in float64 [N]  (3 nnode,)
    model: address of the mjModel the views are of
    data: address of the mjData
    before, after: recorded graphs of a step's forces around the solve
    solve: recorded graphs of the solve and what it needs, each on one device
    leave: recorded graph that takes the contact forces after MuJoCo's step
    respond: recorded graphs of the organ's response to their change; none where the scheme has none
    end: recorded graph that ends a step without that, or None
    advance: recorded graph of the plugin state's step
    place: recorded graph that puts the windows where the plugin state says, or None
    resident: keeper of a motion that stays on the device, or None
    stiff: whether the response is needed, see `inertia.stiffness`
    heaviest: most times its inertia that a node in contact may have, see there  (1,)
    computed: whether forces were computed for the step that ends
    flags: what the coupling reports: STALE (the model lacks slots), ASLEEP, MISSED_NODES,
      MISSED_ELEMENTS, PENDING (mode of the next commit), NEAR (a tool is near), CHANGED (contact
      forces did), ANSWERED (the organ responded) and FORESEEN (what acts on it was)  (NFLAG,)
    policy: MuJoCo's sleep policy of the windows' bodies comes first
    counts: the number of vertices that MuJoCo sees of a windowed organ comes first
    status: iterations, relative residual, norm, failure  (4,)
    error: what went wrong since the last reset, or None
    overflow: what the windows had no room for, the first time, or None
    warning: last index and count of each of MuJoCo's warnings, one after the other
    nefc: the number of MuJoCo's constraints comes first
    nbad: MuJoCo's warnings of bad states that were looked at since the last reset
    model_step: the model's time step comes first [s]
    time_step: time step that the armature is for [s]
    views: what the graphs point at, kept alive
  """

  organ: Declaration
  config: Config
  body: Body
  host: dict[str, wp.array]
  ext: wp.array
  data: int
  model: int = 0
  before: Any = None
  solve: list = dataclasses.field(default_factory=list)
  after: Any = None
  leave: Any = None
  respond: list = dataclasses.field(default_factory=list)
  end: Any = None
  advance: Any = None
  place: Any = None
  resident: Resident | None = None
  stiff: bool = False
  heaviest: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(1))
  computed: bool = False
  flags: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(NFLAG, np.int32))
  policy: memoryview = dataclasses.field(default_factory=lambda: np.zeros(1, np.int32).data)
  counts: memoryview = dataclasses.field(default_factory=lambda: np.zeros(1, np.int32).data)
  status: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(4, np.float32))
  error: str | None = None
  overflow: str | None = None
  # Views that every step looks at: an item of a memoryview costs a tenth of one of an array.
  warning: memoryview = dataclasses.field(default_factory=lambda: memoryview(b""))
  nefc: memoryview = dataclasses.field(default_factory=lambda: memoryview(b"\0"))
  nbad: int = 0
  model_step: memoryview = dataclasses.field(default_factory=lambda: memoryview(b"\0"))
  time_step: float = 0.0
  views: dict = dataclasses.field(default_factory=dict)

  def __post_init__(self):
    self._me = weakref.ref(self)

  def run(self):
    """Computes the step's forces and adds them to qfrc_passive."""
    # The model's windows may not be those of this state, which was set from outside or shares the
    # model with another: contacts must be found again with the windows in place.
    if self.place is not None and not self._owns_model():
      self._find_contacts_again()
    wp.capture_launch(self.before)
    if self.place is not None and self.flags[STALE]:
      self._find_contacts_again()
      wp.capture_launch(self.before)
    if self.place is not None and not self.asleep and self.policy[0] == _ALLOWED:
      window.let_sleep(self, False)
    if self.asleep:
      self.computed = True
      return  # what `after` does was done with `before`
    if self.resident:
      self.resident.send()
      _launch_all(self.resident.left_to_do())
      self.resident.look()
    else:
      _launch_all(self.solve)
    wp.capture_launch(self.after)
    self.computed = True

  def _find_contacts_again(self):
    wp.capture_launch(self.place)
    mjstruct.library().mj_fwdPosition(self.model, self.data)

  def step(self):
    """Steps the plugin state after MuJoCo has moved."""
    computed, self.computed = self.computed, False
    if self.asleep:
      if self.nefc[0]:  # contacts of a window that was left behind wake the organ
        wp.capture_launch(self.leave)
      if self.counts[0]:
        window.hide(self)
      if self.policy[0] != _ALLOWED:
        window.let_sleep(self, True)
      return
    responds = bool(self.respond) and self.stiff and computed
    if responds or self.place is not None:
      wp.capture_launch(self.leave)
    if self.place is not None:
      window.hide(self)
    responds = responds and bool(self.flags[CHANGED])
    self.flags[ANSWERED] = responds
    if responds:
      self._answer()
    elif self.end is not None:
      wp.capture_launch(self.end)
    wp.capture_launch(self.advance)
    if self.resident:
      self.resident.step(computed)

  def _answer(self):
    """Ends the step with the organ's own response to the change of the contact forces."""
    if self.place is not None:
      self.views["inbox"].numpy()[window_nodes.HEAD - 1] = 1.0
    _launch_all(self.respond)
    if self.resident:
      self.flags[PENDING] = 0
      self.resident.look()

  @property
  def asleep(self) -> bool:
    """Whether the organ is at rest and its solve was skipped."""
    return bool(self.flags[ASLEEP])

  def _owns_model(self) -> bool:
    """Returns whether the model's windows were last placed here, and makes it so.

    Raises:
      RuntimeError: two threads step the same model.
    """
    before, thread = _owner.get(self.model), threading.get_ident()
    if before is not None and before == (self._me, thread):
      return True
    _owner[self.model] = (self._me, thread)
    if before is None or before[0] is self._me:
      return before is not None
    if before[0]() is not None and before[1] != threading.get_ident():
      raise RuntimeError(
        "two threads step one mjModel, which holds the windows; give each thread its own model "
        "(copy.copy(model))"
      )
    return False


def _launch_all(graphs: list):
  for device, graph in graphs:
    wp.capture_launch(graph)
    if device.is_cuda:
      wp.synchronize_device(device)


# By address of the mjModel: whose windows it holds, and the thread that placed them.
_owner: dict[int, tuple[Any, int]] = {}


def place(w: Workspace):
  """Puts the windows where the plugin state says."""
  wp.capture_launch(w.place)
  _owner[w.model] = (w._me, threading.get_ident())


def state_size(model: int, instance: int) -> int:
  """Returns the length of the plugin state.

  Contact force, last dv and the one before of each moving vertex, or what `window` says.
  """
  m = mjstruct.Model.from_address(model)
  names = mjstruct.config(model, instance, "window").split()
  if names:
    # Asked before MuJoCo has filled in the flexes: what `window` needs is at most this.
    return window.state_size(m.nflexvert, 0, m.ngeom * len(names))
  return 9 * len(declare.moving_bodies(m, instance)) + 1


def make(model: int, data: int, instance: int) -> Workspace:
  """Returns the workspace of an organ in a fresh mjData; gives the model an armature if needed."""
  windowed = bool(mjstruct.config(model, instance, "window"))
  organ = (declare_windows if windowed else declare).read(model, instance)
  m = mjstruct.Model.from_address(model)
  with _lock:
    body = bodies.worlds(organ.still)
    s = body.shape
    host = {}
    for field in (*_IN, *_OUT, "rhs", "sol"):
      array = _field(body, field)
      if body.device.is_cuda:
        array = wp.zeros(array.shape, dtype=float, device="cpu", pinned=True)
      host[field] = array
    size = organ.windows.nslot if organ.windows else s.nnode
    ext = wp.zeros(3 * size, dtype=wp.float64, device="cpu")
    w = Workspace(organ, organ.config, body, host, ext, data)
    w.status = host["status"].numpy()[0]
    d, count = mjstruct.Data, len(mjstruct.Data.from_address(data).warning)
    w.warning = mjstruct.view(data + d.warning.offset, 2 * count, np.int32).data
    w.nefc = mjstruct.view(data + d.nefc.offset, 1, np.int32).data
    prepare.fit(m, organ, body)
    # Padding nodes have a mass so that nothing divides by zero.
    mass = np.where(s.vert.numpy() >= 0, 0.0, 1.0).reshape(1, -1, 8)
    host["mass"].assign(mass)
    bind(w, model, instance)
    if w.place is not None:
      window.settle(w, model)
      place(w)
    _feel(w, m)
    return w


def _feel(w: Workspace, m):
  """Notes whether the organ is stiff for the present time step."""
  if w.organ.windows:
    nodal = w.views["inertia"].numpy()
  else:
    nodal = inertia.of_dofs(m, w.organ)
  w.stiff, w.heaviest[0] = inertia.stiffness(m, w.organ, w.body, w.config, nodal)


def bind(w: Workspace, model: int, instance: int):
  """Points the graphs at the arrays of `model` and of the workspace's mjData and records them."""
  m = mjstruct.Model.from_address(model)
  device, cpu = w.body.device, wp.get_device("cpu")
  scheme = step.SCHEMES[w.config.integrator]
  side = window if w.organ.windows else coupling
  with _lock:
    load(w.body)
    if w.resident:
      w.resident.fetch()
    launches = side.launches(w, model, instance)
    near = wp.get_device(launches.side)
    crossing = device != near

    def solve():
      if crossing:
        _cross(w, _IN, to_device=True)
      scheme.step(w.body)
      if crossing:
        _cross(w, _OUT, to_device=False)

    def respond():
      if crossing:
        _cross(w, ("rhs",), to_device=True)
      scheme.respond(w.body)
      if crossing:
        _cross(w, ("sol", "status"), to_device=False)

    w.before = _record(cpu, launches.gather)
    w.solve = _record_all((near, launches.enter), (device, solve), (near, launches.look))
    w.after = _record(cpu, launches.scatter)
    w.leave = _record(cpu, launches.leave)
    w.respond = []
    if scheme.respond:
      w.respond = _record_all((near, launches.push), (device, respond), (near, launches.answer))
    w.end = _record(cpu, launches.end) if launches.end else None
    w.advance = _record(cpu, launches.advance)
    w.place = _record(cpu, launches.place) if launches.place else None
    if w.resident:
      w.resident.foresee = _record(cpu, launches.foresee)
      ahead = _record_all((near, launches.enter_ahead), (device, solve))
      w.resident.begin_graph = ahead[0][1]
      w.resident.rest = _record_all((near, launches.look_only))
  w.model = model
  w.model_step = coupling.option_views(model)["timestep"].numpy().data
  w.time_step = float(m.opt.timestep)


# What a solve on another device than MuJoCo's side reads and writes.
_IN = ("step", "disp", "vel", "mass", "force_ext", "dvel_warm")
_OUT = ("dvel", "status")


def _field(body: Body, name: str) -> wp.array:
  return getattr(body.state if hasattr(body.state, name) else body.system, name)


def _cross(w: Workspace, fields: tuple[str, ...], to_device: bool):
  for field in fields:
    there, here = _field(w.body, field), w.host[field]
    if to_device:
      wp.copy(there, here)
    else:
      wp.copy(here, there)


def _record_all(*parts) -> list:
  """Records (device, work) pairs, those in a row on one device as one graph."""
  graphs = []
  for device, group in itertools.groupby(parts, key=lambda part: part[0]):
    work = [part[1] for part in group]
    graphs.append((device, _record(device, lambda work=work: [each() for each in work])))
  return graphs


def _record(device, work) -> Any:
  with wp.ScopedDevice(device), wp.ScopedCapture(device=device) as capture:
    work()
  return capture.graph


def load(body: Body):
  """Loads the modules of a step on a body's device, compiling them where the cache has none."""
  mine = [module.__name__ for module in (coupling, window_nodes, window_slots)]
  for module in (*step.modules(body), *mine):
    wp.load_module(module, device=body.device)
    wp.load_module(module, device="cpu")


def configure(w: Workspace, instance: int, texts: dict[str, str]):
  """Changes configuration keys while running.

  Raises:
    ValueError: a key may not change, or its value is not allowed.
  """
  before = w.config
  w.config = configuration.change(w.organ.name, before, texts, w.organ.mesh.closed)
  if w.resident:
    w.resident.stop()
  changed = {key for key in texts if getattr(before, key) != getattr(w.config, key)}
  if changed.intersection(configuration.MATERIAL):
    shape.change(w.body, w.organ.mesh, w.config, ~w.organ.free)
  else:
    shape.renumber(w.body, w.config)
  if changed.intersection(("integrator", "newton")):
    bind(w, w.model, instance)
  if changed.intersection(configuration.MATERIAL):
    refresh(w)
  else:
    _feel(w, mjstruct.Model.from_address(w.model))
  if w.place is not None:
    window.wake(w)


def sync(w: Workspace):
  """Brings a motion that is on a device into the plugin state."""
  if w.resident:
    w.resident.fetch()


def refresh(w: Workspace):
  """Renews the effective inertia after the time step or the material changed; see `inertia`."""
  m = mjstruct.Model.from_address(w.model)
  with _lock:
    if w.organ.windows is None:
      prepare.give_armature(m, w.organ, w.body, w.config)
    else:
      window.set_inertia(w, m)
    _feel(w, m)
    w.time_step = float(m.opt.timestep)
