"""Organs that are tied to bodies, to each other, and to what carries them."""

import copy

import mujoco
import numpy as np
import palpate
import pytest

SOFT = {"young": 3e4, "tolerance": 1e-7}
HOOK = """<body name="hook" pos="0 0 0.08">{joint}
  <geom size="0.01" mass="0.5" contype="0" conaffinity="0"/></body>"""
CART = """<body name="cart"><joint name="x" type="slide" axis="1 0 0"/>
  <joint name="turn" type="hinge" axis="0 0 1"/>
  <geom size="0.01" mass="10" contype="0" conaffinity="0"/></body>"""


@pytest.fixture(params=["nodal", "window"])
def make(request, scenes):
  """Returns a function that returns model, data and organ of a ball of tissue beside bodies."""
  return lambda bodies, **keys: scenes.beside(request.param, bodies, **SOFT | keys)


def _top(organ):
  return np.flatnonzero(organ.xpos0[:, 2] > 0.04)


def _place(model, data, joint):
  return data.qpos[model.joint(joint).qposadr[0]]


def test_an_organ_and_a_free_body_tied_together_keep_their_momentum(make, scenes, device):
  model, data, organ = make(HOOK.format(joint='<joint name="free" type="free"/>'), device=device)
  mujoco.mj_forward(model, data)
  grip = organ.attach(_top(organ), "hook", stiffness=500)
  dof, adr = model.joint("free").dofadr[0], model.joint("free").qposadr[0]
  data.qvel[dof : dof + 3] = 0.5, 0, 0.5
  mass = scenes.masses(organ)
  pulls = []
  for _ in range(300):
    mujoco.mj_step(model, data)
    pulls.append(grip.force)
  momentum = (mass[:, None] * organ.xvel).sum(0) + 0.5 * data.qvel[dof : dof + 3]
  np.testing.assert_allclose(momentum, [0.25, 0, 0.25], atol=2e-5)
  spin = np.cross(organ.xpos, mass[:, None] * organ.xvel).sum(0)
  turn = data.body("hook").xmat.reshape(3, 3)
  spin += np.cross(data.qpos[adr : adr + 3], 0.5 * data.qvel[dof : dof + 3])
  spin += turn @ (model.body("hook").inertia * data.qvel[dof + 3 : dof + 6])
  np.testing.assert_allclose(spin, [0, 0.02, 0], atol=2e-4)
  assert np.abs(pulls).max() > 0.1 and organ.error is None


def test_a_patch_follows_a_mocap_body_and_feels_it(make):
  model, data, organ = make('<body name="hook" pos="0 0 0.08" mocap="true"/>', foundation=1e4)
  mujoco.mj_forward(model, data)
  grip = organ.attach(_top(organ), "hook")
  data.mocap_pos[0] += [0.002, 0, 0.003]
  mujoco.mj_step(model, data, 400)
  np.testing.assert_allclose(organ.displacement[grip.vertices][:, 2], 0.003, atol=2e-4)
  area = np.linalg.norm(organ.displacement, axis=1)
  assert grip.force[2] > 0.05 and grip.force[0] > 0.01 and area.min() < 1e-3
  grip.detach()
  mujoco.mj_step(model, data, 800)
  assert np.abs(organ.displacement).max() < 2e-4 and not grip.force.any()


def test_a_declared_attachment_holds_what_hangs_from_it(make, scenes):
  points, _ = scenes.sphere(2)
  top = " ".join(map(str, np.flatnonzero(points[:, 2] > 0.04)))
  slide = HOOK.format(joint='<joint name="s" type="slide" axis="0 0 1" stiffness="1000"/>')
  model, data, organ = make(slide, gravity=(0, 0, -9.81), attach=f"hook 800 {top}", damping=0.02)
  model.dof_damping[model.joint("s").dofadr[0]] = 30.0
  mujoco.mj_step(model, data, 1500)
  # The spring of the slide carries both.
  weight = 9.81 * (0.5 + scenes.masses(organ).sum())
  assert 1000 * -_place(model, data, "s") == pytest.approx(weight, rel=0.01)
  assert organ.xpos[:, 2].max() > 0 and organ.error is None


