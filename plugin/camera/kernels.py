"""Pictures of rows: which triangle each pixel shows, and the light that comes back from it.

A row is a world that is drawn. `fill` enters every triangle in the pixels whose rays meet it; the
nearest one stays. `draw` then shades each pixel once. Triangles that cover many pixels are left to
`draw`, where all pixels of a row try them side by side.

Lamps sit beside the lens, so rays from the lens are enough: what a lamp does not reach the lens
does not see, and there are no shadows. The light is OpenGL's fixed pipeline as MuJoCo sets it up
(ambient, diffuse, specular, spots and attenuation; Phong's interpolation of normals in place of
Gouraud's of colours).
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
import warp as wp
from palpate.tissue.types import Array, floats, ints, struct

from .textures import CUBE, LEVELS

_CUBE, _LEVELS = wp.constant(CUBE), wp.constant(LEVELS)
_DIRECTIONAL, _SPOT = wp.constant(1), wp.constant(0)  # mjtLightType
_OPAQUE = wp.constant(0.995)
NOTHING = 2**64 - 1  # what a pixel has met before a picture
_NOTHING = wp.constant(wp.uint64(NOTHING))
LARGEST = 64  # large triangles of a row that are kept
_LARGEST = wp.constant(LARGEST)
LIP = wp.constant(8e-4)  # width of a cut's lips [m]


@struct
class Soft:
  """An organ's surface in rows, of vertices that follow the organ's linearly."""

  first: int  # of its vertices among those of a row
  stride: int  # vertices of a row
  world: ints("nrow")
  x: floats("nworld", "nvert", 3)  # the organ's vertices [m]
  rest: Array(wp.vec3, ("nvert",))
  base: Array(wp.vec3, ("nown",))  # where the surface's are at rest
  adr: ints("nown + 1")  # what each follows
  col: ints("nweight")
  weight: floats("nweight")
  ring_adr: ints("nown + 1")  # triangles around each
  ring: ints("nring")
  above: floats("nown")  # how far it lies outside [m]
  source: ints("nrow", "nown")  # vertex before the first cut
  raw: Array(wp.vec3, ("nrow", "nown"))
  corner: ints("nrow", "nface", 3)
  point: Array(wp.vec3, ("nrow * stride",))
  normal: Array(wp.vec3, ("nrow * stride",))


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


@struct
class View:
  """What cameras see, and what they show."""

  height: int
  width: int
  little: int  # pixels around a triangle from which on it is large
  near: float  # distances that are drawn [m]
  far: float
  world: ints("nrow")
  chosen: Array(wp.bool, ("nrow",))  # whether a picture is drawn
  # Where bodies are, and what hangs on them.
  xpos: Array(wp.vec3, ("nworld", "nbody"))
  xmat: Array(wp.mat33, ("nworld", "nbody"))
  cam_body: int
  cam_pos: Array(wp.vec3, ("nrow",))  # in the frame of the body [m]
  cam_mat: Array(wp.mat33, ("nrow",))
  fovy: floats("nrow")  # [rad]
  pixel: floats("nrow")  # size of a pixel at the distance 1
  shift: floats("nrow")  # of the lens to the right, for stereo [m]
  seed: ints("nrow")  # another one in each picture
  eye: Array(wp.vec3, ("nrow",))  # in the world
  look: Array(wp.mat33, ("nrow",))
  # Surfaces: each triangle's thing, texels a metre, and by its corners normals and coordinates.
  thing: ints("nface")
  dense: floats("nface")
  flat: ints("nface")  # whether its normal is that of the triangle
  coord: Array(wp.vec3, ("nface", 3))
  corner_normal: Array(wp.vec3, ("nface", 3))
  # Parts, of bodies: a world's own place and size.
  corner: Array(wp.vec3, ("nsolid", 3))  # of triangles in the part's frame
  part: ints("nsolid")  # whose triangle it is
  part_body: ints("npart")
  part_thing: ints("npart")  # whose colour decides whether it is seen, -1 for several things'
  part_mat: Array(wp.mat33, ("npart",))
  ball: Array(wp.vec4, ("npart",))  # middle and radius in the part's frame
  part_pos: Array(wp.vec3, ("nrow", "npart"))
  part_size: Array(wp.vec3, ("nrow", "npart"))
  axes: Array(wp.mat33, ("nrow", "npart"))  # in the world
  seen: ints("nrow", "npart")  # 0 not in the picture, 1 opaque, 2 one may see through it
  to_eye: Array(wp.mat33, ("nrow", "npart"))  # from its frame to the camera's
  from_eye: Array(wp.vec3, ("nrow", "npart"))  # its place in the camera's frame
  # Organs.
  soft_start: int  # number of their first triangle
  stride: int
  soft_corner: ints("nrow", "nsoftface", 3)
  point: Array(wp.vec3, ("nrow * stride",))
  normal: Array(wp.vec3, ("nrow * stride",))
  lips: Array(wp.uint8, ("nrow", "nsoftface"))  # bits of sides that cuts have opened, and corners
  lip_thing: ints("nsoftface")
  # All of these before the last `Camera.place`; empty where no flow is asked for.
  eye_before: Array(wp.vec3, ("nrow",))
  look_before: Array(wp.mat33, ("nrow",))
  to_eye_before: Array(wp.mat33, ("nrow", "npart"))
  from_eye_before: Array(wp.vec3, ("nrow", "npart"))
  point_before: Array(wp.vec3, ("nrow * stride",))
  # Things.
  rgba: Array(wp.vec4, ("nrow", "nthing"))
  tex: ints("nrow", "nthing")
  gloss: Array(wp.vec3, ("nthing",))
  kind: Array(wp.vec2i, ("nthing",))  # number and mjtObj
  label: ints("nthing")
  texel: Array(wp.uint32, ("ntexel",))
  image: ints("nimage", 3 + LEVELS)
  sky: int
  # Lamps; the first is at the lens.
  lamp_kind: ints("nlamp")
  lamp_body: ints("nlamp")
  lamp_pos: Array(wp.vec3, ("nrow", "nlamp"))  # in the frame of its body [m]
  lamp_dir: Array(wp.vec3, ("nrow", "nlamp"))
  lamp_at: Array(wp.vec3, ("nrow", "nlamp"))  # in the world
  lamp_to: Array(wp.vec3, ("nrow", "nlamp"))
  ambient: Array(wp.vec3, ("nrow", "nlamp"))
  diffuse: Array(wp.vec3, ("nrow", "nlamp"))
  specular: Array(wp.vec3, ("nrow", "nlamp"))
  fade: Array(wp.vec3, ("nlamp",))
  spot: Array(wp.vec2, ("nlamp",))  # cosine of the cutoff, exponent
  # What pixels of some rows have met: distance, as an integer's upper half, and triangle.
  solid: Array(wp.uint64, ("nsome", "height", "width"))
  clear: Array(wp.uint64, ("nsome", "height", "width"))  # empty where nothing lets one through
  nlarge: ints("nrow")  # large triangles of a row, which `draw` tries in every pixel
  large: ints("nsome", LARGEST)
  large_at: Array(wp.mat33, ("nsome", LARGEST))  # their corners in the camera's frame
  # Pictures, empty where they are not asked for.
  pixels: Array(wp.uint8, ("nrow", "height", "width", 3))
  depth: floats("nrow", "height", "width")
  segmentation: Array(wp.vec2i, ("nrow", "height", "width"))
  labels: Array(wp.uint8, ("nrow", "height", "width"))
  points: Array(wp.vec3, ("nrow", "height", "width"))
  flow: Array(wp.vec2, ("nrow", "height", "width"))


@struct
class Hit:
  """What a ray has met."""

  t: float  # distance along the ray
  u: float
  v: float
  face: int  # -1 for nothing


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
def nothing():
  """Returns the hit of a ray that meets nothing."""
  hit = Hit()
  hit.face = -1
  return hit


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
    if k < _LARGEST:
      c.large[row, k] = f
      c.large_at[row, k] = m
      return
  for i in range(i0, i1 + 1):
    for j in range(j0, j1 + 1):
      key = key_at(c, m, f, ray_of(c, pixel, i, j))
      if key != _NOTHING:
        if clear:
          wp.atomic_min(c.clear, row, i, j, key)
        else:
          wp.atomic_min(c.solid, row, i, j, key)


@wp.func
def met(c: View, r: int, key: wp.uint64, at: wp.vec2):
  """Returns the hit that a pixel has met."""
  if key == _NOTHING:
    return nothing()
  hit = Hit()
  hit.face = int(key & wp.uint64(0xFFFFFFFF))
  m = corners(c, r, hit.face)
  share = shares(m, at)
  total = share[0] + share[1] + share[2]
  hit.t = distance(m, share)
  hit.u = share[0] / total
  hit.v = share[1] / total
  return hit


@wp.func
def texel(c: View, at: int):
  """Returns a texel's colour in [0, 1]."""
  x = c.texel[at]
  m = wp.uint32(255)
  return wp.vec3(
    float(x & m), float((x >> wp.uint32(8)) & m), float((x >> wp.uint32(16)) & m)
  ) / 255.0


