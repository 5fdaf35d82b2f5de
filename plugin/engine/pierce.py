"""Tools that are through an organ's surface, where MuJoCo's contacts no longer hold them back.

MuJoCo looks for contacts once a step, on a surface without thickness: what passes more than its own
radius in a step, or is pressed through, comes out inside.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.kernels import kernel
from palpate.tissue.types import doubles, ints, struct

from . import coupling, flexes, mjstruct
from .layout import FLAG

_EVERY = 500  # steps between looks at what is inside
_OFTEN = 5  # steps between looks along the way of a fast tool
_FAST = 1.0  # speed above which a tool may be through and out again between looks [m/s]
_PATH = 16  # points of that way
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


@struct
class Speeds:
  """The tools of an organ, and what MuJoCo knows of their speed, under its own names."""

  ntool: int
  tool: ints("ntool")  # their geoms
  half: doubles("ntool")  # half the length of a long one's axis [m]
  flags: ints(len(FLAG))  # see FLAG
  # mjModel:
  geom_bodyid: ints("ngeom")
  body_rootid: ints("nbody")
  # mjData:
  geom_xpos: doubles("ngeom", 3)
  cvel: doubles("nbody", 6)
  subtree_com: doubles("nbody", 3)


find_fast = kernel("find_fast", "tools.h", Speeds, coupling.CONSTANTS | {"FAST": _FAST})


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
    self._pos = mjstruct.view(d.geom_xpos, (m.ngeom, 3))[geoms]
    self._axis = mjstruct.view(d.geom_xmat, (m.ngeom, 3, 3))[geoms, :, 2]
    self.half = half_lengths(m, geoms)
    wide = 2 * np.ceil(self.half / mjstruct.view(m.geom_size, (m.ngeom, 3))[geoms, 0]) + 1
    self._count = np.minimum(wide, _MOST).astype(int)
    body = mjstruct.view(m.geom_bodyid, m.ngeom, np.int32)[geoms]
    root = mjstruct.view(m.body_rootid, m.nbody, np.int32)[body]
    self._spin, vel = np.moveaxis(mjstruct.view(d.cvel, (m.nbody, 2, 3))[body], 1, 0)
    com = mjstruct.view(d.subtree_com, (m.nbody, 3))[root]
    self._vel = vel + np.cross(self._spin, self._pos - com)

  def points(self, k: int, before: float = 0.0) -> np.ndarray:
    """Returns the points of tool k, now or so long before, in the organ's frame [m], (., 3)."""
    along = np.linspace(-self.half[k], self.half[k], self._count[k])[:, None]
    axis = self._axis[k] - before * np.cross(self._spin[k], self._axis[k])
    return (self._pos[k] - before * self._vel[k] + along * axis - self._organ.origin) @ (
      self._organ.frame
    )

  def inside(self, disp: np.ndarray) -> list[int]:
    """Returns which of the geoms are inside of the organ.

    Args:
      disp: displacement of the vertices from rest, in the organ's frame [m], (nvert, 3)
    """
    pos, elem = self._organ.mesh.rest + disp, self._organ.mesh.elem
    return [int(g) for k, g in enumerate(self.geoms) if any_inside(self.points(k), pos, elem)]

  def passed(self, disp: np.ndarray, time: float) -> list[int]:
    """Returns which of the fast ones were inside of it on their way within the last seconds."""
    pos, elem = self._organ.mesh.rest + disp, self._organ.mesh.elem
    speed = np.linalg.norm(self._vel, axis=1) + np.linalg.norm(self._spin, axis=1) * self.half
    return [
      int(self.geoms[k])
      for k in map(int, np.flatnonzero(speed > _FAST))
      if any(any_inside(self.points(k, t), pos, elem) for t in np.linspace(0, time, _PATH))
    ]


def half_lengths(m, geoms: np.ndarray) -> np.ndarray:
  """Returns half the length of the axis of long geoms, 0 of others [m]."""
  is_long = np.isin(mjstruct.view(m.geom_type, m.ngeom, np.int32)[geoms], _LONG)
  return np.where(is_long, mjstruct.view(m.geom_size, (m.ngeom, 3))[geoms, 1], 0.0)


def speeds(m, model: int, data: int, organ, flags: np.ndarray) -> Speeds:
  """Returns `Speeds` of the tools of an organ."""
  geoms = tools(m, organ)
  out = coupling.mujoco_arrays(model, data, Speeds)
  out.ntool = len(geoms)
  out.tool = wp.array(geoms, dtype=int, device="cpu")
  out.half = wp.array(half_lengths(m, geoms), dtype=wp.float64, device="cpu")
  out.flags = wp.array(flags, dtype=int, device="cpu", copy=False)
  return out


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
    self._tools: np.ndarray | None = None
    self._inside: set[int] | None = None
    self._said: set[int] = set()
    self._steps = 0

  def due(self, fast: int) -> bool:
    """Counts a step; returns whether it is time to look."""
    self._steps += 1
    return self._steps % (_OFTEN if fast else _EVERY) == 1

  def look(self, w) -> list[int]:
    """Returns the geoms that have come through a workspace's organ since the last look.

    Each once; not those that were inside when this began to look.
    """
    m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
    if self._tools is None:
      self._tools = tools(m, w.organ)
    if not len(self._tools) or not w.organ.mesh.closed:  # a cut opens it
      return []
    seen, disp = Tools(m, d, w.organ, self._tools), _displacement(m, d, w)
    found = set(seen.inside(disp))
    before, self._inside = found if self._inside is None else self._inside, found
    if w.flags[FLAG.fast]:
      passed = set(seen.passed(disp, w.model_step[0] * _OFTEN)) - before
      self.crossed |= passed
      found = found | passed
    new = sorted(found - before - self._said)
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
