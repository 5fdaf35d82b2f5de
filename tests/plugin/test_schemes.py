"""The explicit and the Neumann scheme."""

import mujoco
import numpy as np
import pytest
import warp as wp
from palpate import schemes

H, MASS, BETA = 1e-3, 1e-3, 0.002


def _step(scenes, s, state, integrator, u, v, force):
  """Returns the change of velocity of one step of a scheme, (nvert, 3)."""
  scenes.step(s, state, H, u, v, MASS, force, beta=BETA)  # fills the state
  with wp.ScopedDevice(s.device):
    schemes.step(s, state, integrator)
  return scenes.get(s, state.dvel)


def _random(shape, size, seed):
  return size * np.random.RandomState(seed).uniform(-1, 1, shape)


@pytest.mark.parametrize("terms", [{}, {"bulk": 1e3, "pressure": 50.0}, {"foundation": 1e4}])
def test_explicit_is_force_over_mass(scenes, device, terms):
  points, elem = scenes.sphere(1)
  _, _, s, state = scenes.kernels(points, elem, bend=1.0, device=device, **terms)
  u, force = _random(points.shape, 1e-3, 0), _random(points.shape, 0.02, 1)
  inner = scenes.force(s, state, u)
  found = _step(scenes, s, state, "explicit", u, np.zeros_like(u), force)
  expected = H * (inner + force) / MASS
  np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


def test_neumann_is_the_first_order_polynomial_of_the_thesis(scenes, device):
  points, elem = scenes.sphere(1)
  stiffness, foundation = 20.0, 1e4
  mesh, _, s, state = scenes.kernels(
    points, elem, elements="spring", stiffness=stiffness, foundation=foundation, device=device
  )
  u, v = _random(points.shape, 1e-3, 0), _random(points.shape, 0.05, 1)
  force = _random(points.shape, 0.02, 2)
  inner = scenes.force(s, state, u)
  found = _step(scenes, s, state, "neumann", u, v, force)
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
@pytest.mark.parametrize(("integrator", "damping"), [("explicit", 0.002), ("neumann", 0.0)])
def test_schemes_agree_when_steps_are_small(scenes, device, integrator, damping):
  expected = _free_motion(scenes, "implicit", 2e-5, damping, device)
  found = _free_motion(scenes, integrator, 2e-5, damping, device)
  # First order in h, which is a hundredth of the shortest period.
  np.testing.assert_allclose(found, expected, atol=0.03 * np.abs(expected).max())


def test_the_scheme_switches_while_running(scenes):
  model, data, organ = scenes.load(scenes.press(h=1e-4))
  for integrator in ("explicit", "implicit", "neumann", "implicit"):
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
  assert organ.error is not None and "diverged" in organ.error
  assert any("organ 'organ'" in text for text in said)
