"""A record of people's training: a folder with a database and their recordings.

    FOLDER/record.sqlite                  trainees, sessions, episodes; see `database`
    FOLDER/recordings/ID/trainee.json     who ID is
    FOLDER/recordings/ID/TIME_TASK.npz    recordings, see `recording.Recording`

A recording is written before its row is, and holds all that the row says: a row that is missing,
since a process was killed or the disk was full in between, is made when the record is opened
the next time, and so is a whole database from the recordings. No name stands in a path or in a
recording. Folders that this makes are their owner's alone (0700), and so is every file (0600).
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import json
import math
import pathlib
import re
import unicodedata
import uuid
from collections.abc import Iterator
from typing import Any

from palpate.tasks.files import free, replacing
from palpate.tasks.metrics import METRICS, Metrics, Unknown
from palpate.tasks.people.curves import Attempt
from palpate.tasks.people.limits import Lookup
from palpate.tasks.people.score import score
from palpate.tasks.recording import Recording

from . import database
from .database import PendingError, RecordError

RECORDINGS = "recordings"
_WHO = "trainee.json"
_LONGEST = 80  # name
_ID = re.compile(r"[0-9a-f]{32}")


@dataclasses.dataclass(frozen=True)
class Trainee:
  """A person of a record.

  Attributes:
    id: drawn at random; names the folder of recordings
    name: that people know
    added: when, UTC
  """

  id: str
  name: str
  added: str


@dataclasses.dataclass(frozen=True)
class Episode(Attempt):
  """An exercise that was done. Score and proficiency are those by the limits of then.

  Attributes:
    path: of the recording, from the record's folder
    session: one use of the program: its id
    performer: such as device:mouse
    ended: when, UTC
    task: such as "touch/easy"
    seed: of the episode
    seconds: simulated [s]
    hints: that the coach gave
    versions: of the programs
  """

  path: str
  session: str
  performer: str
  ended: str
  task: str
  seed: int | None
  seconds: float
  hints: int
  versions: dict[str, str]


@dataclasses.dataclass(frozen=True)
class Session:
  """One use of the program by one person; its id is drawn and its time taken when it is made."""

  id: str = dataclasses.field(default_factory=lambda: uuid.uuid4().hex)
  began: str = dataclasses.field(default_factory=lambda: now())


def now() -> str:
  """Returns the time, UTC."""
  return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")


def check_name(name: Any, option: str = "trainee") -> str:
  """Returns a person's name as it is kept; ValueError for what is none, given as `option`."""
  text = unicodedata.normalize("NFC", name).strip() if isinstance(name, str) else ""
  if not (0 < len(text) <= _LONGEST and text.isprintable()):
    shown = str(name)[:_LONGEST]
    raise ValueError(
      f"{option} is {shown!r}, expected a name of 1 to {_LONGEST} printable characters"
    )
  return text


