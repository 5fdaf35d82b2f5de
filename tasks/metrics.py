"""Skill metrics: pure functions of arrays, in SI units.

A metric that cannot be known (no contact, no motion, nothing recorded) is an `Unknown`: a NaN that
carries its reason, never a 0. A metric raises ValueError only for a mistake of the caller's: wrong
shapes, time that does not increase. Samples that are not finite make the metric unknown.
`score.Metrics` holds them all.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterable
from typing import ParamSpec

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

P = ParamSpec("P")

SPARC_CUTOFF = 10.0  # [Hz]
SPARC_AMPLITUDE = 0.05  # share of the largest amplitude
SPARC_PADDING = 4  # powers of two
EVENTS = ("target", "miss", "drop", "unintended_contact", "slip", "note")
ERRORS = ("miss", "drop", "unintended_contact")


class Unknown(float):
  """A NaN that knows why.

  Attributes:
    reason: what was missing, in words
    fault: True for bad data (then a sum over instruments is unknown too), False for absence
  """

  reason: str
  fault: bool

  def __new__(cls, reason: str, fault: bool = False) -> "Unknown":
    """Returns the NaN for this reason."""
    self = super().__new__(cls, "nan")
    self.reason, self.fault = reason, fault
    return self

  def __reduce__(self):
    return Unknown, (self.reason, self.fault)

  def __repr__(self) -> str:
    return f"Unknown({self.reason!r})"


class UnknownError(ValueError):
  """Raised by the helpers where a metric returns `Unknown`."""

  def __init__(self, reason: str, fault: bool = False):
    super().__init__(reason)
    self.fault = fault


def metric(function: Callable[P, float]) -> Callable[P, float]:
  """Turns a function that raises `UnknownError` into one that returns `Unknown`."""

  @functools.wraps(function)
  def wrapped(*args: P.args, **kwargs: P.kwargs) -> float:
    try:
      value = function(*args, **kwargs)
      return value if isinstance(value, Unknown) else float(value)
    except UnknownError as error:
      return Unknown(str(error), error.fault)

  return wrapped


def _rows(name: str, value: ArrayLike, *shape: int, least: int = 1) -> np.ndarray:
  """Returns value as float64 (n, *shape); at least `least` finite samples, or UnknownError."""
  rows = np.asarray(value, np.float64)
  if rows.size == 0:
    rows = rows.reshape(0, *shape)
  if rows.shape[1:] != shape or rows.ndim != 1 + len(shape):
    expected = ", ".join(["n", *map(str, shape)])
    raise ValueError(f"{name} has shape {rows.shape}, expected ({expected})")
  bad = ~np.isfinite(rows).all(axis=tuple(range(1, rows.ndim)))
  if bad.any():
    raise UnknownError(f"{name} is not finite at sample {int(bad.argmax())}", fault=True)
  if len(rows) < least:
    raise UnknownError(f"too few samples: {len(rows)}, at least {least} needed")
  return rows


def check_time(time: ArrayLike, least: int = 2) -> np.ndarray:
  """Returns time as float64 (n,); ValueError unless finite and strictly increasing."""
  time = np.asarray(time, np.float64)
  if time.ndim != 1:
    raise ValueError(f"time has shape {time.shape}, expected (n,)")
  if not np.isfinite(time).all():
    raise ValueError(f"time is not finite at sample {int((~np.isfinite(time)).argmax())}")
  back = np.diff(time) <= 0
  if back.any():
    k = int(back.argmax()) + 1
    raise ValueError(
      f"time does not increase at sample {k}: {float(time[k - 1])!r} s, then {float(time[k])!r} s"
    )
  return _rows("time", time, least=least)


def _same(name: str, rows: np.ndarray, time: np.ndarray, less: int = 0) -> np.ndarray:
  if len(rows) != len(time) - less:
    raise ValueError(f"{name} has {len(rows)} samples, expected {len(time) - less}")
  return rows


def _weights(time: np.ndarray) -> np.ndarray:
  """Returns the time each sample stands for (trapezoidal rule) [s]; 1 for a single sample."""
  if len(time) < 2:
    return np.ones(len(time))
  half = np.diff(time) / 2
  return np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])


# Motion.


@metric
def time_to_completion(time: ArrayLike) -> float:
  """Returns t_end - t_0 [s], lower is better (Oropesa et al. 2013); time (nstep,)."""
  time = check_time(time)
  return time[-1] - time[0]


@metric
def path_length(tip_pos: ArrayLike) -> float:
  """Returns the distance travelled [m], lower is better (Oropesa et al. 2013).

  Args:
    tip_pos: tip position [m]  (nstep, 3)
  """
  pos = _rows("tip_pos", tip_pos, 3, least=2)
  length = np.linalg.norm(np.diff(pos, axis=0), axis=1).sum()
  if length == 0:
    raise UnknownError("no motion")
  return length


@metric
def path_inefficiency(length: float, reference_length: float) -> float:
  """Returns 100 (length / reference_length - 1) [%], lower is better (Perk Tutor).

  The reference is the task's own path, not the straight line (10.1007/s00464-007-9526-z).

  Args:
    length: path length [m]
    reference_length: length of the path that the task asks for [m]
  """
  if isinstance(length, Unknown):
    raise UnknownError(length.reason, length.fault)
  if not reference_length > 0:
    raise UnknownError("no reference length")
  return 100 * (length / reference_length - 1)


def speed(time: ArrayLike, tip_pos: ArrayLike) -> np.ndarray:
  """Returns the speed in each interval between samples [m/s]  (nstep - 1,)."""
  time = check_time(time)
  pos = _same("tip_pos", _rows("tip_pos", tip_pos, 3), time)
  return np.linalg.norm(np.diff(pos, axis=0), axis=1) / np.diff(time)


def uniform_speed(time: ArrayLike, tip_pos: ArrayLike) -> tuple[np.ndarray, float]:
  """Returns the speed [m/s] at a constant rate, and that rate [1/s].

  Samples uneven by more than 0.1 % are interpolated linearly at the mean rate.
  """
  time = check_time(time)
  values = speed(time, tip_pos)
  step = np.diff(time)
  mean = (time[-1] - time[0]) / len(step)
  if np.abs(step - mean).max() > 1e-3 * mean:
    middle = (time[1:] + time[:-1]) / 2
    values = np.interp(middle[0] + mean * np.arange(len(middle)), middle, values)
  return values, float(1 / mean)


def speed_spectrum(values: ArrayLike, rate: float) -> tuple[np.ndarray, np.ndarray, int]:
  """Returns what SPARC looks at: frequency [Hz], normalised amplitude, points up to the cut-off.

  Args:
    values: speed at a constant rate [m/s]  (n,)
    rate: samples per second [1/s]
  """
  values = _rows("speed", values, least=2)
  if not values.any():
    raise UnknownError("no motion")
  size = 2 ** (math.ceil(math.log2(len(values))) + SPARC_PADDING)
  amplitude = np.abs(np.fft.rfft(values, size))
  amplitude /= amplitude.max()
  freq = np.arange(len(amplitude)) * (rate / size)
  selected = (freq <= SPARC_CUTOFF) & (amplitude >= SPARC_AMPLITUDE)
  return freq, amplitude, int(selected.nonzero()[0][-1]) + 1


@metric
def sparc(values: ArrayLike, rate: float) -> float:
  """Returns the spectral arc length of the speed [-], higher (towards 0) is smoother.

  Minus the arc length of the normalised spectrum up to the last frequency <= 10 Hz with amplitude
  >= 0.05, zero-padding 4 (Balasubramanian et al. 2015; 10.1186/s12984-015-0090-9). It is defined
  for one movement; over an exercise of many movements compare recordings of the same task only.

  Args:
    values: speed at a constant rate [m/s]  (n,)
    rate: samples per second [1/s]
  """
  freq, amplitude, cut = speed_spectrum(values, rate)
  if cut < 2:
    raise UnknownError("the speed spectrum has a single point under the cut-off")
  step = np.diff(freq[:cut]) / (freq[cut - 1] - freq[0])
  return -np.hypot(step, np.diff(amplitude[:cut])).sum()


@metric
def log_dimensionless_jerk(values: ArrayLike, rate: float) -> float:
  """Returns -ln((T^3 / v_peak^2) * integral of (d2 speed / dt2)^2) [-], higher is smoother.

  Balasubramanian et al. 2015. It differentiates the scalar speed, not the velocity vector, and
  T counts every sample, as the authors' code does.

  Args:
    values: speed at a constant rate [m/s]  (n,)
    rate: samples per second [1/s]
  """
  values = _rows("speed", values, least=3)
  peak = np.abs(values).max()
  if peak == 0:
    raise UnknownError("no motion")
  jerk = np.diff(values / peak, 2) * rate**2
  integral = np.square(jerk).sum() / rate
  if integral == 0:
    raise UnknownError("the speed has no curvature")
  return -math.log((len(values) / rate) ** 3 * integral)


def _turns(quat: np.ndarray) -> np.ndarray:
  """Returns the rotations between samples, in the body's frame (n - 1, 4), w >= 0."""
  norm = np.linalg.norm(quat, axis=1, keepdims=True)
  if (norm == 0).any():
    k = int((norm[:, 0] == 0).argmax())
    raise UnknownError(f"quat is zero at sample {k}", fault=True)
  quat = quat / norm
  w, v = quat[:-1, :1], -quat[:-1, 1:]
  w_next, v_next = quat[1:, :1], quat[1:, 1:]
  real = w * w_next - (v * v_next).sum(axis=1, keepdims=True)
  turn = np.concatenate([real, w * v_next + w_next * v + np.cross(v, v_next)], axis=1)
  return np.where(real < 0, -turn, turn)


