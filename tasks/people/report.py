"""Writes one self-contained HTML page about a recording, for people: mm, degrees, words.

Needs matplotlib (`palpate[plot]`), which is imported when a page is written and not before.
"""

import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..files import replacing
from ..metrics import METRICS, SUCCESS, Metrics, Spec, Unknown, number
from ..recording import INTERRUPTED, Recording
from . import page
from .page import text
from .plots import force_figure, jpeg, path_figure, png, spectrum_figure
from .score import CONSECUTIVE, FLOOR, PASSING, REPEATS, WEIGHTS, Score, score

_MOST_EVENTS = 50
_ABOUT = {"task_kwargs": "options", "return": "sum of rewards"}  # names of entries, for people
_ENDS = {
  SUCCESS: "Success",
  "damage": "Failed: tissue was harmed",
  "missed": "Failed: it was missed",
  "time limit": "Failed: the time ran out",
  "stopped": "Stopped before the end",
  INTERRUPTED: "Interrupted: the program was killed, this is what it had written",
  "error": "Failed: the performer or the simulation raised an error",
}


def write_report(
  recording: Recording,
  folder: str | os.PathLike[str],
  reference: Mapping[str, Any] | None = None,
  title: str | None = None,
  film: bytes | None = None,
  pictures: np.ndarray | None = None,
) -> Path:
  """Writes `report.html` into a folder and returns its path.

  Args:
    recording: the exercise; its constants `vertices` and `triangles` are drawn under the path
    folder: made if it is missing
    reference: see `score.make_reference`; without it there is no score
    title: heading; the recording's task by default
    film: of the exercise, MP4
    pictures: of the exercise, from the start to the end  (n, height, width, 3) uint8
  """
  content = render(recording, reference, title, film, pictures)
  return write_page(Path(folder) / "report.html", content)


def write_page(path: Path, content: str) -> Path:
  """Writes a page, its folder made if it is missing, and returns its path."""
  path.parent.mkdir(parents=True, exist_ok=True)
  with replacing(path) as file:
    file.write(content)
  return path


def render(
  recording: Recording,
  reference: Mapping[str, Any] | None = None,
  title: str | None = None,
  film: bytes | None = None,
  pictures: np.ndarray | None = None,
) -> str:
  """Returns the page that `write_report` writes."""
  title = title or str(recording.info.get("task", "Exercise"))
  metrics = recording.metrics()
  result = None if reference is None else score(metrics, reference, recording.outcome)
  body = [
    f"<h1>{text(title)}</h1>",
    _outcome(recording),
    f"<p class='faint'>{text(_summary(recording))}</p>",
    views(film, pictures),
    _score_part(result),
    _plots(recording, metrics),
    _metric_table(recording, metrics, reference, result),
    _event_table(recording),
    _about(recording, reference),
  ]
  return page.document(title, body)


def ending(recording: Recording) -> str:
  """Returns how an exercise ended, in words."""
  outcome = recording.outcome
  if outcome is None:
    return "How it ended was not recorded"
  words = _ENDS.get(outcome, f"Failed: {outcome}")
  notes = [event.label for event in recording.events if event.kind == "note" and event.label]
  if outcome in ("damage", "missed") and notes and notes[-1] != SUCCESS:  # the exercise's own
    words = f"Failed: {notes[-1]}"
  if len(recording.time):
    words += f", after {number(float(recording.time[-1] - recording.time[0]))} s"
  return f"{words}: {recording.info['error']}" if "error" in recording.info else words


def _outcome(recording: Recording) -> str:
  outcome = recording.outcome
  kind = "faint" if outcome is None else "good" if outcome == SUCCESS else "bad"
  return f"<p class='outcome {kind}'>{text(ending(recording))}</p>"


def _summary(recording: Recording) -> str:
  count = len(recording.time)
  if count < 2:
    return f"{count} sample{'' if count == 1 else 's'}"
  length = float(recording.time[-1] - recording.time[0])
  return (
    f"{number(length)} s, {count} samples at {number((count - 1) / length)} Hz, "
    f"{', '.join(recording.instruments)}"
  )


def views(film: bytes | None, pictures: np.ndarray | None, whose: str = "") -> str:
  """Returns an exercise's film, or else its pictures side by side, where there are some.

  Args:
    film: MP4
    pictures: (n, height, width, 3) uint8
    whose: the exercise's name, where there are several
  """
  about = f"{whose}: " * bool(whose) + "what the laparoscope saw"
  if film is not None:
    return page.film(film, about)
  if pictures is None:
    return ""
  count = len(pictures)
  shown = (
    page.image(jpeg(each), f"{about}, picture {k + 1} of {count}", "jpeg")
    for k, each in enumerate(pictures)
  )
  return f"<div class='strip'>{''.join(shown)}</div>"


