"""Where everything is in rows, and which triangle each pixel shows.

A row is a world that is drawn. `fill` enters every triangle in the pixels whose rays meet it; the
nearest one stays. Triangles that cover many pixels are left to `spread`, where a warp of a GPU goes
through their pixels.
"""

import warp as wp

from .view import NOTHING, Soft, View

LANES = 32  # that go through a large triangle
_LANES = wp.constant(LANES)
_OPAQUE = wp.constant(0.995)
_NOTHING = wp.constant(wp.uint64(NOTHING))
_SIDE = wp.constant(2**15)  # beyond any line and column


@wp.kernel(enable_backward=False)
def remember(s: Soft):
  """Keeps where a surface was; a vertex that a cut has made since was where its source was."""
  r, v = wp.tid()
  own = r * s.stride + s.first
  p = s.point[own + v]
  if wp.isnan(p[0]):
    p = s.point[own + s.source[wp.min(r, s.source.shape[0] - 1), v]]
  s.before[own + v] = p


@wp.kernel(enable_backward=False)
def follow(s: Soft):
  """Moves a surface after its organ."""
  r, v = wp.tid()
  w = s.world[r]
  p = s.base[v]
  for k in range(s.adr[v], s.adr[v + 1]):
    c = s.col[k]
    p += s.weight[k] * (wp.vec3(s.x[w, c, 0], s.x[w, c, 1], s.x[w, c, 2]) - s.rest[c])
  s.raw[r, v] = p


@wp.kernel(enable_backward=False)
def lift(s: Soft):
  """Finds the normals of a surface, weighted by areas, and lifts it off the organ."""
  r, v = wp.tid()
  n = wp.vec3()
  own = r * s.stride + s.first
  source = s.source[wp.min(r, s.source.shape[0] - 1), v]
  for k in range(s.ring_adr[source], s.ring_adr[source + 1]):
    f = s.ring[k]
    i, j, l = s.corner[r, f, 0] - own, s.corner[r, f, 1] - own, s.corner[r, f, 2] - own
    if i == v or j == v or l == v:  # a cut has given some to other vertices
      a = s.raw[r, i]
      n += wp.cross(s.raw[r, j] - a, s.raw[r, l] - a)
  n = wp.normalize(n)
  s.normal[own + v] = n
  s.point[own + v] = s.raw[r, v] + s.above[v] * n


@wp.kernel(enable_backward=False)
def aim(c: View):
  """Finds where cameras and lamps are."""
  r = wp.tid()
  c.seed[r] += 1
  c.nlarge[r] = 0
  c.pixel[r] = 2.0 * wp.tan(0.5 * c.fovy[r]) / float(c.height)
  w, b = c.world[r], c.cam_body
  look = c.xmat[w, b] * c.cam_mat[r]
  c.eye[r] = c.xpos[w, b] + c.xmat[w, b] * c.cam_pos[r] + look * wp.vec3(c.shift[r], 0.0, 0.0)
  c.look[r] = look
  for k in range(c.lamp_kind.shape[0]):
    on = c.lamp_body[k]
    if on < 0:
      c.lamp_at[r, k] = c.eye[r]
      c.lamp_to[r, k] = c.look[r] * wp.vec3(0.0, 0.0, -1.0)
    else:
      c.lamp_at[r, k] = c.xpos[w, on] + c.xmat[w, on] * c.lamp_pos[r, k]
      c.lamp_to[r, k] = wp.normalize(c.xmat[w, on] * c.lamp_dir[r, k])


