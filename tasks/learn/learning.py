# pyright: reportMissingImports=false
"""Learning in many worlds: practice is proximal policy optimisation (Schulman et al. 2017).

Its steps are rsl_rl's.

A checkpoint is a file of safetensors: weights and optimiser, in the header how far it has come.
"""

from __future__ import annotations

import copy
import dataclasses
import json
import math
import pathlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from palpate.tasks.files import replacing
from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
from safetensors import safe_open
from safetensors.torch import save as dump

from ..batch.vector import Exercises
from . import policy
from .networks import Networks
from .rsl import RslRl

CHECKPOINT = "checkpoint.safetensors"
ROW = (
  "iteration", "steps", "seconds", "episodes", "success", "return", "length", "spread",
  "learning_rate",
)  # fmt: skip
_KEY = "palpate training"
_JUDGED = 1_000_000  # seed of the first world's episode when a policy is judged
LEAST = 2048  # control steps of an iteration, in all worlds
_SHORT = 24  # of a world, at least
_SLOWEST = 1e-4  # learning rate at the start of an iteration, at least
_WATCHING = 2  # iterations in which the critic alone learns, after lessons


@dataclasses.dataclass(frozen=True)
class Settings:
  """How to learn.

  Attributes:
    seed: of what is random
    memory: numbers that the actor remembers
    hidden: sizes of the layers, above the actor's memory and of the critic
    gamma: discount of a control step [-]
    lam: of generalised advantages [-]
    epochs: passes over the steps of an iteration
    minibatches: of a pass
    spread: standard deviation of the actions, at most, while none succeeds [-]
    calm: the same once all do: what succeeds with a large spread may not without [-]
    entropy: what is paid for it
    learning_rate: at the start; it follows the change of the policy
  """

  seed: int = 0
  memory: int = 96
  hidden: tuple[int, ...] = (64,)
  gamma: float = 0.99
  lam: float = 0.95
  epochs: int = 5
  minibatches: int = 4
  spread: float = 0.5
  calm: float = 0.1
  entropy: float = 0.002
  learning_rate: float = 1e-3


# After lessons, so that what was taught is not tried away.
TAUGHT: dict[str, Any] = {"spread": 0.25, "calm": 0.08, "entropy": 0.0, "learning_rate": 3e-4}


