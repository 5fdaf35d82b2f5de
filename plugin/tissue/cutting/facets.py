"""Facets, which cuts open: edges of sheets, or faces between tetrahedra of solids.

Two kinds behind one interface: how a path becomes a cut, how a body's arrays follow it, and how the
plugin state has it. What is above, in one world or many, does not ask which kind it is.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from .. import rows, solid, tets
from ..config import Config
from ..geometry import faces
from ..geometry import mesh as topology
from ..geometry.mesh import Mesh
from . import stamps
from .cut import Cut, Knife, Motion, Springs
from .path import Finder
from .solid_cut import Cleaver
from .surface import WorkingCopy


@dataclasses.dataclass
class World:
  """What cuts have made of an organ in a world.

  Attributes:
    mesh: as it is now
    mass: of its vertices, as compiled [kg]                           (nvert,)
    source: what each was before the first cut                        (nvert,)
    seat: of a solid, a corner of each vertex that cuts have made     (n,)
  """

  mesh: Mesh
  mass: np.ndarray
  source: np.ndarray
  seat: np.ndarray


@dataclasses.dataclass(frozen=True)
class Path:
  """A path that is cut.

  Attributes:
    points: in the organ's frame [m]  (n, 3)
    given: energy around each vertex that what cuts has brought [J]
    at_rest: whether the points are on a sheet at rest, not where it is now
    depth, direction: of the cut in a solid, see `cut_surface.sweep`
  """

  points: np.ndarray
  given: float = 0.0
  at_rest: bool = False
  depth: Any = None
  direction: Any = None


class Edges:
  """Edges of a sheet.

  Args:
    whole: the mesh before the first cut
    room: triangles that there may be

  Attributes:
    CELL: what a mesh has between them
    OF_SHAPE, OF_TISSUE: arrays of `Shape` and `Tissue` that a cut changes
    READ: arrays that are needed to write them
    finder: of places on the surface
  """

  CELL, OF_SHAPE, OF_TISSUE, READ = "elem", rows.OF_SHAPE, rows.OF_TISSUE, rows.ADDRESSES

  def __init__(self, whole: Mesh, room: int):
    self.whole, self._room, self._copy = whole, room, WorkingCopy(whole)
    self.finder = Finder(whole)
    self._knife = self._make_knife()
    self._rows: Any = None
    self._config: Config | None = None

  def _make_knife(self) -> Any:
    return Knife(self._copy, self.finder)

  def cut(
    self, organ: str, had: World, motion: Motion, path: Path, pinned, config, held: Springs | None
  ) -> Cut:
    """Returns what a path makes of a world; see `Knife.cut` and `Cleaver.cut`."""
    if path.depth is not None or path.direction is not None:
      raise ValueError(
        f"organ {organ!r}: depth or direction is set, allowed only with elements='solid'"
      )
    how = config, held, path.given, path.at_rest
    return self._knife.cut(organ, had.mesh, motion, path.points, pinned, *how)

  def seats(self, had: World, found: Any) -> np.ndarray:
    """Returns the corners of vertices that cuts have made, see `World`."""
    return had.seat

  def touched(self, old: Mesh, new: Mesh, changed: np.ndarray) -> np.ndarray:
    """Returns the vertices that something has changed at, in one mesh and another."""
    return topology.distinct(*(getattr(mesh, self.CELL)[changed] for mesh in (old, new)))

  def aim(self, arrays: Mapping[str, Any], node: np.ndarray, nnode: int, half: Any = None):
    """Writes into other arrays from now on.

    Args:
      arrays: of `Shape` and `Tissue`, on the CPU
      node: of each vertex
      nnode: number of nodes
      half: of a solid, blocks to clear of former neighbours, or None
    """
    if self._rows is None:
      self._rows = rows.Rows(self._copy, arrays, node)
    else:
      self._rows.put(arrays)

  def write(
    self, old: Mesh, new: Mesh, changed: np.ndarray, config: Config, pinned: np.ndarray, skip=0
  ):
    """Writes what has changed from one mesh to another, `skip` words on.

    Args:
      old: what the arrays have
      new: what they are to have
      changed: triangles, of a solid tetrahedra, that differ
      config: configuration in force
      pinned: vertices that do not move, (nvert,) bool
      skip: words by which what is written to lies after the arrays

    Raises:
      ValueError: there is no room; nothing has changed then.
    """
    loosened = new.loose is not old.loose
    if not self._rows.write(new, config, pinned, changed, old.elem[changed], loosened, skip):
      raise ValueError("cuts that meet leave no room in the bending matrix")

  # The plugin state: `own` has its blocks, see `engine.layout.Topology`.

  def restored(self, own: Mapping[str, np.ndarray], like: Mesh, rest: np.ndarray) -> tuple:
    """Returns the mesh of a state, what differs from one like it, sources and seats.

    Raises:
      ValueError: the state is not one of this organ.
    """
    whole = self.whole
    elem, loose = stamps.unpack(own["corner"])
    source = np.append(np.arange(whole.nvert - whole.spare), own["source"]).astype(int)
    if (elem < 0).any() or (elem >= whole.nvert).any() or (source[elem] != whole.elem).any():
      raise ValueError("triangles that are none")
    return *topology.recut(like, rest, elem, loose), source, np.zeros(0, np.int64)

  def healed(self, like: Mesh) -> tuple[Mesh, np.ndarray]:
    """Returns the whole mesh, and what differs from `like`."""
    return topology.recut(like, self.whole.rest, self.whole.elem)

  def corner(self, world: World, some: Any = slice(None)) -> np.ndarray:
    """Returns the block `corner`, of some triangles of a sheet or all."""
    mesh = world.mesh
    return stamps.pack(mesh.elem[some], None if mesh.loose is None else mesh.loose[some])

  def origin(self, world: World) -> np.ndarray:
    """Returns the block `source`."""
    return world.source[self.whole.nvert - self.whole.spare :].astype(float)

  def words(self, old: Mesh, new: World, changed: np.ndarray, vert: np.ndarray) -> tuple[Any, Any]:
    """Returns which words of a state may have changed, None for all, and what they are now."""
    mesh = new.mesh
    if len(mesh.tet) or mesh.loose is not old.loose or old.uncut is None:
      return None, self.every_word(new)
    place = (3 * vert[:, None] + np.arange(3)).ravel()
    at = np.concatenate([changed, mesh.nelem + place, mesh.nelem + 3 * mesh.nvert + vert])
    return at, np.concatenate([self.corner(new, changed), mesh.rest[vert].ravel(), new.mass[vert]])

  def every_word(self, world: World) -> np.ndarray:
    """Returns the blocks that a stamp is of."""
    return np.concatenate([self.corner(world), world.mesh.rest.ravel(), world.mass])


class Faces(Edges):
  """Faces between the tetrahedra of a solid: what of these is not as of edges."""

  CELL, OF_SHAPE, OF_TISSUE, READ = "tet", tets.OF_SHAPE, tets.OF_TISSUE, tets.ADDRESSES

  def _make_knife(self) -> Any:
    return Cleaver(self.whole, self.finder, self._room)

  def cut(
    self, organ: str, had: World, motion: Motion, path: Path, pinned, config, held: Springs | None
  ) -> Cut:
    """See `Edges`."""
    how = pinned, path.depth, path.direction, config, path.given
    return self._knife.cut(organ, had.mesh, motion, path.points, *how)

  def seats(self, had: World, found: Any) -> np.ndarray:
    """See `Edges`."""
    first = self.whole.nouter
    seat = np.zeros(found.mesh.nouter - first, np.int64)
    seat[: len(had.seat)] = had.seat
    new = found.member >= first
    seat[found.member[new] - first] = found.seat[new]
    return seat

  def aim(self, arrays: Mapping[str, Any], node: np.ndarray, nnode: int, half: Any = None):
    """See `Edges`."""
    if self._rows is None:
      self._rows = tets.Tets(self.whole, tets.layout(self.whole, node, nnode), node, arrays)
    else:
      self._rows.put(arrays)
    if half is not None:
      self._rows.clear(half)

  def write(
    self, old: Mesh, new: Mesh, changed: np.ndarray, config: Config, pinned: np.ndarray, skip=0
  ):
    """See `Edges`."""
    moduli = None if config == self._config else solid.moduli(new, config)
    if not self._rows.write(new, moduli, pinned | new.unused, changed, old, skip):
      raise ValueError("cuts leave no room for edges; give the organ more spare vertices")
    self._config = config

  def restored(self, own: Mapping[str, np.ndarray], like: Mesh, rest: np.ndarray) -> tuple:
    """See `Edges`."""
    whole, n = self.whole, self.whole.nelem
    face, seat = (np.rint(np.clip(each[each > 0], 0, 2.0**52)).astype(np.int64) - 1
                  for each in (own["corner"][n:], own["source"]))  # fmt: skip
    tet = faces.restored(whole, rest, face, seat)
    of_tet = np.concatenate([whole.of_tet, faces.corners(face)])
    mesh, changed = faces.grown(like, rest, tet, of_tet)
    loose = np.append(stamps.unpack(own["corner"][:n])[1], np.ones(len(face), bool))
    source = np.arange(whole.nvert)
    source[whole.spares][: len(seat)] = whole.tet.ravel()[seat]
    return dataclasses.replace(mesh, loose=loose), changed, source, seat

  def healed(self, like: Mesh) -> tuple[Mesh, np.ndarray]:
    """See `Edges`."""
    return faces.grown(like, self.whole.rest, self.whole.tet, self.whole.of_tet)

  def corner(self, world: World, some: Any = slice(None)) -> np.ndarray:
    """See `Edges`: of walls their faces, from 1."""
    mesh, n = world.mesh, self.whole.nelem
    out = np.zeros(self._room)
    out[:n] = stamps.pack(mesh.elem[:n], None if mesh.loose is None else mesh.loose[:n])
    face = faces.opened(mesh)
    out[n : n + len(face)] = face + 1
    return out

  def origin(self, world: World) -> np.ndarray:
    """See `Edges`: corners, from 1."""
    out = np.zeros(self.whole.spare)
    out[: len(world.seat)] = world.seat + 1
    return out


def of(whole: Mesh, room: int) -> Edges:
  """Returns what comes apart of a mesh; `room`: triangles that there may be."""
  return (Faces if len(whole.tet) else Edges)(whole, room)