class Record:
  """A record, open until it is closed; use it as a context.

  Attributes:
    folder: of the record
    said: what people should know about it: a damaged file that was kept aside, rows made anew
  """

  def __init__(self, folder: pathlib.Path, references: Lookup | None = None):
    """Opens a record; with `references` to write to it, and makes it if there is none.

    Args:
      folder: of the record
      references: what episodes that have no row yet are scored by, see `limits.lookup`
    """
    self.folder, self.said = folder, []
    self._path = folder / database.FILE
    if references is None:
      self._db = database.open_to_read(self._path)
      return
    self._db, aside = database.open_to_write(self._path)
    if aside is not None:
      text = f"{self._path} was damaged: it is kept as {aside.name}, and made anew of recordings"
      self.said.append(text)
    try:
      with database.named(folder / RECORDINGS):
        database.private_folder(folder / RECORDINGS)
      with self._writing():
        self._enter_missing(references)
    except RecordError as error:  # a full disk: they wait on
      self.said.append(f"{error}; some recordings have no row yet")

  def __enter__(self) -> Record:
    return self

  def __exit__(self, *_):
    self.close()

  def close(self) -> None:
    """Closes the record."""
    self._db.close()

  @contextlib.contextmanager
  def _writing(self) -> Iterator[None]:
    with database.named(self._path), database.transaction(self._db):
      yield

  def _rows(self, query: str, *values: Any) -> list[tuple]:
    with database.named(self._path):
      return self._db.execute(query, values).fetchall()

  # People.

  def trainees(self) -> list[Trainee]:
    """Returns the people, by name."""
    return [Trainee(*row) for row in self._rows("select * from trainee order by name")]

  def find(self, name: str) -> Trainee:
    """Returns a person; RecordError names those that there are."""
    name = check_name(name)
    people = self.trainees()
    for person in people:
      if person.name == name:
        return person
    known = ", ".join(repr(p.name) for p in people[:20]) or "nobody yet"
    raise RecordError(f"no trainee {name!r} in {str(self.folder)!r}, it has {known}")

  def add(self, name: str) -> Trainee:
    """Returns a person, who is added if there is none of the name."""
    name = check_name(name)
    with self._writing():
      rows = self._rows("select * from trainee where name = ?", name)
      if rows:
        return Trainee(*rows[0])
      person = Trainee(uuid.uuid4().hex, name, now())
      folder = self.folder / RECORDINGS / person.id
      database.private_folder(folder)
      _write_private(folder / _WHO, json.dumps(dataclasses.asdict(person)))
      self._db.execute("insert into trainee values (?, ?, ?)", dataclasses.astuple(person))
    return person

  # Episodes.

  def episodes(self, person: Trainee) -> list[Episode]:
    """Returns what a person has done, in order."""
    rows = self._rows(
      "select outcome, score, proficient, assessment, metrics, path, session.id, performer, ended,"
      " task, seed, seconds, hints, versions from episode join session on session = session.id"
      " where trainee = ? order by episode.id",
      person.id,
    )
    return [_episode(row) for row in rows]

  def keep(
    self, person: Trainee, recording: Recording, session: Session, references: Lookup
  ) -> Episode:
    """Keeps a recording and its row, and returns what is kept.

    PendingError where the recording is kept but its row is not yet; RecordError where neither is.
    """
    ended = now()
    info = {k: v for k, v in recording.info.items() if k != "person"}
    info["record"] = {"session": session.id, "began": session.began, "ended": ended}
    recording = dataclasses.replace(recording, info=info)
    task = re.sub(r"\W+", "_", str(info.get("task", "exercise")), flags=re.ASCII)[:_LONGEST]
    path = None
    try:
      # The file too: nobody else shall find it before its row, and enter it.
      with self._writing():
        if not self._rows("select 1 from trainee where id = ?", person.id):
          raise RecordError(f"{person.name!r} is no longer in {str(self.folder)!r}")
        folder = self.folder / RECORDINGS / person.id
        file = free(folder, f"{re.sub('[^0-9]', '', ended[:23])}_{task}", ".npz")
        with database.named(file):
          database.private_folder(folder)
          path = recording.save(file)
          path.chmod(0o600)
        self._enter(person, path, recording, references)
    except RecordError as error:
      if path is None:
        raise
      raise PendingError(str(error), path) from None
    return next(e for e in self.episodes(person) if self.folder / e.path == path)

  def path(self, episode: Episode) -> pathlib.Path:
    """Returns where a recording is; RecordError unless that is a file of the record."""
    path = self.folder / episode.path
    inside = (self.folder / RECORDINGS).resolve()
    if not path.resolve().is_relative_to(inside):
      raise RecordError(f"{self._path}: recording {episode.path!r} is outside of the record")
    return path

  def _enter(
    self, person: Trainee, path: pathlib.Path, recording: Recording, references: Lookup
  ) -> None:
    """Makes the row of a recording."""
    info = recording.info
    kept: Any = info.get("record")
    kept = kept if isinstance(kept, dict) else {}
    session = Session(str(kept.get("session", person.id)), str(kept.get("began", person.added)))
    owners = self._rows("select trainee from session where id = ?", session.id)
    if owners not in ([], [(person.id,)]):  # a file that was copied from another's folder
      session = dataclasses.replace(session, id=person.id)
    row = (session.id, person.id, session.began, str(info.get("performer", "")))
    self._db.execute("insert or ignore into session values (?, ?, ?, ?)", row)
    row = {
      "session": session.id,
      "path": path.relative_to(self.folder).as_posix(),
      "ended": str(kept.get("ended", person.added)),
      **_facts(recording, references),
    }
    names, marks = ", ".join(row), ", ".join("?" * len(row))
    self._db.execute(f"insert into episode ({names}) values ({marks})", tuple(row.values()))

  def _enter_missing(self, references: Lookup) -> None:
    """Makes the rows of recordings, and people, that have none."""
    known = {path for (path,) in self._rows("select path from episode")}
    people = {person.id: person for person in self.trainees()}
    count = 0
    for folder in sorted((self.folder / RECORDINGS).iterdir()):
      if not _ID.fullmatch(folder.name) or folder.is_symlink():
        continue
      for part in folder.glob(".*.part"):  # of a process that was killed: nobody else writes now
        part.unlink(missing_ok=True)
      paths = sorted(folder.glob("*.npz"))
      paths = [p for p in paths if p.relative_to(self.folder).as_posix() not in known]
      person = people.get(folder.name) or self._restore(folder)
      if person is None:
        continue
      for path in paths:
        try:
          self._enter(person, path, Recording.load(path), references)
          count += 1
        except (ValueError, TypeError, KeyError, OSError) as error:  # whoever put it there
          self.said.append(f"{path}: not entered: {error}")
    if count:
      self.said.append(f"{count} recordings had no row in {self._path}, they have now")

  def _restore(self, folder: pathlib.Path) -> Trainee | None:
    """Returns the person whose folder it is, entered; None where nobody can say who that is."""
    try:
      person = Trainee(**json.loads((folder / _WHO).read_text(encoding="utf-8")))
      person = Trainee(folder.name, check_name(person.name), str(person.added))
    except (ValueError, TypeError, OSError) as error:
      self.said.append(f"{folder / _WHO}: {error}; its recordings are not entered")
      return None
    if self._rows("select 1 from trainee where name = ?", person.name):
      self.said.append(f"{folder / _WHO}: there is another {person.name!r}; not entered")
      return None
    self._db.execute("insert into trainee values (?, ?, ?)", dataclasses.astuple(person))
    return person

  # Deletion.

  def delete(self, person: Trainee) -> list[str]:
    """Deletes all of a person's data, and returns what it was; RecordError where some is left."""
    episodes = self.episodes(person)
    sessions = len({e.session for e in episodes})
    folder = self.folder / RECORDINGS / person.id
    with self._writing():
      files = _remove(folder)
      self._db.execute("delete from trainee where id = ?", (person.id,))
    with database.named(self._path):
      self._db.execute("vacuum")  # writes every page that is left anew
      self._db.execute("pragma wal_checkpoint(truncate)")
    if left := self.traces(person):
      text = f"{', '.join(map(str, left))}: still has data of {person.name!r}"
      raise RecordError(f"{text}; close other programs that use it, or delete it, and try again")
    return [f"{len(episodes)} episodes in {sessions} sessions", f"{files} files in {folder}"]

  def traces(self, person: Trainee) -> list[pathlib.Path]:
    """Returns the files of the record that have a person's id in them, used or not."""
    word = person.id.encode()
    files = (p for p in sorted(self.folder.rglob("*")) if p.is_file() and not p.is_symlink())
    return [p for p in files if p.suffix != ".npz" and word in p.read_bytes()]


