"""Learn an exercise from nothing: proximal policy optimisation in one file, with torch alone.

    python docs/tutorials/ppo.py grasp/easy > curve.csv                # a GPU, 1024 worlds
    python docs/tutorials/ppo.py touch/easy --device cpu --worlds 32   # the same, slowly

No expert and no demonstration takes part. The environment pays the change of a potential, which
tells the way from anywhere in the scene (tasks/core/base.py, "Reward"). The algorithm is that of
Schulman et al. 2017 (10.48550/arXiv.1707.06347) with generalised advantages; the learning rate
follows the change of the policy. What matters beside it:

- Jaws are told to go a small step from where they are. On tissue that is a gentle force in
  proportion to the action; at full force a fold is over the limit at once, and grasping does harm.
- Who grasps moves slowly, so that noise does not shake what is held, and is shown the last
  millimetres to the site on a scale of their own: they decide whether a fold is between the jaws.
- Rewards of a size that a network tells from its own noise: those of an episode add up to 10.
- Episodes in which nothing was gained for a second or three begin anew.
"""

import argparse
import math
import time
from typing import Any

import gymnasium
import palpate.tasks  # noqa: F401 - registers the exercises
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.99, 0.95, 0.2, 5, 8
KL, ENTROPY, NOISE = 0.015, 0.001, 0.4  # change of the policy aimed at, in a minibatch
STEPS, SCALE = 16, 10.0  # control steps of an iteration, and how much larger rewards are
JAW, CLOSED, WIDE = 0.03, -0.2, 1.0472  # a step of the jaws, and where they may be told to go [rad]
PACE, FINE = 0.4, 0.005  # with jaws: share of the rates, and of what size offsets are seen too [m]
PATIENCE, GAIN = (50, 150), 0.05  # control steps without so much more paid that end an episode
UNSEEN = ("surface",)  # 96 numbers on the whole organ, which these exercises do not need


class Agent(nn.Module):
  """A policy with noise of its own for each component, and a critic."""

  def __init__(self, nseen: int, naction: int):
    """Makes the networks, the policy's with actions near 0."""
    super().__init__()
    self.normal = nn.BatchNorm1d(nseen, eps=1e-6, momentum=None, affine=False).eval()
    self.mean, self.value = (
      nn.Sequential(
        nn.Linear(nseen, 256), nn.ELU(), nn.Linear(256, 128), nn.ELU(), nn.Linear(128, nout)
      )
      for nout in (naction, 1)
    )
    nn.init.normal_(self.mean[-1].weight, std=1e-3)
    self.noise = nn.Parameter(torch.full((naction,), math.log(NOISE)))

  def forward(self, seen: torch.Tensor) -> tuple[torch.distributions.Normal, torch.Tensor]:
    """Returns how actions are distributed, and the values."""
    normal = self.normal(seen).clamp(-5, 5)
    policy = torch.distributions.Normal(self.mean(normal), self.noise.exp())
    return policy, self.value(normal)[:, 0]

  def look(self, seen: torch.Tensor) -> None:
    """Takes observations into the means and variances that all are normalised by."""
    self.normal.train()(seen)
    self.normal.eval()


