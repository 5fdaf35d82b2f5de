"""Solids: tetrahedra inside a surface, against closed forms of elasticity."""

import dataclasses
import os

import numpy as np
import pytest
import warp as wp
from palpate.models import shapes
from palpate.tissue import energy, solid
from palpate.tissue.geometry import fill, gmsh
from palpate.tissue.geometry import mesh as topology
from reference import closed
from reference.closed import YOUNG


@pytest.mark.parametrize("size", [1e-6, 0.1, 1.0])
def test_stress_is_the_derivative_of_the_energy(size):
  random = np.random.RandomState(0)
  slope, mu, lam = size * random.uniform(-1, 1, (40, 3, 3)), 1e3, 5e3
  density, stress = energy.of_gradients(slope, np.full(40, mu), lam)
  step, found = 1e-6, np.empty_like(stress)
  for i, j in np.ndindex(3, 3):
    ahead, behind = slope.copy(), slope.copy()
    ahead[:, i, j] += step
    behind[:, i, j] -= step
    high, low = (energy.of_gradients(each, np.full(40, mu), lam)[0] for each in (ahead, behind))
    found[:, i, j] = (high - low) / (2 * step)
  np.testing.assert_allclose(stress, found, atol=1e-6 * np.abs(stress).max() + 1e-6)
  # The definition, with F and its invariants (Smith, de Goes and Kim 2018, eq. 14).
  F = np.eye(3) + slope
  i, j = np.einsum("nij,nij->n", F, F) - 3, np.linalg.det(F) - 1
  shape = mu / 2 * (i - np.log1p(i / 4)) - 3 / 4 * mu * j
  expected = shape + (lam + 5 / 8 * mu) / 2 * j**2
  np.testing.assert_allclose(density, expected, atol=1e-12 * mu, rtol=1e-6 if size < 1e-3 else 1e-9)


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.49])
def test_small_uniform_strains_have_the_energy_of_linear_elasticity(scenes, poisson):
  points, elem = scenes.box((0.1, 0.08, 0.06), 0.02)
  made = {"elements": "solid", "poisson": poisson, "young": (YOUNG,)}
  mesh, config, _ = scenes.kernels(points, elem, **made)
  mu, lam = solid.lame_solid(np.array(YOUNG), poisson)
  shear = np.eye(3)[[1, 2, 0]]
  for gradient in (np.diag([1e-4, 0, 0]), np.diag([1e-4, -2e-4, 3e-4]), 1e-4 * shear):
    strain = (gradient + gradient.T) / 2
    density = mu * (strain**2).sum() + lam / 2 * np.trace(strain) ** 2
    found = energy.solid(mesh, config, mesh.rest @ gradient.T)
    assert found == pytest.approx(0.1 * 0.08 * 0.06 * density, rel=2e-3)


@pytest.mark.parametrize("poisson", [0.3, 0.45])
def test_a_bar_in_tension_has_its_young(device, poisson):
  stretch, theory, ratio = closed.bar(poisson, device=device)
  assert stretch == pytest.approx(theory, rel=0.005)
  assert ratio == pytest.approx(poisson, abs=0.002)


SKIN = {"capsule_young": (1e5,), "thickness": 5e-4, "bend": 1.0}


def test_a_bar_with_a_skin_has_the_stiffness_of_both(device):
  stretch, theory, ratio = closed.bar(0.3, 0.01, device=device, **SKIN)
  assert stretch == pytest.approx(theory, rel=0.01)  # of which the skin has half
  assert ratio == pytest.approx(0.3, abs=0.03)  # the skin of the ends is not pulled


