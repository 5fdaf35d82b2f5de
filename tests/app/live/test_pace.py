"""The pace of a loop: deadlines, pauses, slow motion, and what it says of them."""

import gc
import sys

import pytest
from palpate.app.live import Lateness, Pace
from palpate.app.live.realtime_clock import punctual


class Clock:
  """A clock that goes on when it is slept by, or worked."""

  def __init__(self):
    self.time, self.slept = 5.0, []

  def __call__(self):
    return self.time

  def sleep(self, seconds):
    self.slept.append(seconds)
    self.time += seconds


def paced(clock, **kwargs):
  return Pace(1e-3, clock=clock, sleep=clock.sleep, **kwargs)


def test_steps_begin_when_they_are_due():
  clock = Clock()
  pace = paced(clock)
  began = []
  for work in (0.2e-3, 0.9e-3, 0.0):
    pace.wait()
    began.append(clock.time - 5.0)
    clock.time += work
  assert began == pytest.approx([0.0, 1e-3, 2e-3])
  assert pace.lateness.missed == 0 and pace.lateness.on_time == 1.0


def test_a_missed_deadline_is_counted_and_made_up_for():
  clock = Clock()
  pace = paced(clock)
  for work in (2.5e-3, 0.1e-3, 0.1e-3, 0.1e-3, 0.1e-3):
    pace.wait()
    clock.time += work
  pace.wait()
  late = pace.lateness
  assert late.missed == 2  # the long one ended after its own and, begun late, the next one did too
  assert late.worst == pytest.approx(1.5e-3)
  assert clock.time == pytest.approx(5.0 + 5e-3)  # back in time
  assert late.work == pytest.approx(2.9e-3)


def test_a_long_stop_is_given_up_not_hurried_after():
  clock = Clock()
  pace = paced(clock)
  pace.wait()
  clock.time += 2.0
  pace.wait()
  assert pace.lateness.skipped == pytest.approx(2.0 - 1e-3)
  before = clock.time
  pace.wait()
  assert clock.time - before == pytest.approx(1e-3)


def test_slow_motion_and_pauses():
  clock = Clock()
  pace = paced(clock, speed=0.25)
  pace.wait()
  pace.wait()
  assert clock.time == pytest.approx(5.0 + 4e-3)
  pace.rest(3.0)
  pace.wait()
  assert pace.lateness.worst == 0.0 and pace.lateness.missed == 0


def test_the_histogram_has_every_step():
  late = Lateness()
  for value in (0.0, 15e-6, 30e-6, 0.7e-3, 0.7e-3, 30e-3, 2.0):
    late.add(value)
  rows = late.histogram()
  assert sum(count for _, _, count in rows) == late.steps == 7
  assert [count for _, _, count in rows] == [2, 1, 0, 0, 0, 2, 0, 0, 0, 0, 2]
  assert late.percentile(0.5) == pytest.approx(0.71e-3)
  assert "7 steps, 100.00 % on time" in late.text() and "2000.0 ms (worst)" in late.text()
  assert Lateness().summary()["on_time"] == 1.0 and Lateness().percentile(0.5) == 0.0


def test_python_is_as_it_was_after_a_loop():
  interval, collects = sys.getswitchinterval(), gc.isenabled()
  with pytest.raises(KeyError), punctual(realtime=True):
    assert not gc.isenabled()
    raise KeyError
  assert (sys.getswitchinterval(), gc.isenabled()) == (interval, collects)


@pytest.mark.parametrize("arguments", [{"period": 0.0}, {"speed": 0.0}, {"speed": float("nan")}])
def test_what_is_no_pace_is_named(arguments):
  with pytest.raises(ValueError, match=f"{next(iter(arguments))} is"):
    Pace(**arguments)
