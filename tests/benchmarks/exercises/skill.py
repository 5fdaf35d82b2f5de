"""Every metric over the same seeds for the expert and each novice; the effect size is Cohen's d.

Episodes are kept in `--runs` and what is there is not run again.
"""

from __future__ import annotations

import argparse
import math
import pathlib

import numpy as np
from benchmarks import results
from benchmarks.exercises.performances import arguments, folder, performances
from benchmarks.runner import Bench, Case, Row
from palpate.tasks.core import performer
from palpate.tasks.metrics import METRICS, Metrics

SKILL_TASKS = ("touch/standard", "probe/easy", "grasp/easy", "trace/easy", "retract/easy")
# What each novice does differently, and the metrics that must show it.
STATED = {
  "tremor": ("trembles", ("log_dimensionless_jerk",)),
  "overshoot": ("goes too far and comes back", ("path_length", "path_inefficiency")),
  "delay": ("waits and is slow", ("time", "idle_time", "idle_share")),
  "force": (
    "starts with twice the force",
    (
      "peak_force", "mean_force", "rms_force", "force_time_product", "force_breaches",
      "excess_impulse", "peak_pressure", "peak_grip", "mean_grip",
    ),
  ),
  "detour": (
    "goes round about",
    ("path_length", "path_inefficiency", "angular_path", "trace_frechet", "trace_rms"),
  ),
}  # fmt: skip
# Where a novice's way does not come into play for a metric: why.
EXCUSED = {
  (task, "force", metric): "still under the limit"
  for task in SKILL_TASKS
  for metric in ("force_breaches", "excess_impulse")
} | {
  (task, "force", metric): "it grips harder, and pulls as before"
  for task in ("grasp/easy", "retract/easy")
  for metric in ("peak_force", "mean_force", "rms_force", "force_time_product", "peak_pressure")
}
LARGE = 0.8  # Cohen's d


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise and performer."""
  keys = {"episodes": args.episodes or (2 if args.short else 10)}
  keys |= {"runs": folder(args)}
  return [
    [
      {"case": f"{task}, {style}", "task": task, "style": style} | keys
      for task in (SKILL_TASKS[:1] if args.short else SKILL_TASKS)
      for style in performer.STYLES
    ]
  ]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns a row an episode: its outcome and metrics."""
  runs = performances(case["task"], case["style"], range(case["episodes"]), case["runs"])
  rows = []
  for seed, result in enumerate(runs):
    row = {"task": case["task"], "style": case["style"], "seed": seed}
    metrics = Metrics.from_json(result.metrics)
    values = {name: float(getattr(metrics, name)) for name in METRICS}
    rows.append(row | {"outcome": result.outcome} | values)
  return rows


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page: what each metric tells apart, and the effect sizes task by task."""
  head = [
    "Cells are Cohen's d, positive where the novice is worse; `inf` where neither group varies. "
    "Bold: the metrics that must show how the novice differs; they do with "
    f"d >= {LARGE}, else they are marked **no**. An empty cell is a metric that is unknown or the "
    "same in every episode.",
  ]
  for style, (text, names) in STATED.items():
    labels = ", ".join(METRICS[name].label for name in names)
    head += ["", f"- `{style}` {text}: {labels}"]
  lines, told = [], {}
  for task in dict.fromkeys(row["task"] for row in rows):
    lines += _task(task, [row for row in rows if row["task"] == task], told)
  lines = [*head, "", "## Metric by metric", "", *_verdicts(told), *lines]
  return results.Page("Metrics: expert against novices", finding(told), lines)


def finding(told: dict[tuple[str, str], dict[str, float]]) -> list[str]:
  """Returns what the page begins with: d by task for every (metric, novice)."""
  found = {(metric, style, task): d for (metric, style), by_task in told.items()
           for task, d in by_task.items() if metric in STATED[style][1]}  # fmt: skip
  missed = sorted({METRICS[metric].label for (metric, _, _), d in found.items() if d < LARGE})
  good = sum(d >= LARGE for d in found.values())
  return [
    f"Metrics tell a novice from the expert in {good} of {len(found)} cases where they must.",
    f"Not everywhere: {', '.join(missed) or 'none'}.",
  ]


def _task(name: str, rows: list[Row], told: dict) -> list[str]:
  """Returns a table of a task's metrics that must show, and adds what all tell apart to `told`."""
  by_style = {style: [r for r in rows if r["style"] == style] for style in performer.STYLES}
  won = {k: sum(r["outcome"] == "success" for r in mine) for k, mine in by_style.items()}
  wins = ", ".join(f"{k} {won[k]}/{len(mine)}" for k, mine in by_style.items())
  lines = ["", f"## {name}", "", f"Success: {wins}"]
  lines += ["", f"| metric | expert | {' | '.join(STATED)} |", "|---|---|" + "---|" * len(STATED)]
  for metric, spec in METRICS.items():
    base = _known(by_style["expert"], metric)
    if not base:
      continue
    shown = f"{spec.scale * np.mean(base):.3g} {spec.shown}"
    cells = []
    for style in STATED:
      d = _cohen(base, _known(by_style[style], metric), spec.better)
      text = "" if d is None else f"{d:.1f}"
      why = EXCUSED.get((name, style, metric))
      if metric in STATED[style][1]:
        good = d is not None and d >= LARGE
        text = f"**{text}**" if good else f"{text} ({why})" if why else f"**no** {text}"
      if not why:
        told.setdefault((metric, style), {})[name] = -math.inf if d is None else d
      cells.append(text)
    if any(metric in metrics for _, metrics in STATED.values()):
      lines.append(f"| {spec.label} | {shown} | {' | '.join(cells)} |")
  return lines


