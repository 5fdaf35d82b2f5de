"""`palpate trainee export`: writes all of a person's data, for the person or for a study."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import math
import os
import pathlib
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..console import CommandError, csv_rows, writing
from . import keeping

if TYPE_CHECKING:
  from .record import Episode, Record, Trainee

_PLAIN = ("ended", "session", "performer", "task", "seed", "outcome", "seconds", "score",
          "proficient", "assessment", "hints")  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options."""
  parser.epilog = (
    "trainee.json contains the whole record; episodes.csv has a row for each episode, "
    "metrics in SI units. `palpate report` and `palpate exercise --replay` read the recordings."
  )
  add = parser.add_argument
  add("name", metavar="NAME", help="of the person")
  keeping.add_record(parser)
  add("--anonymous", action="store_true", help="leave out the name")
  add("-o", "--out", metavar="FILE|FOLDER", required=True, help="a new folder, or a .zip")


def main(args: argparse.Namespace) -> int:
  """Runs the job and returns its exit code."""
  from .record import Record

  out = pathlib.Path(args.out)
  if out.exists():
    raise CommandError(f"out is {args.out!r}, which is there already")
  with keeping.one_line():
    record = Record(keeping.folder(args))
    person = record.find(args.name)
    if args.anonymous:
      named = dataclasses.replace(person, name="")
    else:
      named = person
    episodes = record.episodes(person)
    keeping.tell(record)
    with writing(out), _complete(out) as folder:
      missing = _write(folder, record, named, episodes)
  for name in missing:
    print(f"palpate: {name}: the recording is missing", file=sys.stderr)
  print(f"{len(episodes)} episodes, {len(episodes) - len(missing)} recordings  {out}")
  return 1 if missing else 0


@contextlib.contextmanager
def _complete(out: pathlib.Path):
  """Gives a folder to write to, whose files are at `out` once all are there, or nothing is."""
  out.parent.mkdir(parents=True, exist_ok=True)
  folder = pathlib.Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.parent))  # 0700
  try:
    yield folder
    if out.suffix.lower() == ".zip":
      files = sorted(path for path in folder.rglob("*") if path.is_file())
      part = folder / "part.zip"
      with zipfile.ZipFile(part, "x", zipfile.ZIP_DEFLATED) as archive:
        for path in files:
          archive.write(path, path.relative_to(folder).as_posix())
      part.chmod(0o600)
      os.replace(part, out)
    else:
      os.replace(folder, out)
  finally:
    shutil.rmtree(folder, ignore_errors=True)


def _write(
  folder: pathlib.Path, record: Record, person: Trainee, episodes: Sequence[Episode]
) -> list[str]:
  """Writes the files, and returns the recordings that are missing."""
  (folder / "recordings").mkdir()
  missing, rows = [], []
  for episode in episodes:
    source = record.path(episode)
    name = f"recordings/{source.name}"
    rows.append(_row(episode) | {"recording": name})
    try:
      shutil.copyfile(source, folder / name, follow_symlinks=False)
    except FileNotFoundError:
      missing.append(episode.path)
  sessions = {row["session"]: row["performer"] for row in rows}
  data: dict[str, Any] = {"format": "palpate-trainee", "version": 1}
  data |= dataclasses.asdict(person) | {"sessions": sessions, "episodes": rows}
  text = json.dumps(data, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
  (folder / "trainee.json").write_text(text, encoding="utf-8")
  known = list(dict.fromkeys(name for row in rows for name in row["metrics"]))
  with csv_rows(folder / "episodes.csv", [*_PLAIN, "recording", *known]) as write:
    for row in rows:
      write([*(row[k] for k in [*_PLAIN, "recording"]), *(row["metrics"].get(k) for k in known)])
  for path in folder.rglob("*"):
    path.chmod(0o700 if path.is_dir() else 0o600)
  return missing


def _row(episode: Episode) -> dict[str, Any]:
  """Returns an episode as JSON has it."""
  row = {f.name: getattr(episode, f.name) for f in dataclasses.fields(episode)}
  del row["path"]
  values = episode.metrics.values()
  row["metrics"] = {k: float(v) for k, v in values.items() if math.isfinite(v)}
  row["unknown"] = episode.metrics.reasons()
  return row
