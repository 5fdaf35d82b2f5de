"""The metrics object, expert references and the composite score."""

import copy
import json
import math

import numpy as np
import pytest
from palpate import tasks
from palpate.tasks import suite
from palpate.tasks.metrics import METRICS, Metrics, Unknown
from palpate.tasks.people import score as scoring
from palpate.tasks.people.score import SUCCESS, WEIGHTS, make_reference, score, z_score

SCORED = [name for name, spec in METRICS.items() if spec.better != "neither"]


def _reference(**rows):
  """Of metric=(mean, sd), the limits being two SDs away in the worse direction."""
  table = {}
  for name, (mean, sd) in rows.items():
    worse = -2 if METRICS[name].better == "higher" else 2
    table[name] = {"mean": mean, "sd": sd, "n": 5, "limit": mean + worse * (sd or 0)}
  return {"format": "palpate-reference", "version": 2, "seed": 0, "n": 5, "metrics": table}


def _limits(reference):
  return {name: row["limit"] for name, row in reference["metrics"].items()}


def test_table_is_consistent():
  assert math.isclose(sum(WEIGHTS.values()), 1.0)
  assert WEIGHTS["safety"] == 0.67 and WEIGHTS["efficiency"] == 0.17
  for name, spec in METRICS.items():
    assert spec.group in WEIGHTS, name
    assert spec.better in ("lower", "higher", "neither"), name
    assert spec.combine in ("sum", "max", "mean", "all"), name
    assert spec.source and spec.label, name
  assert (METRICS["path_length"].shown, METRICS["path_length"].scale) == ("mm", 1000)
  assert METRICS["angular_path"].scale * math.pi == pytest.approx(180)
  assert {n for n, s in METRICS.items() if s.better == "higher"} == {"log_dimensionless_jerk"}
  shown = {"mean_speed", "economy_of_volume", "sparc", "bimanual_dexterity", "share_freed"}
  shown |= {"bite_depth", "knot_security"}
  assert set(METRICS) - set(SCORED) == shown


def test_metrics_json_round_trip_is_exact():
  made = Metrics(time=0.1 + 0.2, path_length=1e-300, peak_force=Unknown("no contact"))
  again = Metrics.from_json(made.to_json())
  assert again == made and hash(again) == hash(made)
  assert again.time == 0.1 + 0.2
  assert again.reasons()["peak_force"] == "no contact"
  data = json.loads(made.to_json())
  assert data["values"]["peak_force"] is None
  assert data["unit"]["path_length"] == "m" and data["better"]["log_dimensionless_jerk"] == "higher"
  assert made != Metrics(time=0.3, path_length=1e-300, peak_force=Unknown("no contact"))
  assert made != Metrics(time=0.1 + 0.2, path_length=1e-300, peak_force=Unknown("other"))
  assert Metrics() == Metrics() and set(Metrics().reasons()) == set(METRICS)
  assert Metrics(time=math.inf).reasons()["time"] == "the value is inf"


@pytest.mark.parametrize(
  ("text", "match"),
  [
    ("[]", "format is 'list'"),
    ('{"format": "other"}', "format is 'other'"),
    ('{"format": "palpate-metrics", "version": 2}', "version is 2"),
    ('{"format": "palpate-metrics", "version": 1, "values": 3}', "must be objects"),
    ('{"format": "palpate-metrics", "version": 1, "values": {"tme": 1}}', "no such metric 'tme'"),
    ("{", "Expecting"),
  ],
)
def test_metrics_json_refuses_strangers(text, match):
  with pytest.raises(ValueError, match=match):
    Metrics.from_json(text)


def test_z_score_directions_and_clip():
  assert z_score(8.0, 10.0, 1.0, "lower") == 2
  assert z_score(8.0, 10.0, 1.0, "higher") == -2
  assert z_score(1e9, 10.0, 1.0, "lower") == -10
  assert z_score(1e9, 10.0, 1.0, "higher") == 10


def test_z_score_without_spread():
  assert z_score(0.0, 0.0, 0.0, "lower") == 0
  assert z_score(1.0, 0.0, 0.0, "lower") == -10
  assert z_score(0.0, 1.0, 0.0, "lower") == 0  # better than a constant expert: no scale, no credit
  assert z_score(0.0, 1.0, 0.0, "higher") == -10
  assert z_score(12.0 * (1 + 1e-12), 12.0, 0.0, "lower") == 0  # rounding is not a fault
  assert z_score(12.0 * (1 + 1e-6), 12.0, 0.0, "lower") == -10
  assert "no SD" in z_score(1.0, 1.0, None, "lower").reason
  assert z_score(Unknown("no contact"), 1.0, 1.0, "lower").reason == "no contact"
  assert math.isnan(z_score(math.nan, 1.0, 1.0, "lower"))


