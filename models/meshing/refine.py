"""Finer triangles around a place of a surface, where a tool will touch it.

A contact cannot be smaller than a triangle: the force on one node is that of a disc about as wide
as an edge. So what a small tool meets has to be finer than the rest.
"""

import numpy as np

from .quality import normals
from .remesh import Edges

_WIDENS = 0.4  # by which edges grow with the distance from the region
_ASIDE = 0.04  # from the middle of a halved edge: of vertices on one circle Delaunay says nothing
_ROUNDS = 60
_MOST = 200_000  # vertices


def refine(
  vertices: np.ndarray, triangles: np.ndarray, at, radius: float, edge: float
) -> tuple[np.ndarray, np.ndarray]:
  """Returns the same surface with edges of at most `edge` around a place, longer ones farther away.

  Triangles are halved at their longest edges (Rivara 1984, doi:10.1002/nme.1620200412): none gets
  much less than half the angles it had. Where they lie in one plane they are then made Delaunay's.
  Old vertices keep their numbers, new ones follow.

  Args:
    vertices: of a closed surface [m]                 (n, 3)
    triangles: its triangles, winding outward         (m, 3)
    at: the place, or several [m]                     (3,) or (k, 3)
    radius: of the region around it [m]
    edge: longest edge there [m]

  Raises:
    ValueError: the surface is not closed, or a number is not allowed.
  """
  for name, value in (("radius", radius), ("edge", edge)):
    if not (np.isfinite(value) and value > 0):
      raise ValueError(f"{name} is {value}, expected a number > 0 [m]")
  places = np.atleast_2d(np.asarray(at, dtype=float))
  if places.shape[1:] != (3,) or not np.isfinite(places).all():
    raise ValueError(f"at is {at}, expected three coordinates [m], or rows of three")
  vertices, triangles = np.asarray(vertices, dtype=float), np.asarray(triangles)
  for _ in range(_ROUNDS):
    edges = Edges(triangles, len(vertices))
    split = _split(vertices, triangles, edges, places, radius, edge)
    if len(vertices) > _MOST:
      break
    if not split.size:
      return vertices, _flipped(vertices, triangles)
    vertices, triangles = _halve(vertices, triangles, edges, split)
  raise ValueError(f"edge is {edge:g} m, expected more: {len(vertices)} vertices were not enough")


def _split(vertices, triangles, edges: Edges, places, radius: float, edge: float) -> np.ndarray:
  """Returns the edges to halve: each the longest of both its triangles."""
  a, b = vertices[edges.vert[:, 0]], vertices[edges.vert[:, 1]]
  length = np.linalg.norm(a - b, axis=1)
  middle = (a + b) / 2
  away = np.linalg.norm(middle[:, None] - places, axis=2).min(axis=1) - radius
  rank = np.argsort(np.argsort(length, kind="stable"), kind="stable")  # no two are equal
  longest = np.zeros(len(triangles), int)
  best = np.full(len(triangles), -1)
  for side in range(2):
    np.maximum.at(best, edges.tri[:, side], rank)
  longest[:] = np.argsort(rank)[best]
  needs = (length > edge + _WIDENS * np.maximum(away, 0))[longest]
  while True:  # whose longest edge is to be halved needs the other side of it
    over = edges.tri[longest]
    other = np.where(over[:, 0] == np.arange(len(triangles)), over[:, 1], over[:, 0])
    grown = needs.copy()
    grown[other[needs]] = True
    if (grown == needs).all():
      break
    needs = grown
  one, two = edges.tri.T
  mutual = (longest[one] == longest[two]) & (longest[one] == np.arange(len(length)))
  return np.flatnonzero(mutual & needs[one])


def _halve(vertices, triangles, edges: Edges, split: np.ndarray):
  """Returns the mesh with these edges halved, no two of which share a triangle."""
  (a, b), wing = edges.vert[split].T, edges.wing[split]
  new = len(vertices) + np.arange(len(split))
  share = 0.5 + _ASIDE * np.random.RandomState(len(vertices)).uniform(-1, 1, (len(split), 1))
  vertices = np.concatenate([vertices, (1 - share) * vertices[a] + share * vertices[b]])
  keep = np.ones(len(triangles), bool)
  keep[edges.tri[split]] = False
  c, d = wing.T  # triangles (a, b, c) and (b, a, d)
  halves = [np.stack(t, 1) for t in ((a, new, c), (new, b, c), (b, new, d), (new, a, d))]
  return vertices, np.concatenate([triangles[keep], *halves])


def _flipped(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns the triangles, those in one plane Delaunay's (Lawson 1977): tetrahedra want it so."""
  triangles = triangles.copy()
  for _ in range(_ROUNDS):
    edges = Edges(triangles, len(vertices))
    (a, b), (c, d) = edges.vert.T, edges.wing.T
    ends = vertices[a], vertices[b]
    opposite = _angle(*ends, vertices[c]) + _angle(*ends, vertices[d])
    one, two = normals(vertices, triangles)[edges.tri].transpose(1, 0, 2)
    cosine = (one * two).sum(axis=1)
    flat = cosine > (1 - 1e-9) * np.linalg.norm(one, axis=1) * np.linalg.norm(two, axis=1)
    pick = np.flatnonzero(flat & (opposite > np.pi + 1e-6) & ~edges.has(c, d))
    worst = np.full(len(triangles), -1.0)
    np.maximum.at(worst, edges.tri[pick], opposite[pick, None])
    pick = pick[(worst[edges.tri[pick]] == opposite[pick, None]).all(axis=1)]
    _, first = np.unique(edges.tri[pick].min(axis=1), return_index=True)
    pick = pick[first]
    if not len(pick):
      break
    # Before: (a, b, c), (b, a, d).
    triangles[edges.tri[pick, 0]] = np.stack([a[pick], d[pick], c[pick]], axis=1)
    triangles[edges.tri[pick, 1]] = np.stack([d[pick], b[pick], c[pick]], axis=1)
  return triangles


def _angle(a: np.ndarray, b: np.ndarray, apex: np.ndarray) -> np.ndarray:
  """Returns the angles at the apexes [rad], (n,)."""
  u, v = a - apex, b - apex
  return np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))
