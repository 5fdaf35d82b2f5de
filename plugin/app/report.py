"""`palpate report`: the page about a recording."""

from __future__ import annotations

import argparse
import pathlib

from .console import CommandError, output_folder, writing


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("recording", metavar="FILE", help="a recording, .npz")
  add("-o", "--out", metavar="FOLDER", help="where report.html goes (the recording's folder)")
  add("--reference", metavar="FILE", help="expert reference, JSON (the task's own, if it has one)")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from palpate.tasks import score
  from palpate.tasks.recording import Recording
  from palpate.tasks.report import write_report

  path = pathlib.Path(args.recording)
  try:
    recording = Recording.load(path)
    if args.reference:
      reference = score.read_reference(pathlib.Path(args.reference))
    else:
      reference = score.reference(str(recording.info.get("task", "")))
    folder = output_folder("out", args.out or path.parent)
    with writing(folder):
      print(write_report(recording, folder, reference))
  except (OSError, ValueError) as error:
    raise CommandError(str(error)) from None
  except ImportError as error:
    raise CommandError(f"{error}; install palpate[plot]", code=1) from None
  return 0
