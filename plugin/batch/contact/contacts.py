"""Contacts of an organ's window with tools, written where mujoco_warp makes constraints of them.

They are looked for twice: counted, then written one after the other, by worlds and slots. So no
place is left empty, which mujoco_warp's kernels would run over, and which contact is where does not
depend on who comes first.
"""

import functools
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp

# All that depends on names inside of mujoco_warp: its tools against a triangle, and types.
from palpate.engine import contacts
from palpate.tissue.types import Array, fill, floats, ints

from ..kernels import triple
from ..mjw import private
from ..mjw.arrays import arrays_of, theirs
from ..mjw.private import ContactType, vec5
from ..organ.patch import Patch, halves
from . import convex, cylinder, triangle
from .convex import Convex

if TYPE_CHECKING:
  from ..organ.organ import Organ

_GEOM = mujoco.mjtGeom
# Contacts of a triangle with a tool, at most, as mujoco_warp finds them.
_EACH = {
  int(_GEOM.mjGEOM_SPHERE): 1,
  int(_GEOM.mjGEOM_ELLIPSOID): 1,
  int(_GEOM.mjGEOM_CAPSULE): 5,
  int(_GEOM.mjGEOM_BOX): 11,
  int(_GEOM.mjGEOM_PLANE): 1,  # a corner, see `find`
  int(_GEOM.mjGEOM_CYLINDER): 1,
  int(_GEOM.mjGEOM_MESH): 1,
}
KINDS = tuple(_EACH)  # of tools that a batch knows
LINE = int(_GEOM.mjGEOM_LINE)  # an edge of a thread
_SPHERE, _ELLIPSOID, _CAPSULE, _BOX, _PLANE = (wp.constant(kind) for kind in KINDS[:5])
_CYLINDER, _MESH = KINDS[5:]
_CONSTRAINT = wp.constant(int(ContactType.CONSTRAINT))
_LEAST = 1e-5  # friction, as in MuJoCo
_HARD = (1.0, 1.0, 1.0, 0.5, 2.0)  # solimp; `sliding` makes contacts as soft as they are
_FEW = 4  # tools; more of them share triangles
# Whose sliding friction counts: the greater, or that of the one with priority.
_MIXED = {"margin": (), "slide": (), "whose": (), "condim": (), "friction": (5,), "solref": (2,),
          "solimp": (5,)}  # fmt: skip
_GREATER, _TOOL, _ORGAN = wp.constant(0), wp.constant(1), wp.constant(2)


@theirs(
  "out_",
  data="nacon",
  contact="dist pos frame includemargin friction solref solreffriction solimp dim geom flex elem "
  "vert worldid type geomcollisionid efc_address",
)
class Touch:
  """How an organ's triangles touch each tool, and mujoco_warp's contacts."""

  most: int  # contacts of a world
  nline: int  # edges of threads, the last tools
  ring: int  # threads that share the triangles about a slot's node
  flex: int  # the slots' flex
  radius: float  # of that [m]
  kind: ints("ntool")  # mjtGeom
  line_flex: ints("nline")  # the thread's flex
  line_elem: ints("nline")  # number of the edge in it
  size: Array(wp.vec3, ("ntool",))  # as geom_size
  margin: floats("ntool")  # [m]
  condim: ints("ntool")
  whose: ints("ntool")  # whose sliding friction counts
  lifts: int  # whether forces may let tools not touch it
  lifted: ints("nworld", "nlift")  # what does not, see `engine.contacts.lifted`
  line_lift: ints("nline")  # where a thread's edges are in that
  slide: floats("nworld", "ntool")  # the tool's
  rough: floats("nworld")  # the organ's
  friction: Array(vec5, ("ntool",))  # all of it, the sliding one as compiled
  solref: Array(wp.vec2, ("ntool",))
  solimp: Array(vec5, ("ntool",))
  many: ints("nworld", "nthread")  # contacts that a thread finds, `ring` of them for a slot
  count: ints("nworld")  # of a world
  before: ints("nworld")  # of the worlds before it
  missed: ints("nworld")  # see `Patch`
  start: ints(1)  # the organ's first contact


