"""The laparoscope of a scene whose camera stands: somebody holds it, or it follows the instrument.

It is about a trocar behind the view that the scene begins with. A hand moves the lens across the
picture and along the shaft, and rolls the scope; the camera stays level, or as far from that as the
hand says by `jaw`. The script that follows keeps the tip in the middle, slowly, and only where it
has strayed from there.
"""

import math
from typing import Any

import numpy as np
from palpate.models import laparoscope, trocar
from palpate.models.laparoscope import Pose

from .coupling import Options
from .devices.device import Device, Reading
from .devices.reader import Reader

DEPTH = 0.08  # from the trocar to the lens where a scene begins [m]
REACH = (-0.04, 0.12)  # of the insertion from there [m]
_WIDEST = 1.0  # of pitch and yaw [rad]
_CLEAR = 0.02  # that the lens keeps from the organ [m]
_STRAYED, _MIDDLE = 0.4, 0.06  # where following begins and ends, as shares of half the picture
_SPEED, _TURN = 0.03, 0.5  # of following: lens [m/s], scope and camera [rad/s]
_FAR = (0.07, 0.2)  # from the tip to the lens that follows it [m]
_SAME = 1e-9


class Scope:
  """A laparoscope that meets nothing.

  Other threads may set `follows`.

  Attributes:
    follows: whether it keeps the tip in the picture's middle by itself
    pos: of the lens [m]  (3,)
    mat: the picture's axes right, up, back in columns  (3, 3)
  """

  def __init__(
    self, device: Device, pos: np.ndarray, mat: np.ndarray, fovy: float,
    optics: float = laparoscope.OPTICS,
  ):  # fmt: skip
    """Takes it where a view is.

    Args:
      device: of the hand
      pos: of the lens [m]  (3,)
      mat: the picture's axes  (3, 3)
      fovy: its vertical field of view [deg]
      optics: angle between shaft and view [rad]
    """
    self._reader, self.follows, self.pos, self.mat = Reader(device), False, pos, mat
    self._optics, self._half = optics, math.tan(math.radians(fovy) / 2)
    self._port = laparoscope.behind(pos, mat, DEPTH, optics)
    self._joints = Pose(0.0, 0.0, 0.0, 0.0, 0.0)
    self._tilt = laparoscope.level(mat)  # that the camera is held at [rad]
    self._last: Reading | None = None
    self._straying = False

  @property
  def message(self) -> str:
    """What is wrong with the device, for people; empty where nothing is."""
    return "" if self._reader.state == "good" else self._reader.message

  def advance(self, now: float, dt: float, tip: np.ndarray, nodes: np.ndarray) -> bool:
    """Takes it on by a control step; returns whether the view has changed.

    Args:
      now: time of the loop [s]
      dt: duration of the step [s]
      tip: of the instrument [m]  (3,)
      nodes: of the organ, which the lens keeps away from [m]  (n, 3)
    """
    before = self._joints, self._tilt
    self._hold(now, dt)
    if self.follows:
      self._follow(dt, tip)
    if (self._joints, self._tilt) == before:
      return False
    pos, mat = self._view()
    apart, was = (np.linalg.norm(nodes - each, axis=1).min() for each in (pos, self.pos))
    if apart < _CLEAR and apart < was:
      self._joints, self._tilt = before
      return False
    self.pos, self.mat = pos, mat
    return True

  def _view(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns place and axes; the head holds the camera at its tilt."""
    level = self._joints._replace(head=0.0)
    head = self._tilt - laparoscope.level(laparoscope.view(self._port, level, self._optics)[1])
    return laparoscope.view(self._port, level._replace(head=head), self._optics)

  def _hold(self, now: float, dt: float) -> None:
    """Does what the hand does."""
    reading = self._reader.read(now, dt, Options.patience)
    if self._reader.state in ("jump", "lost"):
      self._last = None
    if reading is None:
      return
    last, self._last = self._last, reading
    if reading.jaw is not None and not self.follows:
      self._tilt = math.pi * reading.jaw
    if last is None or "clutch" in reading.buttons:
      return
    x, y, z = (a - b for a, b in zip(reading.pos, last.pos, strict=True))
    roll = reading.roll - last.roll
    if abs(x) + abs(y) + abs(z) + abs(roll) < _SAME:
      return
    across = x * self.mat[:, 0] + y * self.mat[:, 1]
    self._put(self.pos + across, self._joints.roll + roll, -z)

  def _put(self, lens: np.ndarray, roll: float, deeper: float) -> None:
    """Goes to where the lens is towards a place, as deep as it was and so much deeper."""
    pitch, yaw, _ = trocar.inverse(self._port, lens, check=False)
    low, high = REACH
    self._joints = Pose(
      float(np.clip(pitch, -_WIDEST, _WIDEST)), float(np.clip(yaw, -_WIDEST, _WIDEST)),
      math.remainder(roll, 2 * math.pi), float(np.clip(self._joints.insertion + deeper, low, high)),
      0.0,
    )  # fmt: skip

  def _follow(self, dt: float, tip: np.ndarray) -> None:
    """Goes on towards the view that has the tip in its middle."""
    x, y, back = self.mat.T @ (tip - self.pos)
    off = math.hypot(x, y) / (self._half * max(-back, 1e-3)) if back < 0 else math.inf
    self._straying = off > (_MIDDLE if self._straying else _STRAYED)
    self._tilt -= float(np.clip(self._tilt, -_TURN * dt, _TURN * dt))
    if not self._straying:
      return
    far = float(np.clip(np.linalg.norm(tip - self.pos), *_FAR))
    goal = laparoscope.show(self._port, tip, far, self.mat[:, 2], self._optics)
    way = laparoscope.view(self._port, goal, self._optics)[0] - self.pos
    share = min(_SPEED * dt / max(float(np.linalg.norm(way)), _SAME), 1.0)
    turn = math.remainder(goal.roll - self._joints.roll, 2 * math.pi)
    turn = float(np.clip(turn, -_TURN * dt, _TURN * dt))
    deeper = share * (goal.insertion - self._joints.insertion)
    self._put(self.pos + share * way, self._joints.roll + turn, deeper)


def of(model: Any, data: Any, device: Device, optics: float = laparoscope.OPTICS) -> Scope | None:
  """Returns the laparoscope of a scene, None where its camera goes with a body."""
  k = model.camera(laparoscope.NAME).id
  if model.cam_bodyid[k]:
    return None
  pos, mat = data.cam_xpos[k].copy(), data.cam_xmat[k].reshape(3, 3).copy()
  return Scope(device, pos, mat, float(model.cam_fovy[k]), optics)
