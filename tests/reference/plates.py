"""The bending matrix of a surface, summed over the hinges of its triangles."""

import numpy as np


def bending_matrix(surface, hinge):
  """Returns the plate stiffness on normal displacements at rest [N/m], (nvert, nvert)."""
  out = np.zeros((surface.nvert, surface.nvert))
  corner, twin = surface.elem.reshape(-1), surface.twin
  for t in range(surface.nelem):
    angle = np.zeros((3, surface.nvert))
    for c in range(3):
      other = twin[3 * t + c]
      if other >= 0:
        apex = corner[other - other % 3 + (other + 2) % 3]
        at = [*corner[[3 * t + c, 3 * t + (c + 1) % 3, 3 * t + (c + 2) % 3]], apex]
        np.add.at(angle[c], at, hinge.weight[t, c])
    out += angle.T @ hinge.gain[t] @ angle
  return out
