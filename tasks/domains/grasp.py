"""Grasp: grasp the gallbladder's fundus, lift it, hold it, lower it and let go.

Own observations: `target` (3,), from the tip to the site to grasp [m]; `height` (1,), of the
site above its place at rest, towards the trocar, minus the height to lift to [m]; `held` (1,),
share of the holding time done [-]; `grasped` (1,), whether the jaws hold the site.

Grasped means that there is tissue between the jaws, which are told to close on it: both inner
faces press on it with 0.2 N or more, it keeps them open, and the site is within 12 mm of the tip
and 4 mm of the shaft's axis: a fold beside the mark is another one.
It stays grasped as long as all that is so and the site has not moved in the jaws by more than half
of the lift, from where it was grasped, and again from where it was when the holding was done.

Progress: 0.2 * near until it is grasped, near being the closeness of the tip to within 5 mm of the
site, which the jaws are to go over; then 0.3 + 0.4 * min(height / lift, 1) + 0.2 * held; 0.9 + 0.05
* (1 - min(height / lift, 1)) + 0.03 * share of the rest once held long enough, 1 on release. Only
time under the force limit counts as held. Lowered means to rest for 0.2 s, grasped, between a
quarter of the lift below the site's place and 0.4 of the lift above it. Success: held, lowered, and
let go with the site between there and half of the lift. Slipping from the jaws and letting go
before it is lowered start the holding again. Failure: a force above the damage limit, jaws
included, or the time limit.

Shaping: until it is grasped 0.24 * `ready`, for jaws that are open near the site, are over the fold
and close on it; then 0.26 - (0.16 + 0.15 * held) * min(height / lift, 1). Once held long enough it
is -0.03 - 0.02 * height / lift, from 0 to 2 lifts, so that who holds the fold too high is told the
way down too; and more by 0.045 * (1 - 2 * pinch / force limit), not below 0, while the fold rests
low: jaws that loosen are about to let go. Where a held fold is pushed down by d lifts it is less by
0.15 * d / (1 + d). So no grasp is paid less than what led to it, down to d of 4, and most of what
follows for the lift.
"""

import dataclasses
import itertools

import numpy as np

from ..core import rules as r
from ..core.base import Physics, Task
from ..core.performer import Performer, Script
from ..core.scenes import Scene
from ..registry import exercise
from .touch import SLACK

FUNDUS = Scene(
  organ="gallbladder",
  instrument="grasper",
  center="fundus",
  port=(0.03, 0.06, 0.12),
  camera=(-0.09, 0.072, 0.054),
)
REACH, ASIDE = 0.012, 0.004  # of the jaws around the site, and across the shaft [m]
OVER = 0.005  # how far the tip may go past a site before it is paid less: jaws go over a fold [m]
REST = 0.2  # at a low height before release [s]
# Heights that it rests between, and is let go below, as shares of the lift.
LOW, RESTING, LETTING = -0.25, 0.4, 0.5
READY = 0.24  # shaping of jaws that are closed on the site, less than that of any grasp [-]
TIGHT, HIGH = -0.03, -0.02  # shaping of a fold that was held long enough, and of a lift then [-]
LOOSE = 0.045  # what it gains at rest in jaws without force [-]
GRIPS = {"grip": "closing", "held": "grasped"}  # see `Rules.columns`


class Held:
  """State of jaws that are to hold a site."""

  slip: float  # how far it may move in the jaws [m]
  force_limit: float  # [N]
  control_timestep: float  # [s]
  site: int  # triangle to grasp
  closing: bool  # whether the jaws are told to close
  where: r.Vector  # the site in the frame of the tip, where it was grasped [m]
  distance0: float  # [m]
  target: r.Vector
  grasped: float  # 1 while the jaws hold it


# The rules of holding.


def ready(s, o):
  """Returns how far the jaws are from the way there to closed on the site, 0 to 1 [-].

  They are to be open as they come near, to go over the fold, and to close on it. Closed jaws that
  press on a site push it ahead of them. Beside it they sink in and leave it behind their tips, so
  a site that closed jaws have within is nearer to their axis.
  """
  off, wide = r.from_tip(s, r.point(s, o.site)), r.clamp(r.opening(s), 0.0, 1.0)
  side = ASIDE * (0.6 + 0.4 * wide)
  within = r.clamp(off[2] / OVER, 0.0, 1.0) * r.clamp(2.0 - aside(s, o) / side, 0.0, 1.0)
  return 0.4 * max(near(s, o), 0.0) * max(wide, within) + 0.6 * within * (1.0 - 0.6 * wide)


def distance(s, o):
  """Returns how far the tip is from the site [m]."""
  return r.length(r.point(s, o.site) - r.tip(s))