class Student:
  """Networks that learn an exercise in many worlds.

  Attributes:
    iteration: iterations done
    steps: control steps of all worlds that it learned from
    seconds: spent on it, lessons included
  """

  algorithm = ""  # how it learns, for people
  optimiser: torch.optim.Optimizer

  def __init__(self, env: Exercises, settings: Settings, networks: Networks, seconds: float = 0.0):
    """Begins episodes in an environment with `output="torch"`.

    Args:
      env: many worlds of the exercise
      settings: how to learn
      networks: that learn
      seconds: spent on lessons
    """
    torch.manual_seed(settings.seed)
    self.settings, self.networks = settings, networks
    self._begin(env, settings.seed)
    self.iteration, self.steps, self.seconds = 0, 0, seconds

  @property
  def groups(self) -> Mapping[str, Sequence[str]]:
    """Names of what is observed by group."""
    return self.networks.groups

  def _step(self, said: torch.Tensor):
    """Does what was said."""
    action = self.networks.action(said, self._last)
    found = self.env.step(action)
    self._last = torch.where(found[2].bool()[:, None], self.networks.initial_action, action)
    return found

  def _begin(self, env: Exercises, seed: int) -> None:
    """Begins episodes in all worlds."""
    self.env = RslRl(env, seed, self.groups)
    self.networks.actor.reset()
    self._last = self.networks.initial_action.repeat(self.env.num_envs, 1)

  def iterate(self, stop: Callable[[], bool] = lambda: False) -> dict[str, float] | None:
    """Learns from some steps of all worlds; returns `ROW`, or None if it was to stop."""
    start = time.perf_counter()
    ended: list[dict[str, torch.Tensor]] = []
    success = self._learn(ended, stop)
    if success is None:
      return None
    self.iteration += 1
    self.seconds += time.perf_counter() - start

    def mean(name: str) -> float:
      return float(torch.cat([each[name] for each in ended]).mean()) if ended else math.nan

    return {
      "iteration": self.iteration, "steps": self.steps, "seconds": self.seconds,
      "episodes": sum(len(each["/return"]) for each in ended), "success": success,
      "return": mean("/return"), "length": mean("/length"),
      "spread": self.networks.spread, "learning_rate": self.rate,
    }  # fmt: skip

  def _learn(self, ended: list[dict[str, torch.Tensor]], stop: Callable[[], bool]) -> float | None:
    """Learns from some steps and adds what ended; returns the share of successes."""
    raise NotImplementedError

  @property
  def rate(self) -> float:
    """Learning rate."""
    return float(self.optimiser.param_groups[0]["lr"])

  @rate.setter
  def rate(self, value: float) -> None:
    for group in self.optimiser.param_groups:
      if torch.is_tensor(group["lr"]):  # a recorded step reads it
        group["lr"].fill_(value)
      else:
        group["lr"] = value

  @property
  def modules(self) -> dict[str, torch.nn.Module]:
    """What a checkpoint has of the networks, by name."""
    return {"actor": self.networks.actor, "critic": self.networks.critic}

  def judge(self, stop: Callable[[], bool] = lambda: False) -> float:
    """Returns the share of successes without spread, of an episode in each world."""
    self._begin(self.env.env, _JUDGED)
    env = self.env
    won = torch.zeros(env.num_envs, device=env.device)
    playing = torch.ones_like(won)
    with torch.no_grad():
      while playing.any() and not stop():
        action = self.networks.actor(env.get_observations())
        _, _, over, extras = self._step(action)
        self.networks.actor.reset(over)
        if extras["log"]:
          ended = over.bool()
          won[ended] += playing[ended] * extras["log"]["/success"]
          playing[ended] = 0.0
    self.networks.actor.reset()
    return float(won.mean())

  # Files.

  def policy(self, task: Any, task_kwargs: dict[str, Any]) -> policy.Policy:
    """Returns what was learned, for an exercise."""
    training = {
      "algorithm": self.algorithm, "num_envs": self.env.num_envs, "iteration": self.iteration,
      "steps": self.steps, "seconds": round(self.seconds, 1), "lessons": self.networks.lessons,
      **dataclasses.asdict(self.settings),
    }  # fmt: skip
    return self.networks.policy(task, task_kwargs, training)

  def save(self, path: pathlib.Path, task: str) -> None:
    """Writes a checkpoint."""
    tensors = {}
    for name, module in self.modules.items():
      tensors |= {f"{name}/{key}": value for key, value in module.state_dict().items()}
    for number, state in self.optimiser.state_dict()["state"].items():
      tensors |= {f"adam/{number}/{key}": torch.as_tensor(v) for key, v in state.items()}
    done = {
      "task": task, "iteration": self.iteration, "steps": self.steps, "seconds": self.seconds,
      "learning_rate": self.rate, "settings": dataclasses.asdict(self.settings),
    }  # fmt: skip
    tensors = {name: value.detach().cpu().contiguous().clone() for name, value in tensors.items()}
    with replacing(path, "wb") as file:
      file.write(dump(tensors, {_KEY: json.dumps(done)}))

  def load(self, path: pathlib.Path, task: str) -> None:
    """Goes on from a checkpoint; ValueError says what is wrong with it."""
    try:
      with safe_open(str(path), "pt", device=self.env.device) as file:
        done = json.loads((file.metadata() or {}).get(_KEY, "{}"))
        tensors = {name: file.get_tensor(name) for name in file.keys()}
    except Exception as error:
      raise ValueError(f"{path}: {error}") from None
    if done.get("task") != task:
      raise ValueError(f"{path} is of {done.get('task', 'something else')}, not of {task}")
    try:
      for name, module in self.modules.items():
        module.load_state_dict(_below(tensors, f"{name}/"))
      state: dict[int, dict[str, torch.Tensor]] = {}
      for key, value in _below(tensors, "adam/").items():
        number, _, name = key.partition("/")
        state.setdefault(int(number), {})[name] = value
      groups = self.optimiser.state_dict()["param_groups"]
      self.optimiser.load_state_dict({"state": state, "param_groups": groups})
    except (RuntimeError, KeyError, ValueError) as error:
      raise ValueError(f"{path} does not fit these settings: {error}") from None
    self.iteration, self.steps, self.seconds = done["iteration"], done["steps"], done["seconds"]
    self.rate = done["learning_rate"]
    torch.manual_seed(self.settings.seed + self.iteration)
    self._begin(self.env.env, self.settings.seed + self.iteration * self.env.num_envs)


