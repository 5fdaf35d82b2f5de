"""Internal forces against the gradient of the energy, the matrix against the forces."""

import mujoco
import numpy as np
import palpate
import pytest
from benchmarks import scene
from benchmarks.accuracy import judge
from palpate.tissue import energy
from palpate.tissue.geometry import mesh as topology

SCALE = 0.05  # of the test surfaces [m]
YOUNG = 5000.0

# Every term by itself, all of them together, and open surfaces with pins.
TERMS = {
  "membrane": {"poisson": 0.3},
  "tension": {"poisson": 0.3, "tension": 5.0},
  "spring": {"elements": "spring", "stiffness": 20.0},
  "bending": {"young": (1e-6,), "bend": 1e10},
  "foundation": {"young": (1e-6,), "foundation": 2e4},
  "volume": {"young": (1e-6,), "bulk": 3e3},
  "pressure": {"young": (1e-6,), "pressure": 200.0},
  "solid": {"elements": "solid", "bend": 0.0},
  "all": {"bend": 30.0, "foundation": 2e4, "bulk": 3e3, "pressure": 200.0},
}
FREE = [name for name in TERMS if name not in ("foundation", "all")]


def _surface(scenes, name, **more):
  # An ellipsoid: a sphere's symmetry would hide mistakes.
  points, elem = scenes.sphere(1)
  config = TERMS[name] | more
  return scenes.kernels(points * [1, 0.8, 0.6] + [0.3, -0.2, 0.1], elem, **config)


def _displacement(mesh, size, seed=0):
  """Returns a random displacement of `size` times the radius."""
  return size * SCALE * np.random.RandomState(seed).uniform(-1, 1, (mesh.nvert, 3))


def _gradient(mesh, config, u, step=1e-7):
  """Returns the gradient of the energy [N] by central differences in float64."""
  out = np.zeros_like(u)
  for i in np.ndindex(*u.shape):
    ahead, behind = u.copy(), u.copy()
    ahead[i] += step
    behind[i] -= step
    out[i] = energy.total(mesh, config, ahead) - energy.total(mesh, config, behind)
  return out / (2 * step)


@pytest.mark.parametrize("size", [0.01, 0.3])
@pytest.mark.parametrize("name", list(TERMS))
def test_force_is_minus_the_gradient_of_the_energy(scenes, device, name, size):
  mesh, config, body = _surface(scenes, name, device=device)
  u = _displacement(mesh, size)
  expected = -_gradient(mesh, config, u)
  found = scenes.force(body, u)
  # float32 kernels; the differences are good to 1e-7.
  np.testing.assert_allclose(found, expected, atol=3e-5 * np.abs(expected).max())


def test_bending_force_of_a_sharply_folded_plate(scenes, device):
  points, elem = scenes.triangular(0.1, 0.05, 8, 5)
  mesh, config, body = scenes.kernels(points, elem, device=device, young=(1e-6,), bend=1e12)
  angle = np.deg2rad(130)
  x = np.maximum(points[:, 0] - 0.05, 0)
  u = np.zeros_like(points)
  u[:, 0], u[:, 2] = x * (np.cos(angle) - 1), x * np.sin(angle)
  u += _displacement(mesh, 0.005)
  expected = -_gradient(mesh, config, u)
  found = scenes.force(body, u)
  np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_force_with_a_modulus_of_each_element(scenes, device):
  nelem = 80
  young = tuple(YOUNG * np.random.RandomState(1).uniform(0.1, 3, nelem))
  mesh, config, body = _surface(scenes, "membrane", young=young, bend=5.0, device=device)
  assert mesh.nelem == nelem
  u = _displacement(mesh, 0.1)
  expected = -_gradient(mesh, config, u)
  found = scenes.force(body, u)
  np.testing.assert_allclose(found, expected, atol=3e-5 * np.abs(expected).max())


