"""An organ in all worlds of a batch: its patch of slots, and the kernels over them."""

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine.coupling import Crossing
from palpate.engine.layout import GEOM
from palpate.engine.model import inertia
from palpate.engine.windows import proxies
from palpate.tissue import step
from palpate.tissue.cutting.facets import World
from palpate.tissue.types import Array, Tissue, doubles, fill, floats, ints, vector, zeros

from ..mjw.arrays import theirs

if TYPE_CHECKING:
  from palpate.engine.model.declare import Declaration

_BLOCK = 128  # threads, whole warps
_ENDLESS = 1e300  # square of a distance beyond all others [m^2]
_LONGER = 1.5  # times which an edge may be that a cut has moved
# What worlds have of their own, beside what is not zero.
_OWN = (
  *("lump", "heavier", "calm", "stirred", "force", "last", "before", "count", "candidate"),
  *("distance", "chosen", "found", "missed"),
)
# Steps of the scale of Young's modulus for which the effective inertia is known.
GRADES = 2.0 ** np.arange(-4, 5)


@theirs(
  option="gravity",
  model="dof_armature body_invweight0",
  data="geom_xpos geom_xmat qpos qvel qfrc_passive qfrc_constraint",
)
class Patch:
  """An organ, the slots that stand for it in mujoco_warp, and what they share.

  Nodes are in the order of `Shape`, padding among them: neighbours in memory are neighbours there.
  """

  nnode: int  # nodes
  nslice: int  # slices of nodes
  nslot: int  # slots
  ntool: int  # geoms that the slots follow, and after them edges of threads
  nline: int  # edges of threads
  nq: int
  nv: int
  dofadr: int  # first dof of the slots
  qposadr: int  # their first number in qpos
  bodyid: int  # their first body
  ngrade: int  # rows of `inertia`
  stiff: int  # whether the organ answers for itself, see `inertia.stiffness`
  sleeps: int  # whether it may sleep
  slow: float  # speed below which a node is at rest [m/s]
  h: wp.float64  # time step [s]
  rest_share: wp.float64  # see `step.REST`
  weight: wp.float64  # mass of the organ [kg]
  slot_mass: wp.float64  # mass of a slot's body [kg]
  heaviest: wp.float64  # see `inertia.stiffness`
  skin: wp.float64  # distance from a geom within which a node touches it [m]
  # The organ:
  node: ints("nvert")  # node of a vertex
  free: ints("nnode")  # whether a node moves
  mass: doubles("nnode")  # mass [kg]
  inertia: doubles("ngrade", "nnode")  # effective inertia at each of GRADES [kg]
  near_adr: ints("nnode + 1")  # first of a node's triangles in `near`
  near: ints("nnear")  # triangles of the nodes before the first cut
  frame: doubles(3, 3)  # rotation from the organ's axes to the world's
  origin: doubles(3)  # position of its frame [m]
  tool_geom: ints("ntool")  # geoms that the slots follow; -1 for edges of threads
  # The organ's mesh, of worlds that are cut their own:
  mesh: ints("nworld")  # which of these a world has
  rest: doubles("nmesh", "nnode", 3)  # rest position [m]
  elem: ints("nmesh", "nelem", 3)  # nodes of a triangle, of solids those of the skin
  tet: ints("nmesh", "ntet", 4)  # nodes of a tetrahedron, of solids that may be cut or pierced
  touch: doubles("nmesh", "nnode")  # distance of a geom within which its triangles may touch it [m]
  source: ints("nmesh", "nnode")  # what a node was before it was divided
  share: doubles("nmesh", "nnode")  # its part of that; 0 where it waits for a cut
  held: doubles("nmesh", "nnode")  # mass by which contacts weigh it, of pinned ones a wall's [kg]
  # What a world has of its own:
  grade: floats("nworld")  # place in GRADES of the scale of stiffness over that of mass
  mass_scale: doubles("nworld")  # times the masses below
  lump: floats("nlump", "nnode")  # factor on Young's modulus around a node; none where all have 1
  heavier: doubles("nworld")  # times its inertia at rest that a tool meets; 0 for once
  calm: doubles("nworld")  # how long it has been at rest [s]
  stirred: ints("nworld")  # whether it moved or was touched in the last step
  force: floats("nworld", "nnode", 3)  # contact force of the last step [N]
  last: vector  # last change of the velocity [m/s]
  before: vector  # the one before it [m/s]
  # Within a step:
  tool: doubles("nworld", "ntool", len(GEOM))  # see GEOM
  line_xpos: Array(wp.vec3, ("nworld", "nline"))  # of edges of threads, as geom_xpos [m]
  line_xmat: Array(wp.mat33, ("nworld", "nline"))
  count: ints("nworld")  # candidates
  candidate: ints("nworld", "nnode")  # their nodes
  distance: floats("nworld", "nnode")  # from the nearest tool [m]
  chosen: ints("nworld", "nnode")  # whether they have a slot
  slot_node: ints("nworld", "nslot")  # node of a slot, -1 for none
  node_slot: ints("nworld", "nnode")  # slot of a node, -1 for none
  found: floats("nworld", "nslot", 3)  # contact force of this step [N]
  missed: ints("nworld")  # contacts without room
  overflow: ints("nworld")  # the most of these so far
  bad: ints("nworld")  # whether a number is not finite
  mask: Array(wp.bool, ("nworld",))  # worlds to reset
  tissue: Tissue
  solve: Crossing


