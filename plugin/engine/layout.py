"""Where every number lies that an organ keeps in mjData.plugin_state or exchanges in a step.

Long arrays are structs of blocks, one after the other in the order of their lines; `carve` makes
views of them. Short ones (`Numbers`) have a name for each number. Native code has the blocks as
fields and the offsets of the short ones as constants, HEAD_MODE for `HEAD.mode`.
"""

import math
from collections.abc import Mapping
from typing import Any

import warp as wp
from palpate.tissue.types import DIMS, doubles, struct

WALLS = 4  # triangles that cuts of a solid may open, for one spare vertex
LIPS = 3  # edges that cuts of a sheet may open, for one spare vertex
HOLES = 20  # of a needle in an organ, at once
TRAIL = 12  # points of the path of a blade that has not come apart yet


class Numbers:
  """Offsets of the numbers of a short array by name; `len` is how many there are.

  Args:
    prefix: of their names in native code
    rows: name, how many numbers, unit, meaning
  """

  def __init__(self, prefix: str, *rows: tuple[str, int, str, str]):
    self.rows = rows
    self._prefix = prefix
    self._length = 0
    for name, size, *_ in rows:
      setattr(self, name, self._length)
      self._length += size

  def __getattr__(self, name: str) -> int:
    raise AttributeError(f"{self._prefix} has no number {name!r}")

  def __len__(self) -> int:
    return self._length

  def constants(self) -> dict[str, int]:
    """Returns the offsets, and the length, under their names in native code."""
    names = [name for name, *_ in self.rows]
    offsets = {f"{self._prefix}_{name.upper()}": getattr(self, name) for name in names}
    return offsets | {f"{self._prefix}_LENGTH": len(self)}


FLAG = Numbers(
  "FLAG",
  ("stale", 1, "-", "the model's window is not that of the state"),
  ("asleep", 1, "-", "the organ is at rest and its step is skipped"),
  ("missed_nodes", 1, "-", "nodes that tools touch and the window has no room for"),
  ("missed_elements", 1, "-", "triangles that the window has no room for"),
  ("pending", 1, "-", "mode of the next commit, see MODE"),
  ("near", 1, "-", "a tool is near"),
  ("changed", 1, "-", "the contact forces are not those of the last step"),
  ("answered", 1, "-", "the organ responded to that"),
  ("foreseen", 1, "-", "what acts on the organ is what was guessed"),
  ("weighed", 1, "-", "rows of contacts changed, or may have, that MuJoCo has made use of"),
  ("fast", 1, "-", "a tool may go through the organ and out again between two looks"),
  ("coarse", 1, "um", "edge that a tool needs which is too small for the mesh; negative once told"),
)

# How the last step ends on the nodes' side. These are values, not offsets.
MODE = Numbers(
  "MODE",
  ("still", 1, "-", "there is nothing to commit"),
  ("commit", 1, "-", "the last step's change of velocity"),
  ("halt", 1, "-", "that, and standing still"),
)

# Of the inbox: what is the same for the whole organ.
HEAD = Numbers(
  "HEAD",
  ("step", 1, "s", "time step h of the step that begins"),
  ("gain", 1, "s^2", "h^2 + h damping"),
  ("floor", 1, "kg m^2/s^2", "floor of the residual"),
  ("mode", 1, "-", "how the last step ends, see MODE"),
  ("gravity", 3, "m/s^2", "in the organ's frame"),
  ("reach", 1, "m", "distance from a geom within which nodes may be in a window"),
  ("step_ended", 1, "s", "time step of the step that ends"),
  ("answered", 1, "-", "1 where it ends with the organ's response"),
  ("expected", 1, "J", "see `State.expected`"),
)

# Of the inbox: where contacts left a slot in the last step.
MOVED = Numbers(
  "MOVED",
  ("node", 1, "-", "-1 for none"),
  ("disp", 3, "m", "displacement from rest"),
  ("vel", 3, "m/s", "velocity"),
)

# Of the inbox: what acts on a slot.
PUSHED = Numbers(
  "PUSHED",
  ("node", 1, "-", "-1 for none"),
  ("force", 3, "N", "besides weight; after MuJoCo's step the impulse to answer [N s]"),
)

# Of the inbox: a geom that the window follows, in the organ's frame.
GEOM = Numbers(
  "GEOM",
  ("pos", 3, "m", "centre"),
  ("axis", 9, "-", "its three axes, one after the other"),
  ("type", 1, "-", "mjtGeom"),
  ("size", 3, "m", "as mjModel.geom_size"),
  ("box", 3, "m", "centre of the bounding box, along the axes"),
  ("half", 3, "m", "half its lengths"),
  ("bound2", 1, "m^2", "square of the reach plus the radius of the bounding sphere"),
)

