"""A shape as numbers on a grid: negative inside, positive outside, a distance near the surface."""

import dataclasses
from collections.abc import Callable

import numpy as np
import scipy

# Takes points (n, 3) and returns values (n,), negative inside and close to the distance.
Implicit = Callable[[np.ndarray], np.ndarray]


@dataclasses.dataclass(frozen=True)
class Field:
  """A shape on a grid.

  Attributes:
    value: distance to the surface, negative inside [m]  (nx, ny, nz)
    origin: place of the first value [m]                 (3,)
    spacing: distance between values [m]
  """

  value: np.ndarray
  origin: np.ndarray
  spacing: float

  def at(self, points: np.ndarray) -> np.ndarray:
    """Returns the distance [m] at points (n, 3), linear between values."""
    return self._between(self.value, points)

  def _between(self, array: np.ndarray, points: np.ndarray) -> np.ndarray:
    index = (points - self.origin).T / self.spacing
    return np.asarray(scipy.ndimage.map_coordinates(array, index, order=1, mode="nearest"))

  def surface(self, level: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Returns where the field has a level: vertices (n, 3), triangles (m, 3), winding outward."""
    from skimage.measure import marching_cubes  # takes a second to import

    value = self.value - level
    value[value == 0] = 1e-9 * self.spacing  # on a grid point it would make slivers of no area
    vertices, triangles, _, _ = marching_cubes(value, 0.0)
    return vertices.astype(float) * self.spacing + self.origin, triangles.astype(np.int64)

  def projector(self) -> Callable[[np.ndarray], np.ndarray]:
    """Returns a function that moves points near the surface onto it."""
    slope = np.gradient(self.value, self.spacing)

    def project(points):
      for _ in range(2):
        gradient = np.stack([self._between(each, points) for each in slope], axis=1)
        squared = np.maximum(np.einsum("nd,nd->n", gradient, gradient), 0.1)
        points = points - (self.at(points) / squared)[:, None] * gradient
      return points

    return project


def tabulate(implicit: Implicit, bounds: np.ndarray, spacing: float) -> Field:
  """Returns the shape on a grid over the bounds (2, 3); exact only near the surface."""
  count = np.ceil((bounds[1] - bounds[0]) / (4 * spacing)).astype(int) * 4 + 1
  origin = bounds.mean(axis=0) - (count - 1) * spacing / 2
  coarse_count = (count - 1) // 4 + 1
  coarse_index = np.argwhere(np.ones(coarse_count))
  coarse = implicit(origin + coarse_index * (4 * spacing)).reshape(coarse_count)
  value = np.asarray(scipy.ndimage.zoom(coarse, count / coarse_count, order=1))
  near = np.argwhere(np.abs(value) < 5 * spacing)
  value[tuple(near.T)] = implicit(origin + near * spacing)
  return Field(value, origin, spacing)


def project(implicit: Implicit, points: np.ndarray, steps: int = 3) -> np.ndarray:
  """Returns the points moved onto the surface along the gradient, by Newton's method."""
  reach = 1e-5  # [m]
  corner = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) * reach
  for _ in range(steps):
    value = np.stack([implicit(points + offset) for offset in corner], axis=1)
    gradient = np.einsum("nk,kd->nd", value, corner) / (4 * reach**2)
    squared = np.maximum(np.einsum("nd,nd->n", gradient, gradient), 0.1)
    points = points - (value.mean(axis=1) / squared)[:, None] * gradient
  return points
