"""What MuJoCo feels of an organ: contact forces at rest and in motion, effective inertia."""

import pathlib
import runpy

import mujoco
import numpy as np
import pytest

REFERENCE = pathlib.Path(__file__).parents[1] / "reference" / "press_explicit_20us.csv"
GRAVITY = 9.81


@pytest.mark.parametrize("h", [5e-4, 1e-3, 2e-3])
def test_a_resting_weight_is_carried_exactly(scenes, device, h):
  points, elem = scenes.sphere(2)
  config = {"young": 30e3, "foundation": 2e5, "newton": 1, "device": device}
  mass = 0.05
  organ = scenes.organ(points, elem, mass=0.1, **config)
  ball = scenes.ball(scenes.RADIUS + 0.0066, mass=mass)
  model, data, organ = scenes.load(scenes.world(organ, ball, h=h, gravity=(0, 0, -GRAVITY)))
  model.dof_damping[-1] = 1.0  # of the ball, to come to rest soon; no force at rest
  while data.time < 1.5:
    mujoco.mj_step(model, data)
  assert np.abs(data.qvel).max() < 1e-4
  assert data.qfrc_constraint[-1] == pytest.approx(mass * GRAVITY, rel=1e-3)
  np.testing.assert_allclose(organ.force, [0, 0, -mass * GRAVITY], atol=1e-3 * mass * GRAVITY)


@pytest.mark.parametrize("h", [5e-4, 1e-3, 2e-3])
def test_a_held_organ_carries_its_own_weight(scenes, device, h):
  # Standing on a plane: the plane carries the organ's weight, through many contacts.
  points, elem = scenes.sphere(2)
  config = {"young": 30e3, "bulk": 1e5, "damping": 0.01, "device": device}
  organ = scenes.organ(points, elem, contact={"solref": "0.01 1"}, **config)
  plane = f'<geom type="plane" size="1 1 1" pos="0 0 {-scenes.RADIUS - 0.001}" condim="1"/>'
  model, data, organ = scenes.load(scenes.world(organ, plane, h=h, gravity=(0, 0, -GRAVITY)))
  total = []
  while data.time < 0.8:
    mujoco.mj_step(model, data)
    total.append(organ.force[2])
  # A slow rocking mode remains; its mean force is the weight.
  last = round(0.2 / h)
  assert np.mean(total[-last:]) == pytest.approx(0.1 * GRAVITY, rel=1e-2)


@pytest.fixture(scope="session")
def reference():
  """Returns times and forces of the explicit press."""
  return np.loadtxt(REFERENCE, delimiter=",", skiprows=1).T


@pytest.mark.parametrize(
  ("h", "newton", "allowed"),
  # Share of the peak; half of the square is the first touch, where the ball bounces on one node.
  [(5e-4, 1, 0.005), (1e-3, 1, 0.006), (2e-3, 1, 0.013), (1e-3, 3, 0.006)],
)
def test_the_press_of_the_explicit_reference_is_reproduced(
  scenes, reference, device, h, newton, allowed
):
  script = runpy.run_path(str(REFERENCE.with_suffix(".py")))
  time, expected = reference
  keys = {
    "elements": "spring",
    "stiffness": script["STIFFNESS"],
    "foundation": script["FOUNDATION"],
    "damping": script["DAMPING"],
    "bend": 0,
    "newton": newton,
    "device": device,
  }
  extension = '<extension><plugin plugin="palpate.organ"/></extension>'
  xml = script["mjcf"](h, extension, scenes.plugin(**keys))
  found = script["press"](mujoco.MjModel.from_xml_string(xml))
  force = np.interp(time, found[:, 0], found[:, 1])
  error = np.sqrt(np.mean((force - expected) ** 2)) / expected.max()
  assert error < allowed
  assert force[-1] == pytest.approx(expected[-1], rel=1e-3)