@wp.kernel(enable_backward=False)
def put(c: View):
  """Finds where parts are, and which of them are in the picture."""
  r, p = wp.tid()
  w, b = c.world[r], c.part_body[p]
  size, ball, inward = c.part_size[r, p], c.ball[p], wp.transpose(c.look[r])
  axes = c.xmat[w, b] * c.part_mat[p]
  place = inward * (c.xpos[w, b] + c.xmat[w, b] * c.part_pos[r, p] - c.eye[r])
  mat = inward * axes * wp.diag(size)
  c.axes[r, p] = axes
  c.to_eye[r, p] = mat
  c.from_eye[r, p] = place
  radius = ball[3] * wp.max(size)
  m = place + mat * wp.vec3(ball[0], ball[1], ball[2])
  up, across = 0.5 * float(c.height) * c.pixel[r], 0.5 * float(c.width) * c.pixel[r]
  seen = wp.int32(1)
  if c.part_thing[p] >= 0:
    alpha = c.rgba[r, c.part_thing[p]][3]
    if alpha == 0.0:
      seen = 0
    elif alpha < _OPAQUE:
      seen = 2
  if -m[2] + radius < c.near or -m[2] - radius > c.far:
    seen = 0
  if wp.abs(m[0]) + across * m[2] > radius * wp.sqrt(1.0 + across * across):
    seen = 0
  if wp.abs(m[1]) + up * m[2] > radius * wp.sqrt(1.0 + up * up):
    seen = 0
  c.seen[r, p] = seen


@wp.func
def corners(c: View, r: int, f: int):
  """Returns the corners of a triangle in the camera's frame, as rows."""
  if f < c.soft_start:
    p = c.part[f]
    mat, place = c.to_eye[r, p], c.from_eye[r, p]
    return wp.matrix_from_rows(
      place + mat * c.corner[f, 0], place + mat * c.corner[f, 1], place + mat * c.corner[f, 2]
    )
  inward, eye, k = wp.transpose(c.look[r]), c.eye[r], f - c.soft_start
  return wp.matrix_from_rows(
    inward * (c.point[c.soft_corner[r, k, 0]] - eye),
    inward * (c.point[c.soft_corner[r, k, 1]] - eye),
    inward * (c.point[c.soft_corner[r, k, 2]] - eye),
  )


@wp.func
def ray_of(c: View, pixel: float, i: int, j: int):
  """Returns x and y of a pixel's ray at the distance 1, where a pixel has that size."""
  return wp.vec2(
    (float(j) + 0.5 - 0.5 * float(c.width)) * pixel,
    (0.5 * float(c.height) - float(i) - 0.5) * pixel,
  )


@wp.func
def shares(m: wp.mat33, at: wp.vec2):
  """Returns what the corners of a triangle weigh where a ray meets its plane; none is < 0 inside.

  The ray goes through (x, y, -1) in the camera's frame. Corners are sheared so that it becomes an
  axis (Woop, Benthin and Wald 2013, "Watertight ray/triangle intersection").
  """
  x, y = at[0], at[1]
  ax, ay = m[0, 0] + x * m[0, 2], m[0, 1] + y * m[0, 2]
  bx, by = m[1, 0] + x * m[1, 2], m[1, 1] + y * m[1, 2]
  ex, ey = m[2, 0] + x * m[2, 2], m[2, 1] + y * m[2, 2]
  return wp.vec3(bx * ey - by * ex, ex * ay - ey * ax, ax * by - ay * bx)


@wp.func
def distance(m: wp.mat33, share: wp.vec3):
  """Returns how far from the camera's plane such a place is."""
  across = share[0] * m[0, 2] + share[1] * m[1, 2] + share[2] * m[2, 2]
  return -across / (share[0] + share[1] + share[2])


@wp.func
def key_at(c: View, m: wp.mat33, f: int, at: wp.vec2):
  """Returns what a pixel's ray has met on a triangle: the nearest one is the least."""
  share = shares(m, at)
  if share[0] < 0.0 or share[1] < 0.0 or share[2] < 0.0 or wp.max(share) == 0.0:
    return _NOTHING
  t = distance(m, share)
  if t <= c.near or t >= c.far:
    return _NOTHING
  return (wp.uint64(wp.cast(t, wp.uint32)) << wp.uint64(32)) | wp.uint64(f)


