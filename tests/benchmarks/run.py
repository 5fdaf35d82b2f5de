"""Runs one benchmark: `python tests/benchmarks/run.py NAME --help`.

A bench is a module with a `BENCH` (see `runner`): its cases are data, one function runs a case and
returns rows, figures and summary are drawn from the rows.
"""

from __future__ import annotations

import argparse
import importlib
import pathlib
import sys
from collections.abc import Sequence

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))  # `benchmarks`, `reference`, `scenes`

from palpate.app.console import CommandError

BENCHES = {
  "error": "run time against error, beside MuJoCo's own flex",
  "stability": "where each scheme breaks, over a thousand runs",
  "thesis": "the tables and figures of the thesis, measured today",
  "skipping": "what switching each feature off saves",
}


def main(argv: Sequence[str] | None = None) -> int:
  """Runs the command line and returns its exit code."""
  parser = argparse.ArgumentParser("run.py", description="Measures speed, accuracy, stability.")
  benches = parser.add_subparsers(metavar="BENCH", required=True)
  for name, text in BENCHES.items():
    module = importlib.import_module(f"benchmarks.{name}")
    command = benches.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    module.add_arguments(command)
    command.set_defaults(main=module.main)
  try:
    args = parser.parse_args(argv)
    return args.main(args)
  except CommandError as error:
    print(f"run.py: {error}", file=sys.stderr)
    return error.code
  except KeyboardInterrupt:
    print("run.py: interrupted", file=sys.stderr)
    return 130


if __name__ == "__main__":
  sys.exit(main())
