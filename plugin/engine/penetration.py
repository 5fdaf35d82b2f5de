"""Tools that are through an organ's surface, where MuJoCo's contacts no longer hold them back.

MuJoCo looks for contacts once a step, on a surface without thickness: what passes more than its own
radius in a step, or is pressed through, comes out inside.
"""

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.kernels import kernel
from palpate.tissue.types import doubles, ints

from . import coupling
from .layout import FLAG
from .model import flexes, mjstruct

if TYPE_CHECKING:
  from .model.declare import Declaration
  from .workspace import Workspace

_EVERY = 503  # steps between looks at what is inside; prime: not always where others do more too
_OFTEN = 5  # steps between looks along the way of a fast tool
_FAST = 1.0  # speed above which a tool may be through and out again between looks [m/s]
_PATH = 16  # points of that way
_LONG = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)
_MOST, _ACROSS = 33, 9  # points along a geom's longest axis, and along another


def inside(point: np.ndarray, pos: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns which points are inside of a closed surface, (npoint,) bool.

  A ray along z leaves the surface once more often than it comes in. Exact where the ray meets an
  edge or a vertex: of the triangles around it, it goes through one.

  Args:
    point: [m], (npoint, 3)
    pos: vertices [m], (nvert, 3)
    elem: triangles, counter-clockwise from outside, (nelem, 3)
  """
  found = ((point > pos.min(axis=0)) & (point < pos.max(axis=0))).all(axis=1)
  if found.any():
    found[found] = _crossings(point[found], pos, elem) > 0.5
  return found


def _crossings(point: np.ndarray, pos: np.ndarray, elem: np.ndarray) -> np.ndarray:
  """Returns how often a ray from each point leaves a surface, less how often it comes in."""
  # In the time of a step: of all triangles only what a ray may meet is looked at closely.
  low, high = point.min(axis=0), point.max(axis=0)
  for axis in range(2):
    least, most = _span(pos[:, axis], elem)
    elem = elem[(least <= high[axis]) & (most >= low[axis])]
  (x0, x1), (y0, y1) = (_span(pos[:, axis], elem) for axis in range(2))
  x, y = point[:, :1], point[:, 1:2]
  k, t = np.nonzero((x0 <= x) & (x1 >= x) & (y0 <= y) & (y1 >= y))
  at, corner = point[k], pos[elem[t]]
  through = np.zeros(len(k), bool)
  for i in range(3):
    through ^= _right_of(at, corner[:, i - 1], corner[:, i])
  (ux, uy, uz), (vx, vy, vz) = (corner[:, 1] - corner[:, 0]).T, (corner[:, 2] - corner[:, 0]).T
  normal = np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=1)
  out = np.sign(normal[:, 2])
  above = ((corner[:, 0] - at) * normal).sum(axis=1) * out > 0
  return np.bincount(k, out * (through & above), len(point))


def _span(x: np.ndarray, elem: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the least and the largest of a coordinate in each triangle, (nelem,)."""
  a, b, c = x.take(elem.T)
  return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _right_of(point: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
  """Returns whether edges, seen along z, are met on the way from points along x, (n,) bool.

  To the bit the same from a to b as from b to a.
  """
  up = (a[:, 1] <= b[:, 1])[:, None]
  (x0, y0, _), (x1, y1, _) = np.where(up, a, b).T, np.where(up, b, a).T
  x, y, _ = point.T
  meets = (y0 <= y) & (y < y1)
  return meets & (x < x0 + (y - y0) * (x1 - x0) / np.where(meets, y1 - y0, 1.0))


def tools(m: mjstruct.Struct, organ: "Declaration") -> np.ndarray:
  """Returns the geoms that move and meet an organ; none where it is open and has no inside."""
  if not organ.mesh.closed:
    return np.zeros(0, int)
  body = m.geom_bodyid
  meets = np.unique(np.concatenate([flexes.meeting_geoms(m, flex) for flex in organ.flexes]))
  needles = [flexes.find(m, "body", row.name, organ.name) for row in organ.config.needles]
  # Needles go through it by right.
  return meets[(m.body_weldid[body[meets]] != 0) & ~np.isin(body[meets], needles)]


@coupling.memory("geom_bodyid", "body_rootid", "geom_xpos", "cvel", "subtree_com")
class Speeds:
  """The tools of an organ, and what MuJoCo knows of their speed, under its own names."""

  ntool: int
  tool: ints("ntool")  # their geoms
  reach: doubles("ntool")  # of their points from their centres [m]
  flags: ints(len(FLAG))  # see FLAG


find_fast = kernel("find_fast", "coupling/tools.h", Speeds, coupling.CONSTANTS | {"FAST": _FAST})


class Tools:
  """Where some geoms are: see `points`.

  Attributes:
    geoms: their numbers
    organ: in whose frame they are
    reach: of their points from their centres [m]
  """

  def __init__(self, m: mjstruct.Struct, organ: "Declaration", geoms: np.ndarray):
    """Takes the geoms of an mjModel."""
    self.geoms, self.organ = geoms, organ
    found = points(m, geoms)
    self.reach = _reach(found)
    # Of each point: the tool, and where it is in its frame [m].
    self._tool = np.repeat(np.arange(len(geoms)), [len(each) for each in found])
    self._local = np.concatenate([np.zeros((0, 3)), *found])

  def inside(self, d: mjstruct.Struct, disp: np.ndarray) -> list[int]:
    """Returns which of the geoms are inside of the organ.

    Args:
      d: the mjData
      disp: displacement of the vertices from rest, in the organ's frame [m], (nvert, 3)
    """
    return self.geoms[self._inside(*self._poses(d), disp)].tolist()

  def passed(
    self, m: mjstruct.Struct, d: mjstruct.Struct, disp: np.ndarray, time: float
  ) -> list[int]:
    """Returns which of the fast ones were inside of it on their way within the last seconds."""
    pos, turn = self._poses(d)
    spin, vel = self._motion(m, d, pos)
    speed = np.linalg.norm(vel, axis=1) + np.linalg.norm(spin, axis=1) * self.reach
    turning, found = np.cross(spin[:, :, None], turn, axis=1), np.zeros(len(self.geoms), bool)
    for t in np.linspace(0, time, _PATH):
      found |= self._inside(pos - t * vel, turn - t * turning, disp)
    return self.geoms[found & (speed > _FAST)].tolist()

  def _inside(self, pos: np.ndarray, turn: np.ndarray, disp: np.ndarray) -> np.ndarray:
    """Returns whether any point of each tool is inside, (ntool,) bool."""
    organ, tool = self.organ, self._tool
    point = pos[tool] + (turn[tool] @ self._local[:, :, None])[:, :, 0]
    point = (point - organ.origin) @ organ.frame
    found = np.zeros(len(self.geoms), bool)
    found[tool[inside(point, organ.mesh.rest + disp, organ.mesh.elem)]] = True
    return found

  def _poses(self, d: mjstruct.Struct) -> tuple[np.ndarray, np.ndarray]:
    """Returns the tools' places [m], (ntool, 3), and rotations, (ntool, 3, 3)."""
    return d.geom_xpos[self.geoms], d.geom_xmat.reshape(-1, 3, 3)[self.geoms]

  def _motion(
    self, m: mjstruct.Struct, d: mjstruct.Struct, pos: np.ndarray
  ) -> tuple[np.ndarray, np.ndarray]:
    """Returns angular velocity [rad/s] and velocity [m/s], (ntool, 3) both."""
    body = m.geom_bodyid[self.geoms]
    spin, vel = np.moveaxis(d.cvel.reshape(-1, 2, 3)[body], 1, 0)
    com = d.subtree_com[m.body_rootid[body]]
    return spin, vel + np.cross(spin, pos - com)


def points(m: mjstruct.Struct, geoms: np.ndarray) -> list[np.ndarray]:
  """Returns what stands for each geom, in its frame [m], (n, 3) each.

  Points along the axis of a capsule or cylinder, over the middle of a box, the centre of another:
  MuJoCo feels capsules and boxes at their ends and at the vertices that they meet, so that edges
  pass between.
  """
  kind = m.geom_type[geoms]
  out = []
  for k, size in zip(kind, m.geom_size[geoms], strict=True):
    thick, half = 1.0, np.zeros(3)
    if k in _LONG:
      thick, half[2] = size[0], size[1]
    elif k == _BOX:
      thick = size.min()
      half = size - thick
    most = np.where(np.arange(3) == half.argmax(), _MOST, _ACROSS)
    count = np.minimum(2 * np.ceil(half / thick) + 1, most).astype(int)
    along = [np.linspace(-h, h, n) if n > 1 else [0.0] for h, n in zip(half, count, strict=True)]
    out.append(np.stack(np.meshgrid(*along), axis=-1).reshape(-1, 3))
  return out


def _reach(found: list[np.ndarray]) -> np.ndarray:
  return np.array([np.linalg.norm(each, axis=1).max() for each in found])


def speeds(m: mjstruct.Struct, data: int, organ: "Declaration", flags: np.ndarray) -> Speeds:
  """Returns `Speeds` of the tools of an organ."""
  geoms = tools(m, organ)
  out = coupling.mujoco_arrays(m.address, data, Speeds)
  out.ntool = len(geoms)
  out.tool = wp.array(geoms, dtype=int, device="cpu")
  out.reach = wp.array(_reach(points(m, geoms)), dtype=wp.float64, device="cpu")
  out.flags = wp.array(flags, dtype=int, device="cpu", copy=False)
  return out


class Watch:
  """Looks now and then whether a tool has come through, and all along the way of a fast one.

  And whether tetrahedra stay inside out.

  Attributes:
    crossed: geoms that went in and out again between two looks
  """

  def __init__(self):
    self.crossed: set[int] = set()
    self._tools: Tools | None = None
    self._inside: set[int] | None = None
    self._said: set[int] = set()
    self._steps = 0
    self._inverted: np.ndarray | None = None

  def due(self, fast: int) -> bool:
    """Counts a step; returns whether it is time to look."""
    self._steps += 1
    return self._steps % (_OFTEN if fast else _EVERY) == 1

  def look(self, w: "Workspace") -> list[int]:
    """Returns the geoms that have come through a workspace's organ since the last look.

    Each once; not those that were inside when this began to look.
    """
    m, d = mjstruct.both(w.model, w.data)
    if self._tools is None or self._tools.organ is not w.organ:
      self._tools = Tools(m, w.organ, tools(m, w.organ))
    seen = self._tools
    if not len(seen.geoms) or not w.organ.mesh.closed:  # a cut opens it
      return []
    disp = w.motion()[0]
    found = set(seen.inside(d, disp))
    before, self._inside = found if self._inside is None else self._inside, found
    if w.report.flags[FLAG.fast]:
      passed = set(seen.passed(m, d, disp, w.seen.model_step[0] * _OFTEN)) - before
      self.crossed |= passed
      found = found | passed
    new = sorted(found - before - self._said)
    self._said.update(new)
    return new

  def stuck(self, w: "Workspace") -> int:
    """Returns how many tetrahedra are inside out as at the last look; 0 once that is said."""
    mesh, before = w.organ.mesh, self._inverted
    if not len(mesh.tet) or self._steps % _EVERY != 1 or (before is not None and not before.size):
      return 0
    found = _inside_out(mesh.rest + w.motion()[0], mesh.tet)
    stay = int((found & before).sum()) if before is not None and len(before) == len(found) else 0
    self._inverted = found[:0] if stay else found
    return stay


def _inside_out(x: np.ndarray, tet: np.ndarray) -> np.ndarray:
  """Returns which tetrahedra have no volume or a negative one, (ntet,) bool."""
  corner = x.T[:, tet.T]
  (ax, bx, cx), (ay, by, cy), (az, bz, cz) = corner[:, 1:] - corner[:, :1]
  return ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx) <= 0
