"""Closed forms of plates and membranes, through mj_step: strips, spheres and plates."""

import mujoco
import numpy as np
import pytest
from palpate.tissue.geometry import mesh as topology

THICKNESS = 0.002

# Steps so long that a few of them are the equilibrium; light nodes keep the residual floor low.
STATIC = {"iterations": 5000, "tolerance": 1e-5, "thickness": THICKNESS}
LONG = 1.0


def _load(scenes, organ, data, forces):
  data.qfrc_applied[scenes.dofs(organ)] = forces[organ.free]


def _edge_load(points, at, force):
  """Returns forces that spread `force` evenly along the edge of vertices `at`, corners half."""
  share = np.ones(len(at))
  across = points[at, 1]
  share[[np.argmin(across), np.argmax(across)]] = 0.5
  out = np.zeros(points.shape)
  out[at] = share[:, None] / share.sum() * force
  return out


@pytest.mark.parametrize("stretch", [1.001, 1.1])
@pytest.mark.parametrize(("young", "nu"), [(5e3, 0.45), (3e4, 0.0), (1e6, 0.3)])
def test_a_strip_in_tension_has_its_young_and_poisson(scenes, device, young, nu, stretch):
  length, width = 0.1, 0.02
  points, elem = scenes.strip(length, width, 20, 4)
  middle = int(np.argmin(np.abs(points - [length / 2, 0, 0]).sum(axis=1)))
  config = STATIC | {"young": young, "poisson": nu, "bend": 0, "device": device}
  xml = scenes.world(scenes.organ(points, elem, mass=1e-3, pin=[middle], **config), h=LONG)
  model, data, organ = scenes.load(xml)
  # St. Venant-Kirchhoff in uniaxial tension: force over rest section = E (s^2 - 1) / 2 s.
  pull = young * (stretch**2 - 1) / 2 * stretch * width * THICKNESS
  left, right = (np.flatnonzero(np.abs(points[:, 0] - x) < 1e-9) for x in (0, length))
  along = np.array([pull, 0, 0])
  _load(scenes, organ, data, _edge_load(points, right, along) - _edge_load(points, left, along))
  scenes.settle(model, data, organ)
  extent = np.ptp(organ.xpos, axis=0)
  # Constant strain is exact in linear triangles: what is left is float32 and the solver.
  assert extent[0] / length - 1 == pytest.approx(stretch - 1, rel=1e-4)
  lateral = np.sqrt(1 - nu * (stretch**2 - 1)) - 1
  assert extent[1] / width - 1 == pytest.approx(lateral, rel=1e-3, abs=1e-5 * (stretch - 1))


@pytest.mark.parametrize("jitter", [0.0, 0.2])
def test_patch_with_a_linear_boundary_displacement_is_linear_inside(scenes, device, jitter):
  # Displacements of the boundary are an affine map; then the equilibrium is affine everywhere.
  points, elem = scenes.triangular(0.06, 0.0519615, 6, 6, jitter)
  inside = (points[:, 0] > 1e-9) & (points[:, 0] < 0.06 - 1e-9)
  inside &= np.abs(points[:, 1]) < 0.0519615 / 2 - 1e-9
  affine = np.array([[1.02, 0.01, 0], [0.015, 1.0, 0], [0, 0, 1]])
  config = {key: value for key, value in STATIC.items() if key != "tolerance"}
  # The rest shape is the undeformed one: hold the boundary where the map puts it.
  mesh, _, body = scenes.kernels(
    points, elem, device=device, pin=np.flatnonzero(~inside), tolerance=1e-7, **config
  )
  u = np.where(inside[:, None], 0, points @ affine.T - points)
  for _ in range(20):  # long steps without inertia: Newton's method for the equilibrium
    u = u + LONG * scenes.step(body, LONG, u, mass=1e-6)
  np.testing.assert_allclose(u, points @ affine.T - points, atol=1e-5 * np.abs(u).max())
  assert mesh.nvert == len(u)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_a_sphere_grows_under_pressure(scenes, device, nu):
  radius, young = scenes.RADIUS, 5e3
  points, elem = scenes.sphere(3)
  expected = 1e-3 * radius
  pressure = expected * 2 * young * THICKNESS / (radius**2 * (1 - nu))
  config = STATIC | {"young": young, "poisson": nu, "pressure": pressure, "device": device}
  xml = scenes.world(scenes.organ(points, elem, mass=1e-3, **config), h=LONG)
  model, data, organ = scenes.load(xml)
  scenes.settle(model, data, organ)
  growth = np.linalg.norm(organ.xpos - organ.xpos.mean(axis=0), axis=1).mean() - radius
  # 642 vertices: the polyhedron is 0.6 % smaller than the sphere, the deformation 0.1 %.
  assert growth == pytest.approx(expected, rel=1e-2)
  rest = topology.volume(points, elem)
  assert organ.volume / rest - 1 == pytest.approx(3e-3, rel=2e-2)


