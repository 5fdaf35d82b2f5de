"""Figures of a learner's attempts at one exercise: score, metrics and CUSUM over attempts.

Needs matplotlib (`palpate[plot]`), as `plots`.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ..metrics import METRICS, SUCCESS, Metrics, check_names, number
from . import cusum
from .plots import blank, legend_above, tidy
from .score import FLOOR, tells

if TYPE_CHECKING:
  from matplotlib.figure import Figure

SHOWN = ("time", "path_length", "peak_force")  # metrics, unless others are chosen
_GOOD, _PLAIN, _BAD, _FAINT = "#1c7a4d", "#1b6ca8", "#b3213b", "#8a8f98"
_MEAN = 5  # attempts in a moving mean


@dataclasses.dataclass(frozen=True)
class Attempt:
  """An attempt at an exercise.

  Attributes:
    outcome: `success` or what came in between
    score: see `score.Score`; None where it is unknown
    proficient: whether it was
    assessment: whether it was done without the coach
    metrics: see `metrics.Metrics`
  """

  outcome: str
  score: float | None
  proficient: bool
  assessment: bool
  metrics: Metrics


def learning_figure(
  attempts: Sequence[Attempt],
  reference: Mapping[str, Any] | None = None,
  names: Sequence[str] = SHOWN,
) -> "Figure":
  """Returns score, metrics and CUSUM over attempts, one above the other.

  Args:
    attempts: at one exercise, in order
    reference: whose limits are drawn, see `score.make_reference`
    names: of the metrics
  """
  check_names(names)
  count = 2 + len(names)
  figure = blank(9, 0.6 + 2.15 * count)
  axes: Any = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
  _draw_score(axes[0], attempts)
  for ax, name in zip(axes[1:], names, strict=False):
    _draw_metric(ax, attempts, name, reference)
  _draw_cusum(axes[-1], [a.proficient for a in attempts])
  axes[-1].set_xlabel("attempt")
  axes[-1].set_xlim(0.4, max(len(attempts), 2) + 0.6)
  axes[-1].xaxis.get_major_locator().set_params(integer=True)
  for ax in axes:
    tidy(ax)
  figure.align_ylabels()
  return figure


def _draw_score(ax: Any, attempts: Sequence[Attempt]) -> None:
  values = np.array([
    a.score if a.outcome == SUCCESS and a.score is not None else math.nan for a in attempts
  ])  # fmt: skip
  known = values[np.isfinite(values)]
  low, high = known.min(initial=-1.0), known.max(initial=1.0)
  margin = 0.1 * (high - low)
  ax.axhline(0, color=_FAINT, linewidth=1, linestyle="--", label="skilled people")
  _draw_values(ax, attempts, values)
  failed = [k + 1 for k, a in enumerate(attempts) if a.outcome != SUCCESS]
  if failed:
    low -= 2 * margin  # below every success, as their score is
    label = f"failed, {number(FLOOR)}"
    ax.plot(failed, [low] * len(failed), "x", color=_BAD, markersize=6, label=label)
  ax.set_ylim(low - margin, high + margin)
  ax.set_ylabel("score [-]")
  legend_above(ax)


def _draw_values(ax: Any, attempts: Sequence[Attempt], values: np.ndarray) -> None:
  """Draws a value of each attempt, and the mean of the last ones."""
  ax.plot(np.arange(1, len(values) + 1), _moving_mean(values), color=_PLAIN, linewidth=1.4,
          label=f"mean of {_MEAN}")  # fmt: skip
  for proficient, marker, color in ((True, "o", _GOOD), (False, "D", _PLAIN)):
    label = "proficient" if proficient else "not proficient"
    for alone in (True, False):
      at = [k for k, a in enumerate(attempts) if np.isfinite(values[k])]
      at = [k for k in at if attempts[k].proficient == proficient]
      at = [k for k in at if attempts[k].assessment == alone]
      face = color if alone else "white"
      ax.plot([k + 1 for k in at], values[at], marker, color=color, markersize=5,
              markerfacecolor=face, label=label if alone else None)  # fmt: skip
  if not all(a.assessment for a in attempts):
    ax.plot([], [], "o", color=_FAINT, markersize=5, markerfacecolor="white", label="with coach")


def _moving_mean(values: np.ndarray) -> np.ndarray:
  """Returns the mean of the known ones of the last values, NaN where there are none  (n,)."""
  last = [values[max(0, k + 1 - _MEAN) : k + 1] for k in range(len(values))]
  known = [window[np.isfinite(window)] for window in last]
  return np.array([window.mean() if len(window) else math.nan for window in known])


def _draw_metric(
  ax: Any, attempts: Sequence[Attempt], name: str, reference: Mapping[str, Any] | None
) -> None:
  spec = METRICS[name]
  values = np.array([
    spec.scale * getattr(a.metrics, name) if tells(spec, a.outcome) else math.nan for a in attempts
  ])  # fmt: skip
  row = reference["metrics"].get(name) if reference else None
  if row is not None:
    ax.axhline(
      spec.scale * row["limit"], color=_BAD, linestyle="--", linewidth=1.1,
      label=f"limit, {spec.better} is better",
    )  # fmt: skip
  ax.plot(np.arange(1, len(values) + 1), _moving_mean(values), color=_PLAIN, linewidth=1.4)
  for good, marker, color in ((True, "o", _PLAIN), (False, "x", _BAD)):
    at = [k for k, a in enumerate(attempts) if (a.outcome == SUCCESS) == good]
    ax.plot([k + 1 for k in at], values[at], marker, color=color, markersize=4, linestyle="none")
  unit = "" if spec.shown in ("-", "count") else f" [{spec.shown}]"
  ax.set_ylabel(f"{spec.label}{unit}")
  if row is not None:
    legend_above(ax)


def _draw_cusum(ax: Any, passed: Sequence[bool]) -> None:
  points = cusum.chart(passed)
  limit, start = cusum.LIMIT, 0
  ax.axhline(limit, color=_GOOD, linestyle="--", linewidth=1.1, label=f"competent at {limit:g}")
  ax.axhline(-limit, color=_BAD, linestyle="--", linewidth=1.1, label=f"lost at −{limit:g}")
  ax.axhline(0, color=_FAINT, linewidth=0.8)
  # A piece of the line for each phase: the sum begins anew at 0 where it has crossed.
  for k, point in enumerate(points):
    if point.changed or k == len(points) - 1:
      competent = point.competent ^ point.changed  # until here
      values = [0.0, *(p.value for p in points[start : k + 1])]
      color = _GOOD if competent else _PLAIN
      ax.plot(range(start, k + 2), values, color=color, linewidth=1.6, marker=".", markersize=5)
      if point.changed:
        word, color, side = ("competent", _GOOD, 1) if point.competent else ("lost", _BAD, -1)
        ax.annotate(
          f"{word}, attempt {k + 1}", (k + 1, point.value), xytext=(0, 4 * side), color=color,
          textcoords="offset points", va="bottom" if side > 0 else "top", fontsize=8,
          ha="right" if k > 0.8 * len(points) else "center",
        )  # fmt: skip
      start = k + 1
  reach = max(limit, *(abs(p.value) for p in points)) if points else limit
  ax.set_ylim(-1.35 * reach, 1.35 * reach)
  ax.set_ylabel("CUSUM [-]")
  legend_above(ax)
