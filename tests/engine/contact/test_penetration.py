"""Points inside of a closed surface, also where rays meet its edges and vertices."""

import numpy as np
import pytest
import trimesh
from palpate.engine.penetration import inside


@pytest.mark.parametrize("flip", [1, -1])
def test_points_of_a_box_are_told_apart(flip):
  """Cut into triangles whose edges and vertices lie above and below the points."""
  box = trimesh.creation.box((2.0, 2.0, 2.0)).subdivide().subdivide()
  pos, elem = np.array(box.vertices) * [1, flip, 1], np.array(box.faces)[:, ::flip]
  side = np.linspace(-1.5, 1.5, 13)  # a quarter apart, as the vertices
  point = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
  point = point[(np.abs(np.abs(point) - 1) > 1e-9).all(axis=1)]  # not on the surface
  assert np.array_equal(inside(point, pos, elem), (np.abs(point) < 1).all(axis=1))


def test_a_hollow_is_outside():
  shell, hollow = (trimesh.creation.icosphere(3, radius) for radius in (1.0, 0.5))
  pos = np.concatenate([shell.vertices, hollow.vertices])
  elem = np.concatenate([shell.faces, hollow.faces[:, ::-1] + len(shell.vertices)])
  point = np.random.default_rng(0).uniform(-1, 1, (500, 3))
  far = np.linalg.norm(point, axis=1)
  clear = (np.abs(far - 1) > 0.02) & (np.abs(far - 0.5) > 0.02)
  assert np.array_equal(inside(point[clear], pos, elem), ((far > 0.5) & (far < 1))[clear])
