"""Free practice: an organ, one instrument or two, no task; scheme and device change on the way."""

from __future__ import annotations

import math
import pathlib
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco as mj
import numpy as np
import palpate
from palpate import Organ, models, windows
from palpate.models import laparoscope, situs, trocar
from palpate.organ import instances

from . import scope as scopes
from .coupling import Link, Options
from .devices.device import Device
from .loop import Loop
from .page.picture import FPS, HOOK, Camera
from .realtime_clock import Pace

LIMIT, DAMAGE = 1.5, 3.0  # of the force bar [N]
KEY = "touch"
SAFE = "implicit"  # scheme that holds at every step
_SPARE = 8.0  # vertices for cuts, times the square root of the organ's
_POWER = 30.0  # of a hook's current [W]
# What cuts an organ, by instrument, and the energy of a cut [J/m^2]: as in docs/cutting.md.
_CUTTERS = {
  "scalpel": "scalpel/edge 160",
  "scissors": "scissors/edge_left scissors/edge_right 160",
  "hook": "hook/hook_toe 1.1e6 by hook/current",
}
_APART = 0.25  # from the way to the middle of an own scene's organ to each port, in its sizes
_EYE = (0.2, 1.0, 1.2)  # where its laparoscope looks from, in its sizes
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
    scope: laparoscope that a hand holds or that follows, None where it stands
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
    on: str = "",
    scene: pathlib.Path | None = None,
    holder: Device | None = None,
  ):
    """Prepares the scene.

    Args:
      organ: of `models.NAMES`
      size: its `nodes` or its `grid`, see `models.load`
      hands: device of each instrument, the right hand's first
      step: of the physics [s]
      scheme: time stepping, see `integrator` in docs/configuration.md
      options: of the coupling
      publish: called before the first step, and then `FPS` times a second at most, in the loop's
        thread, to copy what pictures need
      pace: real time by default
      on: device that the organ is computed on, such as "cuda:0"; empty for its own choice
      scene: MJCF file in place of `organ` and `size`
      holder: device that holds the laparoscope, None where it stands
    """
    made = own(scene, tuple(hands)) if scene else furnished(organ, size, tuple(hands))
    spec, name = made
    if on:
      _, plugin, _ = windows.find_organ(spec, name)
      plugin.config = {k: v for k, v in plugin.config.items() if v} | {"device": on}
    self.model: Any = spec.compile()
    self.model.opt.timestep = step
    self.data: Any = mj.MjData(self.model)
    self._key = mj.mj_name2id(self.model, mj.mjtObj.mjOBJ_KEY, KEY)
    self._place()
    self.organ = Organ(self.model, self.data, name)
    found = mj.mj_name2id(self.model, mj.mjtObj.mjOBJ_ACTUATOR, f"{HOOK}current")
    self._current = found if found >= 0 else None
    self._wanted, self._publish, self._due = scheme, publish, 0.0
    self.pace, self.faults = pace or Pace(step), []
    named = {f"{name}/": device for name, device in hands.items()}
    self._names = list(named)
    self._loop = Loop(self.model, self.data, named, options, self.pace)
    self.links: list[Link] = self._loop.links
    self.camera = Camera(self.model, self.data, self.organ, next(iter(named)))
    self._eye, self._lamp = self.model.camera(laparoscope.NAME).id, self._light()
    self._holder, self.scope = holder, scopes.of(self.model, self.data, holder) if holder else None

  @property
  def link(self) -> Link:
    """The right hand's."""
    return self.links[0]

  @property
  def powered(self) -> bool:
    """Whether a hook's current is on."""
    hands = zip(self._names, self.links, strict=True)
    return any(link.grip for name, link in hands if name == HOOK)

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
      for device in [*(link.device for link in self.links), self._holder]:
        if device is not None:
          device.close()

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
    if self._current is not None:
      self.data.ctrl[self._current] = _POWER * self.powered
    if self.pace.now < self._due:
      return
    self._due = max(self._due + 1 / FPS, self.pace.now)
    error = self.organ.error
    if error or not np.abs(self.organ.displacement).max() < _FAR:
      self._diverged()
    for link in self.links:
      self._note(link.message)
    self._look_on()
    if self._publish is not None:
      self._publish(self)

  def _light(self) -> int:
    """Returns the number of the lamp at the lens, -1 for none."""
    found = [
      mj.mj_name2id(self.model, mj.mjtObj.mjOBJ_LIGHT, n) for n in (situs.LIGHT, situs.CAMERA)
    ]
    return max(found)

  def _look_on(self) -> None:
    """Takes the laparoscope on, and the hands' axes with its picture."""
    tip = self.data.site_xpos[self.model.site(f"{self._names[0]}tip").id]
    moved = self.scope is not None and self.scope.advance(
      self.pace.now, 1 / FPS, tip, self.organ.xpos
    )
    if moved and self.scope is not None:
      row = np.concatenate([self.scope.pos, trocar.orientation(self.scope.mat)])
      laparoscope.stand(self.model, self._eye, self._lamp, row)
      for link in self.links:
        link.turn(self.scope.mat)

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

  def _place(self) -> None:
    """Begins: where the keyframe of that name is, if there is one."""
    if self._key >= 0:
      mj.mj_resetDataKeyframe(self.model, self.data, self._key)
    else:
      mj.mj_resetData(self.model, self.data)
    mj.mj_forward(self.model, self.data)

  def _restart(self) -> None:
    self._place()
    self.organ.reset()
    mj.mj_forward(self.model, self.data)
    self._loop.attach()

  def _note(self, fault: str) -> None:
    if fault and (not self.faults or self.faults[-1] != fault):
      self.faults.append(fault)


