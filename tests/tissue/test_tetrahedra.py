"""Solids: tetrahedra inside a surface, against closed forms of elasticity."""

import dataclasses

import numpy as np
import pytest
from palpate.models import shapes
from palpate.tissue import config as configuration
from palpate.tissue import energy, fill
from palpate.tissue import mesh as topology

YOUNG, DENSITY = 5000.0, 1000.0
LENGTH, SIDE = 0.1, 0.04


def _masses(mesh):
  return DENSITY * fill.vertex_volumes(mesh)


def _bar(scenes, poisson, spacing):
  """Returns mesh and body of a bar along x, held at one end, and what its other end carries."""
  points, elem = scenes.box((LENGTH, SIDE, SIDE), spacing)
  pin = np.flatnonzero(points[:, 0] < -LENGTH / 2 + 1e-9)
  made = {"elements": "solid", "poisson": poisson, "young": (YOUNG,)}
  mesh, _, body = scenes.kernels(points, elem, pin=pin, tolerance=1e-5, iterations=2000, **made)
  end = np.abs(mesh.rest[: mesh.nouter, 0] - LENGTH / 2) < 1e-9
  share = topology.vertex_areas(mesh.rest, mesh.elem[end[mesh.elem].all(axis=1)])
  return mesh, body, share / share.sum()


def _settled(scenes, mesh, body, force):
  """Returns the displacement at which forces hold a body in equilibrium [m]."""
  u = np.zeros((mesh.nvert, 3))
  for _ in range(20):  # steps that keep no speed
    u = u + 0.5 * scenes.step(body, 0.5, u, mass=_masses(mesh), force=force, beta=0.0)
  return u


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.49])
def test_small_uniform_strains_have_the_energy_of_linear_elasticity(scenes, poisson):
  points, elem = scenes.box((0.1, 0.08, 0.06), 0.02)
  made = {"elements": "solid", "poisson": poisson, "young": (YOUNG,)}
  mesh, config, _ = scenes.kernels(points, elem, **made)
  mu, lam = configuration.lame_solid(np.array(YOUNG), poisson)
  shear = np.eye(3)[[1, 2, 0]]
  for gradient in (np.diag([1e-4, 0, 0]), np.diag([1e-4, -2e-4, 3e-4]), 1e-4 * shear):
    strain = (gradient + gradient.T) / 2
    density = mu * (strain**2).sum() + lam / 2 * np.trace(strain) ** 2
    found = energy.solid(mesh, config, mesh.rest @ gradient.T)
    assert found == pytest.approx(0.1 * 0.08 * 0.06 * density, rel=2e-3)


