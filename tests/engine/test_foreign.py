"""Plugin states of other origin: from another model, damaged, or set by hand."""

import copy

import mujoco
import numpy as np
import pytest
import scenes
from scenes import drive, load, probed

FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
COUPLINGS = pytest.mark.parametrize("windowed", [False, True], ids=["nodal", "window"])


def fill(d, kind):
  random = np.random.RandomState(0)
  if kind == "random":
    d.plugin_state[:] = random.uniform(-1, 1, d.plugin_state.shape)
  elif kind == "huge":
    d.plugin_state[:] = 0
    d.plugin_state[:10] = 1e9
  else:
    d.plugin_state[:] = 0
    d.plugin_state[3] = np.nan


@COUPLINGS
@pytest.mark.parametrize(
  ("kind", "words"), [("random", "not one of this organ"), ("huge", "1e+06"), ("nan", "finite")]
)
def test_a_plugin_state_that_cannot_be_is_refused_by_name(windowed, kind, words):
  m, d, organ = load(probed(windowed))
  drive(m, d, 90)
  fill(d, kind)
  with scenes.Warnings() as log:
    drive(m, d, 5)
    text = log()
  assert "organ 'organ': ValueError: plugin_state" in organ.error and words in organ.error
  assert text.count("plugin_state") == 1
  mujoco.mj_resetData(m, d)
  fresh = drive(m, mujoco.MjData(m), 20)
  np.testing.assert_allclose(drive(m, d, 20), fresh, atol=1e-9)
  assert organ.error is None


@COUPLINGS
def test_a_plugin_state_of_another_model_is_refused(windowed):
  m, d, _ = load(probed(windowed))
  drive(m, d, 60)
  larger = probed(windowed).replace('type="direct"', 'type="direct" scale="1.1 1.1 1.1"', 1)
  other, e, organ = load(larger)
  e.plugin_state[:] = d.plugin_state
  with scenes.Warnings():
    mujoco.mj_step(other, e)
  assert "not one of this organ" in organ.error


@COUPLINGS
def test_a_state_of_a_model_compiled_with_another_stiffness_goes_on(windowed):
  m, d, _ = load(probed(windowed))
  drive(m, d, 100)
  other, e, organ = load(probed(windowed, keys={"young": 4e4}))
  state = np.empty(mujoco.mj_stateSize(m, FULL))
  mujoco.mj_getState(m, d, state, FULL)
  mujoco.mj_setState(other, e, state, FULL)
  drive(other, e, 20)
  assert organ.error is None and np.abs(organ.displacement).max() > 1e-3


def test_a_copy_made_before_the_first_step_is_one_of_this_organ():
  m, d, organ = load(probed())
  twin = copy.copy(d)
  np.testing.assert_array_equal(drive(m, twin, 30), drive(m, d, 30))
  assert organ.error is None
