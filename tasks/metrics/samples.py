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


def magnitude(force: ArrayLike, name: str = "force") -> np.ndarray:
  """Returns the magnitude of contact forces [N]  (nstep,); force (nstep,) or (nstep, 3)."""
  force = np.asarray(force, np.float64)
  if force.ndim == 2:
    return np.linalg.norm(rows(name, force, 3), axis=1)
  return np.abs(rows(name, force))


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


def low_pass(time: ArrayLike, values: ArrayLike, cutoff: float) -> np.ndarray:
  """Returns samples without what is faster than a cut-off, at the same times.

  A Butterworth filter of order 4 run both ways (no lag), gain 1 / (1 + (f / cutoff)^8), over the
  odd continuation at both ends: straight lines and the two ends stay as they are. Samples uneven by
  more than 0.1 % are interpolated to even ones and back. At half the rate and above nothing is cut.

  Args:
    time: sample times [s]  (nstep,)
    values: at those times  (nstep,) or (nstep, n)
    cutoff: where the gain is a half [Hz]
  """
  time = check_time(time, least=1)
  table = np.asarray(values, np.float64)
  table = same("values", rows("values", table, *table.shape[1:]), time)
  count = len(time) - 1
  if count < 2 or cutoff >= count / (time[-1] - time[0]) / 2:
    return table
  even = np.linspace(time[0], time[-1], count + 1)
  step = even[1] - even[0]
  uneven = np.abs(np.diff(time) - step).max() > 1e-3 * step
  flat = table.reshape(count + 1, -1).T
  if uneven:
    flat = np.stack([np.interp(even, time, column) for column in flat])
  line = flat[:, :1] + (flat[:, -1:] - flat[:, :1]) * np.linspace(0, 1, count + 1)
  rest = flat - line
  odd = np.concatenate([rest, -rest[:, -2:0:-1]], axis=1)
  gain = 1 / (1 + (np.fft.rfftfreq(2 * count, step) / cutoff) ** 8)
  out = line + np.fft.irfft(np.fft.rfft(odd) * gain, 2 * count)[:, : count + 1]
  if uneven:
    out = np.stack([np.interp(time, even, column) for column in out])
  return out.T.reshape(table.shape)


def low_pass_rotation(time: ArrayLike, quat: ArrayLike, cutoff: float) -> np.ndarray:
  """Returns orientations without what is faster than a cut-off, w x y z, see `low_pass`  (n, 4)."""
  table = rows("quat", quat, 4)
  # -q is the same rotation: the sign that jumps least.
  flips = np.cumprod(np.where((table[1:] * table[:-1]).sum(axis=1) < 0, -1.0, 1.0))
  smooth = low_pass(time, table * np.concatenate([[1.0], flips])[:, None], cutoff)
  norm = np.linalg.norm(smooth, axis=1, keepdims=True)
  return smooth / np.where(norm > 0, norm, 1.0)


class Stretch:
  """How much longer the fibres of a surface have become that are stretched most.

  Of each triangle the engineering strain lambda - 1 of the larger principal stretch lambda:
  lambda^2 is the larger eigenvalue of C = F^T F in its plane (Bonet and Wood 2008, chapter 4). It
  is 0 for a rigid motion.
  """

  def __init__(self, rest: np.ndarray, triangles: np.ndarray):
    """Takes the shape at rest.

    Args:
      rest: corners [m]  (nvert, 3)
      triangles: their corners' indices  (ntri, 3)
    """
    self._corners = [np.ascontiguousarray(corner) for corner in np.asarray(triangles).T]
    self._rest = e, f, g = self._metric(rest)
    # Four times the squared area at rest.
    self._area2 = np.maximum(e * g - f * f, np.finfo(float).tiny)

  def each(self, now: np.ndarray) -> np.ndarray:
    """Returns the strain of each triangle [-]  (ntri,); `now` are the corners [m]  (nvert, 3)."""
    return np.sqrt(self._squares(now)) - 1

  def most(self, now: np.ndarray) -> float:
    """Returns the largest strain [-]."""
    return math.sqrt(self._squares(now).max()) - 1

  def _squares(self, now: np.ndarray) -> np.ndarray:
    # With the edges a, b as basis, C is G(now) in a basis with metric G(rest): a 2 x 2 problem.
    (e, f, g), (x, y, z) = self._rest, self._metric(now)
    half = (x * g - 2 * y * f + z * e) / (2 * self._area2)
    det = (x * z - y * y) / self._area2
    return half + np.sqrt(np.maximum(half * half - det, 0.0))

  def _metric(self, pos: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a.a, a.b and b.b of the edges a, b of triangles from their first corners."""
    # Coordinate by coordinate: a sixth of the time, in a loop that has no more than a millisecond.
    columns = np.ascontiguousarray(pos.T)
    first, second, third = (columns.take(k, axis=1, mode="clip") for k in self._corners)
    a, b = second - first, third - first
    return _dot(a, a), _dot(a, b), _dot(b, b)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  """Returns products of vectors in columns  (n,)."""
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def surface_strain(rest: np.ndarray, now: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns the largest principal strain of each triangle of a surface [-]  (ntri,).

  See `Stretch`.

  Args:
    rest: corners at rest [m]  (nvert, 3)
    now: the same now [m]  (nvert, 3)
    triangles: their corners' indices  (ntri, 3)
  """
  return Stretch(rest, triangles).each(np.asarray(now))


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
