"""Coarser meshes of a surface for the multilevel preconditioner, and the weights between them.

A mesh is coarsened by half-edge collapses of vertices that share no edge, a round of them at once
(the vertex removal of Hoppe 1996 without attributes): a removed vertex moves onto a neighbour, the
ring around it is divided into triangles anew, and its displacement is interpolated where it lies
in them. Vertices that stay do not move, so a coarse mesh follows the deformed one by sampling it.
"""

import dataclasses
from typing import Any

import numpy as np
from scipy import sparse

from .geometry import mesh as topology
from .geometry.mesh import Mesh
from .order import LANES, addresses, ellpack, offset

COARSEST = 64  # nodes of the coarsest mesh
_RATIO = 0.25  # of the nodes, from one level to the next: edges twice as long
_QUALITY = 0.25  # least shape of a new triangle; an equilateral one has 1
_MOST_DEGREE = 10  # of a vertex that others moved onto
_ROUNDS = 12
_ENTRIES = 4  # weights of a vertex

# Condition number from which cycles take less time than the iterations of block Jacobi that they
# save, where there is bending. In warm contact steps with cycles take 1.4 times as long at 65, 1.0
# at 75, 0.9 at 110 and 0.8 at 220 on the CPU (2562 to 16,386 nodes, medians of CPU time); a cycle
# takes as long as 9 iterations there and as 15 on an H200 (`palpate bench solver`).
_THRESHOLD = {"cpu": 100.0, "cuda": 300.0}
# Nodes from which they may: what acts on one node of a small mesh reaches the others in few
# iterations. With 280 to 1025 nodes and condition numbers of 256 to 7500 block Jacobi took 2 to 6
# times the cycles, in 0.5 to 0.9 of their time; with cycles a stiff shell of 1446 nodes takes 0.6
# to 0.8 of that of block Jacobi.
_FEWEST = 1200
# Interval of the smoother, as greatest eigenvalue of D^-1 A and its ratio to the lower end, by
# degree. A membrane's is 2.3 on good meshes, at most 3 (three corners an element), and bending
# raises it to 3.4; the smoother stays a contraction up to the sum of both ends.
_INTERVAL = {2: (2.5, 6.0), 3: (3.6, 12.0)}
_BENDING = 0.1  # share of the diagonal from which bending asks for the smoother with 3 steps

