"""Rounds of lessons, without what learns from them."""

import time
import types

import numpy as np
import pytest
from palpate.app import workers
from palpate.app.console import CommandError
from palpate.app.learn import teaching
from palpate.tasks.learn.lessons import Lesson

ROWS = np.zeros((3, 2), np.float32)


def give(job):
  time.sleep(0.05)
  taught = np.ones(3, bool)
  return Lesson(ROWS, ROWS, ROWS, taught, ROWS[:, 0], "success", alone=False)


def learn(lessons, updates, spent):
  for _ in range(40):
    if spent() >= 1.0:
      return 0.5
    time.sleep(0.05)
  return 0.1


def school(folder, monkeypatch):
  monkeypatch.setattr(teaching, "give", give)
  return teaching.School(folder, "touch/easy", {}, seed=0, updates=10)


def teach(found, count, stop=lambda: False, **words):
  networks = types.SimpleNamespace(learn=learn)
  return found.teach(networks, workers.HERE, count, 0.99, stop, **words)


def test_lessons_end_when_the_time_is_over_and_are_learned_from(tmp_path, monkeypatch, capsys):
  found = school(tmp_path, monkeypatch)
  assert teach(found, 1)  # the exercise is loaded once
  before = found.seconds
  assert teach(found, 100, until=before + 1.0)
  count = len(found.lessons) - 1
  assert 1 <= count <= 10 and found.rounds == 2
  assert before + 0.9 < found.seconds < before + 1.6  # lessons half of it, learning the rest
  said = capsys.readouterr().out
  assert f"round 2: {count} of {count} were a success" in said and "error 0.500" in said
  with pytest.raises(CommandError, match="no lesson was given: the time was over"):
    teach(school(tmp_path, monkeypatch), 1000, until=0.0)


def test_no_round_begins_that_would_be_cut_short(tmp_path, monkeypatch):
  found = school(tmp_path, monkeypatch)
  assert not found.ends(0.1)
  assert teach(found, 2)
  assert found.ends(1.2 * found.seconds) and not found.ends(1.8 * found.seconds)


def test_lessons_are_kept_where_learning_from_them_is_interrupted(tmp_path, monkeypatch):
  found, start = school(tmp_path, monkeypatch), []

  def stop():  # after two lessons, while the networks learn
    start.append(time.monotonic()) if len(found.lessons) == 2 else None
    return bool(start) and time.monotonic() > start[0] + 0.2

  assert not teach(found, 2, stop)
  assert found.rounds == 1 and len(found.lessons) == 2


def test_without_a_terminal_lessons_tell_how_far_they_are(tmp_path, monkeypatch, capsys):
  monkeypatch.setattr(teaching, "LINES", 0.1)
  assert teach(school(tmp_path, monkeypatch), 6)
  lines = capsys.readouterr().err.splitlines()
  assert lines[0].startswith("round 1: ") and "of 6 lessons" in lines[0]
  assert len(lines) >= 2 and "learning, step" in lines[-1]
