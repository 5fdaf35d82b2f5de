"""Every kind of tool in a batch meets tissue as it does under the plugin."""

import mujoco
import numpy as np
import palpate.batch
import pytest
from devices import needs_cuda
from scenes import RADIUS, abreast, load, off, organ, probed, sphere, world

DEVICES = ["warp-cpu", pytest.param("cuda:0", marks=needs_cuda)]
POINTS = "-1 -1 -3 1 -1 -3 1 1 -3 -1 1 -3 -1 -1 3 1 -1 3 1 1 3 -1 1 3"
KINDS = {
  "sphere": 'size=".006"',
  "cylinder": 'type="cylinder" size=".006 .02"',
  "shaft": 'type="cylinder" size=".003 .02" euler="0 60 0"',
  "capsule": 'type="capsule" size=".006 .02"',
  "ellipsoid": 'type="ellipsoid" size=".006 .005 .02"',
  "box": 'type="box" size=".006 .006 .02"',
  "mesh": 'type="mesh" mesh="block"',
}


def pressed(geom: str, still: str = "", **keys):
  """Returns a sphere of tissue under a tool on a slide."""
  points, elem = sphere(2)
  tissue = organ(points, elem, young=3e4, foundation=1e5, tolerance=1e-6, bend=0, **keys)
  tool = f"""<body name="tool" pos="0.001 0.0005 {RADIUS + 0.024}">
    <joint name="z" type="slide" axis="0 0 1"/>
    <geom {geom} mass="0.05" condim="1" solref="0.004 1"/></body>"""
  scale = "0.006 0.006 0.0067"
  extra = f"""<asset><mesh name="block" vertex="{POINTS}" scale="{scale}"/></asset>
    <actuator><position joint="z" kp="500" kv="10"/></actuator>"""
  return world(tissue, tool, still, tolerance=1e-8, extra=extra)


def heights(kind: str, k: int) -> float:
  start = {"sphere": -0.017, "shaft": -0.019}.get(kind, -0.003)
  return start - 0.006 * min(1.0, k / 60)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", KINDS)
def test_a_tool_presses_as_under_the_plugin(device, kind):
  made = pressed(KINDS[kind])
  model, data, handle = load(made)
  how = {"device": device, "nodes": 24, "deterministic": True}
  batch = palpate.batch.make(mujoco.MjSpec.from_string(made), 2, **how)
  found = abreast(model, data, handle, batch, [heights(kind, k) for k in range(100)])
  assert not batch.overflow.numpy().any() and not batch.failures.numpy().any()
  assert np.abs(found[:, -1]).max() > 0.05 and off(found) < 0.01
  assert np.array_equal(found[:, 0], found[:, 1])


