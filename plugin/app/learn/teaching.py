"""Lessons for `palpate train`: an expert teaches, in processes beside."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import pathlib
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import palpate

from .. import options, workers
from ..console import CommandError, Progress, writing

if TYPE_CHECKING:
  from palpate.tasks.learn.lessons import Lesson
  from palpate.tasks.learn.networks import Networks

LESSONS = "lessons.npz"
_ROWS, _ENDS = ("seen", "meant", "done", "taught", "returns"), ("outcome", "alone")  # of a lesson
LINES = 30.0  # seconds between lines about the progress, where there is no terminal
_FIRST = 10_000_000  # seed of the first lesson
_NOISE = 0.2  # SD of what shakes the expert in every other lesson, at most [-]
_TURN = 60  # control steps of the policy's turns in every other lesson, at most
_ENOUGH = 0.95  # share of the rest that it brings to a good end alone
_LEAST = 0.5  # of the time of a round, for the next to begin: one that is cut short does harm


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
    most: see `lessons.give`
  """

  task: str
  task_kwargs: str
  names: tuple[str, ...]
  seed: int
  gamma: float
  noise: float = 0.0
  policy: str = ""
  most: int | None = None


def give(job: Job) -> Lesson:
  """Returns a lesson, in a worker's process."""
  palpate.register()
  from palpate.tasks.learn import lessons, policy

  env = options.environment(job.task, job.task_kwargs)
  learner = policy.load(job.policy) if job.policy else None
  return lessons.give(env, job.names, job.seed, job.gamma, job.noise, learner, job.most)


