"""Figures of a recording: the tip's path, the force, the speed's spectrum.

Needs matplotlib (`palpate[plot]`), which is imported when a figure is drawn and not before.
"""

import contextlib
import io
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import metrics as m
from ..recording import Recording

if TYPE_CHECKING:
  from matplotlib.figure import Figure

_TIP = ("#1b6ca8", "#2a8f6a", "#8155a3", "#b06a1f")
_MOST_MARKS = 300  # events that the force's figure shows
_BAD, _CURVE, _ORGAN, _FAINT = "#c8324b", "#222222", "#e3b5a4", "#8a8f98"


def path_figure(recording: Recording) -> "Figure | None":
  """Returns the tip's path in 3D [mm], over the surface if there is one; None without a path."""
  paths = [recording.column("tip_pos", i) for i in range(len(recording.instruments))]
  paths = [None if p is None or not np.isfinite(p).all(axis=1).any() else 1e3 * p for p in paths]
  if all(p is None for p in paths):
    return None
  figure = blank(5.2, 4.2)
  from matplotlib import rc_context

  with rc_context({"grid.color": "#dfe3e8"}):
    ax: Any = figure.add_subplot(projection="3d", computed_zorder=False)
  bounds = [p[np.isfinite(p).all(axis=1)] for p in paths if p is not None]
  surface = _surface(recording)
  if surface is not None:
    x, y, z = 1e3 * surface[0].T
    # Translucent, under the path: mplot3d cannot hide a line behind a surface.
    ax.plot_trisurf(x, y, z, triangles=surface[1], color=_ORGAN, alpha=0.55, linewidth=0, zorder=1)
    bounds.append(1e3 * surface[0])
  if "curve" in recording.constants:
    curve = 1e3 * recording.constants["curve"]
    # Over the path: a well traced curve would be hidden under it.
    ax.plot(*curve.T, color=_CURVE, linestyle="--", linewidth=1.2, label="curve to trace", zorder=5)
    bounds.append(curve)
  last = max(i for i, path in enumerate(paths) if path is not None)
  starred = False  # the legend names the stars once
  for i, path in enumerate(paths):
    if path is not None:
      starred |= _draw_tip(ax, recording, i, path, last=i == last, starred=starred)
  _frame(ax, np.concatenate(bounds))
  figure.legend(loc="outside right upper", fontsize=9, frameon=False)
  return figure


def _draw_tip(
  ax: Any, recording: Recording, i: int, path: np.ndarray, last: bool, starred: bool
) -> bool:
  """Draws one tip's path [mm] (nstep, 3); returns whether it touched a target."""
  several = len(recording.instruments) > 1
  name, color = _label(recording.instruments[i]), _TIP[i % len(_TIP)]
  ax.plot(*path.T, color=color, linewidth=1.3, zorder=3, label=name if several else "tip")
  touch = recording.touching(i)
  if touch is not None and touch.any():
    held = np.where(touch[:, None], path, np.nan)
    label = f"{name} in contact" if several else "in contact"
    ax.plot(*held.T, color=color if several else _BAD, linewidth=2.2, zorder=4, label=label)
  ends = path[np.isfinite(path).all(axis=1)][[0, -1]]
  for k, (marker, word) in enumerate((("o", "start"), ("s", "end"))):
    ax.plot(
      *ends[k : k + 1].T, marker, color=color, markersize=7, markeredgecolor="white", zorder=6,
      label=word if last else None,
    )  # fmt: skip
  reached = [e.time for e in recording.events if e.kind == "target" and e.instrument == i]
  if reached:
    at = np.stack([np.interp(reached, recording.time, c) for c in path.T])
    ax.plot(
      *at, "*", color="#f2b705", markeredgecolor="#5c4700", markersize=9, zorder=7,
      label="" if starred else "target touched",
    )  # fmt: skip
  return bool(reached)


