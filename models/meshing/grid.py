"""Regular closed grids of nodes, as in Kotamraju's thesis (2008), on any sphere-like surface.

The sheet of n x n nodes is folded into an octahedron: its four corners meet in one point and its
borders close on themselves, so that there is no seam. Every node has six edges but for the six
tips, which have four. n x n is n^2 + 2 nodes.
"""

import numpy as np
import scipy
from palpate.tissue.geometry.mesh import vertex_normals
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu

from .quality import angles, normals
from .remesh import Project, guard

Mesh = tuple[np.ndarray, np.ndarray]

# The net's energy is the sum of A0 e^4, e = D (1 + (A0/A)^2) / A0 with D the Dirichlet energy of a
# triangle and A its area: the power keeps the net from slipping off ducts and tips.
_STIFFENING = 4


def octasphere(frequency: int) -> Mesh:
  """Returns a unit sphere of 4 frequency^2 + 2 nodes, an octahedron's faces divided evenly."""
  f = frequency
  i, j = np.array([(i, j) for i in range(f + 1) for j in range(f + 1 - i)]).T
  number = np.zeros((f + 2, f + 2), dtype=np.int64)
  number[i, j] = np.arange(len(i))
  up, down = i + j < f, i + j < f - 1
  a, b = i[up], j[up]
  c, d = i[down], j[down]
  cells = np.concatenate(
    [
      np.stack([number[a, b], number[a + 1, b], number[a, b + 1]], axis=1),
      np.stack([number[c + 1, d], number[c + 1, d + 1], number[c, d + 1]], axis=1),
    ]
  )
  face = np.stack([i, j, f - i - j], axis=1)
  corners, triangles = [], []
  for sign in np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)]):
    triangles.append((cells if sign.prod() > 0 else cells[:, ::-1]) + len(corners) * len(face))
    corners.append(face * sign)
  vertices, index = np.unique(np.concatenate(corners), axis=0, return_inverse=True)
  sphere = np.sin(vertices / f * np.pi / 2)  # more even than the flat faces blown up
  sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
  return sphere, index.ravel()[np.concatenate(triangles)]


def shrink(
  vertices: np.ndarray, triangles: np.ndarray, frequency: int, project: Project, steps: int = 60
) -> Mesh:
  """Returns a regular grid of 4 frequency^2 + 2 nodes that clings to a surface, relaxed.

  The thesis dropped a sheet of cloth on the organ by hand. Here the sheet starts where no triangle
  is folded: the organ is rounded to a sphere without folds, the sheet is laid around the sphere and
  carried back; it then relaxes on the organ as an elastic net that resists folding.

  Args:
    vertices: nodes of a closed sphere-like surface (n, 3)
    triangles: its triangles, winding outward       (m, 3)
    frequency: edges of the grid along an octahedron's edge
    project: puts points near the surface onto it
    steps: most steps of relaxation
  """
  sphere = spherical(vertices, triangles)
  points, cells = octasphere(frequency)
  x = _carry(points, sphere, vertices, triangles)
  x = guard(x, project(x), cells)
  area = np.linalg.norm(normals(x, cells), axis=1).sum() / 2
  equilateral = np.full((len(cells), 3), 0.5 / np.sqrt(3))
  return _settle(
    x, cells, equilateral, np.full(len(cells), area / len(cells)), project, steps
  ), cells