def test_a_solid_with_a_skin_has_the_force_of_its_energy(scenes, device):
  points, elem = scenes.box((0.06, 0.05, 0.04), 0.01)
  made = {"elements": "solid", "poisson": 0.4, "young": (1e4,), "device": device} | SKIN
  mesh, config, body = scenes.kernels(points, elem, damping=0.0, **made)
  random = np.random.RandomState(0)
  u, way = 1e-3 * random.uniform(-1, 1, (2, *mesh.rest.shape))
  force = scenes.force(body, u)
  parts = [energy.total(mesh, config, u + step * way) for step in (1e-3, -1e-3)]
  assert (force * way).sum() == pytest.approx((parts[1] - parts[0]) / 2e-3, rel=1e-5)
  assert energy.membrane(mesh, config, u) > 0.1 * energy.solid(mesh, config, u)
  assert energy.bending(mesh, config, u) > 0
  np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-5 * np.abs(force).max())
  np.testing.assert_allclose(np.cross(mesh.rest + u, force).sum(axis=0), 0.0, atol=1e-6)
  assert np.abs(scenes.force(body, 0 * u)).max() == 0
  # The matrix is the skin's too: where it has all the stiffness, a step has the force at its end.
  body = scenes.kernels(points, elem, damping=0.0, **made | {"young": (10.0,)})[2]
  h, u = 1e-3, 0.01 * u
  step = scenes.step(body, h, u, mass=1e-3)
  again = scenes.step(body, h, u + h * step, mass=1e-3, beta=-h)
  np.testing.assert_allclose(step, again, atol=0.01 * np.abs(step).max())


# A clamp hinders the sides: `clamped` is the sag of quadratic elements over that of a beam.
@pytest.mark.parametrize(("poisson", "clamped"), [(0.3, 0.975), (0.45, 0.94)])
def test_a_cantilever_of_four_across_sags_as_it_should(poisson, clamped):
  sag, beam = closed.cantilever(poisson, 0.01)
  assert sag == pytest.approx(clamped * beam, rel=0.05)


def test_a_solid_that_hardly_gives_way_in_volume_bends_too():
  # Plain tetrahedra have 0.6 of it at 0.45, and less the nearer to 0.5.
  sag, beam = closed.cantilever(0.49, 0.01)
  assert sag == pytest.approx(0.923 * beam, rel=0.12)


def test_equal_tension_everywhere_swells_by_the_bulk_modulus(scenes, device):
  points, elem = scenes.sphere(2)
  mesh, body = closed.solid(points, elem, 0.45, device=device)
  outward = np.zeros((mesh.nvert, 3))
  area = topology.area_vectors(mesh.rest, mesh.elem)
  np.add.at(outward, mesh.elem.ravel(), np.repeat(area, 3, axis=0))
  u = closed.settled(mesh, body, 50.0 / 3 * outward)
  before, after = (topology.volume(mesh.rest + part, mesh.elem) for part in (0 * u, u))
  bulk = YOUNG / (3 * (1 - 2 * 0.45))
  assert after / before - 1 == pytest.approx(50.0 / bulk, rel=0.02)


def test_a_solid_much_stiffer_in_its_matrix_than_it_is_takes_more_iterations(scenes):
  points, elem = scenes.sphere(2)
  made = {"elements": "solid", "poisson": 0.49}
  found = []
  for stiff in (1e4, 1e5, 1e6, 1e7):
    mesh, config, _ = scenes.kernels(points, elem, young=(stiff,), **made)
    found.append(solid.iterations(mesh, config, closed.masses(mesh), 7e-6))
  assert found == [1, 2, 5, 6]


@pytest.mark.parametrize("start", ["squeezed", "turned inside out", "random"])
@pytest.mark.parametrize(
  ("poisson", "skin", "h"),
  [(0.49, {}, 1e-3), (0.49, {}, 3e-3)]
  + [(*made, h) for made in ((0.3, {}), (0.45, {}), (0.45, SKIN)) for h in (1e-3, 5e-3)],
  ids=str,
)
def test_a_crushed_solid_does_not_gain_energy(scenes, start, poisson, skin, h):
  points, elem = scenes.sphere(2)
  made = {"elements": "solid", "poisson": poisson, "young": (YOUNG,)} | skin
  mesh, config, body = scenes.kernels(points, elem, damping=0.0, **made)
  size, random = 0.05, np.random.RandomState(0)
  u = {
    "squeezed": mesh.rest * [0, 0, -0.9],
    "turned inside out": mesh.rest * [0, 0, -1.8],
    "random": size * random.uniform(-0.2, 0.2, mesh.rest.shape),
  }[start]
  mass, v = closed.masses(mesh), np.zeros_like(u)
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