def aside(s, o):
  """Returns how far the site is from the axis of the shaft [m]."""
  off = r.from_tip(s, r.point(s, o.site))
  return r.root(off[0] * off[0] + off[1] * off[1])


def near(s, o):
  """Returns the closeness of the jaws to where they can hold the site [-]."""
  return r.closeness(max(distance(s, o) - OVER, 0.0), o.distance0 - OVER)


def slid(s, o):
  """Returns how far the site has moved in the jaws from where it was grasped [m]."""
  return r.length(r.from_tip(s, r.point(s, o.site)) - o.where)


def follow(s, o):
  """Finds out whether the site is grasped; returns too whether it was until now, and is no more."""
  told, far, before, now = r.closing(s), distance(s, o), o.grasped == 1.0, False
  if before:
    now = told and r.holds(s) and slid(s, o) < o.slip
    if told and not now:
      r.slipped(s, o)
  elif told and far < REACH and aside(s, o) < ASIDE and r.holds(s):
    now = True
    o.where = r.from_tip(s, r.point(s, o.site))
    r.grip(s, o, far)
  if told and not o.closing and far >= 2.0 * REACH:
    r.miss(s, o, far)
  o.closing = told
  o.grasped = 1.0 if now else 0.0
  return o, before and not now


class Hold(Task):
  """What the exercises of the grasper share: a site that is to be held between the jaws.

  Attributes:
    site: triangle to grasp
    grasped: 1 while the jaws hold it, see the module's head
    closing: whether they are told to close
    slip: how far it may move in the jaws [m]
  """

  watch = ("miss", "unintended_contact", "drop")
  slots = 24
  site: int
  slip = 0.005

  def begin(self, physics: Physics) -> None:
    """Draws the site."""
    place, _ = self.place_of_work(physics)
    self.site = int(self.random.choice(place))
    self.grasped, self.closing, self.where = 0.0, False, np.zeros(3)
    self.distance0 = distance(physics, self)

  def slid(self, physics: Physics) -> float:
    """Returns how far the site has moved in the jaws from where it was grasped [m]."""
    return slid(physics, self)

  def label(self, kind: str) -> str:
    """Returns what a miss is, and how tissue was lost."""
    return "closed off the site" if kind == "miss" else "slipped" if self.closing else "let go"


class State(Held):
  """State of a world."""

  lift: float  # [m]
  hold: float  # [s]
  rest: r.Vector  # the site's place at rest [m]
  up: r.Vector  # towards the trocar
  time: float  # held [s]
  done: bool  # it was held
  lowered: float  # it rests low [s]
  letting: bool  # the jaws let go
  height: float
  held: float


# The rules.


def raised(s, o):
  """Returns how far the site is above its place at rest, towards the trocar [m]."""
  return r.dot(r.point(s, o.site) - o.rest, o.up)


def again(o):
  """Starts the holding again."""
  o.time = 0.0
  o.done = False
  o.lowered = 0.0
  o.letting = False
  return o


def lose(s, o):
  """Counts a loss, and starts again."""
  r.drop(s, o)
  return again(o)


def count(s, o, share):
  """Counts the time that the site is held high, and then at rest low."""
  if not o.done:
    if share < 1.0:
      o.time = 0.0
    elif r.peak(s) <= o.force_limit:
      o.time = o.time + o.control_timestep
    if o.time >= o.hold - SLACK:
      o.done = True
      o.where = r.from_tip(s, r.point(s, o.site))
  low = o.done and share >= LOW and share <= RESTING
  o.lowered = o.lowered + o.control_timestep if low else 0.0
  return o


def advance(s, o):
  """Follows the grasp from closing to release."""
  share = raised(s, o) / o.lift
  o, lost = follow(s, o)
  if lost:
    o.letting = o.lowered >= REST - SLACK and not o.closing
    if not o.letting:
      o = lose(s, o)
  if o.letting and (share < LOW or share > LETTING):
    o = lose(s, o)
  if o.letting and not r.holds(s):
    return o, 1.0, r.SUCCESS
  if o.grasped == 1.0:
    o = count(s, o, share)
  high = max(min(share, 1.0), 0.0)
  progress = 0.2 * near(s, o)
  if o.done:
    progress = 0.9 + 0.05 * (1.0 - high) + 0.03 * min(o.lowered / REST, 1.0)
  elif o.grasped == 1.0:
    progress = 0.3 + 0.4 * high + 0.2 * min(o.time / o.hold, 1.0)
  return o, progress, r.RUNNING


