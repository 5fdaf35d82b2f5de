"""The states of a domain's rules in many worlds: a struct a world, and rows of its arrays."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp
from palpate.tasks.core.rules import Rules
from palpate.tissue.types import Array

from .words import compiled


class States:
  """The states of worlds.

  Attributes:
    records: the structs, an array of `kind`
    rows: of arrays of the state by name, (nworld, ...) each, or (1, ...) of what is shared
    drawn: names of what is not shared
    advance: kernel (fields, records)
    observe: kernel (fields, records, beginning)
    act: the same of what an action does besides, or None
    begin: the same of what follows the beginning of an episode, or None
    words: what the rules are written in, functions of `tasks.core.rules` among them
  """

  def __init__(self, own: Rules, task: Any, nworld: int, device: Any):
    self.kind, self.advance, self.observe, self.act, self.begin, self.words = compiled(own)
    self._fields, self._dtype = own.fields, self.kind.numpy_dtype()
    self._dtype = np.dtype(self._dtype)
    self.rows: dict[str, wp.array] = {}
    self.drawn = [name for name in own.fields if name not in own.shared]
    self._full: dict[str, tuple[int, ...]] = {}
    self._host = np.zeros(nworld, self._dtype)
    for name, kind in self._fields.items():
      if not isinstance(kind, Array):
        continue
      shape = tuple(getattr(task, dim) if isinstance(dim, str) else dim for dim in kind.dims)
      count = 1 if name in own.shared else nworld
      rows = wp.zeros((count, *shape), dtype=kind.dtype, device=device)
      self.rows[name], field = rows, self._host[name]
      if name in own.shared:
        rows.assign(np.asarray(getattr(task, name))[None])
      start: Any = rows.ptr
      strides: Any = rows.strides
      field["data"] = start + np.arange(nworld, dtype=np.uint64) * strides[0] * (count > 1)
      field["shape"][:, : len(shape)] = shape
      field["strides"][:, : len(shape)] = strides[1:]
      field["ndim"] = len(shape)
      if name in self.drawn:
        self._full[name] = rows.numpy().shape[1:]
    self.records = wp.array(self._host, dtype=self.kind, device=device)

  def draw(self, task: Any) -> Mapping[str, np.ndarray]:
    """Returns the state that a task has, by name."""
    found = {name: np.asarray(getattr(task, name)) for name in self.drawn}
    for name, full in self._full.items():  # an episode may need less than there is room for
      value = found[name]
      found[name] = np.zeros(full, value.dtype)
      found[name][tuple(slice(k) for k in value.shape)] = value
    return found

  def set(self, name: str, values: np.ndarray) -> None:
    """Takes the numbers of all worlds of a field that is no array."""
    self._host[name] = values

  def table(self) -> np.ndarray:
    """Returns the records as `set` has made them."""
    return self._host

  def array(self, name: str) -> wp.array:
    """Returns a field of all worlds, a view: (nworld,) + shape, of a number (nworld, 1)."""
    fields: Any = self._dtype.fields
    kind, start = fields[name][:2]
    first: Any = self.records.ptr
    shape = kind.shape or (1,)
    steps = [4 * int(np.prod(shape[k + 1 :])) for k in range(len(shape))]
    return wp.array(
      ptr=first + start, dtype=float, shape=(len(self._host), *shape),
      strides=(self._dtype.itemsize, *steps), device=self.records.device,
    )  # fmt: skip
