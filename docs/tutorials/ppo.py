"""Learn an exercise from nothing: proximal policy optimisation in one file, with torch alone.

    python docs/tutorials/ppo.py grasp/easy                             # a GPU, 1024 worlds
    python docs/tutorials/ppo.py touch/easy --device cpu --worlds 32    # the same, slowly

No expert and no demonstration takes part. The environment pays the change of a potential, which
tells the way from anywhere in the scene (tasks/core/base.py, "Reward"). The algorithm is that of
Schulman et al. 2017 (10.48550/arXiv.1707.06347) with generalised advantages; the learning rate
follows the change of the policy. What an agent needs besides:

- Jaws that are told to go a step from where they are. Noise on their position would open and close
  them fifty times a second; so they squeeze with a force in proportion to the action.
- Rewards of a size that a network tells from its own noise: those of an episode add up to 1.
- Episodes that are begun anew when nothing has come of a second or three, so that most worlds are
  where there is something to be learned. What is cut short has the critic's value added.
"""

import argparse
import csv
import math
import time
from typing import Any

import gymnasium
import palpate.tasks  # noqa: F401 - registers the exercises
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

GAMMA, LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.99, 0.95, 0.2, 5, 8
KL, ENTROPY, SPREAD = 0.015, 0.001, 0.4  # change of the policy aimed at, of an iteration
SCALE = 10.0  # of rewards
JAW, CLOSED, WIDE = 0.05, -0.2, 1.0472  # a step of the jaws, and where they may be told to go [rad]
PATIENCE, GAIN = (50, 150), 0.05  # control steps without so much more paid that end an episode
UNSEEN = ("surface",)  # 96 numbers on the whole organ, which these exercises do not need


def network(nin: int, nout: int) -> nn.Sequential:
  """Returns a network of two layers."""
  layers = nn.Linear(nin, 256), nn.ELU(), nn.Linear(256, 128), nn.ELU(), nn.Linear(128, nout)
  return nn.Sequential(*layers)


class Agent(nn.Module):
  """A policy with a spread of its own for each component, and a critic."""

  def __init__(self, nseen: int, naction: int):
    """Makes the networks, the policy's with actions near 0."""
    super().__init__()
    self.mean, self.value = network(nseen, naction), network(nseen, 1)
    with torch.no_grad():
      self.mean[-1].weight.mul_(0.01)
    self.spread = nn.Parameter(torch.full((naction,), math.log(SPREAD)))
    self.register_buffer("count", torch.tensor(1e-4))
    self.register_buffer("centre", torch.zeros(nseen))
    self.register_buffer("square", torch.ones(nseen))

  def look(self, seen: torch.Tensor) -> None:
    """Takes observations into the mean and the variance that all are normalised by."""
    total = self.count + len(seen)
    off = seen.mean(0) - self.centre
    spread = self.square * self.count + seen.var(0) * len(seen)
    self.square = (spread + off**2 * self.count * len(seen) / total) / total
    self.centre, self.count = self.centre + off * len(seen) / total, total

  def normal(self, seen: torch.Tensor) -> torch.Tensor:
    """Returns observations around 0, of size 1."""
    return ((seen - self.centre) / (self.square + 1e-6).sqrt()).clamp(-5, 5)

  def policy(self, normal: torch.Tensor) -> torch.distributions.Normal:
    """Returns how the actions are spread."""
    return torch.distributions.Normal(self.mean(normal), self.spread.exp())


