"""What the tissue bore.

Forces come at their own rate, that of the physics or of a sensor, which is above the samples': a
maximum of each sample's span in place of the signal would make impulses several times too large.
A grasper has two of them: `force` is what the whole tip exerts, its press or pull; `grip_force` is
what the jaws squeeze with.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from .definition import UnknownError, metric
from .samples import check_time, low_pass, magnitude, rows, same, weights

_FORCE = "Horeman et al. 2010; Barrie et al. 2018"
_GRIP = "Heijnsdijk et al. 2004 (10.1007/s00464-003-9244-0)"
_SHAFT = "10.1186/s12893-020-00839-z"
SETTLE = 0.1  # an excursion ends once the force was under the limit for this long [s]


@metric("Peak force", "N", "safety", "max", _FORCE)
def peak_force(force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the largest contact force [N], lower is better (Horeman et al. 2010).

  Args:
    force: contact force [N]  (nstep,) or (nstep, 3)
    contact_force: above which there is contact [N]
  """
  return _touch(force, contact_force)[0].max()


@metric("Mean force in contact", "N", "safety", "mean", _FORCE)
def mean_force(force_time: ArrayLike, force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the mean force over the time in contact [N], lower is better (Horeman et al. 2010)."""
  time = check_time(force_time, least=1)
  force, touch = _touch(force, contact_force)
  weight = weights(time)[same("force", touch, time)]
  return (weight * force[touch]).sum() / weight.sum()


@metric("RMS force in contact", "N", "safety", "mean", _FORCE)
def rms_force(force_time: ArrayLike, force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the root mean square force over the time in contact [N], lower is better.

  Horeman et al. 2010; Barrie et al. 2018. Over contact, like the mean: time in the air would
  otherwise lower it.
  """
  time = check_time(force_time, least=1)
  force, touch = _touch(force, contact_force)
  weight = weights(time)[same("force", touch, time)]
  return math.sqrt((weight * force[touch] ** 2).sum() / weight.sum())


@metric("Force-time product", "N s", "safety", "sum", "Barrie et al. 2018")
def force_time_product(
  force_time: ArrayLike, force: ArrayLike, contact_force: float = 0.0
) -> float:
  """Returns the integral of force over time [N s], lower is better (Barrie et al. 2018)."""
  time = check_time(force_time)
  force, touch = _touch(force, contact_force)
  return float(np.trapezoid(same("force", np.where(touch, force, 0.0), time), time))


@metric("Force limit breaches", "count", "safety", "sum", "Rodrigues")
def force_breaches(
  force_time: ArrayLike, force: ArrayLike, force_limit: float, contact_force: float = 0.0
) -> float:
  """Returns the number of excursions above the limit [count], lower is better (Rodrigues).

  An excursion ends once the force was under the limit for 0.1 s: contact that chatters is one.

  Args:
    force_time: times of the force's samples [s]  (nstep,)
    force: contact force [N]  (nstep,) or (nstep, 3)
    force_limit: F_max [N]
    contact_force: above which there is contact [N]
  """
  return _excursions(force_time, _touch(force, contact_force)[0], force_limit)


@metric("Excess impulse", "N s", "safety", "sum", "Horeman et al. 2010")
def excess_impulse(
  force_time: ArrayLike, force: ArrayLike, force_limit: float, contact_force: float = 0.0
) -> float:
  """Returns the integral of max(force - force_limit, 0) [N s], lower is better.

  Horeman et al. 2010. Exact for a force that is linear between samples.
  """
  time = check_time(force_time)
  over = same("force", _touch(force, contact_force)[0], time) - _limit(force_limit)
  a, b = over[:-1], over[1:]
  above = np.maximum(a, 0) + np.maximum(b, 0)
  whole = np.abs(a) + np.abs(b)
  # A crossing leaves the share above/whole of the interval over the limit.
  share = np.divide(above, whole, out=np.zeros_like(whole), where=whole > 0)
  return (np.diff(time) * above * share).sum() / 2


@metric("Peak contact pressure", "Pa", "safety", "max", "10.1136/bmjsit-2021-000084")
def peak_pressure(sampled_force: ArrayLike, area: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the largest force over contact area [Pa], lower is better.

  Bowel is damaged at 329-330 kPa (10.1136/bmjsit-2021-000084).

  Args:
    sampled_force: contact force at the samples [N]  (nstep,) or (nstep, 3)
    area: area of the organ's touched triangles [m^2]  (nstep,)
    contact_force: above which there is contact [N]
  """
  force, touch = _touch(sampled_force, contact_force)
  area = same("area", rows("area", area), force)
  if (area[touch] <= 0).any():
    k = int((touch & (area <= 0)).argmax())
    raise UnknownError(f"force without contact area at sample {k}", fault=True)
  return (force[touch] / area[touch]).max()


@metric("Peak force rate", "N/s", "safety", "max", "Trejos et al. 2014 (10.1007/s00464-014-3442-9)")
def force_rate(
  force_time: ArrayLike, force: ArrayLike, force_cutoff: float, contact_force: float = 0.0
) -> float:
  """Returns how fast the force changes at most [N/s], lower is better.

  The derivative of Trejos et al. 2014 (10.1007/s00464-014-3442-9), of the force without what is
  faster than the cut-off: a contact that starts within a millisecond has no rate of its own.

  Args:
    force_time: times of the force's samples [s]  (nstep,)
    force: contact force [N]  (nstep,) or (nstep, 3)
    force_cutoff: of `samples.low_pass` [Hz]
    contact_force: above which there is contact [N]
  """
  time = check_time(force_time)
  force = same("force", _touch(force, contact_force)[0], time)
  return np.abs(np.diff(low_pass(time, force, force_cutoff)) / np.diff(time)).max()


@metric("Peak grip", "N", "safety", "max", _GRIP)
def peak_grip(grip_force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the largest force of the jaws [N], lower is better (Heijnsdijk et al. 2004).

  Args:
    grip_force: of the jaw that presses more [N]  (nstep,)
    contact_force: above which there is contact [N]
  """
  return _touch(grip_force, contact_force)[0].max()


@metric("Mean grip", "N", "safety", "mean", _GRIP)
def mean_grip(force_time: ArrayLike, grip_force: ArrayLike, contact_force: float = 0.0) -> float:
  """Returns the mean force of the jaws while they press [N], lower is better.

  Heijnsdijk et al. 2004.
  """
  return mean_force(force_time, grip_force, contact_force)


@metric("Grip limit breaches", "count", "safety", "sum", "Rodrigues")
def grip_breaches(
  force_time: ArrayLike, grip_force: ArrayLike, grip_limit: float, contact_force: float = 0.0
) -> float:
  """Returns the jaws' excursions above their limit [count], lower is better; `force_breaches`."""
  return _excursions(force_time, _touch(grip_force, contact_force)[0], grip_limit)


@metric("Grip against pull", "-", "safety", "mean", _GRIP)
def grip_ratio(
  force_time: ArrayLike, force: ArrayLike, grip_force: ArrayLike, contact_force: float = 0.0
) -> float:
  """Returns the jaws' force over the pull they bear [-], lower is better.

  Impulse over impulse while both act. Heijnsdijk et al. 2004 (10.1007/s00464-003-9244-0): at a pull
  of 5 N people gripped bowel with 6.8 N where 3.0 N kept it from slipping, 1.36 where 0.6 will do.

  Args:
    force_time: times of the forces' samples [s]  (nstep,)
    force: of the whole tip, the pull [N]  (nstep,) or (nstep, 3)
    grip_force: of the jaw that presses more [N]  (nstep,)
    contact_force: above which a force acts [N]
  """
  time = check_time(force_time)
  pull, grip = same("force", magnitude(force), time), magnitude(grip_force)
  both = (pull > contact_force) & (same("grip_force", grip, time) > contact_force)
  if not both.any():
    raise UnknownError("nothing was gripped and pulled")
  weight = weights(time)[both]
  return (weight * grip[both]).sum() / (weight * pull[both]).sum()


@metric("Shaft contact", "s", "safety", "sum", _SHAFT)
def shaft_contact(
  force_time: ArrayLike, shaft_force: ArrayLike, contact_force: float = 0.0
) -> float:
  """Returns how long the shaft pressed on tissue [s], lower is better.

  Contact that was not meant is an error (10.1186/s12893-020-00839-z). 0 where there was none.

  Args:
    force_time: times of the force's samples [s]  (nstep,)
    shaft_force: contact force on the shaft [N]  (nstep,) or (nstep, 3)
    contact_force: above which there is contact [N]
  """
  time = check_time(force_time)
  return weights(time)[same("shaft_force", magnitude(shaft_force), time) > contact_force].sum()


@metric("Peak force of the shaft", "N", "safety", "max", _SHAFT)
def peak_shaft_force(shaft_force: ArrayLike) -> float:
  """Returns the largest contact force of the shaft [N], lower is better; 0 where there was none.

  10.1186/s12893-020-00839-z counts contact that was not meant; this is how hard it was.
  """
  return magnitude(shaft_force).max()


@metric("Peak force on surroundings", "N", "safety", "max", _SHAFT)
def peak_surroundings_force(surroundings_force: ArrayLike) -> float:
  """Returns the largest force on what is around [N], lower is better; 0 where there was none.

  As `peak_shaft_force`, of organs that are no part of the work, fat and the wall.
  """
  return magnitude(surroundings_force).max()


@metric("Peak traction", "N", "safety", "max", "as peak force: Horeman et al. 2010")
def peak_traction(traction: ArrayLike) -> float:
  """Returns the largest pull on what holds an organ [N], lower is better.

  Args:
    traction: magnitude of the sum of its bonds, or of the force along a sheet that its rim holds
      [N]  (nstep,)
  """
  return float(rows("traction", traction).max())


@metric("Peak tissue strain", "-", "safety", "max", "Rosen et al. 2008 (10.1115/1.2898712)")
def peak_strain(strain: ArrayLike) -> float:
  """Returns how far the tissue was stretched at most [-], lower is better.

  Damage of abdominal organs grows with strain and stress (Rosen et al. 2008). It is the strain of
  the organ's surface against the exercise's start, see `samples.surface_strain`; a finer mesh shows
  more of it, so compare recordings of one task only.

  Args:
    strain: largest of the surface [-]  (nstep,)
  """
  return rows("strain", strain).max()


def _excursions(time: ArrayLike, force: np.ndarray, limit: float) -> int:
  """Returns how often a force rose above the limit, at least `SETTLE` after it last was."""
  time = check_time(time, least=1)
  over = same("force", force, time) > _limit(limit)
  at = over.nonzero()[0]
  gap = (np.diff(at) > 1) & (np.diff(time[at]) > SETTLE)
  return int(len(at) > 0) + int(np.count_nonzero(gap))


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
