"""Stress relaxation of an organ: what elastic forces leave behind; see `forces/relaxation.h`."""

import numpy as np
import warp as wp
from palpate.tissue import body as bodies
from palpate.tissue.types import State, System, also, blank, doubles, ints, struct

from ..engine.layout import FLAG
from .host import Bodies, Host, edited, kernels
from .passive import Force


@struct
@also(State, *bodies.PAIRS, "hold", "mass", "force_ext", "dvel")
@also(System, "sol", "rhs", "status")
class Relaxing:
  """The nodes of an organ whose stress relaxes, the moving ones."""

  nrelax: int  # number of them
  node: ints("nrelax")  # node of each
  memory: doubles("nworld", "nrelax", 6)  # last elastic force, and what has not faded of it [N]
  held: int  # whether springs hold nodes
  law: doubles(2)  # share that relaxes [-], time constant [s]
  flags: ints(len(FLAG))  # see FLAG
  quiet: doubles("nworld")  # how long it has been at rest [s]
  mj: Bodies


_enter, _end = kernels("forces/relaxation.h", Relaxing, "enter_relaxation", "end_relaxation")


class Relaxation(Force):
  """Stress relaxation of an organ."""

  KEYS = ("relax_share",)
  ENTER, END = _enter, _end

  def __init__(self, host: Host):
    super().__init__(host)
    self._node = np.flatnonzero(host.organ.free)
    self.count = len(self._node)
    self._law = wp.zeros(2, dtype=wp.float64, device=host.device)
    self.refresh()

  def __bool__(self) -> bool:
    return self.host.organ.config.relax_share > 0

  def refresh(self):
    """Takes the numbers of the configuration that may change while running."""
    self._law.assign(np.array([self.host.config.relax_share, self.host.config.relax_time]))

  def bind(self):
    """See `Force`."""
    if not self:
      return
    host, solve = self.host, self.host.input
    none = {name: blank(Relaxing, name, host.device) for name in bodies.PAIRS}
    values = (none | host.arrays) | dict(
      nrelax=self.count,
      node=solve.node.numpy()[self._node],
      memory=host.rows("relaxation", 6),
      held=int(host.springs is not None),
      law=self._law,
      quiet=solve.quiet,
      hold=solve.hold,
    )
    self.fields = host.fill(Relaxing, values, into=self.fields)

  def end(self):
    """See `Force`."""
    if self:
      self.fields.flags = self.host.flags()  # in a batch they follow how stiff the tissue is
      super().end()

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Force`."""
    if self:
      at = np.cumsum(self.host.organ.free) - 1
      with edited(self.fields.memory, world) as memory:
        memory[at[member]] = share[:, None] * memory[at[group]]
