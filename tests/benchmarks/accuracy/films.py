"""Scripted scenes of the error bench, and runs of them that advance a stretch at a time."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import mujoco
import numpy as np
from benchmarks import runner, scene
from benchmarks.runner import Case
from benchmarks.scene import Tissue
from palpate.tissue.config import Config

SAMPLE = 1e-2  # between compared positions [s]; a multiple of every time step
# Of solids, whose inside makes a node's effective inertia many times its mass: what MuJoCo is wrong
# about it, a contact gives way to by that acceleration times the square of its time constant.
HARD = scene.CONTACT | {"solref": "0.005 1"}
LONGEST = 2e-3  # step that such contacts can have [s]
ELEMENTS = {
  "membrane": Tissue(),
  "spring": Tissue(elements="spring", stiffness=60.0),
  "solid": Tissue(elements="solid", young=1e4, poisson=0.45, mass=0.5),
}


@dataclasses.dataclass(frozen=True)
class Script:
  """A scripted scene.

  Attributes:
    duration: [s]
    probe: whether there is one
    motion: displacement and velocity of the probe at a time, from its start
    joined: whether the top nodes hang on the probe
    friction: of the contact
    released: time at which they no longer do [s]
    begin: displacement of the nodes at first, from their rest positions
  """

  duration: float
  probe: bool = True
  motion: Callable[[float], tuple[np.ndarray, np.ndarray]] | None = None
  joined: bool = False
  friction: float = 0.0
  released: float = math.inf
  begin: Callable[[np.ndarray], np.ndarray] | None = None


def _along(*legs: tuple[float, float, tuple[float, float, float]]):
  """Returns a motion of smooth legs: start [s], duration [s], displacement [m]."""

  def motion(now: float) -> tuple[np.ndarray, np.ndarray]:
    place, speed = np.zeros(3), np.zeros(3)
    for start, duration, move in legs:
      done, rate = scene.ramp(now - start, duration)
      place += done * np.array(move)
      speed += rate * np.array(move)
    return place, speed

  return motion


def _bulge(rest: np.ndarray) -> np.ndarray:
  """Returns a smooth mode: the sphere stretched along z, 5 %."""
  return 0.05 * rest * [-0.5, -0.5, 1.0]


SCRIPTS = {
  "press": Script(0.16, motion=_along((0.0, 0.1, (0, 0, -0.012)))),
  # Without friction: with it the probe sticks on a facet and jumps off it, and when is chance.
  "slide": Script(0.2, motion=_along((0.0, 0.08, (0, 0, -0.008)), (0.08, 0.12, (0.012, 0, 0)))),
  "pull": Script(0.2, motion=_along((0.0, 0.08, (0, 0, 0.01))), joined=True, released=0.1),
  "vibrate": Script(0.08, probe=False, begin=_bulge),
}


def config_of(elements: str) -> Config:
  """Returns the configuration of one of ELEMENTS."""
  t = ELEMENTS[elements]
  return Config(**{"bend": 0} | t.keys() | {"young": (t.young,)})


def build(case: Case, scheme: str, h: float, **keys) -> mujoco.MjModel:
  """Returns the model of a case's scene; `keys` are those of `scene.build`."""
  script = SCRIPTS[case["scene"]]
  mesh = scene.shape("sphere", case["nodes"])
  top = mesh.rest[np.argmax(mesh.rest[:, 2])]
  probe = joined = None
  if script.probe:
    probe = top + np.array([0, 0, 0.0 if script.joined else scene.PROBE + 0.0006])
  if script.joined:
    near = np.linalg.norm(mesh.rest - top, axis=1)
    joined = np.flatnonzero(near < 1.2 * np.sort(near)[1])
  tissue = ELEMENTS[case["elements"]]
  if case["elements"] == "solid":
    keys = {"contact": HARD} | keys
  return scene.build(
    mesh, tissue, scheme, h,
    probe=probe, joined=joined, friction=script.friction, lumped=True, **keys,
  )  # fmt: skip


class Film:
  """A run that can be advanced a stretch at a time.

  Args:
    case: its scene and nodes
    model: of `build`
    ours: whether there is an organ, not MuJoCo's own flex
    weighs: whether a flex of MuJoCo's own gets the right weights of corners, see `scene.weigher`

  Attributes:
    passive: adds forces to a step of its data, or None
  """

  def __init__(self, case: Case, model: mujoco.MjModel, ours: bool = False, weighs: bool = False):
    self.script = SCRIPTS[case["scene"]]
    self.model, self.data = model, mujoco.MjData(model)
    self.h = model.opt.timestep
    self.mesh = scene.shape("sphere", case["nodes"])
    self.organ = scene.handle(model, self.data) if ours else None
    self.state = scene.Nodes(model, self.data, self.mesh, self.organ)
    self.weigh = scene.weigher(model, self.data) if weighs else None
    self.passive: Callable[[mujoco.MjData], None] | None = None
    self.overflow = 0  # nodes that a window had no room for
    self.probe = scene.probe_dofs(model) if self.script.probe else None
    self.force: list[np.ndarray] = []
    self.places: list[np.ndarray] = []
    self.times: list[float] = []
    self.n = 0
    if self.script.begin:
      self.state.put(self.script.begin(self.mesh.rest))

  def move(self, until: float, before=None, after=None):
    """Advances to a time, calling `before` and `after` around each step."""
    mujoco.set_mjcb_passive(self._within if self.passive or self.weigh else None)
    try:
      self._move(until, before, after)
    finally:
      mujoco.set_mjcb_passive(None)

  def _within(self, _, data: mujoco.MjData):
    if self.passive:
      self.passive(data)
    if self.weigh:
      self.weigh()

  def _move(self, until: float, before, after):
    every = round(SAMPLE / self.h)
    while self.n < round(until / self.h):
      now = self.n * self.h
      if self.probe is not None and self.script.motion:
        place, speed = self.script.motion(now)
        scene.put(self.data, self.probe, place, speed)
        if now >= self.script.released - 1e-9:
          self.data.eq_active[:] = 0
      if before:
        before()
      start = runner.clock()
      mujoco.mj_step(self.model, self.data)
      self.times.append(runner.clock() - start)
      self.n += 1
      if after:
        after()
      if self.probe is not None:
        self.force.append(self.data.qfrc_constraint[self.probe].copy())
      if self.n % every == 0:
        self.places.append(self.state.state()[0].copy())
      if self.state.organ:
        self.overflow = max(self.overflow, *self.state.organ.window_overflow)

  def good(self) -> bool:
    """Returns whether all is finite and without error."""
    if scene.bad(self.data) or not np.isfinite(self.data.qpos).all():
      return False
    return self.organ is None or not self.organ.error
