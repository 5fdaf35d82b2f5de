"""Knot: tie a throw inside the body, on a slit Penrose drain, with two wristed needle drivers.

FLS task 5, once the needle is through, up to its first throw. The thread goes through the marks of
the drain, see `drain`: its short tail stands free on the right, its long one is in the right hand.
One hand winds the long tail around the other's jaws, once or twice, which take the short tail and
draw it through; both hands draw the throw down. Further throws are not in it: outside of its holes
the thread does not meet the drain, and throws slide along a tail that is taut before the other one,
past both holes. Pulled apart, the slit then is held by the friction of the holes alone.

Jaws that press on the thread hold it: an equality joins them to the node that is between them.
Threads meet the jaws as round, smooth bodies, on which a loop slides off: the inserts, whose
friction holds a thread, have corners.

Own observations, in the world: `short` (3,) and `long` (3,), from the right tip to the ends of both
tails [m]; `stitch` (3,), from there to the middle of the stitch [m]; `gap` (1,), of the slit [m];
`tension` (1,), the largest of the thread [N]; `tied` (1,), whether the thread has the throw;
`right_holds` (1,), `left_holds` (1,), whether a hand holds the thread.

Success: the thread has the throw, see `palpate.tasks.metrics.knots`, and the slit is closed to
1 mm, for 0.3 s. Progress: 0.9 * closing of a throw that is tied, closing from 0.5 to 1 by the gap.
Failure: a thread that breaks or tears out of the drain, a force above the damage limit, or the time
limit.

It has no vectorised form: a batch cannot lay a thread and sew it while it runs.
"""

import math
from collections.abc import Callable, Mapping

import mujoco
import numpy as np
from palpate.models import wrist

from ...core.base import Physics
from ...core.instrument import Instrument
from ...core.performer import Performer, Script
from ...core.rules import clamp
from ...core.scenes import Scene
from ...metrics import knots
from ...registry import exercise
from . import drain
from .drain import CLOSED, EDGE, HANDS, MIDDLE, PULL, STAYS
from .needles import between

FIELD = Scene(
  instrument="psm", second="psm", port=(0.08, -0.03, 0.12), second_port=(-0.08, -0.03, 0.12),
  camera=(0.0, -0.1, 0.06), nodes=400,
)  # fmt: skip
# Tails: the short one; the long one to where it is held, by the turns, and beyond [m].
SHORT, LONG, BEYOND = 0.019, {1: 0.042, 2: 0.052}, 0.01
_LEAN = np.array([0.8, 0.0, 0.6])  # of the short tail
# From the stitch to where the long tail is held, but for its height, and how far both are off [m].
_ASIDE, _OFF = np.array([-0.003, -0.012, 0.0]), np.array([0.0015, 0.0015, 0.0])
_LEFT = np.array([-0.03, 0.01, 0.045])  # where the left tip begins [m]
# As MuJoCo's solver of needles: see `needles`.
_SOLVED = 1e-12
# Jaws as a thread meets them: their radius, that of the clevis, their length, and that of the
# clevis [m]; steel is smooth.
_ROUND, _CLEVIS, _JAW, _LINK, _STEEL = 0.001, 0.0026, 0.0102, 0.0091, (0.1, 0.005, 0.0001)
# Jaws that press hold a thread: closer than so [rad], as far from the middle of what is between
# them, which is so far from the tip [m].
_SHUT, _WITHIN, _PADS = 0.08, np.array([0.0004, 0.0009, 0.0026]), 0.0036
# Time constant, damping ratio and impedance of what holds it; as they open stiffness, damping and
# impedance, of none to speak of.
_FIRM, _LOOSE = (0.004, 1.0, 0.9), (-1e-10, -1e-10, 1e-4)
_LOOKS = 10  # control steps after which the knot is looked at
# Of the expert. Where the thread is from the tip of jaws that hold it [m], actions of open jaws and
# of those that hold.
_GRIP, _OPEN, HOLD = 0.0025, -0.278, -0.76
# It winds on a circle about the jaws, from an angle that is 0 below them and 90 deg in front [rad],
# at a rate [rad/s], by a turn and so much more, and turns its jaws by so much at most [rad].
_CIRCLE, _START, _RATE = 0.0085, math.radians(160.0), math.radians(130.0)
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


@exercise("suture/knot_easy", 40, "easy", "bimanual")
def easy(**kwargs):
  """Tie one throw with two needle drivers, and close the slit to 1 mm."""
  return Knot(FIELD, **{"turns": 1, **kwargs})


