"""How pictures are made where there is no screen."""

import ctypes.util
import os
import sys


def choose():
  """Sets MUJOCO_GL, unless it is set or there is a screen; MuJoCo reads it when imported."""
  if sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
    for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
      if ctypes.util.find_library(library):
        os.environ.setdefault("MUJOCO_GL", backend)
