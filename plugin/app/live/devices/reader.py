"""Reads a device that may vanish, fall silent, or say what no hand does."""

import math

from .device import Device, DeviceError, Reading
from .relative import Desk

_RETRY = 0.5  # between tries to find a device again [s]
_FASTEST, _STEP = 3.0, 0.01  # a hand's speed [m/s], and what no reading need explain [m]


class Reader:
  """Reads one device.

  Attributes:
    device: that is read
    state: `good`, of the last reading; `jump` for a movement that no hand makes, `bad` for what is
      no pose; `lost` until there is a reading again
    message: the last fault, for people
  """

  def __init__(self, device: Device):
    """Takes a device."""
    self.device, self.state, self.message = device, "good", ""
    self._open, self._tried = True, -math.inf
    self._before, self._time = None, 0.0  # place of the last reading, and when it was
    self.wait()

  def wait(self) -> None:
    """Waits for the next reading, however long it takes."""
    self._heard = math.inf

  def lose(self, message: str) -> None:
    """Takes the device for gone."""
    self.state, self.message, self._open = "lost", message, False
    self._before = None
    self.wait()

  def read(self, now: float, step: float, patience: float) -> Reading | None:
    """Returns what the hand does; None where there is nothing new, or nothing to go by.

    Args:
      now: time of the loop [s]
      step: of the simulation between readings, by which keys and sticks go [s]
      patience: how long a device may say nothing, beyond its own rate [s]
    """
    device = self.device
    if isinstance(device, Desk):
      device.step = step
    try:
      if not self._open:
        if now - self._tried < _RETRY:
          return None
        self._tried = now
        self._open = device.reopen()
        if not self._open:
          return None
      reading = device.read(now)
    except DeviceError as error:
      self._tried = now
      return self.lose(str(error))
    if reading is None:
      if now - self._heard > patience + 1 / device.rate:
        self._tried = now
        self.lose(f"{device.name}: no reading for {patience:g} s")
      return None
    self.state = self._check(reading, now)
    if self.state == "bad":
      return None
    self._heard = now
    return reading

  def _check(self, reading: Reading, now: float) -> str:
    """Returns `good`, `jump` or `bad`."""
    pos, quat, roll, jaw, _, lean = reading
    numbers = pos[0] + pos[1] + pos[2] + roll + sum(quat or lean) + (jaw or 0.0)
    if not math.isfinite(numbers) or (quat and sum(q * q for q in quat) < 1e-6):
      pose = f"{pos} {quat or ''}".strip()
      self.message = f"{self.device.name}: pose is {pose}, expected finite numbers"
      return "bad"
    before, self._before = self._before, pos
    span, self._time = now - self._time, now
    if before is None or (moved := math.dist(before, pos)) <= _STEP + _FASTEST * span:
      return "good"
    self.message = f"{self.device.name}: jumped {1e3 * moved:.0f} mm in {1e3 * span:.0f} ms"
    return "jump"
