"""Extracorporeal: push a throw that was tied outside the body down on a slit, with a knot pusher.

FLS task 4. The thread goes through the marks of a slit Penrose drain, see `drain`, and both strands
come up to the hands outside. These are not simulated: each strand's end is on a slide along it and
is drawn with a fixed pull. A throw is laid loosely around both strands, high over the drain. One of
them, the post, goes through the ring of the pusher, which takes the throw down by contact alone. A
throw is seated when it is down, no slack is left below it and the slit is closed to 1 mm, for
0.3 s. With the pusher back at the mark, the hands outside tie the next throw, the other way round.

Own observations, in the world: `target` (3,), from the tip to where the throw is to be, or to the
mark that the pusher is to go back to [m]; `throw` (3,), from the tip to the throw [m]; `gap` (1,),
of the slit [m]; `tension` (1,), the largest of the thread [N]; `seated` (1,), throws that are.

Progress: (seated + 0.9 * closeness of the throw to its seat, 0 at the least) / throws. Success: all
throws are seated; of several the knot is right, see `palpate.tasks.metrics.knots`, and holds in its
test, see `drain.Sewn`, in which no force on the pusher counts. Failure: a knot that is not so, a
thread that breaks or tears out of the drain, a force above the damage limit, or the time limit.

It has no vectorised form: a batch cannot lay a thread and sew it while it runs.
"""

import math
from collections.abc import Callable

import mujoco
import numpy as np
from palpate.models import trocar

from ...core import rules as r
from ...core.base import Physics
from ...core.performer import Performer, Script
from ...core.scenes import CONTACT, Scene
from ...metrics import knots
from ...registry import exercise
from . import drain
from .drain import CLOSED, EDGE, MIDDLE, PULL, STAYS

FIELD = Scene(
  instrument="knot_pusher", port=(0.0, 0.045, 0.11), camera=(0.029, -0.021, 0.033), nodes=400,
)  # fmt: skip
HIGH = 0.010  # of a throw that is laid over what it is to be pushed to [m]
_HANDS = np.array([0.0, -0.006, 0.026])  # from the stitch to between the hands outside [m]
_APART = 0.008  # of these [m]
_MASS, _DAMPING = 0.02, 5.0  # of each, on its slide [kg], [N s/m]
# Of a throw that is laid: from the strands to its middle, and its length [m].
_LOOSE, _LONG = 2.5e-4, 0.0024  # the length is that of three half turns
# Friction of the ring on any thread: with silk's it would drag both strands along.
_POLISHED = 0.1
_TURNS = 121  # points that it is laid with
_PAST = 6e-4  # from strands that cross over it to between them [m]
_TOUCH = 1.5 * EDGE  # between nodes of strands that touch [m]
_SEAT = 0.003  # a throw no higher over the holes is down [m]
_SNUG = 0.0018  # of a strand in a throw that is drawn tight, at most, for each half turn [m]
_TRIES, _LIFT = 6, np.array([0.0, 0.0, 0.002])  # of the expert at a throw, and between them [m]
_THERE = 0.002  # from the mark, where throws are laid [m]
_MARK = 0.018  # height of the mark over the drain [m]


@exercise("suture/extracorporeal_easy", 15, "easy",
          asks="Push one throw down, and close the slit to 1 mm",
          scene=FIELD, turns=(1,))  # fmt: skip
@exercise("suture/extracorporeal_standard", 30,
          asks="Push down two throws, a square knot that holds 0.6 N",
          scene=FIELD, turns=(1, 1))  # fmt: skip
@exercise("suture/extracorporeal_hard", 45, "hard",
          asks="Push down three throws, the first double, a surgeon's knot that holds 0.6 N",
          scene=FIELD, turns=(2, 1, 1))  # fmt: skip