# Arrays that hold node offsets (by 24 floats a slice), nodes (8 a slice) or first rows.
_OFFSETS = {"fan_node": 3 * LANES, "bend_node": LANES}
_ROWS = {"slot_adr": "fan_spring", "bend_adr": "bend_node"}
_PLAIN = (
  "fan_rest", "fan_metric", "fan_spring", "fan_width", "degree", "rest", "area", "free",
  "bend_gain", "bend_diag", "bend_width",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Coarse:
  """A coarse mesh.

  Attributes:
    mesh: the mesh
    vert: its vertices among those of the finest mesh   (nvert,)
    weight: displacement of each vertex of the next finer mesh from these, sparse (nfiner, nvert)
  """

  mesh: Mesh
  vert: np.ndarray
  weight: sparse.csr_array


def build(mesh: Mesh, least: int = COARSEST) -> list[Coarse]:
  """Returns coarser and coarser meshes, down to `least` vertices or where nothing can be removed.

  Args:
    mesh: the finest mesh
    least: vertices of the coarsest mesh
  """
  levels = []
  vert = np.arange(mesh.nvert)
  while mesh.nvert > least:
    start = mesh.nvert
    weight = sparse.csr_array(sparse.eye_array(start))
    for _ in range(_ROUNDS):
      if mesh.nvert <= max(_RATIO * start, least):
        break
      removed = mesh.nvert
      mesh, keep, step = _round(mesh, int(max(_RATIO * start, least)))
      vert = vert[keep]
      weight = sparse.csr_array(weight @ step)
      if mesh.nvert > 0.97 * removed:
        break
    if mesh.nvert > 0.7 * start:
      break
    levels.append(Coarse(mesh, vert, _prune(weight)))
  return levels


def _round(mesh: Mesh, target: int) -> tuple[Mesh, np.ndarray, sparse.csr_array]:
  """Returns the mesh after one round, the vertices kept, and the weights (nvert, nkept)."""
  nvert, rest, ring, degree = mesh.nvert, mesh.rest, mesh.ring, mesh.degree
  own = np.arange(nvert)
  closed = mesh.ring_elem[own, degree - 1] >= 0
  area = topology.vertex_areas(rest, mesh.elem)
  key = area * np.random.RandomState(0).uniform(0.9, 1.1, nvert)
  chosen = _independent(ring, key, closed & (degree <= 8) & (degree >= 3))
  chosen = chosen[np.argsort(key[chosen], kind="stable")]
  onto, triangle, weight = _collapse(mesh, chosen)
  ok = onto >= 0
  chosen, onto, triangle, weight = chosen[ok], onto[ok], triangle[ok], weight[ok]
  # Two collapses must not make the same edge, nor one vertex the centre of too many.
  first = np.ones(len(chosen), bool)
  added = _new_edges(mesh, chosen, onto)
  flat = added.ravel()
  which = np.repeat(np.arange(len(chosen)), added.shape[1])[flat >= 0]
  _, where, inverse = np.unique(flat[flat >= 0], return_index=True, return_inverse=True)
  first[which[np.arange(len(which)) != where[inverse]]] = False
  chosen, onto, triangle, weight = chosen[first], onto[first], triangle[first], weight[first]
  order = np.argsort(onto, kind="stable")
  begin = np.searchsorted(onto[order], onto[order])
  grown = np.cumsum(degree[chosen[order]] - 4)
  before = np.where(begin > 0, grown[begin - 1], 0)
  fits = np.zeros(len(chosen), bool)
  fits[order] = degree[onto[order]] + grown - before <= _MOST_DEGREE
  fits = np.flatnonzero(fits)[: nvert - target]
  chosen, onto, triangle, weight = chosen[fits], onto[fits], triangle[fits], weight[fits]

  keep = np.ones(nvert, bool)
  keep[chosen] = False
  moved = own.copy()
  moved[chosen] = onto
  elem = moved[mesh.elem]
  elem = elem[(elem != elem[:, [1, 2, 0]]).all(axis=1)]
  number = np.cumsum(keep) - 1
  kept = np.flatnonzero(keep)
  row = np.concatenate([kept, np.repeat(chosen, 3)])
  col = number[np.concatenate([kept, triangle.ravel()])]
  value = np.concatenate([np.ones(len(kept)), weight.ravel()])
  step = sparse.csr_array((value, (row, col)), shape=(nvert, len(kept)))
  step.eliminate_zeros()
  return topology.build("coarse", rest[kept], number[elem]), kept, step


def _independent(ring: np.ndarray, key: np.ndarray, allowed: np.ndarray) -> np.ndarray:
  """Returns vertices without common edges, of small keys (Luby 1986, doi:10.1137/0215074)."""
  state = np.where(allowed, 0, -1)  # 0 undecided, 1 chosen, -1 out
  neighbour = np.where(ring >= 0, ring, len(key))
  for _ in range(8):
    value = np.append(np.where(state == 0, key, np.inf), np.inf)
    best = (state == 0) & (value[:-1] < value[neighbour].min(axis=1))
    if not best.any():
      break
    state[best] = 1
    near = neighbour[best].ravel()
    near = near[near < len(key)]
    state[near] = np.where(state[near] == 0, -1, state[near])
  return np.flatnonzero(state == 1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
  return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _shape(a: np.ndarray, b: np.ndarray, c: np.ndarray, normal: np.ndarray) -> np.ndarray:
  """Returns the shape of triangles, 1 for an equilateral one, -1 where turned from `normal`.

  Vectors are (3, n) here and in `_collapse`: numpy is slow on short last axes.
  """
  u, v, w = b - a, c - a, c - b
  area = _cross(u, v)
  size = np.sqrt(_dot(area, area))
  length2 = np.maximum(_dot(u, u) + _dot(v, v) + _dot(w, w), 1e-300)
  return np.where(_dot(area, normal) > 0.5 * size, 2 * np.sqrt(3) * size / length2, -1)


def _collapse(mesh: Mesh, vert: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns where each vertex moves to, -1 if nowhere, and where it lies in the new triangles.

  Args:
    mesh: the mesh
    vert: vertices with a closed fan, (n,)
  """
  n, degree, most = len(vert), mesh.degree[vert], int(mesh.degree[vert].max(initial=3))
  ring = mesh.ring[vert, :most].T  # (most, n)
  rest = np.ascontiguousarray(mesh.rest.T)
  at = rest[:, np.where(ring >= 0, ring, vert)] - rest[:, None, vert]  # (3, most, n)
  index = np.arange(most)[:, None]
  after = np.where(index + 1 == degree, 0, np.minimum(index + 1, most - 1))
  row = np.arange(n)
  following, beyond = ring[after, row], at[:, after, row]
  valid = ring >= 0
  normal = np.where(valid, _cross(at, beyond), 0).sum(axis=1)
  normal /= np.maximum(np.sqrt(_dot(normal, normal)), 1e-300)
  edges = np.sort(np.stack([mesh.elem.ravel(), mesh.elem[:, [1, 2, 0]].ravel()]), axis=0)
  edges = np.unique(edges[0] * mesh.nvert + edges[1])
  best = np.full(n, _QUALITY)
  onto = np.full(n, -1)
  choice = np.zeros(n, np.int64)
  for j in range(most):
    quality = np.where(valid[j], np.inf, -np.inf)
    for i in range(most):
      use = valid[i] & (i != j) & (after[i] != j)
      shape = _shape(at[:, j], at[:, i], beyond[:, i], normal)
      quality = np.where(use, np.minimum(quality, shape), quality)
    better = np.flatnonzero(quality > best)
    # The link condition: no new edge may be there already.
    free = np.ones(len(better), bool)
    for i in range(most):
      use = valid[i] & (i != j) & (after[i] != j) & (after[j] != i)
      low, high = np.minimum(ring[j], ring[i])[better], np.maximum(ring[j], ring[i])[better]
      code = low * mesh.nvert + high
      found = edges[np.minimum(np.searchsorted(edges, code), len(edges) - 1)] == code
      free &= ~(use[better] & found)
    better = better[free]
    best[better], onto[better], choice[better] = quality[better], ring[j, better], j
  # Barycentric coordinates in the triangle that holds the vertex best; it is the origin here.
  triangle = np.zeros((3, n), np.int64)
  weight = np.zeros((3, n))
  inside = np.full(n, -np.inf)
  centre, target = at[:, choice, row], ring[choice, row]
  for i in range(most):
    use = (onto >= 0) & valid[i] & (i != choice) & (after[i] != choice)
    corner = (centre, at[:, i], beyond[:, i])
    share = np.stack([_dot(_cross(corner[k - 2], corner[k - 1]), normal) for k in range(3)])
    total = share.sum(axis=0)
    share /= np.where(total != 0, total, 1)
    least = share.min(axis=0)
    better = use & (total > 0) & (least > inside)
    inside = np.where(better, least, inside)
    weight = np.where(better, share, weight)
    triangle = np.where(better, np.stack([target, ring[i], following[i]]), triangle)
  onto = np.where(np.isfinite(inside), onto, -1)
  weight = np.maximum(weight, 0)
  weight /= np.maximum(weight.sum(axis=0), 1e-300)
  return onto, triangle.T, weight.T


def _new_edges(mesh: Mesh, vert: np.ndarray, onto: np.ndarray) -> np.ndarray:
  """Returns codes of the edges that the collapses make, -1 for none, (n, most)."""
  ring = mesh.ring[vert]
  most = ring.shape[1]
  j = np.argmax(ring == onto[:, None], axis=1)
  degree = mesh.degree[vert]
  index = np.arange(most)
  gap = (index - j[:, None]) % degree[:, None]
  use = (ring >= 0) & (gap > 1) & (gap < degree[:, None] - 1)
  low, high = np.minimum(ring, onto[:, None]), np.maximum(ring, onto[:, None])
  return np.where(use, low * mesh.nvert + high, -1)


def _prune(weight: sparse.csr_array) -> sparse.csr_array:
  """Returns `weight` with the largest entries of each row, scaled to the same sum."""
  begin, data = np.asarray(weight.indptr), np.asarray(weight.data)
  row = np.repeat(np.arange(len(begin) - 1), np.diff(begin))
  order = np.lexsort((np.negative(data), row))
  keep = order[np.arange(len(row)) - begin[row] < _ENTRIES]
  row, col, value = row[keep], np.asarray(weight.indices)[keep], data[keep]
  value = value / np.bincount(row, value, len(begin) - 1)[row]
  return sparse.csr_array((value, (row, col)), shape=weight.shape)


def join(parts: list[dict[str, Any]]) -> dict[str, Any]:
  """Returns the fields of meshes as those of one surface, slice after slice.

  Elements and hinges are left out: the matrix needs none of them.

  Args:
    parts: fields of each mesh, see `shape.arrays`
  """
  nslice = [len(part["area"]) for part in parts]
  first = np.concatenate([[0], np.cumsum(nslice)])
  out = {name: np.concatenate([part[name] for part in parts]) for name in _PLAIN}
  for name, stride in _OFFSETS.items():
    out[name] = np.concatenate(
      [part[name] + stride * start for part, start in zip(parts, first, strict=False)]
    )
  for name, rows in _ROWS.items():
    begin = np.concatenate([[0], np.cumsum([len(part[rows]) for part in parts])])
    moved = [part[name][:-1] + start for part, start in zip(parts, begin, strict=False)]
    out[name] = np.concatenate([*moved, begin[-1:]]).astype(np.int32)
  out["vert"] = np.concatenate([part["vert"] for part in parts])
  out["node"] = np.concatenate(
    [part["node"] + LANES * start for part, start in zip(parts, first, strict=False)]
  )
  for name in ("fan_corner", "fan_side"):
    out[name] = np.zeros((len(out["fan_metric"]), LANES), np.int32)
  for name, value in parts[0].items():
    if name not in out and isinstance(value, np.ndarray) and name != "number":
      out[name] = np.zeros((min(1, len(value)), *value.shape[1:]), value.dtype)
  names = ("closed", "unheld", "stride", "volume0", "shortest", "number")
  common = {name: parts[0][name] for name in names}
  return out | common


def stiffness(part: dict) -> tuple[float, float]:
  """Returns the mean stiffness of a node along one axis and that of bending [N/m].

  The springs that stand for the edges have a third of their trace along an axis.
  """
  slices = np.repeat(np.arange(len(part["area"])), np.diff(part["slot_adr"]))
  total = np.zeros_like(part["area"], np.float64)
  np.add.at(total, slices, part["fan_spring"])
  real = np.maximum((part["vert"] >= 0).sum(), 1)
  return float(total.sum() / 3 / real), float(part["bend_diag"].sum() / real)


def threshold(device) -> float:
  """Returns the condition number from which cycles pay on a Warp device."""
  return _THRESHOLD["cuda" if device.is_cuda else "cpu"]


def pay(part: dict, scale: float, threshold: float) -> bool:
  """Returns whether cycles take less time than block Jacobi at the time step of `scale`.

  Not on a small mesh. Not on a membrane: contact moves it where it is touched, and block Jacobi
  takes about ten times the cycles, warm half of that, from 678 to 262,146 nodes and from 3 kPa to
  3 MPa, while a cycle takes as long as eight iterations and more.

  Args:
    part: fields of the mesh, see `shape.arrays`
    scale: (h^2 + h damping) over the mean mass of a node [s^2/kg]
    threshold: condition number from which they do
  """
  if (part["vert"] >= 0).sum() < _FEWEST:
    return False
  membrane, bend = stiffness(part)
  return bend > _BENDING * membrane and scale * (membrane + bend) >= threshold


def transfer(
  coarse: list[Coarse], parts: list[dict[str, Any]], pinned: list[np.ndarray], device
) -> dict[str, Any]:
  """Returns the fields of `Transfer`.

  Args:
    coarse: the coarse meshes
    parts: fields of the finest mesh and of these
    pinned: vertices that do not move, of each mesh
    device: Warp device
  """
  nslice = [len(part["area"]) for part in parts]
  first = np.concatenate([[0], np.cumsum(nslice[1:])])  # of each coarse level
  source = np.zeros((first[-1], LANES), np.int32)
  share = np.zeros((first[-1], LANES), np.float32)
  count = np.ones(len(parts[0]["node"]))
  down, up = [], []
  for k, level in enumerate(coarse):
    node = parts[k + 1]["node"]  # within the level
    count = level.weight.T @ count
    flat = slice(first[k] * LANES, first[k + 1] * LANES)
    source.reshape(-1)[flat][node] = offset(parts[0]["node"][level.vert])
    share.reshape(-1)[flat][node] = count
    weight = level.weight.tocoo()
    keep = ~pinned[k][weight.row] & ~pinned[k + 1][weight.col]
    fine, value = parts[k]["node"][weight.row[keep]], weight.data[keep]
    own = node[weight.col[keep]]
    begin = LANES * (first[k - 1] if k else 0)
    down.append(_lists(own, offset(fine + begin), value, nslice[k + 1]))
    up.append(_lists(fine, offset(own + LANES * first[k]), value, nslice[k]))
  none = np.zeros(0, np.int64)
  up.append(_lists(none, none, none, nslice[-1]))
  out: dict[str, Any] = {"source": source, "share": share, "slice_adr": first.astype(np.int32)}
  for name, lists in (("down", down), ("up", up)):
    out[f"{name}_adr"] = addresses(np.concatenate([width for width, _, _ in lists]))
    out[f"{name}_node"] = np.concatenate([index for _, index, _ in lists])
    out[f"{name}_weight"] = np.concatenate([value for _, _, value in lists])
  return out | {
    "nlevel": len(coarse),
    "nodes": int((~pinned[0]).sum()),
    "threshold": threshold(device),
    "rate": _rates(parts),
  }


def _lists(row: np.ndarray, index: np.ndarray, value: np.ndarray, nslice: int):
  return ellpack(row, index, value, np.zeros((nslice, LANES), np.int64))


def _rates(parts: list[dict[str, Any]]) -> np.ndarray:
  """Returns `Transfer.rate` of the meshes, the finest first."""
  count = [(part["vert"] >= 0).sum() for part in parts]
  out = np.zeros((len(parts), 5))
  for row, part, n in zip(out, parts, count, strict=True):
    membrane, bend = stiffness(part)
    degree = 3 if bend > _BENDING * membrane else 2
    high, ratio = _INTERVAL[degree]
    row[:] = membrane + bend, high, high / ratio, degree, count[0] / n
  return out


def young(values: np.ndarray, mesh, coarse: list[Coarse]) -> list[tuple[float, ...]]:
  """Returns Young's modulus of the elements of each coarse mesh, `values` being those of `mesh`."""
  out = []
  at = np.bincount(mesh.elem.ravel(), np.repeat(values, 3), mesh.nvert) / np.bincount(
    mesh.elem.ravel(), minlength=mesh.nvert
  )
  for level in coarse:
    total = level.weight.T @ np.ones(len(at))
    at = (level.weight.T @ at) / np.where(total > 0, total, 1)
    out.append(tuple(at[level.mesh.elem].mean(axis=1)))
  return out
