"""Lessons: what an expert does, alone or where a policy has come to.

The script of an expert makes a plan of what is left to do, from wherever it begins. So a policy and
an expert may play by turns: who learns from that learns the way back from mistakes of its own
(Ross, Gordon and Bagnell 2011, 10.48550/arXiv.1011.0686).
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from dm_control.rl import control

from .performer import Performer, Script
from .physics import AXES

SHAKEN, CALM = 25, 50  # control steps that noise lasts, and that follow without
LEARNER, EXPERT = (1, 60), (20, 80)  # control steps of a turn, at least and at most


@dataclasses.dataclass(frozen=True, eq=False)
class Lesson:
  """What an expert did in an episode, a row a control step.

  Attributes:
    seen: what was observed, flat, in the order of the names  (nstep, nseen)
    done: what the expert meant to do  (nstep, naction)
    returns: discounted sum of the rewards from there on  (nstep,)
    outcome: of the episode, `time limit` without one
  """

  seen: np.ndarray
  done: np.ndarray
  returns: np.ndarray
  outcome: str


class Teacher(Performer):
  """An expert for who sees neither velocity nor time: it moves evenly, and does not wait.

  A slow start cannot be told from an end, nor a pause from having come to rest.
  """

  def line(self, goal: np.ndarray, speed: float) -> Script:
    """Moves the tip along a straight line."""
    start, way = self.tip, np.asarray(goal, float) - self.tip
    steps = max(1, round(float(np.linalg.norm(way)) / speed / self.dt))
    for k in range(1, steps + 1):
      self.tip = start + way * k / steps
      yield self.step()

  def wait(self, duration: float) -> Script:
    """Holds still, where the exercise is over or what is felt is measured."""
    if math.isinf(duration) or not self.task.resumes:
      yield from super().wait(duration)


def give(
  env: control.Environment,
  names: Sequence[str],
  seed: int,
  gamma: float,
  noise: float = 0.0,
  learner: Any = None,
) -> Lesson:
  """Returns the lesson of an episode.

  Args:
    env: of the suite
    names: of what is observed
    seed: of the episode
    gamma: discount of a control step [-]
    noise: SD of what is added to the expert's motion now and then; what is kept is what it meant
      to do (DART: Laskey et al. 2017, 10.48550/arXiv.1703.09327) [-]
    learner: called with an observation, returns an action: it begins, and takes turns with experts
  """
  task: Any = env.task
  task.random, random = np.random.RandomState(seed), np.random.RandomState(seed)
  moves = noise * np.isin(task.components, AXES)
  timestep, phase = env.reset(), random.randint(SHAKEN + CALM)
  expert: Any = Teacher(env) if learner is None else None
  left = random.randint(*LEARNER) if learner else math.inf
  seen, done, rewards, taught = [], [], [], []
  while not timestep.last():
    if not left:
      expert = None if expert else Teacher(env)
      left = random.randint(*(EXPERT if expert else LEARNER))
    left -= 1
    taught.append(expert is not None)
    if expert is None:
      assert learner
      action = learner(timestep.observation)
    else:
      action = np.asarray(expert(timestep), float)
      seen.append(flat(timestep.observation, names))
      done.append(action)
      shakes = (len(done) + phase) % (SHAKEN + CALM) < SHAKEN
      action = np.clip(action + shakes * moves * random.normal(size=len(moves)), -1, 1)
    timestep = env.step(action)
    rewards.append(float(timestep.reward))
  returns = np.array(rewards)
  for k in reversed(range(len(returns) - 1)):
    returns[k] += gamma * returns[k + 1]
  width = sum(int(np.prod(env.observation_spec()[name].shape)) for name in names)
  return Lesson(
    np.array(seen, np.float32).reshape(-1, width),
    np.array(done, np.float32).reshape(-1, len(moves)),
    returns[np.array(taught, bool)].astype(np.float32),
    task.outcome or "time limit",
  )


def flat(observation: Any, names: Sequence[str]) -> np.ndarray:
  """Returns what was observed as one array."""
  return np.concatenate([np.ravel(observation[name]) for name in names])
