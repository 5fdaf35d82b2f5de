"""Smooth surfaces through the vertices of coarse ones, linear in their positions.

The limit of Loop's subdivision (Loop 1987, "Smooth subdivision surfaces based on triangles"; masks
of boundary and limit after Hoppe et al. 1994, "Piecewise smooth surface reconstruction") of a
control mesh that is chosen so that the limit goes through the coarse vertices. All weights of a
fine vertex add up to 1: a linear map of the coarse vertices is the same map of the fine ones.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import SuperLU, splu

LEVELS = (1, 2, 3, 4)


@dataclasses.dataclass(frozen=True)
class Smooth:
  """A fine surface that follows a coarse one.

  Attributes:
    elem: its triangles; the first four, sixteen, ... lie on the first coarse one  (nfine_elem, 3)
    weight: of the control mesh's vertices in each fine vertex        (nfine, ncoarse)
    control: factors of the matrix that takes control vertices to coarse ones
  """

  elem: np.ndarray
  weight: csr_array
  control: SuperLU

  @property
  def count(self) -> int:
    """Number of its vertices."""
    return int(self.elem.max()) + 1

  def __call__(self, values: np.ndarray) -> np.ndarray:
    """Returns values at the fine vertices (nfine, k) of those at the coarse ones (ncoarse, k)."""
    return self.weight @ self.control.solve(np.ascontiguousarray(values, dtype=float))


def smooth(elem: np.ndarray, levels: int) -> Smooth:
  """Returns the fine surface whose triangles are the coarse ones divided in four `levels` times.

  Args:
    elem: triangles of a 2-manifold, which use the vertices 0 to n - 1  (nelem, 3)
    levels: one of LEVELS
  """
  elem = np.ascontiguousarray(elem, dtype=np.int32)
  return _smooth(elem.tobytes(), levels)


@functools.lru_cache(maxsize=32)
def _smooth(content: bytes, levels: int) -> Smooth:
  elem = np.frombuffer(content, np.int32).reshape(-1, 3)
  control = splu(_limit(elem).tocsc())
  weight = None
  for _ in range(levels):
    step, elem = _divide(elem)
    weight = step if weight is None else step @ weight
  weight = csr_array(_limit(elem) @ weight)
  weight.sort_indices()
  return Smooth(elem, weight, control)


def counts(elem: np.ndarray) -> list[int]:
  """Returns how many fine vertices there are at each of LEVELS."""
  nvert, nedge, nelem = int(elem.max()) + 1, len(_edges(elem)[0]), len(elem)
  found = []
  for _ in LEVELS:
    nvert, nedge, nelem = nvert + nedge, 2 * nedge + 3 * nelem, 4 * nelem
    found.append(nvert)
  return found


def _edges(elem: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns the edges (nedge, 2), the edge of each side (nelem, 3), and each edge's triangles."""
  sides = np.sort(elem[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
  edge, number = np.unique(sides, axis=0, return_inverse=True)
  number = number.reshape(-1, 3)
  return edge, number, np.bincount(number.ravel(), minlength=len(edge))


def _matrix(rows: list, columns: list, values: list, shape: tuple[int, int]) -> csr_array:
  parts = (np.concatenate([np.ravel(part) for part in each]) for each in (values, rows, columns))
  value, row, column = parts
  return csr_array((value, (row, column)), shape=shape)


def _divide(elem: np.ndarray) -> tuple[csr_array, np.ndarray]:
  """Returns a step of subdivision as a matrix, and the triangles after it."""
  n = int(elem.max()) + 1
  edge, side, count = _edges(elem)
  border = count < 2
  corner = elem[:, [2, 0, 1]]  # opposite to each side
  near = np.where(border, 0.5, 0.375)
  inner = ~border[side]
  rows = [n + np.arange(len(edge))] * 2 + [n + side[inner]]
  columns = [edge[:, 0], edge[:, 1], corner[inner]]
  values = [near, near, np.full(int(inner.sum()), 0.125)]
  around = _around(n, edge, border, beta=lambda k: _beta(k), border_share=0.125)
  for each, part in zip((rows, columns, values), around, strict=True):
    each.extend(part)
  a, b, c = elem.T
  ab, bc, ca = (n + side).T
  fine = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
  return _matrix(rows, columns, values, (n + len(edge), n)), fine.astype(np.int32)


def _beta(degree: np.ndarray) -> np.ndarray:
  """Returns the weight of each neighbour of an inner vertex (Loop 1987)."""
  return (0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / degree)) ** 2) / degree


def _limit(elem: np.ndarray) -> csr_array:
  """Returns where the vertices end after infinitely many steps, as a matrix."""
  n = int(elem.max()) + 1
  edge, _, count = _edges(elem)

  def beta(degree: np.ndarray) -> np.ndarray:
    return 1 / (3 / (8 * _beta(degree)) + degree)

  return _matrix(*_around(n, edge, count < 2, beta, border_share=1 / 6), (n, n))


def _around(n: int, edge: np.ndarray, border: np.ndarray, beta, border_share: float):
  """Returns rows, columns and values of vertices as means of themselves and their neighbours."""
  both = np.concatenate([edge, edge[:, ::-1]])
  on_border = np.zeros(n, bool)
  on_border[edge[border]] = True
  of_border = np.concatenate([border, border])
  kept = np.where(on_border[both[:, 0]], of_border, True)
  both = both[kept]
  degree = np.bincount(both[:, 0], minlength=n)
  share = np.where(on_border, border_share, beta(np.maximum(degree, 1)))
  own = 1 - share * degree
  return [both[:, 0], np.arange(n)], [both[:, 1], np.arange(n)], [share[both[:, 0]], own]
