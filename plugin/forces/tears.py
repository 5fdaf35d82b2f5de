"""Tissue that tears where it is stretched too far, across the stretch; see `Organ.cut`."""

import contextlib

import numpy as np
from palpate.tissue.cutting.facets import Path
from palpate.tissue.cutting.path import Finder
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import doubles, ints, struct

from .host import Bodies, Nodes, kernels
from .passive import Force, Opening

_WAY = 1.2  # edges by which a tear goes on, to each side where it begins
_NEAR = 1.5  # edges from the end of a cut from which it goes on


@struct
class Stretched:
  """The triangle of each world that is stretched most."""

  nelem: int  # triangles of the organ
  mesh: ints("nworld")  # which mesh a world has
  elem: ints("nmesh", "nelem", 3)  # triangles
  flat: doubles("nmesh", "nvert", 3)  # rest positions as the cuts have them [m]
  own: Nodes
  mj: Bodies
  worst: ints("nworld")  # that triangle
  square: doubles("nworld")  # square of its stretch


(_find,) = kernels("cutting/tears.h", Stretched, "find_stretched")


class Tears(Force):
  """Where an organ tears; false where it does not."""

  KEYS = ("tear",)

  def __bool__(self) -> bool:
    return self.host.config.tear > 0 and self.host.organ.mesh.spare > 0

  def bind(self):
    """See `Force`."""
    host = self.host
    if host.organ.mesh.spare:
      found = {"worst": host.zeros(dtype=int), "square": host.zeros()}
      self.fields = host.fill(Stretched, host.surface() | found, into=self.fields)

  def open(self, opening: Opening, steps: int = 1) -> bool:
    """See `Force`: each world at its most stretched triangle, where that is too far."""
    if not self:
      return False
    self.host.launch(_find, self.fields, 1)
    far = self.fields.square.numpy() > (1 + self.host.config.tear) ** 2
    # Where no spare vertex is left nothing opens.
    meshes = {w: opening.mesh(w) for w in np.flatnonzero(far).tolist()}
    worlds = [w for w, mesh in meshes.items() if mesh.nouter != mesh.nskin]
    if not worlds:
      return False
    opening.begin(worlds)
    worst, opened = self.fields.worst.numpy(), False
    for world in worlds:
      mesh = opening.mesh(world)
      x = mesh.rest + opening.disp(world)
      with contextlib.suppress(ValueError):  # pinned tissue around it
        report = opening.cut(world, Path(line_of(mesh, x, int(worst[world]), opening.finder)))
        opened = report.nodes > 0 or opened
    opening.finish()
    return opened


def line_of(mesh: Mesh, x: np.ndarray, worst: int, finder: Finder) -> np.ndarray:
  """Returns the path that tears: on from the end of a cut beside it, or to both sides.

  Args:
    mesh: the surface
    x: where its vertices are [m]  (nvert, 3)
    worst: the triangle that is stretched most
    finder: of its surfaces

  Returns:
    points on the surface [m], (n, 3)
  """
  corner = x[mesh.elem[worst]]
  at, across = corner.mean(axis=0), _across(mesh.rest[mesh.elem[worst]], corner)
  size = np.linalg.norm(np.diff(x[mesh.elem[:1]][0], axis=0), axis=1).mean()
  size = max(size, mesh.whole.edge_length)
  last = mesh.ring_elem[np.arange(mesh.nvert), np.maximum(mesh.degree - 1, 0)]
  rim = np.flatnonzero((last < 0) & (mesh.degree > 0))
  start = at - _WAY * size * across
  far = np.linalg.norm(x[rim] - at, axis=1)
  if rim.size and far.min() < _NEAR * size:
    start = x[rim[np.argmin(far)]]
    across = across if (at - start) @ across >= 0 else -across
  points = start + np.linspace(0, 2 * _WAY * size, 12)[:, None] * across
  elem, weight, _ = finder.nearest(mesh, x, points)
  return np.einsum("nk,nkj->nj", weight, x[mesh.elem[elem]])


def _across(rest: np.ndarray, now: np.ndarray) -> np.ndarray:
  """Returns the unit vector in a triangle, as it is now, across its greatest stretch."""
  arm, before = now[1:] - now[0], rest[1:] - rest[0]
  value, vector = np.linalg.eig(np.linalg.solve(before @ before.T, arm @ arm.T))
  along = np.real(vector[:, int(np.argmax(value))]) @ arm
  across = np.cross(np.cross(arm[0], arm[1]), along)
  return across / np.linalg.norm(across)
