"""The multilevel preconditioner: the same answer as block Jacobi, iterations that do not grow."""

import numpy as np
import pytest
import warp as wp
from palpate.models.meshing import grid
from palpate.tissue import body as bodies
from palpate.tissue import coarse
from palpate.tissue import shape as making
from palpate.tissue import step as stepping
from palpate.tissue.config import Config
from palpate.tissue.geometry import mesh as topology

H = 1e-3
MASS = 0.1
RADIUS = 0.05


def _sphere(frequency: int) -> tuple[np.ndarray, np.ndarray]:
  points, elem = grid.octasphere(frequency)
  return np.asarray(points) * RADIUS, np.asarray(elem)


def _blob(subdivisions: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns an uneven organ: a bent and squeezed sphere with edges of 1 to 4."""
  import trimesh

  mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
  x = np.array(mesh.vertices)
  x += 0.1 * np.random.RandomState(0).uniform(-1, 1, x.shape) / 2**subdivisions
  x[:, 2] += 0.6 * x[:, 0] ** 2
  x *= np.array([1.0, 0.7, 0.35]) * (0.6 + 0.4 * x[:, :1])
  return RADIUS * x, np.array(mesh.faces)


def _tube(n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns an open tube of n by m nodes."""
  a, z = np.meshgrid(2 * np.pi * np.arange(n) / n, np.linspace(0, 0.1, m), indexing="ij")
  points = np.stack([0.02 * np.cos(a), 0.02 * np.sin(a), z], -1).reshape(-1, 3)
  i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(m - 1), indexing="ij"))
  p, q = i * m + j, (i + 1) % n * m + j
  return points, np.concatenate([np.stack([p, q, p + 1], 1), np.stack([q, q + 1, p + 1], 1)])


def _organ(shape, device="cpu", nworld=1, pin=None, scale=np.inf, **config):
  """Returns mesh and body with coarse meshes."""
  mesh = topology.build("organ", *shape)
  config = {"young": (3e6,), "poisson": 0.3, "tolerance": 1e-4, "iterations": 2000} | config
  low = mesh.rest[:, 2] < mesh.rest[:, 2].min() + 0.05 * np.ptp(mesh.rest[:, 2])
  pinned = low if pin is None else np.isin(np.arange(mesh.nvert), pin)
  return mesh, making.make(mesh, Config(**config), pinned, device, scale, nworld)


def _step(scenes, mesh, body, threshold, **state):
  """Returns the change of velocity, iterations and residual with a threshold in force."""
  body.levels.transfer.threshold = threshold
  top = mesh.rest[np.argmax(mesh.rest[:, 2])]
  near = np.linalg.norm(mesh.rest - top, axis=1) < 0.12 * RADIUS
  state = {"u": 0.0, "force": near[:, None] * [0, 0, -1.0] / near.sum()} | state
  found = scenes.step(body, H, mass=MASS / mesh.nvert, **state)
  return found, *body.system.status.numpy()[0, :2]


def _both(scenes, mesh, body, **state):
  jacobi = _step(scenes, mesh, body, np.inf, **state)
  return jacobi, _step(scenes, mesh, body, 0.0, **state)


TERMS = {
  "membrane": {"bend": 0.0},
  "bending": {},
  "volume": {"bulk": 1e5, "pressure": 100.0, "foundation": 1e5},
  "spring": {"elements": "spring", "stiffness": 5e3, "bend": 0.0},
  "newton": {"newton": 2},
}


@pytest.mark.parametrize("terms", TERMS.values(), ids=TERMS.keys())
def test_the_answer_is_that_of_block_jacobi(scenes, device, terms):
  mesh, body = _organ(_sphere(13), device, tolerance=1e-6, **terms)
  u = 1e-4 * np.random.RandomState(0).standard_normal(mesh.rest.shape)
  v = 0.1 * np.random.RandomState(1).standard_normal(mesh.rest.shape)
  (expected, many, _), (found, few, residual) = _both(scenes, mesh, body, u=u, v=v)
  assert residual <= 1e-6
  assert few < 0.5 * many
  np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


