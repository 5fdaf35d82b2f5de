"""Organs from images: a label of a segmented volume, or what a threshold takes of a scan.

Frame: x to the patient's right, y anterior, z superior (RAS), metres, whatever the file's order of
slices and orientation; the origin is the image's.
"""

import dataclasses
import math
import os
import pathlib

import numpy as np
import scipy

from . import images
from .field import Field
from .images import Segment
from .raster import depth, parts
from .wrap import Report, wrap, wrap_pieces

_SMOOTHING = 0.6  # of the largest voxel edge; removes the steps between slices
_PAD = 4  # voxels around a label
_MOST_LABELS = 1000
_NO_MAP = "expected a label map of whole numbers; a scan needs a threshold"

Wrapped = tuple[np.ndarray, np.ndarray, Report]


@dataclasses.dataclass(frozen=True)
class Labels:
  """A label map.

  Attributes:
    name: for messages
    values: label of every voxel             (layer, i, j, k)
    affine: from indices to metres, RAS      (4, 4)
    segments: the labels in it but for 0
    note: what was left out of it, or nothing
  """

  name: str
  values: np.ndarray
  affine: np.ndarray
  segments: tuple[Segment, ...]
  note: str = ""

  def __str__(self) -> str:
    count = " x ".join(map(str, self.values.shape[1:]))
    edges = 1e3 * np.linalg.norm(self.affine[:3, :3], axis=0)
    return f"{count} voxels of {' x '.join(f'{edge:.3g}' for edge in edges)} mm{self.note}"

  def segment(self, label: int | str | None = None) -> Segment:
    """Returns the label of a number or name; None selects the only one."""
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
  threshold: float | None = None,
  upper: float = math.inf,
  method: str = "even",
) -> Wrapped:
  """Returns vertices (n, 3) [m], triangles (m, 3) and a report for an organ in a volume.

  Args:
    path: NIfTI (.nii, .nii.gz), NRRD (.nrrd, .seg.nrrd), or the folder of a DICOM series
    nodes: number of nodes, as in wrap
    label: the organ's number or name in a label map; not needed if there is only one
    threshold: lowest value of the organ in a scan, in units of the file: Hounsfield's for CT
    upper: highest value of the organ in a scan
    method: even, grid or direct, as in wrap

  Raises:
    ValueError: the volume has no such label or values, or cannot be wrapped.
  """
  labels = read(path, threshold, upper)
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


def read(
  path: str | os.PathLike, threshold: float | None = None, upper: float = math.inf
) -> Labels:
  """Returns the label map in a file; of a scan, with a threshold, the largest part between both."""
  name = os.fspath(path)
  for key, value in (("threshold", threshold), ("upper", upper)):
    if value is not None and (math.isnan(value) or value == -math.inf):
      raise ValueError(f"{key} is {value:g}, expected a number")
  if threshold is not None and not threshold < upper:
    raise ValueError(f"upper is {upper:g}, expected a number > {threshold:g}, the threshold")
  values, affine, named = images.read(pathlib.Path(path))
  if threshold is not None:
    return _largest(name, values, affine, threshold, upper)
  labels = _whole(name, values)
  names = {(segment.layer, segment.value): segment for segment in named}
  found = [
    names.get((layer, int(value)), Segment(int(value), layer))
    for layer, each in enumerate(labels)
    for value in sorted(set().union(*(np.unique(part).tolist() for part in each)) - {0})
  ]
  if len(found) > _MOST_LABELS:
    raise ValueError(f"{name}: has {len(found)} different values, {_NO_MAP}")
  return Labels(name, labels, affine, tuple(found))


def _largest(name: str, values: np.ndarray, affine: np.ndarray, low: float, high: float) -> Labels:
  """Returns the largest connected part of a scan whose values are in a range, as a label 1."""
  if len(values) > 1:
    raise ValueError(f"{name}: has {len(values)} layers, expected a scan with one")
  what = f"{low:g} and more" if high == math.inf else f"{low:g} to {high:g}"
  part, count = parts((values[0] >= low) & (values[0] <= high))
  if not count:
    least, most = (f(values[0]) for f in (np.nanmin, np.nanmax))
    raise ValueError(f"{name}: no voxel has {what}, its values are {least:g} to {most:g}")
  size = np.zeros(count + 1, np.int64)
  for each in part:  # slices: no second copy of them all
    number, times = np.unique(each, return_counts=True)
    size[number] += times
  size[0] = 0
  millilitres = 1e6 * abs(np.linalg.det(affine[:3, :3])) * np.sort(size[1:])[::-1]
  first, *others = (f"{float(f'{each:.3g}'):g} ml" for each in millilitres[:2])
  note = f"; taken: {first} of {what}"
  note += f", left out: {count - 1} parts of up to {others[0]}" if others else ""
  mask = (part == size.argmax()).astype(np.uint8)[None]
  return Labels(name, mask, affine, (Segment(1, 0, what),), note)


def _whole(name: str, values: np.ndarray) -> np.ndarray:
  """Returns labels in the smallest type of integers that holds them."""
  low, high = (values.min(), values.max()) if values.size else (0, 0)
  if not -(2.0**63) <= low <= high < 2.0**63:
    other = high if np.isfinite(low) else low
    raise ValueError(f"{name}: has the value {other}, {_NO_MAP}")
  low, high = int(low), int(high)
  labels = np.empty(values.shape, np.min_scalar_type(high if low >= 0 else min(low, -high - 1)))
  for k in np.ndindex(*values.shape[:2]):  # slices: no second copy of them all
    labels[k] = values[k]
    if not np.array_equal(labels[k], values[k]):
      other = values[k][labels[k] != values[k]][0]
      raise ValueError(f"{name}: has the value {other}, {_NO_MAP}")
  return labels


def surface(mask: np.ndarray, affine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the surface of voxels, vertices (n, 3) [m] and triangles (m, 3), outward winding.

  Args:
    mask: which voxels                                        (i, j, k)
    affine: from indices (voxel centres) to metres            (4, 4)
  """
  (box,) = scipy.ndimage.find_objects(mask.astype(np.int8))
  mask, low = np.pad(mask[box], _PAD), np.array([each.start for each in box], dtype=float)
  edge = np.linalg.norm(affine[:3, :3], axis=0)
  distance = depth(~mask, edge) - depth(mask, edge)
  distance = scipy.ndimage.gaussian_filter(distance, _SMOOTHING * edge.max() / edge)
  if distance.min() >= 0:
    raise ValueError(f"too small, {mask.sum()} voxels, expected an organ")
  vertices, triangles = Field(distance, low - _PAD, 1.0).surface()
  if np.linalg.det(affine[:3, :3]) < 0:
    triangles = triangles[:, ::-1].copy()
  return vertices @ affine[:3, :3].T + affine[:3, 3], triangles
