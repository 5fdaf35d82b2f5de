"""Sleep of windowed organs, and motions that stay on the device."""

import copy

import mujoco
import numpy as np
import palpate
import palpate.models
import pytest
import warp as wp
from palpate.engine import plugin as engine
from palpate.engine.layout import TAIL
from scenes import drive, load, probed, slot_bodies, slots, workspace

STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def make(device="cpu", resident=False, **more):
  keys = {"device": device, "resident": str(resident).lower(), **more}
  return load(probed(keys=keys))


def get_state(m, d) -> np.ndarray:
  state = np.empty(mujoco.mj_stateSize(m, STATE))
  mujoco.mj_getState(m, d, state, STATE)
  return state


def test_resident_motion_is_the_same(device):
  m, d, organ = make(device)
  expected = drive(m, d, 170)
  m, d, resident = make(device, resident=True)
  np.testing.assert_allclose(drive(m, d, 170), expected, atol=1e-6 * np.abs(expected).max())
  np.testing.assert_allclose(resident.xpos, organ.xpos, atol=1e-8)
  np.testing.assert_allclose(resident.xvel, organ.xvel, atol=1e-6)
  assert organ.error is None and resident.error is None


def test_looking_at_a_resident_motion_changes_nothing(device):
  m, d, organ = make(device, resident=True)
  expected = drive(m, d, 120)
  m, d, organ = make(device, resident=True)
  forces = []
  for _ in range(12):
    forces.append(drive(m, d, 10))
    assert np.abs(organ.displacement).max() < 0.01
  np.testing.assert_array_equal(np.concatenate(forces), expected)


def test_synced_resident_state_restores_to_the_bit(device):
  m, d, organ = make(device, resident=True)
  drive(m, d, 100)
  organ.sync()
  state = get_state(m, d)
  expected = drive(m, d, 50)
  mujoco.mj_resetData(m, d)
  drive(m, d, 20)
  mujoco.mj_setState(m, d, state, STATE)
  np.testing.assert_array_equal(drive(m, d, 50), expected)
  organ.sync()
  m2 = copy.copy(m)
  d2 = mujoco.MjData(m2)
  mujoco.mj_copyData(d2, m2, d)
  np.testing.assert_array_equal(drive(m2, d2, 30), drive(m, d, 30))


def test_state_saved_without_sync_is_refused(device):
  m, d, organ = make(device, resident=True)
  drive(m, d, 50)
  state = get_state(m, d)
  drive(m, d, 5)
  mujoco.mj_setState(m, d, state, STATE)
  mujoco.mj_step(m, d)
  assert "sync()" in organ.error
  mujoco.mj_resetData(m, d)
  drive(m, d, 5)
  assert organ.error is None


def test_resident_reset_and_set_state(device):
  m, d, organ = make(device, resident=True)
  expected = drive(m, d, 100)
  mujoco.mj_resetData(m, d)
  assert np.abs(organ.displacement).max() == 0.0
  np.testing.assert_array_equal(drive(m, d, 100), expected)
  organ.set_state(xpos=organ.xpos0 + 0.001)
  np.testing.assert_allclose(organ.xpos, organ.xpos0 + 0.001, atol=1e-12)
  d.ctrl[0] = 0.05
  mujoco.mj_step(m, d)
  assert 1e-4 < np.abs(organ.displacement).max() < 2e-3
  before = organ.displacement
  organ.configure(tolerance="1e-5")
  np.testing.assert_array_equal(organ.displacement, before)
  drive(m, d, 20)
  assert organ.error is None


def test_what_changes_between_steps_counts_at_once(device):
  def run(resident):
    m, d, organ = make(device, resident=resident)
    forces = [drive(m, d, 60)]
    body = m.body("window_12").id
    for force, gravity, timestep in ((0.02, 0.0, 1.0), (0.0, -3.0, 1.0), (0.0, -3.0, 0.5)):
      d.xfrc_applied[body, 2] = force
      m.opt.gravity[2] = gravity
      m.opt.timestep = 1e-3 * timestep
      forces.append(drive(m, d, 15))
    assert organ.error is None
    return np.concatenate(forces), organ.xpos

  (expected, shape), (forces, found) = run(False), run(True)
  np.testing.assert_allclose(forces, expected, atol=1e-6 * np.abs(expected).max())
  np.testing.assert_allclose(found, shape, atol=1e-8)


