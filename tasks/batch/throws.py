"""The throws of a thread in each of many worlds, see `rules.tied`.

A knot is told by its Alexander polynomial D, up to a sign and a power of t: the determinant of a
minor of the relations of its arcs at their crossings in a picture (Alexander 1928,
doi:10.1090/S0002-9947-1928-1501429-1). |D(-1)| and |D(2)| up to a power of 2 are 1 and 1 without a
knot, 3 and 3 of an overhand knot and 5 and 11 of a double throw; of throws one after the other they
are the products. Whichever way round a throw is they are the same, but not the sum of the signs of
crossings: 3 and 5 of throws one way round, -3 and -5 of others, in any reduced alternating picture
(Thistlethwaite 1988, doi:10.1016/0040-9383(88)90012-2), as one of few crossings nearly is.
"""

# Vectors of Warp's are not known to type checkers:
# pyright: reportIndexIssue=false, reportArgumentType=false, reportOperatorIssue=false
# pyright: reportCallIssue=false
import numpy as np
import warp as wp

from .fields import VIEWS, Common

MOST = 40  # crossings of a picture that is looked at
_MOST, _NEAR = wp.constant(MOST), wp.constant(wp.float64(1e-3))
# |D(-1)| and |D(2)| of a single and of a double throw, and how far sums of signs may be off.
_SINGLE, _DOUBLE = wp.constant(wp.vec2d(3.0, 3.0)), wp.constant(wp.vec2d(5.0, 11.0))
_APART = wp.constant(3.0)
_MORE = wp.constant(3)  # corners that close the thread, see `metrics.knots.closed`


def views() -> np.ndarray:
  """Returns frames to see a thread in, its pictures along their last axis  (VIEWS, 3, 3)."""
  random = np.random.RandomState(0)
  return np.stack([np.linalg.qr(random.normal(size=(3, 3)))[0].T for _ in range(VIEWS)])


@wp.func
def _node(s: Common, w: int, k: int):
  return wp.vec3(s.strand[w, k, 0], s.strand[w, k, 1], s.strand[w, k, 2])


@wp.func
def _corner(s: Common, w: int, k: int, middle: wp.vec3, size: float):
  """Returns a corner of the closed thread: a node, or one of those that lead its ends away."""
  n = s.strand.shape[1]
  if k < n:
    return _node(s, w, k)
  first = _node(s, w, 0)
  last = _node(s, w, n - 1)
  out = wp.normalize(last - first)
  if k == n:
    return last + size * out
  if k == n + 2:
    return first - size * out
  least = wp.abs(out)
  axis = wp.vec3(0.0, 0.0, 1.0)
  if least[0] <= least[1] and least[0] <= least[2]:
    axis = wp.vec3(1.0, 0.0, 0.0)
  elif least[1] <= least[2]:
    axis = wp.vec3(0.0, 1.0, 0.0)
  return middle + 4.0 * size * wp.cross(out, axis)


@wp.func
def _box(s: Common, w: int):
  """Returns the middle of the nodes, and four times how far they spread [m, m]."""
  n = s.strand.shape[1]
  middle = wp.vec3()
  low = _node(s, w, 0)
  high = _node(s, w, 0)
  for k in range(n):
    x = _node(s, w, k)
    middle += x / float(n)
    low = wp.min(low, x)
    high = wp.max(high, x)
  return middle, 4.0 * wp.max(high - low)


@wp.func
def _cross(s: Common, w: int, view: wp.mat33, middle: wp.vec3, size: float, note: bool):
  """Returns how many crossings a picture of the thread has, and notes the first of them."""
  whole = s.strand.shape[1] + _MORE
  count = int(0)
  for i in range(whole - 2):
    a, b = view * _corner(s, w, i, middle, size), view * _corner(s, w, i + 1, middle, size)
    d = b - a
    last = wp.where(i == 0, whole - 1, whole)
    start = view * _corner(s, w, i + 2, middle, size)
    for j in range(i + 2, last):
      following = int(j + 1)
      if following == whole:
        following = 0
      end = view * _corner(s, w, following, middle, size)
      e, r = end - start, start - a
      cross = d[0] * e[1] - d[1] * e[0]
      p = (r[0] * e[1] - r[1] * e[0]) / cross
      q = (r[0] * d[1] - r[1] * d[0]) / cross
      if p > 0.0 and p < 1.0 and q > 0.0 and q < 1.0:
        if note and count < _MOST:
          above = a[2] + p * d[2] > start[2] + q * e[2]
          one, other = float(i) + p, float(j) + q
          s.crossing[w, count, 0] = wp.where(above, one, other)
          s.crossing[w, count, 1] = wp.where(above, other, one)
          s.crossing[w, count, 2] = wp.where(above, cross, -cross)
        count += 1
      start = end
  return count


@wp.func
def _arc(s: Common, w: int, count: int, along: float):
  """Returns the number of the arc that is at a place: arcs begin where the thread goes under."""
  before = int(0)
  for k in range(count):
    if s.crossing[w, k, 1] < along:
      before += 1
  return (before + count - 1) % count


