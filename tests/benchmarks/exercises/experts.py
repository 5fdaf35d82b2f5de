"""How many of their episodes experts, skilled people and novices solve, and are proficient in.

`one fault` are scripts that do one thing as badly as novices do, and all else as experts.
Seeds from 0 on, which no reference is made from: those are of `palpate panel`, and of other people.
Episodes are kept in `--runs` and what is there is not run again: stop and go on at will.
"""

from __future__ import annotations

import argparse
import collections
import math
import pathlib
from collections.abc import Iterator

import numpy as np
from benchmarks import plots, results
from benchmarks.exercises.performances import arguments as add_episodes
from benchmarks.exercises.performances import folder, performances
from benchmarks.runner import Bench, Case, Row
from palpate import tasks
from palpate.tasks.core import performer
from palpate.tasks.metrics import METRICS, Metrics
from palpate.tasks.people import score

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]
# Styles of each group, and episodes of each style.
GROUPS = {
  "expert": (("expert",), 50),
  "skilled": (("skilled",), 20),
  "novice": (("novice",), 10),
  "one fault": (tuple(performer.NOVICES), 3),
}
_BLOCK = 3  # episodes of a case: few enough that processes end together


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add_episodes(parser)
  parser.add_argument("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=NAMES)
  parser.add_argument("--who", nargs="+", metavar="WHO", choices=GROUPS, default=list(GROUPS))


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a few episodes of a performer in an exercise."""
  kept = folder(args)
  return [[case | {"runs": kept} for who in args.who for case in _cases(args, who)]]


def _cases(args: argparse.Namespace, who: str) -> Iterator[Case]:
  styles, count = GROUPS[who]
  count = args.episodes or (2 if args.short else count)
  for start in range(0, count, _BLOCK):
    end = min(start + _BLOCK, count)
    for name in args.tasks:
      for style in styles:
        case = {"case": f"{name}, {style}, {start} to {end - 1}", "task": name, "who": who}
        yield case | {"style": style, "start": start, "end": end}


def run(case: Case, out) -> list[Row]:
  """Returns a row an episode."""
  name, seeds = case["task"], range(case["start"], case["end"])
  reference = score.reference(name)
  rows = []
  for result in performances(name, case["style"], seeds, case["runs"]):
    metrics = Metrics.from_json(result.metrics)
    row = {key: case[key] for key in ("task", "who", "style")} | {"seed": result.seed}
    row |= {"outcome": result.outcome, "proficient": "", "score": math.nan}
    row |= {"time_s": round(result.time, 2), "peak_force_N": round(metrics.peak_force, 3)}
    over: tuple[str, ...] = ()
    if reference is not None:
      found = score.score(metrics, reference, result.outcome)
      row |= {"proficient": int(found.proficient), "score": round(found.composite, 2)}
      over = found.over + found.missing if result.outcome == score.SUCCESS else ()
    rows.append(row | {"over": " ".join(over)})
  return rows


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for who in ("expert", "skilled", "novice"):
    mine = [r for r in rows if r["who"] == who]
    if mine:
      won = sum(r["outcome"] == score.SUCCESS for r in mine)
      lines.append(f"Of {len(mine)} episodes of {who} performers {won} succeed and "
                   f"{_share(mine):.0f} % are proficient.")  # fmt: skip
  return lines


def _share(rows: list[Row]) -> float:
  """Returns the share of episodes that are proficient [%]; NaN of none."""
  return 100 * sum(int(r["proficient"] or 0) for r in rows) / len(rows) if rows else math.nan


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page: a line an exercise, and what the groups fail by."""
  groups: dict[tuple[str, str], list[Row]] = collections.defaultdict(list)
  for row in rows:
    groups[row["task"], row["who"]].append(row)
  names = list(dict.fromkeys(name for name in NAMES if any(name == task for task, _ in groups)))
  head = ["exercise"] + [f"{who}: {what}" for who in GROUPS for what in _HEAD]
  table = [
    [name, *(cell for who in GROUPS for cell in _cells(groups.get((name, who), [])))]
    for name in names
  ]
  lines = [*(__doc__ or "").split("\n\n", 1)[1].splitlines(), ""]
  lines += [_WHAT + results.link(path), "", *plots.table(head, table), ""]
  lines += ["## What they fail by", "", *plots.table(_WHY, list(_reasons(groups)))]
  title = "Experts, skilled people and novices"
  picture = plots.bars(path.with_suffix(".png"), "Episodes that are proficient", names, {
    who: [_share(groups.get((name, who), [])) for name in names] for who in GROUPS
  }, "share of the episodes [%]")  # fmt: skip
  return results.Page(title, finding(rows), lines, [picture])


_HEAD = ("success", "proficient", "score")
_WHY = ["exercise", "who", "not a success", "over a limit"]
_WHAT = (
  "Proficient is of all episodes, those without success too; the score is the mean, "
  f"{score.FLOOR:g} without success. "
)


def _cells(rows: list[Row]) -> list[str]:
  """Returns what a table says of a group's episodes."""
  if not rows:
    return ["-"] * len(_HEAD)
  won = sum(row["outcome"] == score.SUCCESS for row in rows)
  passed = sum(int(row["proficient"] or 0) for row in rows)
  mean = np.mean([float(row["score"]) for row in rows])
  return [f"{won} of {len(rows)}", f"{100 * passed / len(rows):.0f} %", f"{mean:.2f}"]


def _reasons(groups: dict[tuple[str, str], list[Row]]) -> Iterator[list[str]]:
  for (task, who), rows in groups.items():
    failed = [
      f"{row['seed'] if row['style'] == who else '{} {}'.format(row['style'], row['seed'])}"
      f" {row['outcome']}"
      for row in rows
      if row["outcome"] != score.SUCCESS
    ]
    over = collections.Counter(name for row in rows for name in str(row["over"]).split())
    most = ", ".join(f"{METRICS[name].label.lower()} {n}" for name, n in over.most_common(4))
    if failed or most:
      yield [task, who, ", ".join(failed), most]


BENCH = Bench("experts", stages, run, report=report, arguments=arguments, limit=3600.0)