@wp.func
def bilinear(c: View, start: int, width: int, height: int, at: wp.vec2, wraps: bool):
  """Returns the colour at a place of an image, in texels."""
  x, y = at[0] - 0.5, at[1] - 0.5
  i, j = int(wp.floor(x)), int(wp.floor(y))
  fx, fy = x - float(i), y - float(j)
  i0, i1, j0, j1 = i, i + 1, j, j + 1
  if wraps:
    i0, i1 = (i0 % width + width) % width, (i1 % width + width) % width
    j0, j1 = (j0 % height + height) % height, (j1 % height + height) % height
  else:
    i0, i1 = wp.clamp(i0, 0, width - 1), wp.clamp(i1, 0, width - 1)
    j0, j1 = wp.clamp(j0, 0, height - 1), wp.clamp(j1, 0, height - 1)
  low = texel(c, start + j0 * width + i0) * (1.0 - fx) + texel(c, start + j0 * width + i1) * fx
  high = texel(c, start + j1 * width + i0) * (1.0 - fx) + texel(c, start + j1 * width + i1) * fx
  return low * (1.0 - fy) + high * fy


@wp.func
def sample(c: View, tex: int, coord: wp.vec3, texels: float):
  """Returns a texture's colour where a pixel covers so many texels."""
  width = int(c.image[tex, 1])
  height = int(c.image[tex, 2])
  most = wp.log2(float(wp.min(width, height)))
  level = int(wp.clamp(wp.log2(wp.max(texels, 1.0)) + 0.5, 0.0, wp.min(most, float(_LEVELS - 1))))
  start = int(c.image[tex, 3 + level])
  for _ in range(level):
    width = width / 2
    height = height / 2
  flat = c.image[tex, 0] != _CUBE
  place = wp.vec2(coord[0], coord[1])
  if not flat:  # OpenGL's faces of a cube
    x, y, z = coord[0], coord[1], coord[2]
    ax, ay, az = wp.abs(x), wp.abs(y), wp.abs(z)
    side, at = wp.int32(4), wp.vec3(wp.sign(z) * x, -y, az)
    if z < 0.0:
      side = 5
    if ax >= ay and ax >= az:
      side, at = 0, wp.vec3(-wp.sign(x) * z, -y, ax)
      if x < 0.0:
        side = 1
    elif ay >= az:
      side, at = 2, wp.vec3(x, wp.sign(y) * z, ay)
      if y < 0.0:
        side = 3
    start += side * width * width
    place = wp.vec2(0.5 * (at[0] / at[2] + 1.0), 0.5 * (at[1] / at[2] + 1.0))
  place = wp.vec2(place[0] * float(width), place[1] * float(height))
  return bilinear(c, start, width, height, place, flat)


