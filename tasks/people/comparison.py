"""Recordings side by side: a page and a text.

Each is scored against the reference of its own task; numbers of different tasks stand beside each
other, but neither is marked as the better one.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..metrics import METRICS, SUCCESS, Metrics, Spec, number
from ..recording import Recording
from . import page
from .page import text
from .plots import compared_figure, path_figure, png
from .report import ending, points, verdict, views, write_page
from .score import WEIGHTS, Score, score


@dataclasses.dataclass(frozen=True)
class Entry:
  """One of the recordings.

  Attributes:
    name: that people know it by
    recording: the exercise
    reference: see `score.make_reference`; None without one
    film: of the exercise, MP4; None without one
    pictures: of the exercise  (n, height, width, 3) uint8; None without any
  """

  name: str
  recording: Recording
  reference: Mapping[str, Any] | None = None
  film: bytes | None = None
  pictures: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class _Measured:
  entry: Entry
  metrics: Metrics
  score: Score | None


def write_comparison(entries: Sequence[Entry], folder: Path) -> Path:
  """Writes `comparison.html` into a folder and returns its path."""
  return write_page(folder / "comparison.html", render(entries))


def render(entries: Sequence[Entry]) -> str:
  """Returns the page."""
  measured = _measure(entries)
  title = " and ".join(dict.fromkeys(_task(e) for e in entries))
  paths = [(e.name, path_figure(e.recording)) for e in entries]
  pictures = [(name, page.image(png(f), f"tip path of {name}")) for name, f in paths if f]
  seen = [(e.name, views(e.film, e.pictures, e.name)) for e in entries]
  over_time = compared_figure([(e.name, e.recording) for e in entries])
  return page.document(
    title,
    [
      f"<h1>{text(title)}</h1>",
      f"<p class='faint'>{text(', '.join(e.name for e in entries))}, side by side</p>",
      page.beside([(name, shown) for name, shown in seen if shown]),
      _outcomes(measured),
      f"<h2>Path</h2>{page.beside(pictures)}" if pictures else "",
      f"<h2>Force and speed</h2>{page.image(png(over_time), 'force and speed over time')}"
      if over_time
      else "",
      _metric_table(measured),
    ],
  )


def as_text(entries: Sequence[Entry]) -> str:
  """Returns the outcomes and the metrics as aligned columns, for a terminal."""
  measured = _measure(entries)
  lines: list[list[str]] = [["", *(e.name for e in entries)]]
  for label, cells in _heads(measured):
    lines.append([label, *cells])
  for name, spec in _shown(measured):
    best = _best(measured, name, spec)
    cells = [number(getattr(m.metrics, name), spec) + "*" * (m is best) for m in measured]
    lines.append([f"{spec.label} [{spec.shown}]", *cells])
  widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
  rows = []
  for label, *cells in lines:
    right = [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
    rows.append("  ".join([label.ljust(widths[0]), *right]).rstrip())
  return "\n".join(rows + ["* the better one of those that succeeded"] * (len(entries) > 1))


def _measure(entries: Sequence[Entry]) -> list[_Measured]:
  out = []
  for entry in entries:
    metrics, reference = entry.recording.metrics(), entry.reference
    result = None if reference is None else score(metrics, reference, entry.recording.outcome)
    out.append(_Measured(entry, metrics, result))
  return out


def _task(entry: Entry) -> str:
  return str(entry.recording.info.get("task", "Exercise"))


def _heads(measured: Sequence[_Measured]) -> list[tuple[str, list[str]]]:
  """Returns the rows above the metrics, in plain words."""
  scores = [m.score for m in measured]
  proficient = ["–" if s is None else "yes" if s.proficient else "no" for s in scores]
  rows = [("Task", [_task(m.entry) for m in measured])]
  rows.append(("Performer", [str(m.entry.recording.info.get("performer", "–")) for m in measured]))
  rows.append(("Outcome", [m.entry.recording.outcome or "not recorded" for m in measured]))
  return [*rows, ("Score", list(map(points, scores))), ("Proficient", proficient)]


def _outcomes(measured: Sequence[_Measured]) -> str:
  rows = []
  for m in measured:
    outcome = m.entry.recording.outcome
    kind = "" if outcome is None else "good" if outcome == SUCCESS else "bad"
    cells = [text(m.entry.name), page.mark(text(ending(m.entry.recording)), kind)]
    cells.append(points(m.score))
    cells.append("no reference" if m.score is None else text(verdict(m.score)))
    rows.append(page.row(cells, [2]))
  return page.table(["recording", "how it ended", "score", "proficiency"], rows, [2])


def _shown(measured: Sequence[_Measured]) -> list[tuple[str, Spec]]:
  """Returns the metrics that one of the recordings has."""
  return [
    (name, spec)
    for name, spec in METRICS.items()
    if any(math.isfinite(getattr(m.metrics, name)) for m in measured)
  ]


def _best(measured: Sequence[_Measured], name: str, spec: Spec) -> _Measured | None:
  """Returns the success with the best value; None where there is none or the tasks differ."""
  good = [m for m in measured if m.entry.recording.outcome in (None, SUCCESS)]
  known = [m for m in good if math.isfinite(getattr(m.metrics, name))]
  values = [getattr(m.metrics, name) for m in known]
  one_task = len({_task(m.entry) for m in measured}) == 1
  if spec.better == "neither" or len(known) < 2 or not one_task or min(values) == max(values):
    return None
  return known[values.index((min if spec.better == "lower" else max)(values))]


def _metric_table(measured: Sequence[_Measured]) -> str:
  names = [text(m.entry.name) for m in measured]
  two = len(measured) == 2
  head = ["metric", *names, "unit", "better", *(["difference"] if two else [])]
  numbers = [*range(1, 1 + len(names)), *([len(names) + 3] if two else [])]
  rows = []
  for group in WEIGHTS:
    mine = [(name, spec) for name, spec in _shown(measured) if spec.group == group]
    rows += [page.group(group, len(head))] if mine else []
    for name, spec in mine:
      best = _best(measured, name, spec)
      cells = [f"<span title='{text(spec.source)}'>{text(spec.label)}</span>"]
      for m in measured:
        value = number(getattr(m.metrics, name), spec)
        over = m.score is not None and name in m.score.over
        cells.append(page.mark(f"<b>{value}</b>" if m is best else value, "bad" * over))
      cells += [text(spec.shown), "–" if spec.better == "neither" else spec.better]
      if two:
        first, second = (getattr(m.metrics, name) for m in measured)
        cells.append("+" * (second > first) + number(second - first, spec))
      rows.append(page.row(cells, numbers))
  about = (
    "Bold is the better value of those that succeeded; red is over the limit of proficiency; the "
    "difference is the second less the first."
  )
  return f"<h2>Metrics</h2>{page.table(head, rows, numbers)}<p class='small faint'>{about}</p>"