def test_a_declared_attachment_is_renamed_with_its_organ(scenes):
  points, elem = scenes.sphere(2)
  body = scenes.organ(points, elem, attach="hook 800 3 4", **SOFT)
  child = mujoco.MjSpec.from_string(scenes.world(body + HOOK.format(joint="")))
  spec = mujoco.MjSpec()
  spec.attach(child, prefix="a/", frame=spec.worldbody.add_frame())
  organ = scenes.load(spec, "a/organ")[2]
  assert organ.config.attach == (("hook", 800.0, (3, 4)),)


def test_organs_attached_to_each_other_hang_on_one(scenes):
  points, elem = scenes.sphere(2)
  low = points - [0, 0, 0.11]
  held = " ".join(map(str, np.flatnonzero(points[:, 2] > 0.03)))
  near = " ".join(map(str, np.flatnonzero(points[:, 2] < -0.045)))
  keys = SOFT | {"damping": 0.01, "contact": {"contype": 1, "conaffinity": 2}}
  upper = scenes.windowed(
    points, elem, "upper", "one", pin=held, attach=f"lower 400 {near}", **keys
  )
  lower = scenes.windowed(low, elem, "lower", "two", **keys)
  made = scenes.world(upper + lower + scenes.ball(1.0, joint=False), gravity=(0, 0, -9.81))
  model, data, organ = scenes.load(made, "upper")
  other = palpate.Organ(model, data, "lower")
  mujoco.mj_step(model, data, 1500)
  drop = -other.displacement[:, 2].mean()
  assert 0.1 * 9.81 / 400 < drop < 0.06
  pull = scenes.workspace(organ).attachments
  force = pull.force(pull.groups[0]).sum(axis=0)
  np.testing.assert_allclose(force, [0, 0, -0.981], atol=0.02)
  assert organ.error is None and other.error is None


# What carries.


def test_a_carried_organ_feels_no_constant_velocity(make):
  model, data, organ = make(CART, foundation=1e4, carrier="cart")
  data.qvel[model.joint("x").dofadr[0]] = 0.3
  organ.set_state(xvel=np.tile([0.3, 0, 0], (organ.nvert, 1)))
  mujoco.mj_step(model, data, 200)
  assert _place(model, data, "x") == pytest.approx(0.06, abs=1e-6)
  np.testing.assert_allclose(organ.displacement, np.tile([0.06, 0, 0], (organ.nvert, 1)), atol=1e-7)


def test_an_accelerated_organ_sags_as_by_gravity(make):
  model, data, organ = make(CART, foundation=1e4, carrier="cart", damping=0.02)
  found = []
  for gravity, pull in ((0.0, 2.0 * 10.1), (-2.0, 2.0 * 10.1)):
    mujoco.mj_resetData(model, data)
    model.opt.gravity[:] = gravity, 0, 0
    for _ in range(900):
      data.qfrc_applied[model.joint("x").dofadr[0]] = pull
      mujoco.mj_step(model, data)
    found.append(organ.displacement[:, 0] - _place(model, data, "x"))
  assert found[0].mean() == pytest.approx(-0.1 * 2.0 / (1e4 * 0.0308), rel=0.05)
  np.testing.assert_allclose(found[0], found[1], rtol=0.03)


