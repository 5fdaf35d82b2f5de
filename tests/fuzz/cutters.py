"""Organs that blades, scissors and currents cut: finite, with no more energy than was put in."""

from __future__ import annotations

import mujoco
import numpy as np
import palpate
import scenes
from palpate.models import trocar

KEPT: tuple[int, ...] = (216,)  # seeds that once failed
# Seeds that fail, and why.
OPEN: dict[int, str] = {}
SECONDS, MOST = 0.3, 150  # of a scene, and its steps
GAIN = 0.02  # of all energy that there was, that the steps' errors may make
SLIDE, HINGE = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
FREE = {"contype": 0, "conaffinity": 0}
BURN = 1.1e6  # [J/m^2]


def _edge(spec, random, power: bool):
  """Adds a blade, or a hook's toe, on three slides."""
  body = spec.worldbody.add_body(name="tool")
  for name, axis in zip("xyz", np.eye(3), strict=True):
    body.add_joint(type=SLIDE, axis=axis, name=name, damping=4)
    scenes.servo(spec, name, 1000)
  tilt = np.append(1.0, random.normal(0, 0.2, 3))
  size = [1e-3, 1e-3, 0] if power else [5e-4, 0.01, 0]
  body.add_geom(pos=[0, 0, 0.02], size=[0.004, 0, 0], mass=0.1, **FREE)
  kind = mujoco.mjtGeom.mjGEOM_CAPSULE
  body.add_geom(name="edge", type=kind, size=size, quat=tilt, mass=1e-3, **FREE)
  if power:
    spec.add_actuator(name="power", target="x", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    spec.actuator("power").gainprm = 10 * [0]


def scene(seed: int):
  """Returns model, data, organ, and what moves the tool in each step."""
  random = np.random.RandomState(seed)
  tool = ("blade", "scissors", "hook")[random.randint(3)]
  flat = bool(random.randint(2))
  points, elem = scenes.triangular(0.06, 0.04, 18, 14, 0.25, seed) if flat else scenes.sphere(2)
  points = points - [0.03, 0, 0] if flat else points
  spec = mujoco.MjSpec()
  spec.option.timestep = float(random.choice([5e-4, 1e-3, 2e-3, 5e-3]))
  spec.option.gravity = [0, 0, 0]
  top = np.array([0.0, 0.0, points[:, 2].max()])
  speed = random.uniform(0.01, 0.06) / (_steps(spec.option) * spec.option.timestep)
  energy = 10 ** random.uniform(0.5, 2.3)
  keys = {"cutters": f"edge {energy}"}
  if tool == "scissors":
    turn = (np.sqrt(0.5), 0, -np.sqrt(0.5), 0)
    place = top + random.uniform([-0.13, -0.004, -0.004], [-0.11, 0.004, 0.004])
    trocar.attach(spec, "scissors", "s/", pos=place, quat=turn)
    for geom in spec.geoms:  # contacts have energies of their own
      geom.contype = geom.conaffinity = 0
    keys = {"cutters": f"s/edge_left s/edge_right {energy}"}
  else:
    _edge(spec, random, tool == "hook")
    keys = {"cutters": f"edge {BURN} by power"} if tool == "hook" else keys
  held = np.abs(points[:, 1]) > 0.0199 if flat else points[:, 2] < -0.035
  keys |= {"pin": np.flatnonzero(held)} if random.rand() < 0.7 else {"foundation": 1e4}
  keys |= {"young": 10 ** random.uniform(3.8, 5.5), "bend": float(random.randint(2))}
  keys |= {"damping": float(random.choice([0.0, 0.002, 0.02])), "thickness": 2e-3}
  # Half are stretched, by up to 5 %; drawn apart, so that seeds keep the rest.
  stretch = max(0.0, np.random.RandomState([seed, 2]).uniform(-0.05, 0.05))
  keys["tension"] = stretch * keys["young"] * keys["thickness"] / (1 - 0.45)
  windows = bool(random.randint(2))
  palpate.add_organ(spec, (points, elem), "organ", windows=windows, spare=300, device="cpu",
                    mass=0.02, **keys)  # fmt: skip
  model = spec.compile()
  data = mujoco.MjData(model)
  ahead = float(random.choice([-1, 1]))
  start = top + random.uniform([0, -0.01, -0.006], [0, 0.01, 0.006])
  start[0] -= 0.012 * ahead
  way = np.array([ahead, *random.normal(0, [0.2, 0.03])])
  way *= speed / np.linalg.norm(way)
  if tool != "scissors":
    data.qpos[[model.joint(name).qposadr[0] for name in "xyz"]] = start
  else:
    data.joint("s/jaw_left").qpos[0] = data.joint("s/jaw_right").qpos[0] = 0.4
  power = 4 * BURN * 2e-3 * speed * random.rand()

  def drive():
    if tool == "scissors":
      data.actuator("s/jaw").ctrl[0] = 0.8 - 18 * speed * data.time
      return
    data.ctrl[:3] = start + way * data.time
    if tool == "hook":
      data.ctrl[3] = power

  organ = palpate.Organ(model, data, "organ")
  if random.rand() < 0.5:  # it moves and is stretched as the tool comes
    mujoco.mj_forward(model, data)
    x = organ.xpos
    shape = np.sin(x @ random.normal(0, 30, (3, 3)) + 6 * random.rand(3)) * ~held[:, None]
    organ.set_state(x + 0.01 * random.rand() * shape, 0.2 * random.rand() * shape)
  return model, data, organ, drive


def _steps(option) -> int:
  return min(MOST, round(SECONDS / option.timestep))


class Balance:
  """The energy of organ and tool, and what actuators and joints' limits have put in.

  Args:
    model: the model
    data: its data
    organ: the organ
  """

  def __init__(self, model, data, organ):
    self._scene = model, data, organ
    names = [model.joint(j).name for j in range(model.njnt)]
    mine = [j for j, name in enumerate(names) if name in ("x", "y", "z") or name[:2] == "s/"]
    dofs = [int(model.jnt_dofadr[j]) for j in mine]
    self._tool = np.isin(np.arange(model.nv), dofs)
    self.put_in = self.scale = 0.0

  def step(self):
    """Takes a step."""
    model, data, _ = self._scene
    before = data.qvel[self._tool].copy()
    mujoco.mj_step(model, data)
    mean = 0.5 * (before + data.qvel[self._tool])
    force = (data.qfrc_actuator + data.qfrc_constraint)[self._tool]
    work = model.opt.timestep * float(force @ mean)
    self.put_in += work
    self.scale += abs(work)

  def stored(self) -> float:
    """Returns the energy now [J], less what was put in."""
    model, data, organ = self._scene
    moving, inertia = np.where(self._tool, data.qvel, 0.0), np.zeros(model.nv)
    mujoco.mj_mulM(model, data, inertia, moving)
    tissue = 0.5 * (organ.mass[:, None] * organ.xvel**2).sum()
    total = organ.energy + tissue + 0.5 * moving @ inertia
    self.scale = max(self.scale, total)
    return total - self.put_in


def check(seed: int):
  """Checks the scene of a seed."""
  model, data, organ, drive = scene(seed)
  mujoco.mj_forward(model, data)
  balance = Balance(model, data, organ)
  first, most = balance.stored(), 0.0
  mujoco.set_mju_user_warning(lambda _: None)
  try:
    for _ in range(_steps(model.opt)):
      drive()
      balance.step()
      most = max(most, balance.stored() - first)
  finally:
    mujoco.set_mju_user_warning(None)
  assert organ.error is None, organ.error
  assert np.isfinite(organ.xpos).all() and np.isfinite(data.qpos).all()
  assert most <= GAIN * balance.scale + 1e-12, (most / balance.scale, len(organ.cuts))
