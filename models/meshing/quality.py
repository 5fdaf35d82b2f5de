"""Quality of closed triangle surfaces: what a simulation asks of an organ's mesh."""

import dataclasses

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


@dataclasses.dataclass(frozen=True)
class Quality:
  """Quality of a triangle surface.

  Attributes:
    nodes: number of nodes
    triangles: number of triangles
    min_angle: smallest angle of any triangle [deg]
    watertight: every edge has exactly two triangles, run through in opposite directions
    manifold: the triangles around every node form one closed fan, every node is used
    components: number of connected pieces
    genus: number of handles of a closed surface, all pieces together; -1 if it is not closed
    volume: enclosed volume [m^3], positive if the triangles wind outward
    spacing: mean edge length [m]
    spacing_spread: standard deviation of the edge lengths over their mean
  """

  nodes: int
  triangles: int
  min_angle: float
  watertight: bool
  manifold: bool
  components: int
  genus: int
  volume: float
  spacing: float
  spacing_spread: float

  @property
  def closed(self) -> bool:
    """Whether this is one closed sphere-like surface with outward winding."""
    one_sphere = self.components == 1 and self.genus == 0
    return self.watertight and self.manifold and one_sphere and self.volume > 0


def normals(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns triangle normals times twice the area [m^2], (m, 3)."""
  a, b, c = (vertices[triangles[:, i]] for i in range(3))
  return np.cross(b - a, c - a)


def angles(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns the angles of every triangle at its corners [rad], (m, 3)."""
  a, b, c = (vertices[triangles[:, i]] for i in range(3))
  u, v, w = b - a, c - b, a - c
  double_area = np.linalg.norm(np.cross(u, -w), axis=1)
  dots = [np.einsum("md,md->m", one, other) for one, other in ((u, -w), (v, -u), (w, -v))]
  return np.stack([np.arctan2(double_area, dot) for dot in dots], axis=1)


def volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
  """Returns the volume inside a closed surface [m^3], positive if it winds outward."""
  a, b, c = (vertices[triangles[:, i]] - vertices.mean(axis=0) for i in range(3))
  return float((a * np.cross(b, c)).sum() / 6)


def quality(vertices: np.ndarray, triangles: np.ndarray) -> Quality:
  """Returns the quality of a triangle surface; vertices (n, 3) [m], triangles (m, 3)."""
  n, m = len(vertices), len(triangles)
  tail = triangles.ravel()
  head = np.roll(triangles, -1, axis=1).ravel()
  directed = tail.astype(np.int64) * n + head
  reverse = head.astype(np.int64) * n + tail
  watertight = m > 0 and bool(
    np.array_equal(np.sort(directed), np.sort(reverse))
    and len(np.unique(directed)) == len(directed)
    and (tail != head).all()
  )
  undirected, first = np.unique(np.minimum(directed, reverse), return_index=True)
  # Corners joined across shared edges: a node with one fan has all its corners in one piece.
  fans = -1
  if watertight:
    corner = np.arange(3 * m)
    order = np.argsort(directed)
    across = order[np.searchsorted(directed[order], reverse)]  # the same edge, other triangle
    following = corner - corner % 3 + (corner + 1) % 3
    link = coo_array((np.ones(3 * m), (corner, following[across])), shape=(3 * m, 3 * m))
    fans = connected_components(link, directed=False)[0]
  graph = coo_array((np.ones(3 * m), (tail, head)), shape=(n, n))
  components = connected_components(graph, directed=False)[0]
  euler = n - len(undirected) + m
  edge = np.linalg.norm(vertices[tail[first]] - vertices[head[first]], axis=1)
  manifold = fans == n
  return Quality(
    nodes=n,
    triangles=m,
    min_angle=float(np.degrees(angles(vertices, triangles).min(initial=np.pi))),
    watertight=watertight,
    manifold=manifold,
    components=int(components),
    genus=int(components - euler // 2) if watertight and manifold else -1,
    volume=volume(vertices, triangles),
    spacing=float(edge.mean()) if m else 0.0,
    spacing_spread=float(edge.std() / edge.mean()) if m else 0.0,
  )
