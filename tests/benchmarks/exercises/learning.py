"""Learns `touch/easy` with Soft Actor-Critic of Stable-Baselines3, on one thread of the CPU.

Mean return and success of evaluations on the way beside those of random actions, and the curve
learning.png; needs `pip install -e '.[learn]'`.

The exercise is as it comes, with its dense reward and its time limit of 10 s. What the agent adds
are ordinary wrappers: it sees the state observations of `OBSERVATIONS`, normalised, and decides
every 0.08 s. Training and evaluation draw their episodes from different seeds; the evaluations' are
the same each time.
"""

import argparse
import pathlib
import time

import gymnasium
import numpy as np
import palpate.tasks  # registers the environments
import torch
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from gymnasium.wrappers import FilterObservation, FlattenObservation
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

ID = "palpate/TouchEasy-v0"
OBSERVATIONS = (
  "joints", "joint_vel", "drive", "tip_vel", "contact_force", "peak_force", "progress", "target",
  "normal",
)  # fmt: skip
REPEAT = 4  # control steps a decision
GAMMA = 0.98  # a horizon of 4 s
SEEDS = 10_000  # the evaluations' episodes start here; training draws its own from --seed


class Repeat(gymnasium.Wrapper):
  """Repeats each action and adds up the rewards."""

  def step(self, action):
    """Takes REPEAT control steps, fewer at the end of an episode."""
    total = 0.0
    for _ in range(REPEAT):
      observation, reward, terminated, truncated, info = self.env.step(action)
      total += float(reward)
      if terminated or truncated:
        break
    return observation, total, terminated, truncated, info


def make() -> gymnasium.Env:
  """Returns the exercise as the agent sees it."""
  env = gymnasium.make(ID, disable_env_checker=True)
  return FlattenObservation(FilterObservation(Repeat(env), OBSERVATIONS))


def evaluate(act, env: gymnasium.Env, episodes: int) -> dict:
  """Returns return, success, damage and duration of episodes; `act` maps observation to action."""
  returns, times, outcomes = [], [], []
  for seed in range(SEEDS, SEEDS + episodes):
    observation, info = env.reset(seed=seed)
    total, over = 0.0, False
    while not over:
      observation, reward, terminated, truncated, info = env.step(act(observation))
      total, over = total + float(reward), terminated or truncated
    returns.append(total)
    times.append(env.unwrapped.environment.physics.time())
    outcomes.append(info["outcome"])
  return {
    "episodes": episodes,
    "return_mean": round(float(np.mean(returns)), 3),
    "return_sd": round(float(np.std(returns, ddof=1)), 3),
    "success_percent": round(100 * outcomes.count("success") / episodes, 1),
    "damage_percent": round(100 * outcomes.count("damage") / episodes, 1),
    "time_s_mean": round(float(np.mean(times)), 2),
  }


