"""Lessons for `palpate train`: an expert teaches, in processes beside."""

from __future__ import annotations

import dataclasses
import json
import pathlib
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import palpate

from . import options, workers
from .console import CommandError, Interrupt, Progress, writing

if TYPE_CHECKING:
  from palpate.tasks.batch.networks import Networks
  from palpate.tasks.lessons import Lesson

LESSONS = "lessons.npz"
_FIRST = 10_000_000  # seed of the first lesson
_NOISE = 0.2  # SD of what shakes the expert in every other lesson, at most [-]


@dataclasses.dataclass(frozen=True)
class Job:
  """A lesson to be given.

  Attributes:
    task: such as "touch/easy"
    task_kwargs: options as JSON
    names: of what is observed
    seed: of the episode
    gamma: discount [-]
    noise: see `lessons.give`
    policy: file of who takes turns with the expert, or empty
  """

  task: str
  task_kwargs: str
  names: tuple[str, ...]
  seed: int
  gamma: float
  noise: float = 0.0
  policy: str = ""


def give(job: Job) -> Lesson:
  """Returns a lesson, in a worker's process."""
  palpate.register()
  from palpate.tasks import lessons, policy

  env = options.environment(job.task, job.task_kwargs)
  learner = policy.load(job.policy) if job.policy else None
  return lessons.give(env, job.names, job.seed, job.gamma, job.noise, learner)


class School:
  """Rounds of lessons of an exercise: first of the expert alone, then where the policy is.

  Attributes:
    lessons: of all rounds so far
    rounds: that are done
    seconds: spent on them
  """

  def __init__(self, folder: pathlib.Path, task: str, task_kwargs: Mapping[str, Any], seed: int):
    """Opens a folder, which may have lessons already."""
    self.path, self.task, self.seed = folder / LESSONS, task, seed
    self.task_kwargs = json.dumps({"surroundings": "none", **task_kwargs})  # it draws nothing
    self.lessons: list[Lesson] = []
    self.rounds, self.seconds = 0, 0.0
    if self.path.exists():
      self._load()

  def teach(
    self,
    networks: Networks,
    crew: workers.Workers,
    count: int,
    gamma: float,
    interrupt: Interrupt,
  ) -> bool:
    """Gives a round of lessons, which the networks learn from; returns whether it is whole.

    Args:
      networks: that learn; the policy beside the lessons is theirs
      crew: who gives lessons
      count: of lessons
      gamma: discount [-]
      interrupt: once seen, the round is given up
    """
    start, progress, given = time.perf_counter(), Progress(), []
    for lesson in workers.parallel(give, self._jobs(count, gamma), crew, interrupt):
      given.append(lesson)
      progress.show(f"round {self.rounds + 1}: {len(given)} of {count} lessons")
    progress.clear()
    if interrupt.seen:
      return False
    whole = [lesson for lesson in given if lesson is not None]
    # What an expert could not bring to a good end may have been past helping.
    self.lessons += [lesson for lesson in whole if lesson.outcome == "success"] or whole
    if not any(len(lesson.done) for lesson in self.lessons):
      raise CommandError(f"{self.task}: no lesson was given: the workers died", code=1)
    error = networks.learn(self.lessons, lambda: interrupt.seen)
    self.rounds += 1
    self.seconds += time.perf_counter() - start
    wins = sum(lesson.outcome == "success" for lesson in whole)
    steps = sum(len(lesson.done) for lesson in self.lessons)
    print(
      f"lessons, round {self.rounds}: {wins} of {count} were a success; {steps} steps to learn "
      f"from, error {error:.3f}, {self.seconds:.0f} s"
    )
    return not interrupt.seen

  def _jobs(self, count: int, gamma: float) -> list[Job]:
    from palpate.tasks.batch.learning import POLICY

    random = np.random.RandomState(self.seed + self.rounds)
    first = _FIRST + (self.seed * 100 + self.rounds) * 10_000
    env: Any = options.environment(self.task, self.task_kwargs)
    jobs = []
    for k in range(count):
      job = Job(self.task, self.task_kwargs, tuple(env.observation_spec()), first + k, gamma)
      if k % 2:
        job = dataclasses.replace(job, noise=float(random.uniform(0, _NOISE)))
      if self.rounds and env.task.resumes:
        job = dataclasses.replace(job, policy=str((self.path.parent / POLICY).resolve()))
      jobs.append(job)
    return jobs

  # The file.

  def save(self) -> None:
    """Writes the lessons, whole or not at all."""
    from palpate.tasks.files import replacing

    every: dict[str, Any] = {
      name: np.concatenate([getattr(lesson, name) for lesson in self.lessons])
      for name in ("seen", "done", "returns")
    }
    lengths = np.array([len(lesson.done) for lesson in self.lessons])
    outcomes = np.array([lesson.outcome for lesson in self.lessons])
    done = np.array(json.dumps([self.task, self.task_kwargs, self.rounds, self.seconds]))
    with writing(self.path), replacing(self.path, "wb") as file:
      np.savez(
        file, allow_pickle=False, about=done, lengths=lengths, outcomes=outcomes, **every
      )  # fmt: skip

  def _load(self) -> None:
    from palpate.tasks.lessons import Lesson

    try:
      with np.load(self.path, allow_pickle=False) as file:
        task, _, self.rounds, self.seconds = json.loads(str(file["about"][()]))
        ends = np.cumsum(file["lengths"])[:-1]
        parts = [np.split(file[name], ends) for name in ("seen", "done", "returns")]
        outcomes = [str(outcome) for outcome in file["outcomes"]]
    except Exception as error:
      raise CommandError(f"{self.path}: {error}") from None
    if task != self.task:
      raise CommandError(f"{self.path} is of {task}, not of {self.task}")
    rows = zip(*parts, outcomes, strict=True)
    self.lessons = [Lesson(*row) for row in rows]
