# pyright: reportMissingImports=false
"""Vectorised exercises for Stable-Baselines3, whose `VecEnv` this is.

    env = Sb3(gymnasium.make_vec("palpate/TouchEasy-v0", num_envs=64))

Its policy is `MultiInputPolicy`, for observations have names.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from ..batch.fields import INFO
from ..batch.vector import Exercises


class Sb3(VecEnv):
  """A vectorised exercise as Stable-Baselines3 wants it: numpy, and a dictionary a world."""

  def __init__(self, env: Exercises):
    """Takes an environment with `output="numpy"`."""
    found: Any = env.unwrapped
    if not isinstance(found, Exercises) or found.output != "numpy":
      raise ValueError("env is no vectorised exercise with output='numpy', expected one")
    self.env, self.render_mode = found, None
    super().__init__(found.num_envs, found.single_observation_space, found.single_action_space)

  def reset(self):
    """Begins episodes in all worlds; `seed` decides which."""
    seeds = self._seeds if any(seed is not None for seed in self._seeds) else None
    seen, _ = self.env.reset(seed=seeds)
    self._reset_seeds()
    return seen

  def step_async(self, actions: np.ndarray) -> None:
    """Takes actions."""
    self._actions = actions

  def step_wait(self):
    """Takes a control step."""
    seen, reward, terminated, truncated, info = self.env.step(self._actions)
    infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
    for world in np.flatnonzero(terminated | truncated):
      final = info["final_info"]
      infos[world] = {name: final[name][world] for name in INFO}
      infos[world]["metrics"] = {name: v[world] for name, v in final["metrics"].items()}
      infos[world]["terminal_observation"] = info["final_obs"][world]
      infos[world]["TimeLimit.truncated"] = bool(truncated[world])
    return seen, reward.astype(np.float32), terminated | truncated, infos

  def close(self) -> None:
    """Closes the environment."""
    self.env.close()

  def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
    """Returns an attribute, the same for every world."""
    return [getattr(self.env, attr_name)] * len(self._count(indices))

  def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
    """Sets an attribute."""
    setattr(self.env, attr_name, value)

  def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any):
    """Calls a method of the environment that all worlds are."""
    return [getattr(self.env, method_name)(*args, **kwargs)] * len(self._count(indices))

  def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: Any = None):
    """Returns that nothing is wrapped."""
    return [False] * len(self._count(indices))

  def _count(self, indices: Any) -> Sequence[int]:
    return list(self._get_indices(indices))