@wp.func
def on_lip(c: View, r: int, f: int, hit: Hit):
  """Returns whether a place on an organ's triangle is on the lip of a cut."""
  open = int(c.lips[r, f])
  if open == 0:
    return False
  i, j, l = c.soft_corner[r, f, 0], c.soft_corner[r, f, 1], c.soft_corner[r, f, 2]
  a, b, e = c.point[i], c.point[j], c.point[l]
  twice = wp.length(wp.cross(b - a, e - a))
  w = 1.0 - hit.u - hit.v
  found = False
  if (open & 1) != 0 and w * twice < LIP * wp.length(b - a):
    found = True
  if (open & 2) != 0 and hit.u * twice < LIP * wp.length(e - b):
    found = True
  if (open & 4) != 0 and hit.v * twice < LIP * wp.length(a - e):
    found = True
  return found


@wp.func
def thing_of(c: View, r: int, hit: Hit):
  """Returns the thing that a ray has met, -1 for none."""
  if hit.face < 0:
    return -1
  if hit.face >= c.soft_start:
    k = hit.face - c.soft_start
    if on_lip(c, r, k, hit):
      return c.lip_thing[k]
  return c.thing[hit.face]


@wp.func
def normal_of(c: View, r: int, hit: Hit):
  """Returns the unit normal where a ray has met a surface."""
  u, v, w = hit.u, hit.v, 1.0 - hit.u - hit.v
  f = hit.face
  if f < c.soft_start:
    n = c.corner_normal[f, 0] * u + c.corner_normal[f, 1] * v + c.corner_normal[f, 2] * w
    p = c.part[f]
    return wp.normalize(c.axes[r, p] * wp.cw_div(n, c.part_size[r, p]))
  k = f - c.soft_start
  i, j, l = c.soft_corner[r, k, 0], c.soft_corner[r, k, 1], c.soft_corner[r, k, 2]
  if c.flat[f] != 0:
    a = c.point[i]
    return wp.normalize(wp.cross(c.point[j] - a, c.point[l] - a))
  return wp.normalize(c.normal[i] * u + c.normal[j] * v + c.normal[l] * w)


