"""Writes what a cut has changed into the arrays of a body, in place: recorded graphs go on.

Numbers of triangles, hinges and nodes stay, and rows have room (`rows.room`): so only what has a
triangle near the cut is computed anew, by the functions that made it.
"""

from __future__ import annotations

import numpy as np

from . import config as configuration
from . import mesh as topology
from . import plate, rows, shape, step
from .body import Body
from .config import Config
from .mesh import Mesh
from .order import LANES
from .types import DIMS, Shape, Tissue


class Refill:
  """The arrays of a body that has room for cuts, on the host.

  Args:
    body: the body, with a `Shape` and a `Tissue` of its own
    mesh: what its arrays are of
  """

  def __init__(self, body: Body, mesh: Mesh):
    self._body = body
    self.mesh = mesh
    kinds = ((body.shape, Shape), (body.tissue, Tissue))
    self._arrays = {
      name: getattr(struct, name) for struct, kind in kinds for name in DIMS[kind.key]
    }
    self._host: dict[str, np.ndarray] = {}
    self._node = body.shape.node.numpy()
    self._start = body.shape.slot_adr.numpy()
    self._bend = body.shape.bend_adr.numpy()

  def _on_host(self, name: str) -> np.ndarray:
    """Returns what an array holds, on the CPU the array itself."""
    if name not in self._host:
      self._host[name] = self._arrays[name].numpy()
    return self._host[name]

  def forget(self):
    """Forgets what the arrays hold: others have written into them."""
    self._host = {}

  def write(self, mesh: Mesh, changed: np.ndarray, config: Config, pinned: np.ndarray):
    """Makes the body that of another mesh.

    Args:
      mesh: of the same whole
      changed: triangles that are not as in the mesh so far
      config: configuration in force
      pinned: vertices that do not move, (nvert,) bool

    Raises:
      ValueError: the bending matrix has no room; nothing has changed then.
    """
    if not changed.size:
      return
    touched = topology.touched(self.mesh, mesh, changed)
    puts: dict[str, list] = self._fans(mesh, touched, config, pinned)
    if self._body.has_bending:
      puts |= self._plate(mesh, changed, config)
    for name, parts in puts.items():
      host = self._on_host(name)
      for where, values in parts:
        host[where] = values
      if self._body.device.is_cuda:
        self._arrays[name].assign(host)
    old, self.mesh = self.mesh, mesh
    if mesh.closed != old.closed:
      shape.renumber(self._body, config, mesh.closed)
    if self._body.levels is not None and (mesh.uncut is None) != (old.uncut is None):
      shape.rerate(self._body.levels, mesh)
    step.calibrate(self._body)

  def _fans(self, mesh: Mesh, touched: np.ndarray, config: Config, pinned: np.ndarray):
    own = self._node[touched]
    s, lane = own // LANES, own % LANES
    width = np.diff(self._start)[s]
    dense = rows.fans(mesh, config, touched, own, self._node, int(width.max()))
    out, where = {}, {}
    for extra in set(rows.EXTRA.values()):
      i, k = np.nonzero(np.arange(width.max() + extra) < (width + extra)[:, None])
      where[extra] = i, k, self._start[s[i]] + extra * s[i] + k, lane[i]
    for name, extra in rows.EXTRA.items():
      i, k, at, which = where[extra]
      out[name] = [(_lane(at, which, dense[name].ndim), dense[name][i, k])]
    for name in ("degree", "rest"):
      out[name] = [(_lane(s, lane, dense[name].ndim + 1), dense[name])]
    out["free"] = [((s, lane), np.where(pinned | mesh.unused, 0.0, 1.0)[touched])]
    which = touched
    if self.mesh.loose is not mesh.loose:  # all that has come free of the foundation
      which = np.arange(mesh.nvert)
    own = self._node[which]
    out["area"] = [((own // LANES, own % LANES), topology.areas_of(mesh, which, held=True))]
    return out

  def _plate(self, mesh: Mesh, changed: np.ndarray, config: Config):
    old, most = self.mesh, self._body.shape.nhingeslice * LANES
    # A triangle's plate is that of the patch of it and its neighbours.
    near = topology.distinct(*(topology.with_beside(m, changed) for m in (old, mesh)))
    vert = topology.distinct(*(m.elem[topology.with_beside(m, near)] for m in (old, mesh)))
    which = topology.with_beside(mesh, topology.around(mesh, vert))
    rigidity = configuration.rigidity(config, mesh.nelem)
    hinge = plate.hinges(mesh, rigidity, config.poisson, which)
    number, none = rows.numbers(mesh, hinge.half), len(mesh.whole.interior)
    assert none < most
    out = self._rows(mesh, hinge, vert)
    of_elem = hinge.of_elem[np.searchsorted(which, near)]
    of_elem = np.where(of_elem >= 0, number[of_elem], -1)
    dense = rows.elements(mesh, near, self._node, of_elem, none)
    for name, values in dense.items():
      out[name] = [(_lane(near // LANES, near % LANES, values.ndim + 1), values)]
    dense = rows.hinges(mesh, hinge, self._node, number)
    changes = topology.among(mesh.nelem, near)[hinge.elem]
    mine = changes[:, 0] | changes[:, 1]
    had = self._numbers(near)
    gone = had[~topology.among(none, number[mine])[had]]
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
    half = 3 * near[:, None] + np.arange(3)
    other = whole.twin[half]
    half = topology.distinct(np.minimum(half, other)[other >= 0])
    return np.searchsorted(whole.interior, half)

  def _rows(self, mesh: Mesh, hinge: plate.Hinges, vert: np.ndarray):
    """Returns rows of the bending matrix."""
    coo = plate.bending_matrix(mesh, hinge, vert)
    row, col, value = coo.row, coo.col, coo.data
    diag = np.zeros(len(vert))
    diag[np.searchsorted(vert, row[row == col])] = value[row == col]
    row, col = self._node[row], self._node[col]
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
    return {
      "bend_node": [(blank, own[i]), (at, col)],
      "bend_gain": [(blank, 0.0), (at, value)],
      "bend_diag": [((s, lane), diag)],
    }


def _lane(row: np.ndarray, lane: np.ndarray, ndim: int) -> tuple:
  """Returns where entries of lanes lie in an array of (rows, ..., 8)."""
  return (row, *(slice(None),) * (ndim - 2), lane)
