"""Cuts in solids: faces, parts, what is kept, how near to the path."""

import dataclasses
import functools

import numpy as np
import pytest
from palpate.tissue import energy
from palpate.tissue.config import Config
from palpate.tissue.cutting import solid_cut
from palpate.tissue.cutting.cut import Motion
from palpate.tissue.cutting.path import Finder, distance
from palpate.tissue.geometry import faces, fill
from palpate.tissue.geometry import mesh as topology


@functools.cache
def solid(kind="ball", spare=700):
  import scenes

  if kind == "box":
    points, elem = scenes.box((0.06, 0.05, 0.03), 0.008)
  else:
    points, elem = scenes.sphere(3 if kind == "fine" else 2)
  both = np.concatenate([points, np.zeros((spare, 3))])
  surface = topology.build("organ", both, elem.astype(int), spare)
  return faces.cuttable(surface, fill.fill("organ", surface.without_spare))


def line(span=0.9, side=0.1):
  """Returns a path over the top of the ball."""
  a = np.linspace(-span, span, 40)
  return 0.05 * np.stack([np.sin(a), side + 0 * a, np.cos(a)], axis=1)


def cut(mesh, points, depth=None, pinned=(), u=0.0, room=None, **keys):
  held = np.isin(np.arange(mesh.nvert), pinned)
  still = np.zeros_like(mesh.rest)
  motion = Motion(fill.vertex_volumes(mesh), still + u, still)
  whole = mesh.whole
  knife = solid_cut.Cleaver(whole, Finder(whole), room or whole.nelem + 4 * mesh.spare)
  return knife.cut("organ", mesh, motion, np.asarray(points), held, depth, **keys)


def sizes(mesh):
  """Returns the volumes of the pieces, the largest first."""
  label = topology.pieces(mesh)[mesh.tet[:, 0]]
  return np.sort(np.bincount(label, fill.volumes(mesh.rest, mesh.tet)))[::-1]


def check(mesh):
  """Makes sure that a cut solid is whole in itself."""
  whole = mesh.whole
  volume = fill.volumes(mesh.rest, mesh.tet)
  assert volume.min() > 0
  assert volume.sum() == pytest.approx(fill.volumes(whole.rest, whole.tet).sum(), rel=1e-10)
  assert topology.volume(mesh.rest, mesh.elem) == pytest.approx(volume.sum(), rel=1e-10)
  shape = [fill.quality(m.rest, m.tet).min() for m in (mesh, whole)]
  assert shape[0] > 0.85 * min(0.15, shape[1])
  # The surface is that of the tetrahedra, and closed.
  used, elem = np.unique(mesh.elem, return_inverse=True)
  assert topology.build("organ", mesh.rest[used], elem.reshape(-1, 3)).closed
  assert np.array_equal(mesh.elem, mesh.tet.ravel()[mesh.of_tet])
  # Neighbours are those that edges lead to.
  start, k = np.nonzero(mesh.ring >= 0)
  edges = mesh.tet[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2)
  expected = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0)
  assert np.array_equal(np.stack([start, mesh.ring[start, k]], 1), expected)


@pytest.mark.parametrize(
  ("kind", "path", "section"),
  [
    ("ball", line(np.pi / 2, 0.0), np.pi * 0.05**2),
    ("box", [[0, y, 0.015] for y in np.linspace(-0.025, 0.025, 9)], 0.05 * 0.03),
  ],
)
def test_what_is_cut_through_falls_in_two(kind, path, section):
  found = cut(solid(kind), path)
  check(found.mesh)
  parts = sizes(found.mesh)
  assert len(parts) == 2 and parts[1] > 0.47 * parts.sum()
  assert found.area == pytest.approx(section, rel=0.12)
  share = np.bincount(found.group, found.share, found.mesh.nvert)
  np.testing.assert_allclose(share[found.group], 1.0, rtol=1e-12)


