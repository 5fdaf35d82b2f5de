"""LeRobotDataset v3.0: tables in Parquet, pictures in MP4, what they are in `meta`.

Written after lerobot's own dataset_metadata.py and dataset_writer.py: many episodes a file, one row
group an episode; films are joined without being encoded again. `observation.state` has what a robot
has, `observation.environment_state` what a simulation knows besides, `next.*` what came of the
action.
"""

from __future__ import annotations

import json
import os
import pathlib
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from palpate.tasks.learn.demonstrations import Demonstration, group, instruction

from ..draw import film
from . import About

_CHUNK = 1000  # files a folder
_DATA_MB, _FILM_MB = 100, 200  # of a file, about
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_PIXELS = "observation.images.laparoscope"
_VECTORS = {"observation.state": "sensors", "observation.environment_state": "state"}
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_LOOKED_AT = 32  # pictures of an episode that its statistics are of
# Frames that others are made of come often, so that any one is found soon; none is made of later
# ones, so that films can be joined.
_ENCODING = ("-crf", "23", "-g", "10", "-bf", "0")

Stats = dict[str, np.ndarray]


def check(env: Any) -> None:
  """Raises ValueError for pictures that are no films, and for a broken rate."""
  observed, (height, width) = env.task.observed, env.task.observed.size
  others = [name for name in observed.pictures if name != "pixels"]
  if others:
    raise ValueError(f"observations has {others[0]!r}, of pictures lerobot has pixels alone")
  if observed.pictures and (height % 2 or width % 2):
    raise ValueError(f"pixels is {height}, {width}, expected even numbers for a film")
  rate = 1 / env.control_timestep()
  if abs(rate - round(rate)) > 1e-6:
    raise ValueError(f"control_timestep gives {rate:g} Hz, expected a whole number for lerobot")


def stage(demo: Demonstration, path: pathlib.Path) -> Demonstration:
  """Makes the film."""
  pictures = demo.observations.pop("pixels", None)
  if pictures is None:
    return demo
  with film.write(_film(path), round(demo.rate), _ENCODING) as frame:
    for picture in pictures[:-1]:
      frame(picture)
  some = pictures[np.linspace(0, len(demo) - 1, min(_LOOKED_AT, len(demo))).astype(int)]
  stats = _stats(some.reshape(-1, some.shape[-1]) / 255.0)
  stats["count"] = np.array([len(some)])
  demo.info["pixels"] = {
    "shape": pictures.shape[1:],
    "stats": {name: value.tolist() for name, value in stats.items()},
  }
  return demo


def _film(path: pathlib.Path) -> pathlib.Path:
  return path.with_suffix(".mp4")


def write(folder: pathlib.Path, paths: Iterable[pathlib.Path], about: About) -> list[str]:
  """Writes the folders `data`, `videos` and `meta`."""
  import pyarrow as pa

  features: dict[str, Any] = {}
  data, rows = _Tables(folder / "data"), _Tables(folder / "meta/episodes")
  films, every, frames, rate = _Films(folder / "videos" / _PIXELS), [], 0, 0
  for index, path in enumerate(paths):
    demo = Demonstration.load(path)
    now, rate = _features(demo), round(demo.rate)
    if features and now != features:
      raise ValueError(f"episode {path.stem} has other observations than the first one")
    features = now
    columns = _columns(demo, index, frames)
    stats = {key: _stats(value) for key, value in columns.items()}
    place = {f"data/{key}": value for key, value in data.place().items()}
    place |= {f"meta/episodes/{key}": value for key, value in rows.place().items()}
    data.add(_table(columns))
    if "pixels" in demo.info:
      seen = demo.info["pixels"]["stats"]
      stats[_PIXELS] = {
        key: np.array(v) if key == "count" else np.reshape(v, (3, 1, 1)) for key, v in seen.items()
      }
      place |= films.add(_film(path), len(demo) / rate)
    every.append(stats)
    row = {
      "episode_index": index, "tasks": [instruction(about.task)], "length": len(demo), **place,
      "dataset_from_index": frames, "dataset_to_index": frames + len(demo),
      **{key: demo.info.get(key) for key in ("seed", "outcome", "performer", "return")},
    }  # fmt: skip
    row |= {f"stats/{k}/{s}": v.tolist() for k, found in stats.items() for s, v in found.items()}
    rows.add(pa.table({key: [value] for key, value in row.items()}))
    frames += len(demo)
  for part in (data, rows, films):
    part.close()
  _write_meta(folder, about, features, _total(every), (rows.count, frames, rate))
  films = ["its pictures are compressed (H.264)"] if _PIXELS in features else []
  return ["the last observation of an episode, which no action answers",
          "numbers beyond float32", *films]  # fmt: skip


