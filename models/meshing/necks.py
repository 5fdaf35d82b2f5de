"""Tubes of a mesh that are three nodes around: too thin for its edges."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from .quality import normals, quality
from .remesh import Edges

_THIN = 0.25  # volume over area, in edges; half of a tube's radius
_MOST_CUTS = 100


def cut(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns the triangles of a closed mesh without its thin tubes, closed where they were cut off.

  A loop of three edges that are no triangle's is a neck; what is behind it goes, if that is thin
  too: a vessel goes, a lobe on a thin stalk stays.
  """
  edge = quality(vertices, triangles).spacing
  for _ in range(_MOST_CUTS):
    best, kept = 0.0, triangles
    for neck in _loops(triangles, len(vertices)):
      behind = _behind(triangles, neck, len(vertices))
      area = np.linalg.norm(normals(vertices, triangles[behind]), axis=1).sum() / 2
      lid = _lid(triangles[~behind], neck)
      part = np.concatenate([triangles[behind], lid[None, ::-1]])
      if area > best and abs(_volume(vertices, part)) < _THIN * edge * area:
        best, kept = area, np.concatenate([triangles[~behind], lid[None]])
    if kept is triangles:
      break
    triangles = kept
  return triangles


def _loops(triangles: np.ndarray, nodes: int) -> np.ndarray:
  """Returns loops of three edges that are no triangle, (k, 3)."""
  edges = Edges(triangles, nodes)
  a, b = edges.vert.T
  both = np.concatenate([a, b]), np.concatenate([b, a])
  joined = coo_array((np.ones(2 * len(a)), both), shape=(nodes, nodes)).tocsr()
  edge, third = joined[a].multiply(joined[b]).nonzero()
  loops = np.unique(np.sort(np.column_stack([edges.vert[edge], third]), axis=1), axis=0)
  own = {tuple(t) for t in np.sort(triangles, axis=1).tolist()}
  return np.array([t for t in loops.tolist() if tuple(t) not in own], dtype=int).reshape(-1, 3)


def _behind(triangles: np.ndarray, neck: np.ndarray, nodes: int) -> np.ndarray:
  """Returns which triangles are on the side of a loop that has fewer of them."""
  edges = Edges(triangles, nodes)
  open_ = ~np.isin(edges.vert, neck).all(axis=1)
  count = len(triangles)
  link = coo_array((np.ones(open_.sum()), edges.tri[open_].T), shape=(count, count))
  parts, label = connected_components(link, directed=False)
  # A loop around a ring has one side: nothing is behind it.
  return (label == np.bincount(label).argmin()) & (parts > 1)


def _lid(triangles: np.ndarray, neck: np.ndarray) -> np.ndarray:
  """Returns the triangle that closes a hole of three edges."""
  tail, head = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
  a, b, c = neck
  runs_along = ((tail == a) & (head == b)).any()
  return np.array([b, a, c] if runs_along else [a, b, c])


def _volume(vertices: np.ndarray, triangles: np.ndarray) -> float:
  a, b, c = (vertices[triangles[:, k]] - vertices[triangles[0, 0]] for k in range(3))
  return float((a * np.cross(b, c)).sum() / 6)