@pytest.mark.parametrize("poisson", [0.3, 0.45])
def test_a_bar_in_tension_has_its_young(scenes, device, poisson):
  points, elem = scenes.box((LENGTH, SIDE, SIDE), 0.02)
  made = {"elements": "solid", "poisson": poisson, "young": (YOUNG,), "device": device}
  mesh, _, body = scenes.kernels(points, elem, tolerance=1e-5, iterations=2000, **made)
  # Pulled at both ends, so that nothing hinders it from getting thinner.
  force = np.zeros((mesh.nvert, 3))
  for sign in (-1, 1):
    end = np.abs(mesh.rest[: mesh.nouter, 0] - sign * LENGTH / 2) < 1e-9
    share = topology.vertex_areas(mesh.rest, mesh.elem[end[mesh.elem].all(axis=1)])
    force[:, 0] += sign * 0.02 * share / share.sum()
  u = _settled(scenes, mesh, body, force)
  stretch = np.polyfit(mesh.rest[:, 0], u[:, 0], 1)[0]
  thinner = -np.polyfit(mesh.rest[:, 1], u[:, 1], 1)[0]
  assert stretch == pytest.approx(0.02 / (YOUNG * SIDE**2), rel=0.03)
  assert thinner / stretch == pytest.approx(poisson, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("poisson", [0.3, 0.49])
def test_a_cantilever_bends_more_like_a_beam_the_finer_it_is(scenes, poisson):
  # Linear tetrahedra are too stiff in bending; without averages, 0.49 would hardly bend at all.
  second, shear = SIDE**4 / 12, YOUNG / (2 * (1 + poisson))
  load = 0.002
  beam = load * LENGTH * (LENGTH**2 / (3 * YOUNG * second) + 1.2 / (shear * SIDE**2))
  found = []
  for spacing in (0.02, 0.01, 0.00667):
    mesh, body, share = _bar(scenes, poisson, spacing)
    u = _settled(scenes, mesh, body, np.outer(load * share, [0, 0, 1]))
    found.append(float(share @ u[:, 2]) / beam)
  assert found[0] < found[1] < found[2] < 1.05
  assert found[2] > 0.7


def test_equal_tension_everywhere_swells_by_the_bulk_modulus(scenes, device):
  points, elem = scenes.sphere(2)
  made = {"elements": "solid", "poisson": 0.45, "young": (YOUNG,), "device": device}
  mesh, _, body = scenes.kernels(points, elem, tolerance=1e-5, iterations=2000, **made)
  outward = np.zeros((mesh.nvert, 3))
  area = topology.area_vectors(mesh.rest, mesh.elem)
  np.add.at(outward, mesh.elem.ravel(), np.repeat(area, 3, axis=0))
  u = _settled(scenes, mesh, body, 50.0 / 3 * outward)
  before, after = (topology.volume(mesh.rest + part, mesh.elem) for part in (0 * u, u))
  bulk = YOUNG / (3 * (1 - 2 * 0.45))
  assert after / before - 1 == pytest.approx(50.0 / bulk, rel=0.02)


@pytest.mark.parametrize("start", ["squeezed", "turned inside out", "random"])
@pytest.mark.parametrize("poisson", [0.3, 0.45, 0.49])
@pytest.mark.parametrize("h", [1e-3, 5e-3])
def test_a_crushed_solid_does_not_gain_energy(scenes, start, poisson, h):
  points, elem = scenes.sphere(2)
  made = {"elements": "solid", "poisson": poisson, "young": (YOUNG,)}
  mesh, config, body = scenes.kernels(points, elem, damping=0.002, **made)
  size, random = 0.05, np.random.RandomState(0)
  u = {
    "squeezed": mesh.rest * [0, 0, -0.9],
    "turned inside out": mesh.rest * [0, 0, -1.8],
    "random": size * random.uniform(-0.2, 0.2, mesh.rest.shape),
  }[start]
  mass, v = _masses(mesh), np.zeros_like(u)
  at_first = energy.total(mesh, config, u)
  for _ in range(40):
    v = v + scenes.step(body, h, u, v, mass)
    u = u + h * v
    kinetic = 0.5 * (mass[:, None] * v**2).sum()
    assert energy.total(mesh, config, u) + kinetic < 1.001 * at_first


def test_a_modulus_of_each_triangle_goes_as_deep_as_it_is_nearest(scenes):
  points, elem = scenes.box((0.1, 0.04, 0.04), 0.01)
  right = points[elem].mean(axis=1)[:, 0] > 0
  young = np.where(right, 10 * YOUNG, YOUNG)
  made = {"elements": "solid", "poisson": 0.3}
  mesh, config, _ = scenes.kernels(points, elem, young=tuple(young), **made)
  _, soft, _ = scenes.kernels(points, elem, young=(YOUNG,), **made)
  lump, without = (energy.solid(mesh, each, mesh.rest * 1e-3) for each in (config, soft))
  assert lump / without == pytest.approx(5.5, rel=0.05)


# The tetrahedra.


@pytest.mark.parametrize("name", ["liver", "stomach", "gallbladder", "kidney"])
def test_tetrahedra_fill_an_organ_and_end_at_its_triangles(name):
  points, elem = getattr(shapes, name)(250)
  mesh = topology.build(name, np.asarray(points), np.asarray(elem))
  solid = fill.fill(name, mesh)
  np.testing.assert_array_equal(solid.rest[: mesh.nvert], mesh.rest)
  np.testing.assert_array_equal(solid.elem, mesh.elem)
  volume = fill.volumes(solid.rest, solid.tet)
  assert volume.sum() == pytest.approx(topology.volume(mesh.rest, mesh.elem), rel=1e-3)
  assert volume.min() > 0 and fill.quality(solid.rest, solid.tet).min() > 0.01
  assert (np.bincount(solid.tet.ravel(), minlength=solid.nvert) > 0).all()
  again = fill.fill(name, mesh)
  np.testing.assert_array_equal(again.tet, solid.tet)


def test_tetrahedra_are_kept_and_made_again_where_a_file_is_damaged(monkeypatch, tmp_path):
  monkeypatch.setattr(fill.wp.config, "kernel_cache_dir", str(tmp_path))
  points, elem = shapes.kidney(150)
  mesh = topology.build("kidney", np.asarray(points) * 1.01, np.asarray(elem))
  made = fill.fill("kidney", mesh)
  (file,) = tmp_path.iterdir()
  with np.load(file) as kept:
    np.testing.assert_array_equal(kept["tet"], made.tet)
  for text in (b"", b"damaged", file.read_bytes()):
    file.write_bytes(text)
    moved = dataclasses.replace(mesh, rest=mesh.rest + 0.0)
    fill.forget()
    np.testing.assert_array_equal(fill.fill("kidney", moved).tet, made.tet)


def test_a_surface_that_cuts_itself_has_no_inside(scenes):
  points, elem = scenes.sphere(2)
  points = points.copy()
  points[:, 2] = np.where(points[:, 2] > 0.6 * 0.05, points[:, 2] - 0.09, points[:, 2])
  with pytest.raises(ValueError, match=r"'organ'.*triangle \d+ .* cannot be the face"):
    fill.fill("organ", topology.build("organ", points, elem))


def test_an_open_surface_has_no_inside(scenes):
  points, elem = scenes.strip(0.1, 0.05, 4, 3)
  with pytest.raises(ValueError, match="expected a closed surface"):
    fill.fill("organ", topology.build("organ", points, elem))
