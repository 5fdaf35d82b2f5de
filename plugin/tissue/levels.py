"""Arrays of the multilevel preconditioner: coarse meshes one after the other, weights between."""

from __future__ import annotations

import numpy as np

from .hierarchy import Coarse
from .simd import LANES

# Condition number from which cycles take less time than the iterations of block Jacobi that they
# save, where there is bending. In warm contact steps with cycles take 1.4 times as long at 65, 1.0
# at 75, 0.9 at 110 and 0.8 at 220 on the CPU (2562 to 16,386 nodes, medians of CPU time); a cycle
# takes as long as 9 iterations there and as 15 on an H200 (benchmarks/solver.py).
_THRESHOLD = {"cpu": 100.0, "cuda": 300.0}
# Interval of the smoother, as greatest eigenvalue of D^-1 A and its ratio to the lower end, by
# degree. A membrane's is 2.3 on good meshes, at most 3 (three corners an element), and bending
# raises it to 3.4; the smoother stays a contraction up to the sum of both ends.
_INTERVAL = {2: (2.5, 6.0), 3: (3.6, 12.0)}
_BENDING = 0.1  # share of the diagonal from which bending asks for the smoother with 3 steps

# Arrays that hold node offsets (by 24 floats a slice), nodes (8 a slice) or first rows.
_OFFSETS = {"fan_node": 3 * LANES, "bend_node": LANES}
_ROWS = {"slot_adr": "fan_spring", "bend_adr": "bend_node"}
_PLAIN = (
  "fan_rest",
  "fan_metric",
  "fan_spring",
  "degree",
  "rest",
  "area",
  "free",
  "bend_gain",
  "bend_diag",
)


def join(parts: list[dict]) -> dict:
  """Returns the arrays of meshes as those of one surface, slice after slice.

  Elements and hinges are left out: the matrix needs none of them.

  Args:
    parts: arrays of each mesh, see `surface.arrays`
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
  rows = len(out["fan_metric"])
  for name in ("fan_corner", "fan_side"):
    out[name] = np.zeros((rows, LANES), np.int32)
  for name, array in parts[0].items():
    if name not in out:  # of elements and hinges
      out[name] = np.zeros((min(1, len(array)), *array.shape[1:]), array.dtype)
  return out


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

  Not on a membrane: contact moves it where it is touched, and block Jacobi takes at most ten times
  the cycles, warm half of that, from 678 to 262,146 nodes and from 3 kPa to 3 MPa
  (benchmarks/preconditioner.py), while a cycle takes as long as eight iterations and more.

  Args:
    part: arrays of the mesh, see `surface.arrays`
    scale: (h^2 + h damping) over the mean mass of a node [s^2/kg]
    threshold: condition number from which they do
  """
  membrane, bend = stiffness(part)
  return bend > _BENDING * membrane and scale * (membrane + bend) >= threshold


def rates(parts: list[dict]) -> np.ndarray:
  """Returns `Levels.rate` of the meshes, the finest first."""
  count = [(part["vert"] >= 0).sum() for part in parts]
  out = np.zeros((len(parts), 5))
  for row, part, n in zip(out, parts, count, strict=True):
    membrane, bend = stiffness(part)
    degree = 3 if bend > _BENDING * membrane else 2
    high, ratio = _INTERVAL[degree]
    row[:] = membrane + bend, high, high / ratio, degree, count[0] / n
  return out


def transfer(coarse: list[Coarse], parts: list[dict], pinned: list[np.ndarray]) -> dict:
  """Returns the arrays of `Levels` that carry residuals down and corrections up.

  Args:
    coarse: the coarse meshes
    parts: arrays of the finest mesh and of these
    pinned: vertices that do not move, of each mesh
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
    source.reshape(-1)[flat][node] = _offset(parts[0]["node"][level.vert])
    share.reshape(-1)[flat][node] = count
    weight = level.weight.tocoo()
    keep = ~pinned[k][weight.row] & ~pinned[k + 1][weight.col]
    fine, value = parts[k]["node"][weight.row[keep]], weight.data[keep]
    own = node[weight.col[keep]]
    begin = LANES * (first[k - 1] if k else 0)
    down.append(_ellpack(own, _offset(fine + begin), value, nslice[k + 1]))
    up.append(_ellpack(fine, _offset(own + LANES * first[k]), value, nslice[k]))
  none = np.zeros(0, np.int64)
  up.append(_ellpack(none, none, none, nslice[-1]))
  out = {"source": source, "share": share, "slice_adr": first.astype(np.int32)}
  for name, lists in (("down", down), ("up", up)):
    size = np.concatenate([width for width, _, _ in lists])
    out[f"{name}_adr"] = np.concatenate([[0], np.cumsum(size)]).astype(np.int32)
    out[f"{name}_node"] = np.concatenate([index for _, index, _ in lists])
    out[f"{name}_weight"] = np.concatenate([value for _, _, value in lists])
  return out


def _offset(node: np.ndarray) -> np.ndarray:
  return (node // LANES) * 3 * LANES + node % LANES


def _ellpack(row: np.ndarray, index: np.ndarray, value: np.ndarray, nslice: int):
  """Returns widths (nslice,), entries and values (rows, 8) of lists of nodes `row`."""
  order = np.lexsort((index, row))
  row, index, value = row[order], index[order], value[order]
  count = np.bincount(row, minlength=nslice * LANES)
  width = count.reshape(nslice, LANES).max(axis=1)
  within = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
  place = (np.cumsum(width) - width)[row // LANES] + within
  entry = np.zeros((width.sum(), LANES), np.int32)
  weight = np.zeros((width.sum(), LANES), np.float32)
  entry[place, row % LANES] = index
  weight[place, row % LANES] = value
  return width, entry, weight


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
