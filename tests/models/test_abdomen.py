"""The abdomen: organs at their places, scenery that only draws, textures that repeat to the bit."""

import mujoco
import numpy as np
import palpate
import pytest
from palpate import models
from palpate.models import catalog, scenery, shapes, situs, texture


@pytest.fixture(scope="module")
def whole():
  return models.abdomen(soft={"gallbladder": 250}, instruments=("grasper",)).compile()


def scenery_of(m) -> dict[str, np.ndarray]:
  """Returns the vertices of what is only drawn in the world [m], by name."""
  found = {}
  for k in range(m.nskin):
    name = m.skin(k).name
    if name.startswith("abdomen_"):
      first = m.skin_vertadr[k]
      found[name.removeprefix("abdomen_")] = m.skin_vert[first : first + m.skin_vertnum[k]]
  return found


def test_textures_are_the_same_to_the_bit():
  for kind in ("liver", "fat"):
    first = texture.texture(kind, 3, 64).copy()
    texture.texture.cache_clear()
    np.testing.assert_array_equal(texture.texture(kind, 3, 64), first)
    assert (texture.texture(kind, 4, 64) != first).any()


def test_tiles_fit():
  """The first row goes on where the last one ends, as rows next to each other do."""
  for kind in ("fat", "wall"):
    image = texture.texture(kind).astype(float)
    for turned in (image, image.swapaxes(0, 1)):
      inside = np.abs(np.diff(turned, axis=0)).mean(axis=(1, 2))
      assert np.abs(turned[0] - turned[-1]).mean() < 1.2 * inside.max()


def test_an_organs_texture_has_no_seam():
  """What is near on the organ is near on the texture: the halves of the sphere meet on its rim."""
  for name in ("liver", "stomach", "gallbladder"):
    surface = scenery.organ(name)
    edge = surface.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    step = np.linalg.norm(np.diff(surface.texcoord[edge], axis=1)[:, 0], axis=1)
    assert step.max() < 0.2  # of 1, across the map's corners
    assert surface.texcoord.min() >= 0 and surface.texcoord.max() <= 1


def test_variants_take_their_texture_from_the_committed_sphere():
  vertices, triangles = shapes.kidney(250, 1)
  uv = scenery.texcoord("kidney", vertices, triangles)
  step = np.linalg.norm(uv[triangles] - np.roll(uv[triangles], 1, axis=1), axis=2)
  assert step.max() < 0.35  # twenty triangles go around it


def test_scenery_has_no_contacts_and_no_dofs(whole):
  assert {"liver", "stomach", "fat", "wall"} <= set(scenery_of(whole))
  bare = models.load("gallbladder", 250, instruments=("grasper",), coupling="window").compile()
  backdrop = 1  # of that scene
  assert whole.ngeom == bare.ngeom - backdrop and (whole.geom_bodyid > 0).all()
  assert whole.nv == bare.nv


def test_organs_are_where_they_belong(whole):
  """Liver right and above, stomach left, the gallbladder under the liver, the fat below all."""
  data = mujoco.MjData(whole)
  mujoco.mj_forward(whole, data)

  points = scenery_of(whole)
  gallbladder = palpate.Organ(whole, data, "gallbladder/gallbladder").xpos
  liver, stomach, fat, wall = (points[n] for n in ("liver", "stomach", "fat", "wall"))
  assert liver[:, 0].mean() > stomach[:, 0].mean() + 0.03  # x to the right
  assert gallbladder[:, 1].mean() > liver[:, 1].mean() + 0.04  # y to the feet
  assert gallbladder[:, 2].max() < liver[:, 2].max()
  assert fat[:, 1].max() > liver[:, 1].max() + 0.05 and fat[:, 2].mean() < liver[:, 2].mean()
  for inner in (liver, stomach, gallbladder):
    assert (inner.min(axis=0) > wall.min(axis=0)).all()
    assert (inner.max(axis=0) < wall.max(axis=0)).all()
  np.testing.assert_allclose(np.ptp(liver, axis=0), [0.22, 0.15, 0.12], atol=0.012)
  # Neighbours touch, they do not lie in each other.
  inside = shapes.anatomy("liver").implicit
  for name in ("stomach", "gallbladder"):
    own = scenery.organ(name).vertices + catalog.PLACES[name][0]
    assert inside(own).min() > -0.004


def test_every_place_and_size_has_a_source():
  assert all(len(source) > 8 for _, source in catalog.PLACES.values())
  for duct in catalog.DUCTS.values():
    assert duct.source
  for name in ("cystic_duct", "cystic_artery"):
    duct = catalog.DUCTS[name]
    rings = scenery.tube(np.array(duct.points), np.full(len(duct.points), duct.diameter / 2))
    middle = rings.vertices.reshape(30, 13, 3)[:, :-1].mean(axis=1)
    length = np.linalg.norm(np.diff(middle, axis=0), axis=1).sum()
    assert length == pytest.approx(0.0273, rel=0.1)


def test_surfaces_face_who_looks_at_them():
  wall = scenery.shell((0, 0, 0), (1, 1, 1), 2.4, (20, 16))
  tube = scenery.tube([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [0.1] * 3)
  floor = scenery.sheet(lambda x, y: 0 * x, (0, 0), (1, 1), (4, 4))
  for surface, out in ((wall, -1), (tube, 1), (floor, 1)):
    corner = surface.vertices[surface.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    away = corner.mean(axis=1) * (1, 1, 1)
    if surface is tube:
      away[:, 0] = 0
    if surface is floor:
      away = np.array([[0, 0, 1.0]])
    assert (out * (normal * away).sum(axis=1) > -1e-9).all()


@pytest.mark.parametrize(
  ("options", "words"),
  [
    ({"soft": "liver"}, ("'liver'", "tuple")),
    ({"soft": ["spleen"]}, ("'spleen'", "liver, gallbladder, stomach")),
    ({"soft": {"liver": 17}}, ("nodes is 17", "250, 1000")),
    ({"instruments": ("knife",)}, ("'knife'", "probe")),
  ],
)
def test_bad_input_is_named(options, words):
  with pytest.raises(ValueError) as error:
    models.abdomen(**options)
  assert all(word in str(error.value) for word in words)
  with pytest.raises(ValueError, match="texture is 'bone', expected one of liver"):
    texture.texture("bone")
  assert set(situs.ARRANGEMENTS) == set(catalog.PLACES)


@pytest.mark.parametrize("name", ["gallbladder", "liver_inclusion"])
def test_a_scene_of_one_organ_enters_the_abdomen_and_moves_as_before(name):
  found = []
  for inside in (False, True):
    spec = models.load(name, 250)
    if inside:
      situs.enter(spec, name, 250)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("press").id)
    mujoco.mj_step(model, data, 20)
    found.append((model, data))
  np.testing.assert_array_equal(found[0][1].qpos, found[1][1].qpos)
  drawn = {found[1][0].skin(k).name for k in range(found[1][0].nskin)}
  assert {"abdomen_fat", "abdomen_wall", "abdomen_stomach", f"{name}/{name}_skin"} <= drawn
  assert "abdomen_" + name.removesuffix("_inclusion") not in drawn and not found[0][0].nskin
