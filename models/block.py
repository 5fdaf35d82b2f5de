"""A block of tissue: the specimen of an indentation test."""

import numpy as np

from .meshing.refine import refine

_COARSE = 6  # edges along the shortest side, away from the tool


def box(size, spacing: float) -> tuple[np.ndarray, np.ndarray]:
  """Returns a closed box about the origin, of even right triangles: points, triangles.

  Args:
    size: along x, y and z [m]  (3,)
    spacing: of the nodes, as near as the size allows [m]
  """
  count = [max(1, round(s / spacing)) for s in size]
  lines = [np.linspace(-s / 2, s / 2, n + 1) for s, n in zip(size, count, strict=True)]
  index: dict[tuple, int] = {}
  elem = []
  for axis in range(3):
    u, v = (axis + 1) % 3, (axis + 2) % 3
    for side in (0, count[axis]):
      for i, j in np.ndindex(count[u], count[v]):
        at = []
        for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)):
          key = [0, 0, 0]
          key[axis], key[u], key[v] = side, i + di, j + dj
          at.append(index.setdefault(tuple(key), len(index)))
        a, b, c, d = at if side else at[::-1]
        elem += [(a, b, c), (a, c, d)] if (i + j) % 2 else [(a, b, d), (b, c, d)]
  points = np.array([[line[k] for line, k in zip(lines, key, strict=True)] for key in index])
  return points, np.array(elem)


def specimen(
  size, radius: float, edge: float, spacing: float | None = None, both: bool = False
) -> tuple[np.ndarray, np.ndarray]:
  """Returns a box with finer triangles around the middle of its top, or of top and bottom.

  Args:
    size: along x, y and z [m]  (3,)
    radius: of the finer region [m]
    edge: longest edge there [m]
    spacing: of the nodes elsewhere [m]; None for a sixth of the shortest side
    both: whether the bottom has such a place too
  """
  points, elem = box(size, spacing or min(size) / _COARSE)
  places = [(0.0, 0.0, sign * size[2] / 2) for sign in (1, -1)[: 1 + both]]
  return refine(points, elem, places, radius, edge)
