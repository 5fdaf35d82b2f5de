"""The metrics against published vectors and closed forms."""

import math
import pickle

import numpy as np
import pytest
from palpate.tasks import metrics

GAUSS = np.exp(-5 * np.arange(-1, 1, 0.01) ** 2)  # the authors' example, 100 Hz


def _quat(axis, angle):
  """Rotations of `angle` (n,) about one axis, w x y z."""
  half = np.asarray(angle)[:, None] / 2
  return np.concatenate([np.cos(half), np.sin(half) * np.asarray(axis, float)], axis=1)


def _multiply(a, b):
  w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(1, keepdims=True)
  v = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
  return np.concatenate([w, v], axis=1)


def _unknown(value, match):
  assert isinstance(value, metrics.Unknown) and math.isnan(value)
  assert match in value.reason
  return True


# Motion.


def test_time_to_completion():
  assert metrics.time_to_completion([1.0, 1.5, 4.25]) == 3.25


def test_path_length_of_a_circle():
  angle = np.linspace(0, 2 * np.pi, 101)
  circle = 0.02 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
  polygon = 100 * 2 * 0.02 * np.sin(np.pi / 100)  # the inscribed polygon, exactly
  assert metrics.path_length(circle) == pytest.approx(polygon, rel=1e-13)
  assert metrics.path_length(circle) == pytest.approx(2 * np.pi * 0.02, rel=2e-4)


def test_speeds_and_economy_of_volume_of_a_box():
  # Along three edges of a box of 20 x 40 x 50 mm: the cube root of 4e-5 m^3 over 110 mm.
  corners = np.array([[0, 0, 0], [0.02, 0, 0], [0.02, 0.04, 0], [0.02, 0.04, 0.05]])
  time = np.array([0.0, 1.0, 2.0, 3.0])
  assert metrics.economy_of_volume(corners) == pytest.approx(4e-5 ** (1 / 3) / 0.11)
  assert metrics.mean_speed(time, corners) == pytest.approx(0.11 / 3)
  assert metrics.peak_speed(metrics.speed(time, corners)) == pytest.approx(0.05)
  assert metrics.economy_of_volume(corners[:3]) == 0  # a path in a plane
  for value in (
    metrics.economy_of_volume(0 * corners),
    metrics.mean_speed(time, 0 * corners),
    metrics.peak_speed(np.zeros(3)),
  ):
    assert _unknown(value, "no motion")


def test_path_inefficiency():
  assert metrics.path_inefficiency(0.15, 0.1) == pytest.approx(50.0)
  assert metrics.path_inefficiency(0.1, 0.1) == 0
  assert _unknown(metrics.path_inefficiency(0.1, 0.0), "reference")
  assert _unknown(metrics.path_inefficiency(0.1, float("nan")), "reference")
  assert _unknown(metrics.path_inefficiency(metrics.Unknown("no motion"), 0.1), "no motion")


def test_speed_of_a_sinusoid():
  time = np.linspace(0, 1, 1001)
  pos = np.stack([0.01 * np.sin(2 * np.pi * time), 0 * time, 0 * time], 1)
  middle = (time[1:] + time[:-1]) / 2
  expected = np.abs(0.01 * 2 * np.pi * np.cos(2 * np.pi * middle))
  # Central differences: relative error (pi dt)^2 / 6; at the turning points the tip doubles back.
  np.testing.assert_allclose(metrics.speed(time, pos), expected, atol=2e-4 * 0.0628)
  assert metrics.path_length(pos) == pytest.approx(0.04, rel=1e-5)


def test_uniform_speed_interpolates_uneven_samples():
  rng = np.random.RandomState(0)
  time = np.sort(rng.uniform(0, 2, 400))
  pos = np.stack([0.05 * time**2, 0 * time, 0 * time], 1)  # speed 0.1 t, linear
  values, rate = metrics.uniform_speed(time, pos)
  assert rate == pytest.approx(399 / (time[-1] - time[0]))
  grid = (time[0] + time[1]) / 2 + np.arange(399) / rate
  inside = grid <= (time[-1] + time[-2]) / 2
  np.testing.assert_allclose(values[inside], 0.1 * grid[inside], rtol=1e-9)
  even = np.arange(50) * 0.02
  pos = np.stack([even**3, 0 * even, 0 * even], 1)
  np.testing.assert_array_equal(metrics.uniform_speed(even, pos)[0], metrics.speed(even, pos))


def test_sparc_published_vector():
  assert round(metrics.sparc(GAUSS, 100.0), 5) == -1.41403


def test_log_dimensionless_jerk_published_vector():
  assert round(metrics.log_dimensionless_jerk(GAUSS, 100.0), 5) == -5.81636