SHAPES = {"sphere": _sphere(25), "blob": _blob(4), "tube": _tube(48, 60)}


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
@pytest.mark.parametrize("bend", [0.0, 1.0], ids=["membrane", "bending"])
def test_uneven_and_open_meshes_take_few_iterations_too(scenes, device, shape, bend):
  mesh, body = _organ(shape, device, bend=bend)
  (expected, many, _), (found, few, _) = _both(scenes, mesh, body)
  assert few <= 40
  assert few < 0.25 * many
  np.testing.assert_allclose(found, expected, atol=5e-3 * np.abs(expected).max())


@pytest.mark.parametrize("bend", [0.0, 1.0], ids=["membrane", "bending"])
def test_iterations_hardly_grow_with_the_nodes(scenes, device, bend):
  # Block Jacobi's grow as the square root of nodes times stiffness.
  count = {}
  for frequency in (13, 25, 50):
    mesh, body = _organ(_sphere(frequency), device, young=(3e5,), bend=bend)
    count[frequency] = [int(result[1]) for result in _both(scenes, mesh, body)]
  assert count[50][0] > 2 * count[13][0]
  assert count[50][1] <= 12 and count[50][1] <= 3 * count[13][1]


@pytest.mark.slow
@pytest.mark.parametrize("young", [3e4, 3e6])
@pytest.mark.parametrize("frequency, bound", [(128, 20), (256, 25)], ids=["65538", "262146"])
def test_large_organs_take_few_iterations(scenes, device, frequency, bound, young):
  mesh, body = _organ(_sphere(frequency), device, young=(young,), bend=0.0)
  assert _step(scenes, mesh, body, 0.0)[1] <= bound


def test_a_pressed_shape_takes_hardly_more_iterations_than_the_rest_shape(scenes, device):
  mesh, body = _organ(_sphere(25), device, young=(3e5,))
  top = np.exp(-((mesh.rest - [0, 0, RADIUS]) ** 2).sum(axis=1) / (0.3 * RADIUS) ** 2)
  count = [
    _step(scenes, mesh, body, 0.0, u=depth * top[:, None] * [0.3, 0.0, -1.0])[1]
    for depth in (0.0, 0.2 * RADIUS)
  ]
  assert count[1] <= 1.5 * count[0] + 2


@pytest.mark.parametrize("pin", [[], [0], list(range(0, 2502, 40))], ids=["none", "one", "many"])
def test_pinned_nodes_stay(scenes, device, pin):
  mesh, body = _organ(_sphere(25), device, pin=pin)
  (expected, many, _), (found, few, _) = _both(scenes, mesh, body)
  assert few < 0.5 * many
  np.testing.assert_array_equal(found[pin], 0)
  np.testing.assert_allclose(found, expected, atol=5e-3 * np.abs(expected).max())


def test_worlds_are_independent_and_repeat_to_the_bit(scenes, device):
  mesh, many = _organ(_sphere(13), device, nworld=2, bulk=1e4)
  one = bodies.worlds(many)
  u = np.stack([1e-4 * np.random.RandomState(k).standard_normal(mesh.rest.shape) for k in (0, 1)])
  _step(scenes, mesh, many, 0.0, u=u)
  together = [scenes.get(many, many.state.dvel, world) for world in range(2)]
  for world in range(2):
    for _ in range(2):
      np.testing.assert_array_equal(_step(scenes, mesh, one, 0.0, u=u[world])[0], together[world])


def test_a_graph_replays_the_step(scenes, device):
  mesh, body = _organ(_sphere(13), device)
  expected, _, _ = _step(scenes, mesh, body, 0.0)
  with wp.ScopedDevice(body.device):
    with wp.ScopedCapture(device=body.device) as capture:
      stepping.step(body)
    body.state.dvel.zero_()
    wp.capture_launch(capture.graph)
  np.testing.assert_array_equal(scenes.get(body, body.state.dvel), expected)


def test_uneven_stiffness_reaches_the_coarse_meshes(scenes, device):
  points, elem = _sphere(25)
  hard = points[elem].mean(axis=1)[:, 0] > 0
  mesh, body = _organ((points, elem), device, young=tuple(np.where(hard, 3e6, 3e4)))
  (_, many, _), (_, few, _) = _both(scenes, mesh, body)
  assert few < 0.25 * many


