"""What acts beside the tissue in batches is what the plugin has, in each world its own."""

import mujoco
import numpy as np
import palpate
import palpate.batch
import pytest
from devices import needs_cuda
from palpate.batch import strip_organs
from scenes import ball, box, documents, load, sphere, windowed, workspace, world

BACKENDS = ["cpu", "warp-cpu", pytest.param("cuda:0", marks=needs_cuda)]
BODIES = """<body name="bed" pos="0 0 -0.0605"><geom name="bed" type="box" size="0.1 0.1 0.01"
  contype="0" conaffinity="0"/></body>
  <body name="hand" pos="0 0 0.08"><joint type="slide" axis="1 0 0"/>
  <joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/>
  <geom size="0.01" mass="0.5" contype="0" conaffinity="0"/></body>"""
NAMES = "globe", "one", "two"
KEYS = {"young": 3e4, "tolerance": 1e-6, "damping": 0.01}
KEYS |= {"contact": {"contype": 1, "conaffinity": 2}}


def scene():
  """Returns a ball on a bed, a free body attached to it, a block bonded to it and one to that."""
  points, elem = sphere(1)
  block, blocks = box((0.04, 0.04, 0.02), 0.02)
  block[:, 2] -= block[:, 2].min()

  def top(x):
    return " ".join(map(str, np.flatnonzero(x[:, 2] > x[:, 2].max() - 0.02)))

  bonds = "bed 1e6 100 0.05 near 0.015, one 1e6 60 0.02 near 0.015"
  on = {"attach": f"hand 20 {top(points)}", "bonds": bonds, "support": "bed", "foundation": 3e2}
  organs = [windowed(points, elem, "globe", "w0", "5 4 1", **KEYS | on)]
  on = {"attach": f"two 30 {top(block)}", "mass": 0.02, "foundation": 1e3, "carrier": "own"}
  organs.append(
    windowed(block + np.array([0.0715, 0, -0.01]), blocks, "one", "w1", "3 3 1", **KEYS | on)
  )
  on = {"foundation": 1e4, "carrier": "hand", "mass": 0.02, "relax_share": 0.6, "relax_time": 0.05}
  organs.append(
    windowed(block + np.array([0.0715, 0, 0.02]), blocks, "two", "w2", "3 3 1", **KEYS | on)
  )
  return world(*organs, ball(0.3), BODIES, gravity=(0.5, 0, 3.0))


@pytest.fixture(params=BACKENDS)
def make(request):
  """Returns what makes a batch of the scene; on a GPU with few slots, which compile sooner."""
  options = {} if request.param == "cpu" else {"nodes": 4}
  spec = mujoco.MjSpec.from_string(scene())
  return lambda nworld: palpate.batch.make(spec, nworld, device=request.param, **options)


def test_what_acts_beside_the_tissue_is_what_the_plugin_has(make):
  model, data, first = load(scene(), NAMES[0])
  organs = [palpate.Organ(model, data, name) for name in NAMES]
  batch = make(3)
  bonds = batch.organ("globe").bonds
  assert np.array_equal(bonds.vertices, first.bonds.vertices) and len(bonds) > 4
  for k in range(140):
    mujoco.mj_step(model, data)
    batch.step()
    if k == 40:
      own = mujoco.MjData(batch.model)
      batch.get_state(2, own)
      batch.set_state(1, own)
  assert 0.1 < first.bonds.share_freed < 0.9 and first.bonds.force.any()
  for organ in organs:
    found = batch.organ(organ.name).xpos.numpy()
    np.testing.assert_allclose(found, np.tile(organ.xpos, (3, 1, 1)), atol=2e-6)
  size = np.abs(first.bonds.force).max()
  for k in range(3):
    np.testing.assert_allclose(bonds.damage.numpy()[k], first.bonds.damage, atol=1e-3)
    np.testing.assert_allclose(bonds.force.numpy()[k], first.bonds.force, atol=2e-3 * size)
  np.testing.assert_allclose(bonds.share_freed.numpy(), first.bonds.share_freed, atol=1e-6)
  np.testing.assert_allclose(batch.qpos.numpy()[:, -3:], np.tile(data.qpos[-3:], (3, 1)), atol=1e-6)


