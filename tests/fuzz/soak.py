"""The hard exercises under random actions of full scale, and organs on many threads, for long."""

from __future__ import annotations

import copy
import threading
import time

import mujoco
import numpy as np
import scenes
from palpate import tasks

OF_TOOLS = ("has gone through its surface", "its windows have no room for")


def act(name: tuple[str, str], seed: int, steps: int):
  """Acts at random for so many steps of the physics; all must stay finite and without warning.

  But for a tool that goes through the organ, or touches more of it than its window has room for:
  full-scale actions are no hand's.
  """
  again = f"soak {name}, seed {seed}: python -m pytest tests/fuzz -k soak --seed {seed}"
  random = np.random.RandomState(seed)
  env = tasks.load(*name, {"random": random.randint(2**31)})
  spec = env.action_spec()
  warned = []
  mujoco.set_mju_user_warning(lambda text: warned.append(str(text)))
  try:
    timestep, done, hold = env.reset(), 0, 0
    while done < steps:
      if timestep.last():
        timestep = env.reset()
      if hold == 0:  # trembles, or goes one way for up to two seconds
        action, hold = random.uniform(spec.minimum, spec.maximum), random.choice([1, 5, 100])
      timestep, hold = env.step(action), hold - 1
      done += round(env.control_timestep() / env.physics.model.opt.timestep)
      assert env.physics.organ.error is None, f"{again}: {env.physics.organ.error}"
      for key, value in timestep.observation.items():
        assert np.isfinite(value).all(), f"{again}: {key} after {done} steps"
      strange = [text for text in warned if not any(part in text for part in OF_TOOLS)]
      assert not strange, f"{again}: {strange[0]} after {done} steps"
      assert not any(warning.number for warning in env.physics.data.warning), again
  finally:
    mujoco.set_mju_user_warning(None)


def step_on_threads(count: int, seconds: float, shared: bool = False) -> int:
  """Steps on as many threads a copy of a model each, or one; each must do what it does alone.

  Returns:
    how many steps they did together
  """
  xml = scenes.probed(keys={"tolerance": 1e-5})
  model = mujoco.MjModel.from_xml_string(xml)
  models = [model if shared else copy.copy(model) for _ in range(count)]
  datas = [mujoco.MjData(m) for m in models]
  forces: list[list[np.ndarray]] = [[] for _ in models]
  until = time.monotonic() + seconds

  def work(k: int):
    while not forces[k] or time.monotonic() < until:
      forces[k].append(scenes.drive(models[k], datas[k], 20))

  threads = [threading.Thread(target=work, args=(k,)) for k in range(count)]
  for thread in threads:
    thread.start()
  for thread in threads:
    thread.join()
  expected = scenes.drive(model, mujoco.MjData(model), 20 * max(map(len, forces)))
  for found in map(np.concatenate, forces):
    np.testing.assert_array_equal(found, expected[: len(found)])
  return sum(20 * len(found) for found in forces)
