"""Writes one self-contained HTML page about a recording, for people: mm, degrees, words.

Needs matplotlib (`palpate[plot]`), which is imported when a page is written and not before.
"""

import base64
import html
import io
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from . import metrics as m
from .recording import Recording
from .score import METRICS, PROFICIENT_SD, WEIGHTS, Metrics, Score, Spec, score

if TYPE_CHECKING:
  from matplotlib.figure import Figure

_TIP = ("#1b6ca8", "#2a8f6a", "#8155a3", "#b06a1f")
_BAD, _CURVE, _ORGAN, _FAINT = "#c8324b", "#222222", "#e3b5a4", "#8a8f98"
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
  part = path.with_name(f".{path.name}.{os.getpid()}.part")
  try:
    part.write_text(page, encoding="utf-8")
    os.replace(part, path)
  finally:
    part.unlink(missing_ok=True)
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


# Plots.


def path_figure(recording: Recording) -> "Figure | None":
  """Returns the tip's path in 3D [mm], over the surface if there is one; None without a path."""
  paths = [recording.column("tip_pos", i) for i in range(len(recording.instruments))]
  paths = [None if p is None or not np.isfinite(p).all(axis=1).any() else 1e3 * p for p in paths]
  if all(p is None for p in paths):
    return None
  figure = _figure(7.5, 6.2)
  from matplotlib import rc_context

  with rc_context({"grid.color": "#dfe3e8"}):
    ax: Any = figure.add_subplot(projection="3d", computed_zorder=False)
  bounds = [p[np.isfinite(p).all(axis=1)] for p in paths if p is not None]
  surface = _surface(recording)
  if surface is not None:
    x, y, z = 1e3 * surface[0].T
    # Translucent, under the path: mplot3d cannot hide a line behind a surface.
    ax.plot_trisurf(
      x, y, z, triangles=surface[1], color=_ORGAN, alpha=0.55, linewidth=0, zorder=1
    )
    bounds.append(1e3 * surface[0])
  if "curve" in recording.constants:
    curve = 1e3 * recording.constants["curve"]
    # Over the path: a well traced curve would be hidden under it.
    ax.plot(*curve.T, color=_CURVE, linestyle="--", linewidth=1.2, label="curve to trace", zorder=5)
    bounds.append(curve)
  several, starred = len(paths) > 1, False
  last = max(i for i, path in enumerate(paths) if path is not None)
  for i, path in enumerate(paths):
    if path is None:
      continue
    name, color = _label(recording.instruments[i]), _TIP[i % len(_TIP)]
    ax.plot(*path.T, color=color, linewidth=1.3, zorder=3, label=name if several else "tip")
    touch = _touching(recording, i)
    if touch.any():
      held = np.where(touch[:, None], path, np.nan)
      label = f"{name} in contact" if several else "in contact"
      ax.plot(*held.T, color=color if several else _BAD, linewidth=2.2, zorder=4, label=label)
    ends = path[np.isfinite(path).all(axis=1)][[0, -1]]
    for k, (marker, word) in enumerate((("o", "start"), ("s", "end"))):
      ax.plot(
        *ends[k : k + 1].T, marker, color=color, markersize=7, markeredgecolor="white", zorder=6,
        label=word if i == last else None,
      )  # fmt: skip
    reached = [e.time for e in recording.events if e.kind == "target" and e.instrument == i]
    if reached:
      at = np.stack([np.interp(reached, recording.time, c) for c in path.T])
      ax.plot(
        *at, "*", color="#f2b705", markeredgecolor="#5c4700", markersize=9, zorder=7,
        label="" if starred else "target touched",
      )  # fmt: skip
      starred = True
  every = np.concatenate(bounds)
  low, high = every.min(axis=0), every.max(axis=0)
  # A flat path must not flatten the box: ticks would run into each other.
  half = np.maximum((high - low) / 2, 0.2 * (high - low).max() + 1e-3)
  middle = (low + high) / 2
  for axis, c, h in zip("xyz", middle, half, strict=True):
    getattr(ax, f"set_{axis}lim")(c - h, c + h)
    getattr(ax, f"set_{axis}label")(f"{axis} [mm]", labelpad=6)
    getattr(ax, f"{axis}axis").set_pane_color((0.97, 0.97, 0.98, 1.0))
  ax.locator_params(nbins=5)
  # A tall box would leave the figure.
  ax.set_box_aspect(half, zoom=min(1.0, 0.72 * float(np.linalg.norm(half) / half[2])))
  ax.view_init(elev=28, azim=-55)
  figure.legend(loc="outside right upper", fontsize=9, frameon=False)
  return figure


