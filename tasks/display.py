"""MuJoCo's window on an exercise."""

from __future__ import annotations

import atexit
import os
import sys
import threading
from typing import Any

from palpate.screen import has_display

_PATIENCE = 5.0  # for the window's thread to end [s]
# Modules that draw for MuJoCo, and what returns the present context.
_CURRENT = {
  "OpenGL.EGL": "eglGetCurrentContext",
  "OpenGL.osmesa": "OSMesaGetCurrentContext",
  "glfw": "get_current_context",
}
_drawn = False  # by this process
_lost = False  # whether a process that had drawn was forked into this one


def can_draw() -> bool:
  """Returns whether drawing does not wait for threads that a fork has left behind."""
  return not _lost


def check_drawing() -> None:
  """Notes that this process draws.

  Raises:
    RuntimeError: it cannot.
  """
  global _drawn
  if _lost:
    raise RuntimeError(
      "this process was forked from one that had drawn, and OpenGL does not survive that; start "
      "processes by 'forkserver' or 'spawn', such as vector_kwargs={'context': 'forkserver'} for "
      "gymnasium.make_vec(..., vectorization_mode='async'), or draw nothing before"
    )
  _drawn = True


def _look_for_contexts() -> None:
  """Notes before a fork what others have drawn."""
  global _drawn
  for name, current in _CURRENT.items():
    if name in sys.modules:
      _drawn = _drawn or bool(getattr(sys.modules[name], current)())


def _lose_contexts() -> None:
  global _lost
  _lost = _drawn


if hasattr(os, "register_at_fork"):
  os.register_at_fork(before=_look_for_contexts, after_in_child=_lose_contexts)


class Window:
  """MuJoCo's window on an exercise, without panels; it shows what the laparoscope sees."""

  def __init__(self, physics, camera: str):
    """Opens the window.

    Args:
      physics: what it shows
      camera: name of the camera that it looks through

    Raises:
      RuntimeError: there is no display.
    """
    if not has_display():
      raise RuntimeError("no display to open a window on")
    import mujoco.viewer  # loads the window system

    model = physics.model.ptr
    self.data, others = physics.data.ptr, set(threading.enumerate())
    self._handle: Any = mujoco.viewer.launch_passive(
      model, self.data, show_left_ui=False, show_right_ui=False
    )
    self._threads = set(threading.enumerate()) - others
    # Python must not end while the window's thread draws: MuJoCo then takes its library away.
    atexit.register(self.close)
    self._handle.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
    self._handle.cam.fixedcamid = model.camera(camera).id
    self._look = self._handle.opt.flags.copy(), self._handle.user_scn.flags.copy()

  def __enter__(self) -> Window:
    return self

  def __exit__(self, *_) -> None:
    self.close()

  def show(self) -> bool:
    """Shows the present state; returns whether the window is still open."""
    with self._handle.lock():  # most letters are switches of the viewer too
      self._handle.opt.flags[:], self._handle.user_scn.flags[:] = self._look
    self._handle.sync()
    return self._handle.is_running()

  def close(self) -> None:
    """Closes the window and waits for its thread."""
    atexit.unregister(self.close)
    self._handle.close()
    for thread in self._threads:
      thread.join(_PATIENCE)