def _frame(ax: Any, points: np.ndarray) -> None:
  """Puts equal axes around all points [mm]  (n, 3)."""
  low, high = points.min(axis=0), points.max(axis=0)
  # A flat path must not flatten the box: ticks would run into each other.
  half = np.maximum((high - low) / 2, 0.2 * (high - low).max() + 1e-3)
  middle = (low + high) / 2
  for axis, c, h in zip("xyz", middle, half, strict=True):
    getattr(ax, f"set_{axis}lim")(c - h, c + h)
    getattr(ax, f"set_{axis}label")(f"{axis} [mm]", labelpad=6)
    getattr(ax, f"{axis}axis").set_pane_color((0.97, 0.97, 0.98, 1.0))
    ax.locator_params(axis=axis, nbins=5 if h > 0.5 * half.max() else 2)
  # A tall box would leave the figure.
  ax.set_box_aspect(half, zoom=min(1.0, 0.66 * float(np.linalg.norm(half) / half[2])))
  ax.view_init(elev=28, azim=-55)


def force_figure(recording: Recording) -> "Figure | None":
  """Returns the contact forces over time with their limit; None where none was recorded."""
  lines = list(_force_lines(recording))
  if not lines or len(recording.time) == 0:
    return None
  figure = blank(9, 3.4)
  ax = figure.add_subplot()
  time = recording.signal_time - recording.time[0]
  limit = recording.settings.force_limit
  top = max(np.nanmax(force) for _, force, _ in lines)
  shaded = False  # the legend names it once
  for name, force, style in lines:
    ax.plot(time, force, linewidth=1.3, label=name, **style)
    over = np.nan_to_num(force) > (np.inf if limit is None else limit)
    if limit is not None and over.any():
      ax.fill_between(
        time, limit, force, where=over.tolist(), interpolate=True, color=_BAD, alpha=0.35,
        linewidth=0, label=None if shaded else "over the limit",
      )  # fmt: skip
      shaded = True
  if limit is not None:
    ax.axhline(limit, color=_BAD, linestyle="--", linewidth=1.2, label=f"limit {limit:g} N")
    top = max(top, limit)
  top = 1.25 * top if top > 0 else 1.0
  _mark_events(ax, recording, top, time[-1])
  ax.set_ylim(0, top)
  ax.set_xlim(0, max(time[-1], 1e-9))
  ax.set_xlabel("time [s]")
  ax.set_ylabel("force [N]")
  tidy(ax)
  legend_above(ax)
  return figure


def _force_lines(recording: Recording) -> Iterator[tuple[str, np.ndarray, dict[str, Any]]]:
  """Yields label, force at `signal_time` [N] and style of what is there to draw."""
  several = len(recording.instruments) > 1
  for i, instrument in enumerate(recording.instruments):
    color, name = _TIP[i % len(_TIP)], f"{_label(instrument)}: " if several else ""
    force, grip = recording.force(i), recording.signal("grip_force", i)
    shaft = recording.signal("shaft_force", i)
    if force is not None:
      text = "press or pull" if grip is not None else "contact force"
      only = several and grip is None  # then the instrument's name says it
      yield (_label(instrument) if only else name + text), force, {"color": color}
    if grip is not None:
      yield f"{name}grip", np.abs(grip), {"color": color, "alpha": 0.45}
    if shaft is not None and np.nanmax(np.abs(shaft)) > recording.settings.contact_force:
      yield f"{name}shaft", np.abs(shaft), {"color": _BAD, "linestyle": ":"}


def _mark_events(ax: Any, recording: Recording, top: float, end: float) -> None:
  """Draws a line at each event, from 0 to `top`, and its words while there is room for them."""
  marks: dict[float, list[str]] = {}  # events of one moment share a line
  for event in recording.events:
    marks.setdefault(event.time - recording.time[0], []).append(event.label or event.kind)
  if len(marks) <= _MOST_MARKS:  # more would be a grey wall, drawn for minutes
    ax.vlines(list(marks), 0, top, color=_FAINT, linewidth=0.8, linestyle=":")
  if len(marks) <= 12:
    for at, words in marks.items():
      late = at > 0.96 * end  # its words would leave the plot
      ax.annotate(
        ", ".join(_label(word) for word in words), (at, top), xytext=(-3 if late else 3, -3),
        textcoords="offset points", fontsize=8, color="#5d6472", rotation=90, va="top",
        ha="right" if late else "left",
      )  # fmt: skip


