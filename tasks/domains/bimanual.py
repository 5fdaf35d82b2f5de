"""Bimanual: hold the gallbladder away from its bed with one hand, divide it with the other's hook.

The action has the grasper's components, then those of the hook: `hook_pitch`, `hook_yaw`,
`hook_roll`, `hook_insertion`, and `hook_current`, which is on above 0.

Own observations: those of `dissect`, and `hook_front` (3,), from the hook to the nearest bond that
holds [m]; `retracted` (1,), how far the site is from its place at rest, away from the bed, as a
share of what is needed [-]; `burnt` (1,), share of the burn that is damage [-].

A current frees the bonds within 3 mm of the hook's wire in 0.2 s. What comes free while the site is
grasped and retracted by 5 mm, with the pull on the liver under its limit, is `clean`; the rest is
`torn`: what is not held away is not seen. A current without a bond in reach burns what the hook
touches; half a second of that is damage. Progress, success and failure are those of `dissect`; the
bed is too strong to be pulled off.
"""

import dataclasses
import itertools

import numpy as np

from ..base import Physics
from ..performer import Performer, Script
from ..registry import exercise
from .dissect import Dissect
from .grasp import FUNDUS

# Stiffness [N/m^3], strength [Pa] and energy [J/m^2] of the bed; ours, we know of no measurement. A
# pull within the limits does not free it.
BED = (1e7, 2.5e4, 40.0)
AWAY = 0.005  # least way of the site from the bed, for what is divided to count [m]
REACH, RATE = 0.003, 5.0  # of the current around the wire [m], damage that it does to bonds [1/s]
TOUCHING, BURN = 0.03, 0.5  # force with which the hook touches [N], time that it may burn [s]
SCENE = dataclasses.replace(
  FUNDUS, nodes=250, bonds=BED, second="hook", second_port=(-0.05, -0.01, 0.12)
)
# Of the expert: how far it pulls at most [m], how much further than it has to, the share of the
# largest traction it keeps under, how far the hook stays from a bond and begins above it [m].
_FAR, _MORE, _SHARE, _OFF, _WAITS = 0.03, 0.3, 0.7, 0.0015, 0.01


@exercise("bimanual/easy", 40, "easy", "bimanual")
def easy(**kwargs):
  """Hold the gallbladder and divide half of its bed with a hook."""
  return Bimanual(SCENE, **{"wanted": 0.5, **kwargs})


@exercise("bimanual/standard", 60, "bimanual")
def standard(**kwargs):
  """Divide 80 % of it."""
  kwargs = {"wanted": 0.8, "jitter": 0.003, **kwargs}
  return Bimanual(SCENE, **kwargs)


@exercise("bimanual/hard", 80, "hard", "bimanual")
def hard(**kwargs):
  """Divide 90 % of it with less force, on varying organs."""
  kwargs = {"wanted": 0.9, "jitter": 0.005, "variants": (None, 1, 2), **kwargs}
  kwargs = {"force_limit": 3.4, "damage": 6.0, "traction": 1.2, **kwargs}
  scene = dataclasses.replace(SCENE, nodes=500)
  return Bimanual(scene, **kwargs)


