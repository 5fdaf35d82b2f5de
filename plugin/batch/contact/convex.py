"""A triangle before a mesh, by mujoco_warp's GJK and EPA, and before the box about any tool."""

import mujoco
import numpy as np
import warp as wp

# All that depends on names inside of mujoco_warp, with those of `contacts`.
from palpate.tissue.types import Array, fill, floats, ints, struct

from ..mjw.private import MJ_MAX_EPAFACES, MJ_MAX_EPAHORIZON, Geom, GeomType, ccd
from ..organ.patch import halves

KINDS = {int(mujoco.mjtGeom.mjGEOM_MESH)}
_ROUNDS = wp.constant(16)  # of GJK and of EPA, at most
_MESH, _TRIANGLE = wp.constant(int(GeomType.MESH)), wp.constant(int(GeomType.TRIANGLE))
_TOLERANCE = wp.constant(1e-6)  # [m]
_APART = wp.constant(1e10)  # distance of what does not touch


@struct
class Convex:
  """Tools, and what EPA needs of memory for each slot of each world."""

  middle: Array(wp.vec3, ("ntool",))  # of a tool's box, in its frame [m]
  half: Array(wp.vec3, ("ntool",))  # half its sides [m]
  mesh: ints("ntool")  # its mesh, -1 for none
  vertadr: ints("nmesh")
  vertnum: ints("nmesh")
  graphadr: ints("nmesh")
  vert: Array(wp.vec3, ("nmeshvert",))
  graph: ints("nmeshgraph")
  point: Array(wp.vec3, ("nthread", "npoint"))
  index: ints("nthread", "npoint")
  face: ints("nthread", "nface")
  onto: Array(wp.vec3, ("nthread", "nface"))
  norm2: floats("nthread", "nface")
  horizon: ints("nthread", "nhorizon")
  lost: ints("nworld")  # mujoco_warp's bits of what it had no room for


@wp.func
def is_beyond(k: Convex, tool: int, pos: wp.vec3, rot: wp.mat33, centre: wp.vec3, around: float):
  """Returns whether a ball is beyond the box about a tool."""
  near = wp.transpose(rot) * (centre - pos) - k.middle[tool]
  far = wp.max(wp.abs(near) - k.half[tool], wp.vec3(0.0))
  return wp.length_sq(far) >= around * around


@wp.func
def _tool(k: Convex, tool: int, kind: int, size: wp.vec3, rot: wp.mat33):
  """Returns a tool about the origin."""
  out = Geom()
  out.pos = wp.vec3(0.0)
  out.rot = rot
  out.size = size
  out.margin = 0.0
  out.index = -1
  if kind == _MESH:
    mesh = k.mesh[tool]
    out.vertadr = k.vertadr[mesh]
    out.vertnum = k.vertnum[mesh]
    out.graphadr = k.graphadr[mesh]
    out.vert = k.vert
    out.graph = k.graph
  return out


@wp.func
def _triangle(a: wp.vec3, b: wp.vec3, d: wp.vec3):
  """Returns a triangle."""
  out = Geom()
  out.pos = wp.vec3(0.0)
  out.rot = wp.mat33(a[0], a[1], a[2], b[0], b[1], b[2], d[0], d[1], d[2])
  out.margin = 0.0
  out.index = -1
  return out


@wp.struct
class Before:
  """A tool before a triangle: what `touch` is asked about."""

  tool: int  # number of the tool
  kind: int  # its mjtGeom
  size: wp.vec3  # as geom_size
  pos: wp.vec3  # where it is
  rot: wp.mat33  # its axes
  reach: float  # distance beyond which no more is asked than that it is
  thread: int  # whose memory EPA has
  world: int


@wp.func
def touch(k: Convex, t: Before, a: wp.vec3, b: wp.vec3, d: wp.vec3):
  """Returns distance, middle and normal between a mesh and a triangle without skin."""
  # About the tool, where float32 has the most digits.
  ta = a - t.pos
  tb = b - t.pos
  td = d - t.pos
  centre = (ta + tb + td) / 3.0
  dist = float(_APART)  # a variable to Warp
  middle = wp.vec3(0.0)
  normal = wp.normalize(wp.cross(tb - ta, td - ta))
  if wp.dot(normal, centre) < 0.0:
    normal = -normal
  i = t.thread
  found, n, x, y, _index = ccd(
    _TOLERANCE, t.reach, _ROUNDS, _ROUNDS, _tool(k, t.tool, t.kind, t.size, t.rot),
    _triangle(ta, tb, td), t.kind, _TRIANGLE, wp.vec3(0.0), centre, k.point[i], k.index[i],
    k.face[i], k.onto[i], k.norm2[i], k.horizon[i], False, t.world, k.lost,
  )  # fmt: skip
  if n > 0 and found < t.reach:
    dist = found
    middle = t.pos + 0.5 * (x + y)
    apart = y - x
    if found < 0.0:
      apart = x - y
    if wp.length(apart) > _TOLERANCE:
      normal = wp.normalize(apart)
  return dist, middle, normal


def make(model: mujoco.MjModel, tools: np.ndarray, lines: list, nthread: int, m, d):
  """Returns the convex tools of an organ.

  Args:
    model: the compiled scene
    tools: geoms that the slots follow
    lines: threads that they follow, which have boxes
    nthread: slots of all worlds
    m: mujoco_warp's model
    d: its data
  """
  kinds = model.geom_type[tools]
  many = nthread if KINDS & set(kinds.tolist()) else 0
  npoint, nface = 10 + 2 * _ROUNDS, 6 + MJ_MAX_EPAFACES * _ROUNDS

  def room(dtype, n):
    return wp.empty((many, n), dtype=dtype, device=d.nacon.device)

  radius, half = halves(lines)
  box = np.stack([radius, radius, radius + half], axis=1)
  mesh = np.where(kinds == int(mujoco.mjtGeom.mjGEOM_MESH), model.geom_dataid[tools], -1)
  values = dict(
    middle=np.concatenate([model.geom_aabb[tools, :3], 0.0 * box]),
    half=np.concatenate([model.geom_aabb[tools, 3:], box]),
    mesh=np.append(mesh, np.full(len(half), -1)),
    vertadr=m.mesh_vertadr,
    vertnum=m.mesh_vertnum,
    graphadr=m.mesh_graphadr,
    vert=m.mesh_vert,
    graph=m.mesh_graph,
    point=room(wp.vec3, npoint),
    index=room(wp.int32, npoint),
    face=room(wp.int32, nface),
    onto=room(wp.vec3, nface),
    norm2=room(wp.float32, nface),
    horizon=room(wp.int32, MJ_MAX_EPAHORIZON),
    lost=d.overflow,
  )  # fmt: skip
  return fill(Convex, d.nacon.device, values)


def bytes_of(kinds: np.ndarray, nslot: int) -> float:
  """Returns about how many bytes a world takes for tools of these kinds."""
  npoint, nface = 10 + 2 * _ROUNDS, 6 + MJ_MAX_EPAFACES * _ROUNDS
  each = 16 * npoint + 20 * nface + 4 * MJ_MAX_EPAHORIZON
  return float(nslot * each) if KINDS & set(kinds.tolist()) else 0.0
