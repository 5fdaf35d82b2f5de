"""Demonstrations: an episode as what was observed, done and felt, to learn from.

Made by a performer, or of a recording that was kept, which is run anew to the bit: so it can be
observed otherwise than it was when it was recorded. Row k of the observations is what action k
answers; row k of forces is what was measured in the step that led to observation k.
"""

import dataclasses
import json
import os
import zipfile
from collections.abc import Mapping
from typing import Any

import numpy as np

from .. import suite
from ..core import episode, observation
from ..core.environment import Environment
from ..core.instrument import AXES
from ..core.performer import Act
from ..files import replacing
from ..inputs import SIGNALS
from ..recording import Recording

OPEN = ("time limit", "stopped")  # outcomes of an episode that could have gone on
LEVEL = 1  # of compression: pictures take 3 % more than at 6, in a third to two thirds of the time
# What LeRobot calls the groups, in data sets and in environments, and the pictures.
VECTORS = {
  "observation.state": "sensors", "observation.environment_state": "state",
  "observation.truth": "truth",
}  # fmt: skip
FILMS = {
  f"pixels{side}": f"observation.images.laparoscope{side}" for side in ("", "_left", "_right")
}


@dataclasses.dataclass(frozen=True, eq=False)
class Demonstration:
  """One episode.

  Attributes:
    observations: by name, pictures among them  (nstep + 1, ...)
    actions: each in [-1, 1]  (nstep, naction)
    rewards: of each action  (nstep,)
    forces: magnitudes by name, at each step of the physics [N]  (nstep + 1, nsubstep)
    components: names of the action's
    rate: actions a second [Hz]
    info: of the recording: task, seed, performer, outcome, return, versions, options
  """

  observations: dict[str, np.ndarray]
  actions: np.ndarray
  rewards: np.ndarray
  forces: dict[str, np.ndarray]
  components: tuple[str, ...]
  rate: float
  info: dict[str, Any]

  def __len__(self) -> int:
    return len(self.actions)

  @property
  def success(self) -> bool:
    """Whether the exercise was done."""
    return self.info["outcome"] == "success"

  @property
  def terminated(self) -> bool:
    """Whether it came to an end of its own, and not by the time limit."""
    return self.info["outcome"] not in OPEN

  def save(self, path: str | os.PathLike[str]) -> None:
    """Writes the demonstration, whole or not at all."""
    meta = {"components": self.components, "rate": self.rate, "info": self.info}
    arrays = {"meta": np.array(json.dumps(meta)), "action": self.actions, "reward": self.rewards}
    arrays |= {f"observation.{name}": value for name, value in self.observations.items()}
    arrays |= {f"force.{name}": value for name, value in self.forces.items()}
    # `np.savez_compressed` knows no level.
    with (
      replacing(path, "wb") as file,
      zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as archive,
    ):
      for name, value in arrays.items():
        with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
          np.lib.format.write_array(entry, np.asarray(value), allow_pickle=False)

  @classmethod
  def load(cls, path: str | os.PathLike[str]) -> "Demonstration":
    """Reads a demonstration that `save` has written."""
    tables: dict[str, dict[str, np.ndarray]] = {"observation": {}, "force": {}}
    with np.load(path, allow_pickle=False) as archive:
      for name in archive.files:
        kind, _, rest = name.partition(".")
        if rest:
          tables[kind][rest] = archive[name]
      meta = json.loads(str(archive["meta"][()]))
      actions, rewards = archive["action"], archive["reward"]
    return cls(
      tables["observation"], actions, rewards, tables["force"],
      tuple(meta["components"]), meta["rate"], meta["info"],
    )  # fmt: skip


def perform(
  env: Environment, act: Act, seed: int, info: Mapping[str, Any] | None = None, noise: float = 0.0
) -> Demonstration:
  """Returns a new episode; what is not said here is as in `episode.run`.

  Args:
    env: of the suite
    act: called with each time step, returns the action
    seed: of the episode
    info: the caller's own entries
    noise: SD of what is added to the instrument's motion; the actions that are kept are those
      that were meant, so that they show how to come back (DART: Laskey et al. 2017) [-]
  """
  watched: Any = _Watched(env)
  random, meant = np.random.RandomState(seed), []
  moves = np.isin(watched.task.components, AXES)

  def shaken(timestep: Any) -> np.ndarray:
    meant.append(np.asarray(act(timestep), float))
    return np.clip(meant[-1] + noise * moves * random.normal(size=len(moves)), -1, 1)

  if not noise:
    return _made(watched, episode.run(watched, act, seed, info))
  kept = dict(info or {}) | {"noise": noise}
  made = _made(watched, episode.run(watched, shaken, seed, kept))
  return dataclasses.replace(made, actions=np.array(meant))


def repeat(env: Environment, recording: Recording) -> Demonstration:
  """Returns the episode of a recording, run anew.

  Args:
    env: one of the recording's task and options, whatever is observed in it
    recording: of an exercise

  Raises:
    ValueError: it comes out otherwise than it was.
  """
  watched: Any = _Watched(env)
  again = episode.replay(recording, env=watched)
  if changed := episode.differences(recording, again):
    raise ValueError(f"the replay differs in {', '.join(changed)}")
  return _made(watched, again)


class _Watched:
  """An environment whose time steps are kept."""

  def __init__(self, env: Any):
    self.inner, self.timesteps = env, []

  def __getattr__(self, name: str) -> Any:
    return getattr(self.inner, name)

  def reset(self) -> Any:
    self.timesteps = [self.inner.reset()]
    return self.timesteps[0]

  def step(self, action: Any) -> Any:
    self.timesteps.append(self.inner.step(action))
    return self.timesteps[-1]


def _made(env: _Watched, recording: Recording) -> Demonstration:
  steps = env.timesteps
  names = steps[0].observation
  forces = {name: recording.columns[name][:, 0] for name in SIGNALS if name in recording.columns}
  actions = recording.arrays["action"][1:]
  if actions.ndim == 3:  # a hand's, at every step of the physics: where it is in the end
    actions = actions[:, -1]
  return Demonstration(
    observations={name: np.stack([step.observation[name] for step in steps]) for name in names},
    actions=actions,
    rewards=np.array([step.reward for step in steps[1:]], float),
    forces={name: value.reshape(len(steps), -1) for name, value in forces.items()},
    components=tuple(env.task.components),
    rate=1 / env.inner.control_timestep(),
    info=dict(recording.info),
  )


def group(name: str) -> str:
  """Returns the group of an observation: `sensors`, `state`, `truth` or `pictures`."""
  if name in observation.PICTURES:
    return "pictures"
  return observation.ROWS[name].group if name in observation.ROWS else "state"


def vector(observed: Mapping[str, np.ndarray], kind: str) -> np.ndarray:
  """Returns the observations of one step that are of a group, one after the other  (n,)."""
  parts = [np.ravel(value) for name, value in observed.items() if group(name) == kind]
  return np.concatenate([np.empty(0), *parts]).astype(np.float32)


def components(observed: Mapping[str, np.ndarray], kind: str) -> list[str]:
  """Returns the names of the numbers in `vector`, such as "tip_pos.0"."""
  return [
    name if np.size(value) == 1 else f"{name}.{i}"
    for name, value in observed.items() if group(name) == kind
    for i in range(np.size(value))
  ]  # fmt: skip


def instruction(task: str) -> str:
  """Returns what a task asks for, in one line, such as "touch four points within 3 mm"."""
  return suite.summary(*suite.split(task))
