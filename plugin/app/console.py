"""What the subcommands share: one-line errors, Ctrl-C as a flag, a progress line, tables."""

from __future__ import annotations

import ctypes.util
import os
import signal
import sys
import time
from collections.abc import Iterable


class CommandError(Exception):
  """Ends the command with one line for people.

  Attributes:
    code: exit code; 2 for a wrong option or scene, 1 for what did not work
  """

  def __init__(self, message: str, code: int = 2):
    super().__init__(" ".join(message.split()))
    self.code = code


class Interrupt:
  """Makes Ctrl-C a flag while the block runs; a second Ctrl-C raises KeyboardInterrupt.

  So a step is never cut in half, and what was measured is kept.
  """

  def __init__(self):
    self.seen = False
    self._before = None

  def __enter__(self) -> Interrupt:
    self._before = signal.signal(signal.SIGINT, self._handle)
    return self

  def __exit__(self, *_):
    signal.signal(signal.SIGINT, self._before or signal.default_int_handler)

  def _handle(self, *_):
    if self.seen:
      raise KeyboardInterrupt
    self.seen = True


class Progress:
  """One line on standard error that is written over; silent unless people see it and the output."""

  def __init__(self, every: float = 0.1):
    self._on = sys.stdout.isatty() and sys.stderr.isatty()
    self._every = every
    self._next = 0.0

  def show(self, text: str, always: bool = False):
    """Shows the text, at most once in `every` seconds."""
    now = time.perf_counter()
    if self._on and (always or now >= self._next):
      self._next = now + self._every
      print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)

  def clear(self):
    """Takes the line away."""
    if self._on:
      print("\r\033[K", end="", file=sys.stderr, flush=True)


def table(rows: Iterable[tuple[str, str]]) -> str:
  """Returns the rows as two aligned columns."""
  rows = list(rows)
  left = max(len(name) for name, _ in rows)
  right = max(len(value) for _, value in rows)
  return "\n".join(f"{name:<{left}}  {value:>{right}}" for name, value in rows)


def has_display() -> bool:
  """Returns whether a window can be opened, as far as the environment tells."""
  if not sys.platform.startswith("linux"):
    return True
  return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def prepare_gl():
  """Chooses a way to render without a screen, unless MUJOCO_GL is set or there is a screen.

  MuJoCo reads the variable once, when it is imported.
  """
  if "MUJOCO_GL" in os.environ or has_display():
    return
  for backend, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
    if ctypes.util.find_library(library):
      os.environ["MUJOCO_GL"] = backend
      return
