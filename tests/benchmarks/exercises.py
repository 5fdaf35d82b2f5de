"""Measures the exercises: steps a second with the cost of the metrics, and expert against novices.

    python tests/benchmarks/exercises.py speed -o tests/benchmarks/results/exercises_cpu.csv
    python tests/benchmarks/exercises.py skill -o tests/benchmarks/results/skill.md

`speed` runs each exercise with its expert. `skill` measures every metric over the same seeds for
the expert and for each novice; the effect size is Cohen's d, positive where the novice is worse.
"""

import argparse
import csv
import math
import pathlib
import time

import mujoco
import numpy as np
import palpate
from palpate import tasks
from palpate.tasks import evaluate, experts
from palpate.tasks.recorder import Recorder
from palpate.tasks.score import METRICS, Metrics

SKILL_TASKS = ("touch/standard", "probe/easy", "grasp/easy", "trace/easy", "retract/easy")
# What each novice does differently, and the metrics that must show it.
STATED = {
  "tremor": ("trembles", ("log_dimensionless_jerk",)),
  "overshoot": ("goes too far and comes back", ("path_length", "path_inefficiency")),
  "delay": ("waits and is slow", ("time", "idle_time")),
  "force": ("starts with twice the force", ("peak_force",)),
  "detour": ("goes round about", ("path_length", "path_inefficiency")),
}
# Where the novice's way does not come into play: why.
EXCUSED = {
  ("trace/easy", "overshoot"): "the tip is led along the curve",
}
LARGE = 0.8  # Cohen's d


def speed(path: pathlib.Path, seconds: float):
  """Writes control steps a second and the share of it that metrics take, task by task."""
  rows = []
  for domain, task in tasks.ALL_TASKS:
    env = tasks.load(domain, task, {"random": 0})
    act = experts.make(env)
    recorder = Recorder(["tip"], env.task.settings(), env.task.watch)
    timestep, stepping, recording, count, start = env.reset(), 0.0, 0.0, 0, 0.0
    while stepping < seconds:
      action = None if timestep.last() else act(timestep)
      if action is None:
        timestep, start = env.reset(), recorder._last
        continue
      before = time.perf_counter()
      timestep = env.step(action)
      stepping += time.perf_counter() - before
      before = time.perf_counter()
      sample = env.task.sample(env.physics)
      sample["time"] += max(start, 0.0)
      recorder.append(**sample)
      recording += time.perf_counter() - before
      count += 1
    before = time.perf_counter()
    recorder.metrics()
    recording += time.perf_counter() - before
    row = {
      "task": f"{domain}/{task}",
      "nodes": env.physics.organ.nvert,
      "steps_per_s": round(count / stepping, 1),
      "real_time": round(count * env.control_timestep() / stepping, 2),
      "metrics_percent": round(100 * recording / stepping, 2),
      "palpate": palpate.__version__,
      "mujoco": mujoco.__version__,
    }
    print(row, flush=True)
    rows.append(row)
  with path.open("w", newline="") as file:
    writer = csv.DictWriter(file, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


def skill(path: pathlib.Path, episodes: int, processes: int):
  """Writes the table of expert against novices."""
  lines = [
    "# Metrics: expert against novices",
    "",
    f"{episodes} episodes of each (seeds 0 to {episodes - 1}), palpate {palpate.__version__}, "
    f"mujoco {mujoco.__version__}; made by `python tests/benchmarks/exercises.py skill`.",
    "",
    "Cells are Cohen's d, positive where the novice is worse; `inf` where neither group varies. "
    "Bold: the metrics that must show how the novice differs; they do with "
    f"d >= {LARGE}, else they are marked **no**. An empty cell is a metric that is unknown or the "
    "same in every episode.",
  ]
  for style, (text, names) in STATED.items():
    labels = ", ".join(METRICS[name].label for name in names)
    lines += ["", f"- `{style}` {text}: {labels}"]
  for name in SKILL_TASKS:
    results = {
      style: list(evaluate.evaluate(name, style, range(episodes), processes))
      for style in experts.STYLES
    }
    wins = {
      style: f"{sum(r.outcome == 'success' for r in rows)}/{episodes}"
      for style, rows in results.items()
    }
    lines += ["", f"## {name}", "", "Success: " + ", ".join(f"{k} {v}" for k, v in wins.items())]
    lines += ["", f"| metric | expert | {' | '.join(STATED)} |", "|---|---|" + "---|" * len(STATED)]
    values = {
      style: [Metrics.from_json(r.metrics) for r in rows] for style, rows in results.items()
    }
    for metric, spec in METRICS.items():
      base = _known(values["expert"], metric)
      if not base:
        continue
      shown = f"{spec.scale * np.mean(base):.3g} {spec.shown}"
      cells = []
      for style in STATED:
        d = _cohen(base, _known(values[style], metric), spec.better)
        text = "" if d is None else f"{d:.1f}"
        if metric in STATED[style][1]:
          good = d is not None and d >= LARGE
          why = EXCUSED.get((name, style))
          text = f"**{text}**" if good else f"{text} ({why})" if why else f"**no** {text}"
        cells.append(text)
      lines.append(f"| {spec.label} | {shown} | {' | '.join(cells)} |")
    print(name, wins, flush=True)
  path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _known(results: list[Metrics], metric: str) -> list[float]:
  return [float(v) for r in results if math.isfinite(v := getattr(r, metric))]


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


def main():
  parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
  parser.add_argument("what", choices=["speed", "skill"])
  parser.add_argument("-o", "--out", type=pathlib.Path, required=True)
  parser.add_argument("--seconds", type=float, default=4.0, help="of stepping a task")
  parser.add_argument("--episodes", type=int, default=8)
  parser.add_argument("--processes", type=int, default=1)
  args = parser.parse_args()
  if args.what == "speed":
    speed(args.out, args.seconds)
  else:
    skill(args.out, args.episodes, args.processes)


if __name__ == "__main__":
  main()
