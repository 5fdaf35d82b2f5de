"""The screen: whether there is one, and how to draw without.

OpenGL is loaded when a picture is asked for, not before: Mesa brings an LLVM that ends the process
where torch brings another one later. MuJoCo and dm_control load it as they are imported.
"""

import contextlib
import ctypes.util
import importlib
import os
import sys
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}  # what draws without a screen, by MUJOCO_GL


def has_display() -> bool:
  """Returns whether a window can be opened, as far as the environment tells."""
  if not sys.platform.startswith("linux"):
    return True
  return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def prepare_gl() -> None:
  """Imports MuJoCo so that it draws without a screen where there is none.

  Without a screen MUJOCO_GL is set, unless it is, to what draws, and MuJoCo draws so even where it
  was imported before. Where the variable was set, MuJoCo has then loaded what it says.
  """
  chosen = None
  if "MUJOCO_GL" not in os.environ and not has_display():
    chosen = next((name for name, lib in _LIBRARIES.items() if ctypes.util.find_library(lib)), None)
    if chosen:
      os.environ["MUJOCO_GL"] = chosen
  if "mujoco" in sys.modules and not chosen:
    return
  with _put_off() as backend:
    names = "mujoco", "mujoco.rendering.classic.gl_context"
    for module in [importlib.import_module(name) for name in names]:
      if backend:
        _bring(module, "GLContext", lambda: importlib.import_module(f"mujoco.{backend}").GLContext)


def import_dm_control() -> bool:
  """Imports dm_control so that it works with MuJoCo 4 and loads OpenGL only when it draws.

  Returns:
    whether it is installed
  """
  if sys.modules.get("dm_control._render"):
    return True
  try:
    importlib.import_module("dm_control")
  except ModuleNotFoundError:
    return False
  with _put_off() as backend:
    render: Any = importlib.import_module("dm_control._render")
    _drop_removed_sizes()
  if backend:
    render.BACKEND, render.USING_GPU = backend, backend == "egl"
    _bring(render, "Renderer", getattr(render, f"_import_{backend}"))
  return True


def _drop_removed_sizes() -> None:
  """Drops the fields that the installed MuJoCo no longer has from dm_control's table of sizes.

  dm_control 1.0.50 reads every array in that table. The table is the one of MuJoCo 3.17, of which
  4.0 has removed nine. Remove this function when dm_control has followed.
  """
  mujoco = importlib.import_module("mujoco")
  sizes = importlib.import_module("dm_control.mujoco.wrapper.mjbindings.sizes").array_sizes
  model = mujoco.MjModel.from_xml_string("<mujoco/>")
  for name, owner in (("mjmodel", model), ("mjdata", mujoco.MjData(model))):
    for field in [field for field in sizes[name] if not hasattr(owner, field)]:
      del sizes[name][field]


@contextlib.contextmanager
def _put_off() -> Iterator[str]:
  """Hides MUJOCO_GL from imports where it names what draws without a screen, and yields it."""
  backend = os.environ.get("MUJOCO_GL", "").lower().strip()
  if backend not in _LIBRARIES:
    yield ""
    return
  os.environ["MUJOCO_GL"] = "disabled"
  try:
    yield backend
  finally:
    os.environ["MUJOCO_GL"] = backend


def _bring(module: ModuleType, name: str, load: Callable[[], Any]) -> None:
  """Lets a module load an attribute when it is asked for (PEP 562)."""

  def find(asked: str) -> Any:
    if asked != name:
      raise AttributeError(f"module {module.__name__!r} has no attribute {asked!r}")
    setattr(module, name, load())
    return getattr(module, name)

  vars(module).pop(name, None)
  setattr(module, "__getattr__", find)  # noqa: B010, a module has none to assign to
