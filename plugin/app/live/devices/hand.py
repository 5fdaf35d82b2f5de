"""A simulated hand: a mass with damping that wants to be somewhere and feels forces."""

from collections.abc import Callable

from .device import STILL, DeviceError, Four, Reading, Silent, Three


class Hand(Silent):
  """A device without hardware, for tests and demonstrations; repeats to the bit.

  The hand has `mass` and `damping` and is pulled towards `goal(t)` with `stiffness`; with stiffness
  0 it flies free. Its axes are those of every device.

  Attributes:
    pos: where it is [m]
    vel: its velocity [m/s]
    force: what it feels [N]
    torque: the same [N m]
    gone: whether it says nothing any more, as an unplugged device
  """

  name = "hand"
  relative = False
  force_limit = 10.0
  torque_limit = 0.5

  def __init__(
    self,
    goal: Callable[[float], Three] | None = None,
    mass: float = 0.2,
    damping: float = 2.0,
    stiffness: float = 200.0,
    rate: float = 1000.0,
    buttons: Callable[[float], frozenset[str]] | None = None,
    quat: Callable[[float], Four] | None = None,
  ):
    """Makes a hand.

    Args:
      goal: takes the time [s] since the first reading, returns where it wants to be [m]
      mass: of hand and device [kg]
      damping: of the hand [N s/m]
      stiffness: with which it goes where it wants [N/m]
      rate: readings a second
      buttons: takes the time [s], returns those that are held
      quat: the same for its orientation
    """
    self._goal, self._buttons, self._quat = goal, buttons, quat
    self.mass, self.damping, self.stiffness, self.rate = mass, damping, stiffness, rate
    self.pos, self.vel = STILL if goal is None else goal(0.0), STILL
    self.force, self.torque = STILL, STILL
    self.gone = False
    self._start: float | None = None
    self._now, self._due = 0.0, 0.0

  @property
  def energy(self) -> float:
    """Its kinetic energy [J]."""
    return 0.5 * self.mass * sum(v * v for v in self.vel)

  def read(self, now: float) -> Reading | None:
    """Moves until now and says where it is; nothing between the readings of a slow one."""
    if self.gone:
      raise DeviceError(f"{self.name}: it is gone")
    if self._start is None:
      self._start = self._now = now
    h, self._now = now - self._now, now
    t = now - self._start
    goal = STILL if self._goal is None else self._goal(t)
    pull = 0.0 if self._goal is None else self.stiffness
    # Implicit in the hand's own spring and damper; axis by axis in words, as each step asks for it.
    a, b = h / self.mass, 1 + h * self.damping / self.mass + h * h * pull / self.mass
    (x, y, z), (u, v, w), (f, g, k) = self.pos, self.vel, self.force
    u = (u + a * (f + pull * (goal[0] - x))) / b
    v = (v + a * (g + pull * (goal[1] - y))) / b
    w = (w + a * (k + pull * (goal[2] - z))) / b
    self.vel, self.pos = (u, v, w), (x + h * u, y + h * v, z + h * w)
    if t < self._due - 1e-9:
      return None
    self._due += 1 / self.rate
    held = self._buttons(t) if self._buttons else frozenset()
    return Reading(self.pos, self._quat(t) if self._quat else None, buttons=held)

  def send(self, force: Three, torque: Three) -> None:
    """Feels."""
    if self.gone:
      raise DeviceError(f"{self.name}: it is gone")
    self.force, self.torque = force, torque

  def reopen(self) -> bool:
    """Returns whether it is there again."""
    if not self.gone:
      self._start, self._due = None, 0.0
    return not self.gone
