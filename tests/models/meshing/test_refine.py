"""Finer triangles around a place: the same surface, good angles, and tetrahedra that follow."""

import numpy as np
import pytest
from palpate.models import shapes
from palpate.models.meshing import refine
from palpate.models.meshing.quality import angles
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology

AT, RADIUS, EDGE = (0, 0, 0.015), 0.006, 0.0015


@pytest.fixture(scope="module")
def block():
  import scenes

  return scenes.box((0.06, 0.06, 0.03), 0.006)


@pytest.fixture(scope="module")
def finer(block):
  return refine.refine(*block, AT, RADIUS, EDGE)


def lengths(points, elem):
  return np.linalg.norm(points[elem[:, [1, 2, 0]]] - points[elem], axis=2).max(axis=1)


def test_edges_are_short_where_asked_and_the_surface_is_the_same(block, finer):
  points, elem = finer
  np.testing.assert_array_equal(points[: len(block[0])], block[0])
  mesh = topology.build("block", points, elem)
  assert mesh.closed
  assert topology.volume(points, elem) == pytest.approx(0.06 * 0.06 * 0.03)
  near = np.linalg.norm(points[elem].mean(axis=1) - AT, axis=1) < RADIUS - EDGE
  assert lengths(points, elem)[near].max() <= EDGE
  assert len(points) < 2 * len(block[0])  # not everywhere
  assert np.degrees(angles(points, elem).min()) >= 22


def test_tetrahedra_are_small_where_triangles_are(finer):
  solid = fill.fill("block", topology.build("block", *finer))
  corner = solid.rest[solid.tet]
  edge = np.linalg.norm(corner - corner.mean(axis=1, keepdims=True), axis=2).max(axis=1)
  away = np.linalg.norm(corner.mean(axis=1) - AT, axis=1)
  assert np.median(edge[away < 0.005]) < 0.4 * np.median(edge[away > 0.02])
  assert fill.quality(solid.rest, solid.tet).min() > 0.01
  assert fill.volumes(solid.rest, solid.tet).sum() == pytest.approx(0.06 * 0.06 * 0.03)


@pytest.mark.parametrize(
  ("nodes", "edge"), [(250, 0.003), (250, 0.002), (1000, 0.003), (1000, 0.0014)]
)
def test_a_round_surface_that_was_refined_has_tetrahedra_inside(nodes, edge):
  # Its old triangles are flat patches of several new ones: vertices in one plane, shallow folds.
  points, elem = shapes.kidney(nodes)
  points, elem = refine.refine(points, elem, points[points[:, 2].argmax()], 0.012, edge)
  mesh = topology.build("kidney", points, elem)
  solid = fill.fill("kidney", mesh)
  assert fill.quality(solid.rest, solid.tet).min() > 0.01
  assert fill.volumes(solid.rest, solid.tet).sum() == pytest.approx(
    topology.volume(mesh.rest, mesh.elem), rel=1e-3
  )
  face = np.sort(solid.tet[:, fill.FACES].reshape(-1, 3), axis=1)
  count = np.unique(face, axis=0, return_counts=True)[1]
  assert (count == 1).sum() == len(elem) and count.max() == 2
  assert len(np.unique(solid.tet)) == solid.nvert


@pytest.mark.parametrize(
  ("bad", "match"),
  [
    ({"edge": 0.0}, r"edge is 0.0, expected a number > 0"),
    ({"radius": np.nan}, r"radius is nan, expected"),
    ({"at": (0, 0)}, r"at is \(0, 0\), expected three coordinates"),
    ({"edge": 1e-9}, r"edge is 1e-09 m, expected more"),
  ],
)
def test_what_is_not_allowed_is_named(block, bad, match):
  with pytest.raises(ValueError, match=match):
    refine.refine(*block, **({"at": AT, "radius": RADIUS, "edge": EDGE} | bad))


def test_a_shipped_organ_is_finer_where_the_instruments_point():
  import mujoco
  import scenes
  from palpate import models

  spec = models.load("kidney", coupling="window", interior="solid", fine=0.002)
  model, data, organ = scenes.load(spec, "kidney/kidney")
  mujoco.mj_forward(model, data)
  assert 1000 < organ.nvert < 2000
  for place in ("anterior", "lower_pole"):
    at = data.site(f"kidney/kidney_{place}").xpos
    near = np.linalg.norm(organ.xpos[organ.elem].mean(axis=1) - at, axis=1) < 0.004
    assert lengths(organ.xpos, organ.elem)[near].max() < 0.00201
  mujoco.mj_step(model, data)
  assert organ.error is None
  assert (model.flex_solimp[:, :2] == [0.99, 0.999]).all()  # of organ and window