def _features(demo: Demonstration) -> dict[str, Any]:
  """Returns what `info.json` says of each column."""
  names = {"action": list(demo.components)}
  for key, kind in _VECTORS.items():
    names[key] = [
      name if np.size(value[0]) == 1 else f"{name}.{i}"
      for name, value in demo.observations.items() if group(name) == kind
      for i in range(np.size(value[0]))
    ]  # fmt: skip
  out: dict[str, Any] = {
    key: {"dtype": value.dtype.name, "shape": list(value.shape[1:]) or [1], "names": names.get(key)}
    for key, value in _columns(demo, 0, 0).items()
  }
  if "pixels" in demo.info:
    height, width, depth = demo.info["pixels"]["shape"]
    out[_PIXELS] = {
      "dtype": "video", "shape": [height, width, depth], "names": ["height", "width", "channels"],
      "info": {
        "video.height": height, "video.width": width, "video.channels": depth,
        "video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False,
        "video.fps": round(demo.rate), "has_audio": False,
      },
    }  # fmt: skip
  return out


def _columns(demo: Demonstration, index: int, start: int) -> dict[str, np.ndarray]:
  """Returns the columns of an episode  (nstep, ...)."""
  count, out = len(demo), {}
  for key, kind in _VECTORS.items():
    parts = [v[:-1].reshape(count, -1) for n, v in demo.observations.items() if group(n) == kind]
    if parts:
      out[key] = np.concatenate(parts, axis=1).astype(np.float32)
  out["action"] = demo.actions.astype(np.float32)
  out |= {f"next.{name}": value[1:].astype(np.float32) for name, value in demo.forces.items()}
  number = np.arange(count)
  return out | {
    "next.reward": demo.rewards.astype(np.float32),
    "next.done": number == count - 1,
    "next.success": (number == count - 1) & demo.success,
    "timestamp": (number / demo.rate).astype(np.float32),
    "frame_index": number,
    "episode_index": np.full(count, index),
    "index": start + number,
    "task_index": np.zeros(count, np.int64),
  }


def _table(columns: Mapping[str, np.ndarray]) -> Any:
  import pyarrow as pa

  arrays = {}
  for key, value in columns.items():
    flat = value.reshape(len(value), -1)
    array = pa.array(flat.ravel())
    arrays[key] = array if flat.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(
      array, flat.shape[1]
    )  # fmt: skip
  return pa.table(arrays)


def _stats(values: np.ndarray) -> Stats:
  """Returns what lerobot normalises by, of each column of (nrow, ncolumn) or of (nrow,)."""
  values = values.reshape(len(values), -1).astype(float)
  quantiles = np.quantile(values, list(_QUANTILES.values()), axis=0)
  return {
    "min": values.min(axis=0),
    "max": values.max(axis=0),
    "mean": values.mean(axis=0),
    "std": values.std(axis=0),
    "count": np.array([len(values)]),
    **dict(zip(_QUANTILES, quantiles, strict=True)),
  }


def _total(episodes: Sequence[Mapping[str, Stats]]) -> dict[str, Any]:
  """Returns the statistics of all episodes as JSON; a quantile is the mean of theirs, as there."""
  out = {}
  for key in episodes[0]:
    every = {name: np.array([stats[key][name] for stats in episodes]) for name in episodes[0][key]}
    count = every["count"][:, 0]
    known = {name: np.average(every[name], axis=0, weights=count) for name in ("mean", *_QUANTILES)}
    square = np.average(every["std"] ** 2 + every["mean"] ** 2, axis=0, weights=count)
    known |= {"min": every["min"].min(axis=0), "max": every["max"].max(axis=0)}
    known |= {"std": np.sqrt(np.maximum(square - known["mean"] ** 2, 0)), "count": [sum(count)]}
    out[key] = {name: np.asarray(value).tolist() for name, value in known.items()}
  return out


