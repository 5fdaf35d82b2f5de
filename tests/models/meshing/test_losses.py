"""What a wrap cannot have of a mesh is named, with its volume, and measured."""

import functools

import numpy as np
import pytest
import trimesh
from palpate.models import shapes
from palpate.models.meshing.field import tabulate
from palpate.models.meshing.quality import quality
from palpate.models.meshing.wrap import wrap, wrap_pieces

NODES = 250


@functools.cache
def organ(name):
  return getattr(shapes, name)(1500)


# What a wrap cannot have: name -> mesh, kind of the loss, its volume [ml].


def both(one, other, offset=(0, 0, 0)):
  return trimesh.util.concatenate([one, other.apply_translation(offset)])


def stump(radius=0.003, length=0.03):
  """Returns a ball of 6 cm radius with a vessel on top."""

  def vessel(x):
    away = np.hypot(x[:, 0], x[:, 1]) - radius
    return np.maximum(away, np.maximum(x[:, 2] - 0.06 - length, 0.04 - x[:, 2]))

  shape = shapes.union(0.001, shapes.ellipsoid([0, 0, 0], [0.06] * 3), vessel)
  return tabulate(shape, np.array([[-0.07] * 3, [0.07, 0.07, 0.1]]), 0.0015).surface()


def beside_a_liver():
  vertices, triangles = organ("liver")
  top = vertices[vertices[:, 1].argmax()]
  tumour = trimesh.creation.icosphere(3, 0.012)
  return both(trimesh.Trimesh(vertices, triangles), tumour, [top[0], top[1] + 0.013, top[2]])


def ball(radius, turned=False):
  mesh = trimesh.creation.icosphere(4, radius)
  if turned:
    mesh.invert()
  return mesh


LOST = {
  "second body": (lambda: both(ball(0.05), ball(0.04), [0.12, 0, 0]), "piece", 268),
  "tumour a millimetre beside a liver": (beside_a_liver, "piece", 7.2),
  "cavity": (lambda: both(ball(0.05), ball(0.03, turned=True)), "inside", 113),
  "tumour inside": (lambda: both(ball(0.05), ball(0.03)), "inside", 113),
  "vessel": (stump, "part", np.pi * 0.003**2 * 0.03 * 1e6),
  "handle": (lambda: trimesh.creation.torus(0.02, 0.0175), "filled", None),
  "tube": (lambda: trimesh.creation.annulus(0.003, 0.01, 0.1), "filled", np.pi * 0.9),
  "thin tube": (lambda: trimesh.creation.annulus(0.0045, 0.005, 0.1), "filled", np.pi * 2.025),
}


@functools.cache
def lossy(name):
  return wrap(LOST[name][0](), NODES)


@pytest.mark.parametrize("name", LOST)
def test_what_is_left_out_or_filled_is_named_with_its_volume(name):
  vertices, triangles, report = lossy(name)
  assert quality(vertices, triangles).closed and report.foldovers == 0
  _, kind, volume = LOST[name]
  loss = report.losses[0]
  assert loss.kind == kind
  if volume:
    assert 1e6 * loss.volume == pytest.approx(volume, rel=0.2)  # counted on a grid
  assert f"{1e6 * loss.volume:.3g} ml" in str(report)


@pytest.mark.parametrize(
  ("name", "least"),
  [
    ("second body", 43),  # the far side of the ball is 0.11 m away, of a diagonal of 0.25 m
    ("cavity", 11),  # 2 of 17 cm
    ("vessel", 10),  # 3 of 22 cm, less a bump of an edge's length
    ("handle", 4),  # the middle of the lid is 2.5 mm off, of 55 mm
  ],
)
def test_the_distance_is_to_the_whole_mesh(name, least):
  assert lossy(name)[2].hausdorff > least


def test_a_vessel_that_is_too_thin_leaves_no_spikes():
  vertices, _, report = lossy("vessel")
  assert np.linalg.norm(vertices, axis=1).max() < 0.06 + 0.5 * report.spacing


@pytest.mark.parametrize("name", ["liver", "stomach", "gallbladder", "kidney", "lobed"])
def test_an_organ_loses_nothing(name):
  report = wrap(organ(name), NODES)[2]
  assert report.losses == ()
  assert report.hausdorff < 4


def test_pieces_are_organs_of_their_own():
  first, second = wrap_pieces(LOST["second body"][0](), NODES)
  for vertices, triangles, report in (first, second):
    assert quality(vertices, triangles).closed
    assert report.losses == ()
  assert first[2].nodes == NODES
  assert second[2].spacing == pytest.approx(first[2].spacing, rel=0.1)
  assert second[2].volume == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=0.05)
  np.testing.assert_allclose(second[0].mean(axis=0), [0.12, 0, 0], atol=1e-3)
