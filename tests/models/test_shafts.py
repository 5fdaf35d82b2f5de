"""Instruments against organs: their sides touch what is between the nodes of a mesh too."""

import mujoco
import numpy as np
import pytest
from palpate import Organ, models
from palpate.models import mjcf, trocar


@pytest.mark.parametrize("name", trocar.NAMES)
def test_an_edge_far_from_its_nodes_does_not_go_through(scenes, name):
  points = [[0.001, -0.04, -0.1], [0.001, 0.04, -0.1], [0.05, 0, -0.1]]
  flex = scenes.flex(points, [[0, 1, 2]], mjcf.EDGE, "edge", pin=(0, 1, 2), radius=0.001)
  world = f"<mujoco><worldbody>{flex}</worldbody></mujoco>"
  spec = mujoco.MjSpec.from_string(world)
  trocar.attach(spec, name, "tool/")
  model = spec.compile()
  data = mujoco.MjData(model)
  lowest = 0.0095 if name == "scalpel" else 0.002  # its blade goes through what it cuts
  for height in np.arange(lowest, 0.15, 0.001):  # above the tip
    data.joint("tool/insertion").qpos = height - 0.02
    mujoco.mj_forward(model, data)
    tip, shaft = (data.sensor(f"tool/{part}_contacts").data[0] for part in ("tip", "shaft"))
    assert tip + shaft > 0, height
    if name == "probe" and height > 0.0125:
      assert tip == 0, height


def sweep(coupling):
  """Sweeps a probe's shaft into the liver's flank; returns the forces on it and what was missed."""
  model = models.load("liver", nodes=250, instruments=("probe",), coupling=coupling).compile()
  data = mujoco.MjData(model)
  organ = Organ(model, data, "liver/liver")
  (prefix,) = {model.sensor(i).name.split("/")[0] + "/" for i in range(model.nsensor)}
  pose = trocar.inverse(trocar.trocar(model, prefix), organ.xpos.mean(axis=0))
  joints = [model.joint(prefix + name).qposadr[0] for name in trocar.JOINTS[:3]]
  drives = [model.actuator(prefix + name).id for name in trocar.JOINTS[:3]]
  pose += [0, 0.52, 0.03]
  data.qpos[joints] = data.ctrl[drives] = pose
  forces = []
  for k in range(500):
    data.ctrl[drives[1]] = pose[1] - 5e-4 * k
    mujoco.mj_step(model, data)
    forces.append(np.linalg.norm(data.sensor(f"{prefix}shaft_force").data))
  return np.array(forces), organ.window_warning if coupling == "window" else None


def test_a_window_follows_the_shaft():
  nodal, _ = sweep("nodal")
  window, missed = sweep("window")
  assert not nodal[:20].any() and 1.0 < nodal[-1] < 10.0
  assert not missed
  # Contacts that come and go by a step: means of 50 ms.
  nodal, window = (force.reshape(-1, 50).mean(axis=1) for force in (nodal, window))
  np.testing.assert_allclose(window, nodal, atol=0.02 * nodal.max())
