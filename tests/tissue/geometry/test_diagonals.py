"""Alternating diagonals become parallel for the physics; other meshes stay as they are."""

import numpy as np
import pytest
from palpate.tissue.geometry import diagonals
from palpate.tissue.geometry import mesh as topology

ONE = np.array([1.0])


def inside(mesh):
  out = np.ones(mesh.nvert, bool)
  out[mesh.elem.ravel()[mesh.twin < 0]] = False
  out[mesh.elem[:, [1, 2, 0]].ravel()[mesh.twin < 0]] = False
  return out


@pytest.mark.parametrize("bow", [0.0, 3.0])
@pytest.mark.parametrize("height", [0.05, 0.08])
def test_vertices_of_alternating_diagonals_get_six_neighbours(scenes, bow, height):
  points, elem = scenes.strip(0.1, height, 20, 12)
  points[:, 2] = bow * points[:, 0] ** 2
  mesh = topology.build("organ", points, elem)
  assert set(mesh.degree[inside(mesh)]) == {4, 8}
  made = diagonals.parallel("organ", mesh, ONE)
  assert set(made.degree[inside(made)]) == {6}
  area, before = (
    np.linalg.norm(topology.area_vectors(points, m.elem), axis=1) for m in (made, mesh)
  )
  np.testing.assert_allclose(area, before, rtol=0.02)
  # Each triangle lies in the rectangle in which it lay.
  moved = points[made.elem].mean(axis=1) - points[elem].mean(axis=1)
  assert np.abs(moved).max() < 0.5 * height / 12 + 1e-9


def test_other_meshes_stay_as_they_are(scenes):
  size = (0.1, 0.08, 15, 15)
  for shape in (scenes.triangular(*size), scenes.triangular(*size, jitter=0.2), scenes.sphere(3)):
    mesh = topology.build("organ", *shape)
    assert diagonals.parallel("organ", mesh, ONE) is mesh


def test_triangles_of_unlike_tissue_are_not_mixed(scenes):
  points, elem = scenes.strip(0.1, 0.1, 12, 12)
  mesh = topology.build("organ", points, elem)
  young = 1.0 + np.arange(mesh.nelem)
  assert diagonals.parallel("organ", mesh, young) is mesh
