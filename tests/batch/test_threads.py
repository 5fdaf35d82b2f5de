"""Threads in batches: as under the plugin, on what does not move and on what hangs on them."""

import mujoco
import numpy as np
import palpate
import palpate.batch
import pytest
from devices import needs_cuda
from scenes import rods as one
from scenes import threads

DEVICES = ["warp-cpu", pytest.param("cuda:0", marks=needs_cuda)]


def scene(made, device: str, nworld: int = 2):
  """Returns a model, its data, its thread, and a batch of it."""
  spec = made if isinstance(made, mujoco.MjSpec) else mujoco.MjSpec.from_string(made)
  worlds = palpate.batch.make(spec, nworld, device)
  model = spec.compile()
  data = mujoco.MjData(model)
  return model, data, palpate.Thread(model, data, "t"), worlds


def load(model, data, worlds, node: int, force):
  """Applies a force to a node, in the plugin and in all worlds."""
  one.force(model, data, node, force)
  adr = worlds.bare.body(f"t_{node}").dofadr[0]
  applied = worlds.d.qfrc_applied.numpy()
  applied[:, adr : adr + 3] = force
  worlds.d.qfrc_applied.assign(applied)


def run(model, data, worlds, steps: int, ctrl=lambda k: 0.0):
  for k in range(steps):
    if model.nu:
      data.ctrl[:] = ctrl(k)
      worlds.ctrl = np.full(worlds.ctrl.shape, ctrl(k))
    mujoco.mj_step(model, data)
    worlds.step()


def off(thread, worlds) -> float:
  """Returns how far a thread's nodes are from those of the plugin's in any world [m]."""
  return float(np.abs(worlds.thread("t").xpos.numpy() - thread.positions).max())


SLOW = pytest.mark.slow


@pytest.mark.parametrize("device", DEVICES)
def test_a_hanging_thread_swings_as_under_the_plugin(device):
  model, data, thread, worlds = scene(one.document(one.line(21, 0.04), pin=(0,), drag=1e-3), device)
  run(model, data, worlds, 60)
  assert off(thread, worlds) < 1e-7
  assert np.abs(data.qvel).max() > 0.5
  np.testing.assert_allclose(worlds.qpos.numpy()[1], data.qpos, atol=1e-7)


@SLOW
@pytest.mark.parametrize("device", DEVICES)
def test_a_pulled_thread_stretches_by_hooke(device):
  text = one.document(one.line(31, 0.06), pin=(0,), h=0.01, option=one.FREE)
  model, data, _, worlds = scene(text, device)
  load(model, data, worlds, 30, (1.0, 0, 0))
  run(model, data, worlds, 60)
  np.testing.assert_allclose(worlds.thread("t").tension.numpy(), 1.0, rtol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
  ("cone", "kind"), [("elliptic", "capsule"), pytest.param("pyramidal", "cylinder", marks=SLOW)]
)
def test_a_thread_around_a_drum_obeys_the_capstan_law(device, cone, kind):
  text = one.drum(0.3, cone, kind)
  model, data, thread, worlds = scene(text, device)
  load(model, data, worlds, 0, (0, 0, -0.1))
  run(model, data, worlds, 120, lambda k: 0.01 * min(1.0, k / 30))
  tension = worlds.thread("t").tension.numpy()
  np.testing.assert_allclose(tension[:, -1] / tension[:, 0], np.exp(0.3 * np.pi), rtol=0.03)
  assert off(thread, worlds) < 2e-5  # it has slid by 1 mm


@pytest.mark.parametrize("device", DEVICES)
def test_a_thread_lies_on_a_thin_jaw_with_all_its_edges(device):
  """They are 0.2 mm long; mujoco_warp keeps one contact a millimetre."""
  model, data, thread, worlds = scene(one.drum(0.3, "elliptic", "capsule", radius=0.002), device)
  load(model, data, worlds, 0, (0, 0, -0.1))
  run(model, data, worlds, 60, lambda k: 0.01 * min(1.0, k / 30))
  tension = worlds.thread("t").tension.numpy()
  np.testing.assert_allclose(tension[:, -1] / tension[:, 0], np.exp(0.3 * np.pi), rtol=0.03)
  assert off(thread, worlds) < 2e-5  # it has slid by 0.45 mm