class Worlds:
  """An exercise in many worlds, as the agent has it."""

  def __init__(self, task: str, count: int, device: str):
    """Makes the worlds."""
    name = f"palpate/{''.join(map(str.title, task.split('/')))}-v0"
    self.env: Any = gymnasium.make_vec(name, num_envs=count, device=device, output="torch")
    self.naction = self.env.single_action_space.shape[0]

  def reset(self, **which: Any) -> torch.Tensor:
    """Begins episodes; returns what is seen  (nworld, nseen)."""
    return self.rows(self.env.reset(**which)[0])

  def rows(self, seen: dict[str, torch.Tensor]) -> torch.Tensor:
    """Returns observations as rows  (nworld, nseen)."""
    self.progress = seen["progress"].float()
    rows = [v.flatten(1).float() for k, v in seen.items() if k not in UNSEEN]
    self.opening = seen["gripper"][:, :1] if "gripper" in seen else None
    if self.opening is not None:
      rows.append((seen["target"].float() / FINE).clamp(-1, 1))
    return torch.cat(rows, 1)

  def step(self, action: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Takes a control step; returns what is seen, paid, and whether it is won: 1, 0, NaN as yet."""
    told = action.clamp(-1, 1)
    if self.opening is not None:
      share = 2 * (self.opening + JAW * told[:, 4:] - CLOSED) / (WIDE - CLOSED) - 1
      told = torch.cat([PACE * told[:, :4], share.clamp(-1, 1)], 1)
    seen, paid, _, _, info = self.env.step(told.float())
    won = torch.full((len(told),), math.nan, device=told.device)
    if "final_info" in info:
      over = torch.as_tensor(info["_final_info"], device=told.device)
      won[over] = info["final_info"]["success"].float().flatten()[over]
    return self.rows(seen), SCALE * paid.float().flatten(), won


def update(agent: Agent, adam: torch.optim.Adam, data: list[torch.Tensor]) -> None:
  """Takes some passes over the steps of an iteration."""
  for _ in range(EPOCHS):
    for rows in torch.randperm(len(data[0]), device=data[0].device).chunk(MINIBATCHES):
      seen, action, before, mean, advantage, value = (each[rows] for each in data)
      policy, guess = agent(seen)
      ratio = (policy.log_prob(action).sum(1) - before).exp()
      advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
      gain = torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
      error = nn.functional.smooth_l1_loss(guess, value)
      adam.zero_grad()
      (error - gain - ENTROPY * policy.entropy().sum(1).mean()).backward()
      nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
      adam.step()
      change = (0.5 * ((policy.mean - mean) / policy.stddev) ** 2).sum(1).mean().item()
      factor = 1 / 1.2 if change > 2 * KL else 1.2 if change < KL / 2 else 1.0
      adam.param_groups[0]["lr"] = min(max(factor * adam.param_groups[0]["lr"], 5e-5), 2e-3)


@torch.no_grad()
def judge(agent: Agent, worlds: Worlds, enough: float) -> float:
  """Returns the share of worlds that succeed without noise, up to where it is clear."""
  seen = worlds.reset(seed=1_000_000)
  won = torch.full((len(seen),), math.nan, device=seen.device)
  while (won == 1).float().mean() < enough and (won == 0).float().mean() <= 1 - enough:
    seen, _, ended = worlds.step(agent(seen)[0].mean)
    won = torch.where(won.isnan(), ended, won)
  return float((won == 1).float().mean())


def main() -> None:
  """Learns until enough worlds succeed, or the time is over; prints the curve."""
  parser = argparse.ArgumentParser(description="Learns an exercise from nothing.")
  add = parser.add_argument
  add("task", nargs="?", default="touch/easy")
  add("--device", default="cuda:0", help="cuda:0, cpu or warp-cpu (%(default)s)")
  add("--worlds", type=int, default=1024)
  add("--minutes", type=float, default=5.0)
  add("--enough", type=float, default=0.9, help="successes without noise (%(default)s)")
  add("--seed", type=int, default=0)
  args = parser.parse_args()
  torch.manual_seed(args.seed)
  start = time.time()
  worlds = Worlds(args.task, args.worlds, args.device)
  for _ in range(2):  # kernels are compiled in the first step, and recorded in the second
    seen = worlds.reset(seed=args.seed)
    worlds.step(torch.zeros(args.worlds, worlds.naction, device=seen.device))
  seen = worlds.reset(seed=args.seed)
  agent = Agent(seen.shape[1], worlds.naction).to(seen.device)
  adam = torch.optim.Adam(agent.parameters(), lr=1e-3)
  won, earned, best, idle = (torch.zeros(args.worlds, device=seen.device) for _ in range(4))
  patience = torch.randint(*PATIENCE, (args.worlds,), device=seen.device)
  made, start = time.time() - start, time.time()
  seconds, iteration, due, judged = 0.0, 0, 0, math.nan
  agent.look(seen)
  print("task,seed,made,steps,seconds,success,judged,progress,most,paid")
  while not (judged >= args.enough or seconds > 60 * args.minutes):
    rows = []
    with torch.no_grad():
      for _ in range(STEPS):
        policy, value = agent(seen)
        action = policy.sample()
        after, paid, ended = worlds.step(action)
        over = ~ended.isnan()
        chance = policy.log_prob(action).sum(1)
        rows.append((seen, action, chance, policy.mean, paid, over.float(), value))
        won, earned = torch.where(over, ended, won), earned + paid
        idle = torch.where(over | (earned > best + GAIN), 0.0, idle + 1)
        best = torch.where(idle > 0, best, earned)
        earned, best, seen = earned * ~over, best * ~over, after
      *told, paid, over, value = (torch.stack(column) for column in zip(*rows, strict=True))
      advantage, following, gain = torch.zeros_like(paid), agent(seen)[1], torch.zeros_like(won)
      for k in reversed(range(STEPS)):
        surprise = paid[k] + GAMMA * following * (1 - over[k]) - value[k]
        advantage[k] = gain = surprise + GAMMA * LAMBDA * (1 - over[k]) * gain
        following = value[k]
    if iteration:  # after the first one it knows how large observations are
      update(agent, adam, [x.flatten(0, 1) for x in (*told, advantage, advantage + value)])
    agent.look(told[0].flatten(0, 1))
    iteration, success, stuck = iteration + 1, float(won.mean()), idle > patience
    if success >= args.enough and iteration >= due:
      judged, due, stuck = judge(agent, worlds, args.enough), iteration + 20, idle > -1
    seconds, steps = time.time() - start, iteration * STEPS * args.worlds
    told = success, judged, worlds.progress.mean(), worlds.progress.max(), paid.sum(0).mean()
    row = ",".join(f"{x:.4g}" for x in told)
    print(f"{args.task},{args.seed},{made:.1f},{steps},{seconds:.1f},{row}", flush=True)
    if stuck.any():
      seen = worlds.reset(options={"reset_mask": stuck.cpu().numpy()})
      earned, best, idle, won = (x * ~stuck for x in (earned, best, idle, won))


if __name__ == "__main__":
  main()