def test_tetrahedra_are_larger_deep_inside(scenes):
  points, elem = scenes.sphere(3)
  solid = fill.fill("ball", topology.build("ball", points, elem))
  size = np.cbrt(fill.volumes(solid.rest, solid.tet))
  depth = 0.05 - np.linalg.norm(solid.rest[solid.tet].mean(axis=1), axis=1)
  assert size[depth > 0.025].mean() > 1.5 * size[depth < 0.005].mean()


@pytest.mark.parametrize("name", ["ball", "box"])
def test_between_tetrahedra_of_a_lattice_is_nothing(scenes, name):
  # Points of a lattice lie on common spheres, four of them in a plane.
  made = {"ball": lambda: scenes.sphere(3), "box": lambda: scenes.box((0.06, 0.05, 0.03), 0.008)}
  points, elem = made[name]()
  tet = fill.fill(name, topology.build(name, points, elem)).tet
  face = np.sort(tet[:, fill.FACES].reshape(-1, 3), axis=1)
  count = np.unique(face, axis=0, return_counts=True)[1]
  assert (count == 1).sum() == len(elem) and count.max() == 2


def test_tetrahedra_are_kept_and_made_again_where_a_file_is_damaged(monkeypatch, tmp_path):
  monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
  points, elem = shapes.kidney(150)
  mesh = topology.build("kidney", np.asarray(points) * 1.01, np.asarray(elem))
  made = fill.fill("kidney", mesh)
  (file,) = tmp_path.glob("fill_*")
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


def test_a_surface_as_thin_as_paper_has_no_room_inside(scenes):
  points, elem = scenes.sphere(2)
  with pytest.raises(ValueError, match=r"'organ'.* at vertex \d+ there is no room for tetrahedra"):
    fill.fill("organ", topology.build("organ", points * [1, 1, 1e-4], elem))


def test_an_open_surface_has_no_inside(scenes):
  points, elem = scenes.strip(0.1, 0.05, 4, 3)
  with pytest.raises(ValueError, match="expected a closed surface"):
    fill.fill("organ", topology.build("organ", points, elem))


# Tetrahedra from a file.


def _blocks(point, tet):
  """Returns a Gmsh file of version 4.1, the nodes numbered from 10 and in reverse."""
  tags = np.arange(len(point))[::-1] + 10
  lines = ["$MeshFormat", "4.1 0 8", "$EndMeshFormat", "$Nodes", f"1 {len(point)} 10 99999"]
  lines += [f"3 1 0 {len(point)}", *map(str, tags)]
  lines += [" ".join(map(repr, row)) for row in point.tolist()]
  lines += ["$EndNodes", "$Elements", f"2 {len(tet) + 1} 1 99999", f"0 1 15 1\n1 {tags[0]}"]
  lines += [f"3 1 4 {len(tet)}"]
  lines += [f"{k + 2} " + " ".join(map(str, tags[row])) for k, row in enumerate(tet)]
  return "\n".join([*lines, "$EndElements"])


def _lines(point, tet):
  """Returns one of version 2.2."""
  lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(point))]
  lines += [f"{k + 1} " + " ".join(map(repr, row)) for k, row in enumerate(point.tolist())]
  lines += ["$EndNodes", "$Elements", str(len(tet) + 1), "1 2 2 0 1 1 2 3"]
  lines += [f"{k + 2} 4 2 0 1 " + " ".join(map(str, row + 1)) for k, row in enumerate(tet)]
  return "\n".join([*lines, "$EndElements"])


