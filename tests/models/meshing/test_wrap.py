import functools
import re

import mujoco
import numpy as np
import palpate
import pytest
import trimesh
from palpate.models import shapes
from palpate.models.meshing.quality import quality
from palpate.models.meshing.repair import Target
from palpate.models.meshing.shrink_wrap import foldovers
from palpate.models.meshing.wrap import Report, wrap

NODES = 250
# Volume that chords of length s cut off a ball: 3/8 (s / r)^2, 2.8 % at 250 nodes.
CHORDS = 0.035


@functools.cache
def organ(name):
  return getattr(shapes, name)(1500)


def spoil(random):
  """Returns a mesh spoilt in one to four ways, and which."""
  vertices, triangles = organ(("lobed", "liver", "kidney")[random.randint(3)])
  ways = random.choice(
    ["holes", "turned", "twice", "soup", "noise", "second", "nan", "cut", "scale", "flat"],
    random.randint(1, 5),
    replace=False,
  )
  for way in sorted(ways, key=lambda way: way == "nan"):  # last, or it might be cut off again
    count = len(triangles)
    if way == "holes":
      triangles = triangles[random.rand(count) > random.uniform(0, 0.3)]
    elif way == "turned":
      turn = random.rand(count) < random.rand()
      triangles = np.where(turn[:, None], triangles[:, ::-1], triangles)
    elif way == "twice":
      triangles = np.concatenate([triangles, triangles[: count // 3]])
    elif way == "soup":
      vertices = vertices[triangles.ravel()]
      triangles = np.arange(3 * count).reshape(-1, 3)
    elif way == "noise":
      vertices = vertices + random.normal(size=vertices.shape) * random.uniform(0, 0.004)
    elif way == "second":
      triangles = np.concatenate([triangles, triangles + len(vertices)])
      vertices = np.concatenate([vertices, vertices * 0.4 + random.normal(size=3) * 0.05])
    elif way == "nan":
      vertices = vertices.copy()
      vertices[triangles[random.randint(count)][0] if count else 0] = np.nan
    elif way == "cut":
      side = vertices[triangles].mean(axis=1) @ random.normal(size=3)
      triangles = triangles[side > random.uniform(-0.1, 0.05)]
    elif way == "scale":
      vertices = vertices * 10 ** random.uniform(-4, 4)
    elif way == "flat":
      vertices = vertices * [1, 1, random.uniform(0, 0.3)]
  return (vertices, triangles), list(ways)


def assert_organ(vertices, triangles, report):
  q = quality(vertices, triangles)
  assert q.watertight and q.manifold and q.components == 1 and q.volume > 0, q
  assert q.nodes == report.nodes and q.genus == report.handles
  assert report.foldovers == 0
  assert q.min_angle >= 10, q
  assert np.isfinite(vertices).all()


@pytest.mark.parametrize("seeds", [8, pytest.param(400, marks=pytest.mark.slow)])
def test_bad_meshes_end_in_an_error_or_an_organ(seeds):
  made, refused = 0, []
  for seed in range(seeds):
    mesh, ways = spoil(np.random.RandomState(seed))
    try:
      result = wrap(mesh, 128)
    except ValueError as error:
      assert "expected" in str(error), (seed, ways)
      assert {"nan", "cut", "scale", "flat", "holes", "noise", "second"} & set(ways), (seed, ways)
      refused.append(ways)
    else:
      assert_organ(*result)
      assert "nan" not in ways
      made += 1
  assert made > 0.3 * seeds and len(refused) > 0.2 * seeds


@pytest.mark.parametrize("way", ["turned", "twice", "soup", "both"])
def test_what_can_be_repaired_is(way):
  vertices, triangles = organ("lobed")
  volume = quality(vertices, triangles).volume
  random = np.random.RandomState(0)
  if way in ("turned", "both"):
    turn = random.rand(len(triangles)) < 0.5
    triangles = np.where(turn[:, None], triangles[:, ::-1], triangles)
  if way in ("twice", "both"):
    triangles = np.concatenate([triangles, triangles[::2, ::-1]])
  if way in ("soup", "both"):
    vertices = vertices[triangles.ravel()]
    triangles = np.arange(len(vertices)).reshape(-1, 3)
  result = wrap((vertices, triangles), NODES)
  assert_organ(*result)
  assert quality(*result[:2]).volume == pytest.approx(volume, rel=CHORDS)
  assert result[2].hausdorff < 1.5


def test_holes_are_closed():
  ball = trimesh.creation.icosphere(4, 0.05)
  hole = ball.triangles_center[:, 2] < 0.045  # 5 % of the ball's area is gone
  result = wrap((ball.vertices, ball.faces[hole]), NODES)
  assert_organ(*result)
  # What is left is the ball without a cap of 5 mm: pi h^2 (3 r - h) / 3.
  expected = 4 / 3 * np.pi * 0.05**3 - np.pi * 0.005**2 * (0.15 - 0.005) / 3
  assert quality(*result[:2]).volume == pytest.approx(expected, rel=CHORDS)


def test_open_ends_are_named():
  pipe = trimesh.creation.cylinder(0.02, 0.1, sections=48)
  side = np.abs(pipe.face_normals[:, 2]) < 0.5
  report = wrap((pipe.vertices, pipe.faces[side]), NODES)[2]
  assert [loss.kind for loss in report.losses] == ["cap", "cap"]
  assert sorted(round(loss.middle[2], 3) for loss in report.losses) == [-0.05, 0.05]
  assert "an open end is capped, and what it leads to is solid" in str(report)
  assert not wrap((pipe.vertices, pipe.faces), NODES)[2].losses


def crossing(radius):
  one, two = trimesh.creation.icosphere(4, radius), trimesh.creation.icosphere(4, radius)
  return trimesh.util.concatenate([one, two.apply_translation([radius, 0, 0])])


def test_crossing_pieces_become_one():
  vertices, triangles, report = wrap(crossing(0.04), 1000)
  assert_organ(vertices, triangles, report)
  assert report.pieces == 1
  # Two balls whose centres are one radius apart: 9/4 pi r^3.
  expected = 9 / 4 * np.pi * 0.04**3
  assert quality(vertices, triangles).volume == pytest.approx(expected, rel=0.02)


def test_largest_of_separate_pieces_is_kept():
  large, small = trimesh.creation.icosphere(4, 0.04), trimesh.creation.icosphere(3, 0.01)
  small.apply_translation([0.08, 0, 0])
  vertices, triangles, report = wrap(trimesh.util.concatenate([large, small]), NODES)
  assert_organ(vertices, triangles, report)
  assert report.pieces == 2
  assert np.abs(vertices).max() < 0.041


@pytest.mark.parametrize("method", ["even", "grid"])
def test_accuracy_on_a_ball(method):
  vertices, triangles, report = wrap(trimesh.creation.icosphere(5, 0.05), 1000, method=method)
  assert_organ(vertices, triangles, report)
  np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.05, rtol=1e-3)
  # The chords' sagitta spacing^2 / (6 r) is 0.06 % of the diagonal at 1000 nodes, 0.1 at the worst.
  assert 0.01 < report.hausdorff < 0.2
  assert report.min_angle > 35
  assert report.area_distortion < 0.25
  assert report.angle_distortion < 10


def test_grid_is_the_folded_sheet():
  vertices, triangles, report = wrap(organ("kidney"), 16 * 16, method="grid")
  assert_organ(vertices, triangles, report)
  assert report.nodes == 258
  assert (np.bincount(triangles.ravel()) == 4).sum() == 6
  assert (np.bincount(triangles.ravel()) == 6).sum() == 252


def test_hausdorff_is_two_sided():
  """The reported distance is not smaller than one measured with every triangle."""
  target = trimesh.creation.box((0.08, 0.06, 0.05))
  vertices, triangles, report = wrap(target, NODES)
  own = Target(vertices, triangles, 1e-3)
  ends = target.vertices[target.edges_unique]
  points = np.concatenate([(1 - t) * ends[:, 0] + t * ends[:, 1] for t in np.linspace(0, 1, 101)])
  missed = np.linalg.norm(own.closest(points) - points, axis=1).max()
  size = np.linalg.norm(target.extents)
  assert missed > 1e-3  # 250 nodes cannot follow every edge
  # The target's samples are half a grid spacing apart: 0.5 / 70 of the diagonal.
  assert report.hausdorff >= 100 * missed / size - 0.7


def test_same_mesh_same_bits():
  first, second = wrap(organ("kidney"), NODES), wrap(organ("kidney"), NODES)
  np.testing.assert_array_equal(first[0], second[0])
  np.testing.assert_array_equal(first[1], second[1])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["even", "grid"])
@pytest.mark.parametrize("name", ["liver", "stomach", "gallbladder", "kidney"])
def test_targets_at_4096_nodes(name, method):
  vertices, triangles, report = wrap(getattr(shapes, name)(16000), 4096, method=method)
  assert_organ(vertices, triangles, report)
  assert report.hausdorff < (1.0 if method == "even" else 1.5)
  assert report.min_angle > (20 if method == "even" else 15)


@pytest.mark.slow
def test_a_million_triangles():
  ball = trimesh.creation.icosphere(8, 0.05)
  assert len(ball.faces) > 1e6
  vertices, triangles, report = wrap(ball, 4096)
  assert_organ(vertices, triangles, report)
  assert report.hausdorff < 0.2


@pytest.mark.parametrize("kind", ["obj", "stl", "ply", "glb"])
def test_files(kind, tmp_path):
  path = tmp_path / f"ball.{kind}"
  trimesh.creation.icosphere(3, 50.0).export(path)  # in millimetres
  with pytest.raises(ValueError, match=rf"ball.{kind}: .*173 m across.*try scale='mm' \(0.17 m\)$"):
    wrap(path, NODES)
  vertices, triangles, report = wrap(path, NODES, scale="mm")
  assert_organ(vertices, triangles, report)
  np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.05, rtol=0.02)


