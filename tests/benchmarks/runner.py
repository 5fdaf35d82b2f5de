"""One runner for all benches: cases in turn, rows appended as they come, resumed where it stopped.

A bench is a module with a `BENCH`: its cases are data, one function runs a case and returns rows,
figures and page are drawn from the rows. Results are `<name>.csv`, notes on the machine beside it
in `<name>.json`.
"""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import math
import pathlib
import sys
import time
from collections.abc import Callable, Iterator

from benchmarks import results, workers
from benchmarks.results import Row
from palpate.app.console import CommandError
from palpate.app.workers import Cluster, Processes

Case = dict
SEED = 20080401  # of every random draw of the benches


def _nothing(*_):
  pass


@dataclasses.dataclass(frozen=True)
class Bench:
  """What a bench is made of.

  Attributes:
    name: word of the command
    stages: returns the cases of each stage, from the options; a stage starts when the one before it
      is done. A case is a dict with a unique `case`, numbers and words only.
    run: returns the rows of a case; the second argument is the output folder
    columns: columns of the CSV, after `case` and `status`; those of the first row if empty
    report: draws figures and returns the page, from the rows of cases that ended and the CSV
    arguments: declares options of its own
    begin: called with the options before the first case
    file: name of the CSV, if not `name`; "{device}" in it is the kind of device of the options
    jobs: processes unless `--jobs` says otherwise; 0 is this one, where a case that fails ends all
    limit: seconds after which a case in a process of its own is given up and noted as such
  """

  name: str
  stages: Callable[[argparse.Namespace], list[list[Case]]]
  run: Callable[[Case, pathlib.Path], list[Row]]
  columns: tuple[str, ...] = ()
  report: Callable[[list[Row], pathlib.Path], results.Page] | None = None
  arguments: Callable[[argparse.ArgumentParser], object] = _nothing
  begin: Callable[[argparse.Namespace], object] = _nothing
  file: str = ""
  jobs: int = 0
  limit: float = 600.0

  def path(self, args: argparse.Namespace) -> pathlib.Path:
    """Returns the path of the CSV."""
    device = getattr(args, "device", "cpu").partition(":")[0]
    name = (self.file or self.name).format(**vars(args) | {"device": device})
    return args.out.resolve() / f"{name}.csv"


def options(bench: Bench, words: list[str]) -> argparse.Namespace:
  """Returns the options that the words of a command line give."""
  about = sys.modules[bench.stages.__module__].__doc__ or ""
  parser = argparse.ArgumentParser(
    f"palpate bench {bench.name}", description=about, formatter_class=argparse.RawTextHelpFormatter
  )
  add = parser.add_argument
  add("-o", "--out", metavar="FOLDER", type=pathlib.Path,
      help="output folder (tests/benchmarks/results; out/bench with --short)")  # fmt: skip
  add("--short", action="store_true", help="the short form: minutes at most")
  add("--resume", action="store_true", help="continue: skip what the output folder already has")
  add("--jobs", metavar="N", type=int, default=bench.jobs,
      help="processes, 0 to stay in this one (%(default)s)")  # fmt: skip
  add("--ray", metavar="ADDRESS", nargs="?", const="",
      help="on a Ray cluster, or on a cluster of this machine alone; --jobs at a time")  # fmt: skip
  add("--minutes", metavar="M", type=float, default=math.inf,
      help="stop after so long; --resume goes on from there")  # fmt: skip
  add("--draw", action="store_true", help="only draw figures and page from the rows there are")
  add("--only", metavar="CASE", action="append", default=[],
      help="run this case again and print its rows; may be repeated; with --resume they take "
           "the place of the earlier ones")  # fmt: skip
  bench.arguments(parser)
  args = parser.parse_args(words)
  if args.jobs < 0:
    raise CommandError(f"jobs is {args.jobs}, expected a number >= 0")
  args.out = args.out or (pathlib.Path("out", "bench") if args.short else results.FOLDER)
  return args


def main(bench: Bench, words: list[str]) -> int:
  """Runs a bench and returns the exit code."""
  args = options(bench, words)
  try:
    args.out.mkdir(parents=True, exist_ok=True)
  except OSError as error:
    raise CommandError(f"cannot write to {str(args.out)!r}: {error.strerror}") from None
  if args.only and not args.resume:
    return _again(bench, args)
  complete = args.draw or execute(bench, args)
  path = bench.path(args)
  if not path.exists():
    raise CommandError(f"no {path}, expected the rows of an earlier run", code=1)
  for written in report(bench, args):
    print(written)
  failed = [row["case"] for row in results.read(path) if row["status"] != "ok"]
  if failed:
    print(f"palpate: {len(failed)} cases have failed, the first is {failed[0]}", file=sys.stderr)
  return 130 if not complete else int(bool(failed))