def test_make_reference():
  times, forces = [10.0, 12.0, 14.0], [1.0, Unknown("no contact"), 2.0]
  results = [Metrics(time=t, peak_force=f, errors=0.0) for t, f in zip(times, forces, strict=True)]
  made = make_reference(results, "touch", seed=7)
  # By log(1 + t / 12), from the median to what 90 % are as good as, a normal one's 1.2816 SDs.
  a, b, c = (math.log1p(t / 12) for t in times)
  spread = (np.quantile([a, b, c], 0.9) - b) / 1.2816
  limit = pytest.approx(12 * math.expm1(b + 2.5 * spread))
  assert made["metrics"]["time"] == {"mean": 12.0, "sd": 2.0, "n": 3, "limit": limit}
  force = {"mean": 1.5, "sd": math.sqrt(0.5), "n": 2, "limit": 2.0}
  assert made["metrics"]["peak_force"] == pytest.approx(force)
  assert made["metrics"]["errors"] == {"mean": 0.0, "sd": 0.0, "n": 3, "limit": 0.0}
  assert "path_length" not in made["metrics"]
  assert (made["seed"], made["n"], made["task"], made["version"]) == (7, 3, "touch", 2)
  assert json.loads(json.dumps(made, allow_nan=False)) == made
  assert make_reference(results[:1], "touch", 7)["metrics"]["time"]["sd"] is None
  equal = make_reference([Metrics(path_length=0.1)] * 3, "touch", 7)["metrics"]["path_length"]
  # The sum of three 0.1 rounds. A tenth more is no fault where a panel never varies.
  assert equal == {"mean": 0.1, "sd": 0.0, "n": 3, "limit": pytest.approx(0.11)}
  fast = make_reference([Metrics(time=1.0, mean_speed=0.1)] * 2, "touch", 7)
  assert "mean_speed" not in fast["metrics"]


def _panel(count, seed):
  rng = np.random.RandomState(seed)
  rows = {f: rng.rand(count) for f in ("mean_force", "rms_force", "path_length", "depth_path")}
  rows |= {"time": 10 + rng.rand(count), "peak_force": rng.gamma(2.0, size=count)}
  return [Metrics(**{k: v[i] for k, v in rows.items()}, errors=0.0) for i in range(count)]


def test_limits_let_a_new_person_of_the_panels_skill_pass():
  reference = make_reference(_panel(32, 0), "touch", 0)
  passed = np.mean([score(one, reference, SUCCESS).proficient for one in _panel(500, 1)])
  assert passed >= 0.88
  slow = [Metrics(**one.values() | {"time": one.time + 2.0}) for one in _panel(500, 1)]
  assert np.mean([score(one, reference, SUCCESS).proficient for one in slow]) < 0.3
  assert _limits(reference)["errors"] == 0


def test_one_freak_of_a_panel_does_not_make_a_limit():
  panel = _panel(32, 0)
  panel[7] = Metrics(
    time=900.0,
    path_length=0.5,
    depth_path=0.5,
    errors=3.0,
    mean_force=0.5,
    rms_force=0.5,
    peak_force=1.0,
  )
  reference = make_reference(panel, "touch", 0)
  assert _limits(reference)["time"] < 13 and _limits(reference)["errors"] == 0
  assert not score(panel[7], reference, SUCCESS).proficient


def test_a_freak_in_one_metric_does_not_move_the_limits_of_others():
  panel = _panel(32, 0)
  before = _limits(make_reference(panel, "touch", 0))
  panel[7] = Metrics(**{**panel[7].values(), "peak_force": 90.0})
  after = _limits(make_reference(panel, "touch", 0))
  assert after["peak_force"] < 3 * before["peak_force"]
  assert after["time"] == pytest.approx(before["time"], rel=0.02)


def test_a_limit_is_below_what_ends_an_exercise_and_below_all_of_a_share():
  panel = [Metrics(time=float(t), idle_share=9.0 * t, peak_force=1.0) for t in range(5, 13)]
  ends = {"time": 12.0, "peak_force": 3.0}
  limits = _limits(make_reference(panel, "touch", 0, ends))
  assert limits == {"time": pytest.approx(10.8), "idle_share": 90, "peak_force": pytest.approx(1.1)}
  assert suite.ends("touch/easy")["time"] == 10 and suite.ends("grasp/hard")["peak_grip"] == 6
  assert "peak_grip" not in suite.ends("suture/drive_easy")  # of a needle


def test_movements_are_not_scored_where_some_of_the_panel_are_too_slow_for_any():
  panel = [Metrics(time=10.0 + i, number_of_movements=float(i)) for i in range(4)]
  assert "number_of_movements" not in make_reference(panel, "touch", 0)["metrics"]
  assert "number_of_movements" in make_reference(panel[1:], "touch", 0)["metrics"]


