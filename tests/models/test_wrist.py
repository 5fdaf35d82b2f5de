"""The wristed needle driver: its kinematics, the targets of its tip, and how it holds a needle."""

import mujoco
import numpy as np
import palpate
import pytest
from palpate import models
from palpate.models import trocar, wrist
from palpate.models.handle import Tip

QUAT = np.array([0.8, 0.3, -0.4, 0.33]) / np.linalg.norm([0.8, 0.3, -0.4, 0.33])
ARC = 0.026 / np.pi  # radius of a needle of 26 mm, 1/2 circle [m]


def _arm(quat=(1.0, 0.0, 0.0, 0.0)):
  spec = mujoco.MjSpec()
  trocar.attach(spec, "psm", "psm/", pos=(0.1, -0.2, 0.3), quat=quat)
  model = spec.compile()
  return model, mujoco.MjData(model), trocar.trocar(model, "psm/")


def _drawn(port, count):
  """Returns joints within their ranges, a roll of less than half a turn."""
  low, high = port.ranges[[0, 1, 3, 2, 4, 5]].T
  joints = np.random.RandomState(0).uniform(low, high, (count, 6))
  joints[:, 2] = np.remainder(joints[:, 2] + np.pi, 2 * np.pi) - np.pi
  return joints


def _denavit_hartenberg(alpha, a, theta, d):
  """Returns the transform of a row of the modified convention (Craig 2005, 3.6)."""
  ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(theta), np.sin(theta)
  return np.array(
    [
      [ct, -st, 0, a],
      [st * ca, ct * ca, -sa, -d * sa],
      [st * sa, ct * sa, ca, d * ca],
      [0, 0, 0, 1],
    ]
  )


def test_forward_is_the_published_table():
  right, port = np.pi / 2, _arm()[2]
  port = trocar.Trocar(depth=port.depth, ranges=port.ranges, wrist=port.wrist)
  base = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # of the instrument's frame
  for joints in (np.zeros(6), *_drawn(port, 20)):
    pitch, yaw, roll, insertion, first, second = joints
    # sawIntuitiveResearchKit, share/kinematic/psm.json, share/tool/LARGE_NEEDLE_DRIVER_400006.json;
    # the last row is the tip, Fontanelli et al. 2017.
    found = np.eye(4)
    for row in (
      (right, 0.0, pitch + right, 0.0),
      (-right, 0.0, yaw - right, 0.0),
      (right, 0.0, 0.0, insertion + wrist.INSERTION - 0.4318),
      (0.0, 0.0, roll, 0.4162),
      (-right, 0.0, first - right, 0.0),
      (-right, 0.0091, second - right, 0.0),
      (-right, 0.0, 0.0, 0.0102),
    ):
      found = found @ _denavit_hartenberg(*row)
    pos, mat = wrist.forward(port, joints)
    np.testing.assert_allclose(base @ pos, found[:3, 3], atol=1e-12)
    # The tip's frame looks back along the jaws, the table's along them.
    np.testing.assert_allclose(base @ mat @ np.diag([1.0, -1.0, -1.0]), found[:3, :3], atol=1e-12)


def test_forward_is_mujocos_and_inverse_undoes_it():
  model, data, port = _arm(QUAT)
  for joints in _drawn(port, 200):
    for name, value in zip(wrist.joints(port), joints, strict=True):
      data.joint(f"psm/{name}").qpos = value
    mujoco.mj_kinematics(model, data)
    pos, mat = wrist.forward(port, joints)
    site = data.site("psm/tip")
    np.testing.assert_allclose(site.xpos, pos, atol=1e-12)
    np.testing.assert_allclose(site.xmat.reshape(3, 3), mat, atol=1e-12)
    np.testing.assert_allclose(wrist.inverse(port, pos, mat), joints, atol=1e-9)
    turned = wrist.inverse(port, pos, mat, near=joints[2] + 2 * np.pi)
    whole = (turned[2] - joints[2]) / (2 * np.pi)
    assert whole == pytest.approx(round(whole)) and abs(turned[2]) <= port.ranges[3, 1]


def test_the_shaft_goes_through_the_trocar():
  model, data, port = _arm(QUAT)
  for joints in _drawn(port, 50):
    for name, value in zip(wrist.joints(port), joints, strict=True):
      data.joint(f"psm/{name}").qpos = value
    mujoco.mj_kinematics(model, data)
    shaft = data.body("psm/shaft")
    away, along = shaft.xpos - port.pos, shaft.xmat.reshape(3, 3)[:, 2]
    assert np.linalg.norm(away - (away @ along) * along) < 1e-12


def test_a_pose_out_of_reach_is_met_within_the_ranges():
  _, _, port = _arm()
  low, high = port.ranges[[0, 1, 3, 2, 4, 5]].T
  for pos, mat in (
    ((0.0, 0.0, -0.4), np.eye(3)),
    ((0.3, 0.0, -0.01), np.eye(3)),
    ((0.0, 0.0, -0.12), np.diag([1.0, -1.0, -1.0])),
    ((0.0, 0.0, 0.0), np.eye(3)),
  ):
    joints = wrist.inverse(port, port.pos + np.array(pos), mat)
    assert np.isfinite(joints).all() and (joints >= low).all() and (joints <= high).all()