@exercise("suture/knot_standard", 40, "bimanual")
def standard(**kwargs):
  """Tie a double throw, the first one of a surgeon's knot."""
  return Knot(FIELD, **{"turns": 2, **kwargs})


class Knot(drain.Sewn):
  """Tie a throw with two needle drivers.

  Attributes:
    turns: how often the strands wind about each other
    tied: whether they do
    holds: what each hand holds
  """

  def __init__(self, scene: Scene, random=None, *, turns: int, **kwargs):
    """Makes the task.

    Args:
      scene: what it plays in
      random: see Task
      turns: how often the strands wind about each other, once or twice
      **kwargs: see Task
    """
    self.turns, self.lean, self.aside = turns, _LEAN, _ASIDE
    # Jaws that close strike each other, and what they take, with 9 to 20 N in single steps.
    super().__init__(scene, random, **{"force_limit": 30.0, "damage": 60.0, **kwargs})

  def line(self) -> np.ndarray:
    """Returns the line of the thread, from the end of its long tail  (4, 3)."""
    mark = np.array([0.5 * drain.BITE, 0.0, 0.0])
    start, far = MIDDLE - mark, LONG[self.turns]
    way = MIDDLE + self.aside - start
    way[2] = math.sqrt(far**2 - way @ way)
    end = MIDDLE + mark + SHORT * self.lean / np.linalg.norm(self.lean)
    return np.array([start + (1.0 + BEYOND / far) * way, start, MIDDLE + mark, end])

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene: the drain, its thread, round jaws, and what joins a node to each hand."""
    line = self.line()
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    at = EDGE * np.arange(int(along[-1] / EDGE) + 1)
    spec = self.build(variant, np.stack([np.interp(at, along, c) for c in line.T], 1))
    spec.option.tolerance = _SOLVED
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    for prefix in (self.prefix, self.second):
      for name, x in (("jaw_left", _ROUND), ("jaw_right", -_ROUND)):
        _rounded(spec.body(prefix + name), _ROUND, (x, 0.0, -_ROUND), _JAW - _ROUND)
      _rounded(spec.body(f"{prefix}tip"), _CLEVIS, (0.0, 0.0, 0.0), _LINK)
      spec.add_equality(
        name=f"{prefix}thread", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=f"{prefix}gripper", name2=f"{drain.THREAD}_0", active=False, solref=[0.004, 1],
      )  # fmt: skip
    return spec

  def build(self, variant: int | None, nodes: np.ndarray) -> mujoco.MjSpec:
    """Returns the drain and a thread with these nodes, see `drain.build`."""
    return drain.build(self._scene(variant), nodes)

  def begin(self, physics: Physics) -> None:
    """Draws how the tails lie and where the left hand is; the right one holds the long tail."""
    super().begin(physics)
    self.lean = _LEAN + self.random.uniform(-0.15, 0.15, 3)
    self.aside = _ASIDE + self.random.uniform(-1.0, 1.0, 3) * _OFF
    self.holds = [Hold(physics, hand) for hand in physics.hands]
    self.tied, self.looked, self.stayed = False, 0, 0.0
    self.place(physics)

  def place(self, physics: Physics) -> None:
    """Sews the thread, and puts the hands to it."""
    line = self.line()
    places = drain.sew(physics.organ, line).positions
    way = line[0] - line[1]
    held = line[1] + LONG[self.turns] * way / np.linalg.norm(way)
    _, left = physics.hands
    # Its roll is where it can be turned on from.
    near = -math.pi
    physics.set_joints(wrist.inverse(physics.trocar(), held - _GRIP * X, _facing(1, _START), near))
    tip = _LEFT + self.random.uniform(-0.004, 0.004, 3)
    left.set_joints(wrist.inverse(left.trocar(), tip, _flat(-1)))
    self.holds[0].take(places)

  def still(self, hand: int) -> np.ndarray:
    """Returns what keeps the jaws closed."""
    return np.array([HOLD])

  def look(self, physics: Physics) -> None:
    """Finds what jaws hold, and now and then the throw."""
    super().look(physics)
    assert physics.thread
    places = physics.thread.positions
    for hold in self.holds:
      hold.follow(places)
    self.looked += 1
    if self.looked % _LOOKS == 0:
      found = knots.throws(knots.closed(places), 1)
      self.tied = self.tied if found is None else [abs(k) for k in found] == [self.turns]

  def advance(self, physics: Physics) -> float:
    """Follows the throw; see the module's head."""
    self.look(physics)
    if self.lost(physics):
      return -1.0
    down = self.tied and self.gap < CLOSED
    self.stayed = self.stayed + self.control_timestep if down else 0.0
    if self.stayed > STAYS - 1e-6:
      self.event(physics, "target", self.gap, "throw")
      self.outcome = "success"
      return 1.0
    closing = clamp((drain.GAPE - self.gap) / (drain.GAPE - CLOSED), 0.0, 1.0)
    return 0.45 * (1.0 + closing) if self.tied else 0.0

  def observe(self, physics: Physics) -> Mapping[str, np.ndarray]:
    """Returns where the tails are, and whether the throw is tied."""
    assert physics.thread
    places, tip = physics.thread.positions, physics.tip_pos()
    right, left = (np.array([float(hold.holds)]) for hold in self.holds)
    return {
      "short": places[-1] - tip,
      "long": places[0] - tip,
      "stitch": MIDDLE - tip,
      "gap": np.array([self.gap]),
      "tension": np.array([self.tension]),
      "tied": np.array([float(self.tied)]),
      "right_holds": right,
      "left_holds": left,
    }

  def show(self, physics: Physics) -> None:
    """Marks nothing."""
    physics.mark(0, MIDDLE, False)

  def instruct(self, physics: Physics) -> str:
    """Says what is next."""
    if self.tied:
      return "Draw both tails apart until the slit is closed"
    if not any(hold.holds for hold in self.holds):
      return "Take the long tail"
    times = ("once", "twice")[self.turns - 1]
    return (
      f"Wind the long tail {times} around the other jaws, take the short tail with them, and draw "
      "it through"
    )

  def expert(self, p: Performer) -> Script:
    """The right hand winds, the left one draws the short tail through."""
    tie = Tie(self, p)
    yield from p.wait(0.1)
    yield from tie.wind(1, self.turns)
    yield from tie.draw(1)
    yield from tie.tighten(1)


