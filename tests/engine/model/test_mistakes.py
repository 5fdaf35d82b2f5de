"""Mistakes: what is refused when a model is compiled, and what is said while it runs."""

import mujoco
import numpy as np
import palpate
import pytest


def _refused(xml, *words):
  with pytest.raises(ValueError) as error:
    mujoco.MjModel.from_xml_string(xml)
  for word in words:
    assert word in str(error.value), str(error.value)


@pytest.mark.parametrize(
  ("key", "value", "words"),
  [
    ("young", "soft", ("young is 'soft'", "a number > 0")),
    ("poisson", "0.5", ("poisson is '0.5'", "[0, 0.5)")),
    ("stiffness", "3", ("stiffness is 3", "elements='spring'")),
    ("elements", "spring", ("stiffness is missing",)),
    ("integrator", "RK4", ("integrator is 'RK4'", "'implicit' or 'midpoint' or 'neumann'")),
    ("device", "cuda:77", ("device is 'cuda:77'", "'cpu'")),
    ("device", "gpu", ("device is 'gpu'", "'cpu'")),
  ],
)
def test_a_bad_key_is_a_compile_error(scenes, key, value, words):
  organ = scenes.organ(*scenes.sphere(1), name="liver", **{key: value})
  _refused(scenes.world(organ), "organ 'liver'", *words)


@pytest.mark.parametrize("key", ["bulk", "pressure"])
def test_an_open_surface_has_no_volume(scenes, key):
  organ = scenes.organ(*scenes.triangular(0.1, 0.05, 4, 3), name="liver", **{key: "10"})
  _refused(scenes.world(organ), "organ 'liver'", f"{key} is 10", "closed surface")


def test_an_unknown_key_is_a_compile_error(scenes):
  organ = scenes.organ(*scenes.sphere(1), yuong="5000")
  _refused(scenes.world(organ), "yuong")


def test_meshes_that_cannot_be_run_are_compile_errors(scenes):
  points, elem = scenes.sphere(1)
  flipped = elem.copy()
  flipped[5] = flipped[5, ::-1]
  _refused(scenes.world(scenes.organ(points, flipped)), "organ 'organ'", "opposite")
  flat = points.copy()
  flat[elem[3, 2]] = 0.5 * (flat[elem[3, 0]] + flat[elem[3, 1]])
  _refused(scenes.world(scenes.organ(flat, elem)), "organ 'organ'", "degenerate")


def test_a_vertex_without_triangles_is_left_out_by_mujoco(scenes):
  points, elem = scenes.sphere(1)
  *_, organ = scenes.load(scenes.world(scenes.organ(np.vstack([points, [0, 0, 1]]), elem)))
  assert organ.nvert == len(points)


def test_flexes_that_are_no_surface_are_refused(scenes):
  plugin = '<plugin plugin="palpate.organ"><config key="device" value="cpu"/></plugin>'
  for dim, count, what in ((1, "4 1 1", "dim is 1"), (3, "3 3 3", "dim is 3")):
    grid = f'type="grid" dim="{dim}" count="{count}" spacing=".1 .1 .1"'
    flex = f'<flexcomp name="rope" {grid} mass="1">'
    _refused(scenes.world(f"{flex}{plugin}</flexcomp>"), "organ 'rope'", what, "dim='2'")
  flex = '<flexcomp name="sheet" type="grid" dim="2" count="4 4 1" spacing=".1 .1 .1" mass="1"'
  elastic = '<elasticity young="1e3" poisson="0.3" thickness="0.01" elastic2d="both"/>'
  xml = scenes.world(f"{flex}>{plugin}{elastic}</flexcomp>")
  _refused(xml, "organ 'sheet'", "MuJoCo elasticity too")
  xml = scenes.world(f'{flex}>{plugin}<edge equality="true"/></flexcomp>')
  _refused(xml, "organ 'sheet'", "holds the flex's edges", "expected none")


def test_a_plugin_on_a_body_without_a_flex_is_refused(scenes):
  body = '<body name="box"><geom size="0.1"/><plugin plugin="palpate.organ"/></body>'
  _refused(scenes.world(body), "'box'", "flexcomp")


@pytest.mark.parametrize("what", ["qpos", "qvel", "force"])
def test_a_state_that_is_not_finite_warns_and_recovers_after_reset(scenes, device, what):
  model, data, organ = scenes.load(scenes.press(device=device))
  expected = scenes.motion(model)
  scenes.run(model, data, 30)
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
  target = {"qpos": data.qpos, "qvel": data.qvel, "force": data.qfrc_applied}[what]
  target[scenes.dofs(organ)[5, 1] if what != "qpos" else scenes.qposs(organ)[5, 1]] = np.nan
  with scenes.Warnings() as log:
    mujoco.mj_forward(model, data)
    text = log()
  assert organ.error is not None and "'organ'" in organ.error and "finite" in organ.error
  assert "organ 'organ'" in text
  model.opt.disableflags = 0
  mujoco.mj_resetData(model, data)
  assert organ.error is None
  np.testing.assert_array_equal(scenes.run(model, data, 80, record=True), expected)


@pytest.mark.parametrize("what", ["qpos", "qvel", "force"])
def test_an_error_stays_visible_when_mujoco_resets_by_itself(scenes, what):
  model, data, organ = scenes.load(scenes.press())
  scenes.run(model, data, 30)
  target = {"qpos": data.qpos, "qvel": data.qvel, "force": data.qfrc_applied}[what]
  target[scenes.dofs(organ)[5, 1] if what != "qpos" else scenes.qposs(organ)[5, 1]] = np.nan
  with scenes.Warnings() as log:
    scenes.run(model, data, 10)
    text = log()
  assert data.time == pytest.approx(0.01)
  assert "organ 'organ'" in text
  assert organ.error is not None and "finite" in organ.error
  organ.reset()
  assert organ.error is None
  scenes.run(model, data, 5)
  assert organ.error is None
  mujoco.mj_resetData(model, data)
  np.testing.assert_array_equal(
    scenes.run(model, data, 40, record=True)[-1], scenes.motion(model)[39]
  )


def test_an_error_is_of_one_data_and_one_organ(scenes):
  points, elem = scenes.sphere(1)
  xml = scenes.world(
    *(scenes.organ(points + np.array([x, 0, 0]), elem, name=n) for n, x in (("a", 0), ("b", 0.3)))
  )
  model, data, a = scenes.load(xml, "a")
  b = palpate.Organ(model, data, "b")
  other = mujoco.MjData(model)
  twin = palpate.Organ(model, other, "a")
  data.qvel[scenes.dofs(a)[0]] = np.nan
  with scenes.Warnings():
    mujoco.mj_step(model, data)
  assert (a.error is None, b.error is None, twin.error is None) == (False, True, True)
  mujoco.mj_copyData(other, model, data)
  mujoco.mj_resetData(model, other)
  assert a.error is not None and twin.error is None
  mujoco.mj_resetData(model, data)
  assert a.error is None


def test_a_diverging_motion_is_reported_once(scenes):
  model, data, organ = scenes.adrift()
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
  data.qvel[scenes.dofs(organ)] = 1e25
  with scenes.Warnings() as log:
    scenes.run(model, data, 20)
    text = log()
  assert organ.error is not None
  assert text.count("palpate.organ") == 1
  organ.reset()
  assert organ.error is None
  np.testing.assert_array_equal(organ.displacement, 0)
