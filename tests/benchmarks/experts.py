"""How many of its episodes each expert solves, over the seeds 0 to 49.

Each episode's recording is kept in `--runs` and what is there is not run again: stop and go on at
will, and remove that folder when the code has changed.
"""

from __future__ import annotations

import argparse
import pathlib

import mujoco
import numpy as np
import palpate
from benchmarks.performances import arguments as add_episodes
from benchmarks.performances import performances
from benchmarks.runner import Bench, Case, Row
from palpate import tasks

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add_episodes(parser)
  parser.add_argument("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=NAMES)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise."""
  keys = {"episodes": args.episodes or (2 if args.short else 50)}
  keys |= {"runs": str(pathlib.Path(args.runs).resolve())}
  return [[{"case": name, "task": name} | keys for name in args.tasks]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of an exercise."""
  name, count = case["task"], case["episodes"]
  failed, ends, peaks = [], [], []
  for seed, recording in enumerate(performances(name, "expert", count, case["runs"])):
    metrics = recording.metrics()
    ends.append(float(recording.time[-1]))
    peaks.append(metrics.peak_force)
    if recording.outcome != "success":
      failed.append(f"{seed} {recording.info['outcome']}")
  versions = {"palpate": palpate.__version__, "mujoco": mujoco.__version__}
  row = {
    "task": name,
    "episodes": count,
    "success": count - len(failed),
    "percent": round(100 - 100 * len(failed) / count, 1),
    "time_s_mean": round(float(np.mean(ends)), 2),
    "time_s_max": round(max(ends), 2),
    "peak_force_N_mean": round(float(np.nanmean(peaks)), 3),
    "failed_seeds": "; ".join(failed),
  }
  return [row | versions]


BENCH = Bench("experts", stages, run, arguments=arguments)
