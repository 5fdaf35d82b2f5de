"""Minari's HDF5, written by Minari itself."""

import importlib.metadata
import pathlib
from collections.abc import Iterable
from typing import Any

import numpy as np
import palpate
from palpate.tasks import registry
from palpate.tasks.learn.demonstrations import Demonstration

from . import About


def check(env: Any) -> None:
  """It holds everything."""


def write(folder: pathlib.Path, paths: Iterable[pathlib.Path], about: About) -> list[str]:
  """Writes the folder `data`."""
  import gymnasium
  from minari.dataset.minari_storage import MinariStorage

  kwargs = {name: value for name, value in about.task_kwargs.items() if name != "random"}
  env = gymnasium.make(registry.gym_id(*about.task.split("/")), **kwargs)
  jpeg = not {"segmentation", "soiling"} & {*env.observation_space.spaces}  # labels are no colours
  storage = MinariStorage.new(
    folder / "data", env.observation_space, env.action_space, env.spec, jpeg_encoding=jpeg
  )
  version = importlib.metadata.version("minari")
  storage.update_metadata({
    "dataset_id": about.id,
    "algorithm_name": about.performer,
    "author": {"palpate"},
    "code_permalink": f"palpate {palpate.__version__}",
    "description": f"{about.task} of Palpate; licence of the data: {about.licence}",
    "minari_version": version,
  })  # fmt: skip
  infos = []
  for path in paths:
    demo = Demonstration.load(path)
    storage.update_episodes([_buffer(demo)])
    infos.append({key: demo.info[key] for key in ("outcome", "performer") if key in demo.info})
  storage.update_episode_metadata(infos)
  env.close()
  return ["pictures are JPEGs"] if jpeg and "pixels" in env.observation_space.spaces else []


def _buffer(demo: Demonstration) -> Any:
  from minari.data_collector.episode_buffer import EpisodeBuffer

  last = np.arange(len(demo)) == len(demo) - 1
  new: Any = EpisodeBuffer  # whose lists may be arrays
  return new(
    seed=demo.info["seed"],
    observations=demo.observations,
    actions=demo.actions,
    rewards=demo.rewards,
    terminations=last & demo.terminated,
    truncations=last & (not demo.terminated),
    infos=demo.forces,
  )