@metric
def angular_path(quat: ArrayLike) -> float:
  """Returns the sum of the rotation angles between samples [rad], lower is better (PMC5845064).

  Args:
    quat: tip orientation, w x y z as in MuJoCo  (nstep, 4)
  """
  turn = _turns(_rows("quat", quat, 4, least=2))
  return (2 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=1), turn[:, 0])).sum()


@metric
def depth_path(tip_pos: ArrayLike, axis: ArrayLike) -> float:
  """Returns the distance travelled along the instrument [m], lower is better (Perk Tutor).

  Args:
    tip_pos: tip position [m]  (nstep, 3)
    axis: direction of the shaft in the world, any length; the mean of two samples is used between
      them  (nstep, 3)
  """
  pos = _rows("tip_pos", tip_pos, 3, least=2)
  shaft = _same("axis", _rows("axis", axis, 3), pos)
  unit = shaft / np.maximum(np.linalg.norm(shaft, axis=1, keepdims=True), np.finfo(float).tiny)
  step = np.diff(pos, axis=0)
  if not step.any():
    raise UnknownError("no motion")
  middle = unit[:-1] + unit[1:]
  norm = np.linalg.norm(middle, axis=1)
  if (norm == 0).any():
    k = int((norm == 0).argmax())
    raise UnknownError(f"axis is zero or reverses at sample {k}", fault=True)
  return (np.abs((step * middle).sum(axis=1)) / norm).sum()


