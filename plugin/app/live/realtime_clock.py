"""Keeps a loop in time, and tells how well."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import itertools
import os
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

_BIN = 10e-6  # of the histogram [s]
_BINS = 5000
_EDGES = (0, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000, 20000)  # of what is shown [us]
_LOST = 0.1  # a loop that is so late goes on from there, it does not hurry after [s]
_SLACK = 29  # PR_SET_TIMERSLACK


class Lateness:
  """How late the steps of a loop began.

  Attributes:
    steps: how many there were
    missed: those that had not ended when the next one was due
    worst: latest beginning [s]
    skipped: time that was given up after long waits [s]
    work: time in the steps, all together [s]
  """

  def __init__(self):
    self._counts = [0] * (_BINS + 1)
    self.steps, self.missed = 0, 0
    self.worst, self.skipped, self.work = 0.0, 0.0, 0.0

  def add(self, late: float) -> None:
    """Counts a step that began `late` [s]."""
    self._counts[min(int(late / _BIN), _BINS) if late > 0 else 0] += 1
    self.steps += 1
    if late > self.worst:
      self.worst = late

  @property
  def on_time(self) -> float:
    """Share of the steps that ended before the next one was due."""
    return 1.0 - self.missed / max(self.steps, 1)

  def percentile(self, share: float) -> float:
    """Returns the lateness that a share of the steps, in [0, 1], is below [s]."""
    total = np.cumsum(self._counts)
    return _BIN * (int(np.searchsorted(total, share * total[-1])) + 1) if self.steps else 0.0

  def histogram(self) -> list[tuple[float, float, int]]:
    """Returns rows of lower and upper edge [s] and number of steps."""
    counts = np.array(self._counts)
    edges = [round(e * 1e-6 / _BIN) for e in _EDGES] + [_BINS + 1]
    return [
      (_BIN * a, _BIN * b if b <= _BINS else float("inf"), int(counts[a:b].sum()))
      for a, b in itertools.pairwise(edges)
    ]

  def summary(self) -> dict[str, Any]:
    """Returns the numbers for a recording; `late` has (at least [us], steps) of the histogram."""
    return {
      "steps": self.steps,
      "missed": self.missed,
      "on_time": self.on_time,
      "median_us": 1e6 * self.percentile(0.5),
      "p99_us": 1e6 * self.percentile(0.99),
      "worst_us": 1e6 * self.worst,
      "skipped_s": self.skipped,
      "work_us": 1e6 * self.work / max(self.steps, 1),
      "late": [[round(1e6 * low), count] for low, _, count in self.histogram()],
    }

  def text(self) -> str:
    """Returns the report for people."""
    lines = [
      f"{self.steps} steps, {100 * self.on_time:.2f} % on time ({self.missed} missed), "
      f"{1e6 * self.work / max(self.steps, 1):.0f} us of work a step",
      f"late by {1e6 * self.percentile(0.5):.0f} us (median), {1e6 * self.percentile(0.99):.0f} us "
      f"(99 %), {1e3 * self.worst:.1f} ms (worst)",
    ]
    for low, high, count in self.histogram():
      share = count / max(self.steps, 1)
      upper = f"{1e6 * high:>6.0f}" if high < float("inf") else "      "
      lines.append(f"{1e6 * low:>6.0f} to {upper} us {count:>8} {'#' * round(40 * share)}")
    return "\n".join(lines)


class Pace:
  """Gives the steps of a loop their time.

  Other threads may set `paused`, `waits`, `stopped` and `speed`.

  Attributes:
    paused: whether the steps wait
    waits: whether they wait for a hand's next movement
    stopped: whether the loop is to end
    speed: 1 is real time, 0.5 slow motion
    lateness: so far
    now: when the present step began [s]
  """

  def __init__(
    self,
    period: float = 1e-3,
    speed: float = 1.0,
    clock: Callable[[], float] = time.perf_counter,
    sleep: Callable[[float], None] = time.sleep,
  ):
    """Makes the pace of steps of `period` [s] of simulated time.

    Args:
      period: of a step [s]
      speed: see the class
      clock: tells the time [s]
      sleep: waits for a time [s]
    """
    if not period > 0:
      raise ValueError(f"period is {period}, expected a number > 0 [s]")
    if not 0.01 <= speed <= 10:
      raise ValueError(f"speed is {speed}, expected a number in [0.01, 10]")
    self.period, self.speed = period, speed
    self.paused = self.waits = self.stopped = False
    self.lateness = Lateness()
    self._clock, self._sleep = clock, sleep
    self._due, self.now = None, 0.0

  @classmethod
  def instant(cls, period: float = 1e-3) -> Pace:
    """Returns a pace that never waits: its clock goes on as the steps ask for, for tests."""
    time_ = [0.0]

    def sleep(seconds: float) -> None:
      time_[0] += seconds

    return cls(period, clock=lambda: time_[0], sleep=sleep)

  def wait(self) -> None:
    """Ends a step, and waits until the next one is due; the first one is due at once."""
    now, late, due = self._clock(), self.lateness, self._due
    if due is None:
      due = now
    else:
      late.work += now - self.now
      due += self.period / self.speed
      late.missed += now > due
    if now < due:
      self._sleep(due - now)
      now = self._clock()
    elif now - due > _LOST:
      late.skipped += now - due
      due = now
    late.add(now - due)
    self.now, self._due = now, due

  def rest(self, seconds: float = 0.01) -> None:
    """Waits in a pause; the time counts nowhere, and the next step is due at once."""
    self._sleep(seconds)
    self._due, self.now = None, self._clock()


@contextlib.contextmanager
def punctual(realtime: bool = False) -> Iterator[None]:
  """Makes this thread's waits exact while the block runs, and keeps Python's own work out of it.

  Args:
    realtime: whether the system is asked to let this thread go first (Linux, if it may)
  """
  interval = sys.getswitchinterval()
  collecting = gc.isenabled()
  slack = _timer_slack(1)
  before = first() if realtime else None
  gc.collect()
  gc.disable()
  sys.setswitchinterval(1e-4)  # another thread's computing delays this one by no more
  try:
    yield
  finally:
    sys.setswitchinterval(interval)
    if collecting:
      gc.enable()
    if slack:
      _timer_slack(slack)
    if before is not None:
      os.sched_setscheduler(0, *before)


def _timer_slack(nanoseconds: int) -> int:
  """Sets how late this thread may be woken; returns what it was, 0 where it cannot be set."""
  if not sys.platform.startswith("linux"):
    return 0
  library = ctypes.CDLL(None)
  before = int(library.prctl(_SLACK + 1, 0, 0, 0, 0))
  return before if library.prctl(_SLACK, nanoseconds, 0, 0, 0) == 0 else 0


def first(priority: int = 10) -> tuple[int, os.sched_param] | None:
  """Asks for this thread to go before other programs; returns what was, None where it may not.

  Args:
    priority: over other threads that do, in [1, 99]
  """
  if not hasattr(os, "sched_setscheduler"):
    return None
  before = os.sched_getscheduler(0), os.sched_getparam(0)
  try:
    # What this thread starts goes as everybody else.
    os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
  except OSError:
    return None
  return before
