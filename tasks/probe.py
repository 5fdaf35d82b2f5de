"""Probe: press sites on the liver to a force or depth and hold, or find what is stiff by touch.

Pressing (`easy`, `standard`, `hard`, `depth`). Own observations: `target` (3,), from the tip to the
site [m]; `normal` (3,), of the surface there [-]; `level` (1,), the pressed force [N] (or
depth [m]) minus the middle of the band; `held` (1,), share of the holding time done [-].
Progress: (sites done + 0.4 * closeness + 0.5 * held) / sites, closeness counting from the site
before. Pressing counts within the tolerance of the site; leaving the band starts the holding again.

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

import numpy as np
from dm_control.utils import containers

from . import base
from .base import Physics, Task
from .palpation import Palpate
from .performer import Performer, Script
from .scenes import Scene
from .touch import SLACK, draw_apart

SUITE = containers.TaggedTasks()
KIDNEY = Scene(
  organ="kidney", center="anterior", port=(0.03, 0.045, 0.12), camera=(-0.05, 0.12, 0.1)
)
PRESSES, LEAVES = 0.1, 0.02  # force above which a press begins, and below which it ends [N]


@SUITE.add("benchmarking", "easy")
def easy(time_limit=15, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to press one site with 0.3 to 0.7 N for 0.5 s."""
  kwargs = {"sites": 1, "band": (0.3, 0.7), "hold": 0.5, "tolerance": 0.008, **kwargs}
  task = Press(Scene(nodes=250), random, name="probe/easy", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking")
def standard(time_limit=40, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to press three sites with 0.4 to 0.6 N for 1 s each."""
  kwargs = {"sites": 3, "band": (0.4, 0.6), "hold": 1.0, "jitter": 0.005, **kwargs}
  task = Press(Scene(nodes=500), random, name="probe/standard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking", "hard")
def hard(time_limit=60, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to press four sites with 0.45 to 0.55 N for 2 s each, on livers that vary."""
  kwargs = {"sites": 4, "band": (0.45, 0.55), "hold": 2.0, "jitter": 0.01, **kwargs}
  kwargs = {"variants": (None, 1, 2), "force_limit": 0.8, "damage": 2.0, **kwargs}
  task = Press(Scene(nodes=1000), random, name="probe/hard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking")
def depth(time_limit=40, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to press three sites 4 to 6 mm deep for 1 s each."""
  kwargs = {"sites": 3, "band": (0.004, 0.006), "hold": 1.0, "jitter": 0.005, **kwargs}
  task = Press(Scene(nodes=500), random, name="probe/depth", by_depth=True, **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking", "easy")
def palpate_easy(time_limit=40, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to find an inclusion ten times as stiff, within 8 mm."""
  kwargs = {"factor": 10.0, "radius": 0.012, "tolerance": 0.008, **kwargs}
  task = Palpate(
    dataclasses.replace(KIDNEY, nodes=250), random, name="probe/palpate_easy", **kwargs
  )
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking")
def palpate_standard(time_limit=60, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to find an inclusion eight times as stiff, within 8 mm."""
  kwargs = {"factor": 8.0, "radius": 0.01, "tolerance": 0.008, "jitter": 0.003, **kwargs}
  scene = dataclasses.replace(KIDNEY, nodes=500)
  task = Palpate(scene, random, name="probe/palpate_standard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking", "hard")
def palpate_hard(time_limit=60, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to find an inclusion five times as stiff, within 7 mm, on varying kidneys."""
  kwargs = {"factor": 5.0, "radius": 0.009, "tolerance": 0.007, "jitter": 0.005, **kwargs}
  kwargs = {"variants": (None, 1, 2), "force_limit": 1.0, **kwargs}
  scene = dataclasses.replace(KIDNEY, nodes=1000)
  task = Palpate(scene, random, name="probe/palpate_hard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


class Press(Task):
  """Press sites into a band of force or depth and hold."""

  watch = ("miss", "unintended_contact")

  def __init__(
    self,
    scene: Scene,
    random=None,
    *,
    name: str,
    sites: int,
    band: tuple[float, float],
    hold: float,
    tolerance: float = 0.005,
    by_depth: bool = False,
    **kwargs,
  ):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      name: domain and task
      sites: how many to press
      band: of force [N] or depth [m]
      hold: how long to stay in the band [s]
      tolerance: largest distance of the tip from the site, along the surface [m]
      by_depth: whether the band is one of depth
      **kwargs: see Task
    """
    self.name, self.targets, self.band, self.hold = name, sites, band, hold
    self.tolerance, self.by_depth = tolerance, by_depth
    kwargs = {"spread": 0.035, **kwargs}
    super().__init__(dataclasses.replace(scene, targets=sites), random, **kwargs)

  def begin(self, physics: Physics) -> None:
    """Draws the sites, apart from each other."""
    place, _ = self.place_of_work(physics)
    self.goals = draw_apart(self.random, physics, place, self.targets, 0.015)
    self.points = np.array([physics.point(goal) for goal in self.goals])
    self.normals = physics.normals()[self.goals]
    self.done, self.held, self._pressing = 0, 0.0, False
    self._path = float(
      np.linalg.norm(np.diff([physics.tip_pos(), *self.points], axis=0), axis=1).sum()
    )
    self._aim(physics)

  def _aim(self, physics: Physics) -> None:
    for i, point in enumerate(self.points):
      physics.mark(i, point, shown=i >= self.done, now=i == self.done)
    self.held = 0.0
    self.distance0 = self.distance(physics)

  @property
  def now(self) -> int:
    """Index of the site to press."""
    return min(self.done, self.targets - 1)

  def distance(self, physics: Physics) -> float:
    """Returns how far the tip is from the site along the surface, or above it [m]."""
    offset = physics.tip_pos() - self.points[self.now]
    height = float(offset @ self.normals[self.now])
    aside = np.linalg.norm(offset - height * self.normals[self.now])
    return float(np.hypot(aside, max(height, 0.0)))

  def level(self, physics: Physics) -> float:
    """Returns what the band is about: the force [N] or the depth below the resting surface [m]."""
    if not self.by_depth:
      return float(np.linalg.norm(physics.contact_force()))
    return max(0.0, float((self.points[self.now] - physics.tip_pos()) @ self.normals[self.now]))

  def advance(self, physics: Physics) -> float:
    """Counts the time in the band."""
    force = float(np.linalg.norm(physics.contact_force()))
    on_site = self.distance(physics) <= self.tolerance
    if force > PRESSES and not self._pressing and not on_site:
      self.event(physics, "miss", self.distance(physics))
    self._pressing = force > (LEAVES if self._pressing else PRESSES)
    inside = presses(on_site, self.level(physics), *self.band, force)
    self.held = self.held + self.control_timestep if inside else 0.0
    if self.held >= self.hold - SLACK:
      self.event(physics, "target", self.distance(physics), str(self.done + 1))
      self.done += 1
      self._aim(physics)
    if self.done == self.targets:
      self.outcome = "success"
      return 1.0
    near = base.closeness(self.distance(physics), self.distance0)
    return progress(float(self.done), near, self.held / self.hold, float(self.targets))

  def instruct(self, physics: Physics) -> str:
    """Says where to press, and how much."""
    if self.distance(physics) > 2 * self.tolerance:
      return f"Go to the yellow site, {min(self.done + 1, self.targets)} of {self.targets}"
    level, (low, high) = self.level(physics), self.band
    if level < low:
      return "Press more"
    if level > high:
      return "Press less"
    return f"Hold it there for {max(self.hold - self.held, 0.0):.1f} s more"

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns target, normal, level and held."""
    return {
      "target": self.points[self.now] - physics.tip_pos(),
      "normal": physics.normal(self.goals[self.now]),
      "level": np.array([self.level(physics) - sum(self.band) / 2]),
      "held": np.array([self.held / self.hold]),
    }

  def reference_length(self) -> float:
    """Returns the length of the straight lines from site to site [m]."""
    return self._path

  def expert(self, p: Performer) -> Script:
    """Presses the sites one by one."""
    while self.done < self.targets:
      done, now = self.done, self.now
      point, normal = self.points[now], self.normals[now]
      if not (self._pressing and self.distance(p.physics) <= self.tolerance):
        yield from p.above(point, 0.008, normal)
      middle = sum(self.band) / 2

      def until(done: int = done) -> bool:
        return self.done > done

      if self.by_depth:
        yield from p.sink(middle, point, -normal, until)
      else:
        yield from p.push(middle, -normal, until, most=6.0)
      yield from p.move(point + 0.008 * normal)


def presses(on: bool, level: float, low: float, high: float, force: float) -> bool:
  """Returns whether a force [N] on the site counts, at a level of what the band is about."""
  return on and low <= level and level <= high and force > 0.02


def progress(done: float, near: float, held: float, sites: float) -> float:
  """Returns the progress of pressing; `near` is the closeness, `held` the share of the time."""
  return (done + 0.4 * near + 0.5 * held) / sites
