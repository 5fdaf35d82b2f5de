"""Contacts that slide: they stay closed, and rub with a share of what presses."""

import mujoco
import numpy as np
import pytest

WEIGHT, FRICTION, SPEED = 0.05, 0.3, 0.02  # [N], [-], [m/s]


def dragged(scenes, cone, condim):
  """Returns normal force and friction of a ball that is dragged over a sheet, each step [N]."""
  points, elem = scenes.strip(0.08, 0.04, 16, 8)
  contact = {"condim": condim, "friction": FRICTION, "solref": "0.004 1"}
  # In a dent as deep as the ball it would press all around, and rub more.
  keys = {"young": 5e3, "foundation": 1e5, "damping": 0.005}
  sheet = scenes.organ(points, elem, mass=0.8, contact=contact, **keys)
  ball = f"""<body name="ball" pos="0.02 0.001 0.0045"><joint name="z" type="slide" axis="0 0 1"/>
    <joint name="x" type="slide" axis="1 0 0"/>
    <geom size="0.004" mass="0.05" condim="{condim}" friction="{FRICTION}"/></body>"""
  drive = """<actuator><position joint="x" kp="500" kv="10"/><motor joint="z"/></actuator>"""
  made = scenes.world(sheet, ball, option=f'cone="{cone}"', extra=drive)
  model, data, organ = scenes.load(made)
  model.dof_damping[model.joint("z").dofadr[0]] = 0.5
  forces, one = np.zeros((900, 2)), np.zeros(6)
  for normal_and_friction in forces:
    data.ctrl[:] = SPEED * max(data.time - 0.2, 0), -WEIGHT
    mujoco.mj_step(model, data)
    for k in range(data.ncon):
      mujoco.mj_contactForce(model, data, k, one)
      normal_and_friction += one[0], np.linalg.norm(one[1:3])
  assert organ.error is None
  return forces[350:].T


@pytest.mark.parametrize("condim", [3, 6])
@pytest.mark.parametrize(("cone", "change"), [("elliptic", 0.03), ("pyramidal", 0.1)])
def test_a_dragged_ball_stays_on_the_tissue(scenes, cone, condim, change):
  normal, friction = dragged(scenes, cone, condim)
  assert (normal == 0).mean() < 0.005
  assert normal.mean() == pytest.approx(WEIGHT, rel=0.1)  # it rubs on the slopes of its dent
  assert np.sqrt(np.mean(np.diff(normal) ** 2)) < change * WEIGHT
  assert friction.sum() == pytest.approx(FRICTION * normal.sum(), rel=0.05)


def test_looking_at_forces_twice_changes_nothing(scenes):
  model, data, _ = scenes.load(scenes.probed(False, cone="elliptic"))
  for k in range(120):
    data.ctrl[:] = -0.05e-3 * k, 0.05e-3 * k
    mujoco.mj_step(model, data)
  mujoco.mj_forward(model, data)
  before = data.efc_pos.copy(), data.efc_force.copy()
  mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_POS, 0)
  np.testing.assert_array_equal(data.efc_pos, before[0])
  np.testing.assert_allclose(data.efc_force, before[1], atol=1e-9)


def test_what_sticks_does_not_creep(scenes):
  points, elem = scenes.strip(0.08, 0.04, 16, 8)
  contact = {"condim": 3, "friction": FRICTION, "solref": "0.02 1"}
  sheet = scenes.organ(points, elem, contact=contact, young=5e3, foundation=1e5, damping=0.005)
  ball = f"""<body name="ball" pos="0.02 0.001 0.0105"><joint name="z" type="slide" axis="0 0 1"/>
    <joint name="x" type="slide" axis="1 0 0"/>
    <geom size="0.01" mass="0.2" condim="3" friction="{FRICTION}"/></body>"""
  drive = """<actuator><motor joint="x"/><motor joint="z"/></actuator>"""
  made = scenes.world(sheet, ball, option='cone="elliptic"', extra=drive)
  model, data, organ = scenes.load(made)
  places = []
  for second in range(3):
    while data.time < second + 1 - 1e-9:
      pull = 0.5 * FRICTION * np.clip((data.time - 0.3) / 0.3, 0, 1)
      data.ctrl[:] = 0.3 * pull, -0.3 * min(1, data.time / 0.2)
      mujoco.mj_step(model, data)
    places.append(data.joint("x").qpos[0])
  assert organ.error is None
  assert abs(places[2] - places[1]) < 5e-5  # 0.76 mm where friction is as soft as what presses
