"""`palpate train`: learns an exercise in many worlds at once."""

from __future__ import annotations

import argparse
import csv
import json
import math
import pathlib
import sys
from typing import TYPE_CHECKING, Any

import palpate

from . import options
from .console import (
  CommandError,
  Interrupt,
  Progress,
  check_counts,
  csv_rows,
  need,
  output_folder,
  writing,
)

if TYPE_CHECKING:
  from palpate.tasks.batch.learning import Learner

_FEW = 16  # worlds on a CPU
_MANY = 4096  # on a GPU
_SAVE = 60.0  # seconds between checkpoints
_JUDGE = 5  # iterations between looks at the policy without spread
_LICENCE = """SPDX-License-Identifier: Apache-2.0

The weights in this folder are licensed under the Apache License, version 2.0, as Palpate is, in
whose exercises they were trained.
"""


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("task", metavar="TASK", help="such as touch/easy; a domain alone is its standard task")
  add("-o", "--out", metavar="FOLDER", required=True, help="of policy, checkpoint and curves")
  add("--iterations", metavar="N", type=int, default=1000, help="at most (%(default)s)")
  add("--minutes", metavar="T", type=float, default=math.inf, help="at most, in all")
  add("--success", metavar="SHARE", type=float, default=math.inf, help="enough, without spread")
  add("--seed", metavar="N", type=int, default=0, help="of all that is random (%(default)s)")
  add("--num-envs", metavar="N", type=int, help=f"worlds ({_FEW} on a CPU, {_MANY} on a GPU)")
  add("--device", metavar="NAME", help="cpu or cuda:N; a GPU where there is one")
  add("--resume", action="store_true", help="go on with what is in the folder")
  options.add_argument(parser)


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  check_counts(args, "iterations")
  if args.num_envs is not None:
    check_counts(args, "num_envs")
  need("train", "torch", "rsl_rl", "tensordict", "safetensors", "gymnasium")
  palpate.register()
  from palpate.tasks import suite

  try:
    name = "/".join(suite.split(args.task))
  except ValueError as error:
    raise CommandError(str(error)) from None
  folder = output_folder("out", args.out)
  kwargs = options.read(args.set)
  learner, task = _learner(name, args, kwargs, folder)
  rows = _kept(folder, learner.iteration)
  progress = Progress()
  with Interrupt() as interrupt:
    last = learner.seconds

    def stop() -> bool:
      return interrupt.seen

    while not interrupt.seen and not _enough(args, learner, rows, stop):
      row = learner.iterate(stop)
      if row is None:
        break
      rows.append(row)
      progress.show(_line(row), always=True)
      if learner.seconds - last > _SAVE:
        last = learner.seconds
        _save(folder, learner, task, kwargs, rows)
  progress.clear()
  _save(folder, learner, task, kwargs, rows)
  if rows:
    print(_line(rows[-1]))
  print(folder / "policy.safetensors")
  if interrupt.seen:
    print("palpate: interrupted; go on with --resume", file=sys.stderr)
    return 130
  return 0


def _learner(name: str, args: argparse.Namespace, kwargs: dict[str, Any], folder: pathlib.Path):
  """Returns who learns, and the task; it goes on with what is in the folder."""
  import warp as wp
  from palpate.tasks.batch import learning, vector

  device = args.device or ("cuda:0" if wp.is_cuda_available() else "cpu")
  count = args.num_envs or (_FEW if device == "cpu" else _MANY)
  path = folder / learning.CHECKPOINT
  if path.exists() and not args.resume:
    raise CommandError(f"out has {path.name}, expected --resume or another folder")
  if args.resume and not path.exists():
    raise CommandError(f"out has no {path.name} to go on with")
  try:
    env = vector.Exercises(count, name, device=device, output="torch", **kwargs)
    learner = learning.Learner(env, learning.Settings(seed=args.seed))
    if args.resume:
      learner.load(path, name)
  except (ValueError, TypeError) as error:
    raise CommandError(str(error)) from None
  return learner, env.task


def _enough(args: argparse.Namespace, learner: Learner, rows: list, stop: Any) -> bool:
  if learner.iteration >= args.iterations or learner.seconds >= 60 * args.minutes:
    return True
  # With the spread of learning a policy may succeed that alone does not.
  wins = rows and rows[-1]["success"] >= args.success and learner.iteration % _JUDGE == 0
  return bool(wins) and learner.judge(stop) >= args.success


def _line(row: dict[str, float]) -> str:
  rate = row["steps"] / max(row["seconds"], 1e-9)
  return (
    f"iteration {row['iteration']:.0f}  {row['steps']:.3g} steps  {row['seconds']:.0f} s  "
    f"success {100 * row['success']:.0f} %  return {row['return']:.2f}  "
    f"{row['length']:.0f} steps an episode  {rate:.0f} steps/s"
  )


def _kept(folder: pathlib.Path, iteration: int) -> list[dict[str, float]]:
  """Returns the rows of the curve in a folder, as far as the checkpoint goes."""
  path = folder / "curve.csv"
  if not iteration or not path.exists():
    return []
  with path.open(newline="", encoding="utf-8") as file:
    rows = [{key: _number(value) for key, value in row.items()} for row in csv.DictReader(file)]
  return [row for row in rows if row["iteration"] <= iteration]


def _number(text: str) -> float:
  return int(text) if text.isdigit() else float(text)


def _save(folder: pathlib.Path, learner: Learner, task: Any, kwargs: dict[str, Any], rows: list):
  """Writes checkpoint, policy, licence and curves."""
  from palpate.tasks import policy
  from palpate.tasks.batch import learning

  with writing(folder):
    learner.save(folder / learning.CHECKPOINT, task.name)
    policy.save(folder / learning.POLICY, learner.policy(task, json.loads(json.dumps(kwargs))))
    (folder / "LICENSE").write_text(_LICENCE, encoding="utf-8")
    if rows:
      _plot(folder / "curve.png", task.name, rows)
  with csv_rows(folder / "curve.csv", learning.ROW) as write:
    for row in rows:
      write(row[name] for name in learning.ROW)


def _plot(path: pathlib.Path, name: str, rows: list[dict[str, float]]):
  """Draws success and return over steps, where matplotlib is installed."""
  try:
    from matplotlib.figure import Figure
  except ImportError:
    return
  figure = Figure(figsize=(7, 4), layout="constrained")
  axes = figure.add_subplot()
  steps = [row["steps"] for row in rows]
  axes.plot(steps, [row["success"] for row in rows], label="success [-]")
  axes.plot(steps, [row["return"] for row in rows], label="return [-]")
  axes.set(title=f"{name}, {rows[-1]['seconds']:.0f} s", xlabel="control steps", ylim=(-1.1, 1.1))
  axes.grid(alpha=0.3)
  axes.legend()
  figure.savefig(path, dpi=120)