class Learner(Student):
  """Networks that practise an exercise."""

  algorithm = "PPO (rsl_rl)"

  def __init__(self, env: Exercises, settings: Settings, networks: Networks, seconds: float = 0.0):
    """Begins, see `Student`; what networks have not been taught they find out here."""
    super().__init__(env, settings, networks, seconds)
    self._count = max(_SHORT, math.ceil(LEAST / env.num_envs))
    seen, count = self.env.get_observations(), self.env.num_actions
    storage = RolloutStorage(
      "rl", env.num_envs, self._count, seen, [count], networks.device
    )  # fmt: skip
    self._ppo = PPO(
      networks.actor, networks.critic, storage, device=networks.device,
      num_learning_epochs=settings.epochs,
      num_mini_batches=min(settings.minibatches, env.num_envs),  # each has whole worlds
      gamma=settings.gamma, lam=settings.lam, entropy_coef=settings.entropy,
      learning_rate=settings.learning_rate,
    )  # fmt: skip
    self.optimiser = self._ppo.optimizer
    self._ppo.train_mode()
    networks.calm(settings.spread)
    if not networks.lessons:
      self._look()
    self.env.stagger(torch.Generator().manual_seed(settings.seed))

  @property
  def rate(self) -> float:
    """Learning rate, which follows the change of the policy."""
    return self._ppo.learning_rate

  @rate.setter
  def rate(self, value: float) -> None:
    self._ppo.learning_rate = value
    for group in self.optimiser.param_groups:
      group["lr"] = value

  def _look(self) -> None:
    """Learns how large observations are."""
    seen = []
    with torch.no_grad():
      for _ in range(self._count):
        seen.append(self.env.get_observations())
        self._step(self.networks.actor(seen[-1], stochastic_output=True))
    self.networks.actor.reset()
    self.networks.normalise(torch.cat(seen))

  def _learn(self, ended: list[dict[str, torch.Tensor]], stop: Callable[[], bool]) -> float | None:
    ppo, env = self._ppo, self.env
    with torch.inference_mode():
      for _ in range(self._count):
        if stop():
          ppo.storage.clear()
          return None
        action = ppo.act(env.get_observations())
        seen, reward, over, extras = self._step(action)
        ppo.process_env_step(seen, reward, over, extras)
        if extras["log"]:
          ended.append(extras["log"])
      ppo.compute_returns(env.get_observations())
    success = float(env.won.mean())
    self._update(success)
    self.steps += self._count * env.num_envs
    return success

  def _update(self, success: float) -> None:
    ppo, networks, settings = self._ppo, self.networks, self.settings
    ppo.learning_rate = max(ppo.learning_rate, _SLOWEST)
    watching = networks.lessons and self.iteration < _WATCHING
    kept = copy.deepcopy(networks.actor.state_dict()) if watching else None
    ppo.update()
    if kept is not None:
      networks.actor.load_state_dict(kept)
      ppo.learning_rate = settings.learning_rate
    else:
      networks.rehearse(ppo.learning_rate)
    # The more often it succeeds, the less it tries: what acts in the end has no spread.
    networks.calm(settings.spread ** (1 - success) * settings.calm**success)


def _below(tensors: dict[str, Any], prefix: str) -> dict[str, Any]:
  return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