@metric
def response_orientation(quat: ArrayLike, local_axis: ArrayLike = (0.0, 0.0, 1.0)) -> float:
  """Returns the sum of roll changes about the instrument [rad], lower is better (CELTS).

  The roll of a rotation is its twist about the shaft (swing-twist decomposition).

  Args:
    quat: tip orientation, w x y z as in MuJoCo  (nstep, 4)
    local_axis: direction of the shaft in the tip's own frame  (3,)
  """
  turn = _turns(_rows("quat", quat, 4, least=2))
  axis = np.asarray(local_axis, np.float64)
  if axis.shape != (3,) or not np.isfinite(axis).all() or not axis.any():
    raise ValueError(f"local_axis is {local_axis!r}, expected three numbers, not all zero")
  along = turn[:, 1:] @ (axis / np.linalg.norm(axis))
  # w >= 0, so that the angle lies in [-pi, pi].
  return np.abs(2 * np.arctan2(along, turn[:, 0])).sum()


@metric
def number_of_movements(
  time: ArrayLike, values: ArrayLike, threshold: float = 0.05, debounce: float = 0.2
) -> float:
  """Returns how often the tip starts to move [count], lower is better (ICSAD, Perk Tutor).

  A movement starts when the speed stays above the threshold for the debounce time and ends when it
  stays below for as long; shorter bursts and pauses do not count.

  Args:
    time: sample times [s]  (nstep,)
    values: speed in each interval [m/s]  (nstep - 1,)
    threshold: speed above which the tip moves [m/s]
    debounce: shortest movement and shortest pause [s]
  """
  time = check_time(time)
  values = _same("speed", _rows("speed", values), time, less=1)
  if not values.any():
    raise UnknownError("no motion")
  moving = values > threshold
  first = np.concatenate([[0], np.diff(moving).nonzero()[0] + 1])
  last = np.concatenate([first[1:], [len(moving)]])
  # Sums of time steps round: without the margin ten steps of 0.02 s may miss 0.2 s.
  long = time[last] - time[first] >= debounce - 1e-9
  state = np.concatenate([[False], moving[first][long]])
  return int(np.count_nonzero(~state[:-1] & state[1:]))


