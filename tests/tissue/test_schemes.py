"""The schemes beside the implicit one: midpoint, explicit and Neumann."""

import mujoco
import numpy as np
import pytest
import warp as wp
from palpate.tissue import step

H, MASS, BETA = 1e-3, 1e-3, 0.002


def _step(scenes, body, integrator, u, v, force):
  """Returns the change of velocity of one step of a scheme, (nvert, 3)."""
  return scenes.step(body, H, u, v, MASS, force, BETA, integrator)


def _random(shape, size, seed):
  return size * np.random.RandomState(seed).uniform(-1, 1, shape)


@pytest.mark.parametrize("terms", [{}, {"bulk": 1e3, "pressure": 50.0}, {"foundation": 1e4}])
def test_explicit_is_force_over_mass(scenes, device, terms):
  points, elem = scenes.sphere(1)
  _, _, body = scenes.kernels(points, elem, bend=1.0, device=device, **terms)
  u, force = _random(points.shape, 1e-3, 0), _random(points.shape, 0.02, 1)
  inner = scenes.force(body, u)
  found = _step(scenes, body, "explicit", u, np.zeros_like(u), force)
  expected = H * (inner + force) / MASS
  np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_neumann_is_the_first_order_polynomial_of_the_thesis(scenes, device):
  points, elem = scenes.sphere(1)
  stiffness, foundation = 20.0, 1e4
  mesh, _, body = scenes.kernels(
    points, elem, elements="spring", stiffness=stiffness, foundation=foundation, device=device
  )
  u, v = _random(points.shape, 1e-3, 0), _random(points.shape, 0.05, 1)
  force = _random(points.shape, 0.02, 2)
  inner = scenes.force(body, u)
  found = _step(scenes, body, "neumann", u, v, force)
  n = mesh.nvert
  laplacian = np.zeros((n, n))
  for i in range(n):
    near = mesh.ring[i, : mesh.degree[i]]
    laplacian[i, near] -= stiffness
    laplacian[i, i] += stiffness * len(near)
  area = np.zeros(n)
  np.add.at(area, elem.ravel(), np.repeat(_areas(points, elem) / 3, 3))
  laplacian += np.diag(foundation * area)
  g = H * H + H * BETA
  w = np.eye(n) + g * laplacian / MASS
  d = np.diag(1 / np.diag(w))
  rhs = (H * (inner + force) - g * laplacian @ v) / MASS
  expected = (2 * d - d @ w @ d) @ rhs
  np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def _areas(points, elem):
  a, b, c = (points[elem[:, k]] for k in range(3))
  return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _free_motion(scenes, integrator, h, damping, device):
  points, elem = scenes.sphere(1)
  config = {"young": 3e4, "foundation": 1e5, "damping": damping, "device": device}
  xml = scenes.world(scenes.organ(points, elem, integrator=integrator, **config), h=h)
  model, data, organ = scenes.load(xml)
  organ.set_state(xvel=_random(points.shape, 0.1, 0))
  scenes.run(model, data, round(5e-3 / h))
  assert organ.integrator == integrator and organ.error is None
  return organ.displacement


# The Neumann scheme damps its constant springs, not the membrane: alike without damping only.
@pytest.mark.parametrize(
  ("integrator", "damping"), [("midpoint", 0.002), ("explicit", 0.002), ("neumann", 0.0)]
)
def test_schemes_agree_when_steps_are_small(scenes, device, integrator, damping):
  expected = _free_motion(scenes, "implicit", 2e-5, damping, device)
  found = _free_motion(scenes, integrator, 2e-5, damping, device)
  # First order in h, which is a hundredth of the shortest period.
  np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max())


def test_the_scheme_switches_while_running(scenes):
  model, data, organ = scenes.load(scenes.press(h=1e-4))
  for integrator in ("explicit", "implicit", "neumann", "midpoint", "implicit"):
    organ.integrator = integrator
    assert organ.integrator == integrator
    scenes.run(model, data, 300)
    assert organ.error is None
    assert np.abs(organ.displacement).max() < 0.02
  assert organ.force[2] < -0.05
  assert all(warning.number == 0 for warning in data.warning)


def test_an_explicit_step_too_long_is_reported(scenes):
  points, elem = scenes.sphere(2)
  config = {"young": 1e6, "damping": 0.0, "integrator": "explicit"}
  model, data, organ = scenes.load(scenes.world(scenes.organ(points, elem, **config), h=5e-3))
  model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
  organ.set_state(xvel=_random(points.shape, 0.1, 0))
  said = []
  mujoco.set_mju_user_warning(said.append)
  try:
    scenes.run(model, data, 200)
  finally:
    mujoco.set_mju_user_warning(None)
  assert organ.error is not None and "the explicit step" in organ.error
  assert any("organ 'organ'" in text for text in said)


# Midpoint.


