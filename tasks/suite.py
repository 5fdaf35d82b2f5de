"""The exercises by name, loaded as those of dm_control's suite."""

from collections.abc import Mapping
from typing import Any

from palpate.models import trocar
from palpate.tissue.reading import choices

from . import registry
from .core import environment

TASKS_BY_DOMAIN = registry.TASKS
# Those with a tag, and all; each is looked up, as a package may have registered more since.
_TAGS = {"ALL_TASKS": None, "BENCHMARKING": None, "EASY": "easy", "HARD": "hard",
         "BIMANUAL": "bimanual"}  # fmt: skip


def __getattr__(name: str) -> Any:
  if name not in _TAGS:
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
  return registry.tagged(_TAGS[name])


def load(
  domain_name: str,
  task_name: str,
  task_kwargs: Mapping[str, Any] | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
) -> environment.Environment:
  """Returns the environment of an exercise.

  Args:
    domain_name: one of `TASKS_BY_DOMAIN`
    task_name: one of that domain's tasks
    task_kwargs: `random` (a seed or RandomState), `time_limit` [s], `reward` ("dense" or "sparse"),
      `pixels` (height, width) and what else the task's class takes
    environment_kwargs: passed to `dm_control.rl.control.Environment`

  Raises:
    ValueError: no such domain or task, or a value that is not allowed; the message lists what is.
  """
  if domain_name not in registry.TASKS:
    raise ValueError(f"domain is {domain_name!r}, {choices(domain_name, registry.TASKS)}")
  names = registry.TASKS[domain_name]
  if task_name not in names:
    raise ValueError(f"{domain_name}: task is {task_name!r}, {choices(task_name, names)}")
  entry = registry.ENTRIES[f"{domain_name}/{task_name}"]
  kwargs = dict(task_kwargs or {})
  limit = kwargs.pop("time_limit", entry.time_limit)
  return environment.make(entry.make(**kwargs | {"name": entry.name}), limit, environment_kwargs)


def split(name: str) -> tuple[str, str]:
  """Returns domain and task of a name such as "touch/easy"; a domain alone means `standard`."""
  domain, _, task = name.partition("/")
  task = task or "standard"
  if f"{domain}/{task}" not in registry.ENTRIES:
    raise ValueError(f"task is {name!r}, {choices(name, registry.ENTRIES)}")
  return domain, task


def ends(name: str) -> dict[str, float]:
  """Returns at which value of a metric an exercise ends, and fails [SI]."""
  entry = registry.ENTRIES["/".join(split(name))]
  task = entry.make(name=entry.name)
  grip = {"peak_grip": float(task.damage)} if task.grips else {}
  return {"time": entry.time_limit, "peak_force": float(task.damage), **grip}


def by_hand(name: str) -> str:
  """Returns the `input` of an exercise for hands: the tip's pose where instruments have a wrist."""
  entry = registry.ENTRIES["/".join(split(name))]
  return "tip" if trocar.kind(entry.make(name=entry.name).prefix) in trocar.WRISTED else "handle"


def summary(domain_name: str, task_name: str) -> str:
  """Returns what the task asks for, in one line."""
  text = registry.ENTRIES[f"{domain_name}/{task_name}"].summary
  return text[0].lower() + text[1:]
