# pyright: reportMissingImports=false
"""Vectorised exercises for rsl_rl, whose `VecEnv` this is.

    env = RslRl(gymnasium.make_vec("palpate/TouchEasy-v0", num_envs=4096, output="torch"))

Observations are a TensorDict of the groups `sensors` and `state`, each flat. `extras["time_outs"]`
is 1 where the time limit ended an episode, `extras["log"]` has what ended episodes came to, but for
those that `stagger` has cut short.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import warp as wp
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from ..batch.vector import Exercises
from ..core.observation import GROUPS, ROWS


class RslRl(VecEnv):
  """A vectorised exercise as rsl_rl wants it; actions are cut to [-1, 1].

  Attributes:
    returns: of the episodes so far
    whole: whether an episode has all its time, which `stagger` takes from it
    won: 1 where the last whole episode of a world that has ended was a success, else 0
  """

  def __init__(
    self, env: Exercises, seed: int | None = None, groups: Mapping[str, Sequence[str]] | None = None
  ):
    """Begins episodes in all worlds of an environment with `output="torch"`.

    Args:
      env: of `gymnasium.make_vec`
      seed: of the episodes
      groups: names of observations by group, in place of `sensors` and `state`
    """
    found: Any = env.unwrapped
    if not isinstance(found, Exercises) or found.output != "torch":
      raise ValueError("env is no vectorised exercise with output='torch', expected one")
    self.env, self.cfg = found, {}
    self.num_envs, self.max_episode_length = found.num_envs, found.max_episode_steps
    self.num_actions = len(found.task.components)
    self.device = str(wp.device_to_torch(found.device))
    self.groups = groups or by_group(found.single_observation_space)
    self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.long, device=self.device)
    self.returns = torch.zeros(self.num_envs, device=self.device)
    self.whole = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
    self.won = torch.zeros(self.num_envs, device=self.device)
    self._seen, _ = found.reset(seed=seed)

  def get_observations(self) -> TensorDict:
    """Returns the last observations."""
    flat = {
      group: torch.cat([self._seen[name].flatten(1) for name in names], dim=1)
      for group, names in self.groups.items()
    }
    return TensorDict(flat, batch_size=[self.num_envs], device=self.device)

  def stagger(self, generator: torch.Generator | None = None) -> None:
    """Lets worlds be at moments of an episode that differ, so that not all end at once."""
    limit = self.max_episode_length
    steps = torch.randint(0, limit, (self.num_envs,), generator=generator)
    for part, at in zip(self.env.parts, self.env.slices, strict=True):
      part.fields.step.assign(steps[at].int().numpy())
    self.episode_length_buf[:] = steps.to(self.device)
    self.whole[:] = False

  def hasten(self, worlds: torch.Tensor) -> None:
    """Lets the time limit of episodes be over with their next step, in worlds of a mask."""
    for part, at in zip(self.env.parts, self.env.slices, strict=True):
      steps: Any = wp.to_torch(part.fields.step)
      steps.masked_fill_(worlds[at].to(steps.device), self.max_episode_length - 1)

  def step(self, actions: torch.Tensor):
    """Takes a control step."""
    actions = actions.detach().clamp(-1.0, 1.0)
    self._seen, reward, terminated, truncated, info = self.env.step(actions)
    over = terminated | truncated
    self.episode_length_buf += 1
    self.returns += reward
    extras: dict[str, Any] = {"time_outs": truncated.float(), "log": {}}
    if "final_info" in info:
      told = over & self.whole
      success = info["final_info"]["success"].float()
      self.won[told] = success[told]
      extras["log"] = {
        "/success": success[told],
        "/return": self.returns[told],
        "/length": self.episode_length_buf[told].float(),
      }
      self.whole[over] = True
      self.episode_length_buf[over] = 0
      self.returns[over] = 0.0
    return self.get_observations(), reward, over.long(), extras


def by_group(space: Any) -> dict[str, list[str]]:
  """Returns the names of a space's observations by their group."""
  found: dict[str, list[str]] = {group: [] for group in GROUPS}
  for name in space.spaces:
    found[ROWS[name].group if name in ROWS else "state"].append(name)
  return {group: names for group, names in found.items() if names}
