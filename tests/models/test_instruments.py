"""The instruments: loading, reach, drives, grip, coupling and sensors."""

import itertools
import warnings

import mujoco
import numpy as np
import pytest
from palpate.models import trocar as trocar_lib
from palpate.models.handle import Handle, pose
from palpate.models.trocar import NAMES, aim, attach, forward, inverse

JAWED = ("grasper", "scissors")
VARIANTS = [(name, handle) for name in NAMES for handle in (False, True)]
INTEGRATORS = (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
STIFFNESS, DAMPING = 500.0, 10.0  # of the virtual coupling [N/m], [N s/m]
QUAT = np.array([0.8, 0.3, -0.4, 0.33]) / np.linalg.norm([0.8, 0.3, -0.4, 0.33])


def _load(name, handle=False, timestep=0.002, integrator=INTEGRATORS[0]):
  model = mujoco.MjModel.from_xml_path(str(trocar_lib.path(name, handle)))
  model.opt.timestep = timestep
  model.opt.integrator = integrator
  return model, mujoco.MjData(model)


def _step(model, data, seconds):
  mujoco.mj_step(model, data, round(seconds / model.opt.timestep))


def _settled_at(model, insertion):
  """Returns data at rest at an insertion, with the actuator holding it."""
  data = mujoco.MjData(model)
  data.joint("insertion").qpos = insertion
  data.actuator("insertion").ctrl = insertion
  mujoco.mj_forward(model, data)
  return data


def _push(model, data, force):
  """Applies a force [N] in the world at the tip site."""
  body = model.body("tip").id
  data.xfrc_applied[body, :3] = force
  data.xfrc_applied[body, 3:] = np.cross(data.site("tip").xpos - data.xipos[body], force)


def _quiet(data):
  return all(warning.number == 0 for warning in data.warning)


@pytest.mark.parametrize(("name", "handle"), VARIANTS)
def test_loads_alone_and_stays_where_it_is(name, handle):
  with warnings.catch_warnings():
    warnings.simplefilter("error")
    model, data = _load(name, handle)
  mujoco.mj_forward(model, data)
  np.testing.assert_allclose(data.site("trocar").xpos, 0, atol=1e-12)
  np.testing.assert_allclose(data.site("tip").xpos, [0, 0, -trocar_lib.DEPTH], atol=1e-12)
  for site in ("tip", "trocar", "shaft"):
    assert model.site(site).id >= 0
  _step(model, data, 0.5)
  assert _quiet(data)
  assert data.ncon == 0
  np.testing.assert_allclose(data.site("tip").xpos, [0, 0, -trocar_lib.DEPTH], atol=1e-9)


@pytest.mark.parametrize(("name", "handle"), VARIANTS)
def test_attached_twice_under_rotated_frames(name, handle):
  spec = mujoco.MjSpec()
  with warnings.catch_warnings():
    warnings.simplefilter("error")
    attach(spec, name, "left/", pos=[-0.1, 0, 0.2], quat=QUAT, handle=handle)
    attach(spec, name, "right/", pos=[0.1, 0, 0.2], handle=handle)
    model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  alone, _ = _load(name, handle)
  assert (model.nv, model.nu, model.nsensor) == (2 * alone.nv, 2 * alone.nu, 2 * alone.nsensor)
  assert model.nmocap == 2 * handle
  np.testing.assert_allclose(model.body("left/tip").mass, alone.body("tip").mass)
  down = np.zeros(3)
  mujoco.mju_rotVecQuat(down, np.array([0, 0, -trocar_lib.DEPTH]), QUAT)
  expected = np.array([-0.1, 0, 0.2]) + down
  np.testing.assert_allclose(data.site("left/tip").xpos, expected, atol=1e-12)
  _step(model, data, 0.3)
  assert _quiet(data)
  np.testing.assert_allclose(data.site("left/tip").xpos, expected, atol=1e-9)


def test_mjcf_attach_and_scene():
  folder = trocar_lib.path("probe").parent
  model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
  assert [model.body(f"{name}/tip").id > 0 for name in NAMES] == [True] * len(NAMES)
  data = mujoco.MjData(model)
  _step(model, data, 0.05)
  assert _quiet(data)
  included = f'<mujoco><include file="{folder / "probe.xml"}"/></mujoco>'
  assert mujoco.MjModel.from_xml_string(included).nv == 4


@pytest.mark.parametrize(("name", "handle"), VARIANTS)
def test_ranges(name, handle):
  model, _ = _load(name, handle)
  for joint, expected in zip(trocar_lib.JOINTS, trocar_lib.RANGES, strict=True):
    assert model.joint(joint).limited
    np.testing.assert_allclose(model.joint(joint).range, expected)
  for actuator in range(model.nu):
    assert model.actuator_ctrllimited[actuator]
    assert model.actuator_forcelimited[actuator]


@pytest.mark.parametrize("name", NAMES)
def test_joint_limits_hold(name):
  model, data = _load(name)
  for joint, (low, high) in zip(trocar_lib.JOINTS, trocar_lib.RANGES, strict=True):
    for limit in (low, high):
      mujoco.mj_resetData(model, data)
      data.joint(joint).qpos = limit
      data.joint(joint).qfrc_applied = np.sign(limit) * (20 if joint == "insertion" else 2)
      data.actuator(joint).ctrl = limit
      _step(model, data, 0.3)
      assert abs(data.joint(joint).qpos[0]) - abs(limit) < 5e-3  # soft limits


def test_inverse_matches_mujoco():
  rng = np.random.RandomState(0)
  spec = mujoco.MjSpec()
  attach(spec, "grasper", "g/", pos=[0.1, -0.2, 0.3], quat=QUAT)
  model = spec.compile()
  data = mujoco.MjData(model)
  trocar = trocar_lib.trocar(model, "g/")
  assert trocar.depth == pytest.approx(trocar_lib.DEPTH)
  low, high = np.array(trocar_lib.RANGES).T
  joints = rng.uniform(low, high, size=(200, 4))
  tip = np.zeros((200, 3))
  for i, q in enumerate(joints):
    for joint, value in zip(trocar_lib.JOINTS, q, strict=True):
      data.joint(f"g/{joint}").qpos = value
    mujoco.mj_kinematics(model, data)
    tip[i] = data.site("g/tip").xpos
  np.testing.assert_allclose(forward(trocar, joints), tip, atol=1e-9)
  np.testing.assert_allclose(inverse(trocar, tip), joints[:, :3], atol=1e-9)
  np.testing.assert_allclose(inverse(trocar, tip[7]), joints[7, :3], atol=1e-9)
  np.testing.assert_allclose(
    inverse(trocar, tip.reshape(10, 20, 3)), joints[:, :3].reshape(10, 20, 3), atol=1e-9
  )
  corners = np.array(list(itertools.product(*trocar_lib.RANGES[:3])))
  np.testing.assert_allclose(inverse(trocar, forward(trocar, corners)), corners, atol=1e-9)


def test_out_of_reach_says_what_and_why():
  trocar = trocar_lib.Trocar("left/")
  with pytest.raises(ValueError, match=r"'left/'.*insertion is 0\.38 m.*\[-0\.08, 0\.13\]"):
    inverse(trocar, [0, 0, -0.5])
  with pytest.raises(ValueError, match=r"pitch of point \(1,\) is 1\.3"):
    inverse(trocar, forward(trocar, [[0.1, 0, 0], [1.3, 0, 0]]))
  with pytest.raises(ValueError, match=r"yaw is -1\.2 rad"):
    inverse(trocar, forward(trocar, [0, -1.2, 0]))
  with pytest.raises(ValueError, match="expected a number"):
    inverse(trocar, [np.nan, 0, -0.1])
  assert inverse(trocar, [0, 0, -0.5], check=False)[2] == pytest.approx(0.38)
  with pytest.raises(ValueError, match="probe, grasper, scissors, hook, scalpel, laparoscope"):
    trocar_lib.path("drill")
  model, data = _load("probe")
  with pytest.raises(ValueError, match="no instrument with the prefix 'x/'"):
    trocar_lib.trocar(model, "x/")
  with pytest.raises(ValueError, match="has no handle"):
    Handle(model, data)
  with pytest.raises(ValueError, match="target"):
    aim([0, 0, 1], [0, 0, 1])


@pytest.mark.parametrize("target", [(0, 0, -1), (0.3, -0.2, -0.4), (1, 0, 0), (0, 0, 2)])
def test_aim_points_the_shaft(target):
  quat, shaft = aim([0, 0, 0.5], target), np.zeros(3)
  mujoco.mju_rotVecQuat(shaft, np.array([0.0, 0, -1]), quat)
  direction = np.subtract(target, [0, 0, 0.5])
  np.testing.assert_allclose(shaft, direction / np.linalg.norm(direction), atol=1e-12)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("timestep", [0.0005, 0.002])
@pytest.mark.parametrize(
  ("actuator", "step", "insertion", "settle"),
  [
    ("pitch", 0.02, -0.08, 0.06),
    ("pitch", 0.02, 0.13, 0.06),
    ("yaw", -0.8, 0.0, 0.5),  # saturated: 2 rad/s
    ("insertion", 0.005, 0.0, 0.05),
    ("insertion", 0.12, 0.0, 0.35),  # saturated: 0.44 m/s
    ("roll", 2.0, 0.0, 0.3),
    ("jaw", 0.9, 0.0, 0.2),
  ],
)
def test_step_response(actuator, step, insertion, settle, timestep, integrator):
  model, _ = _load("grasper", False, timestep, integrator)
  data = _settled_at(model, insertion)
  data.actuator(actuator).ctrl = step
  length = []
  for _ in range(round(0.7 / timestep)):
    mujoco.mj_step(model, data)
    length.append(data.actuator(actuator).length[0] / step)
  length = np.array(length)
  assert length.max() < 1.02  # overshoot, worst with the handle farthest from the trocar
  assert np.abs(length[round(settle / timestep) :] - 1).max() < 0.02
  assert abs(length[-1] - 1) < 1e-6


@pytest.mark.parametrize("name", NAMES)
def test_two_newtons_move_the_tip_less_than_a_millimetre(name):
  model, _ = _load(name)
  for insertion, force in itertools.product((-0.08, 0.0, 0.13), 2 * np.eye(3)):
    data = _settled_at(model, insertion)
    start = data.site("tip").xpos.copy()
    _push(model, data, force)
    _step(model, data, 0.4)
    assert np.linalg.norm(data.site("tip").xpos - start) < 1e-3


@pytest.mark.parametrize("name", NAMES)
def test_presses_a_box_with_few_contacts_and_reads_the_force(name):
  spec = mujoco.MjSpec.from_file(str(trocar_lib.path(name)))
  top = -0.13 + (0.0095 if name == "scalpel" else 0.0)  # its blade goes through
  spec.worldbody.add_geom(
    type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.05, 0.05, 0.01], pos=[0, 0, top - 0.01]
  )
  model = spec.compile()
  data = mujoco.MjData(model)
  data.actuator("insertion").ctrl = 0.0105
  _step(model, data, 1.0)
  force = data.sensor("tip_force").data
  assert 1 < -force[2] < 2.5  # the drive is 4000 N/m and the contact gives a little
  np.testing.assert_allclose(-force[2], data.sensor("insertion_force").data[0], rtol=1e-2)
  np.testing.assert_allclose(force[:2], 0, atol=1e-2)
  assert 1 <= data.ncon <= (12 if name == "knot_pusher" else 4)  # its ring lies on all its pieces
  assert data.sensor("tip_contacts").data[0] == data.ncon
  assert data.sensor("shaft_contacts").data[0] == 0


