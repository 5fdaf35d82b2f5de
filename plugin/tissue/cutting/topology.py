"""Cuts of an organ in one world: finding and applying them, their reports, and the plugin state.

The plugin's world and every world of a batch use this text, for sheets and for solids; `facets`
knows which of the two an organ is.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from ..config import Config
from ..geometry import fill
from ..geometry import mesh as topology
from ..geometry.mesh import Mesh
from . import facets, stamps
from .cut import Cut, Motion, Springs
from .facets import Path, World
from .path import check_points

BLOCKS = ("corner", "place", "weight", "source", "stamp")  # of the plugin state
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


class Topology:
  """What may become of an organ's mesh by cuts.

  Args:
    name: the organ's
    whole: its mesh before the first cut
    mass: of the vertices then [kg]                 (nvert,)
    pinned: vertices that do not move               (nvert,) bool
    frame: rotation from its axes to the world, and the position of its frame [m]
    room: triangles that there may be

  Attributes:
    whole: its mesh before the first cut
    facets: what comes apart of it
    first: a world that was not cut
  """

  def __init__(
    self, name: str, whole: Mesh, mass: np.ndarray, pinned: np.ndarray,
    frame: tuple[np.ndarray, np.ndarray], room: int,
  ):  # fmt: skip
    self._name, self.whole, self._mass, self._pinned, self._frame = name, whole, mass, pinned, frame
    self.facets = facets.of(whole, room)
    self.first = World(whole, mass.copy(), np.arange(whole.nvert), np.zeros(0, np.int64))
    self._ranked: np.ndarray | None = None  # see `_of_skin`
    self._median = 0.0

  def path(self, points: npt.ArrayLike, given=0.0, depth=None, direction=None) -> Path:
    """Returns a path of points in the world, (n, 3) [m], see `Path`; `direction` is there too.

    Raises:
      ValueError: these are no points, or that is no direction.
    """
    frame, origin = self._frame
    if direction is not None:
      if np.shape(direction) != (3,):
        raise ValueError(
          f"organ {self._name!r}: direction is {direction}, expected three numbers, not all 0"
        )
      direction = np.asarray(direction, float) @ frame
    local = (check_points(self._name, points) - origin) @ frame
    return Path(local, given, depth=depth, direction=direction)

  def find(
    self, had: World, disp: np.ndarray, vel: np.ndarray, path: Path, config: Config, springs: list
  ) -> Cut:
    """Returns what a path makes of a world.

    Args:
      had: the world
      disp: displacements of its vertices [m]  (nvert, 3)
      vel: their velocities [m/s]              (nvert, 3)
      path: the path
      config: configuration in force
      springs: what holds vertices, see `together`
    """
    motion, held = Motion(had.mass, disp, vel), together(springs, self.whole.nvert)
    return self.facets.cut(self._name, had, motion, path, self._pinned, config, held)

  def taken(self, had: World, found: Cut) -> World:
    """Returns what a world becomes by a cut that was found."""
    source = had.source.copy()
    source[found.member] = source[found.group]
    return World(found.mesh, found.motion.mass.copy(), source, self.facets.seats(had, found))

  def report(self, had: World, found: Cut, thickness: float) -> Report:
    """Returns what a cut that was found does to a world."""
    frame, origin = self._frame
    path = [origin + line @ frame.T for line in found.path]
    nodes = found.mesh.nouter - had.mesh.nouter
    area = found.length * thickness if found.area is None else found.area
    return Report(found.length, area, path, found.deviation, nodes, found.stopped, found.depth)

  def share(self, world: World, values: np.ndarray, vert: Any = slice(None)) -> np.ndarray:
    """Returns what has become of values by mass of the whole's vertices, at some or all, (n,).

    What comes from the inside of a solid has them as the skin.
    """
    source, was = world.source[vert], self._mass
    out = values[source] * world.mass[vert] / np.where(was[source] > 0, was[source], 1.0)
    if not len(self.whole.tet):
      return out
    out = np.where(source >= self.whole.nskin, world.mass[vert] * self._of_skin(values), out)
    return np.where(world.mass[vert] > 0, out, values[vert])

  def _of_skin(self, values: np.ndarray) -> float:
    """Returns the median of what vertices of the skin have for a mass."""
    if values is not self._ranked:
      n = self.whole.nouter
      ratio = np.sort(values[:n] / np.maximum(self._mass[:n], 1e-300))
      self._ranked, self._median = values, float(ratio[n // 2])
    return self._median

  # The plugin state: `own` has its blocks.

  def read(self, own: Mapping[str, np.ndarray], like: Mesh) -> tuple[World, np.ndarray]:
    """Returns the world that a state has, and what of its mesh differs from `like`.

    Raises:
      ValueError: the state is of another organ.
    """
    if not own["stamp"][0]:
      mesh, changed = self.facets.healed(like)
      return dataclasses.replace(self.first, mesh=mesh), changed
    rest, mass = own["place"].reshape(-1, 3).copy(), own["weight"].copy()
    try:
      if stamps.stamp(own["corner"], rest, mass) != own["stamp"][0]:
        raise ValueError
      mesh, changed, source, seat = self.facets.restored(own, like, rest)
    except ValueError:
      raise ValueError(FOREIGN) from None
    return World(mesh, mass, source, seat), changed

  def write(self, own: Mapping[str, np.ndarray], world: World):
    """Writes a world that was cut to a state."""
    own["corner"][:], own["weight"][:] = self.facets.corner(world), world.mass
    own["place"][:] = world.mesh.rest.ravel()
    own["source"][:] = self.facets.origin(world)
    own["stamp"][0] = stamps.stamp(self.facets.every_word(world))


def together(springs: list[tuple], nvert: int) -> Springs | None:
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
  return Springs(energy, force, hard)


def count(mesh: Mesh) -> int:
  """Returns how many parts of a mesh hang together."""
  return int(topology.pieces(mesh).max()) + 1


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
