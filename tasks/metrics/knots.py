"""Names the knot of a thread: its Jones polynomial, and the throws that have it.

A throw of k turns, with the thread's ends joined far away, is the torus knot T(2, 2 k + 1), right-
or left-handed. Throws one after the other are their connected sum, with the product of polynomials.
"""

import collections
import functools
import itertools
from collections.abc import Mapping, Sequence

import numpy as np

# Of throws: turns, positive where right-handed. Names hold for the mirror image too.
NAMES: Mapping[tuple[int, ...], str] = {
  (): "none",
  (1,): "overhand",
  (2,): "double throw",
  (1, -1): "square",
  (1, 1): "granny",
  (2, -1): "surgeon's",
  (2, 1): "surgeon's granny",
  (2, -1, 1): "surgeon's 2-1-1",
}
_MOST = 40  # crossings of a projection that are looked at
# Projections that are tried until one has few crossings; that with the fewest counts.
_TRIES, _FEW = 24, 12

Polynomial = dict[int, int]  # exponent -> coefficient, of A = t^(-1/4)


def closed(points: np.ndarray, axis: np.ndarray | None = None) -> np.ndarray:
  """Returns a closed polygon of an open thread, its ends led away to where nothing is.

  Args:
    points: nodes in their order [m]  (n, 3)
    axis: along which the last end is led away, and the first one against it, not back through the
      thread; None for the vector from the first to the last

  Returns:
    corners  (n + 3, 3)
  """
  points = np.asarray(points, dtype=float)
  out = points[-1] - points[0] if axis is None else np.asarray(axis, dtype=float)
  out /= np.linalg.norm(out)
  size = 4 * np.ptp(points, axis=0).max()
  aside = np.cross(out, np.eye(3)[np.argmin(np.abs(out))])
  ends = points[-1] + size * out, points[0] - size * out
  return np.concatenate([points, [ends[0], points.mean(axis=0) + 4 * size * aside, ends[1]]])


def throws(polygon: np.ndarray, most: int = 3) -> tuple[int, ...] | None:
  """Returns the throws of a closed polygon, (n, 3): turns, positive where right-handed.

  Returns:
    most turns first; () for no knot; None where it is none of up to `most` throws of one or two
    turns, or too tangled to tell
  """
  found = jones(polygon)
  kinds = (2, -2, 1, -1)
  for count in range(most + 1):
    for each in itertools.combinations_with_replacement(kinds, count):
      if found == functools.reduce(_times, map(_torus, each), {0: 1}):
        return each
  return None


def same(found: tuple[int, ...], turns: Sequence[int]) -> bool:
  """Returns whether throws are those of a knot whose throws alternate, or of its mirror image.

  Args:
    found: see `throws`
    turns: of each throw of the knot
  """
  wound = [(-1) ** k * each for k, each in enumerate(turns)]
  return sorted(found) in (sorted(wound), sorted(-each for each in wound))


def name(polygon: np.ndarray) -> str:
  """Returns the name of a closed polygon's knot, (n, 3), see NAMES, or `other`."""
  found = throws(polygon)
  if found is None:
    return "other"
  for turns in (found, [-k for k in found]):
    for known, text in NAMES.items():
      if sorted(known) == sorted(turns):
        return text
  return "other"


def jones(polygon: np.ndarray) -> Polynomial | None:
  """Returns the Jones polynomial of a closed polygon, (n, 3), as exponents of A = t^(-1/4).

  By the bracket of Kauffman 1987, doi:10.1016/0040-9383(87)90009-7, crossing by crossing; None
  where all projections have too many crossings.
  """
  rng = np.random.RandomState(0)
  best = None
  for _ in range(_TRIES):
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    frame[:, 0] *= np.sign(np.linalg.det(frame))
    found = _diagram(np.asarray(polygon, dtype=float) @ frame)
    if best is None or len(found[0]) < len(best[0]):
      best = found
    if len(best[0]) <= _FEW:
      break
  assert best is not None
  crossings, writhe = best
  if len(crossings) > _MOST:
    return None
  # (-A^3)^(-writhe) <D>, of which a circle is 1.
  sign = -1 if writhe % 2 else 1
  return {e - 3 * writhe: sign * c for e, c in _bracket(crossings).items()}


def _torus(turns: int) -> Polynomial:
  """Returns that of T(2, n), n = 2 |turns| + 1: t^k (1 - t^3 - t^(n+1) + t^(n+2)) / (1 - t^2)."""
  k = abs(turns)
  rest = collections.defaultdict(int, {0: 1, 3: -1, 2 * k + 2: -1, 2 * k + 3: 1})
  out = {}
  for power in range(2 * k + 2):  # the quotient, lowest power first
    if rest[power]:
      out[power + k] = rest[power]
      rest[power + 2] += rest[power]
  return {(-4 if turns > 0 else 4) * power: c for power, c in out.items()}


