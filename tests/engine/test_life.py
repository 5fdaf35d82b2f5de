"""Life cycle: models and data that are copied, freed, reset, edited and saved while organs run."""

import copy
import gc
import re

import mujoco
import numpy as np
import palpate
import pytest
from scenes import drive, load, press, probed, run, sphere, world
from scenes import organ as tissue
from scenes import windowed as windowed_organ

COUPLINGS = pytest.mark.parametrize("windowed", [False, True], ids=["nodal", "window"])
STIFF = {"young": 3e6, "thickness": 0.004, "foundation": 1e4, "tolerance": 1e-6}
FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS


@pytest.fixture
def said():
  """Returns MuJoCo's warnings."""
  lines = []
  mujoco.set_mju_user_warning(lines.append)
  yield lines
  mujoco.set_mju_user_warning(None)


def restore(model, target, source, kind):
  state = np.empty(mujoco.mj_stateSize(model, kind))
  mujoco.mj_getState(model, source, state, kind)
  mujoco.mj_setState(model, target, state, kind)


# Models.


@COUPLINGS
def test_a_model_that_takes_the_address_of_a_freed_one_is_another(windowed):
  m, d, organ = load(probed(windowed))
  expected = drive(m, mujoco.MjData(m), 12)
  seen, again, kept = set(), 0, []
  for _ in range(12):
    mujoco.mj_resetData(m, d)
    twin = copy.copy(m)
    again += twin._address in seen
    seen.add(twin._address)
    np.testing.assert_array_equal(drive(twin, d, 12), expected)
    del twin
    gc.collect()
    kept.append(np.full(m.nbuffer // 8, np.nan))  # where its buffer was
    if again:
      break
  assert again and organ.error is None


@COUPLINGS
def test_a_handle_works_on_its_own_model_when_another_was_freed(windowed):
  m, d, organ = load(probed(windowed))
  for _ in range(3):
    twin = copy.copy(m)
    drive(twin, d, 5)
    del twin
    gc.collect()
    mine = [np.zeros(125_000) for _ in range(20)]
    organ.configure(tolerance=1e-5)
    organ.set_state(xvel=np.full((organ.nvert, 3), 0.01))
    organ.reset()
    assert not any(array.any() for array in mine)
  assert np.isfinite(drive(m, d, 5)).all() and organ.error is None


def test_a_time_integration_that_is_chosen_later_is_checked_too(said):
  m, d, organ = load(press(subdivisions=1))
  run(m, d, 3)
  m.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
  run(m, d, 3)
  assert "integrator is RK4" in organ.error and "integrator is RK4" in said[-1]


@COUPLINGS
def test_a_parent_that_is_moved_later_is_noticed(said, windowed):
  m, d, organ = load(probed(windowed))
  run(m, d, 3)
  m.body("frame").pos = 0.01, 0, 0
  run(m, d, 1)
  assert "body 'frame' was moved" in organ.error if not windowed else "was moved" in organ.error
  fresh = palpate.Organ(m, mujoco.MjData(m), "organ")
  assert fresh.xpos0[:, 0].mean() == pytest.approx(0.01, abs=1e-6)
  run(m, fresh.data, 3)
  assert fresh.error is None


def test_a_closed_surface_that_is_inside_out_is_refused():
  points, elem = sphere(1)
  with pytest.raises(ValueError, match=r"organ 'organ': its surface is inside out.*-0\.0004"):
    load(world(tissue(points, elem[:, ::-1])))
  flat = points * [1, 1, 0]
  with pytest.raises(ValueError, match=r"bulk is 10000, expected 0.*encloses no volume|degenerate"):
    load(world(tissue(flat, elem, bulk=1e4)))


# Data.


@COUPLINGS
def test_a_copy_of_data_has_the_keys_that_were_changed(windowed):
  m, d, organ = load(probed(windowed))
  organ.configure(foundation=3e4, tolerance=1e-5)
  drive(m, d, 60)
  twin = palpate.Organ(m, copy.copy(d), "organ")
  assert twin.config == organ.config
  ahead = drive(m, d, 60)
  np.testing.assert_array_equal(drive(m, twin.data, 60), ahead)


def test_data_with_keys_of_its_own_keeps_them(scenes):
  m, d, organ = load(probed())
  plan = palpate.Organ(m, mujoco.MjData(m), "organ")
  plan.configure(tolerance=1e-2)
  organ.configure(damping=0.004)
  mujoco.mj_copyData(plan.data, m, d)
  assert (plan.config.tolerance, plan.config.damping) == (1e-2, 0.002)


def test_windows_whose_positions_come_without_their_state_are_put_right(said):
  m, d, organ = load(probed())
  drive(m, d, 110)
  early = copy.copy(d)
  drive(m, d, 240)  # the tool has slid: the slots stand on other nodes
  expected = organ.xpos
  restore(m, d, early, mujoco.mjtState.mjSTATE_PHYSICS)
  mujoco.mj_step(m, d)
  assert organ.error is None and "mjSTATE_FULLPHYSICS" in "".join(said)
  assert np.abs(organ.xpos - expected).max() < 1e-3  # it was 80 mm
  restore(m, d, early, FULL)
  expected = drive(m, early, 20)
  np.testing.assert_allclose(drive(m, d, 20), expected, atol=1e-9)
  assert len(said) == 1


def test_a_model_compiled_anew_with_another_geom_says_that_it_resets_the_organ(said):
  spec = mujoco.MjSpec.from_string(probed())
  m = spec.compile()
  d = mujoco.MjData(m)
  drive(m, d, 110)
  spec.worldbody.add_geom(size=[0.01, 0, 0], pos=[1, 0, 0])
  m, d = spec.recompile(m, d)
  mujoco.mj_step(m, d)
  organ = palpate.Organ(m, d, "organ")
  assert "qpos of its windows was set without plugin_state" in "".join(said)
  assert np.abs(organ.displacement).max() < 1e-3 and organ.error is None


# Several organs with windows.


def probes(*names, nodal=(), datas=1):
  """Returns the forces of probes on stiff spheres, where inertia follows the contacts, in a row.

  Args:
    *names: of the spheres
    nodal: those without windows
    datas: how many data of the model are stepped in turns
  """
  bodies, drives = [], []
  for k, name in enumerate(names):
    points, elem = sphere(2)
    if name in nodal:
      made = tissue(points, elem, name, **STIFF)
    else:
      made = windowed_organ(points, elem, name, f"{name}_window", follow=f"{name}_tool", **STIFF)
    tool = (
      f'<body name="{name}_tool" pos="0.0013 0.0007 0.0567"><joint name="{name}" type="slide" '
      'axis="0 0 1"/><geom size="0.006" mass="0.05" condim="1"/></body>'
    )
    bodies.append(f'<body name="{name}_frame" pos="{0.5 * k} 0 0">{made}{tool}</body>')
    drives.append(f'<position joint="{name}" kp="500" kv="10"/>')
  extra = f"<actuator>{''.join(drives)}</actuator>"
  m = mujoco.MjModel.from_xml_string(world(*bodies, extra=extra))
  stepped = [mujoco.MjData(m) for _ in range(datas)]
  force = []
  for _ in range(150):
    for d in stepped:
      d.ctrl[:] = -0.008 * min(1, d.time / 0.08)
      mujoco.mj_step(m, d)
    force.append([stepped[0].joint(name).qfrc_constraint[0] for name in names])
  assert all(palpate.Organ(m, d, name).error is None for name in names for d in stepped)
  return np.array(force)


def test_windowed_organs_of_one_model_do_not_disturb_each_other():
  alone = probes("a")
  together = probes("a", "b", "c")
  assert alone.max() > 0.5
  # Between them is nothing, and MuJoCo's solver ends at a tolerance.
  np.testing.assert_allclose(together, alone.repeat(3, axis=1), atol=0.01 * alone.max())


def test_windows_that_take_turns_leave_another_organs_contacts_and_inertia():
  expected = probes("a", "b", nodal="a")
  np.testing.assert_allclose(probes("a", "b", nodal="a", datas=2), expected, atol=1e-7)


# Errors of MuJoCo.


def test_an_error_where_contacts_are_found_again_is_the_organs(said):
  """Windows that go from a place without contacts to one with many need more memory."""
  m, pressed, _ = load(probed(condim=6))
  drive(m, pressed, 21)
  small = re.sub(r'memory="\w+"', 'memory="70000"', probed(condim=6))
  m, d, organ = load(small)
  below = mujoco.MjData(m)
  below.qpos[-2] = below.ctrl[0] = -0.1138
  mujoco.mj_step(m, below, 3)  # the windows are at the bottom now
  for field in ("plugin_state", "qpos", "qvel", "ctrl"):
    getattr(d, field)[:] = getattr(pressed, field)
  mujoco.mj_step(m, d)
  assert "memory=" in organ.error and len(said) == 1
  with pytest.raises(mujoco.FatalError, match="memory="):  # now in MuJoCo's own part of the step
    mujoco.mj_step(m, d)
  mujoco.mj_resetData(m, d)
  mujoco.mj_step(m, d)
  assert organ.error is None
