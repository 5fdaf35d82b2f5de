"""Formats of data sets of demonstrations, each written by one module of this folder.

A format is a module with

- `check(env)`: raises ValueError for what it cannot hold
- `write(folder, paths, about)`: makes the data set of the demonstrations at `paths`; returns what
  they have that it has not, in words
"""

import dataclasses
import importlib
import pathlib
import re
from collections.abc import Mapping, Sequence
from typing import Any

# The extra that each needs, and what it is written with.
FORMATS = {
  "robomimic": ("data", "h5py"),
  "lerobot": ("lerobot", "lerobot", "datasets", "av"),
  "minari": ("data", "minari", "h5py", "gymnasium", "PIL"),
}
_TAGS = {"lerobot": "LeRobot"}  # as its hub has it


@dataclasses.dataclass(frozen=True)
class About:
  """What a data set is of.

  Attributes:
    task: such as "touch/easy"
    task_kwargs: options of the exercise
    performer: who did it
    licence: of the data, as SPDX has it
    command: that made it
  """

  task: str
  task_kwargs: Mapping[str, Any]
  performer: str
  licence: str
  command: str

  @property
  def id(self) -> str:
    """A name such as "palpate/touch-easy/expert-v0"."""
    who = re.sub(r"[^A-Za-z0-9]+", "-", self.performer).strip("-") or "unknown"
    return f"palpate/{self.task.replace('/', '-').replace('_', '-')}/{who}-v0"


def of(name: str) -> Any:
  """Returns the module of a format; `palpate.register()` comes first."""
  return importlib.import_module(f".{name}", __package__)


def card(about: About, form: str, lines: Sequence[str], path: pathlib.Path) -> str:
  """Returns the card of a data set, README.md.

  Args:
    about: what it is of
    form: its format
    lines: about episodes, seeds and what is left out
    path: of one of its demonstrations
  """
  from palpate.tasks.learn.demonstrations import Demonstration, group, instruction

  demo = Demonstration.load(path)
  licence = about.licence.lower()
  head = ["---", f"license: {licence}", "task_categories: [robotics]",
          f"tags: [palpate, surgery, soft-tissue, {_TAGS.get(form, form)}]"]  # fmt: skip
  if form == "lerobot":
    head += ["configs:", "- config_name: default", "  data_files: data/*/*.parquet"]
  rows = ["| observation | group | shape |", "|---|---|---|"]
  for name, value in demo.observations.items():
    rows.append(f"| `{name}` | {group(name)} | {value.shape[1:]} |")
  info = demo.info
  text = [
    f"# {about.task} by {about.performer}",
    f"To {instruction(about.task)}. Made by Palpate {info['palpate']} (MuJoCo {info['mujoco']}): "
    f"simulated soft tissue, an instrument on a trocar, {demo.rate:g} actions a second.",
    "\n".join(f"- {line[0].upper()}{line[1:]}." for line in lines),
    f"Licence of the data: {about.licence}.",
    f"    {about.command}",
    f"Actions ({', '.join(demo.components)}) are in [-1, 1]. Units and meanings are on Palpate's "
    "page about environments. Forces "
    f"({', '.join(demo.forces)}) are magnitudes [N] at each step of the physics, "
    f"{next(iter(demo.forces.values())).shape[1]} an action.",
    "\n".join(rows),
  ]
  return "\n".join([*head, "---", ""]) + "\n" + "\n\n".join(text) + "\n"
