"""Instruments on a trocar: attaching them, and where the tip is.

The instrument's frame has the trocar point at its origin and the shaft along -z when every joint
is zero, with the tip `DEPTH` below. `pitch` (about x) takes the tip to +y, `yaw` (about -y) to +x,
`insertion` takes it deeper and `roll` turns it about the shaft. In that frame the tip is at

    d (sin yaw, cos yaw sin pitch, -cos yaw cos pitch),   d = DEPTH + insertion

which does not depend on roll. Lengths are in m, angles in rad.
"""

import dataclasses
import math
import pathlib

import mujoco
import numpy as np
from palpate.engine.model.flexes import matrix
from palpate.tissue.reading import choices

NAMES = ("probe", "grasper", "scissors", "hook", "scalpel", "laparoscope", "knot_pusher")
WRISTED = ("psm",)  # with a wrist, and without a handle, see `wrist`
JAWED = ("grasper", "scissors", "psm")
JOINTS = ("pitch", "yaw", "insertion", "roll")
WRIST = ("wrist_pitch", "wrist_yaw")
DEPTH = 0.12  # from the trocar to the tip when every joint is zero [m]
RANGES = ((-1.0472, 1.0472), (-1.0472, 1.0472), (-0.08, 0.13), (-3.1416, 3.1416))  # as JOINTS
_TOLERANCE = 1e-9  # rounding that `inverse` accepts at the ends of a range


@dataclasses.dataclass(frozen=True)
class Trocar:
  """Where an instrument enters and how far it reaches.

  Attributes:
    name: the instrument, for errors
    pos: the trocar point in the world [m]  (3,)
    mat: the instrument's frame in the world  (3, 3)
    depth: from the trocar to the tip when every joint is zero [m]
    ranges: limits of pitch, yaw [rad], insertion [m], roll, and those of a wrist [rad]
      (4, 2) or (6, 2)
    wrist: between the axes of a wrist, and from the second to the tip; empty without one [m]
  """

  name: str = "instrument"
  pos: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
  mat: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
  depth: float = DEPTH
  ranges: np.ndarray = dataclasses.field(default_factory=lambda: np.array(RANGES))
  wrist: tuple[float, ...] = ()


def path(name: str, handle: bool = False) -> pathlib.Path:
  """Returns the MJCF file of an instrument, `handle` for the one with the virtual coupling."""
  known = NAMES if handle else (*NAMES, *WRISTED)
  if name not in known:
    raise ValueError(f"instrument is {name!r}, {choices(name, known)}")
  return pathlib.Path(__file__).parent / "instruments" / f"{name}{'_handle' if handle else ''}.xml"


def attach(
  spec: mujoco.MjSpec,
  name: str,
  prefix: str,
  pos=(0.0, 0.0, 0.0),
  quat=(1.0, 0.0, 0.0, 0.0),
  handle: bool = False,
) -> mujoco.MjsFrame:
  """Attaches an instrument to the world of `spec` with its trocar at `pos`; returns the frame.

  Args:
    spec: the scene, changed in place
    name: one of `NAMES` or, without a handle, of `WRISTED`
    prefix: put before every name of the instrument, for instance "left/"
    pos: the trocar point [m]
    quat: orientation of the instrument's frame (`aim` makes one)
    handle: whether a mocap handle drives the tip in place of position actuators
  """
  frame = spec.worldbody.add_frame(pos=pos, quat=quat)
  spec.attach(mujoco.MjSpec.from_file(str(path(name, handle))), prefix=prefix, frame=frame)
  return frame


def kind(prefix: str) -> str:
  """Returns which instrument has a prefix, such as "psm" has "left_psm/"."""
  return prefix.rstrip("/").rpartition("_")[2]


def aim(pos, target) -> np.ndarray:
  """Returns the quaternion that points the shaft of an instrument at `pos` towards `target`.

  It is the shortest rotation from straight down: x and y stay near the world's.
  """
  shaft = np.subtract(target, pos, dtype=float)
  length = np.linalg.norm(shaft)
  if not length > 0:
    raise ValueError(f"target is {target}, expected a point other than the trocar's")
  quat = np.zeros(4)
  down = np.array([0.0, 0.0, -1.0])
  cosine = -shaft[2] / length
  if cosine < -1 + 1e-12:
    return np.array([0.0, 1.0, 0.0, 0.0])
  quat[0] = 1 + cosine
  quat[1:] = np.cross(down, shaft / length)
  return quat / np.linalg.norm(quat)


