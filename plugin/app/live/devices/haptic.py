"""Force-feedback devices by their makers' libraries, each imported only when it is asked for.

They were written after the packages' own interfaces and tried without hardware. Each runs in a
thread of its own, and lets go by itself when the loop says nothing for 50 ms.
"""

import ctypes
import math
import threading
import time
from typing import Any

import mujoco
import numpy as np

from .device import STILL, DeviceError, Four, Reading, Silent, Three, library

_WATCHDOG = 0.05  # [s]


class Servo(Silent):
  """What they share: the library, the last reading and force, and a watchdog between them."""

  relative = False
  module = ""  # of the maker's library

  def __init__(self, index: int = 0):
    """Opens the device with a number."""
    self._library: Any = library(self.module, self.name, ", and the maker's SDK")
    self._index, self._error = index, ""
    self._reading: Reading | None = None
    self._wrench, self._sent = (STILL, STILL), -math.inf
    if not self.reopen():
      raise DeviceError(f"{self.name}: {self.missing()}")

  def missing(self) -> str:
    """Returns why the device could not be opened."""
    return f"no device {self._index} was found"

  def read(self, now: float) -> Reading | None:
    """Returns the last reading, once."""
    if self._error:
      raise DeviceError(f"{self.name}: {self._error}")
    reading, self._reading = self._reading, None
    return reading

  def send(self, force: Three, torque: Three) -> None:
    """Gives the force to the device's own thread."""
    self._wrench, self._sent = (force, torque), time.monotonic()

  def wrench(self) -> tuple[Three, Three]:
    """Returns force and torque for the device now, zero once the loop has fallen silent."""
    late = time.monotonic() - self._sent > _WATCHDOG
    return (STILL, STILL) if late else self._wrench

  def run(self) -> None:
    """Exchanges forces for readings until `stop`."""
    try:
      while not self._stop.is_set():
        self._reading = self.exchange(*self.wrench())
    except Exception as error:  # the library's own
      self._error = f"{type(error).__name__}: {error}"

  def exchange(self, force: Three, torque: Three) -> Reading:
    """Gives the device a force and returns what the hand does."""
    raise NotImplementedError

  def start(self) -> None:
    """Starts the device's own thread."""
    self._error, self._stop = "", threading.Event()
    self._thread = threading.Thread(target=self.run, name=self.name, daemon=True)
    self._thread.start()

  def stop(self) -> None:
    """Ends it, the force at zero."""
    self._wrench = (STILL, STILL)
    self._stop.set()
    self._thread.join(1.0)


class ForceDimension(Servo):
  """Omega, delta, sigma and lambda by forcedimension-core; needs the Force Dimension SDK."""

  name = "forcedimension"
  module = "forcedimension_core.dhd"
  force_limit = 12.0
  torque_limit = 0.4

  def missing(self) -> str:
    """See `Servo`."""
    return f"no device {self._index}: {self._library.errorGetLastStr()}"

  def reopen(self) -> bool:
    """Opens it again."""
    self._id = self._library.openID(self._index)
    if self._id < 0:
      return False
    self._library.enableForce(True, self._id)
    self._frame = [[0.0] * 3 for _ in range(3)]
    self.start()
    return True

  def exchange(self, force: Three, torque: Three) -> Reading:
    """Its axes: x towards the person, y to the right, z up."""
    dhd, pos, frame = self._library, [0.0] * 3, self._frame
    (x, y, z), (a, b, c) = force, torque
    if dhd.setForceAndTorque([z, x, y], [c, a, b], self._id) < 0:
      raise OSError(dhd.errorGetLastStr())
    if dhd.getPositionAndOrientationFrame(pos, frame, self._id) < 0:
      raise OSError(dhd.errorGetLastStr())
    order = (1, 2, 0)
    mat = [[frame[i][j] for j in order] for i in order]
    held = frozenset({"clutch"} if dhd.getButtonMask(self._id) & 1 else ())
    jaw, angle = None, ctypes.c_double()
    if dhd.hasGripper(self._id) and dhd.getGripperAngleRad(angle, self._id) >= 0:
      jaw = min(max(2 * abs(angle.value) / 0.5 - 1, -1.0), 1.0)
    return Reading((pos[1], pos[2], pos[0]), quaternion(mat), 0.0, jaw, held)

  def close(self) -> None:
    """Stops it."""
    self.stop()
    self._library.stop(self._id)
    self._library.close(self._id)


class Haply(Servo):
  """Inverse3 by haplyhardwareapi: a place and a force, no orientation."""

  name = "haply"
  module = "HaplyHardwareAPI"
  force_limit = 8.0

  def missing(self) -> str:
    """See `Servo`."""
    return f"no Inverse3 with number {self._index} was found"

  def reopen(self) -> bool:
    """Opens it again."""
    ports = self._library.detect_inverse3s()
    if len(ports) <= self._index:
      return False
    self._device = self._library.Inverse3(self._library.SerialStream(ports[self._index]))
    self._device.device_wakeup_dict()
    self.start()
    return True

  def exchange(self, force: Three, torque: Three) -> Reading:
    """Its axes: x to the right, y away from the person, z up."""
    x, y, z = force
    (u, v, w), _ = self._device.end_effector_force([x, -z, y])
    return Reading((u, w, -v))

  def close(self) -> None:
    """Stops it."""
    self.stop()
    self._device.end_effector_force([0.0, 0.0, 0.0])


class OpenHaptics(Servo):
  """Touch and Touch X by pyOpenHaptics; needs 3D Systems' OpenHaptics and driver."""

  name = "openhaptics"
  module = "pyOpenHaptics.hd"
  force_limit = 3.3

  def reopen(self) -> bool:
    """Opens the default device; its scheduler calls `exchange`."""
    callback = library("pyOpenHaptics.hd_callback", self.name).hd_callback
    self._scheduled = callback(self._serve)  # must live as long as the scheduler
    self._device = library("pyOpenHaptics.hd_device", self.name).HapticDevice(self._scheduled)
    return self._device.id is not None

  def _serve(self) -> None:
    try:
      self._reading = self.exchange(*self.wrench())
    except Exception as error:
      self._error = f"{type(error).__name__}: {error}"

  def exchange(self, force: Three, torque: Three) -> Reading:
    """Its axes are those of every device; its lengths are in mm, its matrix in columns."""
    self._library.set_force(list(force))
    columns = self._library.get_transform()
    mat = [[columns[j][i] for j in range(3)] for i in range(3)]
    x, y, z = (1e-3 * columns[3][i] for i in range(3))
    bits = self._library.get_buttons()
    held = frozenset(name for i, name in enumerate(("clutch", "grip")) if bits >> i & 1)
    return Reading((x, y, z), quaternion(mat), buttons=held)

  def close(self) -> None:
    """Stops it."""
    self._wrench = (STILL, STILL)
    self._device.close()


def quaternion(mat: list[list[float]]) -> Four:
  """Returns the quaternion of a rotation matrix, w x y z."""
  quat = np.empty(4)
  mujoco.mju_mat2Quat(quat, np.ravel(mat))
  w, x, y, z = quat.tolist()
  return (w, x, y, z)
