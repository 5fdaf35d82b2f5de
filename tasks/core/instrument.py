"""An instrument on a trocar: where it is, what moves it and what it feels."""

import math
from typing import Any

import mujoco as mj
import numpy as np
from palpate.models import laparoscope, situs, trocar, wrist
from palpate.models.handle import Handle, Tip, find, pose

from .handle import ROW, Guide
from .jaws import Jaws

AXES = ("pitch", "yaw", "roll", "insertion")
SCOPE = f"{laparoscope.NAME}/"  # prefix of the one that carries the camera
FIFTH = ("jaw", "head")  # what a fifth component of an action drives
TOUCH = ("touch_left", "touch_right")  # sensors of the jaws
FORCES = ("tip_force", "shaft_force")  # sensors of what an instrument exerts
AROUND = tuple(f"{situs.SURROUNDINGS}_{part}" for part in ("tip", "shaft"))  # and of that around
RATES = (1.0, 1.0, 3.0, 0.12)  # pitch, yaw, roll [rad/s], insertion [m/s]
HELD_FORCE = 0.2  # of the inner face of either jaw on tissue between them, to hold it [N]

CLOSING = 0.005  # the drive's target is that far below the opening [rad]
# Least opening over a fold of tissue, largest target that grips one [rad].
FOLD, GRIPPING = 0.02, 0.15
DRIVE_RATES = np.array((*RATES, 3.0, 3.0))  # and those of a wrist [rad/s]


def axes(prefix: str) -> tuple[str, ...]:
  """Returns the axes of an instrument with a prefix, whose drives an action moves."""
  return (*AXES, *trocar.WRIST) if trocar.kind(prefix) in trocar.WRISTED else AXES


def jawed(prefix: str) -> bool:
  """Returns whether an instrument with a prefix has jaws."""
  return trocar.kind(prefix) in trocar.JAWED


