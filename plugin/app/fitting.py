"""Least squares for constants of tissue, with confidence intervals."""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping

import numpy as np
from palpate.tissue import config
from scipy import optimize, stats

from .console import CommandError

_STEP = 0.02  # of the Jacobian, in the scaled constants: forces are in single precision
_CLOSE = 1e-3  # relative change of a constant that is none
_MOST = 60  # steps of the search
_ALIKE = 0.98  # correlation from which two constants are not told apart
_SOLVER = ("tolerance",)  # of the solve, not of the tissue


class Stopped(Exception):
  """The search was stopped: what is best so far counts."""


@dataclasses.dataclass(frozen=True)
class Constant:
  """A constant of the tissue that is sought, and how it is scaled for the search.

  Attributes:
    name: key of the configuration
    unit: its unit
    start: where the search begins
    high: what it stays under, infinite for none; it is > 0
  """

  name: str
  unit: str
  start: float
  high: float

  def scaled(self, value: float) -> float:
    """Returns a logarithm, or the logit where there is an upper limit."""
    return math.log(value if math.isinf(self.high) else value / (self.high - value))

  def value(self, scaled: float) -> float:
    """Returns the constant of a scaled one."""
    e = math.exp(min(max(scaled, -60.0), 60.0))
    return e if math.isinf(self.high) else self.high * e / (1 + e)


@dataclasses.dataclass
class Fit:
  """What was found.

  Attributes:
    values: constants, by name
    low, high: ends of their confidence intervals, nan where unknown
    force: of the simulation with them [N]                    (n,)
    residual: root mean square of simulation minus measurement [N]
    simulations: how many it took
    whole: whether the search ended by itself
    alike: pairs of constants that the measurement does not tell apart
  """

  values: dict[str, float]
  low: dict[str, float]
  high: dict[str, float]
  force: np.ndarray
  residual: float
  simulations: int
  whole: bool
  alike: list[tuple[str, str]]


def allowed() -> dict[str, config.Row]:
  """Returns the keys that may be sought: numbers of the tissue that may change while running."""
  return {
    key: row
    for key, row in config.ROWS.items()
    if row.change in (config.NUMBER, config.TISSUE)
    and key not in _SOLVER
    and isinstance(getattr(config.Config, key), float | tuple)
  }


def constant(name: str, start: float | None = None) -> Constant:
  """Returns a constant to seek.

  Args:
    name: key of the configuration
    start: where the search begins; None for the key's default, that of `young` for a
      modulus without one, or a third of its range
  """
  known = allowed()
  if name not in known:
    raise CommandError(f"free is {name!r}, expected some of {', '.join(known)}")
  span = re.search(r"\[([\d.e+-]+), ([\d.e+-]+)\)", known[name].allowed)
  high = float(span[2]) if span else math.inf
  if start is None:
    default = getattr(config.Config, name)
    start = float(np.ravel(config.Config.young if default == () else default)[0])
    if not start > 0:
      start = 0.3 * high if math.isfinite(high) else 1.0
  if not 0 < start < high:
    raise CommandError(f"{name} starts at {start:g}, expected a number in (0, {high:g})")
  return Constant(name, known[name].unit, start, high)


def fit(
  free: list[Constant],
  simulate: Callable[[Mapping[str, float]], np.ndarray],
  measured: np.ndarray,
  level: float = 0.95,
  tell: Callable[[Mapping[str, float], float, int], None] = lambda *_: None,
) -> Fit:
  """Returns the constants with which the simulated force is nearest to the measured one.

  Args:
    free: what is sought
    simulate: returns the force for constants [N], (n,); may raise `Stopped`
    measured: force [N]  (n,)
    level: of the confidence intervals
    tell: called after each simulation with constants, residual [N] and the number so far
  """
  size = float(np.abs(measured).max())
  seen: list[tuple[float, dict[str, float], np.ndarray]] = []
  jacobian: list[np.ndarray] = []

  @functools.cache
  def at(x: bytes) -> np.ndarray:
    return residual(np.frombuffer(x))

  def residual(x: np.ndarray) -> np.ndarray:
    values = {c.name: c.value(s) for c, s in zip(free, x, strict=True)}
    force = simulate(values)
    error = float(np.sqrt(np.mean((force - measured) ** 2)))
    seen.append((error, values, force))
    best = min(seen, key=lambda one: one[0])
    tell(best[1], best[0], len(seen))
    return (force - measured) / size

  def slopes(x: np.ndarray) -> np.ndarray:
    columns = [(at((x + _STEP * e).tobytes()) - at(x.tobytes())) / _STEP for e in np.eye(len(x))]
    jacobian[:] = [np.stack(columns, axis=1)]
    return jacobian[0]

  start = np.array([c.scaled(c.start) for c in free])
  whole = True
  try:
    optimize.least_squares(
      lambda x: at(x.tobytes()),
      start,
      jac=slopes,  # pyright: ignore[reportArgumentType] - of stubs that are too narrow
      xtol=_CLOSE,
      ftol=_CLOSE**2,
      gtol=1e-12,
      max_nfev=_MOST,
    )
  except Stopped:
    whole = False
  if not seen:
    raise CommandError("it was stopped before the first simulation had ended", code=130)
  error, values, force = min(seen, key=lambda one: one[0])
  spread, alike = _spread(free, jacobian, error / size, level)
  low, high = (_moved(free, values, sign * spread) for sign in (-1, 1))
  return Fit(values, low, high, force, error, len(seen), whole, alike)


def _moved(free: list[Constant], values: dict[str, float], by: np.ndarray) -> dict[str, float]:
  """Returns the constants moved by scaled amounts, nan where those are."""
  moves = zip(free, by, strict=True)
  return {c.name: c.value(c.scaled(values[c.name]) + s) if s == s else s for c, s in moves}


def _spread(free: list[Constant], jacobian: list[np.ndarray], error: float, level: float):
  """Returns half the width of each confidence interval, scaled, and constants that are alike.

  Of a linear model with independent errors of equal variance: t s sqrt((J^T J)^-1_kk) (Seber and
  Wild 1989, Nonlinear Regression, eq. 5.7).
  """
  count = len(free)
  unknown = np.full(count, math.nan)
  if not jacobian:
    return unknown, []
  j = jacobian[0]
  rows = len(j)
  if rows <= count:
    return unknown, []
  norm = np.linalg.norm(j, axis=0)
  if not (norm > 0).all():
    return unknown, []
  inverse = np.linalg.pinv((j / norm).T @ (j / norm), rcond=1e-12)
  variance = error**2 * rows / (rows - count)
  deviation = np.sqrt(np.maximum(np.diag(inverse), 0)) / norm * math.sqrt(variance)
  scale = np.sqrt(np.maximum(np.outer(np.diag(inverse), np.diag(inverse)), 1e-300))
  close = np.argwhere(np.triu(np.abs(inverse / scale) > _ALIKE, 1))
  alike = [(free[a].name, free[b].name) for a, b in close]
  return stats.t.ppf(0.5 + level / 2, rows - count) * deviation, alike