@wp.struct
class Place:
  """A triangle before a tool, and where its contacts go."""

  world: int
  first: int  # contact
  room: int  # for how many, 0 where they are counted alone
  thread: int  # slot, of those of all worlds
  elem: int  # -1 for a corner alone
  vert: int  # -1 for a triangle
  tool: int  # which of the organ's
  geom: int


@wp.func
def _where(p: Patch, world: int, i: int):
  """Returns where a node is."""
  s = i // 8
  lane = i % 8
  d = p.solve.disp
  m = p.mesh[world]
  x = p.rest[m, i, 0] + wp.float64(d[world, s, 0, lane])
  y = p.rest[m, i, 1] + wp.float64(d[world, s, 1, lane])
  z = p.rest[m, i, 2] + wp.float64(d[world, s, 2, lane])
  return wp.vec3(
    float(p.origin[0] + p.frame[0, 0] * x + p.frame[0, 1] * y + p.frame[0, 2] * z),
    float(p.origin[1] + p.frame[1, 0] * x + p.frame[1, 1] * y + p.frame[1, 2] * z),
    float(p.origin[2] + p.frame[2, 0] * x + p.frame[2, 1] * y + p.frame[2, 2] * z),
  )


@wp.func
def _put(c: Touch, at: Place, n: int, dist: float, pos: wp.vec3, normal: wp.vec3):
  """Writes a contact, if it is one and there is room; returns how many there are then."""
  q = at.tool
  if not dist < c.margin[q]:
    return n
  if n < at.room:
    k = at.first + n
    c.out_dist[k] = dist
    c.out_pos[k] = pos
    c.out_frame[k] = triangle.axes(normal)
    c.out_includemargin[k] = c.margin[q]
    slide = c.slide[at.world, q]
    if c.whose[q] == _ORGAN:
      slide = c.rough[at.world]
    elif c.whose[q] == _GREATER:
      slide = wp.max(slide, c.rough[at.world])
    friction = c.friction[q]
    friction[0] = wp.max(slide, _LEAST)
    friction[1] = friction[0]
    c.out_friction[k] = friction
    c.out_solref[k] = c.solref[q]
    c.out_solreffriction[k] = wp.vec2(0.0, 0.0)
    c.out_solimp[k] = c.solimp[q]
    c.out_dim[k] = c.condim[q]
    line = q - (c.kind.shape[0] - c.nline)
    if line >= 0:
      c.out_geom[k] = wp.vec2i(-1, -1)
      c.out_flex[k] = wp.vec2i(c.line_flex[line], c.flex)
      c.out_elem[k] = wp.vec2i(c.line_elem[line], at.elem)
    else:
      c.out_geom[k] = wp.vec2i(at.geom, -1)
      c.out_flex[k] = wp.vec2i(-1, c.flex)
      c.out_elem[k] = wp.vec2i(-1, at.elem)
    c.out_vert[k] = wp.vec2i(-1, at.vert)
    c.out_worldid[k] = at.world
    c.out_type[k] = _CONSTRAINT
    c.out_geomcollisionid[k] = n
    for row in range(c.out_efc_address.shape[1]):  # mujoco_warp gives it as many as it needs
      c.out_efc_address[k, row] = -1
  return n + 1


@wp.func
def _pose(p: Patch, world: int, tool: int):
  """Returns where a tool is."""
  line = tool - (p.ntool - p.nline)
  if line >= 0:
    return p.line_xpos[world, line], p.line_xmat[world, line]
  geom = p.tool_geom[tool]
  return p.geom_xpos[world, geom], p.geom_xmat[world, geom]


