"""What the metrics of a recording are computed of."""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from . import metrics as m
from .metrics import METRICS, Metrics, Spec, Unknown, UnknownError

# What is recorded of each instrument: single numbers, and all with the width of an entry; force is
# a vector or a magnitude.
_NUMBERS = (
  "grip_force", "shaft_force", "surroundings_force", "area", "strain", "grip", "held", "visible",
  "centred", "horizon", "freed", "traction", "deviation", "farthest", "excess", "jagged", "depth",
  "current", "idle_current", "regrasped", "ring_time", "ring_force", "bite", "gap", "tension",
  "torn", "security",
)  # fmt: skip
COLUMNS: dict[str, tuple[int, ...]] = {
  "tip_pos": (3,), "quat": (4,), "axis": (3,), "force": (3,), **dict.fromkeys(_NUMBERS, ()),
}  # fmt: skip
# Those that are measured faster: with substeps, magnitudes, one for each since the last sample.
SIGNALS = ("force", "grip_force", "shaft_force", "surroundings_force")


def measure(recording: Any, which: Sequence[int]) -> Metrics:
  """Returns the metrics of some of the instruments of a `recording.Recording` together."""
  if len(recording.time) == 0:
    return Metrics(**dict.fromkeys(METRICS, Unknown("the recording is empty")))
  each = [Inputs(recording, [i]) for i in which]
  values = {
    name: _combine(spec.combine, [inputs.value(name, spec) for inputs in each])
    for name, spec in METRICS.items()
    if spec.combine != "all"
  }
  together = Inputs(recording, which, values)
  for name, spec in METRICS.items():  # those of others come after them
    if spec.combine == "all":
      values[name] = together.value(name, spec)
  return Metrics(**values)