class _Tables:
  """Tables in Parquet files of limited size, a row group each."""

  def __init__(self, folder: pathlib.Path):
    self.folder, self.count = folder, 0
    self._file, self._writer, self._path = 0, None, folder

  def place(self) -> dict[str, int]:
    """Returns where the next table goes."""
    if self._writer is not None and self._path.stat().st_size >= _DATA_MB * 2**20:
      self.close()
    return _numbers(self._file)

  def add(self, table: Any) -> None:
    """Writes a table to its place."""
    import pyarrow.parquet as pq

    self.place()
    if self._writer is None:
      self._path = _place(self.folder, self._file, ".parquet")
      self._writer = pq.ParquetWriter(self._path, table.schema, compression="snappy")
    self._writer.write_table(table)
    self.count += 1

  def close(self):
    if self._writer is not None:
      self._writer.close()
      self._writer, self._file = None, self._file + 1


class _Films:
  """Films joined to files of limited size."""

  def __init__(self, folder: pathlib.Path):
    self.folder, self._file = folder, 0
    self._waiting: list[pathlib.Path] = []
    self._bytes, self._seconds = 0, 0.0

  def add(self, path: pathlib.Path, seconds: float) -> dict[str, Any]:
    """Takes an episode's film and returns where it will be."""
    size = path.stat().st_size
    if self._waiting and self._bytes + size > _FILM_MB * 2**20:
      self.close()
    start = self._seconds
    self._waiting.append(path)
    self._bytes, self._seconds = self._bytes + size, start + seconds
    at = _numbers(self._file) | {"from_timestamp": start, "to_timestamp": self._seconds}
    return {f"videos/{_PIXELS}/{key}": value for key, value in at.items()}

  def close(self):
    """Joins the films that wait."""
    import imageio_ffmpeg

    if not self._waiting:
      return
    out = _place(self.folder, self._file, ".mp4")
    names = self._waiting[0].with_name("films.txt")
    names.write_text("".join(f"file {path.name}\n" for path in self._waiting), encoding="utf-8")
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-f", "concat", "-safe", "0",
             "-i", os.fspath(names), "-c", "copy", os.fspath(out)]  # fmt: skip
    done = subprocess.run(words, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    if done.returncode:
      raise OSError(done.stderr.strip().splitlines()[-1] if done.stderr else "ffmpeg failed")
    self._waiting, self._bytes, self._seconds = [], 0, 0.0
    self._file += 1


def _numbers(file: int) -> dict[str, int]:
  return {"chunk_index": file // _CHUNK, "file_index": file % _CHUNK}


def _place(folder: pathlib.Path, file: int, suffix: str) -> pathlib.Path:
  path = folder / (_FILE.format(**_numbers(file)) + suffix)
  path.parent.mkdir(parents=True, exist_ok=True)
  return path


def _write_meta(
  folder: pathlib.Path, about: About, features: dict[str, Any], stats: dict[str, Any], counts: Any
):
  """Writes `info.json`, `stats.json` and the task, as pandas reads an index."""
  import pyarrow as pa
  import pyarrow.parquet as pq

  episodes, frames, rate = counts
  info = {
    "codebase_version": "v3.0", "robot_type": "palpate", "fps": rate,
    "total_episodes": episodes, "total_frames": frames, "total_tasks": 1,
    "chunks_size": _CHUNK, "data_files_size_in_mb": _DATA_MB, "video_files_size_in_mb": _FILM_MB,
    "splits": {"train": f"0:{episodes}"},
    "data_path": f"data/{_FILE}.parquet",
    "video_path": f"videos/{{video_key}}/{_FILE}.mp4" if _PIXELS in features else None,
    "features": features,
  }  # fmt: skip
  dump: Callable[[Any], str] = lambda value: json.dumps(value, indent=2) + "\n"  # noqa: E731
  (folder / "meta/info.json").write_text(dump(info), encoding="utf-8")
  (folder / "meta/stats.json").write_text(dump(stats), encoding="utf-8")
  kinds = {"task_index": "int64", "task": "unicode"}
  pandas = {
    "index_columns": ["task"], "column_indexes": [],
    "columns": [
      {"name": name, "field_name": name, "pandas_type": kind, "metadata": None,
       "numpy_type": "int64" if kind == "int64" else "object"}
      for name, kind in kinds.items()
    ],
  }  # fmt: skip
  table = pa.table({"task_index": [0], "task": [instruction(about.task)]})
  table = table.replace_schema_metadata({"pandas": json.dumps(pandas)})
  pq.write_table(table, folder / "meta/tasks.parquet")