def _verdicts(told: dict[tuple[str, str], dict[str, float]]) -> list[str]:
  """Returns a table of what each metric tells apart: d by task for every (metric, novice)."""
  lines = ["| metric | must show | does in | does not in | also shows |", "|---|---|---|---|---|"]
  for metric, spec in METRICS.items():
    stated = [style for style in STATED if metric in STATED[style][1]]
    found = {style: told.get((metric, style), {}) for style in STATED}
    good, bad = [], []
    for style in stated:
      for task, d in found[style].items():
        (good if d >= LARGE else bad).append(f"{task} ({style})" if len(stated) > 1 else task)
    also = [
      f"{style} in {count} of {len(found[style])}"
      for style in STATED
      if style not in stated and (count := sum(d >= LARGE for d in found[style].values()))
    ]
    if not any(found.values()):
      bad = ["not known in these tasks"]
    elif good and not bad and not any(metric == excused for *_, excused in EXCUSED):
      good = ["all"]
    cells = [", ".join(words) for words in (stated or ["no novice is made to"], good, bad, also)]
    lines.append(f"| {spec.label} | {' | '.join(cells)} |")
  return lines


def _known(rows: list[Row], metric: str) -> list[float]:
  return [float(row[metric]) for row in rows if math.isfinite(float(row[metric]))]


def _cohen(expert: list[float], novice: list[float], better: str) -> float | None:
  """Returns (novice - expert) / pooled SD [-], turned so that positive is worse."""
  if len(expert) < 2 or len(novice) < 2:
    return None
  gap = np.mean(novice) - np.mean(expert)
  pooled = math.sqrt((np.var(expert, ddof=1) + np.var(novice, ddof=1)) / 2)
  sign = 1 if better == "lower" else -1
  if pooled < 1e-12 * max(abs(np.mean(expert)), 1e-12):
    return None if abs(gap) < 1e-12 else sign * math.copysign(math.inf, gap)
  return float(sign * gap / pooled)


BENCH = Bench("skill", stages, run, report=report, arguments=arguments)
