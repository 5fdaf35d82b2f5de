"""The metrics of a recording, and how a new one comes to be."""

import dataclasses
import json
import math

import numpy as np
import pytest
from palpate.app.learn import evaluate
from palpate.tasks import metrics as functions
from palpate.tasks.metrics import METRICS, Metrics, Unknown, metric
from palpate.tasks.people.score import make_reference, score
from palpate.tasks.recorder import Recorder
from palpate.tasks.recording import Recording
from recordings import LINE, SETTINGS, exercise, plain


def test_a_metric_is_registered_by_its_definition():
  try:

    @metric("Highest point", "m", "efficiency", "max", "this test")
    def highest(tip_pos, contact_force) -> float:
      """Returns the largest z [m], lower is better."""
      assert contact_force == SETTINGS.contact_force
      return np.max(tip_pos[:, 2])

    made = plain(LINE + np.array([0, 0, 0.25])).metrics()
    assert made.highest == 0.25
    assert json.loads(made.to_json())["values"]["highest"] == 0.25
    both = Recorder(("left", "right"))
    both.append(0.0, [[0, 0, 1], [0, 0, 2]])
    assert both.metrics().highest == 2
    assert Recorder().metrics().reasons()["highest"] == "the recording is empty"
    reference = make_reference([made, plain(LINE).metrics()], "touch/easy", 0)
    assert score(made, reference, "success").z["highest"] == pytest.approx(-math.sqrt(0.5))
    result = evaluate.Result(0, "success", 1.0, 1.0, made.to_json())
    assert "Highest point [mm]" in evaluate.table("touch/easy", "expert", [result], None)
  finally:
    METRICS.pop("highest", None)
  assert not hasattr(plain(LINE).metrics(), "highest")


def test_a_metric_of_what_is_not_recorded_is_named():
  try:

    @metric("Nothing", "-", "efficiency", "max", "this test")
    def nothing(temperature) -> float:
      """Returns nothing [-], lower is better."""
      return temperature

    with pytest.raises(TypeError, match="metric 'nothing': no input 'temperature'"):
      plain(LINE).metrics()
  finally:
    METRICS.pop("nothing", None)
  with pytest.raises(ValueError, match="metric 'N': combine is 'most', expected sum, max"):
    metric("N", "-", "efficiency", "most", "this test")


def test_every_metric_names_unit_and_direction():
  for name, spec in METRICS.items():
    first = spec.function.__doc__.split("\n")[0]
    assert f"[{spec.unit}]" in first, name
    assert f"{spec.better} is better" in first or spec.better == "higher" in first, name


def test_metrics_cannot_be_changed_and_name_strangers():
  made = plain(LINE).metrics()
  with pytest.raises(AttributeError, match="cannot set 'time'"):
    made.time = 0.0
  with pytest.raises(
    ValueError, match="no such metric 'tme', expected one of peak_force, mean_force"
  ):
    Metrics(tme=1.0)


def test_metrics_of_a_straight_line():
  made = plain(LINE).metrics()
  assert made.time == pytest.approx(1.2)
  assert made.path_length == pytest.approx(0.12)
  assert made.path_inefficiency == pytest.approx(20)
  assert made.number_of_movements == 1  # 100 mm/s
  assert made.idle_time == 0 and made.idle_share == 0
  reasons = made.reasons()
  assert reasons["peak_force"] == "force not recorded"
  assert reasons["angular_path"] == "quat not recorded"
  assert reasons["depth_path"] == "axis not recorded"
  assert reasons["errors"] == "no kind of error was watched for"
  assert reasons["grasp_slips"] == "grip and held not recorded"
  assert reasons["target_error"] == "no target was touched"
  assert reasons["trace_rms"] == reasons["trace_frechet"] == "no curve to trace"
  assert reasons["bimanual_dexterity"] == "a single instrument"


@pytest.mark.parametrize("outcome", ["time limit", "stopped", "damage"])
def test_the_path_of_what_was_not_finished_is_not_compared_with_the_whole(outcome):
  made = dataclasses.replace(plain(LINE).recording(), info={"outcome": outcome}).metrics()
  assert made.reasons()["path_inefficiency"] == "the exercise was not finished"
  assert made.path_length == pytest.approx(0.12)
  done = dataclasses.replace(plain(LINE).recording(), info={"outcome": "success"}).metrics()
  assert done.path_inefficiency == pytest.approx(20)


