"""The scripts that measure the exercises: what they write; that they go on where they stopped."""

import os
import pathlib
import subprocess
import sys

import pytest
from benchmarks import loopholes, performances, results, run, skill

HERE = pathlib.Path(__file__).parent


def command(*words) -> int:
  return run.main([*map(str, words)])


def table(path):
  return results.read(path)


def test_success_and_skill_come_from_kept_recordings(tmp_path, monkeypatch):
  monkeypatch.setattr(skill, "SKILL_TASKS", ("touch/easy",))
  where = ("--runs", tmp_path / "runs", "--episodes", 2)
  words = ("experts", "-o", tmp_path / "a", "--tasks", "touch/easy", *where)
  assert command(*words) == 0
  (row,) = table(tmp_path / "a" / "experts.csv")
  assert (row["task"], row["success"], row["failed_seeds"]) == ("touch/easy", 2, "")

  assert command("skill", "-o", tmp_path / "a", *where) == 0
  monkeypatch.setattr(performances.episode, "run", None)  # nothing is run again
  assert command(*words) == 0
  assert command("skill", "-o", tmp_path / "b", *where) == 0
  text = (tmp_path / "a" / "skill.md").read_text()
  assert text == (tmp_path / "b" / "skill.md").read_text()
  assert "Success: expert 2/2" in text
  assert "| Time to completion | delay | all |  |" in text
  assert "| Out of view | no novice is made to |" in text


def test_kept_results_are_of_the_tasks():
  from palpate import tasks

  names = ["/".join(pair) for pair in tasks.ALL_TASKS]
  for file in ("experts.csv", "exercises_cpu.csv"):
    rows = [row["task"] for row in table(HERE / "results" / file)]
    assert len(set(rows)) == len(rows) and set(rows) <= set(names)
  # Not there yet: tissue that was lost is damaged on the next try.
  least = {"grasp/hard": 85}
  for row in table(HERE / "results" / "experts.csv"):
    assert float(row["percent"]) >= least.get(row["task"], 95), row["task"]


@pytest.mark.parametrize("kind", ["blind", "aimed"])
def test_a_search_finds_no_success_without_the_work(kind):
  pytest.importorskip("cma")
  tried = loopholes.Attack("retract/easy", kind, length=0.4)
  value = lambda policy: tried.play(policy, 0)[0]  # noqa: E731
  for search in loopholes.SEARCHES.values():
    best = search(value, tried.size, 3, 0)
    total, won, honest = tried.play(best, 0)
    assert abs(best).max() <= 1 and total < 0.3 and won == honest


@pytest.mark.slow
def test_loopholes_writes_its_page(tmp_path):
  pytest.importorskip("cma")
  assert command("loopholes", "--tries", 20, "--tasks", "retract/easy", "-o", tmp_path) == 0
  rows = table(tmp_path / "loopholes.csv")
  assert len(rows) == 4 and not any(row["policies_without_the_work"] for row in rows)
  assert "| retract/easy | blind |" in (tmp_path / "loopholes.md").read_text()


def test_learning_writes_table_and_curve(tmp_path):
  pytest.importorskip("stable_baselines3")
  # Of its own, and without drawing: Mesa's LLVM and the one that some builds of torch load clash.
  environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
  words = ("--decisions", "20", "--every", "20", "--episodes", "2", "-o", str(tmp_path))
  command = [sys.executable, str(HERE / "run.py"), "learning", *words]
  subprocess.run(command, check=True, env=environment, timeout=300)
  rows = table(tmp_path / "learning.csv")
  assert [(row["policy"], row["decisions"]) for row in rows] == [
    ("random", 0),
    ("SAC", 0),
    ("SAC", 20),
  ]
  assert (tmp_path / "learning.png").read_bytes()[:4] == b"\x89PNG"


def test_the_kept_agent_learned():
  first, *_, last = table(HERE / "results" / "learning.csv")
  assert first["policy"] == "random" and int(last["episodes"]) >= 20
  assert float(last["return_mean"]) > float(first["return_mean"]) + 0.5
  assert float(last["success_percent"]) > float(first["success_percent"]) + 50
