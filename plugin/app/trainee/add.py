"""`palpate trainee add`: adds people to a record."""

import argparse

from . import keeping


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("names", metavar="NAME", nargs="+", help="of a person, or a pseudonym")
  keeping.add_record(parser)


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from .record import Record

  with keeping.one_line():
    record = Record(keeping.folder(args), keeping.references(None))
    keeping.tell(record)
    for name in args.names:
      known = record.trainees()
      person = record.add(name)
      print(f"{person.name!r} is {'there already' if person in known else 'added'}")
  print(f"record     {keeping.folder(args)}")
  return 0
