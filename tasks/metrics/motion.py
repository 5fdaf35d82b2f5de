"""How the tip moved."""

import math

import numpy as np
from numpy.typing import ArrayLike

from .definition import Unknown, UnknownError, metric
from .samples import check_time, rows, same, speed_spectrum, weights

_SMOOTH = "Balasubramanian et al. 2015"
_EVA = "Oropesa et al. 2013 (10.1007/s00464-012-2513-z)"


@metric("Time to completion", "s", "time", "all", "Oropesa et al. 2013", name="time")
def time_to_completion(time: ArrayLike) -> float:
  """Returns t_end - t_0 [s], lower is better (Oropesa et al. 2013); time (nstep,)."""
  time = check_time(time)
  return time[-1] - time[0]


@metric("Path length", "m", "efficiency", "sum", "Oropesa et al. 2013")
def path_length(tip_pos: ArrayLike) -> float:
  """Returns the distance travelled [m], lower is better (Oropesa et al. 2013).

  Args:
    tip_pos: tip position [m]  (nstep, 3)
  """
  pos = rows("tip_pos", tip_pos, 3, least=2)
  length = np.linalg.norm(np.diff(pos, axis=0), axis=1).sum()
  if length == 0:
    raise UnknownError("no motion")
  return length


@metric("Mean speed", "m/s", "efficiency", "mean", _EVA, "neither")
def mean_speed(time: ArrayLike, tip_pos: ArrayLike) -> float:
  """Returns path length over time [m/s], neither is better (Oropesa et al. 2013).

  Experts are faster on their way, and slower where it matters.

  Args:
    time: sample times [s]  (nstep,)
    tip_pos: tip position [m]  (nstep, 3)
  """
  time = check_time(time)
  return _moved(path_length(tip_pos)) / (time[-1] - time[0])


@metric("Peak speed", "m/s", "dexterity", "max", "PMC5845064")
def peak_speed(speed: ArrayLike) -> float:
  """Returns the largest speed [m/s], lower is better (a feature of PMC5845064).

  A tip that is fast cannot stop before what it meets.

  Args:
    speed: in each interval [m/s]  (nstep - 1,)
  """
  values = rows("speed", speed)
  if not values.any():
    raise UnknownError("no motion")
  return values.max()


@metric("Peak speed in contact", "m/s", "safety", "max", "this project; as PMC5845064 of the path")
def contact_speed(speed: ArrayLike, touching: ArrayLike) -> float:
  """Returns the largest speed with which the tip meets or moves tissue [m/s], lower is better.

  Ripping, slashing and ramming succeed by speed where a slow hand succeeds by care.

  Args:
    speed: in each interval [m/s]  (nstep - 1,)
    touching: whether there was contact since the sample before  (nstep,)
  """
  values = rows("speed", speed)
  touch = rows("touching", touching) > 0.5
  if len(touch) != len(values) + 1:
    raise ValueError(f"touching has {len(touch)} samples, expected {len(values) + 1}")
  if not touch[1:].any():
    raise UnknownError("no contact")
  return values[touch[1:]].max()


@metric("Economy of volume", "-", "efficiency", "mean", _EVA, "neither")
def economy_of_volume(tip_pos: ArrayLike) -> float:
  """Returns the cube root of the volume the tip used over its path [-], neither is better.

  Oropesa et al. 2013. The volume is that of the path's bounding box along the world's axes. Who
  transfers many pegs does well to be high; the straightest way to one place is 0.

  Args:
    tip_pos: tip position [m]  (nstep, 3)
  """
  length = _moved(path_length(tip_pos))
  return np.cbrt(np.ptp(np.asarray(tip_pos, np.float64), axis=0).prod()) / length


@metric("Path inefficiency", "%", "efficiency", "all", "Perk Tutor; 10.1007/s00464-007-9526-z")
def path_inefficiency(path_length: float, reference_length: float, finished: bool = True) -> float:
  """Returns 100 (path_length / reference_length - 1) [%], lower is better (Perk Tutor).

  The reference is the task's own path, not the straight line (10.1007/s00464-007-9526-z).

  Args:
    path_length: of all instruments together [m]
    reference_length: length of the path that the task asks for [m]
    finished: whether the task was done; of one that was not, the path is a part
  """
  _moved(path_length)
  if not finished:
    raise UnknownError("the exercise was not finished")
  if not reference_length > 0:
    raise UnknownError("no reference length")
  return 100 * (path_length / reference_length - 1)


def _moved(length: float) -> float:
  """Returns a path's length; UnknownError where it is unknown."""
  if isinstance(length, Unknown):
    raise UnknownError(length.reason, length.fault)
  return length


