"""Tubes of a mesh that are three nodes around: too thin for its edges."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .quality import normals
from .remesh import Edges

_THIN = 0.25  # volume over area, in edges; half of a tube's radius


def tubes(vertices: np.ndarray, triangles: np.ndarray, edge: float) -> list[np.ndarray]:
  """Returns the triangles of the thin tubes of a closed mesh, each with a lid.

  A loop of three edges that are no triangle's is a neck; what is behind it is a tube, if that is
  thin too: a vessel is, a lobe on a thin stalk is not.

  Args:
    vertices: nodes [m]           (n, 3)
    triangles: between them       (m, 3)
    edge: their mean edge [m]
  """
  edges, out = Edges(triangles, len(vertices)), []
  for neck in _loops(edges, triangles):
    behind = triangles[_behind(edges, neck, len(triangles))]
    area = np.linalg.norm(normals(vertices, behind), axis=1).sum() / 2
    a, b, c = (vertices[behind[:, k]] - vertices[neck[0]] for k in range(3))
    if abs((a * np.cross(b, c)).sum() / 6) < _THIN * edge * area:
      out.append(np.concatenate([behind, neck[None]]))
  return out


def _loops(edges: Edges, triangles: np.ndarray) -> np.ndarray:
  """Returns loops of three edges that are no triangle, (k, 3)."""
  (a, b), nodes = edges.vert.T, len(edges.valence)
  both = np.concatenate([a, b]), np.concatenate([b, a])
  joined = coo_array((np.ones(2 * len(a)), both), shape=(nodes, nodes)).tocsr()
  edge, third = joined[a].multiply(joined[b]).nonzero()
  loops = np.unique(np.sort(np.column_stack([edges.vert[edge], third]), axis=1), axis=0)
  own = {tuple(t) for t in np.sort(triangles, axis=1).tolist()}
  return np.array([t for t in loops.tolist() if tuple(t) not in own], dtype=int).reshape(-1, 3)


def _behind(edges: Edges, neck: np.ndarray, count: int) -> np.ndarray:
  """Returns which triangles are on the side of a loop that has fewer of them, if it has two."""
  open_ = ~np.isin(edges.vert, neck).all(axis=1)
  link = coo_array((np.ones(open_.sum()), edges.tri[open_].T), shape=(count, count))
  parts, label = connected_components(link, directed=False)
  return (label == np.bincount(label).argmin()) & (parts > 1)