def test_direct_keeps_a_good_mesh():
  vertices, triangles = organ("liver")
  kept, faces, report = wrap((vertices, triangles[:, ::-1]), method="direct")
  assert_organ(kept, faces, report)
  assert report.method == "direct" and report.nodes == len(vertices)
  assert quality(kept, faces).volume == pytest.approx(quality(vertices, triangles).volume)


@pytest.mark.parametrize(
  ("spoilt", "message"),
  [
    (lambda v, t: (v, t[:-1]), "not closed"),
    (lambda v, t: (v, np.where(np.arange(len(t))[:, None] == 5, t[:, ::-1], t)), "wind"),
    (lambda v, t: (np.r_[v, v + 0.01], np.r_[t, t + len(v)]), "2 pieces cross .*method='even'"),
    (lambda v, t: (v * [1, 1, 0.05], t), "smallest angle is .* degrees, expected 10"),
  ],
)
def test_direct_refuses_a_bad_mesh(spoilt, message):
  with pytest.raises(ValueError, match=message):
    wrap(spoilt(*organ("kidney")), method="direct")


def test_direct_refuses_another_number_of_nodes():
  with pytest.raises(ValueError, match="nodes is 300, method='direct' keeps all 1500"):
    wrap(organ("kidney"), 300, method="direct")