@pytest.mark.parametrize("first", [True, False])
def test_tip_force_is_the_weight_it_carries(first):
  """A 0.2 kg block rests on an upturned probe, whichever comes first in the model."""
  spec = mujoco.MjSpec()
  if not first:
    attach(spec, "probe", "p/", quat=[0, 1, 0, 0])
  block = spec.worldbody.add_body(pos=[0, 0, 0.13])
  block.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
  block.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.01, 0.01, 0.01], mass=0.2)
  if first:
    attach(spec, "probe", "p/", quat=[0, 1, 0, 0])
  model = spec.compile()
  data = mujoco.MjData(model)
  _step(model, data, 2.0)
  weight = 0.2 * 9.81
  np.testing.assert_allclose(data.sensor("p/tip_force").data, [0, 0, weight], atol=1e-2 * weight)
  np.testing.assert_allclose(data.sensor("p/insertion_force").data, weight, rtol=1e-2)


def test_shaft_contact_is_told_apart():
  spec = mujoco.MjSpec.from_file(str(trocar_lib.path("probe")))
  spec.worldbody.add_geom(
    type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.01, 0.05, 0.01], pos=[0.0115, 0, -0.06]
  )
  model = spec.compile()
  data = mujoco.MjData(model)
  _step(model, data, 0.3)
  assert data.sensor("shaft_contacts").data[0] > 0
  assert data.sensor("shaft_force").data[0] > 0
  assert data.sensor("tip_contacts").data[0] == 0