def _score_part(result: Score | None) -> str:
  if result is None:
    return "<h2>Score</h2><p>No reference was given, so there is no score.</p>"
  if isinstance(result.composite, Unknown):
    head = f"<p><b>No composite score</b>: {text(result.composite.reason)}.</p>"
  else:
    mark = page.mark(text(verdict(result)), "good" if result.proficient else "bad")
    head = f"<div class='score'><b>{points(result)}</b>{mark}</div>"
  rows = []
  # What a failure did well on the way is no part of its score.
  for name, weight in WEIGHTS.items() if result.outcome == SUCCESS else ():
    value, applied = result.group[name], result.weight[name]
    known = math.isfinite(value)
    cells = [name, f"{100 * weight:.3g} %", f"{100 * applied:.3g} %", number(round(value, 2))]
    cells.append(number(round(applied * value, 2)) if known else "–")
    rows.append(page.row(cells, range(1, 5)))
  columns = ["category", "weight", "applied", "mean z", "contribution"]
  categories = page.table(columns, rows, range(1, 5)) if rows else ""
  return (
    f"<h2>Score</h2>{head}{categories}<p class='small faint'>"
    f"An exercise that is not done counts as {number(FLOOR)}, below every success. Else the score "
    "is the weighted mean of the categories' mean z-scores. A z-score counts standard deviations "
    "of a panel of skilled people of many styles; positive beats their mean, whatever the metric's "
    "direction; it is clipped to ±10. Safety 67 % and efficiency 17 % are the weights of the "
    "Heidelberg VR score (10.1007/s00464-018-6480-x); its remaining 16 % are for time, dexterity "
    "and outcome, shared equally here. A category without a known metric drops out and the others "
    "take its weight in proportion (column “applied”). Proficient is a success within every limit, "
    f"which {100 * PASSING:.0f} % of the panel are; a performer is proficient after {CONSECUTIVE} "
    f"such episodes in a row and {REPEATS} more (Ritter and Scott 2007).</p>"
  )


def points(result: Score | None) -> str:
  """Returns an episode's score for people: a failure has none."""
  if result is None:
    return "–"
  return "not done" if result.composite == FLOOR else number(round(result.composite, 2))


def verdict(result: Score) -> str:
  """Returns whether an episode is proficient, and why not."""
  if result.proficient:
    return "proficient: every metric within its limit"
  if result.outcome != SUCCESS:
    return "not proficient; it did not succeed"
  parts = [
    f"{why}: {', '.join(METRICS[k].label for k in names)}"
    for why, names in (("over the limit", result.over), ("unknown", result.missing))
    if names
  ]
  return f"not proficient; {'; '.join(parts) or 'no limits'}"


def _plots(recording: Recording, metrics: Metrics) -> str:
  parts = []
  reasons = metrics.reasons()
  for title, draw, absent, alt in (
    ("Path", path_figure, "path_length", "tip path in 3D, millimetres"),
    ("Force", force_figure, "peak_force", "contact force over time, newtons"),
    ("Speed spectrum", spectrum_figure, "sparc", "normalised spectrum of the tip's speed"),
  ):
    figure = draw(recording)
    if figure is None:
      parts.append(f"<h2>{title}</h2><p>Nothing to draw: {text(reasons.get(absent, ''))}.</p>")
      continue
    shown = page.image(png(figure), alt)
    # A phone shows curves over time in part, large enough to be read.
    wide = shown if title == "Path" else f"<div class='wide'>{shown}</div>"
    parts.append(f"<h2>{title}</h2>{wide}")
  return "\n".join(parts)


def _metric_table(
  recording: Recording, metrics: Metrics, reference: Mapping[str, Any] | None, result: Score | None
) -> str:
  several = len(recording.instruments) > 1
  each = [recording.metrics(i) for i in range(len(recording.instruments))] if several else []
  head = ["metric", "value", *(text(name) for name in recording.instruments if several)]
  head += ["unit", "better"]
  numbers = list(range(1, 2 + len(each)))
  if result is not None:
    numbers += range(len(head), len(head) + 3)
    head += ["panel mean ± SD", "limit", "z"]
  more = [head.index(name) for name in ("better", "panel mean ± SD") if name in head]
  rows = []
  for group in WEIGHTS:
    names = [name for name, spec in METRICS.items() if spec.group == group]
    known = [n for n in names if math.isfinite(getattr(metrics, n))]
    missing = [n for n in names if result is not None and n in result.missing]
    if known or missing:
      rows.append(page.group(group, len(head)))
    for name in names:
      if name not in known and name not in missing:
        continue
      spec = METRICS[name]
      label = f"<span title='{text(spec.source)}'>{text(spec.label)}</span>"
      cells = [label, *(number(getattr(k, name), spec) for k in [metrics, *each])]
      cells += [text(spec.shown), spec.better if spec.better != "neither" else "–"]
      if reference is not None and result is not None:
        cells += _panel_cells(name, spec, reference, result)
      rows.append(page.row(cells, numbers, more=more))
  unknown = "".join(
    f"<dt>{text(METRICS[n].label)}</dt><dd>{text(r)}</dd>" for n, r in metrics.reasons().items()
  )
  found = f"<h2>Metrics</h2>{page.table(head, rows, numbers, more)}"
  return found + (f"<h2>Not known</h2><dl class='small'>{unknown}</dl>" if unknown else "")


