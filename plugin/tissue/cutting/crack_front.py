"""Where on a path behind a blade the mesh comes apart next: `cutting/crack_front.h`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import numpy as np
import warp as wp

from ..geometry.mesh import Mesh
from ..kernels import kernel
from ..types import CONSTANTS, allocate, doubles, ints, longs, struct
from .surface import WorkingCopy, host_views

# In edges: which come apart at once at least, and do not yet behind the blade; between places that
# are looked at; what a vertex may be farther from the path for an edge that is opened more.
_FIRST, _LAST, _STEP, _FARTHER = 0.9, 0.3, 0.1, 0.15
_POINTS, _PLACES = 16, 64  # that there is room for at first


@struct
class Stop:
  """A surface, a path on it, and where that is to end."""

  nvert: int
  most: int  # neighbours that a vertex has room for
  nplace: int  # places that there is room for
  edge: wp.float64  # mean length of its edges [m]
  first: wp.float64  # see _FIRST, all in [m] but the last
  last: wp.float64
  step: wp.float64
  farther: wp.float64
  asked: ints(2)  # points of the path, vertices on the surface
  elem: longs("nelem", 3)
  spoke: longs("nvert", "most")  # `Mesh.ring_elem`
  degree: longs("nvert")
  rest: doubles("nvert", 3)
  point: doubles("npoint", 3)  # the path at rest [m]
  place: doubles("nplace", 3)  # what follows is scratch
  before: ints("nplace")
  vert: ints("3 nplace")
  box: ints("nvert")
  found: ints(2)  # points of the path before its end, -1 for no end; places that were looked at
  end: doubles(3)


_find = kernel("find_stop", "cutting/crack_front.h", Stop, CONSTANTS)


class Stops:
  """Finds where paths on surfaces of one whole end.

  Args:
    copy: where the surfaces are
  """

  def __init__(self, copy: WorkingCopy):
    self._copy = copy
    self._make_room(_POINTS, _PLACES)

  def _make_room(self, npoint: int, nplace: int):
    whole, there = self._copy.whole, self._copy.fields
    sizes = self._copy.sizes | {"npoint": npoint, "nplace": nplace}
    mine = "elem", "spoke", "degree", "rest"
    self._fields = fields = allocate(Stop, "cpu", sizes, mine)
    fields.nvert, fields.most, fields.nplace = whole.nvert, sizes["most"], nplace
    fields.edge = edge = whole.edge_length
    fields.first, fields.last, fields.step = _FIRST * edge, _LAST * edge, _STEP * edge
    fields.farther = _FARTHER
    for name in mine:
      setattr(fields, name, getattr(there, name)[0])
    self._host = host_views(fields, Stop)
    self._launch = _find.command(fields).launch

  def part(self, mesh: Mesh, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the part of a path that comes apart now, and the rest; nothing where there is none.

    It ends where a vertex is near, so that the mesh need not be bent to where the blade is just
    now.

    Args:
      mesh: the surface
      path: on it at rest [m]  (n, 3)
    """
    n, room = len(path), self._host["point"]
    if n > len(room):
      self._make_room(2 * n, self._fields.nplace)
    self._copy.put(mesh)
    host = self._host
    host["point"][:n], host["asked"][:] = path, (n, mesh.nouter)
    self._launch()
    count, places = host["found"].tolist()
    if places > self._fields.nplace:
      self._make_room(len(room), 2 * places)
      return self.part(mesh, path)
    if count < 0:
      return path[:0], path
    end = host["end"][None]
    return np.concatenate([path[:count], end]), path[count:]
