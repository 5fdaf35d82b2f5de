"""Exercises under random actions, steps on many threads, and memory; long with `-m slow`."""

import pytest
from fuzz import apart, soak
from palpate import tasks

LONG = 10_000_000  # steps of all exercises together
THREADS = (2, 4, 16)


@pytest.mark.parametrize("name", [("grasp", "hard"), ("retract", "hard")], ids="-".join)
def test_soak_in_short(name, request):
  soak.act(name, request.config.getoption("--seed") or 0, 300)


@pytest.mark.slow
@pytest.mark.parametrize("name", tasks.HARD, ids="-".join)
def test_soak(name, request):
  soak.act(name, request.config.getoption("--seed") or 1, LONG // len(tasks.HARD))


@pytest.mark.parametrize("shared", [False, True], ids=["copies", "one model"])
@pytest.mark.parametrize("count", THREADS[:2])
def test_threads_in_short(count, shared):
  assert soak.step_on_threads(count, 0.5, shared) >= 20 * count


@pytest.mark.slow
@pytest.mark.parametrize("shared", [False, True], ids=["copies", "one model"])
@pytest.mark.parametrize("count", THREADS)
def test_threads(count, shared):
  soak.step_on_threads(count, 120, shared)


@pytest.mark.parametrize("coupling", ["nodal", "window"])
def test_steps_hold_no_more_memory(coupling):
  first, last = apart.measure("steps.py", coupling, 4000)
  assert last - first < 2000  # kB


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["nodal", "window"])
def test_a_million_steps_hold_no_more_memory(coupling):
  first, last = apart.measure("steps.py", coupling, 1_000_000)
  assert last - first < 2000  # kB