@metric
def idle_time(time: ArrayLike, speeds: ArrayLike, threshold: float = 0.005) -> float:
  """Returns the time with every instrument slower than the threshold [s], lower is better.

  PMC4412306 calls it the lack of movement of both hands; 5 mm/s is this project's number.

  Args:
    time: sample times [s]  (nstep,)
    speeds: speed in each interval, a row an instrument [m/s]  (ninstrument, nstep - 1)
    threshold: speed below which an instrument rests [m/s]
  """
  time = check_time(time)
  table = np.atleast_2d(np.asarray(speeds, np.float64)).T
  rows = _same("speeds", _rows("speeds", table, table.shape[1]), time, less=1)
  return np.diff(time)[(rows < threshold).all(axis=1)].sum()


@metric
def idle_share(time: ArrayLike, speeds: ArrayLike, threshold: float = 0.005) -> float:
  """Returns `idle_time` as a share of the whole time [%], lower is better (PMC4412306)."""
  idle = idle_time(time, speeds, threshold)
  if isinstance(idle, Unknown):
    raise UnknownError(idle.reason, idle.fault)
  time = check_time(time)
  return 100 * idle / (time[-1] - time[0])


@metric
def bimanual_dexterity(first: ArrayLike, second: ArrayLike) -> float:
  """Returns Pearson's correlation of two instruments' speeds [-], higher is better.

  Hofstad et al. 2013.

  Args:
    first: speed of one instrument [m/s]  (n,)
    second: speed of the other [m/s]  (n,)
  """
  a = _rows("first speed", first, least=2)
  b = _same("second speed", _rows("second speed", second), a)
  # ptp, not a variance: the variance of a constant is rounding error, and so would the result be.
  if np.ptp(a) == 0 or np.ptp(b) == 0:
    raise UnknownError("an instrument's speed does not change")
  a, b = a - a.mean(), b - b.mean()
  return np.clip((a @ b) / math.sqrt((a @ a) * (b @ b)), -1, 1)


@metric
def out_of_view(time: ArrayLike, visible: ArrayLike) -> float:
  """Returns the share of time the tip is outside the view [%], lower is better (PMC5845064).

  Args:
    time: sample times [s]  (nstep,)
    visible: 1 where the camera's view holds the tip, else 0 (see `in_view`)  (nstep,)
  """
  time = check_time(time)
  seen = _same("visible", _rows("visible", visible), time) > 0.5
  return 100 * _weights(time)[~seen].sum() / (time[-1] - time[0])


def in_view(
  tip_pos: ArrayLike, cam_pos: ArrayLike, cam_mat: ArrayLike, fovy: float, aspect: float = 4 / 3
) -> np.ndarray:
  """Returns whether points lie inside a MuJoCo camera's view; tissue in front is not looked at.

  Args:
    tip_pos: points in the world [m]  (nstep, 3), or one (3,)
    cam_pos: `cam_xpos` [m]  (3,) or (nstep, 3)
    cam_mat: `cam_xmat`; the camera looks along its -z  (3, 3) or (nstep, 3, 3)
    fovy: vertical field of view, as in MuJoCo [deg]
    aspect: width over height of the picture [-]
  """
  offset = np.asarray(tip_pos, np.float64) - np.asarray(cam_pos, np.float64)
  mat = np.asarray(cam_mat, np.float64)
  local = offset @ mat if mat.ndim == 2 else np.einsum("nij,ni->nj", mat, offset)
  half = -local[..., 2] * math.tan(math.radians(fovy) / 2)
  inside = (np.abs(local[..., 1]) <= half) & (np.abs(local[..., 0]) <= half * aspect)
  return inside & (local[..., 2] < 0)


