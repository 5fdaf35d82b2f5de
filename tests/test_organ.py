"""`Organ`: what a user reads and sets."""

import mujoco
import numpy as np
import palpate
import pytest
from palpate.attributes import CONTACT, text
from palpate.tissue.geometry import mesh as topology


@pytest.fixture
def pressed(scenes, device):
  """Returns model, data and organ of a sphere that is pressed and held."""
  model, data, organ = scenes.load(scenes.press(bulk=1e4, device=device))
  scenes.run(model, data, 500)
  return model, data, organ


def test_shapes_and_what_stays_constant(scenes, device):
  points, elem = scenes.sphere(1)
  config = {"young": 3e4, "foundation": 1e5, "device": device}
  *_, organ = scenes.load(scenes.world(scenes.organ(points, elem, pin=[2], **config)))
  n = len(points)
  assert (organ.nvert, organ.elem.shape) == (n, elem.shape)
  for name in ("xpos", "xvel", "xpos0", "displacement", "contact_force"):
    assert getattr(organ, name).shape == (n, 3), name
  np.testing.assert_array_equal(organ.elem, elem)
  np.testing.assert_allclose(organ.xpos0, points, atol=1e-12)
  np.testing.assert_array_equal(np.flatnonzero(~organ.free), [2])
  assert organ.config.young == (3e4,) and organ.config.foundation == 1e5
  assert organ.device.startswith(device[:3])
  assert organ.error is None


def test_positions_and_velocities_are_those_of_mujoco(scenes, pressed):
  model, data, organ = pressed
  mujoco.mj_forward(model, data)
  np.testing.assert_allclose(organ.xpos, data.flexvert_xpos, atol=1e-12)
  body = model.flex_vertbodyid
  velocity = np.zeros(6)
  mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body[0], velocity, 0)
  np.testing.assert_allclose(organ.xvel[0], velocity[3:], atol=1e-12)


def test_contact_force_is_what_the_tool_feels(pressed):
  model, data, organ = pressed
  total = np.zeros(3)
  for i in range(data.ncon):
    wrench = np.zeros(6)
    mujoco.mj_contactForce(model, data, i, wrench)
    total += data.contact.frame[i].reshape(3, 3).T @ wrench[:3]
  assert organ.force[2] < -0.3
  np.testing.assert_allclose(np.abs(organ.force), np.abs(total), atol=1e-6)
  touched = np.linalg.norm(organ.contact_force, axis=1) > 1e-6
  assert 0 < touched.sum() < organ.nvert / 4
  # Tool at rest: the actuator holds the tool's weight-free contact force.
  assert data.qfrc_constraint[-1] == pytest.approx(-organ.force[2], rel=1e-6)


def test_work_of_a_slow_pull_is_the_energy(scenes):
  points, elem = scenes.sphere(2)
  config = {"young": 3e4, "foundation": 1e5, "bulk": 1e4, "damping": 1e-3}
  model, data, organ = scenes.load(scenes.world(scenes.organ(points, elem, **config)))
  top = int(np.argmax(points[:, 2]))
  work = 0.0
  for k in range(2000):
    force, before = 0.1 * k / 2000, organ.displacement[top, 2]
    data.qfrc_applied[scenes.dofs(organ)[top, 2]] = force
    mujoco.mj_step(model, data)
    work += force * (organ.displacement[top, 2] - before)
  assert organ.displacement[top, 2] > 2e-3
  assert organ.energy == pytest.approx(work, rel=0.02)  # damping takes the rest


def test_volume(pressed, scenes):
  _, _, organ = pressed
  assert organ.volume == pytest.approx(topology.volume(organ.xpos, organ.elem), rel=1e-9)
  rest = topology.volume(organ.xpos0, organ.elem)
  assert 0.97 < organ.volume / rest < 1
  strip = scenes.organ(*scenes.triangular(0.1, 0.05, 4, 3))
  *_, open_organ = scenes.load(scenes.world(strip))
  assert np.isnan(open_organ.volume)


