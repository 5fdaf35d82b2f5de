"""Learns `touch/easy` with Soft Actor-Critic of Stable-Baselines3, on one thread of the CPU.

    pip install -e '.[learn]'
    python tests/benchmarks/learning.py -o tests/benchmarks/results

writes learning.csv, the mean return and the success of evaluations on the way, beside those of
random actions, and the curve learning.png. The exercise is as it comes, with its dense reward and
its time limit of 10 s. What the agent adds are ordinary wrappers: it sees the state observations of
`OBSERVATIONS`, normalised, and decides every 0.08 s. Training and evaluation draw their episodes
from different seeds. Two runs on one machine give the same numbers but for the times.
"""

import argparse
import csv
import pathlib
import time

import gymnasium
import numpy as np
import palpate  # noqa: F401, registers the environments
import torch
from gymnasium.wrappers import FilterObservation, FlattenObservation
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

ID = "palpate/TouchEasy-v0"
OBSERVATIONS = (
  "joints", "joint_vel", "drive", "tip_vel", "contact_force", "peak_force", "progress", "target",
  "normal",
)  # fmt: skip
REPEAT = 4  # control steps a decision
SEEDS = 10_000  # the evaluation's episodes start here; training draws its own from --seed


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
  """Returns mean and spread of the return, the success and the mean length of episodes."""
  returns, wins, lengths, damage = [], 0, [], 0
  for seed in range(SEEDS, SEEDS + episodes):
    observation, info = env.reset(seed=seed)
    total, steps, over = 0.0, 0, False
    while not over:
      observation, reward, terminated, truncated, info = env.step(act(observation))
      total, steps, over = total + reward, steps + 1, terminated or truncated
    returns.append(total)
    lengths.append(steps * REPEAT * 0.02)
    wins += info["success"]
    damage += info["outcome"] == "damage"
  return {
    "episodes": episodes,
    "return_mean": round(float(np.mean(returns)), 3),
    "return_sd": round(float(np.std(returns, ddof=1)), 3),
    "success_percent": round(100 * wins / episodes, 1),
    "damage_percent": round(100 * damage / episodes, 1),
    "time_s_mean": round(float(np.mean(lengths)), 2),
  }


def main():
  """Trains, evaluates on the way and writes table and curve."""
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  add = parser.add_argument
  add("-o", "--out", type=pathlib.Path, required=True, help="folder of learning.csv and .png")
  add("--decisions", type=int, default=30_000, help="of training (%(default)s)")
  add("--every", type=int, default=5_000, help="decisions between evaluations (%(default)s)")
  add("--episodes", type=int, default=50, help="of the first and last evaluation (%(default)s)")
  add("--seed", type=int, default=0, help="of the agent and its episodes (%(default)s)")
  args = parser.parse_args()
  torch.set_num_threads(1)
  watched = make()
  space = watched.action_space
  space.seed(args.seed)
  rows, training = [], 0.0

  def note(who: str, decisions: int, result: dict):
    row = {"policy": who, "decisions": decisions, "training_s": round(training, 1), **result}
    print(row, flush=True)
    rows.append(row)

  note("random", 0, evaluate(lambda _: space.sample(), watched, args.episodes))
  env = VecNormalize(DummyVecEnv([make]), norm_reward=False, clip_obs=10.0)
  agent = SAC(
    "MlpPolicy", env, seed=args.seed, device="cpu", gamma=0.98, learning_rate=1e-3,
    learning_starts=1_000, batch_size=256, policy_kwargs={"net_arch": [128, 128]},
  )  # fmt: skip

  def act(observation):
    return agent.predict(env.normalize_obs(observation), deterministic=True)[0]

  done = 0
  while done < args.decisions:
    more = min(args.every, args.decisions - done)
    before = time.perf_counter()
    agent.learn(more, reset_num_timesteps=done == 0)
    training += time.perf_counter() - before
    done += more
    last = done >= args.decisions
    note("SAC", done, evaluate(act, watched, args.episodes if last else 10))
  args.out.mkdir(parents=True, exist_ok=True)
  with (args.out / "learning.csv").open("w", newline="") as file:
    writer = csv.DictWriter(file, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


if __name__ == "__main__":
  main()
