"""The metrics of force against closed forms."""

import math

import numpy as np
import pytest
from palpate.tasks import metrics


def _triangles(peak=2.0, base=0.4, pulses=2, step=0.1):
  """Triangular force pulses with a rest of the same length between them."""
  time = np.arange(0, 2 * pulses * base + step / 2, step)
  phase = np.mod(time, 2 * base)
  return time, np.where(phase < base, peak * (1 - np.abs(2 * phase / base - 1)), 0.0)


def _unknown(value, match):
  assert isinstance(value, metrics.Unknown) and math.isnan(value)
  assert match in value.reason
  return True


def test_force_of_triangular_pulses():
  time, force = _triangles()
  assert metrics.peak_force(force) == pytest.approx(2.0)
  assert metrics.force_time_product(time, force) == pytest.approx(2 * 2.0 * 0.4 / 2)
  # Samples in contact, equal weights: 1, 2, 1 in each pulse.
  assert metrics.mean_force(time, force) == pytest.approx(4 / 3)
  assert metrics.rms_force(time, force) == pytest.approx(math.sqrt(2))
  vector = force[:, None] * np.array([0.6, 0, -0.8])
  assert metrics.peak_force(vector) == pytest.approx(2.0)
  assert metrics.force_time_product(time, -force) == metrics.force_time_product(time, force)


def test_mean_force_weighs_by_time():
  # 1 N for half of [0, 2] and [2, 3], 4 N for half of [2, 3] and [3, 4].
  assert metrics.mean_force([0, 2, 3, 4], [0, 1, 4, 0]) == pytest.approx((1.5 * 1 + 1 * 4) / 2.5)


@pytest.mark.parametrize("step", [0.1, 0.05, 0.025])
def test_excess_impulse_is_exact_between_samples(step):
  time, force = _triangles(step=step)
  # What is over the limit is a similar triangle: scaled by (2 - 1.5) / 2 in both directions.
  expected = 2 * (0.5 * 2.0 * 0.4) * (0.5 / 2.0) ** 2
  assert metrics.excess_impulse(time, force, 1.5) == pytest.approx(expected, rel=1e-9)
  assert metrics.excess_impulse(time, force, 2.5) == 0
  assert metrics.excess_impulse(time, force, 0.0) == pytest.approx(0.8, rel=1e-9)


def test_force_breaches_counts_excursions():
  def breaches(force, step=0.2, limit=1.5):
    return metrics.force_breaches(np.arange(len(force)) * step, force, limit)

  assert breaches([0, 2, 2, 0, 2, 0, 0.5]) == 2
  assert breaches([2, 1, 2]) == 2  # over the limit from the start
  assert breaches([2, 2, 2, 2]) == 1
  assert breaches([1.5, 1.5]) == 0  # at the limit is not over it
  assert breaches([0.1, 0.2]) == 0  # touched gently: a known 0
  assert breaches([0, 2, 0, 2, 0, 2, 0], step=0.001) == 1  # contact that chatters
  assert breaches([0, 2, 0, 2], step=0.04) == 1 and breaches([0, 2, 0, 2], step=0.06) == 2
  assert _unknown(breaches([0.1, 0.2], limit=float("nan")), "limit")
  grip = np.array([0, 5, 5, 1, 5, 0.0])
  assert metrics.grip_breaches(np.arange(6) * 0.2, grip, 4.0) == 2
  assert _unknown(metrics.grip_breaches([0, 1], [5, 5], float("nan")), "limit")


def test_peak_pressure():
  assert metrics.peak_pressure([0, 3, 2], [0, 3e-5, 1e-5]) == pytest.approx(2e5)
  assert _unknown(metrics.peak_pressure([0, 3], [0, 0]), "sample 1")


