"""MuJoCo's window on an exercise, which shows what the laparoscope sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from palpate.app.console import has_display

from .scenes import CAMERA


def launch(physics, key: Callable[[int], None] | None = None) -> Any:
  """Returns a passive viewer, without panels.

  Args:
    physics: what it shows
    key: called with the GLFW number of a key that is pressed, in the window's thread

  Raises:
    RuntimeError: there is no display.
  """
  if not has_display():
    raise RuntimeError("no display to open a window on")
  import mujoco.viewer  # loads the window system

  model = physics.model.ptr
  viewer = mujoco.viewer.launch_passive(
    model, physics.data.ptr, key_callback=key, show_left_ui=False, show_right_ui=False
  )
  viewer.cam.type = mujoco.mjtCamera.mjCAMERA_FIXED
  viewer.cam.fixedcamid = model.camera(CAMERA).id
  return viewer
