"""What the exercises of palpation in `probe` are: a field with a stiff inclusion under it.

A report succeeds that is right, made while pressing, and follows from what was felt: luck is none.
"""

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
import scipy
from palpate.models import shapes
from palpate.tissue.types import ints

from ...core import rules as r
from ...core import scenes
from ...core.base import Physics, Task
from ...core.performer import Performer, Script
from ...core.scenes import Scene
from . import feeling
from .feeling import APART, SHARED, SOFT, Notes, chance, nearest, press, sure

_FACING = 0.75  # least cosine between the field's normal and the way to the trocar
_PIN_GAP = 0.02  # the field keeps that far from pinned nodes [m]
FEELING, FELT = 0.1, 0.008  # force [N] that feels, and what lies within that distance [m]
REPORT = 0.05  # least force at the report [N]
# Of the expert: how far above a place it begins, how deep it feels, and how far apart places to
# feel are around what is stiff [m].
_ABOVE, _DEPTH, _CLOSE = 0.004, 0.004, 0.006
_LIKELY = 0.05  # of the likeliest place: others are not felt [-]
_STIFF = 1.3  # times what is soft: what is worth a closer look [-]


class State(Notes):
  """State of a world."""

  tolerance: float  # of the report [m]
  center: r.Vector  # of the field [m]
  inclusion: r.Vector  # where it is [m]
  touched: Annotated[Any, ints("nplace")]  # 1 where the probe has felt near a place
  field: r.Vector
  felt: float
  left: float
  target: r.Vector
  normal: r.Vector


# The rules.


def touch(o, here):
  """Notes what lies near as felt."""
  o.touched[np.linalg.norm(o.places - here, axis=1) < FELT] = 1
  o.felt = float(o.touched.mean())
  return o


@r.many(touch)
def _touch(o, here):
  count = int(0)
  for k in range(o.places.shape[0]):
    if r.length(o.places[k] - here) < FELT:
      o.touched[k] = 1
    count += o.touched[k]
  o.felt = float(count) / float(o.places.shape[0])
  return o


def advance(s, o):
  """Follows what was felt, and judges the report."""
  pressed, here = r.force(s), r.tip(s)
  if r.last_component(s, o) > 0.5:
    off = r.length(here - o.inclusion)
    if off <= o.tolerance and pressed >= REPORT and sure(o):
      r.reach(s, o, off)
      return o, 1.0, r.SUCCESS
    r.miss(s, o, off)
    return o, 0.0, r.MISSED
  o = press(o, here, pressed)
  if pressed >= FEELING:
    o = touch(o, here)
  return o, 0.3 * o.felt, r.RUNNING


def goal(o):
  """Returns where to feel next, or to report [m]."""
  if o.next < 0:
    return o.likely
  return o.places[o.next]


def observe(s, o):
  """Finds field, left, target and normal; felt is up to date."""
  here = r.tip(s)
  o.left = 1.0 if o.next >= 0 else 0.0
  o.field = o.center - here
  o.target = goal(o) - here
  o.normal = o.outward[nearest(o, goal(o))]
  return o


def mark(s, o, k):
  """Marks the inclusion, once it was reported."""
  return o.inclusion, r.LATER if r.ended(s, o) else r.HIDDEN