def test_force_sensors_see_a_flex():
  spec = mujoco.MjSpec.from_string("""
    <mujoco><option integrator="discrete"/><worldbody>
      <flexcomp name="sheet" type="grid" dim="2" count="5 5 1" spacing="0.01 0.01 0.01"
        pos="0 0 -0.125" radius="0.001" mass="0.02">
        <elasticity young="1e5" poisson="0.2" thickness="0.002" damping="0.01" elastic2d="both"/>
        <contact selfcollide="none"/>
        <pin id="0 1 2 3 4 5 9 10 14 15 19 20 21 22 23 24"/>
      </flexcomp></worldbody></mujoco>""")
  attach(spec, "probe", "p/")
  model = spec.compile()
  data = mujoco.MjData(model)
  for t in np.arange(0, 1, model.opt.timestep):
    data.actuator("p/insertion").ctrl = 0.01 * min(t / 0.5, 1)
    mujoco.mj_step(model, data)
  force = data.sensor("p/tip_force").data
  assert force[2] < -0.03
  np.testing.assert_allclose(-force[2], data.sensor("p/insertion_force").data[0], rtol=2e-2)


def test_instruments_collide_with_each_other():
  spec = mujoco.MjSpec()
  attach(spec, "probe", "a/", pos=[0.05, 0, 0])
  attach(spec, "probe", "b/", pos=[-0.05, 0, 0], quat=aim([-0.05, 0, 0], [0.06, 0, -0.1]))
  model = spec.compile()
  data = mujoco.MjData(model)
  data.actuator("b/insertion").ctrl = 0.06
  _step(model, data, 0.5)
  assert data.ncon > 0
  assert data.sensor("a/tip_contacts").data[0] + data.sensor("a/shaft_contacts").data[0] > 0


