"""Worlds on the threads of the CPU, each a copy of the model that the plugin steps."""

from __future__ import annotations

import copy
import functools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.camera import Camera
from palpate.engine import coupling
from palpate.engine import plugin as engine
from palpate.engine.cutting import cuts as cutting
from palpate.engine.model.declare import Declaration
from palpate.organ import Organ, instances
from palpate.thread import Thread
from palpate.tissue import body as bodies
from palpate.tissue.cutting.topology import Report
from palpate.tissue.device import free_memory, refuse_crowd
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.reading import count_of

from . import thread
from .base import Batch, Tissue, spread
from .bonds import OfThreads
from .cutting.fracture import Cutters
from .needles import Needles, gathered

_OF_VERTICES = ("xpos", "xvel", "contact_force")
_FULL = mujoco.mjtState.mjSTATE_FULLPHYSICS
_CTRL = mujoco.mjtState.mjSTATE_CTRL
_ALL = mujoco.mjtState.mjSTATE_INTEGRATION
_BAD = [
  int(getattr(mujoco.mjtWarning, f"mjWARN_{name}"))
  for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL")
]


class Threads(Batch):
  """A batch whose worlds are mjData of the plugin.

  Args:
    scene: an MjSpec or MjModel
    nworld: number of worlds
    nthread: threads that step them; None for as many as the machine has cores
  """

  def __init__(self, scene, nworld: int, nthread: int | None = None):
    model = scene.compile() if isinstance(scene, mujoco.MjSpec) else scene
    nthread = os.cpu_count() or 1 if nthread is None else count_of("nthread", nthread)
    super().__init__(model, nworld, "cpu")
    # Windows, and the inertia that follows a tissue, are in the model: a world needs its own.
    self.models = [copy.copy(model)]
    self.datas = [mujoco.MjData(self.models[0])]
    first = self.datas[0]
    spaces = [engine.find(first._address, number) for number in instances(model).values()]
    each = mujoco.mj_sizeModel(model) + first.nbuffer + sum(bodies.nbytes(w.body) for w in spaces)
    refuse_crowd(nworld, each, free_memory(), "this machine")
    self._allocate()
    self.models += [copy.copy(model) for _ in range(nworld - 1)]
    self.datas += [mujoco.MjData(each) for each in self.models[1:]]
    self._pool, self._pid = ThreadPoolExecutor(min(nthread, nworld)), os.getpid()
    self._begin: np.ndarray | None = None
    self._felt: list[tuple[int, str]] = []
    self._seen = np.zeros((nworld, 0, model.nsensordata), np.float32)
    self._organs = {name: _Tissue(self, name, number) for name, number in instances(model).items()}
    self._threads = {name: _Thread(self, name) for name in instances(model, dim=1)}

  def each(self, work: Callable[[int], object], worlds=None):
    """Does work(world) for all worlds, or some, on the threads."""
    if os.getpid() != self._pid:
      raise RuntimeError("a batch does not work in a process that was forked: make it there")
    list(self._pool.map(work, range(self.nworld) if worlds is None else worlds))

  def _step(self, n: int):
    ctrl, first = self.ctrl.numpy(), self.model.sensor_adr
    peak, mean = self.sensor_peak.numpy(), self.sensor_mean.numpy()

    def work(world: int):
      model, data = self.models[world], self.datas[world]
      data.ctrl[:] = ctrl[world]
      for organ in self._organs.values():
        organ.push(world)
      if not len(first):
        mujoco.mj_step(model, data, n)
        return self._look(world)
      most, total = np.zeros(model.nsensor), np.zeros(model.nsensordata)
      for k in range(n):
        mujoco.mj_step(model, data)
        for adr, organ in self._felt:
          for cutter in self._organs[organ].handles[world].cutters:
            data.sensordata[adr : adr + 3] += cutter.force
        self._seen[world, k : k + 1] = data.sensordata
        total += data.sensordata
        np.maximum(most, np.add.reduceat(data.sensordata**2, first), out=most)
      peak[world], mean[world] = np.sqrt(most), total / n
      return self._look(world)

    self.each(work)

  def _feel(self, sensor: int, organ: str):
    self._felt.append((int(self.model.sensor_adr[sensor]), organ))

  def _watch(self, out: wp.array) -> wp.array:
    self._seen = out.numpy()
    return out

  def _look(self, world: int):
    """Counts what the windows had no room for, and resets a world that diverged."""
    data, overflow, failed = self.datas[world], self.overflow.numpy(), False
    for organ in self._organs.values():
      overflow[world] = max(overflow[world], sum(organ.spaces[world].report.missed))
      failed = failed or organ.handles[world].error is not None
    if failed or any(data.warning[kind].number for kind in _BAD):
      self.failures.numpy()[world] += 1
      self._reset_world(world)

  def _reset_world(self, world: int):
    model, data = self.models[world], self.datas[world]
    mujoco.mj_resetData(model, data)
    if self._begin is not None:
      mujoco.mj_setState(model, data, self._begin, _ALL)
      data.time, data.ctrl[:] = 0.0, 0.0
    engine.place_windows(model, data)
    self.ctrl.numpy()[world] = 0.0
    for organ in self._organs.values():
      if organ.forced:
        organ.applied.numpy()[world] = 0.0

  def _reset(self, mask: wp.array):
    self.each(self._reset_world, np.flatnonzero(mask.numpy()))

  def _declared(self) -> dict[str, Declaration]:
    return {name: organ.spaces[0].organ for name, organ in self._organs.items()}

  def _start(self, data: mujoco.MjData):
    self._check_state(data, self._declared())
    engine.sync(self.model, data)
    self._begin = np.empty(mujoco.mj_stateSize(self.model, _ALL))
    mujoco.mj_getState(self.model, data, self._begin, _ALL)

  def _pose(self, adr: np.ndarray, values: np.ndarray, mask: wp.array):
    for world in np.flatnonzero(mask.numpy()):
      data = self.datas[world]
      data.qpos[adr[:, 0]], data.qvel[adr[:, 1]] = values[world], 0.0

  def _switch(self, equality: int, active: wp.array):
    for data, on in zip(self.datas, active.numpy(), strict=True):
      data.eq_active[equality] = on

  def _place(self, body: int, pos: np.ndarray, quat: np.ndarray, mask: wp.array):
    for world in np.flatnonzero(mask.numpy()):
      model = self.models[world]
      model.body_pos[body], model.body_quat[body] = pos[world], quat[world]

  def _configure(self, worlds: np.ndarray, gravity: np.ndarray | None, friction: dict):
    for k, world in enumerate(worlds):
      model = self.models[world]
      if gravity is not None:
        model.opt.gravity[:] = gravity[k]
      for g, values in friction.items():
        model.geom_friction[g, 0] = values[k]

  @functools.cached_property
  def _poses(self) -> tuple[wp.array, wp.array]:
    shape = self.nworld, self.model.nbody
    pos, mat = (wp.zeros(shape, dtype=kind, device="cpu") for kind in (wp.vec3, wp.mat33))
    return pos, mat

  def camera(self, *args: Any, **kwargs: Any) -> Camera:
    """Returns a camera, see `Batch`."""
    return Camera(self, *args, **kwargs)

  def poses(self) -> tuple[wp.array, wp.array, np.ndarray]:
    """Returns where bodies are now, see `Batch`."""
    pos, mat = (each.numpy() for each in self._poses)

    def work(world: int):
      data = self.datas[world]
      mujoco.mj_kinematics(self.models[world], data)
      pos[world], mat[world] = data.xpos, data.xmat.reshape(-1, 3, 3)

    self.each(work)
    return *self._poses, np.arange(self.model.nbody)

  def _tell(self):
    for name in ("qpos", "qvel", "sensordata"):
      out = self._arrays[name].numpy()
      for world, data in enumerate(self.datas):
        out[world] = getattr(data, name)
    self._arrays["time"].numpy()[:] = [data.time for data in self.datas]

  def _get_state(self, world: int, data: mujoco.MjData):
    model, own = self.models[world], self.datas[world]
    engine.sync(model, own)
    _copy_state(model, own, self.model, data)

  def _set_state(self, world: int, data: mujoco.MjData):
    self._check_state(data, self._declared())
    engine.sync(self.model, data)
    _copy_state(self.model, data, self.models[world], self.datas[world])
    self.ctrl.numpy()[world] = data.ctrl