@pytest.mark.parametrize(
  ("content", "message"),
  [
    ("", "bad.obj: "),
    ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "bad.obj: "),
    ("not a mesh at all", "bad.obj: "),
  ],
)
def test_empty_files_are_named(content, message, tmp_path):
  path = tmp_path / "bad.obj"
  path.write_text(content)
  with pytest.raises(ValueError, match=message):
    wrap(path)


def test_other_files_are_named(tmp_path):
  with pytest.raises(FileNotFoundError, match="none"):
    wrap(tmp_path / "none.obj")
  path = tmp_path / "notes.txt"
  path.write_text("hello")
  with pytest.raises(ValueError, match=r"notes.txt: .*obj, stl, ply, gltf, glb"):
    wrap(path)


@pytest.mark.parametrize(
  ("change", "message"),
  [
    (lambda v, t: (v * [1, 1, 0], t), "flat"),
    (lambda v, t: (v * 1000, t), r"across, expected 0.02 to 2 m; try scale='mm' \(0.18 m\)$"),
    (lambda v, t: (v * 100, t), r"try scale='cm' \(0.18 m\) or scale='inch' \(0.47 m\)"),
    (lambda v, t: (v / 0.0254, t), r"try scale='inch' \(0.18 m\) or scale='cm' \(0.073 m\)"),
    (lambda v, t: (v * 1e-6, t), "expected 0.02 to 2 m; pass the metres per unit"),
    (lambda v, t: (v, t[:0]), "has no triangles"),
    (lambda v, t: (v, t + 1), "outside 0..1499"),
    (lambda v, t: (np.where(np.arange(len(v))[:, None] == 7, np.inf, v), t), "vertex 7 is"),
    (lambda v, t: (v, t[v[t].mean(axis=1)[:, 2] < 0]), "open"),
  ],
)
def test_errors_say_what_is_allowed(change, message):
  with pytest.raises(ValueError, match=message):
    wrap(change(*organ("lobed")), NODES)


