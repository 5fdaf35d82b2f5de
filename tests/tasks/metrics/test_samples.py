"""Filters and strain against closed forms, and what the sampling rate may change."""

import math

import numpy as np
import pytest
from palpate.tasks import metrics
from palpate.tasks.recorder import Recorder, Settings

RATES = (25, 50, 100, 250, 1000)  # [Hz]


def _gain(f, cutoff):
  return 1 / (1 + (f / cutoff) ** 8)


@pytest.mark.parametrize("f", [1.0, 5.0, 6.0, 9.0, 20.0])
def test_the_gain_of_the_low_pass(f):
  time = np.linspace(0, 4, 401)  # whole periods, from zero to zero: its own odd continuation
  wave = np.sin(2 * np.pi * f * time)
  np.testing.assert_allclose(metrics.low_pass(time, wave, 6.0), _gain(f, 6.0) * wave, atol=1e-12)


def test_lines_and_ends_stay():
  time = np.linspace(0, 1, 51)
  line = np.stack([0.1 * time, 3 - time, 0 * time], 1)
  np.testing.assert_allclose(metrics.low_pass(time, line, 2.0), line, atol=1e-14)
  walk = np.cumsum(np.random.RandomState(0).randn(51, 3), axis=0)
  smooth = metrics.low_pass(time, walk, 2.0)
  np.testing.assert_allclose(smooth[[0, -1]], walk[[0, -1]], atol=1e-12)
  assert np.abs(np.diff(smooth, axis=0)).sum() < 0.5 * np.abs(np.diff(walk, axis=0)).sum()
  for short in (walk[:1], walk[:2]):
    np.testing.assert_array_equal(metrics.low_pass(time[: len(short)], short, 2.0), short)
  np.testing.assert_array_equal(metrics.low_pass(time, walk, 25.0), walk)  # half the rate


def test_uneven_samples_are_filtered_at_their_times():
  rng = np.random.RandomState(1)
  time = np.sort(np.concatenate([[0.0, 4.0], rng.uniform(0, 4, 1500)]))
  slow, fast = np.sin(2 * np.pi * time), 0.3 * np.sin(2 * np.pi * 20 * time)
  out = metrics.low_pass(time, slow + fast, 6.0)
  np.testing.assert_allclose(out, slow, atol=0.03)  # linear interpolation over up to 20 ms


def test_rotations_are_filtered_as_rotations():
  time = np.linspace(0, 2, 101)
  angle = 0.4 * np.sin(2 * np.pi * time / 2) + 0.02 * np.sin(2 * np.pi * 12 * time)
  quat = np.stack([np.cos(angle / 2), 0 * angle, np.sin(angle / 2), 0 * angle], 1)
  flips = np.where(np.random.RandomState(0).rand(101, 1) > 0.5, 1, -1)  # -q is the same rotation
  smooth = metrics.low_pass_rotation(time, flips * quat, 4.0)
  np.testing.assert_allclose(np.linalg.norm(smooth, axis=1), 1)
  assert metrics.angular_path(smooth) == pytest.approx(1.6, rel=1e-2)
  assert metrics.angular_path(quat) > 2


def _move(rate, noise=0.0, tremor=0.0, hold=2.0):
  """Three minimum-jerk movements of 0.1 m in 2 s each, and a rest: time and tip positions [m]."""
  rng = np.random.RandomState(0)
  time = np.arange(round((6 + hold) * rate) + 1) / rate
  s = np.clip(time % 2 / 2, 0, 1)
  along = np.where(time < 6, time // 2 + 10 * s**3 - 15 * s**4 + 6 * s**5, 3.0)
  pos = 0.1 * along[:, None] * [1.0, 0, 0] + noise * rng.randn(len(time), 3)
  for f in (4.0, 5.3, 7.1, 8.6, 10.0):
    phase = rng.uniform(0, 2 * np.pi, 3)
    pos += tremor * math.sqrt(2 / 5) * np.sin(2 * np.pi * f * time[:, None] + phase)
  return time, pos


def _metrics(time, pos, **settings):
  recorder = Recorder(settings=Settings(**settings))
  for t, p in zip(time, pos, strict=True):
    recorder.append(t, p)
  return recorder.metrics()


def test_a_tracker_s_noise_and_rate_hardly_change_a_metric():
  exact = _metrics(*_move(100, hold=0), tip_cutoff=None)
  made = [_metrics(*_move(rate, noise=5e-5, hold=0)) for rate in RATES]
  raw = [_metrics(*_move(rate, noise=5e-5, hold=0), tip_cutoff=None) for rate in RATES]

  def spread(name, of):
    return np.ptp([getattr(one, name) for one in of])

  assert spread("log_dimensionless_jerk", raw) > 15  # what it is about
  assert spread("log_dimensionless_jerk", made) < 0.6
  assert spread("sparc", made) < 0.05 and spread("path_length", made) < 1e-3
  for one in made:
    assert one.log_dimensionless_jerk == pytest.approx(exact.log_dimensionless_jerk, abs=1.5)
    assert one.path_length == pytest.approx(0.3, abs=1e-3)
    assert one.number_of_movements == exact.number_of_movements == 3


@pytest.mark.parametrize("rate", RATES)
def test_tremor_costs(rate):
  still = _metrics(*_move(rate))
  shaken = _metrics(*_move(rate, tremor=8e-4))
  assert shaken.log_dimensionless_jerk < still.log_dimensionless_jerk - 3
  assert shaken.sparc < still.sparc - 0.3
  assert shaken.path_length > still.path_length + 0.02
  # It neither joins all movements into one nor takes the rest away.
  assert shaken.number_of_movements == still.number_of_movements == 3
  assert shaken.idle_time == pytest.approx(still.idle_time, abs=0.3) and still.idle_time > 2


# Strain.


def _sheet():
  """A flat sheet of triangles, tilted."""
  grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(3.0)), -1).reshape(-1, 2) * 0.01
  tri = [[k, k + 1, k + 4] for k in (0, 1, 2, 4, 5, 6)]
  tri += [[k + 1, k + 5, k + 4] for k in (0, 1, 2, 4, 5, 6)]
  axes = np.linalg.qr(np.random.RandomState(3).randn(3, 3))[0]
  return grid, axes, np.array(tri)


def test_strain_of_a_sheet():
  grid, axes, tri = _sheet()
  rest = grid @ axes[:2]

  def strain(matrix, turn=((1, 0, 0), (0, 1, 0), (0, 0, 1)), shift=0.0):
    return metrics.surface_strain(rest, (grid @ matrix.T) @ axes[:2] @ np.array(turn) + shift, tri)

  np.testing.assert_allclose(strain(np.diag([1.3, 0.8])), 0.3)  # the longer stretch
  np.testing.assert_allclose(strain(np.diag([0.7, 0.9])), -0.1)  # squeezed both ways
  turn = np.linalg.qr(np.random.RandomState(4).randn(3, 3))[0]
  np.testing.assert_allclose(strain(np.eye(2), turn, 0.2), 0, atol=1e-7)  # a rigid motion
  np.testing.assert_allclose(strain(np.diag([1.3, 0.8]), turn), 0.3)
  # Simple shear g: the larger singular value of [[1, g], [0, 1]].
  sheared = np.linalg.svd([[1, 0.4], [0, 1]])[1][0] - 1
  np.testing.assert_allclose(strain(np.array([[1, 0.4], [0, 1]])), sheared)