@wp.kernel(enable_backward=False)
def fill(c: View, first: int):
  """Enters a triangle in the pixels that it covers; those that face away are not seen."""
  row, f = wp.tid()
  r = first + row
  if not c.chosen[r]:
    return
  clear = False
  if f < c.soft_start:
    seen = c.seen[r, c.part[f]]
    if seen == 0:
      return
    clear = seen == 2
  m = corners(c, r, f)
  a, b, e = m[0], m[1], m[2]
  if wp.dot(a, wp.cross(b - a, e - a)) >= 0.0:
    return
  pixel, half_w, half_h = c.pixel[r], 0.5 * float(c.width), 0.5 * float(c.height)
  up, across = half_h * pixel, half_w * pixel
  x, y, z = wp.vec3(a[0], b[0], e[0]), wp.vec3(a[1], b[1], e[1]), wp.vec3(-a[2], -b[2], -e[2])
  if wp.max(z) <= c.near or wp.min(z) >= c.far:
    return
  if wp.min(x - across * z) > 0.0 or wp.max(x + across * z) < 0.0:
    return
  if wp.min(y - up * z) > 0.0 or wp.max(y + up * z) < 0.0:
    return
  low, high = wp.vec2(1e9, 1e9), wp.vec2(-1e9, -1e9)
  for k in range(3):  # the part of each side that is beyond the near plane
    n = (k + 1) % 3
    if z[k] > c.near or z[n] > c.near:
      step = z[n] - z[k]
      s0, s1 = wp.float32(0.0), wp.float32(1.0)
      if z[k] < c.near:
        s0 = (c.near - z[k]) / step
      if z[n] < c.near:
        s1 = (c.near - z[k]) / step
      for end in range(2):
        s = s0 + float(end) * (s1 - s0)
        at = wp.vec2(x[k] + s * (x[n] - x[k]), y[k] + s * (y[n] - y[k])) / (z[k] + s * step)
        low, high = wp.min(low, at), wp.max(high, at)
  j0 = int(wp.ceil(wp.max(low[0] / pixel, -half_w) + half_w - 0.501))
  j1 = int(wp.floor(wp.min(high[0] / pixel, half_w) + half_w - 0.499))
  i0 = int(wp.ceil(half_h - 0.501 - wp.min(high[1] / pixel, half_h)))
  i1 = int(wp.floor(half_h - 0.499 - wp.max(low[1] / pixel, -half_h)))
  i0, j0 = wp.max(i0, 0), wp.max(j0, 0)
  i1, j1 = wp.min(i1, c.height - 1), wp.min(j1, c.width - 1)
  if i0 > i1 or j0 > j1:
    return
  if (i1 - i0 + 1) * (j1 - j0 + 1) > c.little and not clear:
    k = wp.atomic_add(c.nlarge, r, 1)
    if k < c.large.shape[1]:
      c.large[row, k] = wp.vec3i(f, i0 * _SIDE + i1, j0 * _SIDE + j1)
      return
  for i in range(i0, i1 + 1):
    for j in range(j0, j1 + 1):
      key = key_at(c, m, f, ray_of(c, pixel, i, j))
      if key != _NOTHING:
        if clear:
          wp.atomic_min(c.clear, row, i, j, key)
        else:
          wp.atomic_min(c.solid, row, i, j, key)


@wp.kernel(enable_backward=False)
def spread(c: View, first: int):
  """Enters a large triangle in its pixels, as many side by side as there are lanes."""
  row, k, lane = wp.tid()
  r = first + row
  if not c.chosen[r] or k >= c.nlarge[r]:
    return
  large, pixel = c.large[row, k], c.pixel[r]
  m = corners(c, r, large[0])
  i0, j0 = large[1] / _SIDE, large[2] / _SIDE
  width = large[2] % _SIDE - j0 + 1
  for p in range(lane, (large[1] % _SIDE - i0 + 1) * width, _LANES):
    i, j = i0 + p / width, j0 + p % width
    key = key_at(c, m, large[0], ray_of(c, pixel, i, j))
    if key != _NOTHING:
      wp.atomic_min(c.solid, row, i, j, key)