# Of the outbox: what the whole organ did.
SUMMARY = Numbers(
  "SUMMARY",
  ("status", 4, "-", "as `System.status`"),
  ("ratio", 1, "-", "as `System.ratio`"),
  ("speed2", 1, "m^2/s^2", "square of the greatest speed of a node"),
  ("low", 3, "m", "lowest corner of the organ's bounds, in its frame"),
  ("high", 3, "m", "highest corner"),
)

# Of the outbox: the node of a slot after a step that ended with the organ's response.
ANSWER = Numbers(
  "ANSWER", ("disp", 3, "m", "displacement from rest"), ("vel", 3, "m/s", "velocity")
)

# Of the outbox: a node that is near the window's geoms.
RECORD = Numbers(
  "RECORD",
  ("node", 1, "-", "its number"),
  ("distance", 1, "m", "to the nearest geom"),
  ("disp", 3, "m", "displacement from rest"),
  ("vel", 3, "m/s", "velocity"),
)

# Of the plugin state of a windowed organ: where a geom was when the organ fell asleep, as in GEOM.
POSE = Numbers("POSE", ("pos", 3, "m", "centre"), ("axis", 9, "-", "its three axes"))

# Of the plugin state: the bond of a vertex.
BOND = Numbers(
  "BOND",
  ("damage", 1, "-", "0 whole, 1 free"),
  ("released", 1, "J", "what damage has taken of its energy"),
)

# Of the plugin state: a geom that cuts, and its seat in the tissue; places are at rest.
BLADE = Numbers(
  "BLADE",
  ("stage", 1, "-", "0 away, 1 at the surface, 2 through the wall"),
  ("depth", 1, "m", "how far it has pierced the wall, or cuts into a solid"),
  ("elem", 1, "-", "triangle of its seat"),
  ("at", 3, "m", "its seat"),
  ("toward", 3, "-", "which way it cut last, 0 before"),
  ("work", 1, "J", "what it has spent"),
  ("opened", 1, "m", "what it has cut"),
  ("wait", 1, "m", "how far it goes before the mesh comes apart; 0 as usual, < 0 at an edge"),
  ("count", 1, "-", "points of `trail`"),
  ("trail", 3 * TRAIL, "m", "its path since the mesh came apart"),
  ("below", TRAIL, "m", "how deep it was there in a solid"),
)

# What a geom that cuts meets.
LAW = Numbers(
  "LAW",
  ("force", 1, "N", "to cut, along the surface; of a solid by depth [N/m]"),
  ("pierce", 1, "N", "to pierce the wall, along the blade"),
  ("stiffness", 1, "N/m", "of the spring to its seat"),
  ("wall", 1, "m", "thickness of the wall; of a solid how deep a blade is before it cuts along"),
  ("solid", 1, "-", "whether it is a solid"),
)

# A hole that a needle has made, or a point of its way inside of a solid.
HOLE = Numbers(
  "HOLE",
  ("kind", 1, "-", "0 into a solid, 1 in it, 2 out of it, 3 through a sheet"),
  ("elem", 1, "-", "its triangle, or inside its tetrahedron"),
  ("share", 3, "-", "of the corners but the first"),
  ("slip", 1, "m", "place on the needle at which friction is at rest"),
  ("thread", 1, "m", "place on the thread, from the needle on; 0 while the needle is in it"),
  ("torn", 1, "m", "how far it has torn through the tissue"),
)

# Of the plugin state: a needle, see `forces/needles.h`.
NEEDLE = Numbers(
  "NEEDLE",
  ("stage", 1, "-", "of its tip: 0 away, 1 at a surface, 2 in a solid"),
  ("depth", 1, "m", "how far that has pierced a sheet"),
  ("elem", 1, "-", "triangle of its seat, or inside its tetrahedron"),
  ("share", 3, "-", "of the corners but the first"),
  ("work", 1, "J", "what piercing has taken"),
  ("count", 1, "-", "holes, the first made first"),
  ("hole", HOLES * len(HOLE), "-", "see HOLE"),
)

