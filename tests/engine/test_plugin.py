"""Contracts with MuJoCo: what an organ does in mj_step, wherever and however the model was made."""

import copy
import gc
import os
import pathlib
import subprocess
import sys

import mujoco
import numpy as np
import palpate
import pytest
import warp as wp
from mujoco import rollout
from palpate.engine import plugin as engine
from palpate.tissue import mesh as topology

GRAVITY = (0, 0, -9.81)
SCENE = pathlib.Path(__file__).parents[2] / "models" / "press" / "scene.xml"
STATE = mujoco.mjtState.mjSTATE_INTEGRATION


def _state(model, data):
  out = np.empty(mujoco.mj_stateSize(model, STATE))
  mujoco.mj_getState(model, data, out, STATE)
  return out


def _quiet(data):
  return all(warning.number == 0 for warning in data.warning)


def _free(scenes, **world):
  """Returns an organ on a foundation, in motion, with nothing else."""
  points, elem = scenes.sphere(1)
  config = {"young": 3e4, "foundation": 1e5, "device": "cpu"}
  config |= {key: world.pop(key) for key in list(world) if key in ("bulk", "device", "newton")}
  model, data, organ = scenes.load(scenes.world(scenes.organ(points, elem, **config), **world))
  random = np.random.RandomState(0)
  organ.set_state(xvel=random.uniform(-0.1, 0.1, (organ.nvert, 3)))
  return model, data, organ


# Motion.


def test_an_unsupported_organ_falls(scenes, device):
  points, elem = scenes.sphere(1)
  xml = scenes.world(scenes.organ(points, elem, device=device), gravity=GRAVITY)
  model, data, organ = scenes.load(xml)
  scenes.run(model, data, 100)
  h, n = model.opt.timestep, 100
  fall = -9.81 * h * h * n * (n + 1) / 2  # semi-implicit Euler from rest
  np.testing.assert_allclose(organ.displacement[:, 2], fall, rtol=1e-5)
  np.testing.assert_allclose(organ.displacement[:, :2], 0, atol=1e-6)  # float32
  assert organ.energy < 1e-10


def test_gravity_is_followed_while_running_and_can_be_disabled(scenes, device):
  points, elem = scenes.sphere(1)
  xml = scenes.world(scenes.organ(points, elem, device=device), gravity=GRAVITY)
  model, data, organ = scenes.load(xml)
  scenes.run(model, data, 1)
  model.opt.gravity[:] = (2, 0, 0)
  scenes.run(model, data, 1)
  np.testing.assert_allclose(organ.xvel, np.tile([2e-3, 0, -9.81e-3], (organ.nvert, 1)), atol=1e-5)
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY
  before = organ.xvel
  scenes.run(model, data, 1)
  np.testing.assert_allclose(organ.xvel, before, atol=1e-6)


def test_a_mode_decays_and_swings_as_rayleigh_damping_says(scenes, device):
  # Translation on a foundation is one oscillator: k / m = foundation area / mass.
  points, elem = scenes.sphere(1)
  area = topology.vertex_areas(points, elem).sum()
  mass, damping, h, omega = 0.1, 0.004, 2e-4, 40.0
  config = {"damping": damping, "foundation": omega**2 * mass / area, "tolerance": 1e-6}
  # Vertex masses are even, areas are not: a stiff shell makes the sphere move as one.
  xml = scenes.world(scenes.organ(points, elem, young=1e6, device=device, **config), h=h)
  model, data, organ = scenes.load(xml)
  organ.set_state(organ.xpos0 + np.array([0.001, 0, 0]))
  out = []
  for _ in range(round(0.3 / h)):
    mujoco.mj_step(model, data)
    out.append(organ.displacement[:, 0].mean())
  ratio = damping * omega / 2 + h * omega / 2  # the implicit step adds h omega / 2
  time = h * np.arange(1, len(out) + 1)
  ringing = omega * np.sqrt(1 - ratio**2)
  expected = np.exp(-ratio * omega * time)
  expected *= np.cos(ringing * time) + ratio * omega / ringing * np.sin(ringing * time)
  np.testing.assert_allclose(out, 0.001 * expected, atol=0.001 * 0.02)


