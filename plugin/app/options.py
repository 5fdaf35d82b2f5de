"""Options of an exercise on the command line: `--set time_limit=5 --set 'pixels=[84,84]'`."""

import argparse
import functools
import inspect
import json
from typing import Any

from .console import CommandError, one_line


def add_argument(parser: argparse.ArgumentParser):
  """Declares the option."""
  parser.add_argument(
    "--set", metavar="NAME=VALUE", action="append", default=[],
    help="option of the exercise, such as reward=sparse, time_limit=5 or pixels=[84,84]; JSON or a "
    "word; may be repeated",
  )  # fmt: skip


def add_observations(parser: argparse.ArgumentParser):
  """Declares what is observed."""
  parser.add_argument(
    "--observations", metavar="NAME,NAME",
    help="groups (sensors, state), pictures (pixels, ...) and single ones, by commas "
    "(sensors,state)",
  )  # fmt: skip


def read(texts: list[str], observations: str | None = None) -> dict[str, Any]:
  """Returns the options as `task_kwargs`.

  Args:
    texts: NAME=VALUE each
    observations: names by commas, if they are given
  """
  found: dict[str, Any] = {"observations": observations.split(",")} if observations else {}
  for text in texts:
    name, equal, value = text.partition("=")
    if not (equal and name.isidentifier()):
      raise CommandError(f"set is {text!r}, expected NAME=VALUE")
    if name == "random":
      raise CommandError("set has 'random', expected --seed, which decides everything random")
    try:
      found[name] = json.loads(value)
    except json.JSONDecodeError:
      found[name] = value
  return found


def task_name(text: str) -> str:
  """Returns the whole name of a task, such as `touch/standard` of `touch`."""
  from palpate.tasks import suite

  with one_line():
    return "/".join(suite.split(text))


def load(name: str, task_kwargs: dict[str, Any]):
  """Returns the environment of a task with these options; CommandError says what is wrong."""
  from palpate.tasks import suite

  try:
    return suite.load(*suite.split(name), task_kwargs={"random": 0, **task_kwargs})
  except (ValueError, OSError) as error:
    raise CommandError(str(error)) from None
  except TypeError as error:
    allowed = _allowed(suite.load(*suite.split(name)).task)
    for unknown in task_kwargs.keys() - allowed:
      names = ", ".join(sorted(allowed))
      raise CommandError(f"{name}: set has {unknown!r}, expected one of {names}") from None
    raise CommandError(f"{name}: set: {error}") from None


def _allowed(task: object) -> set[str]:
  """Returns the names of a task's options."""
  names = {"time_limit"}
  for kind in type(task).__mro__[:-1]:
    parameters = inspect.signature(kind.__init__).parameters.values()
    names |= {p.name for p in parameters if p.kind is p.KEYWORD_ONLY}
  return names - {"name", "scene"}


@functools.lru_cache(maxsize=1)  # each takes memory
def environment(name: str, task_kwargs: str):
  """Returns the environment of a task with these options as JSON, the last one again."""
  return load(name, json.loads(task_kwargs))
