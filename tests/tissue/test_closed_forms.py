"""Solids beside closed forms: Lame's hollow sphere, and motions that no force resists."""

import numpy as np
import pytest
from reference import closed

POISSON = [0.3, 0.45, 0.49]


@pytest.mark.parametrize("poisson", POISSON)
def test_a_hollow_sphere_grows_as_lame_says(poisson):
  ours, theory = closed.hollow_sphere(poisson, 3)
  assert ours == pytest.approx(theory, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("poisson", POISSON)
def test_a_fine_hollow_sphere_grows_as_lame_says(poisson):
  ours, theory = closed.hollow_sphere(poisson, 4)
  assert ours == pytest.approx(theory, rel=0.02)


def block(scenes, poisson=0.45):
  return closed.solid(*scenes.box((0.06, 0.04, 0.04), 0.01), poisson)


def turned(points, degrees):
  """Returns points turned about an oblique axis."""
  axis = np.array([1.0, 2.0, -0.5]) / np.sqrt(5.25)
  angle = np.radians(degrees)
  cross = np.cross(np.eye(3), axis)
  turn = np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
  return points @ turn.T


@pytest.mark.parametrize("poisson", POISSON)
@pytest.mark.parametrize("degrees", [10, 90, 180])
def test_a_turned_solid_pulls_on_nothing(scenes, poisson, degrees):
  mesh, body = block(scenes, poisson)
  u = turned(mesh.rest, degrees) - mesh.rest
  stretch = 0.01 * mesh.rest * [1, 0, 0]
  whole = np.abs(scenes.force(body, stretch)).max()  # of a strain of 1 %
  assert np.abs(scenes.force(body, u)).max() < 2e-3 * whole  # single precision


def test_a_solid_falls_freely(scenes):
  mesh, body = block(scenes)
  mass, h, gravity = closed.masses(mesh), 1e-3, np.array([0, 0, -9.81])
  u, v = np.zeros((2, mesh.nvert, 3))
  for _ in range(100):
    v = v + scenes.step(body, h, u, v, mass, mass[:, None] * gravity)
    u = u + h * v
  np.testing.assert_allclose(v, np.broadcast_to(100 * h * gravity, v.shape), atol=1e-5 * 0.981)


def test_a_solid_that_turns_goes_on_turning(scenes):
  mesh, body = block(scenes)
  mass, h = closed.masses(mesh), 1e-3
  spin = np.array([0.0, 0.0, 5.0])  # [rad/s]
  u, v = np.zeros((mesh.nvert, 3)), np.cross(spin, mesh.rest)
  before = (mass[:, None] * np.cross(mesh.rest, v)).sum(axis=0)[2]
  for _ in range(100):
    v = v + scenes.step(body, h, u, v, mass, beta=0.005)
    u = u + h * v
  after = (mass[:, None] * np.cross(mesh.rest + u, v)).sum(axis=0)[2]
  assert after == pytest.approx(before, rel=5e-3)  # of first order
  radius = np.linalg.norm((mesh.rest + u)[:, :2], axis=1).max()
  assert radius == pytest.approx(np.linalg.norm(mesh.rest[:, :2], axis=1).max(), rel=5e-3)
