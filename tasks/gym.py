"""The exercises as Gymnasium environments.

    import gymnasium, palpate.tasks
    env = gymnasium.make("palpate/Touch-v0", render_mode="rgb_array")

Observations are those of the exercise (see `observation`), a `Dict` of boxes. `terminated` is set
by success and failure, `truncated` by the time limit, which is the task's, or `max_episode_steps`
of `gymnasium.make` if that is less. `info` has `success`, `outcome` (None while it runs),
`progress`, the largest forces of the step, `peak_force`, `shaft_force` and `surroundings_force`
[N], and, as constrained reinforcement learning has it, `cost`, at least 0: the sum of `cost_force`,
`cost_shaft`, `cost_surroundings` and `cost_damage`, see `safety`. With ranges to `randomise` it has
what was drawn as `randomised`; with
`record=True` the last step has `metrics`: the known skill metrics of the episode [SI] by name.

Nothing is drawn before the first reset, so processes that an asynchronous vector forks can draw.
"""

import math
from typing import Any

import gymnasium
import numpy as np

from . import registry, suite
from .core import episode
from .core.scenes import CAMERA
from .display import Window
from .recorder import Recorder


def _space(spec: Any) -> gymnasium.spaces.Box:
  low, high = getattr(spec, "minimum", -np.inf), getattr(spec, "maximum", np.inf)
  return gymnasium.spaces.Box(float(low), float(high), spec.shape, spec.dtype.type)


class Exercise(gymnasium.Env):
  """An exercise of `palpate.tasks`."""

  metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 50}  # noqa: RUF012

  def __init__(
    self,
    task: str = "touch/standard",
    render_mode: str | None = None,
    width: int = 640,
    height: int = 480,
    record: bool = False,
    control_timestep: float | None = None,
    n_sub_steps: int | None = None,
    **task_kwargs: Any,
  ):
    """Makes the environment.

    Args:
      task: such as "touch/easy"
      render_mode: None, `rgb_array` (the laparoscope's picture) or `human` (a window)
      width: of the picture [pixels]
      height: of the picture [pixels]
      record: whether the last `info` of an episode holds its skill metrics
      control_timestep: between actions [s], 0.02 by default
      n_sub_steps: steps of the physics between actions, in place of control_timestep
      **task_kwargs: of the task, such as `reward="sparse"` or `pixels=(84, 84)`
    """
    if render_mode is not None and render_mode not in self.metadata["render_modes"]:
      modes = ", ".join(self.metadata["render_modes"])
      raise ValueError(f"render_mode is {render_mode!r}, expected None or one of {modes}")
    self.render_mode = render_mode
    self._size, self._record = (height, width), record
    self._spec, self._name = None, suite.split(task)
    self.environment: Any = suite.load(
      *self._name,
      task_kwargs={"random": 0, **task_kwargs},
      environment_kwargs={"control_timestep": control_timestep, "n_sub_steps": n_sub_steps},
    )
    self._over = True  # until it begins
    rate = round(1 / self.environment.control_timestep())
    self.metadata = {**self.metadata, "render_fps": rate}
    count = len(self._task.components)
    self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (count,), np.float64)
    self.observation_space = gymnasium.spaces.Dict(
      {name: _space(spec) for name, spec in self.environment.observation_spec().items()}
    )
    self._window: Window | None = None
    self._recorder: Recorder | None = None

  @property
  def spec(self) -> Any:
    """What `gymnasium.make` made it of; None where it was made otherwise."""
    return self._spec

  @spec.setter
  def spec(self, value: Any) -> None:
    self._spec = value
    steps = self.environment.step_limit
    if steps > registry.step_limit(*self._name):
      gymnasium.logger.warn(
        f"{self._task.name}: the time limit is {steps} steps; unless gymnasium.make has "
        f"max_episode_steps={steps} too, episodes end after {registry.step_limit(*self._name)}"
      )

  @property
  def _task(self) -> Any:
    return self.environment.task

  @property
  def _physics(self) -> Any:
    return self.environment.physics

  def reset(self, *, seed: int | None = None, options: dict | None = None):
    """Starts an episode; a seed decides everything random from here on."""
    first = self._np_random is None
    super().reset(seed=seed)
    if seed is not None or first:
      self._task.random = np.random.RandomState(self.np_random.integers(2**31))
    timestep = self.environment.reset()
    self._over = False
    self._recorder = None
    if self._record:
      self._recorder = Recorder(
        [hand.prefix.rstrip("/") for hand in self._physics.hands],
        self._task.settings(), self._task.watch,
        substeps=episode.substeps(self.environment),
      )  # fmt: skip
      for name, value in self._task.constants(self._physics).items():
        self._recorder.attach(name, value)
      self._recorder.append(**self._task.sample(self._physics))
    if self.render_mode == "human":
      self._show()
    return dict(timestep.observation), self._info()

  def step(self, action: Any):
    """Takes a control step."""
    if self._over:
      raise gymnasium.error.ResetNeeded(
        f"{self._task.name}: step of an episode that is over or has not begun, expected reset first"
      )
    timestep = self.environment.step(action)
    self._over = timestep.last()
    outcome = self._task.outcome
    info = self._info()
    if self._recorder is not None:
      self._recorder.append(**self._task.sample(self._physics))
      for event in self._task.take_events():
        self._recorder.event(event.kind, event.time, event.value, event.instrument, event.label)
      if timestep.last():
        self._recorder.info["outcome"] = outcome or "time limit"
        known = self._recorder.metrics().values()
        info["metrics"] = {k: float(v) for k, v in known.items() if math.isfinite(v)}
    if self.render_mode == "human":
      self._show()
    terminated = outcome is not None
    truncated = timestep.last() and not terminated
    return dict(timestep.observation), float(timestep.reward), terminated, truncated, info

  def _info(self) -> dict[str, Any]:
    outcome = self._task.outcome
    info = {
      "success": outcome == "success",
      "outcome": outcome,
      "progress": float(self._task.progress),
      "peak_force": float(self._physics.peak_force),
      "shaft_force": float(self._physics.peak_shaft),
      "surroundings_force": float(self._physics.peak_surroundings),
      "cost": self._task.cost.total,
      **{f"cost_{part}": value for part, value in vars(self._task.cost).items()},
    }
    if self._task.ranges:
      info["randomised"] = {name: np.array(value) for name, value in self._task.drawn.items()}
    return info

  def render(self):
    """Returns the laparoscope's picture (height, width, 3) with `rgb_array`, else None."""
    if self.render_mode != "rgb_array":
      return None
    camera = self._physics.model.ptr.camera(CAMERA).id
    return self._physics.render(*self._size, camera_id=camera)

  def _show(self) -> None:
    data = self._physics.data.ptr
    if self._window is not None and self._window.data is not data:  # another organ, another model
      self.close()
    if self._window is None:
      try:
        self._window = Window(self._physics, CAMERA)
      except RuntimeError as error:
        raise RuntimeError(f"render_mode 'human': {error}; use 'rgb_array'") from None
    self._window.show()

  def __getstate__(self) -> dict[str, Any]:
    return vars(self) | {"_window": None}  # which stays where it is

  def close(self) -> None:
    """Closes the window."""
    if self._window is not None:
      self._window.close()
    self._window = None
