# pyright: reportMissingImports=false
"""Training by proximal policy optimisation (Schulman et al. 2017), rsl_rl's.

A checkpoint is a file of safetensors: weights and optimiser, in the header how far it has come.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import pathlib
import time
from collections.abc import Callable
from typing import Any

import palpate
import torch
from palpate.tasks import policy
from palpate.tasks.files import replacing
from palpate.tasks.observation import ROWS
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from rsl_rl.storage import RolloutStorage
from safetensors import safe_open
from safetensors.torch import save as dump

from .rsl import RslRl
from .vector import Exercises

CHECKPOINT, POLICY = "checkpoint.safetensors", "policy.safetensors"
ROW = (
  "iteration", "steps", "seconds", "episodes", "success", "return", "length", "spread",
  "learning_rate",
)  # fmt: skip
_KEY = "palpate training"
_JUDGED = 1_000_000  # seed of the first world's episode when a policy is judged
LEAST = 2048  # control steps of an iteration, in all worlds
_SHORT = 24  # of a world, at least
# How much observations vary at least, by their unit: tissue that is not touched yet will be.
_VARY = {"m": 0.005, "m/s": 0.01, "rad": 0.05, "rad/s": 0.1, "N": 0.3, "-": 0.3}
_STILL = 1e-6  # standard deviation of what has not changed, and may be anything
_SLOWEST = 1e-4  # learning rate at the start of an iteration, at least


@dataclasses.dataclass(frozen=True)
class Settings:
  """How to learn.

  Attributes:
    seed: of what is random
    hidden: sizes of the layers
    gamma: discount of a control step [-]
    lam: of generalised advantages [-]
    epochs: passes over the steps of an iteration
    minibatches: of a pass
    spread: standard deviation of the actions at the start [-]
    entropy: what is paid for it
    learning_rate: at the start; it follows the change of the policy
  """

  seed: int = 0
  hidden: tuple[int, ...] = (128, 128)
  gamma: float = 0.99
  lam: float = 0.95
  epochs: int = 5
  minibatches: int = 4
  spread: float = 0.5
  entropy: float = 0.002
  learning_rate: float = 1e-3


class Learner:
  """A policy that learns an exercise.

  Attributes:
    iteration: iterations done
    steps: control steps of all worlds that it learned from
    seconds: spent on it
  """

  def __init__(self, env: Exercises, settings: Settings):
    """Makes the networks for an environment with `output="torch"`."""
    torch.manual_seed(settings.seed)
    self.settings, self.env = settings, RslRl(env, settings.seed)
    self.iteration, self.steps, self.seconds = 0, 0, 0.0
    self._count = max(_SHORT, math.ceil(LEAST / env.num_envs))
    seen, groups = self.env.get_observations(), list(self.env.groups)
    sets = {"actor": groups, "critic": groups}
    common = {
      "hidden_dims": settings.hidden,
      "activation": "tanh",
      "obs_normalization": True,
    }
    gaussian = {
      "class_name": "GaussianDistribution", "init_std": settings.spread, "std_type": "log"
    }  # fmt: skip
    count, device = self.env.num_actions, self.env.device
    actor = MLPModel(seen, sets, "actor", count, distribution_cfg=gaussian, **common)
    critic = MLPModel(seen, sets, "critic", 1, **common)
    storage = RolloutStorage("rl", env.num_envs, self._count, seen, [count], device)
    self._ppo = PPO(
      actor, critic, storage, device=device, num_learning_epochs=settings.epochs,
      num_mini_batches=settings.minibatches, gamma=settings.gamma, lam=settings.lam,
      entropy_coef=settings.entropy, learning_rate=settings.learning_rate,
    )  # fmt: skip
    self._ppo.train_mode()
    self._look()
    self.env.stagger(torch.Generator().manual_seed(settings.seed))

  def _look(self) -> None:
    """Learns how large observations are, once: what changed it later would change the policy."""
    seen = []
    with torch.no_grad():
      for _ in range(self._count):
        seen.append(self.env.get_observations())
        self.env.step(self._ppo.actor(seen[-1], stochastic_output=True))
    every = torch.cat([torch.cat(seen)[group] for group in self.env.groups], dim=1)
    std = every.std(dim=0)
    std = torch.where(std < _STILL, torch.full_like(std, _VARY["-"]), std)
    std = torch.maximum(std, self._least().to(std))
    for model in (self._ppo.actor, self._ppo.critic):
      known, model.obs_normalizer.eps = model.obs_normalizer.state_dict(), 0.0
      known["_mean"][:], known["_std"][:], known["_var"][:] = every.mean(dim=0), std, std.square()
      model.obs_normalizer.until = 0

  def _least(self) -> torch.Tensor:
    """Returns how much each number that is observed varies at least."""
    out, space = [], self.env.env.single_observation_space
    for name in itertools.chain(*self.env.groups.values()):
      count = math.prod(space[name].shape)
      units = ROWS[name].unit.split(", ") if name in ROWS else []
      least = [_VARY[unit] for unit in units] or [0.0]
      if len(least) == 2:  # three angles and the insertion
        least = 3 * least[:1] + least[1:]
      out += least * (count // len(least))
    return torch.tensor(out)

  def iterate(self, stop: Callable[[], bool] = lambda: False) -> dict[str, float] | None:
    """Learns from some steps of all worlds; returns `ROW`, or None if it was to stop."""
    start, ppo, env = time.perf_counter(), self._ppo, self.env
    ended: list[dict[str, torch.Tensor]] = []
    with torch.inference_mode():
      for _ in range(self._count):
        if stop():
          ppo.storage.clear()
          return None
        action = ppo.act(env.get_observations())
        seen, reward, over, extras = env.step(action)
        ppo.process_env_step(seen, reward, over, extras)
        if extras["log"]:
          ended.append(extras["log"])
      ppo.compute_returns(env.get_observations())
    ppo.learning_rate = max(ppo.learning_rate, _SLOWEST)
    ppo.update()
    self.iteration += 1
    self.steps += self._count * env.num_envs
    self.seconds += time.perf_counter() - start

    def mean(name: str) -> float:
      return float(torch.cat([each[name] for each in ended]).mean()) if ended else math.nan

    return {
      "iteration": self.iteration, "steps": self.steps, "seconds": self.seconds,
      "episodes": sum(len(each["/return"]) for each in ended), "success": float(env.won.mean()),
      "return": mean("/return"), "length": mean("/length"),
      "spread": float(ppo.actor.distribution.log_std_param.detach().exp().mean()),
      "learning_rate": ppo.learning_rate,
    }  # fmt: skip

  def judge(self, stop: Callable[[], bool] = lambda: False) -> float:
    """Returns the share of successes without spread, of an episode in each world."""
    env = self.env = RslRl(self.env.env, _JUDGED)
    won = torch.zeros(env.num_envs, device=env.device)
    playing = torch.ones_like(won)
    with torch.no_grad():
      while playing.any() and not stop():
        action = self._ppo.actor(env.get_observations())
        _, _, over, extras = env.step(action)
        if extras["log"]:
          ended = over.bool()
          won[ended] += playing[ended] * extras["log"]["/success"]
          playing[ended] = 0.0
    return float(won.mean())

  # Files.

  def policy(self, task: Any, task_kwargs: dict[str, Any]) -> policy.Policy:
    """Returns what was learned, for an exercise."""
    weights = {k: v.detach().cpu().numpy() for k, v in self._ppo.actor.state_dict().items()}
    normalizer = self._ppo.actor.obs_normalizer
    linear = sorted(int(k.split(".")[1]) for k in weights if k.startswith("mlp.") and "weight" in k)
    training = {
      "palpate": palpate.__version__, "algorithm": "PPO (rsl_rl)", "num_envs": self.env.num_envs,
      "iteration": self.iteration, "steps": self.steps, "seconds": round(self.seconds, 1),
      **dataclasses.asdict(self.settings),
    }  # fmt: skip
    about = policy.About(
      task.name, tuple(task.components), [*itertools.chain(*self.env.groups.values())],
      task.control_timestep, task_kwargs, training,
    )  # fmt: skip
    return policy.Policy(
      about,
      weights["obs_normalizer._mean"][0],
      1.0 / (weights["obs_normalizer._std"][0] + normalizer.eps),
      [(weights[f"mlp.{k}.weight"], weights[f"mlp.{k}.bias"]) for k in linear],
    )

  def save(self, path: pathlib.Path, task: str) -> None:
    """Writes a checkpoint."""
    ppo, tensors = self._ppo, {}
    for name, module in (("actor", ppo.actor), ("critic", ppo.critic)):
      tensors |= {f"{name}/{key}": value for key, value in module.state_dict().items()}
    for number, state in ppo.optimizer.state_dict()["state"].items():
      tensors |= {f"adam/{number}/{key}": torch.as_tensor(v) for key, v in state.items()}
    done = {
      "task": task, "iteration": self.iteration, "steps": self.steps, "seconds": self.seconds,
      "learning_rate": ppo.learning_rate, "settings": dataclasses.asdict(self.settings),
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
    ppo = self._ppo
    try:
      for name, module in (("actor", ppo.actor), ("critic", ppo.critic)):
        module.load_state_dict(_below(tensors, f"{name}/"))
      state: dict[int, dict[str, torch.Tensor]] = {}
      for key, value in _below(tensors, "adam/").items():
        number, _, name = key.partition("/")
        state.setdefault(int(number), {})[name] = value
      groups = ppo.optimizer.state_dict()["param_groups"]
      ppo.optimizer.load_state_dict({"state": state, "param_groups": groups})
    except (RuntimeError, KeyError, ValueError) as error:
      raise ValueError(f"{path} does not fit these settings: {error}") from None
    self.iteration, self.steps, self.seconds = done["iteration"], done["steps"], done["seconds"]
    ppo.learning_rate = done["learning_rate"]
    for group in ppo.optimizer.param_groups:
      group["lr"] = ppo.learning_rate
    torch.manual_seed(self.settings.seed + self.iteration)
    self.env = RslRl(self.env.env, self.settings.seed + self.iteration * self.env.num_envs)


def _below(tensors: dict[str, Any], prefix: str) -> dict[str, Any]:
  return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
