"""What a hand that searches remembers: where it has felt, and how stiff it was.

A place counts with its stiffness, force over depth, 0 where nothing was felt. What goes over all
places is written for numpy, and for many worlds below it.
"""

from typing import Annotated, Any

import numpy as np
import warp as wp
from palpate.tissue.types import Array, floats, ints

from ...core import rules as r

LEFT = 0.02  # force below which a press has ended [N]
DEEP = 0.0028  # what tells enough [m]
APART = 0.014  # how far from what was felt a place is left to feel [m]
BESIDE, NEAR = 0.008, 0.005  # what lies beside a place, and counts as there [m]
SOFT = 0.25  # share of the places felt that are softer than what counts as soft [-]
STIFF = 1.6  # times that: what is felt around, before anything else [-]
WIDTH = 1.2  # of the bell of stiffness above an inclusion, over its radius [-]
NOISE = 8.0  # of what is felt: triangles differ [N/m]
SURE = 0.45  # of the radius: who knows the place of an inclusion to within that is sure [-]
LEAST = 1e-9


class Notes:
  """State of who remembers."""

  radius: float  # of an inclusion [m]
  places: Annotated[Any, Array(wp.vec3, ("nplace",))]  # that may be felt [m]
  outward: Annotated[Any, Array(wp.vec3, ("nplace",))]  # normals there
  beside: Annotated[Any, ints("nplace", 4)]  # places to the four sides, -1 beyond the field
  stiffness: Annotated[Any, floats("nplace")]  # [N/m]
  last: int  # place that was noted
  depth: float  # there, 0 where no press goes on [m]
  next: int  # place to feel next, -1 where enough is felt
  likely: r.Vector  # where an inclusion is to be expected [m]
  doubt: float  # RMS distance from there to where else it may be [m]


SHARED = ("places", "outward", "beside")  # by all worlds


def start(o: Any, places: np.ndarray, outward: np.ndarray, beside: np.ndarray) -> None:
  """Remembers nothing yet.

  Args:
    o: the state
    places: that may be felt  (nplace, 3) [m]
    outward: normals there  (nplace, 3)
    beside: of `sides`  (nplace, 4)
  """
  o.places, o.outward, o.beside = places, outward, beside
  o.nplace, o.stiffness, o.depth = len(places), np.zeros(len(places)), 0.0
  o.likely, o.doubt = places.mean(axis=0), r.FAR
  o.last = o.next = nearest(o, o.likely)


def felt(o: Any) -> dict[int, float]:
  """Returns the stiffness of the places that were felt [N/m]."""
  return {int(k): float(o.stiffness[k]) for k in np.flatnonzero(o.stiffness)}


# The rules.


def press(o, here, force):
  """Follows a press with a force [N]; each counts once, where it was deepest."""
  if force < LEFT:
    o.depth = 0.0
    return o
  k = nearest(o, here)
  deep = r.dot(o.places[k] - here, o.outward[k])
  if deep > max(o.depth, DEEP):
    if o.depth > 0.0:
      o.stiffness[o.last] = 0.0
    o.last = k
    o.depth = deep
    o.stiffness[k] = force / deep
    o = conclude(o)
  return o


def conclude(o):
  """Finds where to feel next, and where an inclusion is to be expected.

  Next is a side of what is stiff, or else, of the places far from all that was felt, the nearest to
  the last; the first is in the middle. Who is not sure then feels around what is likely.
  """
  low, top = soft(o), stiffest(o)
  place, doubt = expected(o, low)
  o.likely = place
  o.doubt = doubt
  o.next = -1
  if o.stiffness[top] <= STIFF * low:
    o.next = new(o, o.places[o.last], APART)
  if o.next < 0:
    o.next = side(o, top)
  if o.next < 0 and not sure(o):
    o.next = new(o, o.likely, NEAR)
  return o


def sure(o):
  """Returns whether what was felt tells where an inclusion is."""
  return o.doubt <= SURE * o.radius


def nearest(o, point):
  """Returns the place nearest to a point."""
  return int(np.linalg.norm(o.places - point, axis=1).argmin())


@r.many(nearest)
def _nearest(o, point):
  k = int(0)
  for i in range(o.places.shape[0]):
    if r.length(o.places[i] - point) < r.length(o.places[k] - point):
      k = i
  return k


def stiffest(o):
  """Returns the stiffest place."""
  return int(o.stiffness.argmax())


@r.many(stiffest)
def _stiffest(o):
  top = int(0)
  for i in range(o.stiffness.shape[0]):
    if o.stiffness[i] > o.stiffness[top]:
      top = i
  return top


def soft(o):
  """Returns what counts as soft [N/m]."""
  felt = o.stiffness[o.stiffness > 0]
  return float(np.quantile(felt, SOFT, method="lower")) if len(felt) else 0.0


@r.many(soft)
def _soft(o):
  count = int(0)
  for i in range(o.stiffness.shape[0]):
    if o.stiffness[i] > 0.0:
      count += 1
  for i in range(o.stiffness.shape[0]):
    own, below = o.stiffness[i], int(0)
    for j in range(o.stiffness.shape[0]):
      other = o.stiffness[j]
      if other > 0.0 and (other < own or (other == own and j < i)):
        below += 1
    if own > 0.0 and below == int(SOFT * float(count - 1)):
      return own
  return float(0.0)


