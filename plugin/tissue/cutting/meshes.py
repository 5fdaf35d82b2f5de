"""Meshes of worlds that are cut: what differs between them, a row of one memory each.

The first row is the mesh that all have at first. Kernels see arrays in it and how far it is to the
next one (`Shape.stride`), so that worlds that were not cut read the same memory. Rows are written
on the host, by what writes a cut into a body, and go to the device as they are. A world whose whole
mesh is of other tissue has a row from the first, and a copy of that to come back to.
"""

from typing import Any

import numpy as np
import warp as wp

from .. import body as bodies
from ..body import Body
from .facets import Edges

_WARP = {np.dtype(np.int32): wp.int32, np.dtype(np.float32): wp.float32,
         np.dtype(np.float64): wp.float64}  # fmt: skip
_ANGLE = "hinge_angle0"  # that rows also have, where tissue bends


@wp.kernel(enable_backward=False)
def _turn(world: wp.array[int], more: wp.array3d[float], angle: wp.array3d[float]):
  k, s, lane = wp.tid()
  w = world[k]
  angle[1 + w, s, lane] = angle[1 + w, s, lane] + more[w, s, lane]


@wp.kernel(enable_backward=False)
def _restore(
  mask: wp.array[wp.bool], own: wp.array[int], home: wp.array2d[int], row: wp.array2d[int]
):
  w, i = wp.tid()
  if mask[w] and own[w] > 0:
    row[1 + w, i] = home[w, i]


class Meshes:
  """The meshes of a body's worlds: the first one, and room for one more a world.

  Args:
    body: the body, whose shape and tissue become views of the first row
    facets: what comes apart
    more: arrays of the first mesh besides, by names of their own

  Attributes:
    which: which mesh each world has, the first one at first (nworld,)
    more: views of those arrays, with a row a mesh
    here: the same on the host, with a row a world
    own: whether a world has a whole mesh of its own, see `keep` (nworld,)
    arrays: all arrays of the first of these rows; those of others are `open` words on
  """

  def __init__(self, body: Body, facets: Edges, more: dict[str, np.ndarray]):
    self._device = body.device
    of_shape = *facets.OF_SHAPE, _ANGLE
    arrays = {name: getattr(body.shape, name) for name in of_shape}
    arrays |= {name: getattr(body.tissue, name) for name in facets.OF_TISSUE}
    values = {name: array.numpy() for name, array in arrays.items()} | more
    # Those of 64 bits come first, where they are aligned.
    names = sorted(values, key=lambda name: -values[name].itemsize)
    self._like = {name: np.empty(values[name].shape, values[name].dtype) for name in names}
    size = [values[name].nbytes // 4 for name in names]
    start = np.concatenate([[0], np.cumsum(size)]).tolist()
    self._start, self.nword = dict(zip(names, start, strict=False)), start[-1] + start[-1] % 2
    self._first = np.zeros(self.nword, np.int32)
    for name in names:
      self.of(self._first)[name][...] = values[name]
    # Memory that the system gives when it is written to.
    self._rows = np.empty((body.nworld, self.nword), np.int32)
    self._begun: set[int] = set()  # worlds that have been cut
    self._homes: dict[int, np.ndarray] = {}  # rows of those whose whole mesh is their own
    self._home: wp.array | None = None  # the same on the device
    self.own = wp.zeros(body.nworld, dtype=int, device=self._device)
    self.arrays = self._views(self._rows.ctypes.data, wp.get_device("cpu"))
    self.here = {name: self.of(self._rows)[name] for name in more}
    nrow = 1 + body.nworld
    self._memory = wp.zeros((nrow, self.nword), dtype=int, device=self._device)
    first = wp.array(self._first, dtype=int, device=self._device)
    wp.copy(self._memory.flatten(), first, count=self.nword)
    self.which = wp.zeros(body.nworld, dtype=int, device=self._device)
    bodies.unshare(body)
    views = self._views(self._memory.ptr, self._device)
    for struct, some in ((body.shape, of_shape), (body.tissue, facets.OF_TISSUE)):
      for name in some:
        setattr(struct, name, views[name])
    body.fields.shape.mesh, body.fields.shape.stride = self.which, self.nword
    views = self._views(self._memory.ptr, self._device, nrow)
    self.more, self._angle = {name: views[name] for name in more}, views[_ANGLE]

  def of(self, row: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the arrays of a row that is on the host, or of several."""
    out = {}
    for name, like in self._like.items():
      part = row[..., self._start[name] :][..., : like.nbytes // 4]
      out[name] = part.view(like.dtype).reshape(*row.shape[:-1], *like.shape)
    return out

  def _views(self, ptr: int, device: Any, nrow: int = 0) -> dict[str, wp.array]:
    """Returns the arrays of the row at an address, or with an axis of rows that follow it."""
    out = {}
    for name, like in self._like.items():
      shape, options = like.shape, {}
      if nrow:
        shape, options = (nrow, *shape), {"strides": (4 * self.nword, *like.strides)}
      at = ptr + 4 * self._start[name]
      out[name] = wp.array(ptr=at, dtype=_WARP[like.dtype], shape=shape, device=device, **options)
    return out

  def heal(self, world: int):
    """Forgets the row of a world, which has the first mesh again."""
    self._begun.discard(world)

  def open(self, world: int) -> int:
    """Makes a world's row that of its whole mesh where it has none; returns where it starts."""
    if world not in self._begun:
      self._rows[world] = self._homes.get(world, self._first)
      self._begun.add(world)
    return world * self.nword

  def keep(self, worlds: list[int]):
    """Lets the rows of worlds, ascending, as they are be their whole meshes from now on."""
    if self._home is None:
      self._home = wp.zeros(self._rows.shape, dtype=int, device=self._device)
    for world in worlds:
      self._homes[world] = self._rows[world].copy()
    self._send(worlds, self._home, 0)
    own = self.own.numpy()
    own[worlds] = 1
    self.own.assign(own)

  def restore(self, mask: wp.array):
    """Gives the worlds of a mask their whole meshes again, of those that have their own."""
    if self._home is not None:
      inputs = [mask, self.own, self._home, self._memory]
      wp.launch(_restore, dim=self._home.shape, inputs=inputs, device=self._device)

  def upload(self, worlds: list[int]):
    """Writes the rows of worlds, ascending, to the device, which have them from then on."""
    self._send(worlds, self._memory, self.nword)
    which = self.which.numpy()
    which[worlds] = 1 + np.array(worlds)
    self.which.assign(which)

  def _send(self, worlds: list[int], to: wp.array, skip: int):
    """Copies the rows of worlds, ascending, to a memory with a row a world, `skip` words on."""
    there, here = to.flatten(), wp.array(self._rows.ravel(), device="cpu", copy=False)
    ends = np.flatnonzero(np.diff(worlds) > 1) + 1
    for run in np.split(np.array(worlds), ends):
      start, count = int(run[0]) * self.nword, len(run) * self.nword
      wp.copy(there, here, dest_offset=start + skip, src_offset=start, count=count)

  def angle(self, worlds: list[int], more: wp.array):
    """Adds to the rest angles of the hinges of worlds; `more` has a row for every world."""
    at = wp.array(worlds, dtype=int, device=self._device)
    dim = (len(worlds), *self._angle.shape[1:])
    wp.launch(_turn, dim=dim, inputs=[at, more, self._angle], device=self._device)
