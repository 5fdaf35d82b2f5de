"""Scans become organs by a threshold: NIfTI, NRRD and folders of DICOM slices made here."""

import pathlib
import re

import numpy as np
import oblique
import pytest
from oblique import CENTER
from palpate.models.meshing import volume as volumes
from palpate.models.meshing.quality import quality
from palpate.models.meshing.quality import volume as enclosed

nibabel = pytest.importorskip("nibabel")
nrrd = pytest.importorskip("nrrd")
pydicom = pytest.importorskip("pydicom")

SHAPES = {"sphere": (0.03, 0.03, 0.03), "ellipsoid": (0.036, 0.022, 0.028)}  # radii [m]
SIZE = (56, 60, 52)
INSIDE, OUTSIDE, NOISE = 60.0, -80.0, 15.0  # [HU]; fat around an organ


def affine(spacing=(1.4e-3, 1.3e-3, 1.8e-3), turn=None):
  """Returns the map from indices to metres of an oblique grid with the organ in its middle."""
  return oblique.affine(spacing, oblique.rotation(25) if turn is None else turn, SIZE)


def scan(shape, grid, other=True):
  """Returns the scan of an organ in fat [HU], with noise, and a smaller part of its own."""
  world = oblique.places(grid, SIZE)
  radii = np.array(SHAPES[shape])
  away = (np.sqrt(((world / radii) ** 2).sum(axis=-1)) - 1) * radii.min()  # [m], to first order
  # A voxel's value is the mean over it: the edge is as wide as a voxel.
  share = np.clip(0.5 - away / 1.5e-3, 0, 1)
  values = OUTSIDE + (INSIDE - OUTSIDE) * share
  if other:
    values[2:6, 2:6, 2:6] = 400.0
  return values + np.random.RandomState(0).normal(size=SIZE) * NOISE


def save_nifti(path, values, grid):
  image = nibabel.Nifti1Image(values.astype(np.int16), np.diag([1e3, 1e3, 1e3, 1]) @ grid)
  image.header.set_xyzt_units("mm")
  nibabel.save(image, path)


def save_nrrd(path, values, grid):
  grid = np.diag([-1e3, -1e3, 1e3, 1]) @ grid
  header = {"space": "left-posterior-superior", "space directions": grid[:3, :3].T}
  nrrd.write(str(path), values.astype(np.float32), {**header, "space origin": grid[:3, 3]})


def slices(values, grid, slope=2.0, intercept=-1024.0):
  """Returns the data sets of a DICOM series."""
  lps = np.diag([-1e3, -1e3, 1e3, 1]) @ grid
  spacing = np.linalg.norm(lps[:3, :3], axis=0)
  stored = np.round((values - intercept) / slope).astype(np.uint16)
  out = []
  for k in range(values.shape[2]):
    data = pydicom.Dataset()
    data.file_meta = pydicom.dataset.FileMetaDataset()
    data.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
    data.file_meta.MediaStorageSOPClassUID = pydicom.uid.CTImageStorage
    data.file_meta.MediaStorageSOPInstanceUID = data.SOPInstanceUID = f"1.2.3.{k + 1}"
    data.SOPClassUID, data.Modality = pydicom.uid.CTImageStorage, "CT"
    data.SeriesInstanceUID, data.SeriesDescription = "1.2.3", "Abdomen"
    data.Columns, data.Rows = values.shape[:2]
    data.PixelSpacing = [round(float(s), 6) for s in spacing[[1, 0]]]
    axes = (lps[:3, :2] / spacing[:2]).T.ravel()
    data.ImageOrientationPatient = [f"{x:.8f}" for x in axes]
    data.ImagePositionPatient = [f"{x:.6f}" for x in lps[:3] @ [0, 0, k, 1]]
    data.SamplesPerPixel, data.PhotometricInterpretation = 1, "MONOCHROME2"
    data.BitsAllocated = data.BitsStored = 16
    data.HighBit, data.PixelRepresentation = 15, 0
    data.RescaleSlope, data.RescaleIntercept = slope, intercept
    data.PixelData = np.ascontiguousarray(stored[:, :, k].T).tobytes()
    out.append(data)
  return out


def save_series(folder, series, seed=0):
  """Writes slices under names whose order is not that of their places."""
  folder.mkdir(exist_ok=True)
  order = np.random.RandomState(seed).permutation(len(series))
  for name, k in enumerate(order):
    series[k].save_as(folder / f"IM{name:04d}", enforce_file_format=True)


def save_dicom(path, values, grid):
  save_series(path, slices(values, grid))