def test_steps_are_begun_ahead_unless_what_acts_changes(device, monkeypatch):
  m, d, _ = make(device, resident=True)
  resident = engine.find(d._address, 0).graphs.resident
  original, left = resident.left_to_do, []

  def left_to_do(solve):
    left.append(original(solve) is resident.rest)
    return original(solve)

  monkeypatch.setattr(resident, "left_to_do", left_to_do)
  drive(m, d, 100)
  assert sum(left) >= 97  # all but the first ones
  left.clear()
  body = m.body("window_12").id
  for step in range(20):  # a force that never is what it was
    d.xfrc_applied[body, 2] = 1e-3 * step
    drive(m, d, 1)
  assert sum(left) <= 1


def test_forward_between_steps_changes_nothing(device):
  m, d, organ = make(device, resident=True)
  expected = drive(m, d, 100)
  m, d, organ = make(device, resident=True)
  forces = []
  for step in range(10):
    forces.append(drive(m, d, 10))
    for _ in range(step % 3):
      mujoco.mj_forward(m, d)
  np.testing.assert_array_equal(np.concatenate(forces), expected)
  assert organ.error is None


@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a CUDA device")
def test_search_with_little_room_keeps_the_nearest(monkeypatch):
  m, d, _ = make("cuda:0", resident=True)
  expected = drive(m, d, 120)
  monkeypatch.setattr("palpate.engine.windows.windowed.ROOM", 1)
  m, d, _ = make("cuda:0", resident=True)
  np.testing.assert_allclose(drive(m, d, 120), expected, atol=5e-3 * np.abs(expected).max())


def settle(m, d, organ, seconds=8.0):
  """Steps with the tool away until the organ sleeps."""
  d.ctrl[0] = 0.05
  for _ in range(round(seconds / m.opt.timestep)):
    mujoco.mj_step(m, d)
    if organ.asleep:
      return
  raise AssertionError("the organ does not fall asleep")


@pytest.fixture(params=[False, True])
def at_rest(request):
  m, d, organ = make(resident=request.param)
  m.opt.gravity[2] = -9.81
  drive(m, d, 120)
  settle(m, d, organ)
  return m, d, organ


def test_organ_at_rest_sleeps_and_stays_where_it_is(at_rest):
  m, d, organ = at_rest
  before, quiet = organ.displacement, organ.iterations
  mujoco.mj_step(m, d, nstep=100)
  assert organ.asleep and quiet == 0
  np.testing.assert_array_equal(organ.displacement, before)
  assert np.abs(organ.xvel).max() == 0.0


def test_sleep_changes_nothing_measurable(monkeypatch):
  def run():
    m, d, organ = make()
    m.opt.gravity[2] = -9.81
    first = drive(m, d, 120)
    d.ctrl[0] = 0.05
    slept = 0
    for _ in range(3500):
      mujoco.mj_step(m, d)
      slept += organ.asleep
    at_rest = organ.displacement
    d.time = 0.0
    return slept, np.concatenate([first, drive(m, d, 170)]), at_rest

  slept, force, at_rest = run()
  assert slept > 500
  monkeypatch.setattr("palpate.engine.windows.proxies.SLOW", 0.0)
  never, expected, awake = run()
  assert never == 0
  assert np.abs(at_rest - awake).max() < 1e-7
  assert np.abs(force - expected).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("what", ["tool", "force", "gravity", "parameter", "state"])
def test_sleeping_organ_wakes(at_rest, what):
  m, d, organ = at_rest
  before = organ.displacement
  if what == "tool":
    d.ctrl[0] = -0.008
    mujoco.mj_step(m, d, nstep=300)
    assert np.abs(organ.contact_force).max() > 0.005
  elif what == "force":
    d.xfrc_applied[slot_bodies(organ)[slots(organ) >= 0][0], 2] = 0.01
  elif what == "gravity":
    m.opt.gravity[:] = 9.81, 0, 0
  elif what == "parameter":
    organ.configure(foundation="5e3")
  elif what == "state":
    organ.set_state(xpos=organ.xpos + np.array([0, 0, 0.001]))
  mujoco.mj_step(m, d, nstep=20)
  assert not organ.asleep
  assert np.abs(organ.displacement - before).max() > 1e-6


def test_sleep_is_part_of_the_state():
  m, d, organ = make()
  drive(m, d, 120)
  settle(m, d, organ)
  state = get_state(m, d)
  d.time = 0.0
  expected = drive(m, d, 100)
  mujoco.mj_resetData(m, d)
  drive(m, d, 30)
  mujoco.mj_setState(m, d, state, STATE)
  mujoco.mj_forward(m, d)
  assert organ.asleep
  d.time = 0.0
  np.testing.assert_array_equal(drive(m, d, 100), expected)


