"""Grasp: grasp the gallbladder's fundus, lift it, hold it, lower it and let go.

Own observations: `target` (3,), from the tip to the site to grasp [m]; `height` (1,), of the
site above its place at rest, towards the trocar, minus the height to lift to [m]; `held` (1,),
share of the holding time done [-]; `grasped` (1,), whether the jaws hold the site.

Grasped means that there is tissue between the jaws, which are told to close on it: both inner
faces press on it with 0.2 N or more, it keeps them open, and the site is within 12 mm of the tip.
It stays grasped as long as all that is so and the site has not moved in the jaws by more than half
of the lift, from where it was grasped, and again from where it was when the holding was done.

Progress: 0.2 * closeness until it is grasped; then 0.3 + 0.4 * min(height / lift, 1) + 0.2 * held;
0.9 + 0.05 * (1 - min(height / lift, 1)) once held long enough, 1 on release. Only time under the
force limit counts as held. Lowered means to rest for 0.2 s, grasped, between a quarter of the lift
below the site's place and 0.4 of the lift above it. Success: held, lowered, and let go with the
site between there and half of the lift. Slipping from the jaws and letting go before it is lowered
start the holding again. Failure: a force above the damage limit, jaws included, or the time limit.
"""

import dataclasses
import itertools

import numpy as np

from .. import base
from ..registry import exercise
from ..base import Physics, Task
from ..performer import Performer, Script
from ..scenes import Scene
from .touch import SLACK

FUNDUS = Scene(
  organ="gallbladder",
  instrument="grasper",
  center="fundus",
  port=(0.03, 0.06, 0.12),
  camera=(-0.09, 0.072, 0.054),
)
REACH = 0.012  # of the jaws around the site [m]
REST = 0.2  # at a low height before release [s]
# Heights that it rests between, and is let go below, as shares of the lift.
LOW, RESTING, LETTING = -0.25, 0.4, 0.5


@exercise("grasp/easy", 20, "easy")
def easy(**kwargs):
  """Lift the fundus by 6 mm for 0.5 s."""
  kwargs = {"lift": 0.006, "hold": 0.5, **kwargs}
  return Grasp(dataclasses.replace(FUNDUS, nodes=250), **kwargs)


@exercise("grasp/standard", 30)
def standard(**kwargs):
  """Lift the fundus by 8 mm for 1 s."""
  kwargs = {"lift": 0.008, "hold": 1.0, "jitter": 0.003, **kwargs}
  return Grasp(dataclasses.replace(FUNDUS, nodes=250), **kwargs)


@exercise("grasp/hard", 40, "hard")
def hard(**kwargs):
  """Lift the fundus by 10 mm for 2 s with less force, on varying organs."""
  kwargs = {"lift": 0.01, "hold": 2.0, "jitter": 0.005, "variants": (None, 1, 2), **kwargs}
  kwargs = {"force_limit": 3.4, "damage": 6.0, **kwargs}
  return Grasp(dataclasses.replace(FUNDUS, nodes=500), **kwargs)


class Hold(Task):
  """What the exercises of the grasper share: a site that is to be held between the jaws.

  Attributes:
    site: triangle to grasp
    grasped: whether the jaws hold it, see the module's head
    closing: whether they are told to close
    slip: how far it may move in the jaws [m]
  """

  watch = ("miss", "unintended_contact", "drop")
  site: int
  slip = 0.005

  def begin(self, physics: Physics) -> None:
    """Draws the site."""
    place, _ = self.place_of_work(physics)
    self.site = int(self.random.choice(place))
    self.grasped, self.closing = False, False
    self.distance0 = self.distance(physics)

  def distance(self, physics: Physics) -> float:
    """Returns how far the tip is from the site [m]."""
    return float(np.linalg.norm(physics.point(self.site) - physics.tip_pos()))

  def follow(self, physics: Physics) -> bool:
    """Finds out whether the site is grasped; returns whether it was until now, and is no more."""
    before, closing, distance = self.grasped, physics.closing(), self.distance(physics)
    holds = closing and physics.holds()
    if before:
      self.grasped = holds and self.slid(physics) < self.slip
    elif holds and distance < REACH:
      self.grasped = True
      self.hold_here(physics)
      self.event(physics, "target", distance, "grasp")
    if closing and not self.closing and distance >= 2 * REACH:
      self.event(physics, "miss", distance, "closed off the site")
    self.closing = closing
    return before and not self.grasped

  def hold_here(self, physics: Physics) -> None:
    """Takes where the site is in the jaws as the place that it may slip from."""
    self._place = physics.from_tip(physics.point(self.site))

  def slid(self, physics: Physics) -> float:
    """Returns how far the site has moved in the jaws from that place [m]."""
    return float(np.linalg.norm(physics.from_tip(physics.point(self.site)) - self._place))

  def dropped(self, physics: Physics) -> None:
    """Reports that the tissue was lost."""
    self.event(physics, "drop", label="slipped" if self.closing else "let go")

  def recorded(self, physics: Physics) -> dict[str, float]:
    """Returns whether the jaws are told to close and whether they hold."""
    return {"grip": float(self.closing), "held": float(self.grasped)}


