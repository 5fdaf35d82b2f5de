"""Knot: tie a knot inside the body, on a slit Penrose drain, with two wristed needle drivers.

FLS task 5, once the needle is through. The thread goes through the marks of the drain, see `drain`:
its short tail stands free on the right, its long one is in the right hand. One hand winds the long
tail around the other's jaws, once or twice, which take the short tail and draw it through; both
hands draw the throw down. The levels end with this throw, and so does the expert. Where `turns`
asks for several, each goes the other way round than the one before, and a tail that is let go
rests on foam. Outside of its holes the thread does not meet the drain, which stops throws only
there.

Jaws that press on the thread hold it: an equality joins them to the node that is between them.
Threads meet the jaws as round, smooth bodies, on which a loop slides off: the inserts, whose
friction holds a thread, have corners.

Own observations, in the world: `short_tail` (3,) and `long_tail` (3,), from the right tip to the
ends of both tails [m]; `stitch` (3,), from there to the middle of the stitch [m]; `gap` (1,), of
the slit [m]; `tension` (1,), the largest of the thread [N]; `tied` (1,), how many throws the thread
has; `right_holds` (1,), `left_holds` (1,), whether a hand holds the thread.

A throw is down when the thread has it, see `palpate.tasks.metrics.knots`, and the slit is closed to
1 mm, for 0.3 s; throws after the first one when both hands draw with 0.5 N as well. They count one
after the other: a throw on one that is not down does not, and neither does one of the wrong turns
or direction; it is to be taken out again.

Success: all throws are down, and of several the knot holds in its test, see `drain.Sewn`: what jaws
hold is freed for it. Progress: 0.9 * (tied - 1 + closing) / throws, closing from 0.5 to 1 by the
gap, and 0 where none is tied. Failure: a knot that does not hold, a thread that breaks or tears out
of the drain, a force above the damage limit, or the time limit.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any

import mujoco
import numpy as np
import palpate
import warp as wp
from palpate.engine.model.flexes import matrix
from palpate.models import wrist
from palpate.tissue.types import Array, ints

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...core.scenes import Scene
from ...core.stage import STATE, Stage
from ...registry import exercise
from . import drain
from .drain import CLOSED, EDGE, GAPE, HANDS, MIDDLE, STAYS, follow_stitch, pull_test
from .tie import GRIP, HOLD, START, Tie, X, Z, facing, flat

FIELD = Scene(
  instrument="psm", second="psm", port=(0.08, -0.03, 0.12), second_port=(-0.08, -0.03, 0.12),
  camera=(0.0, -0.1, 0.06), nodes=400,
)  # fmt: skip
# Tails: the short one; the long one to where it is held, by the first turns, and beyond, for one
# throw and for several [m].
SHORT, LONG, BEYOND, FURTHER = 0.019, {1: 0.042, 2: 0.052}, 0.01, 0.02
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
# them along each axis, which is so far from the tip [m].
_SHUT, _ACROSS_IT, _BESIDE_IT, _ALONG_IT, _PADS = 0.08, 0.0004, 0.0009, 0.0026, 0.0036
_HIGH = float(MIDDLE[2])  # of the stitch [m]
# Where tails are let go of, between throws: inner friction of a braid, by which one comes to rest
# in some 0.6 ms and does not whip; ours [N s/m^2].
_DRAG = 0.1
_LOOKS = 10  # control steps after which the knot is looked at
# Tension of both strands of a throw that is drawn on another one [N], edges that it is read from.
_DRAWN, _STRAND = 0.5, 6


class State:
  """State of a world."""

  control_timestep: float  # [s]
  turns: Annotated[Any, ints("throws")]  # of each throw
  throws: int
  lips: Annotated[Any, ints("pairs", 2)]  # vertices of both lips beside the stitch
  wall: Annotated[Any, ints("walls", 2)]  # that the test pulls at
  held: Annotated[Any, ints(2)]  # node that each hand holds, or held until it opens; -1 for none
  firm: Annotated[Any, ints(2)]  # whether it holds it
  anchors: Annotated[Any, Array(wp.vec3, (2,))]  # where in the frame of its tip [m]
  looked: int
  stayed: float  # how long the throw has been down [s]
  seated: int  # throws that are
  whole: bool  # whether the thread is in both of its holes
  broken: bool  # whether it is broken
  gap: float
  left: float  # before the test [m]
  free: float  # how long the strands have been let go of for it [s]
  pulled: float  # what the wall is pulled with [N]
  security: float  # what the knot has held [N]
  tension: float
  hardest: float  # largest pull on the drain so far [N]
  tightest: float  # largest tension so far [N]
  short_tail: r.Vector
  long_tail: r.Vector
  stitch: r.Vector
  tied: float
  right_holds: float
  left_holds: float


# The rules.


def around(s, hand):
  """Returns the node nearest to the middle between a hand's jaws, and how far off it is [-].

  1 is as far as a node may be that they hold.
  """
  instrument = s.hands[hand]
  local = (s.thread.positions - instrument.tip_pos()) @ matrix(instrument.tip_quat())
  off = np.abs(local - _PADS * Z) / (_ACROSS_IT, _BESIDE_IT, _ALONG_IT)
  node = int(off.max(axis=1).argmin())
  return node, float(off[node].max())


@r.many(around)
def around_each(s, hand):
  """Returns the same."""
  node = int(0)
  least = float(r.FAR)
  for k in range(r.strands(s)):
    local = r.in_hand(s, hand, r.strand(s, k))
    off = max(abs(local[0]) / _ACROSS_IT, abs(local[1]) / _BESIDE_IT)
    off = max(off, abs(local[2] - _PADS) / _ALONG_IT)
    if off < least:
      node = k
      least = off
  return node, least


def follow_jaws(s, o, hand):
  """Lets jaws that press hold the node that they are around, and let go of it where they do not.

  The node stays theirs until they are open, without a force: the thread does not meet them till
  then, as it is in them. So it is while the knot is tested.
  """
  opening, target = r.jaws(s, hand)
  if opening > _SHUT:
    o.held[hand] = -1
    o.firm[hand] = 0
    r.hold(s, hand, -1, o.anchors[hand], False)
  elif target > 0.0 or o.free > 0.0:
    o.firm[hand] = 0
    r.hold(s, hand, o.held[hand], o.anchors[hand], False)
  elif o.firm[hand] == 0:
    node, off = around(s, hand)
    if off <= 1.0:
      o.held[hand] = node
      o.firm[hand] = 1
      o.anchors[hand] = r.in_hand(s, hand, r.strand(s, node))
      r.hold(s, hand, node, o.anchors[hand], True)
  return o


def begin(s, o):
  """Lets the hands hold what their closed jaws are around."""
  for hand in range(2):
    r.hold(s, hand, -1, o.anchors[hand], False)
    o = follow_jaws(s, o, hand)
  return o


def follow(s, o):
  """Finds what jaws hold, how the stitch is, and now and then the throw."""
  for hand in range(2):
    o = follow_jaws(s, o, hand)
  o = follow_stitch(s, o)
  o.looked = o.looked + 1
  if o.looked % _LOOKS == 0:
    found = r.tied(s, o.turns)
    if found >= 0:
      o.tied = float(found) if found <= o.seated + 1 else 0.0
  return o


def is_down(s, o):
  """Returns whether the throw whose turn it is is tied and drawn, after the first by both hands."""
  if o.tied <= float(o.seated) or o.gap >= CLOSED:
    return False
  if o.seated == 0:
    return True
  least = float(r.FAR)
  for hand in range(2):
    node = o.held[hand]
    beside = node + 2 if 2 * node < r.strands(s) else node - 2 - _STRAND
    pull = r.tugged(s, beside, _STRAND)
    least = min(least, pull if o.firm[hand] == 1 else 0.0)
  return least > _DRAWN


def judge(s, o):
  """Returns the progress of the knot; see the module's head."""
  if o.seated == o.throws:
    o, outcome = pull_test(s, o)
    return o, 0.95, outcome
  if o.broken or not o.whole:
    return o, -1.0, r.DAMAGED
  o.stayed = o.stayed + o.control_timestep if is_down(s, o) else 0.0
  closing = r.clamp((GAPE - o.gap) / (GAPE - CLOSED), 0.0, 1.0)
  before = 2.0 * (o.tied - 1.0)
  progress = 0.45 * (before + 1.0 + closing) / float(o.throws) if o.tied > 0.0 else 0.0
  if o.stayed > STAYS - 1e-6:
    r.reach(s, o, o.gap)
    if o.throws == 1:
      return o, progress, r.SUCCESS
    o.seated = o.seated + 1
    o.stayed = 0.0
  return o, progress, r.RUNNING


