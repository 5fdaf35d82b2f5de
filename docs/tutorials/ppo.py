"""Learn an exercise from nothing: proximal policy optimisation in one file, with torch alone.

    python docs/tutorials/ppo.py touch/easy                             # a GPU, 4096 worlds
    python docs/tutorials/ppo.py touch/easy --device cpu --worlds 32    # the same, slowly

No expert and no demonstration takes part. The environment pays the change of the exercise's
progress (docs/environments.md, "Reward"), which tells the way from anywhere in the scene. The
algorithm is that of Schulman et al. 2017 (10.48550/arXiv.1707.06347) with generalised advantages;
the learning rate follows the change of the policy. Episodes that the time limit ends go on in the
critic's mind: their last reward has the value of what would have followed added to it. So have
those that are begun anew because nothing came of them for a second or three, which keeps most
worlds where there is something to be learned, and lets their episodes begin at different times.
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
NOISE = 0.005  # advantages that are no larger tell nothing, and are not made large
PATIENCE, GAIN = (50, 150), 0.01  # control steps without so much progress that end an episode
DAMAGE = 2  # an outcome, see docs/vector.md
UNSEEN = ("surface",)  # 96 numbers on the whole organ, which these exercises do not need


class Agent(nn.Module):
  """A policy with a spread of its own for each component, and a critic."""

  def __init__(self, nseen: int, naction: int):
    """Makes the networks, the policy's with actions near 0."""
    super().__init__()
    self.mean, self.value = _network(nseen, naction), _network(nseen, 1)
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
    return ((seen - self.centre) / (self.square + 1e-8).sqrt()).clamp(-5, 5)

  def policy(self, normal: torch.Tensor) -> torch.distributions.Normal:
    """Returns how the actions are spread."""
    return torch.distributions.Normal(self.mean(normal), self.spread.exp())


def _network(nin: int, nout: int) -> nn.Sequential:
  return nn.Sequential(
    nn.Linear(nin, 256), nn.ELU(), nn.Linear(256, 128), nn.ELU(), nn.Linear(128, nout)
  )


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
      advantage = (advantage - advantage.mean()) / (advantage.std() + NOISE)
      gain = torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage).mean()
      error = (agent.value(seen)[:, 0] - value).square().mean()
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


def judge(agent: Agent, env: gymnasium.vector.VectorEnv) -> float:
  """Returns the share of successes without spread, of an episode in each world."""
  seen, _ = env.reset(seed=1_000_000)
  won = torch.full((env.num_envs,), -1.0, device=flat(seen).device)
  while (won < 0).any():
    with torch.no_grad():
      action = agent.mean(agent.normal(flat(seen))).clamp(-1, 1)
    seen, _, _, _, info = env.step(action)
    if "final_info" in info:
      over = torch.as_tensor(info["_final_info"], device=won.device) & (won < 0)
      won[over] = info["final_info"]["success"].float().flatten()[over]
  return float(won.mean())


def main() -> None:
  """Learns until enough worlds succeed, or the time is over."""
  parser = argparse.ArgumentParser(description="Learns an exercise from nothing.")
  add = parser.add_argument
  add("task", nargs="?", default="touch/easy")
  add("--device", default="cuda:0", help="cuda:0, cpu or warp-cpu (%(default)s)")
  add("--worlds", type=int, default=4096)
  add("--steps", type=int, default=32, help="of each world in an iteration (%(default)s)")
  add("--minutes", type=float, default=5.0)
  add("--enough", type=float, default=0.9, help="successes without spread (%(default)s)")
  add("--seed", type=int, default=0)
  add("--out", default="ppo.csv", help="curve (%(default)s)")
  args = parser.parse_args()
  torch.manual_seed(args.seed)
  domain, level = args.task.split("/")
  name = f"palpate/{domain.title()}{level.title()}-v0"
  env: Any = gymnasium.make_vec(name, num_envs=args.worlds, device=args.device, output="torch")
  seen, _ = env.reset(seed=args.seed)
  seen = flat(seen)
  agent = Agent(seen.shape[1], env.single_action_space.shape[0]).to(seen.device)
  adam = torch.optim.Adam(agent.parameters(), lr=1e-3)
  won, hurt, best, idle = (torch.zeros(args.worlds, device=seen.device) for _ in range(4))
  patience = torch.randint(*PATIENCE, (args.worlds,), device=seen.device)
  start, done, steps, iteration, judged = time.time(), False, 0, 0, math.nan
  agent.look(seen)
  with open(args.out, "w", newline="") as file:
    write = csv.writer(file)
    names = ("success", "damage", "judged", "paid", "spread")
    write.writerow(("task", "seed", "steps", "seconds", *names))
    while not done:
      rows: list[tuple[torch.Tensor, ...]] = []
      for _ in range(args.steps):
        with torch.no_grad():
          normal = agent.normal(seen)
          policy = agent.policy(normal)
          action = policy.sample()
          told, reward, terminated, truncated, info = env.step(action.clamp(-1, 1))
          after = flat(told)
          reward, over = reward.float().flatten(), (terminated | truncated).flatten()
          if "final_obs" in info:  # what the episode would still have been paid
            last = agent.value(agent.normal(flat(info["final_obs"])))[:, 0]
            reward = reward + GAMMA * last * truncated.flatten()
            ended = info["final_info"]
            won = torch.where(over, ended["success"].float().flatten(), won)
            hurt = torch.where(over, (ended["outcome"] == DAMAGE).float().flatten(), hurt)
          chance = policy.log_prob(action).sum(1)
          value = agent.value(normal)[:, 0]
        progress = torch.where(over, 0.0, info["progress"].flatten())
        idle = torch.where(over | (progress > best + GAIN), 0.0, idle + 1)
        best = torch.where(over, 0.0, torch.where(idle > 0, best, progress))
        rows.append((seen, normal, action, chance, policy.mean, reward, over.float(), value))
        seen = after
      raw, normal, action, chance, mean, reward, over, value = map(
        torch.stack, zip(*rows, strict=True)
      )
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
      stuck = idle > patience
      if stuck.any():
        seen = flat(env.reset(options={"reset_mask": stuck.cpu().numpy()})[0])
        best, idle = torch.where(stuck, 0.0, best), torch.where(stuck, 0.0, idle)
        won, hurt = torch.where(stuck, 0.0, won), torch.where(stuck, 0.0, hurt)
      iteration, steps = iteration + 1, steps + action[..., 0].numel()
      seconds, success = time.time() - start, float(won.mean())
      if success >= args.enough and iteration % 10 == 0:
        judged, done = judge(agent, env), False
        done = judged >= args.enough
        seen = flat(env.reset(seed=args.seed + iteration)[0])
        best, idle = torch.zeros_like(best), torch.zeros_like(idle)
      done = done or seconds > 60 * args.minutes
      paid, spread = float(reward.sum(0).mean()), float(agent.spread.detach().exp().mean())
      row = (success, float(hurt.mean()), judged, paid, spread)
      write.writerow((args.task, args.seed, steps, round(seconds, 1), *(f"{x:.4g}" for x in row)))
      file.flush()
      if iteration % 10 == 0 or done:
        print(f"{args.task} seed {args.seed}: {steps:.3g} steps, {seconds:.0f} s, success "
              f"{100 * success:.0f} %, damage {100 * row[1]:.0f} %, without spread "
              f"{100 * judged:.0f} %, {paid:.3f} paid, "
              f"spread {spread:.2f}", flush=True)  # fmt: skip


if __name__ == "__main__":
  main()
