"""Cuts of an organ in one mjData: its mesh as it is now, which is part of the plugin state.

The state has what tells the mesh from the whole one: corners, rest positions, masses, and a stamp
of them. Where the stamp is not that of the arrays, a state came from outside (or a reset, a copy),
and what differs is written into them. MuJoCo's own list of triangles is in the mjModel; it has a
stamp too, and a number that each writing changes, so that several mjData of one model take turns.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from palpate.tissue import body as bodies
from palpate.tissue.cutting import cut as cutting
from palpate.tissue.cutting.path import Finder, check_points
from palpate.tissue.cutting.refill import Refill
from palpate.tissue.cutting.surface import WorkingCopy
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh

from .. import coupling
from ..model import flexes, mjstruct
from ..windows import model_lock
from .tear import Tear
from .walls import Walls

if TYPE_CHECKING:
  from ..model.declare import Declaration
  from ..workspace import Workspace

_UNCUT = 1.0  # stands for the stamp of triangles before the first cut
FOREIGN = "plugin_state has cuts that are not of this organ; set a state that was saved from it"


@dataclasses.dataclass(frozen=True)
class Report:
  """What a cut has done.

  Attributes:
    length: of the edges that came apart, at rest [m]
    area: of the faces that it opened at rest: length times thickness of a wall [m^2]
    path: those edges at rest, in the world: polylines, each (n, 3) [m]
    deviation: greatest distance of their vertices from the path that was asked for, at rest [m]
    nodes: spare vertices used
    stopped: whether it ended early for want of spare vertices
    depth: of a solid, how far below its skin it goes at most, at rest [m]
  """

  length: float
  area: float
  path: list[np.ndarray]
  deviation: float
  nodes: int
  stopped: bool
  depth: float = 0.0


@dataclasses.dataclass(frozen=True)
class Piece:
  """A part of an organ that hangs together.

  Attributes:
    vertices: numbers of its vertices, those on the surface
    mass: [kg]
    volume: of its wall, rest area times thickness, or of a solid's tetrahedra, at rest [m^3]
    held: whether the foundation holds it; not where it was cut free
  """

  vertices: np.ndarray
  mass: float
  volume: float
  held: bool


class Cuts:
  """The mesh of a workspace's organ; false where there is no room for cuts.

  Args:
    w: the workspace, whose body has a state but no graphs yet
  """

  def __init__(self, w: Workspace):
    self._w = w
    self.whole: Mesh = w.organ.mesh
    self.stamp = 0.0
    self._fresh = False
    self.reports: list[Report] = []
    self._tear = Tear()
    if not self:
      return
    bodies.unshare(w.body)
    bodies.occupy(w.body, self.whole)
    self._make()
    self.walls = Walls(w.organ, w.model)
    self.declared = w.organ
    self.mass = w.organ.mass.copy()
    self.source = np.arange(self.whole.nvert)
    self._own: dict[str, np.ndarray] = {}
    self._total: int | None = None  # that the stamp is made of, None for not known
    self._loose: np.ndarray | None = None  # that of the mesh in the state then
    self.lock: Any = None  # held while the model's triangles are read or written

  def __bool__(self) -> bool:
    return self.whole.spare > 0

  def _make(self):
    """Makes what finds cuts, and what writes meshes into the body's arrays."""
    copy = WorkingCopy(self.whole)
    self._refill, self._knife = Refill(self._w.body, copy), cutting.Knife(copy)
    self.finder = Finder(copy)

  @property
  def full(self) -> bool:
    """Whether there is no spare vertex left."""
    return self.mesh.nouter == self.mesh.nskin

  @property
  def mesh(self) -> Mesh:
    """The mesh as it is now."""
    return self._w.organ.mesh

  def bind(self, model: int):
    """Takes views of the plugin state and of the model."""
    if not self:
      return
    w, m = self._w, mjstruct.Model.from_address(model)
    state, where = w.plugin_state, coupling.spans(w.organ)
    names = ("corner", "place", "weight", "source", "stamp")
    self._own = {name: state[where[name]] for name in names}
    self._words = state[where["corner"].start : where["weight"].stop]
    self._found: Any = self._own["stamp"].data
    self.lock = model_lock.lock_of(model)
    self._elem = flexes.element_data(m, w.organ.flex)
    self._border = np.flatnonzero(self.whole.twin < 0)
    self._rim = flexes.rim_data(m, w.organ.flex, len(self._border))
    self._marks = flexes.marks(m, w.organ.flex)
    self._seen = float(self._marks[1])

  # What the state says.

  def renewed(self) -> bool:
    """Follows the plugin state; returns whether contacts have to be found with another mesh."""
    self.follow()
    was, self._fresh = self._fresh, False
    return was

  def follow(self):
    """Makes the organ what the plugin state says.

    Raises:
      ValueError: the state is not one of this organ.
    """
    if not self or self._found[0] == self.stamp:
      return
    self._become(*self._read(), stamp=self._found[0])
    self.reports = []
    self._fresh, self._total = True, None

  def _read(self) -> tuple:
    """Returns the mesh that the state has, what differs, masses, and where vertices come from."""
    elem, loose, rest, mass, source = read(self.whole, self.declared.mass, self._own)
    return *topology.recut(self.mesh, rest, elem, loose), mass, source

  def copy(self) -> dict[str, np.ndarray]:
    """Returns what the plugin state has of the mesh."""
    return {name: values.copy() for name, values in self._own.items()} if self else {}

  def put(self, kept: dict[str, np.ndarray]):
    """Puts it there again."""
    for name, values in kept.items():
      self._own[name][:] = values

  def _write(self, found: Any, vert: np.ndarray):
    """Writes to the state what a cut has changed, where it has the mesh before; else everything."""
    own, mesh, n = self._own, self.mesh, self.whole.nvert
    words, spare = self._words, mesh.nvert - mesh.spare
    if self._total is None or mesh.loose is not self._loose:
      words[:] = np.concatenate([flexes.pack(mesh.elem, mesh.loose), mesh.rest.ravel(), self.mass])
      self._total = flexes.total(words, slice(None), len(words))
    else:
      elem = found.changed
      loose = None if mesh.loose is None else mesh.loose[elem]
      place = (3 * vert[:, None] + np.arange(3)).ravel()
      at = np.concatenate([elem, mesh.nelem + place, mesh.nelem + 3 * n + vert])
      corner, rest = flexes.pack(mesh.elem[elem], loose), mesh.rest[vert].ravel()
      new, old = np.concatenate([corner, rest, self.mass[vert]]), words[at]
      self._total += flexes.total(new, at, len(words)) - flexes.total(old, at, len(words))
      words[at] = new
    own["source"][:] = self.source[spare:]
    self._loose = mesh.loose
    self.stamp = self._found[0] = flexes.stamp_of(self._total)

  def _become(self, mesh: Mesh, changed: np.ndarray, mass, source, stamp: float) -> np.ndarray:
    """Makes the organ another mesh; returns the vertices that something has changed at."""
    w = self._w
    touched = self._touched(mesh, changed)
    other = mass != self.mass
    other[touched] = False
    if other.any():
      touched = topology.distinct(touched, np.flatnonzero(other))
    self._refill.write(mesh, changed, w.config, ~w.organ.free)
    bodies.occupy(w.body, mesh)
    self.mass, self.source, self.stamp = mass, source, stamp
    w.host.become(self.declared.cut(mesh, mass))
    w.graphs.phases.reshape(touched)
    w.forces.reshape(0)
    return touched

  def _touched(self, mesh: Mesh, changed: np.ndarray) -> np.ndarray:
    """Returns the vertices that something has changed at, in this mesh and another."""
    return topology.touched(self.mesh, mesh, changed)

  def forget(self):
    """Forgets what the body's arrays hold: the material has changed."""
    if self:
      self._refill.forget()

  def share(self, values: np.ndarray, vert: Any = slice(None)) -> np.ndarray:
    """Returns what has become of values by mass of the whole's vertices, at some or all, (n,)."""
    source = self.source[vert]
    was = self.declared.mass[source]
    return values[source] * self.mass[vert] / np.where(was > 0, was, 1.0)

  # MuJoCo's triangles.

  def show(self) -> bool:
    """Gives the model the triangles of this organ; returns whether it has had others meanwhile.

    The caller holds `lock`. What other mjData wrote may be like these again, but not all along.
    """
    own = self.stamp or _UNCUT
    if self._marks[0] != own:
      self._elem[:] = self.mesh.elem[: self.whole.nelem]
      self._rim[:] = np.stack([topology.corners(self.mesh, self._border, k) for k in (0, 1)], 1)
      self._marks[:] = own, model_lock.new_mark()
    was, self._seen = self._seen, float(self._marks[1])
    return was != self._seen

  def draw(self, model: int, data: int):
    """Writes what is drawn of cuts besides these triangles."""
    if self.walls:
      self.walls.draw(self._w.organ, self._w.motion()[0], model, data)

  def hide(self, model: int):
    """Hides it again, after a picture."""
    self.walls.hide(model)

  # Cutting.

  def tear(self) -> bool:
    """Cuts the organ at its most stretched triangle, if that is too far; returns whether."""
    organ, most = self._w.organ, self._w.config.tear
    if self.full:
      return False
    x = organ.mesh.rest + self._w.motion()[0]
    line = self._tear.line(organ.mesh, x, most, self.finder)
    try:
      return line is not None and self.cut(organ.origin + line @ organ.frame.T).nodes > 0
    except ValueError:  # pinned tissue around it
      return False

  def cut(self, points: npt.ArrayLike, given: float = 0.0, depth=None, direction=None) -> Report:
    """Cuts the organ along points in the world, (n, 3) [m]; see `Organ.cut`, and `Knife.cut`."""
    return self._end(self.find(points, given, depth, direction))

  def cut_at_rest(self, points: np.ndarray, given: float) -> Report:
    """Cuts a surface along points on it at rest, in its frame, (n, 3) [m]."""
    self.follow()
    return self._end(self._knife.cut(*self._state(points), given=given, at_rest=True))

  def _end(self, found: Any) -> Report:
    """Takes over what was found, and says what it is."""
    w = self._w
    if found.stopped:
      w.note(
        f"the cut stops early: no spare vertices are left of {self.mesh.spare}; give the organ more"
      )
    done = self._report(found)
    if found.changed.size:
      self._take(found)
    self.reports.append(done)
    return done

  def find(self, points: npt.ArrayLike, given: float = 0.0, depth=None, direction=None) -> Any:
    """Returns what a cut would make of the organ."""
    w, organ = self._w, self._w.organ
    if not self:
      raise ValueError(
        f"organ {organ.name!r}: spare is 0, expected room for cuts: palpate.add_organ(..., spare=)"
      )
    self.follow()
    organ = w.organ
    if direction is not None and np.shape(direction) != (3,):
      raise ValueError(
        f"organ {organ.name!r}: direction is {direction}, expected three numbers, not all 0"
      )
    local = (check_points(organ.name, points) - organ.origin) @ organ.frame
    motion = cutting.Motion(self.mass, *w.motion())
    return self._find(motion, local, given, depth, direction)

  def _find(self, motion: cutting.Motion, points, given: float, depth, direction) -> Any:
    """Returns the cut along points in the organ's frame, see `cutting.Knife`."""
    if depth is not None or direction is not None:
      raise ValueError(
        f"organ {self._w.organ.name!r}: depth or direction is set, allowed only with "
        "elements='solid'"
      )
    return self._knife.cut(*self._state(points, motion), given=given)

  def _state(self, points: np.ndarray, motion: cutting.Motion | None = None) -> tuple:
    """Returns what `Knife.cut` is told of the organ."""
    w, organ = self._w, self._w.organ
    motion = motion or cutting.Motion(self.mass, *w.motion())
    return organ.name, self.mesh, motion, points, ~organ.free, w.config, self._held()

  def _held(self) -> cutting.Springs | None:
    """Returns the springs that hold it, None where there are none."""
    return together(self._w.forces.springs(0), self.mesh.nvert)

  def _report(self, found: Any) -> Report:
    return report(found, self.mesh, self._w.organ, self._w.config.thickness)

  def _take(self, found: Any):
    """Makes the organ the mesh that was found; what moved goes on as it moved."""
    w, mesh, motion = self._w, found.mesh, found.motion
    group, member, share = found.group, found.member, found.share
    source = self.source.copy()
    source[member] = source[group]
    w.forces.carry(0, group, member, share)
    touched = self._become(mesh, found.changed, motion.mass.copy(), source, self.stamp)
    self._write(found, touched)
    changed = topology.distinct(found.near, member)
    w.graphs.phases.carry(changed, motion.disp, motion.vel, group, member, share)
    if not w.organ.windows:  # of which MuJoCo reads triangles only where they are drawn
      with self.lock:
        self.show()

  def pieces(self) -> list[Piece]:
    """Returns the parts that hang together, the largest first."""
    return pieces(self.mesh, self._w.organ.mass, self._w.config.thickness)


