"""States and models: what is saved, copied, reloaded or compiled again moves alike."""

import copy
import gc
import pickle

import mujoco
import numpy as np
import palpate
import pytest
from mujoco import rollout
from palpate import screen
from palpate.engine import plugin as engine

GRAVITY = (0, 0, -9.81)
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


# Repetition and state.


def test_runs_repeat_to_the_bit(scenes, device):
  motion = []
  for _ in range(2):
    model, data, _ = scenes.load(scenes.press(bulk=1e4, device=device))
    motion.append(scenes.run(model, data, 120, record=True))
  np.testing.assert_array_equal(motion[1], motion[0])


def test_forward_twice_changes_nothing(scenes, device):
  plain = scenes.load(scenes.press(device=device))
  extra = scenes.load(scenes.press(device=device))
  motion = [scenes.run(plain[0], plain[1], 100, record=True)]
  out = []
  for _ in range(100):
    extra[1].ctrl[0] = -min(0.1 * extra[1].time, 0.008)
    mujoco.mj_forward(extra[0], extra[1])
    before = scenes.state(extra[0], extra[1])
    mujoco.mj_forward(extra[0], extra[1])
    np.testing.assert_array_equal(scenes.state(extra[0], extra[1]), before)
    out.append(scenes.run(extra[0], extra[1], 1, record=True)[0])
  # The constraint solver starts elsewhere after an extra forward: rounding of its tolerance.
  np.testing.assert_allclose(out, motion[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("restore", ["setState", "copyData", "copy", "resetData", "keyframe"])
def test_a_restored_state_gives_the_same_motion_to_the_bit(scenes, restore):
  model, data, organ = scenes.load(scenes.press(bulk=1e4))
  start = 0 if restore == "resetData" else 80
  scenes.run(model, data, start)
  other = mujoco.MjData(model)
  if restore == "setState":
    scenes.run(model, other, 13)
    mujoco.mj_setState(model, other, scenes.state(model, data), STATE)
  elif restore == "copyData":
    mujoco.mj_copyData(other, model, data)
  elif restore == "copy":
    other = copy.copy(data)
  elif restore == "resetData":
    scenes.run(model, other, 60)
    mujoco.mj_resetData(model, other)
  else:
    spec = mujoco.MjSpec.from_string(scenes.press(bulk=1e4))
    spec.add_key(name="pressed", qpos=data.qpos, qvel=data.qvel, ctrl=data.ctrl, time=data.time)
    model = spec.compile()
    # A keyframe has no contact force: two data restored from it are alike, whatever came before.
    data, other = mujoco.MjData(model), mujoco.MjData(model)
    scenes.run(model, other, 60)
    for d in (data, other):
      mujoco.mj_resetDataKeyframe(model, d, 0)
    assert data.time == pytest.approx(0.08)
  expected = scenes.run(model, data, 60, record=True)
  np.testing.assert_array_equal(scenes.run(model, other, 60, record=True), expected)
  assert organ.error is None


def test_rollout_with_threads_is_the_same_as_without(scenes):
  model, data, _ = scenes.load(scenes.press())
  scenes.run(model, data, 60)
  full = mujoco.mjtState.mjSTATE_FULLPHYSICS
  start = np.empty(mujoco.mj_stateSize(model, full))
  mujoco.mj_getState(model, data, start, full)
  control = np.linspace(-0.01, 0, 6)[:, None, None] * np.ones((6, 40, 1))
  found = {}
  for threads in (1, 3):
    datas = [mujoco.MjData(model) for _ in range(threads)]
    with rollout.Rollout(nthread=threads) as run:
      found[threads], _ = run.rollout(model, datas, np.tile(start, (6, 1)), control)
  assert np.ptp(found[1][:, -1, -1]) > 0 or np.ptp(found[1][:, -1]) > 1e-4
  np.testing.assert_array_equal(found[3], found[1])


# Models.


def test_a_copied_model_moves_alike(scenes):
  model, *_ = scenes.load(scenes.press())
  expected = scenes.motion(model)
  np.testing.assert_array_equal(scenes.motion(copy.copy(model)), expected)
  np.testing.assert_array_equal(scenes.motion(copy.deepcopy(model)), expected)


def test_a_data_used_with_another_copy_of_its_model_follows_that_model(scenes):
  model, data, organ = scenes.load(scenes.world(scenes.organ(*scenes.sphere(1)), gravity=GRAVITY))
  scenes.run(model, data, 5)
  other = copy.copy(model)
  other.opt.gravity[:] = 0
  before = organ.xvel
  scenes.run(other, data, 5)
  np.testing.assert_allclose(organ.xvel, before, atol=1e-5)  # with gravity: 0.05


def test_a_binary_model_reloads(scenes, tmp_path):
  model, *_ = scenes.load(scenes.press())
  path = str(tmp_path / "press.mjb")
  mujoco.mj_saveModel(model, path, None)
  again = mujoco.MjModel.from_binary_path(path)
  np.testing.assert_array_equal(scenes.motion(again), scenes.motion(model))


def test_a_specification_compiles_recompiles_and_saves(scenes, tmp_path):
  spec = mujoco.MjSpec.from_string(scenes.press())
  model = spec.compile()
  expected = scenes.motion(mujoco.MjModel.from_xml_string(scenes.press()))
  np.testing.assert_array_equal(scenes.motion(model), expected)
  np.testing.assert_array_equal(scenes.motion(spec.compile()), expected)
  data = mujoco.MjData(model)
  scenes.run(model, data, 20)
  model, data = spec.recompile(model, data)
  assert data.time == pytest.approx(0.02)
  scenes.run(model, data, 20)
  assert palpate.Organ(model, data, "organ").error is None
  path = tmp_path / "press.xml"
  path.write_text(spec.to_xml())
  # Saved text has fewer digits.
  reloaded = scenes.motion(mujoco.MjModel.from_xml_path(str(path)))
  np.testing.assert_allclose(reloaded, expected, atol=1e-2 * np.abs(expected).max())


def test_an_organ_attached_with_a_prefix(scenes):
  organ = scenes.organ(*scenes.sphere(1), foundation=1e5)
  child = mujoco.MjSpec.from_string(scenes.world(organ, gravity=GRAVITY))
  parent = mujoco.MjSpec.from_string(scenes.world(gravity=GRAVITY))
  frame = parent.worldbody.add_frame(pos=[0.1, 0.2, 0.3], euler=[0.3, 0, 0])
  parent.attach(child, prefix="left/", frame=frame)
  model, data, organ = scenes.load(parent, "left/organ")
  scenes.run(model, data, 300)
  assert organ.displacement.std(axis=0).max() < 1e-3
  assert 1e-6 < np.abs(organ.displacement).max() < 0.05
  np.testing.assert_allclose(organ.xpos.mean(axis=0)[:2], [0.1, 0.2], atol=1e-3)


def test_dm_control_physics_copies_and_resets(scenes):
  screen.import_dm_control()
  dm_mujoco = pytest.importorskip("dm_control.mujoco", reason="dm_control is not installed")
  physics = dm_mujoco.Physics.from_xml_string(scenes.press())

  def motion(of, steps=60):
    out = []
    for _ in range(steps):
      of.set_control([-0.008])
      of.step()
      out.append(of.data.qpos.copy())
    return np.array(out)

  expected = motion(physics)
  with physics.reset_context():
    pass
  np.testing.assert_array_equal(motion(physics), expected)
  twins = [physics.copy(share_model=share) for share in (True, False)]
  moved = [motion(twin) for twin in twins]
  np.testing.assert_array_equal(moved[1], moved[0])
  # dm_control calls mj_forward on a copy: the contact solver starts elsewhere.
  np.testing.assert_allclose(moved[0], motion(physics), atol=2e-5)
  with physics.reset_context():
    pass
  start = physics.get_state()
  first = motion(physics)
  with physics.reset_context():
    physics.set_state(start)
  np.testing.assert_array_equal(motion(physics), first)


def test_deleted_data_and_models_leave_no_workspace(scenes):
  gc.collect()
  before = engine.count()
  for _ in range(2):
    model = mujoco.MjModel.from_xml_string(scenes.press(subdivisions=1))
    datas = [mujoco.MjData(model) for _ in range(3)]
    mujoco.mj_step(model, datas[0])
    twin = copy.copy(datas[0])
    mujoco.mj_copyData(twin, model, datas[1])
    assert engine.count() == before + 4
    del model, datas, twin
    gc.collect()
    assert engine.count() == before


@pytest.mark.parametrize("window", [False, True])
def test_a_pickle_goes_on_to_the_bit_and_has_a_life_of_its_own(scenes, window):
  model = mujoco.MjModel.from_xml_string(scenes.probed(window))
  data = mujoco.MjData(model)
  for k in range(60):
    data.ctrl[:] = -1e-4 * k
    mujoco.mj_step(model, data)
  assert data.ncon
  twin = pickle.loads(pickle.dumps(data))
  for _ in range(20):
    mujoco.mj_step(model, data)
    mujoco.mj_step(twin.model, twin)
  for field in ("qpos", "qvel", "plugin_state", "sensordata", "qfrc_constraint"):
    np.testing.assert_array_equal(getattr(twin, field), getattr(data, field), err_msg=field)
  # A reset is of one of them alone.
  organ, other = (palpate.Organ(d.model, d, "organ") for d in (data, twin))
  for d in (data, twin):
    d.plugin_state[:] = np.nan
    mujoco.mj_step(d.model, d)
  assert organ.error and other.error
  mujoco.mj_resetData(twin.model, twin)
  assert organ.error and not other.error