def test_a_matrix_out_of_the_smoothers_range_is_solved_all_the_same(scenes, device):
  # The smoother's interval is far too low here: the cycle is indefinite and gives way.
  mesh, body = _organ(_sphere(13), device)
  expected, many, _ = _step(scenes, mesh, body, np.inf)
  rate = body.levels.transfer.rate.numpy()
  rate[:, 1:3] *= 0.3
  body.levels.transfer.rate.assign(rate)
  found, count, residual = _step(scenes, mesh, body, 0.0)
  assert residual <= 1e-4 and count <= many + 5
  np.testing.assert_allclose(found, expected, atol=5e-3 * np.abs(expected).max())


def test_soft_and_small_organs_do_without(scenes):
  # sqrt(condition) iterations are few there, and fewer on a membrane: see `coarse.pay`.
  scale = (H * H + H * 0.002) / (MASS / 1446)
  thick = {"thickness": 0.004, "scale": scale}
  assert _organ(_sphere(19), young=(3e3,), **thick)[1].levels is None
  assert _organ(_sphere(19), young=(3e6,), **thick)[1].levels is not None
  assert _organ(_sphere(19), young=(3e6,), bend=0.0, **thick)[1].levels is None
  assert _organ(_sphere(13), young=(3e6,), **thick)[1].levels is None


def test_a_shorter_step_uses_block_jacobi_by_itself(scenes, device):
  mesh, body = _organ(_sphere(13), device, young=(3e5,))
  threshold = body.levels.transfer.threshold = 5.0

  def iterations(h, threshold):
    body.levels.transfer.threshold = threshold
    force = np.zeros((mesh.nvert, 3))
    force[0] = 1.0
    scenes.step(body, h, np.zeros((mesh.nvert, 3)), mass=MASS / mesh.nvert, force=force)
    return body.system.status.numpy()[0, 0]

  assert iterations(1e-3, threshold) == iterations(1e-3, 0.0) < iterations(1e-3, np.inf)
  assert iterations(1e-5, threshold) == iterations(1e-5, np.inf)


def test_stiff_organs_run_in_mujoco_with_coarse_meshes(scenes):
  found = {}
  for young in (3e3, 3e6):
    keys = {"young": young, "bulk": 1e4, "thickness": 0.004}
    model, data, organ = scenes.load(scenes.press(subdivisions=4, **keys))
    found[young] = scenes.workspace(organ).organ.still.levels
    scenes.run(model, data, 30, deepest=0.001)
    assert organ.error is None and organ.residual <= 1e-4
  assert found[3e3] is None and found[3e6].transfer.nlevel >= 1
  assert organ.iterations <= 15


@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES.keys())
def test_coarse_meshes_are_good_surfaces(shape):
  mesh = topology.build("organ", *shape)
  levels = coarse.build(mesh, 64)
  assert len(levels) >= 2
  finer = mesh
  for level in levels:
    assert 0.2 * finer.nvert <= level.mesh.nvert <= 0.45 * finer.nvert or level is levels[-1]
    np.testing.assert_array_equal(level.mesh.rest, mesh.rest[level.vert])
    # Weights interpolate: positive, at most four, exact for constants, near for positions.
    assert level.weight.data.min() > 0
    assert np.diff(level.weight.indptr).max() <= 4
    np.testing.assert_allclose(level.weight.sum(axis=1), 1, rtol=1e-12)
    edge = np.linalg.norm(
      level.mesh.rest[level.mesh.elem] - level.mesh.rest[level.mesh.elem[:, [1, 2, 0]]], axis=2
    )
    moved = np.linalg.norm(level.weight @ level.mesh.rest - finer.rest, axis=1)
    assert moved.max() < edge.max()
    assert np.median(moved) < 0.2 * np.median(edge)
    finer = level.mesh
  assert levels[0].mesh.closed == mesh.closed


def test_an_organ_without_coarse_meshes_pays_nothing(scenes, device):
  _, body = _organ(_sphere(6), device, scale=0.0)
  assert body.levels is None
  assert body.system.e.size == body.system.en.size == 0
