"""Times steps of organs that are never cut, beside those of an older state of the code.

    git worktree add before 0e5a0ce    # the last one that knew of no cuts
    palpate bench uncut --before before

Processes of both, two each, are asked in turn for a few milliseconds of steps of the same scene,
on one core and in another order each round. Of each round the CPU time of the two new ones to that
of the two old ones counts, of all rounds the median, and of that the mean over `--lives`: where a
process has its memory makes its steps up to a percent faster or slower, so all are started anew.
The same of one process of a pair to the other is the control: what differs there is noise.
"""

from __future__ import annotations

import argparse
import math
import os
import pathlib
import random
import subprocess
import sys
import tempfile

import numpy as np
import scenes
from benchmarks import plots, results
from benchmarks.development import stepping
from benchmarks.runner import SEED, Bench, Case, Row
from palpate.app.console import CommandError

ROOT = pathlib.Path(__file__).parents[3]
BLOCK = 0.012  # CPU time of a round of a process [s]


class Server:
  """A process that steps a scene with the code of a folder.

  Args:
    code: folder that has the package
    name: of the scene
    surface: file of its organ
  """

  def __init__(self, code: pathlib.Path, name: str, surface: pathlib.Path):
    path = os.pathsep.join([str(code), os.environ.get("PYTHONPATH", "")])
    words = [sys.executable, stepping.__file__, name, str(surface)]
    more = {"PYTHONPATH": path, "OMP_NUM_THREADS": "1", "MUJOCO_GL": "disabled"}
    self._process = subprocess.Popen(
      words, env=os.environ | more, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )

  def _read(self) -> str:
    assert self._process.stdout
    line = self._process.stdout.readline().strip()
    while line and not line.isdigit() and line != "ready":  # what libraries say
      line = self._process.stdout.readline().strip()
    if not line:
      raise CommandError("a process that steps has ended", code=1)
    return line

  def wait(self):
    """Waits until it is ready."""
    self._read()

  def step(self, count: int) -> float:
    """Takes steps and returns their CPU time [s]."""
    assert self._process.stdin
    self._process.stdin.write(f"{count}\n")
    self._process.stdin.flush()
    return 1e-9 * int(self._read())

  def end(self):
    """Ends the process."""
    assert self._process.stdin
    self._process.stdin.close()
    self._process.wait()


def package(checkout: str | os.PathLike, where: pathlib.Path) -> pathlib.Path:
  """Makes a folder in which the package of a checkout has its name."""
  tree = pathlib.Path(checkout).resolve()
  if not (tree / "plugin").is_dir():
    raise CommandError(f"before is {str(checkout)!r}, expected a checkout of the repository")
  (where / "palpate").mkdir(parents=True)
  for path in (tree / "plugin").iterdir():
    (where / "palpate" / path.name).symlink_to(path)
  for name in ("models", "tasks"):
    if (tree / name).is_dir():
      (where / "palpate" / name).symlink_to(tree / name)
  return where


def write_surface(name: str, file: pathlib.Path):
  """Writes the organ of a scene, which all processes have then."""
  shape, nodes, _ = stepping.SCENES[name]
  if shape == "sheet":
    nx = round(math.sqrt(nodes * 1.3))
    points, elem = scenes.triangular(0.15, 0.10, nx, round(nx / 1.3), 0.2)
  else:
    points, elem = scenes.sphere(round(math.log((nodes - 2) / 10, 4)))
  np.savez(file, points=points, elem=elem)