def _times(p: Polynomial, q: Polynomial) -> Polynomial:
  out: Polynomial = collections.defaultdict(int)
  for (a, c), (b, d) in itertools.product(p.items(), q.items()):
    out[a + b] += c * d
  return {e: c for e, c in out.items() if c}


def _diagram(corner: np.ndarray) -> tuple[list[tuple[int, int, int, int]], int]:
  """Returns the crossings of a closed polygon seen along z, and their writhe.

  A crossing has the numbers of the four strands there, counter-clockwise from the one that comes in
  below.
  """
  n = len(corner)
  edge = np.roll(corner, -1, axis=0) - corner
  i, j = np.triu_indices(n, 2)
  far = ~((i == 0) & (j == n - 1))
  i, j = i[far], j[far]
  d, e, r = edge[i], edge[j], corner[j] - corner[i]
  cross = d[:, 0] * e[:, 1] - d[:, 1] * e[:, 0]
  with np.errstate(divide="ignore", invalid="ignore"):
    s = (r[:, 0] * e[:, 1] - r[:, 1] * e[:, 0]) / cross
    t = (r[:, 0] * d[:, 1] - r[:, 1] * d[:, 0]) / cross
  hit = np.flatnonzero((s > 0) & (s < 1) & (t > 0) & (t < 1))
  i, j, s, t, cross = i[hit], j[hit], s[hit], t[hit], cross[hit]
  above = corner[i, 2] + s * edge[i, 2] > corner[j, 2] + t * edge[j, 2]
  over, under = np.where(above, i + s, j + t), np.where(above, j + t, i + s)
  positive = np.where(above, cross, -cross) > 0  # over x under
  place = np.argsort(np.argsort(np.concatenate([over, under])))  # of each passage along the curve
  count = len(hit)
  found = []
  for k in range(count):
    a, o = int(place[count + k]), int(place[k])
    after_a, after_o = (a + 1) % (2 * count), (o + 1) % (2 * count)
    found.append((a, after_o, after_a, o) if positive[k] else (a, o, after_a, after_o))
  return found, int(2 * positive.sum() - count)


def _bracket(crossings: list[tuple[int, int, int, int]]) -> Polynomial:
  """Returns Kauffman's bracket of a diagram, 1 for a circle."""
  circle = {2: -1, -2: -1}
  terms: dict[frozenset, Polynomial] = {frozenset(): {0: 1}}
  rest, seen = list(crossings), set()
  while rest:
    # That next which has most of its strands among those that are open: few are open at a time.
    crossing = max(rest, key=lambda c: len(set(c) & seen))
    rest.remove(crossing)
    seen ^= {strand for strand in set(crossing) if crossing.count(strand) == 1}
    a, b, c, d = crossing
    after: dict[frozenset, Polynomial] = {}
    for pairs, factor in terms.items():
      for power, joins in ((1, ((a, b), (c, d))), (-1, ((a, d), (b, c)))):
        now, loops = _joined(pairs, joins)
        value = {e + power: k for e, k in factor.items()}
        for _ in range(loops):
          value = _times(value, circle)
        mine = after.setdefault(now, {})
        for e, k in value.items():
          mine[e] = mine.get(e, 0) + k
    terms = after
  out = {e: k for e, k in terms[frozenset()].items() if k}
  return _over_circle(out) if crossings else {0: 1}


def _joined(pairs: frozenset, joins) -> tuple[frozenset, int]:
  """Returns which open strands are the ends of one path after two joins, and the loops closed."""
  other = {}
  for p, q in pairs:
    other[p], other[q] = q, p
  loops = 0
  for p, q in joins:
    if p == q or other.get(p) == q:
      loops += 1
      other.pop(p, None)
      other.pop(q, None)
      continue
    x, y = other.pop(p, p), other.pop(q, q)
    other[x], other[y] = y, x
  return frozenset((p, q) for p, q in other.items() if p < q), loops


def _over_circle(p: Polynomial) -> Polynomial:
  """Returns p / (-A^2 - A^-2)."""
  rest, out = dict(p), {}
  while rest:
    high = max(rest)
    value = -rest[high]
    out[high - 2] = value
    for e in (high, high - 4):
      rest[e] = rest.get(e, 0) + value
      if not rest[e]:
        del rest[e]
  return out
