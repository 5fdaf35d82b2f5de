"""What a configuration key may hold: how its text is read, and what a message says of it.

A reader returns the value of a text, for a number of elements, or raises ValueError; with it comes
what is allowed, in words.
"""

from __future__ import annotations

import math
from typing import Any

AUTO = -1  # spare vertices: as many as there are


def _plain(word: str) -> str:
  """Returns a word of a number; Python alone reads 1_0 and digits of other scripts as one."""
  if not word.isascii() or "_" in word:
    raise ValueError
  return word


def number(low: float, high: float = math.inf, closed: bool = True) -> tuple:
  """Returns the reader of a number from `low` to below `high`, and what it may be."""

  def read(text: str, nelem: int) -> float:
    value = float(_plain(text))
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
  """Returns numbers > 0, one or as many as there are elements."""
  words = text.split()
  values = tuple(float(_plain(word)) for word in words)
  for k, value in enumerate(values):
    if not (math.isfinite(value) and value > 0):
      if len(values) > 1:
        raise ValueError(f"has {words[k]} for element {k}, expected numbers > 0")
      raise ValueError
  if len(values) not in (1, nelem):
    raise ValueError(f"has {len(values)} values, expected 1 or {nelem} (one an element)")
  return values


def count(low: int, high: int) -> tuple:
  """Returns the reader of a whole number, and what it may be."""

  def read(text: str, nelem: int) -> int:
    value = int(_plain(text))
    if not low <= value <= high:
      raise ValueError
    return value

  return read, f"a whole number in [{low}, {high}]"


def choice(values: dict[str, Any]) -> tuple:
  """Returns the reader of one of some texts, and what they are."""

  def read(text: str, nelem: int):
    if text not in values:
      raise ValueError
    return values[text]

  return read, " or ".join(repr(text) for text in values)


def device(text: str, nelem: int) -> str:
  """Returns the name of a device."""
  kind, _, index = text.partition(":")
  if text in ("auto", "cpu", "cuda") or (kind == "cuda" and _plain(index).isdigit()):
    return "cuda:0" if text == "cuda" else text
  raise ValueError


def vertices(text: str, nelem: int) -> tuple[int, ...]:
  """Returns numbers of vertices."""
  if not all(_plain(word).isdigit() for word in text.split()):
    raise ValueError
  return tuple(int(word) for word in text.split())


def names(text: str, nelem: int) -> tuple[str, ...]:
  """Returns names."""
  return tuple(text.split())


def name(text: str, nelem: int) -> str:
  """Returns one name."""
  (name,) = text.split()
  return name


def groups(text: str, nelem: int) -> tuple[tuple[str, ...], ...]:
  """Returns groups of names."""
  return tuple(tuple(group.split()) for group in text.split(","))


def ties(text: str, nelem: int) -> tuple[tuple[str, float, tuple[int, ...]], ...]:
  """Returns groups of a name, a stiffness and vertices."""
  found = []
  for group in text.split(","):
    name, stiffness, *held = group.split()
    value = POSITIVE[0](stiffness, nelem)
    found.append((name, value, vertices(" ".join(held), nelem)))
    if not held:
      raise ValueError
  return tuple(found)


def spare(text: str, nelem: int) -> int:
  """Returns a number of spare vertices."""
  value = int(_plain(text)) if text != "auto" else AUTO
  if value < 0 and text != "auto":
    raise ValueError
  return value


def words(*values: str) -> tuple:
  """Returns the reader of one of some words, and what they are."""
  return choice({value: value for value in values})


POSITIVE = number(0.0, closed=False)
NOT_NEGATIVE = number(0.0)
