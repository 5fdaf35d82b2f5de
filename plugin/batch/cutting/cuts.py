"""Cuts of an organ in worlds, each with its mesh, as `engine.cutting.cuts` has one mjData's.

Cuts are found on the host, for the worlds that are cut alone. Their motion comes from the device,
and what has changed goes there; graphs go on as they were recorded.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from palpate.engine.cutting.cuts import topology_of
from palpate.forces import passive
from palpate.tissue import step
from palpate.tissue.config import Config
from palpate.tissue.cutting import facets, topology
from palpate.tissue.cutting.cut import Cut
from palpate.tissue.cutting.cut import Motion as Carried
from palpate.tissue.cutting.facets import Path
from palpate.tissue.cutting.meshes import Meshes
from palpate.tissue.cutting.topology import BLOCKS, Piece, Report
from palpate.tissue.geometry.mesh import Mesh, distinct
from palpate.tissue.order import LANES, offset
from palpate.tissue.types import NUMBERS, fill

from .. import kernels
from ..organ import host
from ..organ.patch import Surface

if TYPE_CHECKING:
  from ..organ.organ import Organ

_OWN = ("rest", "elem", "tet", "touch", "source", "share", "held")  # fields of `Patch`
_INSIDE = NUMBERS.index("bulk")  # and pressure after it


@dataclasses.dataclass
class World(facets.World):
  """A world that was cut.

  Attributes:
    pieces: how many there are
    reports: what the cuts did
  """

  pieces: int
  reports: list[Report] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Motion:
  """What vertices of some worlds have, (worlds, nvert, 3) each, see `Patch`."""

  disp: np.ndarray
  vel: np.ndarray
  last: np.ndarray
  before: np.ndarray
  force: np.ndarray


class Cuts(passive.Opening):
  """The meshes of an organ's worlds.

  Args:
    organ: the organ of a batch, whose patch is not made yet
    values: fields of that, which take the meshes in place of the one
    surface: makes what of these follows from a mesh
  """

  def __init__(self, organ: Organ, values: dict, surface: Surface):
    declared, body = organ.declared, organ.body
    self._organ, self._surface = organ, surface
    self.whole: Mesh = declared.mesh
    self._topology = topology_of(declared)
    self._facets, self.finder = self._topology.facets, self._topology.facets.finder
    self._node = node = body.shape.node.numpy()
    self._place = offset(node)[:, None] + LANES * np.arange(3)
    own = {f"patch.{name}": np.asarray(values[name][0]) for name in _OWN}
    self._meshes = Meshes(body, self._facets, own)
    values |= {name: self._meshes.more[f"patch.{name}"] for name in _OWN}
    values["mesh"] = self._meshes.which
    self._here = {name: self._meshes.here[f"patch.{name}"] for name in _OWN}
    starts = {name: getattr(body.shape, name).to("cpu") for name in self._facets.READ}
    self._facets.aim(self._meshes.arrays | starts, node, body.shape.nnode)
    number = body.tissue.number.numpy()[:, _INSIDE : _INSIDE + 2]
    self._worlds: dict[int, World] = {}
    self._configs: dict[int, Config] = {}  # of worlds whose tissue is their own
    self._row: dict[int, int] = {}  # of `_motion`, between `begin` and `finish`
    self._changed: dict[int, list[np.ndarray]] = {}  # vertices and elements, see `finish`
    self._whole_count = topology.count(self.whole)
    self._intact = fill(kernels.Whole, body.device, {
      "first": _INSIDE, "count": self._whole_count, "inside": number,
      "pieces": np.full(body.nworld, self._whole_count), "opened": np.zeros(body.nworld),
      "own": self._meshes.own,
    })  # fmt: skip

  # What there is.

  def follow(self):
    """Forgets what worlds were that have been reset."""
    if not self._worlds:
      return
    opened = self._intact.opened.numpy()
    for world in [world for world in self._worlds if not opened[world]]:
      self._forget(world)

  def _forget(self, world: int):
    del self._worlds[world]
    self._meshes.heal(world)

  def mesh(self, world: int) -> Mesh:
    """See `Opening`; as it was when `follow` was called."""
    return self._of(world).mesh

  def mesh_now(self, world: int) -> Mesh:
    """Returns the mesh of a world."""
    self.follow()
    return self.mesh(world)

  def mass(self, world: int) -> np.ndarray:
    """Returns the masses of its vertices, as compiled [kg], (nvert,)."""
    self.follow()
    return self._of(world).mass

  def reports(self, world: int) -> list[Report]:
    """Returns what the cuts of a world did."""
    self.follow()
    return list(self._of(world).reports)

  def pieces(self, world: int) -> list[Piece]:
    """Returns the parts of a world's organ that hang together, the heaviest first."""
    scale = float(self._organ.patch.mass_scale.numpy()[world])
    mass = scale * self.mass(world)
    return topology.pieces(self.mesh_now(world), mass, self._organ.config.thickness)

  def counts(self) -> wp.array:
    """Returns how many pieces there are, (nworld,)."""
    return self._intact.pieces

  # Within a step.

  def heal(self):
    """Gives the worlds of the mask their whole mesh; `rest` has put back the rest."""
    inputs, body = [self._organ.patch, self._intact], self._organ.body
    wp.launch(kernels.heal, dim=body.nworld, inputs=inputs, device=body.device)
    self._meshes.restore(self._organ.patch.mask)

  def stiffen(self, worlds: np.ndarray, young: np.ndarray):
    """Gives worlds a Young's modulus of their own of each triangle [Pa], (worlds, nelem)."""
    self.follow()
    organ, whole, some = self._organ, self.whole, worlds.tolist()
    every, pinned = np.arange(len(whole.tet) or whole.nelem), ~organ.declared.free
    for world, own in zip(some, young, strict=True):
      self._configs[world] = dataclasses.replace(organ.config, young=tuple(own.tolist()))
      self._meshes.heal(world)
      skip = self._meshes.open(world)
      self._facets.write(whole, whole, every, self._configs[world], pinned, skip)
    self._meshes.keep(some)
    self._meshes.upload(some)
    cut = [world for world in some if world in self._worlds]
    for world in cut:
      had = self._worlds.pop(world)
      self._become(world, self._of(world), had, every)
    if cut:
      self._upload(cut)

  def _config(self, world: int) -> Config:
    return self._configs.get(world, self._organ.config)

  def renumber(self, worlds: np.ndarray, number: np.ndarray, rows: dict[str, np.ndarray]):
    """Keeps bulk and pressure of worlds for when they are whole again: where one is open they end.

    Args:
      worlds: that have changed
      number: `NUMBERS` of all worlds, which are written to
      rows: what has changed
    """
    self.follow()
    inside = self._intact.inside.numpy()
    for k in (_INSIDE, _INSIDE + 1):
      if NUMBERS[k] in rows:
        inside[worlds, k - _INSIDE] = rows[NUMBERS[k]]
    self._intact.inside.assign(inside)
    opened = [w for w, own in self._worlds.items() if self.whole.closed and not own.mesh.closed]
    number[opened, _INSIDE : _INSIDE + 2] = 0.0

  # Cutting.

  def begin(self, worlds: list[int]):
    """See `Opening`."""
    self.follow()
    self._motion, self._row = self.motion(worlds), {world: k for k, world in enumerate(worlds)}

  def disp(self, world: int) -> np.ndarray:
    """See `Opening`."""
    return self._motion.disp[self._row[world]]

  def cut(self, world: int, path: Path) -> Report:
    """See `Opening`."""
    return self._apply(world, self._find(world, path))

  def _find(self, world: int, path: Path) -> Cut:
    """Returns what a path makes of a world."""
    organ, k = self._organ, self._row[world]
    had, moving = self._of(world), (self._motion.disp[k], self._motion.vel[k])
    held = organ.forces.springs(world)
    found = self._topology.find(had, *moving, path, self._config(world), held)
    kept = (getattr(found.motion, name).copy() for name in ("mass", "disp", "vel"))
    return dataclasses.replace(found, motion=Carried(*kept))

  def cut_each(self, points: dict[int, np.ndarray], depth, direction) -> list[Report | None]:
    """Cuts worlds along points in the world's axes, (n, 3) [m] each; see `Tissue.cut`."""
    found: dict[int, Cut] = {}
    out: list[Report | None] = [None] * self._organ.body.nworld
    self.begin(sorted(points))
    for world in self._row:
      try:
        path = self._topology.path(points[world], 0.0, depth, direction)
        found[world] = self._find(world, path)
      except ValueError as error:
        raise ValueError(f"world {world}: {error}") from None
    for world, cut in found.items():
      out[world] = self._apply(world, cut)
    self.finish()
    return out

  def _apply(self, world: int, cut: Cut) -> Report:
    """Makes a world the mesh that was found; `finish` is to come."""
    organ, had = self._organ, self._of(world)
    report = self._topology.report(had, cut, organ.config.thickness)
    if cut.changed.size:
      _carry(self._motion, self._row[world], cut, organ.declared.free)
      organ.forces.carry(world, cut.group, cut.member, cut.share)
      # Vertices that come apart inside do not make two pieces of one.
      same = cut.mesh.loose is had.mesh.loose
      pieces = had.pieces if same else topology.count(cut.mesh)
      now = World(**vars(self._topology.taken(had, cut)), pieces=pieces, reports=had.reports)
      self._become(world, had, now, cut.changed)
      now.reports.append(report)
    return report

  def finish(self):
    """See `Opening`: brings the worlds that have changed to the device."""
    organ, own = self._organ, [world for world in self._row if world in self._changed]
    if own:
      which = [self._row[world] for world in own]
      self._upload(own)
      names = [field.name for field in dataclasses.fields(Motion)]
      self.put_motion(own, Motion(*(getattr(self._motion, name)[which] for name in names)))
      host.follow(organ.batch, own)

  def _of(self, world: int) -> World:
    """Returns a world, that of the first mesh until it is cut."""
    known = self._worlds.get(world)
    return known or World(**vars(self._topology.first), pieces=self._whole_count)

  def _become(self, world: int, had: World, now: World, changed: np.ndarray):
    """Writes the row of a world, in which triangles have changed."""
    organ, mesh = self._organ, now.mesh
    touched, pinned = self._facets.touched(had.mesh, mesh, changed), ~organ.declared.free
    skip = self._meshes.open(world)
    self._facets.write(had.mesh, mesh, changed, self._config(world), pinned, skip)
    self._worlds[world] = now
    kept = self._changed.get(world)
    self._changed[world] = (
      [touched, changed] if kept is None
      else [distinct(*pair) for pair in zip(kept, (touched, changed), strict=True)]
    )  # fmt: skip

  def _upload(self, worlds: list[int]):
    """Gives the device the meshes of worlds, and what follows from them."""
    organ, body = self._organ, self._organ.body
    changes = [(self._worlds[world], *self._changed.pop(world)) for world in worlds]
    self._surface.write(self._here, worlds, changes)
    self._meshes.upload(worlds)
    for _ in range(2 * body.has_bending):  # what is left of the first time is exact
      self._meshes.angle(worlds, step.rest_angles(body))
    if body.is_solid:
      for world in worlds:  # whose blocks have former neighbours
        body.system.half[world].zero_()
    mass = np.ones((len(worlds), body.shape.nnode), np.float32)
    scale = organ.patch.mass_scale.numpy()
    for k, world in enumerate(worlds):
      own = scale[world] * self._worlds[world].mass
      mass[k, self._node] = np.where(own > 0, own, 1.0)
    self._put(body.state.mass, worlds, mass)
    if self.whole.closed and any(not self._worlds[world].mesh.closed for world in worlds):
      number = body.tissue.number.numpy()
      for world in worlds:
        if not self._worlds[world].mesh.closed:
          number[world, _INSIDE : _INSIDE + 2] = 0.0
      body.tissue.number.assign(number)
    self._count(worlds, [self._worlds[world].pieces for world in worlds], 1)
    organ.wake(worlds)

  def _count(self, worlds: list[int], pieces: list[int], opened: int):
    for array, values in ((self._intact.pieces, pieces), (self._intact.opened, opened)):
      rows = array.numpy()
      rows[worlds] = values
      array.assign(rows)

  # Motion of some worlds, to the host and back.

  def motion(self, worlds: list[int]) -> Motion:
    """Returns what the vertices of worlds have."""
    out = {}
    for name, array in self._organ.vectors.items():
      out[name] = self._get(array, worlds)[:, self._place].astype(float)
    rows = self._get(self._organ.patch.force, worlds).reshape(len(worlds), -1, 3)
    return Motion(**out, force=rows[:, self._node].astype(float))

  def put_motion(self, worlds: list[int], motion: Motion):
    """Gives vertices of worlds their motion."""
    shape = len(worlds), 3 * self._organ.body.shape.nnode
    for name, array in self._organ.vectors.items():
      rows = np.zeros(shape, np.float32)
      rows[:, self._place] = getattr(motion, name)
      self._put(array, worlds, rows)
    rows = np.zeros(shape, np.float32).reshape(len(worlds), -1, 3)
    rows[:, self._node] = motion.force
    self._put(self._organ.patch.force, worlds, rows)

  def _get(self, array: wp.array, worlds: list[int]) -> np.ndarray:
    whole = array.reshape((array.shape[0], -1))
    rows = wp.empty((len(worlds), whole.shape[1]), dtype=float, device=array.device)
    at = wp.array(worlds, dtype=int, device=array.device)
    wp.launch(kernels.get_rows, dim=rows.shape, inputs=[whole, at, rows], device=array.device)
    return rows.numpy()

  def _put(self, array: wp.array, worlds: list[int], values: np.ndarray):
    whole = array.reshape((array.shape[0], -1))
    rows = wp.array(values.reshape(len(worlds), -1), dtype=float, device=array.device)
    at = wp.array(worlds, dtype=int, device=array.device)
    wp.launch(kernels.put_rows, dim=rows.shape, inputs=[rows, at, whole], device=array.device)

  # States.

  def pull(self, world: int, own: np.ndarray, spans: dict[str, slice]):
    """Writes the mesh of a world to the plugin state, zero where it was not cut."""
    self.follow()
    if world in self._worlds:
      self._topology.write({name: own[spans[name]] for name in BLOCKS}, self._worlds[world])

  def push(self, world: int, own: np.ndarray, spans: dict[str, slice]):
    """Gives a world the mesh of a plugin state."""
    blocks = {name: own[spans[name]] for name in BLOCKS}
    self.follow()
    had = self._of(world)
    found, changed = self._topology.read(blocks, had.mesh)
    if changed.size or found.mesh is not had.mesh:
      now = World(**vars(found), pieces=topology.count(found.mesh))
      self._become(world, had, now, changed)
      self._upload([world])
    if found.mesh is self.whole and world in self._worlds:
      self._forget(world)
      which = self._meshes.which.numpy()
      which[world] = 1 + world if world in self._configs else 0
      self._meshes.which.assign(which)
      self._count([world], [self._whole_count], 0)

  @staticmethod
  def is_cut(own: np.ndarray, spans: dict[str, slice]) -> bool:
    """Returns whether a plugin state has cuts."""
    return bool(own[spans["stamp"]].any())


def _carry(motion: Motion, k: int, cut: Cut, free: np.ndarray):
  """Gives the vertices of the k-th world of a motion what a cut makes of it."""
  motion.disp[k], motion.vel[k] = cut.motion.disp, cut.motion.vel
  moves = free[cut.member]
  group, member, share = cut.group[moves], cut.member[moves], cut.share[moves]
  force = motion.force[k]
  force[member] = share[:, None] * force[group]
  for values in (motion.last[k], motion.before[k]):
    values[member] = values[group]
