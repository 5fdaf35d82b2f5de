import gzip

import numpy as np
import oblique
import pytest
from oblique import CENTER
from palpate.models.meshing import volume as volumes
from palpate.models.meshing.quality import normals, quality
from palpate.models.meshing.quality import volume as enclosed

nibabel = pytest.importorskip("nibabel")
nrrd = pytest.importorskip("nrrd")

SHAPE = (64, 60, 56)
RADII = np.array([0.030, 0.022, 0.026])  # [m]


def ellipsoid(affine, shape=SHAPE, radii=RADII, label=1):
  """Returns the label map of an ellipsoid that stands upright in the world."""
  inside = ((oblique.places(affine, shape) / radii) ** 2).sum(axis=-1) < 1
  return np.where(inside, label, 0).astype(np.int16)


GRIDS = {
  "even": oblique.affine([1.2e-3] * 3, np.eye(3), SHAPE),
  "thick slices": oblique.affine([0.9e-3, 0.9e-3, 2.5e-3], np.eye(3), (84, 84, 30)),
  "oblique": oblique.affine([1.2e-3, 1.0e-3, 1.6e-3], oblique.rotation(35), SHAPE),
  "mirrored": oblique.affine([1.2e-3, 1.2e-3, 1.4e-3], np.diag([-1.0, 1.0, 1.0]), SHAPE),
}
SHAPES = {"thick slices": (84, 84, 30)}


@pytest.mark.parametrize("name", GRIDS)
def test_surface_is_the_ellipsoid(name):
  affine, shape = GRIDS[name], SHAPES.get(name, SHAPE)
  vertices, triangles = volumes.surface(ellipsoid(affine, shape) == 1, affine)
  q = quality(vertices, triangles)
  assert q.closed, q  # positive volume: outward, mirrored or not
  # Smoothing over s = 0.6 voxel edges moves the surface in by s^2 / r, 1 % of the volume at 2.5 mm.
  expected = 4 / 3 * np.pi * RADII.prod()
  assert enclosed(vertices, triangles) == pytest.approx(expected, rel=0.03)
  np.testing.assert_allclose(oblique.centroid(vertices, triangles), CENTER, atol=2e-4)
  np.testing.assert_allclose(np.ptp(vertices, axis=0), 2 * RADII, atol=1.5e-3)


def save_nifti(path, labels, affine, unit="mm"):
  scale = {"mm": 1e3, "meter": 1.0, "micron": 1e6}[unit]
  image = nibabel.Nifti1Image(labels, np.diag([scale, scale, scale, 1]) @ affine)
  image.header.set_xyzt_units(unit)
  nibabel.save(image, path)


def save_nrrd(path, labels, affine, space="right-anterior-superior", sign=(1, 1, 1)):
  affine = np.diag([*(1e3 * np.array(sign)), 1.0]) @ affine
  header = {
    "space": space,
    "space directions": affine[:3, :3].T,
    "space origin": affine[:3, 3],
    "kinds": ["domain"] * 3,
  }
  nrrd.write(str(path), labels, header)


@pytest.mark.parametrize("unit", ["mm", "meter", "micron"])
@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
def test_nifti_keeps_place_and_units(ending, unit, tmp_path):
  path, affine = tmp_path / f"scan.{ending}", GRIDS["oblique"]
  labels = ellipsoid(affine)
  save_nifti(path, labels, affine, unit)
  found = volumes.read(path)
  np.testing.assert_array_equal(found.values[0], labels)
  np.testing.assert_allclose(found.affine, affine, rtol=1e-5, atol=1e-8)  # stored as float32


@pytest.mark.parametrize(
  ("space", "sign"),
  [
    ("right-anterior-superior", (1, 1, 1)),
    ("left-posterior-superior", (-1, -1, 1)),
    ("LPS", (-1, -1, 1)),
    ("left-anterior-superior", (-1, 1, 1)),
  ],
)
def test_nrrd_keeps_place(space, sign, tmp_path):
  path, affine = tmp_path / "scan.nrrd", GRIDS["oblique"]
  labels = ellipsoid(affine)
  save_nrrd(path, labels, affine, space, sign)
  found = volumes.read(path)
  np.testing.assert_array_equal(found.values[0], labels)
  np.testing.assert_allclose(found.affine, affine, rtol=1e-9, atol=1e-12)


