"""`palpate report`: the page about a recording, or about several side by side."""

from __future__ import annotations

import argparse
import pathlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import palpate

from .console import CommandError, output_folder, writing
from .draw import film
from .trainee import keeping

if TYPE_CHECKING:
  from palpate.tasks.people.limits import Lookup

_SIZE = (480, 360)  # of a film in a page [pixels]


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  add = parser.add_argument
  add("recordings", metavar="FILE", nargs="+", help="a recording, .npz; several are compared")
  add(
    "-o", "--out", metavar="FOLDER",
    help="folder of report.html or comparison.html (the first recording's folder)",
  )  # fmt: skip
  keeping.add_references(parser)
  views = parser.add_mutually_exclusive_group()
  views.add_argument(
    "--film", action="store_true", help="replay the exercise for its film, in place of pictures"
  )
  views.add_argument(
    "--no-pictures", action="store_true", help="do not replay the exercise for its pictures"
  )


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from palpate.tasks.people import comparison, report

  paths = [pathlib.Path(name) for name in args.recordings]
  if args.film:
    film.check(".mp4")
  palpate.register()
  try:
    entries = _entries(paths, keeping.references(args.references), args.film, args.no_pictures)
    folder = output_folder("out", args.out or paths[0].parent)
    with writing(folder):
      if len(entries) > 1:
        page = comparison.write_comparison(entries, folder)
      else:
        (one,) = entries
        page = report.write_report(
          one.recording, folder, one.reference, film=one.film, pictures=one.pictures
        )
  except (OSError, ValueError) as error:
    raise CommandError(str(error)) from None
  except ImportError as error:
    raise CommandError(f"{error}; install palpate[plot]", code=1) from None
  print(f"{comparison.as_text(entries)}\n{page}")
  return 0


def _entries(
  paths: Sequence[pathlib.Path], references: Lookup, filmed: bool, blind: bool
) -> list[Any]:
  """Returns what is compared: recordings, references, and films or pictures."""
  from palpate.tasks.people import comparison
  from palpate.tasks.recording import Recording

  entries = []
  for name, path in zip(_names(paths), paths, strict=True):
    recording = Recording.load(path)
    known = references(str(recording.info.get("task", "")))
    shot = film.of_recording(recording, _SIZE) if filmed else None
    pictures = None if filmed or blind else _pictures(recording)
    entries.append(comparison.Entry(name, recording, known, shot, pictures))
  return entries


def _pictures(recording: Any) -> Any:
  """Returns the pictures of a recorded exercise, None with a word where there are none."""
  try:
    return film.strip(recording)
  except CommandError as error:
    print(error, file=sys.stderr)
    return None


def _names(paths: Sequence[pathlib.Path]) -> list[str]:
  """Returns the end of each path that tells it from the others."""
  whole = [path.resolve().with_suffix("").parts for path in paths]
  for length in range(1, max(map(len, whole)) + 1):
    names = ["/".join(parts[-length:]) for parts in whole]
    if len(set(names)) == len(names):
      return names
  return [f"{k + 1}: {path}" for k, path in enumerate(paths)]  # a file beside itself
