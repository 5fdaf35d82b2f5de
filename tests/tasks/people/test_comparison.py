"""Recordings side by side: what is said, what is marked, and that it stands alone."""

import re

import numpy as np
import pytest
from palpate.tasks.people import comparison, plots
from palpate.tasks.people.comparison import Entry
from palpate.tasks.people.score import make_reference
from palpate.tasks.recorder import Recorder, Settings

pytest.importorskip("matplotlib")


def _recorder(speed=0.1, force=1.0, outcome="success", task="touch"):
  recorder = Recorder(
    settings=Settings(force_limit=1.5, reference_length=0.1, tip_cutoff=None),
    info={"task": task, "performer": "someone", "outcome": outcome},
    watch=["miss"],
  )
  for k in range(51):
    recorder.append(0.02 * k, [speed * 0.02 * k, 0, 0], force=force * (k > 20))
  return recorder


def _entry(name, reference=None, film=None, **kwargs):
  return Entry(name, _recorder(**kwargs).recording(), reference, film)


def _reference():
  panel = [_recorder(speed=v, force=f).metrics() for v, f in ((0.1, 1.0), (0.11, 1.1), (0.12, 0.9))]
  return make_reference(panel, "touch", 0)


def _rows(text):
  """The table of a page: first cell -> the others."""
  rows = [re.findall(r"<td[^>]*>(.*?)</td>", r) for r in re.findall(r"<tr>(.*?)</tr>", text)]
  return {re.sub("<[^>]*>", "", r[0]): r[1:] for r in rows if len(r) > 1}


def test_two_are_side_by_side_with_their_difference(monkeypatch):
  monkeypatch.setattr(comparison, "png", lambda figure: b"png")
  entries = [_entry("mine", _reference()), _entry("<yours>", _reference(), speed=0.2, force=2.0)]
  text = comparison.render(entries)
  rows = _rows(text)
  worse = "<span class='bad'>200</span>"
  assert rows["Path length"] == ["<b>100</b>", worse, "mm", "lower", "+100"]
  assert rows["Mean speed"] == ["100", "200", "mm/s", "–", "+100"]  # neither is better
  assert rows["Errors"][:2] == ["0", "0"]
  assert rows["mine"][-1].startswith("proficient: every metric within its limit")
  assert "over the limit: Peak force" in rows["&lt;yours&gt;"][-1]
  assert len(re.findall("data:image/png", text)) == 3  # two paths, one of force and speed
  assert not re.search(r"<(script|link|iframe|video)|<yours>", text)
  with_films = comparison.render([_entry("a", film=b"one"), _entry("b", film=b"two")])
  assert len(re.findall("<video", with_films)) == 2


def test_a_failure_is_never_the_better_one():
  gave_up = _entry("gave up", _reference(), speed=0.01, outcome="stopped")
  entries = [_entry("slow", _reference()), gave_up]
  lines = {line[:20].strip(): line[20:].split() for line in comparison.as_text(entries).split("\n")}
  assert lines["Outcome"] == ["success", "stopped"]
  assert lines["Proficient"] == ["yes", "no"] and lines["Score"][1:] == ["not", "done"]
  text = comparison.as_text(entries)
  assert re.search(r"Path length \[mm\] +100 +10$", text, re.M)
  best = comparison.as_text([_entry("a"), _entry("b", speed=0.2)])
  assert re.search(r"Path length \[mm\] +100\* +200$", best, re.M)
  assert re.search(r"^Score +– +–$", best, re.M)  # without a reference


def test_different_tasks_are_not_ranked():
  text = comparison.as_text([_entry("a"), _entry("b", task="probe", speed=0.2), _entry("c")])
  assert not re.search(r"\d\*", text) and "probe" in text


def test_the_figure_has_both_over_time():
  recordings = [("one", _recorder().recording()), ("two", _recorder(speed=0.3).recording())]
  force, speed = plots.compared_figure(recordings).axes
  assert [line.get_label() for line in force.lines] == ["one", "two", "limit 1.5 N"]
  assert [np.median(line.get_ydata()) for line in speed.lines] == pytest.approx([100, 300])
  assert plots.compared_figure([("none", Recorder().recording())]) is None