def together(springs: list[tuple], nvert: int) -> cutting.Springs | None:
  """Returns what springs are together of each vertex; None where there are none.

  Args:
    springs: vertices, stiffness [N/m], and stretch in the organ's frame [m] of several
    nvert: number of the organ's vertices
  """
  if not springs:
    return None
  energy, force, hard = np.zeros(nvert), np.zeros((nvert, 3)), np.zeros(nvert)
  for vert, stiffness, stretch in springs:
    np.add.at(energy, vert, 0.5 * stiffness * (stretch**2).sum(axis=1))
    np.add.at(force, vert, stiffness[:, None] * stretch)
    np.add.at(hard, vert, stiffness)
  return cutting.Springs(energy, force, hard)


def report(found: cutting.Cut, before: Mesh, organ: Declaration, thickness: float) -> Report:
  """Returns what a cut of a mesh has done; `organ` is its declaration."""
  path = [organ.origin + line @ organ.frame.T for line in found.path]
  nodes = found.mesh.nouter - before.nouter
  area = found.length * thickness
  return Report(found.length, area, path, found.deviation, nodes, found.stopped)


def pieces(mesh: Mesh, mass: np.ndarray, thickness: float) -> list[Piece]:
  """Returns the parts of a mesh that hang together, the heaviest first."""
  label, solid = topology.pieces(mesh), len(mesh.tet) > 0
  area = topology.vertex_areas(mesh.rest, mesh.elem)
  size = fill.vertex_volumes(mesh) if solid else area * thickness
  held = topology.held_areas(mesh) > 0
  out = []
  for k in range(label.max() + 1):
    vert = np.flatnonzero(label == k)
    numbers = float(mass[vert].sum()), float(size[vert].sum()), bool(held[vert].any())
    out.append(Piece(vert[vert < mesh.nouter], *numbers))
  return sorted(out, key=lambda piece: -piece.mass)