def compared_figure(recordings: Sequence[tuple[str, Recording]]) -> "Figure | None":
  """Returns force and speed of several recordings over time; None where neither is known."""
  figure = blank(9, 5)
  axes: Any = figure.subplots(2, 1, sharex=True)
  for k, (name, recording) in enumerate(recordings):
    style = {"color": _TIP[k % len(_TIP)], "linewidth": 1.2, "alpha": 0.85, "label": _label(name)}
    if len(recording.time) < 2:
      continue
    start = recording.time[0]
    if (force := recording.force()) is not None:
      axes[0].plot(recording.signal_time - start, force, **style)
    with contextlib.suppress(m.UnknownError):  # positions are missing
      if (pos := recording.tip_path()) is not None:
        middle = (recording.time[1:] + recording.time[:-1]) / 2 - start
        axes[1].plot(middle, 1e3 * m.speed(recording.time, pos), **style)
  if not any(ax.lines for ax in axes):
    return None
  limits = {r.settings.force_limit for _, r in recordings}
  for limit in sorted(limit for limit in limits if limit is not None):
    axes[0].axhline(limit, color=_BAD, linestyle="--", linewidth=1, label=f"limit {limit:g} N")
  for ax, label in zip(axes, ("force [N]", "speed [mm/s]"), strict=True):
    ax.set_ylabel(label)
    ax.set_ylim(bottom=0)
    tidy(ax)
  axes[1].set_xlim(left=0)
  axes[1].set_xlabel("time [s]")
  legend_above(axes[0] if axes[0].lines else axes[1])
  return figure


def spectrum_figure(recording: Recording) -> "Figure | None":
  """Returns the speed spectrum with the cut-offs of SPARC; None where no tip moved."""
  spectra = []
  for i in range(len(recording.instruments)):
    try:
      pos = recording.tip_path(i)
      if pos is not None:
        values, rate = m.uniform_speed(recording.time, pos)
        spectra.append((i, m.sparc(values, rate), *m.speed_spectrum(values, rate)))
    except m.UnknownError:
      continue
  if not spectra:
    return None
  figure = blank(9, 3.4)
  ax = figure.add_subplot()
  for i, value, freq, amplitude, cut in spectra:
    color = _TIP[i % len(_TIP)]
    name = f"{_label(recording.instruments[i])}: " if len(recording.instruments) > 1 else ""
    ax.plot(freq, amplitude, color=color, linewidth=0.9, alpha=0.5)
    label = f"{name}SPARC {m.number(round(value, 2))}"
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
  tidy(ax)
  legend_above(ax)
  return figure


def png(figure: "Figure") -> bytes:
  """Returns a figure as PNG."""
  buffer = io.BytesIO()
  figure.savefig(buffer, format="png", dpi=120, facecolor="white")
  return buffer.getvalue()


def jpeg(picture: np.ndarray) -> bytes:
  """Returns a picture (height, width, 3), uint8, as JPEG."""
  from PIL import Image  # which matplotlib needs too

  buffer = io.BytesIO()
  Image.fromarray(picture).save(buffer, format="JPEG", quality=85)
  return buffer.getvalue()


def blank(width: float, height: float) -> "Figure":
  """Returns an empty figure, inches."""
  try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
  except ImportError as error:
    raise ImportError("the report draws with matplotlib: pip install 'palpate[plot]'") from error
  # No pyplot: its global state and the caller's backend stay as they are.
  figure = Figure((width, height), layout="constrained")
  FigureCanvasAgg(figure)
  return figure


def tidy(ax: Any) -> None:
  """Takes away what distracts."""
  ax.spines[["top", "right"]].set_visible(False)
  ax.grid(color="#e4e7ec", linewidth=0.7)
  ax.set_axisbelow(True)


def legend_above(ax: Any) -> None:
  """Puts the legend outside."""
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
