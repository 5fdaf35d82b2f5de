"""Shafts against organs: the sides of instruments touch what is between the nodes of a mesh too."""

import mujoco
import numpy as np
import pytest
from palpate.models import trocar

EDGE = """
<mujoco><worldbody>
  <flexcomp name="edge" type="direct" dim="2" radius="0.001" mass="0.01" element="0 1 2"
    point="0.002 -0.04 -0.1  0.002 0.04 -0.1  0.05 0 -0.1">
    <contact selfcollide="none"/><edge damping="1e-9"/><pin id="0 1 2"/>
  </flexcomp>
</worldbody></mujoco>"""


@pytest.mark.parametrize("name", trocar.NAMES)
def test_an_edge_far_from_its_nodes_does_not_go_through(name):
  spec = mujoco.MjSpec.from_string(EDGE)
  trocar.attach(spec, name, "tool/")
  model = spec.compile()
  data = mujoco.MjData(model)
  for height in np.arange(0.002 if name == "probe" else 0.031, 0.15, 0.001):  # above the tip
    data.joint("tool/insertion").qpos = height - 0.02
    mujoco.mj_forward(model, data)
    tip, shaft = (data.sensor(f"tool/{part}_contacts").data[0] for part in ("tip", "shaft"))
    assert tip + shaft > 0, height
    if name == "probe" and height > 0.0125:
      assert tip == 0, height