@pytest.mark.parametrize("metric", [metrics.sparc, metrics.log_dimensionless_jerk])
def test_smoothness_has_no_scale_and_sees_tremor(metric):
  smooth = metric(GAUSS, 100.0)
  assert metric(3.7 * GAUSS, 100.0) == pytest.approx(smooth, rel=1e-12)
  time = np.arange(-1, 1, 0.01)
  tremor = GAUSS * (1 + 0.3 * np.sin(2 * np.pi * 6 * time))
  assert metric(tremor, 100.0) < smooth - 0.1


def test_sparc_matches_a_direct_sum():
  rng = np.random.RandomState(1)
  values, rate = rng.rand(77), 60.0
  size = 2 ** (7 + 4)
  grid = np.exp(-2j * np.pi * np.outer(np.arange(size // 2 + 1), np.arange(77)) / size)
  amplitude = np.abs(grid @ values)
  amplitude /= amplitude.max()
  freq = np.arange(size // 2 + 1) * rate / size
  keep = [k for k in range(len(freq)) if freq[k] <= 10 and amplitude[k] >= 0.05]
  f, a = freq[: keep[-1] + 1], amplitude[: keep[-1] + 1]
  arc = sum(
    math.hypot((f[k + 1] - f[k]) / (f[-1] - f[0]), a[k + 1] - a[k]) for k in range(len(f) - 1)
  )
  assert metrics.sparc(values, rate) == pytest.approx(-arc, rel=1e-10)
  # The cut-offs do cut: the whole spectrum is longer.
  assert keep[-1] < len(freq) - 1


def test_log_dimensionless_jerk_of_a_parabola():
  # Speed 4 s (1 - s): second derivative -8 / T^2, constant, so T^3 * 64 / T^4 * (n - 2) / rate.
  n, rate = 51, 50.0
  s = np.arange(n) / (n - 1)
  second = 8 / ((n - 1) / rate) ** 2
  expected = -math.log((n / rate) ** 3 * second**2 * (n - 2) / rate)
  parabola = 4 * s * (1 - s)
  assert metrics.log_dimensionless_jerk(parabola, rate) == pytest.approx(expected, rel=1e-9)


def test_angular_path_of_a_constant_rotation():
  quat = _quat([0, 0.6, 0.8], np.linspace(0, 3 * np.pi, 200))
  assert metrics.angular_path(quat) == pytest.approx(3 * np.pi, rel=1e-12)
  flip = np.where(np.arange(200)[:, None] % 2, -quat, quat)  # -q is the same rotation
  assert metrics.angular_path(flip) == pytest.approx(3 * np.pi, rel=1e-12)
  assert metrics.angular_path(7 * quat) == pytest.approx(3 * np.pi, rel=1e-12)
  assert metrics.angular_path(np.tile(quat[:1], (5, 1))) == 0
  tiny = _quat([1, 0, 0], np.arange(101) * 1e-9)  # arccos would lose this altogether
  assert metrics.angular_path(tiny) == pytest.approx(1e-7, rel=1e-6)
  assert _unknown(metrics.angular_path([[1, 0, 0, 0], [0, 0, 0, 0]]), "sample 1")


def test_depth_path():
  time = np.linspace(0, 1, 51)
  axis = np.tile([0.0, 0.0, -2.0], (51, 1))
  depth = 0.03 * np.sin(np.pi * time)  # in and out
  pos = np.stack([0.1 * time, 0 * time, depth], 1)
  assert metrics.depth_path(pos, axis) == pytest.approx(0.06, rel=1e-12)
  assert metrics.depth_path(pos * [1, 0, 0], axis) == 0  # moved, but never in depth
  assert _unknown(metrics.depth_path(0 * pos, axis), "no motion")
  assert _unknown(metrics.depth_path(pos, 0 * axis), "axis")


def test_response_orientation_is_the_roll_alone():
  angle = np.linspace(0, 1, 101)
  roll = 0.7 * np.sin(2 * np.pi * angle)  # 4 * 0.7 in all; the grid holds the turning points
  tilt = np.tile(_quat([0.6, 0.8, 0], np.array([0.4])), (101, 1))
  shaft = _multiply(tilt, _quat([0, 0, 1], roll))
  assert metrics.response_orientation(shaft) == pytest.approx(2.8, rel=1e-12)
  assert metrics.response_orientation(_quat([0, 1, 0], angle)) == pytest.approx(0, abs=1e-15)
  sideways = metrics.response_orientation(_quat([0, 1, 0], angle), (0, 3, 0))
  assert sideways == pytest.approx(1.0, rel=1e-12)
  with pytest.raises(ValueError, match="local_axis"):
    metrics.response_orientation(shaft, (0, 0, 0))


def test_number_of_movements_debounces():
  def count(*runs):
    speeds = np.concatenate([np.full(n, v) for v, n in runs])
    return metrics.number_of_movements(np.arange(len(speeds) + 1) * 0.02, speeds)

  fast, slow = 0.08, 0.01
  assert count((slow, 20), (fast, 20), (slow, 20), (fast, 20), (slow, 20)) == 2
  assert count((slow, 20), (fast, 20), (slow, 9), (fast, 20), (slow, 20)) == 1  # short pause
  assert count((slow, 20), (fast, 9), (slow, 20), (fast, 20)) == 1  # short burst
  assert count((fast, 10), (slow, 10), (fast, 10)) == 2  # exactly 0.2 s, moving from the start
  assert count((slow, 50)) == 0  # moved, slowly: a known 0
  assert _unknown(count((0.0, 50)), "no motion")


def test_idle_time_needs_every_instrument_at_rest():
  time = np.arange(11) * 0.5
  left = np.array([0, 0, 0, 0, 1, 1, 1, 0, 0, 0], float)
  right = np.array([1, 1, 0, 0, 0, 0, 1, 1, 1, 0], float)
  assert metrics.idle_time(time, left) == pytest.approx(3.5)
  assert metrics.idle_time(time, [left, right]) == pytest.approx(1.5)
  assert metrics.idle_share(time, 1.5) == pytest.approx(30.0)
  assert metrics.idle_time(time, 0 * left) == pytest.approx(5.0)


def test_who_works_slowly_is_not_idle():
  time, still = np.arange(11) * 0.5, np.zeros(10)
  touch = np.array([0, 0, 1, 1, 1, 0, 0, 0, 0, 0, 1], bool)
  assert metrics.idle_time(time, still, touch) == pytest.approx(3.0)
  with pytest.raises(ValueError, match="at_work has 10 samples, expected 11"):
    metrics.idle_time(time, still, touch[1:])


def test_bimanual_dexterity():
  rng = np.random.RandomState(2)
  a, b = rng.rand(300), rng.rand(300)
  assert metrics.bimanual_dexterity(a, 2 * a + 1) == pytest.approx(1, abs=1e-12)
  assert metrics.bimanual_dexterity(a, 1 - a) == pytest.approx(-1, abs=1e-12)
  assert metrics.bimanual_dexterity(a, a + b) == pytest.approx(np.corrcoef(a, a + b)[0, 1])
  assert _unknown(metrics.bimanual_dexterity(a, np.full(300, 0.1)), "does not change")


def test_out_of_view_and_in_view():
  time = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
  assert metrics.out_of_view(time, [1, 1, 0, 1, 1]) == pytest.approx(25.0)
  assert metrics.out_of_view(time, [True] * 5) == 0
  edge = math.tan(math.radians(20))  # half of fovy 40, at distance 1
  points = [[0, 0, -1], [0, 0.99 * edge, -1], [0, 1.01 * edge, -1], [1.9 * edge, 0, -1]]
  points += [[2.1 * edge, 0, -1], [0, 0, 1], [0, 0, 0]]
  seen = metrics.in_view(points, np.zeros(3), np.eye(3), 40, aspect=2)
  assert seen.tolist() == [True, True, False, True, False, False, False]
  mat = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # looks along -x
  assert metrics.in_view([[4, 5, 6], [6, 5, 6]], [5, 5, 6], mat, 40).tolist() == [True, False]


# Outcome.


def test_grasp_slips():
  held = [0, 1, 1, 0, 0, 1, 1, 0]
  closed = [1, 1, 1, 1, 0, 1, 1, 0]
  assert metrics.grasp_slips(closed, held) == 1  # the second was let go
  assert metrics.grasp_slips([1, 1, 0, 0], [1, 1, 0, 0]) == 0
  assert _unknown(metrics.grasp_slips([1, 1], [0, 0]), "grasped")


def test_events_and_target_error():
  kinds = ["target", "drop", "miss", "note", "drop"]
  assert metrics.count_events(kinds, metrics.ERRORS) == 3
  assert metrics.count_events([], metrics.ERRORS) == 0
  assert metrics.target_error([0.001, 0.003]) == pytest.approx(0.002)
  assert _unknown(metrics.target_error([]), "no target")


def test_trace_rms_of_an_offset_line():
  curve = [[0, 0, 0], [0.05, 0, 0], [0.1, 0, 0]]
  pos = np.stack([np.linspace(0, 0.1, 40), np.full(40, 0.002), np.zeros(40)], 1)
  assert metrics.trace_rms(pos, curve) == pytest.approx(0.002)
  beyond = np.array([[0.103, 0.004, 0.0]])  # 3-4-5 from the end
  assert metrics.trace_rms(beyond, curve) == pytest.approx(0.005)
  assert metrics.trace_rms(pos[::-1], curve) == pytest.approx(0.002)


def test_what_a_cut_is_like_is_said_at_its_end():
  for name in ("deviation", "farthest", "excess", "jagged"):
    measure = getattr(metrics, f"cut_{name}")
    assert measure([0.0, 1e-4, 3e-4]) == 3e-4
    assert _unknown(measure([]), "too few samples: 0,")


def test_share_freed_is_the_last():
  assert metrics.share_freed([0.0, 0.2, 0.6]) == 0.6
  assert _unknown(metrics.share_freed([]), "too few samples: 0,")


def test_trace_frechet_of_an_offset_line_and_of_a_detour():
  curve = np.array([[0, 0, 0], [0.1, 0, 0]], float)
  x = np.linspace(0, 0.1, 257)
  pos = np.stack([x, np.full(257, 0.002), 0 * x], 1)
  assert metrics.trace_frechet(pos, curve) == pytest.approx(0.002)
  detour = pos + np.outer(np.exp(-(((x - 0.05) / 0.01) ** 2)), [0, 0.008, 0])
  assert metrics.trace_frechet(detour, curve) == pytest.approx(0.010)
  # Order counts: backwards, each end is as far as the other end of the curve.
  assert metrics.trace_frechet(pos[::-1], curve) == pytest.approx(math.hypot(0.1, 0.002))
  # Turning back over a third of the curve costs half of that, although no point is off the line.
  back = np.concatenate([x[x <= 0.06], x[(x < 0.06) & (x > 0.03)][::-1], x[x >= 0.03]])
  back = np.stack([back, 0 * back, 0 * back], 1)
  assert metrics.trace_rms(back, curve) == pytest.approx(0, abs=1e-12)
  assert metrics.trace_frechet(back, curve) == pytest.approx(0.015, abs=0.1 / 256)


def test_trace_frechet_matches_the_recursion():
  rng = np.random.RandomState(3)
  pos, curve = rng.rand(23, 3), rng.rand(4, 3)
  at = np.concatenate([[0], np.linalg.norm(np.diff(curve, axis=0), axis=1).cumsum()])
  fine = np.union1d(at, np.linspace(0, at[-1], 257))
  points = np.stack([np.interp(fine, at, c) for c in curve.T], 1)
  reach = np.zeros((len(pos), len(points)))
  for i in range(len(pos)):
    for j in range(len(points)):
      ways = [reach[a, b] for a, b in [(i - 1, j), (i, j - 1), (i - 1, j - 1)] if min(a, b) >= 0]
      reach[i, j] = max(np.linalg.norm(pos[i] - points[j]), min(ways, default=0))
  assert metrics.trace_frechet(pos, curve) == pytest.approx(reach[-1, -1], rel=1e-14)


# What is not known, and what is not allowed.


@pytest.mark.parametrize(
  ("value", "match"),
  [
    (metrics.time_to_completion([]), "too few samples: 0,"),
    (metrics.time_to_completion([3.0]), "too few samples: 1,"),
    (metrics.path_length([]), "too few samples: 0,"),
    (metrics.path_length(np.zeros((1, 3))), "too few samples: 1,"),
    (metrics.path_length(np.ones((9, 3))), "no motion"),
    (metrics.sparc(np.zeros(50), 50.0), "no motion"),
    (metrics.sparc([0.1], 50.0), "too few samples: 1,"),
    (metrics.log_dimensionless_jerk(np.zeros(50), 50.0), "no motion"),
    (metrics.log_dimensionless_jerk(np.full(50, 0.1), 50.0), "curvature"),
    (metrics.angular_path([[1, 0, 0, 0]]), "too few samples: 1,"),
    (metrics.response_orientation([]), "too few samples: 0,"),
    (metrics.number_of_movements([0.0], []), "too few samples: 1,"),
    (metrics.idle_time([0.0], np.zeros((1, 0))), "too few samples: 1,"),
    (metrics.out_of_view([0.0], [1]), "too few samples: 1,"),
    (metrics.force_time_product([0.0], [1.0]), "too few samples: 1,"),
    (metrics.peak_force([]), "too few samples: 0,"),
    (metrics.trace_rms([], [[0, 0, 0], [1, 0, 0]]), "too few samples: 0,"),
    (metrics.trace_frechet([[0, 0, 0]], [[1, 0, 0], [1, 0, 0]]), "no length"),
  ],
)
def test_too_little_is_unknown(value, match):
  assert _unknown(value, match)


def test_a_single_sample_still_has_a_peak():
  assert metrics.peak_force([1.25]) == 1.25
  assert metrics.mean_force([0.0], [1.25]) == 1.25


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_bad_samples_are_unknown_and_named(bad):
  time = np.arange(6) * 0.1
  pos = np.random.RandomState(4).rand(6, 3)
  pos[3, 1] = bad
  force = np.array([0, 1, 1, bad, 0, 0])
  quat = np.tile([1.0, 0, 0, 0], (6, 1))
  quat[3] = bad
  for value in (
    metrics.path_length(pos),
    metrics.depth_path(pos, np.ones((6, 3))),
    metrics.trace_rms(pos, [[0, 0, 0], [1, 0, 0]]),
    metrics.trace_frechet(pos, [[0, 0, 0], [1, 0, 0]]),
    metrics.angular_path(quat),
    metrics.response_orientation(quat),
    metrics.peak_force(force),
    metrics.mean_force(time, force),
    metrics.force_breaches(time, force, 0.5),
    metrics.force_rate(time, force, 2.0),
    metrics.peak_grip(force),
    metrics.grip_ratio(time, np.ones(6), force),
    metrics.shaft_contact(time, force),
    metrics.peak_strain(force),
    metrics.economy_of_volume(pos),
    metrics.mean_speed(time, pos),
    metrics.peak_speed(force),
    metrics.excess_impulse(time, force, 0.5),
    metrics.peak_pressure(force, np.ones(6)),
    metrics.out_of_view(time, force),
    metrics.grasp_slips(force, np.ones(6)),
    metrics.target_error(force),
    metrics.sparc(force, 10.0),
    metrics.bimanual_dexterity(force, np.arange(6)),
  ):
    assert _unknown(value, "not finite at sample 3") and value.fault
  with pytest.raises(ValueError, match="tip_pos is not finite at sample 3"):
    metrics.speed(time, pos)


@pytest.mark.parametrize(
  ("time", "match"),
  [
    ([0.0, 0.2, 0.1], "sample 2: 0.2 s, then 0.1 s"),
    ([0.0, 0.1, 0.1], "sample 2: 0.1 s, then 0.1 s"),
    ([0.0, np.nan, 0.1], "time is not finite at sample 1"),
    ([[0.0], [0.1], [0.2]], r"time has shape \(3, 1\)"),
  ],
)
def test_time_must_increase(time, match):
  for call in (
    lambda: metrics.time_to_completion(time),
    lambda: metrics.speed(time, np.zeros((3, 3))),
    lambda: metrics.mean_force(time, [0, 1, 0]),
    lambda: metrics.out_of_view(time, [1, 1, 1]),
  ):
    with pytest.raises(ValueError, match=match) as error:
      call()
    assert not isinstance(error.value, metrics.UnknownError)


def test_wrong_shapes_are_mistakes():
  with pytest.raises(ValueError, match=r"tip_pos has shape \(4, 2\), expected \(n, 3\)"):
    metrics.path_length(np.zeros((4, 2)))
  with pytest.raises(ValueError, match=r"quat has shape \(4, 3\)"):
    metrics.angular_path(np.zeros((4, 3)))
  with pytest.raises(ValueError, match="force has 2 samples, expected 3"):
    metrics.force_time_product([0, 1, 2], [1, 1])
  with pytest.raises(ValueError, match="speed has 3 samples, expected 2"):
    metrics.number_of_movements([0, 1, 2], [1, 1, 1])


def test_unknown_survives_a_process_boundary():
  value = pickle.loads(pickle.dumps(metrics.Unknown("no contact", fault=True)))
  assert _unknown(value, "no contact") and value.fault
  assert repr(value) == "Unknown('no contact')"


def test_inputs_are_left_alone():
  time = np.arange(17) * 0.1
  force = np.abs(np.sin(4 * time))
  pos = np.random.RandomState(5).rand(len(time), 3)
  quat = np.random.RandomState(6).randn(len(time), 4)
  before = [a.copy() for a in (time, force, pos, quat)]
  metrics.excess_impulse(time, force, 1.0)
  metrics.rms_force(time, force)
  metrics.force_rate(time, force, 2.0)
  metrics.sparc(force, 10.0)
  metrics.angular_path(quat)
  metrics.trace_frechet(pos, pos[:5])
  for a, b in zip((time, force, pos, quat), before, strict=True):
    np.testing.assert_array_equal(a, b)
