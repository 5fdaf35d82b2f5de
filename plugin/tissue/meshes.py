"""Meshes of worlds that are cut: what differs between them, a row of one memory each.

The first row is the mesh that all have at first. Kernels see arrays in it and how far it is to the
next one (`Shape.stride`), so that worlds that were not cut read the same memory. Rows are written
on the host, by what writes a cut into a body, and go to the device as they are.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from . import body as bodies
from .body import Body
from .types import Fields, Shape, Tissue

# What a cut changes of a body's arrays.
_OF_SHAPE = (
  "fan_node", "fan_rest", "fan_corner", "fan_side", "degree", "rest", "area", "free", "elem_node",
  "elem_rest", "elem_hinge", "hinge_node", "hinge_rest", "hinge_elem", "hinge_near",
  "hinge_angle0", "bend_node",
)  # fmt: skip
_OF_TISSUE = ("fan_metric", "fan_spring", "hinge_gain", "bend_gain", "bend_diag")
_WARP = {np.dtype(np.int32): wp.int32, np.dtype(np.float32): wp.float32,
         np.dtype(np.float64): wp.float64}  # fmt: skip


@wp.kernel(enable_backward=False)
def _put(row: wp.array[int], rows: wp.array2d[int], memory: wp.array2d[int]):
  k, i = wp.tid()
  memory[row[k], i] = rows[k, i]


class Meshes:
  """The meshes of a body's worlds: the first one, and room for one more a world.

  Args:
    body: the body, whose shape and tissue become views of the first row
    still: the same on the CPU, with one world
    more: arrays of the first mesh besides, by names of their own

  Attributes:
    which: which mesh each world has, the first one at first (nworld,)
    more: views of those arrays, with a row a mesh
  """

  def __init__(self, body: Body, still: Body, more: dict[str, np.ndarray]):
    self._device, self._still = body.device, still
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
    self._rows: dict[int, np.ndarray] = {}
    nrow = 1 + body.nworld
    self._memory = wp.zeros((nrow, self.nword), dtype=int, device=self._device)
    self._write([0], self._first[None])
    self.which = wp.zeros(body.nworld, dtype=int, device=self._device)
    bodies.unshare(body)
    _point(body.fields, self._views(self._memory.ptr, self._device))
    body.fields.shape.mesh, body.fields.shape.stride = self.which, self.nword
    views = self._views(self._memory.ptr, self._device, nrow)
    self.more = {name: views[name] for name in more}

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

  def row(self, world: int) -> np.ndarray:
    """Returns the row of a world on the host, that of the first mesh until it is written."""
    if world not in self._rows:
      self._rows[world] = self._first.copy()
    return self._rows[world]

  def heal(self, world: int):
    """Forgets the row of a world, which has the first mesh again."""
    self._rows.pop(world, None)

  def body(self, world: int) -> Body:
    """Returns a body on the CPU whose arrays are those of a world's row; only one is in use."""
    fields = Fields()
    for part in Fields.vars:
      setattr(fields, part, getattr(self._still.fields, part))
    fields.shape, fields.tissue = _copy(fields.shape, Shape), _copy(fields.tissue, Tissue)
    _point(fields, self._views(self.row(world).ctypes.data, self._still.device))
    return dataclasses.replace(self._still, fields=fields)

  def upload(self, worlds: list[int]):
    """Writes rows of worlds to the device, which have them from then on."""
    self._write([1 + world for world in worlds], np.stack([self._rows[w] for w in worlds]))
    which = self.which.numpy()
    which[worlds] = 1 + np.array(worlds)
    self.which.assign(which)

  def _write(self, at: list[int], rows: np.ndarray):
    inputs = [wp.array(each, dtype=int, device=self._device) for each in (at, rows)]
    wp.launch(_put, dim=rows.shape, inputs=[*inputs, self._memory], device=self._device)


def _copy(struct: Any, kind: Any) -> Any:
  out = kind()
  for name in kind.vars:
    setattr(out, name, getattr(struct, name))
  return out


def _point(fields: Any, views: dict[str, wp.array]):
  for struct, names in ((fields.shape, _OF_SHAPE), (fields.tissue, _OF_TISSUE)):
    for name in names:
      setattr(struct, name, views[name])
