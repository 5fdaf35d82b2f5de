"""Surfaces of an abdomen that are only drawn: organs made smooth, ducts, fat, the wall.

`python -m palpate.models.scenery` writes where organs are on their textures.

World of the scenes: the patient lies on the back, x to the right, -y superior, z anterior; metres.
"""

import dataclasses
import functools

import numpy as np
import scipy
from palpate.tissue.geometry import subdivide
from palpate.tissue.geometry.mesh import vertex_areas, vertex_normals

from . import catalog, laparoscope, markup, mjcf, texture
from .meshing import grid

# Axis of a texture's middle in the organ's frame: that of the exercises' laparoscopes.
VIEW = (-0.1, 0.62, -0.78)
_SPHERE = "sphere.csv"  # beside an organ's mesh: its vertices on a unit sphere
_NORMAL = 0.02  # what a normal counts beside a distance [m]
# Of balls: the largest radius, how near they lie to a surface, by how much they may stand out [m].
_ROUND, _NEAR, _POKE = 0.4, 0.005, 0.002


@dataclasses.dataclass(frozen=True)
class Surface:
  """A surface that is drawn.

  Attributes:
    vertices: in its frame [m]                  (n, 3)
    triangles: counter-clockwise from outside   (m, 3)
    texcoord: where they are on the texture     (n, 2)
  """

  vertices: np.ndarray
  triangles: np.ndarray
  texcoord: np.ndarray


