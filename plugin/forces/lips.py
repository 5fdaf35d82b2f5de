"""Lips of cuts: what the two sides of a cut do to each other, see `forces/lips.h`."""

from typing import Any

import numpy as np
import warp as wp
from palpate.tissue import body as bodies
from palpate.tissue.geometry import faces
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.step import SCHEMES
from palpate.tissue.types import State, also, doubles, ints, struct

from .host import Bodies, Host, Input, Lists, Nodes, kernels
from .passive import Force
from .transfer import axes

# Stiffness of lips by area, over that of the tissue in an edge.
_FIRM = 10.0
_SMOOTH = 3  # times that normals are averaged


@struct
@also(State, *bodies.PAIRS)
class Lipped:
  """Pairs of vertices that were one before a cut, each vertex in one of them."""

  ahead: wp.float64  # see `Host.fill`
  gain: wp.float64
  reach: wp.float64  # how far they may be from each other and touch [m]
  row: ints("nworld")  # which row of the lists below a world has
  count: ints("nrow", 1)  # number of them
  vert: ints("nrow", "npair", 2)  # both vertices
  corner: ints("nrow", "npair", 2, 3)  # vertices of a triangle at each
  normal: doubles("nrow", "npair", 2, 3)  # from the first to the second in the triangles' axes
  stiffness: doubles("nrow", "npair")  # [N/m]
  own: Nodes
  solve: Input
  mj: Bodies


(_enter,) = kernels("forces/lips.h", Lipped, "enter_lips")


