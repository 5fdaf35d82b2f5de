"""Probe: press sites on the liver to a force or depth and hold, or find what is stiff by touch.

Pressing (`easy`, `standard`, `hard`, `depth`). Own observations: `target` (3,), from the tip to the
site [m]; `normal` (3,), of the surface there [-]; `level` (1,), the pressed force [N] (or
depth [m]) minus the middle of the band; `held` (1,), share of the holding time done [-].
Progress: (sites done + 0.4 * closeness + 0.05 * firm + 0.5 * held) / sites, closeness counting
from the site before; firm is what is pressed within the tolerance over the band's lower end, at
most 1, less what is above its upper end. Pressing counts within the tolerance of the site; leaving
the band starts the holding again.

Palpation (`palpate_easy`, `palpate_standard`, `palpate_hard`): a stiff inclusion lies somewhere
under the field, some 27 cm^2 of the kidney's front. It can be felt, not seen: nothing that is
observed or paid before the report depends on where it is but through what the probe feels. The one
report (action `report` above 0.5) ends the episode, with success when the tip presses with 0.05 N
or more within the tolerance of the inclusion. Reporting the best place without feeling succeeds in
8 % of the episodes (8 mm), 6 to 7 % in `palpate_hard` (7 mm).
Own observations: `field` (3,), from the tip to the field's middle [m]; `felt` (1,), share of the
field that lies within 8 mm of where the probe has pressed with 0.1 N or more [-]; and what follows
from the force over the depth of presses deeper than 2.8 mm: `left` (1,), 1 while a place is left to
feel [-]; `target` (3,), from the tip to it [m]: beside the stiffest, if that is 1.6 times as stiff
as what is soft, or else the nearest 14 mm or more from all that was felt; without one to where the
inclusion is to be expected; `normal` (3,), of the surface there [-].
Progress: 0.3 * felt; on the report 1 or 0.
"""

import dataclasses
from typing import Annotated, Any

import numpy as np
import warp as wp
from palpate.tissue.types import Array, ints

from ...core import rules as r
from ...core.base import Physics, Task
from ...core.performer import Performer, Script
from ...core.scenes import Scene
from ...registry import exercise
from ..touch import SLACK, draw_apart
from . import palpation

KIDNEY = Scene(
  organ="kidney", center="anterior", port=(0.03, 0.045, 0.12), camera=(-0.05, 0.12, 0.1)
)
PRESSES, LEAVES = 0.1, 0.02  # force above which a press begins, and below which it ends [N]


class State:
  """State of a world where sites are pressed."""

  tolerance: float  # [m]
  low: float  # of the band [N] or [m]
  high: float
  hold: float  # [s]
  by_depth: bool  # whether the band is one of depth
  control_timestep: float  # [s]
  goals: Annotated[Any, ints("targets")]  # triangles to press
  points: Annotated[Any, Array(wp.vec3, ("targets",))]  # their middles at rest [m]
  normals: Annotated[Any, Array(wp.vec3, ("targets",))]
  done: int
  time: float  # in the band [s]
  pressing: bool
  distance0: float  # [m]
  target: r.Vector
  normal: r.Vector
  level: float  # from the middle of the band [N] or [m]
  held: float


# The rules of pressing.


def now(o):
  """Returns the index of the site to press."""
  return min(o.done, o.goals.shape[0] - 1)


def distance(s, o):
  """Returns how far the tip is from the site along the surface, or above it [m]."""
  offset = r.tip(s) - o.points[now(o)]
  height = r.dot(offset, o.normals[now(o)])
  aside = r.length(offset - height * o.normals[now(o)])
  above = max(height, 0.0)
  return r.root(aside * aside + above * above)


def level(s, o):
  """Returns what the band is about: the force [N] or the depth below the resting surface [m]."""
  if o.by_depth:
    return max(0.0, r.dot(o.points[now(o)] - r.tip(s), o.normals[now(o)]))
  return r.force(s)


def towards(o, much):
  """Returns how near what is pressed is to the band: 1 in it, 0 without, less above it [-]."""
  return r.clamp(much / o.low, 0.0, 1.0) - r.clamp((much - o.high) / o.high, 0.0, 1.0)


def advance(s, o):
  """Counts the time in the band."""
  far, pressed = distance(s, o), r.force(s)
  if pressed > PRESSES and not o.pressing and far > o.tolerance:
    r.miss(s, o, far)
  o.pressing = pressed > (LEAVES if o.pressing else PRESSES)
  much = level(s, o)
  inside = far <= o.tolerance and o.low <= much and much <= o.high and pressed > 0.02
  o.time = o.time + o.control_timestep if inside else 0.0
  if o.time >= o.hold - SLACK:
    r.reach(s, o, far)
    o.done = o.done + 1
    o.time = 0.0
    far = distance(s, o)
    o.distance0 = far
  outcome = r.SUCCESS if o.done == o.goals.shape[0] else r.RUNNING
  near = r.closeness(far, o.distance0)
  firm = towards(o, much) if far <= o.tolerance else 0.0
  progress = float(o.done) + 0.4 * near + 0.05 * firm + 0.5 * o.time / o.hold
  return o, progress / float(o.goals.shape[0]), outcome


