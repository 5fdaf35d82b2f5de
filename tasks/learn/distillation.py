# pyright: reportMissingImports=false
"""Distillation: a policy of pictures learns in many worlds from one that sees the state.

The teacher says in every world what it would do, whoever acts: in a share of the worlds the student
alone, elsewhere both by turns (Ross, Gordon and Bagnell 2011, 10.48550/arXiv.1011.0686; a teacher
that sees more: Chen et al. 2019, 10.48550/arXiv.1912.12294). From what the student senses and
remembers it has to tell what the teacher sees and it does not, too: so its encoder learns where to
look long before it acts well.
"""

from __future__ import annotations

import collections
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch.nn.functional import smooth_l1_loss

from ..batch.vector import Exercises
from . import policy
from .learning import Settings, Student
from .networks import ACTING, FINE, MORE, Networks
from .sight import PICTURES

TEACHER, PROGRESS = "teacher", "progress"  # groups of observations
STEPS = 32  # control steps of an iteration
UPDATES, WORLDS = 128, 32  # steps of the optimiser of an iteration, and worlds of each
_KEPT = 8  # iterations that are learned from
_ALONE = 1 / 3  # share of worlds where the student acts alone, once it acts
_TURN = 40  # control steps of a turn elsewhere, in the mean
STUCK = 40  # control steps without progress after which it is the teacher's turn there
PATIENCE = 120  # control steps without progress that end an episode: nothing new is seen
_LITTLE = 1e-3  # that is no progress [-]
_ACTS, _LEAST = 0.4, 0.2  # share of the training after which the teacher acts least, and how often
_RATE, _SLOWEST = 3e-3, 0.01  # learning rate, and share of it at the end
_LIGHT = 0.1  # by how much each colour of a picture varies that is learned from [-]
_WARM = 3  # times that work is done before it is recorded


class Recorded:
  """Work on tensors that keep their shapes: small kernels, which a GPU replays as one graph."""

  def __init__(self, work: Callable[[dict[str, torch.Tensor]], torch.Tensor]):
    """Takes the work; nothing in it may wait for the device."""
    self._work, self._graph = work, None

  def __call__(self, part: dict[str, torch.Tensor]) -> torch.Tensor:
    """Does the work with tensors by name; what it returns keeps its place."""
    if self._graph is None:
      self._part, here, aside = part, torch.cuda.current_stream(), torch.cuda.Stream()
      aside.wait_stream(here)
      with torch.cuda.stream(aside):
        for _ in range(_WARM):
          self._work(part)
      here.wait_stream(aside)
      self._graph = torch.cuda.CUDAGraph()
      with torch.cuda.graph(self._graph):
        self._found = self._work(part)
    for name, values in part.items():
      self._part[name].copy_(values)
    self._graph.replay()
    return self._found


