"""The forces of a solid in float64, written independently of the kernels.

Stable neo-Hookean tetrahedra, most of whose energy acts on gradients averaged over nodes, as
`energy.solid` defines them. Damping of shear is that of plain tetrahedra of small strains in the
turned frame, of the volume that of the nodes. The reference of
the error bench; `tests/benchmarks/test_bench.py` checks it against `palpate.tissue.energy`.
"""

from __future__ import annotations

import numpy as np
from palpate.tissue import solid
from palpate.tissue.config import Config
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.step import OWN_SHARE
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
    self.mu, _ = solid.moduli(self.mesh, config)
    self.nodal = solid.nodal_moduli(self.mesh, config).T
    share = np.repeat(self.volume / 4, 4)
    shape = (self.mesh.nvert, len(tet))
    around = sparse.csr_array((share, (tet.ravel(), np.repeat(np.arange(len(tet)), 4))), shape)
    self._mean = sparse.csr_array(sparse.diags_array(1 / around.sum(axis=1)) @ around)
    self._sum = sparse.csr_array(
      (np.ones(tet.size), (tet.ravel(), np.arange(tet.size))), (self.mesh.nvert, tet.size)
    )
    self.foundation = (config.foundation * topology.held_areas(self.mesh))[:, None]

  def force(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Returns elastic force and damping on each node [N], (nvert, 3)."""
    beta = self.config.damping
    tet = self.mesh.tet
    slope, rate = (x[tet].transpose(0, 2, 1) @ self.gradient for x in (u, v))
    mean, mean_rate = ((self._mean @ x.reshape(-1, 9)).reshape(-1, 3, 3) for x in (slope, rate))
    C = _cofactors(mean + np.eye(3))
    mu, lam = self.nodal
    nodal = _stress(mean, mu)
    swell = (C * mean_rate).sum(axis=(1, 2))
    nodal += (lam * (_swelling(mean + np.eye(3), C) + beta * swell))[:, None, None] * C
    F = slope + np.eye(3)
    Q = _turns(F)
    strain = Q.transpose(0, 2, 1) @ rate
    moving = 0.75 * self.mu[:, None, None] * (strain + strain.transpose(0, 2, 1))
    stress = _stress(slope, OWN_SHARE * self.mu) + nodal[tet].mean(axis=1) + beta * Q @ moving
    corner = (self._weighed @ stress.transpose(0, 2, 1)).reshape(-1, 3)
    return -(self._sum @ corner) - self.foundation * (u + beta * v)


def _stress(slope: np.ndarray, mu: np.ndarray) -> np.ndarray:
  """Returns what mu has of the stress [Pa], (n, 3, 3)."""
  F = slope + np.eye(3)
  C = _cofactors(F)
  i = (F * F).sum(axis=(1, 2)) - 3
  stretch, swell = 1 - 1 / (4 + i), 5 / 8 * _swelling(F, C) - 3 / 4
  return (mu * stretch)[:, None, None] * F + (mu * swell)[:, None, None] * C


def _swelling(F: np.ndarray, C: np.ndarray) -> np.ndarray:
  """Returns det F - 1, (n,); C are the cofactors."""
  return (F[:, 0] * C[:, 0]).sum(axis=1) - 1


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
