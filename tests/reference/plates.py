"""Plates: the bending matrix of a surface, and a ball on a plate on a foundation."""

import numpy as np
from scipy.optimize import brentq
from scipy.special import kelvin


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


def ball(radius: float, depth: float, foundation: float, rigidity: float) -> float:
  """Returns the force of a frictionless ball on a flat plate on a Winkler foundation [N].

  The plate lies on a paraboloid up to a radius a and hangs free beyond it, with a deflection of
  A ker(r / l) + B kei(r / l), l^4 = rigidity / foundation (Hertz 1884). Deflection, slope and
  moment are continuous, and the force is the foundation's. A ball of depth d pushes less than the
  paraboloid, by d / (3 radius) where the skin does not stretch and by d / radius where it does
  freely: the mean of both.
  """
  unit = np.sqrt(np.sqrt(rigidity / foundation))

  def solve(a: float) -> tuple[float, float]:
    """Returns depth and force of a contact a wide, in l^2 / radius and foundation l^4 / radius."""
    _, k, _, slope = kelvin(a)
    bend = np.array([-k.imag - slope.real / a, k.real - slope.imag / a])
    line = np.array([[slope.real, slope.imag], bend])
    A, B = np.linalg.solve(line, [-a, -1.0])
    deep = A * k.real + B * k.imag + a**2 / 2
    beyond = a * (B * -slope.real + A * slope.imag)  # of r w, since lap ker = -kei, lap kei = ker
    return deep, 2 * np.pi * (deep * a**2 / 2 - a**4 / 8 - beyond)

  scale = unit**2 / radius
  a = float(brentq(lambda a: solve(a)[0] - depth / scale, 1e-6, 200.0))  # pyright: ignore
  return foundation * unit**2 * scale * solve(a)[1] * (1 - 2 * depth / (3 * radius))
