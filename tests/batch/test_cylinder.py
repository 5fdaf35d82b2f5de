"""A triangle before a cylinder: distance, place and normal against a search over the triangle."""

import numpy as np
import warp as wp
from palpate.batch.contact import cylinder

RADIUS, HALF, CENTRE = 0.0025, 0.006, np.array([0.01, 0.02, 0.03])  # [m]
COUNT = 200


@wp.kernel(enable_backward=False)
def find(
  corner: wp.array(dtype=wp.vec3, ndim=2),
  axes: wp.array(dtype=wp.mat33),
  dist: wp.array(dtype=float),
  point: wp.array(dtype=wp.vec3),
  normal: wp.array(dtype=wp.vec3),
):
  i = wp.tid()
  far, x, n = cylinder.touch(
    wp.vec3(0.01, 0.02, 0.03), axes[i], wp.vec3(0.0025, 0.006, 0.0), 1.0, 0.0,
    corner[i, 0], corner[i, 1], corner[i, 2],
  )  # fmt: skip
  dist[i] = far
  point[i] = x
  normal[i] = n


def beyond(x):
  """Returns the distance of points in the cylinder's frame from it, negative inside."""
  aside, above = np.hypot(x[..., 0], x[..., 1]) - RADIUS, np.abs(x[..., 2]) - HALF
  outside = np.hypot(np.maximum(aside, 0), np.maximum(above, 0))
  return np.where(outside > 0, outside, np.maximum(aside, above))


def triangles(random):
  """Returns triangles near the cylinder and axes of this: any, and such as lie along it."""
  axes = np.linalg.qr(random.normal(size=(COUNT, 3, 3)))[0]
  along = random.normal(size=(COUNT, 3))
  along *= random.uniform(0.002, 0.012, (COUNT, 1)) / np.linalg.norm(along, axis=1)[:, None]
  corner = along[:, None] + 0.004 * random.normal(size=(COUNT, 3, 3))
  corner[: COUNT // 8, :, 0] = RADIUS + 0.0002  # parallel to its side
  corner[COUNT // 8 : COUNT // 4, :, 2] = HALF + 0.0003  # and to its end
  return corner @ np.swapaxes(axes, 1, 2) + CENTRE, axes


def test_a_cylinder_is_as_far_as_the_nearest_point_of_a_triangle():
  corner, axes = triangles(np.random.RandomState(0))
  dist = wp.zeros(COUNT, dtype=float, device="cpu")
  point, normal = (wp.zeros(COUNT, dtype=wp.vec3, device="cpu") for _ in range(2))
  inputs = [wp.array(corner, dtype=wp.vec3, device="cpu")]
  inputs += [wp.array(axes, dtype=wp.mat33, device="cpu"), dist, point, normal]
  wp.launch(find, dim=COUNT, inputs=inputs, device="cpu")
  u, v = np.meshgrid(np.linspace(0, 1, 161), np.linspace(0, 1, 161))
  u, v = u[u + v <= 1], v[u + v <= 1]
  share = np.stack([1 - u - v, u, v], axis=1)
  places = np.einsum("pk,ikc->ipc", share, corner) - CENTRE
  nearest = beyond(np.einsum("ipc,icd->ipd", places, axes)).min(axis=1)
  apart = nearest > 1e-5
  assert 50 < apart.sum() < COUNT
  np.testing.assert_allclose(dist.numpy()[apart], nearest[apart], atol=4e-5)  # of the search
  found = np.einsum("ic,icd->id", point.numpy() - CENTRE, axes)
  np.testing.assert_allclose(beyond(found)[apart], dist.numpy()[apart], atol=1e-6)
  back = found - dist.numpy()[:, None] * np.einsum("ic,icd->id", normal.numpy(), axes)
  np.testing.assert_allclose(beyond(back)[apart], 0, atol=2e-6)  # the normal leads to the cylinder
  # What is under a flat end has its contact in the middle of that, which may be just off it.
  assert (dist.numpy()[nearest < -1e-4] < 0.01 * RADIUS).all()


def test_what_lies_flat_under_an_end_is_touched_in_its_middle():
  depth, small = 1e-4, 2e-4 * np.array([[1, 0, 0], [-0.5, 0.8, 0], [-0.5, -0.8, 0]])
  corner = CENTRE + small + np.array([0.0003, -0.0002, HALF - depth])
  dist = wp.zeros(1, dtype=float, device="cpu")
  point, normal = (wp.zeros(1, dtype=wp.vec3, device="cpu") for _ in range(2))
  inputs = [wp.array(corner[None], dtype=wp.vec3, device="cpu")]
  inputs += [wp.array(np.eye(3)[None], dtype=wp.mat33, device="cpu"), dist, point, normal]
  wp.launch(find, dim=1, inputs=inputs, device="cpu")
  np.testing.assert_allclose(dist.numpy(), -depth, atol=1e-8)
  np.testing.assert_allclose(point.numpy()[0], corner.mean(axis=0), atol=1e-7)
  np.testing.assert_allclose(normal.numpy()[0], [0, 0, 1], atol=1e-7)
