"""The SQLite file of a record: opened, checked, kept aside where it is damaged.

Several processes may have it open: readers never wait (write-ahead log), writers wait for each
other. What was committed outlives a kill or a power cut.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import sqlite3
import time
from collections.abc import Iterator

FILE = "record.sqlite"
VERSION = 1  # of the schema
ASIDE = f"{FILE}.damaged-"  # before the time in the name of a file that was kept aside
_APPLICATION = 0x50414C50  # PALP: what tells a record from other databases
_PATIENCE = 30.0  # with another process that writes [s]
_SCHEMA = (
  """create table trainee (
    id text primary key,        -- 32 hexadecimal digits, drawn; names the folder of recordings
    name text not null unique,  -- Unicode NFC
    added text not null         -- time, UTC
  )""",
  """create table session (
    id text primary key,        -- 32 hexadecimal digits, drawn
    trainee text not null references trainee on delete cascade,
    began text not null,        -- time, UTC
    performer text not null     -- such as device:mouse
  )""",
  """create table episode (
    id integer primary key,     -- in the order they were done
    session text not null references session on delete cascade,
    path text not null unique,  -- of the recording, from the record's folder
    ended text not null,        -- time, UTC
    task text not null,
    seed integer,
    outcome text not null,
    seconds real not null,      -- simulated
    score real,                 -- null where it is unknown
    proficient integer not null,
    assessment integer not null,  -- done without the coach
    hints integer not null,     -- of the coach
    metrics text not null,      -- JSON: values in SI units, and why others are unknown
    versions text not null      -- JSON
  )""",
  "create index session_trainee on session (trainee)",
  "create index episode_session on episode (session)",
)


class RecordError(RuntimeError):
  """Something about a record that people should know, in one line."""


class DamagedError(RecordError):
  """The database cannot be read."""


class PendingError(RecordError):
  """A recording is kept, its row is not yet: it follows when the record is opened again.

  Attributes:
    path: of the recording
  """

  def __init__(self, message: str, path: pathlib.Path):
    super().__init__(f"{message}; {path} is kept, its row follows")
    self.path = path


@contextlib.contextmanager
def named(path: pathlib.Path) -> Iterator[None]:
  """Turns what SQLite and the system say about a database into errors that name the file."""
  try:
    yield
  except sqlite3.OperationalError as error:
    raise RecordError(f"{path}: {error}") from None
  except sqlite3.DatabaseError as error:
    raise DamagedError(f"{path} is damaged: {error}") from None
  except OSError as error:
    raise RecordError(f"{path}: {error.strerror or error}") from None


def private_folder(path: pathlib.Path) -> None:
  """Makes a folder that its owner alone may enter; one that is there stays as it is."""
  path.mkdir(mode=0o700, parents=True, exist_ok=True)


def open_to_read(path: pathlib.Path) -> sqlite3.Connection:
  """Returns a connection to a database that is there; RecordError says what is wrong with it."""
  if not path.is_file():
    raise RecordError(f"no record in {str(path.parent)!r}; `palpate trainee add` begins one")
  return _checked(path)


def open_to_write(path: pathlib.Path) -> tuple[sqlite3.Connection, pathlib.Path | None]:
  """Returns a connection to a database, made if it is missing, and where a damaged one went."""
  with named(path):
    private_folder(path.parent)
    _make(path)
    with contextlib.suppress(DamagedError):
      return _prepared(path), None
    with _alone(path.parent):
      with contextlib.suppress(DamagedError):
        return _prepared(path), None  # another process was here before
      aside = _keep_aside(path)
      _make(path)
      return _prepared(path), aside


def _make(path: pathlib.Path) -> None:
  """Makes an empty file that its owner alone may read; SQLite gives its others the same mode."""
  with contextlib.suppress(FileExistsError):
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600))
  if path.stat().st_mode & 0o077:
    path.chmod(0o600)


def _prepared(path: pathlib.Path) -> sqlite3.Connection:
  """Returns a checked connection to a database that has its tables."""
  connection = _checked(path)
  with _closing_failure(connection), named(path):
    if _number(connection, "user_version") == 0:
      with transaction(connection):
        if _number(connection, "user_version") == 0:  # no other process was faster
          for statement in _SCHEMA:
            connection.execute(statement)
          connection.execute(f"pragma application_id = {_APPLICATION}")
          connection.execute(f"pragma user_version = {VERSION}")
  return connection


def _checked(path: pathlib.Path) -> sqlite3.Connection:
  """Returns a connection to a database that is whole and a record's."""
  uri = f"{path.resolve().as_uri()}?mode=rw"
  with named(path):
    connection = sqlite3.connect(uri, uri=True, timeout=_PATIENCE, isolation_level=None)
  with _closing_failure(connection), named(path):
    (found,) = connection.execute("pragma integrity_check(1)").fetchone()
    if found != "ok":
      raise DamagedError(f"{path} is damaged: {' '.join(found.split())}")
    version = _number(connection, "user_version")
    empty = version == 0 and not connection.execute("select 1 from sqlite_master").fetchone()
    if not empty and _number(connection, "application_id") != _APPLICATION:
      raise RecordError(f"{path} is a database, but no record of Palpate; it is left alone")
    if version > VERSION:
      raise RecordError(f"{path}: version is {version}, this program reads up to {VERSION}")
    connection.execute("pragma foreign_keys = on")
    connection.execute("pragma secure_delete = on")  # what is deleted is overwritten
    connection.execute("pragma synchronous = full")  # what is committed is on the disk
    _write_ahead(connection)
  return connection


