"""Exercises and skill metrics.

    env = palpate.tasks.load("touch", "easy", task_kwargs={"random": 0})

`ALL_TASKS`, `BENCHMARKING`, `EASY` and `HARD` are tuples of (domain, task); see `suite`. `register`
is the decorator that adds an exercise, see `registry`.

    import gymnasium, palpate.tasks
    env = gymnasium.make("palpate/TouchEasy-v0")

Where Gymnasium is installed, importing this package registers the ids (see `registry`). Gymnasium
imports it by itself for `gymnasium.make("palpate.tasks:palpate/TouchEasy-v0")`; since 1.0 it no
longer looks for entry points.
"""

import importlib
import pkgutil
from typing import TYPE_CHECKING, Any

from palpate import screen

screen.import_dm_control()  # before others import it

from . import domains, registry, suite  # noqa: E402
from .registry import exercise as register  # noqa: E402
from .suite import TASKS_BY_DOMAIN, load  # noqa: E402

if TYPE_CHECKING:
  from .suite import ALL_TASKS, BENCHMARKING, EASY, HARD

__all__ = ["ALL_TASKS", "BENCHMARKING", "EASY", "HARD", "TASKS_BY_DOMAIN", "load", "register"]


def __getattr__(name: str) -> Any:
  if name not in __all__:
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
  return getattr(suite, name)


for _module in pkgutil.walk_packages(domains.__path__, f"{domains.__name__}."):
  importlib.import_module(_module.name)
registry.find()
