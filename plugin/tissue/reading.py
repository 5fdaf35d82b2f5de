"""How the words of a configuration key are read, and what a message says is allowed."""

import difflib
import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

AUTO = -1  # spare vertices: as many as there are
NOTHING = "none"  # as bonds: they are made while running


def choices(value: str, known: Iterable[str]) -> str:
  """Returns what is expected in place of a name that is not known, and the most similar one."""
  known = [*known]
  near = difflib.get_close_matches(str(value), known, 1)
  return f"expected one of {', '.join(known)}" + (f"; did you mean {near[0]!r}?" if near else "")


def count_of(name: str, value: Any) -> int:
  """Returns a number of things; ValueError says of which it is none."""
  if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
    raise ValueError(f"{name} is {value!r}, expected a whole number >= 1")
  return int(value)


def plain(word: str) -> str:
  """Returns a word of a number; Python alone reads 1_0 and digits of other scripts as one."""
  if not word.isascii() or "_" in word:
    raise ValueError
  return word


def number(low: float, high: float = math.inf, closed: bool = True) -> tuple:
  """Returns how a number in a range is read, and the words for it."""

  def read(text: str, nelem: int) -> float:
    value = float(plain(text))
    inside = (value >= low if closed else value > low) and value < high
    if not (math.isfinite(value) and inside):
      raise ValueError
    return value

  if not math.isfinite(low):
    return read, "a finite number"
  if not math.isfinite(high):
    return read, f"a number {'>=' if closed else '>'} {low:g}"
  return read, f"a number in {'[' if closed else '('}{low:g}, {high:g})"


def numbers(text: str, nelem: int) -> tuple[float, ...]:
  """Returns numbers > 0: one, or one an element."""
  words = text.split()
  values = tuple(float(plain(word)) for word in words)
  for k, value in enumerate(values):
    if not (math.isfinite(value) and value > 0):
      if len(values) > 1:
        raise ValueError(f"has {words[k]} for element {k}, expected numbers > 0")
      raise ValueError
  if len(values) not in (1, nelem):
    raise ValueError(f"has {len(values)} values, expected 1 or {nelem} (one per element)")
  return values


def whole(low: int, high: int) -> tuple:
  """Returns how a whole number is read, and the words for it."""

  def read(text: str, nelem: int) -> int:
    value = int(plain(text))
    if not low <= value <= high:
      raise ValueError
    return value

  return read, f"a whole number in [{low}, {high}]"


def choice(values: dict[str, Any]) -> tuple:
  """Returns how one of some words is read as its value, and the words for it."""

  def read(text: str, nelem: int):
    if text not in values:
      raise ValueError
    return values[text]

  return read, " or ".join(repr(text) for text in values)


def device(text: str, nelem: int) -> str:
  """Returns the name of a device."""
  kind, _, index = text.partition(":")
  if text in ("auto", "cpu", "cuda") or (kind == "cuda" and plain(index).isdigit()):
    return "cuda:0" if text == "cuda" else text
  raise ValueError


def vertices(text: str, nelem: int) -> tuple[int, ...]:
  """Returns numbers of vertices."""
  if not all(plain(word).isdigit() for word in text.split()):
    raise ValueError
  return tuple(int(word) for word in text.split())


def names(text: str, nelem: int) -> tuple[str, ...]:
  """Returns some names."""
  return tuple(text.split())


def name(text: str, nelem: int) -> str:
  """Returns a single name."""
  (name,) = text.split()
  return name


def attachments(text: str, nelem: int) -> tuple[tuple[str, float, tuple[int, ...]], ...]:
  """Returns groups of a name, a stiffness and vertices."""
  found = []
  for group in text.split(","):
    to, stiffness, *some = group.split()
    value = POSITIVE[0](stiffness, nelem)
    found.append((to, value, vertices(" ".join(some), nelem)))
    if not some:
      raise ValueError
  return tuple(found)


def spare(text: str, nelem: int) -> int:
  """Returns a number of spare vertices."""
  if text == "auto":
    return AUTO
  return whole(0, 10**9)[0](text, nelem)


