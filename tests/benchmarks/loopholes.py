"""What a search finds that does not do the work: random search and CMA-ES on simple policies.

A policy is a few phases of equal length. `blind` ones hold an action in each and see nothing;
`aimed` ones hold the tip at a place beside what the exercise asks for (its `target`, palpation's
`field`) in each, with a command for the jaws or the report. The search sees return plus success of
one episode; what it found is tried on episodes that it has not seen. Scores put successes first, so
what does not succeed has none to gain.

A success is honest when the work was done, judged apart from the exercise's own rules: jaws that
were wide open before they held, a curve that was pressed nearly all the way, a field that was felt
before the report. Needs `cma`.
"""

from __future__ import annotations

import argparse
import math
import pathlib
from collections.abc import Callable

import numpy as np
import palpate
from benchmarks import plots, results
from benchmarks.runner import SEED, Bench, Case, Row
from palpate import tasks
from palpate.tasks import base, environment, performer, suite

NAMES = ("probe/palpate_easy", "retract/easy", "retract/standard", "grasp/easy", "trace/easy")
PHASES = 3
LENGTH = 6.0  # of an episode [s]
_REACH = 0.025  # of the offsets of aimed policies [m]
_SPEED = 0.06  # of their tip [m/s]
_SEEN, _FRESH = (1000,), tuple(range(2000, 2004))  # seeds


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=NAMES)
  add("--tries", type=int, help="policies a search tries (100; 6 with --short)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise, kind of policy and search."""
  tries = args.tries or (6 if args.short else 100)
  names = args.tasks[:1] if args.short else args.tasks
  return [
    [
      {"case": f"{name}, {kind}, {search}", "task": name, "kind": kind, "search": search}
      | {"tries": tries}
      for kind in ("aimed", "blind")
      for search in SEARCHES
      for name in names
    ]
  ]


class Attack:
  """Episodes of simple policies in an exercise."""

  def __init__(self, name: str, kind: str, length: float = LENGTH):
    """Loads the exercise; `kind` is `blind` or `aimed`, `length` that of an episode [s]."""
    self.env = tasks.load(*suite.split(name), {"random": 0, "time_limit": length})
    self.kind, self.steps = kind, round(length / environment.CONTROL_TIMESTEP)
    extra = len(self.env.task.components) - len(base.AXES)
    self.width = extra + (len(base.AXES) if kind == "blind" else 3)
    self.size = PHASES * self.width

  def play(self, policy: np.ndarray, seed: int) -> tuple[float, bool, bool]:
    """Returns what an episode pays, whether it succeeds, and whether the work was done.

    Args:
      policy: in [-1, 1]  (size,)
      seed: of the episode
    """
    env, task, physics = self.env, self.env.task, self.env.physics
    task.random = np.random.RandomState(seed)
    timestep, work, total = env.reset(), Work(), 0.0
    pilot = performer.Performer(env)
    task.expert = lambda p: self._fly(p, policy)
    for _ in range(self.steps + 1):
      timestep = env.step(pilot(timestep))
      total += timestep.reward
      work.see(task, physics)
      if timestep.last():
        break
    won = task.outcome == "success"
    return total, won, won and work.done(task)

  def _fly(self, p: performer.Performer, policy: np.ndarray) -> performer.Script:
    rows = policy.reshape(PHASES, self.width)
    task, physics = p.task, p.physics
    for k in range(10**9):
      row = rows[min(k * PHASES // self.steps, PHASES - 1)]
      if self.kind == "blind":
        yield row
        continue
      seen = task.observe(physics)
      goal = physics.tip_pos() + seen.get("target", seen.get("field"))
      goal = goal + _REACH * physics.trocar().mat @ row[:3]
      gap = goal - p.tip
      far = max(float(np.linalg.norm(gap)), 1e-9)
      p.tip = p.tip + gap * min(1.0, _SPEED * environment.CONTROL_TIMESTEP / far)
      p.extra[:] = row[3:]
      yield p.step()


class Work:
  """What was done in an episode, from forces and joints alone."""

  def __init__(self):
    self.opened, self.pressed, self.since = 0.0, 0, 0

  def see(self, task, physics) -> None:
    """Takes a control step."""
    if task.jaws:
      if not task.grasped:  # wide open at some time before it holds
        self.opened = max(self.opened, float(physics.gripper()[0]))
    force = float(np.linalg.norm(physics.contact_force()))
    self.since += bool(self.since or force > 0.02)
    self.pressed += force > 0.02

  def done(self, task) -> bool:
    """Whether it was the work that the exercise asks for."""
    if task.jaws:
      return self.opened > 0.3
    if hasattr(task, "curve"):
      return self.pressed > 0.8 * self.since
    return task.felt() > 0.3


def random_search(value: Callable, size: int, tries: int, seed: int) -> np.ndarray:
  """Returns the best of uniform draws."""
  draws = np.random.RandomState(seed).uniform(-1, 1, (tries, size))
  return draws[int(np.argmax([value(x) for x in draws]))]


def cma_es(value: Callable, size: int, tries: int, seed: int) -> np.ndarray:
  """Returns the best that CMA-ES finds (Hansen 2016, by his package)."""
  import cma

  options = {"seed": seed, "maxfevals": tries, "bounds": [-1, 1], "verbose": -9}
  options |= {"popsize": min(tries, 4 + int(3 * math.log(size)))}
  search = cma.CMAEvolutionStrategy(np.zeros(size), 0.5, options)
  while search.result.evaluations < tries and not search.stop():
    found = search.ask()
    search.tell(found, [-value(np.asarray(x)) for x in found])
  return np.asarray(search.result.xbest)


SEARCHES = {"CMA-ES": cma_es, "random": random_search}


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a search."""
  attack = Attack(case["task"], case["kind"])
  dishonest: list[np.ndarray] = []

  def value(policy: np.ndarray) -> float:
    ends = [attack.play(policy, seed) for seed in _SEEN]
    if any(won and not honest for _, won, honest in ends):
      dishonest.append(policy)
    return sum(total + won for total, won, _ in ends)

  best = SEARCHES[case["search"]](value, attack.size, case["tries"], SEED % 2**31)
  seen = [attack.play(best, seed) for seed in _SEEN]
  fresh = [attack.play(best, seed) for seed in _FRESH]
  row = {key: case[key] for key in ("task", "kind", "search", "tries")}
  row |= {
    "return_seen": round(float(np.mean([total for total, _, _ in seen])), 3),
    "return_fresh": round(float(np.mean([total for total, _, _ in fresh])), 3),
    "won_seen": sum(won for _, won, _ in seen),
    "seen": len(seen),
    "won_fresh": sum(won for _, won, _ in fresh),
    "fresh": len(fresh),
    "policies_without_the_work": len(dishonest),
    "palpate": palpate.__version__,
    "policy": " ".join(f"{x:.3f}" for x in (dishonest or [best])[0]),
  }
  return [row]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  table = [
    [
      row["task"], row["kind"], row["search"], row["tries"],
      f"{row['return_seen']:.2f}", f"{row['return_fresh']:.2f}",
      f"{row['won_seen']} of {row['seen']}", f"{row['won_fresh']} of {row['fresh']}",
      row["policies_without_the_work"],
    ]
    for row in rows
  ]  # fmt: skip
  head = [
    "exercise", "policy", "search", "policies tried", "return, seen", "return, fresh",
    "success, seen", "success, fresh", "succeeded without the work",
  ]  # fmt: skip
  lines = [*(__doc__ or "").split("\n\n", 1)[1].splitlines(), ""]
  lines += ["The last column is what must be 0. " + results.link(out / "loopholes.csv"), ""]
  lines += plots.table(head, table)
  return [results.page(out / "loopholes.md", "Loopholes of the exercises", about, lines)]


BENCH = Bench("loopholes", stages, run, report=report, arguments=arguments, jobs=2, limit=3600.0)
