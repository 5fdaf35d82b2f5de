"""Rules of exercises, which one world runs and many are compiled from."""

import numpy as np
import pytest
from palpate.tasks.core import rules
from palpate.tasks.core.rules import Rules


class State:
  time: float


def advance(s, o):
  return o, 0.0, 0


def observe(s, o):
  return o


@pytest.mark.parametrize(
  ("changes", "message"),
  [
    ({"advance": 3}, "advance is 3, expected a function of s and o"),
    ({"observe": lambda s: s}, "observe is .*, expected a function of s and o"),
    ({"act": lambda s: s}, "act is .*, expected a function of s and o"),
    ({"observed": ("tine",)}, "State: 'tine' is no field, expected one of time"),
    ({"shared": ("tine",)}, "State: 'tine' is no field, expected one of time"),
    ({"metrics": {"time": "tine"}}, "State: 'tine' is no field, expected one of time"),
  ],
)
def test_malformed_rules_are_named(changes, message):
  rules = {"state": State, "advance": advance, "observe": observe, "observed": ("time",)}
  Rules(**rules)
  with pytest.raises(TypeError, match=message):
    Rules(**rules | changes)


def test_closeness_tells_the_way_back_from_anywhere():
  start, far = 0.05, np.geomspace(1e-4, 10.0, 200)
  values = np.array([rules.closeness(d, start) for d in far])
  assert (np.diff(values) < 0).all() and values[0] > 0.99 and -1 < values[-1] < -0.99
  assert rules.closeness(start, start) == 0
