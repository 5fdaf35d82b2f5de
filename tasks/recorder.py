"""Records an exercise step by step; see `recording` for what comes out."""

import concurrent.futures
import contextlib
import dataclasses
import json
import math
import os
import re
import time as clock
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .inputs import COLUMNS, SIGNALS
from .metrics import Metrics
from .recording import (
  Event,
  Recording,
  Settings,
  check_array,
  check_constant,
  check_event,
  check_substeps,
  check_watch,
  entry_shapes,
)

__all__ = ["Event", "Recorder", "Recording", "Settings"]

_EVERY = 1.0  # between parts of a recording that goes on [s]
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")


def together(*hands: Mapping[str, Any]) -> dict[str, Any]:
  """Returns the entries of a sample of several instruments, each as of one; NaN where one has none.

  Args:
    *hands: entries of `Recorder.append` by name, the main instrument first
  """
  if len(hands) == 1:
    return dict(hands[0])
  blank = {name: np.nan * np.asarray(value) for hand in hands for name, value in hand.items()}
  return {name: np.stack([hand.get(name, none) for hand in hands]) for name, none in blank.items()}


class _Buffer:
  """An array that grows by doubling."""

  def __init__(self, shape: tuple[int, ...], dtype: np.dtype, past: int):
    self.shape = shape
    self.values = np.empty((max(256, 2 * past), *shape), dtype)
    if past:
      self.skip(0, past)

  def put(self, index: int, value: np.ndarray | float) -> None:
    if index >= len(self.values):
      self._reach(index)
    self.values[index] = value

  def skip(self, start: int, end: int) -> None:
    """Marks the samples start to end as missing; floating point only."""
    self._reach(end - 1)
    self.values[start:end] = np.nan

  def view(self, count: int) -> np.ndarray:
    view = self.values[:count]
    view.flags.writeable = False
    return view

  def _reach(self, index: int) -> None:
    if index >= len(self.values):
      grown = np.empty((max(2 * len(self.values), index + 1), *self.shape), self.values.dtype)
      grown[: len(self.values)] = self.values
      self.values = grown


class _Journal:
  """Appends what is new of a recording to its file, in a thread: the disk may take its time."""

  def __init__(self, path: str | os.PathLike[str]):
    self._file = open(path, "ab", buffering=0)
    self._thread = concurrent.futures.ThreadPoolExecutor(1)
    self._work: concurrent.futures.Future[None] | None = None
    self._due = 0.0
    self._samples = self._events = 0
    self._constants: dict[str, np.ndarray] = {}

  @property
  def due(self) -> bool:
    """Whether a part is to be written: not before the last one is on the disk."""
    return clock.monotonic() >= self._due and (self._work is None or self._work.done())

  def add(self, recording: Recording) -> None:
    """Writes what is new."""
    part = recording.since(self._samples, self._events)
    known = self._constants
    new = {name: v for name, v in part.constants.items() if v is not known.get(name)}
    part = dataclasses.replace(part, constants=new, info=dict(part.info))
    known |= new
    self._samples, self._events = len(recording.time), len(recording.events)
    self._due = clock.monotonic() + _EVERY
    self._work = self._thread.submit(self._append, part)

  def _append(self, part: Recording) -> None:
    data, written = part.part(), 0
    with contextlib.suppress(OSError):
      written = self._file.write(data)
      os.fsync(self._file.fileno())
    if written < len(data):
      self._due = math.inf  # the disk is full: nothing can follow half a part

  def close(self, recording: Recording) -> None:
    """Writes the rest and ends the file."""
    if self._due < math.inf:
      self.add(recording)
    self._thread.shutdown()
    with contextlib.suppress(OSError):
      self._file.close()


