"""Whose windows an mjModel holds: several mjData of a windowed model take turns.

Windows are in the mjModel: which triangles they have, and the inertia of their slots. A number of
the model that MuJoCo does not use, the inverse weight of an edge that no equality holds, is a mark
of them, which is copied and freed with the model. Every step leaves another mark: whoever finds the
one that it left finds its own windows; others put theirs there and look for contacts again.

Threads take turns too. Windows are read and written under a lock of the model. MuJoCo looks for
contacts without it, before the callback in which the mark is read: where another thread wrote
windows meanwhile, the mark has changed.
"""

import itertools
import math
import threading
import time
import weakref
from typing import Any

from ..model import mjstruct
from ..model.declare import Windows

_marks = map(float, itertools.count(time.time_ns() >> 10))  # never the same twice
_locks: weakref.WeakValueDictionary[int, Any] = weakref.WeakValueDictionary()  # by model address


def new_mark() -> float:
  """Returns a number that no other call returns."""
  return next(_marks)


def lock_of(model: int):
  """Returns the lock of a model, held while what mjData take turns in is read or written."""
  return _locks.setdefault(model, threading.RLock())


class Turn:
  """The part of one mjData in it, for one organ.

  Attributes:
    lock: held while the model's windows are read or written
    mark: of the windows that are this mjData's
    qpos, stood: numbers of qpos that the slots have, as bytes; after the last step, or None
  """

  def __init__(self):
    self.mark = math.nan
    self.stood: bytes | None = None
    self.qpos = memoryview(b"")
    self.lock: Any = threading.RLock()
    self._found: Any = memoryview(b"")

  def bind(self, model: int, windows: Windows):
    """Points at the mark and the lock of a model, or of a copy."""
    m = mjstruct.model(model)
    edge = int(m.flex_edgeadr[windows.flex])
    self._found = m.flexedge_invweight0[edge:].data
    self.lock = _locks.setdefault(model, self.lock)

  @property
  def mine(self) -> bool:
    """Whether the model holds this mjData's windows."""
    return self._found[0] == self.mark

  def take(self):
    """Leaves a mark on windows that were placed."""
    self._found[0] = self.mark = next(_marks)

  def end(self):
    """Leaves another mark after a step."""
    found, mark = self._found, next(_marks)
    # Where other data was stepped in between, both look for their windows again.
    self.mark = mark if found[0] == self.mark else math.nan
    found[0] = mark