@metric("Smoothness (SPARC)", "-", "dexterity", "mean", _SMOOTH, "neither")
def sparc(even_speed: ArrayLike, rate: float) -> float:
  """Returns the spectral arc length of the speed [-], neither is better.

  Minus the arc length of the normalised spectrum up to the last frequency <= 10 Hz with amplitude
  >= 0.05, zero-padding 4 (Balasubramanian et al. 2015; 10.1186/s12984-015-0090-9). It is defined
  for one movement, where higher (towards 0) is smoother. An exercise has many, and their number
  moves it more than a tremor does (the trembling novice is smoother in `touch/standard`), so it is
  not scored: the jerk is.
  Its filter is the cut-off itself; a recording's positions also went through `tip_cutoff`.

  Args:
    even_speed: speed at a constant rate [m/s]  (n,)
    rate: samples per second [1/s]
  """
  freq, amplitude, cut = speed_spectrum(even_speed, rate)
  if cut < 2:
    raise UnknownError("the speed spectrum has a single point under the cut-off")
  step = np.diff(freq[:cut]) / (freq[cut - 1] - freq[0])
  return -np.hypot(step, np.diff(amplitude[:cut])).sum()


@metric("Log dimensionless jerk", "-", "dexterity", "mean", _SMOOTH, "higher")
def log_dimensionless_jerk(even_speed: ArrayLike, rate: float) -> float:
  """Returns -ln((T^3 / v_peak^2) * integral of (d2 speed / dt2)^2) [-], higher is smoother.

  Balasubramanian et al. 2015. It differentiates the scalar speed, not the velocity vector, and
  T counts every sample, as the authors' code does. It filters nothing: noise of 0.05 mm takes it
  from -14 to -33 between 25 Hz and 1 kHz. In a recording of measured positions, which went through
  `tip_cutoff` (`samples.low_pass`), the same noise leaves it within 0.6.

  Args:
    even_speed: speed at a constant rate [m/s]  (n,)
    rate: samples per second [1/s]
  """
  values = rows("speed", even_speed, least=3)
  peak = np.abs(values).max()
  if peak == 0:
    raise UnknownError("no motion")
  jerk = np.diff(values / peak, 2) * rate**2
  integral = np.square(jerk).sum() / rate
  if integral == 0:
    raise UnknownError("the speed has no curvature")
  return -math.log((len(values) / rate) ** 3 * integral)


@metric("Angular path", "rad", "efficiency", "sum", "PMC5845064")
def angular_path(quat: ArrayLike, moved: bool = True) -> float:
  """Returns the sum of the rotation angles between samples [rad], lower is better (PMC5845064).

  Args:
    quat: tip orientation, w x y z as in MuJoCo  (nstep, 4)
    moved: whether the tip did; one that never moved nor turned did not turn economically
  """
  turn = _turns(rows("quat", quat, 4, least=2), moved)
  return (2 * np.arctan2(np.linalg.norm(turn[:, 1:], axis=1), turn[:, 0])).sum()


@metric("Depth path", "m", "efficiency", "sum", "Perk Tutor")
def depth_path(tip_pos: ArrayLike, axis: ArrayLike) -> float:
  """Returns the distance travelled along the instrument [m], lower is better (Perk Tutor).

  Args:
    tip_pos: tip position [m]  (nstep, 3)
    axis: direction of the shaft in the world, any length; the mean of two samples is used between
      them  (nstep, 3)
  """
  pos = rows("tip_pos", tip_pos, 3, least=2)
  shaft = same("axis", rows("axis", axis, 3), pos)
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


@metric("Response orientation", "rad", "efficiency", "sum", "CELTS")
def response_orientation(
  quat: ArrayLike, local_axis: ArrayLike = (0.0, 0.0, 1.0), moved: bool = True
) -> float:
  """Returns the sum of roll changes about the instrument [rad], lower is better (CELTS).

  The roll of a rotation is its twist about the shaft (swing-twist decomposition).

  Args:
    quat: tip orientation, w x y z as in MuJoCo  (nstep, 4)
    local_axis: direction of the shaft in the tip's own frame  (3,)
    moved: see `angular_path`
  """
  turn = _turns(rows("quat", quat, 4, least=2), moved)
  axis = np.asarray(local_axis, np.float64)
  if axis.shape != (3,) or not np.isfinite(axis).all() or not axis.any():
    raise ValueError(f"local_axis is {local_axis!r}, expected three numbers, not all zero")
  along = turn[:, 1:] @ (axis / np.linalg.norm(axis))
  # w >= 0, so that the angle lies in [-pi, pi].
  return np.abs(2 * np.arctan2(along, turn[:, 0])).sum()


def _turns(quat: np.ndarray, moved: bool) -> np.ndarray:
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
  if not moved and not turn[:, 1:].any():
    raise UnknownError("no motion")
  return np.where(real < 0, -turn, turn)