class Extracorporeal(drain.Sewn):
  """Push throws down with a knot pusher."""

  def __init__(self, **kwargs):
    """Makes the task; see `Sewn`."""
    super().__init__(**{"force_limit": 3.0, "damage": 6.0, **kwargs})

  def spec(self, variant: int | None) -> mujoco.MjSpec:
    """Returns the scene: the drain, its thread, and a slide for each of its ends."""
    line = _line(*strands(HIGH, 1))
    count = int(np.linalg.norm(np.diff(line, axis=0), axis=1).sum() / EDGE) + 1
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    nodes = np.stack([np.interp(EDGE * np.arange(count), along, c) for c in line.T], axis=1)
    spec = drain.build(self._scene(variant), nodes)
    for name, node, way in _ends(count):
      hand = spec.worldbody.add_body(name=name, pos=nodes[node], gravcomp=1)
      hand.add_geom(size=[1e-3, 0, 0], mass=_MASS, contype=0, conaffinity=0, rgba=(0, 0, 0, 0))
      slide = mujoco.mjtJoint.mjJNT_SLIDE
      hand.add_joint(name=name, type=slide, axis=way, damping=_DAMPING)
      motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
      motor.set_to_motor()
      spec.add_equality(
        name=name, type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_BODY,
        name1=name, name2=f"{drain.THREAD}_{node}", solref=[0.002, 1],
      )  # fmt: skip
    for geom in spec.geoms:
      if geom.name.startswith(f"{self.prefix}ring"):
        geom.priority, geom.friction[0] = 1, _POLISHED
        geom.solref, geom.solimp[:3] = CONTACT["solref"], CONTACT["solimp"]
    return spec

  def begin(self, physics: Physics) -> None:
    """Lays the first throw, and puts the pusher's ring around the post above it."""
    super().begin(physics)
    # The way round of the first throw. The pusher takes the post past the tail on the side of +y,
    # where it comes from: a left-handed second throw lies flat so, another one capsizes.
    self.hand = int(self.random.choice([-1, 1])) if self.throws == 1 else 1
    post, tail = strands(HIGH + self.random.uniform(-0.001, 0.001), self.hand, self.turns[0])
    places = drain.sew(physics.organ, _line(post, tail)).positions
    ring = post[-2] + self.random.uniform(0.5, 0.6) * (post[-1] - post[-2])
    physics.set_joints(np.insert(trocar.inverse(physics.trocar(), ring), 2, 0.0))
    self.pull(physics, PULL)
    self.joints = {
      name: np.array([(places[node] - physics.model.ptr.body(name).pos) @ way])
      for name, node, way in _ends(len(places))
    }
    self.laid, self.stayed = 1, 0.0
    self.high0 = HIGH
    self.below = self.sunk = 0.0
    self.slack = False
    self.knot, self.right = "", False
    self.stitch, self.throw = MIDDLE, post[1:-1].mean(axis=0)

  def pull(self, physics: Physics, force: float) -> None:
    """Draws both strands with a force [N]."""
    for name, *_ in _ends(0):
      physics.data.ctrl[physics.model.ptr.actuator(name).id] = force

  def look(self, physics: Physics) -> None:
    """Finds the throw too."""
    super().look(physics)
    if not self.whole:
      return
    assert physics.thread
    places, holes = physics.thread.positions, physics.organ.pinholes
    self.stitch = np.mean([hole.at for hole in holes], axis=0)
    # It slides in its holes: what is outside of them now.
    first, second = sorted(int(-hole.along / EDGE) for hole in holes)
    self.sides = np.arange(first, -1, -1), np.arange(second + 1, len(places))
    post, tail = (places[side] for side in self.sides)
    near = np.linalg.norm(post[:, None] - tail[None], axis=2) < _TOUCH
    ring = np.linalg.norm(post - physics.tip_pos(), axis=1).argmin()
    rows = np.flatnonzero(near[: ring + 1].any(axis=1))  # no throw is beyond it
    self.throw = post[rows[-1]] if len(rows) else 0.5 * (post[0] + tail[0])
    self.below = EDGE * max(rows[-1], np.flatnonzero(near[rows[-1]])[0]) if len(rows) else 0.0

  def advance(self, physics: Physics) -> float:
    """Follows the throw down; see the module's head."""
    self.look(physics)
    if self.seated < self.throws and self.lost(physics):
      return -1.0
    high = float(self.throw[2] - self.stitch[2])
    waits = self.laid == self.seated
    snug = _SNUG * (2 * self.turns[self.laid - 1] + 1)
    self.slack = high < _SEAT and self.below - self.sunk > snug
    down = high < _SEAT and self.gap < CLOSED and not self.slack
    self.stayed = self.stayed + self.control_timestep if down and not waits else 0.0
    if self.stayed > STAYS - 1e-6:
      self.seated, self.stayed, self.sunk = self.seated + 1, 0.0, self.below
      self.event(physics, "target", self.gap, "throw")
      waits = True
    if self.seated == self.throws:
      return self.judge(physics)
    if waits:
      if physics.tip_pos()[2] > drain.HIGH + _MARK:
        self.tie(physics)
      return self.seated / self.throws
    return (self.seated + 0.9 * max(r.closeness(high, self.high0), 0.0)) / self.throws

  def judge(self, physics: Physics) -> float:
    """Lets the strands go and pulls the stitch apart: is the knot right, and does it hold?"""
    if self.throws == 1:
      self.outcome = "success"
      return 1.0
    assert physics.thread
    if not self.free:
      self.pull(physics, 0.0)
      places = knots.closed(physics.thread.positions, np.array([-1.0, 0.0, 0.0]))
      self.knot = knots.name(places)
      self.right = knots.same(knots.throws(places) or (), self.turns)
    # A stitch that gives way in the test throws thread at the pusher: not the trainee's doing.
    steps = len(physics.forces()["force"])
    physics.keep(np.zeros((steps, physics.model.nsensordata)))
    _, outcome = drain.pull_test(physics, self)
    if outcome == r.RUNNING:
      return 0.95
    if self.right and outcome == r.SUCCESS:
      self.outcome = "success"
      return 1.0
    self.outcome = "missed"
    self.event(physics, "note", label=self.label("missed") if self.right else "a wrong knot")
    return 0.95

  def tie(self, physics: Physics) -> None:
    """Lays the next throw over the last one, the other way round, as the hands outside tie it."""
    thread = physics.thread
    assert thread
    places = thread.positions
    top = float(self.throw[2])
    hand = self.hand * (-1) ** self.laid
    lines = again([places[side] for side in self.sides], top, hand, self.turns[self.laid])
    for side, (first, line) in zip(self.sides, lines, strict=True):
      thread.lay(line, side[first:].tolist(), PULL)
    for name, node, way in _ends(len(places)):
      place = thread.positions[node] - physics.model.ptr.body(name).pos
      physics.data.joint(name).qpos[0] = place @ way
      physics.data.joint(name).qvel[0] = 0.0
    self.laid += 1
    physics.forward()
    self.look(physics)
    self.high0 = float(self.throw[2] - self.stitch[2])

  def observe(self, physics: Physics) -> dict[str, np.ndarray]:
    """Returns where the throw is and where it is to go."""
    tip, goal = physics.tip_pos(), self.stitch
    if self.laid == self.seated:
      goal = self.mark
    return {
      "target": goal - tip,
      "throw": self.throw - tip,
      "gap": np.array([self.gap]),
      "tension": np.array([self.tension]),
      "seated": np.array([float(self.seated)]),
    }

  @property
  def mark(self) -> np.ndarray:
    """Where the pusher is to go back to [m]  (3,)."""
    share = (drain.HIGH + _MARK + 0.002 - MIDDLE[2]) / _HANDS[2]
    return MIDDLE + share * (_HANDS - np.array([0.5 * _APART, 0.0, 0.0]))

  def show(self, physics: Physics) -> None:
    """Marks where the pusher is to go back to."""
    waits = self.laid == self.seated < self.throws
    physics.mark(0, self.mark, waits, waits, 0.001)

  def instruct(self, physics: Physics) -> str:
    """Says what is next."""
    if self.laid == self.seated < self.throws:
      return "Take the pusher back up to the yellow mark"
    if self.slack:
      return "Slack is left below the throw: lift the pusher a little, and push again"
    return f"Push throw {self.laid} of {self.throws} down until the slit is closed"

  def expert(self, p: Performer) -> Script:
    """Takes the ring down the post, presses each throw home, and goes back up."""
    while self.outcome is None:
      laid = self.laid
      if self.seated < laid:  # not of who goes on where another has pressed it home
        yield from self._press(p, laid)
      # After the last one too: a drain whose stitch gives way in the test strikes what is near.
      yield from p.move(self.mark, speed=0.03)
      yield from _until(p, 0.5, lambda laid=laid: self.laid > laid)

  def _press(self, p: Performer, laid: int) -> Script:
    """Takes the ring down, and presses the throw that was laid last until it is home."""
    if math.dist(p.tip, self.mark) < _THERE:  # strands that were just laid draw straight: all wait
      yield from Performer.wait(p, 0.2)
    goal = np.array([0.0, 0.0, drain.HIGH + 0.001])
    yield from p.move(goal, speed=0.02)
    # On a double throw others lock loose: they are let go and drawn tight before they stay.
    loose = 2 if self.turns[0] > 1 and laid > 1 else 0
    for k in range(_TRIES):
      yield from _until(p, 0.5 * STAYS if k < loose else 0.8, lambda: self.seated == laid)
      if self.seated == laid:
        break
      # A throw that is pressed on locks. Let go, it slides on and the hands draw the slack up.
      yield from p.line(goal + _LIFT, speed=0.02)
      yield from p.line(goal, speed=0.02)


