"""Paths of cutters, in any world: they grow behind a blade or a current, and the mesh opens there.

A tool that cuts by a current, such as a hook, has an actuator whose control is its power, in watts.
Above 0 it cuts the wall and frees bonds; below 0 it coagulates, which frees bonds alone. The tissue
takes `energy` an area: a path in the wall grows by power / (energy * thickness) a second, and bonds
whose strands it touches lose their hold by power / (energy * area).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from palpate.tissue.cutting import crack_front
from palpate.tissue.cutting.facets import Path
from palpate.tissue.cutting.path import Finder
from palpate.tissue.cutting.topology import Report
from palpate.tissue.geometry.mesh import Mesh, cross, lengths

from ..layout import BLADE, TRAIL

if TYPE_CHECKING:
  from ..model.declare import Declaration

# Share of the work on an edge that moving a vertex may turn into strain: without it none could move
# on to the blade's path, where tissue is stretched.
GIVEN = 0.1
PIERCED = 0.001  # how deep a blade is in a solid before it cuts along it [m]
# As in the header: the blade is out of the tissue; edges between points of a path, and that come
# apart at once.
ENDED, _SPACING, _BATCH = 2, 0.4, 1.8
_MORE = 0.5  # edges after which what could not come apart is tried again
# Edges of a path in a solid that are cut again with what follows, since the end of a cut is not
# even, and that stay whole behind the blade.
_AGAIN, _BEHIND = 1.0, 0.5
_SHUT = 1e-3  # angle of scissors under which they have no way to close [rad]
_FLAT = 0.3  # cosine of a blade to the normal under which the cut goes along that
# How far a current leaps from the wire to tissue [m]. Sparks cut from 200 V on (Koninckx et al.
# 2024, 10.52054/FVVO.16.3.026); a generator's cut reaches 2.5 kV at the peak (Eggleston and von
# Maltzahn 2000, Biomedical Engineering Handbook, chapter 81). Through so much air 1.9 kV break:
# Paschen's law with A = 15 and B = 365 V for each cm Torr (Raizer 1991, Gas Discharge Physics),
# 760 Torr and 0.01 electrons an ion.
SPARK = 0.0003


@dataclasses.dataclass(frozen=True)
class Current:
  """A geom that has a current.

  Attributes:
    geom: the geom
    actuator: whose control is its power [W]
    energy: that an area takes [J/m^2]
    axis: along which it is long
    half: half that length [m]
    reach: how far from its axis tissue may be that it acts on [m]
  """

  geom: int
  actuator: int
  energy: float
  axis: int
  half: float
  reach: float

  @property
  def burning(self) -> dict[str, Any]:
    """What `cohesive_bonds.Burning` has of it."""
    return dict(vars(self))

  def line(self, middle: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of its axis in the world [m], of where the geom is."""
    axis = axes[:, self.axis]
    return middle - self.half * axis, middle + self.half * axis

  def burn(
    self, row: np.ndarray, organ: Declaration, mesh: Mesh, x: np.ndarray, finder: Finder,
    line: tuple[np.ndarray, np.ndarray], given: float, thickness: float,
  ) -> bool:  # fmt: skip
    """Lets the path follow the geom; returns whether it touches the wall.

    Args:
      row: of the blades' state
      organ: the organ before the first cut
      mesh: its mesh now
      x: where its vertices are, in its frame [m]  (nvert, 3)
      finder: of its surfaces
      line: ends of the geom's axis in the world [m]
      given: energy that the current has brought [J]
      thickness: of the wall [m]
    """
    local = (np.linspace(*line, 5) - organ.origin) @ organ.frame
    elem, weight, far = finder.nearest(mesh, x, local)
    k = int(np.argmin(far))
    if far[k] > self.reach and not len(mesh.tet):
      return False
    deep = thickness
    if len(mesh.tet):
      deep = self._depth(x[mesh.elem[elem]], local, far)
      if deep <= 0:
        return False
      row[BLADE.depth] = deep
    goal = weight[k] @ mesh.rest[mesh.elem[elem[k]]]
    at = row[BLADE.at : BLADE.at + 3]
    if not row[BLADE.stage]:
      row[BLADE.stage], row[BLADE.elem], row[BLADE.count] = 2, elem[k], 1
      at[:] = goal
      row[BLADE.trail : BLADE.trail + 3] = goal
      row[BLADE.below] = deep
    way = goal - at
    size = float(np.linalg.norm(way))
    goes = min(size, given / (self.energy * deep))
    if goes > 0:
      at += goes / size * way
      row[BLADE.work] += goes * self.energy * deep
      row[BLADE.opened] += goes
      row[BLADE.elem] = elem[k]
    return True

  def _depth(self, corner: np.ndarray, local: np.ndarray, far: np.ndarray) -> float:
    """Returns how deep in a solid it acts, 0 where it is beside it; `local`: points of its axis."""
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inside = ((local - corner[:, 0]) * normal).sum(axis=1) < 0
    return float(max(np.where(inside, far, -far).max() + self.reach, 0.0))


