"""What a domain of vectorised exercises is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from palpate.tasks.physics import Physics


class Domain:
  """A domain of exercises in arrays: a struct, and kernels over worlds that take it.

  Attributes:
    struct: of Warp, its state
    begin: kernel (fields, own): begins the episodes of `begun`, once the instrument is measured
    advance: kernel (fields, own): what `Task.advance` is; it ends with `kernels.judge`
    observe: kernel (fields, own, beginning): what `Task.observe` is; with two hands (fields, own,
      fields of the other, beginning)
    takes: numbers of the task that the struct has under the same names
    metrics: of its own, by the struct's arrays of an episode's values so far
  """

  struct: Any
  begin: Any
  advance: Any
  observe: Any
  takes: tuple[str, ...] = ()
  metrics: Mapping[str, str] = {}

  @staticmethod
  def sizes(task: Any, physics: Physics) -> dict[str, int]:
    """Returns the named sizes of its arrays."""
    return {}

  @staticmethod
  def attach(worlds: Any) -> None:
    """Asks the batch, which has just been made, for what the domain needs."""

  @staticmethod
  def act(worlds: Any) -> None:
    """Does what of an action no drive does, before the steps of the physics."""

  @staticmethod
  def read(worlds: Any) -> None:
    """Brings what is of the organ up to date, after a step or where episodes begin."""

  @staticmethod
  def sense(worlds: Any) -> None:
    """Measures after a step what the domain alone wants to know."""

  @staticmethod
  def constants(task: Any, physics: Physics) -> Mapping[str, Any]:
    """Returns what else of the struct all worlds share: arrays, vectors, numbers."""
    return {}

  @staticmethod
  def draw(task: Any, physics: Physics) -> Mapping[str, np.ndarray]:
    """Returns the rows of a world whose episode the task has just drawn."""
    raise NotImplementedError
