"""What exercises share that tie a knot on the slit drain: what they look at, and its test."""

from collections.abc import Sequence

import numpy as np

from ...core.base import Physics, Task
from ...core.scenes import Scene
from ...metrics import knots
from . import drain
from .drain import MIDDLE

CLOSED = 0.001  # gap of a slit that is [m], as FLS asks for
EDGE = 4.5e-4  # of the thread, four of its radii [m]
PULL = 0.6  # that strands are drawn with, and that a knot is to hold [N]
STAYS = 0.3  # how long a throw is to stay down [s]
_LET_GO = 0.3  # strands lie so long before the knot is tested [s]
_LAST, _RISES = 2.0, 2.0  # the last pull of the test [N], and its rise [N/s]


class Tying(Task):
  """An exercise that ties a knot.

  Attributes:
    turns: how often the strands wind about each other in each throw
    throws: how many these are
    tension: the largest of the thread [N]
    gap: of the slit now [m]
    left: of the slit before the knot was pulled at [m]
    pulled: pull of the test now [N]
    held: the largest so far at which the slit gaped less than unsewn [N]
    free: how long the strands have been free [s]
    knot: name of what was tied
  """

  settles = drain.SETTLES

  def __init__(self, scene: Scene, random=None, *, turns: Sequence[int], **kwargs):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      turns: how often the strands wind about each other in each throw, (1, 1) of a square knot,
        (2, 1, 1) of a surgeon's
      **kwargs: see Task
    """
    self.turns, self.throws = tuple(turns), len(turns)
    super().__init__(scene, random, **kwargs)

  def place_of_work(self, physics: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Returns all of the drain, and the middle of the stitch."""
    return np.arange(len(physics.organ.elem)), MIDDLE

  def begin(self, physics: Physics) -> None:
    """Nothing is tied."""
    self.gap = self.left = drain.GAPE
    self.seated, self.stayed, self.free = 0, 0.0, 0.0
    self.tension = self.pulled = self.held = 0.0
    self.knot = ""

  def look(self, physics: Physics) -> None:
    """Finds the gap, the tension, and whether the thread is whole and in its holes."""
    assert physics.thread
    self.tension = float(physics.thread.tension.max())
    self.broken = bool(physics.thread.broken.any())
    self.whole = len(physics.organ.pinholes) == 2
    if self.whole:
      self.gap = drain.gap(physics.nodes(), self.scene.nodes)

  def lost(self, physics: Physics) -> bool:
    """Returns whether the thread is broken or out of the drain: the exercise has failed then."""
    if not self.broken and self.whole:
      return False
    self.outcome = "damage"
    self.event(physics, "note", label="thread broken" if self.broken else "torn out of the drain")
    return True

  def hands(self) -> tuple[int, ...]:
    """Returns of which hand the first throw may be, 1 right and -1 left."""
    return (1, -1)

  def judge(self, physics: Physics) -> float:
    """Pulls the stitch apart, whose strands are free: is the knot right, and does it hold?"""
    if self.throws == 1:
      self.outcome = "success"
      return 1.0
    if not self.pulled:
      self.left = self.gap
    if self.gap < drain.GAPE:
      self.held = self.pulled
    gapes = self.left > CLOSED and self.free > _LET_GO - 1e-6
    if gapes or self.gap > drain.GAPE or self.pulled == _LAST:
      assert physics.thread
      places = self.loop(physics.thread.positions)
      self.knot = knots.name(places)
      found = sorted(knots.throws(places) or ())
      wound = [(-1) ** k * turns for k, turns in enumerate(self.turns)]
      right = found in [sorted(-hand * turns for turns in wound) for hand in self.hands()]
      if right and self.held > PULL - 1e-6:
        self.outcome = "success"
        return 1.0
      self.outcome = "missed"
      self.event(physics, "note", label="the knot did not hold" if right else "a wrong knot")
      return 0.95
    self.free += self.control_timestep
    self.pulled = float(np.clip(_RISES * (self.free - _LET_GO), 0.0, _LAST))
    drain.part(physics.organ, self.scene.nodes, self.pulled)
    return 0.95

  def loop(self, places: np.ndarray) -> np.ndarray:
    """Returns the closed polygon of the thread, by whose knot it is named."""
    return knots.closed(places)

  def recorded(self, physics: Physics) -> dict[str, float]:
    """Returns gap, tension and the pull on the drain."""
    pull = float(np.linalg.norm(physics.organ.needles[0].force))
    gap = self.left if self.pulled else self.gap
    found = {"traction": pull, "gap": gap, "tension": self.tension}
    return found | ({"security": self.held} if self.throws > 1 else {})
