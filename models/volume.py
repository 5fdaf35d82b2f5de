"""Organs from images: a label of a segmented volume to a surface, then to an organ.

Frame: x to the patient's right, y anterior, z superior (RAS), metres, whatever the file's order of
slices and orientation; the origin is the image's. Files are read by nibabel (NIfTI) and pynrrd
(NRRD), which `pip install palpate[image]` brings.
"""

import os

import numpy as np

from .field import Field
from .wrap import Report, wrap

_KINDS = (".nii", ".nii.gz", ".nrrd")
_METRES = {"m": 1.0, "meter": 1.0, "mm": 1e-3, "um": 1e-6, "micron": 1e-6, "cm": 1e-2}
_SMOOTHING = 0.6  # of the largest voxel edge; removes the steps between slices


def wrap_volume(
  path: str | os.PathLike,
  nodes: int | None = None,
  *,
  label: int | None = None,
  method: str = "even",
) -> tuple[np.ndarray, np.ndarray, Report]:
  """Returns vertices (n, 3) [m], triangles (m, 3) and a report for a label of a volume.

  Args:
    path: a label map, NIfTI (.nii, .nii.gz) or NRRD (.nrrd)
    nodes: number of nodes, as in wrap
    label: the organ's number in the volume; not needed if there is only one
    method: even or grid, as in wrap

  Raises:
    ValueError: the volume has no such label, is no label map, or cannot be wrapped.
  """
  labels, affine = read(path)
  try:
    mesh = surface(labels, affine, label)
    return wrap(mesh, nodes, method=method)
  except ValueError as error:
    raise ValueError(f"{os.fspath(path)}: {error}") from error


def read(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
  """Returns a volume's labels (i, j, k) and the affine map (4, 4) from indices to metres in RAS."""
  name = os.fspath(path)
  if not name.endswith(_KINDS):
    raise ValueError(f"{name}: not a volume that can be read ({', '.join(_KINDS)})")
  if not os.path.exists(name):
    raise FileNotFoundError(f"{name}: no such file")
  try:
    values, affine = _read_nrrd(name) if name.endswith(".nrrd") else _read_nifti(name)
  except ImportError as error:
    raise ImportError(f"{name}: reading volumes needs `pip install palpate[image]`") from error
  except Exception as error:
    raise ValueError(f"{name}: cannot be read: {error}") from error
  while values.ndim > 3 and values.shape[-1] == 1:
    values = values[..., 0]
  if values.ndim != 3:
    raise ValueError(f"{name}: has {values.ndim} dimensions, expected a label map with 3")
  labels = np.round(values).astype(np.int64)
  if not np.array_equal(labels, values):
    other = values[labels != values][0]
    raise ValueError(f"{name}: has the value {other}, expected a label map of whole numbers")
  if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < 1e-18:
    raise ValueError(f"{name}: its orientation is {affine[:3, :3].tolist()}, expected three axes")
  return labels, affine


def surface(
  labels: np.ndarray, affine: np.ndarray, label: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
  """Returns the surface of a label, vertices (n, 3) [m] and triangles (m, 3), outward winding.

  Args:
    labels: label of every voxel                              (i, j, k)
    affine: from indices (voxel centres) to metres            (4, 4)
    label: the label wanted; None if the volume has only one besides 0
  """
  from scipy.ndimage import gaussian_filter

  present = np.unique(labels)
  present = present[present != 0]
  listed = ", ".join(map(str, present)) or "none"
  if label is None:
    if len(present) != 1:
      raise ValueError(f"label is not given, expected one of those in the volume: {listed}")
    label = int(present[0])
  if label not in present:
    raise ValueError(f"label is {label}, expected one of those in the volume: {listed}")
  mask = labels == label
  voxel = np.argwhere(mask)
  low = voxel.min(axis=0)
  pad = 4
  mask = np.pad(
    mask[tuple(slice(a, b + 1) for a, b in zip(low, voxel.max(axis=0), strict=True))], pad
  )
  edge = np.linalg.norm(affine[:3, :3], axis=0)
  distance = _edt(~mask, edge) - _edt(mask, edge)
  distance = gaussian_filter(distance, _SMOOTHING * edge.max() / edge)
  if distance.min() >= 0:
    raise ValueError(f"label {label} is too small, {len(voxel)} voxels, expected an organ")
  vertices, triangles = Field(distance, low - float(pad), 1.0).surface()
  if np.linalg.det(affine[:3, :3]) < 0:
    triangles = triangles[:, ::-1].copy()
  return vertices @ affine[:3, :3].T + affine[:3, 3], triangles


def _edt(mask: np.ndarray, edge: np.ndarray) -> np.ndarray:
  from scipy.ndimage import distance_transform_edt

  return np.asarray(distance_transform_edt(mask, sampling=edge))


def _read_nifti(name: str) -> tuple[np.ndarray, np.ndarray]:
  import nibabel

  image = nibabel.load(name)
  unit = image.header.get_xyzt_units()[0]  # pyright: ignore
  affine = np.diag([_METRES.get(unit, 1e-3)] * 3 + [1]) @ image.affine  # pyright: ignore
  return np.asanyarray(image.dataobj), affine  # pyright: ignore


def _read_nrrd(name: str) -> tuple[np.ndarray, np.ndarray]:
  import nrrd

  values, header = nrrd.read(name)
  affine = np.eye(4)
  if header.get("space directions") is not None:
    affine[:3, :3] = np.asarray(header["space directions"], dtype=float).T
  else:
    affine[:3, :3] = np.diag(header.get("spacings", np.ones(3)))
  affine[:3, 3] = header.get("space origin", np.zeros(3))
  space = str(header.get("space", "right-anterior-superior")).lower()
  words = space.split("-")[:3] if "-" in space else list(space)[:3]
  sign = [-1.0 if word[0] in "lpi" else 1.0 for word in words]
  unit = str(np.atleast_1d(header.get("space units", "mm"))[0])
  return values, np.diag([*(_METRES.get(unit, 1e-3) * np.array(sign)), 1.0]) @ affine
