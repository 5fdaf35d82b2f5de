"""Measures the exercises: experts' success, expert against novices, and steps a second.

    python tests/benchmarks/exercises.py experts -o tests/benchmarks/results/experts.csv
    python tests/benchmarks/exercises.py skill -o tests/benchmarks/results/skill.md
    python tests/benchmarks/exercises.py speed -o tests/benchmarks/results/exercises_cpu.csv

`experts` runs every exercise over the seeds 0 to 49 and counts successes; with `--references
tasks/references` the expert references are made of the same episodes. `skill` measures every metric
over the same seeds for the expert and for each novice; the effect size is Cohen's d, positive where
the novice is worse. Both keep each episode's recording in `--runs` and do not run again what is
there: stop and go on at will, and remove that folder when the code has changed. `speed` runs each
exercise with its expert and counts CPU time.
"""

import argparse
import csv
import json
import math
import multiprocessing
import pathlib
import time
from collections.abc import Iterator

import mujoco
import numpy as np
import palpate
from palpate import tasks
from palpate.tasks import episode, performer, suite
from palpate.tasks.metrics import METRICS, Metrics
from palpate.tasks.recorder import Recorder
from palpate.tasks.recording import Recording
from palpate.tasks.score import make_reference

SKILL_TASKS = ("touch/standard", "probe/easy", "grasp/easy", "trace/easy", "retract/easy")
# What each novice does differently, and the metrics that must show it.
STATED = {
  "tremor": ("trembles", ("sparc", "log_dimensionless_jerk")),
  "overshoot": ("goes too far and comes back", ("path_length", "path_inefficiency")),
  "delay": ("waits and is slow", ("time", "idle_time", "idle_share")),
  "force": (
    "starts with twice the force",
    (
      "peak_force", "mean_force", "rms_force", "force_time_product", "force_breaches",
      "excess_impulse", "peak_pressure",
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
  for task in ("touch/standard", "probe/easy", "trace/easy")
  for metric in ("force_breaches", "excess_impulse")
}
LARGE = 0.8  # Cohen's d


def performances(
  name: str, style: str, episodes: int, folder: pathlib.Path, processes: int
) -> Iterator[Recording]:
  """Yields the recordings of the seeds 0, 1, ..., run unless they are in the folder."""
  jobs = [(name, style, seed, folder) for seed in range(episodes)]
  if processes == 1:
    yield from map(_perform, jobs)
    return
  with multiprocessing.get_context("spawn").Pool(processes) as pool:
    yield from pool.imap(_perform, jobs)


_environments = {}  # the last one of this process


def _perform(job: tuple[str, str, int, pathlib.Path]) -> Recording:
  name, style, seed, folder = job
  path = folder / name.replace("/", "_") / f"{style}_{seed}.npz"
  if path.exists():
    return Recording.load(path)
  if name not in _environments:
    _environments.clear()
    _environments[name] = suite.load(*suite.split(name), task_kwargs={"random": 0})
  env = _environments[name]
  info = {"task_kwargs": {}, "performer": style}
  try:
    recording = episode.run(env, performer.make(env, style, seed), seed, info)
  except episode.EpisodeError as error:
    recording = error.recording
  path.parent.mkdir(parents=True, exist_ok=True)
  recording.save(path)
  return recording


def success(args: argparse.Namespace):
  """Writes how many of its episodes each expert solves, and the references if asked to."""
  rows = []
  for name in args.tasks:
    count, good, failed, ends, peaks = args.episodes or 50, [], [], [], []
    runs = performances(name, "expert", count, args.runs, args.processes)
    for seed, recording in enumerate(runs):
      metrics = recording.metrics()
      ends.append(float(recording.time[-1]))
      peaks.append(metrics.peak_force)
      if recording.info["outcome"] == "success":
        good.append(metrics)
      else:
        failed.append(f"{seed} {recording.info['outcome']}")
    row = {
      "task": name,
      "episodes": count,
      "success": len(good),
      "percent": round(100 * len(good) / count, 1),
      "time_s_mean": round(float(np.mean(ends)), 2),
      "time_s_max": round(max(ends), 2),
      "peak_force_N_mean": round(float(np.nanmean(peaks)), 3),
      "failed_seeds": "; ".join(failed),
      "palpate": palpate.__version__,
      "mujoco": mujoco.__version__,
    }
    print(row, flush=True)
    rows.append(row)
    if args.references:
      data = make_reference(good, name, 0)
      data |= {"palpate": palpate.__version__, "mujoco": mujoco.__version__, "episodes": count}
      path = args.references / f"{name.replace('/', '_')}.json"
      path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
  write_csv(args.out, rows)


def write_csv(path: pathlib.Path, rows: list[dict]):
  """Writes a table."""
  with path.open("w", newline="") as file:
    writer = csv.DictWriter(file, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)


def speed(args: argparse.Namespace):
  """Writes control steps a second of CPU time, and what metrics add to it, task by task."""
  rows, clock = [], time.process_time
  for name in args.tasks:
    env = tasks.load(*suite.split(name), {"random": 0})
    act = performer.make(env)
    stepping, recording, steps = 0.0, 0.0, 0
    while stepping < args.seconds:  # whole episodes, as the metrics at the end belong to them
      timestep = env.reset()
      recorder = Recorder(["tip"], env.task.settings(), env.task.watch)
      for key, value in env.task.constants(env.physics).items():
        recorder.attach(key, value)
      while not timestep.last():
        action = act(timestep)
        start = clock()
        timestep = env.step(action)
        middle = clock()
        recorder.append(**env.task.sample(env.physics))
        end = clock()
        stepping, recording, steps = stepping + middle - start, recording + end - middle, steps + 1
      start = clock()
      recorder.metrics()
      recording += clock() - start
    row = {
      "task": name,
      "nodes": env.physics.organ.nvert,
      "steps_per_s": round(steps / stepping, 1),
      "real_time": round(steps * env.control_timestep() / stepping, 2),
      "metrics_us_per_step": round(1e6 * recording / steps, 1),
      "metrics_percent": round(100 * recording / stepping, 2),
      "palpate": palpate.__version__,
      "mujoco": mujoco.__version__,
    }
    print(row, flush=True)
    rows.append(row)
  write_csv(args.out, rows)


def skill(args: argparse.Namespace):
  """Writes the table of expert against novices."""
  episodes = args.episodes or 10
  head = [
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
    head += ["", f"- `{style}` {text}: {labels}"]
  lines, told = [], {}
  for name in SKILL_TASKS:
    values, wins = {}, {}
    for style in performer.STYLES:
      runs = list(performances(name, style, episodes, args.runs, args.processes))
      values[style] = [run.metrics() for run in runs]
      wins[style] = f"{sum(run.info['outcome'] == 'success' for run in runs)}/{episodes}"
    lines += ["", f"## {name}", "", "Success: " + ", ".join(f"{k} {v}" for k, v in wins.items())]
    lines += ["", f"| metric | expert | {' | '.join(STATED)} |", "|---|---|" + "---|" * len(STATED)]
    for metric, spec in METRICS.items():
      base = _known(values["expert"], metric)
      if not base:
        continue
      shown = f"{spec.scale * np.mean(base):.3g} {spec.shown}"
      cells = []
      for style in STATED:
        d = _cohen(base, _known(values[style], metric), spec.better)
        text = "" if d is None else f"{d:.1f}"
        why = EXCUSED.get((name, style, metric))
        if metric in STATED[style][1]:
          good = d is not None and d >= LARGE
          text = f"**{text}**" if good else f"{text} ({why})" if why else f"**no** {text}"
        if not why:
          told.setdefault((metric, style), {})[name] = -math.inf if d is None else d
        cells.append(text)
      lines.append(f"| {spec.label} | {shown} | {' | '.join(cells)} |")
    print(name, wins, flush=True)
  lines = [*head, "", "## Metric by metric", "", *_verdicts(told), *lines]
  args.out.write_text("\n".join(lines) + "\n", encoding="utf-8")


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
    elif good and not bad:
      good = ["all"]
    cells = [", ".join(words) for words in (stated or ["no novice is made to"], good, bad, also)]
    lines.append(f"| {spec.label} | {' | '.join(cells)} |")
  return lines


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
  add = parser.add_argument
  add("what", choices=["experts", "skill", "speed"])
  add("-o", "--out", type=pathlib.Path, required=True)
  names = ["/".join(pair) for pair in tasks.ALL_TASKS]
  add("--tasks", nargs="+", metavar="TASK", choices=names, default=names, help="experts, speed")
  add("--episodes", type=int, help="of each performer (experts 50, skill 10)")
  add("--processes", type=int, default=1)
  add("--runs", type=pathlib.Path, default="out/episodes", help="recordings, kept (%(default)s)")
  add("--references", type=pathlib.Path, help="experts: folder to write references to")
  add("--seconds", type=float, default=4.0, help="speed: of stepping a task (%(default)s)")
  args = parser.parse_args()
  {"experts": success, "skill": skill, "speed": speed}[args.what](args)


if __name__ == "__main__":
  main()