def save_segments(path, layers, affine, segments):
  """Writes a .seg.nrrd as 3D Slicer does: layers, and in each the segments that do not overlap."""
  affine = np.diag([1e3, 1e3, 1e3, 1.0]) @ affine
  header = {
    "space": "right-anterior-superior",
    "space directions": np.vstack([np.full((1, 3), np.nan), affine[:3, :3].T]),
    "space origin": affine[:3, 3],
    "kinds": ["list", "domain", "domain", "domain"],
  }
  for k, (name, value, layer) in enumerate(segments):
    header |= {f"Segment{k}_Name": name, f"Segment{k}_LabelValue": str(value)}
    header |= {f"Segment{k}_Layer": str(layer)}
  nrrd.write(str(path), np.stack(layers), header)


def test_segments_in_layers_are_read_by_name(tmp_path):
  """A tumour inside of a liver is in a layer of its own, both with label 1."""
  path, affine = tmp_path / "scan.seg.nrrd", GRIDS["oblique"]
  liver, tumour = ellipsoid(affine), ellipsoid(affine, radii=RADII / 2)
  other = np.zeros_like(liver)
  other[:6, :6, :6] = 2
  segments = [("Liver", 1, 0), ("Tumour 1", 1, 1), ("Bone", 2, 1)]
  save_segments(path, [liver, tumour + other], affine, segments)
  labels = volumes.read(path)
  assert [str(s) for s in labels.segments] == ["1 (Liver)", "1 (Tumour 1)", "2 (Bone)"]
  np.testing.assert_allclose(labels.affine, affine, rtol=1e-9, atol=1e-12)
  for name, size in (("Liver", 1.0), ("Tumour 1", 0.5)):
    vertices, triangles, report = volumes.wrap_volume(path, 250, label=name)
    assert report.losses == ()
    # 250 nodes cut 3 % off, smoothing up to 3 % more.
    assert report.volume == pytest.approx(4 / 3 * np.pi * (size * RADII).prod(), rel=0.08)
    np.testing.assert_allclose(oblique.centroid(vertices, triangles), CENTER, atol=5e-4)
  with pytest.raises(ValueError, match=r"label is 1 in 2 layers, .*: 1 \(Liver\), 1 \(Tumour 1\)"):
    volumes.wrap_volume(path, label=1)
  with pytest.raises(ValueError, match=r"label is Spleen, .*: 1 \(Liver\), 1 \(Tumour 1\), 2"):
    volumes.wrap_volume(path, label="Spleen")


def test_layers_without_names_are_read(tmp_path):
  path, affine = tmp_path / "scan.nrrd", GRIDS["even"]
  save_segments(path, [ellipsoid(affine), 3 * ellipsoid(affine)], affine, [])
  assert [str(s) for s in volumes.read(path).segments] == ["1", "3"]


def test_pieces_of_a_label(tmp_path):
  path, affine = tmp_path / "scan.nii", GRIDS["even"]
  labels = ellipsoid(affine, radii=RADII / 2)
  labels[2:12, 2:12, 2:12] = 1
  save_nifti(path, labels, affine)
  found = volumes.read(path)
  (only,) = volumes.wrap_label(found, found.segment(), 200)
  assert [loss.kind for loss in only[2].losses] == ["piece"]
  # The box of ten voxels has rounded edges.
  assert only[2].losses[0].volume == pytest.approx((10 * 1.2e-3) ** 3, rel=0.1)
  first, second = volumes.wrap_label(found, found.segment(), 200, pieces=True)
  assert first[2].losses == second[2].losses == ()
  assert second[2].volume < first[2].volume


def test_wrap_volume_makes_an_organ(tmp_path):
  path, affine = tmp_path / "scan.nii.gz", GRIDS["oblique"]
  labels = ellipsoid(affine, label=3)
  labels[:5, :5, :5] = 7  # another organ in a corner
  save_nifti(path, labels, affine)
  vertices, triangles, report = volumes.wrap_volume(path, 500, label=3)
  q = quality(vertices, triangles)
  assert q.closed and q.nodes == 500 and q.min_angle > 20
  assert report.foldovers == 0
  # 500 nodes cut 1 % off, smoothing as above.
  assert q.volume == pytest.approx(4 / 3 * np.pi * RADII.prod(), rel=0.04)
  np.testing.assert_allclose(oblique.centroid(vertices, triangles), CENTER, atol=3e-4)
  up = normals(vertices, triangles)
  out = vertices[triangles].mean(axis=1) - CENTER
  assert (np.einsum("md,md->m", up, out) > 0).all()