@wp.func
def flow_of(c: View, r: int, hit: Hit, pixel: float, at: wp.vec2):
  """Returns the way of what a pixel shows since before, right and down [pixels].

  It was on the same triangle, with the same weights of its corners.
  """
  if hit.face < 0:
    return wp.vec2()
  u, v, w, was = hit.u, hit.v, 1.0 - hit.u - hit.v, wp.vec3()
  if hit.face < c.soft_start:
    f, p = hit.face, c.part[hit.face]
    own = c.corner[f, 0] * u + c.corner[f, 1] * v + c.corner[f, 2] * w
    was = c.from_eye_before[r, p] + c.to_eye_before[r, p] * own
  else:
    k = hit.face - c.soft_start
    i, j, l = c.soft_corner[r, k, 0], c.soft_corner[r, k, 1], c.soft_corner[r, k, 2]
    own = c.point_before[i] * u + c.point_before[j] * v + c.point_before[l] * w
    was = wp.transpose(c.look_before[r]) * (own - c.eye_before[r])
  z = wp.max(-was[2], c.near)
  return wp.vec2(at[0] - was[0] / z, was[1] / z - at[1]) / pixel


@wp.func
def light(c: View, r: int, thing: int, p: wp.vec3, n: wp.vec3, to_eye: wp.vec3):
  """Returns the light that comes from a place with the normal n."""
  own, gloss = c.rgba[r, thing], c.gloss[thing]
  colour = wp.vec3(own[0], own[1], own[2])
  matt, shine = gloss[0] * wp.vec3(1.0), wp.vec3()
  for k in range(c.lamp_kind.shape[0]):
    way = -c.lamp_to[r, k]
    share = 1.0
    if c.lamp_kind[k] == _SPOT:
      way = c.lamp_at[r, k] - p
      far = wp.length(way)
      way = way / far
      fade = c.fade[k]
      share = 1.0 / (fade[0] + far * (fade[1] + far * fade[2]))
      straight = -wp.dot(way, c.lamp_to[r, k])
      if straight < c.spot[k][0]:
        share = 0.0
      elif c.spot[k][1] > 0.0:
        share *= wp.pow(wp.max(straight, 0.0), c.spot[k][1])
    facing = wp.dot(n, way)
    matt += share * (c.ambient[r, k] + wp.max(facing, 0.0) * c.diffuse[r, k])
    if facing > 0.0:
      half = wp.normalize(way + to_eye)
      shine += share * gloss[1] * wp.pow(wp.max(wp.dot(n, half), 1e-6), gloss[2]) * c.specular[r, k]
  out = wp.cw_mul(matt, colour) + shine
  return wp.vec3(wp.min(out[0], 1.0), wp.min(out[1], 1.0), wp.min(out[2], 1.0))


