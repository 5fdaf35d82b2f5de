"""Calls of MuJoCo from inside a callback.

A MuJoCo error jumps to where its step was called, over Python's frames if there are any between.
"""

import _thread
from collections.abc import Callable
from typing import Any

from .model import mjstruct

# What says how many of something a constraint solver has.
_COUNTS = ("ncon", "ne", "nf", "nl", "nefc", "nJ", "nA", "nisland", "nidof")


def find_contacts(model: int, data: int):
  """Does the position stage of a step once more.

  Raises:
    RuntimeError: with MuJoCo's error message; the step then has no contacts.
  """
  d = mjstruct.Data.from_address(data)
  stack = d.pstack, d.pbase
  try:
    run(mjstruct.library().mj_fwdPosition, model, data)
  except RuntimeError:
    d.pstack, d.pbase = stack
    for name in _COUNTS:
      setattr(d, name, 0)
    raise


def run(function: Callable, *args):
  """Calls a function of MuJoCo's in a thread of its own, which after an error waits for ever.

  Raises:
    RuntimeError: with MuJoCo's error message.
  """
  lib = mjstruct.library()
  begin, done, never = (_thread.allocate_lock() for _ in range(3))
  results: list[str | None] = []

  def on_message(message: int):
    text = mjstruct.error_text(message)
    if text is None:
      mjstruct.LogHandler(lib._mjPRIVATE_getGlobalLogHandler())(message)
      return
    results.append(text)
    done.release()
    never.acquire()
    never.acquire()

  handler = mjstruct.LogHandler(on_message)

  def body():
    lib._mjPRIVATE_setTlsLogHandler(handler)
    begin.acquire()
    function(*args)
    results.append(None)
    done.release()

  begin.acquire()
  done.acquire()
  _thread.start_new_thread(body, ())
  _wait(begin, done, results)
  if results[0] is not None:
    raise RuntimeError(" ".join(results[0].split()))


def _wait(begin: Any, done: Any, results: list):
  """Lets a thread begin and waits for its result, even if a signal's handler raises meanwhile."""
  late = None
  while not results:
    try:
      if begin.locked():
        begin.release()
      while not results:
        done.acquire()
    except BaseException as error:
      late = error
  if late is not None:
    raise late