@functools.cache
def _against(kinds: frozenset[int]):
  """Returns the function that finds a triangle's contacts with a tool of one of these kinds."""
  sphere, ellipsoid = _SPHERE in kinds, _ELLIPSOID in kinds
  capsule, box = _CAPSULE in kinds, _BOX in kinds
  solid = bool(convex.KINDS & kinds)

  @wp.func
  def against(p: Patch, c: Touch, v: Convex, at: Place, n: int, a: wp.vec3, b: wp.vec3, d: wp.vec3):
    pos, rot = _pose(p, at.world, at.tool)
    size = c.size[at.tool]
    axis = wp.vec3(rot[0, 2], rot[1, 2], rot[2, 2])
    kind = c.kind[at.tool]
    margin = c.margin[at.tool]
    if wp.static(sphere):
      if kind == _SPHERE:
        dist, x, normal = private.sphere_triangle(pos, size[0], a, b, d, c.radius, margin)
        n = _put(c, at, n, dist, x, normal)
    if wp.static(ellipsoid):
      if kind == _ELLIPSOID:
        far, y, out = triangle.ellipsoid(pos, rot, size, a, b, d)
        gap = far - c.radius
        n = _put(c, at, n, gap, y - (c.radius + 0.5 * gap) * out, out)
    if wp.static(capsule):
      if kind == _CAPSULE:
        dists, xs, normals = private.capsule_triangle(
          pos, axis, size[0], size[1], a, b, d, c.radius, margin
        )
        for k in range(5):
          n = _put(c, at, n, dists[k], xs[k], normals[k])
    if wp.static(LINE in kinds):
      if kind == wp.static(LINE):
        near, y5, n5 = triangle.edge(pos, axis, size[0], size[1], a, b, d, c.radius, margin)
        n = _put(c, at, n, near, y5, n5)
    if wp.static(box):
      if kind == _BOX:
        dists2, xs2, normals2 = private.box_triangle(pos, rot, size, a, b, d, c.radius, margin)
        for k in range(11):
          n = _put(c, at, n, dists2[k], xs2[k], normals2[k])
    if wp.static(_CYLINDER in kinds):
      if kind == wp.static(_CYLINDER):
        far4, x4, normal4 = cylinder.touch(pos, rot, size, margin + c.radius, c.radius, a, b, d)
        gap4 = far4 - c.radius
        n = _put(c, at, n, gap4, x4 - (c.radius + 0.5 * gap4) * normal4, normal4)
    if wp.static(solid):
      if kind == wp.static(_MESH):
        before = convex.Before()
        before.tool = at.tool
        before.kind = kind
        before.size = size
        before.pos = pos
        before.rot = rot
        before.reach = margin + c.radius
        before.thread = at.thread
        before.world = at.world
        far3, x3, normal3 = convex.touch(v, before, a, b, d)
        n = _put(c, at, n, far3 - c.radius, x3 - 0.5 * c.radius * normal3, normal3)
    return n

  return against


@wp.func
def _on_planes(p: Patch, c: Touch, at: Place, n: int, x: wp.vec3):
  """Writes the contacts of a node with planes; returns how many there are then."""
  for tool in range(p.ntool):
    at.tool = tool
    at.geom = p.tool_geom[tool]
    if c.kind[tool] == _PLANE:
      rot = p.geom_xmat[at.world, at.geom]
      out = wp.vec3(rot[0, 2], rot[1, 2], rot[2, 2])
      gap = wp.dot(out, x - p.geom_xpos[at.world, at.geom]) - c.radius
      n = _put(c, at, n, gap, x - (c.radius + 0.5 * gap) * out, out)
  return n


@wp.func
def _corners(p: Patch, world: int, e: int):
  m = p.mesh[world]
  return p.elem[m, e, 0], p.elem[m, e, 1], p.elem[m, e, 2]


@wp.func
def _is_lifted(c: Touch, world: int, tool: int, geom: int):
  """Returns whether forces let a tool not touch the organ."""
  line = tool - (c.kind.shape[0] - c.nline)
  if line < 0:
    return c.lifted[world, geom] != 0
  k = c.line_lift[line]
  e = c.line_elem[line]
  return c.lifted[world, k] <= e and e < c.lifted[world, k + 1]


