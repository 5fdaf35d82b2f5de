"""Cuts of an organ in one mjData: its mesh as it is now, which is part of the plugin state.

The state has what tells the mesh from the whole one: corners, rest positions, masses, and a stamp
of them; of a solid the faces that are open, and a corner of each vertex that cuts have made (see
`tissue.cutting.facets`). Where the stamp is not that of the arrays, a state came from outside (or a
reset, a copy), and what differs is written into them. MuJoCo's own list of triangles is in the
mjModel; it has a stamp too, and a number that each writing changes, so that several mjData of one
model take turns (see `model.shared`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from palpate.tissue import body as bodies
from palpate.tissue.cutting import stamps
from palpate.tissue.cutting.cut import Cut
from palpate.tissue.cutting.facets import Path, World
from palpate.tissue.cutting.path import Finder
from palpate.tissue.cutting.refill import Refill
from palpate.tissue.cutting.topology import BLOCKS, Report, Topology
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh

from ...forces import passive
from .. import coupling
from ..model import flexes, mjstruct, shared
from .trails import Current
from .walls import Walls

if TYPE_CHECKING:
  from palpate.tissue.body import Body
  from palpate.tissue.config import Config

  from ..model.declare import Declaration
  from ..workspace import Workspace

_UNCUT = 1.0  # stands for the stamp of triangles before the first cut


class Cuts:
  """The mesh of an organ in an mjData; false where there is no room for cuts.

  Args:
    organ: the organ before the first cut
    body: its body, which has a state but no graphs yet
    model: address of the mjModel

  Attributes:
    declared: the organ before the first cut
    world: its mesh as it is now, with masses
    reports: what cuts did since the state was set
  """

  world: World

  def __init__(self, organ: Declaration, body: Body, model: int):
    self.declared, self.whole, self._body = organ, organ.mesh, body
    self.reports: list[Report] = []
    self._stamp, self._fresh = 0.0, False
    if not self:
      return
    bodies.unshare(body)
    bodies.occupy(body, self.whole)
    self.topology = topology_of(organ)
    self.world, self.finder = self.topology.first, self.topology.facets.finder
    self._refill = Refill(body, self.topology.facets)
    self._walls = Walls(organ, model)
    self._own: dict[str, np.ndarray] = {}
    self._total: int | None = None  # that the stamp is made of, None for not known

  def __bool__(self) -> bool:
    return self.whole.spare > 0

  @property
  def mesh(self) -> Mesh:
    """The mesh as it is now."""
    return self.world.mesh

  def bind(self, model: int, triangles: shared.Triangles, state: np.ndarray):
    """Takes views of a model, of an mjData's triangles, and of its plugin state."""
    if not self:
      return
    m, organ = mjstruct.model(model), self.declared
    where = coupling.spans(organ)
    self._own = {name: state[where[name]] for name in BLOCKS}
    self._words = state[where["corner"].start : where["weight"].stop]
    self._found: Any = self._own["stamp"].data
    self._triangles = triangles
    self._theirs = flexes.element_data(m, organ.flex)
    self._elem = flexes.element_data(mjstruct.model(triangles.model(model)), organ.flex)
    self._elem[:] = self.mesh.elem[: self.whole.nelem]
    self._border = np.flatnonzero(self.whole.twin < 0)
    self._rim = flexes.rim_data(m, organ.flex, len(self._border))
    self._marks = flexes.marks(m, organ.flex)
    self._seen = float(self._marks[1])

  # What the state says.

  @property
  def stale(self) -> bool:
    """Whether the plugin state has another mesh."""
    return self._found[0] != self._stamp

  def renewed(self) -> bool:
    """Returns once after the state had another mesh: contacts have to be found with this one."""
    was, self._fresh = self._fresh, False
    return was

  def read(self, config: Config) -> np.ndarray:
    """Takes the mesh of the plugin state; returns the vertices that something has changed at.

    Raises:
      ValueError: the state is not one of this organ.
    """
    world, changed = self.topology.read(self._own, self.mesh)
    touched = self._become(world, changed, config)
    self._stamp, self._total, self._fresh, self.reports = self._found[0], None, True, []
    return touched

  def copy(self) -> dict[str, np.ndarray]:
    """Returns what the plugin state has of the mesh."""
    return {name: values.copy() for name, values in self._own.items()} if self else {}

  def put(self, kept: dict[str, np.ndarray]):
    """Puts it there again."""
    for name, values in kept.items():
      self._own[name][:] = values

  def _write(self, old: Mesh, changed: np.ndarray, vert: np.ndarray):
    """Writes to the state what a cut has changed."""
    words, facets = self._words, self.topology.facets
    if self._total is None:
      self._total = stamps.total(words, slice(None), len(words))
    at, new = facets.words(old, self.world, changed, vert)
    if at is None:
      at = np.flatnonzero(new != words)
      new = new[at]
    count = len(words)
    self._total += stamps.total(new, at, count) - stamps.total(words[at], at, count)
    words[at] = new
    self._own["source"][:] = facets.origin(self.world)
    self._stamp = self._found[0] = stamps.stamp_of(self._total)

  def _become(self, world: World, changed: np.ndarray, config: Config) -> np.ndarray:
    """Makes the arrays another world's; returns the vertices that something has changed at."""
    old = self.world
    touched = self.topology.facets.touched(old.mesh, world.mesh, changed)
    other = world.mass != old.mass
    other[touched] = False
    if other.any():
      touched = topology.distinct(touched, np.flatnonzero(other))
    self._refill.write(world.mesh, changed, config, ~self.declared.free)
    self._elem[:] = world.mesh.elem[: self.whole.nelem]
    bodies.occupy(self._body, world.mesh)
    self.world = world
    return touched

  def forget(self):
    """Forgets what the body's arrays hold: the material has changed."""
    if self:
      self._refill.forget()

  def share(self, values: np.ndarray, vert: Any = slice(None)) -> np.ndarray:
    """Returns what has become of values by mass of the whole's vertices, at some or all, (n,)."""
    return self.topology.share(self.world, values, vert)

  # MuJoCo's triangles.

  def show(self, drawn: bool = False) -> bool:
    """Gives the model the triangles of this organ, where it may or they are to be drawn.

    Returns:
      whether it has had others meanwhile: other mjData may have written these again
    """
    own = self._stamp or _UNCUT
    with self._triangles.lock:
      if self._marks[0] != own:
        if not (drawn or self._triangles.alone):
          return True
        self._theirs[:] = self._elem
        self._rim[:] = np.stack([topology.corners(self.mesh, self._border, k) for k in (0, 1)], 1)
        self._marks[:] = own, shared.new_mark()
      was, self._seen = self._seen, float(self._marks[1])
    return was != self._seen

  def draw(self, organ: Declaration, disp: np.ndarray, model: int, data: int):
    """Writes what is drawn of the walls of cuts in a solid."""
    if self._walls:
      self._walls.draw(organ, disp, model, data)

  def hide(self, model: int):
    """Hides it again, after a picture."""
    self._walls.hide(model)

  # Cutting.

  def take(self, found: Cut, config: Config) -> tuple[Report, np.ndarray]:
    """Takes over a cut that was found; returns what it did, and the vertices that it changed."""
    had, touched = self.world, np.zeros(0, int)
    done = self.topology.report(had, found, config.thickness)
    if found.changed.size:
      touched = self._become(self.topology.taken(had, found), found.changed, config)
      self._write(had.mesh, found.changed, touched)
    self.reports.append(done)
    return done, touched