def test_a_cut_of_a_depth_leaves_one_piece_and_goes_so_deep():
  mesh = solid("fine")
  for depth in (0.012, 0.03):
    found = cut(mesh, line(), depth)
    check(found.mesh)
    assert len(sizes(found.mesh)) == 1
    assert found.depth == pytest.approx(depth, rel=0.35)
    assert found.area == pytest.approx(found.length * depth, rel=0.45)
    assert found.length == pytest.approx(0.09, rel=0.2)


def test_a_plug_comes_out_of_a_closed_path_and_a_ring_is_cut_to_its_middle():
  t = np.linspace(0, 2 * np.pi, 60)
  cap = 0.05 * np.stack([0.6 * np.cos(t), 0.6 * np.sin(t), 0 * t + 0.8], axis=1)
  parts = sizes(cut(solid(), cap).mesh)
  assert len(parts) == 2  # a core of 0.6 of the radius, of the whole ball's length
  assert parts[1] / parts.sum() == pytest.approx(1 - 0.8**3, abs=0.1)
  around = 0.05 * np.stack([np.sin(t), 0 * t, np.cos(t)], axis=1)
  parts = sizes(cut(solid(), around).mesh)
  assert len(parts) == 2 and parts[1] > 0.45 * parts.sum()


def test_cuts_that_cross_make_four_quarters():
  first = cut(solid(), line(np.pi / 2, 0.0)).mesh
  other = line(np.pi / 2, 0.0)[:, [1, 0, 2]]
  second = cut(first, other).mesh
  check(second)
  parts = sizes(second)
  assert len(parts) == 4 and parts[-1] > 0.2 * parts.sum()


def test_a_deeper_cut_in_the_same_place_goes_on_from_the_first():
  shallow = cut(solid(), line(np.pi / 2, 0.0), 0.015).mesh
  assert len(sizes(shallow)) == 1
  deeper = cut(shallow, line(np.pi / 2, 0.0))
  check(deeper.mesh)
  assert len(sizes(deeper.mesh)) == 2
  with pytest.raises(ValueError, match="no tetrahedra come apart"):
    cut(deeper.mesh, line(np.pi / 2, 0.0))


def test_the_parts_of_a_state_are_found_again():
  first = cut(solid(), line(), 0.02)
  found = cut(first.mesh, line()[:, [1, 0, 2]], 0.02)
  mesh, whole = found.mesh, found.mesh.whole
  seat = {}
  for each in (first, found):
    seat |= dict(zip(each.member.tolist(), each.seat.tolist(), strict=True))
  spare = range(whole.nouter, mesh.nouter)
  corner = np.array([seat[v] for v in spare])
  assert np.array_equal(mesh.tet.ravel()[corner], list(spare))
  tet = faces.restored(whole, mesh.rest, faces.opened(mesh), corner)
  assert np.array_equal(tet, mesh.tet)
  again, changed = faces.grown(whole, mesh.rest, tet, mesh.of_tet)
  assert np.array_equal(again.ring, mesh.ring) and len(changed)
  with pytest.raises(ValueError, match="faces that are none"):
    faces.restored(whole, mesh.rest, faces.opened(mesh)[1:], corner)


def test_without_room_a_cut_ends_early():
  mesh = solid(spare=8)
  found = cut(mesh, line(), 0.02)
  assert found.stopped and 0 < found.mesh.nouter - mesh.nouter <= 8
  check(found.mesh)
  found = cut(solid(), line(), 0.02, room=solid().nelem + 8)
  assert found.stopped and found.mesh.nelem <= solid().nelem + 8


