"""A recorded exercise: its file and its metrics.

A recording is enough to compute every metric again to the bit, and, with the caller's own arrays
(states, actions), to replay the exercise. On disk it is an `.npz` of plain arrays; the rest is JSON
in its entry `meta`. Nothing in it is executed when it is read.

While an exercise goes on, its file is a sequence of parts: `PART`, the length of what follows (8
bytes, little-endian), and an `.npz` of the samples since the part before. The complete recording
takes the place of the parts. Where the process was killed before that, the parts are read as one
recording whose outcome is `interrupted`.
"""

import dataclasses
import io
import json
import math
import os
import typing
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from palpate.tissue.reading import choices

from .files import replacing
from .inputs import COLUMNS, SIGNALS, measure
from .metrics import EVENTS, Metrics, check_time, low_pass, rows

FORMAT = "palpate-recording"
VERSION = 2
PART = b"PART"
INTERRUPTED = "interrupted"  # outcome of what its process did not live to complete


@dataclasses.dataclass(frozen=True)
class Settings:
  """What the metrics need to know besides the samples; None where it is unknown.

  Attributes:
    force_limit: F_max, the force that breaches and excess impulse are counted above [N]
    grip_limit: the same for the force of the jaws [N]
    reference_length: length of the path that the task asks for, all instruments together [m]
    tip_cutoff: where the low pass that positions and orientations go through cuts [Hz]; for those
      of a tracker the 6 Hz of biomechanics (Winter 2009); None where they are exact
    movement_cutoff: the same for counting movements and rest; 98.9 % of the power of a surgeon's
      voluntary movement is below 2 Hz, and tremor is above (Riviere, Rader and Khosla 1997) [Hz]
    movement_speed: tip speed above which an instrument moves [m/s]
    movement_debounce: shortest movement, and shortest pause between two [s]
    idle_speed: tip speed below which an instrument without contact rests [m/s]
    contact_force: force above which there is contact [N]
    force_cutoff: where the low pass cuts that the force's rate is taken after [Hz]
    local_axis: direction of the shaft in the tip's own frame, used where no axis is recorded  (3,)
  """

  force_limit: float | None = None
  grip_limit: float | None = None
  reference_length: float | None = None
  tip_cutoff: float | None = 6.0
  movement_cutoff: float = 2.0
  movement_speed: float = 0.05
  movement_debounce: float = 0.2
  idle_speed: float = 0.005
  contact_force: float = 0.0
  force_cutoff: float = 20.0
  local_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)

  def __post_init__(self):
    axis = tuple(float(x) for x in self.local_axis)
    if len(axis) != 3 or not all(map(math.isfinite, axis)) or not any(axis):
      raise ValueError(f"local_axis is {self.local_axis!r}, expected three numbers, not all zero")
    object.__setattr__(self, "local_axis", axis)
    for field in dataclasses.fields(self)[:-1]:
      value = getattr(self, field.name)
      if value is None and type(None) in typing.get_args(field.type):
        continue
      if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        raise ValueError(f"{field.name} is {value!r}, expected a number")
      if not (math.isfinite(value) and value >= 0):
        raise ValueError(f"{field.name} is {value!r}, expected a finite number >= 0")
      if value == 0 and field.name.endswith("_cutoff"):
        raise ValueError(f"{field.name} is 0 Hz, expected a number > 0")
      object.__setattr__(self, field.name, float(value))


@dataclasses.dataclass(frozen=True)
class Event:
  """Something that happened once.

  Attributes:
    kind: one of `metrics.EVENTS`
    time: when [s]
    value: for `target` and `miss`, the distance to the target [m]; None where there is none
    instrument: index of the instrument
    label: text for people
  """

  kind: str
  time: float
  value: float | None = None
  instrument: int = 0
  label: str = ""


