"""Which exercises are open to a learner, and what is next."""

import pytest
from palpate.tasks.people import curriculum
from palpate.tasks.registry import TASKS

NAMES = [f"{domain}/{task}" for domain, tasks in TASKS.items() for task in tasks]
MET = [True] * 12


def test_every_exercise_can_be_reached_in_the_stated_order():
  assert set(curriculum.AFTER) == set(NAMES)
  met, seen = set(), []
  while (task := curriculum.following(met)) is not None:
    assert curriculum.locked(task, met) is None
    seen.append(task)
    met.add(task)
  assert seen == list(curriculum.AFTER)


def test_an_exercise_opens_with_the_rule_of_proficiency():
  short, met = {"touch/easy": MET[1:]}, {"touch/easy": MET}
  assert curriculum.done(short) == set()
  assert curriculum.locked("touch/standard", curriculum.done(short)) == "touch/easy"
  assert curriculum.following(curriculum.done(short)) == "touch/easy"
  assert curriculum.done(met) == {"touch/easy"}
  assert curriculum.locked("touch/standard", curriculum.done(met)) is None
  assert curriculum.locked("touch/hard", curriculum.done(met)) == "touch/standard"
  assert curriculum.following(curriculum.done(met)) == "navigate/easy"
  assert curriculum.locked("my/own", set()) is None


@pytest.mark.parametrize(
  ("passed", "left"),
  [([], 12), ([True], 11), ([True, False], 12), ([True, True, False, True], 9), (MET, 0),
   ([*MET, False], 0)],
)  # fmt: skip
def test_what_is_left_is_said(passed, left):
  assert curriculum.left(passed) == left
