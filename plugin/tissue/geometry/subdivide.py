"""Smooth surfaces through the vertices of coarse ones, linear in their positions.

The limit of Loop's subdivision (Loop 1987, "Smooth subdivision surfaces based on triangles"; masks
of boundary and limit after Hoppe et al. 1994, "Piecewise smooth surface reconstruction") of a
control mesh that is chosen so that the limit goes through the coarse vertices. All weights of a
fine vertex add up to 1: a linear map of the coarse vertices is the same map of the fine ones.
"""

import dataclasses
import functools

import numpy as np
from scipy.sparse import csr_array, diags_array, hstack, vstack
from scipy.sparse.linalg import SuperLU, splu

LEVELS = (1, 2, 3, 4)
_COLUMNS = 256  # of a dense matrix at a time


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

  def weights(self, least: float) -> csr_array:
    """Returns what coarse vertices weigh in fine ones, without the weights that are below `least`.

    Those of a fine vertex still add up to 1.
    """
    n, columns = len(self.control.perm_c), []
    for start in range(0, n, _COLUMNS):
      unit = np.eye(n, min(_COLUMNS, n - start), -start)
      dense = self(unit)
      dense[np.abs(dense) < least] = 0.0
      columns.append(csr_array(dense))
    found = csr_array(hstack(columns))
    found.data /= np.repeat(np.asarray(found.sum(axis=1)), np.diff(found.indptr))
    return found


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


def _divide(elem: np.ndarray) -> tuple[csr_array, np.ndarray]:
  """Returns a step of subdivision as a matrix, and the triangles after it."""
  n = int(elem.max()) + 1
  edge, side, count = _edges(elem)
  border = count < 2
  ends = np.repeat(np.arange(len(edge)), 2), edge.ravel()
  shape = len(edge), n
  middle = csr_array((np.repeat(np.where(border, 0.5, 0.375), 2), ends), shape=shape)
  inner, corner = ~border[side], elem[:, [2, 0, 1]]  # opposite to each side
  opposite = np.full(int(inner.sum()), 0.125)
  middle += csr_array((opposite, (side[inner], corner[inner])), shape=shape)
  a, b, c = elem.T
  ab, bc, ca = (n + side).T
  fine = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
  step = vstack([_around(n, edge, border, _beta, 0.125), middle], format="csr")
  return csr_array(step), fine.astype(np.int32)


def _beta(degree: np.ndarray) -> np.ndarray:
  """Returns the weight of each neighbour of an inner vertex (Loop 1987)."""
  return (0.625 - (0.375 + 0.25 * np.cos(2 * np.pi / degree)) ** 2) / degree


def _limit(elem: np.ndarray) -> csr_array:
  """Returns where the vertices end after infinitely many steps, as a matrix."""
  edge, _, count = _edges(elem)
  n = int(elem.max()) + 1
  return _around(n, edge, count < 2, lambda k: 1 / (3 / (8 * _beta(k)) + k), 1 / 6)


def _around(n: int, edge: np.ndarray, border: np.ndarray, beta, border_share: float) -> csr_array:
  """Returns the matrix of vertices as means of themselves and their neighbours."""
  both = np.concatenate([edge, edge[:, ::-1]])
  on_border = np.zeros(n, bool)
  on_border[edge[border]] = True
  both = both[~on_border[both[:, 0]] | np.concatenate([border, border])]
  degree = np.bincount(both[:, 0], minlength=n)
  share = np.where(on_border, border_share, beta(np.maximum(degree, 1)))
  near = csr_array((share[both[:, 0]], both.T), shape=(n, n))
  return csr_array(near + diags_array(1 - share * degree))