def _chosen(bench: Bench, args: argparse.Namespace) -> dict[str, Case]:
  """Returns all cases by name; CommandError where one that is asked for is none of them."""
  cases = {case["case"]: case for stage in bench.stages(args) for case in stage}
  for name in args.only:
    if name not in cases:
      near = difflib.get_close_matches(name, cases, 3, 0) or ["none"]
      raise CommandError(f"no case {name!r} in this bench, the nearest are {', '.join(near)}")
  return cases


def _again(bench: Bench, args: argparse.Namespace) -> int:
  """Runs single cases and prints their rows, which go into no file."""
  cases = _chosen(bench, args)
  workers.register_quietly()
  for name in args.only:
    try:
      rows = bench.run(cases[name], args.out.resolve())
    except Exception as error:
      raise CommandError(f"{name}: {type(error).__name__}: {error}", code=1) from None
    for row in rows:
      _show(name, row)
  return 0


def _show(name: str, row: Row):
  """Prints a row."""
  lines = (f"  {key} {value}" for key, value in results.plain(row).items())
  print("\n".join([f"case {name}", *lines]), flush=True)


def execute(bench: Bench, args: argparse.Namespace) -> bool:
  """Runs the cases that are not done and returns whether all are done now."""
  args.out.mkdir(parents=True, exist_ok=True)
  path = bench.path(args)
  _chosen(bench, args)
  table = results.Table(path, bench.columns, args.resume)
  table.drop(args.only)
  done = table.done()
  stages = bench.stages(args)
  total = sum(len(stage) for stage in stages)
  finished = sum(case["case"] in done for stage in stages for case in stage)
  deadline = time.monotonic() + 60 * args.minutes
  started = time.perf_counter()
  reason = "out of time"
  try:
    bench.begin(args)
    for stage in stages:
      todo = [case for case in stage if case["case"] not in done]
      for case, status, rows in _work(bench, args, todo, deadline):
        finished += 1
        kept = {key: case[key] for key in case if key in table.columns}
        table.write(case["case"], status, rows or [kept])
        if finished % max(1, total // 20) == 0:
          spent = time.perf_counter() - started
          print(f"{bench.name}: {finished}/{total} cases, {spent:.0f} s", flush=True)
  except KeyboardInterrupt:
    reason = "interrupted"
  seconds = round(time.perf_counter() - started, 1)
  if args.resume:
    seconds += results.notes(path).get("seconds", 0)
  mine = {key: value for key, value in vars(args).items() if key not in _COMMON}
  # Of a path the name alone: where things lie on a machine is nobody's business.
  mine = {k: v.name if isinstance(v, pathlib.Path) else str(v) for k, v in mine.items()}
  if args.only:
    mine["only"] = ", ".join(args.only)  # the other rows are older
  results.note(path, results.machine() | {
    "bench": bench.name,
    "short": args.short,
    "options": mine,
    "seed": SEED,
    "jobs": args.jobs,
    "cases": total,
    "done": finished,
    "seconds": seconds,
  })  # fmt: skip
  if finished < total:
    print(f"palpate: {reason} after {finished} of {total} cases; --resume goes on from there")
  return finished >= total


_COMMON = ("out", "short", "resume", "jobs", "ray", "minutes", "draw", "only")


def _work(
  bench: Bench, args: argparse.Namespace, cases: list[Case], deadline: float
) -> Iterator[tuple[Case, str, list[Row]]]:
  """Yields (case, status, rows) as cases end."""
  out = args.out.resolve()  # the workers stand elsewhere
  if args.jobs or args.ray is not None:
    crew = Processes(args.jobs) if args.ray is None else Cluster(args.ray, args.jobs or None)
    yield from workers.work(bench.run, out, cases, crew, deadline, bench.limit)
    return
  for case in cases:
    if time.monotonic() > deadline:
      return
    rows = list(bench.run(case, out))
    for row in rows:
      _show(case["case"], row)
    yield case, "ok", rows


def report(bench: Bench, args: argparse.Namespace) -> list[pathlib.Path]:
  """Draws figures and page from the rows there are and returns the paths of all files."""
  path = bench.path(args)
  if bench.report is None:
    return [path]
  rows = results.read(path)
  page = bench.report([row for row in rows if row["status"] == "ok"], path)
  lost = [f"{row['case']} ({row['status']})" for row in rows if row["status"] != "ok"]
  if lost:
    page.lines.extend(["", f"Not run to an end: {', '.join(lost)}"])
  name = path.with_name(f"{page.name or bench.name}.md")
  return [path, *page.pictures, results.write(name, page, results.notes(path))]


def clock() -> float:
  """Returns the CPU time of this thread [s]: of work on one thread, whatever else is running."""
  return time.thread_time()
