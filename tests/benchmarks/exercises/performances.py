"""Episodes of performers: run once for a state of the code, and kept as by `palpate panel`."""

from __future__ import annotations

import argparse
import pathlib
from collections.abc import Iterable, Iterator

from palpate.app import panel
from palpate.app.learn.evaluate import Result


def arguments(parser: argparse.ArgumentParser):
  """Declares the options of benches of episodes."""
  add = parser.add_argument
  add("--episodes", type=int, help="of each performer (experts 50, skill 10)")
  add("--runs", type=pathlib.Path, default=pathlib.Path("out", "panel"),
      help="episodes, kept, as of palpate panel (%(default)s)")  # fmt: skip


def folder(args: argparse.Namespace) -> str:
  """Returns where the episodes of the code as it is are kept."""
  path = args.runs.resolve() / panel.fingerprint()
  path.mkdir(parents=True, exist_ok=True)
  return str(path)


def performances(name: str, style: str, seeds: Iterable[int], kept: str) -> Iterator[Result]:
  """Yields the results of seeds, run unless they are in the folder."""
  for seed in seeds:
    yield panel.kept((name, style, seed, kept))