# The plugin state, see `layout.Topology`; `own` has its blocks.


def read(whole: Mesh, mass: np.ndarray, own: dict[str, np.ndarray]):
  """Returns triangles, which of them are loose, rest places, masses and sources of a state.

  Args:
    whole: the mesh before the first cut
    mass: of its vertices [kg]  (nvert,)
    own: blocks of the state

  Raises:
    ValueError: the state is of another organ.
  """
  if not own["stamp"][0]:
    return whole.elem, None, whole.rest, mass, np.arange(whole.nvert)
  elem, loose = flexes.unpack(own["corner"])
  rest, mass = own["place"].reshape(-1, 3).copy(), own["weight"].copy()
  source = np.append(np.arange(whole.nvert - whole.spare), own["source"]).astype(int)
  inside = (elem >= 0).all() and (elem < whole.nvert).all()
  if not inside or not np.array_equal(source[elem], whole.elem):
    raise ValueError(FOREIGN)
  if flexes.stamp(own["corner"], rest, mass) != own["stamp"][0]:
    raise ValueError(FOREIGN)
  return elem, loose, rest, mass, source


def write(own: dict[str, np.ndarray], mesh: Mesh, mass: np.ndarray, source, stamp: float):
  """Writes a mesh to a state."""
  own["corner"][:] = flexes.pack(mesh.elem, mesh.loose)
  own["place"][:] = mesh.rest.ravel()
  own["weight"][:] = mass
  own["source"][:] = source[mesh.nvert - mesh.spare :]
  own["stamp"][0] = stamp
