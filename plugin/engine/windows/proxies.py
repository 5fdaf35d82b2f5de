"""Windows, the slots' side: what MuJoCo and a windowed organ share, on the CPU."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from palpate.tissue import step
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.kernels import Kernel, aim
from palpate.tissue.types import also, doubles, fill, flags, floats, ints, longs, struct

from .. import coupling
from ..coupling import Mujoco
from ..layout import FLAG, Inbox, Outbox, WindowState

if TYPE_CHECKING:
  from ..host import Host
  from ..model.declare import Declaration

# Nodes within this many mean edges of a tool may be in the window.
_REACH = 4.0
# An organ whose nodes move by less than this share of its size a second is at rest.
SLOW = 1e-5
# Mass and inertia of a slot on a pinned node, in masses of the organ: a wall to tools. The more it
# is, the less care MuJoCo's solver takes of light ones.
WALL = 1e3


@struct
class Slots:
  """A windowed organ, its slots and MuJoCo; see `declare.Windows`."""

  nvert: int  # vertices
  nslot: int  # slots
  ngeom: int  # geoms that the window follows, and edges of threads
  nroom: int  # triangles, and walls that cuts may open
  most: int  # candidates that the outbox has room for
  resident: int  # 1 if the motion stays on a device and the plugin state may be old
  rest_share: wp.float64  # see `step.REST`
  reach: wp.float64  # distance from a geom within which nodes may be in the window [m]
  slow: wp.float64  # speed below which the organ counts as at rest [m/s]
  longest: wp.float64  # longest edge [m]
  radius: wp.float64  # of the window's flex [m]
  skin: wp.float64  # distance of surface and geom at which MuJoCo finds a contact, at most [m]
  weight: wp.float64  # mass of the organ [kg]
  # The organ:
  free: ints("nvert")  # whether a node moves; others are pinned
  node_mass: doubles("nvert")  # mass, of pinned nodes that of a wall [kg]
  rest: doubles("nvert", 3)  # rest position [m]
  inertia: doubles("nvert")  # effective inertia, of pinned nodes that of a wall [kg]
  touch: doubles("nvert")  # distance from a geom within which a node's triangles may touch it [m]
  elem: ints("nroom", 3)  # nodes of a triangle
  begin: ints("nvert")  # first of the triangles whose first corner a node is, -1 for none
  following: ints("nroom")  # the next one with the same first corner, -1 for none
  frame: doubles(3, 3)  # rotation from the organ's axes to the world's
  origin: doubles(3)  # position of its frame [m]
  heaviest: doubles(1)  # see `Workspace`
  number: doubles("nnumber")  # see `NUMBERS`
  flags: ints(len(FLAG))  # see FLAG
  # The window:
  home: ints("nslot")  # default node of a slot, -1 for none
  qhome: doubles("nslot", 3)  # qpos less rest position and displacement [m]
  dofadr: ints("nslot")  # first dof of a slot
  massadr: ints("nslot", 3)  # where M has the diagonals of its dofs
  qposadr: ints("nslot")  # its first number in qpos
  bodyid: ints("nslot")  # its body
  elem_adr: int  # where its triangles start in flex_elem
  elem_num: int  # how many it can hold
  geom: ints("ngeom")  # geoms that it follows; of edges -1 less the first vertex
  flexvert_xpos: doubles("nflexvert", 3)
  line_radius: doubles("ngeom")  # of edges [m]
  # What changes:
  placed: ints("nslot")  # node of a slot in the model, -1 for none
  taken: ints("nvert")  # slot of a node, -1 for none
  chosen: ints("nvert")  # scratch; 0 between steps
  candidate: ints("nvert")  # scratch
  distance: doubles("nvert")  # scratch
  at: ints("nvert")  # scratch: a node's place in the outbox; -1 between steps
  lagged: doubles("nslot", 3)  # external and lagged contact force [N]
  other: doubles("nslot", 3)  # what acted on a slot besides contacts and its weight [N]
  own: WindowState
  inbox: Inbox
  foreseen: Inbox  # what the next step is expected to have
  outbox: Outbox
  status: floats("nworld", 4)  # see `State`
  mj: Mujoco


place, gather, scatter, leave, choose, foresee = coupling.kernels(
  "windows/proxies.h",
  Slots,
  *("place", "gather_slots", "scatter_slots", "leave_slots", "choose", "foresee"),
)


@struct
@also(Slots, "nvert", "radius", "rest", "touch", "node_mass", "free", "elem", "begin", "following")
class Reshaping:
  """The slots' vertices, and the mesh that they are to take over."""

  nelem: int
  most: int  # neighbours that a vertex has room for
  nchanged: int
  wall: wp.float64  # mass of pinned nodes [kg]
  vert: longs("nchanged")  # vertices that something has changed at
  mesh_rest: doubles("nvert", 3)  # see `Mesh`
  mesh_elem: longs("nelem", 3)
  ring: longs("nvert", "most")
  mass: doubles("nvert")  # [kg]
  near: flags("nvert")  # scratch; 0 between calls


(_reshape,) = coupling.kernels("windows/proxies.h", Reshaping, "reshape_slots")


