"""One exercise by hand, or by two: the loop, its recording, and what pictures are drawn of."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from palpate.models import trocar
from palpate.models.handle import Shaft, Wrist
from palpate.tasks.core import episode
from palpate.tasks.core.handle import ROW
from palpate.tasks.recording import Recording

from . import scope as scopes
from .coupling import Link, Options
from .devices.device import Device
from .loop import axes, tick
from .realtime_clock import Pace, punctual

_FPS = 60  # of what is published
# What a hand says for each of the components that do not move its instrument as a whole.
_SAYS: dict[str, Callable[[Link], float]] = {
  "jaw": lambda link: link.jaw,
  "head": lambda link: link.head,
  "report": lambda link: float(link.report),
  "current": lambda link: 1.0 if link.grip else -1.0,
}
_TURNED = 0.01  # of a picture's axes, from which on hands move by the new ones
_FIRST = ("current",)  # of these, what acts as a control step begins, and does not change in it


class Session:
  """An exercise that a person does with a device, or with one in each hand.

  `run` owns the simulation in the thread that calls it. Others may use `pace` to pause, slow down
  and stop it, and read `link.state` and `link.message`.

  Attributes:
    env: of the suite, with an `input` of `suite.by_hand`
    pace: of the loop
    links: between devices and instruments, the main one first
    scope: laparoscope that a hand holds or that follows, None where the camera is an instrument's
    faults: what went wrong on the way, for people
  """

  def __init__(
    self,
    env: Any,
    device: Device,
    seed: int = 0,
    info: Mapping[str, Any] | None = None,
    options: Options | None = None,
    pace: Pace | None = None,
    coach: Any = None,
    publish: Callable[[Session], None] | None = None,
    other: Device | None = None,
    camera: Device | None = None,
    journal: str | os.PathLike[str] | None = None,
  ):
    """Prepares the exercise.

    Args:
      env: of the suite, with an `input` of `suite.by_hand`
      device: of the hand, where there are two of the one that has the main instrument
      seed: of the episode
      info: further entries of the recording; with `task_kwargs` it can be replayed
      options: of the coupling
      pace: real time by default
      coach: looks on after every control step, see `coach.Coach`
      publish: called before the first step, and then 60 times a second, in the loop's thread: to
        copy what pictures need, no more
      other: device of the other hand, where the exercise has two
      camera: device that holds the laparoscope, None where it stands
      journal: file that takes the exercise second by second, see `Recorder`
    """
    if env.task.scene.input == "drives":
      raise ValueError(f"{env.task.name}: input is 'drives', expected 'handle' or 'tip'")
    if bool(env.task.second) != (other is not None):
      hands = "two hands, expected another" if env.task.second else "one hand, expected no other"
      raise ValueError(f"{env.task.name}: it takes {hands} device")
    self.env, self.seed, self.coach = env, seed, coach
    self.pace = pace or Pace(env.physics.timestep())
    h = env.physics.timestep()
    self.links = [Link(each, options, h) for each in (device, other) if each is not None]
    self.faults: list[str] = []
    self.scope: scopes.Scope | None = None
    self._camera, self._turned = camera, np.eye(3)
    self._info, self._publish, self._journal = dict(info or {}), publish, journal
    self._rows = np.zeros((episode.substeps(env), len(env.task.components)))
    self._held: list[tuple[int, Link, Callable[[Link], float]]] = []  # columns of `_FIRST`
    self._due = 0.0

  @property
  def link(self) -> Link:
    """Between the main device and its instrument."""
    return self.links[0]

  def run(self, realtime: bool = False, watch: Callable[[Any], Any] | None = None) -> Recording:
    """Does the exercise and returns its recording; always leaves the device without force.

    Args:
      realtime: see `pace.punctual`
      watch: called with the environment after every control step; a true result ends the exercise
    """
    self._look = watch
    names = "+".join(link.device.name for link in self.links)
    info = {"performer": f"device:{names}", **self._info}
    if self.coach is not None:
      info["coach"] = self.coach.log()
    try:
      with punctual(realtime):
        made = episode.run(
          self.env, self._act, self.seed, info, watch=self._watch, journal=self._journal
        )
    except episode.EpisodeError as error:
      made = error.recording
    finally:
      for hand, link in zip(self.env.physics.hands, self.links, strict=True):
        hand.guide.live = None
        link.quiet()
        link.device.close()
      if self._camera is not None:
        self._camera.close()
    made.info["live"] = self.pace.lateness.summary() | {"faults": self.faults}
    if self.coach is not None:
      made.info["coach"] = self.coach.log()
    return made

  def _act(self, timestep: Any) -> np.ndarray:
    physics, task = self.env.physics, self.env.task
    if timestep.first():
      self._turned = turn = axes(physics.model.ptr, physics.data.ptr)
      follows = self.scope is not None and self.scope.follows
      if self._camera is not None:
        self.scope = scopes.of(physics.model.ptr, physics.data.ptr, self._camera)
        if self.scope is not None:
          self.scope.follows = follows
      self._rows[:] = 0.0
      self._held.clear()
      first, extras = 0, (task.extra, task.other)
      for k, (hand, link, extra) in enumerate(zip(physics.hands, self.links, extras, strict=False)):
        handle, port = hand.handle, hand.trocar()
        shaft = Wrist(port, handle.quat) if port.wrist else Shaft(port)
        closed = port.wrist and "jaw" in extra and float(task.still(k)[0]) < 0
        link.attach(shaft, handle.pos, handle.quat, turn, closed=bool(closed))
        self._rows[:, first : first + len(ROW)] = link.row
        first += len(ROW)
        said = [(first + i, _SAYS[name]) for i, name in enumerate(extra) if name in _FIRST]
        self._held += [(column, link, say) for column, say in said]
        first += len(extra)
        says = [(i, _SAYS[name]) for i, name in enumerate(extra, len(ROW)) if name not in _FIRST]
        hand.guide.live = functools.partial(self._live, link, says)
      if self.coach is not None:
        self.coach.begin(self.env)
      if self._publish is not None:
        self._publish(self)  # the shapes of a scene take longer than a step
    else:
      self._look_on()
    for column, link, say in self._held:
      self._rows[:, column] = say(link)
    return self._rows

  def _look_on(self) -> None:
    """Takes the laparoscope on, and the hands' axes with its picture."""
    physics, scope = self.env.physics, self.scope
    dt = self.env.control_timestep()
    if scope is not None and scope.advance(self.pace.now, dt, physics.tip_pos(), physics.nodes()):
      physics.look_from(np.concatenate([scope.pos, trocar.orientation(scope.mat)]))
    if scope is not None:
      self._note(scope.message)
    now = axes(physics.model.ptr, physics.data.ptr)
    if np.abs(now - self._turned).max() > _TURNED:
      self._turned = now
      for link in self.links:
        link.turn(now)

  def _live(
    self, link: Link, says: Sequence[tuple[int, Callable[[Link], float]]], rows: np.ndarray, k: int
  ) -> None:
    """Fills a hand's row when its step is due, the main one's first."""
    if link is self.link:
      self._tick()
    row = rows[k]
    row[:7] = link.row
    for i, say in says:
      row[i] = say(link)
    # Not beside what a control step does at its end.
    last = link is self.links[-1] and 0 < k < len(rows) - 1
    if last and self._publish is not None and self.pace.now >= self._due:
      self._due = max(self._due + 1 / _FPS, self.pace.now)
      self._publish(self)

  def _tick(self) -> None:
    """Waits until the step is due, and has all hands read and feel."""
    hands, links = self.env.physics.hands, self.links
    before = [link.state for link in links]
    ready = tick(self.pace, links, [hand.tip_pos().tolist() for hand in hands])
    for hand, link in zip(hands, links, strict=True):
      if ready:
        link.feel(hand.handle.wrench())
      self._note(link.message)
    if before != [link.state for link in links]:
      self._due = 0.0

  def _note(self, fault: str) -> None:
    """Notes a fault once."""
    if fault and (not self.faults or self.faults[-1] != fault):
      self.faults.append(fault)

  def _watch(self, env: Any) -> bool:
    if self.coach is not None:
      self.coach.look(env)
    ended = self._look is not None and self._look(env)
    return bool(ended) or self.pace.stopped
