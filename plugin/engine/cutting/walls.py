"""What cuts have opened, drawn in a colour of its own: a flex that nothing touches.

Along the opened edges it has lips, bands around the edge from the outer side to the inner one. Of a
solid it also has the opened faces. They are written when MuJoCo draws; between pictures the flex is
hidden, so that a step spends nothing on it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from palpate.tissue.geometry import mesh as topology

from .. import layout
from ..model import flexes, mjstruct

if TYPE_CHECKING:
  from ..model.declare import Declaration

LIP = 8e-4  # width of a lip [m]
# Of the outer half of a lip's profile: places from the edge inward, and heights over the organ's
# drawn surface [m]. The first one is below it, so that the surface ends the lip neatly.
PROFILE = np.array([(LIP, -1e-4), (0.6 * LIP, 1.5e-4), (-0.15 * LIP, 1e-4)])
_COUNTS = ("flex_vertnum", "flex_elemnum", "flex_shellnum", "flex_bvhnum", "flex_bvhadr")


class Walls:
  """What draws the walls or the lips of cuts; false where nothing does.

  Args:
    organ: which may be cut
    model: address of the mjModel

  Raises:
    ValueError: the configuration names no flex, or one without room.
  """

  def __init__(self, organ: Declaration, model: int):
    name, mesh = organ.config.walls, organ.mesh
    self._nvert = room(mesh.nskin, mesh.spare, len(mesh.tet) > 0)[0]
    self._flex, self._shown = -1, True
    if not name:
      return
    m = mjstruct.model(model)
    names = flexes.names(m)
    found = flexes.resolve(name, organ.name, names)
    if found is None:
      raise ValueError(f"organ {organ.name!r}: walls is {name!r}, the model has {names}")
    flex = names.index(found)
    have = flexes.vertices(m, flex)
    if have != self._nvert:
      raise ValueError(
        f"organ {organ.name!r}: walls {name!r} has {have} vertices, expected {self._nvert}"
      )
    self._flex = flex

  def __bool__(self) -> bool:
    return self._flex >= 0

  def hide(self, model: int):
    """Hides the flex until the next picture."""
    if self and self._shown:
      self._show(mjstruct.model(model), False)

  def _show(self, m, shown: bool):
    room = len(flexes.element_data(m, self._flex))
    counts = (self._nvert, room, 0) if shown else (0, 0, room)
    for name, count in zip(_COUNTS, (*counts, 0, -1), strict=True):
      getattr(m, name)[self._flex] = count
    self._shown = shown

  def draw(self, organ: Declaration, disp: np.ndarray, model: int, data: int):
    """Writes the walls, of vertices displaced by `disp` [m], where renderers read them."""
    m, d = mjstruct.both(model, data)
    elem, mesh = flexes.element_data(m, self._flex), organ.mesh
    skin = mesh.nskin if len(mesh.tet) else 0
    radius = float(m.flex_radius[organ.flex])
    x, lips = _lips(mesh, mesh.rest + disp, radius)
    x = np.concatenate([(mesh.rest + disp)[:skin], x])[: self._nvert]
    wall = np.concatenate([mesh.elem[mesh.whole.nelem :], skin + lips])
    wall = wall[(wall < len(x)).all(axis=1)][: len(elem)]
    elem[: len(wall)], elem[len(wall) :] = wall, 0  # without area, which nobody sees
    self._show(m, True)
    start = int(m.flex_vertadr[self._flex])
    out = d.flexvert_xpos[start : start + len(x)]
    out[:] = organ.origin + x @ organ.frame.T


def room(nskin: int, spare: int, solid: bool) -> tuple[int, int]:
  """Returns how many vertices and triangles the flex has that draws an organ's walls."""
  profile = 2 * len(PROFILE)
  edges = spare * (1 if solid else layout.LIPS)
  walls = (nskin, layout.WALLS * spare) if solid else (0, 0)
  return walls[0] + profile * edges, walls[1] + 2 * (profile - 1) * edges


def _lips(mesh: topology.Mesh, x: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
  """Returns vertices [m] and triangles of the lips along edges that cuts have opened.

  Args:
    mesh: of the organ
    x: its vertices [m]  (nvert, 3)
    radius: how far its surface is drawn outside and inside [m]
  """
  half, elem = topology.opened(mesh), mesh.elem[: mesh.whole.nelem]
  vert, ends = np.unique([topology.corners(mesh, half, k) for k in (0, 1)], return_inverse=True)
  ends = ends.reshape(2, -1)
  out = np.zeros_like(x)  # as MuJoCo draws a flex
  np.add.at(out, elem, _unit(topology.area_vectors(x, elem))[:, None])
  out = _unit(out[vert])
  along = _unit(np.diff(x[vert[ends]], axis=0)[0])
  into, ahead = np.zeros((2, len(vert), 3))
  for at, sign in zip(ends, (-1, 1), strict=True):
    np.add.at(into, at, np.cross(out[at], along))
    np.add.at(ahead, at, sign * along)
  tip = np.linalg.norm(into, axis=1) < 0.7  # both lips begin there: the cut points ahead
  into = _unit(np.where(tip[:, None], ahead, into))
  outer = PROFILE + np.array([0, radius])
  across, up = np.concatenate([outer, outer[::-1] * (1, -1)]).T
  places = x[vert][:, None] + across[:, None] * into[:, None] + up[:, None] * out[:, None]
  n = len(across)
  first = n * ends.T[:, None] + np.arange(n - 1)[:, None]
  quads = np.concatenate([first, first + 1], axis=2).reshape(-1, 4)
  return places.reshape(-1, 3), quads[:, [[0, 1, 3], [0, 3, 2]]].reshape(-1, 3)


def _unit(vector: np.ndarray) -> np.ndarray:
  """Returns vectors of length 1, (n, 3)."""
  return vector / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-300)
