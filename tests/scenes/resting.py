"""Scenes in which an organ comes to rest against something flat."""

import mujoco
import numpy as np
import palpate
import trimesh
from palpate.models import mjcf
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology

from .documents import flex, world

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
    coupling: nodal or window; or flex, MuJoCo's own of the same tetrahedra
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
  if coupling == "flex":
    _attach_flex(spec, mesh, made)
  else:
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


def _attach_flex(spec, mesh, made):
  """Adds MuJoCo's flex of a solid, with MuJoCo's contacts."""
  solid = fill.fill("organ", topology.build("organ", mesh.vertices, mesh.faces))
  keys = {"damping": 0.002} | {k: made[k] for k in ("young", "poisson", "damping") if k in made}
  inside = mjcf.tag("elasticity", keys)
  contact = {"condim": made["contact"]["condim"], "solref": "0.02 1"}
  keys = {"mass": made["mass"], "pin": made.get("pin", ()), "contact": contact, "dim": 3}
  # In a body: pinned to the world it would be lost where it is attached.
  body = mjcf.tag("body", {"name": "organ"}, flex(solid.rest, solid.tet, inside, **keys))
  child = mujoco.MjSpec.from_string(world(body))
  for name in ("timestep", "gravity", "tolerance"):
    setattr(child.option, name, getattr(spec.option, name))
  child.memory = spec.memory
  spec.attach(child, frame=spec.worldbody.add_frame())
  spec.option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE


def _carried(model, data):
  """Returns the force that contacts put on what is no geom [N]."""
  total = np.zeros(3)
  for number, contact in enumerate(data.contact):
    local = np.zeros(6)
    mujoco.mj_contactForce(model, data, number, local)
    sign = 1.0 if contact.geom[0] >= 0 else -1.0
    total += sign * contact.frame.reshape(3, 3).T @ local[:3]
  return total


def watch(spec, seconds=1.5, last=0.3):
  """Runs a scene and returns what is seen of its organ.

  Returns:
    force: on the organ, or of the press, in the last part [N]  (n, 3)
    speed: of the fastest node there [m/s]
    energy: most elastic energy at any time [J]; zero of MuJoCo's flex
    organ: the handle, or None of MuJoCo's flex
  """
  model = spec.compile()
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "organ") if model.nplugin else None
  tool = model.joint("z").dofadr[0] if model.nu else None
  force, speed, energy = [], 0.0, 0.0
  for k in range(round(seconds / model.opt.timestep)):
    data.ctrl[:] = model.actuator_ctrlrange[:, 0] * min(1.0, data.time / 0.3)
    mujoco.mj_step(model, data)
    if organ and k % 10 == 0:
      energy = max(energy, organ.energy)
    if (organ and organ.error is not None) or not np.isfinite(data.qpos).all():
      break
    if data.time > seconds - last:
      own = organ.force if organ else _carried(model, data)
      force.append(own if tool is None else [0, 0, data.qfrc_constraint[tool]])
      moving = organ.xvel if organ else np.delete(data.qvel, [] if tool is None else tool)
      speed = max(speed, np.abs(moving).max())
  return np.array(force), speed, energy, organ