# Meshes of a strip by name, (points, elem) = f(scenes, length, width, nx, ny).
STRIPS = {
  "grid": lambda s, *size: _grid(s, *size),
  "triangular": lambda s, *size: s.triangular(*size),
  "irregular": lambda s, *size: s.triangular(*size, jitter=0.15),
  "alternating": lambda s, *size: s.strip(*size),
}


def _grid(scenes, length, width, nx, ny):
  """Returns the strip of scenes.strip with all diagonals parallel, as MuJoCo's grids have them."""
  points, _ = scenes.strip(length, width, nx, ny)
  a = (np.arange(nx)[:, None] * (ny + 1) + np.arange(ny)).ravel()
  b, c, d = a + ny + 1, a + ny + 2, a + 1
  return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _bent_strip(scenes, device, kind, nu, length, width, nx, ny):
  """Returns tip deflection over that of the beam, F L^3 / (3 E I)."""
  young, edge = 5e3, length / nx
  points, elem = STRIPS[kind](scenes, length + 2 * edge, width, nx + 2, ny)
  points = points - [2 * edge, 0, 0]
  clamped = np.flatnonzero(points[:, 0] < 0.25 * edge)
  config = STATIC | {"young": young, "poisson": nu, "device": device}
  xml = scenes.world(scenes.organ(points, elem, mass=1e-5, pin=clamped, **config), h=LONG)
  model, data, organ = scenes.load(xml)
  # Vertices on both sides of x = 0 turn about it: the strip is clamped half an edge before it.
  span = length + 0.5 * edge
  inertia = width * THICKNESS**3 / 12
  sag = 0.01 * length
  force = sag * 3 * young * inertia / span**3
  tip = np.flatnonzero(points[:, 0] > length - 1e-9)
  load = _edge_load(points, tip, np.array([0, 0, -force]))
  _load(scenes, organ, data, load)
  scenes.settle(model, data, organ, still=2e-4)  # as still as float32 lets so slender a strip be
  return -(organ.displacement[:, 2] * load[:, 2]).sum() / load[:, 2].sum() / sag


@pytest.mark.parametrize("kind", STRIPS)
@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_a_clamped_strip_bends_as_a_beam(scenes, device, kind, nu):
  edge = 0.1 / 30  # of some numbers of edges float32 leaves the strip moving
  ratio = _bent_strip(scenes, device, kind, nu, 0.1, 4 * edge * 0.866, 30, 4)
  # Discretisation; with nu > 0 the clamp also holds the section flat over about a width.
  assert ratio == pytest.approx(1, abs=0.03)


def test_a_wide_clamped_plate_bends_as_a_cylinder(scenes, device):
  nu = 0.45
  ratio = _bent_strip(scenes, device, "triangular", nu, 0.04, 48 * 0.866 * 0.005, 8, 48)
  # D = E t^3 / (12 (1 - nu^2)); the free sides, five spans apart, bend a little more.
  assert ratio / (1 - nu**2) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("clamped", [False, True], ids=["supported", "clamped"])
