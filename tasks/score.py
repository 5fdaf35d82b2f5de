"""All metrics of a recording as one object, and its score against an expert reference.

A reference is plain data, so that it ships as JSON:

    {"format": "palpate-reference", "version": 1, "task": "touch/easy", "seed": 0, "n": 50,
     "metrics": {"time": {"mean": 12.3, "sd": 1.4, "n": 50}, ...}}

Score of one metric: z = (mean - value) / sd where lower is better, (value - mean) / sd where higher
is better, so that a positive z beats the expert; clipped to [-10, 10] so that one metric cannot
outweigh a category. Where the expert never varies (sd = 0) there is no scale: z is 0 for a value as
good or better (within 1e-9, relative), -10 for a worse one.

Composite: the weighted mean over categories of the mean z of the category's known metrics. 0 is the
expert's average; every category at its proficiency limit gives -2. A category without a known
metric drops out and its weight is shared by the rest; where less than half of the weight is known,
so always without safety, the composite is unknown.

Weights: safety 67 %, efficiency 17 % (Heidelberg VR score, 10.1007/s00464-018-6480-x). Its other
16 % go to time, dexterity and outcome; the abstract does not say how, here they share it equally.

Proficiency: the expert's mean + 2 SD in the worse direction (SAGES), for every metric that the
reference has with an SD; a recording that lacks a metric of the reference is not proficient.
"""

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

from .metrics import Unknown

WEIGHTS = {
  "safety": 0.67,
  "efficiency": 0.17,
  "time": 0.16 / 3,
  "dexterity": 0.16 / 3,
  "outcome": 0.16 / 3,
}
Z_LIMIT = 10.0
PROFICIENT_SD = 2.0
LEAST_WEIGHT = 0.5


@dataclasses.dataclass(frozen=True)
class Spec:
  """What a metric is, as data.

  Attributes:
    label: name for people
    unit: SI unit of the value
    group: category of the composite score, a key of `WEIGHTS`
    combine: how several instruments make one value: `sum`, `max`, `mean`, or `all` (one value)
    source: where the definition comes from
    better: `lower` or `higher`
    shown: unit for people
    scale: shown value / SI value
  """

  label: str
  unit: str
  group: str
  combine: str
  source: str
  better: str
  shown: str
  scale: float


_SHOWN = {"m": ("mm", 1e3), "rad": ("deg", 180 / math.pi), "Pa": ("kPa", 1e-3)}
_EFFICIENCY, _SAFETY, _DEXTERITY = "efficiency", "safety", "dexterity"
_FORCE = "Horeman et al. 2010; Barrie et al. 2018"
_SMOOTH = "Balasubramanian et al. 2015"


def _row(
  label: str, unit: str, group: str, combine: str, source: str, better: str = "lower"
) -> Any:
  shown, scale = _SHOWN.get(unit, (unit, 1.0))
  spec = Spec(label, unit, group, combine, source, better, shown, scale)
  return dataclasses.field(default=Unknown("not recorded"), metadata={"spec": spec})


