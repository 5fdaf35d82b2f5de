"""Tissue that tears where it is stretched too far, across the stretch; see `Organ.cut`."""

from __future__ import annotations

import numpy as np
from palpate.tissue import path as paths

_WAY = 1.2  # edges by which a tear goes on, to each side where it begins
_NEAR = 1.5  # edges from the end of a cut from which it goes on


class Tear:
  """Looks after each step whether a workspace's organ tears; false where it cannot.

  Args:
    w: the workspace
  """

  def __init__(self, w):
    self._w = w

  def __bool__(self) -> bool:
    return self._w.config.tear > 0

  def act(self) -> bool:
    """Tears the organ at its most stretched triangle, if that is too far; returns whether."""
    w, mesh = self._w, self._w.organ.mesh
    x = mesh.rest + w.phases.motion()[0]
    stretch = _squares(mesh.rest[mesh.elem], x[mesh.elem])
    stretch[~w.organ.free[mesh.elem].all(axis=1)] = 0.0
    worst = int(np.argmax(stretch))
    if not stretch[worst] > (1 + w.config.tear) ** 2 or self._w.cuts.full:
      return False
    corner = x[mesh.elem[worst]]
    line = self._line(mesh, x, corner.mean(axis=0), _across(mesh.rest[mesh.elem[worst]], corner))
    organ = w.organ
    try:
      return w.cuts.cut(organ.origin + line @ organ.frame.T).nodes > 0
    except ValueError:  # pinned tissue around it
      return False

  def _line(self, mesh, x: np.ndarray, at: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Returns the path that tears: on from the end of a cut beside it, or to both sides."""
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
    elem, weight, _ = paths.nearest(mesh, x, points)
    return np.einsum("nk,nkj->nj", weight, x[mesh.elem[elem]])


def _squares(rest: np.ndarray, now: np.ndarray) -> np.ndarray:
  """Returns the square of the greatest principal stretch of triangles (n, 3, 3), (n,)."""
  metric, turned = _metrics(rest), _metrics(now)
  product = np.linalg.solve(metric, turned)
  half = 0.5 * (product[:, 0, 0] + product[:, 1, 1])
  det = product[:, 0, 0] * product[:, 1, 1] - product[:, 0, 1] * product[:, 1, 0]
  return half + np.sqrt(np.maximum(half * half - det, 0.0))


def _metrics(corner: np.ndarray) -> np.ndarray:
  arm = corner[:, 1:] - corner[:, :1]
  return arm @ arm.transpose(0, 2, 1)


def _across(rest: np.ndarray, now: np.ndarray) -> np.ndarray:
  """Returns the unit vector in a triangle, as it is now, across its greatest stretch."""
  arm, before = now[1:] - now[0], rest[1:] - rest[0]
  value, vector = np.linalg.eig(np.linalg.solve(before @ before.T, arm @ arm.T))
  along = vector[:, int(np.argmax(value))].real @ arm
  across = np.cross(np.cross(arm[0], arm[1]), along)
  return across / np.linalg.norm(across)
