"""What came of it: errors, grasps, targets and traces."""

import functools
import inspect
import itertools
import math
from collections.abc import Callable, Collection, Iterable
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike

from .definition import UnknownError, metric
from .samples import rows, same

EVENTS = ("target", "miss", "drop", "unintended_contact", "slip", "note")
SUCCESS = "success"  # how an exercise ends that was done
ERRORS = ("miss", "drop", "unintended_contact")


def _last(*about: Any, **named: Any) -> Callable[[Callable[..., Any]], Callable[..., float]]:
  """Registers a metric that is the last number of its column, (nstep,): of an episode so far.

  The column is that of the function's argument; the function has no body. Arguments as of `metric`.
  """

  def register(function: Callable[..., Any]) -> Callable[..., float]:
    (column,) = inspect.signature(function).parameters

    @functools.wraps(function)
    def last(*values: Any, **given: Any) -> float:
      return float(rows(column, *values, *given.values())[-1])

    return metric(*about, **named)(last)

  return register


def count_events(kinds: Iterable[str], wanted: Iterable[str]) -> float:
  """Returns how many events are of the wanted kinds [count]."""
  wanted = frozenset(wanted)
  return float(sum(str(kind) in wanted for kind in kinds))


@metric("Errors", "count", "safety", "all", "10.1186/s12893-020-00839-z")
def errors(kinds: Iterable[str], watched: Collection[str]) -> float:
  """Returns the number of misses, drops and unintended contacts [count], lower is better.

  Args:
    kinds: of the events that there were
    watched: kinds that were looked for
  """
  if not set(ERRORS) & set(watched):
    raise UnknownError("no kind of error was watched for")
  return count_events(kinds, ERRORS)


@metric("Grasp slips", "count", "safety", "sum", "GOALS tissue handling")
def grasp_slips(
  grip: ArrayLike | None = None,
  held: ArrayLike | None = None,
  kinds: Iterable[str] = (),
  watched: Collection[str] = (),
) -> float:
  """Returns how many grasps are lost before release [count], lower is better (GOALS).

  Args:
    grip: above 0.5 where the jaw is told to close  (nstep,)
    held: above 0.5 where the jaw holds tissue  (nstep,)
    kinds: of the events, of which the slips are counted where grip or held is None
    watched: kinds of events that were looked for
  """
  if grip is None or held is None:
    if "slip" in watched:
      return count_events(kinds, ["slip"])
    absent = [name for name, value in (("grip", grip), ("held", held)) if value is None]
    raise UnknownError(f"{' and '.join(absent)} not recorded")
  closed = rows("grip", grip) > 0.5
  held = same("held", rows("held", held), closed) > 0.5
  if not held.any():
    raise UnknownError("nothing was grasped")
  return int(np.count_nonzero(held[:-1] & ~held[1:] & closed[1:]))


@metric("Target error", "m", "outcome", "all", "Perk Tutor")
def target_error(target_distance: ArrayLike) -> float:
  """Returns the mean distance to the target at touch [m], lower is better (Perk Tutor).

  Args:
    target_distance: one a touch [m]  (n,)
  """
  touched = rows("target_distance", target_distance, least=0)
  if len(touched) == 0:
    raise UnknownError("no target was touched")
  return float(touched.mean())


@_last("Share freed", "-", "outcome", "all", "VTE: teasing (Kotamraju 2008)", better="neither")
def share_freed(freed: ArrayLike):
  """Returns the share of the bonds' area that came free as it should [-], neither is better.

  A success has what was wanted: more of it, or just that, tells nothing.
  """


@_last("Mean deviation", "m", "outcome", "all", "FLS: 2 mm, 10.1177/1553350607302329")
def cut_deviation(deviation: ArrayLike):
  """Returns the mean distance of a cut from its line [m], lower is better (FLS)."""


@_last("Largest deviation", "m", "outcome", "max", "FLS: 2 mm, 10.1177/1553350607302329")
def cut_farthest(farthest: ArrayLike):
  """Returns the largest distance of a cut from its line [m], lower is better (FLS)."""


@_last("Excess tissue", "m^2", "outcome", "all", "MISTELS: area of deviation")
def cut_excess(excess: ArrayLike):
  """Returns the area between a cut and its line [m^2], lower is better (MISTELS)."""


@_last("Jagged length", "m", "outcome", "all", "FLS: 2 mm, 10.1177/1553350607302329")
def cut_jagged(jagged: ArrayLike):
  """Returns the length of a cut more than 2 mm from its line [m], lower is better (FLS)."""


@_last("Depth of the blade", "m", "safety", "max", "this project: what lies under a wall")
def cut_depth(depth: ArrayLike):
  """Returns how far the blade's tip was under the wall that it cut [m], lower is better."""


@_last("Time of current", "s", "safety", "all", "10.1007/s00464-013-3297-1: cautery time")
def current_time(current: ArrayLike):
  """Returns how long a current was on [s], lower is better."""