@dataclasses.dataclass(frozen=True, eq=False)
class Recording:
  """One exercise, complete.

  Attributes:
    time: sample times [s]  (nstep,)
    columns: what was recorded of the instruments, see `Recorder.append`  (nstep, ninstrument, ...)
    arrays: the caller's arrays, one entry a sample: states, actions  (nstep, ...)
    constants: arrays of the whole exercise: curve, vertices, triangles, initial state
    events: in the order they were reported
    instruments: their names
    settings: limits and thresholds
    watch: kinds of event that the caller looks for
    info: the caller's own data (task, seed, performer, outcome); JSON
    substeps: how many values of the forces there are for each sample
  """

  time: np.ndarray
  columns: dict[str, np.ndarray]
  arrays: dict[str, np.ndarray]
  constants: dict[str, np.ndarray]
  events: tuple[Event, ...]
  instruments: tuple[str, ...]
  settings: Settings
  watch: tuple[str, ...]
  info: dict[str, Any]
  substeps: int = 1

  @property
  def outcome(self) -> str | None:
    """How it ended: `success`, or what came in between; None where nobody said."""
    outcome = self.info.get("outcome")
    return None if outcome is None else str(outcome)

  @property
  def signal_time(self) -> np.ndarray:
    """Times of `signal` [s]: even between samples, a sample's own is its last."""
    if self.substeps == 1 or len(self.time) == 0:
      return self.time
    share = np.arange(1, self.substeps + 1) / self.substeps
    between = self.time[:-1, None] + np.diff(self.time)[:, None] * share
    between[:, -1] = self.time[1:]
    return np.concatenate([self.time[:1], between.ravel()])

  def signal(self, name: str, instrument: int = 0) -> np.ndarray | None:
    """Returns one of `inputs.SIGNALS` at `signal_time`, or None where it was not recorded."""
    values = self.column(name, instrument)
    return values if values is None or self.substeps == 1 else values.ravel()[self.substeps - 1 :]

  def column(self, name: str, instrument: int = 0) -> np.ndarray | None:
    """Returns one instrument's column, or None where it was not recorded."""
    if name not in self.columns:
      return None
    values = np.ascontiguousarray(self.columns[name][:, instrument])
    return None if np.isnan(values).all() and len(values) else values

  def tip_path(self, instrument: int = 0) -> np.ndarray | None:
    """Returns the tip positions as metrics take them: filtered at `Settings.tip_cutoff` [m]."""
    pos, cutoff = self.column("tip_pos", instrument), self.settings.tip_cutoff
    if pos is None or cutoff is None:
      return pos
    return low_pass(self.time, rows("tip_pos", pos, 3), cutoff)

  def force(self, instrument: int = 0) -> np.ndarray | None:
    """Returns the force magnitude at `signal_time` [N], NaN where it is missing; None if all is."""
    force = self.signal("force", instrument)
    if force is None or force.ndim == 1:
      return force if force is None else np.abs(force)
    return np.linalg.norm(force, axis=1)

  def touching(self, instrument: int = 0) -> np.ndarray | None:
    """Returns whether there was contact since the sample before  (nstep,); None if unknown."""
    if (force := self.force(instrument)) is None:
      return None
    touch = np.nan_to_num(force) > self.settings.contact_force
    return np.concatenate([touch[:1], touch[1:].reshape(-1, self.substeps).any(axis=1)])

  def metrics(self, instrument: int | None = None) -> Metrics:
    """Returns the metrics of all instruments together, or of one.

    Several instruments: lengths, counts and impulses add up, peaks take the largest, smoothness and
    mean forces the mean over the instruments where they are known. Tracing errors are those of the
    first instrument, over the samples in contact (from the first to the last one for Frechet), over
    all samples where no force was recorded.
    """
    count = len(self.instruments)
    if instrument is not None and not 0 <= instrument < count:
      raise ValueError(f"instrument is {instrument}, expected 0 to {count - 1}")
    return measure(self, range(count) if instrument is None else [instrument])

  def save(self, path: str | os.PathLike[str]) -> Path:
    """Writes the recording; an interrupted write leaves the old file as it was.

    Args:
      path: the file, by custom with the suffix .npz; its folder must exist
    """
    path = Path(path)
    with replacing(path, "wb") as file:
      np.savez_compressed(file, allow_pickle=False, **self._entries())
    return path

  def part(self) -> bytes:
    """Returns the recording as a part of a file, to be appended to those before."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **self._entries())
    data = file.getvalue()
    return PART + len(data).to_bytes(8, "little") + data

  def since(self, sample: int, event: int) -> "Recording":
    """Returns the samples and the events from these on; views, with the constants."""
    tables = {name: {k: v[sample:] for k, v in getattr(self, name).items()} for name in _SAMPLED}
    return dataclasses.replace(self, time=self.time[sample:], events=self.events[event:], **tables)

  def _entries(self) -> dict[str, np.ndarray]:
    meta = {
      "format": FORMAT,
      "version": VERSION,
      "instruments": list(self.instruments),
      "settings": dataclasses.asdict(self.settings),
      "watch": list(self.watch),
      "events": [dataclasses.asdict(e) for e in self.events],
      "info": self.info,
      "substeps": self.substeps,
    }
    entries = {"meta": np.array(json.dumps(meta, allow_nan=False)), "time": self.time}
    for kind, table in _TABLES.items():
      entries |= {f"{kind}.{name}": value for name, value in getattr(self, table).items()}
    return entries

  @classmethod
  def load(cls, path: str | os.PathLike[str]) -> "Recording":
    """Reads a recording; ValueError and OSError name the file and what is wrong with it."""
    return _reading(path, cls._read, _joined)

  @classmethod
  def load_info(cls, path: str | os.PathLike[str]) -> dict[str, Any]:
    """Reads `info` alone, in a twentieth of the time; errors as of `load`."""
    return _reading(path, cls._read_info, lambda infos: _ended(list(infos)[-1]))

  @classmethod
  def _read_info(cls, file: Any) -> dict[str, Any]:
    with np.load(file, allow_pickle=False) as archive:
      return _meta(archive)["info"]

  @classmethod
  def _read(cls, file: Any) -> "Recording":
    with zipfile.ZipFile(file) as archive:
      size = sum(each.file_size for each in archive.infolist())
      if size > _MOST:
        raise ValueError(f"it declares {size} bytes, expected at most {_MOST}")
      if broken := archive.testzip():
        raise ValueError(f"{broken} fails its checksum")
      file.seek(-12, os.SEEK_END)  # zipfile does not miss what the end of the list says there is
      if (count := int.from_bytes(file.read(2), "little")) != (have := len(archive.infolist())):
        raise ValueError(f"it lists {have} entries of {count}")
    file.seek(0)
    tables: dict[str, dict[str, np.ndarray]] = {table: {} for table in _TABLES.values()}
    with np.load(file, allow_pickle=False) as archive:
      meta = _meta(archive)
      time = check_time(check_array("time", archive["time"]), least=0)
      for name in set(archive.files) - {"meta", "time"}:
        kind, _, rest = name.partition(".")
        if kind not in _TABLES or not rest:
          raise ValueError(f"unknown entry {name!r}")
        value = check_array(name, archive[name])
        if kind != "constant" and value.shape[:1] != time.shape:
          raise ValueError(f"{name} has shape {value.shape}, expected {len(time)} samples")
        if kind == "column":
          _check_column(rest, value, len(meta["instruments"]), meta["substeps"])
        if kind == "constant":
          check_constant(rest, value)
        tables[_TABLES[kind]][rest] = value
    return cls(time=time, **tables, **meta)


_MOST = 2**30  # bytes of all entries, not compressed
_TABLES = {"column": "columns", "array": "arrays", "constant": "constants"}
_SAMPLED = ("columns", "arrays")


def check_array(name: str, value: np.ndarray) -> np.ndarray:
  """Returns the array; ValueError unless it holds numbers."""
  if value.dtype.kind not in "fiub":
    raise ValueError(f"{name} has dtype {value.dtype}, expected numbers or booleans")
  return value


def check_constant(name: str, value: np.ndarray) -> None:
  """Raises ValueError unless the constant holds numbers, those with a meaning finite triples."""
  check_array(f"constant {name!r}", value)
  if name not in ("curve", "vertices", "triangles"):
    return
  if value.ndim != 2 or value.shape[1] != 3:
    raise ValueError(f"constant {name!r} has shape {value.shape}, expected (n, 3)")
  bad = ~np.isfinite(value).all(axis=1)
  if bad.any():
    raise ValueError(f"constant {name!r} is not finite in row {int(bad.argmax())}")


def entry_shapes(name: str, substeps: int) -> list[tuple[int, ...]]:
  """Returns the shapes that an instrument's entry of a column may have."""
  if name in SIGNALS and substeps > 1:
    return [(substeps,)]
  return [COLUMNS[name], ()] if name == "force" else [COLUMNS[name]]


