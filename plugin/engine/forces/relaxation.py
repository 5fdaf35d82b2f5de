"""Stress relaxation of an organ: what elastic forces leave behind; see `forces/relaxation.h`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false

from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from palpate.tissue.config import Config
from palpate.tissue.types import doubles, fill, floats, ints, scalar, struct, vector

from .. import coupling
from ..layout import FLAG
from .passive import Beside, quiet

if TYPE_CHECKING:
  from ..workspace import Workspace


@struct
class Clock:
  """MuJoCo's own memory, under its own names."""

  timestep: doubles(1)


@struct
class Creeping:
  """The nodes of an organ whose stress relaxes, the moving ones."""

  ncreep: int  # number of them
  node: ints("ncreep")  # node of each
  own: doubles("ncreep", 6)  # elastic force of the last step, and what has not faded of it [N]
  held: int  # whether springs hold nodes
  number: doubles(2)  # share that relaxes [-], time constant [s]
  flags: ints(len(FLAG))  # see FLAG
  quiet: doubles("nworld")  # how long it has been at rest [s]
  hold: floats("nworld", "nholdslice", 6, 8)
  mass: scalar
  force_ext: vector
  dvel: vector
  sol: vector
  rhs: vector
  status: floats("nworld", 4)
  mj: Clock


KERNELS = "enter_creep", "end_creep"
_enter, _end = coupling.kernels("forces/relaxation.h", Creeping, *KERNELS)


class Creep(Beside):
  """Stress relaxation of a workspace's organ.

  Args:
    w: the workspace
  """

  KEYS = ("relax_share",)

  ENTER, END = _enter, _end

  def __init__(self, w: "Workspace"):
    super().__init__(w)
    self._number = wp.zeros(2, dtype=wp.float64, device="cpu")
    self.renumber(w.config)

  def __bool__(self) -> bool:
    return self._w.organ.config.relax_share > 0

  def renumber(self, config: Config):
    """Takes the numbers of a configuration that may change while running."""
    self._number.numpy()[:] = config.relax_share, config.relax_time

  def bind(self, model: int):
    """See `Beside`."""
    if not self:
      return
    w, organ = self._w, self._w.organ
    sizes = coupling.sizes(organ)
    values = dict(
      held=int(bool(w.hold)),
      hold=w.hold.array if w.hold else np.zeros((0, 0, 6, 8)),
      ncreep=sizes["ncreep"],
      node=w.body.shape.node.numpy()[np.flatnonzero(organ.free)],
      own=self.rows("creep", 6),
      number=self._number,
      flags=wp.array(np.asarray(w.report.flags), dtype=int, device="cpu", copy=False),
      quiet=quiet(w),
      mj=coupling.mujoco_arrays(model, w.data, Clock),
    )
    names = ("mass", "force_ext", "dvel", "sol", "rhs", "status")
    self.fields = fill(Creeping, "cpu", values | {name: w.host[name] for name in names})

  def carry(self, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Beside`."""
    if self:
      own, at = self.fields.own.numpy(), np.cumsum(self._w.organ.free) - 1
      own[at[member]] = share[:, None] * own[at[group]]
