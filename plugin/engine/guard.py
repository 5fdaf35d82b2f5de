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
_left = threading.Event()  # the last callback of a step, while somebody waits for it
_waiting = 0
_RETRY = 0.01  # after which a step may be over without one [s]
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


def raise_later(error: BaseException):
  """Raises an exception in this thread as soon as that is in no callback."""
  vars(error)[_MARK] = True
  error.__traceback__ = None
  if threading.current_thread() is threading.main_thread():
    _raise_by_signal(error)
  else:
    _raise_in(threading.get_ident(), error)


def raise_in_caller(error: BaseException):
  """Raises an exception where this callback's caller is; else in the main thread.

  The threads of `mujoco.rollout`, say, run for the main thread.
  """
  if isinstance(threading.current_thread(), threading._DummyThread):
    vars(error)[_MARK] = True
    _raise_in(threading.main_thread().ident or 0, error)
  else:
    raise_later(error)


def _raise_by_signal(error: BaseException):
  """Raises an exception in the main thread, from a signal's handler for the time being."""
  before, seen, raised = signal.getsignal(signal.SIGINT), threading.Event(), []

  def on_signal(number: int, frame: types.FrameType | None):
    seen.set()
    if not _is_inside(frame):
      signal.signal(signal.SIGINT, before or signal.SIG_DFL)
      raised.append(True)
      raise error

  def send():
    # One signal at a time: none may be left for the handler that was there before.
    while not raised:
      _wait_for_end()
      seen.clear()
      _thread.interrupt_main()
      seen.wait()

  signal.signal(signal.SIGINT, on_signal)
  threading.Thread(target=send, daemon=True).start()


def _raise_in(thread: int, error: BaseException):
  """Raises an exception in a thread; what comes out in a callback comes here again."""
  # Python makes the exception from a class, where it is raised.
  late = type(type(error).__name__, (type(error),), {"__new__": lambda _: error})

  def send():
    while _is_inside(sys._current_frames().get(thread)):
      _wait_for_end()
    _raise_in_thread(thread, late)

  _thread.start_new_thread(send, ())


def _is_inside(frame: types.FrameType | None) -> bool:
  """Returns whether a frame is in a callback."""
  while frame is not None and frame.f_code not in _codes:
    frame = frame.f_back
  return frame is not None


def _wait_for_end():
  """Waits until a step may have ended."""
  global _waiting
  _waiting += 1
  _left.clear()
  _left.wait(_RETRY)
  _waiting -= 1


def leave():
  """Notes that the last callback of a step ends."""
  if _waiting:
    _left.set()


def _on_interrupt(number: int, frame: types.FrameType | None):
  """Raises KeyboardInterrupt, but not inside a callback."""
  if _is_inside(frame):
    raise_later(KeyboardInterrupt())
  else:
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
