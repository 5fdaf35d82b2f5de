"""The engine plugin `palpate.organ`: registration with MuJoCo and its callbacks.

MuJoCo calls through ctypes, which drops exceptions, so every callback catches all of them: while a
model is compiled they become its error message, while it runs a MuJoCo warning and `Organ.error`.
"""

from __future__ import annotations

import _thread
import atexit
import ctypes as C
import functools
import itertools
import signal
import threading
import types
from typing import Any

import mujoco
import numpy as np
from palpate.tissue.config import KEYS

from . import mjstruct, windowed, workspace
from .layout import FLAG
from .workspace import Workspace

NAME = "palpate.organ"

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
    ("copy", _P),
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


_workspaces: dict[tuple[int, int], Workspace] = {}  # by address of the mjData and plugin instance
_handles: dict[int, Workspace] = {}  # by the number kept in mjData.plugin_data
_next_handle = itertools.count(1)


def find(data: int, instance: int) -> Workspace:
  """Returns the workspace of plugin instance `instance` in the mjData at address `data`."""
  return _workspaces[data, instance]


def _windowed(model: mujoco.MjModel, data: mujoco.MjData) -> list[Workspace]:
  found = [_workspaces.get((data._address, i)) for i in range(model.nplugin)]
  return [w for w in found if w is not None and w.place is not None]


def sync(model: mujoco.MjModel, data: mujoco.MjData):
  """Brings the motion of all organs into the plugin state, before it is read or saved."""
  for w in _windowed(model, data):
    workspace.sync(w)


def place_windows(model: mujoco.MjModel, data: mujoco.MjData):
  """Puts the windows where a plugin state that was set says; stepping does it by itself."""
  for w in _windowed(model, data):
    workspace.place(w)


def warn(text: str):
  """Issues a MuJoCo warning."""
  mjstruct.library().mju_warning(b"%s", f"{NAME}: {text}".encode())


def _nstate(model: int, instance: int) -> int:
  try:
    return workspace.state_size(model, instance)
  except Exception as error:
    warn(repr(error))
    return 0


def _init(model: int, data: int, instance: int) -> int:
  try:
    w = workspace.make(model, data, instance)
    handle = next(_next_handle)
    d = mjstruct.Data.from_address(data)
    mjstruct.view(d.plugin_data, d.nplugin, np.uintp)[instance] = handle
    _workspaces[data, instance] = _handles[handle] = w
    return 0
  except ValueError as error:
    warn(str(error))
  except Exception as error:
    warn(f"{type(error).__name__}: {error}")
  return -1


def _destroy(data: int, instance: int):
  w = _workspaces.pop((data, instance), None)
  for handle in [h for h, other in _handles.items() if other is w]:
    del _handles[handle]


def _reset(model: int, state: int, data: int | None, instance: int):
  m = mjstruct.Model.from_address(model)
  size = int(mjstruct.view(m.plugin_statenum, m.nplugin, np.int32)[instance])
  mjstruct.view(state, size)[:] = 0
  w = _handles.get(data or 0)
  if w is not None:
    w.error, w.nbad = None, 0


def _compute(model: int, data: int, instance: int, capability: int):
  w = _workspaces[data, instance]
  try:
    if w.model != model:
      workspace.bind(w, model, instance)
    if _count_bad(w) > w.nbad:
      _find_bad_state(w)
    w.run()
  except Exception as error:
    _fail(w, f"{type(error).__name__}: {error}")
  if w.status[3]:
    _fail(w, "the implicit step has no finite solution: the motion diverged")


def _count_bad(w: Workspace) -> int:
  warned = w.warning  # last index and count of each
  return warned[2 * _BAD[0] + 1] + warned[2 * _BAD[1] + 1] + warned[2 * _BAD[2] + 1]


def _find_bad_state(w: Workspace):
  """Makes an error of what MuJoCo warned of, and has reset since, if it is in this organ's dofs."""
  w.nbad = _count_bad(w)
  organ = w.organ
  names = ("position (qpos", "velocity (qvel", "acceleration (qacc")
  for kind, name, own in zip(_BAD, names, (organ.qposs, organ.dofs, organ.dofs), strict=True):
    index, count = w.warning[2 * kind : 2 * kind + 2]
    if count and index in own:
      _fail(w, f"{name} {index}) is not finite or huge; the motion diverged")


def _fail(w: Workspace, text: str):
  if w.error is None:
    w.error = f"organ {w.organ.name!r}: {text}"
    warn(w.error)


def _advance(model: int, data: int, instance: int):
  w = _workspaces[data, instance]
  try:
    w.step()
    if w.overflow is None and (w.flags[FLAG.missed_nodes] or w.flags[FLAG.missed_elements]):
      _overflow(w)
    if w.model_step[0] != w.time_step:
      workspace.refresh(w)
  except Exception as error:
    _fail(w, f"{type(error).__name__}: {error}")


def _overflow(w: Workspace):
  """Says, once, that a window is too small."""
  nodes, triangles = int(w.flags[FLAG.missed_nodes]), int(w.flags[FLAG.missed_elements])
  what = f"{triangles} triangles between their nodes; give them more elements"
  if nodes:
    what = f"{nodes} nodes that tools touch and keep the deepest; give them more vertices"
  w.overflow = f"organ {w.organ.name!r}: its windows have no room for {what}"
  warn(w.overflow)


def _visualize(model: int, data: int, option: int, scene: int, instance: int):
  w = _workspaces[data, instance]
  try:
    if w.organ.windows:
      windowed.draw(w, model, data)
  except Exception as error:
    _fail(w, f"{type(error).__name__}: {error}")


def _on_interrupt(number: int, frame: types.FrameType | None):
  """Raises KeyboardInterrupt, but not inside a callback, where ctypes would drop it."""
  here = frame
  while here is not None:
    if here.f_code in _codes:
      threading.Timer(0.001, _thread.interrupt_main).start()
      return
    here = here.f_back
  signal.default_int_handler(number, frame)


@functools.cache
def register() -> int:
  """Registers the plugin with MuJoCo, once a process; returns its slot."""
  mjstruct.check()
  lib = mjstruct.library()
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
    ("reset", _reset),
    ("compute", _compute),
    ("advance", _advance),
    ("visualize", _visualize),
  ):
    setattr(plugin, field, fields[field](function))
    _codes.add(function.__code__)
  slot = lib.mjp_registerPlugin(C.byref(plugin))
  if slot < 0:
    raise ImportError(f"palpate: MuJoCo did not accept the plugin {NAME!r} (slot {slot})")
  _keep.append((plugin, attributes))
  atexit.register(_let_go, slot)
  if (
    threading.current_thread() is threading.main_thread()
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
  ):
    signal.signal(signal.SIGINT, _on_interrupt)
  return slot


def _let_go(slot: int):
  """Lets mjData that outlives Python's modules be freed without calling back into them."""
  registered = _Plugin.from_address(mjstruct.library().mjp_getPluginAtSlot(slot))
  registered.destroy = type(registered.destroy)()


_keep: list = []  # MuJoCo keeps pointers into these
_codes: set[types.CodeType] = set()  # of the callbacks
