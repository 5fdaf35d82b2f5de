"""One exercise by hand: the loop, its recording, and what pictures are drawn of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from palpate.models.handle import Shaft
from palpate.tasks import episode
from palpate.tasks.handle import ROW
from palpate.tasks.recording import Recording

from .coupling import Link, Options
from .device import Device
from .loop import axes, tick
from .pace import Pace, punctual

_FPS = 30  # of what is published


class Session:
  """An exercise that a person does with a device.

  `run` owns the simulation in the thread that calls it. Others may use `pace` to pause, slow down
  and stop it, and read `link.state` and `link.message`.

  Attributes:
    env: of the suite, with `input="handle"`
    pace: of the loop
    link: between device and instrument
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
  ):
    """Prepares the exercise.

    Args:
      env: of the suite, with `input="handle"`
      device: of the hand
      seed: of the episode
      info: further entries of the recording; with `task_kwargs` it can be replayed
      options: of the coupling
      pace: real time by default
      coach: looks on after every control step, see `coach.Coach`
      publish: called before the first step, and then 30 times a second, in the loop's thread: to
        copy what pictures need, no more
    """
    if not env.task.scene.handle:
      raise ValueError(f"{env.task.name}: input is 'drives', expected 'handle' for a device")
    if env.task.second:
      raise ValueError(f"{env.task.name}: it takes two hands, expected one for a single device")
    self.env, self.seed, self.coach = env, seed, coach
    self.pace = pace or Pace(env.physics.timestep())
    self.link = Link(device, options, env.physics.timestep())
    self.faults: list[str] = []
    self._info, self._publish = dict(info or {}), publish
    self._rows = np.zeros((episode.substeps(env), len(env.task.components)))
    self._due = 0.0

  def run(
    self, realtime: bool = False, watch: Callable[[Any], Any] | None = None
  ) -> Recording:
    """Does the exercise and returns its recording; always leaves the device without force.

    Args:
      realtime: see `pace.punctual`
      watch: called with the environment after every control step; a true result ends the exercise
    """
    self._look = watch
    device = self.link.device
    info = {"performer": f"device:{device.name}", **self._info}
    try:
      with punctual(realtime):
        made = episode.run(self.env, self._act, self.seed, info, watch=self._watch)
    except episode.EpisodeError as error:
      made = error.recording
    finally:
      self.env.physics.guide.live = None
      self.link.quiet()
      device.close()
    made.info["live"] = self.pace.lateness.summary() | {"faults": self.faults}
    if self.coach is not None:
      made.info["coach"] = self.coach.log()
    return made

  def _act(self, timestep: Any) -> np.ndarray:
    physics = self.env.physics
    if timestep.first():
      shaft, handle = Shaft(physics.trocar()), physics.handle
      turn = axes(physics.model.ptr, physics.data.ptr)
      self.link.attach(shaft, handle.pos, handle.quat, turn)
      physics.guide.live = self._live
      self._rows[:] = 0.0
      self._rows[:, : len(ROW)] = self.link.row
      if self.coach is not None:
        self.coach.begin(self.env)
      if self._publish is not None:
        self._publish(self)  # the shapes of a scene take longer than a step
    return self._rows

  def _live(self, rows: np.ndarray, k: int) -> None:
    """Fills a row when its step is due."""
    physics, link = self.env.physics, self.link
    before = link.state
    if tick(self.pace, (link,), (physics.tip_pos().tolist(),)):
      link.feel(physics.handle.wrench())
    if link.message and (not self.faults or self.faults[-1] != link.message):
      self.faults.append(link.message)
    if link.state != before:
      self._due = 0.0
    row = link.row
    rows[k, :7] = row
    if self.env.task.jaws:
      rows[k, 7] = link.jaw
    elif self.env.task.extra:
      rows[k, 7] = float(link.report)
    # Not beside what a control step does at its end.
    if 0 < k < len(rows) - 1 and self._publish is not None and self.pace.now >= self._due:
      self._due = max(self._due + 1 / _FPS, self.pace.now)
      self._publish(self)

  def _watch(self, env: Any) -> bool:
    if self.coach is not None:
      self.coach.look(env)
    ended = self._look is not None and self._look(env)
    return bool(ended) or self.pace.stopped
