"""Retract: grasp the gallbladder and pull it aside until what it hides is seen, and hold it there.

Own observations: `target` (3,), from the tip to the site to grasp [m]; `hidden` (3,), from the
tip to the hidden disc [m]; `visible` (1,), share of the disc that the laparoscope sees [-];
`held` (1,), share of the holding time done [-]; `grasped` (1,), whether the jaws hold the site, as
in `grasp`; here it may slip by 5 mm.

Progress: 0.15 * near until it is grasped, near as in `grasp`; then 0.3 + 0.1 * aside + 0.4 *
visible / wanted + 0.2 * held, aside being how far the site has come aside as a share of four radii
of the disc, at most 1: it tells the way before the first of the disc is seen. Only the organ hides:
instruments are not looked at. Success: the wanted share is seen for the holding time, the site
being grasped and the force under its limit; what is above it does not count. Failure: a force above
the damage limit, jaws included, or the time limit.

Shaping: until it is grasped 0.24 * `ready`, as in `grasp`; then 0.3 * (1 - visible / wanted).
"""

import dataclasses
import itertools
from typing import Annotated, Any

import numpy as np
import warp as wp
from palpate.tissue.types import Array

from ..core import rules as r
from ..core.base import Physics
from ..core.performer import Performer, Script
from ..registry import exercise
from .grasp import FUNDUS, GRIPS, READY, Held, Hold, follow, near, ready
from .touch import SLACK

_BEHIND = 0.02  # from the organ's middle to the disc [m]
SAMPLES = 12  # points of the disc
_GRIP = 1.8  # of the expert, more than to lift: what is pulled aside slides [N]
SEEN = 1e-6  # what rounding may take from a share of it


class State(Held):
  """State of a world."""

  wanted: float  # share of the disc
  hold: float  # [s]
  radius: float  # of the disc [m]
  rest: r.Vector  # the site's place at rest [m]
  right: r.Vector  # where to pull it aside to
  disc: Annotated[Any, Array(wp.vec3, (SAMPLES,))]  # points of it [m]
  time: float  # held [s]
  hidden: r.Vector
  visible: float
  held: float


# The rules.


def pulled(s, o):
  """Returns how far the site has come aside, as a share of four radii of the disc [-]."""
  return r.clamp(r.dot(r.point(s, o.site) - o.rest, o.right) / (4.0 * o.radius), -1.0, 1.0)


def advance(s, o):
  """Follows the grasp and what is seen."""
  o, lost = follow(s, o)
  if lost:
    r.drop(s, o)
  o.visible = r.visible(s, o)
  if o.visible < o.wanted - SEEN or o.grasped == 0.0:
    o.time = 0.0
  elif r.peak(s) <= o.force_limit:
    o.time = o.time + o.control_timestep
  if o.time >= o.hold - SLACK:
    return o, 1.0, r.SUCCESS
  progress = 0.15 * near(s, o)
  if o.grasped == 1.0:
    seen = min(o.visible / o.wanted, 1.0)
    progress = 0.3 + 0.1 * pulled(s, o) + 0.4 * seen + 0.2 * o.time / o.hold
  return o, progress, r.RUNNING


def shaping(s, o):
  """Returns what tells the way to a grasp."""
  if o.grasped == 0.0:
    return READY * ready(s, o)
  return 0.3 * (1.0 - min(o.visible / o.wanted, 1.0))


def observe(s, o):
  """Finds target, hidden and held; visible and grasped are up to date."""
  o.target = r.point(s, o.site) - r.tip(s)
  o.hidden = o.disc[0] - r.tip(s)
  o.held = min(o.time / o.hold, 1.0)
  return o


def mark(s, o, k):
  """Marks what the organ hides, and the site."""
  if k == 0:
    return o.disc[0], r.NOW
  return r.point(s, o.site), r.LATER


@exercise("retract/easy", 20, "easy", asks="Uncover half of a disc of 3 mm for 0.5 s",
          scene=dataclasses.replace(FUNDUS, nodes=250), radius=0.003, wanted=0.5,
          hold=0.5)  # fmt: skip
@exercise("retract/standard", 30, asks="Uncover 80 % of a disc of 4 mm for 1 s",
          scene=dataclasses.replace(FUNDUS, nodes=250), radius=0.004, wanted=0.8, hold=1.0,
          jitter=0.003)  # fmt: skip
@exercise("retract/hard", 40, "hard",
          asks="Uncover a disc of 4 mm for 2 s with less force, on varying organs",
          scene=dataclasses.replace(FUNDUS, nodes=500), radius=0.004, wanted=1.0, hold=2.0,
          jitter=0.005, variants=(None, 1, 2), force_limit=3.4, damage=6.0)  # fmt: skip
class Retract(Hold):
  """Pull tissue aside and hold it."""

  rules = r.Rules(
    State, advance, observe, ("target", "hidden", "visible", "held", "grasped"),
    columns=GRIPS, shaping=shaping, mark=mark,
  )  # fmt: skip
  targets = 2

  def __init__(self, *, radius: float, wanted: float, hold: float, **kwargs):
    """Makes the task.

    Args:
      radius: of the hidden disc [m]
      wanted: share of the disc that must be seen [-]
      hold: for how long [s]
      **kwargs: see Task; the force limit counts the jaws too
    """
    self.radius, self.wanted, self.hold = radius, wanted, hold
    super().__init__(**{"spread": 0.012, "force_limit": 4.0, "damage": 8.0, **kwargs})

  def begin(self, physics: Physics) -> None:
    """Draws the site to grasp and hides the disc behind the organ's edge, far from the trocar."""
    super().begin(physics)
    self.time, self.visible = 0.0, 0.0
    self.rest = physics.point(self.site)
    _, center = self.place_of_work(physics)
    self.disc = self._hide(physics, center)
    self.reference_length = self.distance0 + 4 * self.radius  # aside

  def mark_size(self, k: int) -> float:
    """Returns the disc's radius of the first, see `Task`."""
    return super().mark_size(k) if k else self.radius

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
    turn = np.linspace(0, 2 * np.pi, SAMPLES, endpoint=False)[:-1]
    ring = np.cos(turn)[:, None] * right + np.sin(turn)[:, None] * up
    return np.concatenate([middle[None], middle + 0.9 * self.radius * ring])

  def instruct(self, physics: Physics) -> str:
    """Says to grasp, pull aside or hold."""
    if not self.grasped:
      return "Open the jaws, go over the marked fold and close them gently"
    if self.visible < self.wanted:
      return f"Pull it aside: {100 * self.visible:.0f} of {100 * self.wanted:.0f} % are seen"
    return f"Hold it there for {max(self.hold - self.time, 0.0):.1f} s more"

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
