"""Couples a hand to the handle of an instrument.

From hand to handle: scaling, clutch, and an anchor without steps between slow readings. Back: the
coupling's force and torque, limited, with a ramp at the start, and never with more energy than the
hand has given: its account is that of Hannaford and Ryu 2002, and a force that could overdraw it
before the next reading is made smaller. The spring and the damper themselves
are in the model, see `models.handle`.

In a loop of 1 kHz all of this costs a few microseconds: plain numbers, no arrays.
"""

import dataclasses
import math
import threading
from collections.abc import Sequence

import numpy as np
from palpate.models.handle import Shaft, times

from .devices.device import STILL, Device, DeviceError, Four, Reading, Three
from .devices.reader import Reader

_SAME: Four = (1.0, 0.0, 0.0, 0.0)
_STIRS, _TURNS = 2e-4, 0.005  # of a hand that begins [m], [rad]
_CLOSE, _OPEN = 2.0, -0.6  # speed of the jaws by button [1/s], and where they grip
# Energy that the hand may get before it gives any, and most that is kept account of [J].
_LENT, _CREDIT = 1e-3, 0.05
_LIGHTEST = 0.05  # of hands with a device [kg]
_SLOW = 2.5  # steps between readings from which on a device is a slow one
_EDGE = 0.08  # most by which the force on a slow one changes in a step [N]


@dataclasses.dataclass(frozen=True)
class Options:
  """How a hand is coupled.

  Attributes:
    scale: movement of the instrument for one of the hand [-]
    force_scale: force on the hand for one of the coupling [-]
    force_limit: largest force on the hand, below the device's own [N]
    ramp: how long forces take to come after a start, a pause or a clutch [s]
    leash: how far the anchor may be ahead of the tip with a device that gives no forces [m]
    patience: how long a device may say nothing, beyond its own rate, before it counts as gone [s]
    passive: whether forces keep to the energy that the hand has given
  """

  scale: float = 1.0
  force_scale: float = 1.0
  force_limit: float = 20.0
  ramp: float = 0.5
  leash: float = 0.012
  patience: float = 0.25
  passive: bool = True

  def __post_init__(self):
    for field in dataclasses.fields(self)[:-1]:
      value, least = getattr(self, field.name), field.name in ("scale", "leash", "patience")
      if not (math.isfinite(value) and (value > 0 if least else value >= 0)):
        raise ValueError(f"{field.name} is {value}, expected a number {'>' if least else '>='} 0")


class Track:
  """An anchor that moves without steps of place or speed between slow readings.

  It goes in a straight line to each reading while it waits for the next, and a low pass of half of
  that time rounds the corners: 1.5 times the interval between readings late, and with readings as
  frequent as the steps not late at all.
  """

  def __init__(self, h: float):
    """Takes the step [s]."""
    self._h = h
    self.put([0.0] * 3, 1e-3)

  def put(self, value: list[float], interval: float) -> None:
    """Starts anew at a value, with readings about `interval` [s] apart."""
    self.value, self._line, self._goal = value, value, value
    self._left, self._interval, self._since = 0, max(interval, self._h), 0

  def aim(self, goal: list[float]) -> None:
    """Takes a reading."""
    h = self._h
    span = min(self._since * h, 0.2) or h
    self._interval = interval = max(span, 0.9 * self._interval)  # readings come unevenly
    self._goal, self._since = goal, 0
    slow = interval / h
    # The next one comes before it is there.
    self._left = 1 if slow < 1.5 else round(1.25 * slow) + 1

  def advance(self) -> list[float]:
    """Returns the value of the next step."""
    self._since += 1
    line, goal, n = self._line, self._goal, self._left
    if n <= 1 and self._interval < _SLOW * self._h:  # as most devices are in most steps
      self._line = self.value = goal
      return goal
    if n > 1:
      line = [a + (b - a) / n for a, b in zip(line, goal, strict=True)]
      self._left = n - 1
    else:
      line = goal
    self._line = line
    slow = self._interval / self._h
    if slow < _SLOW:
      self.value = line
    else:
      share = 1 / (1 + 0.5 * slow)
      self.value = [a + share * (b - a) for a, b in zip(self.value, line, strict=True)]
    return self.value


