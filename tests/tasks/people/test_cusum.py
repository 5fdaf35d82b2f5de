"""The CUSUM of a learner, against sums by hand, a simulation, and the risks it is stated with."""

import math

import numpy as np
import pytest
from palpate.tasks.people import cusum


def test_the_chart_is_the_one_by_hand():
  """p0 = 0.1, p1 = 0.3: a success adds ln(9/7) = 0.25131, a failure takes ln 3 = 1.09861."""
  attempts = [True, True, False, True] + [True] * 14 + [False, True, False, False, False, True]
  points = cusum.chart(attempts)
  by_hand = [0.25131, 0.50263, 0, 0.25131]  # 0.50263 - 1.09861 is below 0
  by_hand += [0.25131 * k for k in range(2, 16)]  # 15 * 0.25131 = 3.76972 is the first above 3.6
  by_hand += [0, 0, 0, 0, 0, 0]
  assert [p.value for p in points[:18]] == pytest.approx(by_hand[:18], abs=2e-4)
  assert [p.competent for p in points[:18]] == [False] * 17 + [True]
  assert points[17].changed and not any(p.changed for p in points[:17])
  after = [-1.09861, -0.84730, -1.94591, -3.04452, -4.14313]  # below -3.6: lost
  assert [p.value for p in points[18:23]] == pytest.approx(after, abs=1e-5)
  assert [p.competent for p in points[18:]] == [True] * 4 + [False] * 2
  assert points[22].changed and points[23].value == pytest.approx(0.25131, abs=1e-5)


def test_the_weights_are_log_likelihood_ratios():
  assert cusum.weight(True) == pytest.approx(math.log(0.9 / 0.7))
  assert cusum.weight(False) == pytest.approx(-math.log(3))


@pytest.mark.parametrize(
  ("failing", "attempts", "competent", "stated"),
  [(0.3, 30, False, 0.039), (0.1, 30, False, 0.70), (0.1, 50, False, 0.94),
   (0.1, 30, True, 0.045), (0.3, 30, True, 0.82)],
)  # fmt: skip
def test_the_risks_are_those_that_are_stated(failing, attempts, competent, stated):
  exact = cusum.chance(failing, attempts, competent)
  assert exact == pytest.approx(stated, abs=0.006)
  rng = np.random.RandomState(0)
  head = [True] * 15 if competent else []  # what makes a learner competent
  crossed = [
    any(p.changed for p in cusum.chart(head + list(rng.rand(attempts) >= failing))[len(head) :])
    for _ in range(1500)
  ]
  error = math.sqrt(exact * (1 - exact) / 1500)
  assert np.mean(crossed) == pytest.approx(exact, abs=4 * error)


def test_no_attempts_have_no_chart():
  assert cusum.chart([]) == [] and cusum.chance(0.1, 0) == 0
