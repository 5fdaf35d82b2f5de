"""The exercises' ids in Gymnasium, registered by `import palpate` where gymnasium is installed.

A domain's standard task is `palpate/Touch-v0`, the others `palpate/TouchEasy-v0`,
`palpate/ProbePalpateHard-v0` and so on. A change that changes returns gets a new version.
"""

VERSION = 0
_LEVELS = ("easy", "standard", "hard")
TASKS = {  # as suite.TASKS_BY_DOMAIN, without importing dm_control
  "touch": _LEVELS,
  "probe": (*_LEVELS, "depth", "palpate_easy", "palpate_standard", "palpate_hard"),
  "grasp": _LEVELS,
  "trace": _LEVELS,
  "retract": _LEVELS,
}


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
          kwargs={"task": f"{domain}/{task}"},
        )
