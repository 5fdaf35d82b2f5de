"""Reads volumes: NIfTI by nibabel, NRRD by pynrrd, a folder of DICOM slices by pydicom.

`pip install palpate[image]` brings the three. A volume is its voxels, (layer, i, j, k), the affine
map (4, 4) from indices to metres, x to the patient's right, y anterior, z superior (RAS), and the
segments that have names.
"""

import bz2
import dataclasses
import gzip
import math
import pathlib

import numpy as np

KINDS = (".nii", ".nii.gz", ".nrrd")
_METRES = {"m": 1.0, "meter": 1.0, "mm": 1e-3, "um": 1e-6, "micron": 1e-6, "cm": 1e-2}
_MOST = 2**29  # voxels of a volume
_UNEVEN = 0.1  # of the distance between slices, by which one may be off its place
# Of a slice: its place, axes, pixels [mm] and size.
_WHERE = ("ImagePositionPatient", "ImageOrientationPatient", "PixelSpacing", "Rows", "Columns")
_LPS = np.diag([-1e-3, -1e-3, 1e-3, 1.0])  # from DICOM's millimetres, x to the left, y posterior


@dataclasses.dataclass(frozen=True)
class Segment:
  """One label of a volume.

  Attributes:
    value: its number
    layer: the layer that it is in; labels of different layers may overlap
    name: the file's, or nothing
  """

  value: int
  layer: int = 0
  name: str = ""

  def __str__(self) -> str:
    return f"{self.value} ({self.name})" if self.name else f"{self.value}"


Volume = tuple[np.ndarray, np.ndarray, list[Segment]]


def is_volume(path: pathlib.Path) -> bool:
  """Returns whether a path is that of a volume: a file of KINDS, or a folder of slices."""
  return path.name.lower().endswith(KINDS) or path.is_dir()


def read(path: pathlib.Path) -> Volume:
  """Returns the volume in a file or folder.

  Raises:
    ValueError: it cannot be read, or it declares more voxels than are read.
  """
  if not is_volume(path):
    raise ValueError(
      f"{path}: not a volume that can be read ({', '.join(KINDS)}, or a folder with the slices of "
      "a DICOM series)"
    )
  if not (path.is_dir() or path.is_file()):
    raise FileNotFoundError(f"{path}: no such file, or no regular one")
  one = _read_nrrd if path.name.lower().endswith(".nrrd") else _read_nifti
  try:
    values, affine, named = _read_dicom(path) if path.is_dir() else one(str(path))
  except ImportError as error:
    raise ImportError(f"{path}: reading volumes needs `pip install palpate[image]`") from error
  except Exception as error:
    raise ValueError(f"{path}: cannot be read: {' '.join(str(error).split())}") from error
  if values.ndim != 4:
    raise ValueError(f"{path}: has {values.ndim - 1} dimensions, expected a volume with 3")
  if values.dtype.kind not in "biuf":
    raise ValueError(f"{path}: has values of type {values.dtype}, expected whole numbers or reals")
  if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < 1e-18:
    raise ValueError(f"{path}: its orientation is {affine[:3, :3].tolist()}, expected three axes")
  return values, affine, named


def _check_size(shape):
  """Raises ValueError where a header declares more voxels than are read."""
  count = math.prod(int(each) for each in shape)
  if not 0 < count <= _MOST:
    raise ValueError(f"it declares {count} voxels, expected 1 to {_MOST}")


def _read_nifti(name: str) -> Volume:
  import nibabel

  image = nibabel.load(name)
  _check_size(image.shape)  # pyright: ignore
  unit = image.header.get_xyzt_units()[0]  # pyright: ignore
  affine = np.diag([_METRES.get(unit, 1e-3)] * 3 + [1]) @ image.affine  # pyright: ignore
  values = np.asanyarray(image.dataobj)  # pyright: ignore
  while values.ndim > 3 and values.shape[-1] == 1:
    values = values[..., 0]
  return values[None], affine, []


def _read_nrrd(name: str) -> Volume:
  import nrrd

  with open(name, "rb") as file:
    header = nrrd.read_header(file)
    _check_size(header["sizes"])
    if "data file" in header or "datafile" in header:
      raise ValueError("its voxels are in another file, expected them behind the header")
    _check_stream(file, str(header["encoding"]), 8 * math.prod(map(int, header["sizes"])))
    values = nrrd.read_data(header, file, name)
  affine = np.eye(4)
  if header.get("space directions") is not None:
    rows = np.asarray(header["space directions"], dtype=float)
    in_space = np.isfinite(rows).all(axis=1)
    layers = np.flatnonzero(~in_space)
    if in_space.sum() != 3:
      raise ValueError(f"it has {in_space.sum()} axes in space, expected 3")
    affine[:3, :3] = rows[in_space].T
  else:
    affine[:3, :3] = np.diag(header.get("spacings", np.ones(3))[-3:])
    layers = [0] if values.ndim == 4 else []
  values = np.moveaxis(values, layers[0], 0) if len(layers) == 1 else values[None]
  affine[:3, 3] = header.get("space origin", np.zeros(3))
  space = str(header.get("space", "right-anterior-superior")).lower()
  words = space.split("-")[:3] if "-" in space else list(space)[:3]
  sign = [-1.0 if word[0] in "lpi" else 1.0 for word in words]
  unit = str(np.atleast_1d(header.get("space units", "mm"))[0])
  affine = np.diag([*(_METRES.get(unit, 1e-3) * np.array(sign)), 1.0]) @ affine
  return values, affine, _segments(header)