def advance(s, o):
  """Follows the throw."""
  return judge(s, follow(s, o))


def see_tails(s, o):
  """Finds where the tails are, and the stitch."""
  o.short_tail = r.strand(s, r.strands(s) - 1) - r.tip(s)
  o.long_tail = r.strand(s, 0) - r.tip(s)
  o.stitch = r.vector(0.0, 0.0, _HIGH) - r.tip(s)
  return o


def observe(s, o):
  """Finds where the tails are, and who holds one."""
  o = see_tails(s, o)
  o.right_holds = float(o.firm[0])
  o.left_holds = float(o.firm[1])
  return o


@exercise("suture/knot_easy", 40, "easy", "bimanual",
          asks="Tie one throw with two needle drivers, and close the slit to 1 mm",
          scene=FIELD, turns=(1,))  # fmt: skip
@exercise("suture/knot_standard", 40, "bimanual",
          asks="Tie a double throw, the first one of a surgeon's knot",
          scene=FIELD, turns=(2,))  # fmt: skip
class Knot(drain.Sewn):
  """Tie a knot with two needle drivers.

  Attributes:
    tied: throws that the thread has
    held, firm: what each hand holds, see `State`
  """

  rules: Any = r.Rules(
    State,
    advance,
    observe,
    ("short_tail", "long_tail", "stitch", "gap", "tension", "tied", "right_holds", "left_holds"),
    metrics={
      "peak_traction": "hardest", "final_gap": "left", "peak_tension": "tightest",
      "knot_security": "security",
    },
    begin=begin,
    shared=("turns", "lips", "wall"),
  )  # fmt: skip

  def __init__(self, scene: Scene, random=None, *, turns: Sequence[int], **kwargs):
    """Makes the task; see `Sewn`."""
    self.lean, self.aside = _LEAN, _ASIDE
    # Jaws that close strike each other, and what they take, with 9 to 20 N in single steps.
    kwargs = {"force_limit": 30.0, "damage": 60.0, **kwargs}
    super().__init__(scene, random, turns=turns, **kwargs)

  def line(self) -> np.ndarray:
    """Returns the line of the thread, from the end of its long tail  (4, 3)."""
    mark = np.array([0.5 * drain.BITE, 0.0, 0.0])
    start, far = MIDDLE - mark, LONG[self.turns[0]]
    way = MIDDLE + self.aside - start
    way[2] = math.sqrt(far**2 - way @ way)
    end = MIDDLE + mark + SHORT * self.lean / np.linalg.norm(self.lean)
    beyond = FURTHER if self.throws > 1 else BEYOND
    return np.array([start + (1.0 + beyond / far) * way, start, MIDDLE + mark, end])

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene: the drain, its thread, round jaws, and what joins a node to each hand."""
    self.lean, self.aside = _LEAN, _ASIDE  # whatever the last episode has drawn
    line = self.line()
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    at = EDGE * np.arange(int(along[-1] / EDGE) + 1)
    spec = self.build(variant, np.stack([np.interp(at, along, c) for c in line.T], 1))
    spec.option.tolerance = _SOLVED
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    for geom in spec.geoms if self.throws > 1 else ():
      if geom.name.endswith("shaft"):  # the light end of a long tail would strike it with newtons
        geom.contype, geom.conaffinity = geom.contype & ~HANDS, geom.conaffinity & ~HANDS
    for prefix in (self.prefix, self.second):
      for name, x in (("jaw_left", _ROUND), ("jaw_right", -_ROUND)):
        _rounded(spec.body(prefix + name), _ROUND, (x, 0.0, -_ROUND), _JAW - _ROUND)
      _rounded(spec.body(f"{prefix}tip"), _CLEVIS, (0.0, 0.0, 0.0), _LINK)
      spec.add_equality(
        name=f"{prefix}{drain.THREAD}", type=mujoco.mjtEq.mjEQ_CONNECT,
        objtype=mujoco.mjtObj.mjOBJ_BODY, name1=f"{prefix}gripper", name2=f"{drain.THREAD}_0",
        active=False,
      )  # fmt: skip
    return spec

  def build(self, variant: int | None, nodes: np.ndarray) -> mujoco.MjSpec:
    """Returns the drain and a thread with these nodes, see `drain.build`."""
    own = {"meets": HANDS | drain.LIES, "drag": _DRAG} if self.throws > 1 else {}
    return drain.build(self._scene(variant), nodes, **own)

  def _stage(self, spec: mujoco.MjSpec) -> Stage:
    """Returns the stage: the thread is sewn."""
    made = super()._stage(spec)
    data = mujoco.MjData(made.model)
    mujoco.mj_setState(made.model, data, made.state, STATE)
    mujoco.mj_forward(made.model, data)
    drain.sew(palpate.Organ(made.model, data, self.organ), self.line())
    mujoco.mj_getState(made.model, data, made.state, STATE)
    return made

  def begin(self, physics: Physics) -> None:
    """Draws how the tails lie and where the left hand is; the right one holds the long tail."""
    super().begin(physics)
    self.lean = _LEAN + self.random.uniform(-0.15, 0.15, 3)
    self.aside = _ASIDE + self.random.uniform(-1.0, 1.0, 3) * _OFF
    self.held, self.firm, self.anchors = np.full(2, -1), np.zeros(2, int), np.zeros((2, 3))
    self.looked, self.tied, self.stayed = 0, 0.0, 0.0
    self.right_holds = self.left_holds = 0.0
    self.short_tail, self.long_tail, self.stitch = np.zeros((3, 3))
    self.place(physics)

  def place(self, physics: Physics) -> None:
    """Lays the thread, and puts the hands to it."""
    line = self.line()
    thread = physics.thread
    assert thread
    thread.lay(line)
    self.threads = {thread.name: thread.positions}
    way = line[0] - line[1]
    held = line[1] + LONG[self.turns[0]] * way / np.linalg.norm(way)
    _, left = physics.hands
    # Its roll is where it can be turned on from.
    near = -math.pi
    physics.set_joints(wrist.inverse(physics.trocar(), held - GRIP * X, facing(1, START), near))
    place = _LEFT + self.random.uniform(-0.004, 0.004, 3)
    left.set_joints(wrist.inverse(left.trocar(), place, flat(-1)))

  def still(self, hand: int) -> np.ndarray:
    """Returns what keeps the jaws closed."""
    return np.array([HOLD])

  def show(self, physics: Physics) -> None:
    """Marks nothing."""
    physics.mark(0, MIDDLE, False)

  def instruct(self, physics: Physics) -> str:
    """Says what is next."""
    if self.seated == self.throws:
      return "The strands are let go of, and the slit is pulled apart"
    if self.tied > self.seated:
      until = "throw is tight" if self.seated else "slit is closed"
      return f"Draw both tails apart until the {until}"
    if self.tied < self.seated:
      return "This is another knot than was asked for: take the last throw out again"
    if not any(self.firm):
      return "Take the long tail"
    times = ("once", "twice")[self.turns[self.seated] - 1]
    way = ", the other way round than before" if self.seated else ""
    return (
      f"Wind the long tail {times} around the other jaws{way}, take the short tail with them, and "
      "draw it through"
    )

  def expert(self, p: Performer) -> Script:
    """The right hand winds, the left one draws the short tail through."""
    tie = Tie(self, p)
    yield from p.wait(0.1)
    yield from tie.wind(1, self.turns[0])
    yield from tie.draw(1)
    yield from tie.tighten(1)


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
