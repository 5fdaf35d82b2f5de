"""What the kernels of cameras read and write."""

import warp as wp
from palpate.tissue.types import Array, floats, ints, struct

from .textures import LEVELS

NOTHING = 2**64 - 1  # what a pixel has met before a picture


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
  before: Array(wp.vec3, ("nrow * stride",))  # `point` of the last picture; empty without flow


@struct
class Pictures:
  """Pictures of rows; those that are not asked for are empty."""

  pixels: Array(wp.uint8, ("nrow", "height", "width", 3))
  depth: floats("nrow", "height", "width")  # from the camera's plane [m]
  segmentation: Array(wp.vec2i, ("nrow", "height", "width"))  # number and mjtObj, -1 for nothing
  labels: Array(wp.uint8, ("nrow", "height", "width"))
  points: Array(wp.vec3, ("nrow", "height", "width"))  # right, down, ahead of the lens [m]
  flow: Array(wp.vec2, ("nrow", "height", "width"))  # right and down [pixels]
  soiling: Array(wp.uint8, ("nrow", "height", "width", 2))  # smoke and blood on a lens


@struct
class View:
  """What cameras see, and what they show."""

  height: int
  width: int
  little: int  # pixels around a triangle beyond which it is large
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
  # Large triangles of a row: their number, and of each its lines and its columns, first and last.
  nlarge: ints("nrow")
  large: Array(wp.vec3i, ("nsome", "nlarge"))
  out: Pictures
