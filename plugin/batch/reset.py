"""Resets of worlds on a device: those of a mask, and those whose numbers are not finite.

Where worlds start is in arrays of its own: at first what `qpos0` has, or any state since.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from palpate.tissue.types import fill

from . import kernels
from .base import on_device
from .kernels import Start

if TYPE_CHECKING:
  from .worlds import Worlds


class Rest:
  """Resets of the worlds of a batch.

  Args:
    batch: its worlds, with mujoco_warp's data at rest
    bare: the model that mujoco_warp has
  """

  def __init__(self, batch: Worlds, bare: mujoco.MjModel):
    start = mujoco.MjData(bare)
    mujoco.mj_forward(bare, start)
    self.batch, self.mask = batch, batch.mask
    d = batch.d
    values = {name: getattr(d, name) for name in Start.vars if hasattr(d, name)}
    values |= dict(
      mask=batch.mask,
      qpos0=bare.qpos0,
      qvel0=np.zeros(bare.nv),
      act0=np.zeros(bare.na),
      geom_xpos0=start.geom_xpos,
      geom_xmat0=start.geom_xmat.reshape(-1, 3, 3),
      mocap_pos0=start.mocap_pos,
      mocap_quat0=start.mocap_quat,
      eq_active0=bare.eq_active0.astype(bool),
    )  # fmt: skip
    self.start = fill(Start, batch.device, values)
    self._move = move = kernels.Move()
    for name in kernels.Move.vars:
      source = d if hasattr(d, name) else batch.m
      if hasattr(source, name):
        setattr(move, name, getattr(source, name))
    move.mask, move.xpos, move.xmat = batch.mask, wp.clone(d.geom_xpos), wp.clone(d.geom_xmat)

  def launch(self):
    """Puts the worlds of the mask at rest."""
    wp.launch(kernels.reset, dim=self.batch.nworld, inputs=[self.start], device=self.batch.device)
    for organ in self.batch.organs.values():
      organ.rest()

  def pose(self, at: np.ndarray, values):
    """Puts joints of the worlds of the mask at positions; `at` has their places."""
    move, device = self._move, self.batch.device
    move.at = wp.array(at, dtype=int, device=device)
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
    for organ in batch.organs.values():
      organ.find_bad()
    inputs = [batch.bad, self.mask, batch.failures]
    wp.launch(kernels.note, dim=batch.nworld, inputs=inputs, device=batch.device)
    self.launch()

  def count_lost(self, lost: int):
    """Brings `overflow` up to date; `lost` are the bits of mujoco_warp's that count."""
    batch = self.batch
    inputs = [batch.lost, batch.d.overflow, lost, batch.counted]
    wp.launch(kernels.count, dim=batch.nworld, inputs=inputs, device=batch.device)
