"""The exercises by name, and their ids in Gymnasium.

    @exercise("touch/easy", 10, "easy", asks="Touch one point within 5 mm", points=1)
    @exercise("touch/standard", 30, asks="Touch four points within 3 mm", points=4)
    class Touch(Task):

adds two, wherever the module is; a module of another package is found if it is an entry point of
the group `palpate.tasks`. A domain's standard task is `palpate/Touch-v0` in Gymnasium, the others
`palpate/TouchEasy-v0`, `palpate/ProbePalpateHard-v0` and so on. A change that changes returns gets
a new version.
"""

import dataclasses
import functools
import importlib.metadata
import inspect
import itertools
import math
import re
from collections.abc import Callable
from typing import Any

GROUP = "palpate.tasks"  # of entry points
VERSION = 0
TAGS = ("easy", "hard", "bimanual")
_NAME = re.compile(r"([a-z][a-z0-9_]*)/([a-z][a-z0-9_]*)")
_RATE = 50  # control steps a second


@dataclasses.dataclass(frozen=True)
class Entry:
  """A task that is registered.

  Attributes:
    name: domain and task, such as "touch/easy"
    time_limit: of an episode [s]
    tags: of `TAGS`
    make: makes the task, from its keyword arguments
    summary: what it asks for, in a line
    number: tasks of a domain are in the order of these
  """

  name: str
  time_limit: float
  tags: tuple[str, ...]
  make: functools.partial
  summary: str
  number: int


ENTRIES: dict[str, Entry] = {}  # by name
TASKS: dict[str, tuple[str, ...]] = {}  # domain -> its tasks
_NUMBERS = itertools.count()


def exercise(
  name: str, time_limit: float, *tags: str, asks: str | None = None, **defaults: Any
) -> Callable:
  """Returns a decorator that registers what makes a task: its class, or a function.

  Args:
    name: domain and task, such as "touch/easy"
    time_limit: of an episode [s]
    *tags: of `TAGS`
    asks: what the task asks for, in a line; the first one of the docstring by default
    **defaults: arguments that the task is made with unless others are given

  Raises:
    ValueError: the name is taken or no name, the limit is not a duration, a tag is unknown, or
      nothing says what the task asks for.
  """
  if not isinstance(name, str) or not (parts := _NAME.fullmatch(name)):
    raise ValueError(f'exercise is {name!r}, expected "domain/task" in lower case')
  number = isinstance(time_limit, int | float) and not isinstance(time_limit, bool)
  if not number or not 0 < time_limit < math.inf:
    raise ValueError(f"{name}: time_limit is {time_limit!r}, expected a number > 0 [s]")
  for tag in tags:
    if tag not in TAGS:
      raise ValueError(f"{name}: tag is {tag!r}, expected one of {', '.join(TAGS)}")

  place = next(_NUMBERS)  # of the decorators of a class the first is called last

  def add(make: Any) -> Any:
    if not (text := inspect.cleandoc(asks or make.__doc__ or "")):
      raise ValueError(f"{name}: {make.__name__} has no docstring, expected one, or `asks`")
    where = f"{make.__module__}.{make.__qualname__}"
    if name in ENTRIES:
      func = ENTRIES[name].make.func
      if (known := f"{func.__module__}.{func.__qualname__}") != where:
        raise ValueError(f"{name}: it is registered already, by {known}")
    summary, made = text.splitlines()[0].rstrip("."), functools.partial(make, **defaults)
    ENTRIES[name] = Entry(name, float(time_limit), tags, made, summary, place)
    domain, task = parts.groups()
    own = {*TASKS.get(domain, ()), task}
    TASKS[domain] = tuple(sorted(own, key=lambda each: ENTRIES[f"{domain}/{each}"].number))
    for other in sorted(TASKS):  # in the order of the domains, not of imports
      TASKS[other] = TASKS.pop(other)
    _register(domain, task)
    return make

  return add


def tagged(tag: str | None = None) -> tuple[tuple[str, str], ...]:
  """Returns (domain, task) of all tasks, or of those with a tag."""
  found = ((domain, task) for domain, tasks in TASKS.items() for task in tasks)
  return tuple(k for k in found if tag is None or tag in ENTRIES["/".join(k)].tags)


def step_limit(domain: str, task: str) -> int:
  """Returns how many control steps an episode has, unless it is told otherwise."""
  return math.ceil(round(ENTRIES[f"{domain}/{task}"].time_limit * _RATE, 6))


def gym_id(domain: str, task: str) -> str:
  """Returns the id of a task, such as "palpate/TouchEasy-v0"."""
  words = domain.split("_")
  words += [] if task == "standard" else task.removesuffix("_standard").split("_")
  return f"palpate/{''.join(word.capitalize() for word in words)}-v{VERSION}"


def _register(domain: str, task: str) -> None:
  """Registers a task with Gymnasium, where that is installed."""
  try:
    import gymnasium
  except ImportError:  # it is an extra
    return
  gymnasium.registry.pop(gym_id(domain, task), None)
  gymnasium.register(
    gym_id(domain, task),
    entry_point="palpate.tasks.gym:Exercise",
    vector_entry_point="palpate.tasks.batch.vector:Exercises",
    max_episode_steps=step_limit(domain, task),
    kwargs={"task": f"{domain}/{task}"},
  )


def find() -> None:
  """Imports what other packages have registered as entry points."""
  for point in importlib.metadata.entry_points(group=GROUP):
    try:
      point.load()
    except Exception as error:
      error.add_note(f"entry point {point.name!r} of {GROUP}, which is {point.value!r}")
      raise
