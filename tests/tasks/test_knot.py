"""A throw that two hands tie: what jaws hold, what counts as tied, and what goes wrong."""

import mujoco
import numpy as np
import pytest
from palpate.tasks import suite
from palpate.tasks.batch.vector import Exercises, NotVectorisedError
from palpate.tasks.core import episode, performer
from palpate.tasks.domains.suturing import drain, extracorporeal
from palpate.tasks.metrics import knots
from palpate.tasks.recording import Recording

OPEN, SHUT = 0.2, -0.76  # actions of the jaws
STRENGTH = 9.4  # of silk of size 3-0 [N]


def load(level="easy", **kwargs):
  task_kwargs = {"random": 0, "surroundings": "none", **kwargs}
  return suite.load("suture", f"knot_{level}", task_kwargs=task_kwargs)


def still(env, right=SHUT, left=SHUT):
  action = np.zeros(len(env.task.components))
  names = env.task.components
  action[names.index("jaw")], action[names.index("left_psm_jaw")] = right, left
  return action


@pytest.mark.slow
@pytest.mark.parametrize(
  ("level", "seed", "name"),
  # In the last one a step takes 451 iterations.
  [("easy", 0, "overhand"), ("standard", 0, "double throw"), ("standard", 20, "double throw")],
)
def test_the_expert_ties_a_throw_and_replays_to_the_bit(tmp_path, level, seed, name):
  env, about = load(level), {"task_kwargs": {"surroundings": "none"}}
  made = episode.run(env, performer.make(env, seed=seed), seed, about)
  assert made.outcome == "success"
  thread = env.physics.thread
  assert knots.name(knots.closed(thread.positions)) == name
  found = made.metrics()
  assert found.final_gap < 1e-3
  assert 0.3 < found.peak_tension < 0.5 * STRENGTH  # it is drawn with 0.8 N
  assert found.force_breaches == 0  # neither jaws that close nor a thread in them strike with 30 N
  old = Recording.load(made.save(tmp_path / "a.npz"))
  assert episode.differences(old, episode.replay(old)) == []


def test_jaws_hold_the_thread_until_they_open():
  env = load()
  env.reset()
  seen = env.task.get_observation(env.physics)
  assert seen["right_holds"] == 1.0 and seen["left_holds"] == 0.0
  physics, node = env.physics, env.task.holds[0].node
  start = physics.thread.positions[node]
  action = still(env)
  action[env.task.components.index("insertion")] = -0.5  # up
  for _ in range(10):
    env.step(action)
  moved = physics.thread.positions[node] - start
  assert moved[2] > 0.003
  gripped = physics.from_tip(physics.thread.positions[node])
  assert np.linalg.norm(gripped) < 0.006
  most = 0.0
  for _ in range(15):
    seen = env.step(still(env, right=OPEN)).observation
    most = max(most, env.task.tension)
  assert seen["right_holds"] == 0.0
  assert most < 0.2 * STRENGTH  # as they open, they do not tear it
  gripped = physics.from_tip(physics.thread.positions[node])
  assert np.linalg.norm(gripped) > 0.006  # it has sprung off


@pytest.mark.parametrize(("level", "counts"), [("easy", True), ("standard", False)])
def test_a_throw_counts_once_it_is_tied_as_often_as_asked(level, counts):
  env = load(level)
  env.reset()
  task, physics = env.task, env.physics
  post, tail = extracorporeal.strands(0.01, 1)  # one turn
  physics.thread.lay(np.concatenate([post[::-1], tail]))
  for hold in task.holds:
    hold.node = -1
  for _ in range(10):
    progress = task.advance(physics)
  assert task.tied == counts and task.outcome is None
  assert 0.4 < progress < 0.6 if counts else progress == 0.0  # the slit gapes


def test_a_broken_thread_fails():
  env = load()
  env.reset()
  model, data = env.physics.model.ptr, env.physics.data.ptr
  body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"{drain.THREAD}_60")
  for pull in np.linspace(0.0, 1.5 * STRENGTH, 60):  # of 20 nodes: slowly, as they weigh some mg
    data.xfrc_applied[body : body + 20, 0] = pull / 20
    mujoco.mj_step(model, data)
    if env.physics.thread.broken.any():
      break
  data.xfrc_applied[:] = 0.0
  step = env.step(still(env))
  assert step.last() and env.task.outcome == "damage"


def test_batches_refuse_it():
  with pytest.raises(NotVectorisedError, match="rules of Knot is None"):
    Exercises(num_envs=1, task="suture/knot_easy", device="cpu")
