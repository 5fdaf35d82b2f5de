"""One runner for all benches: processes, rows appended as they come, resumed where they stopped."""

from __future__ import annotations

import argparse
import csv
import dataclasses
import difflib
import importlib
import io
import json
import math
import multiprocessing
import os
import pathlib
import platform
import sys
import time
from collections.abc import Callable
from multiprocessing import connection

from palpate.app.console import CommandError, Progress

Case = dict
Row = dict


@dataclasses.dataclass(frozen=True)
class Bench:
  """What a bench is made of.

  Attributes:
    name: word of the command and name of the files
    module: where `run` is, for the workers
    columns: columns of the CSV, after `case` and `status`
    stages: returns the cases of each stage, the short or the full list; a stage starts when the one
      before it is done. A case is a dict with a unique `case`, numbers and words only.
    run: returns the rows of a case; the second argument is the output folder
    draw: draws the figures from the rows and returns their paths
    summarize: returns the summary in Markdown, from rows and machine
    limit: seconds after which a case is given up and noted as such
    jobs: processes unless `--jobs` says otherwise
  """

  name: str
  module: str
  columns: tuple[str, ...]
  stages: Callable[[bool], list[list[Case]]]
  run: Callable[[Case, pathlib.Path], list[Row]]
  draw: Callable[[list[Row], pathlib.Path], list[pathlib.Path]]
  summarize: Callable[[list[Row], dict], str]
  limit: float = 600.0
  jobs: int = 1


def add_arguments(parser: argparse.ArgumentParser, bench: Bench):
  """Declares the options of a bench."""
  add = parser.add_argument
  add("--out", metavar="FOLDER", type=pathlib.Path, default=pathlib.Path("out", "bench"),
      help="output folder (%(default)s)")  # fmt: skip
  add("--short", action="store_true", help="the short form: minutes at most")
  add("--resume", action="store_true", help="continue: skip what the output folder already has")
  add("--jobs", metavar="N", type=int, default=bench.jobs, help="processes (%(default)s)")
  add("--minutes", metavar="M", type=float, default=math.inf,
      help="stop after so long; --resume goes on from there")  # fmt: skip
  add("--draw", action="store_true", help="only draw figures and summary from the rows there are")
  add("--only", metavar="CASE", action="append", default=[],
      help="run this case of the CSV again and print its rows; may be repeated")  # fmt: skip


def main(bench: Bench, args: argparse.Namespace) -> int:
  """Runs a bench and returns the exit code."""
  if args.jobs < 1:
    raise CommandError(f"jobs is {args.jobs}, expected a number >= 1")
  out = args.out
  try:
    out.mkdir(parents=True, exist_ok=True)
  except OSError as error:
    raise CommandError(f"cannot write to {str(out)!r}: {error.strerror}") from None
  path = out / f"{bench.name}.csv"
  complete = True
  if args.only:
    return _again(bench, out, args.short, args.only)
  if not args.draw:
    complete = execute(bench, out, args.short, args.resume, args.jobs, 60 * args.minutes)
  if not path.exists():
    raise CommandError(f"no {path}, expected the rows of an earlier run", code=1)
  for written in report(bench, out):
    print(written)
  return 0 if complete else 130


def _again(bench: Bench, out: pathlib.Path, short: bool, names: list[str]) -> int:
  """Runs single cases and prints their rows, which go into no file."""
  cases = {case["case"]: case for stage in bench.stages(short) for case in stage}
  for name in names:
    if name not in cases:
      near = difflib.get_close_matches(name, cases, 3, 0) or ["none"]
      raise CommandError(f"no case {name!r} in this bench, the nearest are {', '.join(near)}")
  register_quietly()
  for name in names:
    try:
      rows = bench.run(cases[name], out.resolve())
    except Exception as error:
      raise CommandError(f"{name}: {type(error).__name__}: {error}", code=1) from None
    for row in rows:
      print(f"case {name}")
      print("\n".join(f"  {key} {value}" for key, value in _plain(row).items()))
  return 0


