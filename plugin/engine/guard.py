"""What reaches a callback from outside: exceptions of signals, the end of the process.

MuJoCo calls the plugin through ctypes, which drops exceptions; and a thread that is ended in a
callback takes the process with it.
"""

from __future__ import annotations

import _thread
import atexit
import ctypes as C
import signal
import sys
import threading
import time
import types
from collections.abc import Callable, Iterator

_codes: set[types.CodeType] = set()  # of the callbacks
_MARK = "raised late"  # of such an exception
_late: list[BaseException] = []  # to be raised
_left = threading.Event()  # the last callback of a step, while there are such
_RETRY = 0.01  # after which that is tried anyway [s]
_raise_in_thread = C.pythonapi.PyThreadState_SetAsyncExc
_raise_in_thread.argtypes = [C.c_ulong, C.py_object]


def watch(callback: Callable) -> Callable:
  """Makes a function known as a callback of MuJoCo's; returns it."""
  _codes.add(callback.__code__)
  return callback


# Exceptions.


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


def raise_later(error: BaseException, thread: int | None = None):
  """Raises an exception in a thread as soon as that is in no callback.

  Args:
    error: the exception, this very object
    thread: identifier of the thread; None for this one
  """
  _late.append(error)
  vars(error)[_MARK] = True
  error.__traceback__ = None
  ident = threading.get_ident() if thread is None else thread
  # Python makes the exception from a class, in the thread where it is raised.
  late = type(type(error).__name__, (type(error),), {"__new__": lambda _: error})
  _thread.start_new_thread(_raise_when_out, (error, late, ident))


def raise_in_caller(error: BaseException):
  """Raises an exception where this callback's caller is; else in the main thread.

  The threads of `mujoco.rollout`, say, run for the main thread.
  """
  here = threading.current_thread()
  foreign = isinstance(here, threading._DummyThread)
  raise_later(error, threading.main_thread().ident if foreign else here.ident)


def _raise_when_out(error: BaseException, late: type, thread: int):
  while True:
    _left.clear()
    _left.wait(_RETRY)
    frame = inner = sys._current_frames().get(thread)
    while frame is not None and frame.f_code not in _codes:
      frame = frame.f_back
    if frame is None:
      break
  _late[:] = [each for each in _late if each is not error]
  if inner is not None:  # the thread has not ended
    _raise_in_thread(thread, late)


def leave():
  """Notes that the last callback of a step ends."""
  if _late:
    _left.set()


def _on_interrupt(number: int, frame: types.FrameType | None):
  """Raises KeyboardInterrupt, but not inside a callback."""
  here = frame
  while here is not None:
    if here.f_code in _codes:
      raise_later(KeyboardInterrupt())
      return
    here = here.f_back
  signal.default_int_handler(number, frame)


@watch
def _on_unraisable(unraisable, before=sys.unraisablehook):
  """Takes what was raised in a callback before its first line."""
  code = getattr(unraisable.object, "__code__", None)
  if code in _codes and unraisable.exc_value is not None:
    raise_later(unraisable.exc_value)
  else:
    before(unraisable)


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
    time.sleep(_RETRY)


def install():
  """Looks after signals and the end of the process; once a process."""
  sys.unraisablehook = _on_unraisable
  atexit.register(_park)
  if (
    threading.current_thread() is threading.main_thread()
    and signal.getsignal(signal.SIGINT) is signal.default_int_handler
  ):
    signal.signal(signal.SIGINT, _on_interrupt)
