"""Scripted performers: an expert for every exercise, and novices that differ in stated ways.

A performer is made for an environment and called with each time step; it returns the action:

    performer = make(env, seed=0)
    timestep = env.reset()
    while not timestep.last():
      timestep = env.step(performer(timestep))

Scripts see the simulation (targets, triangles, forces), not the observations only: they are
there to show that an exercise can be solved and to be measured against, not to be learned from.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from dm_control.rl import control
from palpate.models import trocar

from .base import AXES, CONTROL_TIMESTEP, RATES
from .grasp import Grasp
from .probe import Palpate, Press
from .retract import Retract
from .touch import Touch
from .trace import Trace

Script = Iterator[np.ndarray]


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
  """

  tremor: float = 0.0
  overshoot: float = 0.0
  delay: float = 0.0
  force: float = 1.0
  detour: float = 0.0
  speed: float = 1.0


EXPERT = Style()
NOVICES = {
  "tremor": Style(tremor=0.0008),
  "overshoot": Style(overshoot=0.25),
  "delay": Style(delay=0.6, speed=0.6),
  "force": Style(force=2.0),
  "detour": Style(detour=0.5),
}
STYLES = {"expert": EXPERT, **NOVICES}
_TREMOR_HZ = np.array([4.0, 5.3, 7.1, 8.6, 10.0])


def make(
  env: control.Environment, style: str | Style = EXPERT, seed: int | np.random.RandomState = 0
) -> "Performer":
  """Returns the performer of an environment's task.

  Args:
    env: of one of the suite's tasks
    style: a `Style`, or a name of `STYLES`
    seed: of what is random in the performer
  """
  if isinstance(style, str):
    if style not in STYLES:
      raise ValueError(f"performer is {style!r}, expected one of {', '.join(STYLES)}")
    style = STYLES[style]
  for kind, script in _SCRIPTS.items():
    if isinstance(env.task, kind):
      return Performer(env, script, style, seed)
  raise ValueError(f"no script for a task of type {type(env.task).__name__}")


class Performer:
  """Follows a script; starts it again with each episode."""

  def __init__(
    self,
    env: control.Environment,
    script: Callable[["Performer"], Script],
    style: Style = EXPERT,
    seed: int | np.random.RandomState = 0,
  ):
    """Makes a performer of `script` in a style; see `make`."""
    self.env, self.style = env, style
    self.physics: Any = env.physics
    self.task: Any = env.task
    self.random = seed if isinstance(seed, np.random.RandomState) else np.random.RandomState(seed)
    self._script, self._steps = script, None

  def __call__(self, timestep: Any) -> np.ndarray:
    """Returns the action for a time step."""
    if timestep.first() or self._steps is None:
      self.trocar = self.physics.trocar()
      joints = self.physics.drive_targets()[[0, 1, 3]]
      self.tip = trocar.forward(self.trocar, joints)  # where the tip is told to be
      self.roll = float(self.physics.drive_targets()[2])
      self.extra = np.zeros(len(self.task.components) - len(AXES))
      self._phase = self.random.uniform(0, 2 * math.pi, (len(_TREMOR_HZ), 3))
      self._steps = self._script(self)
    try:
      return next(self._steps)
    except StopIteration:
      self._steps = self.wait(math.inf)
      return next(self._steps)

  # Words of the scripts.

  def step(self) -> np.ndarray:
    """Returns the action that takes the drives towards `tip`, `roll` and `extra`."""
    tip = self.tip
    if self.style.tremor:
      wave = np.sin(2 * math.pi * _TREMOR_HZ[:, None] * self.physics.time() + self._phase)
      tip = tip + self.style.tremor * math.sqrt(2 / len(_TREMOR_HZ)) * wave.sum(axis=0)
    pitch, yaw, insertion = trocar.inverse(self.trocar, tip, check=False)
    goal = np.array([pitch, yaw, self.roll, insertion])
    move = (goal - self.physics.drive_targets()) / (np.array(RATES) * CONTROL_TIMESTEP)
    return np.concatenate([np.clip(move, -1, 1), self.extra])

  def wait(self, duration: float) -> Script:
    """Holds still for a time [s]."""
    for _ in range(int(min(duration / CONTROL_TIMESTEP, 10**9))):
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
      yield from self._line(point, speed * self.style.speed)

  def _line(self, goal: np.ndarray, speed: float) -> Script:
    start = self.tip.copy()
    steps = max(2, round(float(np.linalg.norm(goal - start)) / speed / CONTROL_TIMESTEP))
    for k in range(1, steps + 1):
      s = k / steps
      self.tip = start + (goal - start) * (10 * s**3 - 15 * s**4 + 6 * s**5)
      yield self.step()

  def push(self, force: float, along: np.ndarray, until: Callable[[], bool], most=5.0) -> Script:
    """Presses with a force [N] along a direction until a condition or for `most` seconds."""
    contact = 0.0  # time in contact [s]
    for _ in range(round(most / CONTROL_TIMESTEP)):
      if until():
        return
      measured = float(np.linalg.norm(self.physics.contact_force()))
      contact += CONTROL_TIMESTEP if measured > 0.02 else 0.0
      speed = np.clip(0.06 * (force * self.excess(contact) - measured), -0.02, 0.012)
      self.tip = self.tip + speed * CONTROL_TIMESTEP * along
      yield self.step()

  def excess(self, contact: float) -> float:
    """Returns the factor on force: too much at first, then corrected within a second or two."""
    return 1 + (self.style.force - 1) * math.exp(-max(contact - 0.4, 0.0))

  def sink(self, depth: float, point: np.ndarray, along: np.ndarray, until: Callable[[], bool]):
    """Presses to a depth [m] below a point until a condition, for 5 s at most."""
    contact = 0.0
    for _ in range(round(5 / CONTROL_TIMESTEP)):
      if until():
        return
      now = float((self.physics.tip_pos() - point) @ along)
      contact += CONTROL_TIMESTEP if now > 0 else 0.0
      speed = np.clip(8 * (depth * self.excess(contact) - now), -0.02, 0.015)
      self.tip = self.tip + speed * CONTROL_TIMESTEP * along
      yield self.step()


