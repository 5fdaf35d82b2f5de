"""What the tissue bore."""

import math

import numpy as np
from numpy.typing import ArrayLike

from .definition import UnknownError, metric
from .samples import check_time, magnitude, rows, same, weights

_FORCE = "Horeman et al. 2010; Barrie et al. 2018"


@metric("Peak force", "N", "safety", "max", _FORCE)
def peak_force(force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the largest contact force [N], lower is better (Horeman et al. 2010).

  Args:
    force: contact force [N]  (nstep,) or (nstep, 3)
    contact_force: above which there is contact [N]
  """
  return _touch(force, contact_force)[0].max()


@metric("Mean force in contact", "N", "safety", "mean", _FORCE)
def mean_force(time: ArrayLike, force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the mean force over the time in contact [N], lower is better (Horeman et al. 2010)."""
  time = check_time(time, least=1)
  force, touch = _touch(force, contact_force)
  weight = weights(time)[same("force", touch, time)]
  return (weight * force[touch]).sum() / weight.sum()


@metric("RMS force in contact", "N", "safety", "mean", _FORCE)
def rms_force(time: ArrayLike, force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the root mean square force over the time in contact [N], lower is better.

  Horeman et al. 2010; Barrie et al. 2018. Over contact, like the mean: time in the air would
  otherwise lower it.
  """
  time = check_time(time, least=1)
  force, touch = _touch(force, contact_force)
  weight = weights(time)[same("force", touch, time)]
  return math.sqrt((weight * force[touch] ** 2).sum() / weight.sum())


@metric("Force-time product", "N s", "safety", "sum", "Barrie et al. 2018")
def force_time_product(time: ArrayLike, force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the integral of force over time [N s], lower is better (Barrie et al. 2018)."""
  time = check_time(time)
  force, touch = _touch(force, contact_force)
  return float(np.trapezoid(same("force", np.where(touch, force, 0.0), time), time))


@metric("Force limit breaches", "count", "safety", "sum", "Rodrigues")
def force_breaches(force: ArrayLike, force_limit: float, contact_force: float = 0.0) -> float:
  """Returns the number of excursions above the limit [count], lower is better (Rodrigues).

  Args:
    force: contact force [N]  (nstep,) or (nstep, 3)
    force_limit: F_max [N]
    contact_force: above which there is contact [N]
  """
  over = _touch(force, contact_force)[0] > _limit(force_limit)
  return int(over[0]) + int(np.count_nonzero(~over[:-1] & over[1:]))


@metric("Excess impulse", "N s", "safety", "sum", "Horeman et al. 2010")
def excess_impulse(
  time: ArrayLike, force: ArrayLike, force_limit: float, contact_force: float = 0.0
) -> float:
  """Returns the integral of max(force - force_limit, 0) [N s], lower is better.

  Horeman et al. 2010. Exact for a force that is linear between samples.
  """
  time = check_time(time)
  over = same("force", _touch(force, contact_force)[0], time) - _limit(force_limit)
  a, b = over[:-1], over[1:]
  above = np.maximum(a, 0) + np.maximum(b, 0)
  whole = np.abs(a) + np.abs(b)
  # A crossing leaves the share above/whole of the interval over the limit.
  share = np.divide(above, whole, out=np.zeros_like(whole), where=whole > 0)
  return (np.diff(time) * above * share).sum() / 2


@metric("Peak contact pressure", "Pa", "safety", "max", "10.1136/bmjsit-2021-000084")
def peak_pressure(force: ArrayLike, area: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the largest force over contact area [Pa], lower is better.

  Bowel is damaged at 329-330 kPa (10.1136/bmjsit-2021-000084).

  Args:
    force: contact force [N]  (nstep,) or (nstep, 3)
    area: area of the organ's touched triangles [m^2]  (nstep,)
    contact_force: above which there is contact [N]
  """
  force, touch = _touch(force, contact_force)
  area = same("area", rows("area", area), force)
  if (area[touch] <= 0).any():
    k = int((touch & (area <= 0)).argmax())
    raise UnknownError(f"force without contact area at sample {k}", fault=True)
  return (force[touch] / area[touch]).max()


def _touch(force: ArrayLike, contact_force: float) -> tuple[np.ndarray, np.ndarray]:
  force = magnitude(force)
  touch = force > contact_force
  if not touch.any():
    raise UnknownError("no contact")
  return force, touch


def _limit(limit: float) -> float:
  if not limit >= 0:
    raise UnknownError("no force limit")
  return limit
