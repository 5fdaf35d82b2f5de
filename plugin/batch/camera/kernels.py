"""Rays from cameras: what they meet, and the light that comes back.

A row is a world that is drawn. Lamps sit beside the lens, so rays from the lens are enough: what a
lamp does not reach the lens does not see, and there are no shadows. The light is OpenGL's fixed
pipeline as MuJoCo sets it up (ambient, diffuse, specular, spots and attenuation; Phong's
interpolation of normals in place of Gouraud's of colours).
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
import warp as wp
from palpate.tissue.types import Array, floats, ints, struct

from .textures import CUBE, LEVELS

_CUBE, _LEVELS = wp.constant(CUBE), wp.constant(LEVELS)
_DIRECTIONAL, _SPOT = wp.constant(1), wp.constant(0)  # mjtLightType
_OPAQUE = wp.constant(0.995)
_PIERCE = wp.constant(8)  # back sides that a ray passes
SMOKE = wp.constant(0.75)  # grey of smoke
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
  film: Array(wp.vec3, ("nrow",))  # share of smoke, exposure, noise
  count: ints(1)  # pictures so far
  eye: Array(wp.vec3, ("nrow",))  # in the world
  look: Array(wp.mat33, ("nrow",))
  # Surfaces: each triangle's thing, texels a metre, and by its corners normals and coordinates.
  thing: ints("nface")
  dense: floats("nface")
  flat: ints("nface")  # whether its normal is that of the triangle
  coord: Array(wp.vec3, ("nface", 3))
  corner_normal: Array(wp.vec3, ("nface", 3))
  # Parts, of bodies: a world's own place and size.
  mesh: Array(wp.uint64, ("npart",))
  start: ints("npart")  # first triangle
  part_body: ints("npart")
  part_thing: ints("npart")  # whose colour decides whether it is seen, -1 for several things'
  part_mat: Array(wp.mat33, ("npart",))
  ball: Array(wp.vec4, ("npart",))  # middle and radius in the part's frame
  part_pos: Array(wp.vec3, ("nrow", "npart"))
  part_size: Array(wp.vec3, ("nrow", "npart"))
  bound: Array(wp.vec4, ("nrow", "npart"))  # middle and radius in the world; no radius, not seen
  place: Array(wp.vec3, ("nrow", "npart"))
  axes: Array(wp.mat33, ("nrow", "npart"))
  # Organs.
  soft: wp.uint64
  root: ints("nrow")
  soft_start: int
  stride: int
  soft_corner: ints("nrow", "nsoftface", 3)
  point: Array(wp.vec3, ("nrow * stride",))
  normal: Array(wp.vec3, ("nrow * stride",))
  lips: Array(wp.uint8, ("nrow", "nsoftface"))  # bits of sides that cuts have opened, and corners
  lip_thing: ints("nsoftface")
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
  # Pictures, empty where they are not asked for.
  pixels: Array(wp.uint8, ("nrow", "height", "width", 3))
  depth: floats("nrow", "height", "width")
  segmentation: Array(wp.vec2i, ("nrow", "height", "width"))
  labels: Array(wp.uint8, ("nrow", "height", "width"))
  points: Array(wp.vec3, ("nrow", "height", "width"))


@struct
class Hit:
  """What a ray has met."""

  t: float  # distance along the ray
  u: float
  v: float
  face: int  # -1 for nothing
  part: int  # -1 for an organ
  soft: int  # triangle among those of a row
  normal: wp.vec3


@wp.kernel(enable_backward=False)
def aim(c: View):
  """Finds where cameras and lamps are."""
  r = wp.tid()
  if r == 0:
    c.count[0] = c.count[0] + 1
  w, b = c.world[r], c.cam_body
  c.eye[r] = c.xpos[w, b] + c.xmat[w, b] * c.cam_pos[r]
  c.look[r] = c.xmat[w, b] * c.cam_mat[r]
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
  """Finds where parts are."""
  r, p = wp.tid()
  w, b = c.world[r], c.part_body[p]
  size, ball = c.part_size[r, p], c.ball[p]
  mat = c.xmat[w, b] * c.part_mat[p]
  place = c.xpos[w, b] + c.xmat[w, b] * c.part_pos[r, p]
  radius = ball[3] * wp.max(size)
  if c.part_thing[p] >= 0 and c.rgba[r, c.part_thing[p]][3] == 0.0:
    radius = 0.0
  middle = place + mat * wp.cw_mul(size, wp.vec3(ball[0], ball[1], ball[2]))
  c.place[r, p] = place
  c.axes[r, p] = mat
  c.bound[r, p] = wp.vec4(middle[0], middle[1], middle[2], radius)


@wp.func
def nothing(far: float):
  """Returns the hit of a ray that meets nothing so far away."""
  hit = Hit()
  hit.t = far
  hit.face = -1
  hit.part = -1
  return hit


@wp.func
def cast(mesh: wp.uint64, root: int, o: wp.vec3, d: wp.vec3, before: Hit):
  """Meets the front of a mesh nearer than a hit; back sides are not seen."""
  hit = before
  start, passed = wp.float32(0.0), wp.int32(0)
  while passed < _PIERCE:  # a loop that is not unrolled
    q = wp.mesh_query_ray(mesh, o + start * d, d, before.t - start, root)
    passed += 1
    if q.result and q.sign > 0.0:
      hit.t = start + q.t
      hit.u = q.u
      hit.v = q.v
      hit.normal = q.normal
      hit.face = q.face
    if not q.result or q.sign > 0.0:
      passed = _PIERCE
    start += q.t * (1.0 + 1e-5) + 1e-7
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
  if hit.part < 0:
    if on_lip(c, r, hit.soft, hit):
      return c.lip_thing[hit.soft]
  return c.thing[hit.face]


@wp.func
def normal_of(c: View, r: int, hit: Hit):
  """Returns the unit normal where a ray has met a surface."""
  u, v, w = hit.u, hit.v, 1.0 - hit.u - hit.v
  f = hit.face
  if hit.part >= 0:
    n = c.corner_normal[f, 0] * u + c.corner_normal[f, 1] * v + c.corner_normal[f, 2] * w
    return wp.normalize(c.axes[r, hit.part] * wp.cw_div(n, c.part_size[r, hit.part]))
  if c.flat[f] != 0:
    return wp.normalize(hit.normal)
  i, j, l = (
    c.soft_corner[r, hit.soft, 0], c.soft_corner[r, hit.soft, 1], c.soft_corner[r, hit.soft, 2]
  )
  return wp.normalize(c.normal[i] * u + c.normal[j] * v + c.normal[l] * w)


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


@wp.func
def meet(c: View, r: int, o: wp.vec3, d: wp.vec3):
  """Returns what a ray meets first, and what it meets first that it may pass through.

  Organs come first, then parts: one place in the code casts rays, which keeps it short.
  """
  solid, clear = nothing(c.far - c.near), nothing(c.far - c.near)
  length2 = wp.dot(d, d)
  for k in range(-1, c.mesh.shape[0]):
    mesh, root, alpha = wp.uint64(c.soft), wp.int32(-1), wp.float32(1.0)
    own, way = wp.vec3(o), wp.vec3(d)
    if k < 0:
      if c.soft != wp.uint64(0):
        root = c.root[r]
    else:
      bound = c.bound[r, k]
      to = wp.vec3(bound[0], bound[1], bound[2]) - o
      along = wp.dot(to, d)
      reach = bound[3] * bound[3]
      mesh = wp.uint64(0)
      if reach > 0.0 and wp.dot(to, to) * length2 - along * along <= reach * length2:
        mesh = c.mesh[k]
        size, turn = c.part_size[r, k], wp.transpose(c.axes[r, k])
        own, way = wp.cw_div(turn * (o - c.place[r, k]), size), wp.cw_div(turn * d, size)
        if c.part_thing[k] >= 0:
          alpha = c.rgba[r, c.part_thing[k]][3]
    if mesh != wp.uint64(0):
      before = solid
      if alpha < _OPAQUE:
        before = clear
      hit = cast(mesh, root, own, way, before)
      if hit.t < before.t:
        hit.part = k
        if k < 0:
          hit.soft = hit.face - r * c.soft_corner.shape[1]
          hit.face = c.soft_start + hit.soft
        else:
          hit.face = c.start[k] + hit.face
        if alpha < _OPAQUE:
          clear = hit
        else:
          solid = hit
  if clear.t >= solid.t:
    clear.face = -1
  return solid, clear


@wp.kernel(enable_backward=False)
def draw(c: View):
  """Draws a pixel of a row; 32 neighbours in 8 columns and 4 lines are near in time."""
  r, tile, k = wp.tid()
  across = (c.width + 7) / 8
  i, j = tile / across * 4 + k / 8, tile % across * 8 + k % 8
  if i >= c.height or j >= c.width or not c.chosen[r]:
    return
  pixel = 2.0 * wp.tan(0.5 * c.fovy[r]) / float(c.height)
  x = (float(j) + 0.5 - 0.5 * float(c.width)) * pixel
  y = (0.5 * float(c.height) - float(i) - 0.5) * pixel
  d = c.look[r] * wp.vec3(x, y, -1.0)  # a distance along it is one from the camera's plane
  o = c.eye[r] + c.near * d
  solid, clear = meet(c, r, o, d)
  first = solid
  if clear.face >= 0:
    first = clear
  seen = thing_of(c, r, first)
  z = c.far
  if first.face >= 0:
    z = c.near + first.t
  if c.depth.shape[0] > 0:
    c.depth[r, i, j] = z
  if c.points.shape[0] > 0:
    c.points[r, i, j] = wp.vec3()
    if first.face >= 0:
      c.points[r, i, j] = wp.vec3(z * x, -z * y, z)
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
          through = 1.0 - c.rgba[r, c.part_thing[clear.part]][3]
        out = through * through * out + (1.0 - through * through) * shade(c, r, o, d, pixel, hit)
      hit = clear
      left -= 1
    film = c.film[r]
    out = film[1] * ((1.0 - film[0]) * out + film[0] * SMOKE * wp.vec3(1.0))
    if film[2] > 0.0:
      grain = wp.rand_init(c.count[0], (r * c.height + i) * c.width + j)
      out += film[2] * wp.vec3(wp.randn(grain), wp.randn(grain), wp.randn(grain))
    for l in range(3):
      c.pixels[r, i, j, l] = wp.uint8(wp.clamp(255.0 * out[l] + 0.5, 0.0, 255.0))


@wp.kernel(enable_backward=False)
def find_roots(mesh: wp.uint64, root: wp.array[int]):
  """Finds where the triangles of each row are in the tree of all."""
  r = wp.tid()
  root[r] = wp.mesh_get_group_root(mesh, r)
