"""The engine plugin `palpate.organ`: registration with MuJoCo and its callbacks.

MuJoCo calls through ctypes, which drops exceptions, so every callback catches all of them: while a
model is compiled they become its error message, while it runs a MuJoCo warning and `Organ.error`.
"""

import atexit
import ctypes as C
import functools
import sys
from typing import Any

import mujoco
from palpate.tissue.config import KEYS

from ..forces.passive import Force
from . import change, contacts, coupling, rods, signals, workspace
from .bind import bind
from .cutting import cuts
from .layout import FLAG
from .model import declare, mjstruct, shared, skin, state_size
from .model.mjstruct import NAME, warn
from .windows import windowed
from .workspace import Workspace

if "register" in globals():
  raise ImportError(
    f"{__name__} cannot be loaded again, because MuJoCo calls the first copy; restart Python"
  )

_P = C.c_void_p
# MuJoCo's warnings of a state it then resets: of positions, velocities and accelerations.
_BAD = (
  int(mujoco.mjtWarning.mjWARN_BADQPOS),
  int(mujoco.mjtWarning.mjWARN_BADQVEL),
  int(mujoco.mjtWarning.mjWARN_BADQACC),
)


class _Plugin(C.Structure):
  """The mjpPlugin struct (mujoco/mjplugin.h), which MuJoCo's introspection data leaves out."""

  _fields_ = (
    ("name", C.c_char_p),
    ("nattribute", C.c_int),
    ("attributes", _P),
    ("capabilityflags", C.c_int),
    ("needstage", C.c_int),
    ("nstate", C.CFUNCTYPE(C.c_int, _P, C.c_int)),
    ("nsensordata", _P),
    ("init", C.CFUNCTYPE(C.c_int, _P, _P, C.c_int)),
    ("destroy", C.CFUNCTYPE(None, _P, C.c_int)),
    ("copy", C.CFUNCTYPE(None, _P, _P, _P, C.c_int)),
    ("reset", C.CFUNCTYPE(None, _P, _P, _P, C.c_int)),
    ("compute", C.CFUNCTYPE(None, _P, _P, C.c_int, C.c_int)),
    ("advance", C.CFUNCTYPE(None, _P, _P, C.c_int)),
    ("visualize", C.CFUNCTYPE(None, _P, _P, _P, _P, C.c_int)),
    ("actuator_act_dot", _P),
    ("sdf_distance", _P),
    ("sdf_gradient", _P),
    ("sdf_staticdistance", _P),
    ("sdf_attribute", _P),
    ("sdf_aabb", _P),
  )


# By address of the mjData and plugin instance.
_workspaces: dict[tuple[int, int], Workspace | rods.Workspace] = {}
_states: dict[int, Workspace | rods.Workspace] = {}  # by that of its numbers in plugin_state


def find(data: int, instance: int) -> Workspace:
  """Returns the workspace of plugin instance `instance` in the mjData at address `data`."""
  found = _workspaces[data, instance]
  assert isinstance(found, Workspace)
  return found


def find_thread(data: int, instance: int) -> rods.Workspace:
  """Returns the thread of plugin instance `instance` in the mjData at address `data`."""
  found = _workspaces[data, instance]
  assert isinstance(found, rods.Workspace)
  return found


def count() -> int:
  """Returns the number of organs in all mjData that there are."""
  if len(_workspaces) != len(_states):
    raise RuntimeError(f"{len(_workspaces)} workspaces, {len(_states)} states")
  return len(_workspaces)


def _windowed(model: mujoco.MjModel, data: mujoco.MjData) -> list[Workspace]:
  found = [_workspaces.get((data._address, i)) for i in range(model.nplugin)]
  return [w for w in found if isinstance(w, Workspace) and w.turn is not None]


def sync(model: mujoco.MjModel, data: mujoco.MjData):
  """Brings the motion of all organs into the plugin state, before it is read or saved."""
  for w in _windowed(model, data):
    workspace.sync(w)


def place_windows(model: mujoco.MjModel, data: mujoco.MjData):
  """Puts the windows where a plugin state that was set says; stepping does it by itself."""
  for w in _windowed(model, data):
    workspace.place(w, model._address)


# Callbacks.


@signals.watch
def _nstate(model: int, instance: int) -> int:
  try:
    return state_size.state_size(model, instance)
  except BaseException as error:
    _say(error)
    return 0


@signals.watch
def _init(model: int, data: int, instance: int) -> int:
  try:
    made = rods if declare.is_rod(mjstruct.model(model), instance) else workspace
    w = made.make(model, data, instance)
    _workspaces[data, instance] = _states[w.plugin_state.ctypes.data] = w
    if isinstance(w, Workspace):
      mine = [each for (of, _), each in _workspaces.items() if of == data]
      for each in workspace.join([each for each in mine if isinstance(each, Workspace)]):
        bind(each, each.model)
    return 0
  except BaseException as error:
    _say(error)
  return -1


