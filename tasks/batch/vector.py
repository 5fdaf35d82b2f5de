"""Vectorised exercises: `gymnasium.make_vec("palpate/TouchEasy-v0", num_envs=4096)`.

docs/vector.md says what seeds, the ends of episodes and shapes are in many worlds.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import warp as wp
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from palpate.batch.base import on_device
from palpate.tasks.core import observation, randomisation
from palpate.tasks.gym import Exercise
from palpate.tissue.reading import count_of

from . import tally
from .fields import INFO, OBSERVED, OUTCOMES
from .worlds import Worlds

_ELSE = 'vectorization_mode="sync" runs single environments side by side'
OUTPUTS = ("numpy", "torch", "warp")


class NotVectorisedError(ValueError):
  """An exercise, or an option of one, that many worlds cannot have."""


class Exercises(VectorEnv):
  """Worlds of an exercise, stepped together.

  Attributes:
    parts: the worlds of each shape on each device
    slices: which of all worlds these are
    task: of the first of them
    device: Warp device of these
    output: what is told, see `__init__`
    max_episode_steps: of an episode
  """

  metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": ["rgb_array"]}  # noqa: RUF012

  def __init__(
    self,
    num_envs: int = 1,
    task: str = "touch/standard",
    max_episode_steps: int | None = None,
    device: str | Sequence[str] | None = None,
    output: str = "numpy",
    nodes: int | None = None,
    render_mode: str | None = None,
    width: int = 640,
    height: int = 480,
    deterministic: bool = False,
    **kwargs: Any,
  ):
    """Makes the environment.

    Args:
      num_envs: number of worlds
      task: such as "touch/easy"
      max_episode_steps: steps of an episode, if less than the task's time limit; -1 for that
      device: `cpu`, `cuda:N`, several of these, which share the worlds, or None for a GPU where
        there is one; see `palpate.batch.make`
      output: what observations, rewards and flags are: `numpy`, or arrays of the device of `torch`
        or `warp`; all are copies
      nodes: on a GPU, see `palpate.batch.make`; None for what the instrument touches
      render_mode: None or `rgb_array`, see `render`
      width: of the pictures of `render` [pixels]
      height: of these [pixels]
      deterministic: whether runs repeat to the bit on a GPU too, see `palpate.batch.make`
      **kwargs: of `Exercise`, such as `reward="sparse"`

    Raises:
      ValueError: a value is not allowed, or a vectorised exercise cannot do it; it is named.
    """
    if render_mode not in (None, *self.metadata["render_modes"]):
      raise ValueError(f"render_mode is {render_mode!r}, expected None or rgb_array")
    if output not in OUTPUTS:
      raise ValueError(f"output is {output!r}, expected one of {', '.join(OUTPUTS)}")
    self.num_envs, self.output = count_of("num_envs", num_envs), output
    _refuse(task, kwargs)
    chosen = observation.choose(kwargs.get("observations"), kwargs.get("pixels"))
    seen = render_mode or chosen.pictures
    kwargs = {"surroundings": "abdomen" if seen else "unseen", **kwargs, "renderer": "cpu"}
    single = Exercise(task, **kwargs)
    self.render_mode, self._size = render_mode, (height, width)
    environment = single.environment
    self.task, limit = environment.task, environment.step_limit
    _refuse_task(self.task)
    if max_episode_steps is not None and max_episode_steps > 0:
      limit = min(limit, max_episode_steps)
    if device is None:
      device = "cuda:0" if wp.is_cuda_available() else "cpu"
    self.single_observation_space, self.single_action_space = (
      single.observation_space, single.action_space
    )  # fmt: skip
    devices = [device] if isinstance(device, str) else list(device)
    options = {"nodes": self.task.slots if nodes is None else nodes}
    self._make(single, task, kwargs, devices, limit, options | {"deterministic": deterministic})
    self.observation_space = batch_space(single.observation_space, self.num_envs)
    self.action_space = batch_space(single.action_space, self.num_envs)
    self.device, self.max_episode_steps = self.parts[0].device, limit
    self._observed = [*environment.observation_spec()]
    self._begun = False
    self.spec = None

  def _make(
    self, single: Exercise, task: str, kwargs: dict[str, Any], devices: list[str], limit: int,
    options: dict[str, Any],
  ) -> None:  # fmt: skip
    """Makes the parts: each shape on each device has as many worlds as another."""
    kinds = list(itertools.product(devices, self.task.variants))
    ends = np.linspace(0, self.num_envs, len(kinds) + 1).round().astype(int).tolist()
    self.parts, self.slices = list[Worlds](), list[slice]()
    for (where, variant), start, end in zip(kinds, ends, ends[1:], strict=False):
      if end > start:
        of_part = single
        if len(kinds) > 1:
          of_part = Exercise(task, **{**kwargs, "variants": (variant,)})
        count, own = end - start, {} if where == "cpu" else options
        self.parts.append(Worlds(of_part.environment, count, where, limit, **own))
        self.slices.append(slice(start, end))

  # Gymnasium's side.

  def reset(
    self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
  ):
    """Begins episodes in all worlds, or in those of `options["reset_mask"]`."""
    mask = _mask(options, self.num_envs)
    super().reset(seed=seed if isinstance(seed, int) else None)
    seeds = _seeds(seed, self.num_envs)
    self._begin(mask if self._begun else np.ones(self.num_envs, bool), seeds)
    self._begun = True
    return self._observations(), self._infos()

  def step(self, actions: Any):
    """Takes a control step in all worlds; begins another episode where one ends."""
    if not self._begun:
      raise gymnasium.error.ResetNeeded("step before a reset, expected reset first")
    shape = tuple(np.shape(actions))
    if shape != self.action_space.shape:
      raise ValueError(f"actions have shape {shape}, expected {self.action_space.shape}")
    self._wait()
    rows = [
      on_device(actions[at], wp.float32, part.device)
      for part, at in zip(self.parts, self.slices, strict=True)
    ]
    for part, at, row in zip(self.parts, self.slices, rows, strict=True):
      part.check(row, at.start)
    for part, row in zip(self.parts, rows, strict=True):
      part.launch_step(row)
    over = np.concatenate([part.wait() for part in self.parts])
    told = [self._tell("reward", np.float64)]
    told += [self._tell(name, bool) for name in ("terminated", "truncated")]
    infos = {}
    if over.any():
      infos = {"final_obs": self._final(over), "_final_obs": over}
      infos |= {"final_info": self._infos(over) | {"metrics": self._metrics()}, "_final_info": over}
      self._begin(over)
    return (self._observations(), *told, self._infos() | infos)

  def _begin(self, mask: np.ndarray, seeds: list[int | None] | None = None) -> None:
    """Begins episodes in the worlds of a mask."""
    for part, at in zip(self.parts, self.slices, strict=True):
      if mask[at].any():
        part.begin(mask[at], seeds and seeds[at])

  # What is told.

  def _tell(self, name: str, dtype: Any = np.float64) -> Any:
    """Returns a copy of an array of all worlds as users want it."""
    arrays = [part.array(name) for part in self.parts]
    if self.output == "numpy":
      return np.concatenate([array.numpy() for array in arrays]).astype(dtype)
    if self.output == "torch":
      return _cat(arrays)
    whole: Any = wp.empty(
      (self.num_envs, *arrays[0].shape[1:]), dtype=arrays[0].dtype, device=self.device
    )
    for at, array in zip(self.slices, arrays, strict=True):
      wp.copy(whole[at], array)
    return whole

  def _wait(self) -> None:
    """Waits for what is on the device: torch does not wait for Warp, nor Warp for torch."""
    if self.output == "torch":
      wp.synchronize_device(self.device)

  def _observations(self) -> dict[str, Any]:
    self._wait()
    space: Any = self.single_observation_space
    return {n: self._tell(OBSERVED.get(n) or n, space[n].dtype) for n in self._observed}

  def render(self, worlds: Sequence[int] = (0,)) -> tuple[np.ndarray, ...] | None:
    """Returns the laparoscope's pictures of some worlds, (height, width, 3) each, with `rgb_array`.

    Args:
      worlds: numbers of the worlds, the first alone by default
    """
    if self.render_mode is None:
      return None
    found: dict[int, np.ndarray] = {}
    for part, at in zip(self.parts, self.slices, strict=True):
      own = [int(world) for world in worlds if at.start <= world < at.stop]
      if own:
        seen = part.show([world - at.start for world in own], self._size)
        found |= dict(zip(own, seen, strict=True))
    missing = [world for world in worlds if world not in found]
    if missing:
      raise ValueError(f"world is {missing[0]}, expected one in [0, {self.num_envs})")
    return tuple(found[world] for world in worlds)

  def _final(self, over: np.ndarray) -> Any:
    seen = self._observations()
    if self.output != "numpy":
      return seen
    final = np.full(self.num_envs, None, dtype=object)
    for world in np.flatnonzero(over):
      final[world] = {name: values[world] for name, values in seen.items()}
    return final

  def _metrics(self) -> dict[str, Any]:
    """Returns the metrics of the episodes so far, NaN where they are unknown."""
    values, names = self._tell("values"), tally.names(self.task.jaws)
    own = self.task.rules.metrics
    more = {name: self._tell(field).reshape(self.num_envs) for name, field in own.items()}
    if self.output != "warp":
      return {name: values[:, k] for k, name in enumerate(names)} | more
    return {name: wp.clone(values[:, k]) for k, name in enumerate(names)} | more

  def _infos(self, where: np.ndarray | None = None) -> dict[str, Any]:
    """Returns what `info` is of a single environment; with a mask that is not of all worlds."""
    found = {name: self._tell(field) for name, field in INFO.items()}
    if self.output != "numpy":
      return found
    found["success"] = found["success"].astype(bool)
    found["outcome"] = np.array([OUTCOMES[int(k)] for k in found["outcome"]], object)
    for name in ("progress", "peak_force"):
      found[name] = found[name][:, 0]
    known = np.ones(self.num_envs, bool) if where is None else where
    if self.task.ranges:
      rows = [part.episodes.rows for part in self.parts]
      found["randomised"] = {
        name: np.concatenate([each[f"drawn_{name}"] for each in rows]) for name in self.task.ranges
      }
    return found | {f"_{name}": known for name in INFO}


def _cat(arrays: list[wp.array]) -> Any:
  """Returns arrays one after the other as a torch tensor on the device of the first."""
  import torch  # pyright: ignore[reportMissingImports]

  tensors = [wp.to_torch(array) for array in arrays]
  return torch.cat([tensor.to(tensors[0].device) for tensor in tensors])


def _seeds(seed: int | Sequence[int | None] | None, count: int) -> list[int | None]:
  if seed is None or isinstance(seed, int | np.integer):
    return [None if seed is None else int(seed) + i for i in range(count)]
  if len(seed) != count:
    raise ValueError(f"seed has {len(seed)} numbers, expected {count}, one a world")
  return list(seed)


def _mask(options: Mapping[str, Any] | None, count: int) -> np.ndarray:
  mask = (options or {}).get("reset_mask")
  if mask is None:
    return np.ones(count, bool)
  mask = np.asarray(mask)
  if mask.shape != (count,) or mask.dtype != bool:
    what = f"shape {mask.shape} of {mask.dtype}"
    raise ValueError(f"options: reset_mask has {what}, expected ({count},) of bool")
  return mask


def _refuse(task: str, kwargs: Mapping[str, Any]) -> None:
  """Raises ValueError for what a vectorised exercise cannot do, naming it."""
  for name in randomisation.check(kwargs.get("randomise") or {}):
    if not randomisation.QUANTITIES[name].seen:
      what = f"randomise has {name!r}, which a vectorised exercise cannot do"
      raise NotVectorisedError(f"{task}: {what}; {_ELSE}")
  truth = {name for name, row in observation.ROWS.items() if row.group == observation.TRUTH}
  for name in {observation.TRUTH, *truth} & {*(kwargs.get("observations") or ())}:
    what = f"observations has {name!r}, which a vectorised exercise cannot do"
    raise NotVectorisedError(f"{task}: {what}; {_ELSE}")
  usual = (("record", None), ("model", None), ("renderer", None), ("input", "drives"))
  for name, value in usual:
    if kwargs.get(name) and kwargs[name] != value:
      what = f"{name} is given, which a vectorised exercise cannot do"
      raise NotVectorisedError(f"{task}: {what}; {_ELSE}")


def _refuse_task(task: Any) -> None:
  if task.rules is None:
    kind = type(task).__name__
    raise NotVectorisedError(f"{task.name}: rules of {kind} is None, expected Rules; {_ELSE}")
