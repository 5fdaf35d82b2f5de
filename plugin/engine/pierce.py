"""Tools that are through an organ's surface, where MuJoCo's contacts no longer hold them back.

MuJoCo looks for contacts once a step, on a surface without thickness: what passes more than its own
radius in a step, or is pressed through, comes out inside.
"""

from __future__ import annotations

import mujoco
import numpy as np

from . import flexes, mjstruct

_EVERY = 500  # steps between looks
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


def inside(m, d, organ, geoms: np.ndarray, disp: np.ndarray) -> list[int]:
  """Returns which of the geoms have their middle inside of an organ.

  Args:
    m: the mjModel
    d: the mjData
    organ: the organ
    geoms: some geoms
    disp: displacement of the vertices from rest, in the organ's frame [m], (nvert, 3)
  """
  pos = organ.mesh.rest + disp
  low, high = pos.min(axis=0), pos.max(axis=0)
  found = []
  for g in map(int, geoms):
    point = (_middle(m, d, g) - organ.origin) @ organ.frame
    point = point[((point > low) & (point < high)).all(axis=1)]
    if len(point) and (winding(point, pos, organ.mesh.elem) > 0.5).any():
      found.append(g)
  return found


def _middle(m, d, geom: int) -> np.ndarray:
  """Returns points along the axis of a long geom, or the centre of another [m], (npoint, 3)."""
  centre = mjstruct.view(d.geom_xpos, (m.ngeom, 3))[geom]
  if mjstruct.view(m.geom_type, m.ngeom, np.int32)[geom] not in _LONG:
    return centre[None].copy()
  axis = mjstruct.view(d.geom_xmat, (m.ngeom, 3, 3))[geom, :, 2]
  radius, half, _ = mjstruct.view(m.geom_size, (m.ngeom, 3))[geom]
  count = int(min(_MOST, 2 * np.ceil(half / radius) + 1))
  return centre + np.linspace(-half, half, count)[:, None] * axis


class Watch:
  """Looks now and then whether a tool has come through."""

  def __init__(self):
    self._tools: np.ndarray | None = None
    self._inside: set[int] | None = None
    self._said: set[int] = set()
    self._steps = 0

  def due(self) -> bool:
    """Counts a step; returns whether it is time to look."""
    self._steps += 1
    return self._steps % _EVERY == 1

  def look(self, w) -> list[int]:
    """Returns the geoms that are inside of a workspace's organ and were not at the last look.

    Each once; not those that were inside when this began to look.
    """
    m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
    if self._tools is None:
      self._tools = tools(m, w.organ)
    found = inside(m, d, w.organ, self._tools, _displacement(m, d, w)) if len(self._tools) else []
    before = set(found) if self._inside is None else self._inside
    new = [g for g in found if g not in before and g not in self._said]
    self._inside = set(found)
    self._said.update(new)
    return new


def _displacement(m, d, w) -> np.ndarray:
  """Returns the displacement of the vertices from rest, in the organ's frame [m], (nvert, 3)."""
  if w.organ.windows:
    return w.boxes["own"].motion.disp.numpy()
  out = np.zeros((w.organ.mesh.nvert, 3))
  moved = mjstruct.view(d.qpos, m.nq) - mjstruct.view(m.qpos0, m.nq)
  out[w.organ.free] = moved[w.organ.qposs].reshape(-1, 3)
  return out