def current(
  geom: int, actuator: int, energy: float, shape: tuple[int, float, float], skin: float
) -> Current:
  """Returns a current.

  Args:
    geom: the geom
    actuator: whose control is its power [W]
    energy: that an area takes [J/m^2]
    shape: axis of the geom, half its length and its width [m]
    skin: from the organ's vertices to its surface [m]
  """
  axis, half, width = shape
  return Current(geom, actuator, energy, axis, half, 0.5 * width + skin + SPARK)


def end(row: np.ndarray) -> int:
  """Ends a path, of a row of the blades' state; returns what is due, as the header says."""
  row[BLADE.stage] = 0
  return ENDED * bool(row[BLADE.count])


def lay(row: np.ndarray, edge: float) -> int:
  """Lets a path follow what cuts by a current; returns what is due.

  Args:
    row: of the blades' state
    edge: mean length of the mesh's edges [m]
  """
  count, at = int(row[BLADE.count]), row[BLADE.at : BLADE.at + 3]
  if not row[BLADE.stage]:
    return 0
  start, last = (row[k : k + 3] for k in (BLADE.trail, BLADE.trail + 3 * (count - 1)))
  if count < TRAIL and np.linalg.norm(at - last) > _SPACING * edge:
    row[BLADE.trail + 3 * count : BLADE.trail + 3 * count + 3] = at
    row[BLADE.below + count] = row[BLADE.depth]
    row[BLADE.count] += 1
  wait = row[BLADE.wait] or _BATCH * edge
  return int(np.linalg.norm(at - start) > wait or row[BLADE.count] == TRAIL)


def open_path(
  row: np.ndarray,
  organ: Declaration,
  mesh: Mesh,
  ended: bool,
  finder: Finder,
  cut: Callable[[np.ndarray, np.ndarray | None], tuple[Report, Mesh]],
) -> tuple[Report | None, str]:
  """Opens the path of a blade, as far as the mesh is to come apart along it.

  Args:
    row: of the blades' state
    organ: the organ before the first cut
    mesh: its mesh now
    ended: whether all of it comes apart
    finder: of its surfaces
    cut: cuts along a path at rest, (n, 3) [m], so deep in a solid, (n,) [m] or None; returns what
      it did, and the mesh then

  Returns:
    what was cut, None for nothing, and why it could not be
  """
  count, at = int(row[BLADE.count]), row[BLADE.at : BLADE.at + 3].copy()
  edge, solid = mesh.whole.edge_length, len(mesh.tet) > 0
  trail = row[BLADE.trail : BLADE.trail + 3 * count].reshape(-1, 3).copy()
  below = row[BLADE.below : BLADE.below + count].copy()
  path, rest, deep, left = np.vstack([trail, at]), at[None], None, np.zeros(0)
  if solid:
    left = np.append(np.cumsum(lengths(path[:-1] - path[1:])[::-1])[::-1], 0.0)
    deep = np.maximum(np.append(below, row[BLADE.depth]), PIERCED)
  if not ended:
    if deep is None:
      path, rest = crack_front.part(finder, mesh, path)
    else:
      path, deep = _until(path, deep, left - _BEHIND * edge)
  report, why = None, ""
  try:
    if len(path) > 1:
      report, mesh = cut(path, deep)
  except ValueError as error:
    why = str(error)
  if ended:
    row[BLADE.count] = 0
    return report, why
  if report is None:
    start = row[BLADE.trail : BLADE.trail + 3]
    row[BLADE.wait] = np.linalg.norm(at - start) + _MORE * edge
    if "pinned" not in why and count < TRAIL:
      return report, why
    kept, below, wait = at[None], np.full(int(solid), row[BLADE.depth]), 0.0  # there is no room
  elif solid:
    first = min(int((left[:-1] > (_BEHIND + _AGAIN) * edge).sum()), count - 1)
    kept, below = trail[first:], below[first:]
    wait = np.linalg.norm(at - kept[0]) + edge
  else:
    tip = (report.path[-1][-1] - organ.origin) @ organ.frame if report.path else path[-1]
    kept, below, wait = np.concatenate([tip[None], rest[:-1]])[:TRAIL], below[:0], 0.0
  if report is not None:
    row[BLADE.elem] = finder.nearest(mesh, mesh.rest, at[None])[0][0]
  row[BLADE.count], row[BLADE.wait] = len(kept), wait
  row[BLADE.trail : BLADE.trail + kept.size] = kept.ravel()
  row[BLADE.below : BLADE.below + len(below)] = below
  return report, why


