"""Where a laparoscope looks from and to, by its joints, and the joints that show a place.

The lens is the instrument's tip, see `trocar`. The optics look down past the shaft by an angle,
0 or 30 degrees: with `roll` zero towards -y of the instrument's frame, and about the shaft with
`roll`. The camera's head turns the picture about its middle. Lengths are in m, angles in rad.
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from palpate.engine.model.flexes import matrix

from .trocar import Trocar, about, forward, inverse

NAME = "laparoscope"
OPTICS = math.radians(30.0)
BESIDE = 0.006  # from the lens to its lamp


class Pose(NamedTuple):
  """The joints of a laparoscope: pitch, yaw, roll, insertion, and the camera's head."""

  pitch: float
  yaw: float
  roll: float
  insertion: float
  head: float


def upright(back: np.ndarray) -> np.ndarray:
  """Returns the axes of a level picture in columns: right, up, and back, a unit vector  (3, 3)."""
  right = np.cross([0.0, 0.0, 1.0], back)
  right /= np.linalg.norm(right)
  return np.column_stack([right, np.cross(back, right), back])


def turned(optics: float) -> np.ndarray:
  """Returns how the body `eye` is turned against the tip, w x y z."""
  return np.array([math.cos(optics / 2), -math.sin(optics / 2), 0.0, 0.0])


def view(port: Trocar, joints, optics: float = OPTICS) -> tuple[np.ndarray, np.ndarray]:
  """Returns where the lens is (3,), and the picture's axes right, up, back in columns (3, 3).

  Args:
    port: of the laparoscope
    joints: as of `Pose`
    optics: angle between shaft and view
  """
  pitch, yaw, roll, insertion, head = joints
  turn = port.mat @ about(0, pitch) @ about(1, -yaw) @ about(2, -roll)
  return forward(port, (pitch, yaw, insertion)), turn @ about(0, -optics) @ about(2, head)


def level(mat: np.ndarray) -> float:
  """Returns the angle of a picture against the horizon; positive where its right is higher."""
  return math.atan2(mat[2, 0], mat[2, 1])


def show(port: Trocar, place, far: float, side, optics: float = OPTICS) -> Pose:
  """Returns the joints that have a place in the middle of a level picture; they may be any number.

  Args:
    port: of the laparoscope
    place: in the world  (3,)
    far: from the lens
    side: direction that it is seen from, as far as the optics allow  (3,)
    optics: angle between shaft and view
  """
  way = np.subtract(place, port.pos)
  reach = float(np.linalg.norm(way))
  along, lean = way / reach, math.asin(min(far * math.sin(optics) / reach, 1.0))
  aside = np.subtract(side, np.dot(side, along) * along)
  aside = aside / max(float(np.linalg.norm(aside)), 1e-9)
  depth = reach * math.cos(lean) - far * math.cos(optics)
  lens = port.pos + depth * (math.cos(lean) * along + math.sin(lean) * aside)
  pitch, yaw, insertion = inverse(port, lens, check=False)
  straight = port.mat @ about(0, pitch) @ about(1, -yaw)
  x, y, _ = straight.T @ (place - lens)
  roll = math.atan2(-x, -y) if optics else 0.0
  joints = Pose(pitch, yaw, roll, insertion, 0.0)
  return joints._replace(head=-level(view(port, joints, optics)[1]))


def behind(pos, mat, depth: float, optics: float = OPTICS) -> Trocar:
  """Returns the port of a laparoscope that has a view with pitch, yaw, roll and head zero.

  Args:
    pos: of the lens  (3,)
    mat: the picture's axes right, up, back in columns  (3, 3)
    depth: from port to lens, with the insertion zero
    optics: angle between shaft and view
  """
  turn = np.asarray(mat) @ about(0, optics)
  return Trocar(NAME, np.asarray(pos) + depth * turn[:, 2], turn, depth)


def stand(model: mujoco.MjModel, camera: int, lamp: int, row) -> None:
  """Puts a camera of the world, and the lamp at its lens, somewhere.

  Args:
    model: changed in place
    camera: its number
    lamp: its number, -1 for none
    row: place of the lens and orientation of the picture, w x y z  (7,)
  """
  model.cam_pos[camera], model.cam_quat[camera] = row[:3], row[3:]
  if lamp >= 0:
    axes = matrix(row[3:])
    model.light_pos[lamp], model.light_dir[lamp] = row[:3] + BESIDE * axes[:, 0], -axes[:, 2]
