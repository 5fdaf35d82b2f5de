"""How several mjData have one mjModel whose triangles change, by windows that slide and by cuts.

MuJoCo reads the triangles of flexes in the mjModel several times in a step, without a lock, and
ends the step with an error where they have changed meanwhile. So each mjData has its own, which the
kernels of its organs read and write. As long as one thread makes and steps all mjData of an
mjModel, they are written there as well. Otherwise none writes there, as another thread may be in
MuJoCo: each finds its contacts again in the callback, with an mjModel that differs from the shared
one in its triangles.

Windows also write the inertia of their slots to the mjModel, and hold a lock of it from then until
contacts are found. A number that MuJoCo does not use, the inverse weight of an edge that no
equality holds, is a mark of them, which is copied and freed with the model. Every step leaves
another mark: whoever finds the one that it left finds its own windows; others put theirs there.
"""

import ctypes as C
import itertools
import math
import threading
import time
import weakref
from typing import Any

from . import flexes, mjstruct
from .declare import Windows

_marks = map(float, itertools.count(time.time_ns() >> 10))  # never the same twice


class _Users:
  """The mjData that change the triangles of an mjModel, and the last thread of each; its lock."""

  def __init__(self):
    self.lock = threading.RLock()
    self.thread: dict[int, int] = {}  # by data address


_users: weakref.WeakValueDictionary[int, _Users] = weakref.WeakValueDictionary()  # by model address


def new_mark() -> float:
  """Returns a number that no other call returns."""
  return next(_marks)


class Triangles:
  """The triangles of an mjData.

  Args:
    m: its mjModel
    data: its address

  Attributes:
    elem: as mjModel.flex_elem
  """

  def __init__(self, m: mjstruct.Struct, data: int):
    self.elem = m.flex_elem.copy()
    self._data, self._users, self._own = data, _Users(), mjstruct.Model()

  def join(self, model: int):
    """Says that the mjData changes the triangles of the mjModel that it has, maybe another now."""
    users = _users.setdefault(model, _Users())
    if users is not self._users:
      self.leave()
      self._users = users
    self.enter()

  def enter(self):
    """Says that the calling thread steps the mjData."""
    self._users.thread[self._data] = threading.get_ident()

  def leave(self):
    """Says that it has no model."""
    self._users.thread.pop(self._data, None)

  @property
  def lock(self) -> Any:
    """Held while what the mjData of the mjModel share is read or written."""
    return self._users.lock

  @property
  def alone(self) -> bool:
    """Whether no other thread reads those of the mjModel."""
    return len(set(self._users.thread.values())) == 1

  def model(self, model: int) -> int:
    """Returns the address of an mjModel like that at another one, with these triangles."""
    C.memmove(C.addressof(self._own), model, mjstruct.size(self._own))
    self._own.flex_elem = self.elem.ctypes.data
    return C.addressof(self._own)


_triangles: dict[int, Triangles] = {}  # by data address


def of(model: int, data: int) -> Triangles:
  """Returns the triangles of the mjData at an address."""
  m, found = mjstruct.model(model), _triangles.get(data)
  if found is None or found.elem.shape != m.flex_elem.shape:
    found = _triangles[data] = Triangles(m, data)
  return found


def forget(data: int):
  """Forgets an mjData that is freed."""
  found = _triangles.pop(data, None)
  if found is not None:
    found.leave()


class Turn:
  """The part of one mjData in the windows of an mjModel, for one organ.

  Attributes:
    lock: held while the model's windows are read or written
    mark: of the windows that are this mjData's
    qpos, stood: numbers of qpos that the slots have, as bytes; after the last step, or None
  """

  def __init__(self):
    self.mark = math.nan
    self.stood: bytes | None = None
    self.qpos = memoryview(b"")
    self._found: Any = memoryview(b"")

  def bind(self, model: int, triangles: Triangles, windows: Windows):
    """Points at the mark and the triangles of a model, or of a copy."""
    m = mjstruct.model(model)
    self._found = flexes.marks(m, windows.flex).data
    mine = slice(windows.elem_adr, windows.elem_adr + 3 * windows.elem_num)
    self._own, self._theirs = triangles.elem[mine], m.flex_elem[mine]
    self._triangles = triangles

  @property
  def lock(self) -> Any:
    """See `Triangles`."""
    return self._triangles.lock

  @property
  def mine(self) -> bool:
    """Whether the model holds this mjData's windows."""
    return self._found[0] == self.mark

  def take(self):
    """Leaves a mark on windows that were placed."""
    self._mark(mine=True)

  def end(self):
    """Leaves another mark after a step."""
    # Where other data was stepped in between, both look for their windows again.
    self._mark(mine=self.mine)

  def _mark(self, mine: bool):
    self._found[0] = mark = next(_marks)
    if self._triangles.alone:
      self._theirs[:] = self._own
    self.mark = mark if mine and self._triangles.alone else math.nan