class Instrument:
  """One of the instruments of a scene.

  Attributes:
    prefix: of its names in the model, for instance "probe/"
    model: what it is in, dm_control's
    data: its state
    by_tip: whether an action says where the tip is to be, and inverse kinematics moves the drives
    handle: that pulls it, or the pose of its tip; None where an action moves the drives
    guide: takes the handle along an action
    jaw: actuator of its jaws, -1 without
    fifth: actuator of jaws or of a camera's head, -1 without
    optics: angle between a laparoscope's shaft and its view [rad]
    peak_force: largest force since the last control step, or a jaw's mean if that is more [N]
    peak_tissue: the same of tissue alone [N]
    peak_shaft: largest force of tissue on the shaft since then [N]
    peak_surroundings: largest force since then on what is around [N]
    edge: force of its edges on tissue that they cut [N]  (3,)
  """

  prefix = ""
  model: Any
  data: Any
  by_tip = False
  handle: Handle | Tip | None = None
  optics = 0.0

  def equip(self, prefix: str) -> None:
    """Finds an instrument in the model."""
    model = self.model.ptr
    self.prefix = prefix
    self._sensors = {}
    for i in range(model.nsensor):
      name = model.sensor(i).name
      if name.startswith(prefix):
        adr = int(model.sensor_adr[i])
        self._sensors[name[len(prefix) :]] = slice(adr, adr + int(model.sensor_dim[i]))
    self._trocar = trocar.trocar(model, prefix)
    joints = [model.joint(prefix + axis) for axis in wrist.joints(self._trocar)]
    self._qpos = np.array([int(joint.qposadr[0]) for joint in joints])
    self._dof = np.array([int(joint.dofadr[0]) for joint in joints])
    self.take_hold()
    self.guide = Guide()
    driven = () if isinstance(self.handle, Handle) else wrist.joints(self._trocar)
    self.drives = np.array([model.actuator(prefix + axis).id for axis in driven], int)
    self.drive_range = model.actuator_ctrlrange[self.drives].copy()
    fifth = [model.actuator(prefix + name).id for name in FIFTH if name in self._sensors]
    self.fifth = fifth[0] if fifth else -1
    self.jaw = self.fifth if self.has_jaw else -1
    self._jaws = Jaws(model, prefix) if self.has_jaw else None
    self._inner = np.zeros(2)
    self._forced = [n for n in (*FORCES, *AROUND) if n in self._sensors]
    signals = [*self._forced, *(TOUCH if self.has_jaw else ())]
    self._signals = np.concatenate([np.arange(*self._sensors[n].indices(10**6)) for n in signals])
    if prefix == SCOPE:
      self._lens = model.camera(laparoscope.NAME).id
      w, x, _, _ = model.body(f"{prefix}eye").quat
      self.optics = -2 * math.atan2(x, w)

  def take_hold(self) -> None:
    """Finds what an action holds: a handle or the pose of the tip, if any."""
    self.handle = find(self.model.ptr, self.data.ptr, self.prefix, self.by_tip)

  @property
  def has_jaw(self) -> bool:
    """Whether the instrument has jaws."""
    return "jaw" in self._sensors

  def sensor(self, name: str) -> np.ndarray:
    """Returns a copy of one of the instrument's sensors."""
    return self.data.ptr.sensordata[self._sensors[name]].copy()

  def tip_pos(self) -> np.ndarray:
    """Returns the tip's position [m]  (3,)."""
    return self.sensor("tip_pos")

  def landmarks(self) -> np.ndarray:
    """Returns the tip, the tips of the left and right jaw, and the shaft in the trocar [m]  (4, 3).

    Without jaws their tips are the tip.
    """
    tip, data, model = self.tip_pos(), self.data.ptr, self.model.ptr
    bodies = [model.body(name).id for name in self._jaws.names] if self._jaws else []
    end = model.site(f"{self.prefix}tip").pos
    ends = [data.xpos[b] - data.xmat[b].reshape(3, 3) @ (model.body_pos[b] - end) for b in bodies]
    return np.stack([tip, *(ends or [tip, tip]), self._trocar.pos])

  def tip_vel(self) -> np.ndarray:
    """Returns the tip's velocity [m/s]  (3,)."""
    return self.sensor("tip_vel")

  def tip_quat(self) -> np.ndarray:
    """Returns the tip's orientation, w x y z  (4,)."""
    return self.sensor("tip_quat")

  def joints(self) -> np.ndarray:
    """Returns pitch, yaw, roll [rad], insertion [m], and a wrist's [rad]  (4,) or (6,)."""
    return self.data.ptr.qpos[self._qpos]

  def joint_vel(self) -> np.ndarray:
    """Returns the velocities of `joints`."""
    return self.data.ptr.qvel[self._dof]

  def drive_targets(self) -> np.ndarray:
    """Returns the targets of the position drives, or where the handle is, as `joints`."""
    return self.handle.joints(self._trocar) if self.handle else self.data.ptr.ctrl[self.drives]

  def contact_force(self) -> np.ndarray:
    """Returns the force on the instrument below the shaft [N]  (3,)."""
    return -self.sensor("tip_force") - self.edge

  def tissue_force(self) -> np.ndarray:
    """Returns the part of `contact_force` that is of tissue [N]  (3,)."""
    around = self.sensor(AROUND[0]) if AROUND[0] in self._sensors else 0.0
    return self.contact_force() + around

  def shaft_force(self) -> np.ndarray:
    """Returns the contact force on the shaft [N]  (3,)."""
    return -self.sensor("shaft_force")

  def forces(self) -> dict[str, np.ndarray]:
    """Returns the forces in each step of the last `step`.

    Those of tissue on tip and shaft, of the jaws' grip, and on what is around, if there is any.
    Magnitudes [N]  (nstep,), as `Recorder.append` takes them; a single 0 before the first.
    """
    return dict(self._forces)

  def felt(self) -> np.ndarray:
    """Returns force [N], torque [N m] on the hand in each step of the last `step`  (nstep, 6)."""
    return self._felt

  def gripper(self) -> np.ndarray:
    """Returns opening and its target [rad], force on the left and right jaw [N]  (4,)."""
    touch = self.sensor("touch_left"), self.sensor("touch_right")
    return np.concatenate([self.sensor("jaw"), self.data.ctrl[[self.jaw]], *touch])

  def closing(self) -> bool:
    """Whether the jaws are told to close: on a fold of tissue at most, and below the opening."""
    opening, target = float(self.sensor("jaw")[0]), float(self.data.ctrl[self.jaw])
    return target < min(opening - CLOSING, GRIPPING)

  def holds(self) -> bool:
    """Whether tissue is between the jaws: it keeps them open, both inner faces press on it."""
    return bool(self._inner.min() > HELD_FORCE and self.sensor("jaw")[0] > FOLD)

  def from_tip(self, point: np.ndarray) -> np.ndarray:
    """Returns a point in the frame of the tip [m]  (3,)."""
    local, turn = np.zeros(3), np.zeros(4)
    mj.mju_negQuat(turn, self.tip_quat())
    mj.mju_rotVecQuat(local, point - self.tip_pos(), turn)
    return local

  def to_world(self, point: np.ndarray) -> np.ndarray:
    """Returns where a point in the frame of the tip is [m]  (3,)."""
    offset = np.zeros(3)
    mj.mju_rotVecQuat(offset, point, self.tip_quat())
    return self.tip_pos() + offset

  def head(self) -> np.ndarray:
    """Returns how far a laparoscope's camera is turned against it [rad]  (1,)."""
    return self.sensor("head")

  def lens(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns where a laparoscope's lens is [m], and the picture's axes right, up, back in columns.

    Shapes (3,) and (3, 3).
    """
    data = self.data.ptr
    return data.cam_xpos[self._lens].copy(), data.cam_xmat[self._lens].reshape(3, 3).copy()

  def trocar(self) -> trocar.Trocar:
    """Returns the instrument's trocar."""
    return self._trocar

  def handle_row(self, tip: np.ndarray, roll: float) -> np.ndarray:
    """Returns the row of an action that holds the tip at a place [m], rolled by an angle  (7,)."""
    return pose(self._trocar, tip, roll)

  def act(self, values: np.ndarray, dt: float) -> None:
    """Takes its part of an action, for a control step of dt [s].

    Args:
      values: of the `axes`, and what is opened of the jaws; or rows of `handle`, each with that
      dt: duration of the control step
    """
    if self.handle:
      self.guide.follow(values.reshape(-1, values.shape[-1]))
      return
    low, high = self.drive_range.T
    ctrl, count = self.data.ptr.ctrl, len(self.drives)
    move = values[:count] * DRIVE_RATES[:count] * dt
    ctrl[self.drives] = (ctrl[self.drives] + move).clip(low, high)
    if self.fifth >= 0:
      self.drive_fifth(values[count])

  def drive_fifth(self, share: float) -> None:
    """Gives jaws their target, 1 is wide open, -1 squeezes closed jaws; or a camera's head."""
    low, high = self.model.ptr.actuator_ctrlrange[self.fifth]
    self.data.ptr.ctrl[self.fifth] = low + (high - low) * (share + 1) / 2

  def set_joints(self, joints: np.ndarray) -> None:
    """Puts the instrument and its drives at a pose, as `joints`, with closed jaws."""
    self.data.qpos[self._qpos] = joints
    if isinstance(self.handle, Tip):
      self.handle.put(joints)
      self.guide.put(np.concatenate([self.handle.pos, self.handle.quat]))
    elif self.handle:
      row = self.handle_row(trocar.forward(self._trocar, joints[[0, 1, 3]]), joints[2])
      self.handle.move(row[:3], row[3:])
      self.guide.put(row)
    else:
      self.data.ctrl[self.drives] = joints
    if self.fifth >= 0:
      self.data.ctrl[self.fifth] = 0.0
    self._inner = np.zeros(2)
    mj.mj_forward(self.model.ptr, self.data.ptr)

  def move_port(self, shift: np.ndarray, turn: np.ndarray) -> None:
    """Moves the trocar and turns it about itself; `shift` [m] and `turn` [rad] are small  (3,)."""
    model, body = self.model.ptr, self.model.ptr.body(f"{self.prefix}trocar")
    quat, rotation = np.zeros(4), np.zeros(4)
    angle = float(np.linalg.norm(turn))
    mj.mju_axisAngle2Quat(rotation, turn / max(angle, 1e-12), angle)
    mj.mju_mulQuat(quat, rotation, body.quat)
    body.pos[:], body.quat[:] = body.pos + shift, quat
    self._trocar = trocar.trocar(model, self.prefix)
    if isinstance(self.handle, Tip):
      self.handle.port = self._trocar

  @property
  def busy(self) -> bool:
    """Whether `advance` has something to do."""
    return self.handle is not None or self._jaws is not None

  def begin(self, nstep: int) -> None:
    """Begins to keep what `nstep` steps of the physics do."""
    self._felt = np.zeros((nstep, 6))

  def advance(self, k: int, nstep: int, dt: float) -> None:
    """Looks at step k of `nstep` of dt [s], between its two halves, and takes the handle on."""
    if k == nstep - 1 and self._jaws:
      self._inner = self._jaws.inner_force(self.model.ptr, self.data.ptr)
    if self.handle:
      self._felt[k] = self.handle.wrench()
      self._lead(k, nstep, dt)

  def _lead(self, k: int, nstep: int, dt: float) -> None:
    """Moves the handle before step k of `nstep`, and the jaws where the row has them."""
    row, vel, spin = self.guide.advance(k, nstep, dt)
    assert self.handle is not None
    self.handle.move(row[:3], row[3:7], vel, spin)
    if self.fifth >= 0 and len(row) > len(ROW):
      self.drive_fifth(row[len(ROW)])

  def keep(self, sensors: np.ndarray) -> None:
    """Keeps the forces of steps that had these sensor values  (nstep, nsensordata)."""
    values = sensors[:, self._signals]
    count = len(self._forced)
    parts = values[:, : 3 * count].reshape(-1, count, 3)
    self.peak_force = float(_norm(parts[:, 0]).max())
    tissue, around = parts[:, :2], parts[:, 2:]
    if around.size:
      tissue = tissue - around
    tip, shaft = _norm(tissue).T
    self._forces = {"force": tip, "shaft_force": shaft}
    self.peak_tissue, self.peak_shaft = float(tip.max()), float(shaft.max())
    self.peak_surroundings = 0.0
    if around.size:
      self._forces["surroundings_force"] = outside = _norm(around.sum(axis=1))
      self.peak_surroundings = float(outside.max())
    if self.has_jaw:
      jaws = values[:, 3 * count :]
      self._forces["grip_force"] = jaws.max(axis=1)
    if self.has_jaw and not self._trocar.wrist:  # whose grip is a needle's
      # Pinched folds make single steps of large jaw force: the jaws' is a mean over the step.
      grip = float(jaws.sum(axis=0).max()) / len(jaws)
      self.peak_force, self.peak_tissue = max(self.peak_force, grip), max(self.peak_tissue, grip)

  def quiet(self) -> None:
    """Forgets the forces of the last steps: they would be in the next episode's start."""
    self.edge = np.zeros(3)
    self.begin(1)
    self.keep(np.zeros((1, self.model.nsensordata)))


def _norm(vectors: np.ndarray) -> np.ndarray:
  """Returns the lengths of vectors, which are in the last axis."""
  return np.sqrt(np.einsum("...k,...k->...", vectors, vectors))


class Second(Instrument):
  """The instrument of the other hand, in the physics of the first."""

  def __init__(self, physics: Any, prefix: str):
    """Finds the instrument with a prefix in a physics."""
    self.model, self.data, self.by_tip = physics.model, physics.data, physics.by_tip
    self.equip(prefix)
    self.quiet()

  def bind(self, physics: Any) -> None:
    """Belongs to a copy of its physics from now on."""
    self.model, self.data = physics.model, physics.data
    self.take_hold()

  def __getstate__(self) -> dict[str, Any]:
    return {k: v for k, v in vars(self).items() if k not in ("model", "data", "handle")}
