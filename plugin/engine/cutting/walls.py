"""What cuts have opened, drawn in a colour of its own: a flex that nothing touches.

Of a solid its vertices are those of the organ's skin, and its triangles the opened faces. Of a
sheet it is ribbons along the opened edges, the lips of the cut. They are written when MuJoCo draws;
between pictures the flex is hidden, so that a step spends nothing on it.
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
    self._nvert = mesh.nskin if len(mesh.tet) else 4 * layout.LIPS * mesh.spare
    self._flex, self._shown = -1, True
    if not name:
      return
    m = mjstruct.Model.from_address(model)
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
      self._show(mjstruct.Model.from_address(model), False)

  def _show(self, m, shown: bool):
    room = len(flexes.element_data(m, self._flex))
    counts = (self._nvert, room, 0) if shown else (0, 0, room)
    for name, count in zip(_COUNTS, (*counts, 0, -1), strict=True):
      mjstruct.view(getattr(m, name), m.nflex, np.int32)[self._flex] = count
    self._shown = shown

  def draw(self, organ: Declaration, disp: np.ndarray, model: int, data: int):
    """Writes the walls, of vertices displaced by `disp` [m], where renderers read them."""
    m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(data)
    elem = flexes.element_data(m, self._flex)
    x, wall = self._walls(organ, disp, m) if len(organ.mesh.tet) else _lips(organ.mesh, disp)
    x, wall = x[: self._nvert], wall[: len(elem)]
    elem[: len(wall)], elem[len(wall) :] = wall, 0  # without area, which nobody sees
    self._show(m, True)
    start = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[self._flex])
    out = mjstruct.view(d.flexvert_xpos, (m.nflexvert, 3))[start : start + len(x)]
    out[:] = organ.origin + x @ organ.frame.T

  def _walls(self, organ: Declaration, disp: np.ndarray, m) -> tuple[np.ndarray, np.ndarray]:
    """Returns the skin's vertices [m] and the faces that are open."""
    mesh = organ.mesh
    x, whole = (mesh.rest + disp)[: self._nvert], mesh.whole.nelem
    # The skin is drawn its flex's radius outside: so is the mouth of a cut.
    radius = mjstruct.view(m.flex_radius, m.nflex)[organ.flex]
    return x + radius * topology.vertex_normals(x, mesh.elem[:whole]), mesh.elem[whole:]


def _lips(mesh: topology.Mesh, disp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns ribbons along edges that cuts have opened: four vertices [m] and two triangles each."""
  half = np.setdiff1d(np.flatnonzero(mesh.twin < 0), np.flatnonzero(mesh.whole.twin < 0))
  x = mesh.rest + disp
  start, end, other = (x[topology.corners(mesh, half, k)] for k in range(3))
  along, inward = end - start, other - start
  inward -= ((inward * along).sum(1) / (along * along).sum(1))[:, None] * along
  inward *= LIP / np.linalg.norm(inward, axis=1, keepdims=True)
  places = np.stack([start, end, end + inward, start + inward], axis=1).reshape(-1, 3)
  quads = 4 * np.arange(len(half))[:, None]
  return places, (quads + np.array([0, 1, 2, 0, 2, 3])).reshape(-1, 3)