def test_worlds_are_weakened_and_healed_alone(make):
  batch = make(3)
  bonds = batch.organ("globe").bonds
  amount = np.zeros((3, len(bonds)))
  amount[1], amount[2, 0] = 2.0, 0.5
  bonds.weaken(amount)
  assert bonds.share_freed.numpy().tolist() == [0, 1, 0]
  assert bonds.damage.numpy()[:, 0].tolist() == [0, 1, 0.5]
  batch.step(3)
  force = np.abs(bonds.force.numpy()).max(axis=(1, 2))
  assert force[0] > 0 and force[1] == 0 and force[2] > 0
  own = mujoco.MjData(batch.model)
  batch.get_state(1, own)
  assert palpate.Organ(batch.model, own, "globe").bonds.share_freed == 1.0
  batch.reset(np.array([False, True, False]))
  assert bonds.share_freed.numpy().tolist() == [0, 0, 0] and bonds.damage.numpy()[2, 0] == 0.5
  batch.start(own)
  batch.reset(np.array([True, False, False]))
  assert bonds.share_freed.numpy().tolist() == [1, 0, 0]
  with pytest.raises(ValueError, match=r"amount has shape \(2,\), expected \(3, "):
    bonds.weaken(np.zeros(2))
  none = batch.organ("two").bonds
  assert not len(none) and not none.share_freed.numpy().any()


def holding():
  """Returns what `scene` has, with room for cuts, and a block that rests on the ball."""
  points, elem = sphere(2)
  block, blocks = box((0.04, 0.04, 0.02), 0.02)
  on_top = block + np.array([0, 0, points[:, 2].max() - block[:, 2].min() - 1e-4])
  block[:, 2] -= block[:, 2].min()
  side = np.flatnonzero(points[:, 1] > 0.03)
  bonds = "bed 1e6 150 0.02 near 0.015, one 1e6 150 0.02 near 0.015"
  on = {"attach": f"hand 20 {' '.join(map(str, side))}", "bonds": bonds, "support": "bed"}
  on |= {"foundation": 3e2, "carrier": "bed", "relax_share": 0.2, "relax_time": 0.1}
  spec = mujoco.MjSpec.from_string(world(ball(0.3), BODIES, gravity=(5.0, 0, -9.81)))
  keys = {**KEYS, "windows": True, "device": "cpu"}
  given = keys | on | {"mass": 0.1, "spare": 80, "thickness": 2e-3}
  palpate.add_organ(spec, (points, elem), "globe", **given)
  on = {"attach": "globe 30 " + " ".join(map(str, np.flatnonzero(block[:, 0] < 0)))}
  given = keys | on | {"mass": 0.02, "foundation": 1e3, "carrier": "own"}
  palpate.add_organ(spec, (block + np.array([0.0715, 0, -0.01]), blocks), "one", **given)
  given = keys | {"mass": 0.02, "support": "globe"}
  palpate.add_organ(spec, (on_top, blocks), "two", **given)
  return spec


ARC = np.linspace(-0.7, 0.7, 9)
CUTS = [  # through what is tied, bonded, and under what rests
  0.05 * np.stack([np.cos(1.2) + 0 * ARC, np.cos(ARC) * np.sin(1.2), np.sin(ARC)], 1),
  0.05 * np.stack([np.sin(ARC), 0.1 + 0 * ARC, -np.cos(ARC)], 1),
  0.05 * np.stack([np.sin(ARC), 0.1 + 0 * ARC, np.cos(ARC)], 1),
]


