"""The handle of an instrument with virtual coupling: where the hand holds it, and what it feels.

The handle is a mocap body with the frame of the tip: its z is along the shaft, back to the hand.
Spring and damper between the two are six site actuators, see `instruments/parts/coupling.xml`.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from palpate.engine.model.flexes import matrix

from . import trocar as ports
from . import wrist

Vector = Sequence[float] | np.ndarray
Quat = tuple[float, float, float, float]
AXES = ("x", "y", "z", "rx", "ry", "rz")
_STILL = (0.0, 0.0, 0.0)


class Handle:
  """The handle of one instrument in one mjData; cheap enough for a loop of 1 kHz."""

  def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, prefix: str = ""):
    """Finds the handle of the instrument whose names start with `prefix`.

    Raises:
      ValueError: it has none.
    """
    try:
      mocap = int(model.body(f"{prefix}handle").mocapid[0])
      acts = [model.actuator(f"{prefix}coupling_{axis}").id for axis in AXES]
      sensors = [int(model.sensor(f"{prefix}coupling_{axis}").adr[0]) for axis in AXES]
    except KeyError:
      raise ValueError(
        f"instrument {prefix!r} has no handle, expected one of the models that end in _handle"
      ) from None
    self.prefix = prefix
    # Views whose numbers are taken and set one by one: a third of the time of arrays so short.
    self._pos, self._quat = data.mocap_pos[mocap].data, data.mocap_quat[mocap].data
    # They are six in a row, in every model that has them.
    self._ctrl = data.ctrl[acts[0] : acts[0] + 6].data
    self._felt = data.sensordata[sensors[0] : sensors[0] + 6].data
    gain, damping = model.actuator_gainprm[acts, 0], -model.actuator_biasprm[acts, 2]
    self._lead = (damping / gain).tolist()  # [s]
    self._turned: tuple[list[float], tuple[float, ...]] = ([], ())  # an orientation and its matrix

  @property
  def pos(self) -> np.ndarray:
    """Where it is in the world [m]  (3,)."""
    return np.array(self._pos)

  @property
  def quat(self) -> np.ndarray:
    """How it is turned, w x y z  (4,)."""
    return np.array(self._quat)

  def move(
    self,
    pos: Vector,
    quat: Vector | None = None,
    vel: Vector | None = None,
    spin: Vector | None = None,
  ) -> None:
    """Puts the handle somewhere.

    Args:
      pos: in the world [m]  (3,)
      quat: orientation, w x y z; as it is if it is left out  (4,)
      vel: its velocity [m/s]; the coupling's damper then acts on the velocity of the tip relative
        to the handle, and without it on that of the tip alone  (3,)
      spin: the same for its angular velocity in the world [rad/s]  (3,)
    """
    place, ctrl = self._pos, self._ctrl
    place[0], place[1], place[2] = pos
    if quat is not None:
      turn = self._quat
      turn[0], turn[1], turn[2], turn[3] = quat
    m = self._matrix()
    (x, y, z), (u, v, w) = vel if vel is not None else _STILL, spin if spin is not None else _STILL
    a, b, c, d, e, f = self._lead
    ctrl[0] = a * (m[0] * x + m[3] * y + m[6] * z)
    ctrl[1] = b * (m[1] * x + m[4] * y + m[7] * z)
    ctrl[2] = c * (m[2] * x + m[5] * y + m[8] * z)
    ctrl[3] = d * (m[0] * u + m[3] * v + m[6] * w)
    ctrl[4] = e * (m[1] * u + m[4] * v + m[7] * w)
    ctrl[5] = f * (m[2] * u + m[5] * v + m[8] * w)

  def wrench(self) -> tuple[float, float, float, float, float, float]:
    """Returns force [N] and torque [N m] that the hand feels, in the world  (6,)."""
    m = self._matrix()
    x, y, z, a, b, c = self._felt.tolist()
    return (
      -m[0] * x - m[1] * y - m[2] * z,
      -m[3] * x - m[4] * y - m[5] * z,
      -m[6] * x - m[7] * y - m[8] * z,
      -m[0] * a - m[1] * b - m[2] * c,
      -m[3] * a - m[4] * b - m[5] * c,
      -m[6] * a - m[7] * b - m[8] * c,
    )

  def _matrix(self) -> tuple[float, ...]:
    """Returns its orientation as a matrix, row by row."""
    quat = self._quat.tolist()
    if quat != self._turned[0]:
      self._turned = quat, _rotation(*quat)
    return self._turned[1]

  def joints(self, trocar: ports.Trocar) -> np.ndarray:
    """Returns the pitch, yaw, roll [rad] and insertion [m] that it asks for  (4,)."""
    pitch, yaw, insertion = ports.inverse(trocar, self._pos, check=False)
    roll = Shaft(trocar).roll(self._pos.tolist(), self._quat.tolist())
    return np.array([pitch, yaw, roll, insertion])


class Tip:
  """The pose that position drives take an instrument's tip to, moved as a `Handle` is.

  Inverse kinematics gives the drives their targets, so the shaft goes through the trocar whatever
  the pose; out of reach it is the nearest one. A telemanipulator's hand feels nothing.

  Attributes:
    port: the instrument's trocar
    pos: where the tip is to be in the world [m]  (3,)
    quat: how it is to be turned, w x y z  (4,)
  """

  def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, prefix: str = ""):
    """Finds the drives of the instrument whose names start with `prefix`."""
    self.prefix, self.port = prefix, ports.trocar(model, prefix)
    names = wrist.joints(self.port)
    self._drives = np.array([model.actuator(prefix + name).id for name in names])
    self._ctrl = data.ctrl
    self.put(data.ctrl[self._drives])

  def put(self, joints: wrist.Joints) -> None:
    """Takes the pose that joints give  (4,) or (6,)."""
    self.pos, mat = wrist.forward(self.port, joints)
    self.quat = ports.orientation(mat)
    self._ctrl[self._drives] = joints

  def move(
    self,
    pos: Vector,
    quat: Vector | None = None,
    vel: Vector | None = None,
    spin: Vector | None = None,
  ) -> None:
    """Sets the pose; arguments as of `Handle.move`, velocities are not used."""
    self.pos, self.quat = np.array(pos), self.quat if quat is None else np.array(quat)
    roll = float(self._ctrl[self._drives[2]])
    self._ctrl[self._drives] = wrist.inverse(self.port, self.pos, matrix(self.quat), roll)

  def wrench(self) -> tuple[float, float, float, float, float, float]:
    """Returns zeros, see `Handle.wrench`."""
    return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0

  def joints(self, trocar: ports.Trocar) -> np.ndarray:
    """Returns the targets of the drives  (4,) or (6,)."""
    return self._ctrl[self._drives]


def find(
  model: mujoco.MjModel, data: mujoco.MjData, prefix: str = "", by_tip: bool = False
) -> Handle | Tip | None:
  """Returns the handle of an instrument; one that has drives has a `Tip`, if asked, or None."""
  known = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, f"{prefix}handle") >= 0
  if known:
    return Handle(model, data, prefix)
  return Tip(model, data, prefix) if by_tip else None


class Shaft:
  """How the shaft of an instrument stands, by where its tip is; for a loop of 1 kHz."""

  def __init__(self, trocar: ports.Trocar):
    """Takes the instrument's trocar."""
    self._pos, self._mat = trocar.pos.tolist(), trocar.mat.T.tolist()
    w, x, y, z = ports.orientation(trocar.mat).tolist()
    self._quat: Quat = (w, x, y, z)
    self.reach = tuple(float(trocar.depth + x) for x in trocar.ranges[2])  # of the tip [m]

  def within(self, pos: Vector) -> list[float]:
    """Returns the point within the reach of the insertion that is nearest to one [m]  (3,)."""
    p = self._pos
    x, y, z = pos[0] - p[0], pos[1] - p[1], pos[2] - p[2]
    far = math.sqrt(x * x + y * y + z * z)
    scale = min(max(far, self.reach[0]), self.reach[1]) / max(far, 1e-9)
    return [p[0] + scale * x, p[1] + scale * y, p[2] + scale * z]

  def quat(self, pos: Vector, roll: float = 0.0) -> Quat:
    """Returns the orientation with the tip at a point [m], rolled by an angle [rad]  (4,)."""
    p, (a, b, c) = self._pos, self._mat
    x, y, z = pos[0] - p[0], pos[1] - p[1], pos[2] - p[2]
    u = a[0] * x + a[1] * y + a[2] * z
    v = b[0] * x + b[1] * y + b[2] * z
    w = c[0] * x + c[1] * y + c[2] * z
    # Half of pitch about x, of -yaw about y, of -roll about z.
    p, q, r = 0.5 * math.atan2(v, -w), -0.5 * math.atan2(u, math.sqrt(v * v + w * w)), -0.5 * roll
    (cp, sp), (cq, sq), (cr, sr) = (
      (math.cos(p), math.sin(p)), (math.cos(q), math.sin(q)), (math.cos(r), math.sin(r))
    )  # fmt: skip
    a, b, c, d = cq * cr, sq * sr, sq * cr, cq * sr
    turn = (cp * a - sp * b, cp * b + sp * a, cp * c - sp * d, cp * d + sp * c)
    return times(self._quat, turn)

  def lean(self, turn: Vector, pos: Vector, roll: float = 0.0) -> None:
    """Turns a wrist by a rotation vector of the world [rad]  (3,); without one nothing turns."""

  def roll(self, pos: Vector, quat: Vector) -> float:
    """Returns the angle about the shaft of an orientation with the tip at a point [rad]."""
    w, x, y, z = self.quat(pos)
    a, b, c, d = quat
    turn = times((w, -x, -y, -z), (a, b, c, d))
    return math.remainder(-2 * math.atan2(turn[3], turn[0]), 2 * math.pi)


