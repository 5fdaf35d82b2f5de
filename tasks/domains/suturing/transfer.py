"""Transfer: pass a needle through rings, from hand to hand, with two wristed needle drivers.

A needle of 26 mm, half a circle, begins in the jaws of the right hand. Through the first ring it
goes tip first into the left hand, through the second one swage first back into the right, and so
on. The action has the right needle driver's components, then the left one's.

Own observations, all in the world: `lead` (3,), from the middle of the ring whose turn it is to the
end of the needle that goes first [m]; `trail` (3,), to the other end; `circle` (3,), axis of the
needle's circle [-]; `way` (3,), way through the ring [-]; `target` (3,), from the tip of the hand
that is to take the needle to where the arc is 25 degrees from its first end [m]; `through` (1,),
share of the needle that is through [-]; `right_holds` (1,), `left_holds` (1,), whether a hand holds
the needle. In the frame of the hand that is to take it: `hand_target` (3,), what `target` is [m];
`hand_circle` (3,), what `circle` is [-]; `hand_along` (3,), way along the needle there [-].

Progress: (done + part) / number, part being 0.25 * closeness of the first end to the ring; once it
is through, 0.25 + 0.4 * through, and 0.1 more when the taking hand holds the needle, 0.1 when it
alone does. A ring is done when all of the needle is through and the taking hand alone holds it.
Success: all of them. Failure: a needle that nobody holds for half a second, a force above the
damage limit, or the time limit.
"""

import itertools
import math
from typing import Annotated, Any

import mujoco
import numpy as np
import palpate
import warp as wp
from palpate.models import trocar, wrist
from palpate.tissue.types import Array

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...core.scenes import Scene
from ...registry import exercise
from . import needles as n

TAKEN = 25.0 / 180.0  # where it is to be taken, from its first end, as a share of it
TUBE, SIDES = 0.0008, 12  # of a ring: radius of its wire [m], and straight pieces
_FINE, _HIDDEN = 32, 3  # of a ring: sides in pictures, and the group of its pieces
MASS = 7e-5  # of a needle of steel [kg]
# Contacts of a needle of 0.07 g with a ring: about 3 N/mm, with the usual ones it would go through.
FIRM = {"solref": (0.005, 1.0), "solimp": (0.999, 0.999, 1e-3, 0.5, 2.0), "solmix": 1e3}
FIELD = Scene(
  instrument="psm", second="psm", port=(-0.06, 0.04, 0.13), second_port=(0.06, 0.04, 0.13),
  camera=(0.076, 0.108, 0.055), nodes=250,
)  # fmt: skip
_HIGH = 0.03  # of the rings over the organ [m]
_APART = 0.034  # of rings: needle and wrist have room between them [m]
# Of the expert, polar angles about a ring's frame, and along the arc from its middle [rad]: the
# turn that an end enters with, that of the handing over, and what is behind the ring in the end.
_ENTERS, _HANDS, _TAKES = math.radians(20.0), math.radians(20.0), math.radians(65.0)
_BACK, _RISE = 0.014, 0.016  # out of a ring, and off the needle [m]


class State(n.Taking):
  """State of a world."""

  size: float  # of the rings: inner radius [m]
  middles: Annotated[Any, Array(wp.vec3, ("targets",))]  # of the rings [m]
  ways: Annotated[Any, Array(wp.vec3, ("targets",))]  # through them from right to left
  done: int
  error0: float  # of the first end at the start [m]
  entered: int  # 1 where the needle is in the ring, first end first, -1 the other way round
  passed: bool  # whether all of the needle is through
  through: float
  scraping: float  # how long rings were touched [s]
  worst: float  # largest force on them [N]
  lead: r.Vector
  trail: r.Vector
  way: r.Vector
  target: r.Vector


# The rules.


def now(o):
  """Returns the number of the ring whose turn it is, the last one when all are done."""
  return min(o.done, o.middles.shape[0] - 1)


def back(o):
  """Returns whether the needle goes back, swage first."""
  return now(o) % 2 == 1


def from_first(s, o, share):
  """Returns where a share of the needle from the end that goes first ends [m]."""
  return n.arc(s, share if back(o) else 1.0 - share)


def crossing(s, o):
  """Returns what share of the needle is through the ring, -1 where no piece is in it."""
  found = float(-1.0)
  middle, way = o.middles[now(o)], o.ways[now(o)]
  before = from_first(s, o, 0.0) - middle
  for k in range(n.PIECES):
    after = from_first(s, o, float(k + 1) / float(n.PIECES)) - middle
    a, b = r.dot(before, way), r.dot(after, way)
    if a * b <= 0.0 and a != b:
      part = a / (a - b)
      if r.length(before + part * (after - before)) < o.size:
        found = (float(k) + part) / float(n.PIECES)
    before = after
  return found