@wp.func
def _determinant(s: Common, w: int, count: int, t: wp.float64):
  """Returns |D(t)| of the noted crossings."""
  zero, one = wp.float64(0.0), wp.float64(1.0)
  for k in range(count):
    for c in range(count):
      s.relation[w, k, c] = zero
  for k in range(count):
    over = _arc(s, w, count, s.crossing[w, k, 0])
    under = _arc(s, w, count, s.crossing[w, k, 1])
    after = (under + 1) % count
    right = s.crossing[w, k, 2] > 0.0
    into = wp.where(right, under, after)
    out = wp.where(right, after, under)
    s.relation[w, k, over] = s.relation[w, k, over] + one - t
    s.relation[w, k, into] = s.relation[w, k, into] + t
    s.relation[w, k, out] = s.relation[w, k, out] - one
  found = wp.float64(1.0)
  for k in range(count - 1):
    pivot = int(k)
    for i in range(k + 1, count - 1):
      if wp.abs(s.relation[w, i, k]) > wp.abs(s.relation[w, pivot, k]):
        pivot = i
    if s.relation[w, pivot, k] == zero:
      return zero
    for c in range(k, count - 1):
      value = s.relation[w, k, c]
      s.relation[w, k, c] = s.relation[w, pivot, c]
      s.relation[w, pivot, c] = value
    found = wp.abs(found * s.relation[w, k, k])
    for i in range(k + 1, count - 1):
      factor = s.relation[w, i, k] / s.relation[w, k, k]
      for c in range(k, count - 1):
        s.relation[w, i, c] = s.relation[w, i, c] - factor * s.relation[w, k, c]
  return found


@wp.func
def _writhe(s: Common, w: int, count: int):
  """Returns the sum of the signs of the noted crossings without those that untwist.

  Such a crossing parts the thread: all others have both or none of their strands between its own.
  """
  sum = float(0.0)
  for k in range(count):
    low = wp.min(s.crossing[w, k, 0], s.crossing[w, k, 1])
    high = wp.max(s.crossing[w, k, 0], s.crossing[w, k, 1])
    parts = bool(True)
    for j in range(count):
      one, other = s.crossing[w, j, 0], s.crossing[w, j, 1]
      if j != k and (one > low and one < high) != (other > low and other < high):
        parts = False
    if not parts:
      sum += wp.sign(s.crossing[w, k, 2])
  return sum


@wp.func
def _halves(turns: wp.array[int], count: int):
  """Returns by how many half turns the strands of so many throws wind, back and forth."""
  sum = float(0.0)
  for k in range(count):
    half = float(2 * turns[k] + 1)
    sum += wp.where(k % 2 == 0, half, -half)
  return wp.abs(sum)


@wp.func
def _divide(value: wp.float64, by: wp.float64):
  """Returns how often a whole number can be divided by another one."""
  found, rest = int(0), wp.float64(value)
  while rest > wp.float64(1.5) and wp.abs(rest / by - wp.round(rest / by)) < _NEAR:
    rest = rest / by
    found += 1
  return found


@wp.func
def tied(s: Common, w: int, turns: wp.array[int]):
  """Returns how many throws of a knot the thread has, see `rules.tied`."""
  middle, size = _box(s, w)
  best = int(0)
  least = int(1 << 20)
  for k in range(s.views.shape[0]):
    count = _cross(s, w, s.views[k], middle, size, False)
    if count < least:
      best = k
      least = count
  if least < 3:
    return 0
  if least > _MOST:
    return -1
  count = _cross(s, w, s.views[best], middle, size, True)
  first = _determinant(s, w, count, wp.float64(-1.0))
  second = _determinant(s, w, count, wp.float64(2.0))
  one, two = _divide(first, _SINGLE[0]), _divide(first, _DOUBLE[0])
  for _k in range(one):
    first = first / _SINGLE[0]
    second = second / _SINGLE[1]
  for _k in range(two):
    first = first / _DOUBLE[0]
    second = second / _DOUBLE[1]
  while second >= wp.float64(2.0) - _NEAR:
    second = second / wp.float64(2.0)
  while second > wp.float64(0.0) and second < wp.float64(1.0) - _NEAR:
    second = second * wp.float64(2.0)
  known = wp.abs(first - wp.float64(1.0)) < _NEAR and wp.abs(second - wp.float64(1.0)) < _NEAR
  if not known or one + two > turns.shape[0]:
    return -1
  writhe = wp.abs(_writhe(s, w, count))
  found = int(0)
  for k in range(turns.shape[0]):
    one -= wp.where(turns[k] == 1, 1, 0)
    two -= wp.where(turns[k] == 2, 1, 0)
    if one == 0 and two == 0 and (k == 0 or wp.abs(writhe - _halves(turns, k + 1)) < _APART):
      found = k + 1
  return found