def _check_stream(file, encoding: str, most: int):
  """Raises ValueError where compressed voxels are more bytes than the header allows for."""
  stream = {"gzip": gzip.open, "gz": gzip.open, "bzip2": bz2.open, "bz2": bz2.open}
  if encoding not in stream:
    return
  at = file.tell()
  with stream[encoding](file) as packed:
    while some := packed.read(1 << 22):
      most -= len(some)
      if most < 0:
        raise ValueError("it holds more voxels than its header declares")
  file.seek(at)


def _segments(header: dict) -> list[Segment]:
  """Returns the segments that the header of a .seg.nrrd has."""
  count = 0
  found = []
  while f"Segment{count}_LabelValue" in header:
    key = f"Segment{count}_"
    value, layer = int(header[f"{key}LabelValue"]), int(header.get(f"{key}Layer", 0))
    found.append(Segment(value, layer, str(header.get(f"{key}Name", ""))))
    count += 1
  return found


def _read_dicom(folder: pathlib.Path) -> Volume:
  """Returns the slices of one series, in the order of their places, rescaled as they say."""
  from pydicom import dcmread
  from pydicom.pixels.processing import apply_rescale

  heads = {}
  for path in sorted(folder.iterdir()):
    if path.is_file() and (head := _slice_header(path)) is not None:
      heads[path.name] = head
  names, shape, affine = _stack(heads)
  values = np.empty((1, *shape), np.float32)
  for k, name in enumerate(names):
    data = dcmread(folder / name)
    try:
      values[0, :, :, k] = np.asarray(apply_rescale(data.pixel_array, data)).T
    except Exception as error:
      raise ValueError(f"slice {name!r}: {error}") from error
  return values, affine, []


def _slice_header(path: pathlib.Path):
  """Returns what a file says of the slice in it; None where it is no DICOM image."""
  from pydicom import dcmread
  from pydicom.errors import InvalidDicomError
  from pydicom.filereader import read_file_meta_info
  from pydicom.uid import DeflatedExplicitVRLittleEndian

  wanted = ["SeriesInstanceUID", "SeriesDescription", "NumberOfFrames", "SamplesPerPixel", *_WHERE]
  try:
    # What is deflated would be inflated as a whole, however large it is.
    if read_file_meta_info(path).get("TransferSyntaxUID") == DeflatedExplicitVRLittleEndian:
      raise ValueError("is deflated, expected pixels that are stored or compressed by slice")
    head = dcmread(path, stop_before_pixels=True, specific_tags=wanted)
    [head.get(key) for key in wanted]  # values are decoded when they are asked for
  except InvalidDicomError:
    return None
  except Exception as error:
    raise ValueError(f"{path.name!r}: {error}") from error
  return head if "Rows" in head else None


def _stack(heads: dict) -> tuple[list[str], tuple[int, int, int], np.ndarray]:
  """Returns the names of slices in the order of their places, the volume's shape and affine map.

  Raises:
    ValueError: they are not the slices of one series, evenly apart; the message names which.
  """
  if len(heads) < 2:
    raise ValueError(f"it holds {len(heads)} DICOM slices, expected those of a series, 2 or more")
  series: dict[str, list] = {}
  for head in heads.values():
    title = str(head.get("SeriesDescription", "") or head.get("SeriesInstanceUID", ""))
    series.setdefault(str(head.get("SeriesInstanceUID", "")), []).append(title)
  if len(series) > 1:
    titles = sorted(series.values())
    listed = ", ".join(f"{each[0]!r} ({len(each)} slices)" for each in titles)
    raise ValueError(f"it holds {len(series)} series, {listed}, expected a folder for each")
  names, places = list(heads), []
  for name, head in heads.items():
    if int(head.get("NumberOfFrames") or 1) > 1 or head.get("SamplesPerPixel", 1) != 1:
      raise ValueError(f"{name!r} holds several frames or colours, expected one slice of numbers")
    try:
      said = [np.ravel(np.asarray(head.get(key), dtype=float)) for key in _WHERE]
    except (TypeError, ValueError):
      said = [np.full(1, np.nan)]
    places.append(np.concatenate(said))
    if places[-1].shape != (13,) or not np.isfinite(places[-1]).all():
      raise ValueError(f"slice {name!r} says no place, orientation and spacing of its pixels")
    if np.abs(places[-1][3:] - places[0][3:]).max() > 1e-3:
      raise ValueError(f"slices {names[0]!r} and {name!r} differ in size, spacing or orientation")
  place = np.array(places)
  right, down, spacing = place[0, 3:6], place[0, 6:9], place[0, 9:11]
  shape = int(place[0, 12]), int(place[0, 11]), len(names)
  _check_size(shape)
  order = np.argsort(place[:, :3] @ np.cross(right, down), kind="stable")
  names, corner = [names[k] for k in order], place[order, :3]
  step = np.diff(corner, axis=0)
  usual = np.median(step, axis=0)
  off = np.linalg.norm(step - usual, axis=1)
  k = int(off.argmax())
  if not np.linalg.norm(usual) > 0 or off[k] > _UNEVEN * np.linalg.norm(usual):
    raise ValueError(
      f"from slice {names[k]!r} to {names[k + 1]!r} it is {np.linalg.norm(step[k]):.3g} mm, "
      f"expected {np.linalg.norm(usual):.3g} mm as between the others: a slice is missing, twice "
      "there or out of line"
    )
  affine = np.eye(4)
  affine[:3, 0], affine[:3, 1] = right * spacing[1], down * spacing[0]
  affine[:3, 2] = (corner[-1] - corner[0]) / (len(names) - 1)
  affine[:3, 3] = corner[0]
  return names, shape, _LPS @ affine
