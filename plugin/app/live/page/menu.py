"""What a page may ask for: the choices it is offered, and the check of what it sends."""

from typing import Any

from palpate.tissue import step

from ...trainee.keeping import Keeping
from ...trainee.record import check_name

FIRST = ("touch", "easy")  # exercise, by domain and name
NODES = (250, 500, 1000, 2000, 4000)  # of an exercise
SPEEDS = (0.1, 0.25, 0.5, 1.0)
SCHEMES = tuple(step.SCHEMES)
OWN = "own scene"  # in free practice, that of --scene
STEPS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)  # [ms]
OTHER = ("", "keyboard", "pad")  # what a page can have for the left hand; none by default


def offer(device: str, kept: Keeping | None = None, scene: bool = False) -> dict[str, Any]:
  """Returns what a page offers, JSON.

  Args:
    device: that the program was started with
    kept: whose exercises they are
    scene: whether there is an own scene to practise on
  """
  from palpate.tasks import suite

  return {
    "type": "menu",
    "tasks": {name: suite.summary(*suite.split(name)) for name in _order()},
    "trainee": kept.trainee if kept else "",
    "locked": kept.locked() if kept else {},
    "progress": _progress(kept),
    "two": ["/".join(pair) for pair in suite.BIMANUAL],
    "nodes": NODES,
    "speeds": SPEEDS,
    "device": device,
    "devices": devices(device),
    "lefts": lefts(device),
    "organs": organs(scene),
    "meshes": meshes(),
    "schemes": SCHEMES,
    "steps": STEPS,
    "instruments": instruments(),
    "processors": processors(),
  }


def _progress(kept: Keeping | None) -> dict[str, dict[str, Any]] | None:
  """Returns what a trainee has done, None where nobody keeps it: attempts, proficient, rule met."""
  from palpate.tasks.people import curriculum

  passed = kept.passed() if kept else None
  if passed is None:
    return None
  met = curriculum.done(passed)
  return {
    task: {"tried": len(each), "good": sum(each), "met": task in met}
    for task, each in passed.items()
  }


def instruments() -> tuple[str, ...]:
  """Returns the instruments of free practice, where the laparoscope is beside them."""
  from palpate.models import laparoscope, trocar

  return tuple(name for name in trocar.NAMES if name != laparoscope.NAME)


def organs(scene: bool) -> tuple[str, ...]:
  """Returns what there is for free practice, an own scene first."""
  from palpate import models

  return (OWN, *models.NAMES) if scene else models.NAMES


def _order() -> list[str]:
  """Returns the exercises by name, those of the curriculum first and in its order."""
  from palpate.tasks import suite
  from palpate.tasks.people import curriculum

  return list(dict.fromkeys([*curriculum.AFTER, *map("/".join, suite.ALL_TASKS)]))


def devices(device: str) -> tuple[str, ...]:
  """Returns the names of the devices that may be chosen; the first is the page itself."""
  from ..devices import registry as known

  own = () if known.on_page(device) else (device,)
  others = (name for name in known.NAMES if not known.on_page(name))
  return ("page", *dict.fromkeys((*own, *others)))


def lefts(device: str) -> tuple[str, ...]:
  """Returns the names of what may be in the left hand."""
  return (*OTHER, *devices(device)[1:])


def processors() -> tuple[str, ...]:
  """Returns what organs of free practice can be computed on."""
  from palpate.tissue import device

  return ("cpu", *device.cuda())


def meshes() -> tuple[str, ...]:
  """Returns the resolutions of an organ in free practice."""
  from palpate import models

  return (*(f"{n} nodes" for n in models.RESOLUTIONS), *(f"{n} x {n}" for n in models.GRIDS))


def exercise(message: dict[str, Any], device: str) -> dict[str, Any]:
  """Returns the exercise that a message asks for; ValueError names what is wrong with it."""
  from palpate.tasks import suite

  task = message.get("task")
  if not isinstance(task, str):
    raise ValueError(f"task is {task!r}, expected a name")
  person = message.get("person", "")
  person = check_name(person, "person") if person != "" else ""
  seed = message.get("seed", 0)
  if type(seed) is not int or not 0 <= seed < 2**31:
    raise ValueError(f"seed is {seed!r}, expected a whole number in [0, 2^31)")
  pair = suite.split(task)
  left = choice("left", message.get("left", ""), lefts(device)) if pair in suite.BIMANUAL else None
  if left == "":
    raise ValueError(
      f"task is {task!r}, which takes two hands, left is '', expected one of {lefts(device)[1:]}"
    )
  return _common(message) | {
    "type": "start",
    "task": "/".join(pair),
    "person": person,
    "seed": seed,
    "nodes": choice("nodes", message.get("nodes"), (None, *NODES)),
    "left": left or "",
    "assessment": message.get("assessment") is True,
    "scope": choice("scope", message.get("scope", "page"), devices(device)),
  }


def practice(message: dict[str, Any], device: str, scene: bool = False) -> dict[str, Any]:
  """Returns the free practice that a message asks for; ValueError names what is wrong with it."""

  def chosen(name: str, default: Any, choices: tuple) -> Any:
    return choice(name, message.get(name, default), choices)

  mesh = chosen("mesh", "1000 nodes", meshes())
  count, _, kind = mesh.partition(" ")
  return _common(message) | {
    "type": "practice",
    "organ": chosen("organ", OWN if scene else "liver", organs(scene)),
    "mesh": mesh,
    "size": {"nodes" if kind == "nodes" else "grid": int(count)},
    "scheme": chosen("scheme", "implicit", SCHEMES),
    "step": chosen("step", 1.0, STEPS),
    "instrument": chosen("instrument", "probe", instruments()),
    "left": chosen("left", "", lefts(device)),
    "on": chosen("on", "cpu", processors()),
    "scope": chosen("scope", "page", devices(device)),
  }


def _common(message: dict[str, Any]) -> dict[str, Any]:
  scale = message.get("scale", 1.0)
  if type(scale) not in (int, float) or not 0.1 <= scale <= 5:
    raise ValueError(f"scale is {scale!r}, expected a number in [0.1, 5]")
  speed = choice("speed", message.get("speed", 1.0), SPEEDS)
  return {"scale": float(scale), "speed": speed}


def choice(name: str, value: Any, choices: tuple) -> Any:
  """Returns a value that is one of the choices; ValueError lists them."""
  if isinstance(value, bool) or value not in choices:
    raise ValueError(f"{name} is {str(value)[:40]!r}, expected one of {choices}")
  return value
