"""Surfaces from files and from what others make of them, in metres."""

import math
import os

import numpy as np

KINDS = "obj, stl, ply, gltf, glb"
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
LEAST, MOST = 0.02, 2.0  # [m], of an organ's bounding box; other sizes are slips of the unit
_USUAL, _LARGE = 0.2, 0.6  # [m]; what an organ usually is, and what it hardly is


def read(mesh, scale: float | str = 1.0, sized: bool = True) -> tuple[str, np.ndarray, np.ndarray]:
  """Returns a name for messages, vertices (n, 3) [m] and triangles (m, 3).

  Args:
    mesh: a file that trimesh reads (OBJ, STL, PLY, glTF), a trimesh, or (vertices, triangles)
    scale: metres per unit of the mesh, or the unit, one of UNITS
    sized: whether its size must be an organ's

  Raises:
    ValueError: this is no surface, or its size is not an organ's; the message says what is allowed.
  """
  factor = factor_of(scale)
  if isinstance(mesh, str | os.PathLike):
    name = os.fspath(mesh)
    vertices, triangles = _load(name)
  else:
    name = "mesh"
    vertices, triangles = mesh if isinstance(mesh, tuple | list) else (mesh.vertices, mesh.faces)
  vertices = np.array(vertices, dtype=float).reshape(-1, 3)
  triangles = np.array(triangles, dtype=np.int64).reshape(-1, 3)
  if not len(triangles):
    raise ValueError(f"{name}: has no triangles, expected a surface")
  if triangles.min() < 0 or triangles.max() >= len(vertices):
    raise ValueError(f"{name}: a triangle uses a vertex outside 0..{len(vertices) - 1}")
  used = np.unique(triangles)
  bad = used[~np.isfinite(vertices[used]).all(axis=1)]
  if len(bad):
    raise ValueError(f"{name}: vertex {bad[0]} is {vertices[bad[0]]}, expected finite numbers")
  if sized:
    _check_size(name, float(np.linalg.norm(np.ptp(vertices[used], axis=0))), factor)
  return name, vertices * factor, triangles


def merge(vertices: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns a mesh without vertices that are equal or unused; the others keep their order."""
  _, first, same = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
  triangles = first[same.ravel()][triangles]
  used, number = np.unique(triangles, return_inverse=True)
  return vertices[used], number.reshape(-1, 3)


def factor_of(scale: float | str) -> float:
  """Returns metres per unit of a scale: a number, or one of UNITS."""
  try:
    factor = UNITS[scale] if isinstance(scale, str) and scale in UNITS else float(scale)
  except (TypeError, ValueError):
    factor = math.nan
  if not (math.isfinite(factor) and factor > 0):
    raise ValueError(f"scale is {scale!r}, expected a number above 0 or one of {', '.join(UNITS)}")
  return factor


def _check_size(name: str, size: float, factor: float):
  """Raises a ValueError where the bounding box, in units of the mesh, is no organ's."""
  if LEAST <= size * factor <= MOST:
    return
  fitting = {unit: size * each for unit, each in UNITS.items() if LEAST <= size * each <= _LARGE}
  units = sorted(fitting, key=lambda unit: abs(math.log(fitting[unit] / _USUAL)))
  tries = " or ".join(f"scale={unit!r} ({fitting[unit]:.2g} m)" for unit in units)
  hint = f"try {tries}" if tries else "pass the metres per unit of the mesh as scale"
  raise ValueError(
    f"{name}: the bounding box is {size * factor:.3g} m across, expected {LEAST:g} to {MOST:g} m; "
    f"{hint}"
  )


def _load(name: str) -> tuple[np.ndarray, np.ndarray]:
  import trimesh  # takes a fifth of the time of all imports, and only files of others need it

  if not os.path.exists(name):
    raise FileNotFoundError(f"{name}: no such file")
  try:
    loaded = trimesh.load(name, force="mesh", process=False)
    return np.asarray(loaded.vertices), np.asarray(loaded.faces)  # pyright: ignore
  except Exception as error:
    raise ValueError(f"{name}: not a surface mesh that can be read ({KINDS}): {error}") from error
