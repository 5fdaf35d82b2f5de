"""Worlds on several devices are those on one."""

import mujoco
import numpy as np
import palpate.batch
import pytest
import warp as wp
from devices import needs_cuda
from scenes import probed

DEVICES = [
  ("warp-cpu", "warp-cpu"),
  pytest.param("cuda:0", f"cuda:{int(wp.get_cuda_device_count() > 1)}", marks=needs_cuda),
]


@pytest.mark.parametrize(("first", "second"), DEVICES)
def test_worlds_on_two_devices_are_those_on_one(first, second):
  found = []
  for device in (first, [first, second]):
    made = mujoco.MjSpec.from_string(probed())
    batch = palpate.batch.make(made, 5, device=device, deterministic=True)
    tissue = batch.organ("organ")
    for part in getattr(batch, "parts", [batch]):
      part.watch(10)  # records the step anew
    tissue.configure(young_scale=[1.0, 1.5, 2.0, 0.5, 1.0], friction=1.0)
    batch.configure(gravity=[0.0, 0.0, -1.0])
    for k in range(30):
      batch.ctrl = np.outer([1, 0.5, 1, 1, 0.8], [-0.0002 * k, 0.0])
      batch.step()
    batch.reset(np.array([True, False, False, True, False]))
    batch.pose(["z"], np.full((5, 1), 0.001), [True, False, False, False, True])
    batch.ctrl = np.full((5, 2), -0.004)
    batch.step(10)
    data = mujoco.MjData(batch.model)
    batch.get_state(3, data)
    batch.set_state(1, data)
    arrays = [batch.qpos, batch.qvel, batch.time, batch.sensordata, batch.ctrl, tissue.xpos]
    arrays += [tissue.contact_force, tissue.iterations, *tissue.contacts, batch.failures]
    found.append([array.numpy().copy() for array in (*arrays, batch.overflow)] + [data.qpos.copy()])
  for one, two in zip(*found, strict=True):
    assert np.array_equal(one, two)
  assert np.ptp(found[0][5][:, :, 2].min(axis=1)) > 0


def test_devices_share_the_worlds():
  made = mujoco.MjSpec.from_string(probed())
  with pytest.raises(ValueError, match="device has 3 names, expected from 1 to nworld, 2"):
    palpate.batch.make(made, 2, device=["warp-cpu"] * 3)
  with pytest.raises(ValueError, match="device is 'cuda:9'"):
    palpate.batch.make(made, 2, device=["cuda:9", "cuda:9"])