@pytest.mark.parametrize("elements", [{}, {"elements": "spring", "stiffness": 20.0}])
def test_force_on_an_open_surface(scenes, device, elements):
  points, elem = scenes.triangular(0.1, 0.05, 6, 4, jitter=0.2)
  mesh, config, body = scenes.kernels(points, elem, device=device, bend=10.0, **elements)
  u = _displacement(mesh, 0.1)
  expected = -_gradient(mesh, config, u)
  found = scenes.force(body, u)
  np.testing.assert_allclose(found, expected, atol=3e-5 * np.abs(expected).max())


@pytest.mark.parametrize("name", sorted(set(TERMS) - {"pressure", "tension", "all"}))
def test_no_force_at_rest_to_the_bit(scenes, device, name):
  mesh, _, body = _surface(scenes, name, device=device)
  found = scenes.force(body, np.zeros((mesh.nvert, 3)))
  # The volume is a float32 sum: 1e-6 of it, against a force of bulk times area.
  atol = 1e-5 * 3e3 * SCALE**2 if name == "volume" else 0
  np.testing.assert_allclose(found, 0, atol=atol)


@pytest.mark.parametrize("name", ["membrane", "spring", "bending", "volume"])
def test_a_rigid_motion_gives_no_force(scenes, device, name):
  mesh, _, body = _surface(scenes, name, device=device)
  a, b = 0.8, -1.3
  turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
  turn = turn @ np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
  x = mesh.rest - mesh.rest.mean(axis=0)
  rigid = scenes.force(body, x @ turn.T - x + [0.01, 0.02, -0.03])
  strained = scenes.force(body, _displacement(mesh, 0.1))
  # float32 keeps 7 digits of the coordinates, and a strain of 1e-7 where one of 0.1 is usual.
  np.testing.assert_allclose(rigid, 0, atol=2e-5 * np.abs(strained).max())


@pytest.mark.parametrize("name", FREE)
def test_internal_forces_have_no_resultant_and_no_torque(scenes, device, name):
  mesh, _, body = _surface(scenes, name, device=device)
  u = _displacement(mesh, 0.1)
  found = scenes.force(body, u)
  x = mesh.rest - mesh.rest.mean(axis=0) + u
  largest = np.abs(found).sum()
  assert np.abs(found.sum(axis=0)).max() < 1e-6 * largest
  assert np.abs(np.cross(x, found).sum(axis=0)).max() < 1e-6 * largest * SCALE


def _dense(body):
  """Returns the matrix A that the solver multiplies with, (3 nvert, 3 nvert) [kg]."""
  n = body.shape.nnode
  matrix = np.zeros((n, 3, n, 3))
  slot, fan = body.shape.slot_adr.numpy(), body.shape.fan_node.numpy()
  if body.is_solid:
    unit = body.state.step.numpy()[0, 1] * body.tissue.stiffness.numpy()[0]
    block = unit * body.system.half.numpy()[0].view(np.float16).astype(float)
  else:
    block = body.system.block.numpy()[0].astype(float)
  diag = body.system.diag.numpy()[0].astype(float)
  g = float(body.state.step.numpy()[0, 1])
  for i in range(n):
    slice_, lane = divmod(i, 8)
    matrix[i, :, i, :] += np.eye(3) * diag[slice_, lane]
    for row in range(slot[slice_], slot[slice_ + 1]):
      at = int(fan[row + 2 * slice_ + 1, lane])
      other = at // 24 * 8 + at % 8
      k = block[row, :, lane].reshape(3, 3)
      matrix[i, :, other, :] += k
      matrix[i, :, i, :] -= k
  matrix = matrix.reshape(3 * n, 3 * n)
  node = np.repeat(3 * body.shape.node.numpy(), 3) + np.tile(np.arange(3), body.shape.nvert)

  def per_node(array):
    values = array.numpy()[0].astype(float)
    return np.moveaxis(values, -1, 1).reshape(-1, 3)

  if body.has_bending:
    adr, col = body.shape.bend_adr.numpy(), body.shape.bend_node.numpy()
    gain, normal = body.tissue.bend_gain.numpy().astype(float), per_node(body.system.normal)
    plate = np.zeros((n, n))
    for i in range(n):
      slice_, lane = divmod(i, 8)
      for row in range(adr[slice_], adr[slice_ + 1]):
        plate[i, col[row, lane]] += gain[row, lane]
    whole = plate[:, None, :, None] * normal[:, :, None, None] * normal[None, None]
    matrix += g * whole.reshape(3 * n, 3 * n)
  if body.number("bulk"):
    area = per_node(body.system.areavec).ravel()
    matrix += g * body.number("bulk") / body.shape.volume0 / 36 * np.outer(area, area)
  return matrix[np.ix_(node, node)]


