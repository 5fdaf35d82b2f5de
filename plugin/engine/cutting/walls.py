"""The walls of cuts in a solid, drawn in a colour of their own: a flex that nothing touches.

Its vertices are those of the organ's skin, its triangles the faces that cuts have opened; they are
written when MuJoCo draws. Between pictures it is hidden, so that a step spends nothing on it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from palpate.tissue.geometry import mesh as topology

from ..model import flexes, mjstruct

if TYPE_CHECKING:
  from ..model.declare import Declaration

_COUNTS = ("flex_vertnum", "flex_elemnum", "flex_shellnum", "flex_bvhnum", "flex_bvhadr")


class Walls:
  """What draws the walls of a solid; false where nothing does.

  Args:
    organ: the solid
    model: address of the mjModel

  Raises:
    ValueError: the configuration names no flex, or one without room.
  """

  def __init__(self, organ: Declaration, model: int):
    name, self._nskin = organ.config.walls, organ.mesh.nskin
    self._flex, self._shown = -1, True
    if not name:
      return
    m = mjstruct.Model.from_address(model)
    names = [flexes.name(m, f) for f in range(m.nflex)]
    found = flexes.resolve(name, organ.name, names)
    if found is None:
      raise ValueError(f"organ {organ.name!r}: walls is {name!r}, the model has {names}")
    flex = names.index(found)
    have = flexes.vertices(m, flex)
    if have != organ.mesh.nskin:
      raise ValueError(
        f"organ {organ.name!r}: walls {name!r} has {have} vertices, expected {organ.mesh.nskin}, "
        "as its own flex"
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
    counts = (self._nskin, room, 0) if shown else (0, 0, room)
    for name, count in zip(_COUNTS, (*counts, 0, -1), strict=True):
      mjstruct.view(getattr(m, name), m.nflex, np.int32)[self._flex] = count
    self._shown = shown

  def draw(self, organ: Declaration, disp: np.ndarray, model: int, data: int):
    """Writes the walls, of vertices displaced by `disp` [m], where renderers read them."""
    m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(data)
    mesh, n = organ.mesh, organ.mesh.nskin
    elem = flexes.element_data(m, self._flex)
    wall = mesh.elem[mesh.whole.nelem :][: len(elem)]
    elem[: len(wall)], elem[len(wall) :] = wall, 0  # without area, which nobody sees
    self._show(m, True)
    start = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[self._flex])
    out = mjstruct.view(d.flexvert_xpos, (m.nflexvert, 3))[start : start + n]
    x = (mesh.rest + disp)[:n]
    # The skin is drawn its flex's radius outside: so is the mouth of a cut.
    radius = mjstruct.view(m.flex_radius, m.nflex)[organ.flex]
    x += radius * topology.vertex_normals(x, mesh.elem[: mesh.whole.nelem])
    out[:] = organ.origin + x @ organ.frame.T
