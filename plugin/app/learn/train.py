"""`palpate train`: learns an exercise from its expert, and by practice in many worlds at once."""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import pathlib
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import palpate

from .. import console, options, workers
from ..console import CommandError
from .teaching import LESSONS, LINES, School

if TYPE_CHECKING:
  from palpate.tasks.learn.learning import Student
  from palpate.tasks.learn.policy import Policy

_FEW = 16  # worlds on a CPU
_MANY, _SEEING = 4096, 1024  # on a GPU, and where pictures are drawn
_TRAINED = "trained"  # the teacher that comes with an exercise
_SAVE = 60.0  # seconds between checkpoints
ROUNDS = 6  # of lessons, at most
_LESSONS = 96  # of a round
UPDATES = 1000  # of the networks, after each round
JUDGE = 5  # iterations between looks at the policy without spread
_LICENCE = """SPDX-License-Identifier: Apache-2.0

The weights in this folder are licensed under the Apache License, version 2.0, as Palpate is, in
whose exercises they were trained.
"""


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("task", metavar="TASK", help="such as touch/easy; a domain alone is its standard task")
  add("-o", "--out", metavar="FOLDER", required=True, help="of policy, checkpoint and curves")
  add(
    "--lessons", metavar="N", type=int, default=_LESSONS,
    help=f"of an expert, in each of {ROUNDS} rounds at most (%(default)s); 0 for practice alone",
  )  # fmt: skip
  add(
    "--updates", metavar="N", type=int, default=UPDATES,
    help="of the networks, after each round (%(default)s)",
  )  # fmt: skip
  add(
    "--teacher", metavar="FILE", default=_TRAINED,
    help="of a policy of pictures: the policy of the state that it learns from (%(default)s)",
  )  # fmt: skip
  add("--from", metavar="FILE", dest="start", help="start from the policy of an easier exercise")
  add("--iterations", metavar="N", type=int, default=1000, help="of practice (%(default)s)")
  add(
    "--minutes", metavar="T", type=float, default=math.inf,
    help="at most, in all; lessons take half of what is left, learning from them the rest",
  )  # fmt: skip
  add("--success", metavar="SHARE", type=float, default=math.inf, help="enough, without noise")
  add("--seed", metavar="N", type=int, default=0, help="of all that is random (%(default)s)")
  add("--num-envs", metavar="N", type=int, help=f"worlds ({_FEW} on a CPU, {_MANY} on a GPU)")
  add("--device", metavar="NAME", help="cpu or cuda:N (a GPU if there is one)")
  add("--resume", action="store_true", help="continue with the files of the folder")
  workers.add_arguments(parser, os.cpu_count() or 1)
  options.add_argument(parser)
  options.add_observations(parser)


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  for count in ("iterations", "lessons"):
    if getattr(args, count) < 0:
      raise CommandError(f"{count} is {getattr(args, count)}, expected a whole number >= 0")
  console.check_counts(args, "updates", *(["num_envs"] if args.num_envs is not None else []))
  if not args.minutes > 0:
    raise CommandError(f"minutes is {args.minutes:g}, expected a number > 0")
  crew = workers.chosen(args)
  console.need("train", "torch", "rsl_rl", "tensordict", "safetensors", "gymnasium")
  palpate.register()

  training = Training(options.task_name(args.task), args, console.output_folder("out", args.out))
  with console.Interrupt() as interrupt:
    ok = training.teach(crew, interrupt) and training.practise(interrupt)
  print(training.folder / "policy.safetensors")
  if not ok:
    print("palpate: interrupted; go on with --resume", file=sys.stderr)
    return 130
  return 0