def progress(done: bool, grasped: bool, near: float, share: float, held: float) -> float:
  """Returns the progress, see the module's head: of closeness, shares of lift and time."""
  high = max(min(share, 1.0), 0.0)
  low = 0.9 + 0.05 * (1.0 - high) if done else 0.2 * near
  return 0.3 + 0.4 * high + 0.2 * min(held, 1.0) if grasped and not done else low


class Grasp(Hold):
  """Grasp, lift, hold, lower, release."""

  def __init__(self, scene: Scene, random=None, *, name: str, lift: float, hold: float, **kwargs):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      name: domain and task
      lift: height to lift the site to [m]
      hold: how long to hold it there [s]
      **kwargs: see Task; the force limit counts the jaws too
    """
    self.name, self.targets, self.lift, self.hold = name, 1, lift, hold
    self.slip = 0.5 * lift
    kwargs = {"spread": 0.012, "force_limit": 4.0, "damage": 8.0, **kwargs}
    super().__init__(dataclasses.replace(scene, targets=1), random, **kwargs)

  def begin(self, physics: Physics) -> None:
    """Draws the site."""
    super().begin(physics)
    self.rest = physics.point(self.site)
    self.up = physics.trocar().mat[:, 2]
    self._again()
    physics.mark(0, self.rest)

  def _again(self) -> None:
    """Starts the holding again."""
    self.held, self.done, self.lowered, self._letting = 0.0, False, 0.0, False

  @property
  def rests(self) -> bool:
    """Whether the site was held, lowered and rests there, ready to be let go."""
    return self.lowered >= REST - SLACK

  def height(self, physics: Physics) -> float:
    """Returns how far the site is above its place at rest, towards the trocar [m]."""
    return float((physics.point(self.site) - self.rest) @ self.up)

  def advance(self, physics: Physics) -> float:
    """Follows the grasp from closing to release."""
    physics.mark(0, physics.point(self.site))
    share = self.height(physics) / self.lift
    if self.follow(physics):
      self._letting = self.rests and not self.closing
      if not self._letting:
        self._lose(physics)
    if self._letting and not LOW <= share <= LETTING:
      self._lose(physics)
    if self._letting and not physics.holds():
      self.outcome = "success"
      return 1.0
    if self.grasped:
      self._count(physics, share)
    near = base.closeness(self.distance(physics), self.distance0)
    return progress(self.done, self.grasped, near, share, self.held / self.hold)

  def instruct(self, physics: Physics) -> str:
    """Says to grasp, lift, hold, lower or let go."""
    if not self.grasped:
      return "Open the jaws, go over the marked fold and close them gently"
    if self.rests:
      return "Open the jaws to let go"
    if self.done:
      return "Lower it to where it was"
    if self.height(physics) < self.lift:
      return f"Lift it by {1e3 * self.lift:.0f} mm, towards the trocar"
    return f"Hold it there for {max(self.hold - self.held, 0.0):.1f} s more"

  def _lose(self, physics: Physics) -> None:
    self.dropped(physics)
    self._again()

  def _count(self, physics: Physics, share: float) -> None:
    """Counts the time that the site is held high, and then at rest low."""
    gentle = physics.peak_force <= self.force_limit
    if not self.done:
      self.held = self.held + self.control_timestep * gentle if share >= 1 else 0.0
      self.done = self.held >= self.hold - SLACK
      if self.done:
        self.hold_here(physics)
    low = self.done and LOW <= share <= RESTING
    self.lowered = self.lowered + self.control_timestep if low else 0.0

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns target, height, held and grasped."""
    return {
      "target": physics.point(self.site) - physics.tip_pos(),
      "height": np.array([self.height(physics) - self.lift]),
      "held": np.array([min(self.held / self.hold, 1.0)]),
      "grasped": np.array([float(self.grasped)]),
    }

  def reference_length(self) -> float:
    """Returns the way to the site, up and down again [m]."""
    return self.distance0 + 2 * self.lift

  def expert(self, p: Performer) -> Script:
    """Grasps, lifts, holds, lowers and lets go."""
    physics = p.physics
    for again in itertools.count():
      if self.outcome is not None:
        return
      yield from p.close(self.site, again)
      up = physics.trocar().mat[:, 2]
      speed, contact = 0.012 * p.style.speed, 0.0
      yield from p.wait(p.style.delay)
      goal = self.lift + 0.0015 + 0.3 * p.style.overshoot * self.lift
      while self.grasped and not self.done:  # up, and hold
        contact += self.control_timestep
        missing = goal - self.height(physics)
        p.tip = p.tip + float(np.clip(3 * missing, -speed, speed)) * self.control_timestep * up
        p.grip(contact)
        yield p.step()
      yield from p.wait(p.style.delay)
      while self.grasped and not self.rests:
        if self.height(physics) > 0.2 * self.lift:
          p.tip = p.tip - speed * self.control_timestep * up
        p.grip(contact)
        yield p.step()
      yield from p.open()
      yield from p.move(p.tip + 0.02 * up)
