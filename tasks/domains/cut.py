"""Cut: cut out a marked piece of a sheet of tissue with a scalpel, along its line.

Own observations: `target` (3,), from the tip to the next point of the line [m]; `ahead` (3, 3),
from the tip to points 5, 10 and 15 mm further along the line [m]; `covered` (1,), share of the line
that is cut [-]; `deviation` (1,), largest distance of the cut from the line so far [m].

Progress: 0.1 * closeness to the line, at its best, + 0.9 * share of the line that is cut. A point
of the line is cut where the edge has gone through the wall within the tolerance of it; moving
along without cutting counts nothing. Success: 98 % of it, and the piece is free, or 6 mm more are
cut than the line is long: the mesh may hang together by an edge. Failure: more than
10 mm cut farther from the line than the tolerance, a force above the damage limit, or the time
limit.

That is the pattern cut of FLS: a circle of 4 cm, and all of the cut within 2 mm of the line (Ritter
and Scott 2007, 10.1177/1553350607302329), with a scalpel in place of scissors and a grasper.
"""

import dataclasses

import mujoco
import numpy as np

from ..base import Physics, Task
from ..core.rules import closeness
from ..performer import Performer, Script
from ..registry import exercise
from ..scenes import Scene
from . import sheet

SCENE = Scene(
  organ="sheet",
  instrument="scalpel",
  port=(0.0, -0.025, 0.12),
  camera=(-0.03, -0.07, 0.09),
)
RULE = 0.002  # [m], of FLS
ASTRAY = 0.01  # most that may be cut beyond the tolerance [m]
COVERED = 0.98  # share of the line that is to be cut
CLOSING = 0.006  # length that is cut beyond that of the line where the piece counts as free [m]
STEP = 0.001  # between points of the line [m]
AHEAD = (5, 10, 15)  # points further on that are observed
_MARKS = 36  # spheres that draw the line
LEAP = 10  # points of the line between two control steps that do not follow one another
# Of the expert: how fast it cuts [m/s], and how deep the tip is under the sheet and over it [m].
_SPEED, _DEEP, _OVER = 0.012, 0.0035, 0.012
_BEYOND = 10  # points of the line that it goes on beyond where it began


@exercise("cut/easy", 40, "easy")
def easy(**kwargs):
  """Cut out a circle of 24 mm within 3 mm of its line."""
  kwargs = {"radius": 0.012, "tolerance": 0.003, **kwargs}
  return Cut(dataclasses.replace(SCENE, nodes=400), **kwargs)


@exercise("cut/standard", 60)
def standard(**kwargs):
  """Cut out a circle of 40 mm within 2 mm, as FLS asks for."""
  kwargs = {"radius": 0.02, "jitter": 0.003, **kwargs}
  return Cut(dataclasses.replace(SCENE, nodes=600), **kwargs)


@exercise("cut/hard", 80, "hard")
def hard(**kwargs):
  """Cut out a clover of 36 mm within 1.5 mm."""
  kwargs = {"radius": 0.018, "wave": 0.2, "tolerance": 0.0015, "jitter": 0.005, **kwargs}
  return Cut(dataclasses.replace(SCENE, nodes=1000), **kwargs)


def line(radius: float, wave: float, start: float) -> tuple[np.ndarray, float]:
  """Returns points of the line around the middle, (n, 3), and its length [m].

  Args:
    radius: mean radius [m]
    wave: by how much that comes and goes, three times around [-]
    start: angle at which it begins [rad]
  """
  angle = start + np.linspace(0, 2 * np.pi, 721)
  far = radius * (1 + wave * np.cos(3 * angle))
  fine = np.stack([far * np.cos(angle), far * np.sin(angle), 0.0 * angle], axis=1)
  arc = np.concatenate([[0.0], np.linalg.norm(np.diff(fine, axis=0), axis=1).cumsum()])
  way = np.linspace(0.0, arc[-1], round(arc[-1] / STEP) + 1)[:-1]
  return np.stack([np.interp(way, arc, column) for column in fine.T], axis=1), float(arc[-1])


