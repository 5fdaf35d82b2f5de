"""Learn an exercise from nothing: proximal policy optimisation in one file, with torch alone.

    python docs/tutorials/ppo.py grasp/easy > curve.csv                # a GPU, 1024 worlds
    python docs/tutorials/ppo.py touch/easy --device cpu --worlds 32   # the same, slowly

No expert takes part: the environment pays the change of a potential, which tells the way. The
algorithm is that of Schulman et al. 2017 (10.48550/arXiv.1707.06347), its learning rate adaptive.
"""

import argparse
import time

import gymnasium
import palpate.tasks  # noqa: F401 - registers the exercises
import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

DISCOUNT, LAMBDA, CLIP, EPOCHS, MINIBATCHES = 0.95, 0.95, 0.2, 5, 4  # see docs/training.md
KL, ENTROPY, NOISE = 0.02, 0.004, 0.4  # change of the policy aimed at, in a minibatch
STEPS, SCALE = 8, 10.0  # decisions of an iteration; of rewards, which add up to that
FINE, LEFT = 0.005, 0.05  # the last of the way [m] and of the progress have scales of their own
REPEAT, PACE = 2, 0.4  # control steps of a decision, and share of the rates that it uses
JAWS, GENTLE = 0.1, 0.03  # how far the jaws' target moves at full rate, and is below them [rad]
CLOSED, WIDE = -0.2, 1.0472  # where jaws are told to go by -1 and 1 [rad]
PATIENCE, GAIN = 100, 0.05  # an episode ends after so many decisions, at most, that gain no more
ENOUGH = 0.9  # success without noise that ends the training


class Agent(nn.Module):
  """A policy whose noise depends on what it sees, as its actions do, and a critic."""

  def __init__(self, nseen: int, naction: int):
    """Makes the networks, the policy's with actions near 0."""
    super().__init__()
    self.normal = nn.BatchNorm1d(nseen, eps=1e-6, momentum=None, affine=False)
    self.policy, self.value = (
      nn.Sequential(nn.Linear(nseen, 256), nn.ELU(), nn.Linear(256, 128), nn.ELU(), last)
      for last in (nn.Linear(128, 2 * naction), nn.Linear(128, 1))
    )
    nn.init.normal_(self.policy[-1].weight, std=1e-3)

  def forward(self, rows: torch.Tensor) -> tuple[torch.distributions.Normal, torch.Tensor]:
    """Returns how actions are distributed, and the values."""
    normal = self.normal(rows).clamp(-5, 5)
    mean, noise = self.policy(normal).chunk(2, 1)
    noise = NOISE * noise.clamp(-1, 0.7).exp()
    return torch.distributions.Normal(mean, noise, validate_args=False), self.value(normal)[:, 0]


def look(seen: dict[str, torch.Tensor]) -> torch.Tensor:
  """Returns observations as rows, with the target in the frame of the tip too  (nworld, n)."""
  own = {name: x.flatten(1).float() for name, x in seen.items() if name != "surface"}
  turn, target = own["tip_quat"], own["target"]
  aside = 2 * torch.linalg.cross(turn[:, 1:], target)
  fine = (target - turn[:, :1] * aside + torch.linalg.cross(turn[:, 1:], aside)) / FINE
  return torch.cat([*own.values(), fine.tanh(), ((1 - own["progress"]) / LEFT).tanh()], 1)


def step(env, seen: dict, action: torch.Tensor) -> tuple[dict, torch.Tensor, torch.Tensor]:
  """Acts; returns what is seen, what was paid, and of an episode's end 1 if won, 0 if not, NaN."""
  total, won = torch.zeros_like(action[:, 0]), torch.full_like(action[:, 0], torch.nan)
  for _ in range(REPEAT):
    told = PACE * action.clamp(-1, 1)
    if (jaws := seen.get("gripper")) is not None:
      goal = torch.maximum(jaws[:, 1:2] + JAWS * told[:, 4:], jaws[:, :1] - GENTLE)
      told[:, 4:] = (2 * (goal - CLOSED) / (WIDE - CLOSED) - 1).clamp(-1, 1)
    seen, paid, _, _, info = env.step(told)
    total += SCALE * paid.float() * won.isnan()
    if "final_info" in info:
      over = torch.as_tensor(info["_final_info"], device=won.device) & won.isnan()
      won = torch.where(over, info["final_info"]["success"].float(), won)
  return seen, total, won


