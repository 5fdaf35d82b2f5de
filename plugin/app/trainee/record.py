"""A record of people's training: a folder of their recordings.

    FOLDER/recordings/ID/trainee.json     who ID is
    FOLDER/recordings/ID/TIME_TASK.npz    recordings, see `recording.Recording`

A recording that is kept has its score and metrics in `info`, by the limits of then, so that a list
reads no samples. No name stands in a path or in a recording. Folders that this makes are their
owner's alone (0700), and so is every file (0600).
"""

import contextlib
import dataclasses
import datetime
import json
import math
import os
import pathlib
import re
import time
import unicodedata
import uuid
from collections.abc import Iterator
from typing import Any

from palpate.tasks.files import free, replacing
from palpate.tasks.metrics import METRICS, Metrics, Unknown
from palpate.tasks.people import limits
from palpate.tasks.people.curves import Attempt
from palpate.tasks.people.limits import Lookup
from palpate.tasks.people.score import score
from palpate.tasks.recording import Recording

RECORDINGS = "recordings"
_WHO = "trainee.json"
_LONGEST = 80  # name
_ID = re.compile(r"[0-9a-f]{32}")


class RecordError(RuntimeError):
  """Something about a record that people should know, in one line."""


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

  def facts(self) -> dict[str, str]:
    """Returns what a recording says of the session that it was made in."""
    return {"session": self.id, "began": self.began}


def now() -> str:
  """Returns the time, UTC."""
  return _time(time.time())