def force_figure(recording: Recording) -> "Figure | None":
  """Returns the contact force over time with its limit; None where no force was recorded."""
  forces = [recording.force(i) for i in range(len(recording.instruments))]
  if all(f is None for f in forces) or len(recording.time) == 0:
    return None
  figure = _figure(9, 3.4)
  ax = figure.add_subplot()
  time = recording.time - recording.time[0]
  limit = recording.settings.force_limit
  top = max((np.nanmax(f) for f in forces if f is not None), default=0.0)
  for i, force in enumerate(forces):
    if force is None:
      continue
    color = _TIP[i % len(_TIP)]
    name = _label(recording.instruments[i]) if len(forces) > 1 else "contact force"
    ax.plot(time, force, color=color, linewidth=1.3, label=name)
    if limit is not None:
      over = np.nan_to_num(force) > limit
      ax.fill_between(
        time, limit, force, where=over.tolist(), interpolate=True, color=_BAD, alpha=0.35,
        linewidth=0, label="over the limit" if i == 0 and over.any() else None,
      )  # fmt: skip
  if limit is not None:
    ax.axhline(limit, color=_BAD, linestyle="--", linewidth=1.2, label=f"limit {limit:g} N")
    top = max(top, limit)
  top = 1.25 * top if top > 0 else 1.0
  marks: dict[float, list[str]] = {}  # events of one moment share a line
  for event in recording.events:
    marks.setdefault(event.time - recording.time[0], []).append(event.label or event.kind)
  for at, words in marks.items():
    ax.axvline(at, color=_FAINT, linewidth=0.8, linestyle=":")
    if len(marks) <= 12:
      late = at > 0.96 * time[-1]  # its words would leave the plot
      ax.annotate(
        ", ".join(_label(word) for word in words), (at, top), xytext=(-3 if late else 3, -3),
        textcoords="offset points", fontsize=8, color="#5d6472", rotation=90, va="top",
        ha="right" if late else "left",
      )  # fmt: skip
  ax.set_ylim(0, top)
  ax.set_xlim(0, max(time[-1], 1e-9))
  ax.set_xlabel("time [s]")
  ax.set_ylabel("force [N]")
  _tidy(ax)
  _legend_above(ax)
  return figure


def spectrum_figure(recording: Recording) -> "Figure | None":
  """Returns the speed spectrum with the cut-offs of SPARC; None where no tip moved."""
  spectra = []
  for i in range(len(recording.instruments)):
    pos = recording.column("tip_pos", i)
    try:
      if pos is not None:
        values, rate = m.uniform_speed(recording.time, pos)
        spectra.append((i, m.sparc(values, rate), *m.speed_spectrum(values, rate)))
    except m.UnknownError:
      continue
  if not spectra:
    return None
  figure = _figure(9, 3.4)
  ax = figure.add_subplot()
  for i, value, freq, amplitude, cut in spectra:
    color = _TIP[i % len(_TIP)]
    name = f"{_label(recording.instruments[i])}: " if len(recording.instruments) > 1 else ""
    ax.plot(freq, amplitude, color=color, linewidth=0.9, alpha=0.5)
    label = f"{name}SPARC {_number(round(value, 2))}"
    ax.plot(freq[:cut], amplitude[:cut], color=color, linewidth=2, label=label)
    ax.plot(freq[cut - 1], amplitude[cut - 1], "o", color=color, markersize=5)
  ax.axvline(
    m.SPARC_CUTOFF, color=_CURVE, linestyle="--", linewidth=1, label=f"{m.SPARC_CUTOFF:g} Hz"
  )
  ax.axhline(
    m.SPARC_AMPLITUDE, color=_CURVE, linestyle=":", linewidth=1,
    label=f"amplitude {m.SPARC_AMPLITUDE:g}",
  )  # fmt: skip
  ax.set_xlim(0, min(1.2 * m.SPARC_CUTOFF, max(s[2][-1] for s in spectra)))
  # Logarithmic: what decides the cut-off is 20 times lower than the peak at 0 Hz.
  ax.set_yscale("log")
  ax.set_ylim(5e-3, 1.2)
  ax.set_yticks([0.01, 0.05, 0.1, 0.5, 1], ["0.01", "0.05", "0.1", "0.5", "1"], minor=False)
  ax.set_xlabel("frequency [Hz]")
  ax.set_ylabel("normalised speed amplitude")
  _tidy(ax)
  _legend_above(ax)
  return figure


def png(figure: "Figure") -> bytes:
  """Returns a figure as PNG."""
  buffer = io.BytesIO()
  figure.savefig(buffer, format="png", dpi=120, facecolor="white")
  return buffer.getvalue()


def _figure(width: float, height: float) -> "Figure":
  try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
  except ImportError as error:
    raise ImportError("the report draws with matplotlib: pip install 'palpate[plot]'") from error
  # No pyplot: its global state and the caller's backend stay as they are.
  figure = Figure((width, height), layout="constrained")
  FigureCanvasAgg(figure)
  return figure


