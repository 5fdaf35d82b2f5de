"""The loop: its thread owns the simulation, everything else is elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from palpate.models import trocar
from palpate.models.handle import Handle, Shaft
from palpate.tasks.core.handle import spin

from .coupling import Link, Options
from .devices.device import Device
from .realtime_clock import Pace, punctual


def tick(pace: Pace, links: Sequence[Link], tips: Sequence[Sequence[float]]) -> bool:
  """Waits for the next step and reads the hands; returns False once the loop is to end.

  In a pause, while a device is gone and until a hand moves where the pace `waits` for it, nothing
  moves, forces are zero, and the devices are still read.
  """
  pace.wait()
  while not pace.stopped:
    ready = not pace.paused
    for link, tip in zip(links, tips, strict=True):
      ready = link.poll(pace.now, tip) and not link.paused and ready
    if pace.waits and ready:
      pace.waits = not any([link.moved() for link in links])
      ready = not pace.waits
    if ready:
      return True
    for link in links:
      if pace.waits:  # the movement that ends the wait counts
        link.quiet()
      else:
        link.hold()
    pace.rest()
  for link in links:
    link.quiet()
  return False


def axes(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
  """Returns a device's axes in the world, the laparoscope's picture's, in columns  (3, 3)."""
  return data.cam_xmat[model.camera("laparoscope").id].reshape(3, 3).copy()


class Loop:
  """Steps a scene with hands on the handles of its instruments.

  Attributes:
    pace: to pause, slow down and stop it from another thread
    links: one for each instrument
  """

  def __init__(
    self,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    hands: Mapping[str, Device],
    options: Options | None = None,
    pace: Pace | None = None,
  ):
    """Couples the hands, their instruments where they are.

    Args:
      model: the scene
      data: its state, which the loop's thread owns from now on
      hands: device of each instrument, by its prefix, such as "probe/"
      options: of the coupling
      pace: 1 kHz, or the model's own time step, by default
    """
    self._model, self._data = model, data
    self.pace = pace or Pace(model.opt.timestep)
    mujoco.mj_forward(model, data)
    self.links = [Link(device, options, model.opt.timestep) for device in hands.values()]
    self._handles = [Handle(model, data, prefix) for prefix in hands]
    self._shafts = [Shaft(trocar.trocar(model, prefix)) for prefix in hands]
    self._tips = [data.site_xpos[model.site(f"{prefix}tip").id].data for prefix in hands]
    jaws = [
      mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, f"{prefix}jaw") for prefix in hands
    ]
    self._jaws = [(link, jaw) for link, jaw in zip(self.links, jaws, strict=True) if jaw >= 0]
    self.attach()

  def attach(self) -> None:
    """Couples the hands to their instruments where these are: nothing moves by this."""
    turn = axes(self._model, self._data)
    for i, link in enumerate(self.links):
      tip, shaft = self._tips[i].tolist(), self._shafts[i]
      link.attach(shaft, tip, shaft.quat(tip), turn)
      self._handles[i].move(tip, link.row[3:])
    self._rows = [link.row for link in self.links]

  def run(
    self,
    duration: float = float("inf"),
    watch: Callable[[Loop], Any] | None = None,
    realtime: bool = False,
  ) -> None:
    """Runs until a time of the simulation [s] has passed, or `pace.stopped`.

    Args:
      duration: of the simulation [s]
      watch: called after every step
      realtime: see `pace.punctual`
    """
    model, data, h = self._model, self._data, self._model.opt.timestep
    steps, k = duration / h, 0
    hands = list(enumerate(zip(self.links, self._handles, strict=True)))
    try:
      with punctual(realtime):
        while k < steps and tick(self.pace, self.links, [tip.tolist() for tip in self._tips]):
          for i, (link, handle) in hands:
            row, before, self._rows[i] = link.row, self._rows[i], link.row
            vel = (row[0] - before[0]) / h, (row[1] - before[1]) / h, (row[2] - before[2]) / h
            handle.move(row[:3], row[3:], vel, spin(before[3:], row[3:], h))
          for link, jaw in self._jaws:
            low, high = model.actuator_ctrlrange[jaw]
            data.ctrl[jaw] = low + (high - low) * (link.jaw + 1) / 2
          mujoco.mj_step(model, data)
          for _, (link, handle) in hands:
            link.feel(handle.wrench())
          k += 1
          if watch is not None:
            watch(self)
    finally:
      for link in self.links:
        link.quiet()