def _tensile(mesh, name):
  """Returns a displacement in which no membrane is compressed: inflation and a little noise."""
  centred = mesh.rest - mesh.rest.mean(axis=0)
  return 0.2 * centred + _displacement(mesh, 0.01)


@pytest.mark.parametrize("name", ["membrane", "tension", "spring", "foundation"])
def test_matrix_is_the_derivative_of_the_force_in_tension(scenes, name):
  # With bend = bulk = 0 A - M is (h^2 + h damping) K; at g = 1 and no mass it is K.
  mesh, config, body = _surface(scenes, name)
  u = _tensile(mesh, name)
  scenes.step(body, 1.0, u, beta=0.0)
  matrix = _dense(body) - np.eye(3 * mesh.nvert)
  scale = np.abs(matrix).max()
  np.testing.assert_allclose(matrix, matrix.T, atol=1e-5 * scale)
  for seed in range(3):
    v = np.random.RandomState(seed).uniform(-1, 1, u.shape)
    step = 1e-5
    change = _gradient(mesh, config, u + step * v) - _gradient(mesh, config, u - step * v)
    expected = change / (2 * step)
    found = (matrix @ v.ravel()).reshape(v.shape)
    # Second differences of the energy are good to about 1e-4.
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


def _fan() -> tuple[np.ndarray, np.ndarray]:
  """Returns triangles around a vertex whose others are on a line: hinges have one curvature."""
  line = [[x, 0.0, 0.0] for x in (0.0, 0.011, 0.021, 0.032, 0.04)]
  elem = [[0, k, k + 1] for k in range(1, 5)]
  return np.array([[0.018, 0.015, 0.0], *line]), np.array(elem)


@pytest.mark.parametrize("shape", ["sheet", "fan"])
def test_bending_matrix_is_the_derivative_at_rest(scenes, shape):
  # A flat plate: out-of-plane stiffness is bending alone.
  points, elem = scenes.triangular(0.1, 0.05, 6, 4) if shape == "sheet" else _fan()
  mesh, config, body = scenes.kernels(points, elem, young=(1e-6,), bend=1e12)
  scenes.step(body, 1.0, np.zeros_like(points), beta=0.0)
  matrix = _dense(body) - np.eye(3 * mesh.nvert)
  v = np.zeros_like(points)
  v[:, 2] = np.random.RandomState(0).uniform(-1, 1, mesh.nvert)
  step = 1e-6
  expected = (_gradient(mesh, config, step * v) - _gradient(mesh, config, -step * v)) / (2 * step)
  found = (matrix @ v.ravel()).reshape(v.shape)
  np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_volume_matrix_is_the_derivative_but_for_its_geometric_part(scenes):
  mesh, config, body = _surface(scenes, "volume")
  scenes.step(body, 1.0, np.zeros((mesh.nvert, 3)), beta=0.0)
  matrix = _dense(body) - np.eye(3 * mesh.nvert)
  v = np.random.RandomState(0).uniform(-1, 1, (mesh.nvert, 3))
  step = 1e-6  # at V = V0 the geometric part is zero
  zero = np.zeros_like(v)
  change = _gradient(mesh, config, zero + step * v) - _gradient(mesh, config, zero - step * v)
  expected = change / (2 * step)
  found = (matrix @ v.ravel()).reshape(v.shape)
  np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


