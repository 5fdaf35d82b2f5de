"""Even remeshing of closed surfaces to a given number of nodes.

Every operation (collapse, flip, slide) keeps a closed surface closed and its genus, so what comes
out is as watertight as what goes in. All are applied in batches that do not touch each other,
chosen by rank: the result repeats bit for bit.
"""

from collections.abc import Callable

import numpy as np
from palpate.tissue.geometry.mesh import vertex_normals
from scipy.sparse import coo_array

from .quality import angles, normals

# Takes points (n, 3) near the surface and returns the points of the surface they belong to.
Project = Callable[[np.ndarray], np.ndarray]

_MIN_VALENCE = 4
_MAX_VALENCE = 9


class Edges:
  """Edges of a closed triangle surface.

  Attributes:
    vert: end nodes; triangle 0 runs from the first to the second   (e, 2)
    tri: triangles at the edge                                      (e, 2)
    wing: node opposite to the edge in each of its triangles        (e, 2)
    key: sorted numbers that identify the edges                     (e,)
    valence: edges at every node                                    (n,)
  """

  def __init__(self, triangles: np.ndarray, nodes: int):
    tail = triangles.ravel()
    head = triangles[:, [1, 2, 0]].ravel()
    wing = triangles[:, [2, 0, 1]].ravel()
    key = np.minimum(tail, head).astype(np.int64) * nodes + np.maximum(tail, head)
    order = np.argsort(key, kind="stable")
    one, two = order[0::2], order[1::2]
    if len(key) % 2 or not np.array_equal(key[one], key[two]):
      raise ValueError("the surface is not closed: an edge does not have two triangles")
    self.key = key[one]
    if (self.key[1:] == self.key[:-1]).any():
      raise ValueError("the surface is not manifold: an edge has more than two triangles")
    self.vert = np.stack([tail[one], head[one]], axis=1)
    self.tri = np.stack([one // 3, two // 3], axis=1)
    self.wing = np.stack([wing[one], wing[two]], axis=1)
    self.valence = np.bincount(self.vert.ravel(), minlength=nodes)
    self._nodes = nodes

  def has(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Returns whether nodes a and b are joined by an edge."""
    key = np.minimum(a, b).astype(np.int64) * self._nodes + np.maximum(a, b)
    at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
    return self.key[at] == key

  def lowest(self, value: np.ndarray) -> np.ndarray:
    """Returns the lowest of a nodal value over every node and its neighbours."""
    out = value.copy()
    np.minimum.at(out, self.vert[:, 0], value[self.vert[:, 1]])
    np.minimum.at(out, self.vert[:, 1], value[self.vert[:, 0]])
    return out


def remesh(
  vertices: np.ndarray, triangles: np.ndarray, nodes: int, project: Project, iterations: int = 40
) -> tuple[np.ndarray, np.ndarray]:
  """Returns an even mesh of the same closed surface with the given number of nodes.

  Args:
    vertices: nodes of a fine closed mesh [m]                  (n, 3)
    triangles: its triangles, winding outward                  (m, 3)
    nodes: number of nodes wanted, at most n
    project: puts points near the surface onto it
    iterations: rounds of sliding and flipping at the end
  """
  if nodes > len(vertices):
    raise ValueError(f"nodes is {nodes}, expected at most the {len(vertices)} of the fine mesh")
  vertices, triangles = _collapse_to(vertices, triangles, nodes, project)
  return relax(vertices, triangles, project, iterations)


def relax(
  vertices: np.ndarray, triangles: np.ndarray, project: Project, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
  """Returns the mesh after rounds of edge flips and sliding along the surface."""
  for _ in range(iterations):
    triangles = _flip(vertices, triangles)
    vertices = project(_slide(vertices, triangles))
  return vertices, _flip(vertices, triangles)


def guard(
  vertices: np.ndarray, moved: np.ndarray, triangles: np.ndarray, least_angle: float = 25.0
) -> np.ndarray:
  """Returns the moved nodes, without the moves that make a thin or folded triangle worse.

  Args:
    vertices: nodes before the move          (n, 3)
    moved: nodes after it                    (n, 3)
    triangles: triangles of both             (m, 3)
    least_angle: angles above this are fine [deg]
  """
  edges = Edges(triangles, len(vertices))
  angle_before, bend_before = _shape(vertices, triangles, edges)
  moved = moved.copy()
  for _ in range(20):
    angle, bend = _shape(moved, triangles, edges)
    thin = (angle < np.radians(least_angle)) & (angle < angle_before)
    folded = (bend < -0.3) & (bend < bend_before)  # over 107 degrees
    undo = np.concatenate([triangles[thin].ravel(), triangles[edges.tri[folded].ravel()].ravel()])
    undo = undo[(moved[undo] != vertices[undo]).any(axis=1)]
    if not len(undo):
      return moved
    moved[undo] = vertices[undo]
  return vertices


def _shape(
  vertices: np.ndarray, triangles: np.ndarray, edges: Edges
) -> tuple[np.ndarray, np.ndarray]:
  """Returns every triangle's smallest angle [rad] and every edge's cosine between normals."""
  normal = normals(vertices, triangles)
  normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
  one, two = normal[edges.tri].transpose(1, 0, 2)
  return angles(vertices, triangles).min(axis=1), np.einsum("ed,ed->e", one, two)


def _scatter(triangles: np.ndarray, value: np.ndarray, nodes: int) -> np.ndarray:
  """Returns sums over corners at the nodes, (nodes, k), of a value per corner (m, 3, k)."""
  index, flat = triangles.ravel(), value.reshape(triangles.size, -1)
  return np.stack([np.bincount(index, column, nodes) for column in flat.T], axis=1)


def _slide(vertices: np.ndarray, triangles: np.ndarray, step: float = 0.7) -> np.ndarray:
  """Returns the nodes moved in their tangent planes towards the centroid of their triangles.

  Weighting centroids by area evens out the density (Lloyd's relaxation on one ring).
  """
  weight = np.linalg.norm(normals(vertices, triangles), axis=1)
  middle = vertices[triangles].mean(axis=1)
  value = np.column_stack([middle * weight[:, None], weight])
  total = _scatter(triangles, np.repeat(value[:, None], 3, axis=1), len(vertices))
  shift = total[:, :3] / np.maximum(total[:, 3:], 1e-300) - vertices
  normal = vertex_normals(vertices, triangles)
  return vertices + step * (shift - (shift * normal).sum(axis=1, keepdims=True) * normal)


def _independent(rank: np.ndarray, vert: np.ndarray, nodes: int) -> np.ndarray:
  """Returns which rows of vert (k, j) have the lowest rank at every one of their nodes."""
  best = np.full(nodes, len(rank))
  np.minimum.at(best, vert.ravel(), np.repeat(rank, vert.shape[1]))
  return (best[vert] == rank[:, None]).all(axis=1)


def _ranked(cost: np.ndarray) -> np.ndarray:
  """Returns the place of every cost in sorted order; ties go by index."""
  rank = np.empty(len(cost), dtype=np.int64)
  rank[np.argsort(cost, kind="stable")] = np.arange(len(cost))
  return rank


def _flip(vertices: np.ndarray, triangles: np.ndarray, batches: int = 4) -> np.ndarray:
  """Returns the triangles after flips towards larger angles and six edges at a node."""
  for _ in range(batches):
    edges = Edges(triangles, len(vertices))
    (a, b), (c, d) = edges.vert.T, edges.wing.T
    valence = edges.valence
    # Before: (a, b, c), (b, a, d). After: (a, d, c), (d, b, c).
    old = np.stack([np.stack([a, b, c], 1), np.stack([b, a, d], 1)])
    new = np.stack([np.stack([a, d, c], 1), np.stack([d, b, c], 1)])
    angle = _worst_angle(vertices, new)
    gain = angle - _worst_angle(vertices, old)
    off = valence[np.stack([a, b, c, d])] - 6
    evened = (off**2).sum(axis=0) - ((off + np.array([[-1], [-1], [1], [1]])) ** 2).sum(axis=0)
    # Two degrees for every step towards valence six, unless the triangles become thin.
    gain += np.where(angle > np.radians(25.0), np.radians(2.0) * evened, 0.0)
    allowed = (valence[a] > _MIN_VALENCE) & (valence[b] > _MIN_VALENCE)
    allowed &= (valence[c] < _MAX_VALENCE) & (valence[d] < _MAX_VALENCE)
    pick = np.flatnonzero(allowed & (gain > 1e-9))
    pick = pick[~edges.has(c[pick], d[pick])]
    pick = pick[_keeps_side(vertices, old[:, pick], new[:, pick])]
    quad = np.concatenate([edges.vert[pick], edges.wing[pick]], axis=1)
    pick = pick[_independent(_ranked(-gain[pick]), quad, len(vertices))]
    if not len(pick):
      break
    triangles = triangles.copy()
    triangles[edges.tri[pick, 0]] = new[0, pick]
    triangles[edges.tri[pick, 1]] = new[1, pick]
  return triangles


def _worst_angle(vertices: np.ndarray, pair: np.ndarray) -> np.ndarray:
  """Returns the smallest angle of pairs of triangles, (2, k, 3)."""
  return np.minimum.reduce([column for t in pair for column in angles(vertices, t).T])


def _keeps_side(vertices: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
  """Returns whether both new triangles face within 60 degrees of the old pair's mean normal."""
  side = sum(normals(vertices, t) for t in old)
  side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
  cosine = [(normals(vertices, t) * side).sum(axis=1) for t in new]
  length = [np.linalg.norm(normals(vertices, t), axis=1) for t in new]
  return (cosine[0] > 0.5 * length[0]) & (cosine[1] > 0.5 * length[1])


def _collapse_to(
  vertices: np.ndarray, triangles: np.ndarray, nodes: int, project: Project
) -> tuple[np.ndarray, np.ndarray]:
  """Returns the mesh after collapsing its shortest edges until `nodes` are left."""
  for _ in range(1000):
    before = len(vertices)
    for _ in range(2):
      if len(vertices) == nodes:
        return vertices, triangles
      vertices, triangles = _collapse(vertices, triangles, len(vertices) - nodes)
    flipped = _flip(vertices, triangles, batches=1)
    if len(vertices) == before and np.array_equal(triangles, flipped):
      break
    vertices, triangles = project(_slide(vertices, flipped)), flipped
  raise ValueError(f"could not reach {nodes} nodes: stuck at {len(vertices)}")


def _collapse(
  vertices: np.ndarray, triangles: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray]:
  """Returns the mesh after one batch of at most `most` collapses of short edges to midpoints."""
  n = len(vertices)
  edges = Edges(triangles, n)
  (a, b), (c, d) = edges.vert.T, edges.wing.T
  length = np.linalg.norm(vertices[a] - vertices[b], axis=1)
  valence = edges.valence
  allowed = valence[a] + valence[b] - 4 <= _MAX_VALENCE
  allowed &= (valence[c] > _MIN_VALENCE) & (valence[d] > _MIN_VALENCE)
  allowed &= length <= np.quantile(length, 0.5)
  pick = np.flatnonzero(allowed)
  pick = pick[_common_neighbours(edges, n)[pick] == 2]  # the link condition
  pick = pick[_apart(edges, pick, length[pick], n)]
  pick = pick[np.argsort(length[pick], kind="stable")][:most]
  for _ in range(10):
    target, moved = np.arange(n), vertices.copy()
    target[b[pick]] = a[pick]
    moved[a[pick]] = (vertices[a[pick]] + vertices[b[pick]]) / 2
    merged = target[triangles]
    t = merged
    alive = (t[:, 0] != t[:, 1]) & (t[:, 1] != t[:, 2]) & (t[:, 2] != t[:, 0])
    old = normals(vertices, triangles[alive])
    new = normals(moved, merged[alive])
    product = np.linalg.norm(old, axis=1) * np.linalg.norm(new, axis=1)
    tiny = 1e-3 * (length.mean() ** 2)  # slivers of marching cubes have no direction to keep
    bad = ((old * new).sum(axis=1) < 0.3 * product) & (np.linalg.norm(old, axis=1) > tiny)
    if not bad.any():
      break
    spoiled = np.zeros(n, dtype=bool)
    spoiled[merged[alive][bad]] = True
    pick = pick[~spoiled[a[pick]]]
  else:
    return vertices, triangles
  keep = np.ones(n, dtype=bool)
  keep[b[pick]] = False
  number = np.cumsum(keep) - 1
  return moved[keep], number[merged[alive]]


def _apart(edges: Edges, pick: np.ndarray, cost: np.ndarray, nodes: int) -> np.ndarray:
  """Returns which picked edges are the cheapest within one ring around both their nodes."""
  rank = _ranked(cost)
  best = np.full(nodes, len(pick))
  np.minimum.at(best, edges.vert[pick].ravel(), np.repeat(rank, 2))
  return (edges.lowest(best)[edges.vert[pick]] == rank[:, None]).all(axis=1)


def _common_neighbours(edges: Edges, nodes: int) -> np.ndarray:
  """Returns how many nodes both ends of every edge are joined to, (e,)."""
  a, b = edges.vert.T
  both = np.concatenate([a, b]), np.concatenate([b, a])
  joined = coo_array((np.ones(2 * len(a)), both), shape=(nodes, nodes)).tocsr()
  return np.asarray(joined[a].multiply(joined[b]).sum(axis=1)).ravel()