@pytest.mark.parametrize("device", DEVICES)
def test_a_thread_over_an_organ_is_borne_by_it(device):
  """Its weight and two loads are the organ's contact force.

  By MuJoCo's own tolerance its normals of edges on triangles are up to 1.5 degrees off, which
  swings the ends by 0.2 to 1.2 mm.
  """
  spec = one.draped()
  spec.option.ccd_tolerance, spec.option.ccd_iterations = 1e-9, 200
  model, data, thread, worlds = scene(spec, device)
  for end in (0, 56):
    load(model, data, worlds, end, (0, 0, -0.01))
  run(model, data, worlds, 30)
  weight = 0.02 + 9.81 * model.body("t_0").mass[0] * 57
  organ, alone = worlds.organ("ball"), palpate.Organ(model, data, "ball")
  force = organ.contact_force.numpy()[:, :, 2].sum(axis=1)
  np.testing.assert_allclose(force, -weight, rtol=0.01)
  assert np.abs(organ.xpos.numpy() - alone.xpos[: organ.nvert]).max() < 2e-5  # dented by 0.8 mm
  assert off(thread, worlds) < 2e-4  # of its ends, which swing
  assert not worlds.overflow.numpy().any()
  there = mujoco.MjData(model)
  worlds.get_state(0, there)
  worlds.set_state(1, there)
  worlds.step(2)
  first, second = worlds.thread("t").xpos.numpy()
  # With what force the thread pressed on which vertex is not in a state.
  np.testing.assert_allclose(first, second, atol=1e-4)


@SLOW
@pytest.mark.parametrize("device", DEVICES)
def test_a_needle_swings_on_its_thread(device):
  model, data, thread, worlds = scene(one.needle(1e-3), device)
  for _ in range(4):
    run(model, data, worlds, 40)
    assert off(thread, worlds) < 2e-5
  np.testing.assert_allclose(worlds.qpos.numpy()[0], data.qpos, atol=1e-4)


@SLOW
@pytest.mark.parametrize("device", DEVICES)
def test_a_held_thread_does_not_meet_the_jaws_that_it_is_in(device):
  model, data, thread, worlds = scene(one.hand(), device)
  run(model, data, worlds, 10, one.shake)
  assert off(thread, worlds) < 1e-8
  run(model, data, worlds, 50, one.shake)  # the tails meet the edges of the jaws
  held = worlds.thread("t").xpos.numpy()[:, 20] - thread.positions[20]
  assert np.abs(held).max() < 1e-5
  assert worlds.thread("t").tension.numpy().max() < 0.1


@pytest.mark.parametrize("device", ["cpu", *DEVICES])
def test_each_world_holds_the_thread_where_it_says(device):
  """A hand takes it at another node in each world, one at none, and lets go of it, as in one."""
  nodes, anchor, text = np.array([20, 12, -1, 25]), (0.0, 0.0005, 0.0), one.hand(held=False)
  alone = [one.loaded(text) for _ in nodes]
  worlds = palpate.batch.make(mujoco.MjSpec.from_string(text), len(nodes), device)
  # In the plane of the jaws' faces a loose hold keeps the thread from meeting these.
  for firm, which, steps in ((True, nodes, 40), (False, nodes, 10), (True, 0 * nodes - 1, 20)):
    given = which, np.tile(anchor, (len(nodes), 1)), np.full(len(nodes), firm)
    worlds.thread("t").hold("grip", *given)
    for (_, _, thread), *each in zip(alone, *given, strict=True):
      thread.hold("grip", *each)
    for k in range(steps):
      ctrl = 3.0 * np.sign(np.sin(0.1 * k)), 0.0, 0.0
      worlds.ctrl = np.tile(ctrl, (len(nodes), 1))
      worlds.step()
      for model, data, _ in alone:
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data)
    places = [thread.positions for _, _, thread in alone]
    np.testing.assert_allclose(worlds.thread("t").xpos.numpy(), places, atol=1e-5)
    if firm and which is nodes:  # it went along with the hand
      hands = np.array([data.qpos[0] for _, data, _ in alone])
      off = np.array(places)[range(len(nodes)), nodes, 1] - hands
      np.testing.assert_allclose(off[nodes >= 0], anchor[1], atol=2e-5)
      assert np.abs(hands).min() > 4e-4
  assert np.ptp([place[20, 1] for place in places]) > 1e-3
  worlds.thread("t").hold("grip", *given)
  worlds.reset()
  worlds.step(10)
  assert np.abs(worlds.thread("t").xpos.numpy()[:, :, 1]).max() < 1e-6


