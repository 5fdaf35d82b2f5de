"""Where the nodes lie in memory: their order, slices of eight, offsets, irregular lists."""

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from .geometry.mesh import Mesh

LANES = 8  # nodes of a slice; see core/simd.h


def pad(array: np.ndarray, fill=0) -> np.ndarray:
  """Returns `array` with its first axis padded to whole slices."""
  extra = np.full((-len(array) % LANES, *array.shape[1:]), fill, array.dtype)
  return np.concatenate([array, extra])


def to_slices(array: np.ndarray) -> np.ndarray:
  """Returns (n, ...) as (n / 8, ..., 8); n a multiple of 8."""
  split = array.reshape(len(array) // LANES, LANES, *array.shape[1:])
  return np.ascontiguousarray(np.moveaxis(split, 1, -1))


def from_slices(array: np.ndarray) -> np.ndarray:
  """Returns (n / 8, ..., 8) as (n, ...)."""
  moved = np.moveaxis(array, -1, 1)
  return moved.reshape(-1, *moved.shape[2:])


def offset(index: np.ndarray, size: int = 3) -> np.ndarray:
  """Returns where the first of the `size` components of `index` starts, in floats."""
  return (index // LANES) * size * LANES + index % LANES


def ellpack(
  row: np.ndarray, index: np.ndarray, value: np.ndarray, fill: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns the lists of all nodes as sliced ELLPACK: row k of a slice has their k-th entries.

  Args:
    row: node whose entry it is (n,)
    index: what it points at    (n,)
    value: its value            (n,)
    fill: what the entries that pad a node's list point at, with value 0 (nslice, 8)

  Returns:
    rows of each slice (nslice,), entries and values (rows, 8)
  """
  by_row = np.lexsort((index, row))
  row, index, value = row[by_row], index[by_row], value[by_row]
  count = np.bincount(row, minlength=fill.size)
  width = count.reshape(-1, LANES).max(axis=1)
  within = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
  place = (np.cumsum(width) - width)[row // LANES] + within
  entry = np.repeat(fill, width, axis=0)
  weight = np.zeros(entry.shape)
  entry[place, row % LANES] = index
  weight[place, row % LANES] = value
  return width, entry.astype(np.int32), weight.astype(np.float32)


def addresses(width: np.ndarray) -> np.ndarray:
  """Returns the first row of each slice and the number of rows, (nslice + 1,)."""
  return np.concatenate([[0], np.cumsum(width)]).astype(np.int32)


def banks(width: np.ndarray) -> np.ndarray:
  """Returns where slices of so many blocks start in memory of 32 banks, in floats, and the end.

  Four slices that follow one another, which a warp reads at once, start in banks of their own.

  Args:
    width: blocks of each slice, 72 floats each (nslice,)
  """
  best = None
  for turn in (1, 3):
    start, at = [], 0
    for s, w in enumerate(width):
      at += (turn * s - at) % 4
      start.append(at)
      at += 9 * int(w)
    if best is None or at < best[-1]:
      best = [*start, at]
  return LANES * np.array(best or [0], np.int32)


def node_order(mesh: Mesh, patch: int = 0) -> np.ndarray:
  """Returns vertices in the order of the solver, padded with -1 to whole slices.

  Spare vertices come last, and a cut changes nothing. Reverse Cuthill-McKee keeps neighbours close
  in memory, patches keep most of them in one block of threads; sorting by degree within a window
  keeps the slices full.

  Args:
    mesh: the surface
    patch: nodes of a block of threads that works on a patch of the surface, 0 for no patches
  """
  mesh = mesh.whole
  spare = np.arange(mesh.spares.start, mesh.spares.stop)
  used = np.delete(np.arange(mesh.nvert), spare)
  order = used[_patches(mesh.rest[used], patch)] if patch else _band(mesh)
  order = order[~np.isin(order, spare)]
  n = len(order)
  window = np.arange(n) // (8 * LANES)
  order = order[np.lexsort((np.arange(n), -mesh.degree[order], window))]
  return np.concatenate([order, spare, np.full(-mesh.nvert % LANES, -1)])


def _patches(point: np.ndarray, size: int) -> np.ndarray:
  """Returns points in runs of `size` close to each other: halved across their longest extent."""
  out, todo = [], [(np.arange(len(point)), size)]
  while todo:
    part, unit = todo.pop()
    if len(part) <= unit:
      unit = 8 * LANES
    if len(part) <= unit:
      out.append(part)
      continue
    half = unit * max(1, len(part) // unit // 2)
    axis = np.argmax(np.ptp(point[part], axis=0))
    part = part[np.argsort(point[part, axis], kind="stable")]
    todo += [(part[half:], unit), (part[:half], unit)]
  return np.concatenate(out)


def _band(mesh: Mesh) -> np.ndarray:
  start, k = np.nonzero(mesh.ring >= 0)
  graph = sparse.coo_matrix(
    (np.ones(len(start)), (start, mesh.ring[start, k])), shape=(mesh.nvert, mesh.nvert)
  ).tocsr()
  return csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
