"""The words of an expert that ties knots with two wristed needle drivers, see `knot`.

A side is 1 for the right hand and -1 for the left one, as its x.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from ...core.performer import Performer, Script
from ...core.rules import clamp
from .drain import PULL, STAYS
from .needles import between

# Where the thread is from the tip of jaws that hold it [m], actions of open jaws and of those that
# hold.
GRIP, OPEN, HOLD = 0.0025, -0.278, -0.76
# It winds on a circle about the jaws, from an angle that is 0 below them and 90 deg in front [rad],
# at a rate [rad/s], by a turn and so much more, and turns its jaws by so much at most [rad].
_CIRCLE, START, _RATE = 0.0085, math.radians(160.0), math.radians(130.0)
_MORE, _MOST = math.radians(60.0), math.radians(400.0)
# Where across the stitch and how far from the tip of the jaws it begins, how far it goes on towards
# the tip on its way below, past the thread that comes up, and with each turn [m].
_ACROSS, _BACK, _PAST, _LEAD = 0.003, 0.0085, 0.0048, 0.0003
# Pull that it winds with [N], thread that a turn takes [m], and how fast it gives way [m/s/N].
_WINDS, _TURN, _GIVES = 0.08, 0.0084, 0.02
# What both tails are drawn with, a little more than they are to bear [N]; fastest on the way [m/s].
_DRAWS, _FAST = 0.8, 0.012
_TRIES = 5  # at the short tail
# From where it takes the long tail, and how far its jaws turn on the way [m, rad].
_CLEAR, _BACKWARDS = 0.02, math.radians(135.0)
X, Y, Z = np.eye(3)


def _frame(back: np.ndarray, across: np.ndarray) -> np.ndarray:
  """Returns the frame of a tip whose jaws point away from one axis and open along another."""
  back = back / np.linalg.norm(back)
  across = across - (across @ back) * back
  across = across / np.linalg.norm(across)
  return np.column_stack([across, np.cross(back, across), back])


def flat(side: int) -> np.ndarray:
  """Returns the frame of jaws that point level to the other side."""
  return _frame(side * X, Y)


def facing(side: int, angle: float) -> np.ndarray:
  """Returns that of jaws that hold a thread which comes from an axis, at an angle about it."""
  return _frame(side * X, np.array([0.0, -math.cos(angle), math.sin(angle)]))


class Tie:
  """The words of an expert with two hands."""

  def __init__(self, task: Any, p: Performer):
    """Takes both hands."""
    assert p.other
    self.task, self.p, self.thread = task, p, p.physics.thread
    self.hand = {1: p, -1: p.other}
    self.dt = p.dt

  def held(self, side: int) -> int:
    """Returns the node that a hand holds."""
    hand = (1 - side) // 2
    return int(self.task.held[hand]) if self.task.firm[hand] else -1

  def pull(self, side: int) -> float:
    """Returns the tension of the strand that a hand holds, as it feels it [N]."""
    node, tension = self.held(side), self.thread.tension
    towards = slice(node + 5, node + 14) if 2 * node < len(tension) else slice(node - 10, node - 4)
    return float(np.median(tension[towards]))

  def step(self) -> np.ndarray:
    """Returns the action of both hands."""
    return np.concatenate([self.hand[1].step(), self.hand[-1].step()])

  def wait(self, duration: float) -> Script:
    """Holds still [s]."""
    for _ in range(round(duration / self.dt)):
      yield self.step()

  def go(
    self,
    duration: float,
    tips: Mapping[int, np.ndarray | Callable[[float], np.ndarray]],
    turns: Mapping[int, np.ndarray | Callable[[float], np.ndarray]] | None = None,
    limit: float = math.inf,
  ) -> Script:
    """Moves and turns tips, by side, in a time [s]; waits while the thread is too tight [N]."""
    begun = {side: (hand.tip.copy(), hand.turn) for side, hand in self.hand.items()}
    for t in self.p.shares(max(2, round(duration / self.dt / self.p.style.speed))):
      for _ in range(50):
        if self.task.tension < limit:
          break
        yield self.step()
      for side, goal in tips.items():
        start = begun[side][0]
        self.hand[side].tip = goal(t) if callable(goal) else start + t * (goal - start)
      for side, goal in (turns or {}).items():
        start = begun[side][1]
        self.hand[side].turn = goal(t) if callable(goal) else between(start, goal, t)
      yield self.step()

  def jaws(self, side: int, goal: float) -> Script:
    """Opens or closes jaws."""
    hand, most = self.hand[side], 2.0 * self.dt
    while hand.extra[0] != goal:
      hand.extra[0] = np.clip(goal, hand.extra[0] - most, hand.extra[0] + most)
      yield self.step()

  def catch(self, s: int, node: int) -> Script:
    """A hand takes the long tail at a node, turned so that it can wind it."""

    def place() -> np.ndarray:
      return self.thread.positions[node] - s * GRIP * X

    yield from self.jaws(s, OPEN)
    yield from self.go(1.0, {s: place() + s * _CLEAR * X}, {s: facing(s, START + _BACKWARDS)})
    yield from self.go(1.0, {}, {s: lambda t: facing(s, START + (1.0 - t) * _BACKWARDS)})
    yield from self.go(0.7, {s: place()})
    yield from self.jaws(s, HOLD)
    yield from self.wait(0.2)

  def wind(self, s: int, turns: int) -> Script:
    """A hand winds the long tail around the other's jaws.

    Both go towards the stitch as the turns take thread, by how hard the tail pulls.
    """
    winds, other = self.hand[s], self.hand[-s]

    def out(angle: float) -> np.ndarray:
      return np.array([0.0, -math.sin(angle), -math.cos(angle)])

    start, end = START, 2.0 * math.pi * turns + _MORE
    x = -s * _ACROSS
    tip = np.array([x + s * _BACK, 0.0, winds.tip[2] - 0.008])
    yield from self.go(0.8, {-s: tip - 0.02 * s * X + 0.004 * Y}, {-s: flat(-s)})
    yield from self.go(0.6, {-s: tip})
    yield from self.go(0.5, {s: tip + (x - tip[0] - s * GRIP) * X + _CIRCLE * out(start)})
    angle, high, share = start, tip[2], min(1.0, _MOST / (end - start))
    while angle < end:
      angle += _RATE * self.dt
      missing = float(np.clip(_WINDS - self.pull(s), -2.0, 0.15))
      high += (_GIVES * missing - _TURN * _RATE / (2.0 * math.pi)) * self.dt
      past = clamp((math.degrees(angle) - 210.0) / 110.0, 0.0, 1.0)
      lead = _PAST * past**2 * (3.0 - 2.0 * past) + _LEAD * (angle - start) / (2.0 * math.pi)
      other.tip = np.array([tip[0], 0.0, high])
      winds.tip = np.array([x + s * (lead - GRIP), 0.0, high]) + _CIRCLE * out(angle)
      winds.turn = facing(s, start + share * (angle - start))
      yield self.step()

  def draw(self, s: int) -> Script:
    """The hand that a tail was wound around by another takes the short one and draws it through."""
    winds, takes = self.hand[s], self.hand[-s]
    low = takes.tip - 0.006 * Z
    front = np.array([winds.tip[0] - takes.tip[0], -0.0085, -0.001])
    yield from self.go(0.5, {-s: low, s: low + front}, limit=0.15)
    yield from self.jaws(-s, OPEN)
    for _ in range(_TRIES):
      turn, _ = self._at_short_tail(s)
      for above, duration in ((0.008, 1.0), (0.0, 0.5)):
        goal = self._at_short_tail(s)[1] + above * turn[:, 2]
        # The loops are 5 mm from the tip, and go where they are.
        move = goal - takes.tip + 0.005 * (turn - takes.turn)[:, 2]
        yield from self.go(duration, {-s: goal, s: winds.tip + move}, {-s: turn})
      yield from self.jaws(-s, HOLD)
      yield from self.wait(0.1)
      if self.held(-s) >= 0:
        break
      yield from self.jaws(-s, OPEN)
    for duration, mine, others in (
      (0.8, (0.002, -0.01, 0.014), (0.004, 0.0, 0.013)),
      (1.2, (0.012, -0.008, 0.012), (-0.01, 0.0, 0.01)),
      (1.0, (0.02, -0.003, 0.01), (-0.012, 0.0, 0.01)),
    ):
      goals = {s: np.array(mine) * (s, 1, 1), -s: np.array(others) * (s, 1, 1)}
      yield from self.go(duration, goals, {-s: flat(-s)}, limit=PULL)

  def _at_short_tail(self, s: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the frame and the place of a tip across the short tail, near its end."""
    places = self.thread.positions
    along = places[-4] - places[-14]
    along /= np.linalg.norm(along)
    back = np.array([-0.5 * s, 0.0, 0.87])
    back -= (back @ along) * along
    across = np.cross(along, back)
    turn = _frame(back, across if across[1] > 0.0 else -across)
    return turn, places[-8] - GRIP * turn[:, 2]

  def tighten(self, s: int) -> Script:
    """Draws both tails apart, level, until they are tight."""
    for _ in range(400):
      pulls = {side: self.pull(side) for side in (s, -s)}
      for side, pull in pulls.items():
        speed = float(np.clip(0.02 * (_DRAWS - pull), -0.3 * _FAST, _FAST))
        self.hand[side].tip = self.hand[side].tip + speed * self.dt * side * X
      yield self.step()
      if min(pulls.values()) > 0.9 * _DRAWS:
        break
    yield from self.wait(2.0 * STAYS)
