"""The smooth surface through coarse vertices: exact where it must be, smooth where it can be."""

import numpy as np
import pytest
from palpate.tissue.geometry import mesh, subdivide


@pytest.mark.parametrize("levels", [1, 2, 3])
def test_linear_fields_are_exact(scenes, levels):
  points, elem = scenes.sphere(1)
  smooth = subdivide.smooth(elem, levels)
  linear = np.random.RandomState(0).normal(size=(3, 3))
  moved = smooth(points + points @ linear + 0.01)
  fine = smooth(points)
  np.testing.assert_allclose(moved, fine + fine @ linear + 0.01, atol=1e-14)  # rounding


def test_it_goes_through_the_coarse_vertices(scenes):
  for points, elem in (scenes.sphere(2), scenes.strip(0.2, 0.1, 8, 4)):
    smooth = subdivide.smooth(elem, 2)
    np.testing.assert_allclose(smooth(points)[: len(points)], points, atol=1e-15)
    assert len(smooth(points)) == subdivide.counts(elem)[1]
    assert len(smooth.elem) == 16 * len(elem)


def test_a_sphere_is_rounder_than_its_triangles(scenes):
  points, elem = scenes.sphere(2)  # 162 vertices
  smooth = subdivide.smooth(elem, 3)
  fine = smooth(points)
  flat = np.linalg.norm(points[elem].mean(axis=1), axis=1).min() / scenes.RADIUS
  off = np.abs(np.linalg.norm(fine, axis=1) / scenes.RADIUS - 1).max()
  assert off < 0.25 * (1 - flat)
  # What an outline shows is the angle between triangles: 20 deg before.
  built = mesh.build("sphere", fine, smooth.elem.astype(np.int64))
  normal = mesh.area_vectors(fine, smooth.elem)
  normal /= np.linalg.norm(normal, axis=1, keepdims=True)
  other = normal[built.twin.reshape(-1, 3) // 3]
  bend = np.degrees(np.arccos(np.clip(np.einsum("ij,ikj->ik", normal, other), -1, 1)))
  assert bend.max() < 3.5


def test_a_sheet_keeps_straight_borders_and_its_plane(scenes):
  points, elem = scenes.strip(0.2, 0.1, 8, 4)
  smooth = subdivide.smooth(elem, 2)
  fine = smooth(points)
  np.testing.assert_allclose(fine[:, 2], 0, atol=1e-15)
  middle = np.abs(fine[:, 0] - 0.1) < 0.05  # corners are rounded, which rings a little
  assert fine[middle, 1].max() == pytest.approx(0.05, abs=3e-4)


def test_the_first_triangles_lie_on_the_first_coarse_one(scenes):
  points, elem = scenes.sphere(2)
  smooth = subdivide.smooth(elem, 2)
  center = smooth(points)[smooth.elem].mean(axis=1).reshape(len(elem), 16, 3).mean(axis=1)
  near = np.linalg.norm(center - points[elem].mean(axis=1), axis=1)
  assert near.max() < 0.05 * scenes.RADIUS