def spherical(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns places on the unit sphere (n, 3) for the nodes of a closed sphere-like surface.

  One to one, first by conformalised mean curvature flow (Kazhdan, Solomon, Ben-Chen 2012, "Can
  mean-curvature flow be modified to be non-singular?"), then with little stretch anywhere: least
  symmetric Dirichlet energy (Smith and Schaefer 2015, "Bijective parameterization with free
  boundaries"), by gradient descent preconditioned with the Laplacian.
  """
  sphere = _flow(vertices, triangles)
  facing = np.einsum("md,md->m", normals(sphere, triangles), sphere[triangles[:, 0]])
  if (facing <= 0).any():
    raise ValueError("the surface could not be rounded to a sphere")
  rest = np.linalg.norm(normals(vertices, triangles), axis=1) / 2
  rest *= 4 * np.pi / rest.sum()
  weight = _cotangents(vertices, triangles)
  return _settle(sphere, triangles, weight, rest, _unit, steps=300)


def _unit(x: np.ndarray) -> np.ndarray:
  return x / np.linalg.norm(x, axis=1, keepdims=True)


def _cotangents(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
  """Returns half the cotangents of the angles (m, 3), kept positive."""
  return np.maximum(0.5 / np.tan(angles(vertices, triangles)), 1e-3)


def _laplacian(weight: np.ndarray, triangles: np.ndarray, nodes: int):
  """Returns the cotangent Laplacian, positive semi-definite, (nodes, nodes)."""
  i, j = triangles[:, [1, 2, 0]].ravel(), triangles[:, [2, 0, 1]].ravel()
  twice = np.concatenate([weight.ravel()] * 2)
  off = coo_array((twice, (np.concatenate([i, j]), np.concatenate([j, i]))), shape=(nodes, nodes))
  return (diags_array(off.sum(axis=1)) - off).tocsc()


def _flow(vertices: np.ndarray, triangles: np.ndarray, steps: int = 15) -> np.ndarray:
  """Returns the conformal sphere that conformalised mean curvature flow ends in."""
  n, x = len(vertices), vertices
  laplacian = _laplacian(_cotangents(vertices, triangles), triangles, n)
  for _ in range(steps):
    x, area = _unit_area(x, triangles)
    mass = np.bincount(triangles.ravel(), np.repeat(area / 3, 3), n)
    x = splu((diags_array(mass) + 0.3 * laplacian).tocsc()).solve(mass[:, None] * x)
  x, _ = _unit_area(x, triangles)
  return _unit(x)


def _unit_area(x: np.ndarray, triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the surface centred and scaled to area 1, and its triangles' areas."""
  area = np.linalg.norm(normals(x, triangles), axis=1) / 2
  center = np.einsum("m,md->d", area, x[triangles].mean(axis=1)) / area.sum()
  return (x - center) / np.sqrt(area.sum()), area / area.sum()


def _settle(
  x: np.ndarray,
  triangles: np.ndarray,
  weight: np.ndarray,
  rest: np.ndarray,
  onto: Project,
  steps: int,
) -> np.ndarray:
  """Returns the nodes slid along a surface to the least stretch nearby (see _STIFFENING).

  Args:
    x: nodes on the surface                                       (n, 3)
    triangles: triangles between them                             (m, 3)
    weight: half the cotangents of the rest triangles' angles     (m, 3)
    rest: the rest triangles' areas, their sum the surface's own  (m,)
    onto: puts nodes back onto the surface
    steps: most steps of descent
  """
  n = len(x)
  laplacian = _laplacian(weight, triangles, n)
  solve = splu((laplacian + 1e-3 * diags_array(np.ones(n))).tocsc()).solve
  size = np.sqrt(rest.sum())
  step = np.inf
  for _ in range(steps):
    facing = normals(x, triangles)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-300)
    up = vertex_normals(x, triangles)
    value, gradient = _energy(x, facing, triangles, weight, rest)
    direction = -_along(solve(_along(gradient, up)), up)
    reach = np.abs(direction).max()
    step = min(4 * step, 0.1 * size / reach)
    wanted = 1e-4 * np.einsum("nd,nd->", gradient, direction)
    while step * reach > 1e-9 * size:
      moved = onto(x + step * direction)
      reached = _energy(moved, facing, triangles, weight, rest)[0]
      if reached <= value + step * wanted:
        break
      step /= 2
    else:
      break
    gained = value - reached
    x = moved
    if gained < 1e-5 * value:
      break
  return x


def _energy(
  x: np.ndarray, facing: np.ndarray, triangles: np.ndarray, weight: np.ndarray, rest: np.ndarray
) -> tuple[float, np.ndarray]:
  """Returns the energy and its gradient (n, 3); infinite if a triangle turned over.

  Args:
    x: nodes                                                    (n, 3)
    facing: unit normals that the triangles must not turn from  (m, 3)
    triangles: as in _settle
    weight: as in _settle
    rest: as in _settle
  """
  normal = normals(x, triangles)
  twice = np.linalg.norm(normal, axis=1)
  if (np.einsum("md,md->m", normal, facing) <= 0.1 * twice).any():
    return np.inf, x  # a triangle turned over
  edge = x[triangles[:, [2, 0, 1]]] - x[triangles[:, [1, 2, 0]]]
  dirichlet = 0.5 * np.einsum("mk,mkd,mkd->m", weight, edge, edge)
  ratio = (2 * rest / twice) ** 2
  pull = weight[:, :, None] * edge
  slope = (1 + ratio)[:, None, None] * (pull[:, [1, 2, 0]] - pull[:, [2, 0, 1]])
  of_area = 0.5 * np.cross((normal / twice[:, None])[:, None], edge)
  slope -= (4 * dirichlet * ratio / twice)[:, None, None] * of_area
  strain = dirichlet * (1 + ratio) / rest
  slope *= (_STIFFENING * strain ** (_STIFFENING - 1))[:, None, None]
  flat = slope.reshape(-1, 3).T
  gradient = np.stack([np.bincount(triangles.ravel(), f, len(x)) for f in flat], axis=1)
  return (strain**_STIFFENING * rest).sum(), gradient


def _along(x: np.ndarray, up: np.ndarray) -> np.ndarray:
  """Returns the part of vectors (n, 3) in the planes across `up`."""
  return x - np.einsum("nd,nd->n", x, up)[:, None] * up


def _carry(
  points: np.ndarray, sphere: np.ndarray, vertices: np.ndarray, triangles: np.ndarray
) -> np.ndarray:
  """Returns where points on the sphere lie on the surface that the sphere is a map of."""
  middle = sphere[triangles].mean(axis=1)
  middle /= np.linalg.norm(middle, axis=1, keepdims=True)
  _, near = scipy.spatial.KDTree(middle).query(points, k=min(16, len(triangles)))
  a, b, c = (sphere[triangles[:, i]][near] for i in range(3))
  share = np.stack(
    [np.einsum("nkd,nd->nk", np.cross(p, q), points) for p, q in ((b, c), (c, a), (a, b))], axis=2
  )
  share /= np.maximum(np.abs(share.sum(axis=2, keepdims=True)), 1e-300)
  row, best = np.arange(len(points)), np.argmax(share.min(axis=2), axis=1)
  share = np.maximum(share[row, best], 0)
  share /= share.sum(axis=1, keepdims=True)
  return np.einsum("nk,nkd->nd", share, vertices[triangles[np.asarray(near)[row, best]]])
