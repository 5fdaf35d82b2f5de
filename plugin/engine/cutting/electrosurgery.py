"""Geoms that cut by their current, such as a hook: what is near them comes apart, or comes free.

An actuator's control is the power, in watts: above 0 it cuts the wall and frees bonds, below 0 it
coagulates, which frees bonds alone. What it touches takes `energy` an area: a path in the wall
grows by power / (energy * thickness) a second, and bonds near it lose their hold by power /
(energy * area).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from palpate.tissue.cutting import path as paths
from palpate.tissue.cutting.surface import WorkingCopy
from palpate.tissue.geometry.mesh import Mesh

from ..layout import BLADE
from ..model import mjstruct

if TYPE_CHECKING:
  from ..workspace import Workspace

_SPARK = 0.001  # how far from its surface, in air and tissue, a current acts [m]


class Current:
  """A geom of a workspace's organ that has a current.

  Args:
    w: the workspace
    geom: the geom
    actuator: whose control is its power [W]
    energy: that an area takes [J/m^2]
    shape: axis along which it is long, half that length and its width [m]
  """

  def __init__(
    self, w: Workspace, geom: int, actuator: int, energy: float, shape: tuple[int, float, float]
  ):
    self._w, self.geom, self.actuator = w, geom, actuator
    self._finder = w.cuts.finder if w.cuts else paths.Finder(WorkingCopy(w.organ.mesh))
    self._energy, (self._axis, self._half, width) = energy, shape
    self._reach = 0.5 * width + _SPARK

  def act(self, row: np.ndarray) -> bool:
    """Does what a step's current does; returns whether the path has ended.

    Args:
      row: of the blades' state
    """
    w = self._w
    m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
    power = float(mjstruct.view(d.ctrl, m.nu)[self.actuator])
    given = abs(power) * float(m.opt.timestep)  # [J]
    if given:
      w.bonds.burn(self.burning)
    if power > 0 and w.cuts:
      x = w.organ.mesh.rest + w.motion()[0]
      if self.burn(row, w.organ.mesh, x, self._finder, *self._line(d, m), given):
        return False
    return ends(row)

  @property
  def burning(self) -> dict[str, Any]:
    """What `cohesive_bonds.Burning` has of it."""
    return dict(
      geom=self.geom, axis=self._axis, actuator=self.actuator, half=self._half, reach=self._reach,
      energy=self._energy,
    )  # fmt: skip

  def _line(self, d, m) -> tuple[np.ndarray, np.ndarray]:
    middle = mjstruct.view(d.geom_xpos, (m.ngeom, 3))[self.geom]
    return self.line(middle, mjstruct.view(d.geom_xmat, (m.ngeom, 3, 3))[self.geom])

  def line(self, middle: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the ends of its axis in the world [m], of where the geom is."""
    axis = axes[:, self._axis]
    return middle - self._half * axis, middle + self._half * axis

  def burn(
    self, row: np.ndarray, mesh: Mesh, x: np.ndarray, finder: paths.Finder,
    low: np.ndarray, high: np.ndarray, given: float,
  ) -> bool:  # fmt: skip
    """Lets the path follow the geom; returns whether it touches the wall.

    Args:
      row: of the blades' state
      mesh: the organ's
      x: where its vertices are, in its frame [m]  (nvert, 3)
      finder: of its surfaces
      low: an end of the geom's axis in the world [m]
      high: the other
      given: energy that the current has brought [J]
    """
    w, organ = self._w, self._w.organ
    local = (np.linspace(low, high, 5) - organ.origin) @ organ.frame
    elem, weight, far = finder.nearest(mesh, x, local)
    k = int(np.argmin(far))
    if far[k] > self._reach and not len(mesh.tet):
      return False
    deep = w.config.thickness
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
    goes = min(size, given / (self._energy * deep))
    if goes > 0:
      at += goes / size * way
      row[BLADE.work] += goes * self._energy * deep
      row[BLADE.opened] += goes
      row[BLADE.elem] = elem[k]
    return True

  def _depth(self, corner: np.ndarray, local: np.ndarray, far: np.ndarray) -> float:
    """Returns how deep in a solid it acts, 0 where it is beside it; `local`: points of its axis."""
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inside = ((local - corner[:, 0]) * normal).sum(axis=1) < 0
    return float(max(np.where(inside, far, -far).max() + self._reach, 0.0))


def ends(row: np.ndarray) -> bool:
  """Ends a path, of a row of the blades' state; returns whether there was one."""
  row[BLADE.stage] = 0
  return bool(row[BLADE.count])
