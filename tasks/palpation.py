"""What the exercises of palpation in `probe` are: a field with a stiff inclusion under it."""

import dataclasses
from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree

from . import scenes
from .base import Physics, Task
from .performer import Performer, Script
from .scenes import Scene

_LEFT = 0.02  # force below which a press has ended [N]
_FACING = 0.75  # least cosine between the field's normal and the way to the trocar
_PIN_GAP = 0.02  # the field keeps that far from pinned nodes [m]
FEELING, FELT = 0.1, 0.008  # force [N] that feels, and what lies within that distance [m]
REPORT = 0.05  # least force at the report [N]
# Of the expert: how far above a place it begins, how deep it feels, and how far apart places to
# feel are, first and around what is stiff [m].
_ABOVE, _DEPTH, _SWEEP, _CLOSE = 0.004, 0.004, 0.014, 0.006
_ENOUGH = 0.7  # share of that depth that tells enough
_LIKELY = 0.05  # of the likeliest place: others are not felt [-]
_NOISE = 8.0  # of what it feels: triangles differ [N/m]
_STIFF = 1.3  # times what is soft: what is worth a closer look [-]
# Of a hasty one: times what is soft, among so many places, that it looks around; how far [m].
_SURE, _SOME, _BESIDE = 1.6, 4, 0.008


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
    if force < _LEFT:
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
    while (k := self._next(p, felt, sweep)) is not None:
      yield from self._hop(p, self.places[k] + _ABOVE * normals[k])
      felt[k] = yield from p.feel(self.places[k], -normals[k], _DEPTH)
      yield from p.line(self.places[k] + _ABOVE * normals[k], 0.03)
    k = self._guess(felt)
    yield from self._hop(p, self.places[k] + _ABOVE * normals[k])
    yield from p.feel(self.places[k], -normals[k], 0.5 * _DEPTH)
    yield from p.say()

  def _next(self, p: Performer, felt: dict[int, float], sweep: Iterator[int]) -> int | None:
    """Returns the place to feel next, None where enough is felt."""
    if p.hasty and self._sure(felt):
      return self._neighbour(p, felt)
    found = None if p.hasty else self._unsure(felt)
    return next(sweep, None) if found is None else found

  def _left_out(self, felt: dict[int, float]) -> list[int]:
    """Returns the places to sweep over but for those that were felt, from the last of these on."""
    sweep, spots = _lattice(self.places, self.center, _SWEEP), self.places[list(felt)]
    near = [
      bool(np.linalg.norm(spots - self.places[k], axis=1).min(initial=np.inf) < 0.5 * _SWEEP)
      for k in sweep
    ]
    first = max((i + 1 for i, done in enumerate(near) if done), default=0)
    order = [*range(first, len(sweep)), *range(first)]
    return [sweep[i] for i in order if not near[i]]

  def _neighbour(self, p: Performer, felt: dict[int, float]) -> int | None:
    """Returns a place beside the stiffest, to the four sides of it; None where all are felt."""
    across, top = p.physics.trocar().mat[:, :2].T, self.places[max(felt, key=lambda k: felt[k])]
    for way in (*across, *-across):
      goal = top + _BESIDE * way
      k = int(np.linalg.norm(self.places - goal, axis=1).argmin())
      far = np.linalg.norm(self.places[[*felt]] - self.places[k], axis=1).min()
      if np.linalg.norm(self.places[k] - goal) < 0.5 * _BESIDE and far > 0.5 * _BESIDE:
        return k
    return None

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

  def _sure(self, felt: dict[int, float]) -> bool:
    """Returns whether something is so stiff, among enough places, that no more need be felt."""
    stiffness = np.array(list(felt.values()))
    return len(felt) >= _SOME and stiffness.max() > _SURE * np.quantile(stiffness, 0.25)

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
