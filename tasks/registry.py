"""The exercises by name, and their ids in Gymnasium.

    @exercise("touch/easy", 10, "easy")
    def easy(**kwargs):
      "Touch one point within 5 mm."
      return Touch(points=1, tolerance=0.005, **kwargs)

adds one, wherever the module is; a module of another package is found if it is an entry point of
the group `palpate.tasks`. A domain's standard task is `palpate/Touch-v0` in Gymnasium, the others
`palpate/TouchEasy-v0`, `palpate/ProbePalpateHard-v0` and so on. A change that changes returns gets
a new version.
"""

import dataclasses
import importlib.metadata
import inspect
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
  """

  name: str
  time_limit: float
  tags: tuple[str, ...]
  make: Callable[..., Any]
  summary: str


ENTRIES: dict[str, Entry] = {}  # by name
TASKS: dict[str, tuple[str, ...]] = {}  # domain -> its tasks


def exercise(name: str, time_limit: float, *tags: str) -> Callable:
  """Returns a decorator that registers the function that makes a task.

  Args:
    name: domain and task, such as "touch/easy"
    time_limit: of an episode [s]
    *tags: of `TAGS`

  Raises:
    ValueError: the name is taken or no name, the limit is not a duration, a tag is unknown, or the
      function has no docstring: its first line is what the task asks for.
  """
  if not isinstance(name, str) or not (parts := _NAME.fullmatch(name)):
    raise ValueError(f'exercise is {name!r}, expected "domain/task" in lower case')
  number = isinstance(time_limit, int | float) and not isinstance(time_limit, bool)
  if not number or not 0 < time_limit < math.inf:
    raise ValueError(f"{name}: time_limit is {time_limit!r}, expected a number > 0 [s]")
  for tag in tags:
    if tag not in TAGS:
      raise ValueError(f"{name}: tag is {tag!r}, expected one of {', '.join(TAGS)}")

  def add(make: Callable[..., Any]) -> Callable[..., Any]:
    text = inspect.getdoc(make)
    if not text:
      raise ValueError(f"{name}: {make.__name__} has no docstring, expected what the task asks for")
    known = ENTRIES.get(name)
    if known and (known.make.__module__, known.make.__qualname__) != (
      make.__module__, make.__qualname__
    ):  # fmt: skip
      where = f"{known.make.__module__}.{known.make.__name__}"
      raise ValueError(f"{name}: it is registered already, by {where}")
    summary = text.splitlines()[0].rstrip(".")
    ENTRIES[name] = Entry(name, float(time_limit), tags, make, summary)
    domain, task = parts.groups()
    TASKS[domain] = tuple(dict.fromkeys((*TASKS.get(domain, ()), task)))
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
