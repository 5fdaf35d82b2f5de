"""Where a laparoscope looks, against MuJoCo's kinematics."""

import mujoco
import numpy as np
import pytest
from palpate.models import laparoscope, trocar

PORT, CENTER = np.array([0.02, 0.2, 0.15]), np.array([0.0, 0.03, 0.01])


def scene(optics):
  """Returns a laparoscope that points at a place, its data and its port."""
  spec = mujoco.MjSpec()
  trocar.attach(spec, "laparoscope", "s/", PORT, trocar.aim(PORT, CENTER))
  spec.body("s/eye").quat = laparoscope.turned(optics)
  model = spec.compile()
  return model, mujoco.MjData(model), trocar.trocar(model, "s/")


def put(model, data, joints):
  for name, value in joints._asdict().items():
    data.joint(f"s/{name}").qpos = value
  mujoco.mj_forward(model, data)
  return data.camera("s/camera").xpos, data.camera("s/camera").xmat.reshape(3, 3)


@pytest.mark.parametrize("optics", [0.0, laparoscope.OPTICS])
def test_the_view_is_the_cameras(optics):
  model, data, port = scene(optics)
  rng = np.random.RandomState(0)
  for _ in range(20):
    joints = laparoscope.Pose(*rng.uniform(-0.6, 0.6, 2), *rng.uniform(-0.07, 0.07, 3))
    joints = joints._replace(roll=rng.uniform(-3, 3), head=rng.uniform(-3, 3))
    pos, mat = put(model, data, joints)
    place, axes = laparoscope.view(port, joints, optics)
    np.testing.assert_allclose(place, pos, atol=1e-9)
    np.testing.assert_allclose(axes, mat, atol=1e-9)
    # With the trocar alone the shaft goes through it.
    shaft = data.site("s/tip").xmat.reshape(3, 3)[:, 2]
    np.testing.assert_allclose(np.cross(pos - PORT, shaft), 0, atol=1e-9)
    assert -axes[:, 2] @ -shaft == pytest.approx(np.cos(optics))


@pytest.mark.parametrize("optics", [0.0, laparoscope.OPTICS])
def test_a_place_is_shown_in_the_middle_and_level(optics):
  model, data, port = scene(optics)
  rng = np.random.RandomState(1)
  for _ in range(20):
    place, far = CENTER + rng.uniform(-0.03, 0.03, 3), rng.uniform(0.05, 0.1)
    side = rng.normal(size=3)
    pos, mat = put(model, data, laparoscope.show(port, place, far, side, optics))
    np.testing.assert_allclose(mat.T @ (place - pos), [0, 0, -far], atol=1e-9)
    assert abs(laparoscope.level(mat)) < 1e-9
    assert mat[2, 1] > 0
    # Of all directions with these optics it is seen from the one nearest to `side`.
    q = (place - PORT) / np.linalg.norm(place - PORT)
    apart = np.arccos(np.clip(mat[:, 2] @ -q, -1, 1))
    lean = np.arcsin(far * np.sin(optics) / np.linalg.norm(place - PORT))
    assert apart == pytest.approx(optics - lean, abs=1e-6)
    aside = side - side @ q * q
    if optics:
      across = mat[:, 2] - mat[:, 2] @ q * q
      assert across @ aside > 0.999 * np.sin(apart) * np.linalg.norm(aside)


def test_a_port_lies_behind_a_view():
  mat = laparoscope.view(trocar.Trocar(), (0.3, -0.2, 0.4, 0.0, 0.1))[1]
  port = laparoscope.behind(CENTER, mat, 0.07)
  pos, axes = laparoscope.view(port, (0.0, 0.0, 0.0, 0.0, 0.0))
  np.testing.assert_allclose(pos, CENTER, atol=1e-12)
  np.testing.assert_allclose(axes, mat, atol=1e-12)


def test_the_horizon_leans_as_the_picture_is_turned():
  model, data, port = scene(laparoscope.OPTICS)
  joints = laparoscope.show(port, CENTER, 0.08, (0, 0, 1))
  for angle in (0.3, -1.2, 2.0):
    mat = put(model, data, joints._replace(head=joints.head + angle))[1]
    assert laparoscope.level(mat) == pytest.approx(angle)