@_last("Current without a target", "s", "safety", "all", "as `current_time`")
def current_wasted(idle_current: ArrayLike):
  """Returns how long a current was on without touching what it is to free [s], lower is better."""


@_last("Grasps of the needle", "count", "efficiency", "all", "GEARS: 10.1016/j.juro.2011.09.032")
def regrasps(regrasped: ArrayLike):
  """Returns how often a hand took the needle [count], lower is better."""


@_last("Contact with rings", "s", "safety", "all", "this project; as `shaft_contact`")
def ring_contact(ring_time: ArrayLike):
  """Returns how long needle or instruments touched the rings [s], lower is better."""


@_last("Peak force on rings", "N", "safety", "all", "this project; as `peak_force`")
def peak_ring_force(ring_force: ArrayLike):
  """Returns the largest force on the rings [N], lower is better."""


@_last("Depth of the bite", "m", "outcome", "all", "FLS task 4: bites", better="neither")
def bite_depth(bite: ArrayLike):
  """Returns how deep a needle went under a wall [m], neither is better."""


@_last("Gap of the cut", "m", "outcome", "all", "FLS tasks 4 and 5: at most 1 mm")
def final_gap(gap: ArrayLike):
  """Returns how far the cut gapes at its widest in the end [m], lower is better."""


@metric("Peak tension of the thread", "N", "safety", "all", "this project; as `peak_force`")
def peak_tension(tension: ArrayLike) -> float:
  """Returns the largest tension of the thread [N], lower is better.

  Args:
    tension: the largest along the thread [N]  (nstep,)
  """
  return float(rows("tension", tension).max())


@_last("Tearing of holes", "m", "safety", "all", "FLS tasks 4 and 5: no avulsion")
def tearing(torn: ArrayLike):
  """Returns how far a hole of needle or thread has torn through tissue [m], lower is better."""


@_last("Knot security", "N", "outcome", "all", "FLS tasks 4 and 5: security", better="neither")
def knot_security(security: ArrayLike):
  """Returns the pull on a slit that its knot has held [N], neither is better."""


@metric("Tracing error (Frechet)", "m", "outcome", "all", "Perk Tutor; Eiter and Mannila 1994")
def trace_frechet(traced_pos: ArrayLike, curve: ArrayLike) -> float:
  """Returns the discrete Frechet distance of the tip's path to a curve [m], lower is better.

  Eiter and Mannila 1994, on the curve with points added every 1/256 of its length. Both run in
  their order: a curve traced backwards scores badly. Above the continuous distance by at most the
  largest gap between neighbouring samples.

  Args:
    traced_pos: tip position from the first to the last contact [m]  (n, 3)
    curve: corners of the polyline [m]  (ncorner, 3)
  """
  pos = rows("tip_pos", traced_pos, 3)
  curve = rows("curve", curve, 3, least=2)
  at = np.concatenate([[0.0], np.linalg.norm(np.diff(curve, axis=0), axis=1).cumsum()])
  fine = np.union1d(at, np.linspace(0, at[-1], 257))
  if len(fine) < 2:
    raise UnknownError("the curve has no length")
  path = np.stack([np.interp(fine, at, column) for column in curve.T], axis=1)
  distance = scipy.spatial.distance.cdist(pos, path)
  n, m = distance.shape
  flat = distance.ravel()
  # Anti-diagonals i + j = k do not depend on themselves; entry i + 1 belongs to row i.
  before, last, new = np.full((3, n + 1), np.inf)
  before[0] = -np.inf  # the way into (0, 0)
  for k in range(n + m - 1):
    low, high = max(0, k - m + 1), min(k, n - 1) + 1
    cost = flat[k + low * (m - 1) : k + (high - 1) * (m - 1) + 1 : m - 1]
    here = new[low + 1 : high + 1]
    np.minimum(last[low + 1 : high + 1], last[low:high], out=here)
    np.minimum(here, before[low:high], out=here)
    np.maximum(here, cost, out=here)
    before[: low + 2] = np.inf  # becomes `new`, whose rows start one later at most
    before, last, new = last, new, before
  return float(last[n])


@metric("Tracing error (RMS)", "m", "outcome", "all", "Perk Tutor")
def trace_rms(touching_pos: ArrayLike, curve: ArrayLike) -> float:
  """Returns the root mean square distance of the tip to a polyline [m], lower is better.

  Perk Tutor.

  Args:
    touching_pos: tip position while in contact [m]  (n, 3)
    curve: corners of the polyline [m]  (ncorner, 3)
  """
  pos = rows("tip_pos", touching_pos, 3)
  curve = rows("curve", curve, 3, least=2)
  least = np.full(len(pos), np.inf)
  for start, end in itertools.pairwise(curve):  # a polyline has few segments
    along = end - start
    share = np.clip((pos - start) @ along / max(along @ along, np.finfo(float).tiny), 0, 1)
    gap = pos - start - share[:, None] * along
    np.minimum(least, (gap * gap).sum(axis=1), out=least)
  return math.sqrt(least.mean())