def test_metrics_agree_with_the_functions():
  made = exercise(instruments=("only",))
  data, got = made.recording(), made.metrics()
  time, pos = data.time, data.column("tip_pos")
  force, limit = data.column("force"), SETTINGS.force_limit
  assert got.path_length == functions.path_length(pos)
  assert got.sparc == functions.sparc(*functions.uniform_speed(time, pos))
  assert got.rms_force == functions.rms_force(time, force)
  assert got.excess_impulse == functions.excess_impulse(time, force, limit)
  assert got.peak_pressure == functions.peak_pressure(force, data.column("area"))
  assert got.target_error == pytest.approx(0.003)
  assert got.errors == 1
  assert got.grasp_slips == 3  # held ends at 40, the jaw opens at 60, three times
  # quat turns about y: the shaft, its z, is (sin a, 0, cos a) with a = 0.6 sin(k / 40).
  angle = 0.6 * np.sin(np.arange(300) / 40)
  axis = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], 1)
  assert got.depth_path == pytest.approx(functions.depth_path(pos, axis), rel=1e-12)
  assert got.angular_path == pytest.approx(np.abs(np.diff(angle)).sum(), rel=1e-9)
  assert got.response_orientation == pytest.approx(0, abs=1e-12)


def test_the_recorded_axis_goes_before_the_derived_one():
  quat = np.tile([1.0, 0, 0, 0], (61, 1))
  assert plain(LINE, quat=quat).metrics().depth_path == 0
  axis = np.tile([1.0, 0, 0], (61, 1))
  assert plain(LINE, quat=quat, axis=axis).metrics().depth_path == pytest.approx(0.12)


def test_a_still_instrument_is_unknown_not_perfect():
  quat = np.tile([1.0, 0, 0, 0], (61, 1))
  still = plain(0 * LINE, quat=quat, force=np.zeros(61)).metrics()
  reasons = still.reasons()
  for name in ("path_length", "path_inefficiency", "sparc", "log_dimensionless_jerk"):
    assert reasons[name] == "no motion"
  for name in ("angular_path", "response_orientation", "depth_path", "number_of_movements"):
    assert reasons[name] == "no motion"
  for name in ("peak_force", "mean_force", "force_time_product", "force_breaches"):
    assert reasons[name] == "no contact"
  assert still.idle_share == 100
  assert plain(LINE, quat=quat).metrics().angular_path == 0  # moved without turning: known


def test_who_waits_while_a_knot_is_tested_is_not_idle():
  tested = np.r_[np.zeros(31), np.linspace(0.1, 2.0, 30)]
  idle = [
    plain(0 * LINE, force=np.zeros(61), security=security).metrics().idle_time
    for security in (np.zeros(61), tested)
  ]
  assert idle[1] == pytest.approx(0.5 * idle[0]) and idle[0] > 0.5


def test_instruments_combine():
  made = exercise()
  both, left, right = made.metrics(), made.metrics(0), made.metrics(1)
  assert both.path_length == left.path_length + right.path_length
  assert both.peak_force == max(left.peak_force, right.peak_force)
  assert both.sparc == (left.sparc + right.sparc) / 2
  assert both.time == left.time
  assert both.idle_time < min(left.idle_time, right.idle_time)
  assert -1 <= both.bimanual_dexterity <= 1 and math.isnan(left.bimanual_dexterity)
  assert (left.errors, right.errors, both.errors) == (1, 0, 1)
  assert left.target_error == 0.002 and right.target_error == 0.004


def test_an_idle_second_instrument_does_not_hide_the_first():
  recorder = Recorder(("left", "right"), SETTINGS)
  for k, point in enumerate(LINE):
    recorder.append(k * 0.02, [point, [0, 0, 0]], force=[1.0, math.nan])
  assert recorder.metrics().path_length == pytest.approx(0.12)
  assert recorder.metrics().peak_force == 1  # the right one has no sensor
  assert recorder.metrics(1).reasons()["peak_force"] == "force not recorded"
  assert recorder.metrics().reasons()["bimanual_dexterity"].startswith("an instrument's speed")


def test_bad_data_of_one_instrument_is_not_hidden():
  recorder = Recorder(("left", "right"), SETTINGS)
  for k, point in enumerate(LINE):
    recorder.append(k * 0.02, [point, point if k != 30 else [math.nan] * 3])
  made = recorder.metrics()
  for name in ("path_length", "path_inefficiency", "sparc", "number_of_movements", "idle_time"):
    assert made.reasons()[name] == "tip_pos is not finite at sample 30", name
  assert recorder.metrics(0).path_length == pytest.approx(0.12)