@signals.watch
def _destroy(data: int, instance: int):
  w = _workspaces.pop((data, instance), None)
  contacts.forget(data)
  coupling.forget(data)
  shared.forget(data)
  for state in [s for s, other in _states.items() if other is w]:
    del _states[state]


@signals.watch
def _copy(data: int, model: int, source: int, instance: int):
  w, other = _workspaces[data, instance], _workspaces[source, instance]
  try:
    if isinstance(w, Workspace) and isinstance(other, Workspace):
      change.copy(w, model, other, functools.partial(_twin, data))
  except BaseException as error:
    _fail(w, error)
  return signals.leave()


def _twin(data: int, force: Force) -> tuple[Workspace, Force]:
  """Returns the workspace and the force of an mjData for a force of another one."""
  w = find(data, force.host.instance)
  return w, w.forces.of(type(force))


@signals.watch
def _reset(model: int, state: int, unused: int | None, instance: int):
  m = mjstruct.model(model)
  size = int(m.plugin_statenum[instance])
  mjstruct.view(state, size)[:] = 0
  w = _states.get(state)  # mjData.plugin_data, the other argument, is copied by pickle
  if w is not None:
    w.forget()
    w.report.nbad = 0
  if isinstance(w, Workspace):
    w.attachments.put([group for group in w.attachments.groups if group.by])
    w.bonds.let_go()
  return signals.leave()


@signals.watch
def _compute(model: int, data: int, instance: int, capability: int):
  w = _workspaces[data, instance]
  try:
    _push(w, model)
  except BaseException as error:
    _fail(w, error)
  return signals.leave()


def _push(w: Workspace | rods.Workspace, model: int):
  """Adds the passive force."""
  signals.enter()
  if isinstance(w, rods.Workspace):
    if not w.seen.identity.is_of(model):
      w.bind(model)
  else:
    workspace.attach(w, model)
  if _count_bad(w) > w.report.nbad:
    _find_bad_state(w)
  w.run()
  if isinstance(w, Workspace) and w.seen.status[3]:
    w.note(f"the {w.config.integrator} step has no finite solution: the motion diverged")


@signals.watch
def _advance(model: int, data: int, instance: int):
  w = _workspaces[data, instance]
  try:
    _end(w)
  except BaseException as error:
    _fail(w, error)
  return signals.leave()


def _end(w: Workspace | rods.Workspace):
  """Ends the step, and looks at what came of it."""
  w.step()
  if isinstance(w, rods.Workspace):
    return
  if w.cuts:
    w.cuts.hide(w.model)
  if any(each and each.open(cuts.Opening(w)) for each in w.opens):
    workspace.place(w, w.model)
  nodes, triangles = w.report.flags[FLAG.missed_nodes], w.report.flags[FLAG.missed_elements]
  if nodes > w.report.missed[0] or triangles > w.report.missed[1]:
    _miss(w, int(nodes), int(triangles))
  if w.report.flags[FLAG.coarse] > 0:
    _tell_coarse(w)
  if w.seen.model_step[0] != w.seen.time_step:
    workspace.refresh(w)
  if w.report.watch.due(w.report.flags[FLAG.fast]) and not (w.asleep or w.graphs.resident):
    _watch(w)


@signals.watch
def _visualize(model: int, data: int, option: int, scene: int, instance: int):
  w = _workspaces[data, instance]
  try:
    if isinstance(w, Workspace):
      _draw(w, model, data)
  except BaseException as error:
    _fail(w, error)
  return signals.leave()


def _draw(w: Workspace, model: int, data: int):
  if w.cuts:
    cuts.follow(w)
    w.cuts.show(drawn=True)
  if w.organ.windows:
    windowed.draw(w, model, data)
  if w.cuts:
    w.cuts.draw(w.organ, w.motion()[0], model, data)
  if w.skin is not None:
    _draw_skin(w, model, data)


def _draw_skin(w: Workspace, model: int, data: int):
  whole = w.organ.mesh.uncut is None
  if w.cuts:  # a skin knows of no cut: the organ's own surface is drawn then
    skin.show(w, model, shown=whole)
  if whole:
    skin.draw(w, model, data)


# What went wrong.


def _count_bad(w: Workspace | rods.Workspace) -> int:
  warned = w.seen.warning  # last index and count of each
  return warned[2 * _BAD[0] + 1] + warned[2 * _BAD[1] + 1] + warned[2 * _BAD[2] + 1]


def _find_bad_state(w: Workspace | rods.Workspace):
  """Makes an error of what MuJoCo warned of, and has reset since, if it is in this organ's dofs."""
  w.report.nbad = _count_bad(w)
  organ = w.organ
  names = ("position (qpos", "velocity (qvel", "acceleration (qacc")
  for kind, name, own in zip(_BAD, names, (organ.qposs, organ.dofs, organ.dofs), strict=True):
    index, count = w.seen.warning[2 * kind : 2 * kind + 2]
    if count and index in own:
      w.note(f"{name} {index}) is not finite or huge; the motion diverged")


