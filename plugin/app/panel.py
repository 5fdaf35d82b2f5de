"""`palpate panel`: makes the references that exercises are scored against.

Every episode is kept in a folder as soon as it ends, and what is there is not run again: stop and
go on at will. The folder is named after what decides an episode (sources, models, versions), so
that nothing an older version left is mixed in.
"""

import argparse
import dataclasses
import hashlib
import json
import os
import pathlib
import sys
from typing import Any

import palpate

from . import console, workers
from .console import CommandError
from .learn.evaluate import Result, perform

_SEED = 10_000  # far from the seeds that people and tests use: those stay fresh
_LEAST = 5  # successes to make a reference of
_SOURCES = {".py", ".h", ".xml", ".obj", ".stl", ".json"}


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("tasks", metavar="TASK", nargs="*", help="such as touch/easy (all)")
  add("-o", "--out", metavar="FOLDER", required=True, help="folder of the TASK.json files")
  add("--runs", metavar="FOLDER", default="out/panel", help="of the episodes (%(default)s)")
  add("--performer", metavar="NAME", default="skilled", help="as evaluate's policy (%(default)s)")
  add("--episodes", metavar="N", type=int, default=100, help="of each task (%(default)s)")
  add("--seed", metavar="N", type=int, default=_SEED, help="of the first episode (%(default)s)")
  workers.add_arguments(parser, os.cpu_count() or 1)


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  console.check_counts(args, "episodes")
  crew = workers.chosen(args)
  palpate.register()
  from palpate.tasks import suite
  from palpate.tasks.core import performer

  with console.one_line():
    pairs = [suite.split(task) for task in args.tasks] or suite.ALL_TASKS
    performer.find(args.performer)
  out = console.output_folder("out", args.out)
  runs = console.output_folder("runs", pathlib.Path(args.runs).absolute() / fingerprint())
  seeds = range(args.seed, args.seed + args.episodes)
  jobs = [("/".join(pair), args.performer, seed, str(runs)) for pair in pairs for seed in seeds]
  progress, results = console.Progress(), []
  with console.Interrupt() as interrupt:
    for job, result in zip(jobs, workers.parallel(kept, jobs, crew, interrupt), strict=False):
      if result is None:
        raise CommandError("a process died; go on with the same command", code=1)
      results.append(result)
      progress.show(f"{job[0]}, {len(results)} of {len(jobs)}")
      if len(results) % args.episodes == 0:
        progress.clear()
        _write(out, job[0], args, results[-args.episodes :])
  progress.clear()
  if interrupt.seen:
    print("palpate: interrupted; go on with the same command", file=sys.stderr)
    return 130
  return 0


def fingerprint() -> str:
  """Returns a name for what decides an episode: sources and models of the package, versions."""
  import mujoco
  import palpate.models
  import palpate.tasks
  import warp

  digest = hashlib.sha256(f"{mujoco.__version__} {warp.__version__} {palpate.__version__}".encode())
  for package in (palpate, palpate.models, palpate.tasks):
    root = pathlib.Path(str(package.__file__)).parent
    for path in sorted(p for p in root.rglob("*") if p.suffix in _SOURCES):
      if path.parent.name != "references":  # they come of the episodes
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
  return digest.hexdigest()[:12]


def kept(job: tuple[str, str, int, str]) -> Result:
  """Returns the result of an episode: task, performer, seed, folder; from there if it was run."""
  from palpate.tasks.files import replacing

  task, who, seed, folder = job
  path = pathlib.Path(folder) / f"{task} {who} {seed}.json".replace("/", "_").replace(":", "_")
  if path.exists():
    return Result(**json.loads(path.read_text(encoding="utf-8")))
  result = perform((task, who, seed, None, "{}"))
  with replacing(path) as file:
    json.dump(dataclasses.asdict(result), file)
  return result


def _write(out: pathlib.Path, task: str, args: argparse.Namespace, results: list[Result]):
  """Writes the reference of a task's successes and says how many there were."""
  import mujoco
  from palpate.tasks import suite
  from palpate.tasks.metrics import SUCCESS, Metrics
  from palpate.tasks.people.score import make_reference, to_json

  good = [Metrics.from_json(r.metrics) for r in results if r.outcome == SUCCESS]
  said = f"{task}: {len(good)} of {len(results)} episodes succeeded"
  if len(good) < min(_LEAST, len(results)):
    first = next((r.error for r in results if r.error), "")
    raise CommandError(f"{said}, too few for a reference" + (f"; {first}" if first else ""), code=1)
  data: dict[str, Any] = make_reference(good, task, args.seed, suite.ends(task))
  data |= {"performer": args.performer, "episodes": len(results)}
  data |= {"palpate": palpate.__version__, "mujoco": mujoco.__version__}
  path = out / f"{task.replace('/', '_')}.json"
  console.write(path, to_json(data))
  print(f"{path}  {said}")
