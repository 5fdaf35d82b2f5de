"""What a search finds that does not do the work: random search and CMA-ES against reward and score.

A policy is a few phases of equal length. `blind` ones hold an action in each and see nothing;
`aimed` ones hold the tip at a place beside what the exercise asks for (its `target`, palpation's
`field`) in each, with a command for the jaws or the report; `styled` ones do the expert's script in
a manner of their own: how it trembles, overshoots, waits, presses, strays, hurries and reacts.

The search sees one episode: its return and success (`reward`), or its score and, until it succeeds,
its best progress (`score`). What it found is tried on episodes that it has not seen.

A success is honest when the work was done, judged apart from the exercise's own rules: contact as
long and as often as the exercise has targets, jaws that were wide open before they held, a curve
that was pressed on or cut nearly everywhere, a strip that was touched for two seconds, a field that
was felt before the report, a hook that touched for half a second. What scores above the expert in
the same episode is counted, with the categories of the score that it is better in. Needs `cma`.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import pathlib
import time
from collections.abc import Callable

import numpy as np
import palpate
from benchmarks import plots, results
from benchmarks.runner import SEED, Bench, Case, Row
from palpate import tasks
from palpate.tasks import suite
from palpate.tasks.core import episode, instrument, performer
from palpate.tasks.core.environment import CONTROL_TIMESTEP
from palpate.tasks.people import score

NAMES = ("touch/easy", "probe/easy", "probe/palpate_easy", "grasp/easy", "trace/easy")
NAMES += ("retract/easy", "cut/easy", "dissect/easy", "tease/easy", "bimanual/easy")
KINDS = ("aimed", "blind", "styled")
PHASES = 3
LENGTH = 6.0  # of an episode of `blind` and `aimed` policies, for each hand [s]
_REACH = 0.025  # of the offsets of aimed policies [m]
_SPEED = 0.06  # of their tip [m/s]
_LEAP = 10  # points of a curve that follow one another in two control steps, at most
_CONTACT, _STROKES = 0.02, 2.0  # force of a contact [N], time of that to free a strip [s]
_GRAZE, _HOOKED = 0.005, 0.5  # the same of a hook
_SEEN, _FRESH = 1000, tuple(range(2000, 2004))  # seeds
# What `styled` policies may be, from -1 to 1; the expert is inside.
MANNERS = {
  "tremor": (0.0, 0.001),
  "overshoot": (0.0, 0.5),
  "delay": (0.0, 0.6),
  "force": (0.3, 3.0),
  "detour": (0.0, 0.6),
  "speed": (0.5, 8.0),
  "reaction": (0.0, 0.2),
}


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  names = ["/".join(pair) for pair in tasks.ALL_TASKS]
  add("--tasks", nargs="+", metavar="TASK", choices=names, default=NAMES)
  add("--kinds", nargs="+", metavar="KIND", choices=KINDS, default=KINDS)
  add("--tries", type=int, help="policies a search tries (100; 6 with --short)")
  add("--seconds", type=float, default=math.inf, help="after which a search ends (never)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise, kind of policy, search and what it is against."""
  tries = args.tries or (6 if args.short else 100)
  names = args.tasks[:1] if args.short else args.tasks
  return [
    [
      {"case": f"{name}, {kind}, {search}, {aim}", "task": name, "kind": kind, "search": search}
      | {"aim": aim, "tries": tries, "seconds": args.seconds}
      for search, aim in PAIRS
      for kind in args.kinds
      for name in names
    ]
  ]


@dataclasses.dataclass(frozen=True)
class End:
  """How an episode ended.

  Attributes:
    paid: its return
    best: its best progress
    won: whether it succeeded
    honest: whether it did the work
    points: its score; `score.FLOOR` or less without success
    proficient: whether it counts as that
    group: category of the score -> mean z [-]
  """

  paid: float
  best: float
  won: bool
  honest: bool
  points: float
  proficient: bool
  group: dict[str, float]

  def worth(self, aim: str) -> float:
    """Returns what a search sees."""
    if aim == "reward":
      return self.paid + self.won
    return self.points if self.won else self.points + 5 * self.best