def test_a_ring_stays_a_ring():
  ring = trimesh.creation.torus(0.05, 0.015, major_sections=96, minor_sections=40)
  for method, nodes in (("even", 500), ("direct", None)):
    vertices, triangles, report = wrap(ring, nodes, method=method)
    q = quality(vertices, triangles)
    assert q.watertight and q.manifold and q.genus == report.handles == 1
    assert report.losses == () and report.foldovers == 0
    # Chords of length s cut 3/16 (s / r)^2 off a tube, half of what they cut off a ball: 6 %.
    assert q.volume == pytest.approx(2 * np.pi**2 * 0.05 * 0.015**2, rel=0.06)
    assert np.hypot(*vertices.T[:2]).min() == pytest.approx(0.035, rel=0.02)
  with pytest.raises(ValueError, match=r"1 holes go through it, expected none .*method='even'"):
    wrap(ring, NODES, method="grid")
  spec = mujoco.MjSpec()
  palpate.add_organ(spec, wrap(ring, 250)[:2], "ring", elements="solid", young=5e3)
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_step(model, data)
  assert palpate.Organ(model, data, "ring").nvert == 250


def test_an_inch_is_no_millimetre():
  """A liver in inches was taken for one in millimetres, and became one of 12 mm."""
  inches = [organ("liver")[0] / 0.0254, organ("liver")[1]]
  with pytest.raises(ValueError, match=r"0.0117 m across, .* try scale='inch'"):
    wrap(inches, NODES, scale="mm")
  assert max(wrap(inches, NODES, scale="inch")[2].size) == pytest.approx(0.222, rel=0.02)


def shell(side, thickness, radius, count):
  """Returns a thin square sheet with even triangles, bent to a half pipe."""
  x, y, z = (a.ravel() for a in np.mgrid[: count + 1, : count + 1, :2])
  corner = np.stack([x, y, z], axis=1)
  number = np.arange(len(x)).reshape(count + 1, count + 1, 2)
  quads = []
  for i in range(count):
    for j in range(count):
      quads.append([(i, j, 1), (i + 1, j, 1), (i + 1, j + 1, 1), (i, j + 1, 1)])
      quads.append([(i, j, 0), (i, j + 1, 0), (i + 1, j + 1, 0), (i + 1, j, 0)])
    a, b, n = i, i + 1, count
    quads += [
      [(a, 0, 0), (b, 0, 0), (b, 0, 1), (a, 0, 1)], [(b, n, 0), (a, n, 0), (a, n, 1), (b, n, 1)],
      [(0, b, 0), (0, a, 0), (0, a, 1), (0, b, 1)], [(n, a, 0), (n, b, 0), (n, b, 1), (n, a, 1)],
    ]  # fmt: skip
  quads = np.array([[number[q] for q in quad] for quad in quads])
  triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
  angle, r = corner[:, 0] * side / count / radius, radius + corner[:, 2] * thickness
  return np.stack(
    [r * np.sin(angle), corner[:, 1] * side / count, r * np.cos(angle)], axis=1
  ), triangles


