"""Runs an exercise, records it, and replays a recording to the bit.

A recording of an exercise holds the task's name and options, the seed, every action and reward, the
organ's surface, and the states at the start and the end. Seed and actions give all the rest again.
Sample 0 is the start; action and reward of sample k are those of the step that led to it, NaN in 0.
"""

import dataclasses
import json
import os
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
import palpate

from .. import suite
from ..recorder import Recorder
from ..recording import Recording
from .environment import Environment
from .performer import Act


class EpisodeError(RuntimeError):
  """An exercise that ended before its time; what was recorded so far is kept.

  Attributes:
    recording: until then
  """

  def __init__(self, message: str, recording: Recording):
    super().__init__(message)
    self.recording = recording


def run(
  env: Environment,
  act: Act,
  seed: int,
  info: Mapping[str, Any] | None = None,
  states: bool = False,
  watch: Callable[[Any], Any] | None = None,
  journal: str | os.PathLike[str] | None = None,
) -> Recording:
  """Returns the recording of one episode.

  Args:
    env: of the suite
    act: called with each time step, returns the action
    seed: of the episode
    info: the caller's own entries of the recording, JSON; with `task_kwargs` it can be replayed
    states: whether the state (mjSTATE_INTEGRATION) of every step is kept; it is large
    watch: called with the environment after every step; a true result ends the episode
    journal: file that takes the episode second by second, see `Recorder`

  Raises:
    EpisodeError: the policy raised, an action is not allowed or the motion diverged.
  """
  task: Any = env.task
  physics: Any = env.physics
  task.random = np.random.RandomState(seed)
  timestep = env.reset()
  recorder = _begin(env, seed, info or {}, states, journal)
  physics.meanwhile = recorder.settle
  total = 0.0

  def finish() -> Recording:
    physics.meanwhile = None
    recorder.info |= {"outcome": task.outcome or "time limit", "return": total}
    recorder.attach("state_last", physics.integration_state())
    recorder.close()
    return recorder.recording()

  while not timestep.last():
    try:
      action = np.asarray(act(timestep), np.float64)
      timestep = env.step(action)
    except (Exception, SystemExit) as error:
      task.outcome = task.outcome or "error"
      recorder.info["error"] = f"{type(error).__name__}: {error}"
      text = f"{task.name}: step {len(recorder) - 1}: {recorder.info['error']}"
      raise EpisodeError(text, finish()) from error
    total += timestep.reward
    arrays = task.arrays(physics) | {"reward": np.float64(timestep.reward)}
    if states:
      arrays["state"] = physics.integration_state()
    recorder.append(**task.sample(physics), arrays=arrays)
    for event in task.take_events():
      recorder.event(**dataclasses.asdict(event))
    if watch is not None and watch(env):
      task.outcome = task.outcome or "stopped"
      break
  return finish()


def _begin(
  env: Environment,
  seed: int,
  info: Mapping[str, Any],
  states: bool,
  journal: str | os.PathLike[str] | None,
) -> Recorder:
  """Returns the recorder of an episode, with the constants and the sample of its start."""
  task: Any = env.task
  physics: Any = env.physics
  names = [hand.prefix.rstrip("/") for hand in physics.hands]
  recorder = Recorder(names, task.settings(), task.watch, substeps=substeps(env), journal=journal)
  recorder.info = {
    "task": task.name,
    "seed": seed,
    "palpate": palpate.__version__,
    "mujoco": mujoco.__version__,
    **json.loads(json.dumps(dict(info))),
  }
  if task.drawn:
    recorder.info["randomised"] = task.drawn
  recorder.attach("vertices", physics.nodes())
  recorder.attach("triangles", physics.organ.elem)
  recorder.attach("state_first", physics.integration_state())
  for name, value in task.constants(physics).items():
    recorder.attach(name, value)
  first = {"state": physics.integration_state()} if states else None
  recorder.append(**task.sample(physics), arrays=first)
  return recorder


def substeps(env: Environment) -> int:
  """Returns how many steps the physics takes in a control step."""
  return round(env.control_timestep() / env.physics.timestep())


def environment(recording: Recording) -> Environment:
  """Returns the environment that a recording was made in."""
  info = recording.info
  if "action" not in recording.arrays and len(recording.time) > 1:
    raise ValueError("the recording holds no actions: it is not one of an exercise")
  for key, kind in (("task", str), ("seed", int), ("task_kwargs", dict)):
    if not isinstance(info.get(key), kind):
      found = repr(info[key]) if key in info else "missing"
      raise ValueError(f"{key!r} is {found}: the recording is not one of an exercise")
  try:
    return suite.load(*suite.split(info["task"]), task_kwargs=info["task_kwargs"])
  except TypeError as error:
    raise ValueError(f"'task_kwargs' is {info['task_kwargs']}: {error}") from None


def replay(
  recording: Recording, watch: Callable[[Any], Any] | None = None, env: Environment | None = None
) -> Recording:
  """Returns a recording's episode run anew from its seed and actions.

  Args:
    recording: of an exercise
    watch: see `run`
    env: to run it in, one like the recording's own by default
  """
  env = env or environment(recording)
  actions = iter(recording.arrays.get("action", np.zeros((0, 0)))[1:])
  views = iter(recording.arrays.get("laparoscope", np.zeros((0, 7)))[1:])

  class _Over(Exception):
    pass

  def act(_) -> np.ndarray:
    try:
      action = next(actions)
    except StopIteration:
      raise _Over from None
    view = next(views, None)
    if view is not None and np.isfinite(view).all():
      env.physics.look_from(view)
    return action

  kept = {k: v for k, v in recording.info.items() if k not in ("outcome", "return", "error")}
  try:
    return run(env, act, recording.info["seed"], kept, "state" in recording.arrays, watch)
  except EpisodeError as error:
    if not isinstance(error.__cause__, _Over):
      raise
    again = error.recording  # the first one was stopped there
    again.info["outcome"] = recording.info.get("outcome", "stopped")
    del again.info["error"]
    return again


def differences(first: Recording, second: Recording) -> list[str]:
  """Returns what two recordings differ in, to the bit; nothing for a true replay."""
  out = []
  if len(first.time) != len(second.time) or not np.array_equal(first.time, second.time):
    out.append("time")
  for table in ("columns", "arrays", "constants"):
    a, b = getattr(first, table), getattr(second, table)
    for name in sorted(set(a) | set(b)):
      same = name in a and name in b and np.array_equal(a[name], b[name], equal_nan=True)
      if not same:
        out.append(f"{table[:-1]} {name}")
  if first.metrics() != second.metrics():
    out.append("metrics")
  return out