class Attack:
  """Episodes of simple policies in an exercise."""

  def __init__(self, name: str, kind: str, length: float = LENGTH):
    """Loads the exercise; `kind` is one of `KINDS`, `length` that of an episode [s]."""
    hands = 1 + (suite.split(name) in suite.BIMANUAL)
    options = {} if kind == "styled" else {"time_limit": hands * length}
    self.env = tasks.load(*suite.split(name), {"random": 0, **options})
    self.name, self.kind, self.steps = name, kind, round(hands * length / CONTROL_TIMESTEP)
    extra = len(self.env.task.components) - hands * len(instrument.AXES)
    self.width = extra + hands * (len(instrument.AXES) if kind == "blind" else 3)
    self.size = len(MANNERS) if kind == "styled" else PHASES * self.width
    self._script = self.env.task.expert

  def play(self, policy: np.ndarray | None, seed: int) -> End:
    """Returns how an episode ends; `policy` is in [-1, 1]  (size,), or None for the expert."""
    env, task, work = self.env, self.env.task, Work()
    style = performer.EXPERT
    task.expert = self._script
    if policy is None:
      pass
    elif self.kind == "styled":
      shares = (np.asarray(policy) + 1) / 2
      low, high = np.array(list(MANNERS.values())).T
      drawn = (low + shares * (high - low)).tolist()
      style = performer.Style(**dict(zip(MANNERS, drawn, strict=True)))
    else:
      task.expert = lambda p: self._fly(p, policy)
    act = performer.Performer(env, style)
    recording = episode.run(env, act, seed, watch=lambda env: work.see(env.task, env.physics))
    won = recording.outcome == score.SUCCESS
    found = score.score(
      recording.metrics(), score.reference(self.name) or {}, recording.info["outcome"]
    )
    return End(
      paid=recording.info["return"],
      best=task.best,
      won=won,
      honest=won and work.done(task),
      points=float(found.composite),
      proficient=found.proficient,
      group=found.group,
    )

  def _fly(self, p: performer.Performer, policy: np.ndarray) -> performer.Script:
    rows = np.asarray(policy).reshape(PHASES, self.width)
    hands = ((p, ("target", "field")), (p.other, ("hook_front",)))
    for k in range(10**9):
      row = rows[min(k * PHASES // self.steps, PHASES - 1)]
      if self.kind == "blind":
        yield row
        continue
      seen, action = p.task.observe(p.physics), []
      for mover, goals in hands:
        if mover is None:
          continue
        goal = mover.hand.tip_pos() + next(seen[name] for name in goals if name in seen)
        gap = goal + _REACH * mover.hand.trocar().mat @ row[:3] - mover.tip
        far = max(float(np.linalg.norm(gap)), 1e-9)
        mover.tip = mover.tip + gap * min(1.0, _SPEED * CONTROL_TIMESTEP / far)
        mover.extra[:] = row[3 : 3 + len(mover.extra)]
        row = row[3 + len(mover.extra) :]
        action.append(mover.step())
      yield np.concatenate(action)


class Work:
  """What was done in an episode, from forces and joints alone."""

  def __init__(self):
    self.opened, self.pressed, self.hooked, self.touches, self._touching = 0.0, 0, 0, 0, False
    self.places: set[int] = set()  # points of a curve that the tip went by as it pressed
    self._last = -1  # of these, -1 where it did not press

  def see(self, task, physics) -> None:
    """Takes a control step."""
    if task.jaws and not task.grasped:  # wide open at some time before it holds
      self.opened = max(self.opened, float(physics.gripper()[0]))
    touching = physics.peak_force > _CONTACT
    self.touches += touching and not self._touching
    self._touching = touching
    self.pressed += touching
    if physics.second:
      self.hooked += float(np.linalg.norm(physics.second.tissue_force())) > _GRAZE
    near = -1
    if touching and hasattr(task, "curve"):
      off = getattr(task, "now", task.curve) - physics.tip_pos()
      near = int(np.linalg.norm(off, axis=1).argmin())
      first = self._last if 0 <= self._last and abs(near - self._last) < _LEAP else near
      self.places.update(range(min(first, near), max(first, near) + 1))
    self._last = near

  def done(self, task) -> bool:
    """Whether it was the work that the exercise asks for."""
    if task.jaws:
      alone = not task.second or self.hooked * task.control_timestep > _HOOKED
      return self.opened > 0.3 and alone
    if hasattr(task, "curve"):
      return len(self.places) > 0.8 * len(task.curve)
    if hasattr(task, "freed"):
      return self.pressed * task.control_timestep > _STROKES
    if hasattr(task, "felt"):
      return task.felt > 0.3
    each = getattr(task, "hold", 0.08) / task.control_timestep
    return self.touches >= task.targets and self.pressed >= 0.9 * each * task.targets


def random_search(value: Callable, size: int, tries: int, seed: int) -> None:
  """Tries uniform draws."""
  for policy in np.random.RandomState(seed).uniform(-1, 1, (tries, size)):
    value(policy)


def cma_es(value: Callable, size: int, tries: int, seed: int) -> None:
  """Tries what CMA-ES asks for (Hansen 2016, by his package)."""
  import cma

  options = {"seed": seed, "maxfevals": tries, "bounds": [-1, 1], "verbose": -9}
  options |= {"popsize": min(tries, 4 + int(3 * math.log(size)))}
  search = cma.CMAEvolutionStrategy(np.zeros(size), 0.5, options)
  while search.result.evaluations < tries and not search.stop():
    found = search.ask()
    search.tell(found, [-value(np.asarray(x)) for x in found])


SEARCHES = {"CMA-ES": cma_es, "random": random_search}
# Random search tries the same whatever it is against.
PAIRS = (("CMA-ES", "reward"), ("CMA-ES", "score"), ("random", "reward"))


class OutOfTimeError(Exception):
  """A search has had its seconds."""


class Log:
  """What a search has tried."""

  def __init__(self, attack: Attack, aim: str, seconds: float = math.inf):
    self.attack, self.aim = attack, aim
    self.tried: list[tuple[np.ndarray, End]] = []
    self._seconds, self._start = seconds, 0.0

  def __call__(self, policy: np.ndarray) -> float:
    """Returns what a policy is worth."""
    if self.tried and time.monotonic() - self._start > self._seconds:
      raise OutOfTimeError
    self._start = self._start or time.monotonic()
    end = self.attack.play(policy, _SEEN)
    self.tried.append((policy, end))
    return end.worth(self.aim)

  @property
  def best(self) -> tuple[np.ndarray, End]:
    """The policy that is worth most, and how it ended."""
    return max(self.tried, key=lambda pair: pair[1].worth(self.aim))


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a search."""
  attack = Attack(case["task"], case["kind"])
  log = Log(attack, case["aim"], case["seconds"])
  try:
    SEARCHES[case["search"]](log, attack.size, case["tries"], SEED % 2**31)
  except OutOfTimeError:
    pass
  policy, seen = log.best
  fresh = [attack.play(policy, seed) for seed in _FRESH]
  expert = Attack(case["task"], "styled")  # has all the time that there is
  experts = [expert.play(None, seed) for seed in _FRESH] if any(end.won for end in fresh) else []
  above = [pair for pair in zip(fresh, experts, strict=False) if pair[0].points > pair[1].points]
  better = [k for end, expert in above for k, z in end.group.items() if z > expert.group[k]]
  ends = [end for _, end in log.tried] + fresh
  fakes = [policy for policy, end in log.tried if end.won and not end.honest]
  fakes += [policy for end in fresh if end.won and not end.honest]
  row = {key: case[key] for key in ("task", "kind", "search", "aim")}
  row |= {
    "tried": len(log.tried),
    "return_seen": round(seen.paid, 3),
    "return_fresh": round(float(np.mean([end.paid for end in fresh])), 3),
    "score_seen": round(seen.points, 2),
    "score_fresh": round(float(np.mean([end.points for end in fresh])), 2),
    "score_expert": round(float(np.mean([end.points for end in experts] or math.nan)), 2),
    "above_expert": len(above),
    "better_in": " ".join(dict.fromkeys(better)),
    "proficient_fresh": sum(end.proficient for end in fresh),
    "won_seen": int(seen.won),
    "won_fresh": sum(end.won for end in fresh),
    "fresh": len(fresh),
    "most_without_success": round(max((e.paid for e in ends if not e.won), default=math.nan), 3),
    "least_with_success": round(min((e.paid for e in ends if e.won), default=math.nan), 3),
    "failures_with_a_score": sum(
      not end.won and (end.points > score.FLOOR or end.proficient) for end in ends
    ),
    "policies_without_the_work": len(fakes),
    "palpate": palpate.__version__,
    "policy": " ".join(f"{x:.3f}" for x in (fakes or [policy])[0]),
  }
  return [row]


def _extreme(rows: list[Row], key: str, pick) -> float:
  return pick((v for row in rows if math.isfinite(v := float(row[key]))), default=math.nan)


def _sum(rows: list[Row], key: str) -> int:
  return sum(int(row[key]) for row in rows)


def _paid(rows: list[Row]) -> tuple[float, float]:
  """Returns the most that was paid without success, and the least with it."""
  return _extreme(rows, "most_without_success", max), _extreme(rows, "least_with_success", min)


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  by_task = {task: [r for r in rows if r["task"] == task] for task in {r["task"]: 0 for r in rows}}
  over = [task for task, mine in by_task.items() if np.greater_equal(*_paid(mine))]
  return [
    f"Of {_sum(rows, 'tried')} policies that a search tried "
    f"{_sum(rows, 'policies_without_the_work')} succeeded without the work.",
    f"{_sum(rows, 'failures_with_a_score')} failures had a score, and "
    f"{_sum(rows, 'above_expert')} successes one above the expert's in that episode.",
    f"Failure was paid as much as some success in {len(over)} of {len(by_task)} exercises"
    f"{': ' * bool(over)}{', '.join(over)}.",
  ]


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page: a line an exercise and kind of policy, of all its searches."""
  groups: dict[tuple[str, str], list[Row]] = {}
  for row in sorted(rows, key=lambda row: (row["task"], KINDS.index(row["kind"]))):
    groups.setdefault((row["task"], row["kind"]), []).append(row)

  def told(value: float) -> str:
    return f"{value:.2f}" if math.isfinite(value) else "-"

  table = [
    [
      *group, _sum(mine, "tried"), f"{_sum(mine, 'won_fresh')} of {_sum(mine, 'fresh')}",
      told(_extreme(mine, "score_fresh", max)), told(_extreme(mine, "score_expert", min)),
      _sum(mine, "above_expert"), " ".join(row["better_in"] for row in mine).strip(),
      *map(told, _paid(mine)),
      _sum(mine, "failures_with_a_score"), _sum(mine, "policies_without_the_work"),
    ]
    for group, mine in groups.items()
  ]  # fmt: skip
  head = [
    "exercise", "policy", "tried", "success, fresh", "best score, fresh", "the expert's",
    "above it", "better in", "most paid without success", "least with", "failures with a score",
    "successes without the work",
  ]  # fmt: skip
  lines = [
    *(__doc__ or "").split("\n\n", 1)[1].splitlines(),
    "What is paid without success must be less than what is paid with it. " + results.link(path),
    "",
    *plots.table(head, table),
  ]
  tasks = list(dict.fromkeys(row["task"] for row in rows))
  paid = [_paid([row for row in rows if row["task"] == task]) for task in tasks]
  without, least = zip(*paid, strict=True)
  picture = plots.bars(path.with_suffix(".png"), "What a search was paid", tasks, {
    "most paid without success": without, "least paid with success": least,
  }, "return")  # fmt: skip
  return results.Page("Loopholes of the exercises", finding(rows), lines, [picture])


BENCH = Bench("loopholes", stages, run, report=report, arguments=arguments, jobs=2, limit=3600.0)
