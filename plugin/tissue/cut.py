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

from . import mesh as topology
from . import path as paths
from .mesh import Mesh

_SHAPE = 0.3  # least shape of a triangle that is moved, or so much of what it had; equilateral: 1
_KEEP = 0.9
_TURN = 0.95  # least cosine between a triangle's normals before and after
_CORNER = -0.8  # greatest cosine between the boundary's edges at a vertex that may slide on it
_TRIES = 10
_RISE = 1.01  # times its energy that the tissue around a vertex may have when it was moved
_LESS = 0.7


# Energy of triangles [J], (n,), from their corners at rest and the displacements of these,
# (n, 3, 3) each, and their numbers (n,).
Energy = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

# Energy of springs that hold vertices [J], (n,), from these (n,) and the changes of their
# displacements (n, 3).
Held = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Cut:
  """What came of a path.

  Attributes:
    mesh: the mesh, cut
    changed: triangles that are not as they were                        (n,)
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
  changed: np.ndarray
  moved: np.ndarray
  corner: np.ndarray
  weight: np.ndarray
  group: np.ndarray
  member: np.ndarray
  path: list[np.ndarray]
  length: float
  deviation: float
  stopped: bool


def cut(
  organ: str,
  mesh: Mesh,
  position: np.ndarray,
  points: np.ndarray,
  pinned: np.ndarray,
  energy: Energy | None = None,
  held: Held | None = None,
  given: float = 0.0,
) -> Cut:
  """Returns the mesh cut along the path on the surface that is nearest to points.

  Args:
    organ: its name, for messages
    mesh: the surface
    position: where its vertices are now [m]     (nvert, 3)
    points: the path, in the same frame [m]      (n, 3)
    pinned: vertices that do not move            (nvert,) bool
    energy: of triangles, which moving vertices must not raise, or None
    held: that of what holds vertices, for which the same is true, or None
    given: but by so much around each, since what cuts has brought it [J]

  Raises:
    ValueError: points are off the surface; the path goes through pinned vertices, or is too short.
  """
  edge = mesh.whole.edge_length
  runs = paths.trace(organ, mesh, position, points, edge)
  for run in runs:
    if not run.open:
      run.chain = paths.chain(mesh, run, edge)
  _check(organ, mesh, runs, pinned)
  edges, stopped = _room(mesh, [pair for run in runs for pair in _uncut(mesh, run.chain)])
  there = {v for pair in edges for v in pair}
  moved, corner, weight = _snap(mesh, runs, pinned, position, (energy, held, given), there)
  rest = mesh.rest.copy()
  rest[moved] = np.einsum("nk,nkj->nj", weight, mesh.rest[corner])
  elem, group, member = _split(mesh, edges)
  rest[member] = rest[group]
  near = topology.around(mesh, topology.distinct(np.array(list(there), int), moved))
  new, changed = topology.recut(mesh, rest, elem, mesh.loose, near)
  if any(_may_separate(run, group) for run in runs):
    new = topology.come_loose(new)
  path = _lines(rest, edges)
  cut_chains = [(run, [v for v in run.chain if v in there]) for run in runs]
  far = [paths.distance(run.at, rest[chain])[0].max() for run, chain in cut_chains if chain]
  length = sum(float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum()) for line in path)
  deviation = float(max(far, default=0.0))
  return Cut(new, changed, moved, corner, weight, group, member, path, length, deviation, stopped)


def _ends_on_rim(mesh: Mesh, chain: list[int]) -> bool:
  if len(chain) != 2:
    return False
  return any(_is_on_rim(mesh, v) for v in chain) and _is_inner(mesh, *chain)


def _is_on_rim(mesh: Mesh, vert: int) -> bool:
  return bool(mesh.ring_elem[vert, mesh.degree[vert] - 1] < 0)


def _check(organ: str, mesh: Mesh, runs: list[paths.Run], pinned: np.ndarray):
  # One edge is enough where it ends on a boundary, or at the end of an older cut.
  if not any(
    run.open or len(run.chain) > 2 or _ends_on_rim(mesh, run.chain) for run in runs
  ):
    raise ValueError(
      f"organ {organ!r}: the path is shorter than two edges of the mesh there, expected a longer "
      "one"
    )
  for run in runs:
    split = run.chain if run.closes else run.chain[1:-1]
    split = [*split, *(v for v in run.chain[:1] + run.chain[-1:] if _is_on_rim(mesh, v))]
    bad = [v for v in split if pinned[v]]
    if bad:
      raise ValueError(
        f"organ {organ!r}: the path goes through vertex {bad[0]}, which is pinned, expected tissue "
        "that moves"
      )


# Snapping.


def _snap(
  mesh: Mesh, runs: list[paths.Run], pinned, position, energies: tuple, there: set[int]
):
  """Returns vertices that move at rest, and where they lie: corners of a triangle and weights.

  Those of the runs that are `there`.
  """
  vert, goal = [np.zeros(0, int)], [np.zeros((0, 3))]
  for run in runs:
    chain = np.array(run.chain, int)
    if not len(chain):
      continue
    at = paths.distance(run.at, mesh.rest[chain])[1]
    if not run.closes:
      at[0], at[-1] = run.at[0], run.at[-1]
    vert.append(chain)
    goal.append(at)
  vert, first = np.unique(np.concatenate(vert), return_index=True)
  goal = np.concatenate(goal)[first]
  goal, free = _on_rim(mesh, vert, goal)
  free &= ~pinned[vert] & topology.among(mesh.nvert, list(there))[vert]
  vert, goal = vert[free], goal[free]
  around = mesh.ring_elem[vert]
  elem = np.where(around >= 0, around, around[:, :1]) // 3
  corner = mesh.rest[mesh.elem[elem]]
  weight, far = paths.closest(goal[:, None], corner[:, :, 0], corner[:, :, 1], corner[:, :, 2])
  best, row = np.argmin(far, axis=1), np.arange(len(vert))
  elem, weight = elem[row, best], weight[row, best]
  own = (mesh.elem[elem] == vert[:, None]).astype(float)
  u = position - mesh.rest
  weight = own + _shares(mesh, vert, elem, weight, u, energies)[:, None] * (weight - own)
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
  slid = here + np.where(
    side[:, None] == 0, along[0][:, None] * units[0], along[1][:, None] * units[1]
  )
  return np.where(rim[:, None], slid, goal), free


def _shares(mesh: Mesh, vert, elem, weight, u: np.ndarray, energies: tuple) -> np.ndarray:
  """Returns how far of its way each vertex goes, (n,).

  So far that no triangle gets thin or turns, and that the energy around none rises: a vertex gets
  the displacement of where it goes to, and an uneven strain is another one after it.
  """
  energy, held, given = energies
  tri = topology.around(mesh, vert)
  own, corner = np.unique(mesh.elem[tri], return_inverse=True)
  corner = corner.reshape(-1, 3)
  number = np.searchsorted(own, vert)
  rest0, u0 = mesh.rest[own], u[own]
  before = rest0[corner]
  normal, shape = _form(before)
  least = np.minimum(_SHAPE, _KEEP * shape)
  way, lead = (
    np.einsum("nk,nkj->nj", weight, values[mesh.elem[elem]]) - values[vert]
    for values in (mesh.rest, u)
  )
  had = np.zeros(0) if energy is None else energy(before, u0[corner], tri)
  share = np.ones(len(vert))
  mover = np.full(len(own), -1)
  mover[number] = np.arange(len(vert))
  who = mover[corner]
  for k in range(_TRIES + 1):
    rest = rest0.copy()
    rest[number] += share[:, None] * way
    turned, now = _form(rest[corner])
    bad = (now < least) | ((turned * normal).sum(1) < _TURN)
    less = topology.distinct(who[bad])
    if energy is not None:
      moved, fine = u0.copy(), ~bad
      moved[number] += share[:, None] * lead
      has = had.copy()
      has[fine] = energy(rest[corner[fine]], moved[corner[fine]], tri[fine])
      old, new = (
        np.bincount(who.ravel() + 1, np.repeat(e, 3), len(vert) + 1)[1:] for e in (had, has)
      )
      if held is not None:
        old, new = old + held(vert, 0 * lead), new + held(vert, share[:, None] * lead)
      less = topology.distinct(less, np.flatnonzero(new > _RISE * old + given))
    less = less[less >= 0]
    if not less.size:
      break
    share[less] *= _LESS if k + 1 < _TRIES else 0.0
  return share


def _form(corner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns unit normals and shapes of triangles (n, 3, 3); an equilateral one has shape 1."""
  a, b, c = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 1], corner[:, 0] - corner[:, 2]
  area = topology.cross(a, -c)
  size = topology.lengths(area)
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