def shaping(s, o):
  """Returns what tells the way to a grasp, up from any depth of the fold, and to let go of it."""
  if o.grasped == 0.0 and not o.done:
    return READY * ready(s, o)
  share = raised(s, o) / o.lift
  high, pushed = r.clamp(share, 0.0, 1.0), max(-share, 0.0)
  deep = 0.15 * pushed / (1.0 + pushed)
  if not o.done:
    return 0.26 - high * (0.16 + (0.12 - TIGHT) * min(o.time / o.hold, 1.0)) - deep
  loose = 0.0
  if o.lowered >= REST - SLACK:
    loose = LOOSE * r.clamp(1.0 - 2.0 * r.pinch(s) / o.force_limit, 0.0, 1.0)
  return TIGHT + HIGH * r.clamp(share, 0.0, 2.0) + loose - deep


def observe(s, o):
  """Finds target, height and held; grasped is up to date."""
  o.target = r.point(s, o.site) - r.tip(s)
  o.height = raised(s, o) - o.lift
  o.held = min(o.time / o.hold, 1.0)
  return o


def mark(s, o, k):
  """Marks the site."""
  return r.point(s, o.site), r.LATER


@exercise("grasp/easy", 20, "easy", asks="Lift the fundus by 6 mm for 0.5 s",
          scene=dataclasses.replace(FUNDUS, nodes=250), lift=0.006, hold=0.5)  # fmt: skip
@exercise("grasp/standard", 30, asks="Lift the fundus by 8 mm for 1 s",
          scene=dataclasses.replace(FUNDUS, nodes=250), lift=0.008, hold=1.0,
          jitter=0.003)  # fmt: skip
@exercise("grasp/hard", 40, "hard",
          asks="Lift the fundus by 10 mm for 2 s with less force, on varying organs",
          scene=dataclasses.replace(FUNDUS, nodes=500), lift=0.01, hold=2.0, jitter=0.005,
          variants=(None, 1, 2), force_limit=3.4, damage=6.0)  # fmt: skip
class Grasp(Hold):
  """Grasp, lift, hold, lower, release."""

  rules = r.Rules(
    State, advance, observe, ("target", "height", "held", "grasped"), columns=GRIPS,
    shaping=shaping, mark=mark,
  )  # fmt: skip

  def __init__(self, *, lift: float, hold: float, **kwargs):
    """Makes the task.

    Args:
      lift: height to lift the site to [m]
      hold: how long to hold it there [s]
      **kwargs: see Task; the force limit counts the jaws too
    """
    self.lift, self.hold = lift, hold
    self.slip = 0.5 * lift
    super().__init__(**{"spread": 0.012, "force_limit": 4.0, "damage": 8.0, **kwargs})

  def begin(self, physics: Physics) -> None:
    """Draws the site."""
    super().begin(physics)
    self.rest = physics.point(self.site)
    self.up = physics.trocar().mat[:, 2]
    self.reference_length = self.distance0 + 2 * self.lift  # up and down again
    again(self)

  @property
  def rests(self) -> bool:
    """Whether the site was held, lowered and rests there, ready to be let go."""
    return self.lowered >= REST - SLACK

  def instruct(self, physics: Physics) -> str:
    """Says to grasp, lift, hold, lower or let go."""
    if not self.grasped:
      return "Open the jaws, go over the marked fold and close them gently"
    if self.rests:
      return "Open the jaws to let go"
    if self.done:
      return "Lower it to where it was"
    if raised(physics, self) < self.lift:
      return f"Lift it by {1e3 * self.lift:.0f} mm, towards the trocar"
    return f"Hold it there for {max(self.hold - self.time, 0.0):.1f} s more"

  def expert(self, p: Performer) -> Script:
    """Grasps, lifts, holds, lowers and lets go."""
    physics = p.physics
    for again in itertools.count():
      if self.outcome is not None:
        return
      if not self.letting:  # nor has somebody else begun to let go
        yield from p.close(self.site, again)
      up = physics.trocar().mat[:, 2]
      speed, contact = 0.012 * p.style.speed, 0.0
      yield from p.wait(p.style.delay)
      goal = self.lift + 0.0015 + 0.3 * p.style.overshoot * self.lift
      while self.grasped and not self.done:  # up, and hold
        contact += self.control_timestep
        missing = goal - raised(physics, self)
        p.tip = p.tip + float(np.clip(3 * missing, -speed, speed)) * self.control_timestep * up
        p.grip(contact)
        yield p.step()
      yield from p.wait(p.style.delay)
      while self.grasped and not self.rests:
        if raised(physics, self) > 0.2 * self.lift:
          p.tip = p.tip - speed * self.control_timestep * up
        p.grip(contact)
        yield p.step()
      yield from p.open()
      yield from p.move(p.tip + 0.02 * up)