@pytest.mark.parametrize("name", list(TERMS))
@pytest.mark.parametrize("factor", [-0.4, 0.2])
def test_matrix_is_positive_definite_under_compression_too(scenes, name, factor):
  mesh, _, body = _surface(scenes, name)
  centred = mesh.rest - mesh.rest.mean(axis=0)
  u = factor * centred + _displacement(mesh, 0.1)
  mass = 1e-6
  scenes.step(body, 1.0, u, mass=mass, beta=0.0)
  matrix = _dense(body)
  lowest = np.linalg.eigvalsh(0.5 * (matrix + matrix.T)).min()
  assert lowest > 0 or lowest > -2e-7 * np.abs(matrix).max()  # float32


def test_blocks_of_16_bits_leave_the_matrix_of_a_turned_solid_positive_definite(scenes):
  # Its lowest motions, turns, have no stiffness of their own; rounding takes 1e-6 of the highest.
  mesh, _, body = scenes.kernels(*scenes.sphere(2), elements="solid", young=(5e3,))
  a = 0.5
  turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
  scenes.step(body, 1.0, mesh.rest @ turn.T - mesh.rest, mass=1e-6, beta=0.0)
  matrix = _dense(body)
  np.testing.assert_allclose(matrix, matrix.T, atol=2e-4 * np.abs(matrix).max())
  assert np.linalg.eigvalsh(0.5 * (matrix + matrix.T)).min() > -1e-8 * np.abs(matrix).max()


def test_a_free_solid_turns_as_a_rigid_body_does(scenes, device):
  mesh, _, body = scenes.kernels(*scenes.sphere(2), elements="solid", young=(5e3,), device=device)
  arm = mesh.rest - mesh.rest.mean(axis=0)
  spin = np.cross([0.0, 0.0, 30.0], arm)  # [m/s^2], with masses of 1 g
  found = scenes.step(body, 1e-3, 0 * arm, mass=1e-3, force=1e-3 * spin)
  np.testing.assert_allclose(found, 1e-3 * spin, atol=3e-4 * np.abs(1e-3 * spin).max())


def test_stiffness_of_a_pinned_vertex_does_not_move_it(scenes, device):
  points, elem = scenes.triangular(0.1, 0.05, 6, 4)
  mesh, _, body = scenes.kernels(points, elem, device=device, pin=(0, 5), bend=1.0)
  dvel = scenes.step(body, 1e-3, _displacement(mesh, 0.05), force=[0, 0, -1])
  np.testing.assert_array_equal(dvel[[0, 5]], 0)
  assert (np.abs(np.delete(dvel, [0, 5], axis=0)).max(axis=1) > 0).all()


def test_area_vectors_are_six_times_the_gradient_of_the_volume(scenes):
  mesh, _, body = _surface(scenes, "volume")
  u = _displacement(mesh, 0.1)
  scenes.step(body, 1.0, u)
  found = scenes.get(body, body.system.areavec) / 6
  x, step = mesh.rest + u, 1e-6
  for i in np.ndindex(3, 3):
    move = np.zeros_like(x)
    move[i] = step
    ahead, behind = (topology.volume(x + side * move, mesh.elem) for side in (1, -1))
    assert found[i] == pytest.approx((ahead - behind) / (2 * step), rel=1e-3, abs=1e-7)


@pytest.mark.parametrize("start", ["flattened", "folded", "inverted"])
def test_a_crushed_organ_does_not_gain_energy(start):
  # Triangles without area have hinges of no height, whose force must fade and not blow up.
  mesh = scene.shape("sphere", 642)
  tissue = scene.Tissue(young=1e4, foundation=3200, bend=1)
  model = scene.build(mesh, tissue, "implicit", 1e-3)
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "organ")
  organ.set_state(mesh.rest + judge.start_state(mesh, start))
  at_first = organ.energy
  for _ in range(60):
    mujoco.mj_step(model, data)
    kinetic = 0.5 * tissue.mass / mesh.nvert * (organ.xvel**2).sum()
    assert organ.energy + kinetic < 1.02 * at_first
  assert organ.error is None