@pytest.mark.parametrize("device", BACKENDS)
def test_a_cut_organ_keeps_what_acts_beside_it(device):
  spec = holding()
  options = {} if device == "cpu" else {"nodes": 4}
  batch = palpate.batch.make(spec, 3, device=device, **options)
  model, data = batch.model, mujoco.MjData(batch.model)
  organs = [palpate.Organ(model, data, name) for name in NAMES]
  globe, there = organs[0], batch.organ("globe")
  bonds = there.bonds
  mask = np.array([True, False, True])
  for k in range(50):
    if k in (10, 20, 30):
      path = CUTS[k // 10 - 1]
      report = globe.cut(path)
      assert report.nodes and [r and r.nodes for r in there.cut(path, mask)] == [
        report.nodes, None, report.nodes
      ]  # fmt: skip
    mujoco.mj_step(model, data)
    batch.step()
  freed = globe.bonds.share_freed
  assert len(globe.bonds) > len(bonds) and 0.1 < freed < 0.9 and organs[2].support_force[2] > 0.02
  for organ in organs:
    found = batch.organ(organ.name).xpos.numpy()[:, : organ.nvert]
    np.testing.assert_allclose(found[::2], np.tile(organ.xpos, (2, 1, 1)), atol=2e-6)
    off = np.linalg.norm(found[1] - organ.xpos, axis=1)
    assert organ.name == "two" or np.nanmax(off) > 1e-4
  worst = np.ones(len(bonds))
  np.minimum.at(worst, globe.bonds.made, globe.bonds.damage)
  np.testing.assert_allclose(bonds.damage.numpy()[0], worst, atol=1e-3)
  assert np.array_equal(bonds.damage.numpy()[0], bonds.damage.numpy()[2])
  own = mujoco.MjData(model)
  batch.get_state(2, own)
  batch.set_state(1, own)
  batch.reset(np.array([True, False, False]))
  assert bonds.share_freed.numpy()[0] == 0
  whole = palpate.batch.make(spec, 1, device=device, **options)
  for _ in range(10):
    batch.step()
    whole.step()
  for name in NAMES:
    found = batch.organ(name).xpos.numpy()
    np.testing.assert_allclose(found[1], found[2], atol=1e-6)
    np.testing.assert_allclose(found[0], whole.organ(name).xpos.numpy()[0], atol=1e-7)


def test_windowed_organs_are_taken_out_of_a_scene():
  made = scene()
  model, data, _ = load(made, NAMES[0])
  declared = [workspace(palpate.Organ(model, data, name)).organ for name in NAMES]
  bare, slots = strip_organs.strip(mujoco.MjSpec.from_string(made), model, declared, [5, 6, 7], [])
  assert bare.nplugin == 0 and bare.nflex == 3 and [each.nslot for each in slots] == [5, 6, 7]


@pytest.mark.parametrize("device", BACKENDS)
def test_an_organ_rests_on_another(device):
  points, elem = sphere(1)
  block, blocks = box((0.04, 0.04, 0.02), 0.02)
  block[:, 2] += points[:, 2].max() - block[:, 2].min() - 0.002
  made = world(
    windowed(points, elem, "low", "w0", "4 3 1", **KEYS | {"foundation": 2e3}),
    windowed(block, blocks, "high", "w1", "4 3 1", **KEYS | {"mass": 0.02, "support": "low"}),
    ball(1.0), gravity=(0, 0, -9.81),
  )  # fmt: skip
  model, data, high = load(made, "high")
  low = palpate.Organ(model, data, "low")
  options = {} if device == "cpu" else {"nodes": 4}
  batch = palpate.batch.make(mujoco.MjSpec.from_string(made), 2, device=device, **options)
  mujoco.mj_step(model, data, 200)
  batch.step(200)
  assert high.support_force[2] > 0.1  # of 0.2 N
  for organ in (low, high):
    found = batch.organ(organ.name).xpos.numpy()
    np.testing.assert_allclose(found, np.tile(organ.xpos, (2, 1, 1)), atol=2e-6)


@pytest.mark.parametrize("device", BACKENDS)
def test_a_force_that_is_applied_to_a_vertex_moves_it_as_the_plugin_does(device):
  points, elem = sphere(1)
  made = world(documents.organ(points, elem, **KEYS | {"foundation": 2e3}), ball(1.0))
  model, data, single = load(made)
  batch = palpate.batch.make(mujoco.MjSpec.from_string(made), 2, device=device)
  tissue, top = batch.organ("organ"), int(points[:, 2].argmax())
  rest, force = tissue.xpos.numpy()[0], np.zeros((2, len(points), 3), np.float32)
  force[1, top] = 0.05, 0.0, 0.1
  tissue.applied.assign(force)
  data.xfrc_applied[model.flex_vertbodyid[top], :3] = force[1, top]
  batch.step(100)
  mujoco.mj_step(model, data, 100)
  found = tissue.xpos.numpy()
  assert np.linalg.norm(found[1, top] - rest[top]) > 1e-4
  np.testing.assert_allclose(found[1], single.xpos, atol=2e-6)
  np.testing.assert_allclose(found[0], rest, atol=1e-6)
  batch.reset(np.array([False, True]))
  batch.step(5)
  np.testing.assert_allclose(tissue.xpos.numpy(), [rest, rest], atol=1e-6)