@pytest.mark.parametrize("text", [_blocks, _lines])
def test_tetrahedra_of_a_file_are_those_of_the_organ(scenes, tmp_path, text):
  mesh = topology.build("organ", *scenes.sphere(1))
  made = fill.fill("organ", mesh)
  file = tmp_path / "inside.msh"
  file.write_text(text(made.rest, made.tet[:, [0, 2, 1, 3]]))  # turned inside out
  found = gmsh.read("organ", str(file), mesh)
  np.testing.assert_array_equal(found.rest[: mesh.nvert], mesh.rest)
  assert len(found.tet) == len(made.tet) and found.nvert == made.nvert
  total = fill.volumes(found.rest, found.tet).sum()
  assert total == pytest.approx(fill.volumes(made.rest, made.tet).sum(), rel=1e-9)


def _flat(point, tet):
  inner = tet[0].max()  # to where the tetrahedron's other corners have their middle
  others = np.setdiff1d(tet[0], inner)
  return np.where(np.arange(len(point))[:, None] == inner, point[others].mean(0), point), tet


@pytest.mark.parametrize(
  ("change", "message"),
  [
    (lambda point, tet: (1000 * point, tet), r"nearest node to vertex \d+ is .* m away"),
    (lambda point, tet: (point, tet[:-1]), "tetrahedron or of two|end at"),
    (lambda point, tet: (point, tet[:0]), "has no tetrahedra"),
    (lambda point, tet: (point * np.nan, tet), "not finite"),
    (_flat, r"tetrahedron \d+ is flat"),
  ],
)
def test_a_file_that_does_not_fit_is_refused(scenes, tmp_path, change, message):
  mesh = topology.build("organ", *scenes.sphere(1))
  made = fill.fill("organ", mesh)
  file = tmp_path / "inside.msh"
  file.write_text(_lines(*change(made.rest, made.tet)))
  with pytest.raises(ValueError, match=f"'organ': tetrahedra is '.*msh'.*({message})"):
    gmsh.read("organ", str(file), mesh)


TWO, FOUR = "$MeshFormat 2.2 0 8 $Nodes ", "$MeshFormat 4.1 0 8 $Nodes "
NODE, NODES = TWO + "1 1 0 0 0 $Elements ", FOUR + "1 1 1 1 2 1 0 1 1 0 0 0 $Elements "
MANY = 10**12


@pytest.mark.parametrize(
  "text",
  ["", "$MeshFormat 4.1 1 8", f"{TWO}-3", f"{TWO}{MANY} 1 0 0 0 $Elements 0",
   f"{NODE}{MANY} 1 15 -4 1", f"{NODE}1 1 15 -4 1", f"{NODE}1 1 15 {MANY} 1",
   f"{FOUR}1 1 1 1 2 1 0 {MANY} 1 0 0 0 $Elements 0 0 0 0",
   f"{FOUR}{MANY} 1 1 1 2 1 0 -1 $Elements 0 0 0 0",
   f"{NODES}1 1 1 1 3 1 4 {MANY} 1 1 1 1 1", f"{NODES}{MANY} 1 1 1 3 1 4 -1"],
)  # fmt: skip
def test_a_file_that_cannot_be_read_is_refused(scenes, tmp_path, text):
  mesh = topology.build("organ", *scenes.sphere(1))
  (tmp_path / "inside.msh").write_text(text)
  with pytest.raises(ValueError, match="expected a Gmsh file as text"):
    gmsh.read("organ", str(tmp_path / "inside.msh"), mesh)
  with pytest.raises(ValueError, match="No such file"):
    gmsh.read("organ", str(tmp_path / "other.msh"), mesh)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_what_is_no_regular_file_is_refused(scenes, tmp_path):
  mesh = topology.build("organ", *scenes.sphere(1))
  os.mkfifo(tmp_path / "pipe.msh")
  for file in (tmp_path / "pipe.msh", tmp_path, "/dev/zero"):
    with pytest.raises(ValueError, match="is no regular file"):
      gmsh.read("organ", str(file), mesh)
