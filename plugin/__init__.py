"""Palpate: soft-tissue simulation for MuJoCo.

`import palpate` registers the engine plugin `palpate.organ`; a `<flexcomp>` that declares it in
MJCF is then a deformable organ in `mujoco.mj_step` and everything that is built on it.
"""

import importlib as _importlib
import os as _os
import sys as _sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
  from .authoring import add_organ
  from .needle import add_needle
  from .organ import Organ
  from .skins import add_skin
  from .spares import add_spare
  from .thread import Thread, add_thread
  from .windows import add_windows

__all__ = [
  "Organ", "Thread", "__version__", "add_needle", "add_organ", "add_skin", "add_spare",
  "add_thread", "add_windows", "register",
]  # fmt: skip
__version__ = "0.2.0"
# Modules of what `register` brings, and of what comes when it is asked for.
_BROUGHT = {
  "Organ": "organ", "add_skin": "skins", "add_spare": "spares", "add_windows": "windows",
}  # fmt: skip
_LATER = {
  "add_needle": "needle", "add_organ": "authoring", "add_thread": "thread", "Thread": "thread",
}  # fmt: skip
_PACKAGES = ("batch", "models", "tasks")


def register() -> int:
  """Registers the plugin with MuJoCo, once a process; returns its slot.

  `import palpate` does it, except in the `palpate` command, whose help needs neither MuJoCo nor
  Warp. Where there is no screen and MUJOCO_GL is not set, it is set to what draws without one;
  MuJoCo reads it when it is imported. From here on Warp speaks of warnings and errors only;
  `warp.config.log_level` changes it.
  """
  from . import screen

  screen.prepare_gl()  # before MuJoCo is imported
  from .engine import plugin
  from .tissue import device

  if "Organ" not in globals():
    for name, module in _BROUGHT.items():
      globals()[name] = getattr(_importlib.import_module(f".{module}", __name__), name)
    device.lower_log_level()
  return plugin.register()


def __getattr__(name: str):
  """Brings what is asked for first: packages, what writes scenes, and in the command all."""
  if name in _BROUGHT:
    register()
    return globals()[name]
  if name in _PACKAGES:
    return _importlib.import_module(f".{name}", __name__)
  if name not in _LATER:
    raise AttributeError(f"module 'palpate' has no attribute {name!r}")
  return getattr(_importlib.import_module(f".{_LATER[name]}", __name__), name)


def _is_command() -> bool:
  """Returns whether this interpreter was started as `palpate` or `python -m palpate`."""
  program = _os.path.basename(_sys.argv[0]) if _sys.argv else ""
  if program == "-m":  # the package is being imported to be run
    words = _sys.orig_argv
    return words[words.index("-m") + 1] == "palpate" if "-m" in words[:-1] else False
  return _os.path.splitext(program)[0] in ("palpate", "palpate-script")


if not _is_command():
  register()
