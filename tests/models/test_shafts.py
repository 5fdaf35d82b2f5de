"""Shafts against organs: the sides of instruments touch what is between the nodes of a mesh too."""

import mujoco
import numpy as np
import pytest
from palpate.models import mjcf, trocar


@pytest.mark.parametrize("name", trocar.NAMES)
def test_an_edge_far_from_its_nodes_does_not_go_through(scenes, name):
  points = [[0.002, -0.04, -0.1], [0.002, 0.04, -0.1], [0.05, 0, -0.1]]
  flex = scenes.flex(points, [[0, 1, 2]], mjcf.EDGE, "edge", pin=(0, 1, 2), radius=0.001)
  world = f"<mujoco><worldbody>{flex}</worldbody></mujoco>"
  spec = mujoco.MjSpec.from_string(world)
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
