"""The exercises by name, loaded as those of dm_control's suite."""

import importlib
import inspect
from collections.abc import Mapping
from typing import Any

from dm_control.rl import control

from . import registry

DOMAINS = {name: importlib.import_module(f".{name}", __package__) for name in registry.TASKS}


def _tagged(tag: str | None) -> tuple[tuple[str, str], ...]:
  return tuple(
    (domain, task)
    for domain, module in DOMAINS.items()
    for task in (module.SUITE if tag is None else module.SUITE.tagged(tag))
  )


ALL_TASKS = _tagged(None)
BENCHMARKING = _tagged("benchmarking")
EASY = _tagged("easy")
HARD = _tagged("hard")
BIMANUAL = _tagged("bimanual")  # for two hands
TASKS_BY_DOMAIN = {domain: tuple(module.SUITE) for domain, module in DOMAINS.items()}


def load(
  domain_name: str,
  task_name: str,
  task_kwargs: Mapping[str, Any] | None = None,
  environment_kwargs: Mapping[str, Any] | None = None,
) -> control.Environment:
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
  if domain_name not in DOMAINS:
    raise ValueError(f"domain is {domain_name!r}, expected one of {', '.join(DOMAINS)}")
  suite = DOMAINS[domain_name].SUITE
  if task_name not in suite:
    raise ValueError(f"{domain_name}: task is {task_name!r}, expected one of {', '.join(suite)}")
  factory = suite[task_name]
  kwargs = dict(task_kwargs or {})
  if environment_kwargs is not None:
    kwargs["environment_kwargs"] = environment_kwargs
  return factory(**kwargs)


def split(name: str) -> tuple[str, str]:
  """Returns domain and task of a name such as "touch/easy"; a domain alone means `standard`."""
  domain, _, task = name.partition("/")
  task = task or "standard"
  if (domain, task) not in ALL_TASKS:
    names = ", ".join("/".join(pair) for pair in ALL_TASKS)
    raise ValueError(f"task is {name!r}, expected one of {names}")
  return domain, task


def summary(domain_name: str, task_name: str) -> str:
  """Returns what the task asks for, in one line."""
  text = inspect.getdoc(DOMAINS[domain_name].SUITE[task_name]) or ""
  return text.splitlines()[0].removeprefix("Returns the task to ").rstrip(".")
