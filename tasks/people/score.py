"""The score of a recording against skilled performers, the outcome first.

An exercise that did not succeed scores `FLOOR`, whatever its metrics: a short path is no merit of a
hand that stopped. It is below every score of a success, and it is never proficient. Its time and
its efficiency are neither compared nor limited (`tells`).

A reference is plain data, so that it ships as JSON:

    {"format": "palpate-reference", "version": 2, "task": "touch/easy", "performer": "skilled",
     "seed": 0, "episodes": 100, "n": 99,
     "metrics": {"time": {"mean": 12.3, "sd": 1.4, "n": 99, "limit": 15.2}, ...}}

It comes from `n` successes of a panel of skilled people of many styles (`performer.skilled`), not
from one hand that repeats itself.

Score of one metric: z = (mean - value) / sd where lower is better, (value - mean) / sd where higher
is better, so that a positive z beats the panel's mean; clipped to [-10, 10] so that one metric
cannot outweigh a category. Where the panel never varies (sd = 0) there is no scale: z is 0 for a
value as good or better (within 1e-9, relative), -10 for a worse one.

Composite: the weighted mean over categories of the mean z of the category's known metrics, 0 for
the panel's average, -10 to 10. Safety counts with its worst metric where one is over its limit: no
haste makes up for a harm. A category without a known metric drops out and its weight is shared
by the rest; where less than half of the weight is known, so always without safety, the composite is
unknown.

Weights: safety 67 %, efficiency 17 % (Heidelberg VR score, 10.1007/s00464-018-6480-x). Its other
16 % go to time, dexterity and outcome; the abstract does not say how, here they share it equally.

Proficiency of an episode: success, and no metric over its limit by more than `MARGIN` of it, which
is what a mesh or a rounding may do. A limit is of its own metric: the
median of the panel and `SPREADS` times a spread that one freak does not move, from the median to
the value that 90 % are as good as, or the worst value of the best `PASSING` of the panel's
episodes, whichever lets more pass. Where a panel hardly varies it is `LEAST` of the median beyond
it, or what nobody feels (`SMALL`). It is at most `BELOW` of what ends an episode, such as its time
limit, or of 100 %. It is of log(1 + value / median) where no value is negative: forces, times and
paths vary by factors, and their long tails are no normal one's. The
mean + 2 SD of SAGES would fail half of the panel, since each of thirty metrics may fail by itself,
and so would the panel's worst values the next person. A metric that some of the panel's successes
lack is not asked for.

Proficiency of a performer: `CONSECUTIVE` proficient episodes in a row, then `REPEATS` more that
need not be in a row: the 2 + 10 of the curriculum for the Fundamentals of Laparoscopic Surgery
(Ritter and Scott 2007, 10.1177/1553350607302329), see `trained`.
"""

import dataclasses
import functools
import json
import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..metrics import METRICS, SUCCESS, Metrics, Spec, Unknown, check_header, check_names

WEIGHTS = {
  "safety": 0.67,
  "efficiency": 0.17,
  "time": 0.16 / 3,
  "dexterity": 0.16 / 3,
  "outcome": 0.16 / 3,
}
Z_LIMIT = 10.0
FLOOR = -20.0  # of an exercise that did not succeed; a success scores -10 or more
PASSING = 0.95
SPREADS, LEAST, BELOW = 2.5, 0.1, 0.9
SMALL = {"s": 0.5, "N": 0.1, "N s": 0.05, "%": 15.0}
MARGIN = 0.05
_NINTH = 1.2816  # normal deviate that 90 % are under
CONSECUTIVE, REPEATS = 2, 10
LEAST_WEIGHT = 0.5
_VERSION = 2


