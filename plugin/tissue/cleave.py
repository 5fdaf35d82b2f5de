"""Cuts in solids: a path sweeps a sheet inward, and tetrahedra on its two sides come apart.

What lies across the sheet goes to one side or the other such that the faces between the sides are
few and near the sheet: a minimal cut of the graph of tetrahedra (Boykov and Jolly 2001,
doi:10.1109/ICCV.2001.937505). The vertices of these faces are moved onto the sheet in the rest
shape, as far as no tetrahedron gets thin ("snap"), and the faces are opened ("split"; Nienhuys and
van der Stappen 2001). Tetrahedra keep their numbers and none is added.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from . import faces, settle
from .cut import Motion
from .fill import FACES
from .mesh import Mesh, among, area_vectors, distinct, lengths
from .settle import Energy
from .sheet import Sheet, Where, sweep

_WIDE = 1.5  # edges inside from the sheet within which tetrahedra are looked at
_ON = 0.02  # edges within which a vertex is on it
_FLAT = 0.05  # cost of a face on the sheet, by area; one an edge away costs 1
_LEAST = 0.3  # edges that a path is deep at least for one tetrahedron to come apart all through
_BESIDE = 0.75  # edges of the skin from the sheet within which its vertices are at the mouth
_FEWER = 0.85  # share of the faces that is tried where there is no room for all
_FINE = 1e4  # of costs as whole numbers
_MOUTH = 0.6  # edges below the path down to which an edge of the skin is at the mouth of a cut
_MUCH = 1_000_000_000


@dataclasses.dataclass(frozen=True)
class Cut:
  """What came of a path.

  Attributes:
    mesh: the solid, cut
    motion: what its vertices carry
    moved: how many vertices lie elsewhere at rest
    near: vertices that move on otherwise                          (n,)
    changed: tetrahedra that are not as they were                  (n,)
    group, member, share, seat: see `faces.Split`                  (m,)
    path: the edges on the skin that came apart at rest [m]        list of (2, 3)
    length: of these [m]
    area: of the opened faces, one of each pair, at rest [m^2]
    depth: how far they go below the skin, along the sheet, at most [m]
    deviation: greatest distance of the path's vertices from it [m]
    stopped: whether there were too few spare vertices or triangles
  """

  mesh: Mesh
  motion: Motion
  moved: int
  near: np.ndarray
  changed: np.ndarray
  group: np.ndarray
  member: np.ndarray
  share: np.ndarray
  seat: np.ndarray
  path: list[np.ndarray]
  length: float
  area: float
  depth: float
  deviation: float
  stopped: bool


def cut(
  organ: str,
  mesh: Mesh,
  motion: Motion,
  points: np.ndarray,
  pinned: np.ndarray,
  depth: float | np.ndarray | None = None,
  direction: np.ndarray | None = None,
  energy: Energy | None = None,
  given: float = 0.0,
  room: int | None = None,
) -> Cut:
  """Returns the solid cut under the path on its skin that is nearest to points.

  Args:
    organ: its name, for messages
    mesh: the solid, as `faces.faced` makes it
    motion: what its vertices carry
    points: the path, in the organ's frame [m]   (n, 3)
    pinned: vertices that do not move            (nvert,) bool
    depth: of the cut, or None, see `sheet.sweep`
    direction: in which it goes, or None, see there
    energy: of tetrahedra, which moving vertices must not raise, or None
    given: but by so much around each, since what cuts has brought it [J]
    room: triangles that there may be, None for any number

  Raises:
    ValueError: the path is off the skin or too short, goes through pinned tissue, or the depth is
      not allowed.
  """
  sheet = sweep(organ, mesh, mesh.rest + motion.disp, points, depth, direction)
  face, where = _between(mesh, sheet)
  face, made, stopped = _fitting(mesh, where, face, room)
  if made is None:
    return _nothing(mesh, motion)
  if not made.group.size and stopped:
    return _nothing(mesh, motion)
  if not made.group.size:
    raise ValueError(
      f"organ {organ!r}: no tetrahedra come apart along the path, expected a longer or deeper one, "
      "or it was cut there before"
    )
  _check(organ, mesh, face, pinned)
  vert = distinct(_corners(mesh, face))
  moves = settle.move(mesh, vert, where, sheet.path, pinned, motion.disp, (energy, given))
  made = faces.split(mesh, moves.rest, face)
  assert made is not None
  goes = _carried(mesh, made, moves, motion, pinned)
  return _told(mesh, made, goes, sheet, stopped)


def _fitting(mesh: Mesh, where: Where, face: np.ndarray, room: int | None):
  """Returns as many faces, from where the path begins, as there is room for, and what they part.

  That is None where there is no room at all.

  Returns:
    faces, what they part, and whether these are fewer for want of room
  """
  along = where.along[_corners(mesh, face)].max(axis=1, initial=0.0)
  face, stopped = face[np.argsort(along, kind="stable")], False
  while True:
    try:
      made = faces.split(mesh, mesh.rest, face)
    except faces.Crowded as crowd:  # around these it hangs together
      beside = np.isin(_corners(mesh, face), crowd.vertices).any(axis=1)
      face = face[~beside] if beside.any() else face[:0]
      continue
    if made is not None and (room is None or made.mesh.nelem <= room):
      return face, made, stopped
    if not face.size:
      return face, None, True
    face, stopped = face[: int(_FEWER * len(face))], True


def _nothing(mesh: Mesh, motion: Motion) -> Cut:
  none = np.zeros(0, int)
  whole = (none, none, none, none, np.zeros(0), none)
  return Cut(mesh, motion, 0, *whole, path=[], length=0.0, area=0.0, depth=0.0, deviation=0.0,
             stopped=True)  # fmt: skip


def _carried(mesh: Mesh, made: faces.Split, moves: settle.Moves, motion: Motion, pinned):
  """Returns what vertices carry then, how many were moved, and which move on otherwise."""
  near = distinct(mesh.tet[made.changed])
  near = near[~pinned[near]]
  disp, vel, mass = motion.disp.copy(), motion.vel.copy(), motion.mass.copy()
  for value, was in ((disp, motion.disp), (vel, motion.vel)):
    value[moves.vert] = np.einsum("nk,nkj->nj", moves.weight, was[moves.corner])
  group, member = made.group, made.member
  disp[member], vel[member] = disp[group], vel[group]
  mass[group] = 0.0
  mass[member] = made.share * motion.mass[group]
  return Motion(mass, disp, vel), len(moves.vert), near


def _corners(mesh: Mesh, face: np.ndarray) -> np.ndarray:
  """Returns the corners of faces, (n, 3)."""
  return mesh.tet.ravel()[face[:, None] // 4 * 4 + FACES[face % 4]]


def _check(organ: str, mesh: Mesh, face: np.ndarray, pinned: np.ndarray):
  held = _corners(mesh, face)
  bad = held[pinned[held]]
  if bad.size:
    raise ValueError(
      f"organ {organ!r}: the cut goes through vertex {bad[0]}, which is pinned, expected tissue "
      "that moves"
    )


def _between(mesh: Mesh, sheet: Sheet) -> tuple[np.ndarray, Where]:
  """Returns the faces that part both sides of a sheet, and where all vertices are beside it."""
  where, edge = _measured(mesh, sheet)
  off = where.off[mesh.tet]
  near = np.flatnonzero(np.isfinite(off).all(axis=1))
  off = off[near]
  low = where.deep[mesh.tet[near]].mean(axis=1)
  past = where.past[mesh.tet[near]].mean(axis=1)
  reach = float(lengths(sheet.end - sheet.begin).max())
  low = low <= 0
  if reach > _LEAST * edge:  # all around the mouth, so that it opens
    skin = mesh.whole.edge_length
    mouth = (np.abs(where.off) < _BESIDE * skin) & (where.deep + reach < _MOUTH * skin)
    mouth[mesh.nskin :] = False
    low |= mouth[mesh.tet[near]].any(axis=1)
  inside = low & (past <= 0)
  near, off = near[inside], off[inside]
  left, right = off.max(axis=1) <= _ON * edge, off.min(axis=1) >= -_ON * edge
  flat = left & right
  left, right = left & ~flat, right & ~flat
  return _parted(mesh, where, near, left, right, edge), where


def _measured(mesh: Mesh, sheet: Sheet) -> tuple[Where, float]:
  """Returns where vertices are beside a sheet, NaN for those that are not near, and an edge."""
  lines = np.concatenate([sheet.begin, sheet.end])
  skin = mesh.whole.edge_length
  low, high = lines.min(axis=0) - 3 * skin, lines.max(axis=0) + 3 * skin
  box = np.flatnonzero(((mesh.rest >= low) & (mesh.rest <= high)).all(axis=1) & (mesh.degree > 0))
  start, k = np.nonzero(mesh.ring[box] >= 0)
  edge = float(lengths(mesh.rest[mesh.ring[box][start, k]] - mesh.rest[box[start]]).mean())
  found = sheet.measure(mesh.rest[box])
  near = np.abs(found.off) < 2 * _WIDE * edge
  box = box[near]
  full = {}
  for name, value in vars(found).items():
    full[name] = np.full((mesh.nvert, *value.shape[1:]), np.nan)
    full[name][box] = value[near]
  return Where(**full), edge


def _parted(mesh: Mesh, where: Where, near, left, right, edge: float) -> np.ndarray:
  """Returns the faces between the left and right ones of tetrahedra `near`, by a minimal cut.

  Those that are neither go to one of them.
  """
  mate, free = faces.mates_now(mesh), ~(left | right)
  count = int(free.sum())
  node = np.full(len(mesh.tet), -1)
  node[near[free]] = np.arange(count)
  node[near[left]], node[near[right]] = count, count + 1
  face = (4 * near[:, None] + np.arange(4)).ravel()
  face = face[mate[face] > face]
  a, b = node[face // 4], node[mate[face] // 4]
  there = (a >= 0) & (b >= 0) & (a != b)
  face, a, b = face[there], a[there], b[there]
  vert = _corners(mesh, face)
  far = np.abs(where.off[vert]).max(axis=1) / edge
  area = lengths(area_vectors(mesh.rest, vert))
  cost = np.maximum(area / edge**2 * (_FLAT + far**2) * _FINE, 1).astype(np.int64)
  cost = np.minimum(cost, _MUCH // max(len(cost), 1))  # their sum is one of 32 bits
  size = count + 2
  ends = np.append(a, b), np.append(b, a)
  graph = sparse.csr_array((np.tile(cost, 2), ends), shape=(size, size)).astype(np.int32)
  flow = csgraph.maximum_flow(graph, count, count + 1).flow
  rest = graph - flow
  rest.data[rest.data < 0] = 0
  rest.eliminate_zeros()
  reached = csgraph.breadth_first_order(rest, count, return_predecessors=False)
  side = among(size, reached)
  return face[side[a] != side[b]]


def _told(mesh: Mesh, made: faces.Split, goes: tuple, sheet: Sheet, stopped: bool) -> Cut:
  """Returns the cut, with what is said of it."""
  new = made.mesh
  wall = new.elem[mesh.nelem :: 2]
  area = float(lengths(area_vectors(new.rest, wall)).sum())
  path, length, deviation, depth = _mouth(mesh, made, sheet)
  motion, moved, near = goes
  return Cut(
    new,
    motion,
    moved,
    near,
    made.changed,
    made.group,
    made.member,
    made.share,
    made.seat,
    path,
    length,
    area,
    depth,
    deviation,
    stopped,
  )


def _mouth(mesh: Mesh, made: faces.Split, sheet: Sheet):
  """Returns the edges of the skin that came apart, their length, how far off and how deep it is.

  An edge of a wall is at its mouth where it is one of the skin's.
  """
  new, first = made.mesh, mesh.whole.nelem
  n = new.nvert

  def keys(elem):
    ends = np.sort(np.stack([elem, elem[:, [1, 2, 0]]], axis=2).reshape(-1, 2), axis=1)
    return ends[:, 0] * n + ends[:, 1]

  wall = new.elem[mesh.nelem :: 2]
  key = np.intersect1d(keys(wall), keys(new.elem[:first]))
  ends = np.stack([key // n, key % n], axis=1)
  line = new.rest[ends]
  reach = float(lengths(sheet.end - sheet.begin).max())
  depth = min(reach, float((sheet.measure(new.rest[wall].reshape(-1, 3)).deep + reach).max()))
  # Near the path, not where the sheet comes out elsewhere.
  off = nearest_on(sheet.path, line.reshape(-1, 3)).reshape(-1, 2)
  below = sheet.measure(line.reshape(-1, 3)).deep.reshape(-1, 2) + reach
  edge = mesh.whole.edge_length
  top = (off.max(axis=1) < 1.5 * edge) & (below.max(axis=1) < _MOUTH * edge)
  deviation = float(off[top].max(initial=0.0))
  line = line[top]
  size = lengths(line[:, 1] - line[:, 0])
  return list(line), float(size.sum()), deviation, depth


def nearest_on(line: np.ndarray, points: np.ndarray) -> np.ndarray:
  """Returns the distances of points from a polyline, (n,)."""
  a, way = line[:-1], np.diff(line, axis=0)
  arm = points[:, None] - a
  t = (arm * way).sum(2) / np.maximum((way * way).sum(1), 1e-300)
  return lengths(arm - np.clip(t, 0, 1)[..., None] * way).min(axis=1, initial=np.inf)