@metric("Number of movements", "count", "efficiency", "sum", "ICSAD; Perk Tutor")
def number_of_movements(
  time: ArrayLike,
  steady_speed: ArrayLike,
  movement_speed: float = 0.05,
  movement_debounce: float = 0.2,
) -> float:
  """Returns how often the tip starts to move [count], lower is better (ICSAD, Perk Tutor).

  A movement starts when the speed stays above the threshold for the debounce time and ends when it
  stays below for as long; shorter bursts and pauses do not count. ICSAD counts on a filtered
  signal; here the speed is that of the path without what is faster than voluntary movement, else a
  hand that trembles would make one movement of all, and never rest.

  Args:
    time: sample times [s]  (nstep,)
    steady_speed: in each interval, of the path under `movement_cutoff` [m/s]  (nstep - 1,)
    movement_speed: above which the tip moves [m/s]
    movement_debounce: shortest movement and shortest pause [s]
  """
  time = check_time(time)
  values = same("speed", rows("speed", steady_speed), time, less=1)
  if not values.any():
    raise UnknownError("no motion")
  moving = values > movement_speed
  first = np.concatenate([[0], np.diff(moving).nonzero()[0] + 1])
  last = np.concatenate([first[1:], [len(moving)]])
  # Sums of time steps round: without the margin ten steps of 0.02 s may miss 0.2 s.
  long = time[last] - time[first] >= movement_debounce - 1e-9
  state = np.concatenate([[False], moving[first][long]])
  return int(np.count_nonzero(~state[:-1] & state[1:]))


@metric("Idle time", "s", "efficiency", "all", "PMC4412306")
def idle_time(
  time: ArrayLike,
  steady_speeds: ArrayLike,
  at_work: ArrayLike | None = None,
  idle_speed: float = 0.005,
) -> float:
  """Returns the time with every instrument slow and none in contact [s], lower is better.

  PMC4412306 calls it the lack of movement of both hands; 5 mm/s is this project's number. Who
  presses, holds or cuts with care is slow and not idle, so contact counts as work.

  Args:
    time: sample times [s]  (nstep,)
    steady_speeds: as in `number_of_movements`, a row an instrument [m/s]  (ninstrument, nstep - 1)
    at_work: whether an instrument had contact since the sample before; never without it  (nstep,)
    idle_speed: below which an instrument rests [m/s]
  """
  time = check_time(time)
  table = np.atleast_2d(np.asarray(steady_speeds, np.float64)).T
  table = same("speeds", rows("speeds", table, table.shape[1]), time, less=1)
  idle = (table < idle_speed).all(axis=1)
  if at_work is not None:
    idle &= ~(same("at_work", rows("at_work", at_work), time)[1:] > 0.5)
  return np.diff(time)[idle].sum()


@metric("Idle share", "%", "efficiency", "all", "PMC4412306")
def idle_share(time: ArrayLike, idle_time: float) -> float:
  """Returns `idle_time` as a share of the whole time [%], lower is better (PMC4412306)."""
  if isinstance(idle_time, Unknown):
    raise UnknownError(idle_time.reason, idle_time.fault)
  time = check_time(time)
  return 100 * idle_time / (time[-1] - time[0])


@metric("Bimanual dexterity", "-", "dexterity", "all", "Hofstad et al. 2013", "neither")
def bimanual_dexterity(first_speed: ArrayLike, second_speed: ArrayLike) -> float:
  """Returns Pearson's correlation of two instruments' speeds [-], neither is better.

  Hofstad et al. 2013. Where one hand holds still and the other divides it is low for good reason.

  Args:
    first_speed: of one instrument [m/s]  (n,)
    second_speed: of the other [m/s]  (n,)
  """
  a = rows("first speed", first_speed, least=2)
  b = same("second speed", rows("second speed", second_speed), a)
  # ptp, not a variance: the variance of a constant is rounding error, and so would the result be.
  if np.ptp(a) == 0 or np.ptp(b) == 0:
    raise UnknownError("an instrument's speed does not change")
  a, b = a - a.mean(), b - b.mean()
  return np.clip((a @ b) / math.sqrt((a @ a) * (b @ b)), -1, 1)


@metric("Out of view", "%", "safety", "mean", "PMC5845064")
def out_of_view(time: ArrayLike, visible: ArrayLike) -> float:
  """Returns the share of time the tip is outside the view [%], lower is better (PMC5845064).

  Args:
    time: sample times [s]  (nstep,)
    visible: 1 where the camera's view holds the tip, else 0 (see `samples.in_view`)  (nstep,)
  """
  return _share_without("visible", visible, time)


def _share_without(name: str, holds: ArrayLike, time: ArrayLike) -> float:
  """Returns the share of time that something is not so [%]; `holds` is 1 where it is."""
  time = check_time(time)
  so = same(name, rows(name, holds), time) > 0.5
  return 100 * weights(time)[~so].sum() / (time[-1] - time[0])


@metric("Off centre", "%", "efficiency", "all", "PMC6465181: centre the target")
def off_centre(time: ArrayLike, centred: ArrayLike) -> float:
  """Returns the share of time that what is shown is off the picture's middle [%], lower is better.

  Args:
    time: sample times [s]  (nstep,)
    centred: 1 where what is to be shown is in the middle of the camera's view, else 0  (nstep,)
  """
  return _share_without("centred", centred, time)


@metric("Horizon angle", "rad", "dexterity", "all", "this project: a level picture")
def horizon_angle(time: ArrayLike, horizon: ArrayLike) -> float:
  """Returns the mean angle of the picture against the horizon [rad], lower is better.

  Args:
    time: sample times [s]  (nstep,)
    horizon: angle of the picture's right against the horizontal [rad]  (nstep,)
  """
  time = check_time(time)
  angle = np.abs(same("horizon", rows("horizon", horizon), time))
  return (weights(time) * angle).sum() / (time[-1] - time[0])