SWING = (
  ('<joint name="x" type="slide" axis="1 0 0"/>', '<joint name="x" axis="0 1 0" armature="1e-4"/>'),
  ('<geom name="tip" size="0.006"', '<geom name="tip" type="capsule" size="0.004 0.02"'),
)


def hovering(resident=False, swing=False, flag=""):
  """Returns a sphere under a still tool at 3 mm, or under a capsule that can swing into it."""
  text = probed(keys={"resident": str(resident).lower()}, flag=flag)
  for old, new in SWING if swing else ():
    text = text.replace(old, new)
  m, d, organ = load(text)
  if swing:
    d.qpos[-1] = d.ctrl[1] = np.pi / 2
  d.qpos[-2] = d.ctrl[0] = 0.003
  return m, d, organ


def approach(m, d, organ, steps, joint, to):
  """Moves one joint of the tool evenly; returns its forces, and whether the organ slept."""
  start, forces, slept = d.ctrl[joint], [], []
  for i in range(steps):
    d.ctrl[joint] = start + (to - start) * (i + 1) / steps
    mujoco.mj_step(m, d)
    forces.append(d.qfrc_constraint[-2:].copy())
    slept.append(organ.asleep)
  return np.array(forces), np.array(slept)


def test_liver_sleeps_with_its_tools_in_the_home_pose():
  presses = []
  for flag in (0, int(mujoco.mjtEnableBit.mjENBL_SLEEP)):  # MuJoCo's own sleep off and on
    m = palpate.models.load("liver", coupling="window").compile()
    m.opt.enableflags |= flag
    d = mujoco.MjData(m)
    organ = palpate.Organ(m, d, "liver/liver")
    mujoco.mj_resetDataKeyframe(m, d, 0)
    mujoco.mj_step(m, d, nstep=250)
    assert organ.asleep and organ.nvert == 1000
    assert d.nv_awake == (10 if flag else m.nv)
    d.ctrl[2] = 0.035
    mujoco.mj_step(m, d, nstep=250)
    assert not organ.asleep and np.linalg.norm(organ.force) > 0.1
    presses.append(organ.contact_force)
  np.testing.assert_array_equal(*presses)


@pytest.mark.parametrize("resident", [False, True])
@pytest.mark.parametrize("swing", [False, True])
@pytest.mark.parametrize("steps", [60, 2000])
def test_still_tool_nearby_lets_it_sleep_and_wakes_it_before_it_touches(
  monkeypatch, resident, swing, steps
):
  def press(slow):
    monkeypatch.setattr("palpate.engine.windows.proxies.SLOW", slow)
    m, d, organ = hovering(resident, swing)
    mujoco.mj_step(m, d, nstep=250)
    slept = organ.asleep
    end = 0.4 if swing else -0.008
    return slept, *approach(m, d, organ, steps, int(swing), end)

  slept, force, asleep = press(1e-5 * 0.17)
  never, expected, awake = press(0.0)
  assert slept and not never and not awake.any()
  touches = np.flatnonzero(np.abs(expected).max(axis=1) > 0)
  assert asleep[0] and not asleep[touches[0] - 1 :].any()
  assert np.abs(expected).max() > (1e-3 if swing else 0.01)
  np.testing.assert_allclose(force, expected, atol=1e-6 * np.abs(expected).max())


def test_tool_that_trembles_lets_it_sleep_and_one_that_goes_wakes_it():
  m, d, organ = hovering()
  mujoco.mj_step(m, d, nstep=250)
  for i in range(100):
    d.ctrl[0] = 0.003 + 2e-4 * np.sin(0.3 * i)
    mujoco.mj_step(m, d)
    assert organ.asleep
  d.ctrl[0] = 0.006
  woke = 0
  for _ in range(50):
    mujoco.mj_step(m, d)
    woke += not organ.asleep
  assert 1 <= woke <= 5 and organ.asleep  # a step to look where the tool is; it is at rest still


