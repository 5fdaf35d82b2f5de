"""Writes one self-contained HTML page about a recording, for people: mm, degrees, words.

Needs matplotlib (`palpate[plot]`), which is imported when a page is written and not before.
"""

import base64
import html
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from .files import replacing
from .metrics import METRICS, Metrics, Spec, Unknown, number
from .plots import force_figure, path_figure, png, spectrum_figure
from .recording import Recording
from .score import PROFICIENT_SD, WEIGHTS, Score, score

_MOST_EVENTS = 50

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #1d2330; background: #fff;
  max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; margin: 0; } h2 { font-size: 1.15rem; margin: 2rem 0 .6rem; }
.faint { color: #5d6472; } .small { font-size: .88rem; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
th, td { text-align: left; padding: .3rem .6rem; border-bottom: 1px solid #e4e7ec; }
th { font-weight: 600; color: #5d6472; } td.n, th.n { text-align: right; white-space: nowrap;
  font-variant-numeric: tabular-nums; }
tr.group td { background: #f4f6f9; font-weight: 600; }
.wide { overflow-x: auto; }
.score { display: flex; gap: 1.5rem; align-items: baseline; flex-wrap: wrap; }
.score b { font-size: 2.2rem; line-height: 1.2; }
.good { color: #1c7a4d; } .bad { color: #b3213b; }
img { max-width: 100%; height: auto; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1rem; margin: 0; }
dt { color: #5d6472; } dd { margin: 0; overflow-wrap: anywhere; }
"""


def write_report(
  recording: Recording,
  folder: str | os.PathLike[str],
  reference: Mapping[str, Any] | None = None,
  title: str | None = None,
) -> Path:
  """Writes `report.html` into a folder and returns its path.

  Args:
    recording: the exercise; its constants `vertices` and `triangles` are drawn under the path
    folder: made if it is missing
    reference: of experts, see `score.make_reference`; without it there is no score
    title: heading; the recording's task by default
  """
  page = render(recording, reference, title)
  path = Path(folder) / "report.html"
  path.parent.mkdir(parents=True, exist_ok=True)
  with replacing(path) as file:
    file.write(page)
  return path


def render(
  recording: Recording, reference: Mapping[str, Any] | None = None, title: str | None = None
) -> str:
  """Returns the page that `write_report` writes."""
  title = title or str(recording.info.get("task", "Exercise"))
  metrics = recording.metrics()
  result = None if reference is None else score(metrics, reference)
  body = [
    f"<h1>{_text(title)}</h1>",
    f"<p class='faint'>{_text(_summary(recording))}</p>",
    _score_part(result, reference),
    _plots(recording, metrics),
    _metric_table(recording, metrics, reference, result),
    _event_table(recording),
    _about(recording, reference),
  ]
  return (
    "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
    "<meta name='viewport' content='width=device-width, initial-scale=1'>"
    f"<title>{_text(title)}</title><style>{_STYLE}</style></head><body>\n"
    + "\n".join(body)
    + "\n</body></html>\n"
  )


def _text(value: Any) -> str:
  return html.escape(str(value), quote=True)


def _row(cells: Iterable[str], numbers: Iterable[int] = (), tag: str = "td") -> str:
  """Returns a table row of finished HTML; `numbers` are the columns to align right."""
  right = set(numbers)
  return "<tr>" + "".join(
    f"<{tag}{' class=n' if k in right else ''}>{cell}</{tag}>" for k, cell in enumerate(cells)
  ) + "</tr>"  # fmt: skip


def _table(head: Iterable[str], rows: Iterable[str], numbers: Iterable[int] = ()) -> str:
  first, rest = _row(head, numbers, "th"), "".join(rows)
  return f"<div class='wide'><table><thead>{first}</thead><tbody>{rest}</tbody></table></div>"


def _summary(recording: Recording) -> str:
  count = len(recording.time)
  if count < 2:
    return f"{count} sample{'' if count == 1 else 's'}"
  length = float(recording.time[-1] - recording.time[0])
  return (
    f"{number(length)} s, {count} samples at {number((count - 1) / length)} Hz, "
    f"{', '.join(recording.instruments)}"
  )


def _score_part(result: Score | None, reference: Mapping[str, Any] | None) -> str:
  if result is None or reference is None:
    return "<h2>Score</h2><p>No expert reference was given, so there is no score.</p>"
  if math.isnan(result.composite):
    reason = result.composite.reason if isinstance(result.composite, Unknown) else ""
    head = f"<p><b>No composite score</b>: {_text(reason)}.</p>"
  else:
    value = number(round(result.composite, 2))
    head = f"<div class='score'><b>{value}</b>{_verdict(result)}</div>"
  rows = []
  for name, weight in WEIGHTS.items():
    value, applied = result.group[name], result.weight[name]
    known = math.isfinite(value)
    cells = [name, f"{100 * weight:.3g} %", f"{100 * applied:.3g} %", number(round(value, 2))]
    rows.append(_row([*cells, number(round(applied * value, 2)) if known else "–"], range(1, 5)))
  head += _table(["category", "weight", "applied", "mean z", "contribution"], rows, range(1, 5))
  return (
    f"<h2>Score</h2>{head}<p class='small faint'>The composite is the weighted mean of the "
    "categories' mean z-scores. A z-score counts expert standard deviations; positive beats the "
    "expert's mean, whatever the metric's direction; it is clipped to ±10. 0 is the expert's "
    "average, −2 the limit of proficiency. Safety 67 % and efficiency 17 % are the weights of the "
    "Heidelberg VR score (10.1007/s00464-018-6480-x); its remaining 16 % are for time, dexterity "
    "and outcome, shared equally here. A category without a known metric drops out and the others "
    "take its weight in proportion (column “applied”).</p>"
  )


def _verdict(result: Score) -> str:
  if result.proficient:
    return "<span class='good'>proficient: every metric within its limit</span>"
  over = [METRICS[k].label for k in result.limit if result.z[k] < -PROFICIENT_SD]
  missing = [METRICS[k].label for k in result.missing]
  parts = []
  if over:
    parts.append(f"over the limit: {', '.join(over)}")
  if missing:
    parts.append(f"unknown: {', '.join(missing)}")
  return f"<span class='bad'>not proficient; {_text('; '.join(parts) or 'no limits')}</span>"


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
      parts.append(f"<h2>{title}</h2><p>Nothing to draw: {_text(reasons.get(absent, ''))}.</p>")
      continue
    data = base64.b64encode(png(figure)).decode("ascii")
    parts.append(f"<h2>{title}</h2><img alt='{alt}' src='data:image/png;base64,{data}'>")
  return "\n".join(parts)


def _metric_table(
  recording: Recording,
  metrics: Metrics,
  reference: Mapping[str, Any] | None,
  result: Score | None,
) -> str:
  several = len(recording.instruments) > 1
  each = [recording.metrics(i) for i in range(len(recording.instruments))] if several else []
  head = ["metric", "value", *(_text(name) for name in recording.instruments if several)]
  head += ["unit", "better"]
  numbers = list(range(1, 2 + len(each)))
  if result is not None:
    numbers += range(len(head), len(head) + 3)
    head += ["expert mean ± SD", "limit", "z"]
  rows = []
  for group in WEIGHTS:
    names = [name for name, spec in METRICS.items() if spec.group == group]
    known = [n for n in names if math.isfinite(getattr(metrics, n))]
    missing = [n for n in names if result is not None and n in result.missing]
    if known or missing:
      rows.append(f"<tr class='group'><td colspan='{len(head)}'>{group}</td></tr>")
    for name in names:
      if name not in known and name not in missing:
        continue
      spec = METRICS[name]
      label = f"<span title='{_text(spec.source)}'>{_text(spec.label)}</span>"
      cells = [label, *(number(getattr(k, name), spec) for k in [metrics, *each])]
      cells += [_text(spec.shown), spec.better]
      if reference is not None and result is not None:
        cells += _expert_cells(name, spec, reference, result)
      rows.append(_row(cells, numbers))
  unknown = "".join(
    f"<dt>{_text(METRICS[n].label)}</dt><dd>{_text(r)}</dd>" for n, r in metrics.reasons().items()
  )
  page = f"<h2>Metrics</h2>{_table(head, rows, numbers)}"
  return page + (f"<h2>Not known</h2><dl class='small'>{unknown}</dl>" if unknown else "")


def _expert_cells(
  name: str, spec: Spec, reference: Mapping[str, Any], result: Score
) -> list[str]:
  row = reference["metrics"].get(name)
  if row is None:
    return ["–", "–", "–"]
  sd = "?" if row.get("sd") is None else number(row["sd"], spec)
  bound = "≤ " if spec.better == "lower" else "≥ "
  limit = bound + number(result.limit[name], spec) if name in result.limit else "–"
  z = result.z[name]
  if not math.isfinite(z):
    return [f"{number(row['mean'], spec)} ± {sd}", limit, "–"]
  # The sign and the word say it too, for those who do not see the colour.
  kind, word = ("bad", " over") if z < -PROFICIENT_SD else ("good", "") if z >= 0 else ("", "")
  text = f"<span class='{kind}'>{number(round(z, 2))}{word}</span>"
  return [f"{number(row['mean'], spec)} ± {sd}", limit, text]


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
    rows.append(_row(map(_text, cells), [0]))
  more = len(recording.events) - _MOST_EVENTS
  tail = f"<p class='faint'>and {more} more</p>" if more > 0 else ""
  head = ["time [s]", "event", "value", "instrument", "label"]
  return f"<h2>Events</h2>{_table(head, rows, [0])}{tail}"


def _about(recording: Recording, reference: Mapping[str, Any] | None) -> str:
  set_ = recording.settings
  lines: dict[str, Any] = dict(recording.info)
  lines |= {
    "force limit": "none" if set_.force_limit is None else f"{set_.force_limit:g} N",
    "reference path": "none"
    if set_.reference_length is None
    else f"{number(1e3 * set_.reference_length)} mm",
    "moving above": f"{1e3 * set_.movement_speed:g} mm/s for {set_.movement_debounce:g} s",
    "idle below": f"{1e3 * set_.idle_speed:g} mm/s",
    "contact above": f"{set_.contact_force:g} N",
  }
  if reference is not None:
    parts = [f"{k} {reference[k]}" for k in ("task", "n", "seed", "version") if k in reference]
    lines["expert reference"] = ", ".join(parts)
  items = "".join(f"<dt>{_text(k)}</dt><dd>{_text(v)}</dd>" for k, v in lines.items())
  return f"<h2>About</h2><dl class='small'>{items}</dl>"
