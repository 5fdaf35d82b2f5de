"""Scripted performers: an expert for every exercise, and people who differ in stated ways.

`expert` makes no mistake that a script need not make. `tremor`, `overshoot`, `delay`, `force` and
`detour` are scripts that each do one thing badly. `skilled` is a person, another with every seed,
who does everything a little worse than the script: what is within a person's reach is measured
against them. `novice` is a person who does everything worse still.

What to do is the task's method `expert`, beside the task; how it is done, the `Style`, is here.

A performer is made for an environment and called with each time step; it returns the action:

    performer = make(env, seed=0)
    timestep = env.reset()
    while not timestep.last():
      timestep = env.step(performer(timestep))

Scripts see the simulation (targets, triangles, forces), not the observations only: they are
there to show that an exercise can be solved and to be measured against, not to be learned from.
"""

import collections
import dataclasses
import importlib
import math
import os
import sys
from collections.abc import Callable, Generator, Iterator
from typing import Any

import numpy as np
from palpate.models import trocar, wrist

from ..learn import policy
from .environment import Environment
from .instrument import DRIVE_RATES

Act = Callable[[Any], Any]
Script = Iterator[np.ndarray]
Feeling = Generator[np.ndarray, None, float]  # a script that returns what was felt


@dataclasses.dataclass(frozen=True)
class Style:
  """How a performer differs from the expert; the default is the expert.

  Attributes:
    tremor: root mean square of the trembling of the tip in each direction, 4 to 10 Hz [m]
    overshoot: how far a movement goes beyond its end, as a share of its length [-]
    delay: pause before each movement [s]
    force: factor on the forces that are pressed, pulled and gripped with [-]
    detour: how far a movement bends aside, as a share of its length [-]
    speed: factor on the speed of movements [-]
    reaction: how late the hand follows what was decided, and so what was felt [s]
  """

  tremor: float = 0.0
  overshoot: float = 0.0
  delay: float = 0.0
  force: float = 1.0
  detour: float = 0.0
  speed: float = 1.0
  reaction: float = 0.0


EXPERT = Style()
# Each does one thing as badly as novices do: experts sutured three to four times faster on paths a
# third as long (van Sickle et al. 2005, 10.1007/s00464-004-8274-6), and with half the force
# (10.1007/s00464-010-1096-9).
NOVICES = {
  "tremor": Style(tremor=0.0008),
  "overshoot": Style(overshoot=0.5),
  "delay": Style(delay=1.0, speed=0.4),
  "force": Style(force=2.0),
  "detour": Style(detour=1.0),
}
STYLES = {"expert": EXPERT, **NOVICES}
# What is drawn for `skilled`: from a script's steady hand to a person's; ranges of `Style`. Tremor
# of surgeons is 0.14 to 0.29 mm in all directions together (PMC3989364), 1.7 times less in each; a
# long instrument shows more of it.
SKILLED = {
  "tremor": (0.0, 0.0002),
  "overshoot": (0.0, 0.08),
  "delay": (0.0, 0.25),
  "force": (0.85, 1.15),
  "detour": (0.0, 0.15),
  "speed": (0.7, 1.2),
  "reaction": (0.0, 0.15),
}
# What is drawn for `novice`: from where skilled people end to what `NOVICES` do.
NOVICE = {
  "tremor": (0.0002, 0.0006),
  "overshoot": (0.08, 0.5),
  "delay": (0.25, 1.0),
  "force": (1.15, 2.0),
  "detour": (0.15, 1.0),
  "speed": (0.4, 0.7),
  "reaction": (0.15, 0.3),
}
_WIDE = 1.0  # action of the jaw: wide open
_ROLL = 0.8  # of the jaws to grasp, across the gallbladder's slack [rad]
_ASIDE = 0.2  # of the height that it comes down from: how far aside it may be
_THERE, _BEGUN = 0.004, 0.015  # jaws so near to their place may close, or go on closing [m]
_CLOSED = -0.35  # action of the jaw: as far as it closes at once
_FIRMER = 0.4  # by how much it is gripped more each time that it was lost [N]
_SLID = 0.001  # what may move in the jaws unnoticed [m]
_REFLEX, _FIRMEST = 400.0, 3.0  # force for each metre that slides further [N/m], and at most [N]
_TREMOR_HZ = np.array([4.0, 5.3, 7.1, 8.6, 10.0])


