"""Grids of voxels that lie askew in the world, around a body at `CENTER`."""

import numpy as np
from scipy.spatial.transform import Rotation

CENTER = np.array([0.012, -0.034, 0.051])  # [m], RAS


def rotation(degrees):
  """Returns a rotation about a skew axis."""
  return Rotation.from_rotvec(degrees / np.sqrt(6) * np.array([1, 2, -1]), degrees=True).as_matrix()


def affine(spacing, turn, shape):
  """Returns the map from indices to metres of a grid with the body in its middle."""
  out = np.eye(4)
  out[:3, :3] = turn @ np.diag(spacing)
  out[:3, 3] = CENTER - out[:3, :3] @ (np.array(shape) / 2.1)
  return out


def places(affine, shape):
  """Returns where the voxels are, from the body's middle [m], (*shape, 3)."""
  index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
  return index @ affine[:3, :3].T + affine[:3, 3] - CENTER


def centroid(vertices, triangles):
  """Returns the centroid of the solid inside a surface."""
  corner = vertices[triangles] - CENTER
  share = (corner[:, 0] * np.cross(corner[:, 1], corner[:, 2])).sum(axis=1) / 6
  return CENTER + share @ corner.sum(axis=1) / 4 / share.sum()
