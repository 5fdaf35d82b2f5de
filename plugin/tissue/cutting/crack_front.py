"""Where on a path behind a blade a sheet comes apart next."""

import math

import numpy as np

from ..geometry.mesh import Mesh, lengths
from .path import Finder

# In edges: which come apart at once at least, and do not yet behind the blade; between places that
# are looked at; what a vertex may be farther from the path for an edge that is opened more.
_FIRST, _LAST, _STEP, _FARTHER = 0.9, 0.3, 0.1, 0.15


def part(finder: Finder, mesh: Mesh, path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the part of a path that comes apart now, and the rest; nothing where there is none.

  It ends where a vertex is near, so that the mesh need not be bent to where the blade is just now.

  Args:
    finder: of its surfaces
    mesh: the sheet
    path: on it at rest [m]  (n, 3)
  """
  edge = mesh.whole.edge_length
  arc = np.append(0.0, np.cumsum(lengths(path[1:] - path[:-1])))
  first, last, step = _FIRST * edge, _LAST * edge, _STEP * edge
  count = math.ceil((arc[-1] - last - first) / step)
  if count <= 0:
    return path[:0], path
  way = first + np.arange(count) * step
  at = np.clip(np.searchsorted(arc, way, side="left") - 1, 0, len(path) - 2)  # the point before
  gap = arc[at + 1] - arc[at]
  share = np.where(gap > 0, (way - arc[at]) / np.where(gap > 0, gap, 1.0), 0.0)
  place = path[at] + share[:, None] * (path[at + 1] - path[at])
  vert = mesh.elem[finder.nearest(mesh, mesh.rest, place)[0]].ravel()
  far = lengths(place[:, None] - mesh.rest[vert]).min(axis=1) - _FARTHER * way
  k = int(np.argmin(far))
  return np.concatenate([path[: at[k] + 1], place[k : k + 1]]), path[at[k] + 1 :]