class Link:
  """One device and the handle it moves.

  Attributes:
    options: of the coupling
    state: `ready`, `clutch`, `lost` or `waiting` for the first reading
    row: place [m] and orientation of the anchor  (7,)
    jaw: opening of the jaws [-]
    head: what the hand says of a camera's head, which takes the place of jaws [-]
    grip: whether the button that closes jaws, or switches a current on, is held
    report: whether a place is reported now
    force: last force sent [N], in the device's axes
    energy: what the hand has given, less what it got, and what it is lent at the start [J]
    paused: whether the hand has asked for a pause
  """

  def __init__(self, device: Device, options: Options | None = None, h: float = 1e-3):
    """Couples a device.

    Args:
      device: the hand's
      options: of the coupling
      h: step of the loop [s]
    """
    self._reader, self.options, self._h = Reader(device), options or Options(), h
    self.force: Three = STILL
    self.state = "waiting"
    self.row, self.jaw, self.paused = [0.0] * 3 + list(_SAME), 1.0, False
    self.head = 0.0
    self.grip = self.report = False
    self.energy, self._asked = _LENT, False
    self._place, self._turn = Track(h), Track(h)
    self._gain = 0.0
    self._reference: tuple[Reading, list[float], Four, float] | None = None
    self._roll = 0.0
    self._next: Device | None = None
    # Of which a movement is told; what moves nothing but itself begins at its origin.
    self._still = Reading(STILL) if device.relative else None
    self._last: Reading | None = None
    self._leant = (0.0, 0.0)  # of the last reading
    self.attach(None, STILL, _SAME, np.eye(3))
    self.quiet()

  @property
  def device(self) -> Device:
    """The hand's."""
    return self._reader.device

  @property
  def message(self) -> str:
    """The last fault of the device, for people."""
    return self._reader.message

  def attach(
    self, shaft: Shaft | None, pos: Sequence[float], quat: Sequence[float], axes: np.ndarray,
    closed: bool = False,
  ) -> None:  # fmt: skip
    """Takes the instrument that it moves, where it is: nothing moves by this.

    Args:
      shaft: of the instrument, None for a free body
      pos: of the handle [m]  (3,)
      quat: its orientation  (4,)
      axes: the device's axes in the world, in columns  (3, 3)
      closed: whether the jaws hold something, and stay closed until the hand has closed too
    """
    self._closed = closed
    if closed:
      self.jaw = -1.0
    self._shaft, self._axes = shaft, [float(x) for x in np.asarray(axes).ravel()]
    if shaft is not None:
      self._roll = shaft.roll(pos, quat)
    self._hold([float(x) for x in pos], tuple(float(x) for x in quat))
    self._reader.wait()
    self.state = "waiting"

  def turn(self, axes: np.ndarray) -> None:
    """Takes other axes, as those of a picture that has turned; nothing moves by this."""
    self._axes, self._reference = [float(x) for x in axes.ravel()], None

  def _hold(self, pos: list[float], quat: tuple[float, ...]) -> None:
    self.row = [*pos, *quat]
    self._place.put(pos, 1 / self.device.rate)
    self._turn.put(list(quat), 1 / self.device.rate)
    self._reference, self._gain = None, 0.0

  def hold(self) -> None:
    """Lets the hand move freely while the handle stays; forces are zero."""
    self._hold(self.row[:3], tuple(self.row[3:]))
    self.quiet()

  def quiet(self) -> None:
    """Sets the forces to zero; they come back by the ramp."""
    self._gain, self.force = 0.0, STILL
    self._felt_at: Three | None = None
    self._pushed, self._fast = (0.0, 0.0, 0.0, 0.0), 0.0
    self._send(STILL, STILL)

  def moved(self) -> bool:
    """Returns whether the hand has moved, or pressed a button, since this was asked and it had."""
    last, still = self._last, self._still
    if last is None:
      return False
    if still is None or last.buttons != still.buttons:
      self._still, pressed = last, bool(last.buttons)
      return pressed
    turned = math.dist((last.roll, *last.lean), (still.roll, *still.lean)) > _TURNS
    away = turned or math.dist(last.pos, still.pos) > _STIRS
    if away:
      self._still = None
    return away

  def change(self, device: Device) -> None:
    """Takes another device with its next reading; to be called from any thread."""
    self._next = device

  def _change(self, device: Device) -> None:
    self.quiet()
    # A library may take its time over it.
    threading.Thread(target=self.device.close, daemon=True).start()
    self._reader, self._next = Reader(device), None
    self._hold(self.row[:3], tuple(self.row[3:]))
    self.state = "waiting"

  # From hand to handle.

  def poll(self, now: float, tip: Sequence[float] | None = None) -> bool:
    """Reads the device; returns whether the exercise can go on.

    Args:
      now: time of the loop [s]
      tip: of the instrument [m]; the leash is tied there  (3,)
    """
    if self._next is not None:
      self._change(self._next)
    reading = self._reader.read(now, self._h, self.options.patience)
    if self._reader.state == "lost":
      if self.state != "lost":
        self.state = "lost"
        self.hold()
      return False
    if self.state == "lost":
      self.state = "waiting"
    if reading is not None:
      if self._reader.state == "jump":
        self._hold(self.row[:3], tuple(self.row[3:]))
        self._felt_at = None
      self._take(reading, tip)
    elif self.state == "waiting":
      return False
    self._advance()
    return True

  def _take(self, reading: Reading, tip: Sequence[float] | None) -> None:
    """Aims the anchor at what the hand does."""
    pos, quat, roll, jaw, buttons, lean = self._last = reading
    up, right = lean[0] - self._leant[0], lean[1] - self._leant[1]
    self._leant = lean
    asks, self._asked = not self._asked, "pause" in buttons
    self.paused ^= asks and self._asked
    self.grip, self.report = "grip" in buttons, "report" in buttons
    self._closed &= not (self.grip or (jaw is not None and jaw < 0))
    if self._closed:
      pass
    elif jaw is not None:
      self.jaw = self.head = min(max(jaw, -1.0), 1.0)
    elif buttons or self.jaw != 1.0:
      step, target = _CLOSE / self.device.rate, _OPEN if "grip" in buttons else 1.0
      self.jaw += min(max(target - self.jaw, -step), step)
    if "clutch" in buttons:
      self.state, self._reference = "clutch", None
      return
    self.state = "ready"
    self._motion(reading)
    if self._reference is None:
      w, x, y, z = self.row[3:]
      self._reference = reading, self.row[:3], (w, x, y, z), self._roll - roll
      return
    first, center, turned, turn = self._reference
    m, scale, (a, b, c) = self._axes, self.options.scale, first.pos
    x, y, z = scale * (pos[0] - a), scale * (pos[1] - b), scale * (pos[2] - c)
    goal = [
      center[0] + m[0] * x + m[1] * y + m[2] * z,
      center[1] + m[3] * x + m[4] * y + m[5] * z,
      center[2] + m[6] * x + m[7] * y + m[8] * z,
    ]
    held = self._bound(goal, tip)
    if self.device.relative and held != goal:  # a mouse that goes on moves nothing; back, it does
      shift = [a + b - c for a, b, c in zip(center, held, goal, strict=True)]
      self._reference = first, shift, turned, turn
    self._roll = min(max(turn + roll, -3.1), 3.1)
    if self._shaft is not None and (up or right):
      self._shaft.lean([up * m[k] - right * m[k + 1] for k in (0, 3, 6)], self.row[:3], self._roll)
    if quat is not None:
      self._turn.aim(list(_nearest(self._turned(reading, first, turned), self._turn.value)))
    self._place.aim(held)

  def _bound(self, goal: list[float], tip: Sequence[float] | None) -> list[float]:
    if self._shaft is not None:
      goal = self._shaft.within(goal)
    if tip is not None and not self.device.force_limit:
      far = math.dist(goal, tip)
      if far > self.options.leash:
        share = self.options.leash / far
        goal = [b + share * (a - b) for a, b in zip(goal, tip, strict=True)]
    x, y, z = goal
    if -1.0 <= x <= 1.0 and -1.0 <= y <= 1.0 and -1.0 <= z <= 1.0:
      return goal
    return [min(max(x, -1.0), 1.0), min(max(y, -1.0), 1.0), min(max(z, -1.0), 1.0)]

  def _turned(self, reading: Reading, first: Reading, turned: Four) -> Four:
    """Returns the handle's orientation for a device that knows its own."""
    w, x, y, z = first.quat or _SAME
    w, x, y, z = times(reading.quat or _SAME, (w, -x, -y, -z))
    m = self._axes
    turn = (
      w,
      m[0] * x + m[1] * y + m[2] * z,
      m[3] * x + m[4] * y + m[5] * z,
      m[6] * x + m[7] * y + m[8] * z,
    )
    return times(turn, turned)

  def _advance(self) -> None:
    pos = self._place.advance()
    if self._shaft is not None and (self._reference is None or self._reference[0].quat is None):
      quat = _nearest(self._shaft.quat(pos, self._roll), self.row[3:])
      self._turn.value = list(quat)
    else:
      w, x, y, z = self._turn.advance()
      scale = 1 / math.sqrt(w * w + x * x + y * y + z * z)
      quat = (w * scale, x * scale, y * scale, z * scale)
    self.row = [*pos, *quat]

  # From handle to hand.

  def _motion(self, reading: Reading) -> None:
    """Takes account of the energy since the last reading."""
    before, self._felt_at = self._felt_at, reading.pos
    if before is None:
      return
    (a, b, c), (d, e, f) = reading.pos, before
    u, v, w = a - d, b - e, c - f
    x, y, z, count = self._pushed  # summed over the steps since then
    given = -(x * u + y * v + z * w) / max(count, 1.0)
    self._pushed = (0.0, 0.0, 0.0, 0.0)
    self.energy = min(self.energy + given, _CREDIT)
    self._fast = self.device.rate * math.sqrt(u * u + v * v + w * w)

  def feel(self, wrench: Sequence[float]) -> None:
    """Makes the hand feel what the handle feels.

    Args:
      wrench: force [N] and torque [N m] on the handle, in the world  (6,)
    """
    device, options, h = self.device, self.options, self._h
    if not math.isfinite(sum(wrench)):  # of a motion that diverged
      return self.quiet()
    if not device.force_limit or self.state != "ready":
      self.force = STILL
      return
    if self._gain < 1.0:
      self._gain = min(self._gain + h / max(options.ramp, h), 1.0)
    m, scale = self._axes, self._gain * options.force_scale
    force = _into(m, wrench[0], wrench[1], wrench[2], scale)
    force = _limited(force, min(device.force_limit, options.force_limit))
    if device.rate * h * _SLOW < 1:
      force = _towards(self.force, force, _EDGE)
    if options.passive:
      force = self._affordable(force)
    torque = STILL
    if device.torque_limit:
      torque = _into(m, wrench[3], wrench[4], wrench[5], scale)
      torque = _limited(torque, device.torque_limit)
    self.force = x, y, z = force
    a, b, c, count = self._pushed
    self._pushed = a + x, b + y, c + z, count + 1
    self._send(force, torque)

  def _affordable(self, force: Three) -> Three:
    """Returns a force made so small that it cannot give the hand more energy than there is.

    Until the next reading the hand goes no further than its speed takes it, and the force itself
    takes the lightest of hands.
    """
    x, y, z = force
    size, interval = math.sqrt(x * x + y * y + z * z), 1 / self.device.rate
    far = (self._fast + size * interval / _LIGHTEST) * interval
    if size * far <= self.energy or size < 1e-9:
      return force
    scale = max(self.energy, 0.0) / max(size * far, 1e-9 * size)
    return (x * scale, y * scale, z * scale)

  def _send(self, force: Three, torque: Three) -> None:
    device = self.device
    if device.force_limit:
      try:
        device.send(force, torque)
      except DeviceError as error:
        self._reader.lose(str(error))
        self.state, self.force = "lost", STILL


