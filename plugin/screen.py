"""The screen: whether there is one, and how to draw without."""

from __future__ import annotations

import ctypes.util
import os
import sys


def has_display() -> bool:
  """Returns whether a window can be opened, as far as the environment tells."""
  if not sys.platform.startswith("linux"):
    return True
  return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def prepare_gl() -> None:
  """Chooses a way to draw without a screen, unless MUJOCO_GL is set or there is a screen.

  MuJoCo reads the variable once, when it is imported, and so does dm_control.
  """
  if "MUJOCO_GL" in os.environ or has_display():
    return
  for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
    if ctypes.util.find_library(library):
      os.environ["MUJOCO_GL"] = backend
      return
