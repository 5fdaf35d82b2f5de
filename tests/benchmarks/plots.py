"""Pictures and tables that the benches share."""

from __future__ import annotations

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


def grid(rows: int, columns: int, width: float, height: float):
  """Returns a figure and its axes, (rows, columns) or (columns,)."""
  try:
    from matplotlib.figure import Figure
  except ImportError:
    raise CommandError(
      "matplotlib is not installed: pip install 'palpate[plot]'; the rows are kept", code=1
    ) from None
  figure = Figure(figsize=(width, height), dpi=140, layout="constrained")
  axes = figure.subplots(rows, columns, squeeze=False)
  for ax in axes.ravel():
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=9)
  return figure, axes[0] if rows == 1 else axes


def plain(axis, least: float = 3):
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
  columns = max(1, len(panels))
  figure, axes = grid(1, columns, 3.6 * columns + 2.0, 3.6)
  for ax, (name, lines) in zip(axes, panels.items(), strict=False):
    for label, (x, y) in lines.items():
      ax.plot(x, y, "o-", ms=4, label=label)
    ax.set_title(name, loc="left", fontsize=9)
    ax.set(xlabel=xlabel)
    if lines:
      ax.set(xscale="log", yscale="log")
      plain(ax.xaxis)
      plain(ax.yaxis)
      ax.legend(frameon=False, fontsize=7)
  axes[0].set_ylabel(ylabel)
  return save(figure, path, title)


def bars(
  path: pathlib.Path, title: str, names: Sequence[str], groups: dict[str, Sequence], xlabel: str
) -> pathlib.Path:
  """Draws horizontal bars and returns the path: a line a name, a colour a group."""
  figure, (ax,) = grid(1, 1, 7.6, 0.14 * len(names) * (len(groups) + 0.6) + 1.4)
  width = 0.8 / max(1, len(groups))
  for k, (label, values) in enumerate(groups.items()):
    at = [i + width * (k - (len(groups) - 1) / 2) for i in range(len(names))]
    ax.barh(at, values, 0.9 * width, label=label)
  ax.set_yticks(range(len(names)), names)
  ax.invert_yaxis()
  ax.axvline(0, color=INK, lw=0.8)
  ax.set_xlabel(xlabel)
  if len(groups) > 1:
    ax.legend(frameon=False, fontsize=8)
  return save(figure, path, title)


def save(figure, path: pathlib.Path, title: str) -> pathlib.Path:
  """Writes a figure and returns its path."""
  figure.suptitle(title, fontsize=10, color=INK, x=0.01, ha="left")
  figure.savefig(path)
  return path


def table(head: Sequence[str], rows: Sequence[Sequence]) -> list[str]:
  """Returns a Markdown table, numbers with three digits."""
  lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
  for row in rows:
    words = [f"{v:.3g}" if isinstance(v, float) else str(v) for v in row]
    lines.append("| " + " | ".join(words) + " |")
  return lines