class Training:
  """An exercise that is learned: by lessons of its expert, then by practice in many worlds.

  Attributes:
    folder: of what comes of it
  """

  def __init__(self, name: str, args: argparse.Namespace, folder: pathlib.Path):
    """Makes the networks, or takes up what the folder has of them."""
    import warp as wp
    from palpate.tasks.core import observation
    from palpate.tasks.learn import learning, networks, policy

    self.name, self.args, self.folder = name, args, folder
    self.kwargs: dict[str, Any] = options.read(args.set, args.observations)
    self.device = args.device or ("cuda:0" if wp.is_cuda_available() else "cpu")
    for path in (folder / learning.CHECKPOINT, folder / LESSONS):
      if path.exists() and not args.resume:
        raise CommandError(f"out has {path.name}, expected --resume or another folder")
    self.school = School(folder, name, self.kwargs, args.seed, args.updates)
    if args.resume and not (self.school.rounds or (folder / learning.CHECKPOINT).exists()):
      raise CommandError(f"out has no {learning.CHECKPOINT} to go on with")
    begun = (folder / learning.CHECKPOINT).exists()
    single: Any = options.environment(name, self.school.task_kwargs)
    self.teacher, self.told = self._find_teacher(single.task), json.dumps(self.kwargs)
    taught = bool(self.teacher or self.school.rounds or (args.lessons and not begun))
    self.settings = learning.Settings(seed=args.seed, **(learning.TAUGHT if taught else {}))
    self.task, spec, privileged = single.task, dict(single.observation_spec()), []
    if self.teacher:
      self.kwargs["observations"] = [*observation.GROUPS, policy.PIXELS]
      single = options.environment(name, json.dumps({**self.kwargs, "surroundings": "unseen"}))
      privileged = [n for n in self.teacher.about.observations if n not in spec]
      spec |= {name: single.observation_spec()[name] for name in privileged}
    device = "cpu" if self.device == "cpu" else str(wp.device_to_torch(self.device))
    self.networks = networks.Networks(
      {key: tuple(spec[key].shape) for key in spec}, self.task.components,
      self.settings.memory, self.settings.hidden, self.settings.spread, args.seed, device, taught,
      privileged, self.task.initial_action,
    )  # fmt: skip
    if self.school.taught:
      self.networks.remember(self.school.lessons)
    self._start(begun)

  def _start(self, begun: bool) -> None:
    """Starts from the policy in the folder, or another one; what has `begun` has a checkpoint."""
    from palpate.tasks.learn import policy

    own = self.folder / policy.FILE
    path = own if (begun or self.school.rounds) and own.exists() else self.args.start
    if not path:
      return
    with console.one_line(before="from: "):
      made = policy.load(path)
      if not begun:
        self.networks.take(made)
    before = made.about.training.get("from", "")
    self.networks.start = before if path == own else pathlib.Path(path).name
    if not begun:
      self._write_taught()

  def _find_teacher(self, task: Any) -> Policy | None:
    """Returns who teaches a policy of pictures, None where numbers alone are observed."""
    from palpate.tasks.learn import policy

    names = task.observed.names
    if not task.observed.pictures:
      return None
    if set(names) != {"sensors", policy.PIXELS}:
      raise CommandError(
        f"{self.name}: observations is {','.join(names)}, expected sensors,{policy.PIXELS} or "
        "numbers alone"
      )
    with console.one_line(before="teacher: "):
      given = self.args.teacher
      return policy.shipped(self.name) if given == _TRAINED else policy.load(given)

  def teach(self, crew: workers.Workers, interrupt: console.Interrupt) -> bool:
    """Lets the expert teach; returns whether it was to the end."""
    from palpate.tasks.learn import learning

    school, networks = self.school, self.networks
    if self.teacher or (self.folder / learning.CHECKPOINT).exists():  # it practises already
      return True
    count, gamma, until = self.args.lessons, self.settings.gamma, 60 * self.args.minutes
    while count and school.rounds < ROUNDS and not school.ends(until):
      before = school.rounds
      whole = school.teach(networks, crew, count, gamma, interrupt, until)
      if school.rounds > before:
        school.save()
      if not whole:
        return False
      self._write_taught()
    return not interrupt.seen

  def _write_taught(self) -> None:
    """Writes the policy as it was taught so far, and its licence."""
    from palpate.tasks.learn import policy

    school, networks = self.school, self.networks
    with console.writing(self.folder):
      training = {
        "algorithm": "lessons", "lessons": networks.lessons, "rounds": school.rounds,
        "seconds": round(school.seconds, 1), "seed": self.args.seed,
      }  # fmt: skip
      made = networks.policy(self.task, self._told(), training)
      policy.save(self.folder / policy.FILE, made)
      (self.folder / "LICENSE").write_text(_LICENCE, encoding="utf-8")

  def practise(self, interrupt: console.Interrupt) -> bool:
    """Practises in many worlds; returns whether it was to the end."""
    time_left = self.school.seconds < 60 * self.args.minutes
    learner = self._learner() if self.args.iterations and time_left else None
    if learner is None:
      return True
    rows, progress = _kept(self.folder, learner.iteration), console.Progress(lines=LINES)
    last = learner.seconds
    while not interrupt.seen and not _enough(self.args, learner, rows, interrupt):
      row = learner.iterate(interrupt)
      if row is None:
        break
      rows.append(row)
      progress.show(_line(row), always=True)
      if learner.seconds - last > _SAVE:
        last = learner.seconds
        self._save(learner, rows)
    progress.clear()
    if rows or not (self.school.rounds or self.teacher):
      self._save(learner, rows)
    if rows:
      print(_line(rows[-1]))
    return not interrupt.seen

  def _learner(self) -> Student | None:
    """Returns who learns in many worlds, None where an exercise can only be taught."""
    from palpate.tasks.batch import vector
    from palpate.tasks.learn import distillation, learning

    path, most = self.folder / learning.CHECKPOINT, _SEEING if self.teacher else _MANY
    count = self.args.num_envs or (_FEW if self.device == "cpu" else most)
    try:
      env = vector.Exercises(count, self.name, device=self.device, output="torch", **self.kwargs)
    except vector.NotVectorisedError as error:
      if not self.school.rounds:
        raise CommandError(str(error)) from None
      print(f"palpate: taught, not practised: {error}", file=sys.stderr)
      return None
    except (ValueError, TypeError) as error:
      raise CommandError(str(error)) from None
    with console.one_line():
      if self.teacher:
        limits = self.args.iterations, 60 * self.args.minutes
        learner = distillation.Distillation(
          env, self.settings, self.networks, self.teacher, *limits
        )
      else:
        learner = learning.Learner(env, self.settings, self.networks, self.school.seconds)
      if path.exists():
        learner.load(path, self.name)
    return learner

  def _told(self) -> dict[str, Any]:
    return json.loads(self.told)

  def _save(self, learner: Student, rows: list[dict[str, float]]) -> None:
    """Writes checkpoint, policy, licence and curves."""
    from palpate.tasks.learn import learning, policy

    folder = self.folder
    with console.writing(folder):
      learner.save(folder / learning.CHECKPOINT, self.name)
      policy.save(folder / policy.FILE, learner.policy(self.task, self._told()))
      (folder / "LICENSE").write_text(_LICENCE, encoding="utf-8")
      if rows:
        _plot(folder / "curve.png", self.name, rows)
    with console.csv_rows(folder / "curve.csv", learning.ROW) as write:
      for row in rows:
        write(row[name] for name in learning.ROW)


def _enough(
  args: argparse.Namespace, learner: Student, rows: list, stop: Callable[[], bool]
) -> bool:
  if learner.iteration >= args.iterations or learner.seconds >= 60 * args.minutes:
    return True
  # With the spread of learning a policy may succeed that alone does not.
  wins = rows and rows[-1]["success"] >= args.success and learner.iteration % JUDGE == 0
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
