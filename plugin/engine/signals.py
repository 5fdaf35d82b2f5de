"""Ctrl-C during a step, and the end of the process while threads step.

MuJoCo calls the plugin through ctypes, which drops exceptions; and a thread that is ended in a
callback takes the process with it.
"""

import _thread
import atexit
import contextlib
import signal
import threading
import time
import types
from collections.abc import Callable, Iterator

_codes: set[types.CodeType] = set()  # of the callbacks
_late: list[BaseException] = []  # what the main thread raises when it has left its callback
_before: list = []  # the handler of SIGINT that ours replaces until then


def watch(callback: Callable) -> Callable:
  """Makes a function known as a callback of MuJoCo's; returns it."""
  _codes.add(callback.__code__)
  return callback


def is_callback(code: types.CodeType) -> bool:
  """Returns whether this is the code of a callback."""
  return code in _codes


# Exceptions.


class _Bell:
  """Sends the main thread SIGINT when it is gone; no line of Python is run for that."""

  __del__ = staticmethod(_thread.interrupt_main)


def leave() -> object:
  """Returns what a callback has to return: ctypes drops it, and `_on_interrupt` is called then.

  Python looks for signals between its instructions: the next one is of MuJoCo's caller, or of
  another callback, which does the same again.
  """
  return _Bell() if _late and threading.current_thread() is threading.main_thread() else None


def raise_later(error: BaseException):
  """Raises an exception in the main thread as soon as that is in no callback, see `leave`."""
  if threading.current_thread() is not threading.main_thread():
    return
  error.__traceback__ = None
  _late[:] = [error]
  if signal.getsignal(signal.SIGINT) is not _on_interrupt:
    _before[:] = [signal.signal(signal.SIGINT, _on_interrupt) or signal.SIG_DFL]


def _on_interrupt(number: int, frame: types.FrameType | None):
  """Raises what is late, or KeyboardInterrupt, once the main thread is in no callback."""
  while frame is not None:
    if frame.f_code in _codes:
      _late[:] = _late or [KeyboardInterrupt()]
      return
    frame = frame.f_back
  if _before:
    signal.signal(signal.SIGINT, _before.pop())
  raise _late.pop() if _late else KeyboardInterrupt()


@contextlib.contextmanager
def deferred() -> Iterator[None]:
  """Lets handlers of signals wait until what is inside is done: half a cut is no organ."""
  if threading.current_thread() is not threading.main_thread():
    yield
    return
  found = {number: signal.getsignal(number) for number in signal.valid_signals()}
  handlers = {number: handler for number, handler in found.items() if callable(handler)}
  came: list[int] = []
  try:
    for number in handlers:
      signal.signal(number, lambda number, _: came.append(number))
    yield
  finally:
    _restore(handlers)
    for number in dict.fromkeys(came):
      signal.raise_signal(number)


def _restore(handlers: dict):
  """Puts handlers back, whatever one of them raises meanwhile."""
  while handlers:
    number, handler = handlers.popitem()
    try:
      signal.signal(number, handler)
    except BaseException:
      _restore(handlers)
      raise


# The end of the process.

_ending = False
_LAST = 1.0  # a thread that has called back within this time may do so again [s]
_called: dict[int, float] = {}  # thread -> when it last did
_parked: set[int] = set()


def enter():
  """Notes that a thread is in a callback; keeps it there for ever once the process ends.

  Where the interpreter is gone, a thread that wants to go on is ended in MuJoCo's frames.
  """
  ident = threading.get_ident()
  _called[ident] = time.perf_counter()
  if _ending and ident != threading.main_thread().ident:
    _parked.add(ident)
    lock = _thread.allocate_lock()
    lock.acquire()
    lock.acquire()


def _park():
  """Waits until all threads that step an organ are in a callback, and leaves them there."""
  global _ending
  _ending = True
  me, start = threading.get_ident(), time.perf_counter()
  while time.perf_counter() - start < _LAST:
    late = start - _LAST
    if all(i in _parked for i, t in _called.items() if t > late and i != me):
      return
    time.sleep(0.001)


def install():
  """Looks after signals and the end of the process; once a process."""
  atexit.register(_park)
  if (
    threading.current_thread() is threading.main_thread()
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
  ):
    signal.signal(signal.SIGINT, _on_interrupt)
