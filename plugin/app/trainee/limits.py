"""`palpate trainee limits`: makes proficiency limits of experts' recordings."""

import argparse
import pathlib
import sys
from collections.abc import Iterator
from typing import Any

import palpate

from ..console import CommandError, output, write
from . import keeping


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.epilog = (
    "The option --references of exercise, evaluate, serve, report and trainee show takes the file. "
    "Limits are made from successes. Other exercises use the references that ship."
  )
  add = parser.add_argument
  add("recordings", metavar="FILE", nargs="*", help="recordings, .npz, beside those of --trainee")
  add("--trainee", metavar="NAME", action="append", default=[], help="an expert; may be repeated")
  keeping.add_record(parser)
  add(
    "--rule", default="panel",
    help="panel: as the references that ship, 95 %% of the experts pass limits made of the others; "
    "sd:K: mean and K SDs; percentile:P (%(default)s)",
  )  # fmt: skip
  add("-o", "--out", metavar="FILE", required=True, help="file of the references, .json")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from palpate.tasks.metrics import SUCCESS
  from palpate.tasks.people import limits

  if not args.recordings and not args.trainee:
    raise CommandError("no FILE and no --trainee to make limits of")
  path = output("out", args.out, (".json",))
  found: dict[str, list[Any]] = {}
  made, few = {}, []
  with keeping.one_line():
    limits.rule(args.rule)
    for task, outcome, metrics in [*_of_files(args), *_of_people(args)]:
      found.setdefault(task, []).extend([metrics] if outcome == SUCCESS else [])
    for task, results in sorted(found.items()):
      try:
        made[task] = limits.of_people(results, task, args.rule) | {"palpate": palpate.__version__}
        print(f"{task}: limits of {len(results)} successes")
      except ValueError as error:
        few.append(str(error))
  for text in few:
    print(f"palpate: {text}", file=sys.stderr)
  if not made:
    raise CommandError("no limits were made", code=1)
  write(path, limits.to_json(made))
  print(f"references {path}")
  return 0


def _of_files(args: argparse.Namespace) -> Iterator[tuple[str, str | None, Any]]:
  """Yields task, outcome and metrics of the recordings that are given."""
  from palpate.tasks.recording import Recording

  for name in args.recordings:
    path = pathlib.Path(name)
    try:
      recording = Recording.load(path)
    except OSError as error:
      raise CommandError(f"{path}: {error.strerror or error}") from None
    yield str(recording.info.get("task", "")), recording.outcome, recording.metrics()


def _of_people(args: argparse.Namespace) -> Iterator[tuple[str, str | None, Any]]:
  """Yields task, outcome and metrics of what people of the record did."""
  from .record import Record

  if not args.trainee:
    return
  record = Record(keeping.folder(args))
  for name in dict.fromkeys(args.trainee):
    for episode in record.episodes(record.find(name)):
      yield episode.task, episode.outcome, episode.metrics