@pytest.mark.parametrize("integrator", ["implicit", "implicitfast", "discrete"])
def test_every_integrator_but_rk4_gives_the_same_free_motion(scenes, device, integrator):
  motion = []
  for name in ("Euler", integrator):
    model, data, _ = _free(scenes, integrator=name, device=device)
    motion.append(scenes.run(model, data, 60, record=True))
  np.testing.assert_allclose(motion[1], motion[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("integrator", ["implicit", "implicitfast", "discrete"])
def test_every_integrator_gives_the_same_held_contact_force(scenes, integrator):
  force = []
  for name in ("Euler", integrator):
    model, data, organ = scenes.load(scenes.press(integrator=name))
    scenes.run(model, data, 600)
    assert organ.error is None and _quiet(data)
    force.append(organ.force[2])
  assert force[0] < -0.3
  assert force[1] == pytest.approx(force[0], rel=2e-3)


def test_rk4_is_refused(scenes):
  with pytest.raises(ValueError, match=r"'organ'.*integrator is RK4.*expected Euler, implicit"):
    mujoco.MjModel.from_xml_string(scenes.press(integrator="RK4"))


def test_a_rotated_nested_static_frame_turns_the_motion(scenes, device):
  outer, inner = 'pos="0.3 -0.2 0.1" euler="30 40 50"', 'pos="0 0.1 0" euler="0 70 -20"'
  frame = (f'name="a" {outer}', f'name="b" {inner}')
  upright = scenes.load(scenes.press(device=device))
  turned = scenes.load(scenes.press(frame=frame, device=device))
  for model, data, _ in (upright, turned):
    scenes.run(model, data, 120)
  turn = turned[1].body("b").xmat.reshape(3, 3)
  origin = turned[1].body("b").xpos
  a, b = upright[2], turned[2]
  assert np.abs(a.displacement).max() > 3e-3
  # MuJoCo solves the contacts in another frame: rounding, grown by 120 steps.
  atol = 1e-3 * np.abs(a.displacement).max()
  np.testing.assert_allclose(b.xpos, a.xpos @ turn.T + origin, atol=atol)
  np.testing.assert_allclose(b.xpos0, a.xpos0 @ turn.T + origin, atol=1e-12)
  force = np.linalg.norm(a.force)
  np.testing.assert_allclose(b.force, a.force @ turn.T, atol=1e-3 * force)
  np.testing.assert_allclose(b.xpos, turned[1].flexvert_xpos, atol=1e-4)  # a step behind


def test_gravity_acts_in_the_world_under_a_rotated_frame(scenes, device):
  points, elem = scenes.sphere(1)
  inside = scenes.organ(points, elem, foundation=1e5, young=3e4, device=device)
  body = f'<body name="frame" euler="90 30 0">{inside}</body>'
  model, data, organ = scenes.load(scenes.world(body, gravity=GRAVITY))
  scenes.run(model, data, 400)
  moved = (organ.xpos - organ.xpos0).mean(axis=0)
  assert moved[2] < -1e-4
  np.testing.assert_allclose(moved[:2], 0, atol=1e-2 * abs(moved[2]))


@pytest.mark.parametrize(
  ("attributes", "inside", "words"),
  [
    ("", "<joint type='hinge'/>", "'cart' has joints"),
    ("", "<freejoint/>", "'cart' has joints"),
    ('mocap="true"', "", "'cart' is a mocap body"),
  ],
)
@pytest.mark.parametrize("nested", [False, True])
def test_a_parent_that_moves_is_refused(scenes, attributes, inside, words, nested):
  organ = scenes.organ(*scenes.sphere(1))
  organ = f'<body name="frame">{organ}</body>' if nested else organ
  cart = f'<body name="cart" {attributes}>{inside}<geom size="0.01"/>{organ}</body>'
  with pytest.raises(ValueError, match=r"body 'cart'|parent body") as error:
    mujoco.MjModel.from_xml_string(scenes.world(cart))
  assert words in str(error.value)
  # MuJoCo 4 refuses joints by itself.
  if mujoco.__version__.startswith("3.") or "mocap" in words:
    assert "organ 'organ': its parent body" in str(error.value)
    assert "static frame" in str(error.value)


def test_pinned_vertices_stay_and_the_rest_hangs_on_them(scenes, device):
  points, elem = scenes.triangular(0.1, 0.05, 8, 5)
  pin = np.flatnonzero(points[:, 0] < 1e-9)
  inside = scenes.organ(points, elem, pin=pin, young=5e4, device=device, iterations=200)
  model, data, organ = scenes.load(scenes.world(inside, gravity=GRAVITY))
  np.testing.assert_array_equal(np.flatnonzero(~organ.free), pin)
  assert model.nv == 3 * (len(points) - len(pin))
  np.testing.assert_allclose(organ.xpos0, points, atol=1e-12)
  scenes.run(model, data, 300)
  np.testing.assert_array_equal(organ.xpos[pin], organ.xpos0[pin])
  assert 0.02 < -organ.displacement[:, 2].min() < 0.2
  assert organ.error is None


def test_several_organs_do_not_feel_each_other(scenes, device):
  points, elem = scenes.sphere(1)

  def make(name, x, **config):
    moved = points + np.array([x, 0, 0])
    return scenes.organ(moved, elem, name=name, device=device, **config)

  a = make("a", 0, foundation=1e4, pin=[0])
  b = make("b", 0.3, foundation=3e4, bulk=1e4, pin=[3, 4])
  flat, triangles = scenes.triangular(0.1, 0.05, 4, 3)
  strip = scenes.organ(
    flat + np.array([0.5, 0, 0]), triangles, name="c", foundation=1e3, device=device
  )
  together = mujoco.MjModel.from_xml_string(scenes.world(a, b, strip, gravity=GRAVITY))
  data = mujoco.MjData(together)
  scenes.run(together, data, 50)
  for name, xml in (("a", a), ("b", b), ("c", strip)):
    model, alone, organ = scenes.load(scenes.world(xml, gravity=GRAVITY), name)
    scenes.run(model, alone, 50)
    same = palpate.Organ(together, data, name)
    np.testing.assert_array_equal(same.free, organ.free)
    np.testing.assert_allclose(same.xpos, organ.xpos, rtol=0, atol=1e-9)


def test_applied_forces_push_the_nodes(scenes, device):
  moved = []
  for kind in range(2):
    model, data, organ = _free(scenes, device=device)
    organ.set_state(xvel=np.zeros((organ.nvert, 3)))
    force = np.array([0.01, -0.02, 0.03])
    if kind:
      data.xfrc_applied[model.body("organ_7").id, :3] = force
    else:
      data.qfrc_applied[scenes.dofs(organ)[7]] = force
    scenes.run(model, data, 400)
    moved.append(organ.displacement)
  np.testing.assert_allclose(moved[1], moved[0], rtol=0, atol=1e-9)
  work = moved[0][7] @ force
  # Equilibrium: force times displacement is twice the elastic energy.
  assert work == pytest.approx(2 * organ.energy, rel=0.03)


@pytest.mark.parametrize("equality", ["connect", "weld"])
def test_a_node_follows_what_it_is_tied_to(scenes, equality):
  points, elem = scenes.sphere(1)
  top = int(np.argmax(points[:, 2]))
  organ = scenes.organ(points, elem, foundation=1e5, young=3e4, contact={"contype": 0})
  x, y, z = points[top]
  tool = f'<body name="tool" mocap="true" pos="{x} {y} {z}"/>'
  tie = f'body1="organ_{top}" body2="tool"' + (' anchor="0 0 0"' if equality == "connect" else "")
  extra = f'<equality><{equality} {tie} solref="0.004 1"/></equality>'
  model, data, organ = scenes.load(scenes.world(organ, tool, extra=extra))
  for k in range(400):
    data.mocap_pos[0] = points[top] + [0, 0, 0.005 * min(1, k / 100)]
    mujoco.mj_step(model, data)
  assert organ.error is None and _quiet(data)
  assert organ.displacement[top, 2] == pytest.approx(0.005, rel=0.1)  # a soft constraint
  # The tie's force does the work that is the elastic energy; not quite linear at this pull.
  assert organ.force[2] == pytest.approx(2 * organ.energy / organ.displacement[top, 2], rel=0.1)


def test_masses_and_time_step_may_change_while_running(scenes, device):
  points, elem = scenes.sphere(1)
  config = {"foundation": 1e5, "young": 3e4, "device": device}
  model, data, organ = scenes.load(
    scenes.world(scenes.organ(points, elem, **config), gravity=GRAVITY)
  )
  sag = []
  for mass, h in ((1, 1e-3), (2, 1e-3), (2, 5e-4)):
    model.body_mass[1:] = mass * 0.1 / organ.nvert
    model.opt.timestep = h
    scenes.run(model, data, round(0.4 / h))
    sag.append(organ.displacement[:, 2].mean())
  assert organ.error is None
  assert sag[1] == pytest.approx(2 * sag[0], rel=0.02)
  assert sag[2] == pytest.approx(sag[1], rel=0.01)


def test_sleep_leaves_the_motion_as_it_is(scenes):
  # Nodes in motion never sleep; bodies beside the organ may.
  motion = []
  for flag in ("disable", "enable"):
    points, elem = scenes.sphere(1)
    organ = scenes.organ(points, elem, foundation=2e5, young=3e4)
    xml = scenes.world(
      organ, scenes.ball(0.07), gravity=GRAVITY, flag=f'<flag sleep="{flag}"/>'
    )
    model, data, organ = scenes.load(xml)
    motion.append(scenes.run(model, data, 800, record=True))
  np.testing.assert_array_equal(motion[1], motion[0])


def test_springs_and_dampers_both_disabled_switch_the_organ_off(scenes):
  # MuJoCo then skips all passive forces, the plugin's too (documented).
  model, data, organ = _free(scenes)
  before = organ.xvel
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER
  scenes.run(model, data, 10)
  np.testing.assert_allclose(organ.xvel, before, atol=1e-12)
  for one in (mujoco.mjtDisableBit.mjDSBL_SPRING, mujoco.mjtDisableBit.mjDSBL_DAMPER):
    model.opt.disableflags = int(one)
    before = organ.xvel
    scenes.run(model, data, 10)
    assert np.abs(organ.xvel - before).max() > 1e-3


def test_nothing_but_the_organs_dofs_is_written(scenes):
  model, data, organ = scenes.load(scenes.press())
  scenes.run(model, data, 50)
  data.qfrc_passive[:] = 0
  mujoco.mj_passive(model, data)
  mine = scenes.dofs(organ).ravel()
  others = np.setdiff1d(np.arange(model.nv), mine)
  assert np.abs(data.qfrc_passive[mine]).max() > 0
  np.testing.assert_array_equal(data.qfrc_passive[others], 0)


def test_cpu_and_cuda_agree(scenes):
  if not wp.is_cuda_available():
    pytest.skip("needs a CUDA device")
  found = {}
  for device in ("cpu", "cuda:0"):
    model, data, organ = scenes.load(scenes.press(bulk=1e4, device=device, tolerance=1e-6))
    scenes.run(model, data, 200)
    found[device] = organ.displacement, organ.force
  for a, b in zip(*found.values(), strict=True):
    np.testing.assert_allclose(b, a, atol=1e-4 * np.abs(a).max())


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
    before = _state(extra[0], extra[1])
    mujoco.mj_forward(extra[0], extra[1])
    np.testing.assert_array_equal(_state(extra[0], extra[1]), before)
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
    mujoco.mj_setState(model, other, _state(model, data), STATE)
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


def _motion(scenes, model):
  data = mujoco.MjData(model)
  return scenes.run(model, data, 80, record=True)


def test_a_copied_model_moves_alike(scenes):
  model, *_ = scenes.load(scenes.press())
  expected = _motion(scenes, model)
  np.testing.assert_array_equal(_motion(scenes, copy.copy(model)), expected)
  np.testing.assert_array_equal(_motion(scenes, copy.deepcopy(model)), expected)


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
  np.testing.assert_array_equal(_motion(scenes, again), _motion(scenes, model))


def test_a_specification_compiles_recompiles_and_saves(scenes, tmp_path):
  spec = mujoco.MjSpec.from_string(scenes.press())
  model = spec.compile()
  expected = _motion(scenes, mujoco.MjModel.from_xml_string(scenes.press()))
  np.testing.assert_array_equal(_motion(scenes, model), expected)
  np.testing.assert_array_equal(_motion(scenes, spec.compile()), expected)
  data = mujoco.MjData(model)
  scenes.run(model, data, 20)
  model, data = spec.recompile(model, data)
  assert data.time == pytest.approx(0.02)
  scenes.run(model, data, 20)
  assert palpate.Organ(model, data, "organ").error is None
  path = tmp_path / "press.xml"
  path.write_text(spec.to_xml())
  # Saved text has fewer digits.
  reloaded = _motion(scenes, mujoco.MjModel.from_xml_path(str(path)))
  np.testing.assert_allclose(reloaded, expected, atol=1e-2 * np.abs(expected).max())


def test_an_organ_attached_with_a_prefix(scenes):
  organ = scenes.organ(*scenes.sphere(1), foundation=1e5)
  child = mujoco.MjSpec.from_string(scenes.world(organ, gravity=GRAVITY))
  parent = mujoco.MjSpec.from_string(scenes.world(gravity=GRAVITY))
  frame = parent.worldbody.add_frame(pos=[0.1, 0.2, 0.3], euler=[0.3, 0, 0])
  parent.attach(child, prefix="left/", frame=frame)
  model = parent.compile()
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "left/organ")
  scenes.run(model, data, 300)
  assert organ.displacement.std(axis=0).max() < 1e-3
  assert 1e-6 < np.abs(organ.displacement).max() < 0.05
  np.testing.assert_allclose(organ.xpos.mean(axis=0)[:2], [0.1, 0.2], atol=1e-3)


@pytest.mark.skipif(mujoco.__version__ >= "4", reason="dm_control 1.0.50 knows MuJoCo 3")
def test_dm_control_physics_copies_and_resets(scenes):
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
  for _ in range(5):
    model = mujoco.MjModel.from_xml_string(scenes.press(subdivisions=1))
    datas = [mujoco.MjData(model) for _ in range(3)]
    mujoco.mj_step(model, datas[0])
    twin = copy.copy(datas[0])
    mujoco.mj_copyData(twin, model, datas[1])
    assert engine.count() == before + 4
    del model, datas, twin
    gc.collect()
    assert engine.count() == before


# Mistakes.


def _refused(scenes, xml, *words):
  with pytest.raises(ValueError) as error:
    mujoco.MjModel.from_xml_string(xml)
  for word in words:
    assert word in str(error.value), str(error.value)


@pytest.mark.parametrize(
  ("key", "value", "words"),
  [
    ("young", "soft", ("young is 'soft'", "a number > 0")),
    ("poisson", "0.5", ("poisson is '0.5'", "[0, 0.5)")),
    ("stiffness", "3", ("stiffness is 3", "elements='spring'")),
    ("elements", "spring", ("stiffness is missing",)),
    ("integrator", "RK4", ("integrator is 'RK4'", "'implicit' or 'midpoint' or 'neumann'")),
    ("device", "cuda:77", ("device is 'cuda:77'", "'cpu'")),
    ("device", "gpu", ("device is 'gpu'", "'cpu'")),
  ],
)
def test_a_bad_key_is_a_compile_error(scenes, key, value, words):
  organ = scenes.organ(*scenes.sphere(1), name="liver", **{key: value})
  _refused(scenes, scenes.world(organ), "organ 'liver'", *words)


@pytest.mark.parametrize("key", ["bulk", "pressure"])
def test_an_open_surface_has_no_volume(scenes, key):
  organ = scenes.organ(*scenes.triangular(0.1, 0.05, 4, 3), name="liver", **{key: "10"})
  _refused(scenes, scenes.world(organ), "organ 'liver'", f"{key} is 10", "closed surface")


def test_an_unknown_key_is_a_compile_error(scenes):
  organ = scenes.organ(*scenes.sphere(1), yuong="5000")
  _refused(scenes, scenes.world(organ), "yuong")


def test_meshes_that_cannot_be_run_are_compile_errors(scenes):
  points, elem = scenes.sphere(1)
  flipped = elem.copy()
  flipped[5] = flipped[5, ::-1]
  _refused(scenes, scenes.world(scenes.organ(points, flipped)), "organ 'organ'", "opposite")
  flat = points.copy()
  flat[elem[3, 2]] = 0.5 * (flat[elem[3, 0]] + flat[elem[3, 1]])
  _refused(scenes, scenes.world(scenes.organ(flat, elem)), "organ 'organ'", "degenerate")


def test_a_vertex_without_triangles_is_left_out_by_mujoco(scenes):
  points, elem = scenes.sphere(1)
  *_, organ = scenes.load(scenes.world(scenes.organ(np.vstack([points, [0, 0, 1]]), elem)))
  assert organ.nvert == len(points)


def test_flexes_that_are_no_surface_are_refused(scenes):
  plugin = '<plugin plugin="palpate.organ"><config key="device" value="cpu"/></plugin>'
  for dim, count, what in ((1, "4 1 1", "dim is 1"), (3, "3 3 3", "dim is 3")):
    grid = f'type="grid" dim="{dim}" count="{count}" spacing=".1 .1 .1"'
    flex = f'<flexcomp name="rope" {grid} mass="1">'
    _refused(scenes, scenes.world(f"{flex}{plugin}</flexcomp>"), "organ 'rope'", what, "dim='2'")
  flex = '<flexcomp name="sheet" type="grid" dim="2" count="4 4 1" spacing=".1 .1 .1" mass="1"'
  elastic = '<elasticity young="1e3" poisson="0.3" thickness="0.01" elastic2d="both"/>'
  xml = scenes.world(f"{flex}>{plugin}{elastic}</flexcomp>")
  _refused(scenes, xml, "organ 'sheet'", "MuJoCo elasticity too")


def test_a_plugin_on_a_body_without_a_flex_is_refused(scenes):
  body = '<body name="box"><geom size="0.1"/><plugin plugin="palpate.organ"/></body>'
  _refused(scenes, scenes.world(body), "'box'", "flexcomp")


@pytest.mark.parametrize("what", ["qpos", "qvel", "force"])
def test_a_state_that_is_not_finite_warns_and_recovers_after_reset(scenes, device, what):
  model, data, organ = scenes.load(scenes.press(device=device))
  expected = _motion(scenes, model)
  scenes.run(model, data, 30)
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
  target = {"qpos": data.qpos, "qvel": data.qvel, "force": data.qfrc_applied}[what]
  target[scenes.dofs(organ)[5, 1] if what != "qpos" else scenes.qposs(organ)[5, 1]] = np.nan
  with _Warnings() as log:
    mujoco.mj_forward(model, data)
    text = log()
  assert organ.error is not None and "'organ'" in organ.error and "finite" in organ.error
  assert "organ 'organ'" in text
  model.opt.disableflags = 0
  mujoco.mj_resetData(model, data)
  assert organ.error is None
  np.testing.assert_array_equal(scenes.run(model, data, 80, record=True), expected)


class _Warnings:
  """Collects MuJoCo's warnings instead of a log file."""

  def __enter__(self):
    self.lines = []
    mujoco.set_mju_user_warning(self.lines.append)
    return lambda: "\n".join(self.lines)

  def __exit__(self, *_):
    mujoco.set_mju_user_warning(None)


@pytest.mark.parametrize("what", ["qpos", "qvel", "force"])
def test_an_error_stays_visible_when_mujoco_resets_by_itself(scenes, what):
  model, data, organ = scenes.load(scenes.press())
  scenes.run(model, data, 30)
  target = {"qpos": data.qpos, "qvel": data.qvel, "force": data.qfrc_applied}[what]
  target[scenes.dofs(organ)[5, 1] if what != "qpos" else scenes.qposs(organ)[5, 1]] = np.nan
  with _Warnings() as log:
    scenes.run(model, data, 10)
    text = log()
  assert data.time == pytest.approx(0.01)
  assert "organ 'organ'" in text
  assert organ.error is not None and "finite" in organ.error
  organ.reset()
  assert organ.error is None
  scenes.run(model, data, 5)
  assert organ.error is None
  mujoco.mj_resetData(model, data)
  np.testing.assert_array_equal(
    scenes.run(model, data, 40, record=True)[-1], _motion(scenes, model)[39]
  )


def test_an_error_is_of_one_data_and_one_organ(scenes):
  points, elem = scenes.sphere(1)
  xml = scenes.world(
    *(scenes.organ(points + np.array([x, 0, 0]), elem, name=n) for n, x in (("a", 0), ("b", 0.3)))
  )
  model, data, a = scenes.load(xml, "a")
  b = palpate.Organ(model, data, "b")
  other = mujoco.MjData(model)
  twin = palpate.Organ(model, other, "a")
  data.qvel[scenes.dofs(a)[0]] = np.nan
  with _Warnings():
    mujoco.mj_step(model, data)
  assert (a.error is None, b.error is None, twin.error is None) == (False, True, True)
  mujoco.mj_copyData(other, model, data)
  mujoco.mj_resetData(model, other)
  assert a.error is not None and twin.error is None
  mujoco.mj_resetData(model, data)
  assert a.error is None


def test_a_diverging_motion_is_reported_once(scenes):
  model, data, organ = _free(scenes)
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
  data.qvel[scenes.dofs(organ)] = 1e25
  with _Warnings() as log:
    scenes.run(model, data, 20)
    text = log()
  assert organ.error is not None
  assert text.count("palpate.organ") == 1
  organ.reset()
  assert organ.error is None
  np.testing.assert_array_equal(organ.displacement, 0)


# Processes.

_SCRIPT = """
import sys, mujoco, palpate
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
for _ in range(20):
  mujoco.mj_step(model, data)
organ = palpate.Organ(model, data, "organ")
print(mujoco.__version__, organ.nvert, organ.error, repr(float(data.qpos[0])))
"""


def _process(scenes, tmp_path, python=sys.executable):
  path = tmp_path / "scene.xml"
  path.write_text(scenes.press(subdivisions=1))
  environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
  return subprocess.run(
    [python, "-c", _SCRIPT, str(path)],
    cwd=tmp_path,
    env=environment,
    capture_output=True,
    text=True,
    timeout=300,
    check=True,
  )


def test_a_fresh_process_prints_nothing_and_leaves_no_log(scenes, tmp_path):
  done = _process(scenes, tmp_path)
  assert len(done.stdout.splitlines()) == 1, done.stdout
  # Warp itself speaks of a missing CUDA driver; of MuJoCo and palpate nothing may be left.
  ours = [line for line in done.stderr.splitlines() if not line.startswith("Warp CUDA warning")]
  assert ours == []
  assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]


