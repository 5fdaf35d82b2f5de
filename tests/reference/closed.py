"""Closed forms of elasticity beside what a solid's kernels give: ours, theory of each."""

from __future__ import annotations

import numpy as np
import scenes
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology

YOUNG, DENSITY = 5000.0, 1000.0
LENGTH, SIDE = 0.1, 0.04  # of a bar along x [m]
LOAD = 0.002  # on the end of a cantilever [N]


def masses(mesh) -> np.ndarray:
  """Returns the mass of each node [kg], (nvert,)."""
  return DENSITY * fill.vertex_volumes(mesh)


def settled(mesh, body, force, steps=30) -> np.ndarray:
  """Returns the displacement at which forces hold a body in equilibrium [m], (nvert, 3).

  Each step keeps no speed; of the last ones' results the mix is taken whose changes cancel best
  (Anderson 1965, doi:10.1145/321296.321305), since the matrix of a step is stiffer than the solid.
  """
  u, past = np.zeros((mesh.nvert, 3)), []
  for _ in range(steps):
    change = 0.5 * scenes.step(body, 0.5, u, mass=masses(mesh), force=force, beta=0.0)
    past = [*past, (u, change)][-8:]
    us, changes = (np.array([each.ravel() for each in part]) for part in zip(*past, strict=True))
    mix = np.linalg.lstsq((changes[1:] - changes[:-1]).T, changes[-1], rcond=1e-9)[0]
    found = us[-1] + changes[-1] - mix @ (us[1:] - us[:-1] + changes[1:] - changes[:-1])
    u = found.reshape(u.shape)
    if np.abs(change).max() < 1e-5 * np.abs(u).max():
      break
  return u


def solid(points, elem, poisson, pin=(), device="cpu", **skin):
  """Returns mesh and body of a solid; `skin` are the keys of one on its surface."""
  made = skin | {"elements": "solid", "poisson": poisson, "young": (YOUNG,), "device": device}
  mesh, _, body = scenes.kernels(points, elem, pin=pin, tolerance=1e-5, iterations=2000, **made)
  return mesh, body


def end_share(mesh, x: float) -> np.ndarray:
  """Returns the share that each node has of a load on the end of a bar, (nvert,)."""
  face = mesh.tet[:, fill.FACES].reshape(-1, 3)
  end = face[(np.abs(mesh.rest[face][..., 0] - x) < 1e-9).all(axis=1)]
  share = topology.vertex_areas(mesh.rest, end)
  return share / share.sum()


def bar(poisson: float, spacing: float = 0.02, device="cpu", **skin) -> tuple[float, float, float]:
  """Returns the strain of a bar that is pulled at both ends, F / (E A), and Poisson's ratio.

  With a skin that is F / (E A + E' t U), U the bar's girth: both have the same Poisson's ratio.
  """
  made = scenes.box((LENGTH, SIDE, SIDE), spacing)
  mesh, body = solid(*made, poisson, device=device, **skin)
  pull, force = 0.02, np.zeros((mesh.nvert, 3))
  for sign in (-1, 1):  # so that nothing hinders it from getting thinner
    force[:, 0] += sign * pull * end_share(mesh, sign * LENGTH / 2)
  u = settled(mesh, body, force)
  stretch, thinner = (float(np.polyfit(mesh.rest[:, k], u[:, k], 1)[0]) for k in (0, 1))
  stiffness = YOUNG * SIDE**2
  if skin:
    stiffness += skin["capsule_young"][0] * skin["thickness"] * 4 * SIDE
  return stretch, pull / stiffness, -thinner / stretch


def cantilever(poisson: float, spacing: float) -> tuple[float, float]:
  """Returns the sag of a bar's end [m]: Timoshenko's beam, a shear factor of 5/6."""
  points, elem = scenes.box((LENGTH, SIDE, SIDE), spacing)
  mesh, body = solid(points, elem, poisson, np.flatnonzero(points[:, 0] < -LENGTH / 2 + 1e-9))
  share = end_share(mesh, LENGTH / 2)
  u = settled(mesh, body, np.outer(LOAD * share, [0, 0, 1]))
  second, shear = SIDE**4 / 12, YOUNG / (2 * (1 + poisson))
  sag = LOAD * LENGTH * (LENGTH**2 / (3 * YOUNG * second) + 1.2 / (shear * SIDE**2))
  return float(share @ u[:, 2]), sag


def hollow_sphere(poisson: float, subdivisions: int = 3, device="cpu") -> tuple[float, float]:
  """Returns how far the outside of a hollow sphere moves under a pressure inside [m].

  Lame: u(b) = p a^3 b / (b^3 - a^3) 3 (1 - nu) / (2 E) (Timoshenko and Goodier 1970, Theory of
  Elasticity, section 136).
  """
  outer, inner, pressure = 0.05, 0.03, 20.0
  points, elem = scenes.sphere(subdivisions, 1.0)
  coarse, inside = scenes.sphere(max(subdivisions - 1, 1), 1.0)
  both = np.concatenate([outer * points, inner * coarse])
  facets = np.concatenate([elem, inside[:, ::-1] + len(points)])
  mesh, body = solid(both, facets, poisson, device=device)
  cavity = mesh.elem[(mesh.elem >= len(points)).all(axis=1)]
  force = np.zeros((mesh.nvert, 3))
  push = -pressure / 3 * topology.area_vectors(mesh.rest, cavity)
  np.add.at(force, cavity.ravel(), np.repeat(push, 3, axis=0))
  u = settled(mesh, body, force)
  shell = slice(0, len(points))
  grown = (u[shell] * mesh.rest[shell]).sum(axis=1).mean() / outer
  theory = pressure * inner**3 * outer / (outer**3 - inner**3) * 1.5 * (1 - poisson) / YOUNG
  return float(grown), theory