class Wrist(Shaft):
  """How the tip of an instrument with a wrist stands: as it did, turned about its jaws, leant."""

  def __init__(self, trocar: ports.Trocar, quat: Vector):
    """Takes the instrument's trocar and how the tip stands, w x y z  (4,)."""
    super().__init__(trocar)
    w, x, y, z = (float(q) for q in quat)
    self._port, self._start = trocar, (w, x, y, z)

  def quat(self, pos: Vector, roll: float = 0.0) -> Quat:
    """See `Shaft`; the place makes no difference."""
    return times(self._start, (math.cos(roll / 2), 0.0, 0.0, -math.sin(roll / 2)))

  def lean(self, turn: Vector, pos: Vector, roll: float = 0.0) -> None:
    """See `Shaft`; it goes as far as the joints do with the tip at a point [m]  (3,)."""
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    mujoco.mju_quatIntegrate(quat, np.array(turn), 1.0)
    w, x, y, z = quat.tolist()
    leant = matrix(np.array(times((w, x, y, z), self.quat(pos, roll))))
    _, found = wrist.forward(self._port, wrist.inverse(self._port, pos, leant))
    w, x, y, z = ports.orientation(found).tolist()
    self._start = times((w, x, y, z), (math.cos(roll / 2), 0.0, 0.0, math.sin(roll / 2)))


def pose(trocar: ports.Trocar, pos: Vector, roll: float = 0.0) -> np.ndarray:
  """Returns place and orientation, as the shaft has it there, of a handle at `pos` [m]  (7,)."""
  return np.array([*pos, *Shaft(trocar).quat(pos, roll)])


def times(p: Quat, q: Quat) -> Quat:
  """Returns the product of two quaternions."""
  a, b, c, d = p
  w, x, y, z = q
  return (
    a * w - b * x - c * y - d * z,
    a * x + b * w + c * z - d * y,
    a * y - b * z + c * w + d * x,
    a * z + b * y - c * x + d * w,
  )


def _rotation(w: float, x: float, y: float, z: float) -> tuple[float, ...]:
  """Returns the matrix of a unit quaternion, row by row."""
  xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
  wx, wy, wz = w * x, w * y, w * z
  return (
    1 - 2 * (yy + zz), 2 * (xy - wz), 2 * (xz + wy),
    2 * (xy + wz), 1 - 2 * (xx + zz), 2 * (yz - wx),
    2 * (xz - wy), 2 * (yz + wx), 1 - 2 * (xx + yy),
  )  # fmt: skip
