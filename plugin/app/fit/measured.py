"""A table of an indentation that was measured: time, depth and force, with their units."""

import csv
import dataclasses
import math
import pathlib
import re

import numpy as np

from ..console import CommandError

# Names of the columns, and the units that they may have [SI].
_NAMES = {
  "time": ("time", "t"),
  "depth": ("depth", "displacement", "indentation"),
  "force": ("force", "f", "load"),
}
_UNITS = {
  "time": {"s": 1.0, "ms": 1e-3, "min": 60.0},
  "depth": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6},
  "force": {"N": 1.0, "mN": 1e-3, "kN": 1e3},
}
_FEWEST = 10  # rows
_AT_FIRST = 0.1  # of the greatest depth, at which a record may begin


@dataclasses.dataclass(frozen=True)
class Record:
  """What was measured.

  Attributes:
    time: from the first row [s]                    (n,)
    depth: of the tool beyond the first touch [m]   (n,)
    force: of the tissue on the tool [N]            (n,)
  """

  time: np.ndarray
  depth: np.ndarray
  force: np.ndarray


def read(path: pathlib.Path) -> Record:
  """Returns the record in a CSV file.

  Its header names time, depth and force with their units: `time [s]`, `depth (mm)` or `force_N`.
  Lines that begin with # are left out.

  Raises:
    CommandError: there is no such file, a column or unit is missing, or a value is none.
  """
  if not path.is_file():
    raise CommandError(f"no file {str(path)!r}, expected a CSV of time, depth and force")
  try:
    text = path.read_text(encoding="utf-8-sig")
  except (OSError, UnicodeDecodeError) as error:
    raise CommandError(f"cannot read {path.name!r}: {error}") from None
  rows = [(n, line) for n, line in enumerate(text.splitlines(), 1) if line.strip()]
  rows = [(n, line) for n, line in rows if not line.lstrip().startswith("#")]
  if not rows:
    raise CommandError(f"{path.name}: it is empty, expected a header and rows")
  comma = ";" if rows[0][1].count(";") > rows[0][1].count(",") else ","
  try:
    cells = list(csv.reader([line for _, line in rows], delimiter=comma))
  except csv.Error as error:
    raise CommandError(f"{path.name}: cannot be read: {error}") from None
  where = _columns(path.name, cells[0])
  values = {name: [] for name in where}
  for (line, _), row in zip(rows[1:], cells[1:], strict=True):
    for name, (column, scale) in where.items():
      values[name].append(scale * _number(path.name, line, name, row, column))
  return _checked(path.name, **{name: np.array(each) for name, each in values.items()})


def _columns(file: str, header: list[str]) -> dict[str, tuple[int, float]]:
  """Returns place and scale of each column that counts."""
  found: dict[str, tuple[int, float]] = {}
  for column, cell in enumerate(header):
    word = cell.strip()
    parts = re.fullmatch(r"(\w+?)(?:_([a-zA-Zµμ]+)|\s*[\[(]\s*([^\])]*?)\s*[\])])?", word)
    name = next((k for k, v in _NAMES.items() if parts and parts[1].lower() in v), None)
    if name is None or not parts:
      continue
    if name in found:
      raise CommandError(f"{file}: column {word!r} is a second {name}, expected one")
    unit = (parts[2] or parts[3] or "").replace("µ", "u").replace("μ", "u")
    allowed = ", ".join(_UNITS[name])
    if not unit:
      raise CommandError(
        f"{file}: column {word!r} has no unit, expected one of {allowed}, as in "
        f"'{name} [{next(iter(_UNITS[name]))}]'"
      )
    if unit not in _UNITS[name]:
      raise CommandError(f"{file}: column {word!r} is in {unit!r}, expected one of {allowed}")
    found[name] = column, _UNITS[name][unit]
  for name, words in _NAMES.items():
    if name not in found:
      have = ", ".join(repr(cell.strip()) for cell in header)
      raise CommandError(
        f"{file}: no column of the {name}, expected one called {', '.join(words)}; it has {have}"
      )
  return found


def _number(file: str, line: int, name: str, row: list[str], column: int) -> float:
  cell = row[column].strip() if column < len(row) else ""
  try:
    value = float(cell)
  except ValueError:
    value = math.nan
  if not math.isfinite(value):
    raise CommandError(f"{file}, line {line}: {name} is {cell!r}, expected a finite number")
  return value


def _checked(file: str, time: np.ndarray, depth: np.ndarray, force: np.ndarray) -> Record:
  if len(time) < _FEWEST:
    raise CommandError(f"{file}: {len(time)} rows, expected at least {_FEWEST}")
  back = np.flatnonzero(np.diff(time) <= 0)
  if back.size:
    raise CommandError(
      f"{file}: time does not grow after row {back[0] + 1} ({time[back[0]]:g} s), expected rows in "
      "order"
    )
  if depth.max() <= 0:
    raise CommandError(f"{file}: depth is nowhere above 0, expected it to grow into the tissue")
  if depth[0] > _AT_FIRST * depth.max():
    raise CommandError(
      f"{file}: depth begins at {depth[0]:g} m, expected a record from the first touch on"
    )
  if force[depth.argmax()] <= 0:
    raise CommandError(
      f"{file}: force is {force[depth.argmax()]:g} N where it is deepest, expected one > 0: the "
      "tissue's push on the tool"
    )
  return Record(time - time[0], depth, force)
