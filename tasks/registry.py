"""The names of the exercises, and their ids in Gymnasium.

A domain is a file of this folder, its tasks are the functions under `@SUITE.add` in it: adding one
there is all. A domain's standard task is `palpate/Touch-v0` in Gymnasium, the others
`palpate/TouchEasy-v0`, `palpate/ProbePalpateHard-v0` and so on. A change that changes returns gets
a new version.
"""

import importlib.resources
import re

VERSION = 0
_TASK = re.compile(r"^@SUITE\.add\([^)]*\)\ndef (\w+)\(time_limit=(\d+)", re.MULTILINE)
_RATE = 50  # control steps a second


def _find() -> dict[str, dict[str, float]]:
  # Read, not imported: dm_control takes a second, which nobody should wait for to see names.
  found, folder = {}, importlib.resources.files("palpate.tasks")
  for file in sorted(folder.iterdir(), key=lambda file: file.name):
    if file.name.endswith(".py") and (names := _TASK.findall(file.read_text(encoding="utf-8"))):
      found[file.name.removesuffix(".py")] = {name: float(limit) for name, limit in names}
  return found


TIME_LIMITS = _find()  # domain -> its tasks -> their time limit [s]
TASKS = {domain: tuple(tasks) for domain, tasks in TIME_LIMITS.items()}  # domain -> its tasks


def step_limit(domain: str, task: str) -> int:
  """Returns how many control steps an episode has, unless it is told otherwise."""
  return round(TIME_LIMITS[domain][task] * _RATE)


def gym_id(domain: str, task: str) -> str:
  """Returns the id of a task, such as "palpate/TouchEasy-v0"."""
  words = [domain] + ([] if task == "standard" else task.removesuffix("_standard").split("_"))
  return f"palpate/{''.join(word.capitalize() for word in words)}-v{VERSION}"


def register() -> None:
  """Registers every exercise with Gymnasium; does nothing the second time."""
  import gymnasium

  for domain, tasks in TASKS.items():
    for task in tasks:
      if gym_id(domain, task) not in gymnasium.registry:
        gymnasium.register(
          gym_id(domain, task),
          entry_point="palpate.tasks.gym:Exercise",
          vector_entry_point="palpate.tasks.batch.vector:Exercises",
          max_episode_steps=step_limit(domain, task),
          kwargs={"task": f"{domain}/{task}"},
        )