@wp.func
def shade(c: View, r: int, o: wp.vec3, d: wp.vec3, pixel: float, hit: Hit):
  """Returns the colour of what a ray has met; `pixel` is a pixel's size at the distance 1."""
  p, n, long = o + hit.t * d, normal_of(c, r, hit), wp.length(d)
  thing = thing_of(c, r, hit)
  out = light(c, r, thing, p, n, d / -long)
  if c.tex[r, thing] >= 0:
    f = hit.face
    coord = c.coord[f, 0] * hit.u + c.coord[f, 1] * hit.v + c.coord[f, 2] * (1.0 - hit.u - hit.v)
    steep = wp.max(wp.abs(wp.dot(n, d)) / long, 0.15)
    out = wp.cw_mul(out, sample(c, c.tex[r, thing], coord, pixel * hit.t * c.dense[f] / steep))
  return out


@wp.kernel(enable_backward=False)
def draw(c: View, start: int):
  """Draws a pixel of a row; 32 neighbours in 8 columns and 4 lines are near in time."""
  row, tile, k = wp.tid()
  r = start + row
  across = (c.width + 7) / 8
  i, j = tile / across * 4 + k / 8, tile % across * 8 + k % 8
  if i >= c.height or j >= c.width or not c.chosen[r]:
    return
  pixel = c.pixel[r]
  at = ray_of(c, pixel, i, j)
  d = c.look[r] * wp.vec3(at[0], at[1], -1.0)  # a distance along it is one from the camera's plane
  o = c.eye[r]
  nearest = c.solid[row, i, j]
  c.solid[row, i, j] = _NOTHING
  for l in range(wp.min(c.nlarge[r], _LARGEST)):
    nearest = wp.min(nearest, key_at(c, c.large_at[row, l], c.large[row, l], at))
  solid, clear = met(c, r, nearest, at), nothing()
  if c.clear.shape[0] > 0:
    key = c.clear[row, i, j]
    if key < nearest:
      clear = met(c, r, key, at)
    c.clear[row, i, j] = _NOTHING
  first = solid
  if clear.face >= 0:
    first = clear
  seen = thing_of(c, r, first)
  z = c.far
  if first.face >= 0:
    z = first.t
  if c.depth.shape[0] > 0:
    c.depth[r, i, j] = z
  if c.points.shape[0] > 0:
    c.points[r, i, j] = wp.vec3()
    if first.face >= 0:
      c.points[r, i, j] = wp.vec3(z * at[0], -z * at[1], z)
  if c.flow.shape[0] > 0:
    c.flow[r, i, j] = flow_of(c, r, first, pixel, at)
  if c.segmentation.shape[0] > 0:
    c.segmentation[r, i, j] = wp.vec2i(-1, -1)
    if first.face >= 0:
      c.segmentation[r, i, j] = c.kind[seen]
  if c.labels.shape[0] > 0:
    c.labels[r, i, j] = wp.uint8(0)
    if first.face >= 0:
      c.labels[r, i, j] = wp.uint8(c.label[seen])
  if c.pixels.shape[0] > 0:
    out = wp.vec3()
    if solid.face < 0 and c.sky >= 0:
      out = sample(c, c.sky, wp.vec3(d[0], d[2], -d[1]), 1.0)
    hit, left = solid, wp.int32(2)
    while left > 0:  # first what is behind, then what one sees through: a loop of one body
      if hit.face >= 0:
        through = wp.float32(0.0)
        if left == 1:  # MuJoCo draws it twice
          through = 1.0 - c.rgba[r, c.thing[clear.face]][3]
        out = through * through * out + (1.0 - through * through) * shade(c, r, o, d, pixel, hit)
      hit = clear
      left -= 1
    for l in range(3):
      c.pixels[r, i, j, l] = wp.uint8(wp.clamp(255.0 * out[l] + 0.5, 0.0, 255.0))