tell_tools, enter, rank, stand, push, take, follow, commit, find_bad, rest = coupling.kernels(
  "coupling/worlds.h",
  Patch,
  *("tell_tools", "enter_worlds", "rank", "stand", "push_worlds", "take", "follow"),
  *("commit_worlds", "find_bad", "rest_organ"),
  own=True,
)


def launch(kernel, patch, nworld: int, count: int, device, arg: int = 0):
  """Launches a kernel over `count` items of each world; one thread has a world on the CPU."""
  nthread = -(-count // 32) * 32 if device.is_cuda else 1
  kernel.launch(device, nworld, nthread, arg, patch, _BLOCK)


def constants(
  body, organ: "Declaration", tools: np.ndarray, lines: list, model: mujoco.MjModel, met, surface
) -> dict:
  """Returns the fields of `Patch` that say what the organ is and which tools it meets.

  Args:
    body: its tissue in all worlds
    organ: its declaration
    tools: geoms that the slots follow
    lines: threads that they follow
    model: the compiled scene
    met: effective inertia of every vertex [kg]
    surface: makes what follows from a mesh
  """
  mesh, skin = organ.mesh, _skin(organ, model)
  nline = sum(len(line.rest) - 1 for line in lines)
  own = surface.make(mesh)
  longest = float(own["touch"].max()) * (_LONGER if mesh.spare else 1.0)
  node, nnode = body.shape.node.numpy(), body.shape.nnode
  elem = node[mesh.elem]
  count = np.bincount(elem.ravel(), minlength=nnode)

  def by_node(values, padding=0.0):
    out = np.full((nnode, *values.shape[1:]), padding)
    out[node] = values
    return out

  return dict(
    nnode=nnode,
    nslice=body.shape.nslice,
    ntool=len(tools) + nline,
    nline=nline,
    line_xpos=np.zeros((body.nworld, nline, 3)),
    line_xmat=np.zeros((body.nworld, nline, 3, 3)),
    ngrade=len(GRADES),
    h=model.opt.timestep,
    rest_share=step.REST,
    weight=float(organ.mass.sum()),
    skin=skin,
    slow=proxies.SLOW * float(np.linalg.norm(np.ptp(mesh.rest, axis=0))),
    node=node,
    free=by_node(organ.free),
    mass=by_node(organ.mass),
    inertia=np.tile(by_node(met, 1.0), (len(GRADES), 1)),
    mesh=np.zeros(body.nworld),
    **{name: values[None] for name, values in own.items()},
    near_adr=np.concatenate([[0], np.cumsum(count)]),
    near=np.argsort(elem.ravel(), kind="stable") // 3,
    frame=organ.frame,
    origin=organ.origin,
    tool_geom=np.append(tools, np.full(nline, -1)),
    tool=np.tile(_tools(tools, lines, model, longest), (body.nworld, 1, 1)),
  )  # fmt: skip


class Surface:
  """What of a patch follows from a mesh.

  Args:
    body: the tissue
    organ: its declaration
    model: the compiled scene
    tools: geoms that the slots follow
    lines: threads that they follow
  """

  def __init__(
    self, body, organ: "Declaration", model: mujoco.MjModel, tools: np.ndarray, lines: list
  ):
    self._node, self._nnode = body.shape.node.numpy(), body.shape.nnode
    self._organ = organ
    margins = *model.geom_margin[tools], *(model.flex_margin[line.flex] for line in lines)
    self._reach = _skin(organ, model) + float(max(margins, default=0.0))
    mass = inertia.masses(model, organ)
    if organ.windows:
      self._held = proxies.hold(organ, mass)
    else:
      wall, own = proxies.WALL * organ.mass[organ.free].sum(), mass[organ.jointed]
      some = own[own > 0].mean()  # as `prepare` gives it to spare vertices
      self._held = np.where(organ.free, np.where(mass > 0, mass, some), wall)

  def make(self, mesh) -> dict[str, np.ndarray]:
    """Returns the fields of `Patch` that a cut changes, of the mesh before the first one."""
    n, inside = self._nnode, bool(mesh.spare or self._organ.config.needles)
    out = {
      "rest": np.zeros((n, 3)),
      "elem": np.zeros((mesh.nelem, 3), np.int32),
      "tet": np.zeros((len(mesh.tet) * inside, 4), np.int32),
      "touch": np.full(n, -np.inf),  # padding is never near
      "source": np.arange(n, dtype=np.int32),
      "share": np.ones(n),
      "held": np.ones(n),
    }
    here = {name: values[None] for name, values in out.items()}
    vert, changed = np.arange(mesh.nvert), np.arange(len(mesh.tet) or mesh.nelem)
    world = World(mesh, self._organ.mass, vert, np.zeros(0, int))
    self.write(here, [0], [(world, vert, changed)])
    return out

  def write(self, out: dict[str, np.ndarray], worlds, changes: list[tuple]):
    """Writes them, for some vertices and triangles of worlds.

    Args:
      out: the fields, with a row a world
      worlds: the worlds
      changes: of each what it is, which vertices, and which triangles, of a solid tetrahedra
    """
    for world, (now, _, changed) in zip(worlds, changes, strict=True):
      mesh, elem = now.mesh, changed
      if len(mesh.tet):
        elem = np.arange(mesh.whole.nelem)
        if len(out["tet"][world]):
          out["tet"][world, changed] = self._node[mesh.tet[changed]]
      out["elem"][world, elem] = self._node[mesh.elem[elem]]
    parts = [
      (v, w.mesh.rest[v], w.mesh.unused[v], _longest(w.mesh, v), w.source[v], w.mass[v])
      for w, v, _ in changes
    ]
    of_vert = np.repeat(worlds, [len(each[0]) for each in parts])
    vert, rest, waits, longest, source, mass = (
      np.concatenate(each) for each in zip(*parts, strict=True)
    )
    was = self._organ.mass[source]
    share = np.where(was > 0, mass / np.where(was > 0, was, 1.0), 1.0)
    # Nodal coupling leaves contacts the masses of the compiled model.
    held = share * self._held[source] if self._organ.windows else self._held[vert]
    at = of_vert, self._node[vert]
    out["rest"][at] = rest
    # Tools do not touch the walls of cuts in a solid.
    wall = (source != vert) & (source >= self._organ.mesh.nskin)
    out["touch"][at] = np.where(waits | wall, -np.inf, self._reach + longest)
    out["source"][at] = self._node[source]
    out["share"][at] = np.where(waits, 0.0, share)
    out["held"][at] = np.where(waits, 1.0, held)


def _skin(organ: "Declaration", model) -> float:
  """Returns the distance from an organ's triangles within which it touches [m]."""
  flexes = organ.flexes
  return float(model.flex_radius[flexes].max() + model.flex_margin[flexes].max())


def _longest(mesh, vert: np.ndarray) -> np.ndarray:
  """Returns the longest edge at each vertex at rest: its triangles are no farther from it [m]."""
  ring = mesh.ring[vert]
  edge = mesh.rest[np.where(ring >= 0, ring, vert[:, None])] - mesh.rest[vert][:, None]
  return np.sqrt(np.einsum("ijk,ijk->ij", edge, edge).max(axis=1))


def halves(lines: list) -> tuple[np.ndarray, np.ndarray]:
  """Returns radius and half the length of each edge of threads [m], (nline,)."""
  half = [0.5 * np.linalg.norm(np.diff(line.rest, axis=0), axis=1) for line in lines]
  radius = [np.full(len(each), line.radius) for each, line in zip(half, lines, strict=True)]
  return np.concatenate([[], *radius]), np.concatenate([[], *half])


def _tools(tools: np.ndarray, lines: list, model, reach: float) -> np.ndarray:
  """Returns what is the same in all worlds of each tool, see GEOM."""
  radius, half = halves(lines)
  line = np.zeros((len(half), len(GEOM)))
  line[:, GEOM.type] = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
  line[:, GEOM.size], line[:, GEOM.size + 1] = radius, half
  line[:, GEOM.bound2] = (radius + half + reach) ** 2
  tool = np.zeros((len(tools), len(GEOM)))
  tool[:, GEOM.type] = model.geom_type[tools]
  tool[:, GEOM.size : GEOM.size + 3] = model.geom_size[tools]
  tool[:, GEOM.box : GEOM.box + 3] = model.geom_aabb[tools, :3]
  tool[:, GEOM.half : GEOM.half + 3] = model.geom_aabb[tools, 3:]
  bound = model.geom_rbound[tools]
  tool[:, GEOM.bound2] = np.where(bound > 0, (bound + reach) ** 2, _ENDLESS)
  return np.concatenate([tool, line])


def variables(nworld: int, nslot: int, nslice: int) -> dict:
  """Returns the fields of `Patch` that worlds have of their own, at rest."""
  sizes = {"nworld": nworld, "nslot": nslot, "nslice": nslice, "nnode": 8 * nslice, "nlump": 0}
  return zeros(_OWN, sizes, (Patch,)) | dict(
    nslot=nslot,
    grade=np.full(nworld, np.log2(1.0 / GRADES[0])),
    mass_scale=np.ones(nworld),
    slot_node=np.full((nworld, nslot), -1),
    node_slot=np.full((nworld, sizes["nnode"]), -1),
  )


def make(values: dict, body):
  """Returns the patch of a body in its worlds; `values` are the fields but those of the body."""
  own = {"tissue": body.tissue, "solve": coupling.crossing(coupling.on_body(body))}
  return fill(Patch, body.device, values | own)