class Lips(Force):
  """The lips of an organ's cuts."""

  KEYS, ENTER = ("spare",), _enter

  def __init__(self, host: Host):
    super().__init__(host)
    self._lists: Lists | None = None
    config = host.organ.config
    if config.spare and SCHEMES[config.integrator].solids and not config.resident:
      self.count = host.organ.mesh.spare
      host.need_pairs()
      found = self._values(host.organ.mesh)
      self._lists = Lists(host, Lipped, [], found, self.count - len(found["vert"]))

  def __bool__(self) -> bool:
    return self._lists is not None

  def bind(self):
    """See `Force`."""
    if self._lists is not None:
      reach = self.host.organ.mesh.whole.edge_length
      values: dict[str, Any] = {"reach": reach, **self._lists.arrays}
      self.fields = self.host.fill(Lipped, values, into=self.fields)

  def enter(self):
    """See `Force`."""
    if self:
      self.host.arrays["paired"].zero_()
      super().enter()

  def reshape(self, world: int):
    """See `Force`."""
    if self._lists is not None:
      self._lists.put(world, self._values(self.host.mesh(world)))
      self.host.arrays["pair_hold"][world].zero_()

  def _values(self, mesh: Mesh) -> dict[str, np.ndarray]:
    """Returns the lists of `Lipped` for a mesh."""
    side, facet, part, wide = _walls(mesh, self.host.config.thickness)
    turned = (side[:, 0, 0] > side[:, 1, 0])[:, None]  # facets begin on either side
    sign, side = np.where(turned, -1, 1), np.where(turned[..., None], side[:, ::-1], side)
    key, first, number = np.unique(
      side[:, 0, 0] * mesh.nvert + side[:, 1, 0], return_index=True, return_inverse=True
    )
    total = np.bincount(number, topology.lengths(wide))
    group, way = number, sign
    if part is not None:  # a later cut must not turn normals along which lips have slid
      begin, group = np.unique(part, return_index=True, return_inverse=True)[1:]
      way = np.where((wide * wide[begin[group]]).sum(axis=1) < 0, -1, 1)[:, None]
    mean = _sums(way * wide, group)
    for _ in range(_SMOOTH):  # over what is next to each other: lips of a rough mesh slide too
      mean = _sums(way * _sums(way * mean[group], facet)[facet], group)
    mean, own = mean[group[first]], _sums(sign * wide, number)
    mean = np.where((mean * own).sum(axis=1)[:, None] < 0, -mean, mean)
    mean /= np.maximum(topology.lengths(mean), 1e-300)[:, None]
    keep = _lasting(np.stack([key // mesh.nvert, key % mesh.nvert], axis=1), total)
    corner, mean, total = side[first[keep]], mean[keep], total[keep]
    turn = axes(mesh.rest[corner].reshape(-1, 3, 3)).reshape(-1, 2, 3, 3)
    firm = _FIRM * float(np.mean(self.host.config.young)) / mesh.whole.edge_length
    return {
      "count": np.array([len(corner)]),
      "vert": corner[:, :, 0],
      "corner": corner,
      "normal": np.einsum("nsij,nj->nsi", turn, mean),
      "stiffness": firm * total,
    }


def _walls(mesh: Mesh, thickness: float) -> tuple[Any, ...]:
  """Returns what cuts have opened, by its corners.

  Returns:
    on both sides of a cut a triangle whose first corner is there (n, 2, 3), which facet that is of
    (n,), of a solid the same number for what was one vertex before one cut (n,), and the area of
    the wall that it stands for, along its normal from the first side [m^2] (n, 3)
  """
  if len(mesh.tet):
    corner, (one, other, match, part, wide) = mesh.tet.reshape(-1), _faces(mesh)
  else:
    corner, (one, other, match, wide) = mesh.elem.reshape(-1), _edges(mesh, thickness)
    part = None
  count = match.shape[1]
  first = (np.arange(count)[:, None] + np.arange(3)) % 3
  second = (match[:, :, None] + np.arange(3)) % 3
  there = np.arange(len(one))[:, None, None]
  side = np.stack([corner[one[:, first]], corner[other[there, second]]], axis=2).reshape(-1, 2, 3)
  wide = np.repeat(wide, count, axis=0)
  apart = side[:, 0, 0] != side[:, 1, 0]  # where a cut ends they are one
  part = None if part is None else part.reshape(-1)[apart]
  return side[apart], np.repeat(np.arange(len(one)), count)[apart], part, wide[apart]


def _faces(mesh: Mesh) -> tuple[np.ndarray, ...]:
  """Returns the faces that cuts of a solid have opened, a row a pair.

  Returns:
    corners of both, numbered (n, 3), which of the second is each of the first (n, 3), the same
    number for what was one vertex before one cut (n, 3), and a third of the first one's area, along
    its normal [m^2] (n, 3)
  """
  face, was = faces.opened(mesh).reshape(-1, 2), mesh.whole.tet.reshape(-1)
  ascends = face[:, 0] < face[:, 1]  # as in cutting/solid/open_faces.h
  cut = np.append(False, ascends[1:] != ascends[:-1])[: len(face)].cumsum()
  one, other = (faces.corners(each) for each in np.sort(face).T)
  match = (was[one][:, :, None] == was[other][:, None, :]).argmax(axis=2)
  wide = topology.area_vectors(mesh.rest, mesh.tet.reshape(-1)[one]) / 3
  return one, other, match, cut[:, None] * mesh.nvert + was[one], wide


def _edges(mesh: Mesh, thickness: float) -> tuple[np.ndarray, ...]:
  """Returns the edges that cuts of a sheet have opened as triangles that begin there, see `_faces`.

  The area is half of that of the wall at the edge, along what is across it in both triangles.
  """
  twin = mesh.whole.twin
  half = topology.opened(mesh)
  half = half[half < twin[half]]
  both = np.stack([half, twin[half]])
  both = (both - both % 3)[..., None] + (both[..., None] + np.arange(3)) % 3
  turn = axes(mesh.rest[mesh.elem.reshape(-1)[both]].reshape(-1, 3, 3)).reshape(2, -1, 3, 3)
  across = turn[1, :, 1] - turn[0, :, 1]
  across /= np.maximum(topology.lengths(across), 1e-300)[:, None]
  start, stop = (mesh.rest[topology.corners(mesh, half, k)] for k in (0, 1))
  wide = 0.5 * thickness * topology.lengths(stop - start)[:, None] * across
  return *both, np.broadcast_to([1, 0], (len(half), 2)), wide


def _sums(values: np.ndarray, group: np.ndarray) -> np.ndarray:
  """Returns the sums of rows by their groups."""
  out = np.zeros((int(group.max(initial=-1)) + 1, 3))
  np.add.at(out, group, values)
  return out


def _lasting(pair: np.ndarray, area: np.ndarray) -> np.ndarray:
  """Returns which pairs have most area of both of their vertices, each of which has one then."""
  order = np.argsort(area, kind="stable")
  best = np.full(int(pair.max(initial=0)) + 1, -1)
  best[pair[order].ravel()] = np.repeat(order, 2)
  return np.flatnonzero((best[pair] == np.arange(len(pair))[:, None]).all(axis=1))