def test_a_stiffer_volume_gives_way_less(scenes):
  lost = []
  for bulk in (1e3, 1e5):
    model, data, organ = scenes.load(scenes.press(bulk=bulk))
    scenes.run(model, data, 300)
    lost.append(1 - organ.volume / topology.volume(organ.xpos0, organ.elem))
  assert 0 < lost[1] < 0.2 * lost[0]


def test_iterations_and_residual_of_the_last_step(scenes, device):
  model, data, organ = scenes.load(scenes.press(tolerance=1e-5, device=device))
  seen = []
  for _ in range(100):
    scenes.run(model, data, 1)
    assert organ.residual <= 1e-5
    seen.append(organ.iterations)
  assert 1 <= max(seen) < 50


def test_set_state_and_reset(scenes, pressed):
  model, data, organ = pressed
  random = np.random.RandomState(0)
  xpos = organ.xpos0 + random.uniform(-1e-3, 1e-3, organ.xpos0.shape)
  xvel = random.uniform(-1, 1, xpos.shape)
  organ.set_state(xpos, xvel)
  np.testing.assert_allclose(organ.xpos, xpos, atol=1e-12)
  np.testing.assert_allclose(organ.xvel, xvel, atol=1e-12)
  organ.set_state(xvel=-xvel)
  np.testing.assert_allclose(organ.xpos, xpos, atol=1e-12)
  np.testing.assert_allclose(organ.xvel, -xvel, atol=1e-12)
  tool = data.qpos[-1]
  organ.reset()
  np.testing.assert_array_equal(organ.displacement, 0)
  np.testing.assert_array_equal(organ.xvel, 0)
  assert data.qpos[-1] == tool
  fresh = scenes.load(scenes.press(bulk=1e4))
  mujoco.mj_resetData(model, data)
  organ.set_state(xpos, xvel)
  fresh[2].set_state(xpos, xvel)
  if organ.device == "cpu":
    expected = scenes.run(fresh[0], fresh[1], 30, record=True)
    np.testing.assert_array_equal(scenes.run(model, data, 30, record=True), expected)


def test_set_state_under_a_rotated_frame_leaves_pins(scenes):
  points, elem = scenes.sphere(1)
  inside = scenes.organ(points, elem, pin=[0, 7], foundation=1e4)
  xml = scenes.world(f'<body name="frame" pos="1 2 3" euler="20 50 -70">{inside}</body>')
  _, _, organ = scenes.load(xml)
  target = organ.xpos0 + np.random.RandomState(0).uniform(-0.01, 0.01, (organ.nvert, 3))
  organ.set_state(target, target)
  np.testing.assert_allclose(organ.xpos[organ.free], target[organ.free], atol=1e-12)
  np.testing.assert_allclose(organ.xvel[organ.free], target[organ.free], atol=1e-12)
  np.testing.assert_array_equal(organ.xpos[~organ.free], organ.xpos0[~organ.free])


def test_energy_does_not_depend_on_the_frame(scenes):
  points, elem = scenes.sphere(1)
  inside = scenes.organ(points, elem, foundation=1e4, bulk=1e3)
  energy = []
  for frame in ("", 'pos="1 2 3" euler="20 50 -70"'):
    _, data, organ = scenes.load(scenes.world(f'<body name="frame" {frame}>{inside}</body>'))
    mujoco.mj_kinematics(organ.model, data)
    turn = data.body("frame").xmat.reshape(3, 3)
    organ.set_state(organ.xpos0 + np.random.RandomState(0).uniform(-0.01, 0.01, (42, 3)) @ turn.T)
    energy.append(organ.energy)
  assert energy[0] > 0
  assert energy[1] == pytest.approx(energy[0], rel=1e-9)


@pytest.mark.parametrize(
  ("arguments", "words"),
  [
    ({"xpos": np.zeros((3, 3))}, ("xpos", "(3, 3)", "(162, 3)")),
    ({"xvel": np.zeros(486)}, ("xvel", "(486,)", "(162, 3)")),
    ({"xpos": np.full((162, 3), np.nan)}, ("xpos", "not finite")),
  ],
)
def test_set_state_refuses_what_does_not_fit_and_changes_nothing(scenes, arguments, words):
  _, _, organ = scenes.load(scenes.press())
  with pytest.raises(ValueError, match="organ 'organ'") as error:
    organ.set_state(**arguments)
  for word in words:
    assert word in str(error.value)
  np.testing.assert_array_equal(organ.displacement, 0)


