"""Skins: the fine surface that is drawn for an organ follows it, and a step knows nothing of it."""

import mujoco
import numpy as np
import palpate
import pytest
from palpate.models.meshing import grid
from palpate.tissue.geometry import subdivide
from scenes import draw

RADIUS = 0.03


def scene(windows=False, skin=True, **options):
  spec = mujoco.MjSpec.from_string(
    """<mujoco><option timestep="0.001" gravity="0 0 0"/><worldbody>
    <body name="finger" mocap="true" pos="0 0 .05"><geom name="finger" size=".004"/></body>
    </worldbody></mujoco>"""
  )
  points, triangles = grid.octasphere(6)
  config = dict(young=5e3, foundation=1e5, mass=0.05, device="cpu")
  palpate.add_organ(spec, (RADIUS * points, triangles), "organ", pos=(0, 0, 0.01), **config)
  if windows:
    palpate.add_windows(spec, "organ")
  if skin:
    palpate.add_skin(spec, "organ", 2, **options)
  return spec


def drawn(m, d) -> np.ndarray:
  """Returns the skin's vertices as renderers get them."""
  scn = mujoco.MjvScene(m, 100)
  draw(m, d, scn)
  return np.array(scn.skinvert).reshape(-1, 3)[: m.nskinvert].astype(float)


def press(m, d, steps=60):
  mujoco.mj_forward(m, d)
  for k in range(steps):
    d.mocap_pos[0, 2] = 0.0445 - 0.006 * k / steps
    mujoco.mj_step(m, d)
  mujoco.mj_forward(m, d)


@pytest.mark.parametrize("windows", [False, True])
def test_a_dent_is_seen(scenes, windows):
  m, d, organ = scenes.load(scene(windows))
  press(m, d)
  deep = organ.xpos0[:, 2] - organ.xpos[:, 2]
  assert deep.max() > 2e-3
  fine = drawn(m, d)
  smooth = subdivide.smooth(organ.elem, 2)
  np.testing.assert_allclose(fine, smooth(organ.xpos), atol=1e-7)  # float32
  np.testing.assert_allclose(fine[: organ.nvert], organ.xpos, atol=1e-7)


@pytest.mark.parametrize("windows", [False, True])
def test_a_step_is_the_same_with_a_skin(windows):
  states = []
  for skin in (False, True):
    m = scene(windows, skin).compile()
    d = mujoco.MjData(m)
    press(m, d)
    if skin:
      drawn(m, d)
    state = np.empty(mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(m, d, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states.append((m.nv, m.ngeom, m.nbody, d.ncon, state))
  assert states[0][:4] == states[1][:4]
  np.testing.assert_array_equal(states[0][4], states[1][4])


def test_it_turns_with_a_scene_that_it_is_attached_to():
  for windows in (False, True):
    parent = mujoco.MjSpec()
    frame = parent.worldbody.add_frame(pos=[0.1, 0.2, 0.3], euler=[70, 20, 10])
    parent.attach(scene(windows, height=3e-4), prefix="a/", frame=frame)
    m = parent.compile()
    d = mujoco.MjData(m)
    mujoco.mj_forward(m, d)
    organ = palpate.Organ(m, d, "a/organ")
    assert organ.config.skin == "organ_skin"
    fine = drawn(m, d)
    smooth = subdivide.smooth(organ.elem, 2)(organ.xpos)
    away = np.linalg.norm(fine - smooth, axis=1)
    np.testing.assert_allclose(away, 3e-4, atol=1e-7)  # outward everywhere
    center = organ.xpos.mean(axis=0)
    assert (np.linalg.norm(fine - center, axis=1) > np.linalg.norm(smooth - center, axis=1)).all()


def test_it_is_saved_and_the_organ_itself_is_not_drawn(tmp_path):
  spec = scene(True, texcoord=np.zeros((146, 2)))
  spec.compile()
  spec.to_file(str(tmp_path / "scene.xml"))
  m = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
  d = mujoco.MjData(m)
  press(m, d)
  organ = palpate.Organ(m, d, "organ")
  np.testing.assert_allclose(drawn(m, d)[: organ.nvert], organ.xpos, atol=1e-7)
  flex = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_FLEX, "organ")
  assert m.flex_group[flex] > 2 and m.skin_group[0] == 0


@pytest.mark.parametrize(
  ("options", "words"),
  [
    ({"levels": 7}, ("'organ'", "levels is 7", "1, 2, 3, 4")),
    ({"texcoord": np.zeros((5, 2))}, ("texcoord", "(5, 2)", "(146, 2)", "(578, 2)")),
  ],
)
def test_bad_arguments_are_named(options, words):
  with pytest.raises(ValueError) as error:
    palpate.add_skin(scene(skin=False), "organ", **({"levels": 1} | options))
  assert all(word in str(error.value) for word in words)


def test_a_skin_has_the_triangles_that_are_declared_where_the_physics_turns_diagonals(scenes):
  points, triangles = scenes.strip(0.08, 0.04, 8, 4)
  spec = mujoco.MjSpec()
  palpate.add_organ(spec, (points, triangles), "organ", young=5e3, mass=0.05, device="cpu")
  palpate.add_skin(spec, "organ", 1)
  m, d, organ = scenes.load(spec)
  assert (np.sort(organ.elem, axis=1) != np.sort(triangles, axis=1)).any()
  mujoco.mj_forward(m, d)
  np.testing.assert_allclose(drawn(m, d), subdivide.smooth(triangles, 1)(points), atol=1e-7)


def test_bad_skins_are_named():
  with pytest.raises(ValueError, match="no flexcomp 'liver'"):
    palpate.add_skin(scene(skin=False), "liver")
  with pytest.raises(ValueError, match="has skin 'organ_skin' already"):
    palpate.add_skin(scene(), "organ")
  spec = scene()
  spec.delete(spec.skins[0])
  with pytest.raises(ValueError, match="skin is 'organ_skin', the model has none"):
    spec.compile()
  spec = scene()
  skin = spec.skins[0]
  skin.face = np.array(skin.face).reshape(-1, 3)[::-1].ravel()
  with pytest.raises(ValueError, match="other triangles"):
    spec.compile()
  spec = scene()
  other = subdivide.smooth(grid.octasphere(5)[1], 2)
  skin, count = spec.skins[0], other.count
  skin.vert, skin.face = np.zeros(3 * count), other.elem.ravel()
  skin.vertid, skin.vertweight = [np.arange(count)], [np.ones(count)]
  with pytest.raises(ValueError, match=f"has {count} vertices, expected one of 578, 2306"):
    spec.compile()