def advance(s, o):
  """Follows the needle: who holds it, what it scrapes on, and how far it is through the ring."""
  o = n.grasped(s, o, n.right_grasp(s), n.left_grasp(s))
  force = r.scraped(s)
  if force > 0.0:
    o.scraping = o.scraping + o.control_timestep
    o.worst = max(o.worst, force)
  share = crossing(s, o)
  if share < 0.0 and o.entered != 0:  # it has gone on, or was taken back
    o.passed = o.through > 0.5
    o.through = 1.0 if o.passed else 0.0
    o.entered = 0
  if share >= 0.0:
    if o.entered == 0:
      o.entered = 1 if share < 0.5 else -1
    o.through = share if o.entered == 1 else 0.0
    o.passed = False
  takes = o.right_holds if back(o) else o.left_holds
  gives = o.left_holds if back(o) else o.right_holds
  if o.passed and takes > gives:
    o.done = o.done + 1
    o.through = 0.0
    o.passed = False
    o.entered = 0
    o.error0 = r.length(from_first(s, o, 0.0) - o.middles[now(o)])
    takes = 0.0
  part = 0.25 * r.closeness(r.length(from_first(s, o, 0.0) - o.middles[now(o)]), o.error0)
  if o.through > 0.0:
    part = 0.25 + 0.4 * o.through + 0.1 * takes + 0.1 * takes * (1.0 - gives)
  count = o.middles.shape[0]
  progress = (float(o.done) + part) / float(count)
  if o.done == count:
    return o, 1.0, r.SUCCESS
  return o, progress, r.MISSED if o.loose > n.LOST else r.RUNNING


def observe(s, o):
  """Finds where the needle is from the ring and from the hand that is to take it."""
  middle = o.middles[now(o)]
  o.lead = from_first(s, o, 0.0) - middle
  o.trail = from_first(s, o, 1.0) - middle
  o.circle = r.needle_place(s, r.vector(0.0, 0.0, 1.0)) - r.needle_place(s, r.vector(0.0, 0.0, 0.0))
  o.way = -o.ways[now(o)] if back(o) else 1.0 * o.ways[now(o)]
  if back(o):
    o.target = n.arc(s, TAKEN) - r.tip(s)
    return n.in_jaws(s, o, 0, TAKEN, 0.01)
  o.target = n.arc(s, 1.0 - TAKEN) - r.other_tip(s)
  return n.in_jaws(s, o, 1, 1.0 - TAKEN, -0.01)


def mark(s, o, k):
  """Marks the rings that are left, above them."""
  return o.middles[k] + r.vector(0.0, 0.0, o.size + 0.005), r.shown(k, o.done)


@exercise("needle/transfer_easy", 25, "easy", "bimanual",
          asks="Pass a needle through a ring of 12 mm into the other hand",
          scene=FIELD, rings=1, size=0.006, tilt=10.0)  # fmt: skip
@exercise("needle/transfer_standard", 45, "bimanual",
          asks="Pass a needle through two rings of 10 mm, there and back",
          scene=FIELD, rings=2, size=0.005, tilt=15.0, jitter=0.003)  # fmt: skip
@exercise("needle/transfer_hard", 70, "hard", "bimanual",
          asks="Pass a needle through three rings of 8 mm, from hand to hand",
          scene=FIELD, rings=3, size=0.004, tilt=20.0, jitter=0.005)  # fmt: skip
