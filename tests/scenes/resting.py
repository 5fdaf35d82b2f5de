"""Scenes in which an organ comes to rest against something flat."""

import mujoco
import numpy as np
import palpate
import trimesh

_PLANE, _BOX, _CYLINDER = (
  getattr(mujoco.mjtGeom, f"mjGEOM_{name}") for name in ("PLANE", "BOX", "CYLINDER")
)
# What an organ rests against: gravity acts on those that lie, a servo presses the others.
LYING = ("plane", "corner", "edge", "organ")
PRESSED = ("plate", "plates", "cylinder")
SOLID = {"elements": "solid", "young": 1e4, "poisson": 0.45, "device": "cpu"}


def block(size=(0.04, 0.04, 0.04), edge=0.011):
  """Returns a box of triangles with edges up to `edge` [m]."""
  made = trimesh.creation.box(size).subdivide_to_size(edge)
  made.merge_vertices()
  return made


def resting(kind, h=1e-3, mesh=None, mass=0.064, press=0.1, coupling="nodal", condim=3, **keys):
  """Returns a spec with an organ that falls or is pressed, and the force to expect [N].

  Args:
    kind: of LYING or PRESSED
    h: time step [s]
    mesh: the organ's; a cube of 40 mm
    mass: of the organ [kg]
    press: how far it is pressed, of its height
    coupling: nodal or window
    condim: of all contacts
    keys: configuration, that of SOLID otherwise

  Returns:
    the spec; the weight to carry, NaN of what is pressed
  """
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.memory = h, 2**28
  spec.option.gravity = [0, 0, -9.81 * (kind in LYING)]
  mesh = block() if mesh is None else mesh.copy()
  if kind == "edge":
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.5, [0, 1, 0]))
  low, high = mesh.bounds
  made = {"mass": mass, "contact": {"condim": condim}} | (SOLID | keys)
  if kind in LYING:
    floor = spec.worldbody.add_body(name="floor", pos=[0, 0, low[2] - 0.005])
    floor.add_geom(type=_PLANE, size=[1, 1, 0.1], condim=condim)
  if kind == "corner":
    spec.option.gravity = [-3, -3, -8.8]
    for axis in np.eye(3)[:2]:
      at = axis * (low - 0.002) + [0, 0, -low[2] + 0.005]
      floor.add_geom(type=_PLANE, size=[1, 1, 0.1], pos=at, zaxis=axis, condim=condim)
  if kind in PRESSED:
    _add_press(spec, kind, low, high, press, condim)
    if kind == "plates":
      lower = spec.worldbody.add_body(name="lower", pos=[0, 0, low[2] - 0.0105])
      lower.add_geom(type=_BOX, size=[0.1, 0.1, 0.01], condim=condim)
    else:
      made.setdefault("pin", np.flatnonzero(mesh.vertices[:, 2] < low[2] + 1e-4).tolist())
  if coupling == "window":
    tools = {"plate": ["press"], "cylinder": ["press"], "plates": [["press", "lower"]]}
    made["windows"] = {"tools": tools.get(kind), "nodes": 200}
  palpate.add_organ(spec, mesh, "organ", **made)
  if kind == "organ":
    mesh.apply_translation([0.002, 0.001, high[2] - low[2] + 0.003])
    palpate.add_organ(spec, mesh, "upper", **made)
  return spec, np.nan if kind in PRESSED else mass * float(np.linalg.norm(spec.option.gravity))


def _add_press(spec, kind, low, high, press, condim):
  """Adds a plate or a cylinder that a servo moves down within 0.3 s."""
  body = spec.worldbody.add_body(name="press", pos=[0, 0, high[2] + 0.0105])
  body.add_joint(name="z", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
  shape = (_CYLINDER, [0.012, 0.01, 0]) if kind == "cylinder" else (_BOX, [0.1, 0.1, 0.01])
  body.add_geom(type=shape[0], size=shape[1], mass=0.5, condim=condim)
  servo = spec.add_actuator(target="z", trntype=mujoco.mjtTrn.mjTRN_JOINT)
  servo.set_to_position(kp=3000, kv=80)
  servo.ctrlrange = [-press * (high[2] - low[2]) - 0.0005, 0]


def watch(spec, seconds=1.5, last=0.3):
  """Runs a scene and returns what is seen of its organ.

  Returns:
    force: on the organ, or of the press, in the last part [N]  (n, 3)
    speed: of the fastest node there [m/s]
    energy: most elastic energy at any time [J]
    organ: the handle
  """
  model = spec.compile()
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "organ")
  force, speed, energy = [], 0.0, 0.0
  for k in range(round(seconds / model.opt.timestep)):
    data.ctrl[:] = model.actuator_ctrlrange[:, 0] * min(1.0, data.time / 0.3)
    mujoco.mj_step(model, data)
    if k % 10 == 0:
      energy = max(energy, organ.energy)
    if organ.error is not None:
      break
    if data.time > seconds - last:
      pressed = model.nu and [0, 0, data.qfrc_constraint[model.joint("z").dofadr[0]]]
      force.append(pressed or organ.force)
      speed = max(speed, np.abs(organ.xvel).max())
  return np.array(force), speed, energy, organ
