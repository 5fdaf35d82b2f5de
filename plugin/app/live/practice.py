# mujoco ships its bindings without type stubs:
# pyright: reportAttributeAccessIssue=false
"""Free practice: an organ, one instrument or two, no task; scheme and device change on the way."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import mujoco as mj
import numpy as np
from palpate import Organ, models

from .coupling import Link, Options
from .devices.device import Device
from .loop import Loop
from .page.picture import Camera
from .realtime_clock import Pace

LIMIT, DAMAGE = 1.5, 3.0  # of the force bar [N]
KEY = "touch"
SAFE = "implicit"  # scheme that holds at every step
_FPS = 30
_FAR = 0.5  # a node that is further off its place than any organ is large [m]
_BUSY = 0.7  # share of the time in steps from which on a loop does not go before all others
_TRIED = 20  # steps that are timed for that


class Practice:
  """Works on an organ for as long as one likes.

  `run` owns the simulation in the thread that calls it. Others may use `pace`, `link.change` and
  `change`.

  Attributes:
    pace: of the loop
    links: between devices and instruments, the right hand's first
    camera: that frames are made by
    faults: what went wrong on the way, for people
  """

  def __init__(
    self,
    organ: str,
    size: Mapping[str, int],
    hands: Mapping[str, Device],
    step: float = 1e-3,
    scheme: str = SAFE,
    options: Options | None = None,
    publish: Callable[[Practice], None] | None = None,
    pace: Pace | None = None,
  ):
    """Prepares the scene.

    Args:
      organ: of `models.NAMES`
      size: its `nodes` or its `grid`, see `models.load`
      hands: device of each instrument, the right hand's first
      step: of the physics [s]
      scheme: time stepping, see `integrator` in docs/configuration.md
      options: of the coupling
      publish: called before the first step, and then 30 times a second at most, in the loop's
        thread, to copy what pictures need
      pace: real time by default
    """
    spec = models.load(organ, instruments=tuple(hands), handle=True, coupling="window", **size)  # pyright: ignore
    self.model: Any = spec.compile()
    self.model.opt.timestep = step
    self.data: Any = mj.MjData(self.model)
    mj.mj_resetDataKeyframe(self.model, self.data, self.model.key(KEY).id)
    mj.mj_forward(self.model, self.data)
    self.organ = Organ(self.model, self.data, f"{organ}/{organ}")
    self._wanted, self._publish, self._due = scheme, publish, 0.0
    self.pace, self.faults = pace or Pace(step), []
    named = {f"{name}/": device for name, device in hands.items()}
    self._loop = Loop(self.model, self.data, named, options, self.pace)
    self.links: list[Link] = self._loop.links
    self.camera = Camera(self.model, self.data, self.organ, next(iter(named)))

  @property
  def link(self) -> Link:
    """The right hand's."""
    return self.links[0]

  def change(self, scheme: str) -> None:
    """Takes another scheme with the next step."""
    self._wanted = scheme

  def run(self, realtime: bool = False, watch: Callable[[Practice], None] | None = None) -> None:
    """Runs until `pace.stopped`; always leaves the devices without force.

    Args:
      realtime: whether the system lets the loop go first, if it leaves time to others
      watch: called after every step
    """
    self._look = watch
    try:
      first = realtime and self._spare()
      if self._publish is not None:
        self._publish(self)  # the shapes of a scene take longer than a step
      self._loop.run(watch=self._watch, realtime=first)
    finally:
      for link in self.links:
        link.device.close()

  def _spare(self) -> bool:
    """Returns whether steps leave time to others."""
    self._switch()
    began = time.thread_time()
    mj.mj_step(self.model, self.data, _TRIED)
    spent = (time.thread_time() - began) / _TRIED
    self._restart()
    return spent < _BUSY * self.pace.period

  def _watch(self, loop: Loop) -> None:
    if self._look is not None:
      self._look(self)
    if self._wanted != self.organ.integrator:
      self._switch()
    if self.pace.now < self._due:
      return
    self._due = max(self._due + 1 / _FPS, self.pace.now)
    error = self.organ.error
    if error or not np.abs(self.organ.displacement).max() < _FAR:
      self._diverged()
    for link in self.links:
      self._note(link.message)
    if self._publish is not None:
      self._publish(self)

  def _switch(self) -> None:
    self.organ.configure(integrator=self._wanted)

  def _diverged(self) -> None:
    """Starts again with a scheme that holds, and says why."""
    h = 1e3 * self.model.opt.timestep
    self._note(
      f"{self._wanted}: the motion diverged at steps of {h:g} ms; it goes on with {SAFE} from the "
      "start"
    )
    self._wanted = SAFE
    self._switch()
    self._restart()

  def _restart(self) -> None:
    mj.mj_resetDataKeyframe(self.model, self.data, self.model.key(KEY).id)
    self.organ.reset()
    mj.mj_forward(self.model, self.data)
    self._loop.attach()

  def _note(self, fault: str) -> None:
    if fault and (not self.faults or self.faults[-1] != fault):
      self.faults.append(fault)