def compare(old: pathlib.Path, new: pathlib.Path, case: Case, order: random.Random) -> dict:
  """Returns the logarithms of ratios of one life, and the CPU time of a step [s]."""
  surface = new.parent / "surface.npz"
  write_surface(case["case"], surface)
  servers = [Server(code, case["case"], surface) for code in (old, old, new, new)]
  try:
    for server in servers:
      server.wait()
    each = max(1, round(BLOCK / (servers[0].step(20) / 20)))
    for server in servers[1:]:
      server.step(20)
    rounds = []
    for _ in range(case["rounds"]):
      spent = np.zeros(4)
      for k in order.sample(range(4), 4):
        spent[k] = servers[k].step(each)
      rounds.append(spent / each)
  finally:
    for server in servers:
      server.end()
  a, a2, b, b2 = np.array(rounds).T
  half = np.log((a2 + b2) / (a + b))
  return {
    "ratio": float(np.median(np.log((b + b2) / (a + a2)))),
    "control": float(np.median(half)),
    "before": float(np.median(0.5 * (a + a2))),
    "now": float(np.median(0.5 * (b + b2))),
  }


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a scene."""
  order = random.Random(SEED)
  if hasattr(os, "sched_setaffinity"):  # processes that follow have it too
    cores = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {cores[-1 - os.getpid() % len(cores)]})
  with tempfile.TemporaryDirectory() as folder:
    old = package(case["before"], pathlib.Path(folder, "old"))
    new = package(ROOT, pathlib.Path(folder, "new"))
    lives = [compare(old, new, case, order) for _ in range(case["lives"])]
  row: Row = {"scene": case["case"], "lives": case["lives"], "rounds": case["rounds"]}
  row |= {f"{k}_ms": 1e3 * float(np.median([life[k] for life in lives])) for k in ("before", "now")}
  for name in ("ratio", "control"):
    values = np.array([life[name] for life in lives])
    row[name] = float(np.exp(values.mean()))
    row[f"{name}_error"] = float(values.std(ddof=1) / math.sqrt(len(values)))
  return [row]


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns a case a scene."""
  lives, rounds = (2, 20) if args.short else (args.lives, args.rounds)
  before = str(args.before.resolve())
  names = list(stepping.SCENES)[-1:] if args.short else stepping.SCENES
  return [[{"case": n, "before": before, "lives": lives, "rounds": rounds} for n in names]]


def arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("--before", type=pathlib.Path, required=True, help="checkout of the older code")
  add("--lives", type=int, default=12, help="times that processes are started (%(default)s)")
  add("--rounds", type=int, default=60, help="of each life (%(default)s)")


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  sheets = [100 * (r["ratio"] - 1) for r in rows if "closed" not in r["scene"]]
  closed = [f"{r['scene']} {100 * (r['ratio'] - 1):+.1f} %" for r in rows if "closed" in r["scene"]]
  lines = []
  if sheets:
    lines.append(f"Steps of sheets that are never cut changed by {min(sheets):+.1f} to "
                 f"{max(sheets):+.1f} %.")  # fmt: skip
  return [*lines, *([f"Steps of closed organs: {', '.join(closed)}."] if closed else [])]


def report(rows: list[Row], about: dict, out: pathlib.Path) -> list[pathlib.Path]:
  """Writes the page."""

  def percent(row, name):
    return f"{100 * (row[name] - 1):+.2f} ± {100 * row[f'{name}_error']:.2f}"

  table = [
    [row["scene"], f"{row['before_ms']:.3f}", f"{row['now_ms']:.3f}", percent(row, "ratio"),
     percent(row, "control")]
    for row in rows
    if row["status"] == "ok"
  ]  # fmt: skip
  head = ["organ", "before [ms]", "now [ms]", "now to before [%]", "control [%]"]
  lines = [*(__doc__ or "").split("\n\n", 2)[2].splitlines(), ""]
  lines += ["Differences with their standard error over lives. " + results.link(out / "uncut.csv")]
  lines += ["", *plots.table(head, table)]
  title = "What cuts cost organs that have no room for them"
  good = [row for row in rows if row["status"] == "ok"]
  picture = plots.bars(out / "uncut.png", title, [row["scene"] for row in good], {
    "now to before": [100 * (row["ratio"] - 1) for row in good],
    "control": [100 * (row["control"] - 1) for row in good],
  }, "change of the time of a step [%]")  # fmt: skip
  return [picture, results.page(out / "uncut.md", title, about, lines, finding(good), picture)]


BENCH = Bench("uncut", stages, run, report=report, arguments=arguments, jobs=1, limit=3600.0,
              folder="development")  # fmt: skip
