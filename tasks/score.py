"""The score of a recording's metrics against an expert reference.

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
import functools
import json
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

from .metrics import METRICS, Metrics, Unknown, check_header, check_names

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
  check_header(reference, "palpate-reference")
  table = reference.get("metrics")
  if not isinstance(table, Mapping):
    raise ValueError("palpate-reference: 'metrics' is missing or not an object")
  check_names(table)
  for name, row in table.items():
    row = row if isinstance(row, Mapping) else {}
    mean, sd = row.get("mean"), row.get("sd")
    if not _number(mean):
      raise ValueError(f"palpate-reference: {name}.mean is {mean!r}, expected a finite number")
    if sd is not None and not (_number(sd) and sd >= 0):
      raise ValueError(f"palpate-reference: {name}.sd is {sd!r}, expected a number >= 0 or null")


def reference_path(task: str) -> pathlib.Path:
  """Returns where the expert reference of a task such as "touch/easy" is kept."""
  return pathlib.Path(__file__).parent / "references" / f"{task.replace('/', '_')}.json"


@functools.cache
def reference(task: str) -> dict[str, Any] | None:
  """Returns the expert reference of a task, None where there is none."""
  path = reference_path(task)
  return read_reference(path) if path.is_file() else None


def read_reference(path: pathlib.Path) -> dict[str, Any]:
  """Returns the expert reference in a file; ValueError says what is wrong with it."""
  if path.exists() and not path.is_file():  # a pipe would be waited for
    raise ValueError(f"{path}: not a palpate-reference: not a file")
  data = json.loads(path.read_text(encoding="utf-8"))
  check_reference(data)
  return data


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
