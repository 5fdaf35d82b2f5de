"""The light that comes back from what pixels show.

Lamps sit beside the lens, so rays from the lens are enough: what a lamp does not reach the lens
does not see, and there are no shadows. The light is OpenGL's fixed pipeline as MuJoCo sets it up
(ambient, diffuse, specular, spots and attenuation; Phong's interpolation of normals in place of
Gouraud's of colours).
"""

import warp as wp
from palpate.engine.cutting.walls import LIP
from palpate.tissue.types import struct

from .filling import corners, distance, ray_of, shares
from .textures import CUBE, LEVELS
from .view import NOTHING, View

_CUBE, _LEVELS = wp.constant(CUBE), wp.constant(LEVELS)
_SPOT = wp.constant(0)  # mjtLightType
_NOTHING = wp.constant(wp.uint64(NOTHING))
_LIP = wp.constant(LIP)


@struct
class Hit:
  """What a ray has met."""

  t: float  # distance along the ray
  u: float
  v: float
  face: int  # -1 for nothing


@wp.func
def nothing():
  """Returns the hit of a ray that meets nothing."""
  hit = Hit()
  hit.face = -1
  return hit


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
  if (open & 1) != 0 and w * twice < _LIP * wp.length(b - a):
    found = True
  if (open & 2) != 0 and hit.u * twice < _LIP * wp.length(e - b):
    found = True
  if (open & 4) != 0 and hit.v * twice < _LIP * wp.length(a - e):
    found = True
  p = hit.u * a + hit.v * b + w * e  # a lip goes on into triangles that it only meets at a corner
  if (open & 8) != 0 and wp.length(p - a) < _LIP:
    found = True
  if (open & 16) != 0 and wp.length(p - b) < _LIP:
    found = True
  if (open & 32) != 0 and wp.length(p - e) < _LIP:
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
  if c.out.depth.shape[0] > 0:
    c.out.depth[r, i, j] = z
  if c.out.points.shape[0] > 0:
    c.out.points[r, i, j] = wp.vec3()
    if first.face >= 0:
      c.out.points[r, i, j] = wp.vec3(z * at[0], -z * at[1], z)
  if c.out.flow.shape[0] > 0:
    c.out.flow[r, i, j] = flow_of(c, r, first, pixel, at)
  if c.out.segmentation.shape[0] > 0:
    c.out.segmentation[r, i, j] = wp.vec2i(-1, -1)
    if first.face >= 0:
      c.out.segmentation[r, i, j] = c.kind[seen]
  if c.out.labels.shape[0] > 0:
    c.out.labels[r, i, j] = wp.uint8(0)
    if first.face >= 0:
      c.out.labels[r, i, j] = wp.uint8(c.label[seen])
  if c.out.pixels.shape[0] > 0:
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
      c.out.pixels[r, i, j, l] = wp.uint8(wp.clamp(255.0 * out[l] + 0.5, 0.0, 255.0))