class _Tissue(Tissue):
  """An organ of `Threads`."""

  def __init__(self, batch: Threads, name: str, instance: int):
    pairs = zip(batch.models, batch.datas, strict=True)
    self.handles = [Organ(model, data, name) for model, data in pairs]
    self.spaces = [engine.find(data._address, instance) for data in batch.datas]
    self.name, self.elem, self.space = name, self.handles[0].elem, self.spaces[0]
    self.nvert = coupling.outer(self.spaces[0].organ)
    self.batch, self._counted = batch, list[Any]([None] * batch.nworld)
    self._pieces = wp.zeros(batch.nworld, dtype=int, device="cpu")

  @functools.cached_property
  def _arrays(self) -> dict[str, wp.array]:
    shape = (self.batch.nworld, self.nvert, 3)
    arrays = {name: wp.zeros(shape, dtype=float, device="cpu") for name in _OF_VERTICES}
    return arrays | {
      name: wp.zeros(self.batch.nworld, dtype=float, device="cpu")
      for name in ("residual", "iterations")
    }

  @functools.cached_property
  def applied(self) -> wp.array:
    if self.space.organ.windows:
      raise ValueError(f"organ {self.name!r}: it has windows, on whose nodes no force is applied")
    return wp.zeros((self.batch.nworld, self.nvert, 3), dtype=float, device="cpu")

  @property
  def forced(self) -> bool:
    """Whether somebody applies forces to it."""
    return "applied" in self.__dict__

  def push(self, world: int):
    """Applies the forces of a world."""
    if self.forced:
      force = self.batch.datas[world].xfrc_applied
      force[self.space.organ.body, :3] = self.applied.numpy()[world]

  @functools.cached_property
  def bonds(self) -> OfThreads:
    return OfThreads(self.batch, self.handles)

  @property
  def needles(self) -> Needles:
    if not self.space.needles:
      raise self._no_needles()
    return gathered([handle.needles for handle in self.handles])

  def _read(self, name: str) -> wp.array:
    array = self._arrays[name]
    out = array.numpy()
    for world, handle in enumerate(self.handles):
      values = getattr(handle, name)
      if name in _OF_VERTICES:  # those that wait for a cut are not there yet
        out[world, len(values) :] = np.nan if name == "xpos" else 0.0
        out[world, : len(values)] = values
      else:
        out[world] = values
    return array

  @property
  def _spare(self) -> int:
    return self.spaces[0].organ.mesh.spare

  def _cut(self, points: dict[int, np.ndarray], depth, direction) -> list[Report | None]:
    for world, path in points.items():
      try:
        cutting.find(self.spaces[world], path, 0.0, depth, direction)
      except ValueError as error:
        raise ValueError(f"world {world}: {error}") from None
    return [
      handle.cut(points[world], depth, direction) if world in points else None
      for world, handle in enumerate(self.handles)
    ]

  def _told(self, name: str, world: int) -> list:
    handle = self.handles[world]
    return list(handle.cuts if name == "reports" else handle.pieces)

  def _piece_count(self) -> wp.array:
    out = self._pieces.numpy()
    for world, space in enumerate(self.spaces):
      cutting.follow(space)
      mesh = space.organ.mesh
      if mesh is not self._counted[world]:
        self._counted[world], out[world] = mesh, int(topology.pieces(mesh).max()) + 1
    return self._pieces

  def _cutters(self) -> Cutters:
    every = [handle.cutters for handle in self.handles]
    columns = (
      np.array([[getattr(each, name) for each in row] for row in every], np.float32)
      for name in Cutters._fields
    )
    return Cutters(*(wp.array(column, dtype=float, device="cpu") for column in columns))

  def meshes(self) -> Sequence[Mesh]:
    for space in self.spaces:
      cutting.follow(space)
    return [space.organ.mesh for space in self.spaces]

  def elem_of(self, world: int) -> np.ndarray:
    return self.handles[self.batch.index(world)].elem

  def configure(self, mask=None, **keys):
    worlds = np.flatnonzero(self.batch.checked(mask).numpy())
    rows = {key: spread(self, key, value, self.batch.nworld) for key, value in keys.items()}

    def work(world: int):
      values = {key: value[world] for key, value in rows.items()}
      if "friction" in values:
        flexes = self.spaces[world].organ.flexes
        self.batch.models[world].flex_friction[flexes, 0] = float(values.pop("friction"))
      self.handles[world].configure(**values)

    self.batch.each(work, worlds)


