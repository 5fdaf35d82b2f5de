"""Tissue that tears where it is stretched too far, across the stretch; see `Organ.cut`."""

from __future__ import annotations

from typing import Any

import numpy as np
from palpate.tissue.cutting.path import Finder
from palpate.tissue.geometry.mesh import Mesh

_WAY = 1.2  # edges by which a tear goes on, to each side where it begins
_NEAR = 1.5  # edges from the end of a cut from which it goes on


class Tear:
  """Finds where a surface tears."""

  def __init__(self):
    self._mesh: Any = None
    self._rest: tuple = ()

  def line(self, mesh: Mesh, x: np.ndarray, most: float, finder: Finder) -> np.ndarray | None:
    """Returns the path on which the most stretched triangle tears, None where that holds.

    Args:
      mesh: the surface
      x: where its vertices are [m]  (nvert, 3)
      most: the strain that it bears
      finder: of its surfaces
    """
    if mesh is not self._mesh:
      self._mesh, self._rest = mesh, _metric(mesh.rest[mesh.elem])
    stretch = _squares(self._rest, _metric(x[mesh.elem]))
    worst = int(np.argmax(stretch))
    return line_of(mesh, x, worst, finder) if stretch[worst] > (1 + most) ** 2 else None


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


def _metric(corner: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns the squares of two edges of triangles and their product, (n,) each."""
  a, b = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
  return tuple(np.einsum("ij,ij->i", p, q) for p, q in ((a, a), (a, b), (b, b)))


def _squares(rest: tuple, now: tuple) -> np.ndarray:
  """Returns the squares of the greatest principal stretches of triangles from their metrics."""
  (r11, r12, r22), (n11, n12, n22) = rest, now
  det = r11 * r22 - r12 * r12
  half = 0.5 * (r22 * n11 - 2 * r12 * n12 + r11 * n22) / det
  return half + np.sqrt(np.maximum(half * half - (n11 * n22 - n12 * n12) / det, 0.0))


def _across(rest: np.ndarray, now: np.ndarray) -> np.ndarray:
  """Returns the unit vector in a triangle, as it is now, across its greatest stretch."""
  arm, before = now[1:] - now[0], rest[1:] - rest[0]
  value, vector = np.linalg.eig(np.linalg.solve(before @ before.T, arm @ arm.T))
  along = np.real(vector[:, int(np.argmax(value))]) @ arm
  across = np.cross(np.cross(arm[0], arm[1]), along)
  return across / np.linalg.norm(across)
