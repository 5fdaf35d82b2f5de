"""The forces of a solid in float64, written independently of the kernels.

Stable neo-Hookean tetrahedra with nodal averages of the change of volume, as `energy.solid` defines
them, and Rayleigh damping on the stiffness of small strains in the turned frame. The reference of
the error bench; `tests/benchmarks/test_bench.py` checks it against `palpate.tissue.energy`.
"""

from __future__ import annotations

import numpy as np
from palpate.tissue import fill, solid
from palpate.tissue import mesh as topology
from palpate.tissue.config import Config
from palpate.tissue.mesh import Mesh
from scipy import sparse

_TURNS = 8  # of Newton's iteration: stretches are moderate


class Inside:
  """Internal force of a solid on all of its nodes, those of the surface first.

  Args:
    mesh: the surface
    config: material; `elements` is `solid`
  """

  def __init__(self, mesh: Mesh, config: Config):
    self.mesh, self.config = fill.fill("organ", mesh), config
    tet = self.mesh.tet
    self.volume = fill.volumes(self.mesh.rest, tet)
    self.gradient = solid.gradients(self.mesh)
    self._weighed = self.volume[:, None, None] * self.gradient
    self.mu, self.lam, averaged = solid.moduli(self.mesh, config)
    share = np.repeat(self.volume / 4, 4)
    shape = (self.mesh.nvert, len(tet))
    around = sparse.csr_array((share, (tet.ravel(), np.repeat(np.arange(len(tet)), 4))), shape)
    total = around.sum(axis=1)
    self._around, self._total = around, total
    self._stiff = (around @ averaged) / total
    self._sum = sparse.csr_array(
      (np.ones(tet.size), (tet.ravel(), np.arange(tet.size))), (self.mesh.nvert, tet.size)
    )
    self.foundation = (config.foundation * topology.held_areas(self.mesh))[:, None]

  def force(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Returns elastic force and damping on each node [N], (nvert, 3)."""
    beta = self.config.damping
    tet = self.mesh.tet
    slope, rate = (x[tet].transpose(0, 2, 1) @ self.gradient for x in (u, v))
    F = slope + np.eye(3)
    C = _cofactors(F)
    j = (F[:, 0] * C[:, 0]).sum(axis=1) - 1
    i = (F * F).sum(axis=(1, 2)) - 3
    mu, lam = self.mu[:, None, None], self.lam[:, None, None]
    stress = mu * (1 - 1 / (4 + i))[:, None, None] * F
    stress += (lam * j[:, None, None] - 0.75 * mu) * C
    swell = j + beta * (C * rate).sum(axis=(1, 2))
    pressure = self._stiff * (self._around @ swell) / self._total
    stress += pressure[tet].mean(axis=1)[:, None, None] * C
    Q = _turns(F)
    strain = Q.transpose(0, 2, 1) @ rate
    trace = np.trace(strain, axis1=1, axis2=2)[:, None, None]
    moving = 0.75 * mu * (strain + strain.transpose(0, 2, 1))
    moving += (lam - 0.625 * mu) * trace * np.eye(3)
    stress += beta * Q @ moving
    corner = (self._weighed @ stress.transpose(0, 2, 1)).reshape(-1, 3)
    return -(self._sum @ corner) - self.foundation * (u + beta * v)


def _cofactors(F: np.ndarray) -> np.ndarray:
  """Returns det(F) F^-T, (n, 3, 3)."""
  (a, b, c), (d, e, f), (g, h, i) = (F[:, k].T for k in range(3))
  rows = (e * i - f * h, f * g - d * i, d * h - e * g, c * h - b * i, a * i - c * g,
          b * g - a * h, b * f - c * e, c * d - a * f, a * e - b * d)  # fmt: skip
  return np.stack(rows, axis=1).reshape(-1, 3, 3)


def _turns(F: np.ndarray) -> np.ndarray:
  """Returns the rotation nearest to each matrix, (n, 3, 3), by Newton's iteration."""
  for _ in range(_TURNS):
    C = _cofactors(F)
    step = 0.5 * (C / (F[:, 0] * C[:, 0]).sum(axis=1)[:, None, None] - F)
    F = F + step
    if np.abs(step).max() < 1e-9:  # the next one would be of its square
      break
  return F
