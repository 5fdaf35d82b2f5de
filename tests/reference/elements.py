"""A press and a cantilever by the quadratic elements of another library, scikit-fem: small strains.

A rigid sphere without friction on a linear elastic body. The body's compliance at the surface's
nodes under the sphere comes from one factorization; the contact is then a quadratic programme:
least p^T C p / 2 - g^T p with p >= 0, p the nodes' forces and g how deep the sphere is at them.
"""

from __future__ import annotations

import functools
import math

import numpy as np
from palpate.tissue import solid
from scipy import optimize
from scipy.sparse import linalg


def layer(height: float, width: float, radius: float, depths, young: float, poisson: float, edge):
  """Returns the force on a sphere in the middle of a round slab [N], (ndepth,).

  Quadratic quadrilaterals in a half plane through the axis, finest under the sphere.

  Args:
    height: of the slab, which is held at its bottom [m]
    width: radius of the slab [m]
    radius: of the sphere [m]
    depths: of the press [m]
    young: [Pa]
    poisson: [-]
    edge: of the finest elements [m]
  """
  import skfem
  from skfem.helpers import dot, grad, sym_grad, trace

  mu, lam = solid.lame_solid(np.array(young), poisson)

  @skfem.BilinearForm
  def energy(u, v, w):
    r = w.x[0]
    around, around_v = u[0] / r, v[0] / r
    swell, swell_v = trace(grad(u)) + around, trace(grad(v)) + around_v
    strain, strain_v = sym_grad(u), sym_grad(v)
    shear = sum(dot(strain[k], strain_v[k]) for k in range(2)) + around * around_v
    return 2 * np.pi * r * (lam * swell * swell_v + 2 * mu * shear)

  widest = math.sqrt(radius * max(depths))
  x = _lines(edge, 1.3 * widest, width)
  z = height - _lines(edge, 1.3 * widest, height)[::-1]
  basis = skfem.Basis(skfem.MeshQuad.init_tensor(x, z), skfem.ElementVector(skfem.ElementQuad2()))
  stiffness = skfem.asm(energy, basis)
  where = basis.doflocs
  down = np.zeros(basis.N, bool)
  down[_along(basis, 1, 2)] = True
  held = (where[1] < 1e-9) | (~down & (where[0] < 1e-9))
  touched = np.flatnonzero(down & (where[1] > height - 1e-9) & (where[0] < 1.3 * widest))
  unit = np.zeros((basis.N, len(touched)))
  unit[touched, np.arange(len(touched))] = -1.0
  compliance = _compliance(stiffness, held, unit)
  gap = np.asarray(depths)[:, None] - where[0][touched] ** 2 / (2 * radius)
  return np.array([_pressed(compliance, g).sum() for g in gap])


@functools.cache
def cantilever(
  length: float, side: float, load: float, young: float, poisson: float, edge: float
) -> float:
  """Returns the sag of a square bar's loaded end [m], the other end clamped.

  Half of the bar, finer towards its edges and its clamp, which hinders the sides from swelling.

  Args:
    length: [m]
    side: [m]
    load: across the bar, even over its end [N]
    young: [Pa]
    poisson: [-]
    edge: of the finest elements [m]
  """
  import skfem
  from skfem.models.elasticity import linear_elasticity

  along, half = _widening(edge, length, side / 3), side / 2 - _widening(edge, side / 2, side / 3)
  cells = skfem.MeshHex.init_tensor(along, half[::-1], np.unique([*half, *-half]))
  element = skfem.ElementVector(skfem.ElementHex2())
  basis = skfem.Basis(cells, element, intorder=4)
  mu, lam = solid.lame_solid(np.array(young), poisson)
  stiffness = linear_elasticity(float(lam), float(mu)).assemble(basis)
  facets = cells.facets_satisfying(lambda x: x[0] > length - 1e-9)
  end = skfem.FacetBasis(cells, element, facets=facets, intorder=4)
  push = skfem.LinearForm(lambda v, w: v[2]).assemble(end) / side**2
  held = basis.get_dofs(lambda x: x[0] < 1e-9).all()
  middle = basis.get_dofs(lambda x: x[1] < 1e-9).all(["u^2"])
  sag = skfem.solve(*skfem.condense(stiffness, load * push, D=np.union1d(held, middle)))
  return float(2 * push @ sag)


def _widening(edge: float, length: float, most: float) -> np.ndarray:
  """Returns coordinates from 0 to length whose distances grow from `edge` to `most`."""
  steps = [edge]
  while sum(steps) < length:
    steps.append(min(1.5 * steps[-1], most))
  line = np.cumsum([0.0, *steps])
  return line * length / line[-1]


def _along(basis, k: int, dim: int) -> np.ndarray:
  """Returns the degrees of freedom along axis k of `dim`."""
  parts = (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs)
  return np.unique(np.concatenate([p[k::dim].ravel() for p in parts if p is not None]))


def _lines(edge: float, fine: float, length: float, growth: float = 1.25) -> np.ndarray:
  """Returns coordinates from 0 to length, `edge` apart up to `fine` and ever farther then."""
  steps = [edge] * math.ceil(fine / edge)
  while sum(steps) < length:
    steps.append(growth * steps[-1])
  line = np.concatenate([[0.0], np.cumsum(steps)])
  rest = line > fine
  line[rest] = fine + (line[rest] - fine) * (length - fine) / (line[-1] - fine)
  return line


def _compliance(stiffness, held: np.ndarray, unit: np.ndarray) -> np.ndarray:
  """Returns how far each place moves along its direction where each is pushed by 1 N."""
  free = np.flatnonzero(~held)
  options = {"permc_spec": "MMD_AT_PLUS_A", "options": {"SymmetricMode": True}}
  solve = linalg.splu(stiffness.tocsc()[free][:, free], diag_pivot_thresh=0.0, **options).solve
  return unit[free].T @ solve(unit[free])


def _pressed(compliance: np.ndarray, gap: np.ndarray) -> np.ndarray:
  """Returns the forces that keep a sphere out of the nodes that would be `gap` in it [N]."""
  root = np.linalg.cholesky((compliance + compliance.T) / 2).T
  target = np.linalg.solve(root.T, gap)
  return optimize.nnls(root, target)[0]