@wp.func
def _owner(p: Patch, world: int, e: int):
  """Returns the first corner of a triangle that has a slot, whose thread has the triangle."""
  a, b, c = _corners(p, world, e)
  if p.node_slot[world, a] >= 0:
    return a
  return wp.where(p.node_slot[world, b] >= 0, b, c)


@functools.cache
def kernel(kinds: frozenset[int], lifts: bool) -> wp.Kernel:
  """Returns the kernel that counts or writes contacts with tools of these kinds, `ring` a slot.

  Args:
    kinds: of the tools
    lifts: whether forces may let tools not touch the organ
  """
  against = _against(kinds)

  @wp.kernel(module="unique", enable_backward=False)
  def find(p: Patch, c: Touch, v: Convex, writes: bool):
    world, k = wp.tid()
    slot = k // c.ring
    at = Place()
    at.world = world
    at.thread = world * p.nslot + slot
    at.room = 0
    first = int(0)
    n = int(0)
    i = p.slot_node[world, slot]
    if writes:
      if c.many[world, k] == 0:
        return
      for before in range(k):
        first += c.many[world, before]
      at.room = c.most - first
      first += c.nacon[0] + c.before[world]
    if i >= 0:
      was = p.source[p.mesh[world], i]
      for q in range(p.near_adr[was] + k % c.ring, p.near_adr[was + 1], c.ring):
        e = p.near[q]
        va, vb, vd = _corners(p, world, e)
        a, b, d = p.node_slot[world, va], p.node_slot[world, vb], p.node_slot[world, vd]
        whole = a >= 0 and b >= 0 and d >= 0
        if _owner(p, world, e) == i and (whole or not writes):
          at.first = first
          at.vert = -1
          at.elem = wp.where(whole, triple(a, b, d, p.nslot), 0)
          more = wp.where(whole, n, 0)
          xa = _where(p, world, va)
          xb = _where(p, world, vb)
          xd = _where(p, world, vd)
          centre, around = triangle.ball(xa, xb, xd)
          for tool in range(p.ntool):
            at.tool = tool
            at.geom = p.tool_geom[tool]
            pos, rot = _pose(p, world, tool)
            far = convex.is_beyond(v, tool, pos, rot, centre, around + c.radius + c.margin[tool])
            if wp.static(lifts):
              far = far or _is_lifted(c, world, tool, at.geom)
            if not far:
              more = against(p, c, v, at, more, xa, xb, xd)
          if whole:
            n = more
          elif more > 0:
            wp.atomic_add(p.missed, world, 1)
      if wp.static(_PLANE in kinds):
        if k % c.ring == 0:
          at.first = first
          at.elem = -1
          at.vert = slot
          n = _on_planes(p, c, at, n, _where(p, world, i))
    if not writes:
      c.many[world, k] = n

  return find


@wp.kernel(enable_backward=False)
def count(c: Touch):
  """Adds up the contacts of a world; those beyond its room are missed."""
  world = wp.tid()
  n = int(0)
  for k in range(c.many.shape[1]):
    n += c.many[world, k]
  c.count[world] = wp.min(n, c.most)
  c.missed[world] = c.missed[world] + n - c.count[world]


@wp.kernel(enable_backward=False)
def add(c: Touch):
  """Adds an organ's to the number of contacts, after all have seen it."""
  last = c.count.shape[0] - 1
  c.start[0] = c.nacon[0]
  c.nacon[0] = c.nacon[0] + c.before[last] + c.count[last]


def most_of(model: mujoco.MjModel, tools: np.ndarray, lines: list, nslot: int) -> int:
  """Returns how many contacts a world has rows for: two a slot, a patch's triangles, or more."""
  each = max((_EACH[int(kind)] for kind in model.geom_type[tools]), default=1)
  many = 4 if each > _EACH[int(_GEOM.mjGEOM_CAPSULE)] else 3 if len(tools) > _FEW else 2
  return nslot * (many + 4 * bool(lines))


