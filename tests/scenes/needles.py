"""A hand that turns a needle about the middle of its circle, into a sheet or a solid below."""

from typing import Any

import mujoco
import numpy as np
import palpate
import trimesh

STEP = 1e-3  # [s]
LENGTH, SLIT = 0.026, 3.5e-4  # of the needle, and of what a tapered one of 0.7 mm opens [m]
RADIUS = LENGTH / np.pi
THICK = 1.5e-3  # of the sheet [m]
ENERGY, FRICTION = 800.0, 40.0  # [J/m^2], [N/m]
SHEET = {"mass": 0.003, "young": 4e5, "thickness": THICK}
LOWER: dict[str, Any] = {"thickness": 2.5e-3, "needles": "needle 300 10"}  # of a wall's lower layer
SOLID = {"young": 1e4, "poisson": 0.45, "elements": "solid"}
SOFT = "needle 150 5 300"  # of the solid; its surface bears twice as much


def sheet(n=13, size=0.04):
  """Returns a square of n by n vertices, and its rim."""
  x = np.linspace(-size / 2, size / 2, n)
  i, j = (k.ravel() for k in np.meshgrid(np.arange(n - 1), np.arange(n - 1)))
  a = n * j + i
  triangles = np.concatenate(
    [np.stack(c, 1) for c in ((a, a + 1, a + n + 1), (a, a + n + 1, a + n))]
  )
  points = np.stack([*(g.ravel() for g in np.meshgrid(x, x)), np.zeros(n * n)], 1)
  return (points, triangles), np.flatnonzero(np.abs(points).max(axis=1) > 0.499 * size)


def block():
  """Returns an ellipsoid with edges of 3 mm, and its lower vertices."""
  ball = trimesh.creation.icosphere(3, 0.025)
  points = ball.vertices * (1.0, 0.8, 0.6)
  return (points, np.array(ball.faces)), np.flatnonzero(points[:, 2] < -0.01)


def scene(
  solid=False,
  free=False,
  needles=None,
  height=None,
  windows=False,
  mesh=None,
  tilt=1.3,
  nodes=0,
  suture=None,
  tip="taper",
  follow=(),
  **config,
):
  """Returns a spec: a hand turns a needle about the middle of its circle, into an organ below."""
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.gravity = STEP, (0, 0, 0)
  pos = (0, 0, (0.0165 if solid else 0.004) if height is None else height)
  quat, down = np.zeros(4), np.zeros(4)
  mujoco.mju_axisAngle2Quat(down, [1, 0, 0], -np.pi / 2)
  mujoco.mju_axisAngle2Quat(quat, [0, 1, 0], -tilt)
  mujoco.mju_mulQuat(quat, quat.copy(), down)
  hand = spec.worldbody.add_body(name="hand", pos=pos)
  hand.add_joint(name="turn", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0], armature=1e-3)
  hand.add_joint(name="shift", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 1, 0])
  hand.add_geom(size=[0.001] * 3, mass=0.05, contype=0, conaffinity=0)
  for joint, gain, damping in (("turn", 40, 0.4), ("shift", 1000, 14)):
    motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_position(gain, kv=damping)
  thread = None
  if nodes:  # straight from the swage on, upward, with edges of 1.5 mm
    thread, swage = "suture", np.zeros(3)
    mujoco.mju_rotVecQuat(swage, [0, -RADIUS, 0], quat)
    way = 1.5e-3 * np.arange(nodes)[:, None] * (-0.9, 0, 0.436)
    palpate.add_thread(spec, pos + swage + way, thread, strength=1e3, **(suture or {}))
  if free:
    palpate.add_needle(spec, length=LENGTH, quat=quat, pos=pos, thread=thread, tip=tip)
    data = np.zeros(mujoco.mjNEQDATA)
    data[6:11] = *quat, 1
    spec.add_equality(
      name="grip", type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, name1="hand",
      name2="needle", solref=[0.004, 1], solimp=[0.999, 0.9999, 0.001, 0.5, 2], data=data,
    )  # fmt: skip
  else:
    palpate.add_needle(spec, length=LENGTH, quat=quat, parent="hand", thread=thread, tip=tip)
  for name in follow:  # and no longer the needle
    body = spec.worldbody.add_body(name=name, pos=(0.1, 0, 0))
    body.add_freejoint()
    body.add_geom(size=[0.002] * 3, mass=0.01)
    for geom in spec.body("needle").geoms:
      geom.contype = geom.conaffinity = 0
  (surface, pin), kind = (block(), SOLID) if solid else (sheet(), SHEET)
  needles = needles or (SOFT if solid else f"needle {ENERGY} {FRICTION}")
  given = kind | {"pin": pin, "device": "cpu"} | config
  palpate.add_organ(spec, mesh or surface, needles=needles, windows=windows, **given)
  return spec


def wall(gap=0.002, **given):
  """Returns a scene with a wall of two layers: under the sheet, in touch with it, lies `lower`."""
  spec = scene(**given)
  mesh, pin = (given["mesh"], given["pin"]) if "mesh" in given else sheet()
  pos = (*given.get("pos", (0, 0))[:2], -gap)
  more: dict[str, Any] = SHEET | LOWER | {"contact": given.get("contact", {})}
  palpate.add_organ(spec, mesh, "lower", pin=pin, pos=pos, device="cpu", **more)
  return spec


def load(spec):
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  return model, data, palpate.Organ(model, data, "organ")


def drive(model, data, organ, turns, speed=4.0):
  """Turns the hand to some angles [rad] in turn; returns rows of its angle and what `look` saw."""
  rows = []
  for angle in turns:
    start = data.ctrl[0]
    steps = max(1, round(abs(angle - start) / (speed * STEP)))
    for k in range(steps):
      data.ctrl[0] = start + (angle - start) * (k + 1) / steps
      mujoco.mj_step(model, data)
      needle = organ.needles[0]
      along = data.site("needle_tip").xmat.reshape(3, 3)[:, 2]
      rows.append((data.qpos[0], needle.tip_force @ along, needle.energy, len(needle.holes)))
  assert organ.error is None
  assert not data.warning.number.any()
  return np.array(rows).T


def gap(data, hole):
  """Returns how far a hole's tissue is off the needle [m]."""
  at = (hole.at - data.body("needle").xpos) @ data.body("needle").xmat.reshape(3, 3)
  return np.hypot(np.hypot(*at[:2]) - RADIUS, at[2])


def pull(model, data, forces, start, stop, steps):
  """Pulls at nodes of the thread, by their numbers, from `start` to `stop` times a force [N]."""
  for k in range(steps):
    for node, force in forces.items():
      data.body(f"suture_{node}").xfrc_applied[:3] = (start + (stop - start) * k / steps) * force
    mujoco.mj_step(model, data)
    yield