class Bimanual(Dissect):
  """Retract with one hand, dissect with the other.

  Attributes:
    burnt: how long the current has burnt what the hook touches [s]
  """

  touched = 36

  @property
  def other(self) -> tuple[str, ...]:
    """See `Task`."""
    return ("current",)

  def begin(self, physics: Physics) -> None:
    """Draws the site to grasp."""
    super().begin(physics)
    self.burnt, self.live = 0.0, False
    self._rest = physics.point(self.site)
    away = self._rest - self.front(physics)
    self._away = away / np.linalg.norm(away)

  def retracted(self, physics: Physics) -> float:
    """Returns how far the site is from its place at rest, away from the bed [m]."""
    return float((physics.point(self.site) - self._rest) @ self._away)

  def fair(self, physics: Physics) -> bool:
    """Whether what comes free now is held away from the bed."""
    return bool(self.grasped) and self.retracted(physics) > AWAY

  def before_step(self, action, physics: Physics) -> None:
    """Moves both instruments, and sends the current through the hook."""
    super().before_step(action, physics)
    self.live = bool(self.action[..., -1].max() > 0)
    if not self.live:
      return
    bonds = physics.organ.bonds
    near = self._distances(physics) < REACH
    if near.any():
      bonds.weaken(RATE * self.control_timestep * near)
    elif np.linalg.norm(physics.hands[1].contact_force()) > TOUCHING:
      self.burnt += self.control_timestep

  def _distances(self, physics: Physics) -> np.ndarray:
    """Returns how far the bonds that hold are from the wire [m]  (n,); free ones are far away."""
    bonds, hook = physics.organ.bonds, physics.hands[1]
    heel = hook.tip_pos()
    along = physics.data.ptr.site_xpos[physics.model.ptr.site("hook/toe").id] - heel
    offset = bonds.positions - heel
    share = (offset @ along / (along @ along)).clip(0, 1)
    far = np.linalg.norm(offset - share[:, None] * along, axis=1)
    return np.where(bonds.free, np.inf, far)

  def advance(self, physics: Physics) -> float:
    """Follows the grasp, what comes free, and what is burnt."""
    done = super().advance(physics)
    if self.burnt > BURN and self.outcome is None:
      self.harm_done(physics, f"burnt for {self.burnt:.2f} s")
      return self.earned(0.0)
    return done

  def instruct(self, physics: Physics) -> str:
    """Says to grasp, to pull, or to divide."""
    if not self.grasped:
      return super().instruct(physics)
    if self.traction > self.limit:
      return "Pull less: the liver gives"
    if not self.fair(physics):
      return "Pull it further from its bed"
    if self.live and not np.isfinite(self._distances(physics)).any():
      return "Current off"
    share = f"{100 * self.clean:.0f} of {100 * self.wanted:.0f} % are free"
    return f"Hold it so, and divide its bed with the hook: {share}"

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns what `dissect` does, hook_front, retracted and burnt."""
    bonds, hook = physics.organ.bonds, physics.hands[1]
    nearest = bonds.positions[self._distances(physics).argmin()]
    return super().observe(physics) | {
      "hook_front": nearest - hook.tip_pos(),
      "retracted": np.array([self.retracted(physics) / AWAY]),
      "burnt": np.array([min(self.burnt / BURN, 1.0)]),
    }

  def expert(self, p: Performer) -> Script:
    """Grasps and pulls with one hand; the other divides, bond by bond from its side."""
    assert p.other
    yield from p.both(self._pull(p), self._divide(p.other))

  def _pull(self, p: Performer) -> Script:
    """Grasps and pulls away from the bed, and holds it so."""

    def further(contact: float) -> bool:
      near = self.retracted(p.physics) < (1 + _MORE) * p.excess(contact) * AWAY
      return near and self.traction < _SHARE * self.limit

    for again in itertools.count():
      if self.outcome is not None:
        return
      yield from p.close(self.site, again)
      yield from self.pull(p, _FAR, further)

  def _divide(self, p: Performer) -> Script:
    """Waits for the pull, and goes from bond to bond."""
    physics, up = p.physics, p.hand.trocar().mat[:, 2]
    while self.outcome is None:
      p.extra[:] = -1.0
      if not self.fair(physics):
        yield p.step()
        continue
      bonds = physics.organ.bonds
      held = np.flatnonzero(~bonds.free)
      near = held[np.linalg.norm(bonds.positions[held] - p.tip, axis=1).argmin()]
      yield from p.above(bonds.positions[near], _WAITS, up)
      while self.outcome is None and self.fair(physics) and not bonds.free[near]:
        goal = bonds.positions[near]
        step = goal + _OFF * up - p.tip
        far = float(np.linalg.norm(step))
        reach = 0.02 * p.style.speed * self.control_timestep
        p.tip = p.tip + step * min(1.0, reach / max(far, 1e-9))
        p.extra[:] = 1.0 if np.linalg.norm(p.hand.tip_pos() - goal) < 0.8 * REACH else -1.0
        yield p.step()