def test_a_metric_that_some_of_the_panel_lack_is_not_asked_for():
  panel = [Metrics(time=10.0 + i, peak_force=1.0 if i else Unknown("no contact")) for i in range(4)]
  reference = make_reference(panel, "touch", 0)
  result = score(Metrics(time=10.0), reference, SUCCESS)
  assert result.proficient and result.missing == ()
  assert not score(Metrics(time=10.0, peak_force=1.1), reference, SUCCESS).proficient
  assert score(Metrics(peak_force=1.0), reference, SUCCESS).missing == ("time",)


# The outcome.


@pytest.mark.parametrize("outcome", ["error", "stopped", "time limit", "damage", "missed"])
def test_what_did_not_succeed_scores_the_floor(outcome):
  reference = _reference(time=(10, 2), path_length=(0.2, 0.1), peak_force=(2, 0.5))
  best = Metrics(time=0.1, path_length=0.0, peak_force=0.0)  # a hand that stopped at once
  worst = score(Metrics(time=1e9, path_length=1e9, peak_force=1e9), reference, SUCCESS)
  failed = score(best, reference, outcome)
  assert failed.composite == scoring.FLOOR < worst.composite == -10
  assert not failed.proficient and failed.over == ()
  slow = score(Metrics(time=1e9, path_length=1e9, peak_force=1e9), reference, outcome)
  assert slow.over == ("peak_force",)  # a time or a path that broke off is not compared
  for name in ("time", "path_length"):
    assert "not finished" in failed.z[name].reason and name not in failed.missing
  assert score(Metrics(), reference, outcome).composite == scoring.FLOOR  # nothing is known
  assert score(best, reference, SUCCESS).proficient


def test_without_an_outcome_there_is_no_score():
  result = score(Metrics(time=1.0, peak_force=1.0), _reference(peak_force=(2, 0.5)), None)
  assert "does not say how it ended" in result.composite.reason and not result.proficient


def test_two_in_a_row_and_ten_more():
  assert scoring.trained([True] * 12) == 12
  assert scoring.trained([True] * 11) is None
  assert scoring.trained([True, False] * 30) is None  # never two in a row
  # The ten need not be in a row, nor do those before the two count.
  assert scoring.trained([True, False, True, True] + [False, True] * 10) == 24
  assert scoring.trained([]) is None


def test_composite_by_hand():
  reference = _reference(time=(10, 2), path_length=(0.2, 0.1), peak_force=(2, 0.5), errors=(1, 1))
  made = Metrics(time=14.0, path_length=0.15, peak_force=3.0, errors=2.0)
  result = score(made, reference, SUCCESS)
  # z: time -2, path +0.5, force -2, errors -1.
  assert result.z == pytest.approx({"time": -2, "path_length": 0.5, "peak_force": -2, "errors": -1})
  assert result.group["safety"] == pytest.approx(-1.5)
  w = 0.16 / 3
  expected = (0.67 * -1.5 + 0.17 * 0.5 + w * -2) / (0.67 + 0.17 + w)
  assert result.composite == pytest.approx(expected)
  assert sum(result.weight.values()) == pytest.approx(1)
  assert result.weight["outcome"] == 0 and result.weight["safety"] == pytest.approx(
    0.67 / (0.84 + w)
  )
  assert _limits(reference) == {"time": 14, "path_length": 0.4, "peak_force": 3.0, "errors": 3}
  assert result.proficient and not result.missing and not result.over


def test_composite_of_the_mean_is_zero_and_at_the_limits_minus_two():
  reference = _reference(**{n: (1.5, 0.25) for n in SCORED})
  assert score(Metrics(**{n: 1.5 for n in SCORED}), reference, SUCCESS).composite == 0
  limits = _limits(reference)
  assert (
    limits["log_dimensionless_jerk"] == 1.0 and limits["time"] == 2.0
  )  # each in its worse direction
  at_limit = score(Metrics(**limits), reference, SUCCESS)
  assert at_limit.composite == pytest.approx(-2) and at_limit.proficient
  over = score(
    Metrics(**{**limits, "peak_force": 2.2, "log_dimensionless_jerk": 0.9}), reference, SUCCESS
  )
  assert not over.proficient and set(over.over) == {"peak_force", "log_dimensionless_jerk"}
  rounded = {**limits, "time": 2.0 * (1 + 1e-12)}
  assert score(Metrics(**rounded), reference, SUCCESS).proficient


def test_safety_outweighs_the_rest():
  reference = _reference(**{n: (1.5, 0.25) for n in SCORED})

  def moved(unsafe, by):
    worse = {n: 1 if METRICS[n].better == "lower" else -1 for n in SCORED}
    return Metrics(
      **{
        n: 1.5 + worse[n] * (by if (METRICS[n].group == "safety") == unsafe else -by)
        for n in SCORED
      }
    )

  # Unsafe, better in all else; and the other way round.
  assert score(moved(True, 0.25), reference, SUCCESS).composite < 0
  assert score(moved(False, 0.25), reference, SUCCESS).composite > 0


