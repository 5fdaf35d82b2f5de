"""What an agent learns of the exercises from random weights: success over time.

A case is a training with docs/tutorials/ppo.py, which knows no expert, to 90 % success without
noise in new episodes, or to the end of its minutes. `--jobs` trainings share the device: each then
has that share of it, and what others run there comes off too.
"""

from __future__ import annotations

import argparse
import csv
import math
import pathlib
import subprocess
import sys
import tempfile

import palpate
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import tasks

SCRIPT = pathlib.Path(__file__).parents[3] / "docs" / "tutorials" / "ppo.py"
NAMES = tuple(f"{domain}/easy" for domain in ("touch", "probe", "trace", "grasp", "retract"))
ENOUGH = 90.0  # success that is asked for [%]
POINTS = 30  # rows that are kept of a curve, and the last


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  names = ["/".join(pair) for pair in tasks.ALL_TASKS]
  add("--tasks", nargs="+", metavar="TASK", choices=names, default=NAMES)
  add("--seeds", type=int, nargs="+", default=[0, 1, 2])
  add("--device", default="cuda:0", help="cuda:0, cpu or warp-cpu (%(default)s)")
  add("--worlds", type=int, default=1024, help="(%(default)s)")
  add("--most", type=float, default=5.0, help="minutes of a training (%(default)s)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a seed and exercise."""
  keys = {key: getattr(args, key) for key in ("device", "worlds", "most")}
  keys |= {"worlds": 4, "most": 0.05} if args.short else {}
  cases = [
    {"case": f"{task}-{seed}", "task": task, "seed": seed} | keys
    for seed in args.seeds
    for task in args.tasks
  ]
  return [cases[:1] if args.short else cases]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Trains, and returns rows of the curve."""
  options = {"minutes": "most"} | {key: key for key in ("device", "worlds", "seed")}
  words = [word for name, key in options.items() for word in (f"--{name}", str(case[key]))]
  command = [sys.executable, str(SCRIPT), case["task"], *words]
  with tempfile.TemporaryFile("w+", encoding="utf-8") as curve:
    ended = subprocess.run(command, stdout=curve, stderr=subprocess.PIPE, text=True)
    if ended.returncode:
      raise RuntimeError(ended.stderr.strip().rpartition("\n")[2])
    curve.seek(0)
    found = list(csv.DictReader(curve))
  apart = max(1, len(found) // POINTS)
  return [
    {key: case[key] for key in ("task", "seed", "worlds")}
    | {"steps": int(row["steps"])}
    | {key: float(row[key]) for key in ("made", "seconds")}
    | {key: round(100 * float(row[key]), 1) for key in ("success", "judged")}
    | {"palpate": palpate.__version__}
    for row in (*found[:-1:apart], found[-1])
  ]


def trainings(rows: list[Row]) -> dict[str, list[list[Row]]]:
  """Returns the curves of each exercise, one a seed."""
  out: dict[str, dict[int, list[Row]]] = {}
  for row in rows:
    out.setdefault(row["task"], {}).setdefault(row["seed"], []).append(row)
  return {task: list(seeds.values()) for task, seeds in out.items()}


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  ends = [curve[-1] for curves in trainings(rows).values() for curve in curves]
  done = [end for end in ends if end["judged"] >= ENOUGH]
  lines = [f"{len(done)} of {len(ends)} trainings reached {ENOUGH:.0f} % success."]
  if done:
    steps, seconds = (max(end[key] for end in done) for key in ("steps", "seconds"))
    names = ", ".join(f"`{task}`" for task in dict.fromkeys(end["task"] for end in done))
    lines.append(f"They took at most {steps / 1e6:.2f} million control steps and {seconds:.0f} s: "
                 f"{names}.")  # fmt: skip
  return lines


def shown(value: float, unit: str = "") -> str:
  """Returns a whole number for a table, "-" where it is unknown."""
  return "-" if math.isnan(value) else f"{value:.0f}{unit}"


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Draws success over control steps, and writes the page."""
  found = trainings(rows)
  figure, axes = plots.grid(1, max(1, len(found)), 2.4 * max(1, len(found)), 2.4)
  for ax, (task, curves) in zip(axes, found.items(), strict=False):
    for curve in curves:
      ax.plot([r["steps"] / 1e6 for r in curve], [r["success"] for r in curve])
    ax.set(title=task, xlabel="million control steps", ylim=(0, 102))
  axes[0].set_ylabel("success, with noise [%]")
  title = "What is learned from nothing"
  picture = plots.save(figure, path.with_suffix(".png"), title)
  table = [
    [task, end["seed"], shown(end["made"]), f"{end['steps'] / 1e6:.2f}", f"{end['seconds']:.0f}",
     shown(end["judged"], " %"), f"{end['success']:.0f} %"]
    for task, curves in found.items()
    for end in (curve[-1] for curve in curves)
  ]  # fmt: skip
  head = ["exercise", "seed", "start [s]", "million control steps", "learning [s]", "success",
          "with noise"]  # fmt: skip
  lines = [
    *(__doc__ or "").split("\n\n", 1)[1].splitlines(),
    "`success` is without noise, of an episode in each world, and at least that: counting ends at "
    f"{ENOUGH:.0f} %. `with noise` is of the last episodes of the training. `start` is what comes "
    "before learning: kernels are compiled the first time an exercise runs, and loaded after that. "
    + results.link(path),
    "",
    *plots.table(head, table),
  ]
  return results.Page(title, finding(rows), lines, [picture])


BENCH = Bench("learning", stages, run, report=report, arguments=arguments, jobs=1, limit=3600.0)
