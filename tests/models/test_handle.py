"""Handles that are turned: the torque that is felt, and the roll of the shaft."""

import mujoco
import numpy as np
import pytest
from palpate.models import trocar as ports
from palpate.models.handle import Handle, pose


def load(name):
  model = mujoco.MjModel.from_xml_path(str(ports.path(name, True)))
  return model, mujoco.MjData(model)


@pytest.mark.parametrize(("axis", "stiffness"), [(0, 0.03), (1, 0.03), (2, 0.3)])
def test_a_turned_handle_is_felt_as_the_stated_torque(axis, stiffness):
  """The tip is held: what the hand feels is stiffness times angle, against the turn."""
  model, data = load("probe")
  held, angle = Handle(model, data), 0.2
  turn = np.zeros(4)
  mujoco.mju_axisAngle2Quat(turn, np.eye(3)[axis], angle)
  held.move(data.mocap_pos[0], turn)
  mujoco.mj_forward(model, data)
  expected = np.zeros(6)
  expected[3 + axis] = -stiffness * angle
  np.testing.assert_allclose(held.wrench(), expected, atol=1e-9)


@pytest.mark.parametrize("name", ports.NAMES)
def test_the_shaft_rolls_with_the_handle(name):
  model, data = load(name)
  trocar, held = ports.trocar(model), Handle(model, data)
  goal = ports.forward(trocar, [0.2, -0.3, 0.01])
  for roll in (1.2, -1.8, 0.0):
    held.move(goal, pose(trocar, goal, roll)[3:])
    np.testing.assert_allclose(held.joints(trocar), [0.2, -0.3, roll, 0.01], atol=1e-9)
    mujoco.mj_step(model, data, 750)
    np.testing.assert_allclose(data.joint("roll").qpos, roll, atol=1e-3)
    np.testing.assert_allclose(data.site("tip").xpos, goal, atol=1e-5)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, data.site("tip").xmat)
    assert abs(quat @ held.quat) == pytest.approx(1, abs=1e-6)