def make_reference(
  results: Sequence[Metrics], task: str, seed: int, caps: Mapping[str, float] | None = None
) -> dict[str, Any]:
  """Returns the reference of several successful recordings of one task.

  The mean and sample SD (n - 1) of the recordings where the metric is known, and the limit of
  proficiency, see the module's head. A metric that is known nowhere, or of which neither more nor
  less is better, is left out, and so are movements where some make none; the SD of a single value
  is null.

  Args:
    results: the recordings' metrics
    task: such as "touch/easy"
    seed: of the first recording
    caps: metric -> value at which an episode fails, such as the time limit [SI]
  """
  table: dict[str, dict[str, Any]] = {}
  for name, spec in METRICS.items():
    if spec.better == "neither":
      continue
    known = [float(v) for r in results if math.isfinite(v := getattr(r, name))]
    if not known or (name == "number_of_movements" and min(known) == 0):
      continue  # a hand too slow for any movement to count would make a faster one the worse
    mean = math.fsum(known) / len(known)
    # The mean of equal values may round: without the test their SD would be 1e-17, not 0.
    constant = min(known) == max(known)
    mean = known[0] if constant else mean
    squares = 0.0 if constant else math.fsum((v - mean) ** 2 for v in known)
    sd = math.sqrt(squares / (len(known) - 1)) if len(known) > 1 else None
    table[name] = {"mean": mean, "sd": sd, "n": len(known)}
  for name, limit in _limits(results, list(table), caps or {}).items():
    table[name]["limit"] = limit
  return {
    "format": "palpate-reference",
    "version": _VERSION,
    "task": task,
    "seed": seed,
    "n": len(results),
    "metrics": table,
  }


def _limits(
  results: Sequence[Metrics], names: Sequence[str], caps: Mapping[str, float]
) -> dict[str, float]:
  """Returns metric -> limit of proficiency [SI], see the module's head."""
  signs = np.array([1.0 if METRICS[name].better == "lower" else -1.0 for name in names])
  values = np.array([[float(getattr(r, name)) for name in names] for r in results])
  asked = np.isfinite(values).all(axis=0)
  worst = np.max(values * signs, axis=0, where=np.isfinite(values), initial=-np.inf)
  panel = values[:, asked] * signs[asked]
  middle = np.median(panel, axis=0)
  unit = np.where((panel >= 0).all(axis=0) & (middle > 0), middle, np.inf)  # inf: as it is
  panel = np.where(np.isfinite(unit), np.log1p(np.maximum(panel, 0.0) / unit), panel)
  far = _ahead_of_others(panel)
  kept = panel[np.argsort(far, kind="stable")[: math.ceil(PASSING * len(panel))]]
  middle = np.median(panel, axis=0)
  spread = (np.quantile(panel, 0.9, axis=0) - middle) / _NINTH
  limit = np.maximum(middle + SPREADS * spread, kept.max(axis=0))
  factors = np.isfinite(unit)
  limit[factors] = unit[factors] * np.maximum(np.expm1(limit[factors]), 1.0 + LEAST)
  small = np.array([SMALL.get(METRICS[name].unit, -np.inf) for name in names])
  limit = np.where(signs[asked] > 0, np.maximum(limit, small[asked]), limit)
  worst[asked] = limit
  most = np.array([_most(name, caps) for name in names])
  limits = np.where(signs > 0, np.minimum(worst, most), worst) * signs
  return dict(zip(names, limits.tolist(), strict=True))


def _most(name: str, caps: Mapping[str, float]) -> float:
  """Returns above what the limit of a metric would bind nobody."""
  share = 100.0 if METRICS[name].unit == "%" and name != "path_inefficiency" else math.inf
  return BELOW * min(caps.get(name, math.inf), share)


def _ahead_of_others(panel: np.ndarray) -> np.ndarray:
  """Returns by how many SDs each episode's worst metric is over the mean of all others  (n,).

  Args:
    panel: metrics of each episode, or logarithms of them, more is worse  (n, nmetric)
  """
  far = np.zeros(len(panel))
  for k in range(len(panel) if len(panel) > 2 else 0):
    others = np.delete(panel, k, axis=0)
    spread, over = others.std(axis=0, ddof=1), panel[k] - others.mean(axis=0)
    scaled = spread > 1e-9 * np.abs(others).max(axis=0)  # else all others are the same
    far[k] = np.max(over[scaled] / spread[scaled], initial=0.0)
  return far


