"""A probe pressing an organ: the scene's actuator, the path it follows, and what is measured."""

import dataclasses
import time
from collections.abc import Iterator

import mujoco
import numpy as np
from palpate.organ import Organ
from palpate.tissue.geometry.mesh import crossings

from ..console import CommandError

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
    iterations: PCG iterations of all solves of the step: each Newton iteration, and the response to
      changed contact forces
    residual: of the implicit step, relative to its right-hand side, which is next to nothing while
      the organ rests; the solve then stops by the weight of the organ instead
    pierced: 1 once the probe's front is on the other side of the surface
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
  pierced: int
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


def contact_force(model, data, probe: Probe, organ: Organ) -> tuple[np.ndarray, int]:
  """Returns the force of an organ's contacts on the probe [N] (3,), and their number."""
  contact = data.contact
  total, wrench = np.zeros(3), np.zeros(6)
  # Contacts are with the organ, or with the window that stands in for it.
  names = [name for name in (organ.name, organ.config.window) if name]
  flexes = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_FLEX, name) for name in names]
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


def front(model, data, probe: Probe) -> np.ndarray:
  """Returns the middle of the probe's front, a radius behind its foremost point [m]  (3,)."""
  axis = data.xaxis[probe.joint]
  ends = []
  for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
    if int(model.geom_bodyid[geom]) in probe.bodies:
      along = np.abs(axis @ data.geom_xmat[geom].reshape(3, 3))
      half, radius = model.geom_aabb[geom, 3:], float(model.geom_size[geom, 0])
      match model.geom_type[geom]:
        case mujoco.mjtGeom.mjGEOM_SPHERE:
          reach = 0.0
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
          reach = along[2] * (half[2] - radius)
        case _:  # as if it were a box
          reach = along @ half - half.min()
      ends.append(data.geom_xpos[geom] + reach * axis)
  if not ends:
    raise CommandError(f"actuator {model.actuator(probe.actuator).name!r} moves no colliding geom")
  return max(ends, key=lambda end: float(end @ axis))


class _Way:
  """Where the probe is told to be: approach, press, hold, release."""

  def __init__(self, probe: Probe, start: float, depth: float, speed: float, hold: float):
    self.probe, self.start, self.depth, self.speed, self.hold = probe, start, depth, speed, hold
    self.command, self.goal = start, probe.high
    self.phase, self.touch, self.left, self.done = "approach", None, _SETTLE, False

  def advance(self, h: float) -> float:
    """Returns the actuator's control for the next step of h [s]."""
    if self.phase == "hold":
      self.command = self.goal
    else:
      step = self.speed * h * (-1 if self.phase == "release" else 1)
      self.command = float(np.clip(self.command + step, self.start, self.goal))
    return self.command

  def meet(self, position: float):
    """Takes the first contact, at a position of the joint [m]."""
    self.touch, self.goal = position, position + self.depth
    if self.goal > self.probe.high:
      raise CommandError(
        f"depth is {self.depth:g} m, expected at most {self.probe.high - position:.3g} m, "
        "where the actuator's range ends"
      )
    self.phase, self.left = "press", self.hold

  def end_step(self, h: float):
    """Goes on to the next phase when it is time."""
    if self.phase == "press":
      if self.command >= self.goal:
        self.phase = "hold"
      return
    last = self.goal if self.phase == "approach" else self.start
    if self.phase == "hold" or self.command == last:
      self.left -= h
    if self.left <= 0:
      if self.phase == "hold":
        self.phase, self.left = "release", _SETTLE
      else:
        self.done = True


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
  h = model.opt.timestep
  mujoco.mj_forward(model, data)
  node = node_ahead(data, probe, organ)
  first, start = float(data.qpos[probe.qposadr]), front(model, data, probe)
  way = _Way(probe, float(data.ctrl[probe.actuator]), depth, speed, hold)
  while not way.done:
    data.ctrl[probe.actuator] = way.advance(h)
    at, position = data.time, float(data.qpos[probe.qposadr])
    moved = float(np.linalg.norm(organ.displacement[node]))
    now = start + (position - first) * data.xaxis[probe.joint]
    line = np.stack([start, now])
    through = way.touch is not None and bool(crossings(line, organ.xpos[organ.elem]))
    before = time.perf_counter()
    mujoco.mj_step(model, data)
    spent = time.perf_counter() - before
    force, contacts = contact_force(model, data, probe, organ)
    if way.touch is None and contacts:
      way.meet(position)
    yield Sample(
      time_s=at,
      phase=way.phase,
      probe_m=position,
      depth_m=0.0 if way.touch is None else max(position - way.touch, 0.0),
      node_m=moved,
      force_x_N=float(force[0]),
      force_y_N=float(force[1]),
      force_z_N=float(force[2]),
      contacts=contacts,
      iterations=organ.iterations,
      residual=organ.residual,
      pierced=int(through),
      step_s=spent,
    )
    way.end_step(h)
  if way.touch is None:
    raise CommandError(
      f"the probe met no organ within its range, {probe.low:g} to {probe.high:g} m", code=1
    )
