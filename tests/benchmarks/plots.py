"""Pictures and tables that the benches share."""

from __future__ import annotations

import itertools
import math
import pathlib
from collections.abc import Sequence

from palpate.app.console import CommandError

INK = "#333333"
# One colour and marker a scheme, the same in every figure.
STYLES = {
  "implicit": ("#08519c", "o", "-"),
  "implicit, window": ("#6baed6", "o", "--"),
  "midpoint": ("#000000", "s", "-"),
  "midpoint, window": ("#969696", "s", "--"),
  "neumann": ("#9467bd", "^", "--"),
  "explicit": ("#2ca02c", "v", "--"),
  "native": ("#c1442e", "D", "-"),
  "native, right weights": ("#f4a582", "D", "--"),
  "native, Newton": ("#8c564b", "P", "-"),
}
# Of curves and bars: the colour-blind tell them apart too (Okabe and Ito 2008).
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
MARKS = "osD^vPX"
WIDE = 1280  # of a figure, at least [pixels]
MANY = 16  # names of bars that stand in one column


def grid(rows: int, columns: int, width: float, height: float):
  """Returns a figure and its axes, (rows, columns) or (columns,)."""
  try:
    from matplotlib.figure import Figure
  except ImportError:
    raise CommandError(
      "matplotlib is not installed: pip install 'palpate[plot]'; the rows are kept", code=1
    ) from None
  dpi = max(140, math.ceil(WIDE / width))
  figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
  axes = figure.subplots(rows, columns, squeeze=False)
  for ax in axes.ravel():
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=9)
    ax.set_prop_cycle(color=COLOURS)
  return figure, axes[0] if rows == 1 else axes


def plain(axis, least: float = 2.3):
  """Labels a logarithmic axis with plain numbers: 1, 2, 5, or decades if it spans more."""
  from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

  low, high = axis.get_view_interval()
  few = high / low < 10**least
  axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few else (1.0,)))
  axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
  axis.set_minor_formatter(NullFormatter())


def cell(at: tuple[int, int], colour: str):
  """Returns a square of a map, centred at integer coordinates."""
  from matplotlib.patches import Rectangle

  return Rectangle((at[0] - 0.48, at[1] - 0.48), 0.96, 0.96, color=colour, lw=0)


def curves(
  path: pathlib.Path,
  title: str,
  panels: dict[str, dict[str, tuple[Sequence, Sequence]]],
  xlabel: str,
  ylabel: str,
) -> pathlib.Path:
  """Draws lines on logarithmic axes and returns the path: panel by panel, line by line (x, y)."""
  columns = min(max(1, len(panels)), 2)
  rows = -(-max(1, len(panels)) // columns)
  figure, axes = grid(rows, columns, 4.6 * columns + 1.0, 3.8 * rows)
  for ax, (name, lines) in itertools.zip_longest(axes.ravel(), panels.items(), fillvalue=("", {})):
    ax.set_visible(bool(name) or len(panels) < 2)
    for k, (label, (x, y)) in enumerate(lines.items()):
      colour, mark = COLOURS[k % len(COLOURS)], MARKS[k % len(MARKS)]
      ax.plot(x, y, "-", marker=mark, ms=5, color=colour, label=label)
    ax.set_title(name, loc="left", fontsize=11)
    ax.set(xlabel=xlabel)
    if lines:
      ax.set(xscale="log", yscale="log")
      plain(ax.xaxis)
      plain(ax.yaxis)
      ax.legend(frameon=False, fontsize=9)
  for row in axes if rows > 1 else [axes]:
    row[0].set_ylabel(ylabel)
  return save(figure, path, title)


def bars(
  path: pathlib.Path, title: str, names: Sequence[str], groups: dict[str, Sequence], xlabel: str
) -> pathlib.Path:
  """Draws horizontal bars and returns the path: a line a name, a colour a group."""
  columns = 2 if len(names) > MANY else 1
  tall = -(-len(names) // columns)
  height = 0.16 * tall * (len(groups) + 0.6) + 1.4
  figure, axes = grid(1, columns, 9.2 if columns > 1 else 7.6, height)
  width = 0.8 / max(1, len(groups))
  for c, ax in enumerate(axes):
    mine = slice(c * tall, (c + 1) * tall)
    for k, (label, values) in enumerate(groups.items()):
      at = [i + width * (k - (len(groups) - 1) / 2) for i in range(len(names[mine]))]
      colour = COLOURS[k % len(COLOURS)]
      ax.barh(at, values[mine], 0.9 * width, color=colour, label=label)
    ax.set_yticks(range(len(names[mine])), names[mine])
    ax.set_ylim(tall - 0.4, -0.6)
    ax.axvline(0, color=INK, lw=0.8)
    ax.set_xlabel(xlabel)
  low, high = min(ax.get_xlim()[0] for ax in axes), max(ax.get_xlim()[1] for ax in axes)
  for ax in axes:
    ax.set_xlim(low, high)
  if len(groups) > 1:
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
  return save(figure, path, title)


def save(figure, path: pathlib.Path, title: str) -> pathlib.Path:
  """Writes a figure and returns its path."""
  figure.suptitle(title, fontsize=11, color=INK, x=0.01, ha="left")
  figure.savefig(path)
  return path


def table(head: Sequence[str], rows: Sequence[Sequence]) -> list[str]:
  """Returns a Markdown table, numbers with three digits."""
  lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
  for row in rows:
    words = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in row]
    lines.append("| " + " | ".join(words) + " |")
  return lines
