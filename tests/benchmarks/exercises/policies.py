"""Policies that were trained: how often each succeeds in the single environment on the CPU.

`palpate train` makes them, all in the same way. Seeds from 0 on, which no policy has learned from.
`--worlds 4096` lets them play in so many worlds side by side as well, on a GPU where there is one.
"""

from __future__ import annotations

import argparse
import collections
import pathlib

import numpy as np
import palpate
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import tasks
from palpate.app.learn import evaluate
from palpate.tasks import registry
from palpate.tasks.learn import policy
from palpate.tasks.metrics import Metrics
from palpate.tasks.people import score

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]
_EPISODES, _BLOCK = 50, 5  # of a policy, of a case
_OTHERS = 1_000_000  # seed of the first of many worlds


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--policies", metavar="FOLDER", type=pathlib.Path, default=policy.FOLDER,
      help="those that ship")  # fmt: skip
  add("--worlds", metavar="N", type=int, default=0, help="side by side, besides")
  add("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=NAMES)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a few episodes of a policy."""
  cases, count = [], 1 if args.short else _EPISODES
  for start in range(0, count, _BLOCK):
    for name in args.tasks:
      file = args.policies.resolve() / f"{name.replace('/', '_')}{policy.SUFFIX}"
      if file.exists():
        case = {"case": f"{name}, from {start}", "task": name, "file": str(file), "start": start}
        cases.append(case | {"end": min(start + _BLOCK, count)})
        if args.worlds and not start:
          cases.append({**case, "case": f"{name}, {args.worlds} worlds", "worlds": args.worlds})
  return [cases]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns a row an episode, or one for many worlds."""
  if case.get("worlds"):
    won = _side_by_side(case["task"], case["file"], case["worlds"])
    return [{"task": case["task"], "worlds": case["worlds"], "won": won}]
  name, seeds = case["task"], range(case["start"], case["end"])
  training, reference = policy.load(case["file"]).about.training, score.reference(name)
  rows = []
  options = {"surroundings": "unseen"}  # nothing is drawn
  for result in evaluate.evaluate(name, case["file"], seeds, task_kwargs=options):
    row = {"task": name, "seed": result.seed, "outcome": result.outcome}
    row |= {"time_s": round(result.time, 2), "lessons": training.get("lessons", 0)}
    row |= {"steps": training.get("steps", 0), "train_s": training.get("seconds", 0)}
    row["began_with"] = training.get("from", "").removesuffix(policy.SUFFIX)
    row |= {"proficient": "", "peak_force_N": "", "over": "", "worlds": "", "won": ""}
    if result.metrics:
      metrics = Metrics.from_json(result.metrics)
      row["peak_force_N"] = round(metrics.peak_force, 3)
      if reference is not None:
        found = score.score(metrics, reference, result.outcome)
        row["proficient"] = int(found.proficient)
        row["over"] = " ".join(found.over) if result.outcome == score.SUCCESS else ""
    rows.append(row)
  return rows


def _side_by_side(name: str, file: str, count: int) -> int:
  """Returns how many worlds a policy succeeds in."""
  import gymnasium

  palpate.register()
  env = gymnasium.make_vec(registry.gym_id(*name.split("/")), num_envs=count)
  act, (seen, _) = policy.load(file).begin(count), env.reset(seed=_OTHERS)
  playing, won = np.ones(count, bool), 0
  while playing.any():
    seen, _, terminated, truncated, info = env.step(act(seen).astype(np.float32))
    over = terminated | truncated
    if over.any():
      won += int((playing & over & info["final_info"]["success"]).sum())
    playing &= ~over
  env.close()
  return won


def finding(judged: dict[str, list[Row]]) -> list[str]:
  """Returns what the page begins with: of the episodes of each exercise."""
  if not judged:
    return []
  won = {name: _share(rows, lambda r: r["outcome"] == score.SUCCESS)
         for name, rows in judged.items()}  # fmt: skip
  worst = min(won, key=lambda name: won[name])
  counted = _counted([r for rows in judged.values() for r in rows])
  passed = _share(counted, lambda r: int(r["proficient"]))
  return [
    f"{sum(share == 100 for share in won.values())} of {len(won)} policies succeed in every "
    f"episode, {sum(share >= 90 for share in won.values())} in 90 % or more.",
    f"`{worst}` succeeds least often, in {won[worst]:.0f} %.",
    f"{passed:.0f} % of {len(counted)} episodes are proficient by the experts' limits.",
  ]


def _share(rows: list[Row], which) -> float:
  return 100 * sum(bool(which(r)) for r in rows) / max(len(rows), 1)


def _counted(rows: list[Row]) -> list[Row]:
  """Returns the episodes that limits were there for."""
  return [row for row in rows if str(row["proficient"]) != ""]


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page: a line an exercise."""
  groups: dict[str, list[Row]] = collections.defaultdict(list)
  many: dict[str, str] = {}
  for row in rows:
    if row.get("worlds"):
      many[row["task"]] = f"{100 * int(row['won']) / int(row['worlds']):.1f} % of {row['worlds']}"
    else:
      groups[row["task"]].append(row)
  head = ["exercise", "lessons", "training [s]", "began with", "success", "proficient",
          "time of a success [s]", "ends otherwise", "successes over a limit",
          "side by side"]  # fmt: skip
  table = [
    [*(_line(name, groups[name]) if name in groups else _untried(name)), many.get(name, "-")]
    for name in NAMES
  ]
  times = [float(line[2]) for line in table if line[1] not in ("-", "0")]
  count = sum(line[1] != "-" for line in table)
  lines = [*(__doc__ or "").split("\n\n", 1)[1].splitlines(), ""]
  lines += [
    f"{count} of {len(NAMES)} exercises have one; training took {np.median(times):.0f} s in "
    "the median. Proficient is by the experts' limits, of all episodes; over a limit are named the "
    "three metrics that most are over. Who began with another's policy has not counted the time of "
    f"that one's training: with 0 lessons it is that one. {results.link(path)}",
    "", *plots.table(head, table),
  ]  # fmt: skip
  judged = {name: groups[name] for name in NAMES if name in groups}
  picture = plots.bars(path.with_suffix(".png"), "Policies that ship", list(judged), {
    "success": [_share(rows, lambda r: r["outcome"] == score.SUCCESS) for rows in judged.values()],
    "proficient": [
      _share(_counted(rows), lambda r: int(r["proficient"])) for rows in judged.values()
    ],
  }, "share of the episodes [%]")  # fmt: skip
  return results.Page("Policies that were trained", finding(judged), lines, [picture])


def _line(name: str, rows: list[Row]) -> list[str]:
  won = [row for row in rows if row["outcome"] == score.SUCCESS]
  ends = collections.Counter(row["outcome"] for row in rows if row["outcome"] != score.SUCCESS)
  over = collections.Counter(metric for row in won for metric in str(row.get("over", "")).split())
  counted = _counted(rows)
  passed = f"{_share(counted, lambda r: int(r['proficient'])):.0f} %" if counted else "-"
  time = f"{np.mean([float(row['time_s']) for row in won]):.1f}" if won else "-"
  first = rows[0]
  return [
    name, str(first["lessons"]), f"{float(first['train_s']):.0f}", first.get("began_with") or "-",
    f"{len(won)} of {len(rows)}", passed, time,
    ", ".join(f"{end} {count}" for end, count in sorted(ends.items())) or "-",
    ", ".join(f"{metric.replace('_', ' ')} {n}" for metric, n in over.most_common(3)) or "-",
  ]  # fmt: skip


def _untried(name: str) -> list[str]:
  """Returns the line of an exercise that has no rows."""
  try:
    training = policy.shipped(name).about.training
  except ValueError:
    return [name, *"--------"]
  told = [str(training.get("lessons", 0)), f"{training.get('seconds', 0):.0f}"]
  return [name, *told, training.get("from", "-").removesuffix(policy.SUFFIX), "not judged", *"----"]


BENCH = Bench("policies", stages, run, report=report, arguments=arguments, jobs=1)
