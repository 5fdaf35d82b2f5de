"""Devices that know movements and speeds but no place: mouse, keyboard, gamepad, SpaceMouse."""

import math
import threading
from collections.abc import Iterable, Sequence
from typing import Any

from .device import DeviceError, Reading, Silent, library

# Of the hand at full deflection: place [m/s], about the shaft and of a wrist [rad/s].
SPEED, ROLL, LEAN = 0.06, 2.0, 1.0
_FULL = (SPEED, SPEED, SPEED, ROLL, LEAN, LEAN)
BUTTONS = frozenset({"clutch", "grip", "report", "pause"})
_MOST = (0.05,) * 3 + (math.pi,) * 3  # of one movement [m], [rad]
_DEAD = 0.08  # share of a stick's way in which nothing moves
_EVERY = 0.008  # between readings of the hardware [s]


class Desk(Silent):
  """A hand that is moved by what another thread says: displacements, speeds, buttons.

  Attributes:
    step: time between readings that speeds are taken for, that of the simulation, which may be
      slower than the clock; None to take the clock's [s]
  """

  relative = True

  def __init__(self, name: str = "desk"):
    """Makes a hand at its origin."""
    self.name = name
    self.step: float | None = None
    self._lock = threading.Lock()
    self._moved = [0.0] * 6
    self._rate: Sequence[float] = (0.0,) * 6
    self._held: frozenset[str] = frozenset()
    self._jaw: float | None = None
    self._at = 0.0
    self._pos, self._time = [0.0] * 6, None

  def feed(
    self,
    move: Sequence[float] = (),
    rate: Sequence[float] = (),
    buttons: Iterable[str] = (),
    jaw: float | None = None,
    at: float = 0.0,
  ) -> None:
    """Takes what the hand does; ValueError says what is no such thing.

    Args:
      move: how far it went since the last call: x y z [m], about the shaft [rad] and, for a wrist,
        up and to the right [rad]  (4,) or (6,)
      rate: its speed from now on, in shares of the full one, each in [-1, 1]  (4,) or (6,)
      buttons: those that are held now, of `BUTTONS`
      jaw: opening of the jaws in [-1, 1], None for the button `grip`
      at: when it was so, by any clock, 1e9 at most
    """
    held = frozenset(buttons)
    if not held <= BUTTONS:
      raise ValueError(f"button is {min(held - BUTTONS)!r}, expected {', '.join(sorted(BUTTONS))}")
    far, fast = _numbers("move", move, math.pi), _numbers("rate", rate, 1.0)
    if jaw is not None:
      jaw = _numbers("jaw", [jaw] * 4, 1.0)[0]
    at = _numbers("at", [at] * 4, 1e9)[0]
    with self._lock:
      sums = zip(self._moved, far, _MOST, strict=True)
      self._moved = [a + min(max(b, -most), most) for a, b, most in sums]
      self._rate, self._held, self._jaw, self._at = fast, held, jaw, at

  def read(self, now: float) -> Reading:
    """Returns where the hand is."""
    span = 0.0 if self._time is None else self.step or min(now - self._time, 0.1)
    self._time = now
    with self._lock:
      moved, rate, held, jaw = self._moved, self._rate, self._held, self._jaw
      self._moved, self.stamp = [0.0] * 6, self._at
    self._pos = [
      p + m + span * r * f for p, m, r, f in zip(self._pos, moved, rate, _FULL, strict=True)
    ]
    x, y, z, roll, up, right = self._pos
    return Reading((x, y, z), None, roll, jaw, held, (up, right))


def _numbers(name: str, values: Sequence[float], most: float) -> tuple[float, ...]:
  good = len(values) in (0, 4, 6) and all(
    isinstance(v, int | float) and not isinstance(v, bool) and abs(v) <= most for v in values
  )
  if not good:
    allowed = f"expected 4 or 6 numbers in [-{most:g}, {most:g}]"
    raise ValueError(f"{name} is {list(values)!r:.80}, {allowed}")
  return (*map(float, values), *[0.0] * (6 - len(values)))


