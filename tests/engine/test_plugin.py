"""Contracts with MuJoCo: what an organ does in mj_step, and what its motion is."""

import mujoco
import numpy as np
import palpate
import pytest
import warp as wp
from palpate.tissue.geometry import mesh as topology

GRAVITY = (0, 0, -9.81)


def _quiet(data):
  return all(warning.number == 0 for warning in data.warning)


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
    model, data, _ = scenes.adrift(integrator=name, device=device)
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
    model, data, organ = scenes.adrift(device=device)
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
    xml = scenes.world(organ, scenes.ball(0.07), gravity=GRAVITY, flag=f'<flag sleep="{flag}"/>')
    model, data, organ = scenes.load(xml)
    motion.append(scenes.run(model, data, 800, record=True))
  np.testing.assert_array_equal(motion[1], motion[0])


def test_springs_and_dampers_both_disabled_switch_the_organ_off(scenes):
  # MuJoCo then skips all passive forces, the plugin's too (documented).
  model, data, organ = scenes.adrift()
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
