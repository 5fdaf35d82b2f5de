"""Retract: grasp the gallbladder and pull it aside until what it hides is seen, and hold it there.

Own observations: `target` (3,), from the tip to the site to grasp [m]; `hidden` (3,), from the
tip to the hidden disc [m]; `visible` (1,), share of the disc that the laparoscope sees [-];
`held` (1,), share of the holding time done [-]; `grasped` (1,), whether the jaws hold the site, as
in `grasp`; here it may slip by 5 mm.

Progress: 0.15 * closeness until it is grasped; then 0.3 + 0.5 * visible / wanted + 0.2 * held. Only
the organ hides: instruments are not looked at. Success: the wanted share is seen for the holding
time, the site being grasped and the force under its limit; what is above it does not count.
Failure: a force above the damage limit, jaws included, or the time limit.
"""

import dataclasses
import itertools

import numpy as np

from .. import base
from ..registry import exercise
from ..base import Physics
from .grasp import FUNDUS, Hold
from ..performer import Performer, Script
from ..scenes import Scene
from .touch import SLACK

_BEHIND = 0.02  # from the organ's middle to the disc [m]
_SAMPLES = 12  # points of the disc
_GRIP = 1.8  # of the expert, more than to lift: what is pulled aside slides [N]
SEEN = 1e-6  # what rounding may take from a share of it


@exercise("retract/easy", 20, "easy")
def easy(**kwargs):
  """Uncover half of a disc of 3 mm for 0.5 s."""
  kwargs = {"radius": 0.003, "wanted": 0.5, "hold": 0.5, **kwargs}
  return Retract(dataclasses.replace(FUNDUS, nodes=250), **kwargs)


@exercise("retract/standard", 30)
def standard(**kwargs):
  """Uncover 80 % of a disc of 4 mm for 1 s."""
  kwargs = {"radius": 0.004, "wanted": 0.8, "hold": 1.0, "jitter": 0.003, **kwargs}
  return Retract(dataclasses.replace(FUNDUS, nodes=250), **kwargs)


@exercise("retract/hard", 40, "hard")
def hard(**kwargs):
  """Uncover a disc of 4 mm for 2 s with less force, on varying organs."""
  kwargs = {"radius": 0.004, "wanted": 1.0, "hold": 2.0, "jitter": 0.005, **kwargs}
  kwargs = {"variants": (None, 1, 2), "force_limit": 3.4, "damage": 6.0, **kwargs}
  return Retract(dataclasses.replace(FUNDUS, nodes=500), **kwargs)