def test_mujoco_4_gives_the_same_motion(scenes, tmp_path):
  python = os.environ.get("PALPATE_MUJOCO4_PYTHON", "")
  if not pathlib.Path(python).is_file():
    pytest.skip("PALPATE_MUJOCO4_PYTHON names no Python that has mujoco 4 and palpate")
  version, nvert, error, qpos = _process(scenes, tmp_path, python).stdout.split()
  assert version.startswith("4.") and (nvert, error) == ("42", "None")
  ours = _process(scenes, tmp_path).stdout.split()[3]
  assert float(qpos) == pytest.approx(float(ours), abs=1e-7)


def test_ctrl_c_ends_a_loop_of_steps(tmp_path):
  # The signal nearly always falls into a callback, where ctypes would drop the exception.
  script = tmp_path / "loop.py"
  script.write_text(
    "import os, signal, threading, mujoco, palpate\n"
    f"m = mujoco.MjModel.from_xml_path({str(SCENE)!r})\n"
    "d = mujoco.MjData(m)\n"
    "mujoco.mj_step(m, d)\n"
    "threading.Timer(0.2, lambda: os.kill(os.getpid(), signal.SIGINT)).start()\n"
    "try:\n"
    "  while d.time < 60: mujoco.mj_step(m, d)\n"
    "  print('lost')\n"
    "except KeyboardInterrupt:\n"
    "  print('interrupted', palpate.Organ(m, d, 'organ').error)\n"
  )
  out = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
  assert out.stdout.strip().endswith("interrupted None"), out.stdout + out.stderr


def test_data_that_outlives_the_modules_is_freed_quietly(scenes):
  # In a cycle that only the interpreter's last collection finds.
  code = f"""
import gc, sys, mujoco, palpate
gc.disable()
class Holder: pass
holder = Holder()
holder.model = mujoco.MjModel.from_xml_string({scenes.press(subdivisions=1)!r})
holder.data = mujoco.MjData(holder.model)
mujoco.mj_step(holder.model, holder.data)
holder.me = sys.modules["kept by nobody"] = holder
print("stepped")
"""
  done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
  assert (done.returncode, done.stdout.strip()) == (0, "stepped"), done.stderr
  assert "Exception" not in done.stderr and "Error" not in done.stderr
