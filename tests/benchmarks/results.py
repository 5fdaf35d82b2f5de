"""Results files: rows in CSV, and beside them what they were measured with."""

from __future__ import annotations

import csv
import io
import json
import os
import pathlib
import platform
import subprocess
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from palpate.app.console import CommandError

FOLDER = pathlib.Path(__file__).parent / "results"
FIRST = ("case", "status")  # columns of every file

Row = dict


class Table:
  """A results file that rows are appended to, a whole case at a time.

  Args:
    path: the file
    columns: those after FIRST; those of the first row if empty
    resume: keep the rows there are; otherwise they move to `<name>.csv.old`
  """

  def __init__(self, path: pathlib.Path, columns: Iterable[str] = (), resume: bool = False):
    self.path = path
    self.columns = tuple(columns)
    if path.exists() and not resume:
      path.replace(path.with_suffix(".csv.old"))
    if path.exists():
      _repair(path)
      with open(path, newline="", encoding="utf-8") as file:
        head = tuple(next(csv.reader(file), ()))
      if head[:2] != FIRST or (self.columns and head[2:] != self.columns):
        raise CommandError(f"{path} is of another form, so it cannot be resumed")
      self.columns = head[2:]
    elif self.columns:
      self._append([[*FIRST, *self.columns]])

  def done(self) -> set[str]:
    """Returns the cases that have rows."""
    return {row["case"] for row in read(self.path)} if self.path.exists() else set()

  def drop(self, cases: Iterable[str]):
    """Takes out the rows of cases that are to be run again."""
    gone = set(cases) & self.done()
    if gone:
      with open(self.path, newline="", encoding="utf-8") as file:
        head, *lines = csv.reader(file)
      self.path.write_text("")
      self._append([head, *(line for line in lines if line[0] not in gone)])

  def write(self, case: str, status: str, rows: list[Row]):
    """Appends the rows of a case."""
    head = []
    if not self.columns:
      if not rows:
        return
      self.columns = tuple(rows[0])
      head = [[*FIRST, *self.columns]]
    for row in rows:
      unknown = set(row) - set(self.columns)
      if unknown:
        raise ValueError(f"case {case!r}: no columns {sorted(unknown)}, there are {self.columns}")
    lines = [[plain(row).get(key, "") for key in self.columns] for row in rows]
    self._append([*head, *([case, status, *line] for line in lines)])

  def _append(self, lines: list[list]):
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    with open(self.path, "a", newline="", encoding="utf-8") as file:
      file.write(text.getvalue())


def read(path: pathlib.Path) -> list[Row]:
  """Returns the rows of a results file, numbers as numbers; a row cut short is left out."""
  with open(path, newline="", encoding="utf-8") as file:
    text = file.read()
  text = text[: text.rfind("\n") + 1]
  reader = csv.DictReader(io.StringIO(text))
  return [
    {"status": "ok"} | {key: _number(value) for key, value in row.items()}
    for row in reader
    if None not in row and None not in row.values()
  ]


def plain(row: Row) -> Row:
  """Returns a row with seven digits of every number."""
  return {key: f"{value:.7g}" if isinstance(value, float) else value for key, value in row.items()}


def _number(text: str):
  for kind in (int, float):
    try:
      return kind(text)
    except ValueError:
      continue
  return text


def _repair(path: pathlib.Path):
  """Takes away a last line that was cut short."""
  data = path.read_bytes()
  if not data.endswith(b"\n"):
    path.write_bytes(data[: data.rfind(b"\n") + 1])


def machine() -> dict:
  """Returns the versions and the machine."""
  import mujoco
  import numpy
  import scipy
  import warp
  from palpate import __version__
  from palpate.tissue import device as devices

  devices.lower_log_level()
  devices.init()
  cpu = platform.processor()
  info = pathlib.Path("/proc/cpuinfo")
  if info.exists():
    lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
    cpu = lines[0].partition(":")[2].strip() if lines else cpu
  cuda = [device.name for device in warp.get_cuda_devices()] if warp.is_cuda_available() else []
  return {
    "palpate": __version__,
    "commit": _commit(),
    "mujoco": mujoco.__version__,
    "warp": warp.__version__,
    "numpy": numpy.__version__,
    "scipy": scipy.__version__,
    "python": platform.python_version(),
    "system": f"{platform.system()} {platform.machine()}",
    "cpu": cpu,
    "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
    "cuda": cuda,
  }