def _tidy(ax: Any) -> None:
  ax.spines[["top", "right"]].set_visible(False)
  ax.grid(color="#e4e7ec", linewidth=0.7)
  ax.set_axisbelow(True)


def _legend_above(ax: Any) -> None:
  # Above the plot, where it can hide neither a peak nor an event.
  ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=6, fontsize=9, frameon=False)


def _label(text: str) -> str:
  """Returns the caller's text for a plot: short, and never read as a formula."""
  text = " ".join(text.split())
  text = text if len(text) <= 24 else text[:23] + "…"
  # A label with a leading underscore would drop out of the legend.
  return text.replace("\\", "/").replace("$", r"\$").lstrip("_") or "-"


def _surface(recording: Recording) -> tuple[np.ndarray, np.ndarray] | None:
  vertices, triangles = (recording.constants.get(k) for k in ("vertices", "triangles"))
  if vertices is None or triangles is None or not len(triangles):
    return None
  if triangles.dtype.kind not in "iu" or triangles.min() < 0 or triangles.max() >= len(vertices):
    raise ValueError(f"triangles must be indices of the {len(vertices)} vertices")
  return vertices, triangles


def _touching(recording: Recording, instrument: int) -> np.ndarray:
  force = recording.force(instrument)
  if force is None:
    return np.zeros(len(recording.time), bool)
  return np.nan_to_num(force) > recording.settings.contact_force


# The page.


def _text(value: Any) -> str:
  return html.escape(str(value), quote=True)


def _number(value: float, spec: Spec | None = None) -> str:
  value = value * (spec.scale if spec else 1.0)
  if math.isnan(value):
    return "–"
  if spec and spec.unit == "count" and value == round(value):
    text = f"{value:.0f}"
  else:
    text = f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
  return text.replace("-", "−")


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
    f"{_number(length)} s, {count} samples at {_number((count - 1) / length)} Hz, "
    f"{', '.join(recording.instruments)}"
  )


def _score_part(result: Score | None, reference: Mapping[str, Any] | None) -> str:
  if result is None or reference is None:
    return "<h2>Score</h2><p>No expert reference was given, so there is no score.</p>"
  if math.isnan(result.composite):
    reason = result.composite.reason if isinstance(result.composite, m.Unknown) else ""
    head = f"<p><b>No composite score</b>: {_text(reason)}.</p>"
  else:
    value = _number(round(result.composite, 2))
    head = f"<div class='score'><b>{value}</b>{_verdict(result)}</div>"
  rows = []
  for name, weight in WEIGHTS.items():
    value, applied = result.group[name], result.weight[name]
    known = math.isfinite(value)
    cells = [name, f"{100 * weight:.3g} %", f"{100 * applied:.3g} %", _number(round(value, 2))]
    rows.append(_row([*cells, _number(round(applied * value, 2)) if known else "–"], range(1, 5)))
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
      cells = [label, *(_number(getattr(k, name), spec) for k in [metrics, *each])]
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
  sd = "?" if row.get("sd") is None else _number(row["sd"], spec)
  bound = "≤ " if spec.better == "lower" else "≥ "
  limit = bound + _number(result.limit[name], spec) if name in result.limit else "–"
  z = result.z[name]
  if not math.isfinite(z):
    return [f"{_number(row['mean'], spec)} ± {sd}", limit, "–"]
  # The sign and the word say it too, for those who do not see the colour.
  kind, word = ("bad", " over") if z < -PROFICIENT_SD else ("good", "") if z >= 0 else ("", "")
  text = f"<span class='{kind}'>{_number(round(z, 2))}{word}</span>"
  return [f"{_number(row['mean'], spec)} ± {sd}", limit, text]


def _event_table(recording: Recording) -> str:
  if not recording.events:
    return ""
  start = float(recording.time[0]) if len(recording.time) else 0.0
  rows = []
  for event in recording.events[:_MOST_EVENTS]:
    distance = ""
    if event.value is not None:
      length = event.kind in ("target", "miss")
      distance = f"{_number(1e3 * event.value)} mm" if length else f"{event.value:g}"
    cells = [_number(event.time - start), event.kind, distance]
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
    else f"{_number(1e3 * set_.reference_length)} mm",
    "moving above": f"{1e3 * set_.movement_speed:g} mm/s for {set_.movement_debounce:g} s",
    "idle below": f"{1e3 * set_.idle_speed:g} mm/s",
    "contact above": f"{set_.contact_force:g} N",
  }
  if reference is not None:
    parts = [f"{k} {reference[k]}" for k in ("task", "n", "seed", "version") if k in reference]
    lines["expert reference"] = ", ".join(parts)
  items = "".join(f"<dt>{_text(k)}</dt><dd>{_text(v)}</dd>" for k, v in lines.items())
  return f"<h2>About</h2><dl class='small'>{items}</dl>"
