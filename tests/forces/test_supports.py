"""Organs that lie on floors, bodies and each other, are lifted, and fall back."""

import warnings

import mujoco
import numpy as np
import palpate
import pytest

KEYS = {"elements": "solid", "young": 2e4, "poisson": 0.45, "damping": 0.01, "tolerance": 1e-5}
KEYS |= {"mass": 0.2, "support": "floor"}
MASS, SIDE = 0.2, 0.03
ROUGH = {"friction": "0.3"}
ALONE = 'friction="0.3" contype="0" conaffinity="0"'
FLOOR = f'<geom name="floor" type="plane" size="1 1 .1" {ALONE}/>'
TRAY = f"""<body name="tray" pos="0 0 -0.05">
  <joint name="s" type="slide" axis="0 0 1" stiffness="500" damping="20"/>
  <geom name="floor" type="box" size="0.1 0.1 0.05" mass="0.5" {ALONE}/></body>"""


def _block(scenes, name="organ", grid="window", up=0.0, shape="box", **keys):
  points, elem = scenes.box((0.06, 0.06, SIDE), 0.012) if shape == "box" else scenes.sphere(2, 0.03)
  points[:, 2] += up - points[:, 2].min()
  return scenes.windowed(points, elem, name, grid, "3 3 1", contact=ROUGH, **KEYS | keys)


def _load(scenes, *bodies, floor=FLOOR, gravity=(0, 0, -9.81), h=2e-3, **keys):
  away = scenes.ball(1.0, joint=False)
  return scenes.load(scenes.world(*bodies, floor, away, gravity=gravity, h=h), **keys)


def _run(model, data, seconds):
  mujoco.mj_step(model, data, round(seconds / model.opt.timestep))


def test_an_organ_falls_rests_is_lifted_and_falls_back(scenes):
  block = _block(scenes, up=0.01)
  hook = '<body name="hook" pos="0 0 0.05" mocap="true"/>'
  model, data, organ = _load(scenes, block + hook)
  _run(model, data, 0.02)
  np.testing.assert_allclose(organ.xvel, np.tile([0, 0, -0.1962], (organ.nvert, 1)), atol=1e-5)
  _run(model, data, 1.0)
  at_rest = organ.xpos
  assert organ.support_force[2] == pytest.approx(MASS * 9.81, rel=0.01)
  assert np.abs(organ.xvel).max() < 2e-3 and -0.001 < organ.xpos[:, 2].min() < 0.001
  top = np.flatnonzero(organ.xpos0[:, 2] > 0.01 + SIDE - 1e-6)
  grip = organ.attach(top, "hook")
  for k in range(200):
    data.mocap_pos[0, 2] = 0.05 + 0.04 * min(1, k / 100)
    mujoco.mj_step(model, data)
  _run(model, data, 0.4)
  assert grip.force[2] == pytest.approx(MASS * 9.81, rel=0.03)
  assert organ.xpos[:, 2].min() > 0.02 and not organ.support_force.any()
  grip.detach()
  _run(model, data, 1.2)
  np.testing.assert_allclose(organ.xpos, at_rest, atol=1e-3)
  assert organ.error is None


@pytest.mark.parametrize(("degrees", "slides"), [(12, False), (30, True)])
def test_friction_holds_an_organ_on_a_slope_up_to_its_angle(scenes, degrees, slides):
  angle = np.radians(degrees)  # 17 degrees is where friction of 0.3 gives way
  gravity = 9.81 * np.array([np.sin(angle), 0, -np.cos(angle)])
  model, data, organ = _load(scenes, _block(scenes), gravity=gravity)
  _run(model, data, 0.4)
  before, v = organ.xpos.mean(axis=0), organ.xvel[:, 0].mean()
  _run(model, data, 0.2)
  moved = organ.xpos.mean(axis=0) - before
  if slides:
    expected = 9.81 * (np.sin(angle) - 0.3 * np.cos(angle))
    assert (organ.xvel[:, 0].mean() - v) / 0.2 == pytest.approx(expected, rel=0.03)
  else:
    assert np.abs(moved).max() < 1e-4


