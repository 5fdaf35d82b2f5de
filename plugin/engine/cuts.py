"""Cuts of an organ in one mjData: its mesh as it is now, which is part of the plugin state.

The state has what tells the mesh from the whole one: corners, rest positions, masses, and a stamp
of them. Where the stamp is not that of the arrays, a state came from outside (or a reset, a copy),
and what differs is written into them. MuJoCo's own list of triangles is in the mjModel; it has a
stamp too, so that several mjData of one model take turns.
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import numpy as np
from palpate.tissue import body as bodies
from palpate.tissue import cut as cutting
from palpate.tissue import energy
from palpate.tissue import mesh as topology
from palpate.tissue.mesh import Mesh
from palpate.tissue.refill import Refill

from . import coupling, flexes, graphs, mjstruct, turns
from .bind import bind
from .tear import Tear

_FOREIGN = "plugin_state has cuts that are not of this organ; set a state that was saved from it"


@dataclasses.dataclass(frozen=True)
class Report:
  """What a cut has done.

  Attributes:
    length: of the edges that came apart, at rest [m]
    area: of the faces that a cut through the wall opened: length times thickness [m^2]
    path: those edges at rest, in the world: polylines, each (n, 3) [m]
    deviation: greatest distance of their vertices from the path that was asked for, at rest [m]
    nodes: spare vertices used
    stopped: whether it ended early for want of spare vertices
  """

  length: float
  area: float
  path: list[np.ndarray]
  deviation: float
  nodes: int
  stopped: bool


@dataclasses.dataclass(frozen=True)
class Piece:
  """A part of an organ that hangs together.

  Attributes:
    vertices: numbers of its vertices
    mass: [kg]
    volume: of its wall, rest area times thickness [m^3]
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

  def __init__(self, w):
    self._w = w
    self.whole: Mesh = w.organ.mesh
    self.stamp = 0.0
    self._fresh = False
    self.reports: list[Report] = []
    self.tear = Tear(w)
    if not self:
      return
    bodies.unshare(w.body)
    self._refill = Refill(w.body, self.whole)
    self.declared = w.organ
    self.mass = w.organ.mass.copy()
    self.source = np.arange(self.whole.nvert)
    self._own: dict[str, np.ndarray] = {}
    self.lock: Any = None  # held while the model's triangles are read or written

  def __bool__(self) -> bool:
    return self.whole.spare > 0

  @property
  def full(self) -> bool:
    """Whether there is no spare vertex left."""
    return self.mesh.nouter == self.mesh.nvert

  @property
  def mesh(self) -> Mesh:
    """The mesh as it is now."""
    return self._w.organ.mesh

  def bind(self, model: int):
    """Takes views of the plugin state and of the model."""
    if not self:
      return
    w, m = self._w, mjstruct.Model.from_address(model)
    state, where = w.views["plugin_state"].numpy(), coupling.spans(w.organ)
    names = ("corner", "place", "weight", "source", "stamp")
    self._own = {name: state[where[name]] for name in names}
    self._found: Any = self._own["stamp"].data
    self.lock = turns.lock_of(model)
    self._elem = flexes.element_data(m, w.organ.flex)
    self._border = np.flatnonzero(self.whole.twin < 0)
    self._rim = flexes.rim_data(m, w.organ.flex, len(self._border))
    self._mark: Any = flexes.marks(m, w.organ.flex, self.whole.nelem)[-1:].data

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
    elem, loose, rest, mass, source = read(self.whole, self.declared.mass, self._own)
    mesh, changed = topology.recut(self.mesh, rest, elem, loose)
    self._become(mesh, changed, mass, source, self._found[0])
    self.reports = []
    self._fresh = True

  def copy(self) -> dict[str, np.ndarray]:
    """Returns what the plugin state has of the mesh."""
    return {name: values.copy() for name, values in self._own.items()} if self else {}

  def put(self, kept: dict[str, np.ndarray]):
    """Puts it there again."""
    for name, values in kept.items():
      self._own[name][:] = values

  def _become(self, mesh: Mesh, changed: np.ndarray, mass, source, stamp: float):
    w = self._w
    touched = topology.touched(self.mesh, mesh, changed)
    touched = topology.distinct(touched, np.flatnonzero(mass != self.mass))
    self._refill.write(mesh, changed, w.config, ~w.organ.free)
    self.mass, self.source, self.stamp = mass, source, stamp
    w.organ = dataclasses.replace(self.declared, mesh=mesh, mass=mass)
    w.phases.reshape(touched)
    for grown in [space for each in w.beside for space in each.reshape()]:
      with graphs.lock:
        bind(grown, grown.model)

  def forget(self):
    """Forgets what the body's arrays hold: the material has changed."""
    if self:
      self._refill.forget()

  def share(self, values: np.ndarray) -> np.ndarray:
    """Returns values by mass of the whole's vertices, spread over what became of them, (nvert,)."""
    was = self.declared.mass[self.source]
    return values[self.source] * self.mass / np.where(was > 0, was, 1.0)

  # MuJoCo's triangles.

  @property
  def shown(self) -> bool:
    """Whether the model has the triangles of this organ."""
    return self._mark[0] == self.stamp

  def show(self):
    """Gives the model the triangles of this organ."""
    if not self.shown:
      self._elem[:] = self.mesh.elem
      self._rim[:] = np.stack([topology.corners(self.mesh, self._border, k) for k in (0, 1)], 1)
      self._mark[0] = self.stamp

  # Cutting.

  def cut(self, points: np.ndarray, given: float = 0.0) -> Report:
    """Cuts the organ along points in the world, (n, 3) [m]; see `Organ.cut`, and `cutting.cut`."""
    w, (found, u, v) = self._w, self.find(points, given)
    organ, mesh = w.organ, self.mesh
    if found.stopped:
      w.note(
        f"the cut stops early: no spare vertices are left of {mesh.spare}; give the organ more"
      )
    done = report(found, mesh, organ, w.config.thickness)
    if found.changed.size:
      self._take(found, u, v)
    self.reports.append(done)
    return done

  def find(
    self, points: np.ndarray, given: float = 0.0
  ) -> tuple[cutting.Cut, np.ndarray, np.ndarray]:
    """Returns what a cut would make of the organ, and displacement and velocity of its vertices."""
    w, organ = self._w, self._w.organ
    if not self:
      raise ValueError(
        f"organ {organ.name!r}: spare is 0, expected room for cuts: palpate.add_organ(..., spare=)"
      )
    self.follow()
    organ, mesh = w.organ, self.mesh
    local = (np.asarray(points, float) - organ.origin) @ organ.frame
    u, v = w.phases.motion()
    of_triangles = functools.partial(energy.of_triangles, w.config)
    energies = of_triangles, self._held()
    found = cutting.cut(organ.name, mesh, mesh.rest + u, local, ~organ.free, *energies, given)
    return found, u, v

  def _held(self) -> cutting.Held | None:
    """Returns what tells the energy of ties and bonds, None where there are none."""
    springs = [*self._w.ties.springs(), *self._w.bonds.springs()]
    if not springs:
      return None
    n = self.mesh.nvert
    whole, pull, hard = np.zeros(n), np.zeros((n, 3)), np.zeros(n)
    for vert, stiffness, stretch in springs:
      np.add.at(whole, vert, 0.5 * stiffness * (stretch**2).sum(axis=1))
      np.add.at(pull, vert, stiffness[:, None] * stretch)
      np.add.at(hard, vert, stiffness)

    def held(vert: np.ndarray, way: np.ndarray) -> np.ndarray:
      return whole[vert] + (way * pull[vert]).sum(1) + 0.5 * hard[vert] * (way**2).sum(1)

    return held

  def _take(self, found: cutting.Cut, u: np.ndarray, v: np.ndarray):
    """Makes the organ the mesh that was found; what moved goes on as it moved."""
    w, mesh, group, member = self._w, found.mesh, found.group, found.member
    after = divide(found, Divided(self.mesh, self.mass, self.source, u, v), w.organ.free)
    for each in w.beside:
      each.carry(group, member, after.share)
    stamp = flexes.stamp(flexes.pack(mesh.elem, mesh.loose), mesh.rest, after.mass)
    self._become(mesh, found.changed, after.mass, after.source, stamp)
    write(self._own, mesh, self.mass, self.source, stamp)
    w.phases.carry(after.changed, after.disp, after.vel, group, member, after.share)
    self.show()

  def pieces(self) -> list[Piece]:
    """Returns the parts that hang together, the largest first."""
    return pieces(self.mesh, self._w.organ.mass, self._w.config.thickness)


