"""All metrics of one recording."""

import json
import math
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from palpate.tissue.reading import choices

from .definition import METRICS, Unknown


class Metrics:
  """Every metric of `METRICS` as an attribute, SI; `Unknown` where it cannot be known."""

  def __init__(self, **values: float):
    """Takes some of the metrics; the others are unknown. ValueError where there is none such."""
    check_names(values)
    absent = Unknown("not recorded")
    self.__dict__.update({name: values.get(name, absent) for name in METRICS})

  if TYPE_CHECKING:

    def __getattr__(self, name: str) -> float: ...

  def __setattr__(self, name: str, value: Any) -> None:
    raise AttributeError(f"cannot set {name!r}: metrics are what was recorded")

  def values(self) -> dict[str, float]:
    """Returns metric -> value [SI]."""
    return dict(self.__dict__)

  def reasons(self) -> dict[str, str]:
    """Returns metric -> why it is unknown, for those that are."""
    return {
      name: value.reason if isinstance(value, Unknown) else f"the value is {value}"
      for name, value in self.values().items()
      if not math.isfinite(value)
    }

  def __repr__(self) -> str:
    known = {name: value for name, value in self.values().items() if math.isfinite(value)}
    return f"Metrics({', '.join(f'{name}={value:.6g}' for name, value in known.items())})"

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
    check_header(data, "palpate-metrics")
    values, unknown = data.get("values"), data.get("unknown", {})
    if not isinstance(values, dict) or not isinstance(unknown, dict):
      raise ValueError("palpate-metrics: 'values' and 'unknown' must be objects")
    return cls(
      **{
        name: Unknown(str(unknown.get(name, "not recorded"))) if value is None else float(value)
        for name, value in values.items()
      }
    )


def check_header(data: Any, name: str, version: int = 1) -> None:
  """Raises ValueError unless the data says that it is of format `name` and of this version."""
  if not isinstance(data, Mapping) or data.get("format") != name:
    found = data.get("format") if isinstance(data, Mapping) else type(data).__name__
    raise ValueError(f"not {name}: format is {found!r}")
  if data.get("version") != version:
    raise ValueError(f"{name}: version is {data.get('version')!r}, expected {version}")


def check_names(names: Iterable[str]) -> None:
  """Raises ValueError unless all are names of metrics."""
  if strange := sorted(set(names) - set(METRICS)):
    raise ValueError(f"no such metric {strange[0]!r}, {choices(strange[0], METRICS)}")
