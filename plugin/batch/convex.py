"""A triangle before a convex tool, a cylinder or a mesh, by mujoco_warp's GJK and EPA."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import mujoco
import numpy as np
import warp as wp

# All that depends on names inside of mujoco_warp, with those of `contacts`.
from mujoco_warp._src.collision_core import Geom
from mujoco_warp._src.collision_gjk import ccd
from mujoco_warp._src.types import MJ_MAX_EPAFACES, MJ_MAX_EPAHORIZON, GeomType
from palpate.tissue.types import Array, fill, floats, ints, struct

KINDS = {int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_MESH)}
_ROUNDS = wp.constant(16)  # of GJK and of EPA, at most
_MESH, _TRIANGLE = wp.constant(int(GeomType.MESH)), wp.constant(int(GeomType.TRIANGLE))
_TOLERANCE = wp.constant(1e-6)  # [m]
_APART = wp.constant(1e10)  # distance of what does not touch


@struct
class Convex:
  """Convex tools, and what EPA needs of memory for each slot of each world."""

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
def _beyond(box: wp.vec3, x: wp.vec3):
  """Returns the distance of a point from a box about the origin."""
  far = wp.max(wp.abs(x) - box, wp.vec3(0.0))
  return wp.length(far)


@wp.func
def touch(
  k: Convex,
  tool: int,
  kind: int,
  size: wp.vec3,
  pos: wp.vec3,
  rot: wp.mat33,
  reach: float,
  thread: int,
  world: int,
  a: wp.vec3,
  b: wp.vec3,
  d: wp.vec3,
):
  """Returns distance, middle and normal between a convex tool and a triangle without skin.

  Args:
    k: convex tools
    tool: number of the tool
    kind: its mjtGeom
    size: as geom_size
    pos: where it is
    rot: its axes
    reach: distance beyond which no more is asked than that it is
    thread: whose memory EPA has
    world: the world
    a: corner of the triangle
    b: the next
    d: the last
  """
  # About the tool, where float32 has the most digits.
  ta = a - pos
  tb = b - pos
  td = d - pos
  centre = (ta + tb + td) / 3.0
  around = wp.max(wp.length(ta - centre), wp.max(wp.length(tb - centre), wp.length(td - centre)))
  near = wp.transpose(rot) * centre - k.middle[tool]
  dist = float(_APART)  # a variable to Warp
  middle = wp.vec3(0.0)
  normal = wp.normalize(wp.cross(tb - ta, td - ta))
  if wp.dot(normal, centre) < 0.0:
    normal = -normal
  if _beyond(k.half[tool], near) < around + reach:
    one = Geom()
    one.pos = wp.vec3(0.0)
    one.rot = rot
    one.size = size
    one.margin = 0.0
    one.index = -1
    if kind == _MESH:
      mesh = k.mesh[tool]
      one.vertadr = k.vertadr[mesh]
      one.vertnum = k.vertnum[mesh]
      one.graphadr = k.graphadr[mesh]
      one.vert = k.vert
      one.graph = k.graph
    other = Geom()
    other.pos = wp.vec3(0.0)
    other.rot = wp.mat33(ta[0], ta[1], ta[2], tb[0], tb[1], tb[2], td[0], td[1], td[2])
    other.margin = 0.0
    other.index = -1
    found, n, x, y, _index = ccd(
      _TOLERANCE, reach, _ROUNDS, _ROUNDS, one, other, kind, _TRIANGLE, wp.vec3(0.0), centre,
      k.point[thread], k.index[thread], k.face[thread], k.onto[thread], k.norm2[thread],
      k.horizon[thread], False, world, k.lost,
    )  # fmt: skip
    if n > 0 and found < reach:
      dist = found
      middle = pos + 0.5 * (x + y)
      apart = y - x
      if found < 0.0:
        apart = x - y
      if wp.length(apart) > _TOLERANCE:
        normal = wp.normalize(apart)
  return dist, middle, normal


def make(model: mujoco.MjModel, tools: np.ndarray, nthread: int, m, d):
  """Returns the convex tools of an organ.

  Args:
    model: the compiled scene
    tools: geoms that the slots follow
    nthread: slots of all worlds
    m: mujoco_warp's model
    d: its data
  """
  kinds = model.geom_type[tools]
  many = nthread if KINDS & set(kinds.tolist()) else 0
  npoint, nface = 10 + 2 * _ROUNDS, 6 + MJ_MAX_EPAFACES * _ROUNDS

  def room(dtype, n):
    return wp.empty((many, n), dtype=dtype, device=d.nacon.device)

  values = dict(
    middle=model.geom_aabb[tools, :3],
    half=model.geom_aabb[tools, 3:],
    mesh=np.where(kinds == int(mujoco.mjtGeom.mjGEOM_MESH), model.geom_dataid[tools], -1),
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