def test_an_instrument_without_a_wrist_takes_the_roll():
  spec = mujoco.MjSpec()
  trocar.attach(spec, "grasper", "g/", pos=(0.1, -0.2, 0.3), quat=QUAT)
  port = trocar.trocar(spec.compile(), "g/")
  joints = np.array([0.3, -0.4, 1.2, 0.02])
  pos, mat = wrist.forward(port, joints)
  np.testing.assert_allclose(pos, trocar.forward(port, joints[[0, 1, 3]]), atol=1e-12)
  np.testing.assert_allclose(wrist.inverse(port, pos, mat), joints, atol=1e-9)


def test_the_drives_take_the_tip_to_its_pose():
  spec = mujoco.MjSpec()
  spec.option.timestep, spec.option.integrator = 0.002, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
  trocar.attach(spec, "psm", "psm/", pos=(0.0, 0.0, 0.2), quat=QUAT)
  model = spec.compile()
  data = mujoco.MjData(model)
  tip = Tip(model, data, "psm/")
  pos, mat = wrist.forward(tip.port, [0.2, 0.1, -0.8, 0.03, 0.5, -0.6])
  quat = np.zeros(4)
  mujoco.mju_mat2Quat(quat, mat.ravel())
  tip.move(pos, quat)
  mujoco.mj_step(model, data, 500)
  np.testing.assert_allclose(data.site("psm/tip").xpos, pos, atol=1e-5)
  np.testing.assert_allclose(data.site("psm/tip").xmat.reshape(3, 3), mat, atol=1e-3)
  assert tip.wrench() == (0.0,) * 6


def test_two_in_a_scene():
  spec = models.load("liver", 250, instruments=("psm", "psm"))
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_resetDataKeyframe(model, data, model.key("touch").id)
  mujoco.mj_forward(model, data)
  for prefix in ("right_psm/", "left_psm/"):
    assert data.sensor(f"{prefix}jaw").data[0] == pytest.approx(0.7)
    assert data.actuator(f"{prefix}jaw").ctrl[0] == pytest.approx(0.7)
  with pytest.raises(ValueError, match="instrument is 'psm'"):
    models.load("liver", 250, instruments=("psm",), handle=True)


def _holding(angle, lean):
  """Returns model and data with a needle between open jaws.

  Args:
    angle: of the needle to the jaws' axis, 0 across them [rad]
    lean: of its circle about its tangent, 0 across the jaws' faces [rad]
  """
  spec = mujoco.MjSpec()
  spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
  spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 100
  spec.option.timestep = 0.001
  trocar.attach(spec, "psm", "psm/", pos=(0.0, 0.0, 0.12))
  _, mat = wrist.forward(trocar.trocar(spec.copy().compile(), "psm/"), np.zeros(6))
  along = np.cos(angle) * mat[:, 1] + np.sin(angle) * mat[:, 2]
  out = np.cos(lean) * mat[:, 0] + np.sin(lean) * np.cross(along, mat[:, 0])
  quat, place = np.zeros(4), 0.0036 * mat[:, 2]
  mujoco.mju_mat2Quat(quat, np.column_stack([out, along, np.cross(out, along)]).ravel())
  palpate.add_needle(spec, pos=place - ARC * out, quat=quat)
  model = spec.compile()
  data = mujoco.MjData(model)
  for side in ("left", "right"):
    data.joint(f"psm/jaw_{side}").qpos = 0.06
  data.actuator("psm/jaw").ctrl = -0.2
  mujoco.mj_step(model, data, 50)
  return model, data


def _middle(data):
  """Returns the middle of the needle and its frame, in that of the tip."""
  site, body = data.site("psm/tip"), data.body("needle")
  mat, turn = site.xmat.reshape(3, 3), body.xmat.reshape(3, 3)
  return mat.T @ (body.xpos + ARC * turn[:, 0] - site.xpos), mat.T @ turn


@pytest.mark.parametrize(("angle", "lean"), [(0.0, 0.0), (0.0, 1.57), (0.6, 0.5)])
def test_jaws_hold_a_needle_by_contact_alone(angle, lean):
  model, data = _holding(angle, lean)
  assert model.neq == 1  # of the jaws: nothing else holds it
  pos, mat = _middle(data)
  needle = model.body("needle").id
  for axis in range(3):
    for sign in (1.0, -1.0):
      data.xfrc_applied[needle, :3] = force = sign * np.eye(3)[axis]  # 1 N at the middle
      middle = data.body("needle").xpos + ARC * data.body("needle").xmat.reshape(3, 3)[:, 0]
      data.xfrc_applied[needle, 3:] = np.cross(middle - data.xipos[needle], force)
      mujoco.mj_step(model, data, 100)
  data.xfrc_applied[:] = 0
  now, turned = _middle(data)
  assert np.linalg.norm(now - pos) < 1e-4
  assert np.arccos((np.trace(mat.T @ turned) - 1) / 2) < 0.05
  # Shaken by a jerk of 6 mm at 5 Hz, about 6 m/s^2.
  for k in range(400):
    data.actuator("psm/pitch").ctrl = 0.05 * np.sin(2 * np.pi * 5 * k * 1e-3)
    mujoco.mj_step(model, data)
  now, turned = _middle(data)
  assert np.linalg.norm(now - pos) < 5e-4
  assert data.sensor("psm/touch_left").data[0] > 10  # [N]


def test_open_jaws_let_it_go():
  model, data = _holding(0.0, 0.0)
  data.actuator("psm/jaw").ctrl = 0.8
  mujoco.mj_step(model, data, 300)
  assert np.linalg.norm(_middle(data)[0]) > 0.05
