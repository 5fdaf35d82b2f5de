"""HDF5 as robomimic has it: `demos.hdf5`, one group an episode.

The layout is that of robomimic 0.5, docs/datasets/overview.md: `data/demo_0` with `obs`,
`next_obs`, `actions`, `rewards`, `dones`; pictures are lossless (height, width, channel) bytes.
"""

import json
import pathlib
import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from palpate.tasks import registry
from palpate.tasks.learn.demonstrations import LEVEL, Demonstration, instruction

from . import About

FILE = "demos.hdf5"
_GYM = 2  # robomimic's EnvType.GYM_TYPE


def check(env: Any) -> None:
  """It holds everything."""


def write(folder: pathlib.Path, paths: Iterable[pathlib.Path], about: About) -> list[str]:
  """Writes the file."""
  import h5py

  names: dict[str, list[str]] = {"success": [], "failure": []}
  with h5py.File(folder / FILE, "w") as file:
    data, total = file.create_group("data"), 0
    for index, path in enumerate(paths):
      demo = Demonstration.load(path)
      _add(data.create_group(f"demo_{index}"), demo)
      names["success" if demo.success else "failure"].append(f"demo_{index}")
      total += len(demo)
    data.attrs["total"] = total
    data.attrs["env_args"] = json.dumps(_environment(about))
    if names["failure"]:  # to choose by, as filter keys
      for key, found in names.items():
        file[f"mask/{key}"] = np.array(found, dtype="S")
  return []


def _environment(about: About) -> dict[str, Any]:
  return {
    "env_name": registry.gym_id(*about.task.split("/")),
    "type": _GYM,
    "env_kwargs": dict(about.task_kwargs),
    "env_lang": instruction(about.task),
  }


def _add(group: Any, demo: Demonstration) -> None:
  group.attrs["num_samples"] = len(demo)
  for key, value in demo.info.items():
    group.attrs[key] = value if isinstance(value, str | int | float) else json.dumps(value)
  dones = np.zeros(len(demo), np.int64)
  dones[-1] = demo.terminated
  for name, value in (("actions", demo.actions), ("rewards", demo.rewards), ("dones", dones)):
    group[name] = value
  for name, value in demo.forces.items():
    group[f"forces/{name}"] = value[1:]
  for name, value in demo.observations.items():
    if value.ndim > 2 and value.shape[1] > 8:
      _add_pictures(group, name, value)
    else:
      group[f"obs/{name}"], group[f"next_obs/{name}"] = value[:-1], value[1:]


def _add_pictures(group: Any, name: str, pictures: np.ndarray) -> None:
  """Adds pictures (n, height, width, ...), each compressed once for both of its places."""
  (count, *size), still = pictures.shape, (0,) * (pictures.ndim - 1)
  packed = {"chunks": (1, *size), "compression": "gzip", "compression_opts": LEVEL}
  now, then = (
    group.create_dataset(f"{which}/{name}", (count - 1, *size), pictures.dtype, **packed)
    for which in ("obs", "next_obs")
  )
  for k, picture in enumerate(pictures):
    chunk = zlib.compress(picture.tobytes(), LEVEL)  # what HDF5's gzip writes
    if k < count - 1:
      now.id.write_direct_chunk((k, *still), chunk)
    if k > 0:
      then.id.write_direct_chunk((k - 1, *still), chunk)