class School:
  """Rounds of lessons of an exercise: first of the expert alone, then where the policy is.

  Attributes:
    lessons: of all rounds so far
    rounds: that are done
    seconds: spent on them
    alone: share that the policy brought to a good end without help where it was let to, last [-]
  """

  def __init__(
    self, folder: pathlib.Path, task: str, task_kwargs: Mapping[str, Any], seed: int, updates: int
  ):
    """Opens a folder, which may have lessons already.

    Args:
      folder: of the lessons
      task: such as "touch/easy"
      task_kwargs: its options
      seed: of the lessons
      updates: steps of the optimiser that a round is learned in
    """
    self.path, self.task, self.seed, self.updates = folder / LESSONS, task, seed, updates
    self.task_kwargs = json.dumps({"surroundings": "unseen", **task_kwargs})  # it draws nothing
    self.lessons: list[Lesson] = []
    self.rounds, self.seconds, self.alone, self._last = 0, 0.0, 0.0, 0.0
    if self.path.exists():
      self._load()

  def ends(self, until: float) -> bool:
    """Returns whether no round is to follow: the policy needs none, or has no time [s] for it."""
    return self.alone >= _ENOUGH or until - self.seconds <= _LEAST * self._last

  @property
  def taught(self) -> bool:
    """Whether there is a step to learn from: the policy may have needed no help so far."""
    return any(lesson.taught.any() for lesson in self.lessons)

  def teach(
    self,
    networks: Networks,
    crew: workers.Workers,
    count: int,
    gamma: float,
    stop: Callable[[], bool],
    until: float = math.inf,
  ) -> bool:
    """Gives a round of lessons, which the networks learn from; returns whether it is whole.

    Lessons that were given are kept, whether the networks have learned from them to the end or not.

    Args:
      networks: that learn; the policy beside the lessons is theirs
      crew: who gives lessons
      count: of lessons
      gamma: discount [-]
      stop: once it says so, the round is given up, or no more is learned of it
      until: seconds of all rounds that learning ends after; no lesson begins after half of those
        that are left
    """
    start, progress, given = time.perf_counter(), Progress(lines=LINES), []
    jobs, left = self._jobs(count, gamma), until - self.seconds

    def over(share: float = 1.0) -> bool:
      return stop() or time.perf_counter() - start >= share * left

    for lesson in workers.parallel(give, jobs, crew, lambda: over(0.5)):
      given.append(lesson)
      progress.show(f"round {self.rounds + 1}: {len(given)} of {count} lessons")
    if stop():
      progress.clear()
      return False
    whole = [lesson for lesson in given if lesson is not None]
    self.lessons += whole
    if not self.lessons:
      why = "the workers died" if given else "the time was over"
      raise CommandError(f"{self.task}: no lesson was given: {why}", code=1)
    error = math.nan
    if self.taught:
      turns, before = itertools.count(1), time.perf_counter() - start

      def spent() -> float:
        progress.show(f"round {self.rounds + 1}: learning, step {next(turns)}")
        return 1.0 if over() else (time.perf_counter() - start - before) / (left - before)

      error = networks.learn(self.lessons, self.updates, spent)
    progress.clear()
    self.rounds += 1
    self._last = time.perf_counter() - start
    self.seconds += self._last
    wins = sum(lesson.outcome == "success" for lesson in whole)
    # Lessons in which a policy was let to do all.
    pairs = zip(given, jobs, strict=False)
    free = [each for each, job in pairs if each and job.policy and job.most is None]
    self.alone = sum(each.alone and each.outcome == "success" for each in free) / max(len(free), 1)
    steps = sum(int(lesson.taught.sum()) for lesson in self.lessons)
    told = f"; {100 * self.alone:.0f} % of {len(free)} alone" if free else ""
    print(
      f"lessons, round {self.rounds}: {wins} of {len(given)} were a success{told}; "
      f"{steps} steps to learn from, error {error:.3f}, {self.seconds:.0f} s",
      flush=True,
    )
    return not stop()

  def _jobs(self, count: int, gamma: float) -> list[Job]:
    from palpate.tasks.learn.policy import FILE

    random = np.random.RandomState(self.seed + self.rounds)
    first = _FIRST + (self.seed * 100 + self.rounds) * 10_000
    env: Any = options.environment(self.task, self.task_kwargs)
    jobs, own = [], (self.path.parent / FILE).resolve()
    for k in range(count):
      job = Job(self.task, self.task_kwargs, tuple(env.observation_spec()), first + k, gamma)
      if k % 2:
        job = dataclasses.replace(job, noise=float(random.uniform(0, _NOISE)))
      # Of an easier exercise's policy alone it would learn what was missing, and forget the rest.
      if own.exists() and (self.rounds or not k % 2):
        turn = _TURN if k % 2 else None
        job = dataclasses.replace(job, policy=str(own), most=turn)
      jobs.append(job)
    return jobs

  # The file.

  def save(self) -> None:
    """Writes the lessons, whole or not at all."""
    from palpate.tasks.files import replacing

    every: dict[str, Any] = {
      name: np.concatenate([getattr(lesson, name) for lesson in self.lessons]) for name in _ROWS
    }
    every |= {name: np.array([getattr(each, name) for each in self.lessons]) for name in _ENDS}
    every["lengths"] = np.array([len(lesson.done) for lesson in self.lessons])
    about = [self.task, self.task_kwargs, self.rounds, self.seconds, self.alone]
    with writing(self.path), replacing(self.path, "wb") as file:
      np.savez(file, allow_pickle=False, about=np.array(json.dumps(about)), **every)

  def _load(self) -> None:
    from palpate.tasks.learn.lessons import Lesson

    try:
      with np.load(self.path, allow_pickle=False) as file:
        task, _, self.rounds, self.seconds, self.alone = json.loads(str(file["about"][()]))
        ends = np.cumsum(file["lengths"])[:-1]
        parts = [np.split(file[name], ends) for name in _ROWS]
        parts += [file[name].tolist() for name in _ENDS]
    except Exception as error:
      raise CommandError(f"{self.path}: {error}") from None
    if task != self.task:
      raise CommandError(f"{self.path} is of {task}, not of {self.task}")
    self.lessons = [Lesson(*row) for row in zip(*parts, strict=True)]
