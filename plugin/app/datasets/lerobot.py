# lerobot needs Python 3.12, so types are checked without it:
# pyright: reportMissingImports=false
"""LeRobotDataset, written by lerobot itself: Parquet, MP4 and `meta`.

`observation.state` has what a robot has, `observation.environment_state` what a simulation knows
besides, `next.*` what came of the action. Seeds and outcomes of the episodes are in
`meta/palpate.json`.
"""

import json
import os
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from palpate.tasks.learn.demonstrations import (
  FILMS,
  VECTORS,
  Demonstration,
  components,
  instruction,
  vector,
)

from . import About

_KEPT = ("seed", "outcome", "performer", "return")  # of an episode


def check(env: Any) -> None:
  """Raises ValueError for pictures that are no films, and for a broken rate."""
  observed, (height, width) = env.task.observed, env.task.observed.size
  others = [name for name in observed.pictures if name not in FILMS]
  if others:
    raise ValueError(
      f"observations has {others[0]!r}, of pictures lerobot has {', '.join(FILMS)} alone"
    )
  if observed.pictures and (height % 2 or width % 2):
    raise ValueError(f"pixels is {height}, {width}, expected even numbers for a film")
  rate = 1 / env.control_timestep()
  if abs(rate - round(rate)) > 1e-6:
    raise ValueError(f"control_timestep gives {rate:g} Hz, expected a whole number for lerobot")


def write(folder: pathlib.Path, paths: Iterable[pathlib.Path], about: About) -> list[str]:
  """Writes the folders `data`, `videos` and `meta`."""
  os.environ.setdefault("SVT_LOG", "1")  # errors of the encoder alone
  from lerobot.datasets.lerobot_dataset import LeRobotDataset

  folder.rmdir()  # lerobot makes it
  dataset, kept = None, []
  for path in paths:
    demo = Demonstration.load(path)
    if dataset is None:
      name, shapes = about.id.replace("/", "-").replace("-", "/", 1), features(demo)
      dataset = LeRobotDataset.create(name, round(demo.rate), shapes, folder, "palpate")
    for frame in frames(demo):
      dataset.add_frame({**frame, "task": instruction(about.task)})
    dataset.save_episode()
    kept.append({key: demo.info.get(key) for key in _KEPT})
  if dataset is None:
    return []
  dataset.finalize()
  (folder / "meta/palpate.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
  seen = any(film in dataset.features for film in FILMS.values())
  films = ["its pictures are compressed (AV1)"] if seen else []
  return ["the last observation of an episode, which no action answers",
          "numbers beyond float32", *films]  # fmt: skip


def frames(demo: Demonstration) -> Iterator[dict[str, np.ndarray]]:
  """Yields the columns of each step."""
  last = len(demo) - 1
  for k in range(len(demo)):
    observed = {name: value[k] for name, value in demo.observations.items()}
    found = {key: vector(observed, kind) for key, kind in VECTORS.items()}
    frame = {key: value for key, value in found.items() if value.size}
    frame |= {film: observed[name] for name, film in FILMS.items() if name in observed}
    forces = {f"next.{name}": value[k + 1].astype("f4") for name, value in demo.forces.items()}
    yield frame | forces | {
      "action": demo.actions[k].astype("f4"),
      "next.reward": demo.rewards[k : k + 1].astype("f4"),
      "next.done": np.array([k == last]),
      "next.success": np.array([k == last and demo.success]),
    }  # fmt: skip


def features(demo: Demonstration) -> dict[str, dict[str, Any]]:
  """Returns type, shape and names of each column, as lerobot asks for them."""
  observed = {name: value[0] for name, value in demo.observations.items()}
  names = {key: components(observed, kind) for key, kind in VECTORS.items()}
  names |= {"action": list(demo.components)}
  names |= {film: ["height", "width", "channels"] for film in FILMS.values()}
  return {
    key: {
      "dtype": "video" if key in FILMS.values() else value.dtype.name,
      "shape": value.shape,
      "names": names.get(key),
    }
    for key, value in next(frames(demo)).items()
  }
