"""Lessons: an expert goes on where another has come to."""

from typing import Any

import numpy as np
import pytest
from palpate import tasks
from palpate.tasks.core import performer
from palpate.tasks.domains.dissection.bimanual import BURN
from palpate.tasks.domains.probing import probe
from palpate.tasks.learn import lessons, policy


def played(env, act, until, most=400, first=None):
  """Plays an episode, or goes on from a time step, until something is so; returns the time step."""
  timestep = first or env.reset()
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


def test_teachers_close_jaws_that_somebody_has_begun_to_close():
  env = tasks.load("grasp", "easy", task_kwargs={"random": 3, "surroundings": "none"})
  timestep = played(env, lessons.Teacher(env), lambda task: np.linalg.norm(task.target) < 0.01)
  down = np.array([0.0, 0.0, 0.0, 0.2, 0.3])  # to the site, too high for the jaws
  near = lambda task: np.linalg.norm(task.target) < 0.005  # noqa: E731
  timestep = played(env, lambda _: down, near, first=timestep)
  told = []
  for _ in range(9):
    told.append(lessons.Teacher(env)(timestep)[4])
    timestep = env.step(np.array([0.0, 0.0, 0.0, 0.0, told[-1]]))
  np.testing.assert_allclose(np.diff(told), -0.06, atol=0.001)
  assert lessons.Teacher(env)(env.step(np.zeros(5) - 0.35))[4] == 1.0  # nothing is held: again


@pytest.mark.parametrize(
  ("domain", "level"),
  [
    ("grasp", "easy"),
    ("needle", "transfer_easy"),
    pytest.param("suture", "running_easy", marks=pytest.mark.slow),
  ],
)
def test_teachers_that_take_turns_are_as_quick_as_one(domain, level):
  env = tasks.load(domain, level, task_kwargs={"surroundings": "none"})

  def steps(turn):
    env.task.random, act, count = np.random.RandomState(3), lessons.Teacher(env), 0
    timestep = env.reset()
    while not timestep.last():
      act = lessons.Teacher(env) if count and count % turn == 0 else act
      timestep, count = env.step(act(timestep)), count + 1
    assert env.task.outcome == "success"
    return count

  assert steps(5) < 1.3 * steps(1000)


def test_an_expert_presses_on_the_site_where_another_came_down_beside_it():
  env = tasks.load("probe", "depth", task_kwargs={"random": 3, "surroundings": "none"})
  timestep = played(env, performer.Performer(env), lambda task: task.pressing)
  while probe.distance(env.physics, env.task) < 0.001:
    timestep = env.step(np.array([0.3, 0.0, 0.0, 0.0]))
  other = performer.Performer(env)
  while not env.task.done:
    timestep = env.step(other(timestep))
    if env.task.held > 0.5:
      assert probe.distance(env.physics, env.task) < 0.00025  # a limit of proficiency


def test_a_teacher_of_the_transfer_goes_on_where_another_has_come_to():
  kwargs = {"random": 3, "surroundings": "none"}
  env = tasks.load("needle", "transfer_easy", task_kwargs=kwargs)

  def before_the_ring(task):
    ahead = float(task.lead @ task.way)
    return -0.008 < ahead < -0.005 and np.linalg.norm(task.lead - ahead * task.way) < 0.001

  timestep = played(env, lessons.Teacher(env), before_the_ring)
  for _ in range(2):  # towards the ring, then down to the needle
    act, far = lessons.Teacher(env), []
    for _ in range(8):
      timestep = env.step(act(timestep))
      far.append(np.linalg.norm(env.task.target if env.task.through else env.task.lead))
    assert (np.diff(far) < 0).all()
    while not env.task.through or np.linalg.norm(env.task.target) > 0.007:
      timestep = env.step(act(timestep))


def test_a_teacher_goes_back_no_further_from_a_ring_than_it_must():
  kwargs = {"random": 3, "surroundings": "none"}
  env = tasks.load("needle", "transfer_easy", task_kwargs=kwargs)
  task: Any = env.task

  def ahead():
    return float(task.lead @ task.way)

  def aside():
    return float(np.linalg.norm(task.lead - ahead() * task.way))

  timestep = played(env, lessons.Teacher(env), lambda _: ahead() > -0.006 and aside() < 0.001)
  push = np.zeros(len(task.components))
  push[[0, 6]] = -0.2, -1.0
  timestep = played(env, lambda _: push, lambda _: aside() > 0.0035, first=timestep)
  before, act, way = ahead(), lessons.Teacher(env), []

  def through(task):
    way.append(ahead())
    return task.through

  played(env, act, through, first=timestep)
  assert min(way) > before - 0.004


@pytest.mark.parametrize("seed", [0, 1])
def test_a_teacher_of_the_transfer_takes_the_needle_back_from_the_same_side(seed):
  kwargs = {"random": seed, "surroundings": "none"}
  env = tasks.load("needle", "transfer_standard", task_kwargs=kwargs)
  teacher = lessons.Teacher(env)
  played(env, teacher, lambda task: task.done and task.right_holds, most=900)
  roll = env.physics.joints()[2]
  assert 0.0 < roll < np.pi / 2  # not half a turn from there, which grips it as well