@pytest.mark.parametrize("first", [False, True])
def test_midpoint_is_centred_and_starts_with_half_a_step(scenes, device, first):
  points, elem = scenes.sphere(1)
  terms = {"foundation": 1e5, "tolerance": 1e-6, "device": device}
  _, _, body = scenes.kernels(points, elem, **terms)
  zero = np.zeros_like(points)
  v, force = _random(points.shape, 1e-4, 0), _random(points.shape, 1e-4, 1)  # linear
  k = _stiffness(scenes, body, points.shape)
  scenes.step(body, H, zero, v, MASS, force, beta=BETA)
  if not first:
    scenes.put(body, body.state.dvel_warm, _random(points.shape, 1e-4, 2))
  before = body.state.step.numpy()[:, :3].copy()
  with wp.ScopedDevice(body.device):
    step.step(body, "midpoint")
  after = body.state.step.numpy()[:, :3]
  np.testing.assert_array_equal(after, before)  # what it changed is put back
  part = 0.5 if first else 1.0
  a = MASS * np.eye(v.size) + part * 0.5 * (H * H + H * BETA) * k
  rhs = part * H * (force.ravel() - BETA * k @ v.ravel())
  expected = np.linalg.solve(a, rhs).reshape(v.shape)
  found = scenes.get(body, body.state.dvel)
  np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("elements", ["membrane", "solid"])
@pytest.mark.parametrize("first", [False, True])
def test_newton_iterations_of_midpoint_mend_what_its_matrix_is_wrong_about(
  scenes, device, elements, first
):
  # Without damping: M dv = part h (F(x + h dv / 2) + f), of matrices stiffer than the energy.
  points, elem = scenes.sphere(1)
  force, h, residual = _random(points.shape, 1e-2, 1), 2e-3, []
  part = 0.5 if first else 1.0
  for newton in (1, 2, 4):
    keys = {"elements": elements, "foundation": 1e4, "tolerance": 1e-6, "device": device}
    mesh, _, body = scenes.kernels(points, elem, newton=newton, **keys)
    u = np.zeros((mesh.nvert, 3))
    u[:, 2] = -0.1 * mesh.rest[:, 2]
    push = np.zeros_like(u)
    push[: len(points)] = force
    scenes.step(body, h, u, 0 * u, MASS, push, 0.0)
    if not first:
      scenes.put(body, body.state.dvel_warm, _random(u.shape, 1e-4, 2))
    with wp.ScopedDevice(body.device):
      step.step(body, "midpoint")
    dvel = scenes.get(body, body.state.dvel)
    inner = scenes.force(scenes.kernels(points, elem, **keys)[2], u + 0.5 * h * dvel)
    residual.append(np.linalg.norm(MASS * dvel - part * h * (inner + push)))
  assert residual[1] < 0.5 * residual[0]
  assert residual[2] < 0.5 * residual[1]


def _stiffness(scenes, body, shape, size=1e-6):
  """Returns minus the slope of the force at rest [N/m], (n, n)."""
  out = np.zeros((np.prod(shape), np.prod(shape)))
  for i in range(len(out)):
    u = np.zeros(len(out))
    u[i] = size
    out[i] = -scenes.force(body, u.reshape(shape)).ravel() / size
  return 0.5 * (out + out.T)


def _swing(scenes, integrator, h, device, bend=0.0):
  """Returns the positions of a sphere let go from a stretched shape, at 20 and 40 ms."""
  points, elem = scenes.sphere(1)
  config = {"young": 3e4, "foundation": 1e5, "bulk": 2e3, "bend": bend, "tolerance": 1e-6}
  organ = scenes.organ(points, elem, integrator=integrator, device=device, **config)
  model, data, organ = scenes.load(scenes.world(organ, h=h))
  organ.set_state(points * [0.97, 0.97, 1.06])
  out = []
  for _ in range(2):
    scenes.run(model, data, round(0.02 / h))
    out.append(organ.displacement)
  return np.array(out)


@pytest.mark.parametrize("bend", [0.0, 1.0])
def test_midpoint_is_of_second_order_in_free_vibration(scenes, device, bend):
  finest = 6.25e-5
  fine, finer = (_swing(scenes, "midpoint", h, device, bend) for h in (2 * finest, finest))
  truth = finer + (finer - fine) / 3  # Richardson
  error = [
    np.linalg.norm(_swing(scenes, "midpoint", h, device, bend) - truth) for h in (1e-3, 5e-4)
  ]
  assert np.log2(error[0] / error[1]) > 1.8
  implicit = np.linalg.norm(_swing(scenes, "implicit", 5e-4, device, bend) - truth)
  assert error[1] < 0.2 * implicit


@pytest.mark.parametrize("h", [1e-3, 5e-3])
def test_midpoint_carries_a_resting_weight_exactly(scenes, device, h):
  points, elem = scenes.sphere(2)
  config = {"young": 30e3, "foundation": 2e5, "integrator": "midpoint", "device": device}
  ball = scenes.ball(scenes.RADIUS + 0.0066, mass=0.05)
  xml = scenes.world(scenes.organ(points, elem, **config), ball, h=h, gravity=(0, 0, -9.81))
  model, data, organ = scenes.load(xml)
  model.dof_damping[-1] = 1.0
  while data.time < 1.5:
    mujoco.mj_step(model, data)
  np.testing.assert_allclose(organ.force, [0, 0, -0.05 * 9.81], atol=1e-3 * 0.05 * 9.81)


def test_midpoint_goes_on_from_a_stored_state_to_the_bit(scenes, device):
  model, data, organ = scenes.load(scenes.press(device=device))
  organ.integrator = "midpoint"
  scenes.run(model, data, 150)
  scenes.goes_on(model, data, lambda each: scenes.run(model, each, 20, record=True), fresh=False)
