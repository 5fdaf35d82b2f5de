"""Exercises and skill metrics.

    env = palpate.tasks.load("touch", "easy", task_kwargs={"random": 0})

`ALL_TASKS`, `BENCHMARKING`, `EASY` and `HARD` are tuples of (domain, task); see `suite`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
  from .suite import ALL_TASKS, BENCHMARKING, EASY, HARD, TASKS_BY_DOMAIN, load

__all__ = ["ALL_TASKS", "BENCHMARKING", "EASY", "HARD", "TASKS_BY_DOMAIN", "load"]


def __getattr__(name: str) -> Any:
  if name not in __all__:
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
  from . import suite

  return getattr(suite, name)
