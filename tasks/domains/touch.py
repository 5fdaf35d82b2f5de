"""Touch: touch numbered points on the liver in order with the probe.

Own observations: `target` (3,), from the tip to the point to touch [m]; `normal` (3,), of the
surface there [-]; `held` (1,), share of the time of a touch done [-].

Progress: (points touched + 0.5 * closeness + 0.2 * held) / points, closeness counting from the
point before. A point is touched by a contact of 0.1 s, of 0.03 N or more, that was within the
tolerance of it and the force limit from its start: a ram is to be let go of, and so is a miss,
which is what starts elsewhere. Success: all points. Failure: a force above the damage limit, or the
time limit.
"""

from typing import Annotated, Any

import numpy as np
from palpate.tissue.types import ints

from ..core import rules as r
from ..core.base import Physics, Task
from ..core.performer import Performer, Script
from ..core.scenes import Scene
from ..registry import exercise

CONTACT, DWELL = 0.03, 0.1  # least force and time of a touch [N], [s]
SLACK = 1e-5  # what rounding may take from times [s]


class State:
  """State of a world."""

  tolerance: float  # [m]
  force_limit: float  # [N]
  control_timestep: float  # [s]
  goals: Annotated[Any, ints("targets")]  # triangles to touch
  done: int
  time: float  # of the touch [s]
  pressing: bool
  spoilt: bool  # the contact counts no more
  distance0: float  # [m]
  target: r.Vector
  normal: r.Vector
  held: float


# The rules.


def goal(o):
  """Returns the triangle to touch next; the last one when all are done."""
  return o.goals[min(o.done, o.goals.shape[0] - 1)]


def distance(s, o):
  """Returns how far the tip is from the point to touch [m]."""
  return r.length(r.point(s, goal(o)) - r.tip(s))


def follow(s, o, far):
  """Follows the contact: one that was elsewhere, too strong or counted counts no more.

  That is until the tip lets go.
  """
  on = far <= o.tolerance
  pressing = r.peak(s) > CONTACT
  if pressing and not o.pressing and not on:
    r.miss(s, o, far)
  o.pressing = pressing
  o.spoilt = pressing and (o.spoilt or not on or r.peak(s) > o.force_limit)
  o.time = o.time + o.control_timestep if pressing and not o.spoilt else 0.0
  return o


def advance(s, o):
  """Counts touches and misses."""
  far = distance(s, o)
  o = follow(s, o, far)
  if o.time >= DWELL - SLACK:
    r.reach(s, o, far)
    o.done = o.done + 1
    o.time = 0.0
    o.spoilt = True
    far = distance(s, o)
    o.distance0 = far
  outcome = r.SUCCESS if o.done == o.goals.shape[0] else r.RUNNING
  near = r.closeness(far, o.distance0)
  progress = (float(o.done) + 0.5 * near + 0.2 * o.time / DWELL) / float(o.goals.shape[0])
  return o, progress, outcome


def observe(s, o):
  """Finds target, normal and held."""
  o.target = r.point(s, goal(o)) - r.tip(s)
  o.normal = r.normal(s, goal(o))
  o.held = o.time / DWELL
  return o


def mark(s, o, k):
  """Marks the points that are left."""
  return r.point(s, o.goals[k]), r.shown(k, o.done)


@exercise("touch/easy", 10, "easy", asks="Touch one point within 5 mm",
          scene=Scene(nodes=250), points=1, tolerance=0.005)  # fmt: skip
@exercise("touch/standard", 30, asks="Touch four points within 3 mm",
          scene=Scene(nodes=500), points=4, tolerance=0.003, jitter=0.005)  # fmt: skip
@exercise("touch/hard", 40, "hard", asks="Touch six points within 2 mm, on livers that vary",
          scene=Scene(nodes=1000), points=6, tolerance=0.002, jitter=0.01, variants=(None, 1, 2),
          damage=2.0)  # fmt: skip
class Touch(Task):
  """Touch points in order."""

  rules = r.Rules(State, advance, observe, ("target", "normal", "held"), mark=mark)

  def __init__(self, *, points: int, tolerance: float, **kwargs):
    """Makes the task.

    Args:
      points: how many to touch
      tolerance: largest distance from tip to point [m]
      **kwargs: see Task
    """
    self.targets, self.tolerance = points, tolerance
    super().__init__(**{"spread": 0.035, "force_limit": 0.5, **kwargs})

  def begin(self, physics: Physics) -> None:
    """Draws the points, apart from each other."""
    place, _ = self.place_of_work(physics)
    self.goals = np.array(draw_apart(self.random, physics, place, self.targets, 0.012))
    self.done, self.time = 0, 0.0
    self.pressing, self.spoilt = False, False
    self.distance0 = distance(physics, self)
    stations = np.array([physics.tip_pos(), *(physics.point(t) for t in self.goals)])
    self.reference_length = float(np.linalg.norm(np.diff(stations, axis=0), axis=1).sum())

  def label(self, kind: str) -> str:
    """Returns the number of the point."""
    return str(self.done + 1) if kind == "target" else ""

  def instruct(self, physics: Physics) -> str:
    """Says which point is next, and to let go."""
    if self.pressing and self.spoilt:
      return "Let go of the organ"
    return f"Touch the yellow point gently, {self.done + 1} of {self.targets}"

  def expert(self, p: Performer) -> Script:
    """Touches the points one by one."""
    physics = p.physics
    while self.done < self.targets:
      done, triangle = self.done, goal(self)
      place, up = physics.point(triangle), physics.normals()[triangle]
      if self.spoilt:
        yield from p.move(place + 0.005 * up)
      elif not self.pressing:
        yield from p.above(place, 0.005, up)
      yield from p.push(0.12, -up, lambda done=done: self.done > done, most=3.0)
      yield from p.line(physics.tip_pos() + 0.01 * up, 0.05)


def draw_apart(
  random: np.random.RandomState, physics: Physics, place: np.ndarray, count: int, gap: float
) -> list[int]:
  """Returns triangles at least `gap` [m] apart, or as far as the place allows."""
  middle = physics.nodes()[physics.organ.elem].mean(axis=1)
  chosen = [int(random.choice(place))]
  while len(chosen) < count:
    distance = np.linalg.norm(middle[place][:, None] - middle[chosen], axis=2).min(axis=1)
    far = place[distance >= min(gap, 0.8 * distance.max())]
    chosen.append(int(random.choice(far)))
  return chosen