def test_a_square_plate_sags_under_a_uniform_load(scenes, device, clamped):
  side, young, nu, nx, ny = 0.1, 5e3, 0.3, 24, 28
  points, elem = scenes.triangular(side, side, nx, ny)
  border = 1.5 * side / ny if clamped else 1e-9
  x, y = np.abs(points[:, 0] - side / 2), np.abs(points[:, 1])
  pin = np.flatnonzero(np.maximum(x, y) > side / 2 - border)
  config = STATIC | {"young": young, "poisson": nu, "device": device}
  xml = scenes.world(scenes.organ(points, elem, mass=1e-4, pin=pin, **config), h=LONG)
  model, data, organ = scenes.load(xml)
  # Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, tables 8 and 35.
  alpha = 0.00126 if clamped else 0.00406
  span = side - 0.5 * (side / nx + side / ny) if clamped else side  # half way between pinned rows
  rigidity = young * THICKNESS**3 / (12 * (1 - nu * nu))
  sag = 1e-2 * THICKNESS
  pressure = sag * rigidity / (alpha * span**4)
  force = np.zeros(points.shape)
  force[:, 2] = -pressure * topology.vertex_areas(points, elem)
  _load(scenes, organ, data, force)
  scenes.settle(model, data, organ, still=1e-4)
  found = -organ.displacement[:, 2].min()
  # Corners of a supported plate would lift; the pinned ones hold them as the theory does.
  assert found == pytest.approx(sag, rel=0.03)


@pytest.mark.parametrize("nu", [0.0, 0.45])
def test_a_free_sheet_under_tension_shrinks_as_much_as_it_was_stretched(scenes, device, nu):
  young, tension = 1e4, 2.0
  points, elem = scenes.triangular(0.06, 0.052, 6, 6)
  middle = int(np.argmin(np.abs(points - [0.03, 0, 0]).sum(axis=1)))
  config = STATIC | {"young": young, "poisson": nu, "bend": 0, "tension": tension, "device": device}
  xml = scenes.world(scenes.organ(points, elem, mass=1e-3, pin=[middle], **config), h=LONG)
  model, data, organ = scenes.load(xml)
  slack = np.sqrt(1 - 2 * tension * (1 - nu) / (young * THICKNESS))  # E = -T (1 - nu) / (E t)
  stretched = THICKNESS * young / (1 - nu) * ((1 - slack**2) / 2) ** 2 * 0.06 * 0.052
  assert organ.energy == pytest.approx(stretched, rel=1e-5)
  mujoco.mj_step(model, data, 30)  # it may turn around the vertex that is pinned
  far = np.linalg.norm(points - points[middle], axis=1)
  found = np.linalg.norm(organ.xpos - points[middle], axis=1)
  np.testing.assert_allclose(found, slack * far, atol=2e-7)
  assert organ.energy < 1e-6 * stretched


def test_a_held_membrane_under_tension_sags_on_a_foundation(scenes, device):
  # T laplace(w) - k w + p = 0 with p = P sin(pi x / a) sin(pi y / a): w = p / (k + 2 T pi^2 / a^2).
  side, tension, bed, pressure = 0.1, 3.0, 4e3, 1.0
  points, elem = scenes.triangular(side, side, 24, 28)
  x, y = points[:, 0], points[:, 1] + side / 2
  pin = np.flatnonzero((np.minimum(x, side - x) < 1e-9) | (np.minimum(y, side - y) < 1e-9))
  config = STATIC | {"young": 1.0, "bend": 0, "tension": tension, "foundation": bed}
  xml = scenes.world(
    scenes.organ(points, elem, mass=1e-4, pin=pin, device=device, **config), h=LONG
  )
  model, data, organ = scenes.load(xml)
  shape = np.sin(np.pi * x / side) * np.sin(np.pi * y / side)
  force = np.zeros(points.shape)
  force[:, 2] = -pressure * shape * topology.vertex_areas(points, elem)
  _load(scenes, organ, data, force)
  scenes.settle(model, data, organ, still=1e-4)
  sag = pressure / (bed + 2 * tension * (np.pi / side) ** 2)
  np.testing.assert_allclose(-organ.displacement[:, 2], sag * shape, atol=0.01 * sag)
