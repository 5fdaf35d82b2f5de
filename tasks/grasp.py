"""Grasp: grasp the gallbladder's fundus, lift it, hold it, lower it and let go.

Own observations: `target` (3,), from the tip to the site to grasp [m]; `height` (1,), of the
site above its place at rest, towards the trocar, minus the height to lift to [m]; `held` (1,),
share of the holding time done [-]; `grasped` (1,), whether both jaws press on something.

Progress: 0.2 * closeness until it is grasped; then 0.3 + 0.4
* min(height / lift, 1) + 0.2 * held; 0.9 once held long enough, 1 on release. Grasped means that
both jaws press within 12 mm of the site. Success: released below half of the height after
holding. Slipping from closed jaws and letting go above half of the height start the holding
again. Failure: a force above the damage limit, jaws included, or the time limit.
"""

import dataclasses

import numpy as np
from dm_control.utils import containers

from . import base
from .base import Physics, Task
from .performer import Performer, Script
from .scenes import Scene

SUITE = containers.TaggedTasks()
FUNDUS = Scene(
  organ="gallbladder",
  instrument="grasper",
  center="fundus",
  port=(0.03, 0.06, 0.12),
  camera=(-0.09, 0.072, 0.054),
)
REACH = 0.012  # of the jaws around the site [m]


@SUITE.add("benchmarking", "easy")
def easy(time_limit=20, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to lift the fundus by 6 mm for 0.5 s."""
  kwargs = {"lift": 0.006, "hold": 0.5, **kwargs}
  task = Grasp(dataclasses.replace(FUNDUS, nodes=250), random, name="grasp/easy", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking")
def standard(time_limit=30, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to lift the fundus by 8 mm for 1 s."""
  kwargs = {"lift": 0.008, "hold": 1.0, "jitter": 0.003, **kwargs}
  task = Grasp(dataclasses.replace(FUNDUS, nodes=250), random, name="grasp/standard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking", "hard")
def hard(time_limit=40, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to lift the fundus by 10 mm for 2 s with less force, on varying organs."""
  kwargs = {"lift": 0.01, "hold": 2.0, "jitter": 0.005, "variants": (None, 1, 2), **kwargs}
  kwargs = {"force_limit": 3.4, "damage": 6.0, **kwargs}
  task = Grasp(dataclasses.replace(FUNDUS, nodes=500), random, name="grasp/hard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


class Grasp(Task):
  """Grasp, lift, hold, lower, release."""

  watch = ("miss", "unintended_contact", "drop")

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
    kwargs = {"spread": 0.012, "force_limit": 4.0, "damage": 8.0, **kwargs}
    super().__init__(dataclasses.replace(scene, targets=1), random, **kwargs)

  def begin(self, physics: Physics) -> None:
    """Draws the site."""
    place, _ = self.place_of_work(physics)
    self.site = int(self.random.choice(place))
    self.rest = physics.point(self.site)
    self.up = physics.trocar().mat[:, 2]
    self.held, self.done = 0.0, False
    self.grasped, self._closing = False, False
    self.distance0 = self.distance(physics)
    physics.mark(0, self.rest)

  def distance(self, physics: Physics) -> float:
    """Returns how far the tip is from the site [m]."""
    return float(np.linalg.norm(physics.point(self.site) - physics.tip_pos()))

  def height(self, physics: Physics) -> float:
    """Returns how far the site is above its place at rest, towards the trocar [m]."""
    return float((physics.point(self.site) - self.rest) @ self.up)

  def advance(self, physics: Physics) -> float:
    """Follows the grasp from closing to release."""
    physics.mark(0, physics.point(self.site))
    height = self.height(physics)
    closing = physics.closing()
    grasped = physics.holds() and self.distance(physics) < REACH and closing
    if self.grasped and not physics.holds():
      low = height < 0.5 * self.lift
      if self.done and low and not closing:
        self.outcome = "success"
        self.grasped = False
        return 1.0
      self.event(physics, "drop", label="slipped" if closing else "let go")
      self.held, self.done = 0.0, False
    if closing and not self._closing and self.distance(physics) >= 2 * REACH:
      self.event(physics, "miss", self.distance(physics), "closed off the site")
    if grasped and not self.grasped:
      self.event(physics, "target", self.distance(physics), "grasp")
    self.grasped = (grasped or self.grasped) and physics.holds()
    self._closing = closing
    if self.grasped and height >= self.lift:
      self.held += self.control_timestep
      self.done = self.done or self.held >= self.hold - 1e-9
    elif not self.done:
      self.held = 0.0
    if self.done:
      return 0.9
    if not self.grasped:
      return 0.2 * base.closeness(self.distance(physics), self.distance0)
    share = float(np.clip(height / self.lift, 0, 1))
    return 0.3 + 0.4 * share + 0.2 * min(self.held / self.hold, 1.0)

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns target, height, held and grasped."""
    return {
      "target": physics.point(self.site) - physics.tip_pos(),
      "height": np.array([self.height(physics) - self.lift]),
      "held": np.array([min(self.held / self.hold, 1.0)]),
      "grasped": np.array([float(self.grasped)]),
    }

  def recorded(self, physics: Physics) -> dict[str, float]:
    """Returns whether the jaws are told to close and whether they hold."""
    return {"grip": float(physics.closing()), "held": float(self.grasped)}

  def reference_length(self) -> float:
    """Returns the way to the site, up and down again [m]."""
    return self.distance0 + 2 * self.lift

  def expert(self, p: Performer) -> Script:
    """Grasps, lifts, holds, lowers and lets go."""
    physics = p.physics
    while self.outcome is None:
      yield from p.close(self.site)
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
      while self.grasped and self.height(physics) > 0.2 * self.lift:
        p.tip = p.tip - speed * self.control_timestep * up
        p.grip(contact)
        yield p.step()
      yield from p.open()
      yield from p.move(p.tip + 0.02 * up)