# fmt: off
@dataclasses.dataclass(frozen=True, eq=False)
class Metrics:
  """Every metric of one recording, SI; `Unknown` where it cannot be known.

  `METRICS` says what each field is; the function of the same name in `metrics` defines it.
  """

  time: float = _row("Time to completion", "s", "time", "all", "Oropesa et al. 2013")
  path_length: float = _row("Path length", "m", _EFFICIENCY, "sum", "Oropesa et al. 2013")
  path_inefficiency: float = _row(
    "Path inefficiency", "%", _EFFICIENCY, "all", "Perk Tutor; 10.1007/s00464-007-9526-z")
  sparc: float = _row("Smoothness (SPARC)", "-", _DEXTERITY, "mean", _SMOOTH, "higher")
  log_dimensionless_jerk: float = _row(
    "Log dimensionless jerk", "-", _DEXTERITY, "mean", _SMOOTH, "higher")
  angular_path: float = _row("Angular path", "rad", _EFFICIENCY, "sum", "PMC5845064")
  depth_path: float = _row("Depth path", "m", _EFFICIENCY, "sum", "Perk Tutor")
  response_orientation: float = _row("Response orientation", "rad", _EFFICIENCY, "sum", "CELTS")
  number_of_movements: float = _row(
    "Number of movements", "count", _EFFICIENCY, "sum", "ICSAD; Perk Tutor")
  idle_time: float = _row("Idle time", "s", _EFFICIENCY, "all", "PMC4412306")
  idle_share: float = _row("Idle share", "%", _EFFICIENCY, "all", "PMC4412306")
  peak_force: float = _row("Peak force", "N", _SAFETY, "max", _FORCE)
  mean_force: float = _row("Mean force in contact", "N", _SAFETY, "mean", _FORCE)
  rms_force: float = _row("RMS force in contact", "N", _SAFETY, "mean", _FORCE)
  force_time_product: float = _row(
    "Force-time product", "N s", _SAFETY, "sum", "Barrie et al. 2018")
  force_breaches: float = _row("Force limit breaches", "count", _SAFETY, "sum", "Rodrigues")
  excess_impulse: float = _row("Excess impulse", "N s", _SAFETY, "sum", "Horeman et al. 2010")
  peak_pressure: float = _row(
    "Peak contact pressure", "Pa", _SAFETY, "max", "10.1136/bmjsit-2021-000084")
  errors: float = _row("Errors", "count", _SAFETY, "all", "10.1186/s12893-020-00839-z")
  grasp_slips: float = _row("Grasp slips", "count", _SAFETY, "sum", "GOALS tissue handling")
  target_error: float = _row("Target error", "m", "outcome", "all", "Perk Tutor")
  trace_frechet: float = _row(
    "Tracing error (Frechet)", "m", "outcome", "all", "Perk Tutor; Eiter and Mannila 1994")
  trace_rms: float = _row("Tracing error (RMS)", "m", "outcome", "all", "Perk Tutor")
  bimanual_dexterity: float = _row(
    "Bimanual dexterity", "-", _DEXTERITY, "all", "Hofstad et al. 2013", "higher")
  out_of_view: float = _row("Out of view", "%", _SAFETY, "mean", "PMC5845064")
  # fmt: on

  def values(self) -> dict[str, float]:
    """Returns metric -> value [SI]."""
    return {name: getattr(self, name) for name in METRICS}

  def reasons(self) -> dict[str, str]:
    """Returns metric -> why it is unknown, for those that are."""
    return {
      name: value.reason if isinstance(value, Unknown) else f"the value is {value}"
      for name, value in self.values().items()
      if not math.isfinite(value)
    }

  def __eq__(self, other: object) -> bool:
    """Equal to the bit; unknown equals unknown for the same reason."""
    return self.to_json() == other.to_json() if isinstance(other, Metrics) else NotImplemented

  def __hash__(self) -> int:
    return hash(self.to_json())

  def to_json(self, indent: int | None = None) -> str:
    """Returns the values (null where unknown), the reasons, the units and the directions."""
    data = {
      "format": "palpate-metrics",
      "version": 1,
      "values": {k: float(v) if math.isfinite(v) else None for k, v in self.values().items()},
      "unknown": self.reasons(),
      "unit": {name: spec.unit for name, spec in METRICS.items()},
      "better": {name: spec.better for name, spec in METRICS.items()},
    }
    return json.dumps(data, indent=indent, allow_nan=False)

  @classmethod
  def from_json(cls, text: str) -> "Metrics":
    """Returns the metrics that `to_json` wrote; ValueError for anything else."""
    data = json.loads(text)
    _check_header(data, "palpate-metrics")
    values, unknown = data.get("values"), data.get("unknown", {})
    if not isinstance(values, dict) or not isinstance(unknown, dict):
      raise ValueError("palpate-metrics: 'values' and 'unknown' must be objects")
    _check_names(values)
    return cls(
      **{
        name: Unknown(str(unknown.get(name, "not recorded"))) if value is None else float(value)
        for name, value in values.items()
      }
    )


METRICS: dict[str, Spec] = {f.name: f.metadata["spec"] for f in dataclasses.fields(Metrics)}


def _check_header(data: Any, name: str) -> None:
  if not isinstance(data, Mapping) or data.get("format") != name:
    found = data.get("format") if isinstance(data, Mapping) else type(data).__name__
    raise ValueError(f"not {name}: format is {found!r}")
  if data.get("version") != 1:
    raise ValueError(f"{name}: version is {data.get('version')!r}, expected 1")


def _check_names(names: Mapping[str, Any]) -> None:
  if strange := sorted(set(names) - set(METRICS)):
    raise ValueError(f"no such metric {strange[0]!r}, expected one of {', '.join(METRICS)}")


def make_reference(results: Sequence[Metrics], task: str, seed: int) -> dict[str, Any]:
  """Returns the expert reference of several recordings of one task.

  The mean and sample SD (n - 1) of the recordings where the metric is known. A metric that is known
  nowhere is left out; the SD of a single value is null.
  """
  table = {}
  for name in METRICS:
    known = [float(v) for r in results if math.isfinite(v := getattr(r, name))]
    if not known:
      continue
    mean = math.fsum(known) / len(known)
    # The mean of equal values may round: without the test their SD would be 1e-17, not 0.
    constant = min(known) == max(known)
    mean = known[0] if constant else mean
    squares = 0.0 if constant else math.fsum((v - mean) ** 2 for v in known)
    sd = math.sqrt(squares / (len(known) - 1)) if len(known) > 1 else None
    table[name] = {"mean": mean, "sd": sd, "n": len(known)}
  return {
    "format": "palpate-reference",
    "version": 1,
    "task": task,
    "seed": seed,
    "n": len(results),
    "metrics": table,
  }


