"""What came of it: errors, grasps, targets and traces."""

import itertools
import math
from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from .definition import UnknownError, metric
from .samples import rows, same

EVENTS = ("target", "miss", "drop", "unintended_contact", "slip", "note")
SUCCESS = "success"  # how an exercise ends that was done
ERRORS = ("miss", "drop", "unintended_contact")


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


@metric("Share freed", "-", "outcome", "all", "VTE: teasing (Kotamraju 2008)", better="neither")
def share_freed(freed: ArrayLike) -> float:
  """Returns the share of the bonds' area that came free as it should [-], neither is better.

  A success has what was wanted: more of it, or just that, tells nothing.

  Args:
    freed: share so far [-]  (nstep,)
  """
  return float(rows("freed", freed)[-1])


@metric("Mean deviation", "m", "outcome", "all", "FLS: 2 mm, 10.1177/1553350607302329")
def cut_deviation(deviation: ArrayLike) -> float:
  """Returns the mean distance of a cut from its line [m], lower is better (FLS).

  Args:
    deviation: mean so far [m]  (nstep,)
  """
  return float(rows("deviation", deviation)[-1])


@metric("Largest deviation", "m", "outcome", "max", "FLS: 2 mm, 10.1177/1553350607302329")
def cut_farthest(farthest: ArrayLike) -> float:
  """Returns the largest distance of a cut from its line [m], lower is better (FLS).

  Args:
    farthest: largest so far [m]  (nstep,)
  """
  return float(rows("farthest", farthest)[-1])


@metric("Excess tissue", "m^2", "outcome", "all", "MISTELS: area of deviation")
def cut_excess(excess: ArrayLike) -> float:
  """Returns the area between a cut and its line [m^2], lower is better (MISTELS).

  Args:
    excess: so far [m^2]  (nstep,)
  """
  return float(rows("excess", excess)[-1])


@metric("Jagged length", "m", "outcome", "all", "FLS: 2 mm, 10.1177/1553350607302329")
def cut_jagged(jagged: ArrayLike) -> float:
  """Returns the length of a cut more than 2 mm from its line [m], lower is better (FLS).

  Args:
    jagged: so far [m]  (nstep,)
  """
  return float(rows("jagged", jagged)[-1])


@metric("Depth of the blade", "m", "safety", "max", "this project: what lies under a wall")
def cut_depth(depth: ArrayLike) -> float:
  """Returns how far the blade's tip was under the wall that it cut [m], lower is better.

  Args:
    depth: largest so far [m]  (nstep,)
  """
  return float(rows("depth", depth)[-1])


@metric("Time of current", "s", "safety", "all", "10.1007/s00464-013-3297-1: cautery time")
def current_time(current: ArrayLike) -> float:
  """Returns how long a current was on [s], lower is better.

  Args:
    current: time so far [s]  (nstep,)
  """
  return float(rows("current", current)[-1])


@metric("Current without a target", "s", "safety", "all", "as `current_time`")
def current_wasted(idle_current: ArrayLike) -> float:
  """Returns how long a current was on without touching what it is to free [s], lower is better.

  Args:
    idle_current: time so far [s]  (nstep,)
  """
  return float(rows("idle_current", idle_current)[-1])


@metric("Grasps of the needle", "count", "efficiency", "all", "GEARS: 10.1016/j.juro.2011.09.032")
def regrasps(regrasped: ArrayLike) -> float:
  """Returns how often a hand took the needle [count], lower is better.

  Args:
    regrasped: times so far  (nstep,)
  """
  return float(rows("regrasped", regrasped)[-1])


@metric("Contact with rings", "s", "safety", "all", "this project; as `shaft_contact`")
def ring_contact(ring_time: ArrayLike) -> float:
  """Returns how long needle or instruments touched the rings [s], lower is better.

  Args:
    ring_time: time so far [s]  (nstep,)
  """
  return float(rows("ring_time", ring_time)[-1])


@metric("Peak force on rings", "N", "safety", "all", "this project; as `peak_force`")
def peak_ring_force(ring_force: ArrayLike) -> float:
  """Returns the largest force on the rings [N], lower is better.

  Args:
    ring_force: largest so far [N]  (nstep,)
  """
  return float(rows("ring_force", ring_force)[-1])


@metric("Depth of the bite", "m", "outcome", "all", "FLS task 4: bites", better="neither")
def bite_depth(bite: ArrayLike) -> float:
  """Returns how deep a needle went under a wall [m], neither is better.

  Args:
    bite: deepest so far [m]  (nstep,)
  """
  return float(rows("bite", bite)[-1])


@metric("Gap of the cut", "m", "outcome", "all", "FLS tasks 4 and 5: at most 1 mm")
def final_gap(gap: ArrayLike) -> float:
  """Returns how far the cut gapes at its widest in the end [m], lower is better.

  Args:
    gap: at its widest [m]  (nstep,)
  """
  return float(rows("gap", gap)[-1])


@metric("Peak tension of the thread", "N", "safety", "all", "this project; as `peak_force`")
def peak_tension(tension: ArrayLike) -> float:
  """Returns the largest tension of the thread [N], lower is better.

  Args:
    tension: the largest along the thread [N]  (nstep,)
  """
  return float(rows("tension", tension).max())


@metric("Tearing of holes", "m", "safety", "all", "FLS tasks 4 and 5: no avulsion")
def tearing(torn: ArrayLike) -> float:
  """Returns how far a hole of needle or thread has torn through tissue [m], lower is better.

  Args:
    torn: the farthest so far [m]  (nstep,)
  """
  return float(rows("torn", torn)[-1])


@metric("Knot security", "N", "outcome", "all", "FLS tasks 4 and 5: security", better="neither")
def knot_security(security: ArrayLike) -> float:
  """Returns the pull on a slit that its knot has held [N], neither is better.

  Args:
    security: so far; 0 before the test [N]  (nstep,)
  """
  return float(rows("security", security)[-1])


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
  distance = cdist(pos, np.stack([np.interp(fine, at, column) for column in curve.T], axis=1))
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