# Force.


def magnitude(force: ArrayLike) -> np.ndarray:
  """Returns the magnitude of contact forces [N]  (nstep,); force (nstep,) or (nstep, 3)."""
  force = np.asarray(force, np.float64)
  if force.ndim == 2:
    return np.linalg.norm(_rows("force", force, 3), axis=1)
  return np.abs(_rows("force", force))


def _touch(force: ArrayLike, contact: float) -> tuple[np.ndarray, np.ndarray]:
  force = magnitude(force)
  touch = force > contact
  if not touch.any():
    raise UnknownError("no contact")
  return force, touch


@metric
def peak_force(force: ArrayLike, contact: float = 0.0) -> float:
  """Returns the largest contact force [N], lower is better (Horeman et al. 2010).

  Args:
    force: contact force [N]  (nstep,) or (nstep, 3)
    contact: force above which there is contact [N]
  """
  return _touch(force, contact)[0].max()


@metric
def mean_force(time: ArrayLike, force: ArrayLike, contact: float = 0.0) -> float:
  """Returns the mean force over the time in contact [N], lower is better (Horeman et al. 2010)."""
  time = check_time(time, least=1)
  force, touch = _touch(force, contact)
  weight = _weights(time)[_same("force", touch, time)]
  return (weight * force[touch]).sum() / weight.sum()


@metric
def rms_force(time: ArrayLike, force: ArrayLike, contact: float = 0.0) -> float:
  """Returns the root mean square force over the time in contact [N], lower is better.

  Horeman et al. 2010; Barrie et al. 2018. Over contact, like the mean: time in the air would
  otherwise lower it.
  """
  time = check_time(time, least=1)
  force, touch = _touch(force, contact)
  weight = _weights(time)[_same("force", touch, time)]
  return math.sqrt((weight * force[touch] ** 2).sum() / weight.sum())


@metric
def force_time_product(time: ArrayLike, force: ArrayLike, contact: float = 0.0) -> float:
  """Returns the integral of force over time [N s], lower is better (Barrie et al. 2018)."""
  time = check_time(time)
  force, touch = _touch(force, contact)
  return float(np.trapezoid(_same("force", np.where(touch, force, 0.0), time), time))


@metric
def force_breaches(force: ArrayLike, limit: float, contact: float = 0.0) -> float:
  """Returns the number of excursions above the limit [count], lower is better (Rodrigues).

  Args:
    force: contact force [N]  (nstep,) or (nstep, 3)
    limit: F_max [N]
    contact: force above which there is contact [N]
  """
  over = _touch(force, contact)[0] > _limit(limit)
  return int(over[0]) + int(np.count_nonzero(~over[:-1] & over[1:]))


@metric
def excess_impulse(time: ArrayLike, force: ArrayLike, limit: float, contact: float = 0.0) -> float:
  """Returns the integral of max(force - limit, 0) [N s], lower is better (Horeman et al. 2010).

  Exact for a force that is linear between samples.
  """
  time = check_time(time)
  over = _same("force", _touch(force, contact)[0], time) - _limit(limit)
  a, b = over[:-1], over[1:]
  above = np.maximum(a, 0) + np.maximum(b, 0)
  whole = np.abs(a) + np.abs(b)
  # A crossing leaves the share above/whole of the interval over the limit.
  share = np.divide(above, whole, out=np.zeros_like(whole), where=whole > 0)
  return (np.diff(time) * above * share).sum() / 2


def _limit(limit: float) -> float:
  if not limit >= 0:
    raise UnknownError("no force limit")
  return limit


@metric
def peak_pressure(force: ArrayLike, area: ArrayLike, contact: float = 0.0) -> float:
  """Returns the largest force over contact area [Pa], lower is better.

  Bowel is damaged at 329-330 kPa (10.1136/bmjsit-2021-000084).

  Args:
    force: contact force [N]  (nstep,) or (nstep, 3)
    area: area of the organ's touched triangles [m^2]  (nstep,)
    contact: force above which there is contact [N]
  """
  force, touch = _touch(force, contact)
  area = _same("area", _rows("area", area), force)
  if (area[touch] <= 0).any():
    k = int((touch & (area <= 0)).argmax())
    raise UnknownError(f"force without contact area at sample {k}", fault=True)
  return (force[touch] / area[touch]).max()


