"""Tools that are through an organ's surface, where MuJoCo's contacts no longer hold them back.

MuJoCo looks for contacts once a step, on a surface without thickness: what passes more than its own
radius in a step, or is pressed through, comes out inside.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from . import flexes, mjstruct

_EVERY = 500  # steps between looks at what is inside
_GLANCE = (20, 0.02)  # steps, and seconds, between glances at where the tools are, at most
_FAST = 1.0  # speed above which a tool may be through and out again between looks [m/s]
_LED = 4.0  # times the way that its speed now explains that a tool may have gone
_PATH = 32  # points of the way of a fast tool
_LONG = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_MOST = 33  # points that stand for a long geom


def winding(point: np.ndarray, pos: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns the winding number of a closed surface around points, (npoint,): 1 inside, 0 outside.

  The solid angles of its triangles, by tan(angle / 2) (Van Oosterom and Strackee 1983,
  doi:10.1109/TBME.1983.325207), over 4 pi.

  Args:
    point: [m], (npoint, 3)
    pos: vertices [m], (nvert, 3)
    elem: triangles, counter-clockwise from outside, (nelem, 3)
  """
  a, b, c = np.moveaxis(pos[elem][None] - point[:, None, None], 2, 0)
  la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
  volume = (a * np.cross(b, c)).sum(axis=-1)
  rest = la * lb * lc + (a * b).sum(axis=-1) * lc + (b * c).sum(axis=-1) * la
  return np.arctan2(volume, rest + (c * a).sum(axis=-1) * lb).sum(axis=1) / (2 * np.pi)


def tools(m, organ) -> np.ndarray:
  """Returns the geoms that move and meet an organ; none where it is open and has no inside."""
  if not organ.mesh.closed:
    return np.zeros(0, int)
  body = mjstruct.view(m.geom_bodyid, m.ngeom, np.int32)
  weld = mjstruct.view(m.body_weldid, m.nbody, np.int32)
  flex = organ.windows.flex if organ.windows else [organ.flex]
  meets = np.unique(np.concatenate([flexes.meeting_geoms(m, int(f)) for f in flex]))
  return meets[weld[body[meets]] != 0]


