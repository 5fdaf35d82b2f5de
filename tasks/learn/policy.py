"""Policies that were trained: files of weights, without code, for the exercise they are of.

    act = load("policy.safetensors").begin()  # of an episode
    action = act(timestep.observation)

A file is one of safetensors: a memory, which is a gated recurrent unit (Cho et al. 2014,
10.48550/arXiv.1406.1078), a network of `tanh` layers above it, what the input is normalised by, and
in the header as JSON the exercise, its action and what it observes. A policy of pictures has an
encoder too: convolutions whose last channels each say where in the picture they respond most and
how much (spatial soft-argmax: Levine et al. 2016, 10.48550/arXiv.1504.00702), and a `tanh` layer.
NumPy is enough to run it.
"""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..files import replacing

SUFFIX = ".safetensors"
FILE = f"policy{SUFFIX}"  # in a folder of training
PIXELS = "pixels"  # the picture that a policy may observe
FOLDER = pathlib.Path(__file__).parents[1] / "policies"  # of those that come with exercises
_KEY = "palpate"  # of the header
_FORMAT = 2
_DTYPES = ("F16", "F32", "F64")  # of arrays
FINE = 0.003  # scale on which some of the input is seen, too [m]
STRIDE = 2  # of the first convolution; the others have 1
_ENCODER = "encoder_"  # before the names of its arrays
_MEMORY = ("input", "state", "input_bias", "state_bias")  # arrays of a memory


@dataclasses.dataclass(frozen=True)
class About:
  """What a policy is of.

  Attributes:
    task: such as "touch/easy"
    components: of the action
    observations: names, in the order of the input, without pictures
    control_timestep: between actions [s]
    power: that the size of what the network says is raised to, which makes it exact where actions
      are small
    changes: components that it says as changes of the last action
    initial_action: what counts as the last action when an episode begins, see
      `Task.initial_action`; empty for zeros
    task_kwargs: options of the exercise it was trained with
    training: how it was made, for people
    licence: of the weights
    pixels: height and width of the picture that it sees, empty for none [pixels]
    fine: numbers of the input that it sees on a scale of `FINE` too: `tanh(x / FINE)` of each
      follows the normalised input
  """

  task: str
  components: Sequence[str]
  observations: Sequence[str]
  control_timestep: float
  power: float = 1.0
  changes: Sequence[str] = ()
  initial_action: Sequence[float] = ()
  task_kwargs: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  training: Mapping[str, Any] = dataclasses.field(default_factory=dict)
  licence: str = "Apache-2.0"
  pixels: Sequence[int] = ()
  fine: Sequence[int] = ()

  @property
  def sees(self) -> bool:
    """Whether it sees a picture."""
    return bool(self.pixels)


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
  """A network.

  Attributes:
    about: what it is of
    mean: of the input  (ninput,)
    scale: what the input is multiplied by once the mean is taken off  (ninput,)
    layers: weights (nout, nin) and biases (nout,)
    memory: weights of input (3 n, ninput) and state (3 n, n), biases of both (3 n,), in each the
      rows of the reset gate, the update gate and the new state; None for no memory
    encoder: of pictures: weights (nout, nin, n, n) and biases (nout,) of convolutions, then those
      of a layer (nout, 3 nin), whose output follows the normalised input; empty for none
  """

  about: About
  mean: np.ndarray
  scale: np.ndarray
  layers: Sequence[tuple[np.ndarray, np.ndarray]]
  memory: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None = None
  encoder: Sequence[tuple[np.ndarray, np.ndarray]] = ()

  def begin(self, *count: int) -> Episode:
    """Returns who acts in an episode, or in `count` side by side, and remembers no others."""
    return Episode(self, *count)

  def check(self, env: Any) -> None:
    """Raises ValueError where an environment is not of the exercise that it was trained for."""
    task, about = env.task, self.about
    if task.name != about.task:
      raise ValueError(f"the policy is of {about.task}, not of {task.name}")
    if tuple(task.components) != tuple(about.components):
      raise ValueError(f"the policy's action is {', '.join(about.components)}, expected "
                       f"{', '.join(task.components)}")  # fmt: skip
    spec = env.observation_spec()
    seen = [PIXELS] if about.sees else []
    missing = [name for name in (*about.observations, *seen) if name not in spec]
    if missing:
      raise ValueError(f"the policy observes {', '.join(missing)}, which observations lack")
    count = sum(int(np.prod(spec[name].shape)) for name in about.observations)
    if count != len(self.mean):
      raise ValueError(f"the policy takes {len(self.mean)} numbers, the exercise has {count}")
    for size in [spec[name].shape[:2] for name in seen]:
      if tuple(size) != tuple(about.pixels):
        raise ValueError(f"the policy sees {_by(about.pixels)} pixels, the exercise draws "
                         f"{_by(size)}")  # fmt: skip
    if not np.isclose(env.control_timestep(), about.control_timestep):
      raise ValueError(f"the policy acts each {about.control_timestep:g} s, not each "
                       f"{env.control_timestep():g} s")  # fmt: skip