SAVE = {"scan.nii.gz": save_nifti, "scan.nrrd": save_nrrd, "series": save_dicom}


@pytest.mark.parametrize("name", SAVE)
@pytest.mark.parametrize("shape", SHAPES)
def test_a_scan_becomes_the_organ_in_it(shape, name, tmp_path):
  grid = affine()
  SAVE[name](tmp_path / name, scan(shape, grid), grid)
  labels = volumes.read(tmp_path / name, 0.5 * (INSIDE + OUTSIDE), 300)
  np.testing.assert_allclose(labels.affine, grid, rtol=1e-5, atol=1e-7)
  surface = labels.surface(labels.segment())
  assert quality(*surface).closed
  radii = np.array(SHAPES[shape])
  assert enclosed(*surface) == pytest.approx(4 / 3 * np.pi * radii.prod(), rel=0.02)
  assert np.linalg.norm(oblique.centroid(*surface) - CENTER) < 1.3e-3  # a voxel
  np.testing.assert_allclose(np.ptp(surface[0], axis=0), 2 * radii, atol=2e-3)  # upright again


def test_the_three_kinds_say_the_same_and_the_largest_part_is_taken(tmp_path):
  grid = affine()
  found = []
  for name, save in SAVE.items():
    save(tmp_path / name, scan("ellipsoid", grid), grid)
    vertices, triangles, report = volumes.wrap_volume(tmp_path / name, 500, threshold=-10)
    assert report.losses == () and report.pieces == 1 and report.nodes == 500
    found.append((quality(vertices, triangles).volume, oblique.centroid(vertices, triangles)))
  radii = np.array(SHAPES["ellipsoid"])
  # 500 nodes cut 1 % off, smoothing up to 3 % more, as of label maps.
  assert found[0][0] == pytest.approx(4 / 3 * np.pi * radii.prod(), rel=0.04)
  for size, middle in found[1:]:
    assert size == pytest.approx(found[0][0], rel=5e-3)  # stored to 2 HU in the slices
    np.testing.assert_allclose(middle, found[0][1], atol=2e-4)
  note = str(volumes.read(tmp_path / "series", 0))
  assert note.startswith("56 x 60 x 52 voxels of 1.4 x 1.3 x 1.8 mm; taken: 9")
  assert "ml of 0 and more, left out: " in note
  # What is brighter than the organ is taken where it is asked for.
  labels = volumes.read(tmp_path / "series", 300)
  assert labels.values.sum() == 4**3


def test_a_tilted_gantry_shears_the_slices(tmp_path):
  grid = affine(turn=np.eye(3))
  grid[1, 2] = 0.4 * grid[2, 2]
  values = scan("sphere", grid)
  save_dicom(tmp_path / "series", values, grid)
  labels = volumes.read(tmp_path / "series", 0)
  np.testing.assert_allclose(labels.affine, grid, rtol=1e-5, atol=1e-7)


def spoilt(change):
  """Returns a function that saves a series with some of its slices changed."""

  def save(folder):
    grid = affine()
    series = slices(scan("sphere", grid)[:, :, :6], grid)
    save_series(folder, change(series) or series)

  return save


def each(key, value, first=3):
  """Returns a change of a tag in a slice."""

  def change(series):
    setattr(series[first], key, value)

  return spoilt(change)


def twice(series):
  other = slices(np.zeros((*SIZE[:2], 3)), affine())
  for data in other:
    data.SeriesInstanceUID, data.SeriesDescription = "1.2.4", "Scout"
  return series + other


def aside(series):
  x, y, z = series[2].ImagePositionPatient
  series[2].ImagePositionPatient = [float(x) + 1.5, y, z]


def deflated(series):
  for data in series:
    data.file_meta.TransferSyntaxUID = pydicom.uid.DeflatedExplicitVRLittleEndian


def short(series):
  series[1].PixelData = series[1].PixelData[:100]


