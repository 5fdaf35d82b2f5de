"""Proficiency limits of a training programme's own experts, and the file that holds them.

A file is plain data, read by the option `--references`:

    {"format": "palpate-references", "version": 1, "references": {"touch/easy": {...}, ...}}

Each entry is a `palpate-reference` (see `score`) whose limits come of one of these rules over the
experts' successes:

    panel          that of the references that ship, see the head of `score`: 95 % of the experts
                   pass limits that are made of the others, in all metrics together
    sd:K           the mean and K sample SDs to the worse side; sd:2 is what SAGES recommends
                   (10.1007/s00464-018-6480-x). Each metric has its own 2 % of failures, so that
                   with thirty metrics about half of the experts' own episodes fail one
    percentile:P   the value that P % of the experts' episodes are as good as, interpolated between
                   order statistics; a share of peers as benchmark as in von Websky et al. 2013
                   (World J Surg 37:2534)
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..metrics import METRICS, Metrics, check_header
from . import score
from .score import check_reference, make_reference, read_reference, reference

FORMAT, VERSION = "palpate-references", 1
RULES = "panel, sd:K or percentile:P"
LEAST = 5  # successes to make limits of

Lookup = Callable[[str], Mapping[str, Any] | None]  # task -> its reference


def rule(text: str) -> Callable[[np.ndarray], float] | None:
  """Returns what makes a limit of a metric's values, where more is worse; None for the panel's.

  ValueError for a text that is none of `RULES`.
  """
  if text == "panel":
    return None
  kind, _, number = text.partition(":")
  try:
    value = float(number)
  except ValueError:
    value = math.nan
  if kind == "sd" and 0 <= value <= 10:
    return lambda v: float(v.mean() + value * v.std(ddof=1) if np.ptp(v) else v[0])
  if kind == "percentile" and 0 < value <= 100:
    return lambda v: float(np.percentile(v, value))
  allowed = "with K in [0, 10] and P in (0, 100]"
  raise ValueError(f"rule is {text!r}, expected {RULES}, {allowed}")


def of_people(results: Sequence[Metrics], task: str, text: str = "panel") -> dict[str, Any]:
  """Returns the reference of experts' successes at one task.

  Args:
    results: of `LEAST` successes or more
    task: such as "touch/easy"
    text: one of `RULES`
  """
  bound = rule(text)
  if len(results) < LEAST:
    raise ValueError(f"{task}: {len(results)} successes, expected {LEAST} or more for limits")
  data = make_reference(results, task, 0)
  del data["seed"]  # people have none
  if bound is not None:
    for name, row in data["metrics"].items():
      sign = 1.0 if METRICS[name].better == "lower" else -1.0
      values = np.array([getattr(r, name) for r in results], float)
      row["limit"] = sign * bound(sign * values[np.isfinite(values)])
  return data | {"performer": "people", "rule": text}


def to_json(references: Mapping[str, Mapping[str, Any]]) -> str:
  """Returns the text of a file of references."""
  return score.to_json({"format": FORMAT, "version": VERSION, "references": references})


def read(path: Path) -> dict[str, Mapping[str, Any]]:
  """Returns task -> reference of a file, which may be that of a single task.

  ValueError names the file and what is wrong with it.
  """
  if path.exists() and not path.is_file():  # a pipe would be waited for
    raise ValueError(f"{path}: not {FORMAT}: not a file")
  try:
    data = json.loads(path.read_text(encoding="utf-8"))
    if isinstance(data, dict) and data.get("format") == "palpate-reference":
      one = read_reference(path)
      return {str(one.get("task", "")): one}
    check_header(data, FORMAT, VERSION)
    table = data.get("references")
    if not isinstance(table, dict) or not table:
      raise ValueError(f"{FORMAT}: 'references' is missing, empty or not an object")
    for entry in table.values():
      check_reference(entry)
  except ValueError as error:
    raise ValueError(f"{path}: {error}") from None
  return table


def lookup(path: Path | None = None) -> Lookup:
  """Returns what finds the reference of a task: in a file, and for others the one that ships."""
  own = {} if path is None else read(path)
  return lambda task: own.get(task) or reference(task)
