"""Limits of a programme's own experts: their rules by hand, and the file."""

import json

import numpy as np
import pytest
from palpate.tasks.metrics import Metrics
from palpate.tasks.people import limits, score

TIMES, SMOOTH = [10.0, 12.0, 14.0, 16.0, 18.0], [-2.0, -3.0, -4.0, -5.0, -6.0]
EXPERTS = [
  Metrics(time=t, log_dimensionless_jerk=s, errors=0) for t, s in zip(TIMES, SMOOTH, strict=True)
]


@pytest.mark.parametrize(
  ("rule", "time", "jerk"),
  [
    ("sd:2", 14 + 2 * np.sqrt(10), -4 - 2 * np.sqrt(2.5)),
    ("sd:0", 14, -4),
    ("percentile:100", 18, -6),
    ("percentile:75", 16, -5),
    ("percentile:95", 17.6, -5.8),
  ],
)
def test_limits_are_those_by_hand(rule, time, jerk):
  rows = limits.of_people(EXPERTS, "touch/easy", rule)["metrics"]
  assert rows["time"]["limit"] == pytest.approx(time)
  assert rows["log_dimensionless_jerk"]["limit"] == pytest.approx(jerk)
  assert rows["errors"]["limit"] == 0


def test_the_rule_is_that_of_the_references_that_ship_unless_told_otherwise():
  made = limits.of_people(EXPERTS, "touch/easy")
  panel = score.make_reference(EXPERTS, "touch/easy", 0)
  assert made["metrics"] == panel["metrics"]
  score.check_reference(made)


def test_a_file_is_read_back_and_others_have_what_ships(tmp_path):
  made = {"touch/easy": limits.of_people(EXPERTS, "touch/easy", "sd:2")}
  path = tmp_path / "own.json"
  path.write_text(limits.to_json(made))
  assert limits.read(path) == made
  lines = path.read_text().splitlines()
  assert sum('"mean":' in line and '"limit":' in line for line in lines) == 3  # a line a metric
  known = limits.lookup(path)
  assert known("touch/easy") == made["touch/easy"]
  assert known("touch/hard") == score.reference("touch/hard") and known("my/own") is None
  path.write_text(json.dumps(score.reference("probe/easy")))  # of one task, as panel writes it
  assert list(limits.read(path)) == ["probe/easy"]


@pytest.mark.parametrize("text", ["", "sd", "sd:x", "sd:-1", "sd:nan", "percentile:0", "best:3"])
def test_a_wrong_rule_says_what_is_one(text):
  with pytest.raises(ValueError, match="expected panel, sd:K or percentile:P"):
    limits.rule(text)


@pytest.mark.parametrize(
  ("text", "said"),
  [
    ("{", "Expecting"),
    ("[]", "format is 'list'"),
    ('{"format": "palpate-references", "version": 9}', "version is 9"),
    ('{"format": "palpate-references", "version": 1}', "'references' is missing"),
    ('{"format": "palpate-references", "version": 1, "references": {"a": 1}}', "format is 'int'"),
  ],
)
def test_what_is_no_file_of_references_is_named(tmp_path, text, said):
  path = tmp_path / "own.json"
  path.write_text(text)
  with pytest.raises(ValueError, match=r"own\.json: ") as error:
    limits.read(path)
  assert said in str(error.value)


def test_few_experts_make_no_limits():
  with pytest.raises(ValueError, match="4 successes, expected 5 or more"):
    limits.of_people(EXPERTS[:4], "touch/easy")