class Tools:
  """Where some geoms are: points along the axis of a long one, the centre of another.

  Args:
    m: the mjModel
    d: the mjData
    organ: the organ, in whose frame they are
    geoms: the geoms
  """

  def __init__(self, m, d, organ, geoms: np.ndarray):
    self.geoms, self._organ = geoms, organ
    self._pos = mjstruct.view(d.geom_xpos, (m.ngeom, 3))
    self._mat = mjstruct.view(d.geom_xmat, (m.ngeom, 3, 3))
    size = mjstruct.view(m.geom_size, (m.ngeom, 3))[geoms]
    is_long = np.isin(mjstruct.view(m.geom_type, m.ngeom, np.int32)[geoms], _LONG)
    self._half = np.where(is_long, size[:, 1], 0.0)
    self._count = np.ones(len(geoms), int)
    wide = 2 * np.ceil(self._half[is_long] / size[is_long, 0]) + 1
    self._count[is_long] = np.minimum(wide, _MOST)
    self._body = mjstruct.view(m.geom_bodyid, m.ngeom, np.int32)[geoms]
    self._root = mjstruct.view(m.body_rootid, m.nbody, np.int32)[self._body]
    self._vel = mjstruct.view(d.cvel, (m.nbody, 2, 3))
    self._com = mjstruct.view(d.subtree_com, (m.nbody, 3))
    arm = np.linalg.norm(self._pos[geoms] - self._com[self._root], axis=1) + self._half
    self._reach = np.stack([arm, np.ones(len(geoms))], axis=1)[:, :, None]

  def pose(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns centres [m] and axes of all, (ntool, 3) each, in the world."""
    return self._pos[self.geoms], self._mat[self.geoms, :, 2]

  def may_be_fast(self) -> bool:
    """Returns whether one may be faster than `_FAST`; cheap, and seldom wrong."""
    return bool(np.abs(self._vel[self._body] * self._reach).max() > _FAST / np.sqrt(6))

  def speed(self, k: int) -> float:
    """Returns how fast tool k moves, at an end of a long one at most [m/s]."""
    spin, vel = self._vel[self._body[k]]
    arm = self._pos[self.geoms[k]] - self._com[self._root[k]]
    return float(np.linalg.norm(vel + np.cross(spin, arm)) + np.linalg.norm(spin) * self._half[k])

  def points(self, pose: tuple[np.ndarray, np.ndarray], k: int) -> np.ndarray:
    """Returns the points of tool k in a pose, in the organ's frame [m], (npoint, 3)."""
    along = np.linspace(-self._half[k], self._half[k], self._count[k])
    return (pose[0][k] + along[:, None] * pose[1][k] - self._organ.origin) @ self._organ.frame

  def inside(self, disp: np.ndarray) -> list[int]:
    """Returns which of the geoms are inside of the organ.

    Args:
      disp: displacement of the vertices from rest, in the organ's frame [m], (nvert, 3)
    """
    pos, pose = self._organ.mesh.rest + disp, self.pose()
    return [
      int(g)
      for k, g in enumerate(self.geoms)
      if any_inside(self.points(pose, k), pos, self._organ.mesh.elem)
    ]

  def passed(self, before, k: int, time: float, disp: np.ndarray) -> bool:
    """Returns whether tool k was inside of the organ on the straight way from a pose before.

    Not where its speed does not lead from there: it was put where it is.

    Args:
      before: that pose
      k: the tool
      time: that has gone [s]
      disp: as for `inside`
    """
    start, end, speed = self.points(before, k), self.points(self.pose(), k), self.speed(k)
    far = np.linalg.norm(end - start, axis=1).max()
    if speed < _FAST or far > _LED * speed * time:
      return False
    pos = self._organ.mesh.rest + disp
    return any(
      any_inside(start + share * (end - start), pos, self._organ.mesh.elem)
      for share in np.linspace(0, 1, _PATH)
    )


def any_inside(point: np.ndarray, pos: np.ndarray, elem: np.ndarray) -> bool:
  """Returns whether one of some points is inside of a closed surface; arguments as `winding`'s."""
  point = point[((point > pos.min(axis=0)) & (point < pos.max(axis=0))).all(axis=1)]
  return bool(len(point)) and bool((winding(point, pos, elem) > 0.5).any())


class Watch:
  """Looks now and then whether a tool has come through, and all along the way of a fast one.

  Attributes:
    crossed: geoms that went in and out again between two looks
  """

  def __init__(self):
    self.crossed: set[int] = set()
    self._tools: Any = None  # `Tools`, from the first look on
    self._pose: Any = None
    self._inside: set[int] | None = None
    self._said: set[int] = set()
    self._until_glance, self._until_look = 1, 1

  def due(self) -> bool:
    """Counts a step; returns whether it is time for a glance."""
    self._until_glance -= 1
    return not self._until_glance

  def look(self, w) -> list[int]:
    """Returns the geoms that have come through a workspace's organ since the last glance.

    Each once; not those that were inside when this began to look.
    """
    if self._tools is None:
      m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
      self._tools = Tools(m, d, w.organ, tools(m, w.organ))
      self._pose = self._tools.pose()
    if not len(self._tools.geoms):
      return []
    before, self._pose = self._pose, self._tools.pose()
    found = self._look_along(w, before) if self._tools.may_be_fast() else set()
    self._until_glance = int(np.clip(_GLANCE[1] / w.model_step[0], 1, _GLANCE[0]))
    self._until_look -= self._until_glance
    if self._until_look <= 0 and not (w.asleep or w.resident):
      self._until_look = _EVERY
      found |= self._look_inside(w)
    if not found:
      return []
    new = sorted(found - self._said)
    self._said.update(new)
    return new

  def _look_inside(self, w) -> set[int]:
    """Returns the geoms that are inside and were not at the last look."""
    found = set(self._tools.inside(_displacement(w)))
    before, self._inside = found if self._inside is None else self._inside, found
    return found - before

  def _look_along(self, w, before) -> set[int]:
    """Returns the geoms that were inside on their way from the pose before, fast ones alone."""
    if w.resident:
      return set()
    time, disp = w.model_step[0] * _GLANCE[0], _displacement(w)
    passed = [self._tools.passed(before, k, time, disp) for k in range(len(self._tools.geoms))]
    found = set(map(int, self._tools.geoms[passed]))
    self.crossed |= found
    return found


def _displacement(w) -> np.ndarray:
  """Returns the displacement of the vertices from rest, in the organ's frame [m], (nvert, 3)."""
  if w.organ.windows:
    return w.boxes["own"].motion.disp.numpy()
  m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
  out = np.zeros((w.organ.mesh.nvert, 3))
  moved = mjstruct.view(d.qpos, m.nq) - mjstruct.view(m.qpos0, m.nq)
  out[w.organ.free] = moved[w.organ.qposs].reshape(-1, 3)
  return out
