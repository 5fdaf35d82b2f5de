"""Probe: press sites on the liver to a force or depth and hold, or find what is stiff by touch.

Pressing (`easy`, `standard`, `hard`, `depth`). Own observations: `target` (3,), from the tip to the
site [m]; `normal` (3,), of the surface there [-]; `level` (1,), the pressed force [N] (or
depth [m]) minus the middle of the band; `held` (1,), share of the holding time done [-].
Progress: (sites done + 0.4 * closeness + 0.5 * held) / sites, closeness counting from the site
before. Pressing counts within the tolerance of the site; leaving the band starts the holding again.

Palpation (`palpate_easy`, `palpate_standard`, `palpate_hard`): a stiff inclusion lies under the
kidney's front, within 22 mm of its middle. It can be felt, not seen: reporting it (action
`report` above 0.5) ends the episode, with success when the tip is within the tolerance of it. No
own observations. Progress: 0.5 * max(closeness, 0) while the probe presses, 1 on success.
"""

import dataclasses

import numpy as np
from dm_control.utils import containers

from . import base, scenes
from .base import Physics, Task
from .performer import Performer, Script
from .scenes import Scene
from .touch import draw_apart

SUITE = containers.TaggedTasks()
KIDNEY = Scene(
  organ="kidney", center="anterior", port=(0.03, 0.045, 0.12), camera=(-0.05, 0.12, 0.1)
)


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
  """Returns the task to find an inclusion ten times as stiff, within 12 mm."""
  kwargs = {"factor": 10.0, "radius": 0.012, "tolerance": 0.012, **kwargs}
  task = Palpate(
    dataclasses.replace(KIDNEY, nodes=250), random, name="probe/palpate_easy", **kwargs
  )
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking")
def palpate_standard(time_limit=60, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to find an inclusion eight times as stiff, within 10 mm."""
  kwargs = {"factor": 8.0, "radius": 0.01, "tolerance": 0.01, "jitter": 0.003, **kwargs}
  scene = dataclasses.replace(KIDNEY, nodes=500)
  task = Palpate(scene, random, name="probe/palpate_standard", **kwargs)
  return base.make(task, time_limit, environment_kwargs)


@SUITE.add("benchmarking", "hard")
def palpate_hard(time_limit=60, random=None, environment_kwargs=None, **kwargs):
  """Returns the task to find an inclusion five times as stiff, within 8 mm, on varying kidneys."""
  kwargs = {"factor": 5.0, "radius": 0.009, "tolerance": 0.008, "jitter": 0.005, **kwargs}
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
    if force > 0.1 and not self._pressing and not on_site:
      self.event(physics, "miss", self.distance(physics))
    self._pressing = force > (0.02 if self._pressing else 0.1)
    low, high = self.band
    inside = on_site and low <= self.level(physics) <= high and force > 0.02
    self.held = self.held + self.control_timestep if inside else 0.0
    if self.held >= self.hold - 1e-9:
      self.event(physics, "target", self.distance(physics), str(self.done + 1))
      self.done += 1
      self._aim(physics)
    if self.done == self.targets:
      self.outcome = "success"
      return 1.0
    near = base.closeness(self.distance(physics), self.distance0)
    return (self.done + 0.4 * near + 0.5 * self.held / self.hold) / self.targets

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
      yield from p.move(point + 0.008 * normal)
      middle = sum(self.band) / 2

      def until(done: int = done) -> bool:
        return self.done > done

      if self.by_depth:
        yield from p.sink(middle, point, -normal, until)
      else:
        yield from p.push(middle, -normal, until, most=6.0)
      yield from p.move(point + 0.008 * normal)


class Palpate(Task):
  """Find the stiff inclusion and report its place."""

  watch = ("miss", "unintended_contact")

  def __init__(
    self,
    scene: Scene,
    random=None,
    *,
    name: str,
    factor: float,
    radius: float,
    tolerance: float,
    **kwargs,
  ):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      name: domain and task
      factor: stiffness of the inclusion over that of the organ [-]
      radius: of the inclusion [m]
      tolerance: largest error of the report [m]
      **kwargs: see Task
    """
    self.name, self.targets = name, 1
    self.factor, self.radius, self.tolerance = factor, radius, tolerance
    self._inclusion: tuple[float, ...] | None = None
    if kwargs.get("model") is not None:
      raise ValueError(
        f"{name}: model is given, expected none: the organ is made with its inclusion"
      )
    kwargs = {"spread": 0.022, **kwargs}
    super().__init__(dataclasses.replace(scene, targets=1), random, **kwargs)

  @property
  def components(self) -> tuple[str, ...]:
    """Names of the action's components."""
    return (*base.AXES, "report")

  def choose(self) -> int | None:
    """Draws shape and inclusion; the organ is compiled anew with it."""
    variant = super().choose()
    vertices, triangles = scenes.surface(self.scene.organ, self.scene.nodes, variant)
    center = scenes.landmark(dataclasses.replace(self.scene, variant=variant), self.scene.center)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    normal = np.cross(b - a, c - a)
    facing = normal @ np.asarray(self.scene.port) / np.linalg.norm(normal, axis=1)
    middle = vertices[triangles].mean(axis=1)
    near = np.linalg.norm(middle - center, axis=1) < self.spread
    self.field = np.flatnonzero(near & (facing > 0.85 * np.linalg.norm(self.scene.port)))
    self.center = center
    self.inclusion = middle[self.random.choice(self.field)]
    inclusion = (*(float(x) for x in self.inclusion), self.radius, self.factor)
    if inclusion != self._inclusion or variant not in self._models:
      self._inclusion = inclusion
      self._models.clear()
    return variant

  def _scene(self, variant: int | None) -> Scene:
    return dataclasses.replace(super()._scene(variant), inclusion=self._inclusion)

  def begin(self, physics: Physics) -> None:
    """Starts the search."""
    physics.mark(0, self.inclusion, shown=False)
    self.distance0 = self.distance(physics)

  def distance(self, physics: Physics) -> float:
    """Returns how far the tip is from the surface above the inclusion [m]."""
    return float(np.linalg.norm(physics.tip_pos() - self.inclusion))

  def advance(self, physics: Physics) -> float:
    """Judges the report."""
    if self.action[4] > 0.5:
      distance = self.distance(physics)
      found = distance <= self.tolerance
      self.outcome = "success" if found else "missed"
      self.event(physics, "target" if found else "miss", distance, "report")
      physics.mark(0, self.inclusion, shown=True)
      return 1.0 if found else 0.0
    if np.linalg.norm(physics.contact_force()) < 0.05:
      return 0.0
    return 0.5 * max(base.closeness(self.distance(physics), self.distance0), 0.0)

  def expert(self, p: Performer) -> Script:
    """Feels all over the field, then closer around the stiffest place, and reports that."""
    physics = p.physics
    place, center = self.field, self.center
    middle = physics.organ.xpos0[physics.organ.elem].mean(axis=1)[place]
    normals = physics.normals()[place]
    spots, stiffness = [], []

    def feel(point: np.ndarray) -> Script:
      k = int(np.argmin(np.linalg.norm(middle - point, axis=1)))
      yield from p.move(middle[k] + 0.005 * normals[k])
      end = physics.time() + 0.9
      peak = [0.0]

      def done() -> bool:
        peak[0] = float(np.linalg.norm(physics.contact_force()))
        return physics.time() > end

      yield from p.sink(0.004, middle[k], -normals[k], done)
      spots.append(middle[k])
      stiffness.append(peak[0])
      yield from p.move(middle[k] + 0.005 * normals[k])

    for point in _lattice(middle, center, 0.0115):
      yield from feel(point)
    for _ in range(2):  # look closer around the stiffest place
      guess = _stiffest(np.array(spots), np.array(stiffness))
      away = np.linalg.norm(middle - guess, axis=1)
      far = np.linalg.norm(middle[:, None] - np.array(spots), axis=2).min(axis=1)
      for _ in range(3):
        point = middle[np.argmax(np.where(away < 0.012, far, -1.0))]
        yield from feel(point)
        far = np.minimum(far, np.linalg.norm(middle - spots[-1], axis=1))
    guess = _stiffest(np.array(spots), np.array(stiffness))
    k = int(np.argmin(np.linalg.norm(middle - guess, axis=1)))
    yield from p.move(middle[k] + 0.003 * normals[k])
    yield from p.move(middle[k])
    yield from p.wait(0.1)
    p.extra[:] = 1.0
    yield p.step()


def _lattice(points: np.ndarray, center: np.ndarray, gap: float) -> list[np.ndarray]:
  """Returns points at least `gap` apart, from the center outward in a spiral's order."""
  chosen = [points[np.argmin(np.linalg.norm(points - center, axis=1))]]
  while True:
    distance = np.linalg.norm(points[:, None] - np.array(chosen), axis=2).min(axis=1)
    left = np.flatnonzero(distance >= gap)
    if not len(left):
      return chosen
    near = np.linalg.norm(points[left] - chosen[-1], axis=1)
    chosen.append(points[left[np.argmin(near)]])


def _stiffest(spots: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
  """Returns where the force at one depth is largest: the mean of its neighbourhood's excess."""
  # The smooth maximum counts every spot's neighbours within 10 mm.
  weight = np.exp(-((np.linalg.norm(spots[:, None] - spots, axis=2) / 0.01) ** 2))
  smooth = weight @ stiffness / weight.sum(axis=1)
  best = spots[np.argmax(smooth)]
  near = np.linalg.norm(spots - best, axis=1) < 0.018
  excess = np.clip(stiffness - np.median(stiffness), 0, None) ** 1.5 * near
  return (excess[:, None] * spots).sum(axis=0) / max(excess.sum(), 1e-12)