@pytest.mark.parametrize(
  "value",
  [
    metrics.peak_force([0, 0]),
    metrics.mean_force([0, 1], [0, 0]),
    metrics.rms_force([0, 1], [0, 0]),
    metrics.force_time_product([0, 1], [0, 0]),
    metrics.force_breaches([0, 1], [0, 0], 1.0),
    metrics.excess_impulse([0, 1], [0, 0], 1.0),
    metrics.force_rate([0, 1], [0, 0], 9.0),
    metrics.peak_grip([0, 0]),
    metrics.mean_grip([0, 1], [0, 0]),
    metrics.grip_breaches([0, 1], [0, 0], 1.0),
    metrics.peak_pressure([0, 0], [1, 1]),
    metrics.peak_force([0.01, 0.02], contact_force=0.05),
  ],
)
def test_no_contact_is_unknown(value):
  assert _unknown(value, "no contact") and not value.fault


def test_force_rate_of_a_sine_and_of_a_step():
  # 1 - cos(w t) changes by w a second at most; 3 Hz is far under the cut-off of 20 Hz.
  time = np.linspace(0, 2, 2001)
  force = 1 - np.cos(2 * np.pi * 3 * time)
  assert metrics.force_rate(time, force, 20.0) == pytest.approx(2 * np.pi * 3, rel=1e-3)
  # A contact of a single millisecond has no rate of its own: the filter's, whatever the signal's.
  tap = np.where(np.arange(2001) == 1000, 0.04, 0.0)
  assert metrics.force_rate(time, tap, 20.0) < 0.2 < np.abs(np.diff(tap)).max() / 1e-3
  # A step of 1 N through the filter rises by the integral of its gain, 2 * 20 Hz * 1.026 [1/s].
  step = np.where(time > 1, 1.0, 0.0)
  fine = np.linspace(0, 50, 500001)
  gain = 2 * 20 * np.trapezoid(1 / (1 + fine**8), fine)
  assert metrics.force_rate(time, step, 20.0) == pytest.approx(gain, rel=2e-2)


def test_the_rate_hardly_depends_on_the_sampling():
  rates = []
  for rate in (200, 500, 1000):
    time = np.arange(0, 2, 1 / rate)
    noise = 0.02 * np.random.RandomState(0).randn(len(time))
    rates.append(metrics.force_rate(time, 1.5 - np.cos(2 * np.pi * 2 * time) + noise, 20.0))
  assert np.ptp(rates) < 0.2 * np.mean(rates)


def test_grip_against_pull():
  time = np.arange(5) * 0.1
  pull, grip = np.array([0, 1, 2, 1, 0.0]), np.array([3, 2, 2, 2, 3.0])
  assert metrics.grip_ratio(time, pull, grip) == pytest.approx(6 / 4)  # while both act
  assert metrics.grip_ratio(time, pull[:, None] * [0, 0.6, 0.8], grip) == pytest.approx(6 / 4)
  assert metrics.peak_grip(grip) == 3 and metrics.mean_grip(time, grip) == pytest.approx(9 / 4)
  assert _unknown(metrics.grip_ratio(time, pull, 0 * grip), "nothing was gripped and pulled")
  assert _unknown(metrics.grip_ratio(time, pull, grip, contact_force=2.5), "gripped and pulled")


def test_shaft_contact():
  time = np.arange(6) * 0.5
  force = [0, 0.2, 0.3, 0, 0, 0.4]
  assert metrics.shaft_contact(time, force) == pytest.approx(0.5 + 0.5 + 0.25)
  assert metrics.peak_shaft_force(force) == 0.4 == metrics.peak_surroundings_force(force)
  assert metrics.shaft_contact(time, force, contact_force=0.25) == pytest.approx(0.75)
  # That there was none is known, unlike what a force would have been without contact.
  assert metrics.shaft_contact(time, np.zeros(6)) == 0 == metrics.peak_shaft_force(np.zeros(6))


def test_peak_traction():
  assert metrics.peak_traction([0.1, 0.9, 0.2]) == 0.9
  assert _unknown(metrics.peak_traction([]), "too few samples: 0,")


def test_peak_strain():
  assert metrics.peak_strain([0.0, 0.31, 0.2]) == 0.31
  assert _unknown(metrics.peak_strain([]), "too few samples: 0,")
