import functools

import numpy as np
import pytest
import warp as wp
from palpate.models import shapes
from palpate.models.meshing.field import project
from palpate.models.meshing.grid import octasphere, spherical
from palpate.models.meshing.quality import normals, quality, volume

ORGANS = ("liver", "stomach", "gallbladder", "kidney", "lobed")

# Lowest and highest volume [ml] and length along x, y, z [cm]. Liver 1200-1800 ml (Gray's Anatomy
# gives 1.2-1.8 kg at 1.06 kg/l); stomach 0.9-1.5 l when filled; gallbladder 30-50 ml; kidney about
# 150 ml. The boxes follow from the sizes in shapes.py and how the organs lie.
ANATOMY = {
  "liver": ((1200, 1800), (20, 22.5), (10, 13), (14, 17.5)),
  "stomach": ((900, 1500), (17, 22), (9, 12), (19, 25)),
  "gallbladder": ((30, 50), (4, 6), (7, 9), (4, 6)),
  "kidney": ((120, 180), (6, 8.5), (3, 4.5), (10, 12)),
}


@functools.cache
def mesh(name, nodes, seed=None):
  return getattr(shapes, name)(nodes) if seed is None else getattr(shapes, name)(nodes, seed)


def assert_good(vertices, triangles, nodes):
  q = quality(vertices, triangles)
  assert q.closed, q
  assert q.nodes == nodes
  assert q.min_angle > 20, q
  valence = np.bincount(triangles.ravel())
  assert valence.min() >= 4 and valence.max() <= 9


@pytest.mark.parametrize("nodes", [250, 1000])
@pytest.mark.parametrize("name", ORGANS)
def test_mesh_is_good(name, nodes):
  vertices, triangles = mesh(name, nodes)
  assert vertices.dtype == np.float64 and triangles.dtype == np.int64
  assert_good(vertices, triangles, nodes)


@pytest.mark.parametrize("seed", [1, 4])
@pytest.mark.parametrize("name", ORGANS)
def test_variants_are_good(name, seed):
  assert_good(*mesh(name, 250, seed), 250)


@pytest.mark.slow
@pytest.mark.parametrize("nodes", [4000, 16000])
@pytest.mark.parametrize("name", ORGANS)
def test_fine_meshes_are_good(name, nodes):
  assert_good(*getattr(shapes, name)(nodes), nodes)
  assert_good(*getattr(shapes, name)(nodes, 7), nodes)


def test_same_seed_same_bits():
  first, second = mesh("kidney", 250, 4), shapes.kidney(250, 4)
  np.testing.assert_array_equal(first[0], second[0])
  np.testing.assert_array_equal(first[1], second[1])
  assert not np.array_equal(first[0], mesh("kidney", 250, 1)[0])


def test_seed_may_be_a_random_state():
  given = shapes.kidney(250, np.random.RandomState(4))
  np.testing.assert_array_equal(given[0], mesh("kidney", 250, 4)[0])


@pytest.mark.parametrize("name", sorted(ANATOMY))
def test_size_is_anatomical(name):
  vertices, triangles = mesh(name, 1000)
  (low, high), *extents = ANATOMY[name]
  assert low < volume(vertices, triangles) * 1e6 < high
  for length, (short, long) in zip(np.ptp(vertices, axis=0) * 100, extents, strict=True):
    assert short < length < long


def test_nodes_lie_on_the_shape():
  vertices, _ = mesh("gallbladder", 1000)
  shape = shapes.anatomy("gallbladder")
  moved = np.linalg.norm(project(shape.implicit, vertices, steps=10) - vertices, axis=1)
  assert moved.max() < 1e-5  # [m], three Newton steps on a smooth shape


@pytest.mark.parametrize("name", ORGANS)
def test_patches_and_landmarks_are_on_the_organ(name):
  vertices, triangles = mesh(name, 250, 4)
  spacing = np.sqrt(np.linalg.norm(normals(vertices, triangles), axis=1).sum() / 2 / 250)
  for patch, nodes in shapes.patches(name, vertices, 4).items():
    assert 3 <= len(nodes) < 100, patch
    assert nodes.max() < len(vertices)
  for mark, point in shapes.landmarks(name, 4).items():
    assert np.linalg.norm(vertices - point, axis=1).min() < spacing, mark


def test_patches_are_where_their_names_say():
  liver, gallbladder, stomach, kidney = (
    mesh(name, 1000)[0] for name in ("liver", "gallbladder", "stomach", "kidney")
  )
  coronary = liver[shapes.patches("liver", liver)["coronary_ligament"]].mean(axis=0)
  assert coronary[1] < 0 and coronary[2] > 0.03  # posterior and superior
  neck = gallbladder[shapes.patches("gallbladder", gallbladder)["neck"]].mean(axis=0)
  assert np.ptp(gallbladder[:, 1]) - (neck[1] - gallbladder[:, 1].min()) > 0.06
  ends = shapes.patches("stomach", stomach)
  assert stomach[ends["cardia"]][:, 2].mean() > 0.07 > stomach[ends["pylorus"]][:, 2].mean()
  assert not set(ends["cardia"]) & set(ends["pylorus"])
  assert kidney[shapes.patches("kidney", kidney)["hilum"]][:, 0].max() < -0.02  # medial


