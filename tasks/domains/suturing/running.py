"""Running: close a cut with a running suture of four stitches, with two wristed needle drivers.

A stretched wall, flat or that of a stomach, has a cut of 25 mm, which gapes by 2 mm. Four stitches
close it, 6 mm apart and 4 mm from its edges, with one thread of polypropylene 3-0 that ends in a
bead. Some of them are placed at the start, but loose. The right hand drives the needle
through the two marks of a stitch, the left one takes its tip and draws needle and thread through.
After the last one the thread is pulled until the gap is under a millimetre, and held so for half a
second: no knot is tied.

The thread meets the wall in its holes alone, and it floats: there is no gravity. The lips of the
cut do not touch each other.

Own observations, in the world: `target` (3,), from the needle's tip to the mark whose turn it is
[m]; `way` (3,), from the entry mark to the exit mark [-]; `circle` (3,), axis of the needle's
circle [-]; `middle` (3,), from the entry mark to the middle of that circle [m];
`stitches` (1,), how many are placed; `pierced` (1,), holes of the next one that are made; `through`
(1,), share of the needle that is through the last hole [-]; `gap` (1,), of the cut at its widest
[m]; `tight` (1,), largest tension of the thread [N]; `right_holds` (1,), `left_holds` (1,), whether
a hand holds the needle. In the frame of the hand that is to take the needle, the right one where
the left one alone holds it: `hand_target` (3,), from its tip to where it may take it [m];
`hand_circle` (3,), axis of the needle's circle [-]; `hand_along` (3,), way along the needle there,
to its tip [-].

Progress: 0.7 of it are the stitches to do, each 0.3 * closeness of the tip to the first mark; 0.4 +
0.2 * closeness to the second one once it is in; 0.6 + 0.4 * through once it is through both. The
last 0.3 go by the gap. Success: all stitches placed, and a gap under the limit for half a second.
Failure: a hole farther from its mark than the tolerance, a stitch that is torn out, a needle that
nobody holds for half a second, a force on the wall above the damage limit, or the time limit.
"""

import itertools
import math
from collections.abc import Callable
from typing import Annotated, Any

import mujoco
import numpy as np
import palpate
import scipy
import warp as wp
from palpate.models import trocar, wrist
from palpate.tissue.types import Array, ints

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...core.scenes import Scene
from ...core.stage import STATE, Stage
from ...registry import exercise
from .. import sheet
from . import needles as n

STITCHES, PITCH, BITE = 4, 0.006, 0.004  # [m]: between stitches, and from the edge of the cut
TENSION = 40.0  # of the wall [N/m]
_FILLING = 5e5  # foundation of the wall of a filled organ: its tension sinks it by 1 mm [Pa/m]
_TOUGH = 1200.0  # as `TOUGH`: more, since stitches are pulled tight in it
CUT = (-0.0135, 0.0075)  # vertices of the wall that the cut divides, along y [m]
CLOSED, HELD = 0.001, 0.5  # gap of a cut that is closed [m], and how long it is to stay so [s]
THREAD, EDGE = 0.12, 0.0015  # length of the thread, and of its edges [m]
# Radius of what is at its end, from there to the first hole, and its rise from the last one [m].
_BEAD, _TAIL, _RISE = 0.001, 0.006, 0.003
FIELD = Scene(
  organ="sheet", instrument="psm", second="psm", port=(-0.06, 0.1, 0.08),
  second_port=(0.06, 0.1, 0.08), camera=(0.0, 0.04, 0.105), nodes=480,
)  # fmt: skip
# Where on the needle the hands take it, as shares.
_BACK, _FRONT = (0.5 + angle / math.pi for angle, _ in (n.RIGHT, n.LEFT))
_MASS, _SLOTS = 0.004, 160  # of the wall [kg], and of its window
# Of the expert: how high the needle is brought over the wall [m], and what it pulls with [N].
_HIGH, _PULL = 0.012, 0.7
_MORE, _SHUT = 0.02, 0.7  # how the pull grows [N/s], and share of the limit at which it is enough
_LITTLE, _DRAWN = 0.01, 0.03  # slack that is drawn in with care [m], and how fast more is [m/s]
_UNDRAWN = 0.013  # slack of the seam that a teacher goes on to draw in [m]
# How high it is handed over [m], tension of a thread without slack [N], and which way it is pulled.
_OVER, _TAUT, _WAY = 0.02, 0.3, np.array([0.6, 0.35, 0.72])


