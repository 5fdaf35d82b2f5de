"""What a device for the hand is.

Axes of a device: x to the right, y up, z towards the person, as the laparoscope's picture has them.
"""

import importlib
from typing import Any, NamedTuple, Protocol

Three = tuple[float, float, float]
Four = tuple[float, float, float, float]
STILL: Three = (0.0, 0.0, 0.0)


class DeviceError(RuntimeError):
  """A device that cannot be opened, or that has vanished."""


class Reading(NamedTuple):
  """What a hand does now.

  Attributes:
    pos: place [m], in the device's axes
    quat: orientation, w x y z; None where the device knows none: the shaft then stands as its place
      has it, turned by `roll`
    roll: about the shaft [rad]
    jaw: opening of the jaws, 1 is wide open, -1 squeezes; None where the button `grip` closes them
    buttons: those that are held: `clutch` (the instrument stays while the hand moves), `grip`,
      `report`, `pause`
    lean: of a wrist, upwards and to the right, where `quat` is None [rad]  (2,)
  """

  pos: Three
  quat: Four | None = None
  roll: float = 0.0
  jaw: float | None = None
  buttons: frozenset[str] = frozenset()
  lean: tuple[float, float] = (0.0, 0.0)


class Device(Protocol):
  """A device for one hand.

  Attributes:
    name: for people
    rate: readings a second
    workspace: lower and upper corner of where the hand can be [m]
    force_limit: largest force it gives [N], 0 for one that gives none
    torque_limit: the same for torque [N m]
    relative: whether only its movements mean something, so that its zero may drift
    stamp: of the last reading, by the clock of whoever made it, for the way from hand to picture
  """

  name: str
  rate: float
  workspace: tuple[Three, Three]
  force_limit: float
  torque_limit: float
  relative: bool
  stamp: float

  def read(self, now: float) -> Reading | None:
    """Returns the latest reading, None where there is none since the last; never waits.

    Args:
      now: time of the loop [s]

    Raises:
      DeviceError: it is gone.
    """
    ...

  def send(self, force: Three, torque: Three) -> None:
    """Makes the hand feel a force [N] and a torque [N m], in the device's axes; never waits.

    Raises:
      DeviceError: it is gone.
    """
    ...

  def reopen(self) -> bool:
    """Tries to find a device again that was gone; returns whether it is there."""
    ...

  def close(self) -> None:
    """Sets the forces to zero and lets go of it."""
    ...


class Silent:
  """What devices without forces share."""

  name = "device"
  rate = 1000.0
  workspace: tuple[Three, Three] = ((-0.2, -0.2, -0.2), (0.2, 0.2, 0.2))
  force_limit = 0.0
  torque_limit = 0.0
  relative = True
  stamp = 0.0

  def send(self, force: Three, torque: Three) -> None:
    """Does nothing."""

  def reopen(self) -> bool:
    """Returns True: it is always there."""
    return True

  def close(self) -> None:
    """Does nothing."""


def library(module: str, extra: str, also: str = "") -> Any:
  """Returns a package that only some devices need; DeviceError says what to install."""
  try:
    return importlib.import_module(module)
  except (ImportError, OSError, AttributeError) as error:
    raise DeviceError(f"{extra}: {error}; pip install 'palpate[{extra}]'{also}") from error
