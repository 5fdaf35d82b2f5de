"""A needle through rings: what counts as through, who holds it, and what is lost."""

import numpy as np
import pytest
from palpate.models import trocar
from palpate.tasks import suite
from palpate.tasks.core import performer
from palpate.tasks.domains.suturing import transfer
from palpate.tasks.learn import lessons


def load(task="transfer_easy", **kwargs):
  env = suite.load("needle", task, task_kwargs={"random": 0, **kwargs})
  return env, env.reset()


def turn(env, angles, shift=0.0):
  """Puts the needle in its ring, turned by angles in turn; returns how far it is through, each."""
  task, out = env.task, []
  for angle in angles:
    pos, mat = transfer.posed(task, 0, angle)
    row = np.concatenate([pos + np.array([0.0, 0.0, shift]), trocar.orientation(mat)])
    env.physics.put({"needle": row}, {})
    transfer.advance(env.physics, task)
    out.append((task.through, task.passed))
  return out


WHOLE = np.radians(np.arange(-200.0, 21.0, 5.0))  # from before the ring to behind it


def test_it_is_through_by_the_share_that_has_gone_through():
  env, _ = load()
  seen = turn(env, WHOLE)
  share = np.array([through for through, _ in seen])
  expected = np.clip((WHOLE + np.pi) / np.pi, 0, 1)
  np.testing.assert_allclose(share, expected, atol=0.03)
  assert not any(passed for _, passed in seen[:-5]) and seen[-1][1]


@pytest.mark.parametrize(
  ("angles", "shift"),
  [
    (WHOLE[::-1], 0.0),  # blunt end first, from behind
    (np.r_[WHOLE[::-1][:25], WHOLE[-24:]], 0.0),  # so for more than half, and back again
    (np.r_[WHOLE[:25], WHOLE[:24][::-1]], 0.0),  # in and out again
    (WHOLE, 0.02),  # over the ring
  ],
)
def test_no_other_way_counts(angles, shift):
  env, _ = load()
  assert not any(passed for _, passed in turn(env, angles, shift))
  assert env.task.done == 0


def test_a_needle_that_nobody_holds_is_lost():
  env, timestep = load()
  action = np.zeros(len(env.task.components))
  action[env.task.components.index("jaw")] = -1.0
  for _ in range(30):
    timestep = env.step(action)
  assert env.task.right_holds == 1.0 and env.task.regrasps == 0.0
  action[env.task.components.index("jaw")] = 1.0
  while env.task.right_holds:
    timestep = env.step(action)
  teacher = lessons.Teacher(env)  # who does not wait for what is not to come
  while not timestep.last():
    timestep = env.step(teacher(timestep))
  assert env.task.outcome == "missed" and env.physics.time() < 1.5
  said = [(event.kind, event.label) for event in env.task.take_events()]
  assert said == [("drop", "needle"), ("note", "the needle was dropped")]


def test_two_rings_there_and_back():
  env, timestep = load("transfer_standard")
  act, total, hands = performer.make(env, seed=0), 0.0, set()
  while not timestep.last():
    timestep = env.step(act(timestep))
    total += timestep.reward
    hands.add((env.task.done, env.task.right_holds, env.task.left_holds))
    if env.task.right_holds and env.task.left_holds:
      # The wire is between the jaws of the hand that takes it, short of their tip, and across.
      seen = timestep.observation
      np.testing.assert_allclose(seen["hand_target"], [0.0, 0.0, 0.0036], atol=0.0015)
      np.testing.assert_allclose(seen["hand_circle"], [0.0, 0.0, 1.0], atol=0.2)
      np.testing.assert_allclose(np.abs(seen["hand_along"]), [0.0, 1.0, 0.0], atol=0.2)
  assert env.task.outcome == "success" and total == pytest.approx(1.0)
  assert env.task.regrasps == 2.0 and env.task.worst == 0.0
  # Each ring is done in the other hand, and both hold the needle in between.
  assert {(0, 1.0, 1.0), (1, 0.0, 1.0), (1, 1.0, 1.0), (2, 1.0, 0.0)} < hands


def test_by_the_poses_of_the_tips():
  env, timestep = load(input="tip")
  act = performer.make(env, seed=0)
  while not timestep.last():
    timestep = env.step(act(timestep))
  assert env.task.outcome == "success"