def _commit() -> str:
  """Returns the commit, with `-dirty` if more than results has changed; empty without git."""

  def ask(*words: str) -> str:
    git = ["git", "-C", str(FOLDER), *words]
    return subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()

  try:
    changed = ask("status", "--porcelain", "--untracked-files=no", ":/", ":(exclude).")
    return ask("rev-parse", "--short", "HEAD") + "-dirty" * bool(changed)
  except (OSError, subprocess.CalledProcessError):
    return ""


def notes(path: pathlib.Path) -> dict:
  """Returns the notes beside a results file."""
  path = path.with_suffix(".json")
  return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def note(path: pathlib.Path, about: dict):
  """Writes the notes beside a results file."""
  path.with_suffix(".json").write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")


def caption(about: dict) -> str:
  """Returns the line of a page that says what it was measured with, as far as that is known."""
  names = ("palpate", "commit", "mujoco", "warp")
  words = [f"{name} {about[name]}" for name in names if about.get(name)]
  words += [f"Python {about['python']}"] if "python" in about else []
  words += [about[name] for name in ("cpu",) if name in about] + about.get("cuda", [])[:1]
  words += [f"{about['cores']} cores"] if "cores" in about else []
  words += [f"{about['jobs'] or 1} processes, one thread each"] if "jobs" in about else []
  line = ", ".join(words)
  if "cases" in about:
    line += f"; seed {about['seed']}; {about['done']} of {about['cases']} cases"
  return f"{line}." if line else ""


class Page(NamedTuple):
  """What a bench tells of its rows.

  Attributes:
    title: of the page
    finding: one to three lines that answer the page's question, with numbers from the rows
    lines: tables and what explains them
    pictures: what was drawn, in the folder of the page; the first shows the finding
    name: of the file, if not that of the bench
  """

  title: str
  finding: list[str]
  lines: list[str]
  pictures: Sequence[pathlib.Path] = ()
  name: str = ""


def write(path: pathlib.Path, page: Page, about: dict) -> pathlib.Path:
  """Writes a page and returns its path.

  A page begins with its title, its finding and its plot. What its rows are older than (`older` in
  the notes, written by hand until the next run), what it was measured with, the command and the
  lines follow. What an existing page has from `## Remarks` on was written by hand and stays.

  Args:
    path: the page
    page: what it says
    about: notes on the machine and the run
  """
  if len(page.finding) > 3:
    raise ValueError(f"{path.name}: the finding has {len(page.finding)} lines, expected at most 3")
  head = [f"- {line}" for line in page.finding or ["Too few rows for a finding."]]
  if about.get("done", 0) < about.get("cases", 0):
    head += ["", f"The run is incomplete: {about['done']} of {about['cases']} cases."]
  head += ["", f"![{page.title}]({page.pictures[0].name})"] if page.pictures else []
  head += ["", f"**Older.** {about['older']}"] if about.get("older") else []
  command = f"    palpate bench {about.get('bench', path.stem)}"
  command += " --short" if about.get("short") else ""
  options = about.get("options", {})
  command += "".join(
    f" --{key} {options[key]}"
    for key in ("device", "beside")
    if options.get(key, "None") not in ("None", "cpu")
  )
  known = [word for line in (caption(about), command) if line for word in (line, "")]
  text = "\n".join([f"# {page.title}", "", *head, "", *known, *page.lines]).rstrip("\n") + "\n"
  before = path.read_text(encoding="utf-8") if path.exists() else ""
  _, mark, remarks = before.partition(REMARKS)
  path.write_text(text + mark + remarks, encoding="utf-8")
  return path


REMARKS = "\n## Remarks\n"


def link(path: pathlib.Path) -> str:
  """Returns a line that names the file that a page is from."""
  return f"From [{path.name}]({path.name})."