def _into(m: list[float], x: float, y: float, z: float, scale: float) -> Three:
  """Returns a vector of the world in the device's axes, scaled."""
  return (
    scale * (m[0] * x + m[3] * y + m[6] * z),
    scale * (m[1] * x + m[4] * y + m[7] * z),
    scale * (m[2] * x + m[5] * y + m[8] * z),
  )


def _limited(vector: Three, most: float) -> Three:
  """Returns a vector that is no longer than `most`."""
  x, y, z = vector
  length = math.sqrt(x * x + y * y + z * z)
  if length <= most:
    return vector
  scale = most / length
  return (x * scale, y * scale, z * scale)


def _towards(start: Three, goal: Three, most: float) -> Three:
  """Returns where one is on the way from start to goal, `most` further."""
  x, y, z = (b - a for a, b in zip(start, goal, strict=True))
  length = math.sqrt(x * x + y * y + z * z)
  if length <= most:
    return goal
  share = most / length
  return (start[0] + share * x, start[1] + share * y, start[2] + share * z)


def _nearest(quat: Four, like: Sequence[float]) -> Four:
  """Returns of the two quaternions of a rotation the one nearer to another."""
  w, x, y, z = quat
  same = w * like[0] + x * like[1] + y * like[2] + z * like[3] >= 0
  return quat if same else (-w, -x, -y, -z)
