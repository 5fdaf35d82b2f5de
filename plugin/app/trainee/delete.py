"""`palpate trainee delete`: deletes all of a person's data."""

import argparse

from ..console import CommandError
from . import keeping


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.epilog = (
    "Exports, files written elsewhere with --out, and backups of the folder are not part of the "
    "record. Delete them yourself."
  )
  parser.add_argument("name", metavar="NAME", help="of the person")
  keeping.add_record(parser)
  parser.add_argument("--yes", action="store_true", help="delete; else only say what would go")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from .record import Record

  folder = keeping.folder(args)
  with keeping.one_line():
    record = Record(folder)  # which makes no record where there is none
    person = record.find(args.name)
    count = len(record.episodes(person))
    if not args.yes:
      raise CommandError(
        f"{person.name!r} has {count} episodes in {str(folder)!r}; nothing is deleted without --yes"
      )
    record = Record(folder, keeping.references(None))
    keeping.tell(record)
    gone = record.delete(person)
  print(f"deleted {person.name!r}: {', '.join(gone)}; no file of {folder} has any of it left")
  return 0