# What a needle meets.
PIERCE = Numbers(
  "PIERCE",
  ("force", 1, "N", "that tissue bears of its tip, along it"),
  ("surface", 1, "N", "that the surface of a solid bears"),
  ("friction", 1, "N/m", "by length in tissue"),
  ("stiffness", 1, "N/m", "of what ties it to a hole"),
  ("tear", 1, "N/m", "that tissue bears across it, by length"),
  ("capstan", 1, "-", "friction of its thread around the edge of a hole"),
  ("wall", 1, "m", "thickness of a sheet, 0 of a solid"),
  ("clear", 1, "m", "how far a tip is off its seat before it may skid"),
  ("margin", 1, "m", "before its first hole, from where on it has no contacts"),
  ("close", 1, "m", "from a hole, to where its thread has none"),
  ("stop", 1, "-", "whether a bead at the thread's end is wider than the hole"),
  ("knot", 1, "m", "thickness of its thread, 0 where a knot of it is no wider than the hole"),
)

# What holds a thread at a place, see `tissue/rod_ties.h`; in the slides' axes.
TIE = Numbers(
  "TIE",
  ("part", 1, "-", "where on its edge it is held, as a share"),
  ("aim", 3, "m", "where what holds it will be"),
  ("stiffness", 1, "N/m", "of the spring"),
  ("friction", 1, "N", "what that bears along the thread"),
  ("along", 3, "-", "which way that is"),
  ("bears", 1, "N", "what holds it across"),
  ("force", 3, "N", "on the thread, of the step"),
  ("torn", 3, "m", "how far that has torn what holds it"),
  ("stop", 1, "m", "how far it keeps off along that way, of what it pushes only; or 0"),
)

# The last numbers of the plugin state of a windowed organ.
TAIL = Numbers(
  "TAIL",
  ("stamp", 1, "-", "of a motion that is kept on a device, see `resident`"),
  ("quiet", 1, "s", "time without motion and force"),
  ("gravity", 3, "m/s^2", "of the step in which the organ fell asleep"),
  ("low", 3, "m", "lowest corner of the organ's bounds, in its frame"),
  ("high", 3, "m", "highest corner"),
  ("heavier", 1, "-", "how many times its inertia at rest a tool meets; 0 for once"),
  ("leeway", 1, "m", "how far a tool may go from where it was when the organ fell asleep"),
)

TABLES = (
  FLAG, MODE, HEAD, MOVED, PUSHED, GEOM, SUMMARY, ANSWER, RECORD, POSE, BOND, BLADE, LAW,
  HOLE, NEEDLE, PIERCE, TIE, TAIL,
)  # fmt: skip
CONSTANTS = {
  "TRAIL": TRAIL,
  "HOLES": HOLES,
  **{name: value for table in TABLES for name, value in table.constants().items()},
}


@struct
class Topology:
  """The mesh of an organ with room for cuts, see `cuts`; zero before the first one."""

  corner: doubles("ncorner")  # corners of each triangle, packed; of a wall its face + 1 [-]
  place: doubles("nplace", 3)  # rest position of each vertex, in the organ's frame [m]
  weight: doubles("nplace")  # its mass [kg]
  source: doubles("nspare")  # what vertex each spare one comes from; of a solid a corner + 1 [-]
  stamp: doubles("ncuts")  # of all these; 0 before the first cut [-]


# Its sizes where there is no room, and that of what cuts.
NO_CUTS = {"nblade": 0, "nneedle": 0, "ncorner": 0, "nplace": 0, "nspare": 0, "ncuts": 0}


@struct
class NodalState:
  """Plugin state of an organ whose nodes are degrees of freedom of MuJoCo; of solids, the outer."""

  disp: doubles("ninner")  # displacement from rest of nodes inside [m]
  vel: doubles("ninner")  # their velocity [m/s]
  force: doubles("nfree")  # contact force of the last step [N]
  last: doubles("nmoving")  # last change of the velocity, of those inside after the others [m/s]
  before: doubles("nmoving")  # the one before it [m/s]
  relaxation: doubles("nrelax", 6)  # see `forces/relaxation.h` [N]
  bond: doubles("nbond", len(BOND))  # of each vertex that moves, see BOND
  blade: doubles("nblade", len(BLADE))  # of each geom that cuts, see BLADE
  needle: doubles("nneedle", len(NEEDLE))  # of each needle, see NEEDLE
  cuts: Topology
  heavier: doubles(1)  # how many times its inertia at rest a tool meets; 0 for once [-]
  signature: doubles(1)  # of the organ, see `Declaration`; 0 where it was set by hand [-]


@struct
class Motion:
  """Motion of a windowed organ, in the order of its vertices and in its frame."""

  disp: doubles("nvert", 3)  # displacement from rest [m]
  vel: doubles("nvert", 3)  # velocity [m/s]
  last: doubles("nvert", 3)  # last change of the velocity [m/s]
  before: doubles("nvert", 3)  # the one before it [m/s]


