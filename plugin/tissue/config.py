"""The organ's configuration: the `<config>` keys, their meaning and what they may hold."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from .step import SCHEMES

ELEMENTS = ("membrane", "spring")
INTEGRATORS = tuple(SCHEMES)


@dataclasses.dataclass(frozen=True)
class Config:
  """Configuration of one organ, one field a `<config>` key.

  Attributes:
    elements: `membrane` (St. Venant-Kirchhoff, plane stress) or `spring` (edge springs)
    young: Young's modulus [Pa], one value or one for each element
    poisson: Poisson's ratio [-], 0 <= nu < 0.5
    thickness: thickness of the surface [m]
    stiffness: constant of the edge springs [N/m]; only with `elements="spring"`
    bend: factor on the plate rigidity E t^3 / (12 (1 - nu^2)) [-]; 0 is off
    foundation: Winkler foundation, force per area per displacement [Pa/m]; 0 is off
    bulk: volume preservation, energy bulk/2 (V - V0)^2 / V0 [Pa]; 0 is off
    pressure: inside minus outside pressure [Pa]
    damping: Rayleigh coefficient on the stiffness [s]
    integrator: time stepping scheme
    iterations: most PCG iterations of a solve
    tolerance: relative residual at which PCG stops [-]
    newton: Newton iterations a step
    window: flexcomps that follow the tools over the organ, which is rigid then; none for an organ
      whose vertices are MuJoCo's dofs
    follow: bodies whose geoms the windows follow, a comma between windows; all that collide
    mass: mass of the organ [kg], only with `window`
    pin: vertices that do not move, only with `window`
    resident: whether the motion stays on the device between steps, only with `window`; the plugin
      state is then brought up to date by `Organ.sync` alone
    device: `cpu`, `cuda:N`, or `auto` (CUDA where there is a device and enough nodes, else CPU)
  """

  elements: str = "membrane"
  young: tuple[float, ...] = (5000.0,)
  poisson: float = 0.45
  thickness: float = 0.002
  stiffness: float = 0.0
  bend: float = 1.0
  foundation: float = 0.0
  bulk: float = 0.0
  pressure: float = 0.0
  damping: float = 0.002
  integrator: str = "implicit"
  iterations: int = 200
  tolerance: float = 1e-4
  newton: int = 1
  window: tuple[str, ...] = ()
  follow: tuple[tuple[str, ...], ...] = ()
  mass: float = 0.0
  pin: tuple[int, ...] = ()
  resident: bool = False
  device: str = "auto"


# Keys in MJCF are the fields above. Numbers: (lowest, highest, is the lowest itself allowed).
_NUMBERS = {
  "poisson": (0.0, 0.5, True),
  "thickness": (0.0, math.inf, False),
  "stiffness": (0.0, math.inf, False),
  "bend": (0.0, math.inf, True),
  "foundation": (0.0, math.inf, True),
  "bulk": (0.0, math.inf, True),
  "pressure": (-math.inf, math.inf, True),
  "damping": (0.0, math.inf, True),
  "tolerance": (0.0, 1.0, False),
  "mass": (0.0, math.inf, False),
}
_COUNTS = {"iterations": (1, 10000), "newton": (1, 100)}
_CHOICES = {"elements": ELEMENTS, "integrator": INTEGRATORS}
# Keys that may change while running; the others shape arrays.
RUNNING = (
  "integrator",
  "iterations",
  "tolerance",
  "newton",
  "damping",
  "foundation",
  "bulk",
  "pressure",
)
# Those among them that make up the material.
MATERIAL = ("young", "poisson", "thickness", "stiffness")
KEYS = tuple(field.name for field in dataclasses.fields(Config))


def _span(low: float, high: float, closed: bool) -> str:
  if not math.isfinite(low):
    return "a finite number"
  if not math.isfinite(high):
    return f"a number {'>=' if closed else '>'} {low:g}"
  return f"a number in {'[' if closed else '('}{low:g}, {high:g})"


def _number(organ: str, key: str, text: str) -> float:
  low, high, closed = _NUMBERS[key]
  try:
    value = float(text)
  except ValueError:
    value = math.nan
  inside = (value >= low if closed else value > low) and value < high
  if not (math.isfinite(value) and inside):
    raise ValueError(f"organ {organ!r}: {key} is {text!r}, expected {_span(low, high, closed)}")
  return value


def _count(organ: str, key: str, text: str) -> int:
  low, high = _COUNTS[key]
  try:
    value = int(text)
  except ValueError:
    value = low - 1
  if not low <= value <= high:
    raise ValueError(
      f"organ {organ!r}: {key} is {text!r}, expected a whole number in [{low}, {high}]"
    )
  return value


def _young(organ: str, text: str, nelem: int) -> tuple[float, ...]:
  words = text.split()
  try:
    values = tuple(float(word) for word in words)
  except ValueError:
    values = ()
  if not values or not all(math.isfinite(v) and v > 0 for v in values):
    shown = text if len(text) <= 40 else text[:40] + "..."
    raise ValueError(f"organ {organ!r}: young is {shown!r}, expected a number > 0")
  if len(values) not in (1, nelem):
    raise ValueError(
      f"organ {organ!r}: young has {len(values)} values, expected 1 or {nelem} (one an element)"
    )
  return values


def _pin(organ: str, text: str) -> tuple[int, ...]:
  words = text.split()
  if not all(word.isdigit() for word in words):
    shown = text if len(text) <= 40 else text[:40] + "..."
    raise ValueError(f"organ {organ!r}: pin is {shown!r}, expected vertex numbers")
  return tuple(int(word) for word in words)


def _flag(organ: str, key: str, text: str) -> bool:
  if text not in ("true", "false"):
    raise ValueError(f"organ {organ!r}: {key} is {text!r}, expected 'true' or 'false'")
  return text == "true"


def _device(organ: str, text: str) -> str:
  kind, _, index = text.partition(":")
  if text in ("auto", "cpu", "cuda") or (kind == "cuda" and index.isdigit()):
    return "cuda:0" if text == "cuda" else text
  raise ValueError(f"organ {organ!r}: device is {text!r}, expected 'cpu', 'cuda:0' or 'auto'")


def parse(organ: str, texts: dict[str, str], nelem: int, closed: bool) -> Config:
  """Returns the configuration that `texts` declares.

  Args:
    organ: name of the flexcomp, for messages
    texts: value of each key that is set; unset keys are absent or empty
    nelem: number of triangles
    closed: whether the surface encloses a volume

  Raises:
    ValueError: a value is not allowed; the message names organ, key, value and what is allowed.
  """
  values = _values(organ, texts, nelem)
  config = Config(**values)
  _check_combination(organ, config, values, closed)
  return config


def change(organ: str, config: Config, texts: dict[str, str], closed: bool) -> Config:
  """Returns `config` with the keys in `texts` changed, which must be ones that may change.

  Raises:
    ValueError: a key may not change while running or its value is not allowed.
  """
  for key in texts:
    if key not in RUNNING:
      raise ValueError(
        f"organ {organ!r}: {key!r} cannot change while running, expected one of "
        f"{', '.join(RUNNING)}"
      )
  changed = dataclasses.replace(config, **_values(organ, texts, nelem=1))
  _check_combination(organ, changed, {"stiffness": 0} if config.stiffness else {}, closed)
  return changed


def _values(organ: str, texts: dict[str, str], nelem: int) -> dict:
  values = {}
  for key, text in texts.items():
    text = text.strip()
    if key not in KEYS:
      raise ValueError(f"organ {organ!r}: unknown key {key!r}, expected one of {', '.join(KEYS)}")
    if not text:
      continue
    if key in _NUMBERS:
      values[key] = _number(organ, key, text)
    elif key in _COUNTS:
      values[key] = _count(organ, key, text)
    elif key == "young":
      values[key] = _young(organ, text, nelem)
    elif key == "window":
      values[key] = tuple(text.split())
    elif key == "follow":
      values[key] = tuple(tuple(group.split()) for group in text.split(","))
    elif key == "pin":
      values[key] = _pin(organ, text)
    elif key == "device":
      values[key] = _device(organ, text)
    elif key == "resident":
      values[key] = _flag(organ, key, text)
    elif text not in _CHOICES[key]:
      allowed = " or ".join(repr(choice) for choice in _CHOICES[key])
      raise ValueError(f"organ {organ!r}: {key} is {text!r}, expected {allowed}")
    else:
      values[key] = text
  return values


def _check_combination(organ: str, config: Config, given: dict, closed: bool):
  spring = config.elements == "spring"
  if spring and "stiffness" not in given:
    raise ValueError(f"organ {organ!r}: elements is 'spring' and stiffness is missing [N/m]")
  if not spring and "stiffness" in given:
    raise ValueError(
      f"organ {organ!r}: stiffness is {config.stiffness:g}, allowed only with elements='spring'"
    )
  for key in ("follow", "mass", "pin", "resident"):
    if key in given and not config.window:
      raise ValueError(f"organ {organ!r}: {key} is set, allowed only with window")
  if config.window and "mass" not in given and not config.mass:
    raise ValueError(f"organ {organ!r}: window is set and mass is missing [kg]")
  for key in ("bulk", "pressure"):
    value = getattr(config, key)
    if value and not closed:
      raise ValueError(f"organ {organ!r}: {key} is {value:g}, allowed only on a closed surface")


def lame(config: Config, nelem: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns the plane stress Lame constants lambda', mu of each element [Pa], (nelem,) each.

  lambda' = E nu / (1 - nu^2), mu = E / (2 (1 + nu)).
  """
  young = np.broadcast_to(np.asarray(config.young), (nelem,))
  nu = config.poisson
  return young * nu / (1 - nu * nu), young / (2 * (1 + nu))


def rigidity(config: Config, nelem: int) -> np.ndarray:
  """Returns the plate bending rigidity bend E t^3 / (12 (1 - nu^2)) [N m], (nelem,)."""
  young = np.broadcast_to(np.asarray(config.young), (nelem,))
  return config.bend * young * config.thickness**3 / (12 * (1 - config.poisson**2))