def topology_of(organ: Declaration) -> Topology:
  """Returns what may become of an organ's mesh by cuts."""
  room, frame = coupling.spans(organ)["corner"], (organ.frame, organ.origin)
  size = room.stop - room.start
  return Topology(organ.name, organ.mesh, organ.mass, ~organ.free, frame, size)


# A workspace whose organ is cut.


def follow(w: Workspace):
  """Makes a workspace's organ what its plugin state says.

  Raises:
    ValueError: the state is not one of this organ.
  """
  if w.cuts and w.cuts.stale:
    _reshape(w, w.cuts.read(w.config))


def _reshape(w: Workspace, touched: np.ndarray):
  """Lets all that a workspace has follow its mesh, changed at some vertices."""
  w.host.become(w.cuts.declared.cut(w.cuts.mesh, w.cuts.world.mass))
  w.graphs.phases.reshape(touched)
  w.forces.reshape(0)


def find(w: Workspace, points: npt.ArrayLike, given=0.0, depth=None, direction=None) -> Cut:
  """Returns what a cut along points in the world, (n, 3) [m], would make of a workspace's organ."""
  if not w.cuts:
    raise ValueError(
      f"organ {w.organ.name!r}: spare is 0, expected room for cuts: palpate.add_organ(..., spare=)"
    )
  return _find(w, w.cuts.topology.path(points, given, depth, direction))


def _find(w: Workspace, path: Path) -> Cut:
  follow(w)
  return w.cuts.topology.find(w.cuts.world, *w.motion(), path, w.config, w.forces.springs(0))


def cut(w: Workspace, points: npt.ArrayLike, given=0.0, depth=None, direction=None) -> Report:
  """Cuts a workspace's organ along points in the world, (n, 3) [m]; see `palpate.Organ.cut`.

  Args:
    w: the workspace
    points: the path
    given: energy around each vertex that what cuts has brought [J]
    depth: of the cut in a solid [m], or None
    direction: in which it goes, in the world, or None
  """
  return _take(w, find(w, points, given, depth, direction))


class Opening(passive.Opening):
  """The organ of a workspace, whose mesh forces let come apart."""

  def __init__(self, w: Workspace):
    self._w = w
    follow(w)

  @property
  def finder(self) -> Finder:
    """See `Opening`."""
    return self._w.cuts.finder

  def mesh(self, world: int) -> Mesh:
    """See `Opening`."""
    return self._w.organ.mesh

  def disp(self, world: int) -> np.ndarray:
    """See `Opening`."""
    return self._w.motion()[0]

  def cut(self, world: int, path: Path) -> Report:
    """See `Opening`."""
    return _take(self._w, _find(self._w, path))

  def burn(self, current: Current):
    """See `Opening`."""
    self._w.bonds.burn(current.burning)


def _take(w: Workspace, found: Cut) -> Report:
  """Makes an organ the mesh that was found; what moved goes on as it moved."""
  group, member, share, motion = found.group, found.member, found.share, found.motion
  if found.stopped:
    w.note(
      f"the cut stops early: no spare vertices are left of {w.cuts.whole.spare}; give the organ "
      "more"
    )
  if found.changed.size:
    w.forces.carry(0, group, member, share)
  report, touched = w.cuts.take(found, w.config)
  if found.changed.size:
    _reshape(w, touched)
    changed = topology.distinct(found.near, member)
    w.graphs.phases.carry(changed, motion.disp, motion.vel, group, member, share)
    if not w.organ.windows:  # of which MuJoCo reads triangles only where they are drawn
      w.cuts.show()
  return report