def _check_column(name: str, value: np.ndarray, count: int, substeps: int) -> None:
  if name not in COLUMNS:
    raise ValueError(f"unknown column {name!r}, {choices(name, COLUMNS)}")
  allowed = [(count, *shape) for shape in entry_shapes(name, substeps)]
  if value.dtype != np.float64 or value.shape[1:] not in allowed:
    raise ValueError(f"column {name} is {value.dtype} {value.shape}, expected float64 {allowed}")


def _reading(
  path: str | os.PathLike[str], read: Callable[[Any], Any], join: Callable[[Iterator[Any]], Any]
) -> Any:
  """Returns what `read` makes of a file, or what `join` makes of its parts, each of them read.

  ValueError and OSError name the file.
  """
  path = Path(path)
  if path.exists() and not path.is_file():  # a pipe would be waited for
    raise ValueError(f"{path}: not a {FORMAT}: not a file")
  try:
    opened = path.open("rb")
  except OSError as error:
    why = f"{error.strerror}, expected a {FORMAT} (.npz), as palpate exercise keeps"
    raise type(error)(f"{path}: {why}") from None
  with opened as file:
    head = file.read(len(PART))
    if head[:2] != b"PK" and head != PART:
      raise ValueError(f"{path}: not a {FORMAT}: not a zip archive")
    file.seek(0)
    # Whatever broken bytes make zipfile, zlib, numpy or json raise is the file's fault.
    try:
      return read(file) if head != PART else join(map(read, _parts(file)))
    except Exception as error:
      text = str(error) or type(error).__name__
      raise ValueError(f"{path}: not a readable {FORMAT}: {text}") from error


