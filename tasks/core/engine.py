"""What exercises stand on: dm_control's classes, or their parts that exercises use without it.

dm_control needs labmaze, which has no wheel for Python 3.13 and later. There an exercise does the
same to the bit with the classes below: the interface is dm_control's (Tassa et al. 2020,
arXiv:2006.12983), and the environment is a `dm_env.Environment` too.
"""

from __future__ import annotations

import contextlib
import types
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import dm_env
import mujoco as mj
import numpy as np
from palpate import screen


class Wrapped:
  """An mjModel or mjData, `ptr`, as dm_control has it; attributes are those of `ptr`."""

  def __init__(self, ptr: Any, model: Wrapped | None = None):
    vars(self).update(ptr=ptr, model=model)

  def __getattr__(self, name: str) -> Any:
    if name.startswith("__"):  # of the wrapper's own, such as __deepcopy__
      raise AttributeError(name)
    return getattr(vars(self)["ptr"], name)

  def __setattr__(self, name: str, value: Any) -> None:
    setattr(self.ptr, name, value)

  def __reduce__(self) -> tuple:
    return Wrapped, (self.ptr, self.model)


class BarePhysics:
  """A model and its data.

  Args:
    data: the wrapped data, see `wrap`

  Attributes:
    data, model: the wrapped data and its model
  """

  def __init__(self, data: Wrapped):
    self._reload_from_data(data)

  @classmethod
  def from_model(cls, model: Wrapped) -> Any:
    """Returns the physics of a wrapped model."""
    return cls(Wrapped(mj.MjData(model.ptr), model))

  def _reload_from_model(self, model: Wrapped) -> None:
    self._reload_from_data(Wrapped(mj.MjData(model.ptr), model))

  def _reload_from_data(self, data: Wrapped) -> None:
    if getattr(self, "_contexts", None):
      self._free_rendering_contexts()
    self._data, self._contexts = data, None
    with contextlib.suppress(PhysicsError):
      self.after_reset()

  data = property(lambda self: self._data)
  model = property(lambda self: self._data.model)

  def copy(self, share_model: bool = False) -> Any:
    """Returns a physics in the same state."""
    twin, model = type(self).__new__(type(self)), self.model.ptr
    own = model if share_model else mj.MjModel.__copy__(model)
    data = mj.MjData(own)
    mj.mj_copyData(data, own, self.data.ptr)
    twin._reload_from_data(Wrapped(data, Wrapped(own)))
    return twin

  def __setstate__(self, data: Wrapped) -> None:
    self._reload_from_data(data)

  def time(self) -> float:
    """Returns the simulated time [s]."""
    return self.data.time

  def timestep(self) -> float:
    """Returns the time step [s]."""
    return self.model.opt.timestep

  def forward(self) -> None:
    """Recomputes what depends on the state."""
    with self.check_invalid_state():
      mj.mj_forward(self.model.ptr, self.data.ptr)

  @contextlib.contextmanager
  def reset_context(self) -> Iterator[Any]:
    """Resets the data before, and computes what depends on its state after what is inside."""
    mj.mj_resetData(self.model.ptr, self.data.ptr)
    with contextlib.suppress(PhysicsError):
      self.after_reset()
    yield self
    self.after_reset()

  def after_reset(self) -> None:
    """Recomputes what depends on the state, without actuation."""
    option = self.model.opt
    before, actuation = option.disableflags, int(mj.mjtDisableBit.mjDSBL_ACTUATION)
    option.disableflags |= actuation
    try:
      self.forward()
    finally:
      option.disableflags = before

  @contextlib.contextmanager
  def check_invalid_state(self) -> Iterator[None]:
    """Raises PhysicsError where what is inside makes MuJoCo warn."""
    before = self.data.warning.number.copy()
    yield
    more = np.flatnonzero(self.data.warning.number > before)
    if len(more):
      names = ", ".join(mj.mjtWarning(int(kind)).name for kind in more)
      raise PhysicsError(f"Physics state is invalid. Warning(s) raised: {names}")

  @property
  def contexts(self) -> dict:
    """The renderers, by height and width."""
    if self._contexts is None:
      self._contexts = {}
    return self._contexts

  def _free_rendering_contexts(self) -> None:
    for renderer in (self._contexts or {}).values():
      renderer.close()
    self._contexts = None

  def render(
    self,
    height: int = 240,
    width: int = 320,
    camera_id: int | str = -1,
    depth: bool = False,
    segmentation: bool = False,
    scene_option: mj.MjvOption | None = None,
  ) -> np.ndarray:
    """Returns a picture, see `dm_control.mujoco.Physics.render`."""
    camera = BareCamera(self, height, width, camera_id)
    return camera.render(depth=depth, segmentation=segmentation, scene_option=scene_option)


