"""Edges of threads that an organ's slots follow, as its last tools."""

import warp as wp
from palpate.engine.layout import GEOM
from palpate.tissue.types import doubles, struct

from ..organ.patch import Patch

_POS, _AXIS = wp.constant(GEOM.pos), wp.constant(GEOM.axis)


@struct
class Line:
  """A thread that an organ's slots follow."""

  first: int  # number of its first edge among those of all
  now: doubles("nworld", "nnode", 3)  # places of nodes in its frame [m]
  frame: doubles(3, 3)  # rotation from that to the world
  origin: doubles(3)  # of that [m]


@wp.kernel(enable_backward=False)
def lay(p: Patch, f: Line):
  """Writes where a thread's edges are."""
  world, e = wp.tid()
  a, b = wp.vec3d(), wp.vec3d()
  for k in range(3):
    for c in range(3):
      a[k] += f.frame[k, c] * f.now[world, e, c]
      b[k] += f.frame[k, c] * f.now[world, e + 1, c]
  axis = wp.normalize(b - a)
  side = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
  if wp.abs(axis[1]) >= wp.float64(0.5):
    side = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
  x = wp.normalize(wp.cross(side, axis))
  y = wp.cross(axis, x)
  middle = wp.vec3d(f.origin[0], f.origin[1], f.origin[2]) + wp.float64(0.5) * (a + b)
  line = f.first + e
  p.line_xpos[world, line] = wp.vec3(middle)
  p.line_xmat[world, line] = wp.mat33(wp.matrix_from_cols(x, y, axis))
  tool = p.ntool - p.nline + line
  for k in range(3):
    for c in range(3):
      turn = p.frame[c, k]
      if c == 0:
        p.tool[world, tool, _POS + k] = wp.float64(0.0)
        for r in range(3):
          p.tool[world, tool, _AXIS + 3 * r + k] = wp.float64(0.0)
      p.tool[world, tool, _POS + k] = p.tool[world, tool, _POS + k] + turn * (
        middle[c] - p.origin[c]
      )
      p.tool[world, tool, _AXIS + k] = p.tool[world, tool, _AXIS + k] + turn * x[c]
      p.tool[world, tool, _AXIS + 3 + k] = p.tool[world, tool, _AXIS + 3 + k] + turn * y[c]
      p.tool[world, tool, _AXIS + 6 + k] = p.tool[world, tool, _AXIS + 6 + k] + turn * axis[c]


@wp.kernel(enable_backward=False)
def lead(p: Patch, accelerated: wp.array2d[float]):
  """Gives slots the last acceleration of their nodes."""
  world, k = wp.tid()
  i = p.slot_node[world, k]
  dof = p.dofadr + 3 * k
  for r in range(3):
    total = float(0.0)
    if i >= 0:
      for c in range(3):
        total += float(p.frame[r, c] / p.h) * p.last[world, i // 8, c, i % 8]
    accelerated[world, dof + r] = total