# Outcome.


def count_events(kinds: Iterable[str], wanted: Iterable[str]) -> float:
  """Returns how many events are of the wanted kinds [count], lower is better.

  Errors are unintended contacts, drops and misses: 10.1186/s12893-020-00839-z.
  """
  wanted = frozenset(wanted)
  return float(sum(str(kind) in wanted for kind in kinds))


@metric
def grasp_slips(closed: ArrayLike, held: ArrayLike) -> float:
  """Returns how many grasps are lost before release [count], lower is better (GOALS).

  Args:
    closed: above 0.5 where the jaw is told to close  (nstep,)
    held: above 0.5 where the jaw holds tissue  (nstep,)
  """
  closed = _rows("grip", closed) > 0.5
  held = _same("held", _rows("held", held), closed) > 0.5
  if not held.any():
    raise UnknownError("nothing was grasped")
  return int(np.count_nonzero(held[:-1] & ~held[1:] & closed[1:]))


@metric
def target_error(distance: ArrayLike) -> float:
  """Returns the mean distance to the target at touch [m], lower is better (Perk Tutor).

  Args:
    distance: distance to the target, one a touch [m]  (n,)
  """
  touched = _rows("distance", distance, least=0)
  if len(touched) == 0:
    raise UnknownError("no target was touched")
  return float(touched.mean())


@metric
def trace_rms(tip_pos: ArrayLike, curve: ArrayLike) -> float:
  """Returns the root mean square distance of the tip to a polyline [m], lower is better.

  Perk Tutor.

  Args:
    tip_pos: tip position while tracing [m]  (nstep, 3)
    curve: corners of the polyline [m]  (ncorner, 3)
  """
  pos = _rows("tip_pos", tip_pos, 3)
  curve = _rows("curve", curve, 3, least=2)
  least = np.full(len(pos), np.inf)
  for start, end in itertools.pairwise(curve):  # a polyline has few segments
    along = end - start
    share = np.clip((pos - start) @ along / max(along @ along, np.finfo(float).tiny), 0, 1)
    gap = pos - start - share[:, None] * along
    np.minimum(least, (gap * gap).sum(axis=1), out=least)
  return math.sqrt(least.mean())


@metric
def trace_frechet(tip_pos: ArrayLike, curve: ArrayLike) -> float:
  """Returns the discrete Frechet distance of the tip's path to a curve [m], lower is better.

  Eiter and Mannila 1994, on the curve with points added every 1/256 of its length. Both run in
  their order: a curve traced backwards scores badly. Above the continuous distance by at most the
  largest gap between neighbouring samples.

  Args:
    tip_pos: tip position while tracing [m]  (nstep, 3)
    curve: corners of the polyline [m]  (ncorner, 3)
  """
  pos = _rows("tip_pos", tip_pos, 3)
  curve = _rows("curve", curve, 3, least=2)
  at = np.concatenate([[0.0], np.linalg.norm(np.diff(curve, axis=0), axis=1).cumsum()])
  fine = np.union1d(at, np.linspace(0, at[-1], 257))
  if len(fine) < 2:
    raise UnknownError("the curve has no length")
  distance = cdist(pos, np.stack([np.interp(fine, at, column) for column in curve.T], axis=1))
  n, m = distance.shape
  flat = distance.ravel()
  # Anti-diagonals i + j = k do not depend on themselves; entry i + 1 belongs to row i.
  before, last, new = np.full((3, n + 1), np.inf)
  before[0] = -np.inf  # the way into (0, 0)
  for k in range(n + m - 1):
    low, high = max(0, k - m + 1), min(k, n - 1) + 1
    cost = flat[k + low * (m - 1) : k + (high - 1) * (m - 1) + 1 : m - 1]
    here = new[low + 1 : high + 1]
    np.minimum(last[low + 1 : high + 1], last[low:high], out=here)
    np.minimum(here, before[low:high], out=here)
    np.maximum(here, cost, out=here)
    before[: low + 2] = np.inf  # becomes `new`, whose rows start one later at most
    before, last, new = last, new, before
  return float(last[n])
