"""The ctypes views of mjModel and mjData."""

import mujoco
import numpy as np
import pytest
from palpate.engine.model import mjstruct


def test_views_are_the_arrays_of_the_bindings(scenes):
  model, data, _ = scenes.load(scenes.press())
  m, d = mjstruct.both(model._address, data._address)
  assert (m.nv, m.nq, m.nflexvert) == (model.nv, model.nq, model.nflexvert)
  assert m.opt.timestep == model.opt.timestep
  d.qpos[3] = 0.25
  assert data.qpos[3] == 0.25
  for owner, own, names in (
    (model, m, ("geom_size", "flex_rigid", "flex_solref", "skin_vert", "body_plugin")),
    (data, d, ("qpos", "xmat", "ctrl", "geom_xpos")),
  ):
    for name in names:
      theirs = getattr(owner, name)
      np.testing.assert_array_equal(getattr(own, name), theirs)
      assert getattr(own, name).shape == theirs.shape
  name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_FLEX, 0)
  assert mjstruct.name_of(m, "flex", 0) == name


def test_an_empty_or_absent_array_is_empty():
  assert mjstruct.view(None, 0).shape == (0,)
  assert mjstruct.view(0, (0, 3)).shape == (0, 3)


def test_a_layout_that_disagrees_with_the_bindings_is_an_import_error(monkeypatch):
  wrong = mujoco.MjModel.from_xml_string("<mujoco/>")._address

  class Shifted(mjstruct.Data):
    @classmethod
    def from_address(cls, address):
      return mjstruct.Model.from_address(wrong)

  monkeypatch.setattr(mjstruct, "Data", Shifted)
  with pytest.raises((ImportError, AttributeError)):
    mjstruct.check()


def test_the_layouts_of_this_version_agree():
  mjstruct.check()


@pytest.mark.parametrize("version", ["3.16.0", "5.0.0"])
def test_another_mujoco_is_refused_by_what_to_install(version, monkeypatch):
  monkeypatch.setattr(mujoco, "__version__", version)
  with pytest.raises(ImportError, match=rf"mujoco is {version}, expected .*: pip install 'mujoco"):
    mjstruct.check()
