"""A probe pressing an organ: the scene's actuator, the path it follows, and what is measured."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator

import mujoco
import numpy as np
from palpate.organ import Organ

from .console import CommandError

_SETTLE = 0.1  # rest after the way back, and most wait for a contact at the end of the range [s]


@dataclasses.dataclass(frozen=True)
class Probe:
  """A rigid body on a slide joint, driven by a position actuator.

  Attributes:
    actuator: index of the actuator
    joint: index of its slide joint
    qposadr: of that joint
    low, high: least and greatest position of the actuator [m]
    bodies: the body that slides and all that hang on it
  """

  actuator: int
  joint: int
  qposadr: int
  low: float
  high: float
  bodies: frozenset[int]


@dataclasses.dataclass
class Sample:
  """One step of a press. Field names are the CSV's columns.

  Attributes:
    time_s: time at the start of the step [s]
    phase: approach, press, hold or release
    probe_m: position of the probe's joint [m]
    depth_m: its way beyond the first contact, 0 before [m]
    node_m: displacement of the node nearest to the probe [m]
    force_x_N: contact force on the probe, world axes [N]
    force_y_N: "
    force_z_N: "
    contacts: contacts of organ and probe
    iterations: PCG iterations
    residual: relative residual of the implicit step
    step_s: wall time of mj_step [s]
  """

  time_s: float
  phase: str
  probe_m: float
  depth_m: float
  node_m: float
  force_x_N: float
  force_y_N: float
  force_z_N: float
  contacts: int
  iterations: int
  residual: float
  step_s: float

  @property
  def force(self) -> float:
    """Size of the contact force [N]."""
    return float(np.linalg.norm([self.force_x_N, self.force_y_N, self.force_z_N]))


def find(model: mujoco.MjModel, name: str) -> Probe:
  """Returns the probe that an actuator drives.

  Raises:
    CommandError: there is none of that name, or it is not a position actuator on a slide joint.
  """
  names = [model.actuator(i).name or f"actuator {i}" for i in range(model.nu)]
  if name not in names:
    have = ", ".join(repr(other) for other in names) or "none"
    raise CommandError(f"no actuator {name!r} in the scene, it has {have}; see --actuator")
  i = names.index(name)
  joint = int(model.actuator_trnid[i, 0])
  on_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
  if not on_joint or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_SLIDE:
    raise CommandError(f"actuator {name!r} does not drive a slide joint, expected one that does")
  affine = model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE
  if not affine or not model.actuator_biasprm[i, 1]:
    raise CommandError(f"actuator {name!r} is no position actuator, expected <position>")
  if not model.actuator_ctrllimited[i]:
    raise CommandError(f"actuator {name!r} has no ctrlrange, expected one [m]")
  low, high = (float(x) for x in model.actuator_ctrlrange[i])
  bodies = {int(model.jnt_bodyid[joint])}
  for body in range(1, model.nbody):
    if int(model.body_parentid[body]) in bodies:
      bodies.add(body)
  return Probe(i, joint, int(model.jnt_qposadr[joint]), low, high, frozenset(bodies))


def contact_force(model, data, probe: Probe, flexes: np.ndarray) -> tuple[np.ndarray, int]:
  """Returns the force of an organ's contacts on the probe [N] (3,), and their number."""
  contact = data.contact
  total, wrench = np.zeros(3), np.zeros(6)
  touched = np.isin(contact.flex, flexes).any(axis=1)
  mine = np.flatnonzero(touched & (contact.geom >= 0).any(axis=1))
  count = 0
  for k in mine:
    side = int(contact.geom[k, 1] >= 0)  # which of the two is the geom
    if int(model.geom_bodyid[contact.geom[k, side]]) not in probe.bodies:
      continue
    mujoco.mj_contactForce(model, data, k, wrench)
    # The wrench acts on the second of the two, in the contact's axes (rows of frame).
    total += (1 if side else -1) * wrench[:3] @ contact.frame[k].reshape(3, 3)
    count += 1
  return total, count


def node_ahead(data, probe: Probe, organ: Organ) -> int:
  """Returns the node that the probe meets first: the nearest along its axis."""
  away = organ.xpos - data.xanchor[probe.joint]
  axis = data.xaxis[probe.joint]
  along = away @ axis
  aside = np.linalg.norm(away - along[:, None] * axis, axis=1)
  corner = organ.xpos0[organ.elem[:, :2]]
  edge = float(np.linalg.norm(corner[:, 0] - corner[:, 1], axis=1).mean())
  near = aside <= max(edge, float(aside.min()))
  return int(np.where(near, along, np.inf).argmin())


def press(
  model: mujoco.MjModel,
  data: mujoco.MjData,
  organ: Organ,
  probe: Probe,
  depth: float,
  speed: float,
  hold: float,
) -> Iterator[Sample]:
  """Steps a scene: approach, press, hold, release; yields every step.

  Args:
    model: compiled model
    data: its data; the probe starts where the actuator's control is
    organ: what is pressed
    probe: what presses
    depth: way beyond the first contact [m]
    speed: of the probe, both ways [m/s]
    hold: time at that depth [s]

  Raises:
    CommandError: no contact within the actuator's range, or the depth reaches beyond it.
  """
  # Contacts are with the organ, or with the windows that stand in for it.
  names = (organ.name, *organ.config.window)
  flexes = np.array([mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, name) for name in names])
  h = model.opt.timestep
  mujoco.mj_forward(model, data)
  node = node_ahead(data, probe, organ)
  start = command = float(data.ctrl[probe.actuator])
  phase, touch, goal, left = "approach", None, probe.high, _SETTLE
  while True:
    step = speed * h * (-1 if phase == "release" else 1)
    command = float(np.clip(command + step, start, goal)) if phase != "hold" else goal
    data.ctrl[probe.actuator] = command
    at, position = data.time, float(data.qpos[probe.qposadr])
    moved = float(np.linalg.norm(organ.displacement[node]))
    before = time.perf_counter()
    mujoco.mj_step(model, data)
    spent = time.perf_counter() - before
    force, contacts = contact_force(model, data, probe, flexes)
    if touch is None and contacts:
      touch = position
      goal = touch + depth
      if goal > probe.high:
        raise CommandError(
          f"depth is {depth:g} m, expected at most {probe.high - touch:.3g} m, "
          "where the actuator's range ends"
        )
      phase, left = "press", hold
    beyond = 0.0 if touch is None else max(position - touch, 0.0)
    yield Sample(
      time_s=at,
      phase=phase,
      probe_m=position,
      depth_m=beyond,
      node_m=moved,
      force_x_N=float(force[0]),
      force_y_N=float(force[1]),
      force_z_N=float(force[2]),
      contacts=contacts,
      iterations=organ.iterations,
      residual=organ.residual,
      step_s=spent,
    )
    if phase == "press" and command >= goal:
      phase = "hold"
    elif phase == "hold":
      left -= h
      if left <= 0:
        phase, left = "release", _SETTLE
    elif (phase == "approach" and command >= goal) or (phase == "release" and command <= start):
      left -= h
      if left <= 0:
        break
  if touch is None:
    raise CommandError(
      f"the probe met no organ within its range, {probe.low:g} to {probe.high:g} m", code=1
    )