class Distillation(Student):
  """Networks that learn from a teacher what pictures show."""

  algorithm = "distillation"

  def __init__(
    self,
    env: Exercises,
    settings: Settings,
    networks: Networks,
    teacher: policy.Policy,
    iterations: int,
    seconds: float = math.inf,
  ):
    """Begins episodes in an environment that observes the groups and the picture.

    Args:
      env: many worlds of the exercise
      settings: how to learn
      networks: that learn; `privileged` are what the teacher alone observes
      teacher: a policy of the same exercise
      iterations: of the training
      seconds: that it takes, at most
    """
    self._names, self._most = list(teacher.about.observations), (max(iterations, 1), seconds)
    space: Any = env.single_observation_space
    device = networks.device
    sizes = {name: math.prod(space[name].shape) for name in networks.groups[MORE]}
    shapes = {name: space[name].shape for name in self._names}
    layers = [len(bias) for _, bias in teacher.layers]
    made = Networks(
      shapes, env.task.components, teacher.layers[0][0].shape[1], layers[:-1], 1.0,
      settings.seed, device,
    )  # fmt: skip
    made.take(teacher)
    self._teacher = made.actor
    super().__init__(env, settings, networks)
    seen = networks.actor.rnn.rnn.input_size + settings.memory
    self._guess = torch.nn.Linear(seen, sum(sizes.values())).to(device)
    share = [1.0 / (len(sizes) * size) for size in sizes.values() for _ in range(size)]
    self._share = torch.tensor(share, device=device)
    parts = [networks.actor.encoder, networks.actor.rnn, networks.actor.mlp, self._guess]
    cuda = torch.device(device).type == "cuda"
    self.optimiser = torch.optim.Adam(
      [p for part in parts for p in part.parameters()],
      torch.tensor(_RATE, device=device) if cuda else _RATE, capturable=cuda,
    )  # fmt: skip
    self._descend = Recorded(self._learn_from) if cuda else self._learn_from
    torch.backends.cudnn.benchmark = True  # sizes stay what they are
    self._kept: collections.deque[dict[str, Any]] = collections.deque(maxlen=_KEPT)
    self._random = torch.Generator(device).manual_seed(settings.seed)
    self.alone = torch.arange(self.env.num_envs, device=device) < _ALONE * self.env.num_envs
    self.helped, self._left = torch.ones_like(self.alone), False
    self.env.stagger(torch.Generator().manual_seed(settings.seed))

  @property
  def groups(self) -> Mapping[str, Sequence[str]]:
    """See `Student`."""
    return {**self.networks.groups, TEACHER: self._names, PROGRESS: [PROGRESS]}

  @property
  def modules(self) -> dict[str, torch.nn.Module]:
    """See `Student`."""
    return {**super().modules, "guess": self._guess}

  @property
  def _done(self) -> float:
    """Share of the training that is done."""
    return min(max(self.iteration / self._most[0], self.seconds / self._most[1]), 1.0)

  def _begin(self, env: Exercises, seed: int) -> None:
    super()._begin(env, seed)
    self._teacher.reset()
    self._best = torch.full((self.env.num_envs,), -math.inf, device=self.env.device)
    self._idle = torch.zeros_like(self._best)

  def _learn(self, ended: list[dict[str, torch.Tensor]], stop: Callable[[], bool]) -> float | None:
    part = self._collect(ended, stop)
    if part is None:
      return None
    self._kept.append(part)
    if not self.iteration:
      seen = {group: part[group].flatten(0, 1) for group in (ACTING, MORE)}
      self.networks.normalise(TensorDict(seen, [len(seen[ACTING])]))
    if len(self._kept) == 1:
      self.networks.weigh(part["says"].flatten(0, 1))
    self.rate = _RATE * max(0.5 + 0.5 * math.cos(math.pi * self._done), _SLOWEST)
    for _ in range(UPDATES):
      self.update()
    self.steps += STEPS * self.env.num_envs
    return float(self.env.won[self.alone].mean()) if self._left else 0.0

  @torch.no_grad()
  def _collect(self, ended: list, stop: Callable[[], bool]) -> dict[str, torch.Tensor] | None:
    """Returns what was seen in some steps of all worlds, and what the teacher said."""
    env, actor = self.env, self.networks.actor
    helps = max(1.0 - (1.0 - _LEAST) * self._done / _ACTS, _LEAST)
    rows: dict[str, list[torch.Tensor]] = collections.defaultdict(list)
    state = actor.get_hidden_state()
    size = env.num_envs, self.settings.memory
    first = torch.zeros(size, device=env.device) if state is None else state[0].clone()
    begun = torch.zeros(env.num_envs, device=env.device)
    if self.iteration and self._done > _ACTS / 2 and not self._left:  # alone from now on
      self._left, env.won[self.alone], env.whole[self.alone] = True, 0.0, False
    for _ in range(STEPS):
      if stop():
        return None
      seen = env.get_observations()
      says = self._teacher(TensorDict({ACTING: seen[TEACHER]}, batch_size=[env.num_envs]))
      said = torch.where(self.helped[:, None], says, actor(seen)) if self.iteration else says
      row = {group: seen[group] for group in (ACTING, PICTURES, MORE)}
      for name, value in {**row, "says": says.clamp(-1.0, 1.0), "begun": begun}.items():
        rows[name].append(value)
      self._watch(seen[PROGRESS][:, 0])
      _, _, over, extras = self._step(said)
      begun = over.float()
      self._best.masked_fill_(over.bool(), -math.inf)
      self._idle.masked_fill_(over.bool(), 0.0)
      for each in (actor, self._teacher):
        each.reset(over)
      if extras["log"]:
        ended.append(extras["log"])
      drawn = torch.rand(2, env.num_envs, generator=self._random, device=env.device)
      again = over.bool() | (drawn[0] < 1 / _TURN)
      self.helped = torch.where(again, drawn[1] < helps, self.helped)
      self.helped |= self._idle > STUCK
      if self._left:
        self.helped &= ~self.alone
    return {name: torch.stack(values) for name, values in rows.items()} | {"state": first[None]}

  def _watch(self, progress: torch.Tensor) -> None:
    """Ends episodes that do not get on."""
    self._idle = torch.where(progress > self._best + _LITTLE, 0.0, self._idle + 1.0)
    self._best = torch.maximum(self._best, progress)
    self.env.hasten(self._idle > PATIENCE)

  def update(self) -> torch.Tensor:
    """Takes a step of the optimiser, by some worlds of an iteration; returns the error."""
    kept, device = self._kept[int(torch.randint(len(self._kept), ()))], self.env.device
    size = (min(WORLDS, self.env.num_envs),)
    worlds = torch.randint(self.env.num_envs, size, generator=self._random, device=device)
    part = {name: rows[:, worlds] for name, rows in kept.items()}
    drawn = torch.rand(4, *size, 1, generator=self._random, device=device)
    part |= {"soft": 0.5 * drawn[0], "light": 1.0 + _LIGHT * (2.0 * drawn[1:] - 1.0)}
    return self._descend(part).clone()

  def _learn_from(self, part: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Takes a step of the optimiser by pieces of episodes  (nstep, nworld, ...)."""
    networks, actor = self.networks, self.networks.actor
    told = actor.sense({**part, PICTURES: self._varied(part)})
    latent = self._remember(told, part["begun"], part["state"][0])
    error = networks.error(latent, part["says"], torch.ones_like(part["begun"]))
    known = networks.critic.obs_normalizer(torch.cat([part[ACTING], part[MORE]], dim=-1))
    more = known[..., part[ACTING].shape[-1] :].clamp(-10.0, 10.0)
    guess = smooth_l1_loss(
      self._guess(torch.cat([told, latent], dim=-1)), more, beta=FINE, reduction="none"
    )
    loss = error + (guess @ self._share).mean()
    self.optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_([p for p in actor.parameters() if p.grad is not None], 1.0)
    self.optimiser.step()
    return loss.detach()

  def _varied(self, part: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Returns pictures as other renderers may draw them: edges are softer, the light is another."""
    seen = part[PICTURES]
    x = seen.reshape(*seen.shape[:-1], *self.networks.pixels, 3).float()
    for dim in (-3, -2):
      around = 0.5 * (x.roll(1, dim) + x.roll(-1, dim))
      x = torch.lerp(x, around, part["soft"][..., None, None])
    light = part["light"].movedim(0, -1)[:, :, None]
    return (x * light).clamp(max=255.0).flatten(2)

  def _remember(self, told: torch.Tensor, begun: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
    """Returns the actor's memory in each step, beginning with a state; an episode has its own."""
    gru = self.networks.actor.rnn.rnn
    weights = gru.weight_ih_l0, gru.weight_hh_l0, gru.bias_ih_l0, gru.bias_hh_l0
    states = []
    for x, begins in zip(told, begun, strict=True):
      state = torch.gru_cell(x, state * (1.0 - begins)[:, None], *weights)
      states.append(state)
    return torch.stack(states)
