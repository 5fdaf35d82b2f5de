"""Meshes of worlds that are cut: what differs between them, a row of one memory each.

The first row is the mesh that all have at first. Kernels see arrays in it and how far it is to the
next one (`Shape.stride`), so that worlds that were not cut read the same memory. Rows are written
on the host, by what writes a cut into a body, and go to the device as they are.
"""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import warp as wp

from . import body as bodies
from .body import Body

# What a cut changes of a body's arrays.
_OF_SHAPE = (
  "fan_node", "fan_rest", "fan_corner", "fan_side", "fan_width", "degree", "rest", "area", "free",
  "elem_node", "elem_rest", "elem_hinge", "hinge_node", "hinge_rest", "hinge_elem", "hinge_near",
  "hinge_angle0", "bend_node", "bend_width",
)  # fmt: skip
_OF_TISSUE = ("fan_metric", "fan_spring", "hinge_gain", "bend_gain", "bend_diag")
_WARP = {np.dtype(np.int32): wp.int32, np.dtype(np.float32): wp.float32,
         np.dtype(np.float64): wp.float64}  # fmt: skip


@wp.kernel(enable_backward=False)
def _begin(row: wp.array[int], memory: wp.array2d[int]):
  k, i = wp.tid()
  memory[row[k], i] = memory[0, i]


@wp.kernel(enable_backward=False)
def _put(
  row: wp.array[int], at: wp.array[int], word: wp.array[int], memory: wp.array2d[int]
):
  i = wp.tid()
  memory[row[i], at[i]] = word[i]


@wp.kernel(enable_backward=False)
def _turn(world: wp.array[int], more: wp.array3d[float], angle: wp.array3d[float]):
  k, s, lane = wp.tid()
  w = world[k]
  angle[1 + w, s, lane] = angle[1 + w, s, lane] + more[w, s, lane]


class Meshes:
  """The meshes of a body's worlds: the first one, and room for one more a world.

  Args:
    body: the body, whose shape and tissue become views of the first row
    still: the same on the CPU, with one world, whose arrays become those that are written
    more: arrays of the first mesh besides, by names of their own

  Attributes:
    which: which mesh each world has, the first one at first (nworld,)
    more: views of those arrays, with a row a mesh
    body: the body on the CPU, see `writing`
    here: all arrays there by name
  """

  def __init__(self, body: Body, still: Body, more: dict[str, np.ndarray]):
    self._device = body.device
    arrays = {name: getattr(body.shape, name) for name in _OF_SHAPE}
    arrays |= {name: getattr(body.tissue, name) for name in _OF_TISSUE}
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
    self._rows: dict[int, np.ndarray] = {}  # of the worlds that have been cut
    self._new: dict[int, list[np.ndarray]] = {}  # what the device has not got of them yet
    self._there: set[int] = set()  # worlds whose row it has
    self._open = self._first.copy()
    self.here, self.body = self.of(self._open), still
    _point(still.fields, self._views(self._open.ctypes.data, still.device))
    nrow = 1 + body.nworld
    self._memory = wp.zeros((nrow, self.nword), dtype=int, device=self._device)
    first = wp.array(self._first, dtype=int, device=self._device)
    wp.copy(self._memory.flatten(), first, count=self.nword)
    self.which = wp.zeros(body.nworld, dtype=int, device=self._device)
    bodies.unshare(body)
    _point(body.fields, self._views(self._memory.ptr, self._device))
    body.fields.shape.mesh, body.fields.shape.stride = self.which, self.nword
    views = self._views(self._memory.ptr, self._device, nrow)
    self.more, self._angle = {name: views[name] for name in more}, views["hinge_angle0"]

  def of(self, row: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the arrays of a row that is on the host."""
    out = {}
    for name, like in self._like.items():
      part = row[self._start[name] :][: like.nbytes // 4]
      out[name] = part.view(like.dtype).reshape(like.shape)
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
    self._rows.pop(world, None)
    self._new.pop(world, None)
    self._there.discard(world)

  @contextlib.contextmanager
  def writing(self, world: int):
    """Lets `body` and `here` have the row of a world, that of the first mesh until it is written.

    What is written to them is kept unless an error is raised.
    """
    if world not in self._rows:
      self._rows[world], self._new[world] = self._first.copy(), []
    row = self._rows[world]
    self._open[:] = row
    yield
    at = np.flatnonzero(self._open != row).astype(np.int32)
    row[at] = self._open[at]
    self._new.setdefault(world, []).append(at)

  def upload(self, worlds: list[int]):
    """Writes what has changed in rows of worlds to the device, which have them from then on."""
    fresh = [1 + world for world in worlds if world not in self._there]
    if fresh:
      rows = wp.array(fresh, dtype=int, device=self._device)
      dim = (len(fresh), self.nword)
      wp.launch(_begin, dim=dim, inputs=[rows, self._memory], device=self._device)
    found = [(world, _union(self._new.pop(world))) for world in worlds]
    row = np.repeat(1 + np.array(worlds), [len(at) for _, at in found])
    at = np.concatenate([at for _, at in found])
    word = np.concatenate([self._rows[world][at] for world, at in found])
    inputs = [wp.array(each, dtype=int, device=self._device) for each in (row, at, word)]
    wp.launch(_put, dim=len(row), inputs=[*inputs, self._memory], device=self._device)
    self._there |= set(worlds)
    which = self.which.numpy()
    which[worlds] = 1 + np.array(worlds)
    self.which.assign(which)


  def angle(self, worlds: list[int], more: wp.array):
    """Adds to the rest angles of the hinges of worlds; `more` has a row for every world."""
    at = wp.array(worlds, dtype=int, device=self._device)
    dim = (len(worlds), *self._angle.shape[1:])
    wp.launch(_turn, dim=dim, inputs=[at, more, self._angle], device=self._device)


def _union(parts: list[np.ndarray]) -> np.ndarray:
  return parts[0] if len(parts) == 1 else np.unique(np.concatenate(parts))


def _point(fields: Any, views: dict[str, wp.array]):
  for struct, names in ((fields.shape, _OF_SHAPE), (fields.tissue, _OF_TISSUE)):
    for name in names:
      setattr(struct, name, views[name])