def _say(error: BaseException):
  """Makes the error message of a model that does not compile."""
  if not isinstance(error, Exception):
    signals.raise_later(error)
  warn(str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}")


def _fail(w: Workspace | rods.Workspace, error: BaseException):
  """Makes an error of an exception in a callback, whose step is not whole."""
  if isinstance(error, Exception):
    w.note(f"{type(error).__name__}: {error}")
  else:
    _interrupt(w, error)


def _interrupt(w: Workspace | rods.Workspace | None, error: BaseException):
  """Makes an error of what a signal's handler raised, and raises that after the callback."""
  signals.raise_later(error)
  if w is not None:
    w.note(f"a step was interrupted by {type(error).__name__}; reset the data or set a state")


@signals.watch
def _on_unraisable(unraisable: Any, before: Any = sys.unraisablehook):
  """Takes what a signal's handler raised at the first or last instruction of a callback."""
  trace = unraisable.exc_traceback
  if trace is None or not signals.is_callback(trace.tb_frame.f_code):
    return before(unraisable)
  known = trace.tb_frame.f_locals
  _interrupt(_workspaces.get((known.get("data"), known.get("instance"))), unraisable.exc_value)
  return signals.leave()


def _watch(w: Workspace):
  """Warns of tools that have come through the surface, and of tetrahedra that stay inside out."""
  if stuck := w.report.watch.stuck(w):
    warn(
      f"organ {w.organ.name!r}: {stuck} of {len(w.organ.mesh.tet)} tetrahedra are inside out and "
      "do not recover: the tissue is crushed or was placed so; a smaller time step, newton of 2 or "
      "3 or a greater young may keep them from it, a reset puts them right"
    )
  for geom in w.report.watch.look(w):
    m = mjstruct.model(w.model)
    name = mjstruct.name_of(m, "geom", geom) or geom
    warn(
      f"organ {w.organ.name!r}: geom {name!r} has gone through its surface, where contacts do not "
      "hold it any more; see Organ.pierced"
    )


def _tell_coarse(w: Workspace):
  """Warns, once, of a tool that is too small for the mesh."""
  edge, w.report.flags[FLAG.coarse] = 1e-6 * w.report.flags[FLAG.coarse], -1
  warn(
    f"organ {w.organ.name!r}: a tool touches it whose radius is under a twentieth of an edge of "
    f"its triangles, so that forces depend on where it meets them; edges of {1e3 * edge:.2g} mm "
    "would do"
  )


def _miss(w: Workspace, nodes: int, triangles: int):
  """Keeps the most that the windows had no room for, and warns the first time."""
  first = w.report.missed == (0, 0)
  w.report.missed = max(nodes, w.report.missed[0]), max(triangles, w.report.missed[1])
  if first:
    warn(windowed.shortage(w) or "")


@functools.cache
def register() -> int:
  """Registers the plugin with MuJoCo, once a process; returns its slot."""
  mjstruct.check()
  contacts.are_wrong()  # compiles a model, which cannot be done while another is, or in a callback
  lib = mjstruct.library()
  slot = C.c_int(-1)
  if lib.mjp_getPlugin(NAME.encode(), C.byref(slot)):
    raise ImportError(
      f"{__name__}: another copy of the package has registered {NAME!r} in this process; import it "
      "under one name"
    )
  plugin = _Plugin()
  lib.mjp_defaultPlugin(C.byref(plugin))
  keys = [key.encode() for key in KEYS]
  attributes = (C.c_char_p * len(keys))(*keys)
  plugin.name = NAME.encode()
  plugin.nattribute = len(keys)
  plugin.attributes = C.cast(attributes, _P)
  plugin.capabilityflags = int(mujoco.mjtPluginCapabilityBit.mjPLUGIN_PASSIVE)
  fields: dict[str, Any] = dict(_Plugin._fields_)  # pyright: ignore
  for field, function in (
    ("nstate", _nstate),
    ("init", _init),
    ("destroy", _destroy),
    ("copy", _copy),
    ("reset", _reset),
    ("compute", _compute),
    ("advance", _advance),
    ("visualize", _visualize),
  ):
    setattr(plugin, field, fields[field](function))
  number = lib.mjp_registerPlugin(C.byref(plugin))
  if number < 0:
    raise ImportError(f"palpate: MuJoCo did not accept the plugin {NAME!r} (slot {number})")
  _keep.append((plugin, attributes))
  atexit.register(_let_go, number)
  sys.unraisablehook = _on_unraisable
  signals.install()
  return number


def _let_go(slot: int):
  """Lets mjData that outlives Python's modules be freed without calling back into them."""
  registered = _Plugin.from_address(mjstruct.library().mjp_getPluginAtSlot(slot))
  registered.destroy = type(registered.destroy)()


_keep: list = []  # MuJoCo keeps pointers into these
