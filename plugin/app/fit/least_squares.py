"""Least squares for constants of tissue, with confidence intervals."""

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping

import numpy as np
from palpate.tissue import config
from scipy import optimize, stats

from ..console import CommandError

# Steps of differences in the scaled constants, of the search and of the intervals: a simulated
# force repeats to some 0.5 % of the greatest one, and a short step measures that.
_STEP, _WIDE = 0.1, 0.5
_CLOSE = 1e-3  # relative change of a constant that is none
_MOST = 60  # steps of the search
# Errors of a simulation: a share of every force, from the mesh (tests/benchmarks/results/truth.md),
# and one of any shape, whose root mean square is a share of the greatest force.
_MESH, _ROUGH = 0.04, 0.01
_UNKNOWN = 1.0  # half the width of a scaled interval, a factor of e, that says too little
_ZERO = 1e-9  # singular value of the Jacobian
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
    values: constants that the measurement determines, by name
    low, high: ends of their confidence intervals, nan where the search was stopped
    kept: constants that it does not determine, at their starts, for which the others hold
    force: of the simulation with them [N]                    (n,)
    residual: root mean square of simulation minus measurement [N]
    simulations: how many it took
    whole: whether the search ended by itself
  """

  values: dict[str, float]
  low: dict[str, float]
  high: dict[str, float]
  kept: dict[str, float]
  force: np.ndarray
  residual: float
  simulations: int
  whole: bool


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
  mesh: float = _MESH,
  rough: float = _ROUGH,
) -> Fit:
  """Returns the constants with which the simulated force is nearest to the measured one.

  A constant that the measurement does not determine is kept at its start, and the search begins
  anew without it. Of several it is the one that changes the force least.

  Args:
    free: what is sought
    simulate: returns the force for constants [N], (n,); may raise `Stopped`
    measured: force [N]  (n,)
    level: of the confidence intervals
    tell: called after each simulation with constants, residual [N] and the number so far
    mesh: error of the simulation, as a share of every force
    rough: its error of any shape, root mean square, as a share of the greatest force

  Raises:
    CommandError: the measurement determines none of the constants, or has too few rows.
  """
  if len(measured) <= len(free):
    raise CommandError(f"{len(measured)} rows for {len(free)} constants, expected more rows")
  free, kept, count = list(free), {}, 0
  while free:
    found, jacobian = _search(free, kept, simulate, measured, tell, count)
    count = found.simulations
    if not found.whole:
      return found
    spread = _spread(jacobian, found, level, mesh, rough)
    poor = np.flatnonzero(spread > _UNKNOWN)
    if not poor.size:
      for c, half in zip(free, spread, strict=True):
        at = c.scaled(found.values[c.name])
        found.low[c.name], found.high[c.name] = c.value(at - half), c.value(at + half)
      return found
    weakest = free.pop(int(poor[np.linalg.norm(jacobian[:, poor], axis=0).argmin()]))
    kept[weakest.name] = weakest.start
  raise CommandError(f"the data determine none of {', '.join(kept)}", code=1)


def _search(free, kept, simulate, measured: np.ndarray, tell, count: int) -> tuple[Fit, np.ndarray]:
  """Returns what least squares find, without intervals, and the Jacobian of the force there."""
  seen: list[tuple[float, dict[str, float], np.ndarray]] = []

  @functools.cache
  def at(x: bytes) -> np.ndarray:
    values = {c.name: c.value(s) for c, s in zip(free, np.frombuffer(x), strict=True)}
    force = simulate(kept | values)
    seen.append((float(np.sqrt(np.mean((force - measured) ** 2))), values, force))
    best = min(seen, key=lambda one: one[0])
    tell(best[1], best[0], count + len(seen))
    return force

  def slopes(x: np.ndarray, back: float, ahead: float) -> np.ndarray:
    ends = ((at((x - back * e).tobytes()), at((x + ahead * e).tobytes())) for e in np.eye(len(x)))
    return np.stack([(b - a) / (back + ahead) for a, b in ends], axis=1)

  size = float(np.abs(measured).max())
  jacobian, whole = np.empty((0, 0)), True
  try:
    optimize.least_squares(
      lambda x: (at(x.tobytes()) - measured) / size,
      np.array([c.scaled(c.start) for c in free]),
      jac=lambda x: slopes(x, 0.0, _STEP) / size,  # pyright: ignore[reportArgumentType] - of stubs
      xtol=_CLOSE,
      ftol=_CLOSE**2,
      gtol=1e-12,
      max_nfev=_MOST,
    )
    best = min(seen, key=lambda one: one[0])[1]
    jacobian = slopes(np.array([c.scaled(best[c.name]) for c in free]), _WIDE, _WIDE)
  except Stopped:
    whole = False
  if not seen:
    raise CommandError("it was stopped before the first simulation had ended", code=130)
  error, values, force = min(seen, key=lambda one: one[0])
  low, high = (dict.fromkeys(values, math.nan) for _ in range(2))
  return Fit(values, low, high, kept, force, error, count + len(seen), whole), jacobian


def _spread(
  jacobian: np.ndarray, found: Fit, level: float, mesh: float, rough: float
) -> np.ndarray:
  """Returns half the width of each confidence interval, scaled.

  Noise: of a linear model with independent errors of equal variance, t s sqrt((J^T J)^-1_kk) (Seber
  and Wild 1989, Nonlinear Regression, eq. 5.7). The simulation's own errors do not average out over
  the rows: the most that they can move the constants is added.
  """
  rows, count = jacobian.shape
  norm = np.maximum(np.linalg.norm(jacobian, axis=0), _ZERO)
  u, s, v = np.linalg.svd(jacobian / norm, full_matrices=False)
  inverse = (v.T / np.maximum(s, _ZERO)) @ u.T / norm[:, None]
  reach = np.linalg.norm(inverse, axis=1) * math.sqrt(rows)  # of an error of any shape
  noise = stats.t.ppf(0.5 + level / 2, rows - count) * found.residual / math.sqrt(rows - count)
  rough *= np.abs(found.force).max()
  return (noise + rough) * reach + mesh * np.abs(inverse @ found.force)
