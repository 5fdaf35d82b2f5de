"""Worlds split over several devices of a host, behind the interface of one batch.

Each device has a batch of its own, in `parts`, and steps beside the others. What is read of all
worlds is gathered on the first device; `parts` have theirs in place.
"""

import functools
import itertools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.cutting.topology import Report

from .base import Batch, Contacts, Thread, Tissue, on_device, spread
from .bonds import Gathered
from .cutting.fracture import Cutters
from .needles import Needles
from .worlds import Worlds


class Several(Batch):
  """A batch whose worlds are on several devices.

  Args:
    spec: the scene
    nworld: number of worlds
    devices: one a part, which get as many worlds each as can be
    nodes: see `Worlds`
    deterministic: see `Worlds`

  Attributes:
    parts: the batches, whose worlds follow one another
    slices: worlds of each
  """

  def __init__(
    self,
    spec: mujoco.MjSpec,
    nworld: int,
    devices: Sequence[str],
    nodes: int | dict[str, int] | None = None,
    deterministic: bool = False,
  ):
    if not 1 <= len(devices) <= nworld:
      raise ValueError(f"device has {len(devices)} names, expected from 1 to nworld, {nworld}")
    ends = np.linspace(0, nworld, len(devices) + 1).round().astype(int)
    self.slices = [slice(int(a), int(b)) for a, b in itertools.pairwise(ends)]
    self.parts = [
      Worlds(spec, part.stop - part.start, device, nodes, deterministic)
      for part, device in zip(self.slices, devices, strict=True)
    ]
    super().__init__(self.parts[0].model, nworld, self.parts[0].device)
    self._allocate()
    self._organs = {name: _Gathered(self, name) for name in self.parts[0].organs}

  @property
  def threads(self) -> dict[str, Thread]:
    """Raises ValueError: they are in the parts."""
    raise ValueError("worlds on several devices have their threads in `parts`")

  def gather(self, arrays: Sequence[wp.array], out: wp.array) -> wp.array:
    """Copies an array of each part to one of all worlds."""
    for part, array, batch in zip(self.slices, arrays, self.parts, strict=True):
      if array.size:
        wp.synchronize_device(batch.device)
        wp.copy(_rows(out, part), array.contiguous())
    return out

  def _summed(self, name: str) -> wp.array:
    return self.gather([getattr(part, name) for part in self.parts], super()._summed(name))

  def _tell(self):
    for name in ("time", "qpos", "qvel", "sensordata"):
      self.gather([getattr(part, name) for part in self.parts], self._arrays[name])

  def _step(self, n: int):
    wp.synchronize_device(self.device)  # who wrote the controls
    for at, part in zip(self.slices, self.parts, strict=True):
      if self.ctrl.size:
        wp.copy(part.ctrl, _rows(self.ctrl, at))
    for part in self.parts:
      part.step(n)

  def _each(self, mask: wp.array):
    """Yields each part, which is to change, its worlds, and what of a mask is theirs."""
    whole = mask.numpy()
    for at, part in zip(self.slices, self.parts, strict=True):
      part._fresh = False
      yield part, at, on_device(whole[at], wp.bool, part.device)

  def _reset(self, mask: wp.array):
    for part, _, own in self._each(mask):
      part._reset(own)
    self.ctrl.assign(np.where(mask.numpy()[:, None], 0.0, self.ctrl.numpy()))

  def _start(self, data: mujoco.MjData):
    for part in self.parts:
      part._start(data)

  def _pose(self, adr: np.ndarray, values: Any, mask: wp.array):
    for part, at, own in self._each(mask):
      part._pose(adr, values[at], own)

  def _switch(self, equality: int, active: wp.array):
    for part, _, own in self._each(active):
      part._switch(equality, own)

  def _place(self, body: int, pos: Any, quat: Any, mask: wp.array):
    for part, at, own in self._each(mask):
      part._place(body, pos[at], quat[at], own)

  def _configure(self, worlds: np.ndarray, gravity: np.ndarray | None, friction: dict):
    for part, at in zip(self.parts, self.slices, strict=True):
      mine = (worlds >= at.start) & (worlds < at.stop)
      rough = {geom: values[mine] for geom, values in friction.items()}
      part._configure(worlds[mine] - at.start, None if gravity is None else gravity[mine], rough)

  def _find(self, world: int) -> tuple[Batch, int]:
    k = next(k for k, at in enumerate(self.slices) if world < at.stop)
    return self.parts[k], world - self.slices[k].start

  def _get_state(self, world: int, data: mujoco.MjData):
    part, own = self._find(world)
    part.get_state(own, data)

  def _set_state(self, world: int, data: mujoco.MjData):
    part, own = self._find(world)
    part.set_state(own, data)
    if self.ctrl.size:
      wp.copy(_rows(self.ctrl, slice(world, world + 1)), _rows(part.ctrl, slice(own, own + 1)))