def trocar(model: mujoco.MjModel, prefix: str = "") -> Trocar:
  """Returns the trocar of the instrument whose names start with `prefix` in a compiled model."""
  try:
    body = model.body(f"{prefix}trocar").id
    tip = model.site(f"{prefix}tip")
    wristed = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, prefix + WRIST[0]) >= 0
    joints = (*JOINTS, *WRIST) if wristed else JOINTS
    ranges = np.array([model.joint(prefix + joint).range for joint in joints])
  except KeyError as error:
    raise ValueError(f"no instrument with the prefix {prefix!r} in the model: {error}") from None
  if model.body_weldid[body] != 0:
    raise ValueError(f"instrument {prefix!r}: its trocar moves, expected one fixed to the world")
  depth = -tip.pos[2]
  child = int(tip.bodyid[0])
  wrist = (-float(model.body_pos[child, 2]), float(depth)) if wristed else ()
  while child != body:
    depth -= model.body_pos[child, 2]
    child = int(model.body_parentid[child])
  pos, quat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
  while body:
    moved, turned = np.zeros(3), np.zeros(4)
    mujoco.mju_rotVecQuat(moved, pos, model.body_quat[body])
    mujoco.mju_mulQuat(turned, model.body_quat[body], quat)
    pos, quat = moved + model.body_pos[body], turned
    body = int(model.body_parentid[body])
  return Trocar(prefix, pos, matrix(quat), float(depth), ranges, wrist)


def forward(trocar: Trocar, joints) -> np.ndarray:
  """Returns the tip's position in the world [m]  (..., 3).

  Args:
    trocar: of the instrument
    joints: pitch, yaw, insertion; more columns, such as roll, are ignored  (..., >= 3)
  """
  joints = np.asarray(joints, dtype=float)
  pitch, yaw = joints[..., 0], joints[..., 1]
  depth = trocar.depth + joints[..., 2]
  local = np.stack(
    [np.sin(yaw), np.cos(yaw) * np.sin(pitch), -np.cos(yaw) * np.cos(pitch)], axis=-1
  )
  return trocar.pos + depth[..., None] * (local @ trocar.mat.T)


def inverse(trocar: Trocar, tip_pos, check: bool = True) -> np.ndarray:
  """Returns the pitch, yaw and insertion that put the tip at `tip_pos`  (..., 3).

  Args:
    trocar: of the instrument
    tip_pos: points in the world [m]  (..., 3)
    check: whether a point out of reach raises a ValueError that names the joint, value and range
  """
  tip_pos = np.asarray(tip_pos, dtype=float)
  local = (tip_pos - trocar.pos) @ trocar.mat
  depth = np.linalg.norm(local, axis=-1)
  joints = np.stack(
    [
      np.arctan2(local[..., 1], -local[..., 2]),
      np.arctan2(local[..., 0], np.hypot(local[..., 1], local[..., 2])),
      depth - trocar.depth,
    ],
    axis=-1,
  )
  if not check:
    return joints
  low, high = trocar.ranges[:3].T
  inside = (joints >= low - _TOLERANCE) & (joints <= high + _TOLERANCE)
  if not inside.all():
    index = tuple(int(i) for i in np.argwhere(~inside)[0])
    joint, unit = JOINTS[index[-1]], "m" if index[-1] == 2 else "rad"
    at = f" of point {index[:-1]}" if index[:-1] else ""
    raise ValueError(
      f"instrument {trocar.name!r}: {joint}{at} is {joints[index]:.6g} {unit} to reach "
      f"{tip_pos[index[:-1]]}, expected a number in [{low[index[-1]]:g}, {high[index[-1]]:g}]"
    )
  return np.clip(joints, low, high)


def orientation(mat: np.ndarray) -> np.ndarray:
  """Returns the quaternion of a matrix, w x y z."""
  quat = np.zeros(4)
  mujoco.mju_mat2Quat(quat, np.ascontiguousarray(mat).ravel())
  return quat


def about(axis: int, angle: float) -> np.ndarray:
  """Returns the rotation about an axis by an angle [rad]."""
  out, (j, k) = np.eye(3), ((axis + 1) % 3, (axis + 2) % 3)
  out[j, j] = out[k, k] = math.cos(angle)
  out[k, j] = math.sin(angle)
  out[j, k] = -out[k, j]
  return out
