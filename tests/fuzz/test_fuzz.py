"""Random cases by seed: a few always, and as many of each kind as LONG says with `-m slow`.

A seed that failed is run again with `python -m pytest tests/fuzz -k KIND --seed N`.
"""

import importlib
import sys

import pytest
from fuzz import apart

SHORT = {"configurations": 40, "meshes": 40, "files": 12, "cutters": 3, "solids": 4}
LONG = dict.fromkeys(SHORT, 10_000) | {"cutters": 1000, "solids": 1000}


@pytest.mark.parametrize("kind", SHORT)
def test_a_few_cases(kind, request):
  seed = request.config.getoption("--seed")
  kept = importlib.import_module(f"fuzz.{kind}").KEPT
  for number in [*kept, *range(SHORT[kind])] if seed is None else [seed]:
    apart.one(kind, number)


STILL_OPEN = [
  pytest.param(kind, seed, marks=pytest.mark.xfail(reason=reason))
  for kind in SHORT
  for seed, reason in importlib.import_module(f"fuzz.{kind}").OPEN.items()
]


@pytest.mark.parametrize(("kind", "seed"), STILL_OPEN)
def test_what_is_not_mended_yet(kind, seed):
  apart.one(kind, seed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SHORT)
def test_many_cases(kind):
  known = importlib.import_module(f"fuzz.{kind}").OPEN
  failed = [seed for seed in apart.sweep(kind, LONG[kind]) if seed not in known]
  assert not failed


def test_lives_end_well(request):
  apart.measure("life.py", request.config.getoption("--seed") or 0, 300)


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
@pytest.mark.parametrize("seed", range(8))
def test_long_lives_hold_no_more_memory(seed):
  half, whole = apart.measure("life.py", seed, 6000)
  assert whole - half < 20_000  # kB in 3000 acts
