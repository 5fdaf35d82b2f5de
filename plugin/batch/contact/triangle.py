"""Geometry of contacts: a triangle before an ellipsoid or an edge of a thread, and axes."""

import warp as wp

from ..mjw import private

_FAR = wp.constant(1e10)  # what mujoco_warp says of a contact that is none


@wp.func
def axes(normal: wp.vec3):
  """Returns the axes of a contact, its normal first."""
  n = wp.normalize(normal)
  side = wp.vec3(0.0, 1.0, 0.0)
  if wp.abs(n[1]) >= 0.5:
    side = wp.vec3(0.0, 0.0, 1.0)
  t = wp.normalize(side - wp.dot(side, n) * n)
  u = wp.cross(n, t)
  return wp.mat33(n[0], n[1], n[2], t[0], t[1], t[2], u[0], u[1], u[2])


@wp.func
def ball(a: wp.vec3, b: wp.vec3, d: wp.vec3):
  """Returns middle and radius of a ball about a triangle."""
  centre = (a + b + d) / 3.0
  far = wp.max(wp.length_sq(a - centre), wp.length_sq(b - centre))
  return centre, wp.sqrt(wp.max(far, wp.length_sq(d - centre)))


@wp.func
def ellipsoid(pos: wp.vec3, rot: wp.mat33, size: wp.vec3, a: wp.vec3, b: wp.vec3, d: wp.vec3):
  """Returns distance, place and normal of the point of a triangle that is nearest to an ellipsoid.

  Nearest is meant in units of its half axes; the distance is that of `core/geom.h`.
  """
  t = wp.transpose(rot)
  la = wp.cw_div(t * (a - pos), size)
  lb = wp.cw_div(t * (b - pos), size)
  ld = wp.cw_div(t * (d - pos), size)
  dist, nearest, _normal = private.sphere_triangle(wp.vec3(0.0), 0.0, la, lb, ld, 0.0, _FAR)
  k = wp.normalize(nearest) * wp.max(dist, 1e-6)
  r = wp.length(k)
  gradient = wp.cw_div(k, size)
  e = wp.length(gradient)
  where = pos + rot * wp.cw_mul(k, size)
  return r * (r - 1.0) / wp.max(e, 1e-12), where, rot * wp.normalize(gradient)


@wp.func
def _between(p: wp.vec3, d: wp.vec3, q: wp.vec3, e: wp.vec3):
  """Returns the nearest points of the segments from p along d and from q along e, and how far."""
  r = p - q
  dd, ee, de = wp.dot(d, d), wp.dot(e, e), wp.dot(d, e)
  dr, er = wp.dot(d, r), wp.dot(e, r)
  apart = dd * ee - de * de
  s = float(0.5)
  if apart > 1e-6 * dd * ee:
    s = wp.clamp((de * er - dr * ee) / apart, 0.0, 1.0)
  t = wp.clamp((de * s + er) / ee, 0.0, 1.0)
  s = wp.clamp((de * t - dr) / dd, 0.0, 1.0)
  x = p + s * d
  y = q + t * e
  return wp.length(y - x), x, y


@wp.func
def edge(
  pos: wp.vec3, axis: wp.vec3, radius: float, half: float, a: wp.vec3, b: wp.vec3, d: wp.vec3,
  skin: float, margin: float,
):  # fmt: skip
  """Returns distance, place and normal of the point of an edge that is nearest to a triangle."""
  start = pos - half * axis
  dist, x, normal = private.sphere_triangle(start, radius, a, b, d, skin, margin)
  other, y, n = private.sphere_triangle(pos + half * axis, radius, a, b, d, skin, margin)
  if other < dist:
    dist, x, normal = other, y, n
  for k in range(3):
    corner = wp.where(k == 0, a, wp.where(k == 1, b, d))
    along = wp.where(k == 0, b, wp.where(k == 1, d, a)) - corner
    far, here, there = _between(start, 2.0 * half * axis, corner, along)
    if far - radius - skin < dist and far > 1e-9:
      dist = far - radius - skin
      normal = (there - here) / far
      x = here + (radius + 0.5 * dist) * normal
  return dist, x, normal