def furnished(
  organ: str, size: Mapping[str, int], instruments: Sequence[str]
) -> tuple[mj.MjSpec, str]:
  """Returns a scene of an organ in the abdomen, and its name; what cuts may cut it.

  A regular grid lies alone, for it has no texture.
  """
  spec = models.load(organ, instruments=instruments, handle=True, coupling="window", **size)  # pyright: ignore
  name = f"{organ}/{organ}"
  _cut(spec, name, instruments)
  if "nodes" in size:
    situs.enter(spec, organ, size["nodes"])
  return spec, name


def _cut(spec: mj.MjSpec, name: str, instruments: Sequence[str]) -> None:
  """Gives an organ vertices for cuts by those of the instruments that cut."""
  cutters = [_CUTTERS[each] for each in instruments if each in _CUTTERS]
  flex, plugin, _ = windows.find_organ(spec, name)
  if not cutters or plugin.config.get("cutters"):
    return
  if not plugin.config.get("spare"):
    palpate.add_spare(spec, name, round(_SPARE * math.sqrt(int(np.max(flex.elem)) + 1)))
  config = {key: value for key, value in plugin.config.items() if value}
  plugin.config = config | {"cutters": ", ".join(cutters)}
  if "hook" in instruments:
    current = spec.add_actuator(
      name=f"{HOOK}current", trntype=mj.mjtTrn.mjTRN_SITE, target=f"{HOOK}tip"
    )
    current.gainprm[0] = 0.0


def own(path: pathlib.Path, instruments: Sequence[str]) -> tuple[mj.MjSpec, str]:
  """Returns somebody's own scene with instruments in it, and the name of its first organ.

  A camera `laparoscope` is added where there is none. The instruments come through ports in the
  direction of that camera, and point at the organ's middle.

  Raises:
    ValueError: it is no MJCF, or has no organ.
  """
  spec = mj.MjSpec.from_file(str(path))
  model = spec.compile()
  names = list(instances(model))
  if not names:
    raise ValueError(f"scene {path}: it has no organ, expected a flexcomp with the plugin's")
  data = mj.MjData(model)
  mj.mj_forward(model, data)
  x = Organ(model, data, names[0]).xpos
  middle, size = x.mean(axis=0), float(np.ptp(x, axis=0).max())
  for key in list(spec.keys):  # they know nothing of the instruments
    spec.delete(key)
  eye = middle + size * np.array(_EYE)
  if mj.mj_name2id(model, mj.mjtObj.mjOBJ_CAMERA, "laparoscope") < 0:
    turn = laparoscope.upright((eye - middle) / np.linalg.norm(eye - middle))
    quat = trocar.orientation(turn)
    spec.worldbody.add_camera(name="laparoscope", pos=eye, fovy=50.0, quat=quat)
  else:
    eye = data.cam_xpos[model.camera("laparoscope").id]
  toward = (eye - middle) / np.linalg.norm(eye - middle)
  aside = np.cross([0.0, 0.0, 1.0], toward)
  aside /= np.linalg.norm(aside)
  reach = float(((x - middle) @ toward).max()) + trocar.DEPTH + 0.02
  for instrument, side in zip(instruments, (1, -1), strict=False):
    port = middle + reach * toward + side * _APART * size * aside
    trocar.attach(spec, instrument, f"{instrument}/", port, trocar.aim(port, middle), handle=True)
  return spec, names[0]
