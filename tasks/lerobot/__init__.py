# lerobot needs Python 3.12, so types are checked without it:
# pyright: reportMissingImports=false
"""The exercises as environments of LeRobot.

    lerobot-eval --env.discover_packages_path=palpate.tasks.lerobot --env.type=palpate \
      --env.task=touch/easy --policy.path=outputs/train/act/checkpoints/last/pretrained_model

Importing this package registers the type `palpate`; `env.py` beside it is the file that LeRobot's
environment hub asks for. Observations are named as `palpate export --format lerobot` names them.
"""

import dataclasses
import os
from typing import Any

import gymnasium
import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from .. import gym
from ..learn.demonstrations import FILMS, VECTORS, instruction, vector

# OpenBLAS's threads can wait for ever in processes that are forked, as asynchronous vectors are.
# They begin later than this and read it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

_ID = "palpate/LeRobot-v0"
_CAMERAS = {name: film.rpartition(".")[2] for name, film in FILMS.items()}
# What an environment calls the columns `VECTORS`, and what they are.
_STATES = {
  "agent_pos": ("observation.state", FeatureType.STATE),
  "environment_state": ("observation.environment_state", FeatureType.ENV),
}


class Exercise(gymnasium.Wrapper):
  """An exercise that observes as LeRobot's policies do, and tells its task in words."""

  def __init__(self, **kwargs: Any):
    """Makes the environment, of the arguments of `palpate.tasks.gym.Exercise`."""
    super().__init__(gym.Exercise(**kwargs))
    self.task = kwargs["task"]
    self.task_description = instruction(self.task)
    boxes: Any = self.env.observation_space
    known = self._named({name: box.low for name, box in boxes.items()})
    mine: dict[str, gymnasium.Space] = {
      name: gymnasium.spaces.Box(-np.inf, np.inf, value.shape)
      for name, value in known.items() if name != "pixels"
    }  # fmt: skip
    if "pixels" in known:
      seen = {camera: boxes[name] for name, camera in _CAMERAS.items() if name in boxes.spaces}
      mine["pixels"] = gymnasium.spaces.Dict(seen)
    self.observation_space = gymnasium.spaces.Dict(mine)

  def reset(self, **kwargs: Any):
    """Starts an episode."""
    observation, info = self.env.reset(**kwargs)
    return self._named(observation), info | {"is_success": info["success"]}

  def step(self, action: Any):
    """Takes a control step; a network's output beyond [-1, 1] is clipped."""
    observation, *result, info = self.env.step(np.clip(action, -1, 1))
    return self._named(observation), *result, info | {"is_success": info["success"]}

  def _named(self, observation: dict[str, np.ndarray]) -> dict[str, Any]:
    found = {name: vector(observation, VECTORS[key]) for name, (key, _) in _STATES.items()}
    named: dict[str, Any] = {name: value for name, value in found.items() if value.size}
    seen = {camera: observation[name] for name, camera in _CAMERAS.items() if name in observation}
    return named | ({"pixels": seen} if seen else {})


gymnasium.register(_ID, entry_point=Exercise)


@EnvConfig.register_subclass("palpate")
@dataclasses.dataclass
class Palpate(EnvConfig):
  """An exercise to make.

  Attributes:
    task: domain and task
    fps: actions a second, as the exercise has them
    observations: groups (`sensors`, `state`), `pixels` and single ones
    size: of the pictures, height and width [pixels]
    options: others of the exercise, such as {"reward": "sparse"}
  """

  task: str | None = "touch/easy"
  fps: int = 50
  observations: list[str] = dataclasses.field(default_factory=lambda: ["sensors", "state"])
  size: list[int] = dataclasses.field(default_factory=lambda: [84, 84])
  options: dict[str, Any] = dataclasses.field(default_factory=dict)

  def __post_init__(self):
    env = Exercise(**self._kwargs)
    spaces: Any = env.observation_space
    self.fps, self._steps = env.metadata["render_fps"], env.unwrapped.environment.step_limit
    self.features = {"action": PolicyFeature(FeatureType.ACTION, env.action_space.shape)}
    self.features_map = {"action": "action"}
    for name, (key, kind) in _STATES.items():
      self.features_map[name] = key
      if name in spaces.spaces:
        self.features[name] = PolicyFeature(kind, spaces[name].shape)
    for name, camera in _CAMERAS.items():
      self.features_map[FILMS[name]] = FILMS[name]
      if "pixels" in spaces.spaces and camera in spaces["pixels"].spaces:
        shape = spaces["pixels"][camera].shape
        self.features[FILMS[name]] = PolicyFeature(FeatureType.VISUAL, shape)
    env.close()

  @property
  def _kwargs(self) -> dict[str, Any]:
    chosen = {"observations": self.observations, "pixels": self.size}
    return {"task": self.task, "render_mode": "rgb_array", **chosen, **self.options}

  @property
  def gym_id(self) -> str:
    """The id of all exercises."""
    return _ID

  @property
  def gym_kwargs(self) -> dict[str, Any]:
    """The arguments of `gymnasium.make`."""
    return {**self._kwargs, "max_episode_steps": self._steps}
