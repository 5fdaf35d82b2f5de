"""The exercises as Gymnasium environments.

    import gymnasium, palpate.tasks
    env = gymnasium.make("palpate/Touch-v0", render_mode="rgb_array")

Observations are those of the exercise (see `base`), a `Dict` of float64 boxes; actions and rewards
too. `terminated` is set by success and failure, `truncated` by the time limit. `info` has
`success`, `outcome` (None while it runs), `progress` and `peak_force` [N]; with `record=True` the
last step has `metrics` as well: the known skill metrics of the episode [SI] by name.
"""

import math
from typing import Any

import gymnasium
import numpy as np

from . import episode, suite
from .display import Window
from .recorder import Recorder
from .scenes import CAMERA


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
    **task_kwargs: Any,
  ):
    """Makes the environment.

    Args:
      task: such as "touch/easy"
      render_mode: None, `rgb_array` (the laparoscope's picture) or `human` (a window)
      width: of the picture [pixels]
      height: of the picture [pixels]
      record: whether the last `info` of an episode holds its skill metrics
      **task_kwargs: of the task, such as `reward="sparse"` or `pixels=(84, 84)`
    """
    if render_mode is not None and render_mode not in self.metadata["render_modes"]:
      modes = ", ".join(self.metadata["render_modes"])
      raise ValueError(f"render_mode is {render_mode!r}, expected None or one of {modes}")
    self.render_mode = render_mode
    self._size, self._record = (height, width), record
    self.environment = suite.load(*suite.split(task), task_kwargs={"random": 0, **task_kwargs})
    count = len(self._task.components)
    self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (count,), np.float64)
    self.observation_space = gymnasium.spaces.Dict(
      {
        name: gymnasium.spaces.Box(0, 255, spec.shape, np.uint8)
        if spec.dtype == np.uint8
        else gymnasium.spaces.Box(-np.inf, np.inf, spec.shape, np.float64)
        for name, spec in self.environment.observation_spec().items()
      }
    )
    self._window: Window | None = None
    self._recorder: Recorder | None = None

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
    self._recorder = None
    if self._record:
      self._recorder = Recorder(
        ["instrument"], self._task.settings(), self._task.watch,
        substeps=episode.substeps(self.environment),
      )  # fmt: skip
      for name, value in self._task.constants(self._physics).items():
        self._recorder.attach(name, value)
      self._recorder.append(**self._task.sample(self._physics))
    if self.render_mode == "human":
      self._show()
    return dict(timestep.observation), self._info()

  def step(self, action: Any):
    """Takes a control step of 0.02 s."""
    timestep = self.environment.step(action)
    outcome = self._task.outcome
    info = self._info()
    if self._recorder is not None:
      self._recorder.append(**self._task.sample(self._physics))
      for event in self._task.take_events():
        self._recorder.event(event.kind, event.time, event.value, event.instrument, event.label)
      if timestep.last():
        known = self._recorder.metrics().values()
        info["metrics"] = {k: float(v) for k, v in known.items() if math.isfinite(v)}
    if self.render_mode == "human":
      self._show()
    terminated = outcome is not None
    truncated = timestep.last() and not terminated
    return dict(timestep.observation), float(timestep.reward), terminated, truncated, info

  def _info(self) -> dict[str, Any]:
    outcome = self._task.outcome
    return {
      "success": outcome == "success",
      "outcome": outcome,
      "progress": float(self._task.progress),
      "peak_force": float(self._physics.peak_force),
    }

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

  def close(self) -> None:
    """Closes the window."""
    if self._window is not None:
      self._window.close()
    self._window = None