def test_a_carried_organ_turns_with_its_carrier(make):
  model, data, organ = make(CART, foundation=1e4, carrier="cart")
  data.qvel[model.joint("turn").dofadr[0]] = 3.0
  organ.set_state(xvel=np.cross([0, 0, 3.0], organ.xpos0))
  mujoco.mj_step(model, data, 300)
  angle = _place(model, data, "turn")
  turn = np.array(
    [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
  )
  assert angle > 0.8
  np.testing.assert_allclose(organ.xpos, organ.xpos0 @ turn.T, atol=1e-4)


def test_a_foundation_of_its_own_motion_lets_an_organ_fall_and_turn(make, scenes):
  model, data, organ = make("", gravity=(0, 0, -9.81), foundation=1e4, carrier="own")
  spin = np.array([1.0, 2.0, 3.0])
  organ.set_state(xvel=np.cross(spin, organ.xpos0) + np.array([0.1, 0, 0]))
  mujoco.mj_step(model, data, 200)
  mass = scenes.masses(organ)[:, None]
  middle, vel = ((mass * each).sum(0) / mass.sum() for each in (organ.xpos, organ.xvel))
  np.testing.assert_allclose(vel, [0.1, 0, -9.81 * 0.2], atol=2e-3)
  now = np.cross(organ.xpos - middle, mass * (organ.xvel - vel)).sum(0)
  then = np.cross(organ.xpos0, mass * np.cross(spin, organ.xpos0)).sum(0)
  np.testing.assert_allclose(now, then, rtol=0.03)
  assert organ.energy < 1e-5


def test_pins_of_a_carrier_move_along(scenes):
  points, elem = scenes.sphere(2)
  pin = np.flatnonzero(points[:, 2] < -0.03)
  keys = SOFT | {"pin": " ".join(map(str, pin)), "carrier": "cart"}
  model, data, organ = scenes.load(
    scenes.world(scenes.windowed(points, elem, **keys) + scenes.ball(1.0, joint=False) + CART)
  )
  for _ in range(300):
    data.qfrc_applied[model.joint("x").dofadr[0]] = 2.0
    mujoco.mj_step(model, data)
  moved = _place(model, data, "x")
  assert moved > 0.005
  np.testing.assert_allclose(organ.displacement[pin, 0], moved, atol=1e-4)


# State.


def test_a_copy_is_attached_too_and_a_reset_lets_go(make):
  model, data, organ = make('<body name="hook" pos="0 0 0.08" mocap="true"/>', foundation=1e4)
  mujoco.mj_forward(model, data)
  organ.attach(_top(organ), "hook", 300)
  data.mocap_pos[0] += [0, 0, 0.005]
  mujoco.mj_step(model, data, 20)
  other = copy.copy(data)
  twin = palpate.Organ(model, other, "organ")
  for each in (data, other):
    mujoco.mj_step(model, each, 20)
  np.testing.assert_array_equal(twin.xpos, organ.xpos)
  mujoco.mj_resetData(model, data)
  data.mocap_pos[0] += [0, 0, 0.005]
  mujoco.mj_step(model, data, 20)
  assert np.abs(organ.displacement).max() < 1e-9 and np.abs(twin.displacement).max() > 1e-4


# What is refused.


@pytest.mark.parametrize(
  ("arguments", "message"),
  [
    (([5000], "hook"), r"vertices have 5000, expected in \[0, 162\)"),
    (([], "hook"), "vertices have none"),
    (([3], "nobody"), "no body 'nobody'"),
    (([3], 1.5), "no body 1.5"),
    (([3], None), "no body None"),
    (([3], "hook", -1.0), "stiffness is -1"),
    (([3], "hook", 1e9), "expected at most .* N/m for a body this light"),
  ],
)
def test_what_cannot_be_attached_is_named(make, arguments, message):
  model, data, organ = make(HOOK.format(joint='<joint name="free" type="free"/>'))
  mujoco.mj_forward(model, data)
  with pytest.raises(ValueError, match=message):
    organ.attach(*arguments)


@pytest.mark.parametrize(
  ("keys", "message"),
  [
    ({"attach": "hook 500"}, "attach is 'hook 500', expected a body or organ, a stiffness > 0"),
    ({"attach": "hook 0 3"}, "attach is 'hook 0 3', expected"),
    ({"attach": "nobody 5 3"}, "attach names 'nobody', which is no body"),
    ({"attach": "hook 5 900"}, "vertices have 900"),
    ({"carrier": "nobody", "foundation": 1e4}, "carrier names 'nobody', which is no body"),
    ({"carrier": "hook", "integrator": "neumann"}, "allowed only without carrier"),
  ],
)
def test_a_declaration_that_cannot_be_is_named(make, keys, message):
  with pytest.raises(ValueError, match=message):
    make(HOOK.format(joint=""), **keys)