class Law(NamedTuple):
  """How bonds hold and break: the bilinear law of `forces/cohesive_bonds.h`.

  Attributes:
    stiffness: by area [N/m^3]
    strength: traction at which they begin to soften [Pa]
    energy: that it takes to free them [J/m^2]
  """

  stiffness: float
  strength: float
  energy: float


class BondRow(NamedTuple):
  """Bonds that a configuration declares.

  Attributes:
    to: name of a body or another organ
    law: how they hold and break
    near: distance within which vertices are bonded [m], 0 where they are named
    vertices: those that are named
  """

  to: str
  law: Law
  near: float
  vertices: tuple[int, ...]


def law(stiffness: float, strength: float, energy: float) -> Law:
  """Returns the law of bonds; ValueError says which number cannot be."""
  out = Law(float(stiffness), float(strength), float(energy))
  for what, value in zip(Law._fields, out, strict=True):
    if not (math.isfinite(value) and value > 0):
      raise ValueError(f"has {what} {value:g}, expected a number > 0")
  least = out.strength**2 / (2 * out.stiffness)
  if out.energy <= least:
    raise ValueError(
      f"has energy {out.energy:g} J/m^2, expected more than strength^2 / (2 stiffness), {least:.3g}"
    )
  return out


def bonds(text: str, nelem: int) -> tuple[BondRow, ...]:
  """Returns groups of bonds; see `BondRow`."""
  found = []
  for group in text.split(",") if text != NOTHING else ():
    to, stiffness, strength, energy, how, *where = group.split()
    if how not in ("near", "at") or not where:
      raise ValueError
    far = POSITIVE[0](" ".join(where), nelem) if how == "near" else 0.0
    some = vertices(" ".join(where), nelem) if how == "at" else ()
    values = (float(plain(word)) for word in (stiffness, strength, energy))
    found.append(BondRow(to, law(*values), far, some))
  return tuple(found)


class CutterRow(NamedTuple):
  """What cuts, as a configuration declares it.

  Attributes:
    geoms: name of a geom, or of the two blades of scissors
    energy: that it takes to open an area [J/m^2]
    current: name of the actuator whose control is its power, "" for one that cuts by its edge
  """

  geoms: tuple[str, ...]
  energy: float
  current: str


def cutters(text: str, nelem: int) -> tuple[CutterRow, ...]:
  """Returns groups of one or two geoms and an energy, or with `by` and an actuator."""
  found = []
  for group in text.split(","):
    words, current = group.split(), ""
    if len(words) > 2 and words[-2] == "by":
      *words, _, current = words
    *geoms, energy = words
    if len(geoms) not in ((1,) if current else (1, 2)):
      raise ValueError
    found.append(CutterRow(tuple(geoms), POSITIVE[0](energy, nelem), current))
  return tuple(found)


class NeedleRow(NamedTuple):
  """A needle, as a configuration declares it.

  Attributes:
    name: of its body
    energy: that it takes to open an area [J/m^2]
    friction: by length in tissue [N/m]
    surface: energy that it takes to open the surface of a solid [J/m^2]
  """

  name: str
  energy: float
  friction: float
  surface: float


def needles(text: str, nelem: int) -> tuple[NeedleRow, ...]:
  """Returns groups of a body and an energy, with a friction, and with the surface's energy."""
  found = []
  for group in text.split(","):
    name, energy, *more = group.split()
    if len(more) > 2:
      raise ValueError
    opens, *surface = (POSITIVE[0](word, nelem) for word in (energy, *more[1:]))
    friction = NOT_NEGATIVE[0](more[0], nelem) if more else 0.0
    found.append(NeedleRow(name, opens, friction, *surface or [opens]))
  return tuple(found)


def words(*values: str) -> tuple:
  """Returns how one of some words is read, and the words for it."""
  return choice({value: value for value in values})


PATH = (lambda text, nelem: text, "a path")
POSITIVE = number(0.0, closed=False)
NOT_NEGATIVE = number(0.0)
