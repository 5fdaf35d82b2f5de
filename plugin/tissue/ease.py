"""What is around a cut in a solid goes on with no more energy than it had.

Means over nodes are finer where a node has become two, and by convexity have no less energy at the
same positions. So where a cut has raised the energy, what came apart gives way along its forces by
as little as puts that right: some hundredths of an edge. Velocities keep momentum and angular
momentum, and as much of what they have besides as the energy allows.
"""

from __future__ import annotations

import numpy as np

from . import solid
from .config import Config
from .cut import Motion
from .energy import of_gradients, stresses
from .fill import volumes
from .mesh import Mesh, among, cross, distinct, held_areas
from .step import OWN_SHARE

_ROUNDS, _TRIES = 20, 4
_FAR = 4.0
_MORE = 1.001  # times what is wanted that is asked for
_LITTLE = 1e-9  # of the largest moment of inertia


def ease(
  old: Mesh,
  new: Mesh,
  own: np.ndarray,
  group: np.ndarray,
  member: np.ndarray,
  before: Motion,
  after: Motion,
  pinned: np.ndarray,
  config: Config,
) -> tuple[Motion, np.ndarray]:
  """Returns what vertices carry after a cut, and which do not go on as they did.

  Args:
    old: the solid before
    new: and after it
    own: tetrahedra that are not as they were                       (n,)
    group: vertices that came apart, which they were one            (m,)
    member: these, old and new                                      (m,)
    before: what vertices carried
    after: what they carry where each goes on as it did
    pinned: vertices that do not move                               (nvert,) bool
    config: material
  """
  around = among(new.nvert, member)[new.tet].any(axis=1)
  around[own] = True
  one, two = _Patch(old, around, config), _Patch(new, around, config)
  # Masses go with the tissue, from which what was moved at rest has another part now.
  source, had, mass = np.arange(new.nvert), np.zeros(new.nvert), after.mass.copy()
  source[member] = group
  had[one.vert] = one.size
  had = had[source[two.vert]] * mass[two.vert] / before.mass[source[two.vert]]
  mass[two.vert] *= two.size / had
  mass[two.vert] *= before.mass[one.vert].sum() / mass[two.vert].sum()
  old_vert, vert = (patch.vert[~pinned[patch.vert]] for patch in (one, two))
  was = before.mass[old_vert], (old.rest + before.disp)[old_vert], before.vel[old_vert]
  most, disp, vel, apart = one.energy(before.disp), after.disp, after.vel.copy(), distinct(member)
  for _ in range(2):
    disp, more = two.give_way(disp, apart, most)
    now = mass[vert], (new.rest + disp)[vert], after.vel[vert]
    vel[vert], more = _kept(was, now, max(more, 0.0))
    if more <= 0:
      break
    most -= more
  return Motion(mass, disp, vel), vert


