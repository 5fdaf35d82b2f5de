"""Lessons: what an expert does, alone or where a policy has come to.

The script of an expert makes a plan of what is left to do, from wherever it begins. So a policy and
an expert may play by turns: who learns from that learns the way back from mistakes of its own
(Ross, Gordon and Bagnell 2011, 10.48550/arXiv.1011.0686). A turn of the policy ends where it does
not get on, or presses or grips with more than the force limit, while there is a way back: most is
taught where most is to be learned.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ..core.environment import Environment
from ..core.instrument import AXES
from ..core.performer import Performer, Script
from .policy import Policy

SHAKEN, CALM = 25, 50  # control steps that noise lasts, and that follow without
# What it shakes. Not the roll: where an expert does not turn the shaft, its clone shall not.
SHAKES = tuple(name for name in AXES if name != "roll")
_BACK = 0.2  # share of what has shaken the instrument that is made up in a control step
_STILL = 1e-9  # change of a goal in a control step that is none [rad, m]
EXPERT = (20, 80)  # control steps of an expert's turn, at least and at most
PATIENCE = (40, 120)  # control steps without progress that end a policy's turn


@dataclasses.dataclass(frozen=True, eq=False)
class Lesson:
  """An episode with an expert, a row a control step.

  Attributes:
    seen: what was observed, flat, in the order of the names  (nstep, nseen)
    meant: what the expert meant to do, 0 in a policy's turns  (nstep, naction)
    done: what was done  (nstep, naction)
    taught: whether that is worth to be learned  (nstep,) bool
    returns: discounted sum of the rewards from there on  (nstep,)
    outcome: of the episode, `time limit` without one
    alone: whether the policy needed no help
  """

  seen: np.ndarray
  meant: np.ndarray
  done: np.ndarray
  taught: np.ndarray
  returns: np.ndarray
  outcome: str
  alone: bool


class Teacher(Performer):
  """An expert to learn from: it moves evenly, does not wait, and announces what ends an episode.

  A slow start is hard to tell from an end, a pause from having come to rest, and a single step is
  easily missed. It searches no longer than it must: what is done long after its cause is hard to
  learn.

  Attributes:
    moves: whether the script moves the hand now
  """

  hasty = True

  def begin(self) -> None:
    """See `Performer`."""
    super().begin()
    self._before, self.moves = self.hand.drive_targets(), False

  def drive(self, goal: np.ndarray) -> np.ndarray:
    """Returns where the drives go on the way to a goal: what has shaken them is made up slowly.

    What is undone at once is neither seen nor learned.
    """
    before, self._before = self._before, goal
    self.moves = not np.allclose(goal, before, rtol=0.0, atol=_STILL)
    return self.hand.drive_targets() + goal - before + _BACK * (before - self.hand.drive_targets())

  def shares(self, steps: int) -> Iterator[float]:
    """Yields the shares of its way that an even movement has come after each of so many steps."""
    for k in range(1, steps + 1):
      yield k / steps

  def wait(self, duration: float) -> Script:
    """Holds still where the exercise is over."""
    if math.isinf(duration):
      yield from super().wait(duration)

  def say(self) -> Script:
    """Sets the component that is no motion to 1, by and by."""
    for self.extra[:] in np.linspace(0.1, 1.0, 10):
      yield self.step()


def give(
  env: Environment,
  names: Sequence[str],
  seed: int,
  gamma: float,
  noise: float = 0.0,
  learner: Policy | None = None,
  most: int | None = None,
) -> Lesson:
  """Returns the lesson of an episode.

  Args:
    env: of the suite
    names: of what is observed
    seed: of the episode
    gamma: discount of a control step [-]
    noise: SD of what is added to the motion of a hand that the expert moves, now and then; what is
      kept is what it meant to do (DART: Laskey et al. 2017, 10.48550/arXiv.1703.09327) [-]
    learner: takes turns with experts, and begins
    most: control steps of its turns at most; all, by default, as long as it gets on. With it an
      expert begins every other time: who fails at once would not be taught how to begin
  """
  task: Any = env.task
  task.random, random = np.random.RandomState(seed), np.random.RandomState(seed)
  shaken = noise * np.array([name.endswith(SHAKES) for name in task.components])
  own = np.arange(len(shaken)) < len(task.moved(task.prefix)) + len(task.extra)
  final = np.isin(task.components, task.final)
  timestep, phase = env.reset(), random.randint(SHAKEN + CALM)
  act = learner.begin() if learner else None
  turns = _Turns(env, random, most, act is not None)
  seen, meant, done, taught, rewards, best = [], [], [], [], [], 0
  while not timestep.last():
    seen.append(flat(timestep.observation, names))
    action = act(timestep.observation) if act else np.zeros(len(shaken))  # it sees all
    expert = turns.next(bool((action[final] > 0.5).any()))
    meant.append(np.zeros(len(shaken)) if expert is None else np.asarray(expert(timestep), float))
    if expert is not None:
      shakes = (len(done) + phase) % (SHAKEN + CALM) < SHAKEN
      moves = np.where(own, expert.moves, expert.other is not None and expert.other.moves)
      off = shakes * moves * shaken * random.normal(size=len(shaken))
      action = np.clip(meant[-1] + off, -1, 1)
    if act:
      act.last = action
    done.append(action)
    taught.append(expert is not None)
    before, timestep = task.best, env.step(action)
    rewards.append(float(timestep.reward))
    best = len(done) if task.best > before else best
  if task.outcome != "success":
    taught[best:] = [False] * (len(taught) - best)  # it did not help
  returns = np.array(rewards)
  for k in reversed(range(len(returns) - 1)):
    returns[k] += gamma * returns[k + 1]
  rows = np.array(seen, np.float32), np.array(meant, np.float32), np.array(done, np.float32)
  ends = returns.astype(np.float32), task.outcome or "time limit", not turns.helped
  return Lesson(*rows, np.array(taught, bool), *ends)


class _Turns:
  """Whose turn it is in a lesson.

  Attributes:
    helped: whether an expert had one
  """

  def __init__(self, env: Environment, random: np.random.RandomState, most: int | None, both: bool):
    self._env, self._random, self._most, self._both = env, random, most, both
    self._expert: Teacher | None = None
    self.helped = False
    self._begin(not both or (most is not None and random.rand() < 0.5))

  def next(self, ends: bool) -> Teacher | None:
    """Returns the expert if it is the next to act; `ends` is whether a policy wants to end all."""
    task: Any = self._env.task
    physics: Any = self._env.physics
    progress, harsh = float(task.progress), task.harsh(physics)
    self._idle = 0 if progress > self._best else self._idle + 1
    self._best = max(self._best, progress)
    if not self._left or (self._expert is None and self._idle > self._patience):
      self._begin(self._expert is None)
    if (ends or harsh) and self._expert is None:
      self._begin(True)
    self._left -= 1
    return self._expert

  def _begin(self, helps: bool) -> None:
    """Begins a turn, of an expert or of the policy."""
    self._expert = Teacher(self._env) if helps else None
    self.helped |= helps
    turn = EXPERT if helps else self._most and (1, self._most)
    self._left = self._random.randint(*turn) if turn and self._both else math.inf
    self._idle, self._best = 0, -math.inf
    self._patience = self._random.randint(*PATIENCE)


def flat(observation: Any, names: Sequence[str]) -> np.ndarray:
  """Returns what was observed as one array."""
  return np.concatenate([np.ravel(observation[name]) for name in names])