def _may_separate(run: paths.Run, group: np.ndarray) -> bool:
  """Returns whether a cut along a run may make two pieces: not where an end of it is inside."""
  ends = {run.chain[0], run.chain[-1]} if run.chain else {-1}
  return run.closes or ends <= set(group.tolist())


def _uncut(mesh: Mesh, chain: list[int]) -> list[tuple[int, int]]:
  """Returns the edges of a chain that have tissue on both sides.

  Where it goes along an older cut, single edges between are not a way into the tissue.
  """
  pairs = paths.pairs(chain)
  inner = [_is_inner(mesh, *pair) for pair in pairs]
  if all(inner):
    return pairs
  beside = [False, *inner, False]
  return [p for k, p in enumerate(pairs) if inner[k] and (beside[k] or beside[k + 2])]


def _is_inner(mesh: Mesh, a: int, b: int) -> bool:
  """Returns whether an edge has a triangle on both sides."""
  halves = mesh.ring_elem[a][mesh.ring[a] == b]
  return bool(len(halves) and halves[0] >= 0 and mesh.twin[halves[0]] >= 0)


def _room(mesh: Mesh, pairs: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], bool]:
  """Returns as many of the edges, from the first one, as there are spare vertices for."""
  left = mesh.nvert - mesh.nouter
  count = len(pairs)
  while count:
    cuts = {(min(p), max(p)) for p in pairs[:count]}
    verts = dict.fromkeys(v for pair in pairs[:count] for v in pair)
    need = sum(len(_fans(mesh, v, cuts)) - 1 for v in verts)
    if not need:  # nothing comes apart: it was cut already, or there is no room at all
      return [], count < len(pairs)
    if need <= left:
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
