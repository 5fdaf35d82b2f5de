"""Rules of exercises, which one world runs and many are compiled from."""

import pytest
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