@pytest.mark.parametrize("name", JAWED)
def test_jaws_move_as_mirror_images(name):
  model, data = _load(name)
  for ctrl in (1.0, 0.3, 0.6, 0.0):
    data.actuator("jaw").ctrl = ctrl
    for _ in range(round(0.4 / model.opt.timestep)):
      mujoco.mj_step(model, data)
      assert abs(data.joint("jaw_left").qpos[0] - data.joint("jaw_right").qpos[0]) < 1e-6
    np.testing.assert_allclose(data.sensor("jaw").data[0], ctrl, atol=1e-3)
  assert data.ncon == 0


def test_one_loaded_jaw_takes_the_other_along():
  model, data = _load("grasper")
  data.actuator("jaw").ctrl = 0.6
  _step(model, data, 0.5)
  data.joint("jaw_left").qfrc_applied = 0.024  # 2 N at the middle of the pad
  _step(model, data, 0.5)
  left, right = data.joint("jaw_left").qpos[0], data.joint("jaw_right").qpos[0]
  np.testing.assert_allclose(left, right, atol=0.02)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_grip_force(integrator):
  """Closed on something at the middle of its pads, 12 mm from the pivot, each jaw gives 10 N."""
  spec = mujoco.MjSpec.from_file(str(trocar_lib.path("grasper")))
  spec.worldbody.add_geom(
    type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.001, 0.003, 0.001], pos=[0, 0, -0.11]
  )
  model = spec.compile()
  model.opt.integrator = integrator
  data = mujoco.MjData(model)
  data.joint("jaw_left").qpos = data.joint("jaw_right").qpos = 0.5
  mujoco.mj_forward(model, data)
  data.actuator("jaw").ctrl = -0.2
  _step(model, data, 1.0)
  left, right = data.sensor("touch_left").data[0], data.sensor("touch_right").data[0]
  np.testing.assert_allclose([left, right], 10, rtol=0.05)  # the lever shifts with the opening
  np.testing.assert_allclose(left, right, rtol=1e-3)
  wedge = left * np.sin(data.sensor("jaw").data[0])  # most that the jaws' angle can push forwards
  assert -wedge < data.sensor("tip_force").data[2] < 1e-3
  np.testing.assert_allclose(data.sensor("tip_force").data[:2], 0, atol=1e-3)
  data.actuator("jaw").ctrl = data.sensor("jaw").data[0] - 0.03
  _step(model, data, 0.5)
  torque = 1.2 * (data.sensor("jaw").data[0] - data.actuator("jaw").ctrl[0])
  np.testing.assert_allclose(data.sensor("touch_left").data[0], torque / 0.012, rtol=0.05)
  assert data.ncon <= 4


