"""The scripts that measure the exercises: what they write; that they go on where they stopped."""

import collections
import pathlib
import sys

import numpy as np
import pytest
from benchmarks import results
from benchmarks.exercises import experts, learning, loopholes, skill
from palpate.app import cli, panel
from palpate.tasks.core import performer
from palpate.tasks.people import score

HERE = pathlib.Path(__file__).parent
# Share of experts that are not proficient where it is above 5 %: rare peaks of pressure and strain,
# a cut that is gone over again, force on what is around a probe, gaps of a running suture whose
# references are older, how jaws strike a thread, how fast a stitch's force rises, and how long its
# instruments are out of view.
SHORT = {"cut/easy": 0.08, "cut/standard": 0.2, "navigate/hard": 0.06,
         "probe/palpate_easy": 0.14, "retract/hard": 0.06, "suture/knot_easy": 0.07,
         "suture/running_hard": 0.08,
         "suture/stitch_easy": 0.23, "suture/stitch_standard": 0.26}  # fmt: skip


def command(*words) -> int:
  return cli.main(["bench", *map(str, words)])


def table(path):
  return results.read(path)


def test_success_and_skill_come_from_kept_episodes(tmp_path, monkeypatch):
  monkeypatch.setattr(skill, "SKILL_TASKS", ("touch/easy",))
  where = ("--runs", tmp_path / "runs", "--episodes", 2)
  words = ("experts", "-o", tmp_path / "a", "--tasks", "touch/easy", *where)
  assert command(*words) == 0
  rows = table(tmp_path / "a" / "experts.csv")
  assert {row["task"] for row in rows} == {"touch/easy"}
  expert, people, novices, faults = ([r for r in rows if r["who"] == g] for g in experts.GROUPS)
  assert [row["seed"] for row in expert] == [row["seed"] for row in people] == [0, 1]
  assert all(row["outcome"] == "success" and row["proficient"] for row in expert)
  assert {row["style"] for row in faults} == set(performer.NOVICES) and len(faults) == 10
  assert len(novices) == 2 and not any(row["proficient"] for row in novices)
  assert "| touch/easy | 2 of 2 | 100 % |" in (tmp_path / "a" / "experts.md").read_text()

  assert command("skill", "-o", tmp_path / "a", *where) == 0
  monkeypatch.setattr(panel, "perform", None)  # nothing is run again
  assert command(*words) == 0
  assert command("skill", "-o", tmp_path / "b", *where) == 0
  text = (tmp_path / "a" / "skill.md").read_text()
  assert text == (tmp_path / "b" / "skill.md").read_text()
  assert "Success: expert 2/2" in text
  assert "| Time to completion | delay | all |  |" in text
  assert "| Out of view | no novice is made to |" in text


def test_kept_results_are_of_the_tasks():
  rows = table(HERE / "results" / "exercises_cpu.csv")
  tasks_of = [row["task"] for row in rows]
  assert len(set(tasks_of)) == len(tasks_of) and set(tasks_of) <= set(experts.NAMES)


def test_kept_episodes_rank_as_they_should():
  groups = collections.defaultdict(list)
  for row in table(HERE / "results" / "experts.csv"):
    groups[row["task"], row["who"]].append(row)

  def share(rows):
    return np.mean([row["proficient"] for row in rows])

  names = {name for name, _ in groups}
  assert names >= {row["task"] for row in table(HERE / "results" / "exercises_cpu.csv")}
  for name in names:
    expert, people, novice = (groups[name, who] for who in ("expert", "skilled", "novice"))
    assert len(expert) >= 12 and {row["outcome"] for row in expert} == {score.SUCCESS}, name
    missed = sum(not row["proficient"] for row in expert)
    assert missed <= max(1, SHORT.get(name, 0.05) * len(expert)), name
    assert not people or share(people) >= 0.75, name
    assert not novice or share(novice) == 0, name


@pytest.mark.parametrize("kind", loopholes.KINDS)
@pytest.mark.parametrize("search", loopholes.SEARCHES)
def test_a_search_tries_policies_and_finds_no_success_without_the_work(kind, search):
  pytest.importorskip("cma")
  attack = loopholes.Attack("touch/easy", kind, length=0.4)
  tried = loopholes.Log(attack, "score")
  loopholes.SEARCHES[search](tried, attack.size, 2, 0)
  assert len(tried.tried) == 2
  policy, end = tried.best
  assert abs(policy).max() <= 1 and (end.won == end.honest)
  assert end.won or (end.paid < 0.5 and end.points == score.FLOOR and not end.proficient)
  late = loopholes.Log(attack, "reward", seconds=0.0)
  late(policy)  # one at least
  with pytest.raises(loopholes.OutOfTimeError):
    late(policy)


def test_the_expert_does_the_work():
  attack = loopholes.Attack("touch/easy", "styled")
  low, high = np.array(list(loopholes.MANNERS.values())).T
  expert = np.array([getattr(performer.EXPERT, name) for name in loopholes.MANNERS])
  end = attack.play(2 * (expert - low) / (high - low) - 1, 0)
  assert end.honest and end.points > score.FLOOR and end.paid > 0.9


@pytest.mark.slow
def test_loopholes_writes_its_page(tmp_path):
  pytest.importorskip("cma")
  words = ("--tries", 4, "--tasks", "retract/easy", "--kinds", "blind", "-o", tmp_path)
  assert command("loopholes", *words) == 0
  rows = table(tmp_path / "loopholes.csv")
  assert len(rows) == 3 and not any(row["policies_without_the_work"] for row in rows)
  assert "| retract/easy | blind |" in (tmp_path / "loopholes.md").read_text()


def test_the_kept_search_found_no_loophole():
  for row in table(HERE / "results" / "loopholes.csv"):
    assert row["status"] == "ok", row["case"]
    assert not row["policies_without_the_work"] and not row["failures_with_a_score"], row["case"]
    paid = float(row["most_without_success"]), float(row["least_with_success"])
    assert not paid[0] >= paid[1], row["case"]  # which may be unknown


@pytest.mark.slow
def test_a_race_against_itself_is_even(tmp_path):
  words = ("--tasks", "touch/easy", "--seconds", 0.1, "--against", sys.executable, "-o", tmp_path)
  assert command("speed", *words) == 0
  (row,) = table(tmp_path / "exercises_cpu.csv")
  assert 0.5 < float(row["times"]) < 2 and row["solved"] == row["solved_before"] == 1
  assert "times the tree before" in (tmp_path / "exercises.md").read_text()


@pytest.mark.slow
def test_learning_writes_table_and_curve(tmp_path):
  pytest.importorskip("torch")
  assert command("learning", "--short", "--device", "cpu", "-o", tmp_path) == 0
  rows = table(tmp_path / "learning.csv")
  steps = [int(row["steps"]) for row in rows]
  assert {row["task"] for row in rows} == {"touch/easy"} and steps == sorted(steps)
  assert (tmp_path / "learning.png").read_bytes()[:4] == b"\x89PNG"
  assert "0 of 1 trainings" in (tmp_path / "learning.md").read_text()


def test_what_was_kept_was_learned_from_nothing():
  found = learning.trainings(results.read(HERE / "results" / "learning.csv"))
  learned = {"touch/easy", "trace/easy", "probe/easy"}  # the page says which others were tried
  assert learned <= set(found)
  for task, curves in found.items():
    for first, *_, last in curves:
      assert first["success"] < 10, task
      assert task not in learned or last["judged"] >= 90, task