class _Patch:
  """The part of a solid whose energy a cut changes.

  Args:
    mesh: the solid
    own: the tetrahedra that are not the same in another one        (ntet,) bool
    config: material
  """

  def __init__(self, mesh: Mesh, own: np.ndarray, config: Config):
    self.mesh, self.vert = mesh, distinct(mesh.tet[own])
    number = np.full(mesh.nvert, -1)
    number[self.vert] = np.arange(len(self.vert))
    which = np.flatnonzero((number[mesh.tet] >= 0).any(axis=1))
    self._own, self._tet = own[which], mesh.tet[which]
    corner = number[self._tet]
    self._entry = np.nonzero(corner >= 0)
    self._at, self._corner = corner[self._entry], corner[self._own]
    self._volume = volumes(mesh.rest, self._tet)
    self._slope = solid.gradients(mesh, self._tet)
    mu, lam = (each[which] for each in solid.moduli(mesh, config))
    self.size = self._sums(np.ones(len(which)))
    self._nodal = self._sums((1 - OWN_SHARE) * mu) / self.size, self._sums(lam) / self.size
    self._mu, self._whole = OWN_SHARE * mu[self._own], (mu + lam)[self._own]
    k = 0.0 if config.carrier else config.foundation
    self._held = k * held_areas(mesh)[self.vert] if k else np.zeros(len(self.vert))

  def _sums(self, value: np.ndarray) -> np.ndarray:
    """Returns the sum over the tetrahedra around each vertex of values by a quarter of volume."""
    tet = self._entry[0]
    share = (self._volume / 4 * value.T).T[tet].reshape(len(tet), -1)
    n = len(self.vert)
    out = np.stack([np.bincount(self._at, column, n) for column in share.T], axis=1)
    return out.reshape(n, *value.shape[1:])

  def _slopes(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the gradients of a displacement in own tetrahedra, and their means at vertices."""
    each = np.einsum("tki,tkj->tij", u[self._tet], self._slope)
    return each[self._own], self._sums(each) / self.size[:, None, None]

  def energy(self, u: np.ndarray) -> float:
    """Returns the energy of the patch with a displacement of all vertices [J]."""
    each, mean = self._slopes(u)
    inside = self._volume[self._own] @ of_gradients(each, self._mu, 0.0)
    inside += self.size @ of_gradients(mean, *self._nodal)
    return float(inside + 0.5 * self._held @ (u[self.vert] ** 2).sum(axis=1))

  def _forces(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the forces on vertices [N], and their stiffness if they moved alone [N/m].

    Those on vertices that also have other tetrahedra than the patch's are not whole.
    """
    each, mean = self._slopes(u)
    stress = stresses(each, self._mu, 0.0) + stresses(mean, *self._nodal)[self._corner].mean(axis=1)
    slope, volume = self._slope[self._own], self._volume[self._own]
    force = -np.einsum("t,tij,tkj->tki", volume, stress, slope).reshape(-1, 3)
    hard = (volume * self._whole)[:, None] * (slope**2).sum(axis=2)
    parts = *force.T, hard.ravel()
    sums = [np.bincount(self._corner.ravel(), part, len(self.vert)) for part in parts]
    return np.stack(sums[:3], 1) - self._held[:, None] * u[self.vert], sums[3] + self._held

  def give_way(self, u: np.ndarray, vert: np.ndarray, most: float) -> tuple[np.ndarray, float]:
    """Returns the displacement with some vertices moved along their forces as far as it takes.

    Args:
      u: displacement of all vertices [m]         (nvert, 3)
      vert: those that move, ascending, whose tetrahedra are all of the patch
      most: energy that there may be [J]

    Returns:
      the displacement, and by how much the energy is more than that, or less, yet [J]
    """
    at, more = np.searchsorted(self.vert, vert), self.energy(u) - most
    way, last = np.zeros((len(vert), 3)), 0.0
    for _ in range(_ROUNDS):
      if more <= 0:
        break
      force, hard = (each[at] for each in self._forces(u))
      down = force / hard[:, None]
      size = float((force * down).sum())
      way = down + (size / last if last else 0.0) * way  # conjugate gradients (Fletcher, Reeves)
      slope, last = float((force * way).sum()), size
      if slope <= 0:
        way, slope = down, size
      u, less = self._along(u, vert, way, slope, more)
      if less <= 0:
        break
      more -= less
    return u, more

  def _along(self, u: np.ndarray, vert: np.ndarray, way: np.ndarray, slope: float, more: float):
    """Returns the displacement with vertices moved on until the energy is less by `more`, and by how
    much it is; along the way it falls by about slope s - bend s^2."""
    was, bend, best = self.energy(u), 0.0, (u, 0.0)
    for _ in range(_TRIES):
      root = slope**2 - 4 * bend * _MORE * more
      share = 2 * _MORE * more / (slope + root**0.5) if root > 0 else slope / (2 * bend)
      out = u.copy()
      out[vert] += min(share, _FAR) * way
      less = was - self.energy(out)
      best = max(best, (out, less), key=lambda pair: pair[1])
      share = min(share, _FAR)
      now = max((slope * share - less) / share**2, 0.0)
      if less >= more or (bend and less > 0) :
        break
      bend = now
    return best


def _kept(was: tuple, now: tuple, less: float) -> tuple[np.ndarray, float]:
  """Returns velocities of nodes with the momentum and angular momentum that they had.

  They turn slowly together for it. Where they have more than their kinetic energy less some, they
  move less beside what they have in common.

  Args:
    was: masses [kg], positions [m] and velocities [m/s] before     (m,), (m, 3), (m, 3)
    now: masses, positions and velocities they would have           (n,), (n, 3), (n, 3)
    less: energy that they lose [J]

  Returns:
    the velocities, and how much more energy they have than they should [J]
  """
  centre = now[0] @ now[1] / now[0].sum()
  (p, spin, energy), (q, turns, _) = (_sums(*each, centre) for each in (was, now))
  mass, x, v = now
  arm = x - centre
  inertia = (mass @ (arm**2).sum(axis=1)) * np.eye(3) - (mass * arm.T) @ arm

  def rigid(momentum, moment):
    omega = np.linalg.lstsq(inertia, moment, rcond=_LITTLE)[0]
    return momentum / mass.sum() + cross(omega[None], arm)

  common, rest = rigid(p, spin), v - rigid(q, turns)
  own, besides = (0.5 * float(mass @ (each**2).sum(axis=1)) for each in (common, rest))
  left = energy - less - own
  share = np.sqrt(max(left, 0.0) / besides) if besides > 0 else 1.0
  return common + min(1.0, share) * rest, -left


def _sums(mass, x, v, centre):
  """Returns momentum, angular momentum about a point, and kinetic energy."""
  p = mass[:, None] * v
  return p.sum(axis=0), cross(x - centre, p).sum(axis=0), 0.5 * float((p * v).sum())