class Transfer(n.Needlework):
  """Pass a needle through rings, from hand to hand."""

  mark_radius = 0.0015
  rules = r.Rules(
    State,
    advance,
    observe,
    ("lead", "trail", "circle", "way", "target", "through", "right_holds", "left_holds",
     "hand_target", "hand_circle", "hand_along"),
    metrics={"regrasps": "regrasps", "ring_contact": "scraping", "peak_ring_force": "worst"},
    columns={"regrasped": "regrasps", "ring_time": "scraping", "ring_force": "worst"},
    mark=mark,
  )

  def __init__(self, *, rings: int, size: float, tilt: float, **kwargs):
    """Makes the task.

    Args:
      rings: number of rings
      size: their inner radius [m]
      tilt: largest rotation of the rings about the vertical [deg]
      **kwargs: see Task
    """
    self.targets, self.size, self.tilt = rings, size, math.radians(tilt)
    super().__init__(**{"force_limit": 5.0, "damage": 20.0, **kwargs})

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene with needle and rings."""
    spec = super().spec(variant)
    stands = spec.worldbody.add_body(name="rings")
    turn = 2 * np.pi * np.arange(SIDES + 1) / SIDES
    far = (self.size + TUBE) / math.cos(math.pi / SIDES)  # the pieces are outside of the circle
    corners = far * np.column_stack([0 * turn, np.sin(turn), -np.cos(turn)])
    foot = corners[0] - np.array([0.0, 0.0, 0.02])
    look = {"contype": n.MEETS, "conaffinity": n.MEETS, "rgba": (0.2, 0.55, 0.6, 1.0)} | FIRM
    round_ = spec.add_mesh(name="ring", scale=[self.size + TUBE] * 3)
    round_.make_supertorus(_FINE, TUBE / (self.size + TUBE), 1.0, 1.0)
    for k in range(self.targets):
      ring = stands.add_body(name=f"ring{k}")
      for i, (start, end) in enumerate([*itertools.pairwise(corners), (corners[0], foot)]):
        ring.add_geom(
          type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[*start, *end], size=[TUBE, 0, 0],
          group=_HIDDEN * (i < SIDES), **look,
        )  # fmt: skip
      ring.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname="ring", quat=(1, 0, 1, 0), rgba=look["rgba"],
        contype=0, conaffinity=0, mass=0, group=2,
      )  # fmt: skip
    spec.add_sensor(
      name="scrape", type=mujoco.mjtSensor.mjSENS_CONTACT, objtype=mujoco.mjtObj.mjOBJ_XBODY,
      objname="rings", intprm=[2, 3, 1],
    )  # fmt: skip
    self.meet(spec)
    look = {"contype": n.MEETS, "conaffinity": n.MEETS}
    palpate.add_needle(spec, mass=MASS, contact=look)
    return spec

  def begin(self, physics: Physics) -> None:
    """Draws the rings and how the right hand holds the needle."""
    _, center = self.place_of_work(physics)
    rows = np.arange(self.targets) - 0.5 * (self.targets - 1)
    along = np.column_stack([0 * rows, -_APART * rows, 0 * rows])
    drawn = self.random.uniform(-1, 1, (self.targets, 3)) * [0.003, 0.002, 0.004]
    self.middles = center + np.array([0.0, 0.0, _HIGH]) + along + drawn
    turned = self.random.uniform(-self.tilt, self.tilt, self.targets)
    self.ways = np.column_stack([np.cos(turned), np.sin(turned), 0 * turned])
    self.bodies = {
      f"ring{k}": np.array([*self.middles[k], math.cos(a / 2), 0.0, 0.0, math.sin(a / 2)])
      for k, a in enumerate(turned)
    }
    place, mat = entrance(self, 0)
    place = place + self.random.uniform(-0.006, 0.006, 3) - np.array([0.006, 0.0, 0.0])
    _, second = physics.hands
    end = self.take_up(physics, (place, mat), -_TAKES, lean=0.2, along=0.15)
    port = second.trocar()
    second.set_joints(wrist.inverse(port, *park(self, port, self.middles.mean(axis=0))))
    self.done, self.entered, self.passed, self.through = 0, 0, False, 0.0
    self.scraping = self.worst = 0.0
    self.error0 = float(np.linalg.norm(end - self.middles[0]))

  def instruct(self, physics: Physics) -> str:
    """Says what is next."""
    gives, takes = ("left", "right") if back(self) else ("right", "left")
    end, number = ("blunt end" if back(self) else "tip"), f"ring {now(self) + 1} of {self.targets}"
    if not self.right_holds + self.left_holds:
      return "Take the needle"
    if not self.through:
      return f"Bring the needle's {end} through {number}"
    if not (self.right_holds if back(self) else self.left_holds):
      return f"Take the needle with the {takes} hand"
    if self.left_holds if back(self) else self.right_holds:
      return f"Let go with the {gives} hand"
    return "Pull it through"

  def expert(self, p: Performer) -> Script:
    """Turns the needle about its circle through each ring, hands it over and pulls it through."""
    assert p.other
    while self.outcome is None:
      gives, takes = (p.other, p) if back(self) else (p, p.other)
      mine, others = self.right_holds > 0, self.left_holds > 0
      giver, taker = (others, mine) if back(self) else (mine, others)
      off = self.through - (0.5 - _HANDS / math.pi)
      if taker and self.through and (giver or n.lingers(gives)):
        yield from n.one(p, gives, _let_go(self, gives))
      elif giver and (off < -0.03 or (p.hasty and abs(off) > 0.02)):
        yield from n.one(p, gives, self._drive(gives))
      elif giver:
        yield from n.one(p, takes, self._take(takes))
      elif taker and self.through:
        yield from n.one(p, takes, self._pull(takes))
      else:  # nobody holds it
        yield from Performer.wait(p, 0.1)  # a teacher too

  def _drive(self, p: Performer) -> Script:
    """Brings the end that goes first to the ring, and turns it through as far as to be taken."""
    ring, sign = now(self), -1.0 if back(self) else 1.0
    if not self.through and not _begun(p, self):
      place, mat = entrance(self, ring)
      if ring:  # out of the ring before
        pos, turned = n.needle(p.physics)
        off = pos - posed(self, ring - 1, 0.0)[0]
        left = _BACK + sign * float(off @ self.ways[ring - 1])
        if left > 0 and np.linalg.norm(off) < _APART / 2:
          out = pos - sign * left * self.ways[ring - 1]
          yield from n.carry(p, lambda t: (out, turned))
      way = sign * self.ways[ring]
      clear = place - min(n.height(p, n.needle(p.physics), (place, mat), -way), _BACK) * way
      yield from n.come(
        n.carry(p, lambda t: (clear, mat)),
        lambda: n.over(p, n.needle(p.physics), (place, mat), -way),
      )
      yield from n.come(n.carry(p, lambda t: (place, mat)), lambda: _begun(p, self))
    start, end = turn_of(self, p.physics), -n.QUARTER - sign * _HANDS
    yield from n.carry(p, lambda t: posed(self, ring, start + t * (end - start)), end - start)

  def _take(self, p: Performer) -> Script:
    """Takes the needle from above, near the end that went first."""
    sign = -1.0 if back(self) else 1.0
    pos, mat = n.needle(p.physics)
    goal, turn = n.grasp(p.trocar, pos, mat, sign * _TAKES)
    up = mat[:, 2]
    yield from n.close_on(p, (goal, turn), _RISE * up)

  def _pull(self, p: Performer) -> Script:
    """Turns the needle on until all of it is through, and out of the ring's way."""
    ring, sign = now(self), -1.0 if back(self) else 1.0
    start, end = turn_of(self, p.physics), -n.QUARTER + sign * (n.QUARTER + _ENTERS)
    yield from n.carry(p, lambda t: posed(self, ring, start + t * (end - start)), end - start)