def make(env: Environment, who: str | Style = EXPERT, seed: int = 0) -> Act:
  """Returns who acts in an environment, to be called with each time step.

  Args:
    env: of one of the suite's tasks
    who: a `Style`, a name of `STYLES` or of `PEOPLE`, `trained` for the policy that comes with the
      exercise, a file of another, or "module:object": a class is made with (env, seed) and its
      object called with each time step; anything else is called with the observation
    seed: of what is random in a scripted performer
  """
  if isinstance(who, Style):
    return Performer(env, who, seed)
  found = find(who)
  if found in PEOPLE.values():
    found = found(seed)
  if found is trained:
    found = trained(env)
  if isinstance(found, Style):
    return Performer(env, found, seed)
  if isinstance(found, policy.Policy):
    found.check(env)
    return _played(found)
  if not isinstance(found, type):
    return lambda timestep: found(timestep.observation)
  try:
    return found(env, seed)
  except Exception as error:
    raise ValueError(f"policy {who!r}: {type(error).__name__}: {error}") from error


def _played(made: policy.Policy) -> Act:
  """Returns who plays a policy, episode by episode."""
  act = made.begin()

  def play(timestep: Any) -> np.ndarray:
    nonlocal act
    act = made.begin() if timestep.first() else act
    return act(timestep.observation)

  return play


def skilled(seed: int) -> Style:
  """Returns a style drawn from `SKILLED`."""
  return _drawn(SKILLED, seed)


def novice(seed: int) -> Style:
  """Returns a style drawn from `NOVICE`."""
  return _drawn(NOVICE, seed)


PEOPLE = {"skilled": skilled, "novice": novice}


def _drawn(ranges: dict[str, tuple[float, float]], seed: int) -> Style:
  random = np.random.RandomState(seed)
  return Style(**{name: float(random.uniform(*span)) for name, span in ranges.items()})


def trained(env: Environment) -> policy.Policy:
  """Returns the policy that comes with an exercise: of pictures where no state is observed."""
  observed: Any = env.task.observed
  sees = policy.PIXELS in observed.pictures and "state" not in observed.names
  return policy.shipped(env.task.name, sees)


def find(who: str) -> Any:
  """Returns the style or the object that a name stands for; ValueError says what is wrong with it.

  Args:
    who: see `make`
  """
  for found in (*PEOPLE.values(), trained):
    if who == found.__name__:
      return found
  if who.endswith(policy.SUFFIX):
    return policy.load(who)
  if ":" not in who:
    if who not in STYLES:
      names = ", ".join((*STYLES, *PEOPLE, trained.__name__))
      raise ValueError(
        f"performer is {who!r}, expected one of {names}, a file of a "
        f"trained policy (*{policy.SUFFIX}) or module:object"
      )
    return STYLES[who]
  module, _, name = who.partition(":")
  if not module or not name:
    raise ValueError(f"policy is {who!r}, expected module:object")
  if os.getcwd() not in sys.path:
    sys.path.insert(0, os.getcwd())
  try:
    found: Any = importlib.import_module(module)
  except (Exception, SystemExit) as error:
    raise ValueError(f"policy {who!r}: {type(error).__name__}: {error}") from error
  for part in name.split("."):
    if not hasattr(found, part):
      raise ValueError(f"policy {who!r}: {module} has no {name!r}")
    found = getattr(found, part)
  if not callable(found):
    raise ValueError(f"policy {who!r} is a {type(found).__name__}, expected something to call")
  return found


