"""Throws that a pusher takes down: gap, knot and thread, and what goes wrong."""

import mujoco
import numpy as np
import pytest
from palpate.tasks import suite
from palpate.tasks.batch.vector import Exercises, NotVectorisedError
from palpate.tasks.core import episode, performer
from palpate.tasks.domains.suturing import extracorporeal
from palpate.tasks.metrics import knots
from palpate.tasks.recording import Recording


def load(task="extracorporeal_easy", **kwargs):
  return suite.load("suture", task, task_kwargs={"random": 0, "surroundings": "none", **kwargs})


def tied(places):
  return knots.throws(knots.closed(places, np.array([-1.0, 0.0, 0.0])))


@pytest.mark.slow
def test_the_expert_takes_a_throw_down_and_replays_to_the_bit(tmp_path):
  env = load()
  made = episode.run(env, performer.make(env, seed=0), 0, {"task_kwargs": {"surroundings": "none"}})
  assert made.outcome == "success"
  thread = env.physics.thread
  assert tied(thread.positions) == (-env.task.hand,) and not thread.broken.any()
  found = made.metrics()
  assert found.final_gap < 1e-3
  # Both hands outside pull with 0.6 N, and so much is lost where the ring and the throw rub.
  assert 0.6 < found.peak_tension < 1.2
  assert np.isnan(found.knot_security)  # of one throw
  old = Recording.load(made.save(tmp_path / "a.npz"))
  assert episode.differences(old, episode.replay(old)) == []


@pytest.mark.slow
def test_the_second_throw_is_tied_the_other_way_round_and_they_hold():
  env = load(throws=2)
  made = episode.run(env, performer.make(env, seed=0), 0, {"task_kwargs": {}})
  assert made.outcome == "success"
  assert tied(env.physics.thread.positions) == (1, -1)
  found = made.metrics()
  assert found.knot_security == pytest.approx(0.1) and found.final_gap < 1e-3


def test_a_throw_that_is_laid_on_a_thread_is_what_it_says():
  for hand in (1, -1):
    post, tail = extracorporeal.strands(0.01, hand)
    assert tied(np.concatenate([post[::-1], tail])) == (-hand,)


def test_a_broken_thread_fails():
  env = load()
  env.reset()
  model, data = env.physics.model.ptr, env.physics.data.ptr
  for name in ("hand_post", "hand_tail"):
    data.ctrl[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)] = 40.0
  while not env.step(np.zeros(4)).last():
    pass
  assert env.task.outcome == "damage"


def test_batches_refuse_it():
  with pytest.raises(NotVectorisedError, match="rules of Extracorporeal is None"):
    Exercises(num_envs=1, task="suture/extracorporeal_easy", device="cpu")
