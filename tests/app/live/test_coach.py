"""The coach: what it says while one works, and afterwards."""

import copy
import dataclasses
import pathlib
import re

import numpy as np
import palpate
import pytest
from palpate.app.live import page
from palpate.app.live.coach import ADVICE, Coach, card
from palpate.tasks import suite
from palpate.tasks.core import episode, performer
from palpate.tasks.metrics import METRICS
from palpate.tasks.people.score import reference


def load(name, **kwargs):
  palpate.register()
  return suite.load(*suite.split(name), task_kwargs={"random": 0, **kwargs})


def follow(name, seed=0):
  """Returns what a coach said to the expert, in order."""
  env, coach = load(name), Coach()
  act = performer.make(env, seed=seed)

  def watch(env):
    coach.look(env)

  def first(timestep):
    if timestep.first():
      coach.begin(env)
    return act(timestep)

  made = episode.run(env, first, seed, {"task_kwargs": {}}, watch=watch)
  return coach, made


@pytest.mark.parametrize(
  ("name", "steps"),
  [
    ("touch/easy", ["Touch the yellow point gently, 1 of 1"]),
    ("grasp/easy", ["Open the jaws, go over", "Lift it by 6 mm", "Hold it", "Lower", "let go"]),
    ("probe/easy", ["Go to the yellow site", "Press more", "Hold it there"]),
  ],
)
def test_instructions_follow_the_phases(name, steps):
  coach, made = follow(name)
  assert made.outcome == "success"
  said = [hint["text"] for hint in coach.log()["hints"] if hint["kind"] == "instruction"]
  at = -1
  for step in steps:
    at = next((i for i, text in enumerate(said) if i > at and step in text), None)
    assert at is not None, (step, said)


def test_warnings_name_force_and_view():
  env, coach = load("touch/easy"), Coach()
  env.reset()
  coach.begin(env)
  assert coach.warning == "" and "yellow point" in coach.instruction
  env.task.force_limit = -1.0
  coach.look(env)
  assert coach.warning == "Too much force: 0.0 N, expected at most -1.0 N"
  env.task.force_limit = 1.0
  env.physics.move_port(np.array([0.2, 0.0, 0.0]), np.zeros(3))
  env.physics.forward()
  env.physics.set_joints(env.physics.joints())
  coach.look(env)
  assert coach.warning == "The tip is out of the picture"
  assert [hint["kind"] for hint in coach.log()["hints"]] == ["instruction", "warning", "warning"]


def test_an_assessment_is_silent():
  env, coach = load("touch/easy"), Coach(assessment=True)
  env.reset()
  coach.begin(env)
  env.task.force_limit = -1.0
  coach.look(env)
  assert (coach.instruction, coach.warning) == ("", "")
  assert coach.log() == {"assessment": True, "hints": []}


def test_a_card_says_what_was_good_what_to_do_next_and_what_helps():
  env = load("touch/easy")
  made = episode.run(env, performer.make(env, seed=0), 0, {"task_kwargs": {}})
  strict = copy.deepcopy(reference("touch/easy"))
  strict["metrics"]["path_length"]["limit"] = 0.001  # [m]
  shown = card(made, strict)
  assert shown["done"] and shown["ending"].startswith("Success, after") and shown["moved"]
  (row,) = shown["better"]
  assert (row["label"], row["limit"], row["least"]) == ("Path length", "1 mm", False)
  assert shown["helps"] == ["go straight to the target"]
  over = {row["label"] for row in shown["rows"] if row["over"]}
  assert over == {"Path length"} and shown["outcome"] == "success" and not shown["proficient"]
  unjudged = card(made, None)
  assert unjudged["better"] == unjudged["good"] == [] and unjudged["composite"] is None
  stopped = dataclasses.replace(made, info={**made.info, "outcome": "damage"})
  failed = card(stopped, strict)
  assert "Failed: tissue was harmed" in failed["ending"]
  assert not failed["done"] and failed["composite"] is None  # -20 says nothing to a person
  rows = {row["label"]: row["value"] for row in failed["rows"]}
  assert "Path length" not in rows and "Peak force" in rows  # what ends early is short
  assert "Time to completion" not in rows
  assert "Path length" not in [row["label"] for row in failed["better"]]


def test_one_smooth_movement_is_asked_for_where_there_were_several():
  env = load("touch/easy")
  made = episode.run(env, performer.make(env, seed=0), 0, {"task_kwargs": {}})
  strict = copy.deepcopy(reference("touch/easy"))
  strict["metrics"]["log_dimensionless_jerk"]["limit"] = 0.0
  several = made.metrics().number_of_movements > 1
  shown = card(made, strict)
  assert "Log dimensionless jerk" in [row["label"] for row in shown["better"]]
  assert any("one smooth movement" in text for text in shown["helps"]) == several


def test_what_is_said_is_in_the_table_of_words():
  """Exercises, metrics and what helps have German words; numbers stay in their order."""
  texts = pathlib.Path(str(page.__file__)).with_name("static") / "texts.js"
  german = texts.read_text().partition("const ENGLISH")[0]
  words = dict(re.findall(r'"((?:[^"\\]|\\.)*)":\s*"((?:[^"\\]|\\.)*)"', german))
  names = [word for domain, level in suite.ALL_TASKS for word in (f"{domain}/", *level.split("_"))]
  said = [re.sub(r"\d+(\.\d+)?", "#", suite.summary(*pair)) for pair in suite.ALL_TASKS]
  said += [*names, *(spec.label for spec in METRICS.values()), *ADVICE.values()]
  assert not {text for text in said if text not in words}
  assert not {text for text, other in words.items() if text.count("#") != other.count("#")}