@dataclasses.dataclass
class Divided:
  """A mesh, and what its vertices have.

  Attributes:
    mesh: the mesh
    mass: of each vertex [kg]                                    (nvert,)
    source: what vertex each was before the first cut            (nvert,)
    disp: displacement [m]                                       (nvert, 3)
    vel: velocity [m/s]                                          (nvert, 3)
    changed: vertices with another displacement or velocity      (n,)
    share: of what was one, the part that each member has        (m,)
  """

  mesh: Mesh
  mass: np.ndarray
  source: np.ndarray
  disp: np.ndarray
  vel: np.ndarray
  changed: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
  share: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))


def divide(found: cutting.Cut, was: Divided, free: np.ndarray) -> Divided:
  """Returns what vertices have after a cut: what moved goes on as it moved.

  Args:
    found: the cut
    was: what they had
    free: whether a vertex moves   (nvert,) bool
  """
  old, mesh, u, v = was.mesh, found.mesh, was.disp, was.vel
  group, member = found.group, found.member
  mass, source = was.mass.copy(), was.source.copy()
  area = topology.areas_of(mesh, member)
  share = area / np.bincount(group, area, mesh.nvert)[group]
  mass[member] = share * was.mass[group]
  source[member] = source[group]
  now, speed = u.copy(), v.copy()
  now[found.moved] = np.einsum("nk,nkj->nj", found.weight, u[found.corner])
  near = topology.distinct(old.elem[found.changed])
  near = near[free[near]]
  before, goes = (old.rest + u)[near], (mesh.rest + now)[near]
  speed[near] = _keep_spin(was.mass[near], before, goes, v[near])
  now[member], speed[member] = now[group], speed[group]
  changed = topology.distinct(near, member)
  return Divided(mesh, mass, source, now, speed, changed, share)