class State(n.Taking, n.Driving):
  """State of a world."""

  damage: float  # [N]
  placed: int  # stitches that are placed at the start
  close: float  # gap of a closed cut [m]
  seat: Annotated[Any, ints("targets")]  # triangle of each mark
  shares: Annotated[Any, Array(wp.vec3, ("targets",))]  # of its corners
  lips: Annotated[Any, ints("pairs", 4)]  # triangle and corner of both lips at places of the cut
  gap0: float  # of the cut then [m]
  done: int  # stitches that are placed
  closed: float  # how long the gap has been under the limit [s]
  pull: float  # of needle and thread on the wall [N]
  pulled: float  # the largest so far [N]
  deepest: float  # how far the needle was under its first mark [m]
  tightest: float  # largest tension so far [N]
  torn: float  # how far a hole has torn at most [m]
  way: r.Vector
  middle: r.Vector
  stitches: float
  through: float
  gap: float
  tight: float


# The rules.


def place(s, o, k):
  """Returns where a mark is now [m]."""
  a, b, c = r.corner(s, o.seat[k], 0), r.corner(s, o.seat[k], 1), r.corner(s, o.seat[k], 2)
  return o.shares[k][0] * a + o.shares[k][1] * b + o.shares[k][2] * c


def now(o):
  """Returns the first mark of the stitch whose turn it is, of the last one when all are placed."""
  return 2 * min(o.done, o.marks.shape[0] // 2 - 1)


def widest(s, o):
  """Returns how far the cut gapes at most [m]."""
  most = float(-r.FAR)
  for k in range(o.lips.shape[0]):
    a, b = r.corner(s, o.lips[k, 0], o.lips[k, 1]), r.corner(s, o.lips[k, 2], o.lips[k, 3])
    most = max(most, float(b[0] - a[0]))
  return most


def advance(s, o):
  """Follows needle and thread through the wall, and the gap."""
  o = n.grasped(s, o, n.right_grasp(s), n.left_grasp(s))
  count, pull = r.pierced(s)
  o.pull = pull
  o.tight = r.taut(s)
  o.pulled = max(o.pulled, pull)
  o.tightest = max(o.tightest, o.tight)
  number = o.marks.shape[0]
  for k in range(count):
    o.torn = max(o.torn, r.torn_at(s, k))
  o, worst = n.open_holes(s, o, min(count, number))
  if o.holes > 2 * o.done:
    o.deepest = max(o.deepest, float(place(s, o, now(o))[2]) - n.lowest(s))
  o.through = 0.0
  if o.holes == 2 * o.done + 2:
    _, along = r.pinhole(s, o.holes - 1)
    o.through = r.clamp(1.0 - along / (2.0 * n.QUARTER * n.RADIUS), 0.0, 1.0)
    if along < 0.0:
      o.done = o.done + 1
      o.through = 0.0
  o.gap = widest(s, o)
  if o.pull > o.damage:
    return o, -1.0, r.DAMAGED
  todo = number // 2 - o.placed
  part = float(o.done - o.placed)
  if o.done < number // 2:
    first = now(o)
    far = r.length(n.arc(s, 1.0) - place(s, o, first + min(max(o.holes - first, 0), 1)))
    if o.holes <= 2 * o.done:
      part = part + 0.3 * r.closeness(far, o.start0)
    elif o.holes == 2 * o.done + 1:
      part = part + 0.4 + 0.2 * r.closeness(far, 2.0 * BITE)
    else:
      part = part + 0.6 + 0.4 * o.through
  closing = r.clamp((o.gap0 - o.gap) / (o.gap0 - o.close), 0.0, 1.0)
  progress = 0.7 * part / float(todo) + 0.3 * closing * float(o.done) / float(number // 2)
  o.closed = o.closed + o.control_timestep if o.gap < o.close else 0.0
  if count < 2 * o.done or worst > o.tolerance or o.loose > n.LOST:
    return o, progress, r.MISSED
  if o.done == number // 2 and o.closed > HELD - 1e-5:
    return o, progress, r.SUCCESS
  return o, progress, r.RUNNING


def observe(s, o):
  """Finds where the needle is from the stitch whose turn it is."""
  middle = r.needle_place(s, r.vector(0.0, 0.0, 0.0))
  first = now(o)
  start, end = place(s, o, first), place(s, o, first + 1)
  o.target = place(s, o, first + min(max(o.holes - first, 0), 1)) - n.arc(s, 1.0)
  o.way = (end - start) / r.length(end - start)
  o.circle = r.needle_place(s, r.vector(0.0, 0.0, 1.0)) - middle
  o.middle = middle - start
  o.stitches = float(o.done)
  o.pierced = float(max(o.holes - 2 * o.done, 0))
  left = o.left_holds > o.right_holds
  return n.in_jaws(s, o, 0 if left else 1, _BACK if left else _FRONT, 0.01)


def mark(s, o, k):
  """Marks the holes that are left, the next one in yellow."""
  return place(s, o, k) + r.vector(0.0, 0.0, n.MARK), r.shown(k, o.holes)


@exercise("suture/running_easy", 40, "easy", "bimanual",
          asks="Place the last of four stitches within 3 mm of its marks, and close the cut",
          scene=FIELD, placed=3, tolerance=0.003)  # fmt: skip
@exercise("suture/running_standard", 80, "bimanual",
          asks="Place two of four stitches within 2 mm of their marks, and close the cut",
          scene=FIELD, placed=2, tolerance=0.002, jitter=0.002)  # fmt: skip
@exercise("suture/running_hard", 150, "hard", "bimanual",
          asks="Place three of them within 1.5 mm, in the wall of a stomach that is stretched more",
          scene=FIELD, tension=50.0, over=("stomach", "body"), placed=1, tolerance=0.0015,
          jitter=0.003)  # fmt: skip
class Running(n.Stitching):
  """Close a cut with a running suture."""

  rules = r.Rules(
    State,
    advance,
    observe,
    ("target", "way", "circle", "middle", "stitches", "pierced", "through", "gap", "tight",
     "right_holds", "left_holds", "hand_target", "hand_circle", "hand_along"),
    metrics={"peak_traction": "pulled", "bite_depth": "deepest", "regrasps": "regrasps",
             "final_gap": "gap", "peak_tension": "tightest", "tearing": "torn"},
    columns={"traction": "pull", "bite": "deepest", "regrasped": "regrasps", "gap": "gap",
             "tension": "tight", "torn": "torn"},
    mark=mark,
  )  # fmt: skip
  targets = 2 * STITCHES

  def __init__(
    self,
    *,
    scene: Scene,
    placed: int,
    tolerance: float,
    close: float = CLOSED,
    tension: float = TENSION,
    over: tuple[str, str] | None = None,
    **kwargs,
  ):
    """Makes the task.

    Args:
      scene: of the exercise
      placed: number of the four stitches that are placed at the start
      tolerance: largest distance of holes from their marks [m]
      close: largest gap of a closed cut [m]
      tension: of the wall [N/m]
      over: organ and landmark whose wall it is, with its filling; None for a flat one
      **kwargs: see Task
    """
    self.placed, self.tolerance, self.close = placed, tolerance, close
    self.tension, self.over = tension, over
    self.edges = sheet.slit(*sheet.sheet(kwargs.get("nodes") or scene.nodes), CUT)[2]
    self.pairs = len(self.edges)
    super().__init__(scene=scene, **{"force_limit": 3.0, "damage": 8.0, **kwargs})

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene: a wall with a cut in a frame, and the needle with its thread."""
    tissue = n.WALL | {"needles": f"needle {_TOUGH:g} {n.FRICTION:g}", "tension": self.tension}
    tissue |= {"foundation": _FILLING} if self.over else {}
    scene = self._scene(variant)
    spec = sheet.stretched(scene, tissue, _MASS, slots=_SLOTS, span=CUT, over=self.over)
    spec.option.gravity = np.zeros(3)
    self.meet(spec)
    apart = np.array([0.1, 0.0, -0.05])  # until an episode begins
    nodes = (
      apart + (0.0, 0.0, -n.RADIUS) + np.arange(round(THREAD / EDGE) + 1)[:, None] * (0, 0, -EDGE)
    )
    meets = {"contype": 0, "conaffinity": 0}
    palpate.add_thread(spec, nodes, "suture", material="polypropylene", bead=_BEAD, contact=meets)
    meets = {"contype": 1 | n.MEETS, "conaffinity": 1 | n.MEETS}
    palpate.add_needle(spec, pos=tuple(apart), quat=(1, 1, 0, 0), thread="suture", contact=meets)
    return spec

  def _stage(self, spec: mujoco.MjSpec) -> Stage:
    """Returns the stage: the cut gapes, and the stitches that are placed are sewn."""
    made = super()._stage(spec)
    data = mujoco.MjData(made.model)
    mujoco.mj_setState(made.model, data, made.state, STATE)
    mujoco.mj_forward(made.model, data)
    organ = palpate.Organ(made.model, data, self.organ)
    seat, share = _seats(organ.xpos0, organ.elem, self._planned(organ.xpos0))
    at = (share[..., None] * organ.xpos[organ.elem[seat]]).sum(axis=1)
    self.held = n.piercing(at[2 * self.placed :], -math.radians(60.0))
    self.held = self.held[0] + np.array([-0.003, 0.0, _HIGH]), self.held[1]
    pos, mat = self.held
    data.joint("needle").qpos[:] = np.concatenate([pos, trocar.orientation(mat)])
    mujoco.mj_forward(made.model, data)
    line = _laid(at[: 2 * self.placed], pos - n.RADIUS * mat[:, 1])
    palpate.Thread(made.model, data, "suture").lay(line)
    organ.sew("needle")
    data.qvel[:] = 0
    mujoco.mj_getState(made.model, data, made.state, STATE)
    return made

  def _planned(self, rest: np.ndarray) -> np.ndarray:
    """Returns the marks at rest before they are drawn [m]  (2 * STITCHES, 3)."""
    x, y, _ = rest[self.edges[:, 0]].mean(axis=0)
    rows = y + PITCH * (np.arange(STITCHES) - (STITCHES - 1) / 2)
    return np.array([[x + side * BITE, row, 0.0] for row in rows for side in (-1, 1)])

  def begin(self, physics: Physics) -> None:
    """Draws the marks and how the right hand holds the needle."""
    rest, elem = physics.organ.xpos0, physics.organ.elem
    self.marks, first = self._planned(rest), 2 * self.placed
    todo = self.random.uniform(-0.001, 0.001, (STITCHES - self.placed, 1, 2))
    each = self.random.uniform(-0.0005, 0.0005, (STITCHES - self.placed, 2, 2))
    self.marks[first:, :2] += (todo + each).reshape(-1, 2)
    self.seat, self.shares = _seats(rest, elem, self.marks)
    self.lips = np.array([_corner(elem, v) for v in self.edges.ravel()]).reshape(-1, 4)
    self.holes, self.done, self.misses = first, self.placed, np.zeros(self.targets)
    self.pull = self.pulled = self.deepest = self.tight = self.tightest = self.torn = 0.0
    self.closed = self.through = self.stitches = self.pierced = 0.0
    self.target, self.way, self.circle, self.middle = np.zeros((4, 3))
    self.gap = self.gap0 = widest(physics, self)
    angle, tilt = n.RIGHT
    tip = self.take_up(physics, self.held, angle, lean=0.0, along=0.08, side=-1.0, tilt=tilt)
    self.start0 = float(np.linalg.norm(tip - place(physics, self, first)))
    self.aims = -1, np.zeros((2, 3))  # of the expert, see `_ends`
    _, second = physics.hands
    port, aside = second.trocar(), self.random.uniform(-0.005, 0.005, 3)
    pos, turn = n.park(port)
    second.set_joints(wrist.inverse(port, pos + aside, turn))

  def label(self, kind: str) -> str:
    """Returns what an event of the rules is called."""
    lost = self.loose > n.LOST or self.misses.max() > self.tolerance
    return "a stitch came out" if kind == "missed" and not lost else super().label(kind)

  def instruct(self, physics: Physics) -> str:
    """Says what is next."""
    if self.done == STITCHES:
      return "Pull the thread until the cut is closed, and hold it"
    which = f"stitch {self.done + 1} of {STITCHES}"
    return (
      f"Bring the needle's tip to the yellow mark of {which}, and turn it in",
      "Turn the needle about its circle, to the yellow mark",
      "Take the needle's tip with the left hand, and draw it through",
    )[min(max(self.holes - 2 * self.done, 0), 2)]

  def expert(self, p: Performer) -> Script:
    """Drives each stitch with the right hand, draws it through with the left one, and pulls."""
    assert p.other
    while self.outcome is None:
      out = self.holes == 2 * self.done + 2
      if self.done == STITCHES:
        yield from n.one(p, p.other, self._pull(p.other, lambda: self.outcome is not None))
      elif out and self.left_holds and (self.right_holds or n.lingers(p)):
        yield from n.one(p, p, n.let_go(p))
      elif self.left_holds and (out or (p.hasty and self._seam(p.physics) > _UNDRAWN)):
        yield from n.one(p, p.other, self._draw(p.other))
      elif not out and self.right_holds and (self.left_holds or n.lingers(p.other)):
        yield from n.one(p, p.other, n.let_go(p.other))
      elif self.left_holds:
        yield from n.one(p, p.other, self._hand(p.other))
        yield from n.one(p, p, n.take(p, *n.RIGHT))
      elif self.right_holds and out and self._angle(p) > n.OUT - 0.1:
        yield from n.one(p, p.other, n.take(p.other, *n.LEFT))
      elif self.right_holds:
        yield from n.one(p, p, self._drive(p))
      else:
        yield from p.wait(0.1)

  def _ends(self, p: Performer) -> np.ndarray:
    """Returns where the marks of the stitch are whose turn it is [m]  (2, 3).

    They are those before the needle is in: a hand that followed the wall would draw it along.
    """
    first = now(self)
    if self.holes <= first or self.aims[0] != first:
      self.aims = first, np.array([place(p.physics, self, first + k) for k in range(2)])
    return self.aims[1]

  def _angle(self, p: Performer) -> float:
    """Returns the angle of the needle's tip, see `piercing`."""
    return n.tip_angle(p.physics, self._ends(p))

  def _drive(self, p: Performer) -> Script:
    """Puts the needle over the first mark, and turns it about its circle through both."""
    if self.holes <= 2 * self.done:
      yield from n.approach(p, self._ends(p), math.radians(14.0))
    while self.holes < 2 * self.done + 2 or self._angle(p) < n.OUT - 0.02:
      yield from n.turn_on(p, self._ends(p), max(n.OUT, self._angle(p) + 0.2))

  def _draw(self, p: Performer) -> Script:
    """Turns the needle out of the wall, and draws the thread after it."""
    end = n.half_angle(self._ends(p)) + math.radians(185.0)

    def inside() -> bool:
      return self.holes == 2 * self.done + 2

    while inside() and self._angle(p) < end - 0.05:
      yield from n.turn_on(p, self._ends(p), end)
    while inside():  # not of a hole that is lost
      yield from p.line(p.tip + np.array([0.001, 0.0, 0.002]), 0.02)
    # Who has closed the cut pulls no harder, see below.
    yield from self._pull(p, lambda: self.tight > _TAUT or self._shut(p.physics))

  def _hand(self, p: Performer) -> Script:
    """Brings the needle over the next stitch, to where the right hand can take it."""
    up, (pos, mat) = np.array([0.0, 0.0, 1.0]), n.piercing(self._ends(p), math.radians(90.0))
    goal = pos + _OVER * up, mat

    def there() -> bool:
      return n.over(p, n.needle(p.physics), goal, up)

    yield from n.come(n.carry(p, lambda t: (goal[0] + 0.01 * up, mat)), there)
    if not there() or n.needle(p.physics)[0][2] > goal[0][2] + n.NARROW:
      yield from n.carry(p, lambda t: goal)
      yield from n.arrive(p)

  def _pull(self, p: Performer, enough: Callable[[], bool]) -> Script:
    """Draws the thread through until it has little slack, and pulls at it until that is enough."""
    most = _PULL * self.tension / TENSION * p.style.force
    while not enough():
      most += _MORE * p.dt  # nobody stops short of what is wanted
      if self.gap < _SHUT * self.close:
        most = min(most, self.tight)
      careful = p.care * float(np.clip(0.05 * (most - self.tight), -0.01, 0.025))
      speed = _DRAWN * p.style.speed if self._slack(p.physics) > _LITTLE else careful
      p.tip = p.tip + speed * p.dt * _WAY
      yield p.step()

  def _shut(self, physics: Any) -> bool:
    """Returns whether the cut is closed more than is asked for, by a thread with little slack."""
    return bool(self.gap < _SHUT * self.close and self._slack(physics) < _LITTLE)

  def _slack(self, physics: Any) -> float:
    """Returns how much longer the thread is from its first hole to the needle than the way [m]."""
    holes = physics.needle().holes
    way = np.array([*(hole.at for hole in holes), n.arc(physics, 0.0)])
    return -holes[0].along - _along(way) if holes else 0.0

  def _seam(self, physics: Any) -> float:
    """Returns how much longer the thread is than the way from its first hole to its last [m]."""
    holes = physics.needle().holes
    way = np.array([hole.at for hole in holes])
    return holes[-1].along - holes[0].along - _along(way) if holes else 0.0


def _seats(rest: np.ndarray, elem: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the triangle of each of some places of a flat wall (n,), and shares in it (n, 3)."""
  a, b, c = (rest[elem[:, k], :2] for k in range(3))
  sides = np.stack([b - a, c - a], axis=2)
  share = np.linalg.solve(sides, (at[:, None, :2] - a)[..., None])[..., 0]
  share = np.concatenate([1 - share.sum(axis=2, keepdims=True), share], axis=2)
  seat = share.min(axis=2).argmax(axis=1)
  return seat, share[np.arange(len(at)), seat]


def _corner(elem: np.ndarray, vertex: int) -> tuple[int, int]:
  """Returns a triangle and the corner of it that a vertex is."""
  triangle, which = np.argwhere(elem == vertex)[0]
  return int(triangle), int(which)


def _laid(holes: np.ndarray, swage: np.ndarray) -> np.ndarray:
  """Returns the line of a thread through holes of stitches, from the swage on [m].

  What is over of it is in a bow over the stitches.
  """
  deep, share = 0.0015, np.linspace(0.0, 1.0, 100)
  line = [holes[0] + (1 - share[:-1, None]) * (0.0, 0.0, _TAIL)]
  for k, (start, end) in enumerate(itertools.pairwise(holes)):
    down = (1 if k % 2 else -1) * deep * np.sin(np.pi * share)
    line.append(start + share[:-1, None] * (end - start) + down[:-1, None] * (0.0, 0.0, 1.0))
  top = holes[-1] + share[:, None] * (0.0, 0.0, _RISE)
  seam = np.concatenate([*line, top])
  over = THREAD - _along(seam)

  def left(angle: float) -> float:
    return over - _along(_bow(swage, seam[-1], angle))

  found = scipy.optimize.root_scalar(left, bracket=(0.1, math.pi - 0.1))
  return np.concatenate([_bow(swage, seam[-1], found.root), seam[-2::-1]])


def _along(line: np.ndarray) -> float:
  """Returns the length of a line [m]."""
  return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def _bow(start: np.ndarray, end: np.ndarray, angle: float) -> np.ndarray:
  """Returns an arc of twice an angle [rad] between two points, over the wall [m]."""
  chord = start - end
  along, aside = chord / np.linalg.norm(chord), np.array([0.1, -0.8, 0.6])
  aside -= (aside @ along) * along
  aside /= np.linalg.norm(aside)
  radius = 0.5 * np.linalg.norm(chord) / math.sin(angle)
  turn = np.linspace(angle, -angle, 400)[:, None]
  middle = 0.5 * (start + end) - radius * math.cos(angle) * aside
  bow = middle + radius * (np.sin(turn) * along + np.cos(turn) * aside)
  return np.column_stack([bow[:, :2], np.maximum(bow[:, 2], 0.9 * _RISE)])