def test_tracing_counts_the_contact_only():
  recorder = Recorder(settings=SETTINGS)
  recorder.attach("curve", [[0.02, 0, 0], [0.1, 0, 0]])
  for k, point in enumerate(LINE):
    touching = 0.02 <= point[0] <= 0.1
    height = 0.001 if touching else 0.5
    recorder.append(k * 0.02, [point[0], 0, height], force=float(touching))
  assert recorder.metrics().trace_rms == pytest.approx(0.001)
  # The tip is sampled every 2 mm: the point half-way is 1 mm along and 1 mm across from either.
  assert recorder.metrics().trace_frechet == pytest.approx(math.hypot(1e-3, 1e-3), rel=1e-3)
  lifted = Recorder(settings=SETTINGS)  # in the middle, for 10 mm, by 8 mm
  lifted.attach("curve", [[0.02, 0, 0], [0.1, 0, 0]])
  for k in range(81):
    off = 35 < k < 45
    lifted.append(k * 0.02, [0.02 + k * 1e-3, 0, 0.008 if off else 0], force=0.0 if off else 1.0)
  assert lifted.metrics().trace_rms == pytest.approx(0, abs=1e-12)
  assert lifted.metrics().trace_frechet == pytest.approx(0.008, rel=1e-2)
  never = plain(LINE, force=np.zeros(61))
  never.attach("curve", LINE[:2])
  assert never.metrics().reasons()["trace_rms"] == "no contact"
  unmeasured = plain(LINE)
  unmeasured.attach("curve", LINE[[0, -1]])
  assert unmeasured.metrics().trace_rms == pytest.approx(0, abs=1e-12)


def test_watched_events_without_an_event_are_a_known_zero():
  def counts(watch, *events):
    recorder = Recorder(watch=watch)
    for k in range(3):
      recorder.append(k * 0.1, [k, 0, 0])
    for kind in events:
      recorder.event(kind, 0.1)
    return recorder.metrics().errors, recorder.metrics().grasp_slips

  assert counts(["miss", "slip"]) == (0, 0)
  assert counts([], "drop", "slip", "slip", "miss", "target") == (2, 2)
  assert all(isinstance(v, Unknown) for v in counts(["target"]))


def test_forces_between_the_samples_count():
  # A tap of 2 N for 5 of every 20 ms: its maxima alone would make four times the impulse.
  span = np.where(np.arange(20) < 5, 2.0, 0.0)
  recorder = Recorder(settings=SETTINGS, substeps=20)
  recorder.append(0.0, LINE[0], force=0.0, grip_force=0.0, shaft_force=0.0)
  for k, point in enumerate(LINE[1:], 1):
    recorder.append(k * 0.02, point, force=span, grip_force=3.0, shaft_force=span)
  made, data = recorder.metrics(), recorder.recording()
  assert len(data.signal_time) == 1 + 60 * 20 == len(data.signal("force"))
  np.testing.assert_allclose(np.diff(data.signal_time), 1e-3, atol=1e-12)
  np.testing.assert_array_equal(data.signal_time[::20], data.time)
  assert made.force_time_product == pytest.approx(60 * 5e-3 * 2)
  assert made.shaft_contact == pytest.approx(60 * 5e-3)
  assert (made.peak_force, made.mean_force, made.rms_force) == (2, 2, 2)
  assert made.force_breaches == 1  # 15 ms under the limit do not end it
  assert made.peak_grip == 3 and made.grip_breaches == 1
  assert made.grip_ratio == pytest.approx(3 / 2)  # while both act
  assert data.touching().tolist() == [False] + [True] * 60


def test_forces_between_the_samples_are_kept(tmp_path):
  recorder = Recorder(("left", "right"), substeps=3)
  values = np.arange(24.0).reshape(4, 2, 3)
  for k, value in enumerate(values):
    recorder.append(k * 0.3, np.zeros((2, 3)), force=value, shaft_force=[1.0, 2.0])
  data = Recording.load(recorder.save(tmp_path / "a.npz"))
  # The first sample ends no span: its last value is its own.
  assert data.force(1).tolist() == [5, *values[1:, 1].ravel()]
  assert data.signal_time.tolist() == pytest.approx(np.linspace(0, 0.9, 10).tolist())
  assert data.signal("shaft_force", 1).tolist() == [2] * 10
  assert data.metrics(1) == recorder.metrics(1)
  for bad in (np.zeros((2, 3, 3)), np.zeros((2, 4))):
    with pytest.raises(ValueError, match=r"force has shape .*, expected \(2, 3\)"):
      recorder.append(2.0, np.zeros((2, 3)), force=bad)
  with pytest.raises(ValueError, match="substeps is 0, expected a whole number >= 1"):
    Recorder(substeps=0)
