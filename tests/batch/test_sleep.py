"""Organs of a batch on a GPU sleep while nothing happens to them, and wake as the plugin's do."""

import mujoco
import numpy as np
import palpate.batch
import pytest
from devices import needs_cuda
from scenes import load, probed

DEVICES = ["warp-cpu", pytest.param("cuda:0", marks=needs_cuda)]
AWAY, DEEP = 0.02, -0.006  # where the probe waits, and is pressed to [m]


def make(device, nworld=2, **keys):
  made = mujoco.MjSpec.from_string(probed(keys=keys))
  batch = palpate.batch.make(made, nworld, device=device)
  batch.ctrl = np.tile([AWAY, 0.0], (nworld, 1))
  return batch


@pytest.mark.parametrize("device", DEVICES)
def test_an_organ_that_was_let_go_comes_to_rest_and_stays(device):
  batch = make(device, damping=0.01)
  tissue, fastest = batch.organ("organ"), []
  for z in (DEEP, AWAY, AWAY):
    batch.ctrl = np.array([[z, 0.0], [AWAY, 0.0]])
    batch.step(400)
    fastest.append(np.linalg.norm(tissue.xvel.numpy(), axis=2).max(axis=1))
  assert fastest[0][0] > 0 and not fastest[2].any()  # to the bit
  still = tissue.xpos.numpy().copy()
  batch.step(50)
  assert np.array_equal(tissue.xpos.numpy(), still) and not tissue.iterations.numpy().any()


@pytest.mark.parametrize("device", DEVICES)
def test_a_tool_wakes_it_with_the_forces_of_the_plugin(device):
  batch, (model, data, organ) = make(device), load(probed())
  found, expected = [], []
  for k in range(700):
    z = AWAY + (DEEP - AWAY) * np.clip((k - 400) / 200, 0, 1)
    data.ctrl[:] = z, 0
    batch.ctrl = np.tile([z, 0.0], (2, 1))
    mujoco.mj_step(model, data)
    batch.step()
    found.append(batch.organ("organ").contact_force.numpy()[0].sum(axis=0))
    expected.append(organ.contact_force.sum(axis=0))
  found, expected = np.array(found), np.array(expected)
  peak = np.abs(expected).max()
  assert peak > 0.01 and np.sqrt(np.mean((found - expected) ** 2)) < 0.003 * peak


@pytest.mark.parametrize("device", DEVICES)
def test_what_changes_wakes_the_worlds_that_it_changes(device):
  batch = make(device, 3)
  tissue = batch.organ("organ")
  batch.step(400)
  still = tissue.xpos.numpy().copy()
  batch.configure([True, False, False], gravity=[0, 0, -9.81])
  tissue.configure([False, True, False], pressure=50.0)
  batch.step(50)
  moved = np.abs(tissue.xpos.numpy() - still).max(axis=(1, 2))
  assert moved[0] > 1e-5 and moved[1] > 1e-5 and moved[2] == 0
