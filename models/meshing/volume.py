"""Organs from images: a label of a segmented volume to a surface, then to an organ.

Frame: x to the patient's right, y anterior, z superior (RAS), metres, whatever the file's order of
slices and orientation; the origin is the image's. Files are read by nibabel (NIfTI) and pynrrd
(NRRD), which `pip install palpate[image]` brings.
"""

from __future__ import annotations

import bz2
import dataclasses
import gzip
import math
import os

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from .field import Field
from .wrap import Report, wrap, wrap_pieces

KINDS = (".nii", ".nii.gz", ".nrrd")
_METRES = {"m": 1.0, "meter": 1.0, "mm": 1e-3, "um": 1e-6, "micron": 1e-6, "cm": 1e-2}
_SMOOTHING = 0.6  # of the largest voxel edge; removes the steps between slices
_PAD = 4  # voxels around a label
_MOST = 2**29  # voxels of a volume

Wrapped = tuple[np.ndarray, np.ndarray, Report]


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


@dataclasses.dataclass(frozen=True)
class Labels:
  """A label map.

  Attributes:
    name: for messages
    values: label of every voxel             (layer, i, j, k)
    affine: from indices to metres, RAS      (4, 4)
    segments: the labels in it but for 0
  """

  name: str
  values: np.ndarray
  affine: np.ndarray
  segments: tuple[Segment, ...]

  def segment(self, label: int | str | None = None) -> Segment:
    """Returns a label by number or name; None for the only one there is."""
    listed = ", ".join(map(str, self.segments)) or "none"
    if label is None:
      fitting = list(self.segments)
      what = "label is not given, expected one of those in the volume"
    else:
      fitting = [s for s in self.segments if str(label) in (s.name, str(s.value))]
      what = f"label is {label}, expected one of those in the volume"
      if len(fitting) > 1:
        what = f"label is {label} in {len(fitting)} layers, expected a name of those in the volume"
    if len(fitting) != 1:
      raise ValueError(f"{self.name}: {what}: {listed}")
    return fitting[0]

  def surface(self, segment: Segment) -> tuple[np.ndarray, np.ndarray]:
    """Returns the surface of a label, vertices (n, 3) [m] and triangles (m, 3), wound outward."""
    mask = self.values[segment.layer] == segment.value
    try:
      return surface(mask, self.affine)
    except ValueError as error:
      raise ValueError(f"{self.name}: label {segment}: {error}") from None


def wrap_volume(
  path: str | os.PathLike,
  nodes: int | None = None,
  *,
  label: int | str | None = None,
  method: str = "even",
) -> Wrapped:
  """Returns vertices (n, 3) [m], triangles (m, 3) and a report for a label of a volume.

  Args:
    path: a label map, NIfTI (.nii, .nii.gz) or NRRD (.nrrd, .seg.nrrd)
    nodes: number of nodes, as in wrap
    label: the organ's number or name in the volume; not needed if there is only one
    method: even or grid, as in wrap

  Raises:
    ValueError: the volume has no such label, is no label map, or cannot be wrapped.
  """
  labels = read(path)
  return wrap_label(labels, labels.segment(label), nodes, method=method)[0]


def wrap_label(
  labels: Labels,
  segment: Segment,
  nodes: int | None = None,
  *,
  method: str = "even",
  pieces: bool = False,
) -> list[Wrapped]:
  """Returns the wrap of a label's largest body, or of every one; arguments as for `wrap`."""
  mesh = labels.surface(segment)
  try:
    if pieces:
      return wrap_pieces(mesh, nodes, method=method)
    return [wrap(mesh, nodes, method=method)]
  except ValueError as error:
    reason = str(error).removeprefix("mesh: ")
    raise ValueError(f"{labels.name}: label {segment}: {reason}") from error


def read(path: str | os.PathLike) -> Labels:
  """Returns the label map in a file."""
  name = os.fspath(path)
  if not name.lower().endswith(KINDS):
    raise ValueError(f"{name}: not a volume that can be read ({', '.join(KINDS)})")
  if not os.path.isfile(name):
    raise FileNotFoundError(f"{name}: no such file")
  reader = _read_nrrd if name.lower().endswith(".nrrd") else _read_nifti
  try:
    values, affine, named = reader(name)
  except ImportError as error:
    raise ImportError(f"{name}: reading volumes needs `pip install palpate[image]`") from error
  except Exception as error:
    raise ValueError(f"{name}: cannot be read: {error}") from error
  if values.ndim != 4:
    raise ValueError(f"{name}: has {values.ndim - 1} dimensions, expected a label map with 3")
  labels = _whole(name, values)
  if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < 1e-18:
    raise ValueError(f"{name}: its orientation is {affine[:3, :3].tolist()}, expected three axes")
  names = {(segment.layer, segment.value): segment for segment in named}
  found = (
    names.get((layer, int(value)), Segment(int(value), layer))
    for layer, each in enumerate(labels)
    for value in sorted(set().union(*(np.unique(part).tolist() for part in each)) - {0})
  )
  return Labels(name, labels, affine, tuple(found))