class BareCamera:
  """A camera of a physics.

  Args:
    physics: the physics
    height, width: of the pictures
    camera_id: number or name of a camera, -1 for the free one
  """

  def __init__(self, physics: Any, height: int, width: int, camera_id: int | str = -1):
    size, renderers = (height, width), physics.contexts
    if size not in renderers:
      renderers[size] = mj.Renderer(physics.model.ptr, height, width)
    self._renderer, self._physics, self._id = renderers[size], physics, camera_id
    # The renderer keeps its scene for the next picture.
    self.scene = types.SimpleNamespace(flags=self._renderer.scene.flags, free=lambda: None)

  def render(self, depth: bool = False, segmentation: bool = False, scene_option=None):
    """Returns colours, depths [m] or numbers and kinds of what is seen, (height, width, ...)."""
    renderer = self._renderer
    renderer.update_scene(self._physics.data.ptr, self._id, scene_option)
    if segmentation:
      renderer.enable_segmentation_rendering()
    if depth:
      renderer.enable_depth_rendering()
    try:
      return renderer.render()
    finally:
      renderer.disable_depth_rendering()
      renderer.disable_segmentation_rendering()


class BareEnvironment(dm_env.Environment):
  """An environment, see `dm_control.rl.control.Environment`."""

  def __init__(
    self, physics, task, time_limit, control_timestep, n_sub_steps, flat_observation=False,
    legacy_step=True,  # which an exercise's physics, with steps of its own, does not read
  ):  # fmt: skip
    self._physics, self._task, self._flat_observation = physics, task, flat_observation
    if n_sub_steps is not None and control_timestep is not None:
      raise ValueError("Both n_sub_steps and control_timestep were supplied.")
    if n_sub_steps is None:
      share = control_timestep / physics.timestep()
      n_sub_steps = round(share)
      if n_sub_steps < 1 or abs(share - n_sub_steps) > 1e-8:
        raise ValueError(
          f"Control timestep ({control_timestep}) must be an integer multiple of physics timestep "
          f"({physics.timestep()})"
        )
    self._n_sub_steps = n_sub_steps
    self._step_limit, self._step_count, self._reset_next_step = time_limit, 0, True

  physics = property(lambda self: self._physics)
  task = property(lambda self: self._task)

  def control_timestep(self) -> float:
    """Returns the time between actions [s]."""
    return self._physics.timestep() * self._n_sub_steps

  def _observe(self) -> Any:
    found = self._task.get_observation(self._physics)
    if not self._flat_observation:
      return found
    return {FLAT_OBSERVATION_KEY: np.concatenate([np.ravel(each) for each in found.values()])}

  def reset(self) -> dm_env.TimeStep:
    """Begins an episode."""
    self._reset_next_step, self._step_count = False, 0
    with self._physics.reset_context():
      self._task.initialize_episode(self._physics)
    return dm_env.restart(self._observe())._replace(reward=None, discount=None)

  def step(self, action: Any) -> dm_env.TimeStep:
    """Takes an action; after the last step of an episode it begins another."""
    if self._reset_next_step:
      return self.reset()
    task, physics = self._task, self._physics
    task.before_step(action, physics)
    physics.step(self._n_sub_steps)
    task.after_step(physics)
    reward, observation = task.get_reward(physics), self._observe()
    self._step_count += 1
    discount = 1.0
    if self._step_count < self._step_limit:
      discount = task.get_termination(physics)
    self._reset_next_step = discount is not None
    kind = dm_env.StepType.LAST if self._reset_next_step else dm_env.StepType.MID
    return dm_env.TimeStep(kind, reward, 1.0 if discount is None else discount, observation)

  def action_spec(self) -> Any:
    """Returns the spec of an action."""
    return self._task.action_spec(self._physics)

  def observation_spec(self) -> Any:
    """Returns the specs of the observations by name."""
    return self._task.observation_spec(self._physics)


if TYPE_CHECKING or screen.import_dm_control():
  from dm_control.mujoco import Camera, Physics, wrapper
  from dm_control.rl import control

  Environment, Task, PhysicsError = control.Environment, control.Task, control.PhysicsError
  FLAT_OBSERVATION_KEY = control.FLAT_OBSERVATION_KEY
  wrap = wrapper.MjModel
else:
  Camera, Environment, FLAT_OBSERVATION_KEY = BareCamera, BareEnvironment, "observations"
  Physics, PhysicsError, Task, wrap = BarePhysics, RuntimeError, object, Wrapped
