"""Control steps a second of CPU time of each exercise with its expert, and what metrics add.

With `--against PYTHON`, the Python of another installation of this package, it races that one:
stretches of 10 control steps in turn, an episode of the same seeds each.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import subprocess
import sys
import time

import mujoco
import palpate
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import tasks
from palpate.tasks import suite
from palpate.tasks.core import episode, performer
from palpate.tasks.recorder import Recorder

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=NAMES)
  add("--seconds", type=float, default=4.0, help="of stepping a task (%(default)s)")
  add("--against", metavar="PYTHON", type=pathlib.Path, help="of another installation, to race")
  add("--episodes", type=int, default=1, help="of a race (%(default)s)")


_RUNNER = """
import os, sys, time
for name in ("OMP", "OPENBLAS", "MKL"):
  os.environ[name + "_NUM_THREADS"] = "1"
import numpy as np
from palpate import tasks
from palpate.tasks import suite
from palpate.tasks.core import performer
say = os.fdopen(os.dup(1), "w", buffering=1)
os.dup2(2, 1)  # what libraries print
env = tasks.load(*suite.split(sys.argv[1]), {"random": 0})
act = performer.make(env)
say.write("ready\\n")
for line in sys.stdin:
  if line.startswith("reset"):
    env.task.random = np.random.RandomState(int(line.split()[1]))
    timestep, spent, steps = env.reset(), 0.0, 0
  for _ in range(10):
    if timestep.last():
      break
    action, start = act(timestep), time.process_time()
    timestep = env.step(action)
    spent, steps = spent + time.process_time() - start, steps + 1
  say.write(f"{int(timestep.last())} {steps} {spent} {env.task.outcome}\\n")
"""


def race(task: str, other: pathlib.Path, episodes: int) -> Row:
  """Returns how this installation and another do an exercise in turn: CPU time and outcomes."""
  environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "MUJOCO_GL")}
  mine = environment | {"PYTHONPATH": os.environ.get("PYTHONPATH", "")}
  runners = [
    subprocess.Popen(
      [python, "-c", _RUNNER, task], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
      stderr=subprocess.DEVNULL, text=True, env=env,
    )
    for python, env in ((sys.executable, mine), (other, environment))
  ]  # fmt: skip

  def ask(runner: subprocess.Popen, word: str) -> list[str]:
    assert runner.stdin and runner.stdout
    runner.stdin.write(word + "\n")
    runner.stdin.flush()
    return runner.stdout.readline().split()

  steps, spent, outcomes = [0, 0], [0.0, 0.0], [[], []]
  for runner in runners:
    assert runner.stdout
    if runner.stdout.readline() != "ready\n":
      raise RuntimeError(f"{runner.args}: it did not start")  # pyright: ignore
  for seed in range(episodes):
    word, live = [f"reset {seed}"] * 2, {0, 1}
    while live:
      for k in sorted(live):
        over, count, seconds, outcome = ask(runners[k], word[k])
        word[k] = "go"
        if over == "1":
          steps[k], spent[k] = steps[k] + int(count), spent[k] + float(seconds)
          outcomes[k].append(outcome)
          live.discard(k)
  for runner in runners:
    runner.communicate()
  each = [seconds / count for seconds, count in zip(spent, steps, strict=True)]
  return {
    "steps_per_s": round(1 / each[0], 1),
    "times": round(each[1] / each[0], 2),
    "solved": outcomes[0].count("success"),
    "solved_before": outcomes[1].count("success"),
    "episodes": episodes,
  }


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise."""
  names = args.tasks[:1] if args.short else args.tasks
  keys = {key: getattr(args, key) for key in ("seconds", "against", "episodes")}
  return [[{"case": name, "task": name} | keys for name in names]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of an exercise."""
  name, clock = case["task"], time.process_time
  env = tasks.load(*suite.split(name), {"random": 0})
  act = performer.make(env)
  stepping, recording, steps = 0.0, 0.0, 0
  while stepping < case["seconds"]:  # whole episodes, as the metrics at the end belong to them
    timestep = env.reset()
    recorder = Recorder(
      ["tip"], env.task.settings(), env.task.watch, substeps=episode.substeps(env)
    )
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
  none = {"times": "", "solved": "", "solved_before": "", "episodes": ""}
  return [row | (race(name, case["against"], case["episodes"]) if case["against"] else none)]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  if not rows:
    return []
  least, most = (pick(rows, key=lambda r: r["steps_per_s"]) for pick in (min, max))
  share = max(r["metrics_percent"] for r in rows)
  return [
    f"One core takes {least['steps_per_s']:.0f} (`{least['task']}`) to {most['steps_per_s']:.0f} "
    f"(`{most['task']}`) control steps a second.",
    f"Every exercise runs at least {0.02 * least['steps_per_s']:.2g} times as fast as real time.",
    f"Recording and metrics take at most {share:.0f} % of a step.",
  ]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  raced = all(row["times"] for row in rows)
  table = [
    [r["task"], r["nodes"], f"{r['steps_per_s']:.0f}", f"{r['metrics_percent']:.1f} %"]
    + ([f"{r['times']:.2f}", f"{r['solved']} of {r['episodes']}"] if raced else [])
    for r in rows
  ]
  head = ["exercise", "nodes", "control steps a second", "of it metrics"]
  text = (
    "A control step is 0.02 s of simulated time, with the expert at work; CPU time. The fourth "
    "column is what recording and metrics take. "
  )
  if raced:
    head += ["times the tree before", "solved"]
    text += (
      "The fifth compares it with commit 198529a, before windows and shafts that touch, in "
      "stretches of 10 control steps in turn: `--against` the Python of a venv that has that "
      "commit. "
    )
  lines = [text + results.link(out / "exercises_cpu.csv"), "", *plots.table(head, table)]
  title = "How fast the exercises run"
  rates = {"": [r["steps_per_s"] for r in rows]}
  names = [r["task"] for r in rows]
  picture = plots.bars(out / "exercises.png", title, names, rates, "control steps a second")
  return [picture, results.page(out / "exercises.md", title, about, lines, finding(rows), picture)]


BENCH = Bench("speed", stages, run, report=report, arguments=arguments, file="exercises_cpu")
