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
    observe: kernel (fields, own, beginning): what `Task.observe` is
    takes: numbers of the task that the struct has under the same names
    tissue: keys of the organ's tissue among the rows of `draw`, which the struct does not have
  """

  struct: Any
  begin: Any
  advance: Any
  observe: Any
  takes: tuple[str, ...] = ()
  tissue: tuple[str, ...] = ()

  @staticmethod
  def prepare(task: Any) -> None:
    """Changes the task before its scene is made for all worlds."""

  @staticmethod
  def sizes(task: Any, physics: Physics) -> dict[str, int]:
    """Returns the named sizes of its arrays."""
    return {}

  @staticmethod
  def constants(task: Any, physics: Physics) -> Mapping[str, Any]:
    """Returns what else of the struct all worlds share: arrays, vectors, numbers."""
    return {}

  @staticmethod
  def draw(task: Any, physics: Physics) -> Mapping[str, np.ndarray]:
    """Returns the rows of a world whose episode the task has just drawn."""
    raise NotImplementedError
