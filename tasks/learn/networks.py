# pyright: reportMissingImports=false
"""The networks that learn: an actor, which goes into a policy, and a critic.

The actor has a memory: an expert's script does one thing after the other, and what comes next
cannot be seen in every moment. When it is taught it does not see velocities and what the drives are
behind: they tell what was done before, and who copies an expert by that does not look (de Haan,
Jayaraman and Levine 2019, 10.48550/arXiv.1905.11979). Nor does it see the far parts of the organ.
The critic sees all, and remembers nothing.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import palpate
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch.nn.functional import smooth_l1_loss
from torch.nn.utils.rnn import pad_sequence

from ..core.observation import ROWS
from . import policy
from .lessons import Lesson
from .sight import PICTURES, Seeing, Sensing

HIDDEN = ("joint_vel", "drive", "tip_vel", "surface")  # from an actor that is taught
ACTING, MORE = "acting", "more"  # groups of observations
CHANGES = ("jaw", "head")  # ends of components that an actor says as changes: jaws close by and by
# Ends of offsets [m] that an actor sees on a finer scale too: they begin large and decide small.
FINELY = ("target", "front", "lead", "trail")
POWER = 2.0  # an action is what the actor says times its size: slow motion is as clear as fast
_BATCH, _RATE = 32, 3e-3  # lessons of a step
FINE = 0.1  # errors above count by their size, not their square [-]
_SELDOM = 0.01  # least mean size of a component: what is said seldom counts more [-]
_PAST = 0.15  # how far past its limit a change is said: small errors do not open closed jaws [-]
_LAST = 50  # steps of the optimiser that the error is a mean of
_KNOWN = 0.05  # share of `_VARY` that is enough where lessons have shown the whole
_REHEARSING, _CAREFUL = 5, 0.2  # steps an iteration, learning rate over that of practice
# How much observations vary at least, by their unit: tissue that is not touched yet will be.
_VARY = {"m": 0.005, "m/s": 0.01, "rad": 0.05, "rad/s": 0.1, "N": 0.3, "-": 0.3}
_GATES = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")  # of torch, as a policy has them
_STILL = 1e-6  # standard deviation of what has not changed, and may be anything


def grouped(
  names: Sequence[str], taught: bool, privileged: Sequence[str] = ()
) -> dict[str, list[str]]:
  """Returns what is observed in the groups of the networks; `privileged` is not to act by."""
  seen = [name for name in names if name == policy.PIXELS]
  hidden = [name for name in names if (taught and name.endswith(HIDDEN)) or name in privileged]
  acting = [name for name in names if name not in (*hidden, *seen)]
  found = {ACTING: acting, MORE: hidden, PICTURES: seen}
  return {group: chosen for group, chosen in found.items() if chosen}


class Networks:
  """Actor and critic of an exercise.

  Attributes:
    actor: Gaussian about what it would do
    critic: returns what is to come of the discounted rewards
    groups: names of what is observed by group
    initial_action: what counts as the last action when an episode begins  (naction,)
    lessons: how many it was taught
    start: file name of the policy that it began with, or empty
  """

  def __init__(
    self,
    shapes: Mapping[str, tuple[int, ...]],
    components: Sequence[str],
    memory: int,
    hidden: Sequence[int],
    spread: float,
    seed: int,
    device: str,
    taught: bool = True,
    privileged: Sequence[str] = (),
    initial_action: Sequence[float] = (),
  ):
    """Makes networks that know nothing.

    Args:
      shapes: of what is observed, by name
      components: of an action
      memory: numbers that the actor remembers
      hidden: sizes of the layers, above the actor's memory and of the critic
      spread: standard deviation of the actions [-]
      seed: of the weights, and of the order of what is learned
      device: of torch
      taught: whether there will be lessons
      privileged: names of what the critic alone sees
      initial_action: what counts as the last action when an episode begins; zeros by default
    """
    torch.manual_seed(seed)
    self.groups, self.device, self.lessons = grouped(list(shapes), taught, privileged), device, 0
    self.start = ""
    self._shapes: dict[str, tuple[int, ...]] = dict(shapes)
    self._memory: Any = None
    self._components = list(components)
    self._scaled: list[Any] = []  # networks that know how large observations are
    self._changes = [name for name in components if name.endswith(CHANGES)]
    first = initial_action or [0.0] * len(components)
    self.initial_action = torch.tensor(first, dtype=torch.float32, device=device)
    self._adds = torch.tensor([float(name.endswith(CHANGES)) for name in components], device=device)
    seen = TensorDict(
      {g: torch.zeros(1, self._width(names)) for g, names in self.groups.items()}, batch_size=[1]
    )
    common = {"hidden_dims": list(hidden), "activation": "tanh", "obs_normalization": True}
    gaussian = {"class_name": "GaussianDistribution", "init_std": spread, "std_type": "log"}
    sets = {"actor": [ACTING], "critic": [g for g in self.groups if g != PICTURES]}
    recurrent: dict[str, Any] = {"rnn_type": "gru", "rnn_hidden_dim": memory}
    recurrent["distribution_cfg"], count = gaussian, len(components)
    recurrent["fine"] = self.fine = self._columns(FINELY)
    self.pixels = self._shapes[policy.PIXELS][:2] if PICTURES in self.groups else ()
    kind: Any = functools.partial(Seeing, size=self.pixels) if self.pixels else Sensing
    self.actor: Any = kind(seen, sets, "actor", count, **recurrent, **common).to(device)
    self.critic: Any = MLPModel(seen, sets, "critic", 1, **common).to(device)
    self._last: Any = torch.optim.Adam(self._parts())

  def _parts(self) -> list[Any]:
    return [*self.actor.rnn.parameters(), *self.actor.mlp.parameters()]

  def _width(self, names: Sequence[str]) -> int:
    return sum(math.prod(self._shapes[name]) for name in names)

  def _columns(self, ends: tuple[str, ...]) -> list[int]:
    """Returns where in what the actor sees the observations are whose names end so."""
    at, found = 0, []
    for name in self.groups[ACTING]:
      size = self._width([name])
      found += range(at, at + size) if name.endswith(ends) else ()
      at += size
    return found

  def normalise(self, seen: TensorDict) -> None:
    """Learns how large observations are; what was learned with others says the same as before."""
    for model in (self.actor, self.critic):
      every = torch.cat([seen[group] for group in model.obs_groups], dim=1)
      names = [name for group in model.obs_groups for name in self.groups[group]]
      std = every.std(dim=0)
      std = torch.where(std < _STILL, torch.full_like(std, _VARY["-"]), std)
      share = _KNOWN if self.lessons else 1.0
      std = torch.maximum(std, share * self._least(names).to(std))
      if model in self._scaled:
        _rescale(model, every.mean(dim=0), std)
      self._scale(model, every.mean(dim=0), std)

  def _scale(self, model: Any, mean: torch.Tensor, std: torch.Tensor) -> None:
    known, model.obs_normalizer.eps = model.obs_normalizer.state_dict(), 0.0
    known["_mean"][:], known["_std"][:], known["_var"][:] = mean, std, std.square()
    model.obs_normalizer.until = 0
    self._scaled.append(model)

  def take(self, made: policy.Policy) -> None:
    """Begins with what a policy of another exercise does; ValueError says why it cannot."""
    for what, own, other in (
      ("observes", self._observed, (*made.about.observations, *_pictures(made.about.pixels))),
      ("moves", self._components, made.about.components),
    ):
      if list(own) != list(other):
        raise ValueError(f"the policy {what} {', '.join(other)}, expected {', '.join(own)}")
    weights, (mean, std) = self.actor.state_dict(), (made.mean, 1.0 / made.scale)
    linear = [k.removesuffix(".weight") for k in weights if k.startswith("mlp") and "weight" in k]
    arrays = dict(zip([f"rnn.rnn.{gate}_l0" for gate in _GATES], made.memory or (), strict=False))
    if self.fine and not made.about.fine and made.memory:  # it saw nothing on that scale
      at, blind = len(made.mean), np.zeros((len(made.memory[0]), len(self.fine)), np.float32)
      arrays[f"rnn.rnn.{_GATES[0]}_l0"] = np.insert(made.memory[0], [at], blind, axis=1)
    pairs = [*zip(linear, made.layers, strict=False), *self._encoder(made.encoder)]
    for name, (weight, bias) in pairs:
      arrays |= {f"{name}.weight": weight, f"{name}.bias": bias}
    known = {k: v for k, v in weights.items() if k.startswith(("rnn", "mlp", "encoder"))}
    if {k: v.shape for k, v in arrays.items()} != {k: tuple(v.shape) for k, v in known.items()}:
      raise ValueError("the policy is of another network")
    if made.about.power != POWER or made.about.changes != self._changes:
      raise ValueError("the policy says its actions otherwise")
    for name, array in arrays.items():
      known[name].copy_(torch.from_numpy(array))
    self._scale(self.actor, *(torch.from_numpy(row).to(self.device) for row in (mean, std)))

  @property
  def _observed(self) -> list[str]:
    return [*self.groups[ACTING], *_pictures(self.pixels)]

  def _encoder(self, layers: Sequence[Any]) -> list[tuple[str, Any]]:
    """Returns the layers of an encoder by their names in the actor."""
    last = len(layers) - 1
    names = [f"encoder.convolutions.{k}" if k < last else "encoder.head" for k in range(last + 1)]
    return list(zip(names, layers, strict=True))

  def _least(self, names: Sequence[str]) -> torch.Tensor:
    """Returns how much each number that is observed varies at least."""
    out: list[float] = []
    for name in names:
      units = ROWS[name].unit.split(", ") if name in ROWS else []
      least = [_VARY[unit] for unit in units] or [0.0]
      size = math.prod(self._shapes[name])
      if len(least) == 2:  # three angles, the insertion, and the angles of a wrist
        least = 3 * least[:1] + least[1:] + (size - 4) * least[:1]
      out += least * (size // len(least))
    return torch.tensor(out)

  def action(self, said: torch.Tensor, last: torch.Tensor) -> torch.Tensor:
    """Returns the action for what the actor says, after the last one."""
    said = said.detach().clamp(-1.0, 1.0)
    return (said * said.abs() ** (POWER - 1.0) + self._adds * last).clamp(-1.0, 1.0)

  # Lessons.

  def learn(
    self, lessons: Sequence[Lesson], updates: int, spent: Callable[[], float] = lambda: 0.0
  ) -> float:
    """Learns to do what was done in lessons, and what comes of it; returns the error.

    Args:
      lessons: of all rounds
      updates: steps of the optimiser
      spent: share of the time for it that is over: the learning rate falls in that time, and at 1
        it stops
    """
    self.remember(lessons)
    parameters = [*self._parts(), *self.critic.mlp.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=_RATE)
    falling = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=updates)
    losses = []
    for _ in range(updates):
      if (share := spent()) >= 1.0:
        break
      some = self._some()
      loss = self._error(some)
      values = self.critic(some["seen"]).squeeze(-1)
      both = loss + (some["present"] * (values - some["returns"]).square()).mean()
      optimiser.zero_grad()
      both.backward()
      torch.nn.utils.clip_grad_norm_(parameters, 1.0)
      optimiser.step()
      falling.last_epoch = min(max(falling.last_epoch, int(share * updates)), updates - 1)
      falling.step()
      losses.append(loss.detach())
    return float(torch.stack(losses[-_LAST:]).mean()) if losses else math.nan

  def remember(self, lessons: Sequence[Lesson]) -> None:
    """Keeps lessons to learn from and to rehearse, and learns how large observations are."""
    self.lessons = len(lessons)
    whole = sorted((each for each in lessons if len(each.done)), key=lambda each: len(each.done))
    self._memory = [self._read(lesson) for lesson in whole]
    every = torch.cat([each["seen"] for each in self._memory])
    self.normalise(every)
    self.weigh(torch.cat([each["says"][each["taught"] > 0] for each in self._memory]))
    for each in self._memory:
      each["says"] += _PAST * each["limit"]

  def weigh(self, says: torch.Tensor) -> None:
    """Learns how much each component of what is to be said varies  (n, naction)."""
    size = (says - says.median(dim=0).values).abs().mean(dim=0)
    self._weights = 1.0 / (len(size) * size.clamp(min=_SELDOM))

  def _read(self, lesson: Lesson) -> TensorDict:
    """Returns a lesson on the device."""
    flat, count = torch.from_numpy(lesson.seen), len(lesson.done)
    widths = [math.prod(shape) for shape in self._shapes.values()]
    parts = dict(zip(self._shapes, flat.split(widths, dim=1), strict=True))
    groups = {g: torch.cat([parts[n] for n in names], dim=1) for g, names in self.groups.items()}
    meant, done = torch.from_numpy(lesson.meant), torch.from_numpy(lesson.done)
    last = torch.cat([self.initial_action.cpu()[None], done[:-1]])
    says = (meant - self._adds.cpu() * last).clamp(-1.0, 1.0)
    rows = {
      "seen": TensorDict(groups, batch_size=[count]),
      "says": says.sign() * says.abs() ** (1.0 / POWER),
      "limit": self._adds.cpu() * meant.sign() * (meant.abs() >= 1.0),
      "taught": torch.from_numpy(lesson.taught).float(),
      "returns": torch.from_numpy(lesson.returns),
      "present": torch.ones(count),
    }
    return TensorDict(rows, batch_size=[count]).to(self.device)

  def _some(self) -> TensorDict:
    """Returns lessons that are about as long, padded  (nstep, nlesson)."""
    first = int(torch.randint(1 - _BATCH // 2, len(self._memory), ()))
    chosen = self._memory[max(first, 0) : max(first + _BATCH, 1)]
    return TensorDict.from_dict(_padded(chosen), batch_size=[len(chosen[-1]), len(chosen)])

  def _error(self, some: TensorDict) -> torch.Tensor:
    """Returns how far the actor is from what was meant, each component by its size in lessons."""
    actor = self.actor
    latent, _ = actor.rnn.rnn(actor.sense(some["seen"]))
    return self.error(latent, some["says"], some["taught"])

  def error(self, latent: torch.Tensor, says: torch.Tensor, taught: torch.Tensor) -> torch.Tensor:
    """Returns how far what the actor says by its memory is from what it should, where taught."""
    error = smooth_l1_loss(self.actor.mlp(latent), says, beta=FINE, reduction="none")
    return ((error @ self._weights) * taught).sum() / taught.sum().clamp(min=1.0)

  def rehearse(self, rate: float) -> None:
    """Goes over some of what it was taught, so that practice does not make it forget the manner.

    Args:
      rate: learning rate of the practice
    """
    if self._memory is None:
      return
    self._last.param_groups[0]["lr"] = _CAREFUL * rate
    for _ in range(_REHEARSING):
      loss = self._error(self._some())
      self._last.zero_grad()
      loss.backward()
      self._last.step()

  # Spread.

  @property
  def spread(self) -> float:
    """Mean standard deviation of the actions [-]."""
    return float(self.actor.distribution.log_std_param.detach().exp().mean())

  def calm(self, most: float) -> None:
    """Lets no action vary more than that [-]."""
    with torch.no_grad():
      self.actor.distribution.log_std_param.clamp_(max=math.log(most))

  # Files.

  def policy(self, task: Any, task_kwargs: Mapping[str, Any], training: Mapping[str, Any]):
    """Returns what was learned as a policy of an exercise."""
    weights = {k: v.detach().cpu().numpy() for k, v in self.actor.state_dict().items()}
    linear = sorted(int(k.split(".")[1]) for k in weights if k.startswith("mlp.") and "weight" in k)
    begun = {"from": self.start} if self.start else {}
    about = policy.About(
      task.name, tuple(task.components), self.groups[ACTING], task.control_timestep, POWER,
      self._changes, self.initial_action.tolist(), dict(task_kwargs),
      {"palpate": palpate.__version__, **begun, **training}, pixels=self.pixels, fine=self.fine,
    )  # fmt: skip
    layers = self._encoder(self.actor.encoder.layers if self.pixels else [])
    memory: Any = tuple(weights[f"rnn.rnn.{name}_l0"] for name in _GATES)
    return policy.Policy(
      about,
      weights["obs_normalizer._mean"][0],
      1.0 / (weights["obs_normalizer._std"][0] + self.actor.obs_normalizer.eps),
      [(weights[f"mlp.{k}.weight"], weights[f"mlp.{k}.bias"]) for k in linear],
      memory,
      [(weights[f"{name}.weight"], weights[f"{name}.bias"]) for name, _ in layers],
    )


def _pictures(pixels: Sequence[int]) -> list[str]:
  return [policy.PIXELS] if pixels else []


def _rescale(model: Any, mean: torch.Tensor, std: torch.Tensor) -> None:
  """Changes the first weights of a network so that it says the same with another scale."""
  weight, bias = model.mlp[0].weight, model.mlp[0].bias
  if model.is_recurrent:
    weight, bias = model.rnn.rnn.weight_ih_l0[:, : len(mean)], model.rnn.rnn.bias_ih_l0
  known = model.obs_normalizer.state_dict()
  with torch.no_grad():
    bias += weight @ ((mean - known["_mean"][0]) / known["_std"][0])
    weight *= std / known["_std"][0]


def _padded(parts: Sequence[TensorDict]) -> dict[str, Any]:
  """Returns what has rows of different number as columns, with zeros below."""
  keys = parts[0].keys()
  return {
    key: _padded([part[key] for part in parts])
    if isinstance(parts[0][key], TensorDict)
    else pad_sequence([part[key] for part in parts])
    for key in keys
  }
