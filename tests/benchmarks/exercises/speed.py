"""Control steps a second of CPU time of each exercise with its expert, and what metrics add.

With `--against PYTHON`, the Python of another installation of this package, it races that one:
stretches of 10 control steps in turn, an episode of the same seeds each.

With `--device cuda:0` it times exercises in many worlds, with runs that repeat to the bit and
without, in turn, and counts the worlds that differ between two runs.
"""

from __future__ import annotations

import argparse
import os
import pathlib
import subprocess
import sys
import time

import mujoco
import numpy as np
import palpate
import warp as wp
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import tasks
from palpate.tasks import suite
from palpate.tasks.batch.vector import Exercises
from palpate.tasks.core import episode, performer
from palpate.tasks.recorder import Recorder

NAMES = ["/".join(pair) for pair in tasks.ALL_TASKS]
MANY = {  # exercises in many worlds, and how many
  "touch/easy": 1024, "grasp/easy": 512, "cut/easy": 256, "retract/easy": 256, "bimanual/easy": 256,
  "suture/drive_easy": 4096,
}  # fmt: skip
STEPS, TURNS = 100, 9  # control steps of a run, and stretches that are timed


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--tasks", nargs="+", metavar="TASK", choices=NAMES, help="all; some in many worlds")
  add("--device", default="cpu", help="cpu: one world of the plugin; cuda:0 (%(default)s)")
  add("--worlds", type=int, help="of each exercise, in place of its own number")
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
  names = args.tasks or (NAMES if args.device == "cpu" else [*MANY])
  names = names[:1] if args.short else names
  keys = {key: getattr(args, key) for key in ("seconds", "against", "episodes", "device", "worlds")}
  return [[{"case": name, "task": name} | keys for name in names]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of an exercise, or the two of one in many worlds."""
  name, clock = case["task"], time.process_time
  if case["device"] != "cpu":
    return many(name, case["device"], case["worlds"] or MANY.get(name, 256))
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


def many(task: str, device: str, nworld: int) -> list[Row]:
  """Returns the rows of an exercise in many worlds, without and with runs that repeat."""
  options = {"device": device, "output": "warp"}
  envs = [Exercises(nworld, task, deterministic=bool(k), **options) for k in range(2)]
  random, shape = np.random.RandomState(0), envs[0].action_space.shape
  drawn = np.clip(random.normal(0.0, 0.4, (STEPS, *shape)), -1, 1)
  drawn[..., 3] = np.clip(drawn[..., 3] + 0.3, -1, 1)  # towards the organ
  actions = [wp.array(row, dtype=wp.float32, device=device) for row in drawn]

  def play(env: Exercises) -> np.ndarray:
    env.reset(seed=0)
    for action in actions:
      seen, *_ = env.step(action)
    return np.concatenate([x.numpy().reshape(nworld, -1) for x in seen.values()], axis=1)

  differ = [int((play(env) != play(env)).any(axis=1).sum()) for env in envs]
  spent: list[list[float]] = [[], []]
  for _ in range(TURNS):
    for env, times in zip(envs, spent, strict=True):
      start = time.perf_counter()
      for action in actions[: STEPS // 5]:
        env.step(action)
      wp.synchronize_device(device)
      times.append(time.perf_counter() - start)
  return [
    {"task": task, "device": device, "nworld": nworld, "repeat": bool(k)}
    | {"steps_per_s": round(nworld * (STEPS // 5) / float(np.median(spent[k])))}
    | {"differ": differ[k], "palpate": palpate.__version__, "mujoco": mujoco.__version__}
    for k in range(2)
  ]


def compare(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page of exercises in many worlds."""
  pairs = list(zip(rows[::2], rows[1::2], strict=True))
  times = [free["steps_per_s"] / same["steps_per_s"] for free, same in pairs]
  table = [
    [free["task"], free["nworld"], free["steps_per_s"], same["steps_per_s"], f"{more:.2f}",
     free["differ"], same["differ"]]
    for (free, same), more in zip(pairs, times, strict=True)
  ]  # fmt: skip
  head = ["exercise", "worlds", "control steps a second", "repeating", "times as long",
          "worlds that differ", "repeating"]  # fmt: skip
  text = (
    f"Random actions towards the organ. Worlds are compared by all that is observed after {STEPS} "
    f"control steps, which are run twice. Times are medians of {TURNS} stretches of "
    f"{STEPS // 5} control steps, of both in turn. "
  )
  lines = [text + results.link(path), "", *plots.table(head, table)]
  found = [
    f"Runs that repeat take {min(times):.2f} to {max(times):.2f} times as long.",
    f"Of their worlds {sum(same['differ'] for _, same in pairs)} differ between two runs; without "
    f"`deterministic=True` {sum(free['differ'] for free, _ in pairs)} of "
    f"{sum(free['nworld'] for free, _ in pairs)} do.",
  ]
  return results.Page("How fast exercises run in many worlds", found, lines, name="exercises_cuda")


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


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Writes the page."""
  if rows and "repeat" in rows[0]:
    return compare(rows, path)
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
  lines = [text + results.link(path), "", *plots.table(head, table)]
  rates = {"": [r["steps_per_s"] for r in rows]}
  names = [r["task"] for r in rows]
  title = "How fast the exercises run"
  picture = path.with_name("exercises.png")
  plots.bars(picture, title, names, rates, "control steps a second")
  return results.Page(title, finding(rows), lines, [picture], "exercises")


BENCH = Bench("speed", stages, run, report=report, arguments=arguments, file="exercises_{device}")