def test_a_good_position_with_a_bad_velocity_changes_nothing(scenes):
  _, _, organ = scenes.load(scenes.press())
  with pytest.raises(ValueError, match="xvel"):
    organ.set_state(organ.xpos0 + 1, np.zeros(3))
  np.testing.assert_array_equal(organ.displacement, 0)


def test_configuration_changes_while_running(scenes, device):
  points, elem = scenes.sphere(1)
  model, data, organ = scenes.load(
    scenes.world(scenes.organ(points, elem, foundation=1e5, device=device), gravity=(0, 0, -9.81))
  )
  scenes.run(model, data, 400)
  sag = organ.displacement[:, 2].mean()
  organ.configure(foundation=2e5, tolerance=1e-6)
  assert (organ.config.foundation, organ.config.tolerance) == (2e5, 1e-6)
  scenes.run(model, data, 400)
  assert organ.displacement[:, 2].mean() == pytest.approx(sag / 2, rel=0.02)
  organ.configure(bulk=1e4, pressure=100)  # terms that were off
  rest = organ.volume
  scenes.run(model, data, 400)
  assert organ.error is None
  assert organ.volume > 1.001 * rest


@pytest.mark.parametrize(
  ("keys", "words"),
  [
    ({"bend": 2}, ("bend",)),
    ({"young_scale": 0}, ("young_scale is '0', expected a number > 0",)),
    ({"young": [1e4, 2e4]}, ("young has 2 values",)),
    ({"damping": -1}, ("damping is '-1'", "a number >= 0")),
    ({"integrator": "rk4"}, ("integrator is 'rk4'", "'implicit'")),
    ({"stiff": 1}, ("stiff",)),
  ],
)
def test_a_configuration_that_may_not_change_stays(scenes, keys, words):
  _, _, organ = scenes.load(scenes.press())
  before = organ.config
  with pytest.raises(ValueError, match="organ 'organ'") as error:
    organ.configure(**keys)
  for word in words:
    assert word in str(error.value)
  assert organ.config == before


@pytest.mark.parametrize("force", [0.7, 3.0, 10.0])
@pytest.mark.parametrize("windowed", [False, True], ids=["nodal", "window"])
def test_an_8_mm_ball_at_a_hands_speed_does_not_go_through(scenes, windowed, force):
  build = scenes.windowed if windowed else scenes.organ
  contact = {key: text(value) for key, value in CONTACT.items()}
  keys = {"young": 5e3, "foundation": 2e5, "bulk": 1e4}
  made = build(*scenes.sphere(2), mass=0.5, radius=0.001, contact=contact, **keys)
  tool = f"""<body name="ball" pos="0.0003 0.0002 {scenes.RADIUS + 0.0055}">
    <joint name="z" type="slide" axis="0 0 1"/><geom size="0.004" mass="0.02"/></body>"""
  model, data, organ = scenes.load(scenes.world(tool, made))
  joint = model.joint("z")
  data.qvel[joint.dofadr[0]] = -0.25
  for _ in range(400):
    data.qfrc_applied[joint.dofadr[0]] = -force * min(1, data.time / 0.05)
    mujoco.mj_step(model, data)
  assert organ.error is None and organ.pierced == ()
  assert data.qfrc_constraint[joint.dofadr[0]] > 0.5 * force  # it is held


@pytest.mark.parametrize("windowed", [False, True], ids=["nodal", "window"])
def test_a_tool_that_goes_through_the_surface_is_named_once(scenes, windowed):
  model, data, organ = scenes.load(scenes.probed(windowed, keys={"foundation": 1e5}))
  joint = model.joint("z")
  with scenes.Warnings() as log:
    scenes.drive(model, data, 110)
    assert organ.pierced == () and data.qfrc_constraint[joint.dofadr[0]] > 0.1
    data.qpos[joint.qposadr[0]] = -scenes.RADIUS  # a jump to the middle
    for _ in range(1000):
      data.ctrl[0] = -scenes.RADIUS
      mujoco.mj_step(model, data)
    text = log()
  assert organ.pierced == ("tip",)
  assert text.count("geom 'tip' has gone through its surface") == 1
  mujoco.mj_resetData(model, data)
  mujoco.mj_forward(model, data)
  assert organ.pierced == ()