class Cut(Task):
  """Cut out a marked piece.

  Attributes:
    cut: which points of the line are cut           (n,) bool
    opened: length that was cut so far [m]
    astray: length of that beyond the tolerance [m]
    jagged: length of that more than 2 mm from the line [m]
    excess: area between cut and line [m^2]
    deviation: mean distance of the cut from the line [m]
    farthest: largest [m]
  """

  watch = ("miss", "unintended_contact")

  def __init__(
    self,
    scene: Scene,
    random=None,
    *,
    name: str,
    radius: float,
    wave: float = 0.0,
    tolerance: float = RULE,
    **kwargs,
  ):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      name: domain and task
      radius: of the line [m]
      wave: by how much that comes and goes, three times around [-]
      tolerance: largest distance of the cut from the line [m]
      **kwargs: see Task
    """
    self.targets = _MARKS
    if not 0.005 <= radius * (1 + abs(wave)) <= 0.024:
      raise ValueError(
        f"{name}: radius is {radius} and wave {wave}, expected a line from 5 to 24 mm of the middle"
      )
    if not 0 < tolerance < radius:
      raise ValueError(f"{name}: tolerance is {tolerance}, expected a number in (0, {radius})")
    self.radius, self.wave, self.tolerance = radius, wave, tolerance
    kwargs = {"force_limit": 0.8, "damage": 2.0, **kwargs}
    super().__init__(dataclasses.replace(scene, targets=_MARKS), random, name=name, **kwargs)

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene, which has no other shapes."""
    return sheet.build(self._scene(variant))

  def place_of_work(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns the triangles, and the middle of the sheet [m]."""
    return np.arange(len(physics.organ.elem)), np.zeros(3)

  def begin(self, physics: Physics) -> None:
    """Draws the line, which begins anywhere on it."""
    self.curve, self.length = line(self.radius, self.wave, self.random.uniform(0, 2 * np.pi))
    self.cut = np.zeros(len(self.curve), bool)
    self.opened = self.astray = self.jagged = self.excess = self.farthest = 0.0
    self._seat: np.ndarray | None = None
    self._last = physics.organ.cutters[0].length
    self.nearest, self.distance0 = 0.0, self.distance(physics)
    for i, k in enumerate(np.linspace(0, len(self.curve), _MARKS, endpoint=False).astype(int)):
      physics.mark(i, self.curve[k] + [0.0, 0.0, 0.0006], size=0.0009)

  @property
  def deviation(self) -> float:
    """Mean distance of the cut from the line so far [m]."""
    return self.excess / self.opened if self.opened else 0.0

  @property
  def next(self) -> int:
    """The first point of the line that is not cut, after those that are."""
    if not self.cut.any() or self.cut.all():
      return 0
    return int(np.flatnonzero(~self.cut & np.roll(self.cut, 1))[0])

  def distance(self, physics: Physics) -> float:
    """Returns how far the tip is from the next point of the line [m]."""
    return float(np.linalg.norm(self.curve[self.next] - physics.tip_pos()))

  def advance(self, physics: Physics) -> float:
    """Follows the edge through the tissue."""
    (cutter,) = physics.organ.cutters
    more, self._last = cutter.length - self._last, cutter.length
    seat = cutter.seat if cutter.inside else None
    if more > 0 and seat is not None:
      self._open(physics, self._seat if self._seat is not None else seat, seat, more)
    self._seat = seat
    share = float(self.cut.mean())
    if self.astray > ASTRAY:
      self.outcome = "damage"
      self.event(physics, "note", label=f"{1e3 * self.astray:.0f} mm are cut beside the line")
      return -1.0
    closed = self.opened > self.length + CLOSING
    if share >= COVERED and (closed or len(physics.organ.pieces) > 1):
      self.outcome = "success"
      return 1.0
    self.nearest = max(self.nearest, closeness(self.distance(physics), self.distance0))
    return 0.1 * self.nearest + 0.9 * share

  def _open(self, physics: Physics, start: np.ndarray, end: np.ndarray, length: float) -> None:
    """Counts a piece of the cut, between two places at rest [m]."""
    far = np.linalg.norm(self.curve[:, None, :2] - np.stack([start, end])[:, :2], axis=2)
    first, last = far.argmin(axis=0)
    off = float(far[last, 1])
    beside, count = off > self.tolerance, len(self.curve)
    if beside and not self._beside(start):
      self.event(physics, "miss", off)
    self.opened += length
    self.excess += off * length
    self.farthest = max(self.farthest, off)
    self.jagged += length * (off > RULE)
    self.astray += length * beside
    if beside:
      return
    way = (last - first + count // 2) % count - count // 2
    between = np.arange(min(0, way), max(0, way) + 1) if abs(way) <= LEAP else np.array([way])
    self.cut[(first + between) % count] = True

  def _beside(self, place: np.ndarray) -> bool:
    return bool(np.linalg.norm(self.curve[:, :2] - place[:2], axis=1).min() > self.tolerance)

  def instruct(self, physics: Physics) -> str:
    """Says to begin, or to go on."""
    if not self.opened:
      return "Push the tip of the blade through the line"
    return f"Cut along the line: {100 * self.cut.mean():.0f} % done"

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns target, ahead, covered and deviation."""
    further = [(self.next + k) % len(self.curve) for k in AHEAD]
    return {
      "target": self.curve[self.next] - physics.tip_pos(),
      "ahead": self.curve[further] - physics.tip_pos(),
      "covered": np.array([float(self.cut.mean())]),
      "deviation": np.array([self.farthest]),
    }

  def recorded(self, physics: Physics) -> dict[str, float]:
    """Returns how the cut is so far."""
    own = {"deviation": self.deviation, "farthest": self.farthest}
    own |= {"excess": self.excess, "jagged": self.jagged}
    return dict(super().recorded(physics)) | own

  def constants(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns the line to cut [m]."""
    return {"line": self.curve}

  def reference_length(self) -> float:
    """Returns the length of the line and of the way to it [m]."""
    return self.length + self.distance0

  def _goes_on(self, physics: Physics) -> bool:
    """Returns whether somebody else was cutting along the line."""
    (cutter,) = physics.organ.cutters
    off = np.linalg.norm(self.curve[self.next] - cutter.seat) if cutter.inside else np.inf
    return bool(off < 2 * self.tolerance)

  def expert(self, p: Performer) -> Script:
    """Goes through the sheet and around, a little beyond where it began."""
    physics, up, count = p.physics, np.array([0.0, 0.0, 1.0]), len(self.curve)
    port = physics.trocar().pos

    def under(place: np.ndarray, deep: float) -> np.ndarray:
      """Returns where the tip is when the blade goes through a place [m]."""
      return place + deep / np.linalg.norm(place - port) * (place - port)

    while self.outcome is None:
      start = self.next
      if not self._goes_on(physics):
        yield from p.move(self.curve[start] + _OVER * up)
      yield from p.line(under(self.curve[start], _DEEP), speed=0.02)
      for _ in range(100):  # the sheet gives before it is pierced
        if physics.organ.cutters[0].inside:
          break
        p.tip = p.tip - 0.01 * self.control_timestep * up
        yield p.step()
      yield from p.line(under(self.curve[start], _DEEP), speed=0.02)
      at, time = float(start), 0.0
      while self.outcome is None and at < start + count + _BEYOND:
        time += self.control_timestep
        at += _SPEED * p.style.speed * self.control_timestep / STEP
        k, share = int(at), at % 1
        rest = (1 - share) * self.curve[k % count] + share * self.curve[(k + 1) % count]
        out = rest / np.linalg.norm(rest)
        wander = p.style.detour * 0.002 * np.sin(2.5 * time)
        wander += p.style.overshoot * 0.003 * np.sin(4 * time)
        deep = _DEEP * (1 + 0.3 * (p.style.force - 1))
        p.tip = under(rest + wander * out, deep)
        yield p.step()
      yield from p.move(p.tip + (_OVER + _DEEP) * up, speed=0.03)