def scratch(nvert: int, nslot: int) -> dict[str, wp.array]:
  """Returns the arrays of `Slots` that outlive a new recording."""
  ints_of = {"placed": (nslot, -2), "taken": (nvert, -1), "chosen": (nvert, 0)}
  ints_of |= {"candidate": (nvert, 0), "at": (nvert, -1)}
  zeros = {"distance": nvert, "inertia": nvert, "other": (nslot, 3)}
  return {
    name: wp.full(count, value, dtype=int, device="cpu") for name, (count, value) in ints_of.items()
  } | {name: wp.zeros(shape, dtype=wp.float64, device="cpu") for name, shape in zeros.items()}


def make(
  host: "Host", boxes: Mapping[str, Any], kept: Mapping[str, wp.array], sizes: Mapping[str, int]
) -> Any:
  """Returns the slots of an organ.

  Args:
    host: the organ
    boxes: blocks of the plugin state and of what crosses
    kept: what `scratch` gave
    sizes: what the blocks of `layout` need
  """
  m, organ, win, mesh = host.m, host.organ, host.organ.window, host.organ.mesh
  lengths, longest = _edges(mesh)
  radius, margin = float(m.flex_radius[win.flex]), float(m.flex_margin[win.flex])
  thread = np.searchsorted(m.flex_vertadr, win.line, side="right") - 1  # the flex of each edge
  margin += float(max((*m.geom_margin[win.geom], *m.flex_margin[thread]), default=0.0))
  thick = m.flex_radius[thread]
  room = max(mesh.whole.nelem, sizes["ncorner"])
  values = {**boxes} | {name: kept[name] for name in scratch(0, 0)} | dict(
    nvert=sizes["nvert"],
    nslot=sizes["nslot"],
    ngeom=sizes["ngeom"],
    nroom=room,
    most=sizes["most"],
    resident=int(host.config.resident),
    rest_share=step.REST,
    reach=max(_REACH * float(lengths.mean()), float(longest.max())) + radius,
    slow=SLOW * float(np.linalg.norm(np.ptp(mesh.rest, axis=0))),
    longest=float(longest.max()),
    radius=radius,
    skin=radius + margin,
    weight=float(win.mass.sum()),
    free=organ.free,
    node_mass=hold(organ, organ.mass),
    rest=mesh.rest,
    touch=longest + radius,
    elem=np.zeros((room, 3)),
    begin=np.full(mesh.nvert, -1),
    following=np.full(room, -1),
    frame=organ.frame,
    origin=organ.origin,
    heaviest=host.arrays["heaviest"],
    number=host.number,
    flags=host.flags(),
    home=win.home,
    qhome=win.qhome,
    dofadr=win.dofadr,
    massadr=coupling.mass_addresses(m, win.dofadr[:, None] + np.arange(3)),
    qposadr=win.qposadr,
    bodyid=win.body,
    elem_adr=win.elem_adr,
    elem_num=win.elem_num,
    geom=np.append(win.geom, -1 - win.line),
    line_radius=np.append(np.zeros(win.geom.size), thick),
    flexvert_xpos=coupling.mujoco_arrays(host.model, host.data, Slots).flexvert_xpos,
    lagged=host.arrays["lagged"],
    status=host.arrays["status"],
    mj=coupling.mujoco_arrays(host.model, host.data),
  )  # fmt: skip
  return fill(Slots, "cpu", values)


class Reshape:
  """Gives slots the mesh and the masses that vertices have; triangles keep their number.

  Args:
    organ: the declaration
    slots: of it
  """

  def __init__(self, organ: "Declaration", slots: Any):
    self._fields = fields = Reshaping()
    mesh = organ.mesh
    for name in ("rest", "touch", "node_mass", "free", "elem", "begin", "following", "radius"):
      setattr(fields, name, getattr(slots, name))
    fields.nvert, fields.most = mesh.nvert, mesh.ring.shape[1]
    fields.wall = WALL * float(organ.window.mass.sum())
    fields.near = wp.zeros(mesh.nvert, dtype=wp.uint8, device="cpu")
    self._launch = _reshape.command(fields).launch
    self.put(organ, np.arange(mesh.nvert))

  def put(self, organ: "Declaration", vert: np.ndarray):
    """Gives the slots what the organ has at vertices that something has changed at."""
    mesh, fields = organ.mesh, self._fields
    fields.nelem, fields.nchanged = mesh.nelem, len(vert)
    whole = {"vert": vert, "mesh_elem": mesh.elem, "ring": mesh.ring}
    whole = {name: np.ascontiguousarray(each, np.int64) for name, each in whole.items()}
    aim(fields, mesh_rest=mesh.rest, mass=organ.mass, **whole)
    self._launch()


def hold(organ: "Declaration", inertia: np.ndarray, vert: Any = slice(None)) -> np.ndarray:
  """Returns the inertia of nodes, with that of a wall for pinned ones [kg]."""
  return np.where(organ.free[vert], inertia, WALL * organ.window.mass.sum())


def _edges(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
  """Returns the lengths of the triangles' edges, (nelem, 3), and the longest one at each node.

  A tool that touches a triangle is no farther from its corners than their longest edges.
  """
  edge = mesh.rest[mesh.elem[:, [1, 2, 0]]] - mesh.rest[mesh.elem]
  length = np.linalg.norm(edge, axis=2)
  longest = np.zeros(mesh.nvert)
  for corner in (mesh.elem, mesh.elem[:, [1, 2, 0]]):
    np.maximum.at(longest, corner.ravel(), length.ravel())
  return length, longest


def launch(kernel: Kernel, slots: Any):
  """Launches a kernel over all slots."""
  kernel.launch("cpu", 1, 1, 0, slots)
