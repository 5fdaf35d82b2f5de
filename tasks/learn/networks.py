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
# Windows of a step of the optimiser, as many as all lessons have at most, and steps of a window.
_BATCH, _WINDOW, _RATE = 256, 96, 3e-3
# Steps of the optimiser until the memories that windows begin with are found anew, and lessons that
# this is done of at once.
_ANEW, _TOGETHER = 40, 256
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
    self._lessons: Any = None
    self._steps = 0  # of the optimiser
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
    finely = [name for name in self.groups[ACTING] if name.endswith(FINELY)]
    recurrent["fine"] = self.fine = self._columns(finely)
    self.pixels = self._shapes[policy.PIXELS][:2] if PICTURES in self.groups else ()
    kind: Any = functools.partial(Seeing, size=self.pixels) if self.pixels else Sensing
    self.actor: Any = kind(seen, sets, "actor", count, **recurrent, **common).to(device)
    self.critic: Any = MLPModel(seen, sets, "critic", 1, **common).to(device)
    self._last: Any = torch.optim.Adam(self._parts())

  def _parts(self) -> list[Any]:
    return [*self.actor.rnn.parameters(), *self.actor.mlp.parameters()]

  def _width(self, names: Sequence[str]) -> int:
    return sum(math.prod(self._shapes[name]) for name in names)

  def _columns(self, names: Sequence[str]) -> list[int]:
    """Returns where in what the actor sees observations are."""
    at, found = 0, {}
    for name in self.groups[ACTING]:
      found[name] = range(at, at := at + self._width([name]))
    return [k for name in names for k in found[name]]

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
    """Begins with what a policy does that observes no more; ValueError says why it cannot."""
    about, blind = made.about, set(self.groups[ACTING]) - set(made.about.observations)
    for what, own, other in (
      ("observes", self._observed, [*about.observations, *_pictures(about.pixels)]),
      ("moves", self._components, list(about.components)),
    ):
      if [name for name in own if name not in blind] != other:
        raise ValueError(f"the policy {what} {', '.join(other)}, expected {', '.join(own)}")
    weights, at = self.actor.state_dict(), self._columns(about.observations)
    linear = [k.removesuffix(".weight") for k in weights if k.startswith("mlp") and "weight" in k]
    arrays = dict(zip([f"rnn.rnn.{gate}_l0" for gate in _GATES], made.memory or (), strict=False))
    width, size = self._width(self.groups[ACTING]), self.actor.rnn.rnn.input_size
    finely = {at[k] for k in about.fine}
    fine = [width + n for n, k in enumerate(self.fine) if k in finely]
    inputs = [*at, *fine, *range(width + len(self.fine), size)]
    if made.memory and len(inputs) == made.memory[0].shape[1]:
      arrays[f"rnn.rnn.{_GATES[0]}_l0"] = weight = np.zeros((len(made.memory[0]), size), np.float32)
      weight[:, inputs] = made.memory[0]
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
    mean, std = torch.zeros(width), torch.ones(width)
    mean[at], std[at] = torch.from_numpy(made.mean), torch.from_numpy(1.0 / made.scale)
    self._scale(self.actor, mean.to(self.device), std.to(self.device))

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

    A step of the optimiser goes over windows of lessons, not over whole ones: each control step has
    to wait for the one before, whether many lessons are gone over or few.

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
      some, loss = self._some()
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
    self._lengths = [len(each.done) for each in whole]
    self._lessons = rows = torch.cat([self._read(each) for each in whole])
    self._taught = torch.nonzero(rows["taught"]).squeeze(1)
    self.normalise(rows["seen"])
    self.weigh(rows["says"][self._taught])
    rows["says"] += _PAST * rows["limit"]
    lengths = torch.tensor(self._lengths, device=self.device)
    self._ends = lengths.cumsum(0).repeat_interleave(lengths)  # of the lessons, for each row
    self._starts = self._ends - lengths.repeat_interleave(lengths)
    self._steps = 0

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

  def _some(self) -> tuple[TensorDict, torch.Tensor]:
    """Returns windows of lessons (nstep, nwindow), and how far the actor is from what was meant."""
    if self._steps % _ANEW == 0:
      self._memories = self._remembered()
    self._steps += 1
    steps = torch.arange(min(_WINDOW, self._lengths[-1]), device=self.device)[:, None]
    size = (min(_BATCH, math.ceil(len(self._lessons) / len(steps))),)
    moment = self._taught[torch.randint(len(self._taught), size, device=self.device)]
    before = torch.randint(len(steps), size, device=self.device)
    first = torch.maximum(moment - before, self._starts[moment])
    rows = first + steps
    inside = rows < self._ends[moment]
    some = self._lessons[rows.clamp(max=len(self._lessons) - 1)]
    for key in ("taught", "present"):
      some[key] *= inside
    latent, _ = self.actor.rnn.rnn(self.actor.sense(some["seen"]), self._memories[None, first])
    return some, self.error(latent, some["says"], some["taught"])

  @torch.no_grad()
  def _remembered(self) -> torch.Tensor:
    """Returns what the actor remembers before each row of the lessons  (nrow, nmemory)."""
    lessons, found = self.actor.sense(self._lessons["seen"]).split(self._lengths), []
    for k in range(0, len(lessons), _TOGETHER):
      some = lessons[k : k + _TOGETHER]
      known, _ = self.actor.rnn.rnn(pad_sequence(some))
      known = torch.cat([torch.zeros_like(known[:1]), known])
      found += [known[: len(lesson), n] for n, lesson in enumerate(some)]
    return torch.cat(found)

  def error(self, latent: torch.Tensor, says: torch.Tensor, taught: torch.Tensor) -> torch.Tensor:
    """Returns how far what the actor says by its memory is from what it should, where taught."""
    error = smooth_l1_loss(self.actor.mlp(latent), says, beta=FINE, reduction="none")
    return ((error @ self._weights) * taught).sum() / taught.sum().clamp(min=1.0)

  def rehearse(self, rate: float) -> None:
    """Goes over some of what it was taught, so that practice does not make it forget the manner.

    Args:
      rate: learning rate of the practice
    """
    if self._lessons is None:
      return
    self._last.param_groups[0]["lr"] = _CAREFUL * rate
    for _ in range(_REHEARSING):
      _, loss = self._some()
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