@pytest.mark.parametrize("windowed", [False, True], ids=["nodal", "window"])
def test_a_tool_that_flies_through_the_organ_is_named(scenes, windowed):
  build = scenes.windowed if windowed else scenes.organ
  made = build(*scenes.sphere(2), mass=0.5, radius=0.001, young=5e3, foundation=2e5)
  tool = """<body name="ball" pos="0.0003 0.0002 0.5"><joint name="z" type="slide" axis="0 0 1"/>
    <geom name="shot" size="0.002" mass="0.02"/></body>"""
  model, data, organ = scenes.load(scenes.world(tool, made))
  joint = model.joint("z")
  with scenes.Warnings() as log:
    mujoco.mj_step(model, data, nstep=33)
    assert organ.pierced == ()
    data.qvel[joint.dofadr[0]] = -10.0
    mujoco.mj_step(model, data, nstep=100)
    text = log()
  assert data.qpos[joint.qposadr[0]] < -0.8  # on the other side
  assert text.count("geom 'shot' has gone through its surface") == 1
  assert organ.pierced == ("shot",)
  organ.reset()
  assert organ.pierced == ()


@pytest.mark.parametrize("size", ["0.001 0.03 0.001", "0.03 0.03 0.001"], ids=["bar", "plate"])
def test_a_thin_box_pressed_through_beside_its_centre_is_named(scenes, size):
  made = scenes.windowed(*scenes.sphere(2), mass=0.5, radius=0.001, young=5e3, foundation=2e5)
  tool = f"""<body name="bar" pos="0 {scenes.RADIUS + 0.005} {scenes.RADIUS}">
    <joint name="z" type="slide" axis="0 0 1"/>
    <geom name="thin" type="box" size="{size}" mass="0.1"/></body>"""
  drive = '<actuator><position joint="z" kp="5000" kv="60"/></actuator>'
  model, data, organ = scenes.load(scenes.world(tool, made, extra=drive))
  for _ in range(600):
    data.ctrl[0] = -0.1 * min(data.time, 0.3)
    mujoco.mj_step(model, data)
  assert not organ.error and organ.pierced == ("thin",)


def test_a_tool_that_is_put_on_the_other_side_has_not_gone_through(scenes):
  made = scenes.windowed(*scenes.sphere(2), mass=0.5, radius=0.001, young=5e3, foundation=2e5)
  tool = """<body name="ball" pos="0 0 0.1"><joint name="z" type="slide" axis="0 0 1"/>
    <geom name="shot" size="0.002" mass="0.02"/></body>"""
  model, data, organ = scenes.load(scenes.world(tool, made))
  mujoco.mj_step(model, data, nstep=33)
  data.qpos[model.joint("z").qposadr[0]] = -0.2
  mujoco.mj_step(model, data, nstep=50)
  assert organ.pierced == ()


def test_an_unknown_name_lists_the_organs(scenes):
  model, data, _ = scenes.load(scenes.press())
  with pytest.raises(ValueError, match=r"no organ 'liver' in the model, it has 'organ'"):
    palpate.Organ(model, data, "liver")
  bare = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><flexcomp name="f" type="grid" dim="2" count="3 3 1" spacing=".1 .1 .1">'
    '<edge damping="1e-9"/></flexcomp>'
    "</worldbody></mujoco>"
  )
  with pytest.raises(ValueError, match="it has none"):
    palpate.Organ(bare, mujoco.MjData(bare), "f")


def test_an_organ_outlives_a_deleted_model_variable(scenes):
  model, data, organ = scenes.load(scenes.press())
  twin = palpate.Organ(model, data, "organ")
  del model, data
  np.testing.assert_array_equal(twin.xpos, organ.xpos)