def test_what_carries_an_organ_feels_its_weight(scenes):
  model, data, organ = _load(scenes, _block(scenes), TRAY, floor="")
  _run(model, data, 1.5)
  carried = -500 * data.qpos[model.joint("s").qposadr[0]]
  assert carried == pytest.approx((MASS + 0.5) * 9.81, rel=0.01)
  assert organ.error is None


def test_an_organ_and_what_it_strikes_keep_their_momentum(scenes):
  tray = TRAY.replace('stiffness="500"', "").replace('damping="20"', "")
  block = _block(scenes, up=0.01, shape="sphere")
  model, data, organ = _load(scenes, block, tray, floor="", gravity=(0, 0, 0))
  organ.set_state(xvel=np.tile([0, 0, -0.5], (organ.nvert, 1)))
  _run(model, data, 0.2)
  space = scenes.workspace(organ)
  v = space.graphs.phases.boxes["own"].motion.vel.numpy()  # with the inside
  momentum = space.organ.windows.mass @ v[:, 2] + 0.5 * data.qvel[model.joint("s").dofadr[0]]
  assert data.qvel[model.joint("s").dofadr[0]] < -0.1
  assert momentum == pytest.approx(-0.5 * MASS, rel=0.01)


def test_organs_lie_on_each_other(scenes):
  lower = _block(scenes, "lower", "one")
  upper = _block(scenes, "upper", "two", SIDE + 0.004, "sphere", support="floor lower", mass=0.05)
  model, data, organ = _load(scenes, lower, upper, name="lower")
  other = palpate.Organ(model, data, "upper")
  _run(model, data, 1.5)
  assert other.support_force[2] == pytest.approx(0.05 * 9.81, rel=0.02)
  assert organ.support_force[2] == pytest.approx((MASS + 0.05) * 9.81, rel=0.01)
  assert other.xpos[:, 2].min() == pytest.approx(SIDE, abs=0.004)
  assert np.abs(other.xvel).max() < 5e-3 and organ.error is None and other.error is None


def test_a_saved_state_goes_on_to_the_bit(scenes):
  lower = _block(scenes, "lower", "one")
  upper = _block(scenes, "upper", "two", SIDE + 0.001, "sphere", support="floor lower", mass=0.05)
  model, data, _ = _load(scenes, lower, upper, name="upper", gravity=(2, 0, -9))

  def drive(each, seconds=0.05):
    _run(model, each, seconds)
    return palpate.Organ(model, each, "upper").xpos

  drive(data, 0.2)
  scenes.goes_on(model, data, drive)


@pytest.mark.parametrize(
  ("keys", "message"),
  [
    ({"support": "table"}, "support names 'table', which does not exist, expected a geom or"),
    ({"integrator": "neumann", "elements": "membrane"}, "allowed only without support"),
  ],
)
def test_what_cannot_bear_is_named(scenes, keys, message):
  with pytest.raises(ValueError, match=message):
    _load(scenes, _block(scenes, **keys))


@pytest.mark.parametrize("meets", [0, 1])
def test_what_bears_an_organ_by_contacts_as_well_is_said_once(scenes, meets):
  spec = mujoco.MjSpec.from_string(f"""<mujoco><worldbody>
    <geom name="slab{meets}" type="plane" size="1 1 .1" contype="{meets}" conaffinity="{meets}"/>
    <body name="finger" mocap="true" pos="0 0 0.2"><geom size="0.005"/></body>
  </worldbody></mujoco>""")
  place = dict(windows=True, support=f"slab{meets}", pos=(0, 0, 0.02))
  with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    palpate.add_organ(spec, scenes.sphere(2, 0.02), elements="solid", mass=0.03, **place)
    assert not said
    spec.compile()
  found = [each for each in said if "'slab1' bears it by support and contact" in str(each.message)]
  assert len(found) == meets == len(said)