def _whole(name: str, values: np.ndarray) -> np.ndarray:
  """Returns labels in the smallest type of integers that holds them."""
  if values.dtype.kind not in "biuf":
    raise ValueError(f"{name}: has values of type {values.dtype}, expected whole numbers")
  low, high = (values.min(), values.max()) if values.size else (0, 0)
  if not -(2.0**63) <= low <= high < 2.0**63:
    other = high if np.isfinite(low) else low
    raise ValueError(f"{name}: has the value {other}, expected a label map of whole numbers")
  low, high = int(low), int(high)
  labels = np.empty(values.shape, np.min_scalar_type(high if low >= 0 else min(low, -high - 1)))
  for k in np.ndindex(*values.shape[:2]):  # slices: no second copy of them all
    labels[k] = values[k]
    if not np.array_equal(labels[k], values[k]):
      other = values[k][labels[k] != values[k]][0]
      raise ValueError(f"{name}: has the value {other}, expected a label map of whole numbers")
  return labels


def _check_size(shape):
  """Raises ValueError where a header declares more voxels than are read."""
  count = math.prod(int(each) for each in shape)
  if not 0 < count <= _MOST:
    raise ValueError(f"it declares {count} voxels, expected 1 to {_MOST}")


def surface(mask: np.ndarray, affine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the surface of voxels, vertices (n, 3) [m] and triangles (m, 3), outward winding.

  Args:
    mask: which voxels                                        (i, j, k)
    affine: from indices (voxel centres) to metres            (4, 4)
  """
  voxel = np.argwhere(mask)
  low, high = voxel.min(axis=0), voxel.max(axis=0)
  mask = np.pad(mask[tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))], _PAD)
  edge = np.linalg.norm(affine[:3, :3], axis=0)
  distance = _edt(~mask, edge) - _edt(mask, edge)
  distance = gaussian_filter(distance, _SMOOTHING * edge.max() / edge)
  if distance.min() >= 0:
    raise ValueError(f"too small, {len(voxel)} voxels, expected an organ")
  vertices, triangles = Field(distance, low - float(_PAD), 1.0).surface()
  if np.linalg.det(affine[:3, :3]) < 0:
    triangles = triangles[:, ::-1].copy()
  return vertices @ affine[:3, :3].T + affine[:3, 3], triangles


def _edt(mask: np.ndarray, edge: np.ndarray) -> np.ndarray:
  return np.asarray(distance_transform_edt(mask, sampling=edge))


Read = tuple[np.ndarray, np.ndarray, list[Segment]]  # (layer, i, j, k), (4, 4), those with names


def _read_nifti(name: str) -> Read:
  import nibabel

  image = nibabel.load(name)
  _check_size(image.shape)  # pyright: ignore
  unit = image.header.get_xyzt_units()[0]  # pyright: ignore
  affine = np.diag([_METRES.get(unit, 1e-3)] * 3 + [1]) @ image.affine  # pyright: ignore
  values = np.asanyarray(image.dataobj)  # pyright: ignore
  while values.ndim > 3 and values.shape[-1] == 1:
    values = values[..., 0]
  return values[None], affine, []


def _read_nrrd(name: str) -> Read:
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
    rows = [_direction(row) for row in header["space directions"]]
    layers = [k for k, row in enumerate(rows) if row is None]  # an axis that is not in space
    if len(rows) - len(layers) != 3:
      raise ValueError(f"it has {len(rows) - len(layers)} axes in space, expected 3")
    affine[:3, :3] = np.array([row for row in rows if row is not None]).T
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


def _direction(row) -> np.ndarray | None:
  """Returns an axis of a volume; None for one that is not in space, such as that of the layers."""
  if row is None or not np.isfinite(np.asarray(row, dtype=float)).all():
    return None
  return np.asarray(row, dtype=float)


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
