"""Environments that are copied and pickled in mid-episode: what follows is the same to the bit."""

import copy
import pickle
import subprocess
import sys

import mujoco
import numpy as np
import palpate
import pytest
from palpate import models, tasks, windows

PRESSED = 0.1  # force on the tool from which on it is copied [N]


def nodal_scene():
  """Options of a scene whose organ has no windows."""
  spec = models.load("liver", nodes=250, instruments=("probe",))
  assert not any(windows.organs(spec).values())
  spec.worldbody.add_site(name="target0")
  return {"model": spec, "organ": "liver/liver"}


@pytest.fixture(scope="module", params=["nodal", "windowed", "jaws", "bonds"])
def pressing(request):
  """An environment whose tool presses on the organ, and the actions that follow."""
  if request.param == "jaws":
    env = tasks.load("grasp", "easy", task_kwargs={"random": 0})
  elif request.param == "bonds":
    env = tasks.load("dissect", "easy", task_kwargs={"random": 0})
  else:
    scene = nodal_scene() if request.param == "nodal" else {}
    env = tasks.load("touch", "easy", task_kwargs={"random": 0, "damage": 100.0, **scene})
  env.reset()
  random, count = np.random.RandomState(1), len(env.task.components)
  actions = np.c_[random.uniform(-0.1, 0.1, (60, 3)), np.full(60, 0.3), np.full(60, -0.5)]
  for _ in range(300):
    if env.physics.peak_force > PRESSED:
      break
    env.step(np.array([0.0, 0.0, 0.0, 0.3, -0.5])[:count])
  assert env.physics.data.ncon
  return env, actions[:15, :count]


def observe(env):
  return env.task.get_observation(env.physics)


def same(a, b):
  return list(a) == list(b) and all(np.array_equal(a[name], b[name]) for name in a)


def run(env, actions):
  """Returns rewards and observations of the steps and of a new episode, and the last state."""
  steps = [env.step(action) for action in actions]
  state = env.physics.integration_state()
  steps.append(env.reset())
  steps.append(env.step(np.zeros(len(env.task.components))))
  return [(step.reward, *map(bytes, step.observation.values())) for step in steps], state


WAYS = {"deepcopy": copy.deepcopy, "pickle": lambda env: pickle.loads(pickle.dumps(env))}


def test_copies_go_on_to_the_bit(pressing):
  env, actions = pressing
  before = env.physics.integration_state()
  twins = [way(env) for way in WAYS.values()]
  for twin in twins:
    assert same(observe(twin), observe(env))
  expected = run(copy.deepcopy(twins[0]), actions)
  for twin in twins:  # of a copy too; and none is changed by what others do
    steps, state = run(twin, actions)
    assert steps == expected[0]
    np.testing.assert_array_equal(state, expected[1])
  np.testing.assert_array_equal(env.physics.integration_state(), before)


@pytest.mark.parametrize("share", [False, True])
def test_a_physics_is_copied_whole(pressing, share):
  env, _ = pressing
  physics = env.physics
  twin, other = physics.copy(share_model=share), physics.copy(share_model=share)
  assert twin.peak_force == physics.peak_force and twin.has_jaw == physics.has_jaw
  np.testing.assert_array_equal(twin.contact_force(), physics.contact_force())
  for _ in range(3):  # by turns
    for each in (twin, other):
      each.step(20)
    np.testing.assert_array_equal(twin.integration_state(), other.integration_state())
    np.testing.assert_array_equal(twin.nodes(), other.nodes())
  assert twin.time() > physics.time()


def test_the_original_goes_on_as_if_it_had_not_been_copied():
  steps = []
  for copied in (False, True):
    env = tasks.load("touch", "easy", task_kwargs={"random": 3})
    env.reset()
    for k in range(30):
      env.step(np.array([0.0, 0.0, 0.0, 0.6]))
      if copied and k in (5, 25):
        copy.deepcopy(env).reset()
        pickle.dumps(env)
    steps.append(run(env, np.full((5, 4), 0.1)))
  assert steps[0][0] == steps[1][0]


def test_the_trocar_of_a_copy_comes_home():
  # Where it was moved to in the copied episode is not where the next one starts from.
  env = tasks.load("touch", "easy", task_kwargs={"random": 0, "jitter": 0.01})
  env.reset()
  twin = copy.deepcopy(env)
  for _ in range(2):
    a, b = env.reset(), twin.reset()
    assert same(a.observation, b.observation)
    np.testing.assert_array_equal(env.physics.trocar().pos, twin.physics.trocar().pos)


def test_what_was_configured_comes_along(pressing):
  env, _ = pressing
  env = copy.deepcopy(env)
  env.physics.organ.configure(young_scale=2.0, tolerance=1e-7)
  env.physics.step(20)  # the step that was under way began before
  twin = pickle.loads(pickle.dumps(env))
  assert twin.physics.organ.config == env.physics.organ.config
  for each in (env, twin):
    each.physics.step(20)
  np.testing.assert_array_equal(env.physics.integration_state(), twin.physics.integration_state())


def test_another_process_goes_on_to_the_bit(tmp_path):
  env = tasks.load("touch", "easy", task_kwargs={"random": 0})
  env.reset()
  for _ in range(45):
    env.step(np.array([0.0, 0.0, 0.0, 0.5]))
  assert env.physics.data.ncon
  (tmp_path / "env.pkl").write_bytes(pickle.dumps(env))
  code = """
import pickle, sys
with open(sys.argv[1], "rb") as file:
  env = pickle.load(file)
env.physics.step(40)
sys.stdout.buffer.write(env.physics.integration_state().tobytes())
"""
  words = [sys.executable, "-c", code, str(tmp_path / "env.pkl")]
  done = subprocess.run(words, check=True, capture_output=True)
  twin = copy.deepcopy(env)
  twin.physics.step(40)
  np.testing.assert_array_equal(np.frombuffer(done.stdout), twin.physics.integration_state())


def test_data_and_models_alone_come_out_of_a_pickle_alive(pressing):
  env, _ = pressing
  physics = copy.deepcopy(env).physics
  name = physics.organ_name
  model, data = physics.model.ptr, physics.data.ptr
  mujoco.mj_step(model, data)
  twin = pickle.loads(pickle.dumps(data))
  organ = palpate.Organ(twin.model, twin, name)
  for _ in range(20):
    mujoco.mj_step(model, data)
    mujoco.mj_step(twin.model, twin)
  np.testing.assert_array_equal(organ.xpos, palpate.Organ(model, data, name).xpos)
  mujoco.mj_resetData(twin.model, twin)
  assert palpate.Organ(model, data, name).error is None and organ.error is None
