"""Young's modulus of each triangle of each world: a lump that lies elsewhere in each.

All that depends on it in a step is linear in the triangles' factors on the modulus they were
compiled with, so that a world's numbers are products with sparse matrices.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import numpy as np
import warp as wp
from palpate.tissue import config as configuration
from palpate.tissue import plate
from palpate.tissue.order import LANES, ellpack
from palpate.tissue.types import Lump, allocate, fill, floats, ints, struct
from scipy import sparse


@struct
class Map:
  """A sparse matrix from the factors of triangles."""

  adr: ints("nrow + 1")
  elem: ints("nentry")
  share: floats("nentry")


@wp.kernel(enable_backward=False)
def mix(m: Map, factor: wp.array2d[float], world: wp.array[int], out: wp.array2d[float]):
  """Writes the product of a matrix with the factors of some worlds' triangles."""
  k, i = wp.tid()
  total = float(0.0)  # noqa: UP018 - a variable to Warp
  for q in range(m.adr[i], m.adr[i + 1]):
    total += m.share[q] * factor[k, m.elem[q]]
  out[world[k], i] = total


class Lumps:
  """The factors of an organ's triangles in all worlds, 1 at first.

  Args:
    organ: its declaration
    body: its tissue in all worlds, whose `lump` is filled
  """

  def __init__(self, organ, body):
    self._device, self._nelem = body.device, organ.mesh.nelem
    body.fields.lump = allocate(Lump, body.device, body.sizes | {"nlump": body.nworld})
    self.node = wp.zeros((body.nworld, body.shape.nnode), dtype=float, device=body.device)
    maps = _maps(organ, body)
    lump = body.fields.lump
    self._maps = [
      (self._put(map), _rows(array))
      for map, array in (
        (maps["node"], self.node),
        (maps["fan"], lump.fan),
        (maps["hinge"], lump.hinge),
        (maps["bend_gain"], lump.bend_gain),
        (maps["bend_diag"], lump.bend_diag),
      )
      if array.size
    ]
    lump.hinge_left.assign(maps["hinge_left"])
    self.put(np.arange(body.nworld), np.ones((1, self._nelem), np.float32))

  def _put(self, matrix: sparse.csr_matrix):
    values = {"adr": matrix.indptr, "elem": matrix.indices, "share": matrix.data}
    return fill(Map, self._device, values)

  def put(self, worlds: np.ndarray, factors: np.ndarray):
    """Gives some worlds the factors of their triangles, (worlds, nelem), or (1, nelem) for all."""
    rows = wp.array(worlds, dtype=int, device=self._device)
    factors = np.broadcast_to(factors, (len(worlds), self._nelem)).astype(np.float32)
    given = wp.array(factors, dtype=float, device=self._device)
    for map, out in self._maps:
      dim = (len(worlds), out.shape[1])
      wp.launch(mix, dim=dim, inputs=[map, given, rows, out], device=self._device)


def _rows(array: wp.array) -> wp.array:
  return array.reshape((array.shape[0], -1))


def _maps(organ, body) -> dict:
  """Returns the matrices from factors to the arrays of `Lump`, and its constant."""
  mesh, config, shape = organ.mesh, organ.config, body.shape
  node, nelem = shape.node.numpy(), mesh.nelem

  def pick(offset):
    """Returns the matrix that takes triangles by the offsets of vectors of four."""
    elem = (offset // (4 * LANES) * LANES + offset % (4 * LANES)).ravel()
    ones = np.ones(len(elem), np.float32)
    return sparse.csr_matrix((ones, (np.arange(len(elem)), np.minimum(elem, nelem - 1))),
                             shape=(len(elem), nelem))  # fmt: skip

  around = sparse.csr_matrix(
    (np.ones(3 * nelem), (node[mesh.elem].ravel(), np.repeat(np.arange(nelem), 3))),
    shape=(shape.nnode, nelem),
  )
  total = np.maximum(np.asarray(around.sum(axis=1)).ravel(), 1.0)
  out = {
    "node": sparse.csr_matrix(sparse.diags_array(1.0 / total) @ around),
    "fan": pick(shape.fan_corner.numpy()),
    "hinge": pick(shape.hinge_elem.numpy()),
    "bend_gain": None,
    "bend_diag": None,
    "hinge_left": np.zeros(body.fields.lump.hinge_left.shape, np.float32),
  }
  if body.has_bending:
    hinge = plate.hinges(mesh, configuration.rigidity(config, nelem), config.poisson)
    out |= _plate_maps(hinge, body, node)
  return out


def _plate_maps(hinge: plate.Hinges, body, node: np.ndarray) -> dict:
  """Returns the matrices of the bending matrix, and what of a hinge's stiffness is to its left."""
  nelem, nhinge, nnode = len(hinge.gain), len(hinge.vert), body.shape.nnode
  own, left = np.arange(nhinge), hinge.elem[:, 0]
  corner = np.argmax(hinge.of_elem[left] == own[:, None], axis=1)
  gain_left = np.zeros(body.fields.lump.hinge_left.size)
  gain_left[:nhinge] = hinge.gain[left, corner, corner]
  vert, weight = hinge.vert, hinge.weight[left, corner]
  row, col, value, elem = [], [], [], []
  for a in range(3):
    for b in range(3):
      e = np.flatnonzero((hinge.of_elem[:, a] >= 0) & (hinge.of_elem[:, b] >= 0))
      p, q = hinge.of_elem[e, a], hinge.of_elem[e, b]
      part = hinge.gain[e, a, b][:, None, None] * weight[p][:, :, None] * weight[q][:, None, :]
      row.append(np.broadcast_to(node[vert[p]][:, :, None], part.shape).ravel())
      col.append(np.broadcast_to(node[vert[q]][:, None, :], part.shape).ravel())
      value.append(part.ravel())
      elem.append(np.repeat(e, 16))
  row, col, value, elem = (np.concatenate(each) for each in (row, col, value, elem))
  # Where the ELLPACK has each pair of nodes.
  key, which = np.unique(row * nnode + col, return_inverse=True)
  pad = np.arange(nnode).reshape(-1, LANES)
  _, _, number = ellpack(key // nnode, key % nnode, 1.0 + np.arange(len(key)), pad)
  number = number.astype(int).ravel()
  place = np.zeros(len(key), int)
  place[number[number > 0] - 1] = np.flatnonzero(number)
  same = row == col
  return {
    "hinge_left": gain_left.reshape(-1, LANES),
    "bend_gain": sparse.csr_matrix((value, (place[which], elem)), shape=(len(number), nelem)),
    "bend_diag": sparse.csr_matrix((value[same], (row[same], elem[same])), shape=(nnode, nelem)),
  }