def posed(task: Transfer, ring: int, turn: float) -> n.Pose:
  """Returns the needle's pose in a ring, turned by an angle about its circle [rad].

  The circle lies level and goes through the ring's middle, at a polar angle of -90 degrees.
  """
  way, up = task.ways[ring], np.array([0.0, 0.0, 1.0])
  side = np.cross(up, way)
  x = math.cos(turn) * way + math.sin(turn) * side
  return task.middles[ring] + n.RADIUS * side, np.column_stack([x, np.cross(up, x), up])


def entrance(task: Transfer, ring: int) -> n.Pose:
  """Returns the needle's pose in front of a ring, the end that goes first before it."""
  sign = -1.0 if ring % 2 else 1.0
  return posed(task, ring, -n.QUARTER - sign * (n.QUARTER + _ENTERS))


def turn_of(task: Transfer, physics: Any) -> float:
  """Returns how the needle is turned about its circle, see `posed`; from -270 to 90 degrees."""
  way = task.ways[now(task)]
  x = n.needle(physics)[1][:, 0]
  side = np.cross([0.0, 0.0, 1.0], way)
  return math.remainder(math.atan2(x @ side, x @ way) + n.QUARTER, 2 * math.pi) - n.QUARTER


def park(task: Transfer, port: Any, middle: np.ndarray) -> n.Pose:
  """Returns a pose of a tip beside the rings, on the side of its trocar, jaws down."""
  aside = math.copysign(0.03, port.pos[0] - middle[0])
  turn = port.mat.copy()
  return middle + np.array([aside, 0.0, 0.02]), turn @ trocar.about(2, -n.QUARTER)


def _let_go(task: Transfer, p: Performer) -> Script:
  """Opens the jaws and takes the hand aside."""
  end = park(task, p.trocar, task.middles.mean(axis=0))
  yield from n.leave(p, _RISE * p.turn[:, 2], end)


def _begun(p: Performer, task: Transfer) -> bool:
  """Returns whether a teacher's needle may turn into the ring from where it is."""
  (pos, mat), turn = n.needle(p.physics), turn_of(task, p.physics)
  sign = -1.0 if back(task) else 1.0
  place, turned = posed(task, now(task), turn)
  way = sign * (turn + n.QUARTER) + n.QUARTER + _ENTERS
  there = float(np.linalg.norm(pos - place)) < n.NARROW and n.apart(mat, turned) < n.TURNED
  return p.hasty and there and -n.TURNED < way < 2 * _ENTERS
