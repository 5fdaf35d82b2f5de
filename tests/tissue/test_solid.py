"""Solids: tetrahedra inside a surface, against closed forms of elasticity."""

import numpy as np
import pytest
from palpate.models import shapes
from palpate.tissue import config as configuration
from palpate.tissue import energy, fill
from palpate.tissue import mesh as topology

YOUNG = 5000.0


def _settle(scenes, body, force, mass, h=0.05, count=60):
  """Returns the displacement at which a body comes to rest under forces."""
  u, v = 0.0, 0.0
  for _ in range(count):
    v = 0.0 * v + scenes.step(body, h, u, 0.0, mass, force, beta=0.0)
    u = u + h * v
  return u


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45, 0.49])
def test_small_uniform_strains_have_the_energy_of_linear_elasticity(scenes, poisson):
  points, elem = scenes.box((0.1, 0.08, 0.06), 0.02)
  mesh, config, _ = scenes.kernels(points, elem, elements="solid", poisson=poisson, young=(YOUNG,))
  mu, lam = configuration.lame_solid(YOUNG, poisson)
  volume = 0.1 * 0.08 * 0.06
  for gradient in (np.diag([1e-4, 0, 0]), np.diag([1e-4, -2e-4, 3e-4]), 1e-4 * np.eye(3)[[1, 2, 0]]):
    strain = (gradient + gradient.T) / 2
    expected = volume * (mu * (strain**2).sum() + lam / 2 * np.trace(strain) ** 2)
    found = energy.solid(mesh, config, mesh.rest @ gradient.T)
    assert found == pytest.approx(expected, rel=1e-3)
