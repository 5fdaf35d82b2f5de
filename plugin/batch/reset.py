"""Resets of worlds on a device: those of a mask, and those whose numbers are not finite.

Where worlds start is in arrays of its own: at first what `qpos0` has, or any state since.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from palpate.forces.cohesive_bonds import Bonds

from . import kernels
from .base import on_device
from .mjw.arrays import arrays_of

if TYPE_CHECKING:
  from .worlds import Worlds

# What of mujoco_warp's data is zero after a reset.
_ZERO = ("time", "overflow", "qacc", "qacc_warmstart", "qfrc_applied", "xfrc_applied", "ctrl",
         "sensordata")  # fmt: skip


class Rest:
  """Resets of the worlds of a batch.

  Args:
    batch: its worlds, with mujoco_warp's data at rest
    bare: the model that mujoco_warp has

  Attributes:
    starts: arrays with a row a world, and one of where worlds start
  """

  def __init__(self, batch: Worlds, bare: mujoco.MjModel):
    start = mujoco.MjData(bare)
    mujoco.mj_forward(bare, start)
    self.batch, self.mask = batch, batch.mask
    d = batch.d
    first = {
      "qpos": bare.qpos0,
      "qvel": np.zeros(bare.nv),
      "act": np.zeros(bare.na),
      "geom_xpos": start.geom_xpos,
      "geom_xmat": start.geom_xmat,
      "mocap_pos": start.mocap_pos,
      "mocap_quat": start.mocap_quat,
      "eq_active": bare.eq_active0.astype(bool),
    }
    self.starts = [_start(getattr(d, name), each) for name, each in first.items() if each.size]
    zero = [getattr(d, name) for name in _ZERO]
    for organ in batch.organs.values():
      self.starts += [_start(array) for array in organ.motion.values()]
      zero += [organ.body.state.dvel, organ.patch.stirred]
      zero += [group.arrays["stretch"] for group in organ.forces.of(Bonds).groups]
    for thread in batch.rods.all.values():
      f = thread.fields
      self.starts += [_start(f.now, thread.declared.rest)]
      self.starts += [_start(array) for array in (f.speed, *thread.own.values())]
    self._rows = self.starts + [_start(array) for array in zero if array.size]
    self._move = move = kernels.Move()
    for name, array in arrays_of(kernels.Move, batch.m, d).items():
      setattr(move, name, array)
    self._places: dict[bytes, wp.array] = {}
    move.mask, move.xpos, move.xmat = batch.mask, wp.clone(d.geom_xpos), wp.clone(d.geom_xmat)

  def launch(self):
    """Puts the worlds of the mask at rest."""
    for out, start in self._rows:
      inputs = [self.mask, start, out]
      wp.launch(kernels.put_back_rows, dim=out.shape, inputs=inputs, device=out.device)
    for organ in self.batch.organs.values():
      organ.rest()

  def pose(self, at: np.ndarray, values):
    """Puts joints of the worlds of the mask at positions; `at` has their places."""
    move, device, key = self._move, self.batch.device, at.tobytes()
    if key not in self._places:  # a graph that is being recorded cannot take them to the device
      self._places[key] = wp.array(at, dtype=int, device=device)
    move.at = self._places[key]
    move.values = on_device(values, wp.float32, device)
    wp.launch(kernels.pose, dim=values.shape, inputs=[move], device=device)

  def place(self, body: int, pos, quat):
    """Moves a body of the worlds of the mask; quaternions have w first."""
    move, device = self._move, self.batch.device
    move.body = body
    move.pos = on_device(pos, wp.float32, device).view(wp.vec3)
    move.quat = on_device(quat, wp.float32, device).view(wp.quat)
    wp.launch(kernels.place, dim=self.batch.nworld, inputs=[move], device=device)

  def look(self):
    """Finds where geoms are in the worlds of the mask, whose joints or bodies have been moved."""
    d, move = self.batch.d, self._move
    wp.copy(move.xpos, d.geom_xpos)
    wp.copy(move.xmat, d.geom_xmat)
    mjw.kinematics(self.batch.m, d)
    wp.launch(kernels.put_back, dim=move.xpos.shape, inputs=[move], device=self.batch.device)

  def find(self):
    """Resets and counts the worlds with numbers that are not finite."""
    batch = self.batch
    for each in (*batch.organs.values(), *batch.rods.all.values()):
      each.find_bad()
    inputs = [batch.bad, self.mask, batch.failures]
    wp.launch(kernels.note, dim=batch.nworld, inputs=inputs, device=batch.device)
    self.launch()

  def count_lost(self, lost: int):
    """Brings `overflow` up to date; `lost` are the bits of mujoco_warp's that count."""
    batch = self.batch
    inputs = [batch.lost, batch.d.overflow, lost, batch.counted]
    wp.launch(kernels.count, dim=batch.nworld, inputs=inputs, device=batch.device)


def _start(array: wp.array, values: np.ndarray | None = None) -> tuple[wp.array, wp.array]:
  """Returns an array's numbers, a row a world, and a row of where worlds start: zero if None."""
  plain = array if array.dtype in kernels.NUMBERS else array.view(wp.float32)
  rows = plain.reshape((array.shape[0], -1))
  start = np.zeros(rows.shape[1]) if values is None else values
  return rows, wp.array(start.reshape(1, -1), dtype=rows.dtype, device=rows.device)