class Worlds:
  """An exercise in many worlds, as the agent has it."""

  def __init__(self, task: str, count: int, device: str):
    """Makes the worlds."""
    name = f"palpate/{''.join(map(str.title, task.split('/')))}-v0"
    self.env: Any = gymnasium.make_vec(name, num_envs=count, device=device, output="torch")
    self.naction, self.seen = self.env.single_action_space.shape[0], {}

  def reset(self, **which: Any) -> torch.Tensor:
    """Begins episodes; returns what is seen  (nworld, nseen)."""
    self.seen, _ = self.env.reset(**which)
    return flat(self.seen)

  def step(self, action: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Takes a control step; returns what is seen, is paid, is over, is cut short, and info."""
    action = action.clamp(-1, 1)
    if "gripper" in self.seen:
      told = self.seen["gripper"][:, :1] + JAW * action[:, 4:]  # [rad]
      share = 2 * (told - CLOSED) / (WIDE - CLOSED) - 1
      action = torch.cat([action[:, :4], share.clamp(-1, 1)], 1)
    self.seen, reward, terminated, truncated, info = self.env.step(action.float())
    over, cut = (terminated | truncated).flatten(), truncated.flatten()
    return flat(self.seen), SCALE * reward.float().flatten(), over, cut, info


def flat(seen: dict[str, torch.Tensor]) -> torch.Tensor:
  """Returns observations as rows, (nworld, nseen)."""
  return torch.cat([v.flatten(1).float() for k, v in seen.items() if k not in UNSEEN], 1)


def update(agent: Agent, adam: torch.optim.Adam, data: list[torch.Tensor]) -> None:
  """Takes some passes over the steps of an iteration."""
  for _ in range(EPOCHS):
    for rows in torch.randperm(len(data[0]), device=data[0].device).chunk(MINIBATCHES):
      seen, action, before, mean, advantage, value = (each[rows] for each in data)
      policy = agent.policy(seen)
      ratio = (policy.log_prob(action).sum(1) - before).exp()
      advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
      gain = torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
      error = nn.functional.smooth_l1_loss(agent.value(seen)[:, 0], value)
      loss = error - gain - ENTROPY * policy.entropy().sum(1).mean()
      adam.zero_grad()
      loss.backward()
      nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
      adam.step()
      with torch.no_grad():  # both means under the spread of now
        change = (0.5 * ((policy.mean - mean) / policy.stddev) ** 2).sum(1).mean()
      rate = adam.param_groups[0]["lr"]
      rate = rate / 1.2 if change > 2 * KL else rate * 1.2 if change < KL / 2 else rate
      adam.param_groups[0]["lr"] = min(max(rate, 5e-5), 2e-3)


def judge(agent: Agent, worlds: Worlds, enough: float) -> float:
  """Returns the share of worlds that succeed without spread, up to where it is clear."""
  seen = worlds.reset(seed=1_000_000)
  won = torch.full((len(seen),), math.nan, device=seen.device)
  while True:
    with torch.no_grad():
      seen, _, over, _, info = worlds.step(agent.mean(agent.normal(seen)))
    if over.any():
      found = info["final_info"]["success"].float().flatten()
      won = torch.where(over & won.isnan(), found, won)
    share = float((won == 1).float().mean())
    if share >= enough or float((won == 0).float().mean()) > 1 - enough:
      return share


def main() -> None:
  """Learns until enough worlds succeed, or the time is over."""
  parser = argparse.ArgumentParser(description="Learns an exercise from nothing.")
  add = parser.add_argument
  add("task", nargs="?", default="touch/easy")
  add("--device", default="cuda:0", help="cuda:0, cpu or warp-cpu (%(default)s)")
  add("--worlds", type=int, default=1024)
  add("--steps", type=int, default=16, help="of a world in an iteration (%(default)s)")
  add("--minutes", type=float, default=5.0)
  add("--enough", type=float, default=0.9, help="successes without spread (%(default)s)")
  add("--seed", type=int, default=0)
  add("--out", default="ppo.csv", help="curve (%(default)s)")
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
  done, steps, iteration, due, judged = False, 0, 0, 0, math.nan
  agent.look(seen)
  with open(args.out, "w", newline="") as file:
    write = csv.writer(file)
    names = ("success", "judged", "progress", "most", "paid", "spread")
    write.writerow(("task", "seed", "made", "steps", "seconds", *names))
    while not done:
      rows: list[tuple[torch.Tensor, ...]] = []
      for _ in range(args.steps):
        with torch.no_grad():
          normal = agent.normal(seen)
          policy, value = agent.policy(normal), agent.value(normal)[:, 0]
          after, reward, over, cut, info = worlds.step(action := policy.sample())
          earned = earned + reward
          if over.any():
            last = agent.normal(flat(info["final_obs"]))
            reward = reward + GAMMA * agent.value(last)[:, 0] * cut
            won = torch.where(over, info["final_info"]["success"].float().flatten(), won)
        chance = policy.log_prob(action).sum(1)
        rows.append((seen, normal, action, chance, policy.mean, reward, over.float(), value))
        idle = torch.where(over | (earned > best + GAIN), 0.0, idle + 1)
        best = torch.where(idle > 0, best, earned)
        earned, best, seen = earned * ~over, best * ~over, after
      columns = (torch.stack(column) for column in zip(*rows, strict=True))
      raw, normal, action, chance, mean, reward, over, value = columns
      with torch.no_grad():
        following, gain = agent.value(agent.normal(seen))[:, 0], torch.zeros_like(reward[0])
        advantage = torch.zeros_like(reward)
        for k in reversed(range(args.steps)):
          surprise = reward[k] + GAMMA * following * (1 - over[k]) - value[k]
          gain = surprise + GAMMA * LAMBDA * (1 - over[k]) * gain
          advantage[k], following = gain, value[k]
      data = (normal, action, chance, mean, advantage, advantage + value)
      if iteration:  # after the first one it knows how large observations are
        update(agent, adam, [each.flatten(0, 1) for each in data])
      agent.look(raw.flatten(0, 1))
      iteration, steps = iteration + 1, steps + over.numel()
      seconds, success = time.time() - start, float(won.mean())
      stuck = idle > patience
      if success >= args.enough and iteration >= due:
        judged, stuck = judge(agent, worlds, args.enough), torch.ones_like(stuck)
        due, seconds = iteration + 30, time.time() - start
      if stuck.any():
        seen = worlds.reset(options={"reset_mask": stuck.cpu().numpy()})
        earned, best, idle, won = (x * ~stuck for x in (earned, best, idle, won))
      done = judged >= args.enough or seconds > 60 * args.minutes
      progress = info["progress"]
      row = (success, judged, float(progress.mean()), float(progress.max()),
             float(reward.sum(0).mean()), float(agent.spread.detach().exp().mean()))  # fmt: skip
      now = round(made, 1), steps, round(seconds, 1)
      write.writerow((args.task, args.seed, *now, *(f"{x:.4g}" for x in row)))
      file.flush()
      if iteration % 10 == 0 or done:
        shown = ", ".join(f"{name} {x:.2f}" for name, x in zip(names, row, strict=True))
        print(f"{args.task} {args.seed}: {steps:,} steps, {seconds:.0f} s, {shown}", flush=True)


if __name__ == "__main__":
  main()