def _touch(p: Performer) -> Script:
  while p.task.done < p.task.targets:
    done, goal = p.task.done, p.task.goal()
    point, normal = p.physics.point(goal), p.physics.normals()[goal]
    yield from p.move(point + 0.01 * normal)
    yield from p.push(0.12, -normal, _more(p, done), most=3.0)
    yield from p.move(p.physics.tip_pos() + 0.01 * normal)


def _press(p: Performer) -> Script:
  while p.task.done < p.task.targets:
    done, now = p.task.done, p.task.now
    point, normal = p.task.points[now], p.task.normals[now]
    yield from p.move(point + 0.008 * normal)
    middle = sum(p.task.band) / 2
    until = _more(p, done)
    if p.task.by_depth:
      yield from p.sink(middle, point, -normal, until)
    else:
      yield from p.push(middle, -normal, until, most=6.0)
    yield from p.move(point + 0.008 * normal)


def _more(p: Performer, done: int) -> Callable[[], bool]:
  return lambda: p.task.done > done


def _palpate(p: Performer) -> Script:
  place, center = p.task.field, p.task.center
  middle = p.physics.organ.xpos0[p.physics.organ.elem].mean(axis=1)[place]
  normals = p.physics.normals()[place]
  spots, stiffness = [], []

  def feel(point: np.ndarray) -> Script:
    k = int(np.argmin(np.linalg.norm(middle - point, axis=1)))
    yield from p.move(middle[k] + 0.005 * normals[k])
    end = p.physics.time() + 0.9
    peak = [0.0]

    def done() -> bool:
      peak[0] = float(np.linalg.norm(p.physics.contact_force()))
      return p.physics.time() > end

    yield from p.sink(0.004, middle[k], -normals[k], done)
    spots.append(middle[k])
    stiffness.append(peak[0])
    yield from p.move(middle[k] + 0.005 * normals[k])

  for point in _lattice(middle, center, 0.0115):
    yield from feel(point)
  for _ in range(2):  # look closer around the stiffest place
    guess = _stiffest(np.array(spots), np.array(stiffness))
    away = np.linalg.norm(middle - guess, axis=1)
    far = np.linalg.norm(middle[:, None] - np.array(spots), axis=2).min(axis=1)
    for _ in range(3):
      point = middle[np.argmax(np.where(away < 0.012, far, -1.0))]
      yield from feel(point)
      far = np.minimum(far, np.linalg.norm(middle - spots[-1], axis=1))
  guess = _stiffest(np.array(spots), np.array(stiffness))
  k = int(np.argmin(np.linalg.norm(middle - guess, axis=1)))
  yield from p.move(middle[k] + 0.003 * normals[k])
  yield from p.move(middle[k])
  yield from p.wait(0.1)
  p.extra[:] = 1.0
  yield p.step()


def _lattice(points: np.ndarray, center: np.ndarray, gap: float) -> list[np.ndarray]:
  """Returns points at least `gap` apart, from the center outward in a spiral's order."""
  chosen = [points[np.argmin(np.linalg.norm(points - center, axis=1))]]
  while True:
    distance = np.linalg.norm(points[:, None] - np.array(chosen), axis=2).min(axis=1)
    left = np.flatnonzero(distance >= gap)
    if not len(left):
      return chosen
    near = np.linalg.norm(points[left] - chosen[-1], axis=1)
    chosen.append(points[left[np.argmin(near)]])