def is_policy(found: Any) -> bool:
  """Returns whether what `find` found is a trained policy, which is of one exercise."""
  return found is trained or isinstance(found, policy.Policy)


class Performer:
  """Follows the script of the environment's task; starts it again with each episode.

  Called first in the middle of an episode, it does what is left to do.

  Attributes:
    hand: the instrument that it moves
    hasty: whether it leaves out what may be left out
    other: who moves the other hand's, None where there is none
  """

  hasty = False

  def __init__(self, env: Environment, style: Style = EXPERT, seed: int = 0, hand: int = 0):
    """Makes a performer in a style, see `make`; `hand` is which of the instruments it moves."""
    self.env, self.style, self._which = env, style, hand
    self.dt = env.control_timestep()  # [s]
    self.physics: Any = env.physics
    self.task: Any = env.task
    self.random = np.random.RandomState(seed)
    self._steps: Script | None = None
    second = self.task.second and not hand
    self.other = type(self)(env, style, seed + 1, hand=1) if second else None

  def __call__(self, timestep: Any) -> np.ndarray:
    """Returns the action for a time step."""
    if timestep.first() or self._steps is None:
      self.begin()
      if self.other:
        self.other.begin()
      script: Script = self.task.expert(self)
      self._steps = script
    try:
      action = next(self._steps)
    except StopIteration:
      self._steps = self.wait(math.inf)
      action = next(self._steps)
    # A script that speaks of one hand leaves the other where it is.
    if self.other and len(action) < len(self.task.components):
      action = np.concatenate([action, self.other.step()])
    return action

  def begin(self) -> None:
    """Takes the instrument as it is when an episode begins."""
    self.hand: Any = self.physics.hands[self._which]
    self.trocar = self.hand.trocar()
    joints = self.hand.drive_targets()
    # Where the tip is told to be, and how it is to be turned: by a wrist, or with the shaft.
    self.tip, self.turn = wrist.forward(self.trocar, joints)
    if not self.trocar.wrist:
      self.tip = trocar.forward(self.trocar, joints[[0, 1, 3]])
    self.roll = float(joints[2])
    self.extra = self.task.still(self._which)
    late = round(self.style.reaction / self.dt)
    still = self.tip, self.roll, self.turn, self.extra.copy()
    self._told = collections.deque([still] * late, maxlen=late + 1)
    self._phase = self.random.uniform(0, 2 * math.pi, (len(_TREMOR_HZ), 3))

  # Words of the scripts.

  def step(self) -> np.ndarray:
    """Returns the action that takes drives or handle towards `tip`, `roll`, `turn`, `extra`."""
    self._told.append((self.tip, self.roll, self.turn, self.extra.copy()))
    tip, roll, turn, extra = self._told[0]  # of the moment that the hand follows now
    if self.style.tremor:
      wave = np.sin(2 * math.pi * _TREMOR_HZ[:, None] * self.physics.time() + self._phase)
      tip = tip + self.style.tremor * math.sqrt(2 / len(_TREMOR_HZ)) * wave.sum(axis=0)
    bent = bool(self.trocar.wrist)
    if self.hand.handle:
      row = [*tip, *trocar.orientation(turn)] if bent else self.hand.handle_row(tip, roll)
      return np.concatenate([row, extra])
    if bent:
      goal = wrist.inverse(self.trocar, tip, turn, float(self.hand.drive_targets()[2]))
    else:
      pitch, yaw, insertion = trocar.inverse(self.trocar, tip, check=False)
      goal = np.array([pitch, yaw, roll, insertion])
    goal = self.drive(goal)
    move = (goal - self.hand.drive_targets()) / (DRIVE_RATES[: len(goal)] * self.dt)
    return np.concatenate([np.clip(move, -1, 1), extra])

  def drive(self, goal: np.ndarray) -> np.ndarray:
    """Returns where the drives go on the way to a goal: there, as fast as they can."""
    return goal

  def both(self, mine: Script, others: Script) -> Script:
    """Does one script with this hand and another with the other, until both are done."""
    assert self.other
    while True:
      first, second = next(mine, None), next(others, None)
      if first is None and second is None:
        return
      first = self.step() if first is None else first
      yield np.concatenate([first, self.other.step() if second is None else second])

  def wait(self, duration: float) -> Script:
    """Holds still for a time [s]."""
    for _ in range(int(min(duration / self.dt, 10**9))):
      yield self.step()

  def move(self, goal: np.ndarray, speed: float = 0.05) -> Script:
    """Moves the tip along a minimum-jerk line; `speed` is its mean [m/s] (Flash, Hogan 1985)."""
    yield from self.wait(self.style.delay)
    start, goal = self.tip.copy(), np.asarray(goal, float)
    length = float(np.linalg.norm(goal - start))
    if length < 1e-6:
      return
    points = [goal]
    if self.style.detour and length > 0.008:
      aside = np.cross(goal - start, self.random.normal(size=3))
      aside *= self.style.detour * length / np.linalg.norm(aside)
      # Bends away from the organ, not into it.
      outward = self.trocar.pos - start
      aside *= math.copysign(1, float(aside @ outward))
      points.insert(0, (start + goal) / 2 + aside)
    if self.style.overshoot and length > 0.008:
      over = goal + self.style.overshoot * (goal - start)
      points.insert(-1, over)
    for point in points:
      yield from self.line(point, speed)

  def above(self, point: np.ndarray, high: float, along: np.ndarray) -> Script:
    """Moves to a height [m] over a point, unless somebody else was on the way down from there."""
    height = float((self.tip - point) @ along)
    aside = float(np.linalg.norm(self.tip - point - height * along))
    if not -_ASIDE * high < height <= high or aside > _ASIDE * high:
      yield from self.move(point + high * along)

  def line(self, goal: np.ndarray, speed: float) -> Script:
    """Moves the tip along such a line at once and straight: a stroke that is known by heart."""
    start, speed = self.tip.copy(), speed * self.style.speed
    steps = max(2, round(float(np.linalg.norm(goal - start)) / speed / self.dt))
    for share in self.shares(steps):
      self.tip = start + (goal - start) * share
      yield self.step()

  def shares(self, steps: int) -> Iterator[float]:
    """Yields the shares of its way that a movement has come after each of so many steps."""
    for k in range(1, steps + 1):
      t = k / steps
      yield 10 * t**3 - 15 * t**4 + 6 * t**5

  def push(self, force: float, along: np.ndarray, until: Callable[[], bool], most=5.0) -> Script:
    """Presses with a force [N] along a direction until a condition or for `most` seconds."""
    contact = 0.0  # time in contact [s]
    for _ in range(round(most / self.care / self.dt)):
      if until():
        return
      measured = float(np.linalg.norm(self.hand.contact_force()))
      contact += self.dt if measured > 0.02 else 0.0
      speed = np.clip(0.06 * (force * self.excess(contact) - measured), -0.02, 0.012)
      self.tip = self.tip + self.care * speed * self.dt * along
      yield self.step()

  @property
  def care(self) -> float:
    """Factor on the speed of pressing: who reacts late and presses fast is always too late."""
    return 1 / (1 + self.style.reaction / 0.05)

  def excess(self, contact: float) -> float:
    """Returns the factor on force: too much at first, then corrected within a second or two."""
    return 1 + (self.style.force - 1) * math.exp(-max(contact - 0.4, 0.0))

  def sink(self, depth: float, point: np.ndarray, along: np.ndarray, until: Callable[[], bool]):
    """Presses to a depth [m] below a point until a condition, for 5 s at most."""
    contact = 0.0
    for _ in range(round(5 / self.care / self.dt)):
      if until():
        return
      now = float((self.hand.tip_pos() - point) @ along)
      contact += self.dt if now > 0 else 0.0
      speed = np.clip(8 * (depth * self.excess(contact) - now), -0.02, 0.015)
      self.tip = self.tip + self.care * speed * self.dt * along
      yield self.step()

  def feel(self, point: np.ndarray, along: np.ndarray, depth: float) -> Feeling:
    """Presses to a depth [m] below a point in one stroke; returns the stiffness felt [N/m]."""
    yield from self.line(point + depth * self.excess(0.0) * along, speed=0.03)
    yield from Performer.wait(self, self.style.reaction + 0.1)  # subclasses too
    force = float(np.linalg.norm(self.hand.contact_force()))
    return force / max(float((self.hand.tip_pos() - point) @ along), 1e-3)

  def close(self, site: int, again: int = 0, grip: float = 1.5) -> Script:
    """Grasps a triangle: opens above it, goes down over it, and closes to a gentle force.

    Args:
      site: the triangle
      again: how often it was lost: it is taken deeper then, and firmer
      grip: force that holds it [N]
    """
    physics, up = self.physics, self.hand.trocar().mat[:, 2]
    self.firm = self._enough = grip + _FIRMER * min(again, 2)
    if self.task.grasped:  # by the performer that had the instrument before
      self.extra[:] = self.share()
      return
    self.roll, deep = _ROLL, min(0.009 + 0.0015 * again, 0.012)

    def off() -> float:
      return float(np.linalg.norm(physics.point(site) - deep * up - self.hand.tip_pos()))

    # What somebody else has begun is ended: where a script changed its mind in the middle, who
    # learns from it would learn the mean of both, and hover with jaws half open.
    share = self.share()
    near = _BEGUN if share > _CLOSED + 0.05 else _THERE
    begun = not again and share < _WIDE - 0.1 and off() < near
    if begun:
      self.extra[:] = share
    else:
      self.extra[:] = _WIDE
      yield from self.above(physics.point(site) - deep * up, 0.012 + deep, up)
      yield from self.wait(0.2)
      yield from self.move(physics.point(site) - deep * up, speed=0.03)
    while self.extra[0] > _CLOSED:
      self.extra[0] -= 3.0 * self.dt
      yield self.step()
    for _ in range(round(2 / self.care / self.dt)):
      if begun and off() > _THERE and not self.hand.holds():
        return
      yield self.step()
      if abs(self._squeeze(0.0, 1.0)) < 0.25 and self.hand.holds():
        return

  def say(self) -> Script:
    """Sets the component that is no motion to 1."""
    self.extra[:] = 1.0
    yield self.step()

  def share(self) -> float:
    """Returns the action of the jaw that is their target now."""
    low, high = self.physics.model.ptr.actuator_ctrlrange[self.hand.jaw]
    return float(2 * (self.hand.gripper()[1] - low) / (high - low) - 1)

  def grip(self, contact: float) -> None:
    """Keeps the force of the jaws, which have held for a time [s]; more where the tissue slides."""
    slid = max(self.task.slid(self.physics) - _SLID, 0.0) if self.task.grasped else 0.0
    self.firm = max(self.firm, min(self._enough + _REFLEX * slid, _FIRMEST))
    self._squeeze(contact, 0.5)

  def _squeeze(self, contact: float, gain: float) -> float:
    """Closes or opens the jaws towards their force; returns what is missing of it [N]."""
    missing = self.firm * self.excess(contact) - float(self.hand.gripper()[2:].max())
    gain *= self.dt
    change = self.care * float(np.clip(gain * missing, -0.5 * gain, 0.5 * gain))
    self.extra[0] = float(np.clip(self.extra[0] - change, -1, -0.3))
    return missing

  def open(self) -> Script:
    """Lets go, gently until nothing is held: a pinched fold would jump."""
    if self.hasty and not (self.task.grasped or self.hand.holds()):
      return  # it was lost, and is grasped again at once
    while self.extra[0] < 0.1:
      self.extra[0] += self.dt * (1.0 if self.hand.gripper()[2:].any() else 3.0)
      yield self.step()