def test_unknown_metrics_drop_out_and_safety_must_be_known():
  reference = _reference(time=(10, 2), peak_force=(2, 0.5), force_breaches=(1, 1))
  some = Metrics(time=10.0, peak_force=2.5, force_breaches=Unknown("no limit"))
  partly = score(some, reference, SUCCESS)
  assert partly.group["safety"] == pytest.approx(-1)
  assert partly.missing == ("force_breaches",) and not partly.proficient
  unsafe = score(Metrics(time=10.0), reference, SUCCESS)
  assert isinstance(unsafe.composite, Unknown)
  assert "safety" in unsafe.composite.reason and not unsafe.proficient
  assert unsafe.weight["safety"] == 0
  nothing = score(Metrics(), _reference(), SUCCESS)
  assert math.isnan(nothing.composite) and not nothing.proficient


def test_a_reference_of_one_recording_has_limits_and_no_scale():
  made = Metrics(time=10.0, peak_force=2.0)
  reference = make_reference([made], "touch", 0)
  result = score(made, reference, SUCCESS)
  assert math.isnan(result.composite) and result.proficient
  assert not score(Metrics(time=10.0, peak_force=2.4), reference, SUCCESS).proficient


def test_what_nobody_feels_is_within_every_limit():
  made = Metrics(time=10.0, shaft_contact=0.0, peak_shaft_force=0.01)
  limits = _limits(make_reference([made] * 5, "touch", 0))
  assert (limits["shaft_contact"], limits["peak_shaft_force"]) == (0.5, 0.1)


def test_no_haste_makes_up_for_a_harm():
  reference = _reference(time=(10, 2), peak_force=(2, 0.5), mean_force=(1, 0.5), errors=(1, 1))
  careful = score(Metrics(time=10.0, peak_force=2.0, mean_force=1.0, errors=1), reference, SUCCESS)
  hasty = Metrics(time=2.0, peak_force=3.5, mean_force=0.1, errors=0.0)
  rash = score(hasty, reference, SUCCESS)
  assert rash.over == ("peak_force",) and rash.group["safety"] == pytest.approx(-3.0)
  assert rash.composite < careful.composite == 0


def test_own_weights():
  reference = _reference(time=(10, 2), peak_force=(2, 0.5))
  weights = dict.fromkeys(WEIGHTS, 0) | {"time": 5}
  slow = Metrics(time=12.0, peak_force=9.0)
  assert score(slow, reference, SUCCESS, weights).composite == -1
  for weights, match in (
    (dict.fromkeys(WEIGHTS, 0), "all 0"),
    ({"safety": 1}, "weights are"),
    (WEIGHTS | {"time": -1}, "weights are"),
  ):
    with pytest.raises(ValueError, match=match):
      score(Metrics(), reference, SUCCESS, weights)


@pytest.mark.parametrize(
  ("path", "value", "match"),
  [
    (("format",), "x", "format is 'x'"),
    (("version",), 3, "version is 3"),
    (("metrics",), None, "'metrics' is missing"),
    (("metrics", "speed"), {"mean": 1, "sd": 1}, "no such metric 'speed'"),
    (("metrics", "time", "mean"), None, "time.mean is None"),
    (("metrics", "time", "mean"), math.nan, "time.mean is nan"),
    (("metrics", "time", "mean"), True, "time.mean is True"),
    (("metrics", "time", "sd"), -1, "time.sd is -1"),
    (("metrics", "time", "limit"), None, "time.limit is None"),
    (("version",), 1, "version is 1, expected 2"),
    (("metrics", "mean_speed"), {"mean": 1, "sd": 1, "limit": 1}, "mean_speed is not scored"),
    (("metrics", "time"), 3, "time.mean is None"),
  ],
)
def test_bad_references_are_named(path, value, match):
  reference = copy.deepcopy(_reference(time=(10, 2)))
  place = reference
  for key in path[:-1]:
    place = place[key]
  place[path[-1]] = value
  with pytest.raises(ValueError, match=match):
    score(Metrics(time=1.0), reference, SUCCESS)
  with pytest.raises(ValueError, match="format is 'list'"):
    scoring.check_reference([])


def test_references_are_those_of_the_tasks():
  for pair in tasks.ALL_TASKS:
    name = "/".join(pair)
    reference = scoring.reference(name)
    assert reference is not None, name
    assert reference["task"] == name and reference["n"] >= 5
    assert {"seed", "episodes", "performer", "palpate", "mujoco"} < set(reference)
