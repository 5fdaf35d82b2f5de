"""dm_control's environment of an exercise."""

import collections
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from dm_env import specs
from palpate.tissue.reading import count_of

from . import engine, observation

CONTROL_TIMESTEP = 0.02  # [s]


class Environment(engine.Environment):
  """An exercise as dm_control has it; a step after the last one of an episode begins another."""

  def __init__(
    self,
    physics: engine.Physics,
    task: Any,
    time_limit: float,
    control_timestep: float | None = None,
    n_sub_steps: int | None = None,
    **kwargs: Any,
  ):
    """Makes the environment.

    Args:
      physics: of the exercise
      task: the exercise
      time_limit: of an episode [s]
      control_timestep: between actions [s]; 0.02 unless n_sub_steps is given
      n_sub_steps: steps of the physics between actions, in place of control_timestep
      **kwargs: see `dm_control.rl.control.Environment`
    """
    if n_sub_steps is None and control_timestep is None:
      control_timestep = CONTROL_TIMESTEP
    for name, value in (("time_limit", time_limit), ("control_timestep", control_timestep)):
      if value is not None and not (isinstance(value, int | float) and value > 0):
        raise ValueError(f"{task.name}: {name} is {value!r}, expected a number > 0 [s]")
    if n_sub_steps is not None:
      n_sub_steps = count_of(f"{task.name}: n_sub_steps", n_sub_steps)
    super().__init__(physics, task, time_limit, control_timestep, n_sub_steps, **kwargs)
    task.control_timestep = self.control_timestep()
    # Rounding must not add a step: 0.3 / 0.02 is more than 15.
    steps = time_limit / self.control_timestep()
    self.step_limit = steps if math.isinf(steps) else math.ceil(round(steps, 6))
    self._step_limit = self.step_limit  # dm_control's

  def observation_spec(self) -> Any:
    """Returns the specs of the observations by name; no picture is drawn for it."""
    found = self._task.observation_spec(self._physics)
    if not self._flat_observation:
      return found
    count = sum(math.prod(spec.shape) for spec in found.values())
    dtype = np.result_type(*(spec.dtype for spec in found.values()))
    name = engine.FLAT_OBSERVATION_KEY
    return collections.OrderedDict([(name, specs.Array((count,), dtype, name=name))])


def make(task: Any, time_limit: float, environment_kwargs: Mapping | None) -> Environment:
  """Returns the environment of a task, in a state in which it can be observed."""
  physics, before = task.physics(), task.random.get_state()
  with physics.reset_context():
    task.initialize_episode(physics)
  task.random.set_state(before)
  observation.check(task, physics)
  for name in task.rules.fields if task.rules else ():
    if not hasattr(task, name):
      kind = type(task).__name__
      raise TypeError(f"{task.name}: {kind} has no {name!r}, which is a field of its state")
  return Environment(physics, task, time_limit, **(environment_kwargs or {}))