def report(found: cutting.Cut, before: Mesh, organ, thickness: float) -> Report:
  """Returns what a cut of a mesh has done; `organ` is its declaration."""
  path = [organ.origin + line @ organ.frame.T for line in found.path]
  nodes = found.mesh.nouter - before.nouter
  area = found.length * thickness
  return Report(found.length, area, path, found.deviation, nodes, found.stopped)


def pieces(mesh: Mesh, mass: np.ndarray, thickness: float) -> list[Piece]:
  """Returns the parts of a mesh that hang together, the heaviest first."""
  label = topology.pieces(mesh)
  area = topology.vertex_areas(mesh.rest, mesh.elem)
  held = topology.held_areas(mesh) > 0
  out = []
  for k in range(label.max() + 1):
    vert = np.flatnonzero(label == k)
    volume = float(area[vert].sum() * thickness)
    out.append(Piece(vert, float(mass[vert].sum()), volume, bool(held[vert].any())))
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
    raise ValueError(_FOREIGN)
  if flexes.stamp(own["corner"], rest, mass) != own["stamp"][0]:
    raise ValueError(_FOREIGN)
  return elem, loose, rest, mass, source


def write(own: dict[str, np.ndarray], mesh: Mesh, mass: np.ndarray, source, stamp: float):
  """Writes a mesh to a state."""
  own["corner"][:] = flexes.pack(mesh.elem, mesh.loose)
  own["place"][:] = mesh.rest.ravel()
  own["weight"][:] = mass
  own["source"][:] = source[mesh.nvert - mesh.spare :]
  own["stamp"][0] = stamp


def _keep_spin(mass: np.ndarray, was: np.ndarray, now: np.ndarray, v: np.ndarray) -> np.ndarray:
  """Returns velocities with which nodes, some of them moved, keep momentum and angular momentum.

  That is `v` and a slow rotation of them all about their centre.
  """
  if len(mass) < 3:
    return v
  spin = (mass[:, None] * topology.cross(was - now, v)).sum(axis=0)
  arm = now - (mass[:, None] * now).sum(axis=0) / mass.sum()
  inertia = (mass * (arm**2).sum(axis=1)).sum() * np.eye(3) - (mass * arm.T) @ arm
  omega = np.linalg.lstsq(inertia, spin, rcond=1e-6)[0]
  return v + topology.cross(omega[None], arm)