@pytest.mark.parametrize("height", [0.001, 0.006])
@pytest.mark.parametrize("swing", [False, True])
def test_tool_may_go_half_of_its_distance_from_the_surface(swing, height):
  m, d, organ = hovering(swing=swing)
  d.qpos[-2] = d.ctrl[0] = height
  mujoco.mj_step(m, d, nstep=250)
  assert organ.asleep
  leeway = workspace(organ).graphs.phases.boxes["own"].tail.numpy()[TAIL.leeway]
  n = 60
  a, b = np.array([(i / n, j / n) for i in range(n + 1) for j in range(n + 1 - i)]).T[:, :, None]
  x, y, z = organ.xpos[organ.elem].transpose(1, 0, 2)[:, :, None]
  surface = x + a * (y - x) + b * (z - x)
  tip = m.geom("tip").id
  to = surface.reshape(-1, 3) - d.geom_xpos[tip]
  axis = d.geom_xmat[tip].reshape(3, 3)[:, 2]
  along = np.clip(to @ axis, -0.02, 0.02) if swing else np.zeros(len(to))
  away = np.linalg.norm(to - along[:, None] * axis, axis=1) - m.geom_size[tip, 0]
  gap = away.min() - 0.0005  # the radius of the flex
  # Less than half, by at most half of what the sampling of an edge of 17 mm may miss.
  assert gap / 2 - 0.0004 < leeway < gap / 2


@pytest.mark.parametrize("resident", [False, True])
def test_sleep_near_a_tool_is_part_of_the_state(resident):
  m, d, organ = hovering(resident)
  mujoco.mj_step(m, d, nstep=250)
  approach(m, d, organ, 20, 0, 0.0028)
  assert organ.asleep
  organ.sync()
  state = get_state(m, d)
  expected, slept = approach(m, d, organ, 100, 0, -0.008)
  assert slept[0] and not slept[-1] and np.abs(expected[-1]).max() > 0.01
  mujoco.mj_resetData(m, d)
  drive(m, d, 30)
  mujoco.mj_setState(m, d, state, STATE)
  d.ctrl[:] = 0.0028, 0.0
  force, again = approach(m, d, organ, 100, 0, -0.008)
  np.testing.assert_array_equal(again, slept)
  np.testing.assert_array_equal(force, expected)


MUJOCO_SLEEPS = '<flag sleep="enable"/>'


@pytest.mark.parametrize("resident", [False, True])
@pytest.mark.parametrize("gravity", [0.0, -9.81])
def test_mujoco_skips_the_slots_of_a_sleeping_organ(resident, gravity):
  def press(flag):
    m, d, organ = hovering(resident, flag=flag)
    m.opt.gravity[2] = gravity
    d.ctrl[0] = 0.006
    mujoco.mj_step(m, d, nstep=4000 if gravity else 400)
    assert organ.asleep and m.nv == 164
    return d.nv_awake, *approach(m, d, organ, 80, 0, -0.008), organ.displacement

  everything, expected, slept, there = press("")
  tool, force, again, here = press(MUJOCO_SLEEPS)
  assert (everything, tool) == (164, 2)
  assert slept[0] and not slept[-1] and np.abs(expected).max() > 0.01
  np.testing.assert_array_equal(again, slept)
  np.testing.assert_array_equal(force, expected)
  np.testing.assert_array_equal(here, there)


def test_states_of_an_organ_whose_slots_mujoco_skips():
  m, d, organ = hovering(flag=MUJOCO_SLEEPS)
  awake = get_state(m, d)
  mujoco.mj_step(m, d, nstep=250)
  state = get_state(m, d)
  assert organ.asleep and d.nv_awake == 2
  other = mujoco.MjData(m)  # on the same model, and awake
  mujoco.mj_setState(m, other, awake, STATE)
  other.ctrl[0] = -0.008
  mujoco.mj_step(m, other, nstep=50)
  assert other.nv_awake == m.nv and np.abs(palpate.Organ(m, other, "organ").force).max() > 0.001
  expected, slept = approach(m, d, organ, 100, 0, -0.008)
  assert slept[0] and not slept[-1] and d.nv_awake == m.nv
  mujoco.mj_setState(m, d, state, STATE)
  d.ctrl[:] = 0.003, 0.0
  np.testing.assert_array_equal(approach(m, d, organ, 100, 0, -0.008)[0], expected)


def test_force_on_a_slot_that_mujoco_skips_wakes_the_organ():
  m, d, organ = hovering(flag=MUJOCO_SLEEPS)
  mujoco.mj_step(m, d, nstep=250)
  d.xfrc_applied[slot_bodies(organ)[slots(organ) >= 0][0], 2] = 0.01
  mujoco.mj_step(m, d)
  assert not organ.asleep and d.nv_awake == m.nv
  mujoco.mj_step(m, d, nstep=19)
  assert np.abs(organ.displacement).max() > 1e-6


def test_resident_needs_a_window():
  with pytest.raises(ValueError, match="resident is set, allowed only with window"):
    mujoco.MjModel.from_xml_string(probed(False, keys={"resident": "true"}))
  with pytest.raises(ValueError, match="resident is 'yes', expected 'true' or 'false'"):
    mujoco.MjModel.from_xml_string(probed(keys={"resident": "yes"}))
