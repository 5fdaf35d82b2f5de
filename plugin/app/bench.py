"""`palpate bench NAME`: runs a measurement of `tests/benchmarks`, in a checkout alone."""

import argparse
import importlib
import pathlib
import sys

import palpate

from .console import CommandError


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.add_argument("name", metavar="NAME", nargs="?", help="which one; lists all if left out")
  parser.add_argument(
    "options", metavar="OPTION", nargs=argparse.REMAINDER, help="its own: palpate bench NAME --help"
  )


def main(args: argparse.Namespace) -> int:
  """Runs the bench and returns its exit code."""
  tests = _checkout() / "tests"
  sys.path.insert(0, str(tests))  # `benchmarks`, `reference`, `scenes`
  palpate.register()
  benches = importlib.import_module("benchmarks.run")
  if args.name is None:
    print("\n".join(f"{name:16}{text}" for name, text in benches.BENCHES.items()))
    return 0
  if args.name not in benches.BENCHES:
    raise CommandError(f"no bench {args.name!r}, expected one of {', '.join(benches.BENCHES)}")
  return benches.main(args.name, args.options)


def _checkout() -> pathlib.Path:
  """Returns the folder of the sources, that of an editable install or the one we are in."""
  for folder in (pathlib.Path(palpate.__file__).resolve().parents[1], pathlib.Path.cwd()):
    if (folder / "tests/benchmarks/run.py").is_file():
      return folder
  raise CommandError(
    "the benches are not part of the package, run the command in a checkout of Palpate's sources",
    code=1,
  )