class Inputs:
  """What the arguments of metrics stand for, by their names.

  `time`, the recording's `COLUMNS` and `Settings`, the properties below and, for metrics of all
  instruments together, the other metrics. Of several instruments the columns are the first one's.
  `SIGNALS` are at `force_time`; positions and orientations went through `Settings.tip_cutoff`.
  """

  def __init__(
    self, recording: Any, which: Sequence[int], values: Mapping[str, float] | None = None
  ):
    """Makes the inputs of some instruments; `values` are metrics that are known already."""
    self._recording, self._which, self._values = recording, which, values or {}
    self._settings = dataclasses.asdict(recording.settings)
    self._paths: dict[int, np.ndarray | None] = {}
    self.time = recording.time

  def value(self, name: str, spec: Spec) -> float:
    """Returns the value of a metric."""
    given, absent = {}, []
    try:
      for need in spec.needs:
        value = self._get(name, need)
        if value is not None:
          given[need] = value
        elif need not in spec.may:
          absent.append(need)
    except UnknownError as error:
      return Unknown(str(error), error.fault)
    if absent:
      return Unknown(f"{' and '.join(absent)} not recorded")
    return spec.function(**given)

  def _get(self, metric: str, name: str) -> Any:
    kinds = property, functools.cached_property
    if name == "time" or isinstance(getattr(type(self), name, None), kinds):
      return getattr(self, name)
    if name in self._settings:
      value = self._settings[name]
      return math.nan if value is None else value
    if name in self._values:
      return self._values[name]
    if name in SIGNALS:
      return self._signal(name)
    if name in COLUMNS:
      return self._recording.column(name, self._which[0])
    raise TypeError(f"metric {metric!r}: no input {name!r}, see {type(self).__name__}")

  @property
  def tip_pos(self) -> np.ndarray | None:
    """Tip position [m]  (nstep, 3)."""
    return self._path(0)

  @functools.cached_property
  def quat(self) -> np.ndarray | None:
    """Tip orientation, w x y z  (nstep, 4)."""
    quat, cutoff = self._recording.column("quat", self._which[0]), self._settings["tip_cutoff"]
    return quat if quat is None or cutoff is None else m.low_pass_rotation(self.time, quat, cutoff)

  @property
  def axis(self) -> np.ndarray | None:
    """Direction of the shaft in the world  (nstep, 3)."""
    axis = self._recording.column("axis", self._which[0])
    if axis is None and self.quat is not None:
      return _rotate(self.quat, self._settings["local_axis"])
    return axis

  @property
  def moved(self) -> bool:
    """Whether the tip is known to have moved."""
    return self.tip_pos is not None and not math.isnan(m.path_length(self.tip_pos))

  @property
  def finished(self) -> bool:
    """Whether the exercise succeeded, or nobody said how it ended."""
    return self._recording.outcome in (None, m.SUCCESS)

  @property
  def force_time(self) -> np.ndarray:
    """Times of the forces' samples, `substeps` for one of the others [s]."""
    return self._recording.signal_time

  @property
  def sampled_force(self) -> np.ndarray | None:
    """Contact force at the samples [N]  (nstep,)."""
    return None if (force := self._signal("force")) is None else force[:: self._recording.substeps]

  @property
  def speed(self) -> np.ndarray:
    """Speed in each interval [m/s]  (nstep - 1,)."""
    return self._speed(0)

  @property
  def touching(self) -> np.ndarray | None:
    """Whether there was contact since the sample before  (nstep,)."""
    return self._recording.touching(self._which[0])

  @property
  def at_work(self) -> np.ndarray | None:
    """Whether any instrument had contact since the sample before, or a knot is tested  (nstep,)."""
    each = [self._recording.touching(k) for k in self._which]
    known = [touch for touch in each if touch is not None]
    if (security := self._recording.column("security", self._which[0])) is not None:
      known.append(security > 0.0)  # who waits for the test has nothing else to do
    return np.any(known, axis=0) if known else None

  @property
  def steady_speed(self) -> np.ndarray:
    """Speed of the path under `Settings.movement_cutoff` [m/s]  (nstep - 1,)."""
    return self._speed(0, steady=True)

  @property
  def steady_speeds(self) -> list[np.ndarray]:
    """The same of every instrument  (ninstrument, nstep - 1)."""
    return [self._speed(k, steady=True) for k in range(len(self._which))]

  @property
  def first_speed(self) -> np.ndarray:
    """Speed of the first of two instruments [m/s]  (nstep - 1,)."""
    return self._one_of_two(0)

  @property
  def second_speed(self) -> np.ndarray:
    """Speed of the second [m/s]  (nstep - 1,)."""
    return self._one_of_two(1)

  def _one_of_two(self, k: int) -> np.ndarray:
    if len(self._which) < 2:
      raise UnknownError("a single instrument")
    return self._speed(k)

  @functools.cached_property
  def _even(self) -> tuple[np.ndarray, float]:
    return m.uniform_speed(self.time, self._position(0))

  @property
  def even_speed(self) -> np.ndarray:
    """Speed at a constant rate [m/s]  (n,)."""
    return self._even[0]

  @property
  def rate(self) -> float:
    """That rate [1/s]."""
    return self._even[1]

  @property
  def kinds(self) -> list[str]:
    """Kinds of the instruments' events."""
    return [e.kind for e in self._recording.events if e.instrument in self._which]

  @property
  def watched(self) -> set[str]:
    """Kinds of event that were looked for: an event shows that its kind was."""
    return {*self._recording.watch, *(e.kind for e in self._recording.events)}

  @property
  def target_distance(self) -> list[float]:
    """Distances to the targets that were touched [m]."""
    return [
      math.nan if e.value is None else e.value
      for e in self._recording.events
      if e.kind == "target" and e.instrument in self._which
    ]

  @property
  def curve(self) -> np.ndarray:
    """Corners of the polyline to trace [m]  (ncorner, 3)."""
    if "curve" not in self._recording.constants:
      raise UnknownError("no curve to trace")
    return self._recording.constants["curve"]

  @property
  def touching_pos(self) -> np.ndarray:
    """Tip positions in contact, all of them where no force was recorded [m]  (n, 3)."""
    return self._tracing(lambda touch: touch)

  @property
  def traced_pos(self) -> np.ndarray:
    """Tip positions from the first to the last contact [m]  (n, 3)."""
    return self._tracing(lambda touch: slice(touch[0], touch[-1] + 1))

  def _tracing(self, choose: Callable[[np.ndarray], Any]) -> np.ndarray:
    _ = self.curve  # without one nothing is traced
    pos = self._position(0)
    if self._signal("force") is None:
      return pos
    touch = self._recording.touching(self._which[0]).nonzero()[0]
    if len(touch) == 0:
      raise UnknownError("no contact")
    return pos[choose(touch)]

  def _signal(self, name: str) -> np.ndarray | None:
    values = self._recording.signal(name, self._which[0])
    return None if values is None else m.magnitude(values, name)

  def _path(self, k: int) -> np.ndarray | None:
    if k not in self._paths:
      self._paths[k] = self._recording.tip_path(self._which[k])
    return self._paths[k]

  def _position(self, k: int) -> np.ndarray:
    if (pos := self._path(k)) is None:
      raise UnknownError("tip_pos not recorded")
    return pos

  def _speed(self, k: int, steady: bool = False) -> np.ndarray:
    pos = self._position(k)
    if steady:
      pos = m.low_pass(self.time, m.rows("tip_pos", pos, 3), self._settings["movement_cutoff"])
    return m.speed(self.time, pos)


def _combine(how: str, values: Sequence[float]) -> float:
  """Returns one value of several instruments; bad data of one makes all unknown, absence not."""
  for value in values:
    if isinstance(value, Unknown) and value.fault:
      return value
  known = [v for v in values if not math.isnan(v)]
  if not known:
    return values[0]
  return max(known) if how == "max" else sum(known) / (len(known) if how == "mean" else 1)


def _rotate(quat: np.ndarray, axis: Sequence[float]) -> np.ndarray:
  """Returns a vector of the tip's frame in the world  (nstep, 3)."""
  w, v = quat[:, :1], quat[:, 1:]
  twice = 2 * np.cross(v, np.asarray(axis, np.float64))
  return np.asarray(axis, np.float64) + w * twice + np.cross(v, twice)
