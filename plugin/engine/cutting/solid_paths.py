"""Paths of what cuts a solid: the mesh comes apart along them, as deep as a blade was there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from palpate.tissue.geometry.mesh import cross, lengths

from ..layout import BLADE, TRAIL

if TYPE_CHECKING:
  from ..model.declare import Declaration

PIERCED = 0.001  # how deep a blade is in a solid before it cuts along it [m]
# Edges of a path that are cut again with what follows, since the end of a cut is not even, and that
# stay whole behind the blade; and after which what could not come apart is tried again.
_AGAIN, _BEHIND, _MORE = 1.0, 0.5, 0.5
_SHUT = 1e-3  # angle of scissors under which they have no way to close [rad]
_FLAT = 0.3  # cosine of a blade to the normal under which the cut goes along that


def open_path(row: np.ndarray, edge: float, ended: bool, finder, cut):
  """Opens the path of a blade, as far as the mesh is to come apart along it.

  Args:
    row: of the blades' state
    edge: of the organ's mesh [m]
    ended: whether all of it comes apart
    finder: of its surfaces
    cut: cuts along a path at rest, (n, 3) [m], so deep, (n,) [m]; returns what it did, and the mesh

  Returns:
    what was cut, None for nothing, and why it could not be
  """
  count, at = int(row[BLADE.count]), row[BLADE.at : BLADE.at + 3].copy()
  trail = row[BLADE.trail : BLADE.trail + 3 * count].reshape(-1, 3)
  path = np.vstack([trail, at])
  deep = np.append(row[BLADE.below : BLADE.below + count], row[BLADE.depth])
  left = np.append(np.cumsum(lengths(path[:-1] - path[1:])[::-1])[::-1], 0.0)
  goes = path, np.maximum(deep, PIERCED)
  if not ended:
    goes = _until(*goes, left - _BEHIND * edge)
  report, mesh, why = None, None, ""
  try:
    if len(goes[0]) > 1:
      report, mesh = cut(*goes)
  except ValueError as error:
    why = str(error)
  if ended:
    row[BLADE.count] = 0
  elif report is None or mesh is None:
    row[BLADE.wait] = np.linalg.norm(at - trail[0]) + _MORE * edge
    if "pinned" in why or count == TRAIL:
      row[BLADE.count], row[BLADE.wait] = 1, 0.0
      row[BLADE.trail : BLADE.trail + 3], row[BLADE.below] = at, deep[-1]
  else:
    first = min(int((left[:-1] > (_BEHIND + _AGAIN) * edge).sum()), count - 1)
    kept, below = trail[first:].copy(), deep[first:count].copy()
    row[BLADE.count] = len(kept)
    row[BLADE.wait] = np.linalg.norm(at - kept[0]) + edge
    row[BLADE.elem] = finder.nearest(mesh, mesh.rest, at[None])[0][0]
    row[BLADE.trail : BLADE.trail + kept.size] = kept.ravel()
    row[BLADE.below : BLADE.below + len(below)] = below
  return report, why


def direction(
  organ: Declaration, disp: np.ndarray, along: np.ndarray | None, elem: np.ndarray
) -> np.ndarray:
  """Returns the unit vector along which a blade cuts into the tissue, in the world.

  Args:
    organ: its declaration
    disp: displacements of its vertices [m]  (nvert, 3)
    along: the blade's way, of either sign; None for what cuts along the normal
    elem: triangles that its path is on  (n,)
  """
  vert = organ.mesh.elem[elem]
  a, b, c = np.moveaxis(organ.mesh.rest[vert] + disp[vert], 1, 0)
  normals = cross(b - a, c - a)
  normal = organ.frame @ (normals / lengths(normals)[:, None]).sum(axis=0)
  normal /= np.linalg.norm(normal)
  size = 0.0 if along is None else np.linalg.norm(along)
  if along is None or size < _SHUT:
    return -normal
  along = along / size
  level = along @ normal
  return -normal if abs(level) < _FLAT else -np.sign(level) * along


def _until(path: np.ndarray, depth: np.ndarray, left: np.ndarray):
  """Returns a path and its depths up to where nothing is left, (n, 3) and (n,)."""
  k = int((left > 0).sum())
  if not 0 < k < len(path):
    return path[:k], depth[:k]
  share = left[k - 1] / (left[k - 1] - left[k])
  ends = [x[k - 1] + share * (x[k] - x[k - 1]) for x in (path, depth)]
  return np.vstack([path[:k], ends[0]]), np.append(depth[:k], ends[1])