def sticks(value: float) -> float:
  """Returns the deflection of a stick without its dead zone."""
  size = (abs(value) - _DEAD) / (1 - _DEAD)
  return math.copysign(min(size, 1.0), value) if size > 0 else 0.0


class Hardware(Desk):
  """A desk device that is asked for its deflections."""

  def read(self, now: float) -> Reading:
    """Asks the hardware when it is time, and returns where the hand is."""
    if self._time is None or now - self._asked >= _EVERY:
      self._asked = now
      self.ask()
    return super().read(now)

  _asked = 0.0

  def ask(self) -> None:
    """Feeds what the hardware says; DeviceError if it is gone."""
    raise NotImplementedError


class Gamepad(Hardware):
  """A gamepad by pygame: left stick across the picture, right stick depth and roll, hat the wrist.

  Buttons: 0 grips, 1 reports, 2 or either shoulder is the clutch, 7 pauses.
  """

  def __init__(self, index: int = 0):
    """Opens the gamepad with a number."""
    super().__init__("gamepad")
    self._index = index
    self._pygame: Any = library("pygame", "gamepad")
    self._pygame.init()
    if not self.reopen():
      found = self._pygame.joystick.get_count()
      raise DeviceError(f"gamepad {index}: there is none; {found} found")

  def reopen(self) -> bool:
    """Looks for it again."""
    joystick = self._pygame.joystick
    joystick.quit()
    joystick.init()
    if joystick.get_count() <= self._index:
      return False
    self._pad = joystick.Joystick(self._index)
    self._pad.init()
    return True

  def ask(self) -> None:
    """Feeds sticks and buttons."""
    # Without a window of pygame events still have to be fetched.
    self._pygame.event.pump()
    if not self._pad.get_init() or self._pygame.joystick.get_count() <= self._index:
      raise DeviceError(f"{self.name}: it is gone")
    pad, count = self._pad, self._pad.get_numaxes()
    x, y, u, v = (sticks(pad.get_axis(i)) if i < count else 0.0 for i in (0, 1, 2, 3))
    right, up = pad.get_hat(0) if pad.get_numhats() else (0, 0)
    down = {i for i in range(pad.get_numbuttons()) if pad.get_button(i)}
    names = {0: "grip", 1: "report", 2: "clutch", 4: "clutch", 5: "clutch", 7: "pause"}
    self.feed(rate=(x, -y, v, u, up, right), buttons={names[i] for i in down & set(names)})

  def close(self) -> None:
    """Lets go of it."""
    self._pygame.joystick.quit()


class SpaceMouse(Hardware):
  """A SpaceMouse by pyspacemouse: pushed as the tip is to go, twisted to roll.

  Buttons: the first is the clutch, the second grips, or reports where there are no jaws.
  """

  def __init__(self):
    """Opens the first one."""
    super().__init__("spacemouse")
    self._library: Any = library("pyspacemouse", "spacemouse")
    self._mouse: Any = None
    if not self.reopen():
      raise DeviceError("spacemouse: none was found")

  def reopen(self) -> bool:
    """Looks for it again."""
    try:
      self._mouse = self._library.open(axis_convention="hid_z_up")
    except Exception as error:  # the library's, hidapi's or the system's
      raise DeviceError(f"spacemouse: {error}") from error
    return self._mouse is not None

  def ask(self) -> None:
    """Feeds deflections and buttons."""
    try:
      state = self._mouse.read()
    except Exception as error:
      raise DeviceError(f"{self.name}: {error}") from error
    first, second, *_ = [*state.buttons, 0, 0]
    held = {"clutch"} if first else set()
    rate = [sticks(min(max(v, -1.0), 1.0)) for v in (state.x, state.z, -state.y, state.yaw)]
    self.feed(rate=rate, buttons=held | ({"grip", "report"} if second else set()))

  def close(self) -> None:
    """Lets go of it."""
    if self._mouse is not None:
      self._mouse.close()