SMALL = {  # where it starts, and how far it goes: the tissue about a flat end stays level
  "sphere": ('size=".003"', -0.0195, 0.004),
  "cylinder": ('type="cylinder" size=".004 .02"', -0.003, 0.0015),
  "capsule": ('type="capsule" size=".003 .02"', 0.0, 0.004),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("firm", [True, False])
@pytest.mark.parametrize("kind", SMALL)
def test_a_small_tool_sinks_into_a_bare_solid_as_under_the_plugin(device, kind, firm):
  geom, start, deep = SMALL[kind]
  made = pressed(geom, elements="solid", poisson=0.45)
  if firm:  # as the tissue asks for
    made = made.replace('solref="0.004 1"', "")
  model, data, handle = load(made)
  batch = palpate.batch.make(mujoco.MjSpec.from_string(made), 2, device=device)
  batch.organ("organ").configure(young=[3e4, 6e4])
  handle.configure(young=6e4)
  ways = start - deep * np.minimum(1.0, np.arange(100) / 60)
  found = abreast(model, data, handle, batch, ways)[..., 2]
  assert not batch.overflow.numpy().any() and found[:, -1].min() < -0.1
  assert off(found, world=1) < 0.01


@pytest.mark.parametrize("device", DEVICES)
def test_a_row_of_geoms_on_a_triangle_loses_none(device):
  points, elem = sphere(2)
  tissue = organ(points, elem, young=3e4, foundation=1e5, tolerance=1e-6, bend=0)
  row = "".join(
    f'<geom size="0.0015" pos="{0.0012 * k - 0.0048} 0 0" mass="0.005" condim="1" '
    'solref="0.004 1"/>'
    for k in range(9)
  )
  tool = f"""<body name="tool" pos="0.001 0.0005 {RADIUS + 0.004}">
    <joint name="z" type="slide" axis="0 0 1"/>{row}</body>"""
  extra = '<actuator><position joint="z" kp="500" kv="10"/></actuator>'
  made = world(tissue, tool, tolerance=1e-8, extra=extra)
  model, data, handle = load(made)
  batch = palpate.batch.make(mujoco.MjSpec.from_string(made), 2, device=device)
  found, most = [], 0
  for k in range(80):
    data.ctrl[:] = -0.006 * min(1.0, k / 60)
    batch.ctrl = np.full((2, 1), data.ctrl[0])
    mujoco.mj_step(model, data)
    batch.step()
    total = batch.organ("organ").contact_force.numpy()[0].sum(axis=0)
    found.append((total, handle.contact_force.sum(axis=0)))
    most = max(most, int((batch.organ("organ").contacts.geom.numpy()[0] >= 0).sum()))
  found = np.array(found)
  assert not batch.overflow.numpy().any() and most > 8
  peak = np.abs(found[:, 1]).max()
  assert np.sqrt(np.mean((found[:, 0] - found[:, 1]) ** 2)) < 0.01 * peak


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("still", ["plane", "ball"])
def test_an_organ_rests_on_what_does_not_move(device, still):
  points, elem = sphere(2)
  tissue = organ(points, elem, young=3e4, foundation=1e4, damping=0.01, tolerance=1e-6, bend=0)
  z = -RADIUS - 0.0008
  floor = {
    "plane": f'<geom type="plane" size="1 1 1" condim="1" solref="0.01 1" pos="0 0 {z}"/>',
    "ball": f'<geom size="0.02" condim="1" solref="0.01 1" pos="0 0 {z - 0.02}"/>',
  }[still]
  made = world(tissue, floor, gravity=(0, 0, -9.81), tolerance=1e-8)
  model, data, handle = load(made)
  batch = palpate.batch.make(mujoco.MjSpec.from_string(made), 2, device=device, nodes=48)
  found = abreast(model, data, handle, batch, np.zeros((150, 0)))[..., 2]
  assert not batch.overflow.numpy().any() and found[:, -1].max() > 0.01
  assert off(found) < 0.01


@pytest.mark.parametrize("device", DEVICES)
def test_a_sensor_feels_the_contacts_of_its_own_bodies_alone(device):
  points, elem = sphere(2)
  tissue = organ(points, elem, young=3e4, foundation=1e5, tolerance=1e-6, bend=0)
  tools = "".join(
    f"""<body name="{name}" pos="{x} 0 {RADIUS + 0.0055}"><joint name="{name}" type="slide"
    axis="0 0 1"/><geom size="0.006" mass="0.05" condim="1"/><site name="{name}" size="0.05"/>
    </body>"""
    for name, x in (("left", -0.001), ("right", 0.001))
  )
  extra = """<actuator><position joint="left" kp="500" kv="10"/><position joint="right" kp="500"
    kv="10"/></actuator>
    <sensor><touch site="left"/><touch site="right"/>
    <contact body1="left" data="force" reduce="netforce"/>
    <contact body1="left" body2="right" data="force" reduce="netforce"/></sensor>"""
  made = world(tissue, tools, tolerance=1e-8, extra=extra)
  model, data, handle = load(made)
  batch = palpate.batch.make(mujoco.MjSpec.from_string(made), 2, device=device, nodes=24)
  abreast(model, data, handle, batch, [(-0.002, 0.02)] * 60)
  felt = data.sensordata
  assert felt[0] > 0.02 and felt[1] == 0 and np.linalg.norm(felt[2:5]) > 0.02 and not felt[5:].any()
  np.testing.assert_allclose(
    batch.sensordata.numpy(), np.tile(felt, (2, 1)), rtol=0.02, atol=2e-4 * felt[0]
  )
  assert not batch.sensordata.numpy()[:, 5:].any()


@pytest.mark.parametrize("device", DEVICES)
def test_nodes_on_a_plane_that_have_no_slot_are_counted(device):
  points, elem = sphere(2)
  tissue = organ(points, elem, young=3e4, bulk=1e4, bend=0)
  floor = f'<geom type="plane" size="1 1 1" condim="1" pos="0 0 {-0.6 * RADIUS}"/>'
  made = mujoco.MjSpec.from_string(world(tissue, floor))
  batch = palpate.batch.make(made, 2, device=device, nodes=8)
  batch.step()
  with pytest.warns(UserWarning, match="windows had no room"):
    assert (batch.overflow.numpy() > 0).all()


def test_rows_of_contacts_that_were_are_forgotten():
  """A contact may come where one with more rows has been: of other friction, or another world's."""
  forces = []
  for stale in (-1, 0):
    spec = mujoco.MjSpec.from_string(probed(condim=3, cone="elliptic"))
    spec.worldbody.add_geom(size=[0.01, 0, 0], pos=[1, 1, 1], condim=6)
    batch = palpate.batch.make(spec, 1, "warp-cpu", deterministic=True)  # rows are sparse
    for k in range(20):
      batch.ctrl = np.array([[-0.001 * k, 0.0]])
      batch.d.contact.efc_address.fill_(stale)
      batch.step()
    forces.append(batch.organ("organ").contact_force.numpy())
  assert np.array_equal(*forces)
  assert np.abs(forces[0]).max() > 1e-3
