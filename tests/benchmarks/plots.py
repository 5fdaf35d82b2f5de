"""Pictures and tables that the benches share."""

from __future__ import annotations

import pathlib
from collections.abc import Sequence

from benchmarks.results import BenchError

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
    raise BenchError(
      "matplotlib is not installed: pip install 'palpate[plot]'; the rows are kept", code=1
    ) from None
  figure = Figure(figsize=(width, height), dpi=140, layout="constrained")
  axes = figure.subplots(rows, columns, squeeze=False)
  for ax in axes.ravel():
    ax.spines[["top", "right"]].set_visible(False)
    ax.tick_params(labelsize=8)
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