def train(args: argparse.Namespace):
  """Yields a row for the random policy and for the agent each time it is evaluated."""
  torch.set_num_threads(1)
  watched, training = make(), 0.0
  space = watched.action_space
  space.seed(args.seed)

  def row(policy: str, decisions: int, result: dict) -> dict:
    versions = {"palpate": palpate.__version__, "seed": args.seed}
    head = {"policy": policy, "decisions": decisions, "simulated_s": decisions * REPEAT * 0.02}
    return head | {"training_s": round(training, 1)} | result | versions

  yield row("random", 0, evaluate(lambda _: space.sample(), watched, args.episodes))
  # Rewards add up to 1 over an episode: normalised, SAC's entropy does not drown them.
  env = VecNormalize(DummyVecEnv([make]), gamma=GAMMA)
  agent = SAC(
    "MlpPolicy", env, seed=args.seed, device="cpu", gamma=GAMMA, learning_rate=1e-3,
    learning_starts=1_000, ent_coef="auto_0.1", policy_kwargs={"net_arch": [128, 128]},
  )  # fmt: skip

  def act(observation: np.ndarray) -> np.ndarray:
    return agent.predict(env.normalize_obs(observation), deterministic=True)[0]

  yield row("SAC", 0, evaluate(act, watched, args.episodes))
  done = 0
  while done < args.decisions:
    more = min(args.every, args.decisions - done)
    before = time.perf_counter()
    agent.learn(more, reset_num_timesteps=done == 0)
    training += time.perf_counter() - before
    done += more
    yield row("SAC", done, evaluate(act, watched, args.episodes if done >= args.decisions else 20))


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--decisions", type=int, default=15_000, help="of training (%(default)s)")
  add("--every", type=int, default=2_500, help="decisions between evaluations (%(default)s)")
  add("--episodes", type=int, default=50, help="of the first and last evaluation (%(default)s)")
  add("--seed", type=int, default=0, help="of the agent and its episodes (%(default)s)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns one case an agent."""
  keys = {k: getattr(args, k) for k in ("decisions", "every", "episodes", "seed")}
  return [[{"case": f"seed-{args.seed}"} | keys]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Trains, and returns a row an evaluation."""
  rows = []
  for row in train(argparse.Namespace(**case)):
    print(row["policy"], row["decisions"], row["return_mean"], flush=True)
    rows.append(row)
  return rows


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  agent = [r for r in rows if r["policy"] == "SAC"]
  first = next((r for r in agent if r["success_percent"] >= 95), None)
  lines = [f"Random actions succeed in {rows[0]['success_percent']:.0f} % of the episodes."]
  if first:
    lines.append(f"SAC succeeds in {first['success_percent']:.0f} % after "
                 f"{first['simulated_s'] / 60:.0f} minutes of practice.")  # fmt: skip
  last = agent[-1]
  return [*lines, f"At the end, after {last['simulated_s'] / 60:.0f} simulated minutes and "
          f"{last['training_s'] / 60:.0f} minutes of training, it succeeds in "
          f"{last['success_percent']:.0f} % of {last['episodes']}."]  # fmt: skip


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Draws return and success over training."""
  from matplotlib.figure import Figure

  figure = Figure((6.4, 3.0), layout="constrained")
  for k, (key, label) in enumerate((("return_mean", "return"), ("success_percent", "success [%]"))):
    ax = figure.add_subplot(1, 2, k + 1)
    agent = [r for r in rows if r["policy"] == "SAC"]
    ax.plot([r["simulated_s"] / 60 for r in agent], [r[key] for r in agent], "o-", label="SAC")
    ax.axhline(rows[0][key], color="#8a8f98", linestyle="--", label="random actions")
    ax.set_xlabel("practice, simulated [min]")
    ax.set_ylabel(label)
    ax.spines[["top", "right"]].set_visible(False)
    ax.grid(color="#e4e7ec")
  figure.axes[0].legend(loc="lower right", frameon=False)
  path = out / "learning.png"
  figure.savefig(path, dpi=100)
  return [path, write(rows, about, out)]


def write(rows: list[Row], about: dict, out: pathlib.Path) -> pathlib.Path:
  """Writes the page and returns its path."""
  table = [
    [r["policy"], f"{r['simulated_s']:.0f}", f"{r['training_s']:.0f}", r["episodes"],
     f"{r['return_mean']:.2f} ± {r['return_sd']:.2f}", f"{r['success_percent']:.0f} %",
     f"{r['damage_percent']:.0f} %"]
    for r in rows
  ]  # fmt: skip
  head = ["policy", "simulated [s]", "training [s]", "episodes", "return", "success", "damage"]
  lines = [
    "Soft Actor-Critic of Stable-Baselines3 with the dense reward, evaluated on targets that it "
    "has not seen, beside random actions. " + results.link(out / "learning.csv"),
    "",
    *plots.table(head, table),
  ]
  picture = out / "learning.png"
  return results.page(out / "learning.md", "Learning `touch/easy`", about, lines, finding(rows),
                      picture if picture.exists() else None)  # fmt: skip


BENCH = Bench("learning", stages, run, report=report, arguments=arguments)
