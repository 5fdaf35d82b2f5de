"""How many of their episodes experts, skilled people and novices solve, and are proficient in.

Seeds from 0 on, which no reference is made from: those are of `palpate panel`. Each episode's
recording is kept in `--runs` and what is there is not run again: stop and go on at will, and remove
that folder when the code has changed.
"""

from __future__ import annotations

import argparse
import collections
import pathlib

import mujoco
import numpy as np
import palpate
from benchmarks.performances import arguments as add_episodes
from benchmarks.performances import performances
from benchmarks.runner import Bench, Case, Row
from palpate import tasks
from palpate.tasks import performer, score

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]
# Styles of each group, and episodes of each style.
GROUPS = {
  "expert": (("expert",), 50),
  "skilled": (("skilled",), 20),
  "novices": (tuple(performer.NOVICES), 3),
}


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add_episodes(parser)
  parser.add_argument("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=NAMES)
  parser.add_argument("--who", nargs="+", metavar="WHO", choices=GROUPS, default=list(GROUPS))


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise and group."""
  runs = str(pathlib.Path(args.runs).resolve())
  return [
    [
      {"case": f"{name}, {who}", "task": name, "who": who, "runs": runs}
      | {"episodes": args.episodes or (2 if args.short else GROUPS[who][1])}
      for name in args.tasks
      for who in args.who
    ]
  ]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of an exercise and group."""
  name = case["task"]
  reference = score.reference(name)
  failed, over, scores, ends, peaks = [], collections.Counter(), [], [], []
  for style in GROUPS[case["who"]][0]:
    for seed, recording in enumerate(performances(name, style, case["episodes"], case["runs"])):
      metrics, outcome = recording.metrics(), recording.info["outcome"]
      ends.append(float(recording.time[-1]))
      peaks.append(metrics.peak_force)
      if outcome != score.SUCCESS:
        failed.append(f"{seed if style == case['who'] else f'{style} {seed}'} {outcome}")
      if reference is not None:
        scores.append(score.score(metrics, reference, outcome))
        over.update(scores[-1].over if outcome == score.SUCCESS else ())
  return [row(name, case["who"], failed, over, scores, ends, peaks)]


def row(name, who, failed, over, scores, ends, peaks) -> Row:
  """Returns the row of a group's episodes; the arguments are theirs."""
  count = len(ends)
  return {
    "task": name,
    "who": who,
    "episodes": count,
    "success": count - len(failed),
    "percent": round(100 - 100 * len(failed) / count, 1),
    "proficient_percent": round(100 * float(np.mean([s.proficient for s in scores])), 1),
    "score_mean": round(float(np.mean([s.composite for s in scores])), 2),
    "time_s_mean": round(float(np.mean(ends)), 2),
    "time_s_max": round(max(ends), 2),
    "peak_force_N_mean": round(float(np.nanmean(peaks)), 3),
    "failed_seeds": "; ".join(failed),
    "over_the_limit": "; ".join(f"{metric} {n}" for metric, n in over.most_common(3)),
    "palpate": palpate.__version__,
    "mujoco": mujoco.__version__,
  }


BENCH = Bench("experts", stages, run, arguments=arguments)
