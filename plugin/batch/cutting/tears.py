"""Tissue of `Worlds` that tears where it is stretched too far; see `engine.cutting.tear`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
import contextlib
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from palpate.engine.cutting import tear
from palpate.tissue.cutting.facets import Path

from .. import host
from ..patch import Patch

if TYPE_CHECKING:
  from ..organs import Organ

# In what a triangle is beyond the limit: shares of it, and the most that are told apart.
_FINE, _MOST = wp.constant(wp.float64(2.0**26)), wp.constant(wp.float64(1e4))


@wp.func
def _rest(p: Patch, mesh: int, i: int):
  return wp.vec3d(p.rest[mesh, i, 0], p.rest[mesh, i, 1], p.rest[mesh, i, 2])


@wp.func
def _moved(p: Patch, world: int, i: int):
  s = i // 8
  lane = i % 8
  d = p.solve.disp
  return wp.vec3d(wp.vec3(d[world, s, 0, lane], d[world, s, 1, lane], d[world, s, 2, lane]))


@wp.kernel(enable_backward=False)
def _find(p: Patch, limit: wp.float64, out: wp.array[wp.int64]):
  """Finds the triangle of each world that is stretched most beyond a limit.

  Writes how far, in the upper digits, and how many triangles follow it; 0 where there is none.

  Args:
    p: the organ
    limit: square of the greatest stretch
    out: (nworld,)
  """
  w, e = wp.tid()
  m = p.mesh[w]
  i = p.elem[m, e, 0]
  a = _rest(p, m, p.elem[m, e, 1]) - _rest(p, m, i)
  b = _rest(p, m, p.elem[m, e, 2]) - _rest(p, m, i)
  c = a + _moved(p, w, p.elem[m, e, 1]) - _moved(p, w, i)
  d = b + _moved(p, w, p.elem[m, e, 2]) - _moved(p, w, i)
  det = wp.dot(a, a) * wp.dot(b, b) - wp.dot(a, b) * wp.dot(a, b)
  area2 = wp.dot(c, c) * wp.dot(d, d) - wp.dot(c, d) * wp.dot(c, d)
  mixed = wp.dot(b, b) * wp.dot(c, c) + wp.dot(a, a) * wp.dot(d, d)
  half = (wp.float64(0.5) * mixed - wp.dot(a, b) * wp.dot(c, d)) / det
  square = half + wp.sqrt(wp.max(half * half - area2 / det, wp.float64(0.0)))
  if square > limit:
    n = p.elem.shape[1]
    wp.atomic_max(out, w, wp.int64(wp.min(square / limit, _MOST) * _FINE) * wp.int64(n)
                  + wp.int64(n - 1 - e))  # fmt: skip


class Tears(host.Opens):
  """Where an organ tears in all worlds.

  Args:
    organ: the organ, which has room for cuts
  """

  def __init__(self, organ: "Organ"):
    super().__init__(organ)
    self._found = self._zeros(self._nworld, dtype=wp.int64)

  def open(self, steps: int):
    """Tears each world at its most stretched triangle, where that is too far."""
    organ, cuts, nelem = self._organ, self._organ.topology, len(self._organ.elem)
    assert cuts is not None
    limit = (1 + organ.config.tear) ** 2
    self._found.zero_()
    inputs = [organ.patch, limit, self._found]
    wp.launch(_find, dim=(self._nworld, nelem), inputs=inputs, device=self._device)
    found = self._found.numpy()
    cuts.follow()
    worlds = [w for w in np.flatnonzero(found).tolist() if not cuts.is_full(w)]
    if not worlds:
      return
    motion = cuts.motion(worlds)
    for k, world in enumerate(worlds):
      mesh, worst = cuts.mesh_of(world), nelem - 1 - int(found[world]) % nelem
      line = tear.line_of(mesh, mesh.rest + motion.disp[k], worst, cuts.finder)
      with contextlib.suppress(ValueError):  # pinned tissue around it
        cuts.apply(world, cuts.find(world, Path(line), motion, k), motion, k)
    cuts.finish(worlds, motion)


def make(organ: "Organ") -> tuple[Tears, ...]:
  """Returns what tears an organ of `Worlds`, if it can tear."""
  return (Tears(organ),) if organ.config.tear else ()
