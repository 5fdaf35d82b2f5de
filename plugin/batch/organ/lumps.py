"""Young's modulus of each triangle of each world: a lump that lies elsewhere in each.

In a solid tetrahedra have that of the triangle nearest to them. All that depends on it in a step is
linear in the triangles' factors on the modulus they were compiled with, so that a world's numbers
are products with sparse matrices.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from palpate.tissue import config as configuration
from palpate.tissue import solid, step, tets
from palpate.tissue.geometry import plate
from palpate.tissue.geometry.fill import vertex_volumes, volumes
from palpate.tissue.order import LANES, ellpack, offset
from palpate.tissue.types import Lump, allocate, fill, floats, ints, struct
from scipy import sparse

if TYPE_CHECKING:
  from palpate.engine.model.declare import Declaration


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
  total = float(0.0)
  for q in range(m.adr[i], m.adr[i + 1]):
    total += m.share[q] * factor[k, m.elem[q]]
  out[world[k], i] = total


class Lumps:
  """The factors of an organ's triangles in all worlds, 1 at first.

  Args:
    organ: its declaration
    body: its tissue in all worlds, whose `lump` is filled where they have one mesh
  """

  def __init__(self, organ: "Declaration", body):
    self._device, self._nelem = body.device, organ.mesh.nelem
    self.node = wp.zeros((body.nworld, body.shape.nnode), dtype=float, device=body.device)
    maps = {"node": _around(organ.mesh, body)}
    if not organ.mesh.spare:  # else each world has what follows in its mesh, see `Cuts.stiffen`
      body.fields.lump = allocate(Lump, body.device, body.sizes | {"nlump": body.nworld})
      maps |= _solid_maps(organ, body) if body.is_solid else _maps(organ, body)
    lump = body.fields.lump
    if not (body.is_solid or organ.mesh.spare):
      lump.hinge_left.assign(_left(organ, body))
    self._maps = []
    for name, map in maps.items():
      out = self.node if name == "node" else getattr(lump, name)
      values = {"adr": map.indptr, "elem": map.indices, "share": map.data}
      self._maps.append((fill(Map, self._device, values), out.reshape((out.shape[0], -1))))
    self.put(np.arange(body.nworld), np.ones((1, self._nelem), np.float32))

  def put(self, worlds: np.ndarray, factors: np.ndarray):
    """Gives some worlds the factors of their triangles, (worlds, nelem), or (1, nelem) for all."""
    rows = wp.array(worlds, dtype=int, device=self._device)
    factors = np.broadcast_to(factors, (len(worlds), self._nelem)).astype(np.float32)
    given = wp.array(factors, dtype=float, device=self._device)
    for map, out in self._maps:
      dim = (len(worlds), out.shape[1])
      wp.launch(mix, dim=dim, inputs=[map, given, rows, out], device=self._device)


def _around(mesh, body) -> sparse.csr_matrix:
  """Returns the matrix from factors of triangles to their means around nodes."""
  node, nelem = body.shape.node.numpy(), mesh.nelem
  alone = np.setdiff1d(np.arange(body.shape.nnode), node[mesh.elem])  # padding, and spare vertices
  row = np.concatenate([node[mesh.elem].ravel(), alone])
  col = np.concatenate([np.repeat(np.arange(nelem), 3), np.zeros(len(alone), int)])
  around = sparse.csr_matrix((np.ones(len(row)), (row, col)), shape=(body.shape.nnode, nelem))
  total = np.maximum(np.asarray(around.sum(axis=1)).ravel(), 1.0)
  return sparse.csr_matrix(sparse.diags_array(1.0 / total) @ around)


def _solid_maps(organ: "Declaration", body) -> dict:
  """Returns the matrices from factors to the moduli of tetrahedra and nodes."""
  mesh, lump, node = organ.mesh, body.fields.lump, body.shape.node.numpy()
  ntet, nlane = len(mesh.tet), LANES * body.shape.ntetslice
  # Padding has no volume, but quotients of mu.
  elem = np.concatenate([solid.nearest_triangle(mesh), np.zeros(nlane - ntet, int)])
  place = np.arange(nlane)
  place[tets.order(mesh, node)] = np.arange(ntet)
  share = np.repeat(volumes(mesh.rest, mesh.tet) / 4, 4)
  share /= vertex_volumes(mesh)[mesh.tet.ravel()]
  tet = np.repeat(np.arange(ntet), 4)
  rows: dict[str, list] = {"tet_moduli": [], "node_moduli": []}
  for k, modulus in enumerate(solid.moduli(mesh, organ.config)):
    own = np.concatenate([modulus, np.full(nlane - ntet, 1.0 - k)])
    rows["tet_moduli"].append((offset(place, 2) + k * LANES, elem, own))
    mean = (1 - step.OWN_SHARE if k == 0 else 1.0) * share * modulus[tet]
    rows["node_moduli"].append((offset(node[mesh.tet.ravel()], 2) + k * LANES, elem[tet], mean))
  out = {}
  for name, parts in rows.items():
    row, col, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    size = math.prod(getattr(lump, name).shape[1:])
    out[name] = sparse.csr_matrix((value, (row, col)), shape=(size, mesh.nelem))
  return out


def _left(organ: "Declaration", body) -> np.ndarray:
  """Returns `Lump.hinge_left`."""
  out = np.zeros(body.fields.lump.hinge_left.size)
  if body.has_bending:
    hinge = _hinges(organ)
    own, left = np.arange(len(hinge.vert)), hinge.elem[:, 0]
    corner = np.argmax(hinge.of_elem[left] == own[:, None], axis=1)
    out[: len(own)] = hinge.gain[left, corner, corner]
  return out.reshape(-1, LANES)


def _hinges(organ: "Declaration") -> plate.Hinges:
  mesh, config = organ.mesh, organ.config
  return plate.hinges(mesh, configuration.rigidity(config, mesh.nelem), config.poisson)


def _maps(organ: "Declaration", body) -> dict:
  """Returns the matrices from factors to the arrays of `Lump` that a surface has."""
  nelem, shape = organ.mesh.nelem, body.shape

  def pick(start):
    """Returns the matrix that takes triangles by the offsets of vectors of four."""
    elem = (start // (4 * LANES) * LANES + start % (4 * LANES)).ravel()
    ones = np.ones(len(elem), np.float32)
    return sparse.csr_matrix((ones, (np.arange(len(elem)), np.minimum(elem, nelem - 1))),
                             shape=(len(elem), nelem))  # fmt: skip

  out = {"fan": pick(shape.fan_corner.numpy())}
  if body.has_bending:
    out["hinge"] = pick(shape.hinge_elem.numpy())
    out |= _plate_maps(_hinges(organ), body, shape.node.numpy())
  return out


def _plate_maps(hinge: plate.Hinges, body, node: np.ndarray) -> dict:
  """Returns the matrices of the bending matrix."""
  nelem, nnode = len(hinge.gain), body.shape.nnode
  left = hinge.elem[:, 0]
  corner = np.argmax(hinge.of_elem[left] == np.arange(len(left))[:, None], axis=1)
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
    "bend_gain": sparse.csr_matrix((value, (place[which], elem)), shape=(len(number), nelem)),
    "bend_diag": sparse.csr_matrix((value[same], (row[same], elem[same])), shape=(nnode, nelem)),
  }
