"""Episodes of experts and novices, kept as recordings."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Iterator

from palpate.tasks import episode, performer, suite
from palpate.tasks.recording import Recording

_environments = {}  # the last one of this process


def arguments(parser: argparse.ArgumentParser):
  """Declares the options of benches of episodes."""
  add = parser.add_argument
  add("--episodes", type=int, help="of each performer (experts 50, skill 10)")
  add("--runs", default="out/episodes", help="recordings, kept (%(default)s)")


def performances(name: str, style: str, episodes: int, folder: str) -> Iterator[Recording]:
  """Yields the recordings of the seeds 0, 1, ..., run unless they are in the folder."""
  for seed in range(episodes):
    yield _perform(name, style, seed, pathlib.Path(folder))


def _perform(name: str, style: str, seed: int, folder: pathlib.Path) -> Recording:
  path = folder / name.replace("/", "_") / f"{style}_{seed}.npz"
  if path.exists():
    return Recording.load(path)
  if name not in _environments:
    _environments.clear()
    _environments[name] = suite.load(*suite.split(name), task_kwargs={"random": 0})
  env = _environments[name]
  info = {"task_kwargs": {}, "performer": style}
  try:
    recording = episode.run(env, performer.make(env, style, seed), seed, info)
  except episode.EpisodeError as error:
    recording = error.recording
  path.parent.mkdir(parents=True, exist_ok=True)
  recording.save(path)
  return recording
