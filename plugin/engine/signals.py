"""What reaches a callback from outside: exceptions of signals, the end of the process.

MuJoCo calls the plugin through ctypes, which drops exceptions; and a thread that is ended in a
callback takes the process with it.
"""

from __future__ import annotations

import _thread
import atexit
import ctypes as C
import functools
import signal
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator

_codes: set[types.CodeType] = set()  # of the callbacks
_MARK = "raised late"  # of an exception that came in a callback and is kept until after it
_late: list[BaseException] = []  # of the main thread
_late_in: dict[int, BaseException] = {}  # of another thread
_before: list = []  # handler of SIGINT while there are some
_raise_in_thread = C.pythonapi.PyThreadState_SetAsyncExc
_raise_in_thread.argtypes = [C.c_ulong, C.py_object]


def watch(callback: Callable) -> Callable:
  """Makes a function known as a callback of MuJoCo's; returns it."""
  _codes.add(callback.__code__)
  return callback


# Exceptions.


class _Bell:
  """Sends the main thread SIGINT when it is gone; no line of Python is run for that."""

  __del__ = staticmethod(_thread.interrupt_main)


def leave() -> object:
  """Returns what a callback has to return: ctypes drops it, and with that what is late is raised.

  Python looks for signals, and exceptions of other threads, between its instructions. From where
  ctypes drops what a callback returned the next instruction is one of MuJoCo's caller or of another
  callback, which does the same again.
  """
  if not (_late or _late_in):
    return None
  ident = threading.get_ident()
  if ident == threading.main_thread().ident:
    return _Bell() if _late else None
  error = _late_in.pop(ident, None)
  if error is None:
    return None
  # Python makes the exception from a class, where it is raised.
  kind = type(type(error).__name__, (type(error),), {"__new__": lambda _: error})
  ring = functools.partial(_raise_in_thread, ident, kind)
  return type("_Bell", (), {"__del__": staticmethod(ring)})()


def raise_later(error: BaseException):
  """Raises an exception in this thread as soon as that is in no callback, see `leave`."""
  vars(error)[_MARK] = True
  error.__traceback__ = None
  if threading.current_thread() is not threading.main_thread():
    _late_in[threading.get_ident()] = error
    return
  _late.append(error)
  if signal.getsignal(signal.SIGINT) is not _on_bell:
    _before[:] = [signal.getsignal(signal.SIGINT)]
    signal.signal(signal.SIGINT, _on_bell)


def _on_bell(number: int, frame: types.FrameType | None):
  """Raises what is late, once the main thread is in no callback."""
  if _is_inside(frame):
    return
  error = _late.pop(0) if _late else KeyboardInterrupt()
  if not _late:
    signal.signal(signal.SIGINT, _before[0] or signal.SIG_DFL)
  raise error


def is_foreign(error: BaseException) -> bool:
  """Returns whether a signal's handler raised an exception that a callback has caught."""
  if not isinstance(error, Exception) or _MARK in vars(error):
    return True
  handlers = set(_handlers())
  trace = error.__traceback__
  while trace is not None:
    if trace.tb_frame.f_code in handlers:
      return True
    trace = trace.tb_next
  return False


def _handlers() -> Iterator[types.CodeType]:
  """Yields the code of the signals' handlers."""
  for number in signal.valid_signals():
    handler = signal.getsignal(number)
    handler = getattr(handler, "func", handler)  # of functools.partial
    if not hasattr(handler, "__code__") and not hasattr(handler, "__func__"):
      handler = getattr(handler, "__call__", handler)  # noqa: B004
    code = getattr(getattr(handler, "__func__", handler), "__code__", None)
    if code is not None:
      yield code


def _is_inside(frame: types.FrameType | None) -> bool:
  """Returns whether a frame is in a callback."""
  while frame is not None and frame.f_code not in _codes:
    frame = frame.f_back
  return frame is not None


def _on_interrupt(number: int, frame: types.FrameType | None):
  """Raises KeyboardInterrupt, but not inside a callback."""
  if _is_inside(frame):
    raise_later(KeyboardInterrupt())
  else:
    signal.default_int_handler(number, frame)


@watch
def _on_unraisable(unraisable, before=sys.unraisablehook):
  """Takes what was raised in a callback before its first line, which is run then, or its last."""
  callback, error = unraisable.object, unraisable.exc_value
  code = getattr(callback, "__code__", None)
  if code not in _codes or error is None:
    return before(unraisable)
  known = error.__traceback__.tb_frame.f_locals
  begun = len(known) > code.co_argcount
  arguments = [] if begun else [known[name] for name in code.co_varnames[: code.co_argcount]]
  raise_later(error)
  if begun or "return" in callback.__annotations__:  # which is lost
    return leave()
  return callback(*arguments)


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
  sys.unraisablehook = _on_unraisable
  atexit.register(_park)
  if (
    threading.current_thread() is threading.main_thread()
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
  ):
    signal.signal(signal.SIGINT, _on_interrupt)