@pytest.mark.parametrize("duration", [0.03, pytest.param(0.25, marks=pytest.mark.slow)])
def test_the_stored_reference_is_what_its_script_computes(duration):
  script = runpy.run_path(str(REFERENCE.with_suffix(".py")))
  stored = np.loadtxt(REFERENCE, delimiter=",", skiprows=1)[: round(duration / script["EVERY"])]
  again = script["reference"](duration)
  assert stored[-1, 1] > 0.01  # the ball has touched
  np.testing.assert_allclose(again, stored, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("young", [3e4, 3e5])
def test_stiff_tissue_is_pressed_without_chatter(scenes, device, young):
  model, data, organ = scenes.load(
    scenes.press(h=2e-3, young=young, foundation=2e5 * young / 3e4, device=device)
  )
  scenes.run(model, data, 150)
  held = []
  for _ in range(50):
    mujoco.mj_step(model, data)
    held.append(organ.force[2])
  assert organ.error is None
  assert np.mean(held) < -0.05
  assert np.ptp(held) < 0.01 * abs(np.mean(held))


def test_effective_inertia_is_isotropic_and_more_than_the_mass(scenes, device):
  model, _, organ = scenes.load(scenes.press(young=3e5, device=device))
  mass = 0.1 / organ.nvert
  armature = model.dof_armature[scenes.dofs(organ)]
  np.testing.assert_array_equal(armature, armature[:, :1].repeat(3, axis=1))
  assert (armature >= 0).all()
  # Neighbours move along, the whole organ does not.
  assert 0.1 * mass < armature.max() < 0.1


def test_effective_inertia_keeps_the_contact_iteration_stable(scenes):
  # Spectral radius of Mhat n^T A^-1 n on the nodes within the tool's radius, by unit impulses.
  h = 1e-3
  points, elem = scenes.sphere(3)
  config = {"young": (30e3,), "foundation": 2e5, "bend": 1.0, "tolerance": 1e-6, "iterations": 500}
  model, _, organ = scenes.load(scenes.press(h, subdivisions=3, tool=0.012))
  mass = 0.1 / organ.nvert
  inertia = mass + model.dof_armature[scenes.dofs(organ)][:, 0]
  _, _, body = scenes.kernels(points, elem, **config)
  normal = points / scenes.RADIUS
  order = np.argsort(points[:, 2])[::-1]
  patch = order[np.linalg.norm(points[order] - points[order[0]], axis=1) < 0.012]
  assert len(patch) >= 4
  response = np.zeros((len(patch), len(patch)))
  for k, i in enumerate(patch):
    force = np.zeros(points.shape)
    force[i] = normal[i] / h
    dvel = scenes.step(body, h, np.zeros(points.shape), mass=mass, force=force)
    response[:, k] = (dvel[patch] * normal[patch]).sum(axis=1)
  radius = np.abs(np.linalg.eigvals(inertia[patch][:, None] * response)).max()
  assert radius < 1.2  # stable up to 2; the rule aims at 1, interpolation between samples adds some


def test_the_armature_follows_the_time_step(scenes):
  model, data, organ = scenes.load(scenes.press(1e-3))
  before = model.dof_armature[scenes.dofs(organ)].copy()
  model.opt.timestep = 2e-3
  mujoco.mj_step(model, data)
  other, *_ = scenes.load(scenes.press(2e-3))
  after = model.dof_armature[scenes.dofs(organ)]
  assert after.max() > 1.2 * before.max()
  np.testing.assert_allclose(after, other.dof_armature[scenes.dofs(organ)], rtol=1e-4)


def test_an_armature_of_the_user_stays(scenes):
  default = '<default><joint armature="0.003"/></default>'
  xml = scenes.press().replace("<worldbody>", default + "<worldbody>")
  model, data, organ = scenes.load(xml)
  scenes.run(model, data, 3)
  np.testing.assert_array_equal(model.dof_armature[scenes.dofs(organ)], 0.003)
