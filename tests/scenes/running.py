"""Loads scenes and moves what is in them."""

import copy

import mujoco
import numpy as np
import palpate

from .documents import ball, organ, windowed, world
from .surfaces import sphere


def load(made, name="organ"):
  """Returns model, data and the organ's handle, of MJCF, an MjSpec or an MjModel."""
  if isinstance(made, mujoco.MjModel):
    model = made
  else:
    model = mujoco.MjModel.from_xml_string(made) if isinstance(made, str) else made.compile()
  data = mujoco.MjData(model)
  return model, data, palpate.Organ(model, data, name)


def beside(coupling, bodies, points=None, elem=None, h=1e-3, gravity=(0, 0, 0), **keys):
  """Returns model, data and organ of tissue, a ball unless given, beside bodies.

  Args:
    coupling: `nodal` or `window`
    bodies: MJCF
    points: (nvert, 3)
    elem: triangles
    h: time step
    gravity: of the world
    **keys: the plugin's
  """
  if points is None:
    points, elem = sphere(2)
  if coupling == "window":
    body = windowed(points, elem, **keys) + ball(1.0, joint=False)
  else:
    body = organ(points, elem, **keys)
  return load(world(body + bodies, h=h, gravity=gravity))


def run(model, data, steps, record=False, speed=0.1, deepest=0.008):
  """Presses at constant speed to the deepest point and stays; returns qpos of each step."""
  out = []
  for _ in range(steps):
    if model.nu:
      data.ctrl[0] = -min(speed * data.time, deepest)
    mujoco.mj_step(model, data)
    if record:
      out.append(np.concatenate([data.qpos, data.qvel]))
  return np.array(out)


def drive(model, data, steps):
  """Presses the probe of `probed` 6 mm, slides 10 mm, releases; returns its forces."""
  out = []
  for _ in range(steps):
    t = data.time
    data.ctrl[0] = -0.008 * min(1, t / 0.08) + 0.02 * max(0, min(1, (t - 0.25) / 0.05))
    data.ctrl[1] = 0.01 * max(0, min(1, (t - 0.12) / 0.1))
    mujoco.mj_step(model, data)
    out.append(data.qfrc_constraint[-2:].copy())
  return np.array(out)


def follow(model, data, organ, way, seconds):
  """Moves a blade by the controls way(time); returns its force on the organ [N]  (nstep, 3)."""
  out = []
  for _ in range(round(seconds / model.opt.timestep)):
    data.ctrl[:] = way(data.time)
    mujoco.mj_step(model, data)
    out.append(organ.cutters[0].force)
  assert organ.error is None
  return np.array(out)


def grasp(model, data, organ, steps=450):
  """Grasps the `ridge`, lifts it 4 mm, lets go; returns forces on the joints and positions."""
  joints = [model.joint(name).dofadr[0] for name in ("z", "left", "right")]
  forces, positions = [], []
  for _ in range(steps):
    shut = 0.0075 * min(1, data.time / 0.1) - 0.008 * np.clip((data.time - 0.33) / 0.05, 0, 1)
    data.ctrl[:] = 0.004 * np.clip((data.time - 0.15) / 0.1, 0, 1), shut, shut
    mujoco.mj_step(model, data)
    forces.append(data.qfrc_constraint[joints])
    positions.append(organ.xpos)
  return np.array(forces), np.array(positions)


def settle(model, data, organ, steps=200, still=1e-5):
  """Steps until two steps move no vertex by more than `still` of the greatest displacement."""
  quiet = 0
  for _ in range(steps):
    mujoco.mj_step(model, data)
    moved = np.abs(data.qvel).max() * model.opt.timestep
    quiet = quiet + 1 if moved <= still * np.abs(organ.displacement).max() else 0
    if quiet == 2:
      return
  raise AssertionError(f"still moving by {moved} m a step after {steps} steps")


def motion(model):
  """Returns qpos and qvel of each step of a press with fresh data."""
  data = mujoco.MjData(model)
  return run(model, data, 80, record=True)


def adrift(**settings):
  """Returns an organ on a foundation, in motion, with nothing else."""
  points, elem = sphere(1)
  config = {"young": 3e4, "foundation": 1e5, "device": "cpu"}
  own = set(settings) & {"bulk", "device", "newton"}
  config |= {key: settings.pop(key) for key in own}
  model, data, made = load(world(organ(points, elem, **config), **settings))
  random = np.random.RandomState(0)
  made.set_state(xvel=random.uniform(-0.1, 0.1, (made.nvert, 3)))
  return model, data, made


def abreast(model, data, organ, batch, ctrls):
  """Moves the plugin and all worlds of a batch by the same controls; a row a step in `ctrls`.

  Returns:
    forces of contact on an organ in each world, and last those of the plugin [N]
      (nstep, nworld + 1, 3)
  """
  out = []
  for ctrl in ctrls:
    data.ctrl[:] = ctrl
    batch.ctrl = np.tile(data.ctrl, (batch.nworld, 1))
    mujoco.mj_step(model, data)
    batch.step()
    found = batch.organ(organ.name).contact_force.numpy().sum(axis=1)
    out.append([*found, organ.contact_force.sum(axis=0)])
  return np.array(out)


def off(found, world=0):
  """Returns how far forces of `abreast` in a world are from the plugin's: RMS by its peak [-]."""
  expected = found[:, -1]
  return np.sqrt(np.mean((found[:, world] - expected) ** 2)) / np.abs(expected).max()


def draw(model, data, drawn):
  """Draws a state into an MjvScene, as a viewer does."""
  everything = mujoco.mjtCatBit.mjCAT_ALL.value
  about = mujoco.MjvOption(), mujoco.MjvPerturb(), mujoco.MjvCamera()
  mujoco.mjv_updateScene(model, data, *about, everything, drawn)


class Warnings:
  """Collects MuJoCo's warnings instead of a log file."""

  def __enter__(self):
    self.lines = []
    mujoco.set_mju_user_warning(self.lines.append)
    return lambda: "\n".join(self.lines)

  def __exit__(self, *_):
    mujoco.set_mju_user_warning(None)


def state(model, data, kind=mujoco.mjtState.mjSTATE_INTEGRATION):
  """Returns mj_getState's numbers."""
  out = np.zeros(mujoco.mj_stateSize(model, kind))
  mujoco.mj_getState(model, data, out, kind)
  return out


def goes_on(model, data, drive, fresh=True):
  """Asserts that a motion goes on to the bit in a copy, and where its state is set; returns it.

  Args:
    model: of the data
    data: whose motion it is; it is driven, and again after a reset
    drive: takes a data, moves it and returns what it saw, an array
    fresh: whether the state is set in a data as well that knows nothing of this one
  """
  kept, others = state(model, data), [copy.copy(data)]
  expected = drive(data)
  mujoco.mj_resetData(model, data)
  for each in [data, mujoco.MjData(model)][: 1 + fresh]:
    mujoco.mj_setState(model, each, kept, mujoco.mjtState.mjSTATE_INTEGRATION)
    others.append(each)
  for each in others:
    np.testing.assert_array_equal(drive(each), expected)
  return expected