def check_reference(reference: Any) -> None:
  """Raises ValueError naming the entry unless this is a reference to score against."""
  check_header(reference, "palpate-reference", _VERSION)
  table = reference.get("metrics")
  if not isinstance(table, Mapping):
    raise ValueError("palpate-reference: 'metrics' is missing or not an object")
  check_names(table)
  if neither := [name for name in table if METRICS[name].better == "neither"]:
    raise ValueError(f"palpate-reference: {neither[0]} is not scored: neither is better")
  for name, row in table.items():
    row = row if isinstance(row, Mapping) else {}
    mean, sd = row.get("mean"), row.get("sd")
    if not _number(mean):
      raise ValueError(f"palpate-reference: {name}.mean is {mean!r}, expected a finite number")
    if not _number(limit := row.get("limit")):
      raise ValueError(f"palpate-reference: {name}.limit is {limit!r}, expected a finite number")
    if sd is not None and not (_number(sd) and sd >= 0):
      raise ValueError(f"palpate-reference: {name}.sd is {sd!r}, expected a number >= 0 or null")


def reference_path(task: str) -> pathlib.Path:
  """Returns where the expert reference of a task such as "touch/easy" is kept."""
  return pathlib.Path(__file__).parents[1] / "references" / f"{task.replace('/', '_')}.json"


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


def to_json(data: Mapping[str, Any], depth: int = 0) -> str:
  """Returns the text of a reference, or of an object that holds some: a metric is one line."""
  if not any(isinstance(value, Mapping) for value in data.values()):
    return json.dumps(data, allow_nan=False)
  lines = []
  for name, value in data.items():
    nested = isinstance(value, Mapping)
    text = to_json(value, depth + 1) if nested else json.dumps(value, allow_nan=False)
    lines.append(f"{' ' * (depth + 1)}{json.dumps(name)}: {text}")
  return "{\n" + ",\n".join(lines) + f"\n{' ' * depth}}}" + "\n" * (depth == 0)


def _number(value: Any) -> bool:
  return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


@dataclasses.dataclass(frozen=True)
class Score:
  """A recording against a reference.

  Attributes:
    outcome: `success`, or what came in between; None where nobody said
    composite: weighted z-score, 0 is the panel's average, `FLOOR` without success [-]; `Unknown`
      says why there is none
    proficient: True for a success that is within the limit of every metric
    over: metrics that are over their limit
    missing: metrics that all of the panel has and the recording has not
    z: metric -> z-score, positive beats the panel's mean; `Unknown` where there is none [-]
    group: category -> mean z of its known metrics [-]
    weight: category -> weight as applied: 0 for a category without a known metric, sum 1 [-]
  """

  outcome: str | None
  composite: float
  proficient: bool
  over: tuple[str, ...]
  missing: tuple[str, ...]
  z: dict[str, float]
  group: dict[str, float]
  weight: dict[str, float]


def z_score(value: float, mean: float, sd: float | None, better: str) -> float:
  """Returns by how many SDs a value beats the panel's mean [-], see the module's head."""
  if not math.isfinite(value):
    return Unknown(value.reason if isinstance(value, Unknown) else f"the value is {value}")
  if sd is None:
    return Unknown("the reference has no SD (a single recording)")
  ahead = _ahead(value, mean, better)
  if sd == 0:
    return 0.0 if _as_good(value, mean, better) else -Z_LIMIT
  return max(-Z_LIMIT, min(Z_LIMIT, ahead / sd))


def _ahead(value: float, other: float, better: str) -> float:
  return value - other if better == "higher" else other - value