class Hold:
  """What a hand's jaws hold of the thread: a node that an equality joins to them.

  Attributes:
    node: that they hold, or held until they are open; -1 for none
  """

  def __init__(self, physics: Physics, hand: Instrument):
    """Looks after a hand."""
    self.hand, self.node = hand, -1
    model = physics.model.ptr
    self._equality = model.equality(f"{hand.prefix}thread").id
    self._gripper = model.body(f"{hand.prefix}gripper").id
    self._first = model.body(f"{drain.THREAD}_0").id

  @property
  def holds(self) -> bool:
    """Whether they hold it."""
    return self.node >= 0 and bool(self.hand.model.ptr.eq_solref[self._equality, 0] > 0.0)

  def press(self, first: float, second: float, impedance: float) -> None:
    """Sets solref and impedance of the equality."""
    model = self.hand.model.ptr
    model.eq_solref[self._equality] = first, second
    model.eq_solimp[self._equality, :2] = impedance

  def take(self, places: np.ndarray) -> None:
    """Takes the node nearest to the middle between the jaws, if one is between them."""
    model, data = self.hand.model.ptr, self.hand.data.ptr
    frame = data.xmat[self._gripper].reshape(3, 3)
    local = (places - data.xpos[self._gripper]) @ frame
    off = np.abs(local + (_JAW - _PADS) * Z) / _WITHIN
    node = int(off.max(axis=1).argmin())
    if off[node].max() > 1.0:
      return
    self.node = node
    model.eq_obj2id[self._equality] = self._first + node
    model.eq_data[self._equality, :6] = *local[node], 0.0, 0.0, 0.0
    self.press(*_FIRM)
    data.eq_active[self._equality] = 1

  def follow(self, places: np.ndarray) -> None:
    """Takes what jaws that press are around, and lets go of it where they do not.

    The equality stays until they are open, without a force: the thread does not meet them till
    then, as it is in them.
    """
    opening, target = self.hand.gripper()[:2]
    if opening > _SHUT:
      self.node = -1
      self.hand.data.ptr.eq_active[self._equality] = 0
    elif target > 0.0:
      self.press(*_LOOSE)
    elif not self.holds:
      self.take(places)


def _rounded(body: mujoco.MjsBody, radius: float, start: tuple, far: float) -> None:
  """Lets a thread meet a capsule down a body from a place on [m], in place of what it has."""
  for geom in body.geoms:
    geom.contype, geom.conaffinity = geom.contype & ~HANDS, geom.conaffinity & ~HANDS
  x, y, z = start
  body.add_geom(
    type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(x, y, z, x, y, -far), size=(radius, 0, 0), mass=0,
    contype=HANDS, conaffinity=HANDS, priority=1, friction=_STEEL, solref=(0.002, 1),
    solimp=(0.99, 0.99, 0.001, 0.5, 2), group=3, rgba=(0, 0, 0, 0),
  )  # fmt: skip


