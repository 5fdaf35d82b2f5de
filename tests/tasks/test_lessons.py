"""Lessons: an expert goes on where another has come to."""

import numpy as np
import pytest
from palpate import tasks
from palpate.tasks import lessons, performer


def played(env, act, until, most=400):
  """Plays an episode until something is so; returns the time step."""
  timestep = env.reset()
  for _ in range(most):
    if until(env.task):
      return timestep
    timestep = env.step(act(timestep))
  raise AssertionError("it did not come to that")


@pytest.mark.parametrize(
  ("domain", "begun", "lost"),
  [
    ("touch", lambda task: task.held > 0, lambda task: not task.pressing),
    ("probe", lambda task: task.held > 0.1, lambda task: task.held == 0),
    ("trace", lambda task: task.done > 20, lambda task: task.done < 20),
    ("grasp", lambda task: task.grasped, lambda task: not task.grasped),
  ],
)
def test_an_expert_goes_on_with_what_has_begun(domain, begun, lost):
  env = tasks.load(domain, "easy", task_kwargs={"random": 3, "surroundings": "none"})
  timestep = played(env, performer.Performer(env), begun)
  other, before = performer.Performer(env), env.task.progress
  for _ in range(4 if domain == "touch" else 15):
    timestep = env.step(other(timestep))
    if timestep.last():
      break
    assert not lost(env.task)
  assert env.task.progress >= before


def test_a_lesson_is_what_the_expert_meant_from_its_turn_on():
  env = tasks.load("touch", "easy", task_kwargs={"surroundings": "none"})
  names = ("target", "joints")
  alone = lessons.give(env, names, 5, 0.5)
  assert alone.outcome == "success" and alone.seen.shape == (len(alone.done), 7)
  assert alone.returns[-1] > 0.6  # the reward of the end
  assert np.allclose(alone.returns[:-1] - 0.5 * alone.returns[1:], rewards(env, 5), atol=1e-6)
  shaken = lessons.give(env, names, 5, 0.5, noise=0.2)
  assert shaken.outcome == "success"
  count = min(len(alone.done), len(shaken.done))
  assert not np.allclose(shaken.done[:count], alone.done[:count], atol=0.05)
  turns = []
  both = lessons.give(env, names, 5, 0.5, learner=lambda seen: turns.append(1) or [0, 0, 0, -1.0])
  assert both.outcome == "success" and len(turns) > 5
  far = np.linalg.norm(both.seen[:, :3], axis=1)
  assert far[0] > np.linalg.norm(alone.seen[0, :3]) + 0.0005 * len(turns[:3])  # backed away


def rewards(env, seed):
  """Returns the rewards of a teacher's episode but the last."""
  env.task.random = np.random.RandomState(seed)
  timestep, act, found = env.reset(), lessons.Teacher(env), []
  while not timestep.last():
    timestep = env.step(act(timestep))
    found.append(timestep.reward)
  return found[:-1]
