"""Exercises and skill metrics.

    env = palpate.tasks.load("touch", "easy", task_kwargs={"random": 0})

`ALL_TASKS`, `BENCHMARKING`, `EASY` and `HARD` are tuples of (domain, task); see `suite`.

    import gymnasium, palpate.tasks
    env = gymnasium.make("palpate/TouchEasy-v0")

Where Gymnasium is installed, importing this package registers the ids (see `registry`). Gymnasium
imports it by itself for `gymnasium.make("palpate.tasks:palpate/TouchEasy-v0")`; since 1.0 it no
longer looks for entry points.
"""

import contextlib
import importlib
from typing import TYPE_CHECKING, Any

from . import registry

if TYPE_CHECKING:
  from .suite import ALL_TASKS, BENCHMARKING, EASY, HARD, TASKS_BY_DOMAIN, load

__all__ = ["ALL_TASKS", "BENCHMARKING", "EASY", "HARD", "TASKS_BY_DOMAIN", "load"]


def __getattr__(name: str) -> Any:
  if name not in __all__:
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
  suite = importlib.import_module(".suite", __package__)  # which takes a second
  return getattr(suite, name)


with contextlib.suppress(ImportError):  # Gymnasium is an extra
  registry.register()
