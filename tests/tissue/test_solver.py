"""The implicit step: a float64 solve as reference, tolerance, Newton iterations, worlds."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from palpate.tissue import energy
from palpate.tissue import shape as making
from palpate.tissue import step as stepping
from palpate.tissue.config import rigidity
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry import plate
from reference import plates

H = 1e-3
MASS = 1e-3


def _hessian(mesh, config, u, step=1e-5):
  """Returns the Hessian of the energy [N/m] by central differences in float64."""
  n = u.size
  out = np.zeros((n, n))

  def value(*moves):
    x = u.ravel().copy()
    for i, size in moves:
      x[i] += size
    return energy.total(mesh, config, x.reshape(u.shape))

  for i in range(n):
    for j in range(i + 1):
      signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
      total = sum(a * b * value((i, a * step), (j, b * step)) for a, b in signs)
      out[i, j] = out[j, i] = total / (4 * step * step)
  return out


def _force(mesh, config, u, step=1e-7):
  out = np.zeros(u.size)
  for i in range(u.size):
    x = np.zeros(u.size)
    x[i] = step
    x = x.reshape(u.shape)
    out[i] = energy.total(mesh, config, u - x) - energy.total(mesh, config, u + x)
  return out.reshape(u.shape) / (2 * step)


def _random(shape, size, seed):
  return size * np.random.RandomState(seed).uniform(-1, 1, shape)


@pytest.mark.parametrize(
  "terms",
  [
    {},
    {"elements": "spring", "stiffness": 20.0},
    {"foundation": 2e5},
    {"bulk": 1e4},
    {"bend": 10.0},
  ],
  ids=["membrane", "spring", "foundation", "volume", "bending"],
)
def test_a_step_is_the_solution_of_the_linear_system(scenes, device, terms):
  # At rest the matrix leaves nothing out and is the Hessian of the energy; of bending it has the
  # part along the normals, which is all of it on a flat plate.
  points, elem = scenes.triangular(0.06, 0.034, 3, 2) if "bend" in terms else scenes.sphere(0)
  settings = {"damping": 0.01, "tolerance": 1e-6, "device": device}
  mesh, config, body = scenes.kernels(points, elem, **(settings | terms))
  u = np.zeros_like(points)
  v, force = _random(u.shape, 1e-3, 1), _random(u.shape, 0.02, 2)  # slow: x + h v is about x
  k = _hessian(mesh, dataclasses.replace(config, bend=0.0), u)
  if config.bend:
    hinge = plate.hinges(mesh, rigidity(config, mesh.nelem), config.poisson)
    k[2::3, 2::3] += plates.bending_matrix(mesh, hinge)
  g = H * H + H * config.damping
  rhs = H * force.ravel() - g * k @ v.ravel()
  expected = np.linalg.solve(MASS * np.eye(u.size) + g * k, rhs).reshape(u.shape)
  found = scenes.step(body, H, u, v, MASS, force)
  np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


def test_a_step_of_a_stretched_membrane_is_linear_about_where_it_leads(scenes, device):
  points, elem = scenes.sphere(0)
  keys = {"foundation": 1e3, "tolerance": 1e-6, "device": device}  # held, so that it keeps no spin
  mesh, config, body = scenes.kernels(points, elem, **keys)
  u = 0.2 * points + _random(points.shape, 5e-4, 0)  # all in tension
  v = _random(u.shape, 0.1, 1)
  k, g = _hessian(mesh, config, u + H * v), H * H + H * config.damping
  rhs = H * _force(mesh, config, u + H * v).ravel() - H * config.damping * k @ v.ravel()
  expected = np.linalg.solve(MASS * np.eye(u.size) + g * k, rhs).reshape(u.shape)
  found = scenes.step(body, H, u, v, MASS)
  np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


@pytest.mark.parametrize("speed", [3.0, 30.0])
def test_a_fast_step_stands_where_no_edge_has_changed_by_more_than_a_tenth(scenes, device, speed):
  points, elem = scenes.sphere(0)
  keys = {"foundation": 1e3, "tolerance": 1e-6, "device": device}  # held, so that it keeps no spin
  mesh, config, body = scenes.kernels(points, elem, **keys)
  u, h = 0.2 * points, 1e-2
  v = _random(u.shape, speed, 1)
  found = scenes.step(body, h, u, v, MASS)
  edge = mesh.rest[elem[:, [1, 2, 0]]] - mesh.rest[elem]
  change = h * np.linalg.norm(v[elem[:, [1, 2, 0]]] - v[elem], axis=2)
  share = 0.1 / (change / np.linalg.norm(edge, axis=2)).max()
  assert share < 0.5
  x = u + share * h * v
  k = _hessian(mesh, config, x)
  gain = h * h + h * config.damping
  rhs = h * _force(mesh, config, x).ravel() - (gain - share * h * h) * k @ v.ravel()
  expected = np.linalg.solve(MASS * np.eye(u.size) + gain * k, rhs).reshape(u.shape)
  np.testing.assert_allclose(found, expected, atol=5e-4 * np.abs(expected).max())


def _pressed(scenes, **config):
  """Returns mesh, configuration, surface, state, displacement, velocity, force of a sphere."""
  points, elem = scenes.sphere(2)
  config = {"young": (30e3,), "foundation": 2e5, "bulk": 1e4, "bend": 1.0} | config
  mesh, settings, body = scenes.kernels(points, elem, **config)
  top = np.exp(-((points - [0, 0, scenes.RADIUS]) ** 2).sum(axis=1) / 0.01**2)
  force = -0.02 * top[:, None] * [0, 0, 1]
  u = -0.003 * top[:, None] * [0, 0, 1]
  return mesh, settings, body, u, _random(u.shape, 0.02, 3), force


@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-6])
def test_pcg_stops_at_its_tolerance(scenes, device, tolerance):
  _, _, body, u, v, force = _pressed(scenes, iterations=500, tolerance=tolerance, device=device)
  scenes.step(body, H, u, v, MASS, force)
  iterations, residual, _, failed = body.system.status.numpy()[0]
  assert 0 < iterations < 100 and failed == 0
  assert residual <= tolerance


def test_a_tighter_tolerance_comes_closer(scenes, device):
  found = {}
  for tolerance in (1e-2, 1e-3, 1e-4, 1e-7):
    arguments = {"iterations": 500, "tolerance": tolerance, "device": device}
    _, _, body, u, v, force = _pressed(scenes, **arguments)
    found[tolerance] = scenes.step(body, H, u, v, MASS, force)
  best = found.pop(1e-7)
  error = {t: np.linalg.norm(x - best) / np.linalg.norm(best) for t, x in found.items()}
  for tolerance, value in error.items():
    assert value < 5 * tolerance  # residual and error differ by the condition number


def test_pcg_takes_no_more_than_its_iterations(scenes, device):
  _, _, body, u, v, force = _pressed(scenes, iterations=3, tolerance=1e-7, device=device)
  scenes.step(body, H, u, v, MASS, force)
  assert body.system.status.numpy()[0, 0] == 3


def test_nothing_to_do_takes_no_iteration(scenes, device):
  mesh, _, body, *_ = _pressed(scenes, bulk=0.0, device=device)
  dvel = scenes.step(body, H, np.zeros((mesh.nvert, 3)), mass=MASS)
  assert body.system.status.numpy()[0, 0] == 0
  np.testing.assert_array_equal(dvel, 0)


def test_rounding_of_the_volume_moves_nothing(scenes, device):
  mesh, _, body, *_ = _pressed(scenes, device=device)
  dvel = scenes.step(body, H, np.zeros((mesh.nvert, 3)), mass=MASS)
  # float32 has 1e-7 of the volume: about 1e-7 of bulk on the area of a node, for one step.
  limit = 10 * 1e-7 * body.number("bulk") * 4 * np.pi * scenes.RADIUS**2 / mesh.nvert * H / MASS
  np.testing.assert_allclose(dvel, 0, atol=limit)


def test_newton_iterations_reduce_the_residual_of_the_nonlinear_step(scenes, device):
  # g(dv) = M dv - h (F(x + h (v + dv)) - damping K (v + dv) + f): here without damping.
  residual = []
  for newton in (1, 2, 3):
    config = {"newton": newton, "tolerance": 1e-6, "iterations": 500, "damping": 0.0}
    mesh, settings, body, u, v, force = _pressed(scenes, device=device, **config)
    v, h = 20 * v, 2e-3  # far enough for the forces to be nonlinear
    dvel = scenes.step(body, h, u, v, MASS, force)
    ahead = _gradient_force(scenes, mesh, settings, u + h * (v + dvel))
    residual.append(np.linalg.norm(MASS * dvel - h * (ahead + force)))
  assert residual[1] < 0.3 * residual[0]
  assert residual[2] < 0.5 * residual[1]


def _gradient_force(scenes, mesh, settings, u):
  """Returns the internal force [N] by the kernels, which test_elastic holds against the energy."""
  config = {
    key: getattr(settings, key) for key in ("young", "foundation", "bulk", "bend", "poisson")
  }
  _, _, body = scenes.kernels(mesh.rest, mesh.elem, **config)
  return scenes.force(body, u)


def test_worlds_are_independent(scenes, device):
  points, elem = scenes.sphere(1)
  config = {"bulk": 1e3, "bend": 1.0, "foundation": 1e4, "device": device}
  _, _, many = scenes.kernels(points, elem, nworld=3, **config)
  _, _, one = scenes.kernels(points, elem, **config)
  u = np.stack([_random(points.shape, size, 0) for size in (0.001, 0.002, 0.005)])
  scenes.step(many, H, u, mass=MASS)
  together = [scenes.get(many, many.state.dvel, world) for world in range(3)]
  for world in range(3):
    np.testing.assert_array_equal(together[world], scenes.step(one, H, u[world], mass=MASS))


def test_a_step_repeats_to_the_bit(scenes, device):
  _, _, body, u, v, force = _pressed(scenes, device=device)
  first = scenes.step(body, H, u, v, MASS, force)
  np.testing.assert_array_equal(scenes.step(body, H, u, v, MASS, force), first)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_a_state_without_a_solution_is_reported(scenes, device, bad):
  _, _, body, u, v, force = _pressed(scenes, device=device)
  u[3, 1] = bad
  scenes.step(body, H, u, v, MASS, force)
  assert body.system.status.numpy()[0, 3] == 1


def test_the_order_of_the_vertices_does_not_matter(scenes, device):
  mesh, _, body, u, v, force = _pressed(scenes, tolerance=1e-7, device=device)
  expected = scenes.step(body, H, u, v, MASS, force)
  order = np.random.RandomState(0).permutation(mesh.nvert)
  where = np.argsort(order)
  config = {"young": (30e3,), "foundation": 2e5, "bulk": 1e4, "bend": 1.0, "tolerance": 1e-7}
  _, _, body = scenes.kernels(mesh.rest[order], where[mesh.elem], device=device, **config)
  found = scenes.step(body, H, u[order], v[order], MASS, force[order])
  np.testing.assert_allclose(found[where], expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize(
  "change", [{"foundation": 1e5}, {"bulk": 0.0}, {"pressure": 50.0}, {"tolerance": 1e-2}]
)
def test_a_recorded_step_follows_the_numbers(scenes, device, change):
  _, settings, body, u, v, force = _pressed(scenes, device=device, iterations=500)
  changed = dataclasses.replace(settings, **change)
  expected = scenes.step(making.make(*_made_of(scenes, changed), device), H, u, v, MASS, force)
  before = scenes.step(body, H, u, v, MASS, force)
  with wp.ScopedDevice(body.device), wp.ScopedCapture(device=body.device) as capture:
    stepping.step(body)
  making.renumber(body, changed)
  wp.capture_launch(capture.graph)
  found = scenes.get(body, body.state.dvel)
  assert np.abs(found - before).max() > 0
  np.testing.assert_array_equal(found, expected)


def _made_of(scenes, settings):
  points, elem = scenes.sphere(2)
  mesh = topology.build("organ", points, elem)
  return mesh, settings, np.zeros(mesh.nvert, bool)
