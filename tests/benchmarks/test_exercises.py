"""The scripts that measure the exercises: what they write; that they go on where they stopped."""

import csv
import importlib.util
import json
import os
import pathlib
import subprocess
import sys

import pytest

HERE = pathlib.Path(__file__).parent


def script(name):
  spec = importlib.util.spec_from_file_location(f"benchmark_{name}", HERE / f"{name}.py")
  module = importlib.util.module_from_spec(spec)
  spec.loader.exec_module(module)
  return module


def run(module, monkeypatch, *words):
  monkeypatch.setattr(sys, "argv", [module.__name__, *map(str, words)])
  module.main()


def table(path):
  with path.open(newline="") as file:
    return list(csv.DictReader(file))


def test_success_and_skill_come_from_kept_recordings(tmp_path, monkeypatch):
  module = script("exercises")
  monkeypatch.setattr(module, "SKILL_TASKS", ("touch/easy",))
  where = ("--runs", tmp_path / "runs", "--episodes", 2)
  references = tmp_path / "references"
  references.mkdir()
  words = ("experts", "-o", tmp_path / "a.csv", "--tasks", "touch/easy", *where)
  run(module, monkeypatch, *words, "--references", references)
  (row,) = table(tmp_path / "a.csv")
  assert (row["task"], row["success"], row["failed_seeds"]) == ("touch/easy", "2", "")
  reference = json.loads((references / "touch_easy.json").read_text())
  assert reference["n"] == reference["episodes"] == 2 and reference["seed"] == 0

  run(module, monkeypatch, "skill", "-o", tmp_path / "a.md", *where)
  monkeypatch.setattr(module.episode, "run", None)  # nothing is run again
  run(module, monkeypatch, *words)
  run(module, monkeypatch, "skill", "-o", tmp_path / "b.md", *where)
  text = (tmp_path / "a.md").read_text()
  assert text == (tmp_path / "b.md").read_text()
  assert "Success: expert 2/2" in text
  assert "| Time to completion | delay | all |  |" in text
  assert "| Out of view | no novice is made to |" in text


def test_kept_results_are_of_the_tasks():
  from palpate import tasks

  names = ["/".join(pair) for pair in tasks.ALL_TASKS]
  for file in ("experts.csv", "exercises_cpu.csv"):
    rows = [row["task"] for row in table(HERE / "results" / file)]
    assert len(set(rows)) == len(rows) and set(rows) <= set(names)
  for row in table(HERE / "results" / "experts.csv"):
    assert float(row["percent"]) >= 95, row["task"]


def test_learning_writes_table_and_curve(tmp_path):
  pytest.importorskip("stable_baselines3")
  # Of its own, and without drawing: Mesa's LLVM and the one that some builds of torch load clash.
  environment = {k: v for k, v in os.environ.items() if k != "MUJOCO_GL"}
  words = ("--decisions", "20", "--every", "20", "--episodes", "2", "-o", str(tmp_path))
  command = [sys.executable, str(HERE / "learning.py"), *words]
  subprocess.run(command, check=True, env=environment, timeout=300)
  rows = table(tmp_path / "learning.csv")
  assert [(row["policy"], row["decisions"]) for row in rows] == [
    ("random", "0"),
    ("SAC", "0"),
    ("SAC", "20"),
  ]
  assert (tmp_path / "learning.png").read_bytes()[:4] == b"\x89PNG"


def test_the_kept_agent_learned():
  first, *_, last = table(HERE / "results" / "learning.csv")
  assert first["policy"] == "random" and int(last["episodes"]) >= 20
  assert float(last["return_mean"]) > float(first["return_mean"]) + 0.5
  assert float(last["success_percent"]) > float(first["success_percent"]) + 50