def _remove(folder: pathlib.Path) -> int:
  """Removes a folder of recordings and returns how many files there were."""
  if folder.is_symlink():
    folder.unlink()  # what it leads to is not the record's
    return 0
  if not folder.is_dir():
    return 0
  files = [path for path in folder.iterdir() if path.is_symlink() or not path.is_dir()]
  for path in files:
    path.unlink()
  folder.rmdir()
  return len(files)


def _write_private(path: pathlib.Path, text: str) -> None:
  with replacing(path) as file:
    file.write(text)
  path.chmod(0o600)


def _facts(recording: Recording, references: Lookup) -> dict[str, Any]:
  """Returns the columns of a recording's row that follow from it."""
  info, metrics = recording.info, recording.metrics()
  task, coach = str(info.get("task", "")), info.get("coach")
  coach = coach if isinstance(coach, dict) else {"assessment": True}
  hints = coach.get("hints")
  reference = references(task)
  judged = None if reference is None else score(metrics, reference, recording.outcome)
  seed = info.get("seed")
  values = {k: v if math.isfinite(v) else None for k, v in metrics.values().items()}
  return {
    "task": task,
    "seed": seed if type(seed) is int and abs(seed) < 2**63 else None,
    "outcome": recording.outcome or "not recorded",
    "seconds": float(recording.time[-1] - recording.time[0]) if len(recording.time) else 0.0,
    "score": judged.composite if judged and math.isfinite(judged.composite) else None,
    "proficient": judged is not None and judged.proficient,
    "assessment": coach.get("assessment") is True,
    "hints": len(hints) if isinstance(hints, list) else 0,
    "metrics": json.dumps({"values": values, "unknown": metrics.reasons()}, allow_nan=False),
    "versions": json.dumps({k: str(info[k]) for k in ("palpate", "mujoco") if k in info}),
  }


def _episode(row: tuple) -> Episode:
  outcome, value, proficient, assessment, metrics, *middle, versions = row
  found = json.loads(metrics)
  values = {
    name: Unknown(found["unknown"].get(name, "not recorded")) if number is None else number
    for name, number in found["values"].items()
    if name in METRICS  # not one of another version's
  }
  head = [outcome, value, bool(proficient), bool(assessment), Metrics(**values)]
  columns: list[Any] = [*head, *middle, json.loads(versions)]
  return Episode(*columns)
