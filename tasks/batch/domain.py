"""What a domain of vectorised exercises is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from palpate.tasks.base import Task
from palpate.tasks.physics import Physics


class Domain:
  """A domain of exercises in arrays: a struct, and kernels over worlds that take it.

  Attributes:
    struct: of Warp, its state
    observed: fields that are observed, by the names they have in the exercise
    begin: kernel (fields, own): begins the episodes of `begun`, once the instrument is measured
    advance: kernel (fields, own): what `Task.advance` is; it ends with `kernels.judge`
    observe: kernel (fields, own, beginning): what `Task.observe` is
  """

  struct: Any
  observed: tuple[str, ...]
  begin: Any
  advance: Any
  observe: Any

  @staticmethod
  def numbers(task: Task) -> dict[str, float | int]:
    """Returns the struct's numbers."""
    return {}

  @staticmethod
  def sizes(task: Any, physics: Physics) -> dict[str, int]:
    """Returns the named sizes of its arrays."""
    return {}

  @staticmethod
  def draw(task: Any, physics: Physics) -> Mapping[str, np.ndarray]:
    """Returns the rows of a world whose episode the task has just drawn."""
    raise NotImplementedError
