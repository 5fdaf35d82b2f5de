"""Kinematics of wristed instruments: the pose of the tip, and the joints that give it.

Joints are `pitch`, `yaw`, `roll`, `insertion`, `wrist_pitch` and `wrist_yaw`. The first four are
those of every instrument, see `trocar`. Where all joints are zero the wrist's first axis is along
-y of the instrument's frame, its second along x. The tip's frame has its z back along the jaws and
its y along the second axis.

These are the joints of the patient side manipulator of the da Vinci Research Kit (dVRK), signs
included: with the instrument's frame turned by -90 degrees about z its `outer_yaw` is `pitch` here,
its `outer_pitch` is `yaw`, and its `outer_insertion` is longer by `INSERTION`. Table of
Denavit-Hartenberg parameters, lengths and ranges: dVRK, sawIntuitiveResearchKit,
share/kinematic/psm.json and share/tool/LARGE_NEEDLE_DRIVER_400006.json; the dVRK user guide;
Fontanelli et al. 2017, 10.1109/IROS.2017.8205968. Lengths are in m, angles in rad.
"""

import math
from collections.abc import Sequence

import numpy as np

from .trocar import WRIST, Trocar, about

INSERTION = 0.1163  # what the dVRK adds to `insertion`
_SINGULAR = 1e-9  # how near the second axis may be to the line through the trocar
Joints = Sequence[float] | np.ndarray


def joints(port: Trocar) -> tuple[str, ...]:
  """Returns the names of an instrument's joints, in the order of this module."""
  return ("pitch", "yaw", "roll", "insertion", *(WRIST if port.wrist else ()))


def forward(port: Trocar, joints: Joints) -> tuple[np.ndarray, np.ndarray]:
  """Returns the tip's position (3,) and its frame in columns (3, 3), both in the world.

  Args:
    port: of the instrument; one without a wrist has a tip that stands as its shaft
    joints: pitch, yaw, roll, insertion, and those of the wrist, if it has one  (4,) or (6,)
  """
  pitch, yaw, roll, insertion = (float(q) for q in joints[:4])
  turn = port.mat @ about(0, pitch) @ about(1, -yaw)
  pos = port.pos - (port.depth - sum(port.wrist) + insertion) * turn[:, 2]
  turn = turn @ about(2, -roll)
  if port.wrist:
    turn = turn @ about(1, -joints[4])
    pos = pos - port.wrist[0] * turn[:, 2]
    turn = turn @ about(0, joints[5]) @ about(2, -math.pi / 2)
    pos = pos - port.wrist[1] * turn[:, 2]
  return pos, turn


def inverse(port: Trocar, pos, mat, near: float = 0.0) -> np.ndarray:
  """Returns the joints that put the tip at a place with a frame; the shaft goes through the trocar.

  Of the two solutions it is the one with the wrist bent by less than a right angle. Each joint is
  kept within its range, where the pose is out of reach. An instrument without a wrist takes from
  the frame its roll alone.

  Args:
    port: of the instrument
    pos: of the tip in the world  (3,)
    mat: its frame in columns  (3, 3)
    near: of the rolls that are whole turns apart, the range's nearest to this one is taken

  Returns:
    pitch, yaw, roll, insertion, and those of the wrist, if it has one  (4,) or (6,).
  """
  axes = (port.mat.T @ mat).T.tolist()
  x, y, z = (port.mat.T @ np.subtract(pos, port.pos)).tolist()
  link = axes[2]  # back along what the first axis of the wrist carries
  if port.wrist:
    # The shaft and the link are across the first axis, so the plane of the link and the second axis
    # holds the trocar: the link is the part across that axis of the way there.
    between, beyond = port.wrist
    x, y, z = x + beyond * link[0], y + beyond * link[1], z + beyond * link[2]
    a, b, c = axes[1]
    along = x * a + y * b + z * c
    across = (along * a - x, along * b - y, along * c - z)
    far = math.hypot(*across)
    if far > _SINGULAR:
      link = [across[0] / far, across[1] / far, across[2] / far]
    x, y, z = x + between * link[0], y + between * link[1], z + between * link[2]
  pitch, yaw = math.atan2(y, -z), math.atan2(x, math.hypot(y, z))
  insertion = math.hypot(x, y, z) - (port.depth - sum(port.wrist))
  if not port.wrist:
    u, v, _ = _rolled(axes[0], pitch, yaw, 0.0)
    return _within(port, [pitch, yaw, math.atan2(-v, u), insertion])
  # The first axis in the frame of the shaft is (sin roll, cos roll, 0).
  u, v, _ = _rolled(_cross(link, axes[1]), pitch, yaw, 0.0)
  most, turn = float(port.ranges[3, 1]), 2 * math.pi
  roll = near + math.remainder(math.atan2(u, v) - near, turn)
  if abs(roll) > most:
    roll = math.remainder(roll, turn)
  u, _, w = _rolled(link, pitch, yaw, roll)
  wrist_pitch = math.atan2(-u, w)
  u, v, w = _rolled(axes[2], pitch, yaw, roll)
  w = w * math.cos(wrist_pitch) - u * math.sin(wrist_pitch)
  return _within(port, [pitch, yaw, roll, insertion, wrist_pitch, math.atan2(-v, w)])


def _rolled(v: Sequence[float], pitch: float, yaw: float, roll: float) -> tuple[float, ...]:
  """Returns a vector of the instrument's frame in that of its rolled shaft."""
  x, y, z = v
  c, s = math.cos(pitch), math.sin(pitch)
  y, z = c * y + s * z, c * z - s * y
  c, s = math.cos(yaw), math.sin(yaw)
  x, z = c * x + s * z, c * z - s * x
  c, s = math.cos(roll), math.sin(roll)
  return c * x - s * y, s * x + c * y, z


def _cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, ...]:
  """Returns the cross product of two vectors; in plain numbers, for a loop of 1 kHz."""
  return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _within(port: Trocar, joints: list[float]) -> np.ndarray:
  """Returns joints within their ranges."""
  order = [0, 1, 3, 2, 4, 5][: len(joints)]
  limits = port.ranges[order].tolist()
  return np.array([min(max(q, a), b) for q, (a, b) in zip(joints, limits, strict=True)])