def _until(path: np.ndarray, depth: np.ndarray, left: np.ndarray):
  """Returns a path and its depths up to where nothing is left, (n, 3) and (n,)."""
  k = int((left > 0).sum())
  if not 0 < k < len(path):
    return path[:k], depth[:k]
  share = left[k - 1] / (left[k - 1] - left[k])
  ends = [x[k - 1] + share * (x[k] - x[k - 1]) for x in (path, depth)]
  return np.vstack([path[:k], ends[0]]), np.append(depth[:k], ends[1])


def path_of(
  path: np.ndarray, depth: np.ndarray, given: float, organ: Declaration, mesh: Mesh,
  disp: np.ndarray, finder: Finder, way: np.ndarray | None,
) -> Path:  # fmt: skip
  """Returns the path that is cut in a solid behind a blade.

  Args:
    path: at rest [m]                                 (n, 3)
    depth: [m]                                        (n,)
    given: energy by depth that what cuts has brought [J/m]
    organ: the organ before the first cut
    mesh: its mesh now
    disp: displacements of its vertices [m]           (nvert, 3)
    finder: of its surfaces
    way: along a blade in the world, of either sign; None for what cuts along the normal
  """
  elem, weight, _ = finder.nearest(mesh, mesh.rest, path)
  corner = (mesh.rest + disp)[mesh.elem[elem]]
  now = np.einsum("nk,nkj->nj", weight, corner)
  direction = _direction(organ.frame, corner, way) @ organ.frame
  return Path(now, given * float(depth.mean()), depth=depth, direction=direction)


def along(turn: np.ndarray, geoms: np.ndarray, axes: np.ndarray) -> np.ndarray:
  """Returns the way along a blade, or along which scissors close, in the world, either sign.

  Args:
    turn: axes of all geoms in the world    (ngeom, 3, 3)
    geoms: its geoms, the second of scissors alone, else -1
    axes: axis of each along which its edge is
  """
  one, two = (turn[g][:, k] for g, k in zip(geoms, axes, strict=True))
  if geoms[1] < 0:
    return one
  return one - np.copysign(1.0, one @ two) * two  # blades are at less than 90 degrees


def _direction(frame: np.ndarray, corner: np.ndarray, way: np.ndarray | None) -> np.ndarray:
  """Returns the unit vector along which a blade cuts into the tissue, in the world.

  Args:
    frame: rotation from the organ's axes to the world
    corner: of the triangles that its path is on, where they are [m]  (n, 3, 3)
    way: the blade's, see `path_of`
  """
  a, b, c = np.moveaxis(corner, 1, 0)
  normals = cross(b - a, c - a)
  normal = frame @ (normals / lengths(normals)[:, None]).sum(axis=0)
  normal /= np.linalg.norm(normal)
  size = 0.0 if way is None else np.linalg.norm(way)
  if way is None or size < _SHUT:
    return -normal
  way = way / size
  level = way @ normal
  return -normal if abs(level) < _FLAT else -np.sign(level) * way