@pytest.mark.parametrize("name", NAMES)
def test_coupling_is_the_stated_spring(name):
  """A constant force on the tip displaces it from the handle by force / stiffness."""
  model, data = _load(name, True)
  trocar = trocar_lib.trocar(model)
  rng = np.random.RandomState(1)
  for force in rng.uniform(-2, 2, size=(4, 3)):
    mujoco.mj_resetData(model, data)
    handle = forward(trocar, rng.uniform([-0.5, -0.5, -0.04], [0.5, 0.5, 0.08]))
    held = Handle(model, data)
    held.move(handle, pose(trocar, handle, rng.uniform(-1, 1))[3:])
    for _ in range(1500):
      _push(model, data, force)
      mujoco.mj_step(model, data)
    # Near the trocar the springs against swinging take up to 1.5 % of it.
    np.testing.assert_allclose(
      data.site("tip").xpos - handle, force / STIFFNESS, atol=0.015 * 2 / STIFFNESS
    )
    np.testing.assert_allclose(held.wrench()[:3], force, atol=0.015 * 2)


def test_coupling_is_the_stated_damper():
  """With the tip on the handle the force is damping times velocity, relative if both are known."""
  model, data = _load("probe", True)
  data.joint("pitch").qvel, data.joint("yaw").qvel, data.joint("insertion").qvel = 0.5, -0.3, 0.1
  mujoco.mj_forward(model, data)
  velocity = data.sensor("tip_vel").data.copy()
  assert np.linalg.norm(velocity) > 0.1
  np.testing.assert_allclose(Handle(model, data).wrench()[:3], DAMPING * velocity, rtol=1e-9)
  handle = np.array([0.02, 0.1, -0.05])
  held = Handle(model, data)
  held.move(data.site("tip").xpos, vel=handle)
  mujoco.mj_forward(model, data)
  np.testing.assert_allclose(held.wrench()[:3], DAMPING * (velocity - handle), rtol=1e-9)


def test_coupling_decays_as_spring_damper_and_mass_do():
  """Along the shaft the tool is one mass: compare with m x'' + (c + c_joint) x' + k x = 0."""
  model, data = _load("probe", True, 1e-4)
  data.joint("insertion").qpos = 0.005
  mass = 0.0502  # shaft, grip and tip [kg]
  damping = DAMPING + model.dof_damping[2]
  root = np.sqrt(complex(damping**2 / 4 - STIFFNESS * mass))
  s1, s2 = (-damping / 2 + root) / mass, (-damping / 2 - root) / mass
  t = np.arange(1, 501) * 1e-4
  expected = 0.005 * np.real((s1 * np.exp(s2 * t) - s2 * np.exp(s1 * t)) / (s1 - s2))
  measured = []
  for _ in t:
    mujoco.mj_step(model, data)
    measured.append(data.joint("insertion").qpos[0])
  np.testing.assert_allclose(measured, expected, atol=0.005 * 1e-2)  # first-order step of 0.1 ms


@pytest.mark.parametrize("timestep", [0.0005, 0.002])
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("insertion", [-0.08, 0.0, 0.13])
def test_coupling_settles(insertion, integrator, timestep):
  model, _ = _load("grasper", True, timestep, integrator)
  data = mujoco.MjData(model)
  data.joint("insertion").qpos = insertion
  mujoco.mj_forward(model, data)
  start = data.site("tip").xpos.copy()
  inwards = [0.005, 0.003, 0.004 if insertion > 0 else -0.004]
  goal = start + inwards
  Handle(model, data).move(goal, pose(trocar_lib.trocar(model), goal)[3:])
  peak = 0.0
  for _ in range(round(1 / timestep)):
    mujoco.mj_step(model, data)
    peak = max(peak, (data.site("tip").xpos - start)[0] / 0.005)
  assert peak < (1.12 if insertion < 0 else 1.02)  # near the trocar the lever makes the tool heavy
  np.testing.assert_allclose(data.site("tip").xpos, start + inwards, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_dragging_the_handle_moves_the_tip(name):
  spec = mujoco.MjSpec()
  attach(spec, name, "a/", pos=[0.1, 0, 0.2], quat=QUAT, handle=True)
  model = spec.compile()
  data = mujoco.MjData(model)
  trocar = trocar_lib.trocar(model, "a/")
  center = forward(trocar, [0.1, -0.1, 0.0])
  lag, held = [], Handle(model, data, "a/")
  for t in np.arange(0, 1.5, model.opt.timestep):
    pos = center + 0.02 * np.array([np.sin(4 * t), np.cos(4 * t), 0])
    held.move(pos, pose(trocar, pos)[3:], 0.08 * np.array([np.cos(4 * t), -np.sin(4 * t), 0]))
    mujoco.mj_step(model, data)
    lag.append(np.linalg.norm(data.site("a/tip").xpos - pos))
  assert np.max(lag[250:]) < 2e-3
  assert _quiet(data)