def observe(s, o):
  """Finds target, normal, level and held."""
  o.target = o.points[now(o)] - r.tip(s)
  o.normal = r.normal(s, o.goals[now(o)])
  o.level = level(s, o) - 0.5 * (o.low + o.high)
  o.held = o.time / o.hold
  return o


def mark(s, o, k):
  """Marks the sites that are left."""
  return o.points[k], r.shown(k, o.done)


@exercise("probe/easy", 15, "easy", asks="Press one site with 0.3 to 0.7 N for 0.5 s",
          scene=Scene(nodes=250), sites=1, band=(0.3, 0.7), hold=0.5, tolerance=0.008)  # fmt: skip
@exercise("probe/standard", 40, asks="Press three sites with 0.4 to 0.6 N for 1 s each",
          scene=Scene(nodes=500), sites=3, band=(0.4, 0.6), hold=1.0, jitter=0.005)  # fmt: skip
@exercise("probe/hard", 60, "hard",
          asks="Press four sites with 0.45 to 0.55 N for 2 s each, on livers that vary",
          scene=Scene(nodes=1000), sites=4, band=(0.45, 0.55), hold=2.0, jitter=0.01,
          variants=(None, 1, 2), force_limit=0.8, damage=2.0)  # fmt: skip
@exercise("probe/depth", 40, asks="Press three sites 4 to 6 mm deep for 1 s each",
          scene=Scene(nodes=500), by_depth=True, sites=3, band=(0.004, 0.006), hold=1.0,
          jitter=0.005)  # fmt: skip
class Press(Task):
  """Press sites into a band of force or depth and hold."""

  rules = r.Rules(State, advance, observe, ("target", "normal", "level", "held"), mark=mark)

  def __init__(
    self,
    *,
    sites: int,
    band: tuple[float, float],
    hold: float,
    tolerance: float = 0.005,
    by_depth: bool = False,
    **kwargs,
  ):
    """Makes the task.

    Args:
      sites: how many to press
      band: of force [N] or depth [m]
      hold: how long to stay in the band [s]
      tolerance: largest distance of the tip from the site, along the surface [m]
      by_depth: whether the band is one of depth
      **kwargs: see Task
    """
    self.targets, self.band, self.hold = sites, band, hold
    self.low, self.high = band
    self.tolerance, self.by_depth = tolerance, by_depth
    super().__init__(**{"spread": 0.035, **kwargs})

  def begin(self, physics: Physics) -> None:
    """Draws the sites, apart from each other."""
    place, _ = self.place_of_work(physics)
    self.goals = np.array(draw_apart(self.random, physics, place, self.targets, 0.015))
    self.points = np.array([physics.point(goal) for goal in self.goals])
    self.normals = physics.normals()[self.goals]
    self.done, self.time, self.pressing = 0, 0.0, False
    self.distance0 = distance(physics, self)
    stations = np.array([physics.tip_pos(), *self.points])
    self.reference_length = float(np.linalg.norm(np.diff(stations, axis=0), axis=1).sum())

  def label(self, kind: str) -> str:
    """Returns the number of the site."""
    return str(self.done + 1) if kind == "target" else ""

  def instruct(self, physics: Physics) -> str:
    """Says where to press, and how much."""
    if distance(physics, self) > 2 * self.tolerance:
      return f"Go to the yellow site, {min(self.done + 1, self.targets)} of {self.targets}"
    much = level(physics, self)
    if much < self.low:
      return "Press more"
    if much > self.high:
      return "Press less"
    return f"Hold it there for {max(self.hold - self.time, 0.0):.1f} s more"

  def expert(self, p: Performer) -> Script:
    """Presses the sites one by one."""
    while self.done < self.targets:
      done, k = self.done, now(self)
      point, normal = self.points[k], self.normals[k]
      if not (self.pressing and distance(p.physics, self) <= self.tolerance):
        yield from p.above(point, 0.008, normal)
      aside = p.tip - point - (p.tip - point) @ normal * normal
      if np.linalg.norm(aside) > 1e-6:  # somebody else has begun, beside the site
        yield from p.line(p.tip - aside, 0.01)
      middle = sum(self.band) / 2

      def until(done: int = done) -> bool:
        return self.done > done

      if self.by_depth:
        yield from p.sink(middle, point, -normal, until)
      else:
        yield from p.push(middle, -normal, until, most=6.0)
      yield from p.move(point + 0.008 * normal)


@exercise("probe/palpate_easy", 40, "easy",
          asks="Find an inclusion ten times as stiff, within 8 mm",
          scene=dataclasses.replace(KIDNEY, nodes=250), factor=10.0, radius=0.012,
          tolerance=0.008)  # fmt: skip
@exercise("probe/palpate_standard", 60,
          asks="Find an inclusion eight times as stiff, within 8 mm",
          scene=dataclasses.replace(KIDNEY, nodes=500), factor=8.0, radius=0.01, tolerance=0.008,
          jitter=0.003)  # fmt: skip
@exercise("probe/palpate_hard", 60, "hard",
          asks="Find an inclusion five times as stiff, within 7 mm, on varying kidneys",
          scene=dataclasses.replace(KIDNEY, nodes=1000), factor=5.0, radius=0.009, tolerance=0.007,
          jitter=0.005, variants=(None, 1, 2), force_limit=1.0)  # fmt: skip
class Palpate(palpation.Palpate):
  """Find what is stiff by touch."""