def test_advice_leads_to_an_organ_not_in_a_circle():
  """What a refusal tells to do works."""
  cases = [  # mesh, method, nodes; the advice
    (shell(0.1, 0.0004, 0.03, 60), "even", NODES),
    (trimesh.creation.icosphere(3, 0.05).apply_scale([1, 1, 0.15]), "direct", None),
    (crossing(0.05), "direct", None),
    (organ("kidney"), "direct", 300),
  ]
  for mesh, method, nodes in cases:
    with pytest.raises(ValueError) as error:
      wrap(mesh, nodes, method=method)
    said = str(error.value)
    other = re.search(r"method='(even|direct)' (keeps the|makes)", said)
    if other is None:
      assert "leave nodes out" in said
    method = other[1] if other else method
    assert wrap(mesh, None if method == "direct" else NODES, method=method)[2].foldovers == 0


def stick():
  mesh = trimesh.creation.capsule(0.3, 0.002)
  return mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], [1, 1, 1]))


def most_nodes(mesh):
  with pytest.raises(ValueError, match="nodes is 100000, expected at most") as error:
    wrap(mesh, 100_000)
  return int(re.search(r"at most (\d+)", str(error.value))[1])


def test_too_many_nodes_are_refused_at_once():
  assert 1000 < most_nodes(stick()) < 10_000


@pytest.mark.slow
def test_as_many_nodes_as_are_allowed_can_be_had():
  nodes = most_nodes(stick())
  assert wrap(stick(), nodes)[2].nodes == nodes


def test_bad_arguments():
  with pytest.raises(ValueError, match="'magic', expected one of even, grid, direct"):
    wrap(organ("lobed"), method="magic")
  with pytest.raises(ValueError, match="nodes is 5, expected a number from 64"):
    wrap(organ("lobed"), 5)
  for scale in (0, -1, np.nan):
    with pytest.raises(ValueError, match="scale is"):
      wrap(organ("lobed"), scale=scale)


def test_foldovers_are_counted():
  vertices, triangles = (a.copy() for a in shapes.lobed(250))
  assert foldovers(vertices, triangles) == 0
  node = triangles[0, 0]
  ring = np.unique(triangles[(triangles == node).any(axis=1)])
  far = vertices[ring][np.linalg.norm(vertices[ring] - vertices[node], axis=1).argmax()]
  vertices[node] += 2.5 * (far - vertices[node])  # across its own ring
  assert foldovers(vertices, triangles) > 0


def test_report_prints_a_line_a_field():
  report = wrap(organ("lobed"), method="direct")[2]
  assert isinstance(report, Report)
  assert len(str(report).splitlines()) == 17
  assert "foldovers: 0" in str(report)
  for line in ("volume: .* ml", "size: .* x .* x .* mm", "edges: .* mm", "angle: .* degrees"):
    assert re.search(line, str(report)), line


def test_closest_points_match_a_plain_search():
  random = np.random.RandomState(0)
  vertices, triangles = shapes.lobed(250)
  target = Target(vertices, triangles, 2e-3)
  points = vertices[random.randint(250, size=50)] + random.normal(size=(50, 3)) * 5e-3
  found = np.linalg.norm(target.closest(points) - points, axis=1)
  # A fine lattice of every triangle: at most one lattice step of 0.3 mm along the surface off.
  u, v = (a.ravel() for a in np.meshgrid(np.arange(41) / 40, np.arange(41) / 40))
  inside = u + v <= 1
  share = np.stack([1 - u - v, u, v], axis=1)[inside]
  lattice = np.einsum("sk,mkd->msd", share, vertices[triangles]).reshape(-1, 3)
  plain = [np.linalg.norm(lattice - p, axis=1).min() for p in points]
  np.testing.assert_allclose(found, plain, atol=1e-4)
