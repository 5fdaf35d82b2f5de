"""Control steps a second of CPU time of each exercise with its expert, and what metrics add."""

from __future__ import annotations

import argparse
import pathlib
import time

import mujoco
import palpate
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import tasks
from palpate.tasks import episode, performer, suite
from palpate.tasks.recorder import Recorder

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--tasks", nargs="+", metavar="TASK", choices=NAMES, default=NAMES)
  add("--seconds", type=float, default=4.0, help="of stepping a task (%(default)s)")


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case an exercise."""
  names = args.tasks[:1] if args.short else args.tasks
  return [[{"case": name, "task": name, "seconds": args.seconds} for name in names]]


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
  return [row]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""
  table = [
    [r["task"], r["nodes"], f"{r['steps_per_s']:.0f}", f"{r['metrics_percent']:.1f} %"]
    for r in rows
  ]
  lines = [
    "A control step is 0.02 s of simulated time, with the expert at work; CPU time. The last "
    "column is what recording and metrics take. " + results.link(out / "exercises_cpu.csv"),
    "",
    *plots.table(["exercise", "nodes", "control steps a second", "of it metrics"], table),
  ]
  return [results.page(out / "exercises.md", "How fast the exercises run", about, lines)]


BENCH = Bench("speed", stages, run, report=report, arguments=arguments, file="exercises_cpu")