def _time(seconds: float) -> str:
  at = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
  return at.isoformat(timespec="milliseconds")


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
  """A record.

  Attributes:
    folder: of the record
    said: what people should know about it: files that could not be read
  """

  def __init__(self, folder: pathlib.Path, references: Lookup | None = None):
    """Opens a record; with `references` to write to it, and makes it if there is none.

    Args:
      folder: of the record
      references: what recordings without a score are scored by, see `limits.lookup`
    """
    self.folder, self.said = folder, []
    self._people = folder / RECORDINGS
    self._references = references or limits.lookup()
    with _named(self._people):
      if references is None:
        if not self._people.is_dir():
          raise RecordError(f"no record in {str(folder)!r}; `palpate trainee add` begins one")
        return
      for each in (folder, self._people):
        each.mkdir(mode=0o700, parents=True, exist_ok=True)
      self._people.chmod(0o700)  # it may have been there, open to others
      with self._alone():
        for part in self._people.glob("*/.*.part"):  # of a process that was killed
          part.unlink(missing_ok=True)

  @contextlib.contextmanager
  def _alone(self) -> Iterator[None]:
    """Lets one process at a time write; a killed one blocks nobody."""
    try:
      import fcntl
    except ImportError:  # Windows
      yield
      return
    lock = os.open(self._people, os.O_RDONLY)
    try:
      fcntl.flock(lock, fcntl.LOCK_EX)
      yield
    finally:
      os.close(lock)

  def _say(self, text: str) -> None:
    if text not in self.said:
      self.said.append(text)

  # People.

  def trainees(self) -> list[Trainee]:
    """Returns the people, by name."""
    found: dict[str, Trainee] = {}
    with _named(self._people):
      for folder in sorted(self._people.iterdir()):
        if not _ID.fullmatch(folder.name) or folder.is_symlink():
          continue
        try:
          person = Trainee(**json.loads((folder / _WHO).read_text(encoding="utf-8")))
          person = Trainee(folder.name, check_name(person.name), str(person.added))
          if person.name in found:
            raise ValueError(f"there is another {person.name!r}")
        except (ValueError, TypeError, OSError) as error:
          self._say(f"{folder / _WHO}: {error}; its recordings are not counted")
          continue
        found[person.name] = person
    return [found[name] for name in sorted(found)]

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
    with _named(self._people), self._alone():
      for person in self.trainees():
        if person.name == name:
          return person
      person = Trainee(uuid.uuid4().hex, name, now())
      folder = self._people / person.id
      folder.mkdir(mode=0o700)
      with replacing(folder / _WHO) as file:
        file.write(json.dumps(dataclasses.asdict(person)))
      (folder / _WHO).chmod(0o600)
    return person

  # Episodes.

  def episodes(self, person: Trainee) -> list[Episode]:
    """Returns what a person has done, in order."""
    found = []
    for path in sorted((self._people / person.id).glob("*.npz")):
      try:
        if not path.stat().st_size:  # an exercise begins
          continue
        found.append(self._episode(person, path))
      except (ValueError, TypeError, KeyError, OSError) as error:  # whoever put it there
        self._say(f"{path}: not counted: {error}")
    return found

  def reserve(self, person: Trainee, task: str) -> pathlib.Path:
    """Returns the file, empty so far, that an exercise's recording is to take."""
    task = re.sub(r"\W+", "_", task, flags=re.ASCII)[:_LONGEST]
    folder = self._people / person.id
    with _named(folder), self._alone():
      if not (folder / _WHO).is_file():
        raise RecordError(f"{person.name!r} is no longer in {str(self.folder)!r}")
      path = free(folder, f"{re.sub('[^0-9]', '', now()[:23])}_{task}", ".npz")
      path.touch(0o600, exist_ok=False)
    return path

  def keep(
    self,
    person: Trainee,
    recording: Recording,
    session: Session,
    references: Lookup,
    path: pathlib.Path | None = None,
  ) -> Episode:
    """Keeps a recording, and returns what is kept; RecordError where it is not.

    Args:
      person: who did it
      recording: of an exercise
      session: that it was done in
      references: that it is scored by
      path: from `reserve`; its file may hold parts of the recording
    """
    info = {k: v for k, v in recording.info.items() if k != "person"}
    info["record"] = session.facts() | {"ended": now()} | _facts(recording, references)
    recording = dataclasses.replace(recording, info=info)
    path = path or self.reserve(person, str(info.get("task", "exercise")))
    with _named(path), self._alone():
      if not path.exists():
        raise RecordError(f"{person.name!r} is no longer in {str(self.folder)!r}")
      recording.save(path).chmod(0o600)
    return self._episode(person, path)

  def path(self, episode: Episode) -> pathlib.Path:
    """Returns where a recording is."""
    return self.folder / episode.path

  def _episode(self, person: Trainee, path: pathlib.Path) -> Episode:
    """Returns what a recording says; one that was not kept by a record is scored now."""
    if path.is_symlink():
      raise ValueError("it is a link, expected a file")
    info = Recording.load_info(path)
    kept = info.get("record")
    kept = kept if isinstance(kept, dict) else {}
    if "metrics" not in kept:  # interrupted, or not made by a record
      kept = kept | _facts(Recording.load(path), self._references)
    value, known = kept["score"], kept["metrics"]
    values = {
      name: Unknown(kept["unknown"].get(name, "not recorded")) if number is None else float(number)
      for name, number in known.items()
      if name in METRICS  # not one of another version's
    }
    return Episode(
      outcome=str(kept["outcome"]),
      score=None if value is None else float(value),
      proficient=kept["proficient"] is True,
      assessment=kept["assessment"] is True,
      metrics=Metrics(**values),
      path=path.relative_to(self.folder).as_posix(),
      session=str(kept.get("session", person.id)),
      performer=str(info.get("performer", "")),
      ended=str(kept.get("ended") or _time(path.stat().st_mtime)),
      task=str(info.get("task", "")),
      seed=info["seed"] if type(info.get("seed")) is int else None,
      seconds=float(kept["seconds"]),
      hints=int(kept["hints"]),
      versions={k: str(info[k]) for k in ("palpate", "mujoco") if k in info},
    )

  # Deletion.

  def delete(self, person: Trainee) -> list[str]:
    """Deletes all of a person's data, and returns what it was; RecordError where some is left."""
    episodes = self.episodes(person)
    sessions = len({e.session for e in episodes})
    folder = self._people / person.id
    with _named(folder), self._alone():
      files = _remove(folder)
    if left := self.traces(person):
      text = f"{', '.join(map(str, left))}: still has data of {person.name!r}"
      raise RecordError(f"{text}; delete it")
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


def _facts(recording: Recording, references: Lookup) -> dict[str, Any]:
  """Returns what a record says of a recording that follows from it and from the limits of now."""
  info, metrics = recording.info, recording.metrics()
  coach = info.get("coach")
  coach = coach if isinstance(coach, dict) else {"assessment": True}
  hints = coach.get("hints")
  reference = references(str(info.get("task", "")))
  judged = None if reference is None else score(metrics, reference, recording.outcome)
  return {
    "outcome": recording.outcome or "not recorded",
    "seconds": float(recording.time[-1] - recording.time[0]) if len(recording.time) else 0.0,
    "score": judged.composite if judged and math.isfinite(judged.composite) else None,
    "proficient": judged is not None and judged.proficient,
    "assessment": coach.get("assessment") is True,
    "hints": len(hints) if isinstance(hints, list) else 0,
    "metrics": {k: v if math.isfinite(v) else None for k, v in metrics.values().items()},
    "unknown": metrics.reasons(),
  }


@contextlib.contextmanager
def _named(path: pathlib.Path) -> Iterator[None]:
  """Turns what the system says about a file into an error that names it."""
  try:
    yield
  except OSError as error:
    raise RecordError(f"{error.filename or path}: {error.strerror or error}") from None