@contextlib.contextmanager
def _closing_failure(connection: sqlite3.Connection) -> Iterator[None]:
  try:
    yield
  except BaseException:
    connection.close()
    raise


def _write_ahead(connection: sqlite3.Connection) -> None:
  """Chooses the write-ahead log. SQLite waits for nobody here, so this does."""
  due = time.monotonic() + _PATIENCE
  while True:
    try:
      connection.execute("pragma journal_mode = wal")
      return
    except sqlite3.OperationalError as error:
      if "locked" not in str(error) or time.monotonic() > due:
        raise
      time.sleep(0.02)


def _number(connection: sqlite3.Connection, pragma: str) -> int:
  return connection.execute(f"pragma {pragma}").fetchone()[0]


@contextlib.contextmanager
def transaction(connection: sqlite3.Connection) -> Iterator[None]:
  """Writes alone: all of what is in the block is committed, or nothing."""
  connection.execute("begin immediate")
  try:
    yield
    connection.execute("commit")
  except BaseException:
    with contextlib.suppress(sqlite3.Error):  # a full disk has rolled it back already
      connection.execute("rollback")
    raise


def _keep_aside(path: pathlib.Path) -> pathlib.Path:
  """Gives a damaged database, with its log, a name of its own, and returns it."""
  stamp, k = time.strftime("%Y%m%d-%H%M%S"), 0
  while (aside := path.with_name(f"{ASIDE}{stamp}{f'-{k}' if k else ''}")).exists():
    k += 1
  path.rename(aside)
  for suffix in ("-wal", "-shm"):
    with contextlib.suppress(FileNotFoundError):
      path.with_name(path.name + suffix).rename(aside.with_name(aside.name + suffix))
  return aside


@contextlib.contextmanager
def _alone(folder: pathlib.Path) -> Iterator[None]:
  """Lets one process at a time into the block; a killed one blocks nobody."""
  try:
    import fcntl
  except ImportError:  # Windows refuses to rename what another has open
    yield
    return
  lock = os.open(folder, os.O_RDONLY)
  try:
    fcntl.flock(lock, fcntl.LOCK_EX)
    yield
  finally:
    os.close(lock)