@pytest.mark.parametrize(
  ("save", "words"),
  [
    (spoilt(lambda s: s[:2] + s[3:]), r"'IM\d+' to 'IM\d+' it is 3.6 mm, expected 1.8 mm"),
    (spoilt(lambda s: [*s, s[4]]), r"it is 0 mm, expected 1.8 mm as between the others"),
    (spoilt(aside), r"a slice is missing, twice there or out of line"),
    (spoilt(twice), r"2 series, 'Abdomen' \(6 slices\), 'Scout' \(3 slices\), expected a folder"),
    (spoilt(lambda s: s[:1]), "holds 1 DICOM slices, expected those of a series"),
    (each("ImageOrientationPatient", [1, 0, 0, 0, 1, 0]), r"slices 'IM\d+' and 'IM\d+' differ in"),
    (each("PixelSpacing", [3, 3]), "differ in size, spacing or orientation"),
    (each("ImagePositionPatient", None), r"slice 'IM\d+' says no place"),
    (each("ImagePositionPatient", [1, 2]), r"slice 'IM\d+' says no place"),
    (each("NumberOfFrames", 40), r"'IM\d+' holds several frames or colours"),
    (each("SamplesPerPixel", 3), r"'IM\d+' holds several frames or colours"),
    (spoilt(deflated), r"'IM\d+': is deflated, expected"),
    (spoilt(short), r"slice 'IM\d+': "),
  ],
)
def test_slices_that_are_no_series_are_named(save, words, tmp_path):
  save(tmp_path / "series")
  with pytest.raises(ValueError, match=f"series: cannot be read: .*{words}"):
    volumes.read(tmp_path / "series", 0)


def test_what_lies_beside_the_slices_is_skipped(tmp_path):
  grid, folder = affine(), tmp_path / "series"
  save_dicom(folder, scan("sphere", grid), grid)
  (folder / "README.txt").write_text("not a slice")
  (folder / "empty").touch()
  (folder / "more").mkdir()
  report = pydicom.Dataset()
  report.file_meta = pydicom.dataset.FileMetaDataset()
  report.file_meta.TransferSyntaxUID = pydicom.uid.ExplicitVRLittleEndian
  report.file_meta.MediaStorageSOPClassUID = report.SOPClassUID = "1.2.840.10008.5.1.4.1.1.88.11"
  report.file_meta.MediaStorageSOPInstanceUID = report.SOPInstanceUID = "1.2.3.999"
  report.save_as(folder / "SR0001", enforce_file_format=True)
  assert volumes.read(folder, 0).values.shape == (1, *SIZE)
  with pytest.raises(ValueError, match="holds 0 DICOM slices"):
    volumes.read(folder / "more", 0)


def test_a_series_larger_than_it_may_be_is_refused_unread(tmp_path):
  series = slices(np.zeros((4, 4, 3)), affine())
  for data in series:
    data.Rows = data.Columns = 60_000
  save_series(tmp_path / "series", series)
  with pytest.raises(ValueError, match="it declares 10800000000 voxels, expected 1 to"):
    volumes.read(tmp_path / "series", 0)


def test_thresholds_say_what_is_there(tmp_path):
  grid = affine()
  path = tmp_path / "scan.nii.gz"
  save_nifti(path, scan("sphere", grid), grid)
  with pytest.raises(ValueError, match=r"no voxel has 5000 and more, its values are -\d+ to 4\d\d"):
    volumes.read(path, 5000)
  with pytest.raises(ValueError, match="threshold is nan, expected a number"):
    volumes.read(path, np.nan)
  with pytest.raises(ValueError, match="upper is 20, expected a number > 30, the threshold"):
    volumes.read(path, 30, 20)
  with pytest.raises(ValueError, match=r"label 1 \(450 and more\): too small, 1 voxels"):
    values = scan("sphere", grid, other=False)
    values[20, 20, 20] = 500
    save_nifti(path, values, grid)
    volumes.wrap_volume(path, threshold=450)
  values = np.arange(SIZE[0] * SIZE[1] * 2).reshape(*SIZE[:2], 2)
  save_nifti(path, values, grid)
  with pytest.raises(ValueError, match=r"has 6\d+ different values, .*a scan needs a threshold"):
    volumes.read(path)


def test_layers_are_no_scan(tmp_path):
  header = {"space": "LPS", "space directions": np.vstack([[np.nan] * 3, np.eye(3)])}
  nrrd.write(str(tmp_path / "scan.nrrd"), np.ones((2, 4, 4, 4), np.int16), header)
  with pytest.raises(ValueError, match="has 2 layers, expected a scan with one"):
    volumes.read(tmp_path / "scan.nrrd", 0)


def test_the_example_of_the_page_runs(tmp_path, monkeypatch, capsys):
  page = pathlib.Path(__file__).parents[3] / "docs" / "wrapping.md"
  text = page.read_text(encoding="utf-8").split("### Scans")[1]
  monkeypatch.chdir(tmp_path)
  code = re.search(r"```python\n(.*?)```", text, re.S)[1]
  exec(compile(code, str(page), "exec"), {})
  told = float(re.search(r"# (\S+) m", code)[1])
  assert float(capsys.readouterr().out) == pytest.approx(told, rel=5e-3)
