"""Runs an exercise, records it, and replays a recording to the bit.

A recording of an exercise holds the task's name and options, the seed, every action and reward, the
organ's surface, and the states at the start and the end. Seed and actions give all the rest again.
Sample 0 is the start; action and reward of sample k are those of the step that led to it, NaN in 0.
"""

import dataclasses
import functools
import importlib
import json
import os
import pathlib
import sys
from collections.abc import Callable, Mapping
from typing import Any

import mujoco
import numpy as np
import palpate
from dm_control.rl import control

from . import experts, suite
from .recorder import Recorder
from .recording import Recording
from .score import check_reference

Act = Callable[[Any], Any]


class EpisodeError(RuntimeError):
  """An exercise that ended before its time; what was recorded so far is kept.

  Attributes:
    recording: until then
  """

  def __init__(self, message: str, recording: Recording):
    super().__init__(message)
    self.recording = recording


def run(
  env: control.Environment,
  act: Act,
  seed: int,
  info: Mapping[str, Any] | None = None,
  states: bool = False,
  watch: Callable[[Any], Any] | None = None,
) -> Recording:
  """Returns the recording of one episode.

  Args:
    env: of the suite
    act: called with each time step, returns the action
    seed: of the episode
    info: the caller's own entries of the recording, JSON; with `task_kwargs` it can be replayed
    states: whether the state (mjSTATE_INTEGRATION) of every step is kept; it is large
    watch: called with the environment after every step; a true result ends the episode

  Raises:
    EpisodeError: the policy raised, an action is not allowed or the motion diverged.
  """
  task: Any = env.task
  physics: Any = env.physics
  task.random = np.random.RandomState(seed)
  timestep = env.reset()
  recorder = Recorder([physics.prefix.rstrip("/")], task.settings(), task.watch)
  recorder.info = {
    "task": task.name,
    "seed": seed,
    "palpate": palpate.__version__,
    "mujoco": mujoco.__version__,
    **json.loads(json.dumps(dict(info or {}))),
  }
  recorder.attach("vertices", physics.nodes())
  recorder.attach("triangles", physics.organ.elem)
  recorder.attach("state_first", physics.integration_state())
  for name, value in task.constants(physics).items():
    recorder.attach(name, value)
  first = {"state": physics.integration_state()} if states else None
  recorder.append(**task.sample(physics), arrays=first)
  total = 0.0

  def finish() -> Recording:
    recorder.info |= {"outcome": task.outcome or "time limit", "return": total}
    recorder.attach("state_last", physics.integration_state())
    return recorder.recording()

  while not timestep.last():
    try:
      action = np.asarray(act(timestep), np.float64)
      timestep = env.step(action)
    except Exception as error:
      task.outcome = task.outcome or "error"
      recorder.info["error"] = f"{type(error).__name__}: {error}"
      text = f"{task.name}: step {len(recorder) - 1}: {recorder.info['error']}"
      raise EpisodeError(text, finish()) from error
    total += timestep.reward
    arrays = {"action": action, "reward": np.float64(timestep.reward)}
    if states:
      arrays["state"] = physics.integration_state()
    recorder.append(**task.sample(physics), arrays=arrays)
    for event in task.take_events():
      recorder.event(**dataclasses.asdict(event))
    if watch is not None and watch(env):
      task.outcome = task.outcome or "stopped"
      break
  return finish()


def environment(recording: Recording) -> control.Environment:
  """Returns the environment that a recording was made in."""
  info = recording.info
  if "action" not in recording.arrays and len(recording.time) > 1:
    raise ValueError("the recording holds no actions: it is not one of an exercise")
  for key in ("task", "seed", "task_kwargs"):
    if key not in info:
      raise ValueError(f"the recording has no {key!r}: it is not one of an exercise")
  return suite.load(*suite.split(info["task"]), task_kwargs=info["task_kwargs"])


def replay(
  recording: Recording, watch: Callable[[Any], Any] | None = None
) -> tuple[Recording, control.Environment]:
  """Returns a recording's episode run anew from its seed and actions, and its environment."""
  env = environment(recording)
  actions = iter(recording.arrays.get("action", np.zeros((0, 0)))[1:])

  class _Over(Exception):
    pass

  def act(_) -> np.ndarray:
    try:
      return next(actions)
    except StopIteration:
      raise _Over from None

  kept = {k: v for k, v in recording.info.items() if k not in ("outcome", "return", "error")}
  try:
    again = run(env, act, recording.info["seed"], kept, "state" in recording.arrays, watch)
  except EpisodeError as error:
    if not isinstance(error.__cause__, _Over):
      raise
    again = error.recording  # it had been stopped there
  return again, env


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


def task_kwargs(options: Mapping[str, Any], seed: int) -> dict[str, Any]:
  """Returns the keyword arguments of a task with its seed."""
  return {"random": seed, **options}


# Policies and references.


def find(spec: str) -> Any:
  """Returns the object that "module:object" names; ValueError says what is wrong with it."""
  module, _, name = spec.partition(":")
  if not module or not name:
    raise ValueError(f"policy is {spec!r}, expected module:object")
  if os.getcwd() not in sys.path:
    sys.path.insert(0, os.getcwd())
  try:
    found: Any = importlib.import_module(module)
  except Exception as error:
    raise ValueError(f"policy {spec!r}: {type(error).__name__}: {error}") from error
  for part in name.split("."):
    if not hasattr(found, part):
      raise ValueError(f"policy {spec!r}: {module} has no {name!r}")
    found = getattr(found, part)
  if not callable(found):
    raise ValueError(f"policy {spec!r} is a {type(found).__name__}, expected something to call")
  return found


def performer(spec: str, env: control.Environment, seed: int) -> Act:
  """Returns who acts in an environment.

  Args:
    spec: a name of `experts.STYLES`, or "module:object": a class is made with (env, seed) and its
      object called with each time step; anything else is called with the observation
    env: the environment
    seed: of what is random in a scripted performer
  """
  if ":" not in spec:
    return experts.make(env, spec, seed)
  found = find(spec)
  if isinstance(found, type):
    return found(env, seed)
  return lambda timestep: found(timestep.observation)


def reference_path(name: str) -> pathlib.Path:
  """Returns where the expert reference of a task such as "touch/easy" is kept."""
  return pathlib.Path(__file__).parent / "references" / f"{name.replace('/', '_')}.json"


@functools.cache
def reference(name: str) -> dict[str, Any] | None:
  """Returns the expert reference of a task, None where there is none."""
  path = reference_path(name)
  if not path.exists():
    return None
  data = json.loads(path.read_text(encoding="utf-8"))
  check_reference(data)
  return data
