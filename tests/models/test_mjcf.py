"""The one writer of flexcomps and OBJ files."""

import mujoco
import numpy as np
import palpate
import pytest
import trimesh
from palpate.models import mjcf, shapes

MESH = (
  np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 1 / 3]]),
  np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)


def compile_(flex, extension=None):
  world = f"<worldbody>{flex}</worldbody>"
  return mujoco.MjModel.from_xml_string(f"<mujoco>{extension or mjcf.extension()}{world}</mujoco>")


def test_a_flexcomp_is_the_organ_that_was_asked_for():
  config = {"young": [1e3, 2e3, 3e3, 4e3], "bulk": 5, "device": "cpu"}
  contact = {**mjcf.CONTACT, "friction": (0.5, 0.01, 0.001)}
  text = mjcf.flexcomp(
    "o", MESH, config=config, contact=contact, pin=[0], mass=0.4, radius=0.002, rgba=(1, 0, 0, 1)
  )
  model = compile_(text)
  organ = palpate.Organ(model, mujoco.MjData(model), "o")
  np.testing.assert_allclose(organ.xpos0, MESH[0], atol=1e-9)
  np.testing.assert_array_equal(organ.elem, MESH[1])
  np.testing.assert_array_equal(organ.free, [False, True, True, True])
  assert organ.config.young == (1e3, 2e3, 3e3, 4e3) and organ.config.bulk == 5
  np.testing.assert_allclose(model.body_mass[1:], 0.1)
  np.testing.assert_allclose(model.flex_friction[0], [0.5, 0.01, 0.001])
  assert model.flex_radius[0] == 0.002
  assert max(map(len, text.splitlines())) <= 100


def test_a_rigid_organ_and_its_window_are_written_too():
  config = {"window": "w", "mass": 0.4, "device": "cpu"}
  bare = {"contype": 0, "conaffinity": 0, "selfcollide": "none"}  # its window has the contacts
  organ = mjcf.flexcomp("o", MESH, contact=bare, rigid=True)
  window = mjcf.flexcomp(
    "w", contact=mjcf.CONTACT, inside=mjcf.EDGE, type="grid", count=(3, 3, 1), mass=0.01,
    spacing=(0.01, 0.01, 0.01),
  )  # fmt: skip
  named = compile_(
    f'<body name="b">{mjcf.plugin(instance="i")}{organ}</body>{window}',
    mjcf.extension({"i": config}),
  )
  plain = compile_(f'<body name="b">{mjcf.plugin(config)}{organ}</body>{window}')
  for model in (named, plain):
    assert palpate.Organ(model, mujoco.MjData(model), "o").config.window == "w"


def test_pins_with_names_and_without_are_the_same():
  named = mjcf.flexcomp("o", MESH, config={}, pin={"top": [3], "bottom": [0, 1]}, mass=1)
  plain = mjcf.flexcomp("o", MESH, config={}, pin=[0, 1, 3], mass=1)
  assert "<!-- top -->" in named
  bodies = [compile_(text).flex_vertbodyid.tolist() for text in (named, plain)]
  assert bodies[0] == bodies[1] == [0, 0, 1, 0]


@pytest.mark.parametrize("digits", [6, 9, 17])
def test_numbers_are_as_exact_as_asked(digits):
  values = np.array([1 / 3, -0.0, 1e-12, 123456.789, -2.5])
  text = mjcf.numbers(values, digits)
  np.testing.assert_allclose(np.fromstring(text, sep=" "), values, rtol=0.5 * 10.0 ** (1 - digits))
  assert "-0 " not in text


def test_an_obj_is_read_back(tmp_path):
  vertices, triangles = shapes.lobed(250)
  path = tmp_path / "organ.obj"
  path.write_text(mjcf.obj(vertices, triangles))
  mesh = trimesh.load_mesh(path, process=False)
  np.testing.assert_allclose(mesh.vertices, vertices, atol=0.5e-6)
  np.testing.assert_array_equal(mesh.faces, triangles)