@torch.enable_grad()
def update(agent: Agent, adam: torch.optim.Adam, data: list[torch.Tensor]) -> None:
  """Takes some passes over the decisions of an iteration."""
  for _ in range(EPOCHS):
    for rows in torch.randperm(len(data[0]), device=data[0].device).chunk(MINIBATCHES):
      seen, action, before, mean, advantage, value = (each[rows] for each in data)
      policy, guess = agent(seen)
      ratio = (policy.log_prob(action).sum(1) - before).exp()
      advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
      gain = torch.min(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage)
      gain += ENTROPY * policy.entropy().sum(1)
      adam.zero_grad()
      (nn.functional.smooth_l1_loss(guess, value) - gain.mean()).backward()
      nn.utils.clip_grad_norm_(agent.parameters(), 1.0)
      adam.step()
      change = (0.5 * ((policy.mean - mean) / policy.stddev) ** 2).sum(1).mean().item()
      factor = 1 / 1.2 if change > 2 * KL else 1.2 if change < KL / 2 else 1.0
      adam.param_groups[0]["lr"] = min(max(factor * adam.param_groups[0]["lr"], 5e-5), 2e-3)


def judge(agent: Agent, env) -> float:
  """Returns the share of worlds that succeed without noise, up to where it is clear."""
  seen, won = env.reset(seed=1_000_000)[0], torch.tensor(torch.nan)
  while not ((won == 1).float().mean() >= ENOUGH or (won == 0).float().mean() > 1 - ENOUGH):
    seen, _, ended = step(env, seen, agent(look(seen))[0].mean)
    won = torch.where(won.to(ended).isnan(), ended, won)
  return float((won == 1).float().mean())


@torch.no_grad()
def main() -> None:
  """Learns until enough worlds succeed, or the time is over; prints the curve."""
  parser = argparse.ArgumentParser(description="Learns an exercise from nothing.")
  parser.add_argument("task", nargs="?", default="touch/easy")
  for name, most in dict(device="cuda:0", worlds=1024, minutes=5.0, seed=0).items():
    parser.add_argument(f"--{name}", type=type(most), default=most, help="(%(default)s)")
  args = parser.parse_args()
  torch.manual_seed(args.seed)
  start, name = time.time(), f"palpate/{args.task.title().replace('/', '')}-v0"
  env = gymnasium.make_vec(name, num_envs=args.worlds, device=args.device, output="torch")
  seen = env.reset(seed=args.seed)[0]
  agent = Agent(look(seen).shape[1], env.action_space.sample().shape[1]).to(look(seen).device)
  adam = torch.optim.Adam(agent.parameters(), lr=1e-3, fused=True)
  seen, won, _ = step(env, seen, agent(look(seen))[0].mean)  # compiles kernels
  won, lead, idle = torch.zeros(3, len(won), device=won.device)
  made, steps, judged, start = time.time() - start, 0, torch.nan, time.time()
  print("task,seed,made,steps,seconds,success,judged,paid")
  while not (judged >= ENOUGH or time.time() - start > 60 * args.minutes):
    data = []
    for _ in range(STEPS):
      policy, value = agent.eval()(rows := look(seen))
      action = policy.sample()
      seen, paid, ended = step(env, seen, action)
      goes, before = ended.isnan(), policy.log_prob(action).sum(1)
      data.append((rows, action, before, policy.mean, paid, goes.float(), value))
      won, lead, idle = torch.where(goes, won, ended), lead + paid, idle + 1
      lead, idle = (x * (goes & (lead < GAIN)) for x in (lead, idle))
    *told, paid, goes, value = (torch.stack(column) for column in zip(*data, strict=True))
    advantage, gain, then = torch.zeros_like(paid), 0.0, [*value[1:], agent(look(seen))[1]]
    for k in reversed(range(STEPS)):
      advantage[k] = gain = paid[k] - value[k] + DISCOUNT * goes[k] * (then[k] + LAMBDA * gain)
    if steps:  # after the first iteration it knows how large observations are
      update(agent, adam, [x.flatten(0, 1) for x in (*told, advantage, advantage + value)])
    agent.train()(told[0].flatten(0, 1))
    steps, success = steps + REPEAT * goes.numel(), float(won.mean())
    stuck = idle > PATIENCE * (0.3 + 0.7 * torch.rand_like(idle))
    if success >= ENOUGH:
      judged, stuck = judge(agent.eval(), env), idle >= 0
    row = f"{time.time() - start:.1f},{success:.4g},{judged:.4g},{paid.sum(0).mean():.4g}"
    print(f"{args.task},{args.seed},{made:.1f},{steps},{row}", flush=True)
    seen = env.reset(options={"reset_mask": stuck.cpu().numpy()})[0]
    won, lead, idle = (x * ~stuck for x in (won, lead, idle))


if __name__ == "__main__":
  main()
