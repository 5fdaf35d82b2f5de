"""An organ of the catalogue made at a resolution: its mesh, where it is held, its named places."""

import copy
import functools

import numpy as np

from . import catalog, shapes
from .catalog import DEFAULT, Entry
from .meshing import quality
from .meshing.refine import refine

_REACH = 0.006  # around a place that an instrument points at, of its finer triangles [m]


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
      vertices, self.triangles = shapes.organ(entry.shape, nodes, seed)
    self.vertices = np.round(vertices, 6) + 0.0
    self._seed = seed
    self.patches = shapes.patches(entry.shape, self.vertices, seed)
    self.landmarks = shapes.landmarks(entry.shape, seed)

  def finer(self, edge: float) -> "Build":
    """Returns it with edges of at most `edge` [m] around the places that instruments point at."""
    places = [self.landmarks[port.landmark] for port in self.entry.ports]
    out = copy.copy(self)
    vertices, out.triangles = refine(self.vertices, self.triangles, places, _REACH, edge)
    out.vertices = np.round(vertices, 6) + 0.0
    out.patches = shapes.patches(self.entry.shape, out.vertices, self._seed)
    return out

  @property
  def pins(self) -> np.ndarray:
    """Pinned nodes, sorted."""
    return np.unique(np.concatenate(list(self.patches.values())))

  @property
  def volume(self) -> float:
    """Enclosed volume [m^3]."""
    return quality.volume(self.vertices, self.triangles)

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
