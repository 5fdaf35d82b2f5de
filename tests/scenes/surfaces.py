"""Surfaces: points (nvert, 3) and triangles (nelem, 3)."""

import numpy as np
import trimesh
from palpate.tissue.geometry import mesh as topology
from scipy.spatial import Delaunay

RADIUS = 0.05  # of the test sphere [m]


def sphere(subdivisions=2, radius=RADIUS):
  mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
  return np.array(mesh.vertices), np.array(mesh.faces)


def strip(length, width, nx, ny):
  """Returns a flat strip along x, diagonals alternating, origin at the middle of its left end."""
  x, y = np.linspace(0, length, nx + 1), np.linspace(-width / 2, width / 2, ny + 1)
  points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((nx + 1, ny + 1))], -1)
  i, j = (a.ravel() for a in np.meshgrid(np.arange(nx), np.arange(ny), indexing="ij"))
  a = i * (ny + 1) + j
  b, c, d = a + ny + 1, a + ny + 2, a + 1
  odd = ((i + j) % 2 == 1)[:, None]
  first = np.where(odd, np.stack([a, b, d], 1), np.stack([a, b, c], 1))
  second = np.where(odd, np.stack([b, c, d], 1), np.stack([a, c, d], 1))
  return points.reshape(-1, 3), np.concatenate([first, second])


def triangular(length, width, nx, ny, jitter=0.0, seed=0):
  """Returns a flat strip of triangles, equilateral where width / ny is 0.866 length / nx.

  Args:
    length: along x [m]
    width: along y [m]
    nx: edges along x
    ny: rows
    jitter: greatest random move of the inner nodes, in edges
    seed: of those moves
  """
  rows = []
  for j in range(ny + 1):
    x = np.linspace(0, length, nx + 1)
    if j % 2:
      x = np.concatenate([[0], 0.5 * (x[1:] + x[:-1]), [length]])
    rows.append(np.stack([x, np.full(len(x), (j / ny - 0.5) * width), np.zeros(len(x))], 1))
  points = np.concatenate(rows)
  inside = (points[:, 0] > 1e-9) & (points[:, 0] < length - 1e-9)
  inside &= np.abs(points[:, 1]) < width / 2 - 1e-9
  move = np.random.RandomState(seed).uniform(-jitter, jitter, (len(points), 2)) * length / nx
  points[inside, :2] += move[inside]
  elem = Delaunay(points[:, :2]).simplices
  area = topology.area_vectors(points, elem)[:, 2]
  elem[area < 0] = elem[area < 0][:, [0, 2, 1]]
  return points, elem[np.abs(area) > 1e-12]