@functools.lru_cache(maxsize=8)
def _reference(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns an organ's committed mesh: vertices [m], triangles, and vertices on a unit sphere."""
  assets = markup.ROOT / name / "assets"
  sphere = np.loadtxt(assets / _SPHERE, delimiter=",", comments="#")
  return *mjcf.read_obj(assets / f"{name}.obj"), sphere


def texcoord(name: str, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns places on an organ's texture for a mesh of it, or of a variant.

  Args:
    name: of the organ
    vertices: in its frame [m]                (n, 3)
    triangles: counter-clockwise from outside (m, 3)

  Returns:
    Places, 0 to 1  (n, 2).
  """
  return texture.fold(_carry(name, vertices, triangles))


def _carry(name: str, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns a mesh's vertices on the committed mesh's sphere: those of the nearest ones."""
  own, elem, sphere = _reference(name)
  # Normals tell the sides of an edge apart.
  features = [
    np.concatenate([x, _NORMAL * vertex_normals(x, t)], axis=1)
    for x, t in ((own, elem), (vertices, triangles))
  ]
  away, near = scipy.spatial.KDTree(features[0]).query(features[1], k=4)
  share = 1 / (away + 1e-6) ** 2
  out = np.einsum("nk,nkd->nd", share, sphere[near])
  tail, head = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
  for _ in range(2):  # even where the nearest ones change
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    total = np.stack([np.bincount(tail, out[head, k], len(out)) for k in range(3)], axis=1)
    out = out + total / np.bincount(tail, minlength=len(out))[:, None]
  return out / np.linalg.norm(out, axis=1, keepdims=True)


def _sphere(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns an organ as a unit sphere, turned to where its vertices are; z is VIEW  (n, 3)."""
  points = grid.spherical(vertices, triangles)
  away = vertices - vertices.mean(axis=0)
  away /= np.linalg.norm(away, axis=1, keepdims=True)
  # The rotation that brings one nearest to the other (Kabsch 1976).
  left, _, right = np.linalg.svd(points.T @ away)
  flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
  z = np.array(VIEW) / np.linalg.norm(VIEW)
  return points @ (left @ flip @ right) @ laparoscope.upright(z)


@functools.lru_cache(maxsize=8)
def organ(name: str, levels: int = 1) -> Surface:
  """Returns a whole organ of the catalogue in its frame, its triangles divided `levels` times."""
  vertices, triangles, sphere = _reference(name)
  if not levels:
    return Surface(vertices, triangles, texture.fold(sphere))
  smooth = subdivide.smooth(triangles, levels)
  points = smooth(sphere)
  points /= np.linalg.norm(points, axis=1, keepdims=True)
  return Surface(smooth(vertices), smooth.elem, texture.fold(points))


def tube(points, radii) -> Surface:
  """Returns a tube with open ends along a smooth curve.

  Args:
    points: of the curve [m]                  (k, 3)
    radii: at these points [m]                (k,)
  """
  points, radii = np.asarray(points, float), np.asarray(radii, float)
  knots = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
  t = np.linspace(0, knots[-1], 30)
  curve = scipy.interpolate.CubicSpline(knots, points)
  tangent = curve(t, 1) / np.linalg.norm(curve(t, 1), axis=1, keepdims=True)
  side = np.cross(tangent, [0.3, 0.5, 0.8])
  side /= np.linalg.norm(side, axis=1, keepdims=True)
  angle = np.linspace(0, 2 * np.pi, 13)
  ring = np.cos(angle)[None, :, None] * side[:, None]
  ring = ring + np.sin(angle)[None, :, None] * np.cross(side, tangent)[:, None]
  radius = np.interp(t, knots, radii)
  vertices = curve(t)[:, None] + radius[:, None, None] * ring
  uv = np.stack(np.meshgrid(t / knots[-1], angle / (2 * np.pi), indexing="ij"), axis=-1)
  return lattice(vertices, uv)


def sheet(height, low, high, cells: tuple[int, int]) -> Surface:
  """Returns a surface over a rectangle, seen from above.

  Args:
    height: takes x, y [m], returns z [m]
    low: corner of the rectangle [m]           (2,)
    high: opposite corner [m]                  (2,)
    cells: vertices along x and y
  """
  x, y = np.meshgrid(*(np.linspace(*ends) for ends in zip(low, high, cells, strict=True)))
  x, y = x.T, y.T
  vertices = np.stack([x, y, height(x, y)], axis=-1)
  return lattice(vertices, (vertices[..., :2] - low) / np.subtract(high, low).max())


def shell(center, radii, power: float, cells: tuple[int, int]) -> Surface:
  """Returns a rounded box |x/a|^p + |y/b|^p + |z/c|^p = 1 that is seen from inside.

  Its poles are at the ends of z.
  """
  turn = np.linspace(0, 2 * np.pi, cells[0])
  rise = np.linspace(1e-3, np.pi - 1e-3, cells[1])
  turn, rise = np.meshgrid(turn, rise, indexing="ij")
  way = np.stack([np.sin(rise) * np.cos(turn), np.sin(rise) * np.sin(turn), np.cos(rise)], axis=-1)
  long = (np.abs(way) ** power).sum(axis=-1, keepdims=True) ** (-1 / power)
  vertices = np.asarray(center) + np.asarray(radii) * way * long
  return lattice(vertices, np.stack([2 * turn / np.pi, 2 * rise / np.pi], axis=-1))


def lattice(vertices: np.ndarray, texcoord: np.ndarray) -> Surface:
  """Returns the surface over a grid; columns lie to the left of rows, seen from outside.

  Args:
    vertices: [m]  (rows, columns, 3)
    texcoord: where they are on the texture  (rows, columns, 2)
  """
  rows, columns = vertices.shape[:2]
  i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
  a = (i * columns + j).ravel()
  b, c, d = a + columns, a + columns + 1, a + 1
  triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
  return Surface(vertices.reshape(-1, 3), triangles, texcoord.reshape(-1, 2))


def balls(surface: Surface, count: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns balls behind a surface that lie against as much of it as so many can.

  Each is the largest behind a vertex, as in Ma, Bae and Choi 2012 (10.1007/s00371-011-0594-7). One
  is chosen after the other, for the area that it is the first to lie near.

  Args:
    surface: seen from outside
    count: of the balls

  Returns:
    Centers [m] (count, 3) and radii [m] (count,).
  """
  x, normal = surface.vertices, vertex_normals(surface.vertices, surface.triangles)
  height = (x * normal).sum(axis=1)[:, None] - normal @ x.T - _POKE  # below each vertex
  squared = scipy.spatial.distance.cdist(x, x, "sqeuclidean")
  radii = np.where(height > 0, squared / (2 * np.maximum(height, 1e-9)), _ROUND)
  radii = radii.min(axis=1)
  centers = x - radii[:, None] * normal
  gap = scipy.spatial.distance.cdist(centers, x) - radii[:, None]
  near, left = (np.abs(gap) < _NEAR).astype(float), vertex_areas(x, surface.triangles)
  chosen = []
  for _ in range(count):  # `left` is the area that none is near to yet
    chosen.append(int((near @ left).argmax()))
    left = left * (1 - near[chosen[-1]])
  return centers[chosen], radii[chosen]


def bumps(seed: int, size: float, height: float):
  """Returns a function of x, y [m] that is a field of lumps so large and so high [m]."""
  random = np.random.RandomState(seed)
  turn = random.uniform(0, 2 * np.pi, 24)
  wave = np.stack([np.cos(turn), np.sin(turn)]) * (2 * np.pi / size)
  wave *= random.uniform(0.6, 1.5, 24)
  phase = random.uniform(0, 2 * np.pi, 24)

  def field(x, y):
    rough = np.cos(x[..., None] * wave[0] + y[..., None] * wave[1] + phase).sum(axis=-1)
    rough = rough / np.sqrt(12)
    return height * (np.sqrt(rough * rough + 0.1) - 0.8)  # creases between round lumps

  return field


def to_world(surface: Surface) -> Surface:
  """Returns a surface of the organ's frame in the world of the scenes."""
  return dataclasses.replace(surface, vertices=catalog.to_world(surface.vertices))


def main():
  """Writes the spheres of all organs."""
  for name in sorted(catalog.PLACES):
    assets = markup.ROOT / name / "assets"
    sphere = _sphere(*mjcf.read_obj(assets / f"{name}.obj"))
    head = "vertices on a unit sphere: x, y, z; made by python -m palpate.models.scenery"
    np.savetxt(assets / _SPHERE, sphere, fmt="%.4f", delimiter=",", header=head)
    print(assets / _SPHERE)


if __name__ == "__main__":
  main()
