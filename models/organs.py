"""An organ of the catalogue made at a resolution: its mesh, where it is held, its named places."""

import functools

import numpy as np

from . import catalog, quality, shapes
from .catalog import DEFAULT, Entry


class Build:
  """An organ's mesh and where it is held and named, in the organ's frame.

  Attributes:
    entry: of the catalogue
    vertices: nodes [m], rounded as the files have them  (n, 3)
    triangles: winding outward                           (m, 3)
    patches: pinned nodes  name -> indices
    landmarks: places on the surface [m]  name -> (3,)
  """

  def __init__(self, entry: Entry, nodes: int, grid: int, seed: int | None):
    self.entry = entry
    if grid:
      vertices, self.triangles = shapes.grid(entry.shape, grid, seed)
    else:
      vertices, self.triangles = shapes.mesh(shapes.anatomy(entry.shape, seed), nodes)
    self.vertices = np.round(vertices, 6) + 0.0
    self.patches = shapes.patches(entry.shape, self.vertices, seed)
    self.landmarks = shapes.landmarks(entry.shape, seed)

  @property
  def pins(self) -> np.ndarray:
    """Pinned nodes, sorted."""
    return np.unique(np.concatenate(list(self.patches.values())))

  @property
  def volume(self) -> float:
    """Enclosed volume [m^3]."""
    return quality.volume(self.vertices, self.triangles)

  @property
  def area(self) -> float:
    """Surface [m^2]."""
    return float(np.linalg.norm(quality.normals(self.vertices, self.triangles), axis=1).sum() / 2)

  @property
  def mass(self) -> float:
    """Mass of the whole organ [kg]."""
    return self.entry.tissue.mass_of(self.volume)

  def young(self) -> list[float]:
    """Young's modulus [Pa], one value or one a triangle."""
    entry = self.entry
    if entry.inclusion is None:
      return [entry.tissue.young]
    values = shapes.inclusion_young(
      self.vertices,
      self.triangles,
      self.landmarks[entry.inclusion.landmark],
      entry.inclusion.radius,
      entry.tissue.young,
      entry.inclusion.young,
    )
    return [float(v) for v in np.round(values)]


@functools.lru_cache(maxsize=8)
def build(name: str, nodes: int = DEFAULT, grid: int = 0, seed: int | None = None) -> Build:
  """Returns the mesh of an organ of the catalogue; do not change it."""
  return Build(catalog.entry(name), nodes, grid, seed)
