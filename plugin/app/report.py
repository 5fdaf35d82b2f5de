"""`palpate report`: the page about a recording."""

from __future__ import annotations

import argparse
import json
import pathlib

from .console import CommandError


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("recording", metavar="FILE", help="a recording, .npz")
  add("-o", "--out", metavar="FOLDER", help="where report.html goes (the recording's folder)")
  add("--reference", metavar="FILE", help="expert reference, JSON (the task's own, if it has one)")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from palpate.tasks.recording import Recording
  from palpate.tasks.report import write_report
  from palpate.tasks.score import check_reference

  path = pathlib.Path(args.recording)
  try:
    recording = Recording.load(path)
    if args.reference:
      reference = json.loads(pathlib.Path(args.reference).read_text(encoding="utf-8"))
      check_reference(reference)
    else:
      reference = _own(str(recording.info.get("task", "")))
    print(write_report(recording, args.out or path.parent, reference))
  except (OSError, ValueError) as error:
    raise CommandError(str(error)) from None
  except ImportError as error:
    raise CommandError(f"{error}; install palpate[plot]", code=1) from None
  return 0


def _own(name: str):
  path = pathlib.Path(__file__).parent / "references" / f"{name.replace('/', '_')}.json"
  return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