class Episode:
  """A policy in an episode, to be called with each observation.

  Attributes:
    last: action, to be set where somebody else has acted
  """

  def __init__(self, policy: Policy, *count: int):
    """Begins with an empty memory."""
    self.policy, self._count = policy, count
    self._state = np.zeros((*count, policy.memory[1].shape[1])) if policy.memory else None
    first = policy.about.initial_action or np.zeros(len(policy.about.components))
    self.last = np.tile(np.asarray(first, float), (*count, 1))
    self._adds = np.isin(policy.about.components, policy.about.changes)

  def __call__(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
    """Returns the action for an observation."""
    policy = self.policy
    names = policy.about.observations
    parts = [np.reshape(observation[name], (*self._count, -1)) for name in names]
    seen = np.concatenate(parts, axis=-1)
    x = (seen - policy.mean) * policy.scale
    if policy.about.fine:
      x = np.concatenate([x, np.tanh(seen[..., list(policy.about.fine)] / FINE)], axis=-1)
    if policy.encoder:
      x = np.concatenate([x, encode(observation[PIXELS], policy.encoder)], axis=-1)
    if policy.memory:
      x = self._state = _remember(x, self._state, *policy.memory)
    for k, (weight, bias) in enumerate(policy.layers):
      x = (np.tanh(x) if k else x) @ weight.T + bias
    x = np.clip(x, -1.0, 1.0).astype(float)
    said = np.sign(x) * np.abs(x) ** policy.about.power
    self.last = np.clip(said + self._adds * self.last, -1.0, 1.0)
    return self.last


def encode(pixels: np.ndarray, layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
  """Returns what an encoder says of pictures (..., height, width, 3), see `Policy`  (..., nout)."""
  *convolutions, (head, bias) = layers
  x = np.asarray(pixels, np.float32) / 255.0 - 0.5
  for k, (weight, shift) in enumerate(convolutions):
    step = 1 if k else STRIDE
    shape, x = weight.shape[2:], np.maximum(x, 0.0) if k else x
    windows = np.lib.stride_tricks.sliding_window_view(x, shape, axis=(-3, -2))
    windows = windows[..., ::step, ::step, :, :, :]  # (..., row, column, channel, n, n)
    rows = windows.reshape(*windows.shape[:-3], -1)
    x = rows @ weight.reshape(len(weight), -1).T + shift
  height, width, count = x.shape[-3:]
  flat = x.reshape(*x.shape[:-3], height * width, count)
  most = flat.max(axis=-2, keepdims=True)
  share = np.exp(flat - most)
  total = share.sum(axis=-2)
  y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
  places = [(share * axis.reshape(-1, 1)).sum(axis=-2) / total for axis in (x, y)]
  level = most[..., 0, :] + np.log(total / (height * width))
  return np.tanh(np.concatenate([*places, level], axis=-1) @ head.T + bias)


def _by(size: Sequence[int]) -> str:
  return " x ".join(map(str, size))


def _remember(x, state, weight, own, bias, own_bias) -> np.ndarray:
  """Returns the next state of a memory."""
  new, old = (
    np.split(rows, 3, axis=-1) for rows in (x @ weight.T + bias, state @ own.T + own_bias)
  )
  gates = (0.5 + 0.5 * np.tanh(0.5 * (a + b)) for a, b in zip(new[:2], old[:2], strict=True))
  reset, update = gates
  return (1.0 - update) * np.tanh(new[2] + reset * old[2]) + update * state


def save(path: str | os.PathLike[str], policy: Policy) -> None:
  """Writes a policy, its weights in half precision."""
  from safetensors.numpy import save as dump

  arrays = dict(zip(_MEMORY, policy.memory or (), strict=False))
  for name, layers in (("", policy.layers), (_ENCODER, policy.encoder)):
    for k, (weight, bias) in enumerate(layers):
      arrays |= {f"{name}weight{k}": weight, f"{name}bias{k}": bias}
  arrays = {name: np.asarray(array, np.float16) for name, array in arrays.items()}
  arrays |= {"mean": policy.mean.astype(np.float32), "scale": policy.scale.astype(np.float32)}
  about = json.dumps({"format": _FORMAT, **dataclasses.asdict(policy.about)})
  arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
  with replacing(path, "wb") as file:
    file.write(dump(arrays, {_KEY: about}))


def load(path: str | os.PathLike[str]) -> Policy:
  """Returns the policy of a file; ValueError says what is wrong with it."""
  try:
    from safetensors import SafetensorError, safe_open
  except ImportError:
    raise ValueError("safetensors is not installed: pip install 'palpate[policy]'") from None
  if os.path.exists(path) and not os.path.isfile(path):
    raise ValueError(f"policy {os.fspath(path)!r} is no regular file")
  try:
    with safe_open(os.fspath(path), "np") as file:
      header = (file.metadata() or {}).get(_KEY)
      for name in file.keys():
        kind = file.get_slice(name).get_dtype()
        if kind not in _DTYPES:
          raise ValueError(f"{name} is of type {kind}, expected one of {', '.join(_DTYPES)}")
      arrays = {name: file.get_tensor(name).astype(np.float32) for name in file.keys()}
  except (OSError, SafetensorError, ValueError) as error:
    raise ValueError(f"policy {os.fspath(path)!r}: {error}") from None
  if header is None:
    raise ValueError(f"policy {os.fspath(path)!r} is not one of Palpate's")
  try:
    about = json.loads(header)
    if not isinstance(about, dict) or about.pop("format", None) != _FORMAT:
      raise ValueError("it is of another version")
    layers, encoder = (_layers(arrays, name) for name in ("", _ENCODER))
    memory: Any = tuple(arrays[name] for name in _MEMORY if name in arrays) or None
    made = Policy(About(**about), arrays["mean"], arrays["scale"], layers, memory, encoder)
    _check_about(made.about)
    _check_shapes(made)
  except RecursionError:
    raise ValueError(f"policy {os.fspath(path)!r}: its header is nested too deep") from None
  except (ValueError, KeyError, TypeError, AttributeError) as error:
    raise ValueError(f"policy {os.fspath(path)!r}: {error}") from None
  return made


def _layers(arrays: Mapping[str, np.ndarray], name: str) -> list[tuple[np.ndarray, np.ndarray]]:
  count = sum(key.startswith(f"{name}weight") for key in arrays)
  return [(arrays[f"{name}weight{k}"], arrays[f"{name}bias{k}"]) for k in range(count)]


def shipped(task: str, pictures: bool = False) -> Policy:
  """Returns the policy that comes with an exercise; ValueError names those there are.

  Args:
    task: such as "touch/easy"
    pictures: whether it sees pictures in place of the state
  """
  kind = f"_{PIXELS}" if pictures else ""
  path = FOLDER / f"{task.replace('/', '_')}{kind}{SUFFIX}"
  if not path.exists():
    names = [found.stem for found in FOLDER.glob(f"*{SUFFIX}")]
    names = [n.removesuffix(kind) for n in names if n.endswith(f"_{PIXELS}") == pictures]
    have = ", ".join(sorted(name.replace("_", "/", 1) for name in names))
    what = "policy of pictures" if pictures else "policy"
    raise ValueError(f"no trained {what} comes with {task}, expected one of {have or 'none'}")
  return load(path)


def _check_about(about: About) -> None:
  for name in ("task", "licence"):
    if not isinstance(getattr(about, name), str):
      raise ValueError(f"{name} is {getattr(about, name)!r}, expected a text")
  for name in ("components", "observations", "changes"):
    value = getattr(about, name)
    if not isinstance(value, list | tuple) or not all(isinstance(each, str) for each in value):
      raise ValueError(f"{name} is {value!r}, expected a list of names")
  for name in ("power", "control_timestep"):
    value = getattr(about, name)
    if not (_is_number(value) and 0 < value < np.inf):
      raise ValueError(f"{name} is {value!r}, expected a finite number > 0")
  first, count = about.initial_action, len(about.components)
  numbers = isinstance(first, list | tuple) and all(_is_number(v) and abs(v) <= 1 for v in first)
  if not numbers or len(first) not in (0, count):
    raise ValueError(f"initial_action is {first!r}, expected {count} numbers in [-1, 1] or none")
  if not isinstance(about.fine, list | tuple) or not all(type(n) is int for n in about.fine):
    raise ValueError(f"fine is {about.fine!r}, expected numbers of the input")
  size = about.pixels
  if not isinstance(size, list | tuple) or not all(type(n) is int and n > 0 for n in size):
    raise ValueError(f"pixels is {size!r}, expected height and width")
  for name in ("task_kwargs", "training"):
    if not isinstance(getattr(about, name), dict):
      raise ValueError(f"{name} is {getattr(about, name)!r}, expected options by name")


def _is_number(value: Any) -> bool:
  return isinstance(value, int | float) and not isinstance(value, bool)


def _check_shapes(policy: Policy) -> None:
  if policy.mean.ndim != 1:
    raise ValueError(f"mean has shape {policy.mean.shape}, expected (ninput,)")
  size = len(policy.mean)
  if policy.scale.shape != (size,):
    raise ValueError(f"scale has shape {policy.scale.shape}, expected ({size},)")
  if not all(0 <= n < size for n in policy.about.fine):
    raise ValueError(f"fine is {list(policy.about.fine)}, expected numbers from 0 to {size - 1}")
  size += len(policy.about.fine) + _check_encoder(policy)
  if policy.memory:
    count = policy.memory[1].shape[-1]
    expected = [(3 * count, size), (3 * count, count), (3 * count,), (3 * count,)]
    for name, array, shape in zip(_MEMORY, policy.memory, expected, strict=True):
      if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    size = count
  for k, (weight, bias) in enumerate(policy.layers):
    if weight.shape != (len(bias), size):
      raise ValueError(f"weight{k} has shape {weight.shape}, expected ({len(bias)}, {size})")
    size = len(bias)
  if not policy.layers or size != len(policy.about.components):
    raise ValueError(f"it ends in {size} numbers, expected {len(policy.about.components)}")
  parts = (*policy.layers, *policy.encoder, policy.memory or (), (policy.mean, policy.scale))
  if not all(np.isfinite(array).all() for part in parts for array in part):
    raise ValueError("its weights are not finite")


def _check_encoder(policy: Policy) -> int:
  """Returns how many numbers the encoder says, 0 without one."""
  if bool(policy.encoder) != bool(policy.about.pixels):
    have = f"{len(policy.encoder)} layers see them"
    raise ValueError(f"pixels is {policy.about.pixels!r}, but {have}")
  if not policy.encoder:
    return 0
  *convolutions, (head, bias) = policy.encoder
  size, channels = np.array(policy.about.pixels), 3
  for k, (weight, shift) in enumerate(convolutions):
    if weight.ndim != 4 or weight.shape[:2] != (len(shift), channels):
      expected = f"({len(shift)}, {channels}, n, n)"
      raise ValueError(f"{_ENCODER}weight{k} has shape {weight.shape}, expected {expected}")
    size, channels = (size - weight.shape[2:]) // (1 if k else STRIDE) + 1, len(shift)
  if len(size) != 2 or not convolutions or size.min() < 1:
    raise ValueError(f"pixels is {policy.about.pixels!r}, too few for the encoder")
  if head.shape != (len(bias), 3 * channels):
    last = f"{_ENCODER}weight{len(convolutions)}"
    raise ValueError(f"{last} has shape {head.shape}, expected ({len(bias)}, {3 * channels})")
  return len(bias)
