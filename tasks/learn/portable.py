"""A physics that is copied and pickled whole: what goes on from a copy goes on to the bit."""

import copy
import dataclasses
from typing import Any

import mujoco as mj
from palpate import Organ
from palpate.models.handle import Handle, Tip
from palpate.tissue.config import Config

from .. import display
from ..core.engine import Physics
from ..core.scenes import ORGAN

# What belongs to one process or is made anew from the data.
_OWN = {"_contexts", "_contexts_lock", "_data", "_named", "organ", "handle"}
_OWN |= {"eyes", "meanwhile", "_warnings", "_warnings_before", "_new_warnings"}


class Portable(Physics):
  """Physics with one organ; `copy`, `copy.deepcopy` and `pickle` take it in mid-episode.

  dm_control's own copy has MuJoCo's numbers alone, and recomputes them without controls.

  Attributes:
    organ: the handle on the organ
    organ_name: its name in the model
    prefix: of the instrument
    handle: that of the instrument, see `Instrument`
  """

  organ: Organ
  prefix = ""
  handle: Handle | Tip | None = None
  organ_name = ORGAN

  @property
  def contexts(self) -> Any:
    """What draws; RuntimeError in a process where drawing would wait for ever."""
    display.check_drawing()
    return super().contexts

  def _free_rendering_contexts(self) -> None:
    if display.can_draw():
      super()._free_rendering_contexts()
    self._contexts = None

  def copy(self, share_model: bool = False) -> "Portable":
    """Returns a physics that goes on from here as this one does.

    Args:
      share_model: whether both have one mjModel; then use them in one thread
    """
    twin: Any = super().copy(share_model)
    twin.resume(self.data.ptr, copy.deepcopy(self._others()), self.organ.config)
    return twin

  def __getstate__(self) -> tuple:
    return self.data, self._others(), self.organ.config

  def __setstate__(self, state: tuple) -> None:
    data, rest, config = state
    now = copy.copy(data.ptr)  # what follows changes it
    super().__setstate__(data)
    self.resume(now, rest, config)

  def take_hold(self) -> None:
    """See `Instrument`, of which an exercise's physics is one."""

  def _others(self) -> dict[str, Any]:
    return {name: value for name, value in vars(self).items() if name not in _OWN}

  def resume(self, data: mj.MjData, rest: dict[str, Any], config: Config) -> None:
    """Goes on from another physics of an equal model.

    Args:
      data: the other's data
      rest: its other attributes
      config: of its organ
    """
    vars(self).update(rest)
    model, own = self.model.ptr, self.data.ptr
    self.organ = Organ(model, own, self.organ_name)
    self.take_hold()
    now = self.organ.config
    names = [field.name for field in dataclasses.fields(Config)]
    changed = {n: getattr(config, n) for n in names if getattr(config, n) != getattr(now, n)}
    if changed:  # since the model was compiled
      self.organ.configure(**changed)
    # The plugin computes in a step's first half what it needs in the second.
    mj.mj_forward(model, own)
    mj.mj_copyData(own, model, data)