def execute(
  bench: Bench,
  out: pathlib.Path,
  short: bool = False,
  resume: bool = False,
  jobs: int = 1,
  seconds: float = math.inf,
) -> bool:
  """Runs the cases that are not done and returns whether all are done now.

  Rows go to `<name>.csv`, a whole case at a time; `<name>.json` says with what and on what.

  Args:
    bench: the bench
    out: output folder
    short: the short list of cases instead of the full one
    resume: keep the rows there are and skip their cases; otherwise they move to `<name>.csv.old`
    jobs: processes
    seconds: time after which no case is left running
  """
  out = out.resolve()  # the workers stand elsewhere
  out.mkdir(parents=True, exist_ok=True)
  path = out / f"{bench.name}.csv"
  if path.exists() and not resume:
    path.replace(path.with_suffix(".csv.old"))
  done = {row["case"] for row in read(path)} if path.exists() else set()
  if path.exists():
    _repair(path)
  stages = bench.stages(short)
  total = sum(len(stage) for stage in stages)
  mine = {case["case"] for stage in stages for case in stage}
  finished = len(done & mine)
  deadline = time.monotonic() + seconds
  started = time.perf_counter()
  header = ("case", "status", *bench.columns)
  progress = Progress()
  interrupted = False
  with open(path, "a", newline="", encoding="utf-8") as file:
    if file.tell() == 0:
      csv.writer(file).writerow(header)
      file.flush()
    try:
      for stage in stages:
        todo = [case for case in stage if case["case"] not in done]
        for case, status, rows in _work(bench, out, todo, jobs, deadline):
          finished += 1
          text = io.StringIO()
          writer = csv.DictWriter(text, header, restval="", extrasaction="raise")
          for row in rows or [{key: case[key] for key in case if key in bench.columns}]:
            writer.writerow({"case": case["case"], "status": status} | _plain(row))
          file.write(text.getvalue())
          file.flush()
          spent = time.perf_counter() - started
          progress.show(f"{finished}/{total} cases, {spent:.0f} s  {case['case']}", always=True)
          if finished % max(1, total // 20) == 0 and not sys.stderr.isatty():
            print(f"{bench.name}: {finished}/{total} cases, {spent:.0f} s", flush=True)
    except KeyboardInterrupt:
      interrupted = True
  progress.clear()
  about = machine() | {
    "bench": bench.name,
    "short": short,
    "seed": SEED,
    "jobs": jobs,
    "cases": total,
    "done": finished,
    "seconds": round(time.perf_counter() - started, 1),
  }
  earlier = out / f"{bench.name}.json"
  if resume and earlier.exists():
    about["seconds"] += json.loads(earlier.read_text(encoding="utf-8")).get("seconds", 0)
  earlier.write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
  if finished < total:
    reason = "interrupted" if interrupted else "out of time"
    print(f"palpate: {reason} after {finished} of {total} cases; --resume goes on from there")
  return finished >= total


SEED = 20080401  # of every random draw of the benches


def report(bench: Bench, out: pathlib.Path) -> list[pathlib.Path]:
  """Draws figures and summary from the rows in `out` and returns the paths of all files."""
  path = out / f"{bench.name}.csv"
  about_path = out / f"{bench.name}.json"
  rows = read(path)
  about = json.loads(about_path.read_text(encoding="utf-8")) if about_path.exists() else machine()
  figures = bench.draw(rows, out) if rows else []
  summary = out / f"{bench.name}.md"
  summary.write_text(bench.summarize(rows, about), encoding="utf-8")
  return [path, about_path, *figures, summary]


def read(path: pathlib.Path) -> list[Row]:
  """Returns the rows of a results file, numbers as numbers; a row cut short is left out."""
  with open(path, newline="", encoding="utf-8") as file:
    text = file.read()
  text = text[: text.rfind("\n") + 1]
  reader = csv.DictReader(io.StringIO(text))
  return [
    {key: _number(value) for key, value in row.items()}
    for row in reader
    if None not in row and None not in row.values()
  ]


def clock() -> float:
  """Returns the CPU time of this thread [s]: of work on one thread, whatever else is running."""
  return time.thread_time()


def machine() -> dict:
  """Returns the versions and the machine, for the results."""
  import mujoco
  import numpy
  import scipy
  import warp
  from palpate import __version__
  from palpate.tissue import device

  device.lower_log_level()
  device.init()
  cpu = platform.processor()
  info = pathlib.Path("/proc/cpuinfo")
  if info.exists():
    lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
    cpu = lines[0].partition(":")[2].strip() if lines else cpu
  cuda = [device.name for device in warp.get_cuda_devices()] if warp.is_cuda_available() else []
  return {
    "palpate": __version__,
    "mujoco": mujoco.__version__,
    "warp": warp.__version__,
    "numpy": numpy.__version__,
    "scipy": scipy.__version__,
    "python": platform.python_version(),
    "system": f"{platform.system()} {platform.machine()}",
    "cpu": cpu,
    "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
    "cuda": cuda,
  }


def caption(about: dict) -> str:
  """Returns the line of a summary that says what it was measured with."""
  gpu = f", {about['cuda'][0]}" if about.get("cuda") else ""
  return (
    f"palpate {about['palpate']}, mujoco {about['mujoco']}, warp {about['warp']}, Python "
    f"{about['python']}, {about['cpu']}{gpu}, {about['cores']} cores, {about.get('jobs', 1)} "
    f"processes, one thread each; seed {about.get('seed', SEED)}; "
    f"{about.get('done', '?')} of {about.get('cases', '?')} cases."
  )


def _plain(row: Row) -> Row:
  return {key: f"{value:.7g}" if isinstance(value, float) else value for key, value in row.items()}


def _number(text: str):
  for kind in (int, float):
    try:
      return kind(text)
    except ValueError:
      continue
  return text


def _repair(path: pathlib.Path):
  """Takes away a last line that was cut short."""
  data = path.read_bytes()
  if not data.endswith(b"\n"):
    path.write_bytes(data[: data.rfind(b"\n") + 1])


def _work(bench: Bench, out: pathlib.Path, cases: list[Case], jobs: int, deadline: float):
  """Yields (case, status, rows) as cases end; status is `ok`, `error: ...`, `crash` or `timeout`.

  Each process runs one case at a time and is ended when its case takes too long.
  """
  context = multiprocessing.get_context("spawn")
  todo = list(reversed(cases))
  workers: list[_Worker] = []
  try:
    while (todo and time.monotonic() < deadline) or any(w.case for w in workers):
      while todo and len(workers) < jobs and time.monotonic() < deadline:
        workers.append(_Worker(context, bench.module, out))
      for worker in workers:
        if todo and not worker.case and time.monotonic() < deadline:
          worker.give(todo.pop())
      busy = {worker.pipe: worker for worker in workers if worker.case}
      if not busy:
        break
      for pipe in connection.wait(list(busy), timeout=1.0):
        worker = busy[pipe]  # type: ignore[index]
        case = worker.case or {}
        try:
          status, rows = worker.pipe.recv()
        except (EOFError, OSError):
          status, rows = "crash", []
          worker.end()
          workers.remove(worker)
        worker.case = {}
        yield case, status, rows
      now = time.monotonic()
      for worker in list(workers):
        if worker.case and (now - worker.since > bench.limit or now > deadline):
          case = worker.case
          worker.end()
          workers.remove(worker)
          if now <= deadline:
            yield case, "timeout", []
  finally:
    for worker in workers:
      worker.end()


class _Worker:
  """A process and the case it is at."""

  def __init__(self, context, module: str, out: pathlib.Path):
    self.pipe, there = context.Pipe()
    self.process = context.Process(target=_serve, args=(there, module, str(out)), daemon=True)
    threads = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))  # read when numpy is loaded
    try:
      self.process.start()
    finally:
      for name, value in threads.items():
        if value is None:
          del os.environ[name]
        else:
          os.environ[name] = value
    there.close()
    self.case: Case = {}
    self.since = 0.0

  def give(self, case: Case):
    self.case, self.since = case, time.monotonic()
    self.pipe.send(case)

  def end(self):
    self.process.kill()
    self.process.join()
    self.pipe.close()


_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def _serve(pipe, module: str, out: str):
  """Runs cases until the pipe closes; a worker's body."""
  import signal
  import tempfile
  import traceback

  signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends its workers
  os.chdir(tempfile.gettempdir())  # MuJoCo writes its log where it stands
  register_quietly()
  bench: Bench = importlib.import_module(module).BENCH
  while True:
    try:
      case = pipe.recv()
    except EOFError:
      return
    try:
      answer = "ok", bench.run(case, pathlib.Path(out))
    except Exception as error:
      traceback.print_exc()
      text = " ".join(f"{type(error).__name__}: {error}".split())
      answer = f"error: {text[:200]}", []
    try:
      pipe.send(answer)
    except OSError:  # nobody waits any more
      return


def register_quietly():
  """Registers the plugin and keeps MuJoCo's warnings off the screen."""
  from palpate import register

  register()
  import mujoco

  mujoco.set_mju_user_warning(lambda _: None)
