"""Kernels are compiled before the first step, which does not launch them."""

# pyright: reportIndexIssue=false
import mujoco
import mujoco_warp as mjw
import numpy as np
import palpate.batch
import pytest
import warp as wp
from palpate.batch.mjw.compiling import compile_ahead
from scenes import press

INTERPOLATED = """
<mujoco>
  <option jacobian="dense"/>
  <worldbody>
    <geom type="box" size="1 1 .1" pos="0 0 -.1"/>
    <flexcomp name="block" type="grid" dim="3" count="3 3 3" spacing=".1 .1 .1" pos="0 0 .105"
              radius=".01" dof="trilinear" mass="1">
      <elasticity young="1e4" poisson=".2"/>
      <contact condim="1" selfcollide="none"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


@wp.kernel(enable_backward=False)
def _count(out: wp.array[int]):
  out[wp.tid()] = out[wp.tid()] + 1


def test_kernels_are_compiled_before_they_are_launched():
  launched, asked = wp.launch, wp.get_suggested_block_size
  out = wp.zeros(3, dtype=int, device="cpu")
  more = wp.ones(1, dtype=int, device="cpu")

  def work():
    wp.launch(_count, dim=3, inputs=[out], device="cpu")

  def works():
    wp.get_suggested_block_size(_count)  # would compile it, on CUDA
    wp.capture_while(more, while_body=work)  # would not end

  compile_ahead(wp.get_device("cpu"), [works])
  assert out.numpy().tolist() == [0, 0, 0]
  assert wp.launch is launched and wp.get_suggested_block_size is asked
  work()
  assert out.numpy().tolist() == [1, 1, 1]


@pytest.mark.slow  # a minute of compilation
def test_interpolated_flexes_of_others_have_contacts_beside_a_batch():
  palpate.batch.make(mujoco.MjSpec.from_string(press()), 1, device="warp-cpu").step()
  model = mujoco.MjModel.from_xml_string(INTERPOLATED)
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  m, d = mjw.put_model(model), mjw.put_data(model, data, nconmax=32, njmax=128)
  mjw.forward(m, d)
  found, expected = d.qfrc_constraint.numpy()[0], data.qfrc_constraint
  assert np.abs(found - expected).max() < 0.05 * np.abs(expected).max()
