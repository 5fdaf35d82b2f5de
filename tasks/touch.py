"""Touch: touch numbered points on the liver in order with the probe.

Own observations: `target` (3,), from the tip to the point to touch [m]; `normal` (3,), of the
surface there [-]; `held` (1,), share of the time of a touch done [-].

Progress: (points touched + 0.5 * closeness + 0.2 * held) / points, closeness counting from the
point before. A point is touched by a contact of 0.1 s, of 0.03 N or more, that was within the
tolerance of it and the force limit from its start: a ram is to be let go of, and so is a miss,
which is what starts elsewhere. Success: all points. Failure: a force above the damage limit, or the
time limit.
"""

import dataclasses

import numpy as np
from dm_control.utils import containers

from . import base
from .base import Physics, Task
from .performer import Performer, Script
from .scenes import Scene

SUITE = containers.TaggedTasks()
CONTACT, DWELL = 0.03, 0.1  # least force and time of a touch [N], [s]
SLACK = 1e-5  # what rounding may take from times [s]


@SUITE.add("benchmarking", "easy")
def easy(time_limit=10, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to touch one point within 5 mm."""
  task = Touch(1, 0.005, Scene(nodes=250), random, name="touch/easy", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking")
def standard(time_limit=30, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to touch four points within 3 mm."""
  kwargs = {"jitter": 0.005, **kwargs}
  task = Touch(4, 0.003, Scene(nodes=500), random, name="touch/standard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking", "hard")
def hard(time_limit=40, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to touch six points within 2 mm, on livers that vary."""
  kwargs = {"jitter": 0.01, "variants": (None, 1, 2), "damage": 2.0, **kwargs}
  task = Touch(6, 0.002, Scene(nodes=1000), random, name="touch/hard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


class Touch(Task):
  """Touch points in order."""

  def __init__(self, points: int, tolerance: float, scene: Scene, random=None, *, name, **kwargs):
    """Makes the task.

    Args:
      points: how many to touch
      tolerance: largest distance from tip to point [m]
      scene: what it plays in
      random: see Task
      name: domain and task
      **kwargs: see Task
    """
    self.name, self.targets, self.tolerance = name, points, tolerance
    kwargs = {"spread": 0.035, "force_limit": 0.5, **kwargs}
    super().__init__(dataclasses.replace(scene, targets=points), random, **kwargs)

  def begin(self, physics: Physics) -> None:
    """Draws the points, apart from each other."""
    place, _ = self.place_of_work(physics)
    self.goals = draw_apart(self.random, physics, place, self.targets, 0.012)
    self.done, self.held = 0, 0.0
    self.pressing, self.spoilt = False, False
    self._aim(physics)
    self._path = float(np.linalg.norm(np.diff(self._stations(physics), axis=0), axis=1).sum())

  def _stations(self, physics: Physics) -> np.ndarray:
    return np.array([physics.tip_pos(), *(physics.point(t) for t in self.goals)])

  def _aim(self, physics: Physics) -> None:
    for i, goal in enumerate(self.goals):
      physics.mark(i, physics.point(goal), shown=i >= self.done, now=i == self.done)
    if self.done < self.targets:
      self.distance0 = self.distance(physics)

  def goal(self) -> int:
    """Returns the triangle to touch next; the last one when all are done."""
    return self.goals[min(self.done, self.targets - 1)]

  def distance(self, physics: Physics) -> float:
    """Returns how far the tip is from the point to touch [m]."""
    return float(np.linalg.norm(physics.point(self.goal()) - physics.tip_pos()))

  def advance(self, physics: Physics) -> float:
    """Counts touches and misses."""
    force, distance = physics.peak_force, self.distance(physics)
    on = distance <= self.tolerance
    if force > CONTACT and not self.pressing and not on:
      self.event(physics, "miss", distance)
    self.pressing, self.spoilt, self.held = follow(
      self.spoilt, self.held, force, on, self.force_limit, self.control_timestep
    )
    if self.held >= DWELL - SLACK:
      self.event(physics, "target", distance, str(self.done + 1))
      self.done, self.held, self.spoilt = self.done + 1, 0.0, True
      self._aim(physics)
    if self.done == self.targets:
      self.outcome = "success"
      return 1.0
    near = base.closeness(self.distance(physics), self.distance0)
    return progress(float(self.done), near, self.held, float(self.targets))

  def instruct(self, physics: Physics) -> str:
    """Says which point is next, and to let go."""
    if self.pressing and self.spoilt:
      return "Let go of the organ"
    return f"Touch the yellow point gently, {self.done + 1} of {self.targets}"

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns target, normal and held."""
    goal = self.goal()
    return {
      "target": physics.point(goal) - physics.tip_pos(),
      "normal": physics.normal(goal),
      "held": np.array([self.held / DWELL]),
    }

  def reference_length(self) -> float:
    """Returns the length of the straight lines from point to point [m]."""
    return self._path

  def expert(self, p: Performer) -> Script:
    """Touches the points one by one."""
    physics = p.physics
    while self.done < self.targets:
      done, goal = self.done, self.goal()
      point, normal = physics.point(goal), physics.normals()[goal]
      if self.spoilt:
        yield from p.move(point + 0.005 * normal)
      elif not self.pressing:
        yield from p.above(point, 0.005, normal)
      yield from p.push(0.12, -normal, lambda done=done: self.done > done, most=3.0)
      yield from p.line(physics.tip_pos() + 0.01 * normal, 0.05)


# The rules, which the vectorised exercise has in kernels.


def follow(
  spoilt: bool, held: float, force: float, on: bool, limit: float, dt: float
) -> tuple[bool, bool, float]:
  """Returns whether the tip presses, whether its contact counts no more, and the time it has [s].

  A contact that was elsewhere, too strong or counted counts no more until the tip lets go.
  """
  pressing = force > CONTACT
  lost = pressing and (spoilt or not on or force > limit)
  return pressing, lost, held + dt if pressing and not lost else 0.0


def progress(done: float, near: float, held: float, points: float) -> float:
  """Returns the progress, see the module's head; `near` is the closeness to the next point."""
  return (done + 0.5 * near + 0.2 * held / DWELL) / points


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
