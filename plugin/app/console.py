"""What the subcommands share: one-line errors, Ctrl-C as a flag, files to write, tables."""

from __future__ import annotations

import argparse
import contextlib
import csv
import importlib.util
import math
import os
import pathlib
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence


class CommandError(Exception):
  """Ends the command with one line for people.

  Attributes:
    code: exit code; 2 for a wrong option or scene, 1 for what did not work
  """

  def __init__(self, message: str, code: int = 2):
    super().__init__(" ".join(message.split()))
    self.code = code


def compile_error(error: Exception) -> str:
  """Returns what the plugin said, of an error of MuJoCo's compiler, or else the whole of it."""
  lines = str(error).splitlines()
  said = [line for line in lines if line.startswith("palpate.organ: ")]  # MuJoCo says it twice
  return said[0].removeprefix("palpate.organ: ") if said else str(error)


def check_counts(args: argparse.Namespace, *names: str):
  """Raises CommandError where one of the options is no whole number >= 1."""
  for name in names:
    if getattr(args, name) < 1:
      raise CommandError(f"{name} is {getattr(args, name)}, expected a whole number >= 1")


@contextlib.contextmanager
def one_line(*kinds: type[Exception], before: str = "") -> Iterator[None]:
  """Turns a ValueError, or an error of other kinds, into one line, with words before it."""
  try:
    yield
  except (ValueError, *kinds) as error:
    raise CommandError(f"{before}{error}") from None


class Interrupt:
  """Makes Ctrl-C a flag while the block runs; a second Ctrl-C raises KeyboardInterrupt.

  So a step is never cut in half, and what was measured is kept.
  """

  def __init__(self):
    self.seen = False
    self._before = None

  def __enter__(self) -> Interrupt:
    self._before = signal.signal(signal.SIGINT, self._handle)
    return self

  def __exit__(self, *_):
    signal.signal(signal.SIGINT, self._before or signal.default_int_handler)

  def __call__(self) -> bool:
    """Returns whether Ctrl-C was pressed."""
    return self.seen

  def _handle(self, *_):
    if self.seen:
      raise KeyboardInterrupt
    self.seen = True


class Progress:
  """One line on standard error that is written over.

  Unless both the output and the errors go to a terminal it is silent, or writes a line from time to
  time.
  """

  def __init__(self, every: float = 0.1, lines: float = math.inf):
    """Shows a text at most once in `every` seconds; without a terminal once in `lines` seconds."""
    self._on = sys.stdout.isatty() and sys.stderr.isatty()
    self._every = every if self._on else lines
    self._next = 0.0 if self._on else time.perf_counter() + lines

  def show(self, text: str, always: bool = False):
    """Shows the text if it is time; on a terminal also with `always`."""
    now = time.perf_counter()
    if now >= self._next or (always and self._on):
      self._next = now + self._every
      start, end = ("\r\033[K", "") if self._on else ("", "\n")
      print(f"{start}{text}", end=end, file=sys.stderr, flush=True)

  def clear(self):
    """Takes the line away."""
    if self._on:
      print("\r\033[K", end="", file=sys.stderr, flush=True)


def need(extra: str, *modules: str):
  """Raises CommandError, naming the extra to install, if a module is missing."""
  missing = [name for name in modules if importlib.util.find_spec(name) is None]
  if missing:
    verb = "is" if len(missing) == 1 else "are"
    raise CommandError(
      f"{', '.join(missing)} {verb} not installed: pip install 'palpate[{extra}]'", code=1
    )


def output(option: str, name: str | os.PathLike[str], suffixes: Sequence[str] = ()) -> pathlib.Path:
  """Returns the path of a file to write, its folder made: said before the work, not after it.

  Args:
    option: that names the file, for the error
    name: of the file
    suffixes: that it may end in, any where there are none

  Raises:
    CommandError: it cannot be written.
  """
  path = pathlib.Path(name)
  if suffixes and path.suffix.lower() not in suffixes:
    *others, last = suffixes
    allowed = f"{', '.join(others)} or {last}" if others else last
    raise CommandError(f"{option} is {str(name)!r}, expected a name that ends in {allowed}")
  with writing(path, f"{option}: "):
    if path.is_dir():
      raise IsADirectoryError(None, "it is a folder")
    if path.exists() and not os.access(path, os.W_OK):
      raise PermissionError(None, "permission denied")
    output_folder(option, path.parent)
  return path


def output_folder(option: str, name: str | os.PathLike[str]) -> pathlib.Path:
  """Returns a folder to write to, made if it is missing; as `output`."""
  path = pathlib.Path(name)
  with writing(path, f"{option}: "):
    path.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=path).close()
  return path


@contextlib.contextmanager
def writing(path: pathlib.Path, before: str = "") -> Iterator[None]:
  """Turns what the system says about a file into one line that names it."""
  try:
    yield
  except OSError as error:
    why = error.strerror or str(error)
    raise CommandError(f"{before}cannot write {str(path)!r}: {why}", code=1) from None


def write(path: pathlib.Path, text: str):
  """Writes a file, whole or not at all; CommandError where it cannot be written."""
  from palpate.tasks.files import replacing

  with writing(path), replacing(path) as file:
    file.write(text)


@contextlib.contextmanager
def csv_rows(path: pathlib.Path, header: Iterable[str]) -> Iterator[Callable[[Iterable], None]]:
  """Gives a function that writes a row of a CSV file; numbers have seven digits."""
  with writing(path), path.open("w", newline="", encoding="utf-8") as file:
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(header)
    yield lambda row: writer.writerow(f"{v:.7g}" if isinstance(v, float) else v for v in row)


def table(rows: Iterable[tuple[str, str]]) -> str:
  """Returns the rows as two aligned columns."""
  rows = list(rows)
  left = max(len(name) for name, _ in rows)
  right = max(len(value) for _, value in rows)
  return "\n".join(f"{name:<{left}}  {value:>{right}}" for name, value in rows)
