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
field that lies within 8 mm of where the probe has pressed with 0.1 N or more [-].
Progress: 0.3 * felt; on the report 1 or 0.
"""

import dataclasses

import numpy as np
from dm_control.utils import containers
from scipy.spatial import cKDTree

from . import base, scenes
from .base import Physics, Task
from .performer import Performer, Script
from .scenes import Scene
from .touch import SLACK, draw_apart

SUITE = containers.TaggedTasks()
KIDNEY = Scene(
  organ="kidney", center="anterior", port=(0.03, 0.045, 0.12), camera=(-0.05, 0.12, 0.1)
)
_FACING = 0.75  # least cosine between the field's normal and the way to the trocar
_PIN_GAP = 0.02  # the field keeps that far from pinned nodes [m]
PRESSES, LEAVES = 0.1, 0.02  # force above which a press begins, and below which it ends [N]
FEELING, FELT = 0.1, 0.008  # force [N] that feels, and what lies within that distance [m]
REPORT = 0.05  # least force at the report [N]
# Of the expert: how far above a place it begins, how deep it feels, and how far apart places to
# feel are, first and around what is stiff [m].
_ABOVE, _DEPTH, _SWEEP, _CLOSE = 0.004, 0.004, 0.014, 0.006
_ENOUGH = 0.7  # share of that depth that tells enough
_LIKELY = 0.05  # of the likeliest place: others are not felt [-]
_NOISE = 8.0  # of what it feels: triangles differ [N/m]
_STIFF = 1.3  # times what is soft: what is worth a closer look [-]


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


class Palpate(Task):
  """Find the stiff inclusion and report its place."""

  watch = ("miss", "unintended_contact")
  final = ("report",)

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
    self.embeds, self._inclusion = True, None
    self._fields: dict[int | None, tuple[np.ndarray, ...]] = {}
    if kwargs.get("model") is not None:
      raise ValueError(
        f"{name}: model is given, expected none: the organ is made with its inclusion"
      )
    kwargs = {"spread": 0.036, **kwargs}
    super().__init__(dataclasses.replace(scene, targets=1), random, **kwargs)

  @property
  def extra(self) -> tuple[str, ...]:
    """Names of the action's components that do not move the instrument."""
    return ("report",)

  def choose(self) -> int | None:
    """Draws shape and inclusion, evenly over the field; the organ is compiled anew with it."""
    variant = super().choose()
    if variant not in self._fields:
      self._fields[variant] = self._find_field(super()._scene(variant))
    self.field, self.places, corners, share, self.center = self._fields[variant]
    triangle = corners[self.random.choice(len(share), p=share)]
    self.inclusion = self.random.dirichlet(np.ones(3)) @ triangle
    if self.embeds:
      self._inclusion = (*(float(x) for x in self.inclusion), self.radius, self.factor)
      self._models.clear()
    return variant

  def leave_out(self) -> None:
    """Lets the organ be made without inclusions from now on, for whoever puts them in otherwise."""
    self.embeds, self._inclusion = False, (0.0, 0.0, 0.0, self.radius, 1.0)
    self._models.clear()

  def _find_field(self, scene: Scene) -> tuple[np.ndarray, ...]:
    """Returns the field's triangles, middles, corners, shares of its area, and the center."""
    vertices, triangles = scenes.surface(scene.organ, scene.nodes, scene.variant)
    center = scenes.landmark(scene, scene.center)
    corners = vertices[triangles]
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    port = np.asarray(scene.port) / np.linalg.norm(scene.port)
    middle = corners.mean(axis=1)
    pins = cKDTree(vertices[list(scenes.pins(scene.organ, scene.nodes, scene.variant))])
    near = np.linalg.norm(middle - center, axis=1) < self.spread
    near &= pins.query(middle)[0] > _PIN_GAP
    field = np.flatnonzero(near & (normal @ port > _FACING * area))
    return field, middle[field], corners[field], area[field] / area[field].sum(), center

  def _scene(self, variant: int | None) -> Scene:
    return dataclasses.replace(super()._scene(variant), inclusion=self._inclusion)

  def begin(self, physics: Physics) -> None:
    """Starts the search."""
    self._felt = np.zeros(len(self.field), bool)
    self._outward = physics.normals()[self.field]
    self._noted: dict[int, float] = {}
    self._deepest, self._depth = 0, 0.0
    physics.mark(0, self.center, shown=False)

  def felt(self) -> float:
    """Returns the share of the field that was felt [-]."""
    return float(self._felt.mean())

  def distance(self, physics: Physics) -> float:
    """Returns how far the tip is from the surface above the inclusion [m]."""
    return float(np.linalg.norm(physics.tip_pos() - self.inclusion))

  def advance(self, physics: Physics) -> float:
    """Follows what was felt, and judges the report."""
    force = float(np.linalg.norm(physics.contact_force()))
    if self.action[..., -1].max() > 0.5:
      distance = self.distance(physics)
      found = distance <= self.tolerance and force >= REPORT
      self.outcome = "success" if found else "missed"
      self.event(physics, "target" if found else "miss", distance, "report")
      physics.mark(0, self.inclusion, shown=True)
      return 1.0 if found else 0.0
    self._note(physics, force)
    if force >= FEELING:
      self._felt |= np.linalg.norm(self.places - physics.tip_pos(), axis=1) < FELT
    return 0.3 * self.felt()

  def _note(self, physics: Physics, force: float) -> None:
    """Notes what a press feels [N/m], for an expert who goes on where somebody else has felt."""
    if force < LEAVES:
      self._depth = 0.0
      return
    offset = self.places - physics.tip_pos()
    k = int(np.einsum("ij,ij->i", offset, offset).argmin())
    depth = float(offset[k] @ self._outward[k])
    if depth > max(self._depth, _ENOUGH * _DEPTH):
      if self._depth:
        self._noted.pop(self._deepest, None)
      self._deepest, self._depth, self._noted[k] = k, depth, force / depth

  def instruct(self, physics: Physics) -> str:
    """Says to feel, and to report."""
    share = f"{100 * self.felt():.0f} % of the field is felt"
    return f"Press here and there, and report where it is stiff while you press: {share}"

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns field and felt."""
    return {"field": self.center - physics.tip_pos(), "felt": np.array([self.felt()])}

  def expert(self, p: Performer) -> Script:
    """Feels over the field until something is stiff, then around it, and reports the middle.

    It knows where the organ's triangles are and presses their middles: on the coarse mesh corners
    feel stiffer. Where the inclusion is it learns from forces and depths alone.
    """
    normals = p.physics.normals()[self.field]
    felt = dict(self._noted)  # place -> stiffness [N/m]
    sweep = iter(self._left_out(felt))
    while (k := self._unsure(felt)) is not None or (k := next(sweep, None)) is not None:
      yield from self._hop(p, self.places[k] + _ABOVE * normals[k])
      felt[k] = yield from p.feel(self.places[k], -normals[k], _DEPTH)
      yield from p.line(self.places[k] + _ABOVE * normals[k], 0.03)
    k = self._guess(felt)
    yield from self._hop(p, self.places[k] + _ABOVE * normals[k])
    yield from p.feel(self.places[k], -normals[k], 0.5 * _DEPTH)
    yield from p.say()

  def _left_out(self, felt: dict[int, float]) -> list[int]:
    """Returns the places to sweep over, but for those that were felt."""
    spots, sweep = self.places[list(felt)], _lattice(self.places, self.center, _SWEEP)
    far = [np.linalg.norm(spots - self.places[k], axis=1).min(initial=np.inf) for k in sweep]
    return [k for k, away in zip(sweep, far, strict=True) if away > 0.5 * _SWEEP]

  def _unsure(self, felt: dict[int, float]) -> int | None:
    """Returns the place to feel for to be sure of what is stiff, None where nothing is, or all.

    The likeliest of those that nothing near was felt of: what is stiff at an edge of the field
    shows on one side alone.
    """
    stiffness = np.array(list(felt.values()))
    if not len(felt) or stiffness.max() < _STIFF * np.quantile(stiffness, 0.25):
      return None
    chance = self._chance(felt)
    spots = self.places[list(felt)]
    far = np.linalg.norm(self.places[:, None] - spots, axis=2).min(axis=1) > _CLOSE
    k = int((chance * far).argmax())
    return k if far[k] and chance[k] > _LIKELY * chance.max() else None

  def _guess(self, felt: dict[int, float]) -> int:
    """Returns the place nearest to where the inclusion is to be expected.

    The best fit alone may be a far one of several that are nearly as good.
    """
    chance = self._chance(felt)
    middle = chance @ self.places / chance.sum()
    return int(np.linalg.norm(self.places - middle, axis=1).argmin())

  def _chance(self, felt: dict[int, float]) -> np.ndarray:
    """Returns how likely the inclusion is under each place, against the likeliest [-]  (nplace,).

    As likely as a bell of stiffness on it, h exp(-(d/w)^2) above what is soft, fits what was felt.
    """
    stiffness = np.array(list(felt.values()))
    more = stiffness - np.quantile(stiffness, 0.25)
    distance = np.linalg.norm(self.places[:, None] - self.places[list(felt)], axis=2)
    bell = np.exp(-((distance / (1.2 * self.radius)) ** 2))
    height = np.maximum(bell @ more / np.maximum((bell**2).sum(axis=1), 1e-9), 0.0)
    error = ((more - height[:, None] * bell) ** 2).sum(axis=1)
    return np.exp((error.min() - error) / (2 * _NOISE**2))

  def _hop(self, p: Performer, goal: np.ndarray) -> Script:
    """Moves to a point, in an arch over the organ where it is far."""
    far = float(np.linalg.norm(goal - p.tip))
    if far > 0.025:
      yield from p.move((goal + p.tip) / 2 + 0.35 * far * p.physics.trocar().mat[:, 2])
    yield from p.move(goal)


def _lattice(points: np.ndarray, center: np.ndarray, gap: float) -> list[int]:
  """Returns points at least `gap` [m] apart, each the nearest to the last, from the center on."""
  chosen = [int(np.argmin(np.linalg.norm(points - center, axis=1)))]
  while True:
    distance = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
    left = np.flatnonzero(distance >= gap)
    if not len(left):
      return chosen
    near = np.linalg.norm(points[left] - points[chosen[-1]], axis=1)
    chosen.append(int(left[np.argmin(near)]))