@struct
class WindowState:
  """Plugin state of a windowed organ."""

  motion: Motion
  force: doubles("nslot", 3)  # contact force of the last step on each slot [N]
  relaxation: doubles("nrelax", 6)  # see `forces/relaxation.h` [N]
  bond: doubles("nbond", len(BOND))  # of each vertex that moves, see BOND
  blade: doubles("nblade", len(BLADE))  # of each geom that cuts, see BLADE
  needle: doubles("nneedle", len(NEEDLE))  # of each needle, see NEEDLE
  slip: doubles("nrest", 3)  # how far nodes have slipped on what they rest on [m]
  slot: doubles("nslot")  # node + 1; 0: the slot's default node, -1: not used
  cuts: Topology
  pose: doubles("ngeom", len(POSE))  # where the window's geoms were, see POSE
  tail: doubles(len(TAIL))  # see TAIL
  signature: doubles(1)  # of the organ, see `Declaration`; 0 where it was set by hand [-]


@struct
class RodState:
  """Plugin state of a thread, see `rods`."""

  twist: doubles("nvert")  # twist at each node between two edges, 0 at the ends [rad]
  pushed: doubles("nv")  # force on other bodies in the last step: known, and its constraints'
  accelerated: doubles("nv")  # their acceleration then
  broken: doubles("nvert")  # whether an edge has broken
  moved: doubles("nmoved")  # how far each node has along the thread, see `solver/rod_refine.h` [m]
  rest_curvature: doubles("nyield")  # of each node, in the slides' axes, see `tissue/rod.h`
  signature: doubles(1)  # of the thread; 0 where it was set by hand [-]


def rod_sizes(nvert: int, nv: int, refine: Any, yields: Any) -> dict[str, int]:
  """Returns the sizes of `RodState`, of nodes that move along a thread or not, and yield or not."""
  sizes = {"nmoved": nvert if refine else 0, "nyield": 3 * nvert if yields else 0}
  return {"nvert": nvert, "nv": nv} | sizes


@struct
class Inbox:
  """What a windowed organ's nodes are told."""

  head: doubles(len(HEAD))  # see HEAD
  moved: doubles("nslot", len(MOVED))  # see MOVED
  pushed: doubles("nslot", len(PUSHED))  # see PUSHED
  geom: doubles("ngeom", len(GEOM))  # see GEOM


@struct
class Outbox:
  """What they answer."""

  summary: doubles(len(SUMMARY))  # see SUMMARY
  dvel: doubles("nslot", 3)  # change of each slot's velocity in this step [m/s]
  answer: doubles("nslot", len(ANSWER))  # see ANSWER
  found: doubles(1)  # nodes near the window's geoms
  record: doubles("most", len(RECORD))  # see RECORD, as far as there is room


def spans(kind: Any, sizes: Mapping[str, int], start: int = 0) -> dict[str, slice]:
  """Returns where each block of a struct lies, by name; `sizes` has the named sizes."""
  out: dict[str, slice] = {}
  for name, var in kind.vars.items():
    dims = DIMS[kind.key].get(name)
    if dims is None:
      out |= spans(var.type, sizes, start)
    else:
      out[name] = slice(start, start + math.prod(_shape(dims, sizes)))
    start = list(out.values())[-1].stop
  return out


def size(kind: Any, sizes: Mapping[str, int]) -> int:
  """Returns how many numbers the blocks of a struct have."""
  return list(spans(kind, sizes).values())[-1].stop


def carve(kind: Any, array: wp.array, sizes: Mapping[str, int]):
  """Returns the struct whose blocks are views of an array, which must outlive it."""
  return _carve(kind, array, sizes, spans(kind, sizes))


def _carve(kind: Any, array: wp.array, sizes: Mapping[str, int], where: dict[str, slice]):
  out = kind()
  for name, var in kind.vars.items():
    dims = DIMS[kind.key].get(name)
    if dims is None:
      view = _carve(var.type, array, sizes, where)
    else:
      address, shape = array.ptr + 8 * where[name].start, _shape(dims, sizes)
      view = wp.array(ptr=address, dtype=wp.float64, shape=shape, device=array.device)
    setattr(out, name, view)
  return out


def _shape(dims: tuple, sizes: Mapping[str, int]) -> tuple[int, ...]:
  return tuple(sizes[n] if isinstance(n, str) else n for n in dims)
