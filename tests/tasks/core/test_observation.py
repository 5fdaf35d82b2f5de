"""Pictures' ground truth: camera and key points, against what pictures show."""

import numpy as np
import pytest
from palpate import tasks
from palpate.tasks.core import observation

SIZE = (90, 120)


def load(name, *observed, **options):
  kwargs = {"random": 1, "observations": observed, "pixels": SIZE, "renderer": "cpu", **options}
  return tasks.load(*name.split("/"), task_kwargs=kwargs)


def test_the_camera_is_that_of_the_points():
  seen = load("touch/easy", "truth", "points", "segmentation").reset().observation
  x, y, z = np.moveaxis(seen["points"].astype(float), 2, 0)
  known = z > 0
  at = seen["camera_matrix"] @ np.stack([x, y, z])[:, known] / z[known]
  rows, columns = np.nonzero(known)
  np.testing.assert_allclose(at[:2], [columns, rows], atol=1e-3)
  env = load("touch/easy", "truth", "points", "segmentation")
  target = env.reset().observation["segmentation"] == observation.LABELS["target"]
  pose = seen["camera_pose"]
  world = (seen["points"][target] - pose[:3, 3]) @ pose[:3, :3]  # of the marker's front
  site = env.physics.data.ptr.site_xpos[env.physics.target_sites[0]]
  assert len(world) and np.linalg.norm(world - site, axis=1).max() < 0.005


@pytest.mark.parametrize(
  "name, count", [("grasp/easy", 4), pytest.param("bimanual/easy", 8, marks=pytest.mark.slow)]
)
def test_key_points_are_where_instruments_are(name, count):
  env = load(name, "keypoints", "points", "segmentation")
  env.reset()
  for _ in range(12):
    seen = env.step(np.full(env.action_spec().shape, 0.5)).observation
  points = seen["keypoints"]
  assert points.shape == (count, 3) and set(points[:, 2]) <= {0, 1} and points[0, 2]
  tip, left, right, entry = env.physics.landmarks()
  assert 0.003 < np.linalg.norm(left - right) < 0.03  # jaws that open
  np.testing.assert_allclose(0.5 * (left + right), tip, atol=0.006)
  assert not points[3, 2] and np.linalg.norm(entry - tip) > 0.05
  label = seen["segmentation"] == observation.LABELS["instrument"]
  rows, columns = np.nonzero(label)
  for x, y, shown in points[:3]:
    assert shown and np.hypot(columns - x, rows - y).min() < 1.5


def test_a_lens_bends_key_points_as_pictures():
  straight, bent = (
    load("touch/easy", "truth", randomise={"lens_k1": (k, k), "lens_k2": (0.0, 0.0)})
    for k in (0.0, -0.3)
  )
  a, b = straight.reset().observation, bent.reset().observation
  np.testing.assert_array_equal(b["camera_distortion"], [-0.3, 0.0])
  middle, focal = a["camera_matrix"][:2, 2], a["camera_matrix"][0, 0]
  before, after = (each["keypoints"][0, :2] - middle for each in (a, b))
  r2 = (before**2).sum() / focal**2
  np.testing.assert_allclose(after, before * (1 - 0.3 * r2), atol=1e-6)


@pytest.mark.parametrize(
  "options, said",
  [
    ({"renderer": "vulkan"}, "renderer is 'vulkan', expected one of opengl, cpu"),
    ({"renderer": "opengl", "observations": ["flow"]}, "'flow', which renderer opengl cannot draw"),
  ],
)
def test_renderers_that_cannot_are_said(options, said):
  with pytest.raises(ValueError, match=said):
    load("touch/easy", "pixels", **options)
