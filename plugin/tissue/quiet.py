"""Starts Warp without its greeting, without a line for every module, and without a word on CUDA.

A machine without an NVIDIA driver is an ordinary place to run; Warp's library says so on standard
error whatever the log level is. `palpate doctor` lists the devices.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import tempfile

import warp as wp

_DRIVER = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
_NO_DRIVER = "Could not find or load the NVIDIA CUDA driver"


def lower_log_level():
  """Lets Warp speak of warnings and errors only, unless a level other than its default was set."""
  if wp.config.log_level == wp.LOG_INFO:
    wp.config.log_level = wp.LOG_WARNING


@functools.cache
def init():
  """Initialises Warp, once a process."""
  try:
    ctypes.CDLL(_DRIVER)
  except OSError:
    _init_without_driver()
  else:
    wp.init()


def _init_without_driver():
  sys.stderr.flush()
  kept = os.dup(2)
  with tempfile.TemporaryFile() as heard:
    os.dup2(heard.fileno(), 2)
    try:
      wp.init()
    finally:
      sys.stderr.flush()
      os.dup2(kept, 2)
      os.close(kept)
      heard.seek(0)
      for line in heard.read().decode(errors="replace").splitlines():
        if _NO_DRIVER not in line:
          print(line, file=sys.stderr)
