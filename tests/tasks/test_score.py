"""The metrics object, expert references and the composite score."""

import copy
import json
import math

import pytest
from palpate import tasks
from palpate.tasks import score as scoring
from palpate.tasks.metrics import METRICS, Metrics, Unknown
from palpate.tasks.score import WEIGHTS, make_reference, score, z_score


def _reference(**rows):
  table = {k: {"mean": m, "sd": s, "n": 5} for k, (m, s) in rows.items()}
  return {"format": "palpate-reference", "version": 1, "seed": 0, "n": 5, "metrics": table}


def test_table_is_consistent():
  assert math.isclose(sum(WEIGHTS.values()), 1.0)
  assert WEIGHTS["safety"] == 0.67 and WEIGHTS["efficiency"] == 0.17
  for name, spec in METRICS.items():
    assert spec.group in WEIGHTS, name
    assert spec.better in ("lower", "higher") and spec.combine in ("sum", "max", "mean", "all")
    assert spec.source and spec.label, name
  assert (METRICS["path_length"].shown, METRICS["path_length"].scale) == ("mm", 1000)
  assert METRICS["angular_path"].scale * math.pi == pytest.approx(180)
  assert {n for n, s in METRICS.items() if s.better == "higher"} == {
    "sparc",
    "log_dimensionless_jerk",
    "bimanual_dexterity",
  }


def test_metrics_json_round_trip_is_exact():
  made = Metrics(time=0.1 + 0.2, path_length=1e-300, peak_force=Unknown("no contact"))
  again = Metrics.from_json(made.to_json())
  assert again == made and hash(again) == hash(made)
  assert again.time == 0.1 + 0.2
  assert again.reasons()["peak_force"] == "no contact"
  data = json.loads(made.to_json())
  assert data["values"]["peak_force"] is None
  assert data["unit"]["path_length"] == "m" and data["better"]["sparc"] == "higher"
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
  assert made["metrics"]["time"] == {"mean": 12.0, "sd": 2.0, "n": 3}
  assert made["metrics"]["peak_force"] == pytest.approx({"mean": 1.5, "sd": math.sqrt(0.5), "n": 2})
  assert made["metrics"]["errors"] == {"mean": 0.0, "sd": 0.0, "n": 3}
  assert "path_length" not in made["metrics"]
  assert (made["seed"], made["n"], made["task"], made["version"]) == (7, 3, "touch", 1)
  assert json.loads(json.dumps(made, allow_nan=False)) == made
  assert make_reference(results[:1], "touch", 7)["metrics"]["time"]["sd"] is None
  equal = make_reference([Metrics(time=0.1)] * 3, "touch", 7)["metrics"]["time"]
  assert equal == {"mean": 0.1, "sd": 0.0, "n": 3}  # the sum of three 0.1 rounds


def test_composite_by_hand():
  reference = _reference(time=(10, 2), path_length=(0.2, 0.1), peak_force=(2, 0.5), errors=(1, 1))
  made = Metrics(time=14.0, path_length=0.15, peak_force=3.0, errors=2.0)
  result = score(made, reference)
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
  assert result.limit == pytest.approx(
    {"time": 14, "path_length": 0.4, "peak_force": 3.0, "errors": 3}
  )
  assert result.proficient and not result.missing


def test_composite_of_the_expert_mean_is_zero_and_at_the_limit_minus_two():
  names = list(METRICS)
  reference = _reference(**{n: (1.5, 0.25) for n in names})
  assert score(Metrics(**{n: 1.5 for n in names}), reference).composite == 0
  limits = score(Metrics(**{n: 1.5 for n in names}), reference).limit
  assert limits["sparc"] == 1.0 and limits["time"] == 2.0  # each in its worse direction
  at_limit = score(Metrics(**limits), reference)
  assert at_limit.composite == pytest.approx(-2) and at_limit.proficient
  over = score(Metrics(**{**limits, "peak_force": 2.01}), reference)
  assert not over.proficient


def test_safety_outweighs_the_rest():
  names = list(METRICS)
  reference = _reference(**{n: (1.5, 0.25) for n in names})

  def moved(unsafe, by):
    return Metrics(
      **{
        n: 1.5
        + (by if (s.group == "safety") == unsafe else -by) * (1 if s.better == "lower" else -1)
        for n, s in METRICS.items()
      }
    )

  assert score(moved(True, 0.25), reference).composite < 0  # unsafe, better in all else
  assert score(moved(False, 0.25), reference).composite > 0


def test_unknown_metrics_drop_out_and_safety_must_be_known():
  reference = _reference(time=(10, 2), peak_force=(2, 0.5), force_breaches=(1, 1))
  partly = score(Metrics(time=10.0, peak_force=2.5, force_breaches=Unknown("no limit")), reference)
  assert partly.group["safety"] == pytest.approx(-1)
  assert partly.missing == ("force_breaches",) and not partly.proficient
  unsafe = score(Metrics(time=10.0), reference)
  assert isinstance(unsafe.composite, Unknown)
  assert "safety" in unsafe.composite.reason and not unsafe.proficient
  assert unsafe.weight["safety"] == 0
  no_spread = _reference(time=(10, 2), peak_force=(2, 0.5), path_length=(0.1, None))
  assert not score(Metrics(time=10.0, peak_force=2.0), no_spread).proficient
  assert score(Metrics(time=10.0, peak_force=2.0, path_length=9.0), no_spread).proficient
  nothing = score(Metrics(), _reference())
  assert math.isnan(nothing.composite) and not nothing.proficient


def test_a_reference_of_one_recording_gives_no_score():
  made = Metrics(time=10.0, peak_force=2.0)
  result = score(made, make_reference([made], "touch", 0))
  assert math.isnan(result.composite) and not result.proficient and not result.missing
  assert result.limit == {}


def test_own_weights():
  reference = _reference(time=(10, 2), peak_force=(2, 0.5))
  weights = dict.fromkeys(WEIGHTS, 0) | {"time": 5}
  assert score(Metrics(time=12.0, peak_force=9.0), reference, weights).composite == -1
  with pytest.raises(ValueError, match="all 0"):
    score(Metrics(), reference, dict.fromkeys(WEIGHTS, 0))
  with pytest.raises(ValueError, match="weights are"):
    score(Metrics(), reference, {"safety": 1})
  with pytest.raises(ValueError, match="weights are"):
    score(Metrics(), reference, WEIGHTS | {"time": -1})


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
    score(Metrics(time=1.0), reference)
  with pytest.raises(ValueError, match="format is 'list'"):
    scoring.check_reference([])


def test_references_are_those_of_the_tasks():
  for pair in tasks.ALL_TASKS:
    name = "/".join(pair)
    reference = scoring.reference(name)
    assert reference is not None, name
    assert reference["task"] == name and reference["n"] >= 5
    assert {"seed", "palpate", "mujoco"} < set(reference)