# The expert. A side is 1 for the right hand and -1 for the left one, as its x.


def _frame(back: np.ndarray, across: np.ndarray) -> np.ndarray:
  """Returns the frame of a tip whose jaws point away from one axis and open along another."""
  back = back / np.linalg.norm(back)
  across = across - (across @ back) * back
  across = across / np.linalg.norm(across)
  return np.column_stack([across, np.cross(back, across), back])


def _flat(side: int) -> np.ndarray:
  """Returns the frame of jaws that point level to the other side."""
  return _frame(side * X, Y)


def _facing(side: int, angle: float) -> np.ndarray:
  """Returns that of jaws that hold a thread which comes from an axis, at an angle about it."""
  return _frame(side * X, np.array([0.0, -math.cos(angle), math.sin(angle)]))


class Tie:
  """The words of an expert with two hands."""

  def __init__(self, task: Knot, p: Performer):
    """Takes both hands."""
    assert p.other
    self.task, self.p, self.thread = task, p, p.physics.thread
    self.hand = {1: p, -1: p.other}
    self.dt = p.dt

  def held(self, side: int) -> int:
    """Returns the node that a hand holds."""
    hold = self.task.holds[(1 - side) // 2]
    return hold.node if hold.holds else -1

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
      return self.thread.positions[node] - s * _GRIP * X

    yield from self.jaws(s, _OPEN)
    yield from self.go(1.0, {s: place() + s * _CLEAR * X}, {s: _facing(s, _START + _BACKWARDS)})
    yield from self.go(1.0, {}, {s: lambda t: _facing(s, _START + (1.0 - t) * _BACKWARDS)})
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

    start, end = _START, 2.0 * math.pi * turns + _MORE
    x = -s * _ACROSS
    tip = np.array([x + s * _BACK, 0.0, winds.tip[2] - 0.008])
    yield from self.go(0.8, {-s: tip - 0.02 * s * X + 0.004 * Y}, {-s: _flat(-s)})
    yield from self.go(0.6, {-s: tip})
    yield from self.go(0.5, {s: tip + (x - tip[0] - s * _GRIP) * X + _CIRCLE * out(start)})
    angle, high, share = start, tip[2], min(1.0, _MOST / (end - start))
    while angle < end:
      angle += _RATE * self.dt
      missing = float(np.clip(_WINDS - self.pull(s), -2.0, 0.15))
      high += (_GIVES * missing - _TURN * _RATE / (2.0 * math.pi)) * self.dt
      past = clamp((math.degrees(angle) - 210.0) / 110.0, 0.0, 1.0)
      lead = _PAST * past**2 * (3.0 - 2.0 * past) + _LEAD * (angle - start) / (2.0 * math.pi)
      other.tip = np.array([tip[0], 0.0, high])
      winds.tip = np.array([x + s * (lead - _GRIP), 0.0, high]) + _CIRCLE * out(angle)
      winds.turn = _facing(s, start + share * (angle - start))
      yield self.step()

  def draw(self, s: int) -> Script:
    """The hand that a tail was wound around by another takes the short one and draws it through."""
    winds, takes = self.hand[s], self.hand[-s]
    low = takes.tip - 0.006 * Z
    front = np.array([winds.tip[0] - takes.tip[0], -0.0085, -0.001])
    yield from self.go(0.5, {-s: low, s: low + front}, limit=0.15)
    yield from self.jaws(-s, _OPEN)
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
      yield from self.jaws(-s, _OPEN)
    for duration, mine, others in (
      (0.8, (0.002, -0.01, 0.014), (0.004, 0.0, 0.013)),
      (1.2, (0.012, -0.008, 0.012), (-0.01, 0.0, 0.01)),
      (1.0, (0.02, -0.003, 0.01), (-0.012, 0.0, 0.01)),
    ):
      goals = {s: np.array(mine) * (s, 1, 1), -s: np.array(others) * (s, 1, 1)}
      yield from self.go(duration, goals, {-s: _flat(-s)}, limit=PULL)

  def _at_short_tail(self, s: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns the frame and the place of a tip across the short tail, near its end."""
    places = self.thread.positions
    along = places[-4] - places[-14]
    along /= np.linalg.norm(along)
    back = np.array([-0.5 * s, 0.0, 0.87])
    back -= (back @ along) * along
    across = np.cross(along, back)
    turn = _frame(back, across if across[1] > 0.0 else -across)
    return turn, places[-8] - _GRIP * turn[:, 2]

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