def test_a_lesson_is_what_the_expert_meant_from_its_turn_on():
  env = tasks.load("touch", "easy", task_kwargs={"surroundings": "none"})
  names = ("target", "joints")
  alone = lessons.give(env, names, 5, 0.5)
  assert alone.outcome == "success" and alone.seen.shape == (len(alone.done), 7)
  assert alone.returns[-1] > 0.6  # the reward of the end
  assert alone.taught.all() and not alone.alone and np.array_equal(alone.meant, alone.done)
  assert np.allclose(alone.returns[:-1] - 0.5 * alone.returns[1:], rewards(env, 5), atol=1e-6)
  shaken = lessons.give(env, names, 5, 0.5, noise=0.2)
  assert shaken.outcome == "success"
  count = min(len(alone.done), len(shaken.done))
  assert not np.allclose(shaken.meant[:count], alone.meant[:count], atol=0.05)
  assert not np.allclose(shaken.meant, shaken.done, atol=0.05)
  assert not shaken.meant[:, 2].any()  # who never rolls the shaft teaches not to
  both = lessons.give(env, names, 6, 0.5, learner=says([0, 0, 0, -0.5]), most=20)
  assert both.outcome == "success" and not both.alone and not both.taught[0]
  assert (both.done[~both.taught] == [0, 0, 0, -0.5]).all() and 5 < both.taught.sum()
  far = np.linalg.norm(both.seen[:, :3], axis=1)
  assert far[both.taught.argmax()] > far[0] + 0.0005  # it backed away
  other = lessons.give(env, names, 7, 0.5, learner=says([0, 0, 0, -0.5]), most=20)
  assert other.taught[: lessons.EXPERT[0]].all()  # there the expert begins


def test_only_the_hand_that_the_expert_moves_is_shaken():
  kwargs = {"surroundings": "none", "time_limit": 1.0}
  env = tasks.load("needle", "transfer_easy", task_kwargs=kwargs)
  lesson = lessons.give(env, ("target",), 3, 0.99, noise=0.3)
  right, left = np.split(lesson.done - lesson.meant, 2, axis=1)
  assert np.abs(right).max() > 0.3
  np.testing.assert_allclose(left, 0.0, atol=1e-6)


def test_who_does_not_get_on_is_helped_and_what_did_not_help_is_not_learned():
  env = tasks.load("touch", "easy", task_kwargs={"surroundings": "none"})
  idle = lessons.give(env, ("target",), 5, 0.5, learner=says([0, 0, 0, 0]))
  first = int(idle.taught.argmax())
  assert lessons.PATIENCE[0] < first <= lessons.PATIENCE[1] + 1 and idle.outcome == "success"
  env = tasks.load("touch", "easy", task_kwargs={"surroundings": "none", "time_limit": 0.4})
  env.task.tolerance = 0.0  # nobody can touch it
  lost = lessons.give(env, ("target",), 5, 0.5)
  best = np.linalg.norm(lost.seen, axis=1).argmin()
  assert lost.outcome == "time limit" and not lost.taught[best + 1 :].any()


def test_who_presses_too_hard_is_helped_while_there_is_a_way_back():
  env = tasks.load("touch", "easy", task_kwargs={"surroundings": "none"})
  lesson = lessons.give(env, ("peak_force",), 5, 0.5, learner=says([0, 0, 0, 0.5]))
  peak, first = lesson.seen[:, 0], int(lesson.taught.argmax())
  assert lesson.outcome == "success" and peak.max() < 2 * env.task.force_limit
  assert peak[first] > env.task.force_limit > peak[first - 1]


def test_who_burns_the_organ_is_helped():
  env = tasks.load("bimanual", "easy", task_kwargs={"random": 3, "surroundings": "none"})
  env.reset()
  task: Any = env.task
  assert not task.harsh(env.physics)
  task.time = 0.3 * BURN
  assert task.harsh(env.physics)


def test_a_policy_does_not_end_the_lesson_of_a_search():
  env = tasks.load("probe", "palpate_easy", task_kwargs={"surroundings": "none", "time_limit": 5})
  lesson = lessons.give(env, ("field",), 5, 0.5, learner=says([0, 0, 0, 0, 1.0]))
  assert lesson.taught[0] and not lesson.alone and len(lesson.done) > 50


def says(action):
  """Returns a policy that always does the same."""
  names = ("pitch", "yaw", "roll", "insertion", "report")[: len(action)]
  about = policy.About("any", names, ("joints",), 0.02)
  layers = [(np.zeros((len(action), 4)), np.array(action, float))]
  return policy.Policy(about, np.zeros(4), np.ones(4), layers)


def rewards(env, seed):
  """Returns the rewards of a teacher's episode but the last."""
  env.task.random = np.random.RandomState(seed)
  timestep, act, found = env.reset(), lessons.Teacher(env), []
  while not timestep.last():
    timestep = env.step(act(timestep))
    found.append(timestep.reward)
  return found[:-1]