class Palpate(Task):
  """Find the stiff inclusion and report its place."""

  rules = r.Rules(
    State, advance, observe, ("field", "felt", "left", "target", "normal"), shared=SHARED, mark=mark
  )
  final = ("report",)

  def __init__(self, *, name: str, factor: float, radius: float, tolerance: float, **kwargs):
    """Makes the task.

    Args:
      name: domain and task
      factor: stiffness of the inclusion over that of the organ [-]
      radius: of the inclusion [m]
      tolerance: largest error of the report [m]
      **kwargs: see Task
    """
    self.targets = 1
    self.factor, self.radius, self.tolerance = factor, radius, tolerance
    self.embeds, self._inclusion = True, None
    self._fields: dict[int | None, tuple[np.ndarray, ...]] = {}
    if kwargs.get("model") is not None:
      raise ValueError(
        f"{name}: model is given, expected none: the organ is made with its inclusion"
      )
    super().__init__(name=name, **{"spread": 0.036, **kwargs})

  @property
  def extra(self) -> tuple[str, ...]:
    """Names of the action's components that do not move the instrument."""
    return ("report",)

  def choose(self) -> int | None:
    """Draws shape and inclusion, evenly over the field; the organ is compiled anew with it."""
    variant = super().choose()
    if variant not in self._fields:
      self._fields[variant] = self._find_field(super()._scene(variant))
    self.triangles, *where, corners, share, self.center = self._fields[variant]
    feeling.start(self, *where)
    triangle = corners[self.random.choice(len(share), p=share)]
    self.inclusion = self.random.dirichlet(np.ones(3)) @ triangle
    if self.embeds:
      self._inclusion = (*(float(x) for x in self.inclusion), self.radius, self.factor)
      self._models.clear()
    return variant

  def share(self) -> None:
    """Lets the organ be made without inclusions from now on: `tissue` has them."""
    self.embeds, self._inclusion = False, (0.0, 0.0, 0.0, self.radius, 1.0)
    self._models.clear()

  def _find_field(self, scene: Scene) -> tuple[np.ndarray, ...]:
    """Returns the field's triangles, middles, normals, sides, corners, shares of area; center."""
    vertices, triangles = scenes.surface(scene.organ, scene.nodes, scene.variant)
    center = scenes.landmark(scene, scene.center)
    corners = vertices[triangles]
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    port = np.asarray(scene.port) / np.linalg.norm(scene.port)
    middle = corners.mean(axis=1)
    pins = list(scenes.pins(scene.organ, scene.nodes, scene.variant))
    near = np.linalg.norm(middle - center, axis=1) < self.spread
    near &= scipy.spatial.KDTree(vertices[pins]).query(middle)[0] > _PIN_GAP
    field = np.flatnonzero(near & (normal @ port > _FACING * area))
    outward, share = normal[field] / area[field, None], area[field] / area[field].sum()
    beside = feeling.sides(middle[field], np.asarray(scene.port, float))
    return field, middle[field], outward, beside, corners[field], share, center

  def _scene(self, variant: int | None) -> Scene:
    return dataclasses.replace(super()._scene(variant), inclusion=self._inclusion)

  def tissue(self) -> Mapping[str, np.ndarray]:
    """Returns Young's modulus with the inclusion [Pa]."""
    scene = self.scene
    vertices, triangles = scenes.surface(scene.organ, scene.nodes, self.variants[0])
    young = scenes.TISSUES[scene.organ].young
    return {
      "young": shapes.inclusion_young(
        vertices, triangles, self.inclusion, self.radius, young, self.factor * young
      )
    }

  def begin(self, physics: Physics) -> None:
    """Starts the search."""
    self.touched, self.felt = np.zeros(self.nplace, int), 0.0

  def label(self, kind: str) -> str:
    """Returns what was done there, or why it failed."""
    return "reported a wrong place" if kind == "missed" else "report"

  def instruct(self, physics: Physics) -> str:
    """Says to feel, and to report."""
    share = f"{100 * self.felt:.0f} % of the field is felt"
    return f"Press here and there, and report where it is stiff while you press: {share}"

  def expert(self, p: Performer) -> Script:
    """Feels over the field until something is stiff, then around it, and reports the middle.

    It knows where the organ's triangles are and presses their middles: on the coarse mesh corners
    feel stiffer. Where the inclusion is it learns from forces and depths alone.
    """
    normals, felt = self.outward, feeling.felt(self)  # place -> stiffness [N/m]
    sweep = iter(self._left_out(felt))
    while (k := self._next(p, felt, sweep)) is not None:
      yield from self._hop(p, self.places[k] + _ABOVE * normals[k])
      felt[k] = yield from p.feel(self.places[k], -normals[k], _DEPTH)
      yield from p.line(self.places[k] + _ABOVE * normals[k], 0.03)
    # A hasty one goes by what is observed alone, which can be learned.
    goal = self.likely if p.hasty else self.places[self._guess(felt)]
    normal = normals[nearest(self, goal)]
    yield from self._hop(p, goal + _ABOVE * normal)
    yield from p.feel(goal, -normal, 0.5 * _DEPTH)
    yield from p.say()

  def _next(self, p: Performer, felt: dict[int, float], sweep: Iterator[int]) -> int | None:
    """Returns the place to feel next, None where enough is felt."""
    if p.hasty:
      return self.next if self.next >= 0 else None
    found = self._unsure(felt, _STIFF)
    if found is None:
      found = next(sweep, None)
    return self._unsure(felt) if found is None else found  # nothing was stiff enough in passing

  def _left_out(self, felt: dict[int, float]) -> list[int]:
    """Returns the places to sweep over but for those that were felt, from the last of these on."""
    sweep, spots = _lattice(self.places, self.center, APART), self.places[list(felt)]
    near = [
      bool(np.linalg.norm(spots - self.places[k], axis=1).min(initial=np.inf) < 0.5 * APART)
      for k in sweep
    ]
    first = max((i + 1 for i, done in enumerate(near) if done), default=0)
    order = [*range(first, len(sweep)), *range(first)]
    return [sweep[i] for i in order if not near[i]]

  def _unsure(self, felt: dict[int, float], stiff: float = 0.0) -> int | None:
    """Returns the place to feel for to be sure of what is stiff, None where nothing is, or all.

    Stiff is what is so many times stiffer than what is soft.

    The likeliest of those that nothing near was felt of: what is stiff at an edge of the field
    shows on one side alone.
    """
    if not felt or max(felt.values()) < stiff * _soft(felt):
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
    return nearest(self, middle)

  def _chance(self, felt: dict[int, float]) -> np.ndarray:
    more = np.array(list(felt.values())) - _soft(felt)
    return chance(self.places, np.array([*felt]), more, self.radius)

  def _hop(self, p: Performer, goal: np.ndarray) -> Script:
    """Moves to a point, in an arch over the organ where it is far."""
    far = float(np.linalg.norm(goal - p.tip))
    if far > 0.025:
      yield from p.move((goal + p.tip) / 2 + 0.35 * far * p.physics.trocar().mat[:, 2])
    yield from p.move(goal)


def _soft(felt: dict[int, float]) -> float:
  """Returns what counts as soft [N/m]."""
  return float(np.quantile(list(felt.values()), SOFT))


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
