# pyright: reportMissingImports=false
"""The networks that learn: an actor, which goes into a policy, and a critic.

An actor that is taught does not see velocities and what the drives are behind: they tell what was
done before, and who copies an expert by that does not look (de Haan, Jayaraman and Levine 2019,
10.48550/arXiv.1905.11979). Nor does it see the far parts of the organ. A critic sees all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import palpate
import torch
from palpate.tasks import policy
from palpate.tasks.lessons import Lesson
from palpate.tasks.observation import ROWS
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch.nn.functional import smooth_l1_loss

HIDDEN = ("joint_vel", "drive", "tip_vel", "surface")  # from an actor that is taught
ACTING, MORE = "acting", "more"  # groups of observations
CLONING = 3000  # steps of the optimiser at most
_BATCH, _RATE = 1024, 2e-3
_FINE = 0.05  # errors above count by their size, not their square: a touch is small motion [-]
_KNOWN = 0.05  # share of `_VARY` that is enough where lessons have shown the whole
_REHEARSING, _CAREFUL = 10, 0.2  # steps an iteration, learning rate over that of practice
# How much observations vary at least, by their unit: tissue that is not touched yet will be.
_VARY = {"m": 0.005, "m/s": 0.01, "rad": 0.05, "rad/s": 0.1, "N": 0.3, "-": 0.3}
_STILL = 1e-6  # standard deviation of what has not changed, and may be anything


def grouped(names: Sequence[str], taught: bool) -> dict[str, list[str]]:
  """Returns what is observed in the groups of the networks."""
  hidden = [name for name in names if taught and name in HIDDEN]
  found = {ACTING: [name for name in names if name not in hidden], MORE: hidden}
  return {group: chosen for group, chosen in found.items() if chosen}


class Networks:
  """Actor and critic of an exercise.

  Attributes:
    actor: Gaussian about what it would do
    critic: returns what is to come of the discounted rewards
    groups: names of what is observed by group
    lessons: how many it was taught
  """

  def __init__(
    self,
    shapes: Mapping[str, tuple[int, ...]],
    count: int,
    hidden: Sequence[int],
    spread: float,
    seed: int,
    device: str,
    taught: bool = True,
  ):
    """Makes networks that know nothing.

    Args:
      shapes: of what is observed, by name
      count: of the components of an action
      hidden: sizes of the layers
      spread: standard deviation of the actions [-]
      seed: of the weights, and of the order of what is learned
      device: of torch
      taught: whether there will be lessons
    """
    torch.manual_seed(seed)
    self.groups, self.device, self.lessons = grouped(list(shapes), taught), device, 0
    self._shapes: dict[str, tuple[int, ...]] = dict(shapes)
    self._memory: Any = None
    seen = TensorDict(
      {g: torch.zeros(1, self._width(names)) for g, names in self.groups.items()}, batch_size=[1]
    )
    common = {"hidden_dims": list(hidden), "activation": "tanh", "obs_normalization": True}
    gaussian = {"class_name": "GaussianDistribution", "init_std": spread, "std_type": "log"}
    sets = {"actor": [ACTING], "critic": list(self.groups)}
    self.actor: Any = MLPModel(
      seen, sets, "actor", count, distribution_cfg=gaussian, **common
    ).to(device)  # fmt: skip
    self.critic: Any = MLPModel(seen, sets, "critic", 1, **common).to(device)
    self._last: Any = torch.optim.Adam(self.actor.mlp.parameters())

  def _width(self, names: Sequence[str]) -> int:
    return sum(math.prod(self._shapes[name]) for name in names)

  def normalise(self, seen: TensorDict) -> None:
    """Learns how large observations are, once: what changed it later would change the policy."""
    for model in (self.actor, self.critic):
      every = torch.cat([seen[group] for group in model.obs_groups], dim=1)
      names = [name for group in model.obs_groups for name in self.groups[group]]
      std = every.std(dim=0)
      std = torch.where(std < _STILL, torch.full_like(std, _VARY["-"]), std)
      share = _KNOWN if self.lessons else 1.0
      std = torch.maximum(std, share * self._least(names).to(std))
      known, model.obs_normalizer.eps = model.obs_normalizer.state_dict(), 0.0
      known["_mean"][:], known["_std"][:], known["_var"][:] = every.mean(dim=0), std, std.square()
      model.obs_normalizer.until = 0

  def _least(self, names: Sequence[str]) -> torch.Tensor:
    """Returns how much each number that is observed varies at least."""
    out: list[float] = []
    for name in names:
      units = ROWS[name].unit.split(", ") if name in ROWS else []
      least = [_VARY[unit] for unit in units] or [0.0]
      if len(least) == 2:  # three angles and the insertion
        least = 3 * least[:1] + least[1:]
      out += least * (math.prod(self._shapes[name]) // len(least))
    return torch.tensor(out)

  # Lessons.

  def learn(self, lessons: Sequence[Lesson], stop: Callable[[], bool] = lambda: False) -> float:
    """Learns to do what was done in lessons, and what comes of it; returns the error."""
    self.remember(lessons)
    seen, done, returns = self._memory
    parameters = [*self.actor.mlp.parameters(), *self.critic.mlp.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=_RATE)
    falling = torch.optim.lr_scheduler.OneCycleLR(optimiser, _RATE, total_steps=CLONING)
    loss = torch.zeros(())
    for _ in range(CLONING):
      if stop():
        break
      rows = torch.randint(len(done), (min(_BATCH, len(done)),), device=self.device)
      some = seen[rows]
      loss = smooth_l1_loss(self.actor(some), done[rows], beta=_FINE)
      both = loss + (self.critic(some) - returns[rows]).square().mean()
      optimiser.zero_grad()
      both.backward()
      optimiser.step()
      falling.step()
    return float(loss.detach())

  def remember(self, lessons: Sequence[Lesson]) -> None:
    """Keeps lessons to learn from and to rehearse, and learns how large observations are."""
    every = torch.cat([torch.from_numpy(lesson.seen) for lesson in lessons])
    widths = [math.prod(shape) for shape in self._shapes.values()]
    parts = dict(zip(self._shapes, every.split(widths, dim=1), strict=True))
    seen = TensorDict(
      {g: torch.cat([parts[name] for name in names], dim=1) for g, names in self.groups.items()},
      batch_size=[len(every)],
    )
    done = torch.cat([torch.from_numpy(lesson.done) for lesson in lessons]).clamp(-1.0, 1.0)
    returns = torch.cat([torch.from_numpy(lesson.returns) for lesson in lessons])[:, None]
    self.lessons = len(lessons)
    self._memory = seen.to(self.device), done.to(self.device), returns.to(self.device)
    self.normalise(self._memory[0])

  def rehearse(self, rate: float) -> None:
    """Goes over some of what it was taught, so that practice does not make it forget the manner.

    Args:
      rate: learning rate of the practice
    """
    if self._memory is None:
      return
    self._last.param_groups[0]["lr"] = _CAREFUL * rate
    seen, done, _ = self._memory
    for _ in range(_REHEARSING):
      rows = torch.randint(len(done), (min(4 * _BATCH, len(done)),), device=self.device)
      loss = smooth_l1_loss(self.actor(seen[rows]), done[rows], beta=_FINE)
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
    about = policy.About(
      task.name, tuple(task.components), self.groups[ACTING], task.control_timestep,
      dict(task_kwargs), {"palpate": palpate.__version__, **training},
    )  # fmt: skip
    return policy.Policy(
      about,
      weights["obs_normalizer._mean"][0],
      1.0 / (weights["obs_normalizer._std"][0] + self.actor.obs_normalizer.eps),
      [(weights[f"mlp.{k}.weight"], weights[f"mlp.{k}.bias"]) for k in linear],
    )
