"""Vectorised exercises in the hands of libraries for learning."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")
torch = pytest.importorskip("torch")

import palpate.tasks  # noqa: E402, F401


def make(**options):
  return gymnasium.make_vec("palpate/TouchEasy-v0", num_envs=2, device="cpu", **options)


def test_rsl_rl():
  pytest.importorskip("rsl_rl")
  from palpate.tasks.learn.rsl import RslRl

  env = RslRl(make(output="torch", time_limit=0.06), seed=0)
  seen = env.get_observations()
  assert set(seen.keys()) == {"sensors", "state"} and seen["state"].shape[0] == env.num_envs == 2
  assert env.max_episode_length == 3 and env.num_actions == 4
  for k in range(3):
    before = env.get_observations()["sensors"].clone()
    seen, _, over, extras = env.step(torch.full((2, 4), 3.0))  # cut to 1
    assert not torch.equal(before, seen["sensors"]) and seen.batch_size == (2,)
    assert over.dtype == torch.long and over.all() == (k == 2)
    assert torch.equal(extras["time_outs"], over.float())
  assert extras["log"]["/length"].tolist() == [3, 3] and env.episode_length_buf.tolist() == [0, 0]
  with pytest.raises(ValueError, match="output='torch'"):
    RslRl(make())


def test_stable_baselines3():
  pytest.importorskip("stable_baselines3")
  from palpate.tasks.learn.sb3 import Sb3
  from stable_baselines3 import PPO

  env = Sb3(make(time_limit=0.06))
  env.seed(3)
  seen = env.reset()
  for _ in range(3):
    _, reward, done, infos = env.step(np.full((2, 4), 0.1))
  assert done.all() and infos[0]["TimeLimit.truncated"] and reward.dtype == np.float32
  assert set(infos[1]["terminal_observation"]) == set(seen) and infos[1]["outcome"] is None
  model = PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, n_epochs=1)
  model.learn(8)


def test_skrl():
  pytest.importorskip("skrl")
  from skrl.envs.wrappers.torch import wrap_env

  env = wrap_env(make(output="torch"), wrapper="gymnasium", verbose=False)
  seen, _ = env.reset()
  assert env.num_envs == 2 and seen.shape[0] == 2
  seen, reward, terminated, truncated, _ = env.step(torch.zeros((2, 4)))
  assert reward.shape == terminated.shape == truncated.shape == (2, 1)
  assert torch.isfinite(seen).all()