def _panel_cells(name: str, spec: Spec, reference: Mapping[str, Any], result: Score) -> list[str]:
  row = reference["metrics"].get(name)
  if row is None:
    return ["–", "–", "–"]
  sd = "?" if row.get("sd") is None else number(row["sd"], spec)
  limit = ("≤ " if spec.better == "lower" else "≥ ") + number(row["limit"], spec)
  z = result.z[name]
  # The word says it too, for those who do not see the colour.
  over = name in result.over
  kind = "bad" if over else "good" if z >= 0 and result.outcome == SUCCESS else ""
  shown = page.mark(number(round(z, 2)) + " over" * over, kind)
  return [f"{number(row['mean'], spec)} ± {sd}", limit, shown if over or math.isfinite(z) else "–"]


def _event_table(recording: Recording) -> str:
  if not recording.events:
    return ""
  start = float(recording.time[0]) if len(recording.time) else 0.0
  rows = []
  for event in recording.events[:_MOST_EVENTS]:
    distance = ""
    if event.value is not None:
      length = event.kind in ("target", "miss")
      distance = f"{number(1e3 * event.value)} mm" if length else f"{event.value:g}"
    cells = [number(event.time - start), event.kind, distance]
    cells += [recording.instruments[event.instrument], event.label]
    rows.append(page.row(map(text, cells), [0]))
  more = len(recording.events) - _MOST_EVENTS
  tail = f"<p class='faint'>and {more} more</p>" if more > 0 else ""
  head = ["time [s]", "event", "value", "instrument", "label"]
  return f"<h2>Events</h2>{page.table(head, rows, [0])}{tail}"


def _about(recording: Recording, reference: Mapping[str, Any] | None) -> str:
  set_ = recording.settings
  lines = {_ABOUT.get(k, k): v for k, v in recording.info.items() if v not in ("", {})}
  if "coach" in lines:
    said = [f"{hint['time']:.1f} s: {hint['text']}" for hint in lines["coach"].get("hints", ())]
    lines["coach"] = "; ".join(said) or "silent"
  if "live" in lines:
    live = lines["live"]
    on_time = f"{100 * live['on_time']:.1f} % of {live['steps']} steps on time"
    lines["live"] = "; ".join([on_time, *live.get("faults", ())])
  lines |= {
    "force limit": "none" if set_.force_limit is None else f"{set_.force_limit:g} N",
    "reference path": "none"
    if set_.reference_length is None
    else f"{number(1e3 * set_.reference_length)} mm",
    "positions": "as they are (exact)"
    if set_.tip_cutoff is None
    else f"without what is faster than {set_.tip_cutoff:g} Hz (measured)",
    "movements": f"without what is faster than {set_.movement_cutoff:g} Hz (tremor)",
    "moving above": f"{1e3 * set_.movement_speed:g} mm/s for {set_.movement_debounce:g} s",
    "idle below": f"{1e3 * set_.idle_speed:g} mm/s",
    "contact above": f"{set_.contact_force:g} N, {recording.substeps} values a sample",
  }
  if reference is not None:
    keys = ("task", "performer", "n", "seed", "palpate")
    lines["reference"] = ", ".join(f"{k} {reference[k]}" for k in keys if k in reference)
  items = "".join(f"<dt>{text(k)}</dt><dd>{text(_plain(v))}</dd>" for k, v in lines.items())
  return f"<h2>About</h2><dl class='small'>{items}</dl>"


def _plain(value: Any) -> str:
  """Returns what JSON holds, for people."""
  if isinstance(value, Mapping):
    return "; ".join(f"{k} = {_plain(v)}" for k, v in value.items())
  if isinstance(value, list | tuple):
    return ", ".join(map(_plain, value))
  if isinstance(value, float):
    return f"{value:.6g}"
  return "none" if value is None else str(value)
