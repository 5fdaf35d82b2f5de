"""Devices by name."""

import math
from collections.abc import Callable

from palpate.tissue.reading import choices

from .bridge import Bridge
from .device import Device
from .hand import Hand
from .haptic import ForceDimension, Haply, OpenHaptics
from .relative import Desk, Gamepad, SpaceMouse


def _bridge(words: list[str]) -> Bridge:
  """Returns the bridge of `udp`, `udp:PORT` or `udp:HOST:PORT`."""
  host, port = (["127.0.0.1"] + (words or ["5005"]))[-2:]
  if not (port.isdigit() and int(port) < 65536):
    raise ValueError(f"device 'udp': port is {port!r}, expected a whole number below 65536")
  return Bridge(int(port), host)


def _hand(words: list[str]) -> Hand:
  """Returns a hand that circles and comes nearer, to see a device at work without one."""
  return Hand(lambda t: (0.01 * math.sin(2 * t), 0.01 * math.cos(2 * t) - 0.01, -0.004 * t))


_PAGE = ("mouse", "keyboard", "touch")  # those that need the page
_MAKERS: dict[str, Callable[[list[str]], Device]] = {
  **{name: lambda words, name=name: Desk(name) for name in _PAGE},
  "gamepad": lambda words: Gamepad(*map(int, words)),
  "spacemouse": lambda words: SpaceMouse(),
  "udp": _bridge,
  "openhaptics": lambda words: OpenHaptics(),
  "forcedimension": lambda words: ForceDimension(*map(int, words)),
  "haply": lambda words: Haply(*map(int, words)),
  "hand": _hand,
}
NAMES = tuple(_MAKERS)


def check(name: str) -> str:
  """Returns the kind of a device, ValueError if there is none of the name."""
  kind = name.partition(":")[0]
  if kind not in _MAKERS:
    raise ValueError(f"device is {name!r}, {choices(name, NAMES)}")
  return kind


def on_page(name: str) -> bool:
  """Returns whether a device is in the browser."""
  return check(name) in _PAGE


def device(name: str) -> Device:
  """Returns a device, opened.

  Args:
    name: one of `NAMES`; `udp:PORT` or `udp:HOST:PORT`; `gamepad:1` for the second one

  Raises:
    ValueError: there is none of that name.
    DeviceError: it cannot be opened.
  """
  kind, *words = name.split(":")
  check(kind)
  try:
    return _MAKERS[kind](words)
  except (TypeError, ValueError) as error:
    raise ValueError(f"device {name!r}: {error}") from None
