"""Cuts: a path on the surface becomes edges of the mesh, and the mesh comes apart along them.

A chain of edges near the path is found, its vertices are moved onto the path in the rest shape
("snap"), as far as no triangle gets thin, and vertices on it are doubled ("split"; Nienhuys and van
der Stappen 2001). Triangles keep their numbers and none is added, so that what is stored by
triangle stays, and so does the room that arrays need.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from scipy import sparse, spatial
from scipy.sparse import csgraph

from . import mesh as topology
from .mesh import Mesh

_STEP = 0.25  # between samples of the path, in edges
_OFF = 2.0  # edges from the surface from which a point is off it
_WAY = 8.0  # edges between vertices that the chain must pass
_RIM = 0.5  # edges: a cut that ends closer to a boundary opens it
_SHAPE = 0.3  # least shape of a triangle that is moved, or so much of what it had; equilateral: 1
_KEEP = 0.9
_TURN = 0.95  # least cosine between a triangle's normals before and after
_CORNER = -0.8  # greatest cosine between the boundary's edges at a vertex that may slide on it
_TRIES = 10
_RISE = 1.01  # times its energy that the tissue around a vertex may have when it was moved
_LESS = 0.7
_NEAR = 6  # vertices nearest to a point around which its triangle is looked for


# Energy of triangles [J], (n,), from their corners at rest and the displacements of these, (n, 3, 3)
# each, and their numbers (n,).
Energy = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Cut:
  """What came of a path.

  Attributes:
    mesh: the mesh, cut
    touched: vertices of triangles that are not as they were
    moved: vertices that lie elsewhere at rest                          (n,)
    corner: where they lie in the mesh before: corners of a triangle    (n, 3)
    weight: and their weights                                           (n, 3)
    group: vertices that were one, of the first of each group           (m,)
    member: those vertices, old and new                                 (m,)
    path: the cut edges, one after the other, at rest [m]               list of (k, 3)
    length: of the cut edges at rest [m]
    deviation: greatest distance of their vertices from the path [m]
    stopped: whether there were too few spare vertices
  """

  mesh: Mesh
  touched: np.ndarray
  moved: np.ndarray
  corner: np.ndarray
  weight: np.ndarray
  group: np.ndarray
  member: np.ndarray
  path: list[np.ndarray]
  length: float
  deviation: float
  stopped: bool


@dataclasses.dataclass
class _Run:
  """A part of a path without gaps: samples at rest (n, 3), their triangles, chain of vertices."""

  at: np.ndarray
  elem: np.ndarray
  chain: list[int] = dataclasses.field(default_factory=list)

  @property
  def closes(self) -> bool:
    """Whether the chain ends where it begins."""
    return len(self.chain) > 3 and self.chain[0] == self.chain[-1]


def cut(
  organ: str,
  mesh: Mesh,
  position: np.ndarray,
  points: np.ndarray,
  pinned: np.ndarray,
  energy: Energy | None = None,
) -> Cut:
  """Returns the mesh cut along the path on the surface that is nearest to points.

  Args:
    organ: its name, for messages
    mesh: the surface
    position: where its vertices are now [m]     (nvert, 3)
    points: the path, in the same frame [m]      (n, 3)
    pinned: vertices that do not move            (nvert,) bool
    energy: of triangles, which moving vertices must not raise, or None

  Raises:
    ValueError: points are off the surface, or the path goes through pinned vertices or is too short.
  """
  edge = mesh.edge_length
  runs = _trace(organ, mesh, position, points, edge)
  for run in runs:
    run.chain = _chain(mesh, run, edge)
  _check(organ, runs, pinned)
  edges, stopped = _room(mesh, [pair for run in runs for pair in _pairs(run.chain)])
  there = {v for pair in edges for v in pair}
  moved, corner, weight = _snap(mesh, runs, pinned, position, energy, there)
  rest = mesh.rest.copy()
  rest[moved] = np.einsum("nk,nkj->nj", weight, mesh.rest[corner])
  elem, group, member = _split(mesh, edges)
  rest[member] = rest[group]
  new, touched = topology.recut(mesh, rest, elem, mesh.loose)
  new = topology.come_loose(new)
  path = _lines(rest, edges)
  cut_chains = [(run, [v for v in run.chain if v in there]) for run in runs]
  far = [_distance(run.at, rest[chain])[0].max() for run, chain in cut_chains if chain]
  length = sum(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in path)
  deviation = float(max(far, default=0.0))
  return Cut(new, touched, moved, corner, weight, group, member, path, length, deviation, stopped)


# The path on the surface.


def _trace(organ: str, mesh: Mesh, position, points, edge: float) -> list[_Run]:
  """Returns the parts of the path on the surface, in the rest shape."""
  _check_points(organ, points)
  gap = np.linalg.norm(np.diff(points, axis=0), axis=1)
  steps = np.maximum(np.ceil(gap / (_STEP * edge)).astype(int), 1)
  share = np.concatenate([np.arange(n) / n for n in steps] + [[0.0]])
  k = np.append(np.repeat(np.arange(len(steps)), steps), len(steps) - 1)
  share[-1] = 1.0
  sample = points[k] + share[:, None] * (points[k + 1] - points[k])
  elem, weight, far = nearest(mesh, position, sample)
  given = np.append(np.cumsum(steps) - steps, len(sample) - 1)
  off = np.flatnonzero(far[given] > _OFF * edge)
  if off.size:
    raise ValueError(
      f"organ {organ!r}: point {off[0]} of the path is {far[given[off[0]]]:.3g} m from the surface, "
      f"expected at most {_OFF * edge:.3g} m"
    )
  at = np.einsum("nk,nkj->nj", weight, mesh.rest[mesh.elem[elem]])
  # Where the path crosses an older cut, or leaps, it begins anew.
  label = topology.pieces(mesh)[mesh.elem[elem, 0]]
  leap = np.linalg.norm(np.diff(at, axis=0), axis=1) > 2 * edge
  parts = np.flatnonzero(leap | (np.diff(label) != 0) | _crosses(mesh, elem)) + 1
  runs = [_Run(a, e) for a, e in zip(np.split(at, parts), np.split(elem, parts), strict=True)]
  return [run for run in runs if len(run.at) > 1]


def _check_points(organ: str, points: np.ndarray):
  if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
    raise ValueError(
      f"organ {organ!r}: points of a cut have shape {points.shape}, expected (n, 3), n >= 2"
    )
  if not np.isfinite(points).all():
    bad = int(np.flatnonzero(~np.isfinite(points).all(axis=1))[0])
    raise ValueError(f"organ {organ!r}: point {bad} is {points[bad]}, expected finite numbers")


def _crosses(mesh: Mesh, elem: np.ndarray) -> np.ndarray:
  """Returns where neighbouring samples were neighbours before the first cut, and are no more."""
  whole = mesh.whole
  if mesh is whole:
    return np.zeros(len(elem) - 1, bool)
  a, b = elem[:-1], elem[1:]
  def shares(m):
    return (m.elem[a][:, :, None] == m.elem[b][:, None]).any(axis=(1, 2))
  return (a != b) & shares(whole) & ~shares(mesh)


def nearest(
  mesh: Mesh, position: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns the points of the surface nearest to points.

  Args:
    mesh: the surface
    position: where its vertices are [m]  (nvert, 3)
    points: some points [m]               (n, 3)

  Returns:
    triangles (n,), weights of their corners (n, 3), distances [m] (n,)
  """
  used = mesh.nouter
  _, near = spatial.cKDTree(position[:used]).query(points, k=min(_NEAR, used))
  around = mesh.ring_elem[near].reshape(len(points), -1)
  elem = np.where(around >= 0, around // 3, around.max(axis=1, keepdims=True) // 3)
  corner = position[mesh.elem[elem]]
  weight, far = _closest(points[:, None], corner[:, :, 0], corner[:, :, 1], corner[:, :, 2])
  best = np.argmin(far, axis=1)
  row = np.arange(len(points))
  return elem[row, best], weight[row, best], far[row, best]


def _closest(p, a, b, c) -> tuple[np.ndarray, np.ndarray]:
  """Returns weights of the point of triangles that is nearest to points, and its distance."""
  ab, ac, ap = b - a, c - a, p - a
  d11, d12, d22 = (ab * ab).sum(-1), (ab * ac).sum(-1), (ac * ac).sum(-1)
  e1, e2 = (ap * ab).sum(-1), (ap * ac).sum(-1)
  det = np.maximum(d11 * d22 - d12 * d12, 1e-300)
  v, w = (d22 * e1 - d12 * e2) / det, (d11 * e2 - d12 * e1) / det
  found = [np.stack([1 - v - w, v, w], -1)]
  inside = (found[0] >= 0).all(axis=-1)
  # On the edges.
  t = np.clip(e1 / np.maximum(d11, 1e-300), 0, 1)
  found.append(np.stack([1 - t, t, 0 * t], -1))
  t = np.clip(e2 / np.maximum(d22, 1e-300), 0, 1)
  found.append(np.stack([1 - t, 0 * t, t], -1))
  bc, bp = c - b, p - b
  t = np.clip((bp * bc).sum(-1) / np.maximum((bc * bc).sum(-1), 1e-300), 0, 1)
  found.append(np.stack([0 * t, 1 - t, t], -1))
  weight = np.stack(found, -2)  # (..., 4, 3)
  at = weight @ np.stack([a, b, c], -2)
  far = np.linalg.norm(at - p[..., None, :], axis=-1)
  far[..., 0] = np.where(inside, far[..., 0], np.inf)
  best = np.argmin(far, axis=-1)[..., None]
  return (
    np.take_along_axis(weight, best[..., None], -2)[..., 0, :],
    np.take_along_axis(far, best, -1)[..., 0],
  )


def _distance(line: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the distances of points from a polyline, and its points there (n,), (n, 3)."""
  a, d = line[:-1], np.diff(line, axis=0)
  t = ((points[:, None] - a) * d).sum(-1) / np.maximum((d * d).sum(-1), 1e-300)
  at = a + np.clip(t, 0, 1)[..., None] * d
  far = np.linalg.norm(points[:, None] - at, axis=-1)
  best = np.argmin(far, axis=1)
  row = np.arange(len(points))
  return far[row, best], at[row, best]


# The chain of edges near it.


def _chain(mesh: Mesh, run: _Run, edge: float) -> list[int]:
  """Returns vertices near a path, each a neighbour of the one before."""
  near = np.unique(mesh.elem[run.elem])
  ring = mesh.ring[near]
  band = np.unique(np.append(ring[ring >= 0], near))
  far, _ = _distance(run.at, mesh.rest[band])
  band, far = band[far < 1.5 * edge], far[far < 1.5 * edge]
  if len(band) < 2:
    return []
  number = np.full(mesh.nvert, -1)
  number[band] = np.arange(len(band))
  ring = mesh.ring[band]
  a, k = np.nonzero((ring >= 0) & (number[ring] >= 0))
  b = number[ring[a, k]]
  size = np.linalg.norm(mesh.rest[band[a]] - mesh.rest[band[b]], axis=1)
  cost = size * (0.05 + (far[a] ** 2 + far[b] ** 2) / edge**2)
  graph = sparse.csr_array((cost, (a, b)), shape=(len(band), len(band)))
  way = _ways(mesh, run, band, edge)
  out = [way[0]]
  for begin, end in zip(way[:-1], way[1:], strict=True):
    before = csgraph.dijkstra(graph, indices=begin, return_predecessors=True)[1]
    part = [end]
    while part[-1] != begin and before[part[-1]] >= 0:
      part.append(int(before[part[-1]]))
    if part[-1] == begin:
      out += part[-2::-1]
  return _without_spikes([int(band[k]) for k in out])


def _ways(mesh: Mesh, run: _Run, band: np.ndarray, edge: float) -> list[int]:
  """Returns numbers of vertices of the band that the chain passes, its ends among them."""
  along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(run.at, axis=0), axis=1))])
  parts = max(1, round(along[-1] / (_WAY * edge)))
  closes = along[-1] > 3 * edge and np.linalg.norm(run.at[-1] - run.at[0]) < _STEP * edge
  parts = max(parts, 3) if closes else parts
  where = np.searchsorted(along, np.linspace(0, along[-1], parts + 1)).clip(0, len(along) - 1)
  rest = mesh.rest[band]
  far = np.linalg.norm(run.at[where][:, None] - rest, axis=2)
  way = [int(k) for k in np.argmin(far, axis=1)]
  if closes:
    return [*way[:-1], way[0]]
  rim = mesh.ring_elem[band, np.maximum(mesh.degree[band] - 1, 0)] < 0
  for end in (0, -1):
    at_rim = np.where(rim, far[end], np.inf)
    if at_rim.min(initial=np.inf) < _RIM * edge:
      way[end] = int(np.argmin(at_rim))
  return way


def _without_spikes(chain: list[int]) -> list[int]:
  out: list[int] = []
  for v in chain:
    if out and out[-1] == v:
      continue
    if len(out) > 1 and out[-2] == v:
      out.pop()
    else:
      out.append(v)
  return out


def _pairs(chain: list[int]) -> list[tuple[int, int]]:
  return list(zip(chain[:-1], chain[1:], strict=True))


def _check(organ: str, runs: list[_Run], pinned: np.ndarray):
  if not any(len(run.chain) > 2 for run in runs):
    raise ValueError(
      f"organ {organ!r}: the path is shorter than two edges of the mesh there, expected a longer one"
    )
  for run in runs:
    inner = run.chain if run.closes else run.chain[1:-1]
    bad = [v for v in inner if pinned[v]]
    if bad:
      raise ValueError(
        f"organ {organ!r}: the path goes through vertex {bad[0]}, which is pinned, expected tissue "
        "that moves"
      )


# Snapping.


def _snap(mesh: Mesh, runs: list[_Run], pinned, position, energy: Energy | None, there: set[int]):
  """Returns vertices that move at rest, and where they lie: corners of a triangle and weights.

  Those of the runs that are `there`.
  """
  vert, goal = [np.zeros(0, int)], [np.zeros((0, 3))]
  for run in runs:
    chain = np.array(run.chain, int)
    if not len(chain):
      continue
    at = _distance(run.at, mesh.rest[chain])[1]
    if not run.closes:
      at[0], at[-1] = run.at[0], run.at[-1]
    vert.append(chain)
    goal.append(at)
  vert, first = np.unique(np.concatenate(vert), return_index=True)
  goal = np.concatenate(goal)[first]
  goal, free = _on_rim(mesh, vert, goal)
  free &= ~pinned[vert] & np.isin(vert, list(there))
  vert, goal = vert[free], goal[free]
  around = mesh.ring_elem[vert]
  elem = np.where(around >= 0, around, around[:, :1]) // 3
  corner = mesh.rest[mesh.elem[elem]]
  weight, far = _closest(goal[:, None], corner[:, :, 0], corner[:, :, 1], corner[:, :, 2])
  best, row = np.argmin(far, axis=1), np.arange(len(vert))
  elem, weight = elem[row, best], weight[row, best]
  own = (mesh.elem[elem] == vert[:, None]).astype(float)
  u = position - mesh.rest
  weight = own + _shares(mesh, vert, elem, weight, u, energy)[:, None] * (weight - own)
  moved = (weight != own).any(axis=1)
  return vert[moved], mesh.elem[elem[moved]], weight[moved]


def _on_rim(mesh: Mesh, vert: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns goals of vertices, those of a boundary on it, and whether each may move."""
  last = mesh.degree[vert] - 1
  rim = mesh.ring_elem[vert, last] < 0
  here = mesh.rest[vert]
  arms = [mesh.rest[mesh.ring[vert, k]] - here for k in (0 * last, last)]
  units = [arm / np.linalg.norm(arm, axis=1, keepdims=True) for arm in arms]
  free = ~rim | ((units[0] * units[1]).sum(1) < _CORNER)
  along = np.stack([np.maximum(((goal - here) * u).sum(1), 0.0) for u in units])
  side = np.argmax(along, axis=0)
  slid = here + np.where(side[:, None] == 0, along[0][:, None] * units[0], along[1][:, None] * units[1])
  return np.where(rim[:, None], slid, goal), free


def _shares(mesh: Mesh, vert, elem, weight, u: np.ndarray, energy: Energy | None) -> np.ndarray:
  """Returns how far of its way each vertex goes, (n,).

  So far that no triangle gets thin or turns, and that the energy around none rises: a vertex gets
  the displacement of where it goes to, and an uneven strain is another one after it.
  """
  around = mesh.ring_elem[vert]
  tri = np.unique(around[around >= 0] // 3)
  before = mesh.rest[mesh.elem[tri]]
  normal, shape = _form(before)
  least = np.minimum(_SHAPE, _KEEP * shape)
  way, lead = (
    np.einsum("nk,nkj->nj", weight, values[mesh.elem[elem]]) - values[vert]
    for values in (mesh.rest, u)
  )
  had = None if energy is None else energy(before, u[mesh.elem[tri]], tri)
  share = np.ones(len(vert))
  number = np.full(mesh.nvert, -1)
  number[vert] = np.arange(len(vert))
  for k in range(_TRIES + 1):
    rest = mesh.rest.copy()
    rest[vert] += share[:, None] * way
    turned, now = _form(rest[mesh.elem[tri]])
    bad = (now < least) | ((turned * normal).sum(1) < _TURN)
    who = number[mesh.elem[tri]]
    less = np.unique(who[bad])
    if energy is not None:
      moved = u.copy()
      moved[vert] += share[:, None] * lead
      has = energy(rest[mesh.elem[tri]], moved[mesh.elem[tri]], tri)
      old, new = (np.bincount(who.ravel() + 1, np.repeat(e, 3), len(vert) + 1) for e in (had, has))
      less = np.union1d(less, np.flatnonzero(new > _RISE * old) - 1)
    less = less[less >= 0]
    if not less.size:
      break
    share[less] *= _LESS if k + 1 < _TRIES else 0.0
  return share


def _form(corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns unit normals and shapes of triangles (n, 3, 3); an equilateral one has shape 1."""
  a, b, c = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 1], corner[:, 0] - corner[:, 2]
  area = np.cross(a, -c)
  size = np.linalg.norm(area, axis=1)
  length2 = (a * a).sum(1) + (b * b).sum(1) + (c * c).sum(1)
  return area / np.maximum(size, 1e-300)[:, None], 2 * np.sqrt(3) * size / length2


# Splitting.


def _fans(mesh: Mesh, vert: int, cuts: set[tuple[int, int]]) -> list[list[int]]:
  """Returns the half-edges from a vertex, in a list for each of the parts that edges cut it in."""
  degree = int(mesh.degree[vert])
  ring, half = mesh.ring[vert, :degree].tolist(), mesh.ring_elem[vert, :degree].tolist()
  closed = half[-1] >= 0
  is_cut = [(min(vert, v), max(vert, v)) in cuts for v in ring]
  parts: list[list[int]] = [[]]
  for k, h in enumerate(half):
    if is_cut[k] and parts[-1]:
      parts.append([])
    if h >= 0:
      parts[-1].append(h)
  if closed and len(parts) > 1 and not is_cut[0]:
    parts[0] = parts.pop() + parts[0]
  return [part for part in parts if part]


def _room(mesh: Mesh, pairs: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], bool]:
  """Returns as many of the edges, from the first one, as there are spare vertices for."""
  left = mesh.nvert - mesh.nouter
  count = len(pairs)
  while count:
    cuts = {(min(p), max(p)) for p in pairs[:count]}
    verts = dict.fromkeys(v for pair in pairs[:count] for v in pair)
    need = sum(len(_fans(mesh, v, cuts)) - 1 for v in verts)
    if need <= left:
      count *= need > 0
      break
    count -= max(1, min(count, need - left))
  return pairs[:count], count < len(pairs)


def _split(mesh: Mesh, pairs: list[tuple[int, int]]):
  """Returns the triangles cut along edges, and the vertices that were one."""
  cuts = {(min(p), max(p)) for p in pairs}
  elem = mesh.elem.copy()
  corner = elem.reshape(-1)
  following = mesh.nouter
  group, member = [], []
  for v in dict.fromkeys(v for pair in pairs for v in pair):
    parts = _fans(mesh, v, cuts)
    if len(parts) < 2:
      continue
    kept = max(range(len(parts)), key=lambda k: len(parts[k]))
    for k, part in enumerate(parts):
      name = v if k == kept else following
      following += k != kept
      corner[part] = name
      group.append(v)
      member.append(name)
  return elem, np.array(group, int), np.array(member, int)


def _lines(rest: np.ndarray, pairs: list[tuple[int, int]]) -> list[np.ndarray]:
  """Returns edges that follow one another as polylines."""
  lines: list[list[int]] = []
  for a, b in pairs:
    if lines and lines[-1][-1] == a:
      lines[-1].append(b)
    else:
      lines.append([a, b])
  return [rest[line] for line in lines]