def _rows(array: wp.array, at: slice) -> Any:
  """Returns rows of an array, in its memory."""
  return array[at]


class _Gathered(Tissue):
  """An organ of `Several`."""

  def __init__(self, batch: Several, name: str):
    self.batch, self.name = batch, name
    self._parts = [part.organ(name) for part in batch.parts]
    self.nvert, self.elem = self._parts[0].nvert, self._parts[0].elem
    self._arrays: dict[str, wp.array] = {}

  def _gather(self, name: str, arrays: Sequence[wp.array]) -> wp.array:
    batch = self.batch
    if name not in self._arrays:
      shape = (batch.nworld, *arrays[0].shape[1:])
      self._arrays[name] = wp.zeros(shape, dtype=arrays[0].dtype, device=batch.device)
    return batch.gather(arrays, self._arrays[name])

  def _read(self, name: str) -> wp.array:
    return self._gather(name, [getattr(part, name) for part in self._parts])

  @functools.cached_property
  def bonds(self) -> Gathered:
    return Gathered(self.batch, [part.bonds for part in self._parts])

  @property
  def needles(self) -> Needles:
    return Needles(*self._each("needle", [part.needles for part in self._parts]))

  def _each(self, name: str, parts: Sequence[Any]) -> list[wp.array]:
    """Returns the arrays of named tuples of all parts, in their order."""
    return [
      self._gather(f"{name}.{field}", [getattr(part, field) for part in parts])
      for field in parts[0]._fields
    ]

  @property
  def _spare(self) -> int:
    return self._parts[0]._spare

  def _cut(self, points: dict[int, np.ndarray], depth, direction) -> list[Report | None]:
    out: list[Report | None] = []
    for at, part in zip(self.batch.slices, self._parts, strict=True):
      own = {world - at.start: points[world] for world in points if at.start <= world < at.stop}
      out += part._cut(own, depth, direction) if own else [None] * (at.stop - at.start)
    return out

  def _told(self, name: str, world: int) -> list:
    part, own = self._part(world)
    return part._told(name, own)

  def _part(self, world: int) -> tuple[Tissue, int]:
    batch, own = self.batch._find(world)
    return batch.organ(self.name), own

  def _piece_count(self) -> wp.array:
    return self._gather("piece_count", [part.piece_count for part in self._parts])

  def _cutters(self) -> Cutters:
    return Cutters(*self._each("cutter", [part.cutters for part in self._parts]))

  def elem_of(self, world: int) -> np.ndarray:
    part, own = self._part(self.batch.index(world))
    return part.elem_of(own)

  @property
  def contacts(self) -> Contacts:
    return Contacts(*self._each("contact", [part.contacts for part in self._parts]))

  def configure(self, mask=None, **keys):
    batch = self.batch
    rows = {key: spread(self, key, value, batch.nworld) for key, value in keys.items()}
    for part, at, own in batch._each(batch.checked(mask)):
      part.organ(self.name).configure(own, **{key: values[at] for key, values in rows.items()})
