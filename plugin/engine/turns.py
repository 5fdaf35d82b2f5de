"""Whose windows an mjModel holds: several mjData of a windowed model take turns.

Windows are in the mjModel: which triangles they have, and the inertia of their slots. A number of
the model that MuJoCo does not use, the inverse weight of an edge that no equality holds, is a mark
of them, which is copied and freed with the model. Every step leaves another mark: whoever finds the
one that it left finds its own windows.
"""

from __future__ import annotations

import itertools
import math
import threading
import time
import weakref
from typing import Any

import numpy as np

from . import mjstruct
from .declare import Windows

HOME = 0.0  # the mark of windows that stand where they were compiled
_marks = map(float, itertools.count(time.time_ns() >> 10))  # never the same twice
# Another thread has left a model alone so long after its last step, or, because it may be within
# one, after it last computed forces [s].
_PAUSE, _WITHIN = 0.05, 1.0
_LOOK = 0.005  # between looks; longer than others look for contacts [s]
_all: weakref.WeakSet[Turn] = weakref.WeakSet()


class Contested(RuntimeError):
  """Two threads step one mjModel."""


class Turn:
  """The part of one mjData in it, for one organ."""

  def __init__(self):
    self.mark = HOME
    self.model = 0  # address
    self.refused = False
    self._found: Any = memoryview(b"")
    self._thread, self._seen = 0, -math.inf
    self._within = self._waiting = False
    _all.add(self)

  def bind(self, model: int, windows: Windows):
    """Points at the mark of a model, or of a copy."""
    m = mjstruct.Model.from_address(model)
    self.model = model
    edge = int(mjstruct.view(m.flex_edgeadr, m.nflex, np.int32)[windows.flex[0]])
    self._found = mjstruct.view(m.flexedge_invweight0, m.nflexedge)[edge:].data

  @property
  def mine(self) -> bool:
    """Whether the model holds this mjData's windows."""
    return self._found[0] == self.mark

  def is_orphan(self) -> bool:
    """Returns whether nobody is left who has put the windows of the model where they stand."""
    return self.new or self._last() == 0

  def go_home(self):
    """Leaves the mark of windows that stand at home."""
    self._found[0] = HOME

  @property
  def new(self) -> bool:
    """Whether nobody has stepped the model, and its windows stand at home."""
    return self._found[0] == HOME

  def begin(self) -> bool:
    """Begins a step; returns whether the windows are this mjData's.

    Raises:
      Contested: another thread steps the same model.
    """
    self._thread, self._seen, self._within = threading.get_ident(), time.perf_counter(), True
    if self.mine and not self.new:
      return True
    elsewhere = not self.new and self._last() not in (0, self._thread)
    self._wait()
    if elsewhere:  # somebody else may be looking for contacts with the same thought
      time.sleep(_LOOK)
      self._wait()
    return self.mine

  def take(self):
    """Leaves a mark on windows that were placed."""
    self._found[0] = self.mark = next(_marks)

  def check(self):
    """Makes sure that no other thread has taken the windows within the step that ends.

    Raises:
      Contested: one has.
    """
    if not self.mine and self._last() not in (0, self._thread):
      self._refuse()

  def end(self):
    """Leaves another mark after a step."""
    mine = self.mine
    self._found[0] = mark = next(_marks)
    # Where this thread has stepped other data in between, both look for their windows again.
    if mine:
      self.mark = mark
    else:
      self.leave()
    self._seen, self._within = time.perf_counter(), False

  def is_free(self) -> bool:
    """Returns whether no other thread steps the model."""
    return self._rival() is None

  def leave(self):
    """Makes the next step look for its windows."""
    self.mark = math.nan

  def stand_back(self):
    """Waits while others step the model, for one that was refused it."""
    self._within = False
    while self._rival() is not None:
      time.sleep(_LOOK)

  def retire(self):
    """Leaves the models to others for good."""
    _all.discard(self)

  def _wait(self):
    """Waits until other threads have left the model; those that go on have it."""
    while (other := self._rival()) is not None:
      seen, self._waiting = other._seen, True
      time.sleep(_LOOK)
      self._waiting = False
      if other._seen != seen and other.model == self.model:
        self._refuse()

  def _rival(self) -> Turn | None:
    """Returns one in another thread that may step the model."""
    now, me = time.perf_counter(), threading.get_ident()
    for other in list(_all):
      if other is self or other.model != self.model or other._waiting or other._thread in (0, me):
        continue
      if now - other._seen < (_WITHIN if other._within else _PAUSE):
        return other
    return None

  def _last(self) -> int:
    """Returns the thread that left the mark, 0 for nobody who is alive."""
    mark = self._found[0]
    return next((o._thread for o in list(_all) if o is not self and o.mark == mark), 0)

  def _refuse(self):
    self.refused, self._within = True, False
    raise Contested(
      "two threads step one mjModel, which holds the windows; give each thread its own model "
      "(copy.copy(model))"
    )