class _Thread(thread.Thread):
  """A thread of `Threads`."""

  def __init__(self, batch: Threads, name: str):
    pairs = zip(batch.models, batch.datas, strict=True)
    self.name, self.handles = name, [Thread(model, data, name) for model, data in pairs]
    self._batch = batch
    number = instances(batch.model, dim=1)[name]
    self.space = engine.find_thread(batch.datas[0]._address, number)
    self.nworld, self.holds = batch.nworld, self.handles[0].holds

  @property
  def xpos(self) -> wp.array:
    return wp.array([each.positions for each in self.handles], dtype=float, device="cpu")

  @property
  def tension(self) -> wp.array:
    return wp.array([each.tension for each in self.handles], dtype=float, device="cpu")

  @property
  def broken(self) -> wp.array:
    rows = [np.append(each.broken, False) for each in self.handles]
    return wp.array(rows, dtype=wp.float64, device="cpu")

  def lay(self, places: np.ndarray, mask=None):
    organ, self._batch._fresh = self.space.organ, False
    for world in np.flatnonzero(self._batch.checked(mask).numpy()):
      model, data = self._batch.models[world], self._batch.datas[world]
      moved = (places[world] - organ.origin) @ organ.frame - organ.rest
      data.qpos[organ.qposs] = model.qpos0[organ.qposs] + moved[organ.free].ravel()
      data.qvel[organ.dofs] = 0.0

  def _hold(self, by: str, node, anchor, firm):
    given = node, anchor, firm
    rows = (each.numpy() if isinstance(each, wp.array) else np.asarray(each) for each in given)
    for handle, *row in zip(self.handles, *rows, strict=True):
      handle.hold(by, *row)


def _copy_state(model, data, other_model, other):
  for kind in (_FULL, _CTRL):
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, state, kind)
    mujoco.mj_setState(other_model, other, state, kind)
  engine.place_windows(other_model, other)
