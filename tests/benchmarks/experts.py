"""How many of its episodes each expert solves, over the seeds 0 to 49.

With `--references tasks/references` the expert references are made of the same episodes. Each
episode's recording is kept in `--runs` and what is there is not run again: stop and go on at will,
and remove that folder when the code has changed.
"""

from __future__ import annotations

import argparse
import json
import pathlib

import mujoco
import numpy as np
import palpate
from benchmarks.performances import arguments as add_episodes
from benchmarks.performances import performances
from benchmarks.runner import Bench, Case, Row
from palpate import tasks
from palpate.tasks.score import make_reference

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add_episodes(parser)
  parser.add_argument("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=NAMES)
  parser.add_argument("--references", default="", help="folder to write references to")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise."""
  keys = {"episodes": args.episodes or (2 if args.short else 50), "references": args.references}
  keys |= {"runs": str(pathlib.Path(args.runs).resolve())}
  if args.references:
    keys["references"] = str(pathlib.Path(args.references).resolve())
  return [[{"case": name, "task": name} | keys for name in args.tasks]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of an exercise."""
  name, count = case["task"], case["episodes"]
  good, failed, ends, peaks = [], [], [], []
  for seed, recording in enumerate(performances(name, "expert", count, case["runs"])):
    metrics = recording.metrics()
    ends.append(float(recording.time[-1]))
    peaks.append(metrics.peak_force)
    if recording.info["outcome"] == "success":
      good.append(metrics)
    else:
      failed.append(f"{seed} {recording.info['outcome']}")
  versions = {"palpate": palpate.__version__, "mujoco": mujoco.__version__}
  if case["references"]:
    data = make_reference(good, name, 0) | versions | {"episodes": count}
    path = pathlib.Path(case["references"]) / f"{name.replace('/', '_')}.json"
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
  row = {
    "task": name,
    "episodes": count,
    "success": len(good),
    "percent": round(100 * len(good) / count, 1),
    "time_s_mean": round(float(np.mean(ends)), 2),
    "time_s_max": round(max(ends), 2),
    "peak_force_N_mean": round(float(np.nanmean(peaks)), 3),
    "failed_seeds": "; ".join(failed),
  }
  return [row | versions]


BENCH = Bench("experts", stages, run, arguments=arguments)