def make(organ: "Organ", model: mujoco.MjModel, tools: np.ndarray, lines: list):
  """Returns how an organ touches its tools.

  Args:
    organ: the organ in all worlds
    model: the compiled scene
    tools: geoms that its slots follow
    lines: threads that they follow
  """
  patch, data, nworld = organ.patch, organ.batch.d, organ.batch.nworld
  nslot, flex = organ.place.nslot, organ.place.flex
  # EPA has memory for one triangle of a slot at a time.
  alone = convex.KINDS & set(model.geom_type[tools].tolist())
  ring = 1 if alone else int(np.diff(patch.near_adr.numpy()).max())
  own = organ.declared.flexes[0]
  rows = [_mix(model, "geom", int(g), own) for g in tools]
  if not contacts.says(model, own):
    firm = {"solref": (contacts.SLOW * model.opt.timestep, 1.0), "solimp": _HARD}
    rows = [row | firm for row in rows]
  number = np.array([len(line.rest) - 1 for line in lines], int)
  for line, count in zip(lines, number, strict=True):
    rows += [_mix(model, "flex", line.flex, own)] * int(count)
  radius, half = halves(lines)
  line_size = np.stack([radius, half, 0 * half], axis=1)
  bare, kind = organ.batch.bare, mujoco.mjtObj.mjOBJ_FLEX
  flexes = [mujoco.mj_name2id(bare, kind, line.name) for line in lines]
  mixed = {name: np.array([row[name] for row in rows]).reshape(-1, *wide)
           for name, wide in _MIXED.items()}  # fmt: skip
  lifts = bool(organ.config.needles)
  values = mixed | arrays_of(Touch, None, data) | dict(
    most=most_of(model, tools, lines, nslot),
    nline=len(half),
    line_flex=np.repeat(flexes, number),
    line_elem=np.concatenate([[], *map(np.arange, number)]),
    flex=flex,
    radius=float(model.flex_radius[own]),
    kind=np.append(model.geom_type[tools], np.full(len(half), LINE)),
    size=np.concatenate([model.geom_size[tools], line_size]),
    rough=np.full(nworld, model.flex_friction[own, 0]),
    slide=np.tile(mixed["slide"], (nworld, 1)),
    ring=ring,
    many=np.zeros((nworld, ring * nslot)),
    count=np.zeros(nworld),
    before=np.zeros(nworld),
    missed=patch.missed,
    start=np.zeros(1),
    lifts=int(lifts),
    lifted=organ.host.lifted() if lifts else np.zeros((nworld, 0)),
    line_lift=np.repeat([model.ngeom + 2 * line.flex for line in lines], number),
  )  # fmt: skip
  return fill(Touch, data.nacon.device, values)


def _mix(model, kind: str, g: int, f: int) -> dict:
  """Returns the parameters of a contact with a flex, as mj_contactParam mixes them."""

  def both(name: str) -> np.ndarray:
    return np.stack([getattr(model, f"{kind}_{name}")[g], getattr(model, f"flex_{name}")[f]])

  mine, other = both("priority").tolist()
  solref, solimp, friction, condim = map(both, ("solref", "solimp", "friction", "condim"))
  margin = float(both("margin").sum())
  out = {"margin": margin, "slide": friction[0, 0], "whose": int(_GREATER)}
  if mine != other:
    k = int(other > mine)
    parts = condim[k], solref[k], solimp[k], friction[k]
    out["whose"] = int(_ORGAN if k else _TOOL)
  else:
    a, b = both("solmix").tolist()
    share = a / (a + b) if a + b > 0 else 0.5
    mixed = share * solref[0] + (1 - share) * solref[1]
    direct = (solref[:, 0] <= 0).any()
    ref = solref.min(axis=0) if direct else mixed
    parts = condim.max(), ref, share * solimp[0] + (1 - share) * solimp[1], friction.max(axis=0)
  out |= dict(zip(("condim", "solref", "solimp"), parts[:3], strict=True))
  return out | {"friction": np.maximum(parts[3][[0, 0, 1, 2, 2]], _LEAST)}
