"""A triangle before a cylinder: where a convex function, the distance from it, is least."""

# Vectors of Warp's are not known to type checkers:
# pyright: reportOperatorIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportIndexIssue=false
import warp as wp
from palpate.engine.contacts import FLAT

_POINTS = wp.constant(FLAT["POINTS"])
_LEVEL, _RIM, _SLACK, _COVER = (
  wp.constant(FLAT[name]) for name in ("LEVEL", "RIM", "SLACK", "COVER")
)
_HALVINGS = wp.constant(20)  # of an edge: to 1e-6 of its length
_LEAST = wp.constant(1e-9)  # length of a direction [m]
_JUST = wp.constant(1e-8)  # how far in what just touches is [m]


@wp.func
def _beyond(x: wp.vec3, r: float, half: float):
  """Returns the distance of a point from a cylinder along z, negative inside, and its gradient."""
  rho = wp.sqrt(x[0] * x[0] + x[1] * x[1])
  radial = wp.vec3(x[0], x[1], 0.0) / wp.max(rho, _LEAST)
  axial = wp.vec3(0.0, 0.0, wp.where(x[2] < 0.0, -1.0, 1.0))
  aside = rho - r
  above = wp.abs(x[2]) - half
  dist = wp.max(aside, above)
  gradient = wp.where(aside > above, radial, axial)
  if aside > 0.0 and above > 0.0:
    dist = wp.sqrt(aside * aside + above * above)
    gradient = (aside * radial + above * axial) / dist
  return dist, gradient


@wp.func
def _lowest(a: wp.vec3, b: wp.vec3, r: float, half: float):
  """Returns the point of an edge that is nearest to the cylinder, or deepest in it."""
  low = float(0.0)
  high = float(1.0)
  for _ in range(_HALVINGS):
    t = 0.5 * (low + high)
    _dist, gradient = _beyond(a + t * (b - a), r, half)
    if wp.dot(gradient, b - a) > 0.0:
      high = t
    else:
      low = t
  return a + 0.5 * (low + high) * (b - a)


@wp.func
def _within(x: wp.vec3, a: wp.vec3, b: wp.vec3, d: wp.vec3, n: wp.vec3):
  """Returns whether a point is above a triangle with normal n."""
  u = wp.dot(wp.cross(b - a, x - a), n)
  v = wp.dot(wp.cross(d - b, x - b), n)
  w = wp.dot(wp.cross(a - d, x - d), n)
  return u >= 0.0 and v >= 0.0 and w >= 0.0


@wp.func
def _under_end(size: wp.vec3, radius: float, a: wp.vec3, b: wp.vec3, d: wp.vec3):
  """Returns how much of a triangle lies under a flat end, its middle and gap, and the way out.

  It is `under_end` of contact/contact_weights.h, in the cylinder's frame.
  """
  out = wp.where(a[2] + b[2] + d[2] < 0.0, -1.0, 1.0)
  level = wp.abs(wp.normalize(wp.cross(b - a, d - a))[2]) >= _LEVEL
  slack = _SLACK * size[0]
  middle = wp.vec3(0.0)
  total = float(0.0)
  covered = float(0.0)
  if level:
    for i in range(_POINTS):
      for j in range(_POINTS - i):
        u = (float(i) + 1.0 / 3.0) / float(_POINTS)
        v = (float(j) + 1.0 / 3.0) / float(_POINTS)
        x = (1.0 - u - v) * a + u * b + v * d
        depth = size[1] + radius - out * x[2]
        aside = wp.sqrt(x[0] * x[0] + x[1] * x[1])
        inside = wp.min((size[0] + radius - aside - depth) / (_RIM * size[0]), 1.0)
        if depth > -slack and inside > 0.0:
          middle += (depth + slack) * inside * x
          total += (depth + slack) * inside
          covered += inside
  middle = middle / wp.max(total, 1e-30)
  share = wp.min(covered / (0.5 * float(_POINTS * (_POINTS + 1)) * _COVER), 1.0)
  return share, middle, share * (out * middle[2] - size[1] - radius), out


@wp.func
def touch(
  pos: wp.vec3,
  rot: wp.mat33,
  size: wp.vec3,
  reach: float,
  radius: float,
  a: wp.vec3,
  b: wp.vec3,
  d: wp.vec3,
):
  """Returns distance, point of a triangle and normal there of a cylinder that is nearest to it.

  The cylinder's utmost point towards the triangle's plane lies over the triangle, or an edge is
  nearest. What is farther than `reach` is not looked at closely. What touches under a flat end does
  so at its middle there; if that is not in the skin, it touches just so.
  """
  r, half = size[0], size[1]
  t = wp.transpose(rot)
  la, lb, ld = t * (a - pos), t * (b - pos), t * (d - pos)
  n = wp.normalize(wp.cross(lb - la, ld - la))
  up = n  # towards the cylinder
  if wp.dot(n, la) > 0.0:
    up = -n
  side = wp.vec2(up[0], up[1])
  utmost = wp.vec3(0.0, 0.0, wp.where(up[2] > 0.0, -half, half))
  if wp.length(side) > 1e-6:
    side = r * wp.normalize(side)
    utmost = utmost - wp.vec3(side[0], side[1], 0.0)
  dist = wp.dot(up, utmost - la)
  x = utmost - dist * up
  normal = -up
  if dist < reach and not _within(x, la, lb, ld, n):
    x = _lowest(la, lb, r, half)
    dist, normal = _beyond(x, r, half)
    for k in range(2):
      y = _lowest(wp.where(k == 0, lb, ld), wp.where(k == 0, ld, la), r, half)
      far, out = _beyond(y, r, half)
      if far < dist:
        x, dist, normal = y, far, out
  if dist < reach:
    under, middle, gap, end = _under_end(size, radius, la, lb, ld)
    if under > 0.0:
      x, normal = middle, wp.vec3(0.0, 0.0, end)
      dist = wp.min(gap + radius, reach - _JUST)
  return dist, pos + rot * x, rot * normal
