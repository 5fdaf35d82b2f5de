"""Loopholes of the exercises: what policies find that look at nothing, searched for return.

Their actions are the same in every episode: one a component at a few times, with lines between.
`constant` has one time, `random` tries as many at random as `cmaes` (CMA-ES; Hansen 2016,
arXiv:1604.00772) searches with. Each is searched for on a few seeds and judged on fresh ones: what
succeeds there without looking is chance, or a loophole. Success with cost is one too.
"""

from __future__ import annotations

import argparse
import pathlib

import numpy as np
import palpate
from benchmarks import plots, results
from benchmarks.runner import SEED, Bench, Case, Row
from palpate import tasks
from palpate.tasks import suite

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]
KINDS = ("constant", "random", "cmaes")
TIMES = 7  # of the actions, evenly over an episode
FRESH = 1000  # first of the seeds that a policy is judged on


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  easy = ["/".join(pair) for pair in tasks.EASY]
  add("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=easy)
  add("--kinds", nargs="+", choices=KINDS, default=KINDS)
  add("--tries", type=int, help="policies (200; 6 with --short)")
  add("--seeds", type=int, help="to search on (3; 1 with --short)")
  add("--episodes", type=int, help="fresh ones, to judge by (20; 2 with --short)")
  add("--seconds", type=float, default=6.0, help="of an episode, at most (%(default)s)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise and kind."""
  keys = {"seconds": args.seconds, "tries": args.tries or (6 if args.short else 200)}
  keys |= {"seeds": args.seeds or (1 if args.short else 3)}
  keys |= {"episodes": args.episodes or (2 if args.short else 20)}
  return [
    [
      {"case": f"{task}, {kind}", "task": task, "kind": kind} | keys
      for task in args.tasks[: 1 if args.short else None]
      for kind in args.kinds
    ]
  ]


def play(env, plan: np.ndarray, seed: int) -> tuple[float, float, str | None]:
  """Returns return, cost and outcome of an episode with these actions  (times, components)."""
  env.task.random = np.random.RandomState(seed)
  timestep, steps = env.reset(), 0
  at = np.linspace(0, 1, len(plan))
  most = round(env.task.seconds / env.control_timestep())
  total = cost = 0.0
  while not timestep.last():
    now = np.array([np.interp(steps / most, at, component) for component in plan.T])
    timestep = env.step(np.clip(now, -1, 1))
    total, cost, steps = total + timestep.reward, cost + env.task.cost.total, steps + 1
  return total, cost, env.task.outcome


def search(kind: str, shape: tuple[int, int], tries: int, worth) -> np.ndarray:
  """Returns the best of so many plans."""
  draw = np.random.RandomState(SEED)
  best, found = -np.inf, np.zeros(shape)

  def ask(plan: np.ndarray) -> float:
    nonlocal best, found
    value = worth(plan)
    if value > best:
      best, found = value, plan
    return value

  if kind != "cmaes":
    for _ in range(tries):
      ask(draw.uniform(-1, 1, (1, shape[1]) if kind == "constant" else shape))
    return found
  import cmaes  # pip install cmaes

  size = shape[0] * shape[1]
  optimizer = cmaes.CMA(np.zeros(size), 0.5, np.array([[-1.0, 1.0]] * size), seed=SEED)
  for _ in range(max(1, tries // optimizer.population_size)):
    plans = [optimizer.ask() for _ in range(optimizer.population_size)]
    optimizer.tell([(plan, -ask(plan.reshape(shape))) for plan in plans])
  return found


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of an exercise and a kind of policy."""
  env = tasks.load(*suite.split(case["task"]), {"random": 0, "time_limit": case["seconds"]})
  env.task.seconds = case["seconds"]
  shape = (TIMES, len(env.task.components))

  def worth(plan: np.ndarray) -> float:
    return float(np.mean([play(env, plan, seed)[0] for seed in range(case["seeds"])]))

  plan = search(case["kind"], shape, case["tries"], worth)
  fresh = [play(env, plan, FRESH + seed) for seed in range(case["episodes"])]
  good = [cost for _, cost, outcome in fresh if outcome == "success"]
  row = {
    "task": case["task"],
    "kind": case["kind"],
    "tries": case["tries"],
    "return_searched": round(worth(plan), 3),
    "return_fresh": round(float(np.mean([total for total, _, _ in fresh])), 3),
    "success_percent": round(100 * len(good) / len(fresh), 1),
    "damage_percent": round(100 * sum(end == "damage" for _, _, end in fresh) / len(fresh), 1),
    "success_cost_max": round(max(good, default=0.0), 3),
    "palpate": palpate.__version__,
  }
  return [row]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  keys = ("return_searched", "return_fresh", "success_percent", "damage_percent")
  table = [[r["task"], r["kind"], r["tries"], *(r[key] for key in keys)] for r in rows]
  head = ["exercise", "policy", "tries", "return, searched", "fresh", "success %", "damage %"]
  lines = [
    "Policies that look at nothing: `constant` actions, `random` ones in time, and the best that "
    "CMA-ES finds, searched for return on a few seeds and judged on fresh ones. "
    + results.link(out / "loopholes.csv"),
    "",
    *plots.table(head, table),
  ]
  return [results.page(out / "loopholes.md", "What the exercises give away", about, lines)]


BENCH = Bench("loopholes", stages, run, report=report, arguments=arguments, limit=7200.0)
