"""Samples as metrics take them: checked, weighted by time, and what follows from them."""

import math

import numpy as np
from numpy.typing import ArrayLike

from .definition import UnknownError

SPARC_CUTOFF = 10.0  # [Hz]
SPARC_AMPLITUDE = 0.05  # share of the largest amplitude
SPARC_PADDING = 4  # powers of two


def rows(name: str, value: ArrayLike, *shape: int, least: int = 1) -> np.ndarray:
  """Returns value as float64 (n, *shape); at least `least` finite samples, or UnknownError."""
  table = np.asarray(value, np.float64)
  if table.size == 0:
    table = table.reshape(0, *shape)
  if table.shape[1:] != shape or table.ndim != 1 + len(shape):
    expected = ", ".join(["n", *map(str, shape)])
    raise ValueError(f"{name} has shape {table.shape}, expected ({expected})")
  bad = ~np.isfinite(table).all(axis=tuple(range(1, table.ndim)))
  if bad.any():
    raise UnknownError(f"{name} is not finite at sample {int(bad.argmax())}", fault=True)
  if len(table) < least:
    raise UnknownError(f"too few samples: {len(table)}, at least {least} needed")
  return table


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
  return rows("time", time, least=least)


def same(name: str, table: np.ndarray, time: np.ndarray, less: int = 0) -> np.ndarray:
  """Returns the table; ValueError unless it has a row a sample, or `less` fewer."""
  if len(table) != len(time) - less:
    raise ValueError(f"{name} has {len(table)} samples, expected {len(time) - less}")
  return table


def weights(time: np.ndarray) -> np.ndarray:
  """Returns the time each sample stands for (trapezoidal rule) [s]; 1 for a single sample."""
  if len(time) < 2:
    return np.ones(len(time))
  half = np.diff(time) / 2
  return np.concatenate([half, [0.0]]) + np.concatenate([[0.0], half])


def magnitude(force: ArrayLike) -> np.ndarray:
  """Returns the magnitude of contact forces [N]  (nstep,); force (nstep,) or (nstep, 3)."""
  force = np.asarray(force, np.float64)
  if force.ndim == 2:
    return np.linalg.norm(rows("force", force, 3), axis=1)
  return np.abs(rows("force", force))


def speed(time: ArrayLike, tip_pos: ArrayLike) -> np.ndarray:
  """Returns the speed in each interval between samples [m/s]  (nstep - 1,)."""
  time = check_time(time)
  pos = same("tip_pos", rows("tip_pos", tip_pos, 3), time)
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


def speed_spectrum(even_speed: ArrayLike, rate: float) -> tuple[np.ndarray, np.ndarray, int]:
  """Returns what SPARC looks at: frequency [Hz], normalised amplitude, points up to the cut-off.

  Args:
    even_speed: speed at a constant rate [m/s]  (n,)
    rate: samples per second [1/s]
  """
  values = rows("speed", even_speed, least=2)
  if not values.any():
    raise UnknownError("no motion")
  size = 2 ** (math.ceil(math.log2(len(values))) + SPARC_PADDING)
  amplitude = np.abs(np.fft.rfft(values, size))
  amplitude /= amplitude.max()
  freq = np.arange(len(amplitude)) * (rate / size)
  selected = (freq <= SPARC_CUTOFF) & (amplitude >= SPARC_AMPLITUDE)
  return freq, amplitude, int(selected.nonzero()[0][-1]) + 1


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