class Retract(Hold):
  """Pull tissue aside and hold it."""

  def __init__(
    self,
    scene: Scene,
    random=None,
    *,
    name: str,
    radius: float,
    wanted: float,
    hold: float,
    **kwargs,
  ):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      name: domain and task
      radius: of the hidden disc [m]
      wanted: share of the disc that must be seen [-]
      hold: for how long [s]
      **kwargs: see Task; the force limit counts the jaws too
    """
    self.name, self.targets = name, 2
    self.radius, self.wanted, self.hold = radius, wanted, hold
    kwargs = {"spread": 0.012, "force_limit": 4.0, "damage": 8.0, **kwargs}
    super().__init__(dataclasses.replace(scene, targets=2), random, **kwargs)

  def begin(self, physics: Physics) -> None:
    """Draws the site to grasp and hides the disc behind the organ's edge, far from the trocar."""
    super().begin(physics)
    self.held, self.visible = 0.0, 0.0
    _, center = self.place_of_work(physics)
    self.disc = self._hide(physics, center)
    physics.mark(0, self.disc[0], now=True, size=self.radius)
    physics.mark(1, physics.point(self.site))

  def _hide(self, physics: Physics, center: np.ndarray) -> np.ndarray:
    _, mat, _ = physics.camera()
    right, up, back = mat.T
    behind = physics.nodes().mean(axis=0)
    # In the plane behind the organ, on the line through the site that is grasped.
    height = float((center - behind) @ up) + self.random.uniform(-0.012, 0.0)
    aside = np.arange(-0.06, 0.06, 0.001)
    line = behind - _BEHIND * back + height * up + aside[:, None] * right
    covered = physics.hidden(line)
    if not covered.any():
      raise ValueError(f"{self.name}: the organ hides nothing from the laparoscope")
    edge = aside[covered].min()
    self.right = right
    middle = behind - _BEHIND * back + height * up + (edge + 1.8 * self.radius) * right
    turn = np.linspace(0, 2 * np.pi, _SAMPLES, endpoint=False)[:-1]
    ring = np.cos(turn)[:, None] * right + np.sin(turn)[:, None] * up
    return np.concatenate([middle[None], middle + 0.9 * self.radius * ring])

  def advance(self, physics: Physics) -> float:
    """Follows the grasp and what is seen."""
    physics.mark(1, physics.point(self.site))
    if self.follow(physics):
      self.dropped(physics)
    self.visible = 1 - float(physics.hidden(self.disc).mean())
    seen = self.visible >= self.wanted - SEEN
    gentle = physics.peak_force <= self.force_limit
    if not (seen and self.grasped):
      self.held = 0.0
    elif gentle:
      self.held += self.control_timestep
    if self.held >= self.hold - SLACK:
      self.outcome = "success"
      return 1.0
    near = base.closeness(self.distance(physics), self.distance0)
    return progress(self.grasped, near, self.visible / self.wanted, self.held / self.hold)

  def instruct(self, physics: Physics) -> str:
    """Says to grasp, pull aside or hold."""
    if not self.grasped:
      return "Open the jaws, go over the marked fold and close them gently"
    if self.visible < self.wanted:
      return f"Pull it aside: {100 * self.visible:.0f} of {100 * self.wanted:.0f} % are seen"
    return f"Hold it there for {max(self.hold - self.held, 0.0):.1f} s more"

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns target, hidden, visible, held and grasped."""
    return {
      "target": physics.point(self.site) - physics.tip_pos(),
      "hidden": self.disc[0] - physics.tip_pos(),
      "visible": np.array([self.visible]),
      "held": np.array([min(self.held / self.hold, 1.0)]),
      "grasped": np.array([float(self.grasped)]),
    }

  def reference_length(self) -> float:
    """Returns the way to the site and aside by four radii of the disc [m]."""
    return self.distance0 + 4 * self.radius

  def expert(self, p: Performer) -> Script:
    """Grasps and pulls aside, a little up, until enough is seen."""
    physics = p.physics
    for again in itertools.count():
      if self.outcome is not None:
        return
      yield from p.close(self.site, again, _GRIP)
      up = physics.trocar().mat[:, 2]
      yield from p.wait(p.style.delay)
      along = self.right + 0.15 * up
      along /= np.linalg.norm(along)
      start, speed, contact = p.tip.copy(), 0.015 * p.style.speed, 0.0
      far, extra = 0.0, 0.002 * (1 + 4 * p.style.overshoot)
      enough = None
      while self.grasped:
        contact += self.control_timestep
        if self.visible >= self.wanted - 1e-9:
          enough = far + extra if enough is None else enough
        elif enough is not None and far >= enough + self.slid(physics):
          enough = None  # the organ slid back
        # What slides in the jaws is pulled in again before the disc is covered by it.
        if far < (0.035 if enough is None else enough + self.slid(physics)):
          far += speed * self.control_timestep
        p.tip = start + far * along
        p.grip(contact)
        yield p.step()
      yield from p.open()
      yield from p.move(p.tip + 0.02 * up)


def progress(grasped: bool, near: float, seen: float, held: float) -> float:
  """Returns the progress, see the module's head: of closeness, shares of disc and time."""
  return 0.3 + 0.5 * min(seen, 1.0) + 0.2 * held if grasped else 0.15 * near