def check_reference(reference: Any) -> None:
  """Raises ValueError naming the entry unless this is a reference to score against."""
  _check_header(reference, "palpate-reference")
  table = reference.get("metrics")
  if not isinstance(table, Mapping):
    raise ValueError("palpate-reference: 'metrics' is missing or not an object")
  _check_names(table)
  for name, row in table.items():
    row = row if isinstance(row, Mapping) else {}
    mean, sd = row.get("mean"), row.get("sd")
    if not _number(mean):
      raise ValueError(f"palpate-reference: {name}.mean is {mean!r}, expected a finite number")
    if sd is not None and not (_number(sd) and sd >= 0):
      raise ValueError(f"palpate-reference: {name}.sd is {sd!r}, expected a number >= 0 or null")


def _number(value: Any) -> bool:
  return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclasses.dataclass(frozen=True)
class Score:
  """A recording against an expert reference.

  Attributes:
    composite: weighted z-score, 0 is the expert's average [-]; `Unknown` says why not
    proficient: True when every metric of the reference is known and none is over its limit
    z: metric -> z-score, positive beats the expert; `Unknown` where there is none [-]
    limit: metric -> proficiency limit, expert mean + 2 SD in the worse direction [SI]
    group: category -> mean z of its known metrics [-]
    weight: category -> weight as applied: 0 for a category without a known metric, sum 1 [-]
    missing: metrics that the reference has and the recording has not
  """

  composite: float
  proficient: bool
  z: dict[str, float]
  limit: dict[str, float]
  group: dict[str, float]
  weight: dict[str, float]
  missing: tuple[str, ...]


def z_score(value: float, mean: float, sd: float | None, better: str) -> float:
  """Returns by how many expert SDs a value beats the expert's mean [-], see the module's head."""
  if not math.isfinite(value):
    return Unknown(value.reason if isinstance(value, Unknown) else f"the value is {value}")
  if sd is None:
    return Unknown("the reference has no SD (a single recording)")
  ahead = value - mean if better == "higher" else mean - value
  if sd == 0:
    return 0.0 if ahead >= -1e-9 * max(abs(value), abs(mean)) else -Z_LIMIT
  return max(-Z_LIMIT, min(Z_LIMIT, ahead / sd))


def score(
  metrics: Metrics, reference: Mapping[str, Any], weights: Mapping[str, float] | None = None
) -> Score:
  """Returns the score of a recording's metrics; the formula is at the module's head.

  Args:
    metrics: of the recording
    reference: see `make_reference`
    weights: category -> weight >= 0, `WEIGHTS` by default; any scale
  """
  check_reference(reference)
  weights = WEIGHTS if weights is None else weights
  if set(weights) != set(WEIGHTS) or not all(_number(w) and w >= 0 for w in weights.values()):
    raise ValueError(f"weights are {dict(weights)}, expected numbers >= 0 for {', '.join(WEIGHTS)}")
  total = sum(weights.values())
  if total == 0:
    raise ValueError("weights are all 0")

  z: dict[str, float] = {}
  limit: dict[str, float] = {}
  missing, within = [], True
  for name, row in reference["metrics"].items():
    value, better = getattr(metrics, name), METRICS[name].better
    z[name] = z_score(value, row["mean"], row.get("sd"), better)
    worse = 1 if better == "lower" else -1
    if row.get("sd") is not None:
      limit[name] = row["mean"] + worse * PROFICIENT_SD * row["sd"]
      # By z, not by the limit: z knows about rounding where the SD is 0.
      within = within and z[name] >= -PROFICIENT_SD
    if not math.isfinite(value):
      missing.append(name)

  group: dict[str, float] = {}
  for name in WEIGHTS:
    known = [v for k, v in z.items() if METRICS[k].group == name and math.isfinite(v)]
    group[name] = math.fsum(known) / len(known) if known else Unknown("no known metric")
  share = sum(weights[name] for name, v in group.items() if math.isfinite(v)) / total
  applied = {
    name: weights[name] / total / share if math.isfinite(v) and share > 0 else 0.0
    for name, v in group.items()
  }
  if share < LEAST_WEIGHT:
    absent = ", ".join(n for n, v in group.items() if not math.isfinite(v) and weights[n] > 0)
    composite = Unknown(f"only {100 * share:.0f} % of the weight is known; no {absent}")
  else:
    composite = math.fsum(applied[n] * v for n, v in group.items() if applied[n] > 0)
  proficient = within and bool(limit) and not missing
  return Score(composite, proficient, z, limit, group, applied, tuple(missing))
