"""Writes what a cut has changed into the arrays of a body, in place: recorded graphs go on.

Numbers of triangles, hinges and nodes stay, and rows have room (`rows.room`): so only what has a
triangle near the cut is computed anew, by the functions that made it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from . import config as configuration
from . import mesh as topology
from . import plate, rows, shape, step
from .body import Body
from .config import Config
from .mesh import Mesh
from .order import LANES


class Refill:
  """The arrays of a body that has room for cuts, on the host.

  Args:
    body: the body, with a `Shape` and a `Tissue` of its own
    mesh: what its arrays are of
  """

  def __init__(self, body: Body, mesh: Mesh):
    self._body = body
    self.mesh = mesh
    self._node = body.shape.node.numpy()
    self._start = body.shape.slot_adr.numpy()
    self._bend = body.shape.bend_adr.numpy()

  def _array(self, name: str) -> Any:
    return getattr(self._body.shape if hasattr(self._body.shape, name) else self._body.tissue, name)

  def write(self, mesh: Mesh, touched: np.ndarray, config: Config, pinned: np.ndarray):
    """Makes the body that of another mesh.

    Args:
      mesh: of the same whole
      touched: vertices of triangles that are not as in the mesh so far
      config: configuration in force
      pinned: vertices that do not move, (nvert,) bool

    Raises:
      ValueError: the bending matrix has no room; nothing has changed then.
    """
    if not touched.size:
      return
    changed: dict[str, tuple] = self._fans(mesh, touched, config, pinned)
    if self._body.has_bending:
      changed |= self._plate(mesh, touched, config)
    for name, puts in changed.items():
      array = self._array(name)
      host = array.numpy()  # on the CPU the array itself
      for where, values in puts:
        host[where] = values
      if array.device.is_cuda:
        array.assign(host)
    self.mesh = mesh
    shape.renumber(self._body, config, mesh.closed)
    if self._body.levels is not None:
      shape.rerate(self._body.levels, mesh)
    step.calibrate(self._body)

  def _fans(self, mesh: Mesh, touched: np.ndarray, config: Config, pinned: np.ndarray):
    own = self._node[touched]
    s, lane = own // LANES, own % LANES
    width = np.diff(self._start)[s]
    dense = rows.fans(mesh, config, touched, own, self._node, int(width.max()))
    out = {}
    for name, extra in rows.EXTRA.items():
      first = self._start[s] + extra * s
      k = np.arange(width.max() + extra)
      i, k = np.nonzero(k < (width + extra)[:, None])
      at = first[i] + k
      out[name] = [(_lane(at, lane[i], dense[name].ndim), dense[name][i, k])]
    for name in ("degree", "rest"):
      out[name] = [(_lane(s, lane, dense[name].ndim + 1), dense[name])]
    out["free"] = [((s, lane), np.where(pinned | mesh.unused, 0.0, 1.0)[touched])]
    which = touched
    if self.mesh.loose is not mesh.loose:  # all that has come free of the foundation
      which = np.arange(mesh.nvert)
    own = self._node[which]
    out["area"] = [((own // LANES, own % LANES), topology.areas_of(mesh, which, held=True))]
    return out

  def _plate(self, mesh: Mesh, touched: np.ndarray, config: Config):
    old, most = self.mesh, self._body.shape.nhingeslice * LANES
    near = _around(old, touched) | _around(mesh, touched)
    near |= _beside(old, near) | _beside(mesh, near)
    vert = np.unique(np.concatenate([_patch(old, near), _patch(mesh, near)]))
    which = _around(mesh, vert)
    which = np.flatnonzero(which | _beside(mesh, which))
    rigidity = configuration.rigidity(config, mesh.nelem)
    hinge = plate.hinges(mesh, rigidity, config.poisson, which)
    number, none = rows.numbers(mesh, hinge.half), len(mesh.whole.interior)
    assert none < most
    out = self._rows(mesh, hinge, vert)
    every = np.full(3 * mesh.nelem, -1)
    every[3 * which[:, None] + np.arange(3)] = np.where(
      hinge.of_elem >= 0, number[hinge.of_elem], -1
    )
    elem = np.flatnonzero(near)
    dense = rows.elements(mesh, elem, self._node, every.reshape(-1, 3)[elem], none)
    for name, values in dense.items():
      out[name] = [(_lane(elem // LANES, elem % LANES, values.ndim + 1), values)]
    dense = rows.hinges(mesh, hinge, self._node, number)
    mine = near[hinge.elem].any(axis=1)
    gone = np.setdiff1d(self._numbers(near), number[mine])
    for name, values in dense.items():
      at, off = number[mine], gone
      out[name] = [
        (_lane(at // LANES, at % LANES, values.ndim + 1), values[mine]),
        (_lane(off // LANES, off % LANES, values.ndim + 1), 0),
      ]
    return out

  def _numbers(self, near: np.ndarray) -> np.ndarray:
    """Returns the numbers of all hinges that triangles had before the first cut."""
    whole = self.mesh.whole
    half = 3 * np.flatnonzero(near)[:, None] + np.arange(3)
    other = whole.twin[half]
    half = np.unique(np.minimum(half, other)[other >= 0])
    return np.searchsorted(whole.interior, half)

  def _rows(self, mesh: Mesh, hinge: plate.Hinges, vert: np.ndarray):
    """Returns rows of the bending matrix."""
    coo = rows.matrix(mesh, hinge)
    mine = np.zeros(mesh.nvert, bool)
    mine[vert] = True
    keep = mine[coo.row]
    row, col, value = self._node[coo.row[keep]], self._node[coo.col[keep]], coo.data[keep]
    order = np.lexsort((col, row))
    row, col, value = row[order], col[order], value[order]
    own = self._node[vert]
    s, lane = own // LANES, own % LANES
    width = np.diff(self._bend)[s]
    i, k = np.nonzero(np.arange(width.max()) < width[:, None])
    blank = _lane(self._bend[s[i]] + k, lane[i], 2)
    begin = np.searchsorted(row, row)
    within = np.arange(len(row)) - begin
    if (within >= np.diff(self._bend)[row // LANES]).any():
      raise ValueError("cuts that meet leave no room in the bending matrix")
    at = _lane(self._bend[row // LANES] + within, row % LANES, 2)
    diag = np.zeros(mesh.nvert)
    same = coo.row == coo.col
    diag[coo.row[same]] = coo.data[same]
    return {
      "bend_node": [(blank, own[i]), (at, col)],
      "bend_gain": [(blank, 0.0), (at, value)],
      "bend_diag": [((s, lane), diag[vert])],
    }


def _lane(row: np.ndarray, lane: np.ndarray, ndim: int) -> tuple:
  """Returns where entries of lanes lie in an array of (rows, ..., 8)."""
  return (row, *(slice(None),) * (ndim - 2), lane)


def _around(mesh: Mesh, vert: np.ndarray) -> np.ndarray:
  """Returns which triangles have one of these corners, (nelem,) bool."""
  mine = np.zeros(mesh.nvert, bool)
  mine[vert] = True
  return np.any(mine[mesh.elem], axis=1)


def _beside(mesh: Mesh, elem: np.ndarray) -> np.ndarray:
  """Returns which triangles share an edge with these, (nelem,) bool."""
  other = mesh.twin.reshape(-1, 3)
  return np.any((other >= 0) & elem[other // 3], axis=1)


def _patch(mesh: Mesh, elem: np.ndarray) -> np.ndarray:
  """Returns the corners of triangles and of their neighbours."""
  return np.unique(mesh.elem[elem | _beside(mesh, elem)])
