"""`palpate trainee list`: who is in a record, and what they have done."""

import argparse

from . import history, keeping


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  keeping.add_record(parser)


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from palpate.tasks.people import curriculum

  from .record import Record

  with keeping.one_line():
    record = Record(keeping.folder(args))
    for person in record.trainees():
      episodes = record.episodes(person)
      met = curriculum.done(history.passed(episodes))
      last = f", last {episodes[-1].ended[:10]}" if episodes else ""
      count = f"{len(episodes)} episode{'' if len(episodes) == 1 else 's'}{last}"
      then = curriculum.following(met) or "none"
      print(f"{person.name:24} {count}; exercises done: {len(met)}, next {then}")
    keeping.tell(record)
  return 0