def test_label_at_the_border_is_closed():
  labels = np.ones((20, 24, 16), dtype=bool)
  vertices, triangles = volumes.surface(labels, np.diag([2e-3, 2e-3, 2e-3, 1]))
  q = quality(vertices, triangles)
  assert q.closed
  assert q.volume == pytest.approx(20 * 24 * 16 * 8e-9, rel=0.05)  # edges are rounded


def test_labels_are_listed(tmp_path):
  path, affine = tmp_path / "scan.nii", GRIDS["even"]
  labels = ellipsoid(affine, label=2)
  labels[0, 0, 0] = 5
  save_nifti(path, labels, affine)
  with pytest.raises(ValueError, match=r"scan.nii: label is 4, .*in the volume: 2, 5"):
    volumes.wrap_volume(path, label=4)
  with pytest.raises(ValueError, match=r"label is not given, .*in the volume: 2, 5"):
    volumes.wrap_volume(path)
  with pytest.raises(ValueError, match="label 5: too small, 1 voxels"):
    volumes.wrap_volume(path, label=5)
  save_nifti(path, labels * 0, affine)
  with pytest.raises(ValueError, match="in the volume: none"):
    volumes.wrap_volume(path)


def test_labels_take_the_smallest_integers(tmp_path):
  affine = GRIDS["even"]
  for value, kind in ((3, np.uint8), (300, np.uint16), (-3, np.int8)):
    for saved in (np.int16, np.float32):
      save_nifti(tmp_path / "scan.nii", ellipsoid(affine, label=value).astype(saved), affine)
      labels = volumes.read(tmp_path / "scan.nii")
      assert labels.values.dtype == kind
      assert [each.value for each in labels.segments] == [value]


def test_volumes_larger_than_they_may_be_are_refused_unread(tmp_path):
  path = tmp_path / "large.nii"
  header = nibabel.Nifti1Header()
  header.set_data_shape((30_000, 30_000, 30_000))
  with path.open("wb") as file:
    header["vox_offset"] = 352
    file.write(header.binaryblock + bytes(4))
  with pytest.raises(ValueError, match="declares 27000000000000 voxels, expected 1 to"):
    volumes.read(path)
  text = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: {0} {0} {0}\nencoding: {1}\n{2}\n"
  path = tmp_path / "large.nrrd"
  path.write_bytes(text.format(30_000, "gzip", "").encode())
  with pytest.raises(ValueError, match="declares 27000000000000 voxels, expected 1 to"):
    volumes.read(path)
  path.write_bytes(text.format(10, "gzip", "").encode() + gzip.compress(bytes(10**6)))
  with pytest.raises(ValueError, match="holds more voxels than its header declares"):
    volumes.read(path)
  (tmp_path / "other").write_bytes(bytes(1000))
  path.write_bytes(text.format(10, "raw", "data file: other\n").encode())
  with pytest.raises(ValueError, match="its voxels are in another file"):
    volumes.read(path)


def test_colours_are_no_labels(tmp_path):
  colours = np.zeros((4, 4, 4), [("R", "u1"), ("G", "u1"), ("B", "u1")])
  nibabel.save(nibabel.Nifti1Image(colours, np.eye(4)), tmp_path / "colours.nii")
  with pytest.raises(ValueError, match=r"colours.nii: has values of type .*, expected whole"):
    volumes.read(tmp_path / "colours.nii")


def test_files_that_are_no_label_maps(tmp_path):
  affine = np.eye(4)
  with pytest.raises(ValueError, match=r"scan.dcm: .*\.nii, \.nii\.gz, \.nrrd"):
    volumes.read(tmp_path / "scan.dcm")
  with pytest.raises(FileNotFoundError, match="none"):
    volumes.read(tmp_path / "none.nii")
  for ending in ("nii", "nrrd"):
    path = tmp_path / f"broken.{ending}"
    path.write_bytes(b"nothing of use")
    with pytest.raises(ValueError, match=rf"broken.{ending}: cannot be read"):
      volumes.read(path)
  path = tmp_path / "grey.nii"
  nibabel.save(nibabel.Nifti1Image(np.full((4, 4, 4), 0.5, np.float32), affine), path)
  with pytest.raises(ValueError, match=r"has the value 0.5, expected a label map"):
    volumes.read(path)
  path = tmp_path / "many.nii"
  nibabel.save(nibabel.Nifti1Image(np.ones((4, 4, 4, 3), np.int16), affine), path)
  with pytest.raises(ValueError, match="has 4 dimensions, expected a volume with 3"):
    volumes.read(path)