@pytest.mark.parametrize("device", ["cpu", *DEVICES])
def test_worlds_begin_with_a_thread_that_is_laid(device):
  """One along an arc, from which it springs back as in one world; the other one stays."""
  text = one.document(one.line(21, 0.04), option=one.FREE, bend=1.0, drag=1e-3)
  model, data, thread, worlds = scene(text, device)
  angle = np.linspace(0.0, 1.5, 200)
  thread.lay(0.03 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
  places = np.stack([thread.positions, 0 * thread.positions])
  worlds.thread("t").lay(places, np.array([True, False]))
  mujoco.mj_step(model, data, 20)
  worlds.step(20)
  found = worlds.thread("t").xpos.numpy()
  np.testing.assert_allclose(found[0], thread.positions, atol=1e-6)
  assert np.abs(thread.positions - places[0]).max() > 1e-4
  np.testing.assert_allclose(found[1], one.line(21, 0.04), atol=1e-7)


def test_what_cannot_hold_a_thread_is_named():
  given = np.zeros(2, int), np.zeros((2, 3)), np.ones(2, bool)
  for held, names in ((True, "none"), (False, "'grip'")):
    text = one.hand(held=held)
    worlds = palpate.batch.make(mujoco.MjSpec.from_string(text), 2, "cpu")
    what = f"'nail' cannot hold it, .*; the scene has {names}"
    with pytest.raises(ValueError, match=what):
      worlds.thread("t").hold("nail", *given)
    with pytest.raises(ValueError, match=what):
      one.loaded(text)[2].hold("nail", 0)
  with pytest.raises(ValueError, match=r"node is 41, expected one in \[-1, 41\)"):
    one.loaded(text)[2].hold("grip", 41)
  with pytest.raises(ValueError, match=r"anchor has shape \(2,\), expected \(2, 3\)"):
    worlds.thread("t").hold("grip", given[0], given[0], given[2])


@pytest.mark.parametrize("device", DEVICES)
def test_a_body_on_a_thread_rests_on_a_table_as_under_the_plugin(device):
  world = """<geom type="plane" size="1 1 1" pos="0 0 -0.0101"/><body name="box"><freejoint/>
    <geom type="box" size="0.004 0.004 0.01" mass="0.01"/></body>"""
  after = '<equality><connect body1="box" body2="t_0" anchor="0 0 0"/></equality>'
  line, unmet = one.line(11, 0.02), 'contype="0" conaffinity="0"'
  text = one.document(line, pin=(10,), world=world, after=after, contact=unmet)
  model, data, _, worlds = scene(text, device)
  run(model, data, worlds, 100)
  assert data.body("box").xpos[2] == pytest.approx(-1e-4, abs=2e-4)
  np.testing.assert_allclose(worlds.qpos.numpy()[1], data.qpos, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_a_world_goes_on_where_a_state_says(device):
  """There and back, and after a reset."""
  model, data, thread, worlds = scene(one.needle(1e-3), device)
  one.run(model, data, 30)
  worlds.set_state(1, data)
  run(model, data, worlds, 20)
  there = worlds.thread("t").xpos.numpy()
  assert np.abs(there[1] - thread.positions).max() < 1e-5
  assert np.abs(there[0] - there[1]).max() > 1e-3
  other = mujoco.MjData(model)
  worlds.get_state(1, other)
  one.run(model, other, 20)
  run(model, data, worlds, 20)
  twin = palpate.Thread(model, other, "t")
  assert np.abs(twin.positions - thread.positions).max() < 1e-5
  worlds.reset(np.array([True, False]))
  worlds.step(50)
  assert np.abs(worlds.thread("t").xpos.numpy()[0] - there[0]).max() < 0.1
  fresh = mujoco.MjData(model)
  mujoco.mj_resetData(model, fresh)
  one.run(model, fresh, 50)
  expected = palpate.Thread(model, fresh, "t").positions
  assert np.abs(worlds.thread("t").xpos.numpy()[0] - expected).max() < 1e-5


@pytest.mark.parametrize("device", ["cpu", *DEVICES])
def test_nodes_move_along_a_thread_as_in_one_world(device):
  """From a state in which a knot tightens; tension by the edges' present lengths, and a reset."""
  points = threads.overhand(0.0012, 8 * threads.RADIUS, 0.008)
  spec = mujoco.MjSpec()
  spec.option.gravity = (0, 0, 0)
  palpate.add_thread(spec, points, "t", refine=2.5 * threads.RADIUS)
  way = points[-1] - points[0]
  threads.add_hands(spec, "t", points, ((0, -way), (len(points) - 1, way)), 2.0)
  model, data, thread, worlds = scene(spec, device)
  run(model, data, worlds, 60, lambda k: min(0.3, 0.01 * k))
  worlds.set_state(1, data)
  before = thread.rest_lengths
  run(model, data, worlds, 10, lambda k: 0.3)
  assert np.abs(thread.rest_lengths - before).max() > 1e-5
  assert np.abs(worlds.thread("t").xpos.numpy()[1] - thread.positions).max() < 1e-6
  np.testing.assert_allclose(worlds.thread("t").tension.numpy()[1], thread.tension, atol=1e-3)
  other = mujoco.MjData(model)
  worlds.get_state(1, other)
  found = palpate.Thread(model, other, "t").rest_lengths
  np.testing.assert_allclose(found, thread.rest_lengths, atol=1e-7)
  worlds.reset()
  worlds.get_state(1, other)
  lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
  np.testing.assert_allclose(palpate.Thread(model, other, "t").rest_lengths, lengths, rtol=1e-12)


@pytest.mark.parametrize("device", DEVICES)
def test_a_thread_keeps_its_bends_as_under_the_plugin(device):
  """It swings on a peg; its state goes from world to world by an mjData, and a reset forgets it."""
  peg = '<geom type="capsule" size=".002 .02" pos=".012 0 -.01" euler="90 0 0"/>'
  text = one.document(one.line(31, 0.03), pin=(0, 1), world=peg, bend=0.05, yield_strain=5e-4)
  model, data, thread, worlds = scene(text, device)
  load(model, data, worlds, 30, (0, 1e-4, -1e-3))
  run(model, data, worlds, 100)
  rest = thread.rest_curvature
  assert np.linalg.norm(rest, axis=1).max() > 0.05
  assert off(thread, worlds) < 2e-5
  other = mujoco.MjData(model)
  worlds.get_state(1, other)
  np.testing.assert_allclose(palpate.Thread(model, other, "t").rest_curvature, rest, atol=1e-3)
  worlds.set_state(0, other)
  worlds.step(10)
  first, second = worlds.thread("t").xpos.numpy()
  np.testing.assert_array_equal(first, second)
  worlds.thread("t").lay(np.tile(one.line(31, 0.03), (2, 1, 1)), np.array([True, False]))
  for world, kept in ((0, False), (1, True)):
    worlds.get_state(world, other)
    assert palpate.Thread(model, other, "t").rest_curvature.any() == kept
  worlds.reset()
  worlds.get_state(1, other)
  assert not palpate.Thread(model, other, "t").rest_curvature.any()


@pytest.mark.parametrize("device", DEVICES)
def test_a_thread_that_is_torn_apart_is_reset(device):
  _, _, _, worlds = scene(one.document(one.line(11, 0.02), pin=(0,)), device)
  worlds.step(5)
  applied = worlds.d.qfrc_applied.numpy()
  applied[1, 3] = np.nan
  worlds.d.qfrc_applied.assign(applied)
  worlds.step(2)
  assert worlds.failures.numpy().tolist() == [0, 1]
  assert np.isfinite(worlds.thread("t").xpos.numpy()).all()


def test_threads_of_a_batch_are_named():
  worlds = palpate.batch.make(mujoco.MjSpec.from_string(one.document(one.line(5, 0.01))), 2)
  with pytest.raises(ValueError, match="no thread 'u' in the batch, it has 't'"):
    worlds.thread("u")
  assert worlds.thread("t").xpos.numpy().shape == (2, 5, 3)


@pytest.mark.parametrize("device", DEVICES)
def test_a_ball_falls_through_a_thread_that_it_breaks(device):
  world = '<body name="ball" pos=".021 0 .0022"><freejoint/><geom size=".002" mass=".002"/></body>'
  text = one.document(one.line(21, 0.04), pin=(0, 20), world=world, strength=0.05)
  model, data, thread, worlds = scene(text, device)
  run(model, data, worlds, 150)
  broken = worlds.thread("t").broken.numpy()[:, :-1]
  np.testing.assert_array_equal(broken, np.tile(thread.broken, (2, 1)))
  assert broken.sum() == 2
  height = model.jnt_qposadr[model.body("ball").jntadr[0]] + 2
  assert (worlds.qpos.numpy()[:, height] < -0.05).all()
  worlds.reset()
  assert not worlds.thread("t").broken.numpy().any()