def _stiffest(spots: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
  """Returns where the force at one depth is largest: the mean of its neighbourhood's excess."""
  # The smooth maximum counts every spot's neighbours within 10 mm.
  weight = np.exp(-((np.linalg.norm(spots[:, None] - spots, axis=2) / 0.01) ** 2))
  smooth = weight @ stiffness / weight.sum(axis=1)
  best = spots[np.argmax(smooth)]
  near = np.linalg.norm(spots - best, axis=1) < 0.018
  excess = np.clip(stiffness - np.median(stiffness), 0, None) ** 1.5 * near
  return (excess[:, None] * spots).sum(axis=0) / max(excess.sum(), 1e-12)


def _trace(p: Performer) -> Script:
  task, physics = p.task, p.physics
  up = -physics.trocar().mat[:, 2] * -1
  yield from p.move(task.curve[0] + 0.01 * up)
  yield from p.push(0.08, -up, lambda: task.done > 0, most=3.0)
  # Pulls a point along the curve and keeps the force by its height.
  at, height, contact = 0.0, float((p.tip - task.curve[0]) @ up), 0.0
  step = 0.02 * p.style.speed * CONTROL_TIMESTEP / 0.0015
  while task.done < len(task.curve):
    contact += CONTROL_TIMESTEP
    at = min(at + step, task.done + 2.0, len(task.curve) - 1)
    force = float(np.linalg.norm(physics.contact_force()))
    error = 0.12 * p.excess(contact) - force
    height -= float(np.clip(0.08 * error, -0.01, 0.01)) * CONTROL_TIMESTEP
    k = int(at)
    rest = task.curve[k] + (at - k) * (task.curve[min(k + 1, len(task.curve) - 1)] - task.curve[k])
    wander = p.style.detour * 0.006 * math.sin(
      2.5 * contact
    ) + p.style.overshoot * 0.012 * math.sin(5 * contact)
    p.tip = rest + height * up + wander * physics.trocar().mat[:, 0]
    yield p.step()
  yield from p.move(p.tip + 0.01 * up)


_WIDE = 1.0  # action of the jaw: wide open
_GRIP = 2.4  # force that holds the organ [N]


def _close(p: Performer) -> Script:
  """Grasps: opens above the site, goes down over it, and closes to a gentle force."""
  task, physics = p.task, p.physics
  up = physics.trocar().mat[:, 2]
  p.roll, p.extra[:] = 0.0, _WIDE
  yield from p.move(physics.point(task.site) + 0.012 * up)
  yield from p.wait(0.2)
  yield from p.move(physics.point(task.site) - 0.009 * up, speed=0.03)
  while p.extra[0] > -0.35:
    p.extra[0] -= 0.06
    yield p.step()
  for _ in range(100):
    force = float(physics.gripper()[2:].max())
    p.extra[0] -= float(np.clip(0.02 * (_GRIP * p.excess(0.0) - force), -0.01, 0.01))
    yield p.step()
    if abs(force - _GRIP * p.excess(0.0)) < 0.25 and physics.holds():
      return


def _grip(p: Performer, contact: float) -> None:
  """Keeps the force of the jaws."""
  force = float(p.physics.gripper()[2:].max())
  p.extra[0] -= float(np.clip(0.01 * (_GRIP * p.excess(contact) - force), -0.005, 0.005))
  p.extra[0] = float(np.clip(p.extra[0], -1, -0.3))


def _open(p: Performer) -> Script:
  while p.extra[0] < 0.1:
    p.extra[0] += 0.06
    yield p.step()


def _grasp(p: Performer) -> Script:
  task, physics = p.task, p.physics
  while task.outcome is None:
    yield from _close(p)
    up = physics.trocar().mat[:, 2]
    speed, contact = 0.012 * p.style.speed, 0.0
    yield from p.wait(p.style.delay)
    goal = task.lift + 0.0015 + 0.3 * p.style.overshoot * task.lift
    while task.grasped and not task.done:  # up, and hold
      contact += CONTROL_TIMESTEP
      missing = goal - task.height(physics)
      p.tip = p.tip + float(np.clip(3 * missing, -speed, speed)) * CONTROL_TIMESTEP * up
      _grip(p, contact)
      yield p.step()
    yield from p.wait(p.style.delay)
    while task.grasped and task.height(physics) > 0.2 * task.lift:
      p.tip = p.tip - speed * CONTROL_TIMESTEP * up
      _grip(p, contact)
      yield p.step()
    yield from _open(p)
    yield from p.move(p.tip + 0.02 * up)


def _retract(p: Performer) -> Script:
  task, physics = p.task, p.physics
  while task.outcome is None:
    yield from _close(p)
    up = physics.trocar().mat[:, 2]
    yield from p.wait(p.style.delay)
    # A little up, then aside until enough is seen.
    along = task.right + 0.15 * up
    along /= np.linalg.norm(along)
    start, speed, contact = p.tip.copy(), 0.015 * p.style.speed, 0.0
    far, extra = 0.0, 0.002 * (1 + 4 * p.style.overshoot)
    enough = None
    while task.grasped:
      contact += CONTROL_TIMESTEP
      if task.visible >= task.wanted - 1e-9:
        enough = far + extra if enough is None else enough
      elif enough is not None and far >= enough:
        enough = None  # the organ slid back
      if far < (0.035 if enough is None else enough):
        far += speed * CONTROL_TIMESTEP
      p.tip = start + far * along
      _grip(p, contact)
      yield p.step()
    yield from _open(p)
    yield from p.move(p.tip + 0.02 * up)


_SCRIPTS: dict[type, Callable[[Performer], Script]] = {
  Touch: _touch,
  Press: _press,
  Palpate: _palpate,
  Trace: _trace,
  Grasp: _grasp,
  Retract: _retract,
}
