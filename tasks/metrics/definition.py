"""What a metric is, and the table of them all."""

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable
from typing import ParamSpec

P = ParamSpec("P")

COMBINE = ("sum", "max", "mean", "all")
_SHOWN = {"m": ("mm", 1e3), "m/s": ("mm/s", 1e3), "rad": ("deg", 180 / math.pi)}
_SHOWN |= {"Pa": ("kPa", 1e-3)}


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
  """Raised within a metric, which then returns `Unknown`."""

  def __init__(self, reason: str, fault: bool = False):
    super().__init__(reason)
    self.fault = fault


@dataclasses.dataclass(frozen=True)
class Spec:
  """A metric.

  Attributes:
    label: name for people
    unit: SI unit of the value
    group: category of the composite score, a key of `score.WEIGHTS`
    combine: how several instruments make one value: `sum`, `max`, `mean`, or `all` (one value)
    source: where the definition comes from
    better: `lower`, `higher`, or `neither`: shown, but neither scored nor limited
    shown: unit for people
    scale: shown value / SI value
    function: what computes it
    needs: names of its arguments, see `inputs.Inputs`
    may: those of them that have a default
  """

  label: str
  unit: str
  group: str
  combine: str
  source: str
  better: str
  shown: str
  scale: float
  function: Callable[..., float]
  needs: tuple[str, ...]
  may: frozenset[str]


METRICS: dict[str, Spec] = {}  # in the order of their definition


def metric(
  label: str,
  unit: str,
  group: str,
  combine: str,
  source: str,
  better: str = "lower",
  name: str | None = None,
) -> Callable[[Callable[P, float]], Callable[P, float]]:
  """Registers the function below it as a metric, under its own name; all else follows from that.

  The names of its arguments say what it is computed of, see `inputs.Inputs`. It may raise
  `UnknownError`; whoever calls it gets `Unknown`. Its first line says the unit and the direction.

  Args:
    label: see `Spec`, as the other arguments
    unit: "
    group: "
    combine: "
    source: "
    better: "
    name: of the metric, where it is not the function's
  """
  if combine not in COMBINE:
    raise ValueError(f"metric {label!r}: combine is {combine!r}, expected {', '.join(COMBINE)}")

  def register(function: Callable[P, float]) -> Callable[P, float]:
    wrapped = known(function)
    shown, scale = _SHOWN.get(unit, (unit, 1.0))
    arguments = inspect.signature(function).parameters.values()
    METRICS[name or function.__name__] = Spec(
      label, unit, group, combine, source, better, shown, scale, wrapped,
      needs=tuple(a.name for a in arguments),
      may=frozenset(a.name for a in arguments if a.default is not a.empty),
    )  # fmt: skip
    return wrapped

  return register


def known(function: Callable[P, float]) -> Callable[P, float]:
  """Turns a function that raises `UnknownError` into one that returns `Unknown`."""

  @functools.wraps(function)
  def wrapped(*args: P.args, **kwargs: P.kwargs) -> float:
    try:
      value = function(*args, **kwargs)
      return value if isinstance(value, Unknown) else float(value)
    except UnknownError as error:
      return Unknown(str(error), error.fault)

  return wrapped


def number(value: float, spec: Spec | None = None) -> str:
  """Returns a value for people: in the unit they read, three digits."""
  value = value * (spec.scale if spec else 1.0)
  if math.isnan(value):
    return "–"
  if spec and spec.unit == "count" and value == round(value):
    text = f"{value:.0f}"
  else:
    text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
  return text.replace("-", "−")