def _parts(file: Any) -> Iterator[io.BytesIO]:
  """Yields the parts of a file that were written to their end; ValueError where none was."""
  count = 0
  while file.read(len(PART)) == PART:
    length = int.from_bytes(file.read(8), "little")
    data = file.read(min(length, _MOST))
    if len(data) < length:
      break
    yield io.BytesIO(data)
    count += 1
  if not count:
    raise ValueError("no part of it is complete")


def _joined(parts: Iterator[Recording]) -> Recording:
  """Returns the recording that its parts make, as interrupted."""
  known, size = [], 0
  for part in parts:
    known.append(part)
    size += sum(v.nbytes for kind in _TABLES.values() for v in getattr(part, kind).values())
    if size > _MOST:
      raise ValueError(f"its parts hold {size} bytes, expected at most {_MOST}")
  last, counts = known[-1], [len(each.time) for each in known]
  tables: dict[str, dict[str, np.ndarray]] = {"constants": {}}
  for each in known:
    tables["constants"] |= each.constants
  for table in _SAMPLED:
    rows = [getattr(each, table) for each in known]
    like = {name: value for row in rows for name, value in row.items()}
    tables[table] = {
      name: np.concatenate([
        row[name] if name in row else np.full((n, *value.shape[1:]), np.nan, value.dtype)
        for row, n in zip(rows, counts, strict=True)
      ])
      for name, value in like.items()
    }  # fmt: skip
  return dataclasses.replace(
    last,
    time=check_time(np.concatenate([each.time for each in known]), least=0),
    events=tuple(event for each in known for event in each.events),
    info=_ended(last.info),
    **tables,
  )


def _ended(info: dict[str, Any]) -> dict[str, Any]:
  return {"outcome": INTERRUPTED, **info}


def _meta(archive: Any) -> dict[str, Any]:
  """Returns the entry `meta` of an archive, checked."""
  for required in ("meta", "time"):
    if required not in archive.files:
      raise ValueError(f"no entry {required!r}")
  if archive["meta"].dtype.kind != "U" or archive["meta"].shape != ():
    raise ValueError("entry 'meta' is no text")
  return _check_meta(json.loads(str(archive["meta"][()])))


def _check_meta(meta: Any) -> dict[str, Any]:
  if not isinstance(meta, dict) or meta.get("format") != FORMAT:
    raise ValueError(f"format is {meta.get('format') if isinstance(meta, dict) else meta!r}")
  if meta.get("version") != VERSION:
    raise ValueError(f"version is {meta.get('version')!r}, this program reads {VERSION}")
  names = meta["instruments"]
  if not (isinstance(names, list) and names and all(isinstance(n, str) for n in names)):
    raise ValueError(f"instruments is {names!r}, expected a list of names")
  events = tuple(Event(**event) for event in meta["events"])
  for event in events:
    check_event(event, len(names))
  if not isinstance(meta["info"], dict):
    raise ValueError(f"info is {meta['info']!r}, expected an object")
  return {
    "substeps": check_substeps(meta["substeps"]),
    "instruments": tuple(names),
    "settings": Settings(**meta["settings"]),
    "watch": check_watch(meta["watch"]),
    "events": events,
    "info": meta["info"],
  }


def check_substeps(substeps: Any) -> int:
  """Returns the number of substeps; ValueError unless it is a whole number above 0."""
  if type(substeps) is not int or substeps < 1:
    raise ValueError(f"substeps is {substeps!r}, expected a whole number >= 1")
  return substeps


def check_watch(watch: Sequence[str]) -> tuple[str, ...]:
  """Returns the kinds; ValueError unless all are `metrics.EVENTS`."""
  for kind in watch:
    if kind not in EVENTS:
      raise ValueError(f"no event {kind!r} to watch, {choices(kind, EVENTS)}")
  return tuple(watch)


def check_event(event: Event, count: int) -> None:
  """Raises ValueError unless the event is one that `count` instruments can have."""
  if event.kind not in EVENTS:
    raise ValueError(f"no event {event.kind!r}, {choices(event.kind, EVENTS)}")
  if type(event.instrument) is not int or not 0 <= event.instrument < count:
    raise ValueError(f"event {event.kind!r}: instrument is {event.instrument!r} of {count}")
  if not isinstance(event.label, str):
    raise ValueError(f"event {event.kind!r}: label is {event.label!r}, expected text")
  for name, value in (("time", event.time), ("value", event.value)):
    if not (value is None and name == "value") and not (
      isinstance(value, int | float) and math.isfinite(value)
    ):
      raise ValueError(f"event {event.kind!r}: {name} is {value!r}, expected a finite number")
