"""Keeps what a person does in a record: options of the commands, and what they call at the end."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import pathlib
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from .. import console
from ..console import CommandError

if TYPE_CHECKING:
  from palpate.tasks.people.limits import Lookup
  from palpate.tasks.recording import Recording

  from .record import Record, Session, Trainee

FOLDER = "out/record"  # where a record is unless a command is told otherwise


def add_record(parser: argparse.ArgumentParser):
  """Declares the option that says where the record is."""
  text = f"folder of the trainees and their recordings ({FOLDER})"
  parser.add_argument("--record", metavar="FOLDER", help=text)


def add_references(parser: argparse.ArgumentParser):
  """Declares the option that says what is scored against."""
  parser.add_argument(
    "--references", metavar="FILE",
    help="references of scores and limits, from `palpate trainee limits` or `palpate panel` (those "
    "that ship)",
  )  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser):
  """Declares the options of a command whose exercises are kept."""
  add = parser.add_argument
  add("--trainee", metavar="NAME", help="name of the trainee; the recording goes to the record")
  add_record(parser)
  add("--any-task", action="store_true", help="allow exercises that are not open to the trainee")
  add_references(parser)


def folder(args: argparse.Namespace) -> pathlib.Path:
  """Returns where the record is."""
  return pathlib.Path(args.record or FOLDER)


def references(path: str | pathlib.Path | None) -> Lookup:
  """Returns what finds the references of tasks; CommandError says what is wrong with the file."""
  from palpate.tasks.people import limits

  try:
    return limits.lookup(None if path is None else pathlib.Path(path))
  except OSError as error:
    raise CommandError(f"references: {path}: {error.strerror or error}") from None
  except ValueError as error:
    raise CommandError(f"references: {error}") from None


@contextlib.contextmanager
def one_line():
  """Turns what is wrong with a record into one line."""
  from .record import RecordError

  try:
    with console.one_line():
      yield
  except RecordError as error:
    raise CommandError(str(error), code=1) from None


def tell(record: Record) -> None:
  """Says what people should know about a record that was opened."""
  for text in record.said:
    print(f"palpate: {text}", file=sys.stderr)


@dataclasses.dataclass(frozen=True)
class Kept:
  """What became of a recording.

  Attributes:
    path: where it is, None where it could not be kept anywhere
    fault: why it is not where it belongs; empty if it is
    said: what it means for the person, in sentences
  """

  path: pathlib.Path | None
  fault: str = ""
  said: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Keeping:
  """Where exercises are kept, and for whom; it can be sent to other processes.

  Attributes:
    folder: of the record, None without one
    trainee: who does them all; empty where each exercise says who does it
    references: file of references, None for those that ship
    any_task: whether exercises that are not open to the trainee may be done
  """

  folder: pathlib.Path | None
  trainee: str = ""
  references: str | None = None
  any_task: bool = False

  def __str__(self) -> str:
    return f"{self.folder}, of {self.trainee or 'the name on the page'}"

  def check(self, task: str) -> None:
    """Raises ValueError unless the task is open to the trainee, RecordError without a record."""
    from palpate.tasks.people import curriculum

    if before := self.locked().get(task):
      raise ValueError(
        f"task is {task!r}, which is not open to {self.trainee!r} yet: {before} comes first, "
        f"{curriculum.RULE}; --any-task does not ask"
      )

  def locked(self) -> dict[str, str]:
    """Returns the tasks that are not open to the trainee, each with the one that comes first."""
    from palpate.tasks.people import curriculum

    passed = self.passed()
    if passed is None or self.any_task:
      return {}
    met = curriculum.done(passed)
    found = {task: curriculum.locked(task, met) for task in curriculum.AFTER}
    return {task: before for task, before in found.items() if before}

  def passed(self) -> Mapping[str, Sequence[bool]] | None:
    """Returns task -> whether each attempt of the trainee was proficient, None without a record."""
    from . import history
    from .record import Record

    if self.folder is None or not self.trainee:
      return None
    record = Record(self.folder)
    return history.passed(record.episodes(record.find(self.trainee)))

  def knows(self, person: str) -> bool:
    """Returns whether what a person did goes to a record; a trainee does everything."""
    return self.folder is not None and bool(self.trainee or person)

  def begin(self, folder: pathlib.Path | None = None) -> Sitting:
    """Returns a use of the program, a session of the record; `folder` takes what nobody did."""
    from .record import Session

    return Sitting(self, Session(), references(self.references), folder or pathlib.Path("out"))


@dataclasses.dataclass(frozen=True)
class Sitting:
  """One use of the program: what is kept in it is of one session.

  Attributes:
    keeping: where
    session: of the record
    references: what finds the references of tasks
    folder: of recordings that go to no record
  """

  keeping: Keeping
  session: Session
  references: Lookup
  folder: pathlib.Path

  def reserve(self, task: str, person: str = "") -> tuple[pathlib.Path | None, dict[str, Any]]:
    """Returns the file, empty so far, that an exercise is to take, and what its `info` says first.

    No person's name is in what a record holds. Without a file, `keep` will say what is wrong.

    Args:
      task: of the exercise
      person: see `keep`
    """
    known = self.keeping.knows(person)
    info = {"record": self.session.facts()} if known else {"person": person}
    try:
      if known:
        with self._opened(person) as (record, who):
          return record.reserve(who, task), info
      path = self._free(task)
      path.touch(exist_ok=False)
      return path, info
    except (RuntimeError, ValueError, OSError):  # RecordError is a RuntimeError
      return None, info

  def keep(
    self, recording: Recording, before: Kept | None = None, path: pathlib.Path | None = None
  ) -> Kept:
    """Keeps a recording, or else puts it among the temporary files.

    It goes to the record if there is a trainee, or if its `info` has a `person`, who is added if
    new; otherwise to the folder. Only a trainee is told of the other exercises: a person who gives
    a name on a page learns nothing about its owner.

    Args:
      recording: of an exercise that ended
      before: result of a call that failed; its temporary file stays the only one
      path: from `reserve`
    """
    person = str(recording.info.get("person", ""))
    known = self.keeping.knows(person)
    folder = (known and self.keeping.folder) or self.folder
    task = str(recording.info.get("task", "exercise"))
    try:
      if known:
        return self._record(recording, person, path)
      return Kept(recording.save(path or self._free(task)))
    except (RuntimeError, ValueError, OSError) as error:  # RecordError is a RuntimeError
      fault = f"not kept in {folder}: {_why(error)}"
    if before is not None and before.path is not None:
      return Kept(before.path, fault)
    try:
      spare = pathlib.Path(tempfile.mkdtemp(prefix="palpate-"))
      return Kept(recording.save(spare / f"{_name(task)}.npz"), fault)
    except OSError as error:
      return Kept(None, f"{fault}; nor among the temporary files: {_why(error)}")

  def _free(self, task: str) -> pathlib.Path:
    from palpate.tasks.files import free

    self.folder.mkdir(parents=True, exist_ok=True)
    return free(self.folder, _name(task), ".npz")

  @contextlib.contextmanager
  def _opened(self, person: str) -> Iterator[tuple[Record, Trainee]]:
    """Gives the record, and who does the exercises."""
    from .record import Record

    assert self.keeping.folder is not None
    record = Record(self.keeping.folder, self.references)
    trainee = self.keeping.trainee
    yield record, record.find(trainee) if trainee else record.add(person)

  def _record(self, recording: Recording, person: str, path: pathlib.Path | None) -> Kept:
    with self._opened(person) as (record, who):
      episode = record.keep(who, recording, self.session, self.references, path)
      judged = self.references(episode.task) is not None
      told = self.keeping.trainee
      said = _progress(record.episodes(who), episode.task, judged) if told else ()
      tell(record)
      return Kept(record.path(episode), "", said)


def _name(task: str) -> str:
  return f"{time.strftime('%Y%m%d-%H%M%S')}_{task.replace('/', '_')}"


def _why(error: Exception) -> str:
  return getattr(error, "strerror", None) or str(error)


def read(args: argparse.Namespace, task: str = "", pages: bool = False) -> Keeping | None:
  """Returns what the options of `add_arguments` say; None where that is nothing.

  CommandError says what is wrong with them, and whether the task is not open to the trainee.

  Args:
    args: of the command
    task: that is done; empty where it is chosen later
    pages: whether a person gives a name on a page where there is no trainee
  """
  from .record import Record

  references(args.references)
  if args.trainee is None and (pages is False or args.record is None):
    for name, given in (("record", args.record is not None), ("any-task", args.any_task)):
      if given:
        raise CommandError(f"{name} is given without --trainee")
    return Keeping(None, references=args.references) if pages and args.references else None
  name = ""
  with one_line():
    if args.trainee is None:
      Record(folder(args), references(None))  # what is wrong with it is said now
    else:
      record = Record(folder(args))
      name = record.find(args.trainee).name
    keeping = Keeping(folder(args), name, args.references, args.any_task)
    keeping.check(task)
  return keeping


def _progress(episodes: Sequence[Any], task: str, judged: bool) -> tuple[str, ...]:
  """Returns what the last episode, of a task that has limits or not, means for the person."""
  from palpate.tasks.people import curriculum

  from . import history

  passed: Mapping[str, Sequence[bool]] = history.passed(episodes)
  mine, met = passed.get(task, []), curriculum.done(passed)
  before = curriculum.done({**passed, task: mine[:-1]})
  if not judged:
    return (f"Attempt {len(mine)} at {task}, which has no limits; --references FILE gives some.",)
  said = f"Attempt {len(mine)} at {task}, {sum(mine)} of them proficient"
  if task not in met:
    return (f"{said}; {curriculum.left(mine)} more, if all are, meet the rule of proficiency.",)
  then = curriculum.following(met)
  opened = f"next is {then}" if then else "all exercises are done"
  if task in before:
    return (f"{said}; {opened}.",)
  return (f"{said}: the rule of proficiency is met ({curriculum.RULE}), {opened}.",)