@pytest.mark.parametrize(
  ("keys", "message"),
  [
    ({"depth": 0.0}, "depth is 0, expected a number > 0"),
    ({"depth": -1.0}, "depth is -1, expected"),
    ({"depth": float("nan")}, "depth is nan, expected"),
    ({"depth": np.ones(3)}, r"depth has shape \(3,\), expected one number, or \(40,\)"),
    ({"pinned": range(200)}, "goes through vertex .*, which is pinned"),
    ({"points": 2 * line()}, "point 0 of the path is .* m from the surface"),
    ({"points": line()[:1]}, r"shape \(1, 3\), expected"),
    ({"points": line()[[0, 0]]}, "the path is shorter than an edge"),
    ({"points": line() * [1, np.nan, 1]}, "point 0 is .*, expected finite numbers"),
    ({"direction": np.zeros(3)}, "direction is .*, expected three numbers, not all 0"),
    ({"points": line(2.4, 0.0), "depth": None}, "goes around the organ and has no depth"),
  ],
)
def test_what_cannot_be_cut_says_so(keys, message):
  with pytest.raises(ValueError, match=message):
    cut(solid(), **({"points": line(), "depth": 0.02} | keys))


def test_a_direction_slants_the_cut():
  found = cut(
    solid("box"), [[0, -0.025, 0.015], [0, 0.025, 0.015]], 0.02, direction=np.array([1.0, 0, -1])
  )
  wall = found.mesh.elem[solid("box").nelem :]
  x = found.mesh.rest[wall].reshape(-1, 3)
  below = x[:, 2] < 0.008
  assert below.any() and x[below, 0].mean() > 0.006


def test_the_strain_energy_around_what_moves_does_not_rise():
  mesh, config = solid(), dataclasses.replace(Config(), elements="solid", bend=0.0)
  u = 0.004 * np.sin(40 * mesh.rest[:, [1, 2, 0]]) * (mesh.degree > 0)[:, None]
  found = cut(mesh, line(), 0.02, u=u, config=config)
  assert found.moved > 5
  both = (mesh, u), (found.mesh, found.motion.disp)
  before, after = (energy.solid(m, config, x) for m, x in both)
  assert after < (1 + 1e-9) * before


def off(mesh, sides, depth):
  """Returns how far the vertices at the mouths of cuts are off their paths, ends too [m]."""
  far = []
  for side in sides:
    path = line(side=side)
    path *= 0.05 / np.linalg.norm(path, axis=1, keepdims=True)
    found = cut(mesh, path, depth)
    check(found.mesh)
    length = topology.lengths(np.diff(path, axis=0)).sum()
    assert found.length == pytest.approx(length, rel=0.1)
    far.append(distance(path, np.concatenate(found.path))[0])
  return np.concatenate(far)


def test_the_mouth_of_a_cut_follows_its_path():
  mesh = solid("fine")
  assert off(mesh, (0.1, 0.2, 0.3, 0.4), 0.02).max() < 0.1 * mesh.edge_length


@pytest.mark.slow
def test_a_cut_at_4000_nodes_follows_its_path():
  import scenes

  points, elem = scenes.sphere(4)
  both = np.concatenate([points, np.zeros((900, 3))])
  surface = topology.build("organ", both, elem.astype(int), 900)
  mesh = faces.cuttable(surface, fill.fill("organ", surface.without_spare))
  far = off(mesh, (0.0, 0.1, 0.2, 0.3, 0.4, 0.5), 0.012)
  assert np.percentile(far, 98) < 0.1e-3 and far.max() < 1e-3


def test_triangles_of_a_solid_with_room_for_cuts_keep_their_numbers():
  """MuJoCo's are of 32 bits, which numbers of three vertices together exceed."""
  import scenes

  points, elem = scenes.box((0.06, 0.05, 0.03), 0.004)
  both = np.concatenate([points, np.zeros((2500, 3))])
  surface = topology.build("organ", both, elem.astype(np.int32), 2500)
  mesh = faces.cuttable(surface, fill.fill("organ", surface.without_spare))
  # Some have the diagonal of the tetrahedra: two corners of their own.
  assert all(len(np.intersect1d(*pair)) >= 2 for pair in zip(mesh.elem, elem, strict=True))