def _until(p: Performer, most: float, done: Callable[[], bool]) -> Script:
  """Holds still until a condition, or for a time [s]."""
  for _ in range(round(most / p.dt)):
    if done():
      return
    yield p.step()


# Strands, and throws around them.


def strands(high: float, hand: int, turns: int = 1) -> tuple[np.ndarray, np.ndarray]:
  """Returns post and tail from the marks to the hands, with a throw at a height over the stitch.

  Args:
    high: of the throw's middle [m]
    hand: 1 for a right-handed throw, -1 for a left-handed one
    turns: of the throw
  """
  lean = high / _HANDS[2] * _HANDS
  out = []
  for side, turn in zip((1, -1), twist(MIDDLE + lean, hand, turns), strict=True):
    start = MIDDLE + np.array([0.5 * drain.BITE * side, 0.0, 0.0])
    end = MIDDLE + _HANDS - np.array([0.5 * _APART * side, 0.0, 0.0])
    out.append(np.concatenate([[start], turn, [end]]))
  return out[0], out[1]


def twist(middle: np.ndarray, hand: int, turns: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns two strands that wind about each other by 2 turns + 1 half turns, from +x and from -x.

  They go in below and come out above, on the other side.
  """
  half = 2.0 * turns + 1.0
  u = np.linspace(0.0, 1.0, _TURNS)
  angle = half * np.pi * u
  x, y, z = half / 3.0 * _LONG * (0.5 - u), hand * _LOOSE * np.sin(angle), -_LOOSE * np.cos(angle)
  return middle + np.stack([x, y, z], axis=1), middle + np.stack([-x, -y, z], axis=1)


def again(
  strands: list[np.ndarray], top: float, hand: int, turns: int = 1
) -> list[tuple[int, np.ndarray]]:
  """Returns where strands are laid anew for another throw: from which of their nodes on, and how.

  Args:
    strands: nodes from the marks up, of post and tail  (n, 3) each
    top: height of the throw before [m]
    hand: see `strands`
    turns: of the throw
  """
  low, high = top + 0.002, top + HIGH + 0.002
  first = [int((strand[:, 2] > low).argmax()) for strand in strands]
  last = [int((strand[:, 2] > high).argmax()) for strand in strands]
  base = [strand[k] for strand, k in zip(strands, first, strict=True)]
  ends = [strand[k] for strand, k in zip(strands, last, strict=True)]
  below, above = np.mean(base, axis=0), np.mean(ends, axis=0)
  wound = twist(below + 0.4 * (above - below), hand, turns)
  wound = wound if base[0][0] > base[1][0] else wound[::-1]
  out = []
  for k in (0, 1):
    cross = wound[k][-1] + 0.3 * (ends[k] - wound[k][-1])
    cross[1] += _PAST * (1 - 2 * k)
    line = np.concatenate([[base[k]], wound[k], [cross], strands[k][last[k] :]])
    out.append((first[k], line))
  return out


def _line(post: np.ndarray, tail: np.ndarray) -> np.ndarray:
  """Returns the line of the whole thread from the post's end on [m]  (n, 3)."""
  return np.concatenate([post[::-1], tail])


def _ends(count: int) -> tuple[tuple[str, int, np.ndarray], ...]:
  """Returns for each hand outside its name, the node of the thread in it, and its slide's way."""
  post, tail = strands(HIGH, 1)
  ways = [(strand[-1] - strand[-2]) for strand in (post, tail)]
  ways = [way / np.linalg.norm(way) for way in ways]
  return ("hand_post", 0, ways[0]), ("hand_tail", count - 1, ways[1])