def test_unknown_organ_lists_the_choices():
  with pytest.raises(ValueError, match=r"'spleen'.*gallbladder, kidney, liver, lobed, stomach"):
    shapes.anatomy("spleen")
  with pytest.raises(ValueError, match="nodes is 10, expected 100 or more"):
    shapes.liver(10)
  with pytest.raises(ValueError, match="side is 17, expected an even number"):
    shapes.grid("liver", 17)


def test_inclusion_is_a_bell():
  vertices, triangles = mesh("lobed", 250)
  middle = vertices[triangles].mean(axis=1)
  center, radius = np.array([0.0, 0.0, 0.04]), 0.02
  young = shapes.inclusion_young(vertices, triangles, center, radius, 5e3, 5e4)
  assert young.shape == (len(triangles),)
  distance = np.linalg.norm(middle - center, axis=1)
  np.testing.assert_allclose(young, 5e3 + 4.5e4 * np.exp(-((distance / radius) ** 2)), rtol=1e-12)
  assert (np.diff(young[np.argsort(distance)]) <= 0).all()


@pytest.mark.parametrize("frequency", [1, 2, 8])
def test_octasphere_is_regular(frequency):
  vertices, triangles = octasphere(frequency)
  q, valence = quality(vertices, triangles), np.bincount(triangles.ravel())
  assert q.closed and q.nodes == 4 * frequency**2 + 2
  assert (valence.min(), valence.max()) == (4, 6 if frequency > 1 else 4)


@pytest.mark.parametrize("name", ORGANS)
def test_grid_is_regular_and_unfolded(name):
  vertices, triangles = shapes.grid(name, 16)
  q = quality(vertices, triangles)
  assert q.closed and q.nodes == 258
  assert (np.bincount(triangles.ravel()) == 4).sum() == 6  # the tips of the octahedron
  assert (np.bincount(triangles.ravel()) == 6).sum() == 252
  assert q.min_angle > 10, q  # fixed edges must stretch around the ducts


@pytest.mark.slow
@pytest.mark.parametrize("side", [64, 128, 256])
@pytest.mark.parametrize("name", ORGANS)
def test_fine_grid_is_unfolded(name, side):
  q = quality(*shapes.grid(name, side))
  assert q.closed and q.nodes == side**2 + 2
  assert q.min_angle > 10, q


def test_sphere_map_is_one_to_one():
  vertices, triangles = mesh("stomach", 1000)
  sphere = spherical(vertices, triangles)
  facing = np.einsum("md,md->m", normals(sphere, triangles), sphere[triangles[:, 0]])
  assert facing.min() > 0
  share = facing / facing.sum()
  area = np.linalg.norm(normals(vertices, triangles), axis=1)
  ratio = share / (area / area.sum())
  assert ratio.min() > 0.1 and ratio.max() < 4  # the conformal map alone gives 2e-5


def test_quality_of_known_meshes():
  corner = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
  solid = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
  q = quality(corner, solid)
  assert q.closed and q.genus == 0
  assert q.volume == pytest.approx(1 / 6)
  assert q.min_angle == pytest.approx(45)
  assert not quality(corner, solid[:, ::-1]).closed  # inside out
  assert not quality(corner, solid[:3]).watertight  # open
  turned = solid.copy()
  turned[0] = turned[0, ::-1]
  assert not quality(corner, turned).watertight
  two = quality(np.concatenate([corner, corner + 5]), np.concatenate([solid, solid + 4]))
  assert two.watertight and two.components == 2 and not two.closed
  touching = np.concatenate([corner, corner[1:] * -1])
  other = np.array([0, 4, 5, 6])[solid][:, ::-1]
  pinched = quality(touching, np.concatenate([solid, other]))
  assert pinched.watertight and not pinched.manifold and not pinched.closed


def test_quality_counts_handles():
  import trimesh

  torus = trimesh.creation.torus(0.05, 0.01)
  q = quality(torus.vertices, torus.faces)
  assert q.genus == 1 and not q.closed


def test_what_was_made_once_is_read_from_a_file_to_the_bit(monkeypatch, tmp_path):
  monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
  made = shapes.kidney(150, 3)
  (file,) = tmp_path.iterdir()
  with np.load(file) as kept:
    np.savez(file, vertices=2 * kept["vertices"], triangles=kept["triangles"])
  np.testing.assert_array_equal(shapes.kidney(150, 3)[0], 2 * made[0])
  file.write_bytes(b"damaged")
  for _ in range(2):  # made again, then read again
    again = shapes.kidney(150, 3)
    for one, other in zip(made, again, strict=True):
      np.testing.assert_array_equal(one, other)
      assert one.dtype == other.dtype
  shapes.kidney(150, 4)
  assert len(list(tmp_path.iterdir())) == 2