def _as_good(value: float, other: float, better: str, margin: float = 1e-9) -> bool:
  """Returns whether a value is as good as another, but for a share of it; for rounding alone."""
  return _ahead(value, other, better) >= -margin * max(abs(value), abs(other))


def tells(spec: Spec, outcome: str | None) -> bool:
  """Returns whether a metric tells of skill: what ends early is quick and short without merit."""
  return outcome in (None, SUCCESS) or spec.group not in ("efficiency", "time")


def score(
  metrics: Metrics,
  reference: Mapping[str, Any],
  outcome: str | None,
  weights: Mapping[str, float] | None = None,
) -> Score:
  """Returns the score of a recording; the formula is at the module's head.

  Args:
    metrics: of the recording
    reference: see `make_reference`
    outcome: of the recording; without one it may be neither proficient nor have a score
    weights: category -> weight >= 0, `WEIGHTS` by default; any scale
  """
  check_reference(reference)
  weights = WEIGHTS if weights is None else weights
  if set(weights) != set(WEIGHTS) or not all(_number(w) and w >= 0 for w in weights.values()):
    raise ValueError(f"weights are {dict(weights)}, expected numbers >= 0 for {', '.join(WEIGHTS)}")
  if sum(weights.values()) == 0:
    raise ValueError("weights are all 0")

  z, over, missing = {}, [], []
  for name, row in reference["metrics"].items():
    value, better = getattr(metrics, name), METRICS[name].better
    if not tells(METRICS[name], outcome):
      z[name] = Unknown("the exercise was not finished")
      continue
    z[name] = z_score(value, row["mean"], row.get("sd"), better)
    if not math.isfinite(value):
      if row.get("n") == reference.get("n"):
        missing.append(name)
    elif not _as_good(value, row["limit"], better, MARGIN):
      over.append(name)
  composite, group, applied = _composite(z, weights, over)
  if outcome is None:
    composite = Unknown("the recording does not say how it ended")
  elif outcome != SUCCESS:
    composite = FLOOR
  proficient = outcome == SUCCESS and bool(z) and not over and not missing
  return Score(outcome, composite, proficient, tuple(over), tuple(missing), z, group, applied)


def _composite(
  z: Mapping[str, float], weights: Mapping[str, float], over: Sequence[str]
) -> tuple[float, dict[str, float], dict[str, float]]:
  """Returns composite, category -> mean z, and category -> weight as applied."""
  group: dict[str, float] = {}
  for name in WEIGHTS:
    known = [v for k, v in z.items() if METRICS[k].group == name and math.isfinite(v)]
    group[name] = math.fsum(known) / len(known) if known else Unknown("no known metric")
  harms = [z[k] for k in over if METRICS[k].group == "safety" and math.isfinite(z[k])]
  group["safety"] = min([group["safety"], *harms]) if harms else group["safety"]
  total = sum(weights.values())
  share = sum(weights[name] for name, v in group.items() if math.isfinite(v)) / total
  applied = {
    name: weights[name] / total / share if math.isfinite(v) and share > 0 else 0.0
    for name, v in group.items()
  }
  if share < LEAST_WEIGHT:
    absent = ", ".join(n for n, v in group.items() if not math.isfinite(v) and weights[n] > 0)
    text = f"only {100 * share:.0f} % of the weight is known; no {absent}"
    return Unknown(text), group, applied
  return math.fsum(applied[n] * v for n, v in group.items() if applied[n] > 0), group, applied


def trained(proficient: Sequence[bool]) -> int | None:
  """Returns after how many episodes a performer is proficient, see the module's head; None if not.

  Args:
    proficient: of each episode, in order
  """
  run, since = 0, -1  # since the run was complete: proficient episodes after it
  for k, passed in enumerate(proficient):
    if since >= 0:
      since += passed
    else:
      run = run + 1 if passed else 0
      since = 0 if run == CONSECUTIVE else -1
    if since == REPEATS:
      return k + 1
  return None
