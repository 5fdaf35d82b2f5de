"""Policies that were trained: files of weights, without code, for the exercise they are of.

    policy = load("policy.safetensors")
    action = policy(timestep.observation)

A file is one of safetensors: a network of `tanh` layers, what its input is normalised by, and in
the header as JSON the exercise, its action and what it observes. NumPy is enough to run it.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .files import replacing

SUFFIX = ".safetensors"
FOLDER = pathlib.Path(__file__).parent / "policies"  # of those that come with exercises
_KEY = "palpate"  # of the header
_FORMAT = 1


@dataclasses.dataclass(frozen=True)
class About:
  """What a policy is of.

  Attributes:
    task: such as "touch/easy"
    components: of the action
    observations: names, in the order of the input
    control_timestep: between actions [s]
    task_kwargs: options of the exercise it was trained with
    training: how it was made, for people
    licence: of the weights
  """

  task: str
  components: Sequence[str]
  observations: Sequence[str]
  control_timestep: float
  task_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  training: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  licence: str = "Apache-2.0"


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
  """A network.

  Attributes:
    about: what it is of
    mean: of the input  (ninput,)
    scale: what the input is multiplied by once the mean is taken off  (ninput,)
    layers: weights (nout, nin) and biases (nout,)
  """

  about: About
  mean: np.ndarray
  scale: np.ndarray
  layers: Sequence[tuple[np.ndarray, np.ndarray]]

  def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the action for an observation."""
    parts = [np.ravel(observation[name]) for name in self.about.observations]
    x = (np.concatenate(parts) - self.mean) * self.scale
    for k, (weight, bias) in enumerate(self.layers):
      x = weight @ (np.tanh(x) if k else x) + bias
    return np.clip(x, -1.0, 1.0).astype(float)

  def check(self, env: Any) -> None:
    """Raises ValueError where an environment is not of the exercise that it was trained for."""
    task, about = env.task, self.about
    if task.name != about.task:
      raise ValueError(f"the policy is of {about.task}, not of {task.name}")
    if tuple(task.components) != tuple(about.components):
      raise ValueError(f"the policy's action is {', '.join(about.components)}, expected "
                       f"{', '.join(task.components)}")  # fmt: skip
    spec = env.observation_spec()
    missing = [name for name in about.observations if name not in spec]
    if missing:
      raise ValueError(f"the policy observes {', '.join(missing)}, which observations lack")
    count = sum(int(np.prod(spec[name].shape)) for name in about.observations)
    if count != len(self.mean):
      raise ValueError(f"the policy takes {len(self.mean)} numbers, the exercise has {count}")
    if not np.isclose(env.control_timestep(), about.control_timestep):
      raise ValueError(f"the policy acts each {about.control_timestep:g} s, not each "
                       f"{env.control_timestep():g} s")  # fmt: skip


def save(path: str | os.PathLike[str], policy: Policy) -> None:
  """Writes a policy."""
  from safetensors.numpy import save as dump

  arrays = {"mean": policy.mean, "scale": policy.scale}
  for k, (weight, bias) in enumerate(policy.layers):
    arrays |= {f"weight{k}": weight, f"bias{k}": bias}
  about = json.dumps({"format": _FORMAT, **dataclasses.asdict(policy.about)})
  arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in arrays.items()}
  with replacing(path, "wb") as file:
    file.write(dump(arrays, {_KEY: about}))


def load(path: str | os.PathLike[str]) -> Policy:
  """Returns the policy of a file; ValueError says what is wrong with it."""
  try:
    from safetensors import SafetensorError, safe_open
  except ImportError:
    raise ValueError("safetensors is not installed: pip install 'palpate[policy]'") from None
  try:
    with safe_open(os.fspath(path), "np") as file:
      header = (file.metadata() or {}).get(_KEY)
      arrays = {name: file.get_tensor(name) for name in file.keys()}
  except (OSError, SafetensorError) as error:
    raise ValueError(f"policy {os.fspath(path)!r}: {error}") from None
  if header is None:
    raise ValueError(f"policy {os.fspath(path)!r} is not one of Palpate's")
  try:
    about = json.loads(header)
    if about.pop("format") != _FORMAT:
      raise ValueError("it is of another version")
    count = sum(name.startswith("weight") for name in arrays)
    layers = [(arrays[f"weight{k}"], arrays[f"bias{k}"]) for k in range(count)]
    made = Policy(About(**about), arrays["mean"], arrays["scale"], layers)
    _check_shapes(made)
  except (ValueError, KeyError, TypeError, AttributeError) as error:
    raise ValueError(f"policy {os.fspath(path)!r}: {error}") from None
  return made


def shipped(task: str) -> Policy:
  """Returns the policy that comes with an exercise; ValueError names those there are."""
  path = FOLDER / f"{task.replace('/', '_')}{SUFFIX}"
  if not path.exists():
    have = ", ".join(sorted(found.stem.replace("_", "/", 1) for found in FOLDER.glob(f"*{SUFFIX}")))
    raise ValueError(f"no trained policy comes with {task}, expected one of {have or 'none'}")
  return load(path)


def _check_shapes(policy: Policy) -> None:
  size = len(policy.mean)
  if policy.scale.shape != (size,):
    raise ValueError(f"scale has shape {policy.scale.shape}, expected ({size},)")
  for k, (weight, bias) in enumerate(policy.layers):
    if weight.shape != (len(bias), size):
      raise ValueError(f"weight{k} has shape {weight.shape}, expected ({len(bias)}, {size})")
    size = len(bias)
  if not policy.layers or size != len(policy.about.components):
    raise ValueError(f"it ends in {size} numbers, expected {len(policy.about.components)}")
  if not all(np.isfinite(array).all() for layer in policy.layers for array in layer):
    raise ValueError("its weights are not finite")