class Recorder:
  """Takes one sample a control step from any environment or plain MuJoCo loop.

  In short: `recorder = Recorder(settings=Settings(force_limit=1.5), watch=["drop"])`; after every
  control step `recorder.append(data.time, data.site("tip").xpos, force=force)`; in the end
  `recorder.metrics()` and `recorder.save("exercise.npz")`.
  """

  def __init__(
    self,
    instruments: Sequence[str] = ("instrument",),
    settings: Settings | None = None,
    watch: Sequence[str] = (),
    info: Mapping[str, Any] | None = None,
    substeps: int = 1,
    journal: str | os.PathLike[str] | None = None,
  ):
    """Starts an empty recording.

    Args:
      instruments: names, the main one first
      settings: limits and thresholds
      watch: kinds of event (`metrics.EVENTS`) that the caller looks for; without an event, a kind
        that is watched counts 0 and one that is not is unknown
      info: the caller's own data (task, seed, performer), anything that JSON holds; without an
        `outcome`, which is `success` or another word, there is no score
      substeps: how many values of the forces come with each sample, for instance the physics' steps
        in a control step
      journal: file that what is recorded is appended to every second, so that a process that is
        killed leaves it; `Recording.load` reads it. `close` ends it, `save` may take its place
    """
    if isinstance(instruments, str) or not instruments:
      raise ValueError(f"instruments is {instruments!r}, expected a list of names")
    self.instruments = tuple(str(name) for name in instruments)
    self.settings = settings or Settings()
    self.watch = check_watch(watch)
    self.substeps = check_substeps(substeps)
    try:
      self.info = json.loads(json.dumps(dict(info or {}), allow_nan=False))
    except (TypeError, ValueError) as error:
      raise ValueError(f"info cannot be written as JSON: {error}") from error
    self._count = 0
    self._last = -math.inf
    self._time = _Buffer((), np.dtype(float), 0)
    self._columns: dict[str, _Buffer] = {}
    self._arrays: dict[str, _Buffer] = {}
    self._constants: dict[str, np.ndarray] = {}
    self._events: list[Event] = []
    self._owed: Callable[[], float] | None = None  # the last sample's strain
    self._journal = None if journal is None else _Journal(journal)

  def __len__(self) -> int:
    return self._count

  def append(
    self,
    time: float,
    tip_pos: ArrayLike,
    *,
    quat: ArrayLike | None = None,
    axis: ArrayLike | None = None,
    force: ArrayLike | None = None,
    grip_force: ArrayLike | None = None,
    shaft_force: ArrayLike | None = None,
    surroundings_force: ArrayLike | None = None,
    strain: ArrayLike | Callable[[], float] | None = None,
    arrays: Mapping[str, ArrayLike] | None = None,
    **numbers: ArrayLike | None,
  ) -> None:
    """Adds one sample; with several instruments each argument has a row (or a number) for each.

    A value that is left out is missing (NaN) in this sample; NaN stands for it too. A call that
    raises leaves the recording as it was.

    Args:
      time: above the last one [s]
      tip_pos: tip position in the world [m]  (3,) or (ninstrument, 3)
      quat: tip orientation, w x y z  (4,)
      axis: direction of the shaft in the world, if not `settings.local_axis` turned by quat  (3,)
      force: contact force on the instrument [N]  (3,), or its magnitude  (); with `substeps` the
        magnitudes since the last sample, evenly spaced, now the last  (substeps,), or one for all
      grip_force: of the jaw that presses more [N]  (), or (substeps,)
      shaft_force: magnitude of the contact force on the shaft [N]  (), or (substeps,)
      surroundings_force: of that on what is around and is no part of the work [N]  (), or
        (substeps,)
      strain: largest of the tissue, see `metrics.surface_strain`  (); or, with one instrument, what
        returns it, which is called by `settle`
      arrays: the caller's own, of any shape and number type, the same in every sample; arrays that
        are not floating point may not miss a sample
      **numbers: one each: `area` of the organ's touched triangles [m^2]; `grip`, `held`, above 0.5
        where the jaw is told to close, holds tissue; `visible`, 1 where the camera's view holds the
        tip, else 0; `freed`, share of what is bonded that came free as it should; `traction`, pull
        on what it is bonded to [N]; of a cut so far, `deviation`, mean distance from its line [m],
        `farthest`, the largest [m], `excess`, area between the two [m^2], `jagged`, length that is
        more than 2 mm off [m], `depth`, of the blade under the wall at most [m]; `current`, time
        that one was on so far [s], and `idle_current` without touching what it is to free [s];
        `regrasped`, how often the needle was taken so far, `ring_time`, how long rings were touched
        [s], and `ring_force`, with how much at most [N]; `bite`, how deep a needle went under a
        wall [m]; `gap`, of a cut at its widest [m], `tension`, largest of a thread [N], `torn`, how
        far a hole of it has torn [m]; `security`, the pull that its knot has held [N]
    """
    time = float(time)
    if not (math.isfinite(time) and time > self._last):
      raise ValueError(f"sample {self._count}: time is {time}, expected above {self._last}")
    self.settle()
    owed = strain if callable(strain) else None
    strain = strain if owed is None else math.nan
    given = {"tip_pos": tip_pos, "quat": quat, "axis": axis, "force": force, "strain": strain}
    given |= {"grip_force": grip_force, "shaft_force": shaft_force}
    given |= {"surroundings_force": surroundings_force, **numbers}
    columns = {k: self._entry(k, v) for k, v in given.items() if v is not None}
    own = {name: self._own(name, value) for name, value in arrays.items()} if arrays else {}
    self._store(time, columns, own)
    self._owed = owed
    if self._journal is not None and self._journal.due:
      self._journal.add(self._view(self._count - (owed is not None)))

  def settle(self) -> None:
    """Works out what the last sample was given as a function; at the latest the next one does."""
    if self._owed is not None:
      owed, self._owed = self._owed, None
      self._columns["strain"].put(self._count - 1, owed())

  def _store(
    self, time: float, columns: dict[str, np.ndarray | float], own: dict[str, np.ndarray]
  ) -> None:
    """Adds a sample whose entries were checked one by one."""
    k = self._count
    for name, buffer in self._arrays.items():
      if name not in own and buffer.values.dtype.kind != "f":
        raise ValueError(f"sample {k}: array {name!r} is {buffer.values.dtype} and is missing")
    for table, entries in ((self._columns, columns), (self._arrays, own)):
      if table.keys() != entries.keys():
        for name, buffer in table.items():
          if name not in entries:
            buffer.skip(k, k + 1)
        for name, value in entries.items():
          if name not in table:
            first = np.asarray(value)
            table[name] = _Buffer(first.shape, first.dtype, k)
      for name, value in entries.items():
        table[name].put(k, value)
    self._time.put(k, time)
    self._count, self._last = k + 1, time

  def _entry(self, name: str, value: ArrayLike) -> np.ndarray | float:
    count = len(self.instruments)
    buffer = self._columns.get(name)
    if type(value) is float and buffer is not None and buffer.shape == (1,):
      return value
    array = np.asarray(value, np.float64)
    if name in SIGNALS and self.substeps > 1 and array.shape in ((), (count,), (count, 1)):
      array = np.repeat(array.reshape(-1, 1), self.substeps, axis=1)
    if buffer is not None and (
      array.shape == buffer.shape or (count == 1 and array.shape == buffer.shape[1:])
    ):
      return array  # fits as it is
    if name not in COLUMNS:
      raise TypeError(f"append takes no {name!r}, expected some of {', '.join(COLUMNS)}")
    shapes = entry_shapes(name, self.substeps)
    if buffer is not None:
      shapes = [buffer.shape[1:]]
    for shape in shapes:
      if array.shape == (count, *shape) or (count == 1 and array.shape == shape):
        return array.reshape(count, *shape)
    wanted = " or ".join(str((count, *shape) if count > 1 else shape) for shape in shapes)
    raise ValueError(f"sample {self._count}: {name} has shape {array.shape}, expected {wanted}")

  def _own(self, name: str, value: ArrayLike) -> np.ndarray:
    array, buffer = np.asarray(value), self._arrays.get(name)
    if buffer and array.shape == buffer.shape and array.dtype == buffer.values.dtype:
      return array  # fits as it is
    if not _NAME.fullmatch(name):
      raise ValueError(f"array name {name!r}, expected letters, digits, _ . -")
    check_array(f"array {name!r}", array)
    if buffer is None:
      if self._count and array.dtype.kind != "f":
        raise ValueError(f"array {name!r} is {array.dtype} and misses the samples so far")
      return array
    # Only what the buffer holds without loss: a float64 in a float32 buffer would not replay.
    if array.shape != buffer.shape or not np.can_cast(array.dtype, buffer.values.dtype):
      raise ValueError(
        f"sample {self._count}: array {name!r} is {array.dtype} {array.shape}, "
        f"expected {buffer.values.dtype} {buffer.shape}"
      )
    return array

  def attach(self, name: str, value: ArrayLike) -> None:
    """Keeps an array of the whole exercise.

    Three names have a meaning: `curve`, the polyline to trace [m] (ncorner, 3); `vertices` [m]
    (nvert, 3) and `triangles` (ntri, 3), the surface that the report draws.
    """
    array = np.array(value)
    if not _NAME.fullmatch(name):
      raise ValueError(f"constant name {name!r}, expected letters, digits, _ . -")
    check_constant(name, array)
    array.flags.writeable = False
    self._constants[name] = array

  def event(
    self, kind: str, time: float, value: float | None = None, instrument: int = 0, label: str = ""
  ) -> None:
    """Reports an event, see `Event`."""
    number = None if value is None else float(value)
    event = Event(str(kind), float(time), number, int(instrument), str(label))
    check_event(event, len(self.instruments))
    self._events.append(event)

  def recording(self) -> Recording:
    """Returns what was recorded so far; read-only views, cheap."""
    self.settle()
    return self._view(self._count)

  def close(self) -> None:
    """Writes the rest to the journal, if there is one, and ends it."""
    if self._journal is not None:
      self._journal.close(self.recording())
      self._journal = None

  def _view(self, n: int) -> Recording:
    """Returns the first n samples."""
    return Recording(
      time=self._time.view(n),
      columns={name: buffer.view(n) for name, buffer in self._columns.items()},
      arrays={name: buffer.view(n) for name, buffer in self._arrays.items()},
      constants=dict(self._constants),
      events=tuple(self._events),
      instruments=self.instruments,
      settings=self.settings,
      watch=self.watch,
      info=self.info,
      substeps=self.substeps,
    )

  def metrics(self, instrument: int | None = None) -> Metrics:
    """Returns the metrics so far, see `Recording.metrics`."""
    return self.recording().metrics(instrument)

  def save(self, path: str | os.PathLike[str]) -> Path:
    """Writes what was recorded so far, see `Recording.save`."""
    return self.recording().save(path)