def new(o, place, apart):
  """Returns of the places that far from all that was felt the nearest to one, -1 without one."""
  gaps = np.linalg.norm(o.places[:, None] - o.places[np.flatnonzero(o.stiffness)], axis=2)
  away = np.linalg.norm(o.places - place, axis=1)
  away[gaps.min(axis=1, initial=np.inf) < apart] = np.inf
  k = int(away.argmin())
  return k if away[k] < np.inf else -1


@r.many(new)
def _new(o, place, apart):
  found = int(-1)
  least = float(0.0)
  for k in range(o.places.shape[0]):
    away = r.length(o.places[k] - place)
    if found < 0 or away < least:
      left = wp.bool(True)
      for j in range(o.places.shape[0]):
        if left and o.stiffness[j] > 0.0:
          left = r.length(o.places[k] - o.places[j]) >= apart
      if left:
        found = k
        least = away
  return found


def side(o, top):
  """Returns a place beside the stiffest that is left to feel, -1 without one."""
  felt = np.flatnonzero(o.stiffness)
  for k in o.beside[top][o.beside[top] >= 0]:
    gaps = np.linalg.norm(o.places[felt] - o.places[k], axis=1)
    if not (gaps[felt != top] < NEAR).any():
      return int(k)
  return -1


@r.many(side)
def _side(o, top):
  for i in range(4):
    k = o.beside[top, i]
    new = k >= 0
    for j in range(o.places.shape[0]):
      if new and o.stiffness[j] > 0.0 and j != top:
        new = r.length(o.places[j] - o.places[k]) >= NEAR
    if new:
      return k
  return -1


def expected(o, low):
  """Returns where an inclusion is to be expected (3,), and how far from there it may be [m].

  What counts as soft is `low` [N/m].
  """
  felt = np.flatnonzero(o.stiffness)
  likely = chance(o.places, felt, o.stiffness[felt] - low, o.radius)
  likely /= likely.sum()
  middle = likely @ o.places
  return middle, float(np.sqrt(likely @ ((o.places - middle) ** 2).sum(axis=1)))


@r.many(expected)
def _expected(o, low):
  best, mass, square = float(0.0), float(0.0), float(0.0)
  sum = wp.vec3()
  for k in range(o.places.shape[0]):
    best = max(best, _gain(o, k, low))
  for k in range(o.places.shape[0]):
    likely = wp.exp((_gain(o, k, low) - best) / (2.0 * NOISE * NOISE))
    away = o.places[k] - o.places[o.last]  # small numbers: squares of them are told apart
    mass += likely
    sum += likely * away
    square += likely * r.dot(away, away)
  sum = sum / mass
  return o.places[o.last] + sum, r.root(max(square / mass - r.dot(sum, sum), 0.0))


def _gain(o, k, low):
  """Returns what the best bell on a place takes off the sum of squares, see `chance`."""
  both, square = float(0.0), float(LEAST)
  for j in range(o.places.shape[0]):
    if o.stiffness[j] > 0.0:
      ratio = r.length(o.places[j] - o.places[k]) / (WIDTH * o.radius)
      bell = wp.exp(-ratio * ratio)
      both += bell * (o.stiffness[j] - low)
      square += bell * bell
  both = max(both, 0.0)
  return both * both / square


def chance(places: np.ndarray, felt: np.ndarray, more: np.ndarray, radius: float) -> np.ndarray:
  """Returns how likely an inclusion is under each place, against the likeliest [-]  (nplace,).

  It is the likelihood of what was felt, given a bell of stiffness h exp(-(d/w)^2) above the soft.

  Args:
    places: where it may be  (nplace, 3) [m]
    felt: which of them were felt  (nfelt,)
    more: stiffness there above what is soft  (nfelt,) [N/m]
    radius: of the inclusion [m]
  """
  distance = np.linalg.norm(places[:, None] - places[felt], axis=2)
  bell = np.exp(-((distance / (WIDTH * radius)) ** 2))
  # What the best height takes off the sum of squares.
  gain = np.maximum(bell @ more, 0.0) ** 2 / np.maximum((bell**2).sum(axis=1), LEAST)
  return np.exp((gain - gain.max()) / (2 * NOISE**2))


def sides(places: np.ndarray, up: np.ndarray) -> np.ndarray:
  """Returns the places to the four sides of each, across `up`; -1 without one  (nplace, 4)."""
  one, two = np.linalg.svd(np.reshape(up, (1, 3)))[2][1:]
  found = np.full((len(places), 4), -1)
  for i, way in enumerate((one, two, -one, -two)):
    gap = np.linalg.norm(places[:, None] + BESIDE * way - places, axis=2)
    nearest = gap.argmin(axis=1)
    there = gap[np.arange(len(places)), nearest] < 0.5 * BESIDE
    found[there, i] = nearest[there]
  return found
