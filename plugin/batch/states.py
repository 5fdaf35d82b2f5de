"""States of worlds on a device, as the model that the user gave has them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine import plugin as engine
from palpate.engine.layout import TAIL
from palpate.tissue.order import from_slices, to_slices

from . import kernels
from .organ import host
from .organ.organ import Organ

if TYPE_CHECKING:
  from .worlds import Worlds

_MOTION = ("disp", "vel", "last", "before")
_PLAIN = ("act", "ctrl", "mocap_pos")


def bytes_of(bare: mujoco.MjModel, njmax: int, ncon: int) -> float:
  """Returns about how many bytes mujoco_warp takes for a world."""
  nv = bare.nv + 32
  floats = njmax * (nv + 20) + 2 * nv * nv + 60 * nv + 10 * bare.nflexedge + 80 * bare.nbody
  return 4.0 * floats + 230.0 * ncon


# Reading.


class Teller:
  """Writes qpos and qvel of a batch in the model's layout."""

  def __init__(self, batch: Worlds):
    def put(values):
      return wp.array(values, dtype=int, device=batch.device)

    self.batch = batch
    self._kept = [put(numbers) for numbers in batch.kept]
    nodal = [organ for organ in batch.organs.values() if organ.declared.windows is None]
    self._nodes = [
      (organ, (put(organ.declared.qposadr), put(organ.declared.dofadr))) for organ in nodal
    ]

  def tell(self):
    """Brings both up to date."""
    batch, device = self.batch, self.batch.device
    outs = (batch.qpos_out, batch.qvel_out)
    for k, (at, source, out) in enumerate(
      zip(self._kept, (batch.d.qpos, batch.d.qvel), outs, strict=True)
    ):
      dim = (batch.nworld, at.size)
      wp.launch(kernels.spread, dim=dim, inputs=[source, at, out], device=device)
      for organ, adr in self._nodes:
        dim, inputs = (batch.nworld, organ.nvert), [organ.patch, adr[k], k, out]
        wp.launch(kernels.spread_nodes, dim=dim, inputs=inputs, device=device)


# One world, to and from an mjData.


def pull(batch: Worlds, world: int, data: mujoco.MjData):
  """Writes the state of a world to an mjData."""
  model, d = batch.model, batch.d
  mujoco.mj_resetData(model, data)
  for k, name in enumerate(("qpos", "qvel")):
    row = getattr(d, name)[world].numpy()
    getattr(data, name)[batch.kept[k]] = row[: len(batch.kept[k])]
  for name in _PLAIN:
    if getattr(data, name).size:
      getattr(data, name)[:] = getattr(d, name)[world].numpy()
  if model.nmocap:
    data.mocap_quat[:] = d.mocap_quat[world].numpy()
  if model.neq:
    data.eq_active[:] = d.eq_active[world].numpy()[: model.neq]
  data.time = d.time[world : world + 1].numpy()[0]
  for organ in batch.organs.values():
    _pull_organ(organ, world, model, data)
  for thread in batch.rods.all.values():
    thread.pull(world, data)
  engine.place_windows(model, data)


def _own(organ: Organ, model, data) -> tuple[np.ndarray, dict[str, slice]]:
  """Returns an organ's part of the plugin state, and where its blocks lie."""
  start = model.plugin_stateadr[organ.instance]
  size = model.plugin_statenum[organ.instance]
  return data.plugin_state[start : start + size], coupling.spans(organ.declared)


def _kept(declared) -> list[tuple[str, np.ndarray]]:
  """Returns what the plugin state has of an organ's motion with nodal coupling, and of whom."""
  moving = np.flatnonzero(declared.free)
  return [("last", moving), ("before", moving), ("disp", declared.inner), ("vel", declared.inner)]


def _pull_organ(organ: Organ, world: int, model, data):
  declared, node = organ.declared, organ.body.shape.node.numpy()
  own, spans = _own(organ, model, data)
  motion = {
    name: from_slices(array[world].numpy())[node].astype(float)
    for name, array in organ.vectors.items()
  }
  force = organ.patch.force[world].numpy()[node].astype(float)
  heavier = float(organ.patch.heavier[world : world + 1].numpy()[0])
  if declared.windows is None:
    jointed = declared.jointed
    data.qpos[declared.qposs] = (motion["disp"] + _shift(organ, world))[jointed].ravel()
    data.qvel[declared.dofs] = motion["vel"][jointed].ravel()
    for name, which in _kept(declared):
      own[spans[name]] = motion[name][which].ravel()
    own[spans["force"]] = force[jointed].ravel()
    own[spans["heavier"]] = heavier
  else:
    for name in _MOTION:
      own[spans[name]] = motion[name].ravel()
    own[spans["tail"]] = 0.0
    own[spans["tail"].start + TAIL.heavier] = heavier
    _pull_slots(organ, world, own, spans, force)
  if organ.topology:
    organ.topology.pull(world, own, spans)
  for block, (there, _) in organ.host.kept.items():
    own[spans[block]] = there[world].numpy()
  own[spans["signature"]] = declared.signature


def _shift(organ: Organ, world: int) -> np.ndarray:
  """Returns how far cuts have moved vertices at rest [m], (nvert, 3)."""
  whole = organ.declared.mesh
  return organ.topology.mesh_now(world).rest - whole.rest if organ.topology else 0.0 * whole.rest


def _pull_slots(organ: Organ, world: int, own, spans, force: np.ndarray):
  """Gives the window the nodes of the slots, those with the greatest forces first."""
  win = organ.declared.window
  node = organ.patch.slot_node[world].numpy()
  node = organ.body.shape.vert.numpy()[node[node >= 0]]  # vertices from here on
  node = node[np.argsort(-np.linalg.norm(force[node], axis=1), kind="stable")]
  node = node[: win.nslot - 1]  # the last slot stays free
  number, forces = np.full(win.nslot, -1.0), np.zeros((win.nslot, 3))
  number[: len(node)], forces[: len(node)] = node + 1, force[node]
  own[spans["slot"]], own[spans["force"]] = number, forces.ravel()


def push(batch: Worlds, world: int, data: mujoco.MjData):
  """Gives a world the state of an mjData."""
  model, d = batch.model, batch.d
  engine.sync(model, data)
  scratch = batch.scratch
  mujoco.mj_resetData(model, scratch)
  scratch.qpos[:], scratch.mocap_pos[:], scratch.mocap_quat[:] = (
    data.qpos, data.mocap_pos, data.mocap_quat
  )  # fmt: skip
  mujoco.mj_kinematics(model, scratch)
  for k, name in enumerate(("qpos", "qvel")):
    array = getattr(d, name)
    row = array[world].numpy()
    row[: len(batch.kept[k])] = getattr(data, name)[batch.kept[k]]
    _assign(array, world, row)
  for name in _PLAIN:
    _assign(getattr(d, name), world, getattr(data, name))
  _assign(d.qacc_warmstart, world, np.zeros(d.qacc_warmstart.shape[1]))
  _assign(d.mocap_quat, world, data.mocap_quat)
  active = np.zeros(d.eq_active.shape[1], bool)  # nothing holds a thread, see `rods.Thread`
  active[: model.neq] = data.eq_active
  _assign(d.eq_active, world, active)
  poses = (d.geom_xpos, scratch.geom_xpos), (d.geom_xmat, scratch.geom_xmat)
  for array, values in poses if model.ngeom else ():
    row = array[world].numpy()
    row[: model.ngeom] = values.reshape(model.ngeom, *row.shape[1:])
    _assign(array, world, row)
  d.time[world : world + 1].assign(np.array([data.time], np.float32))
  for organ in batch.organs.values():
    _push_organ(organ, world, model, data)
  for thread in batch.rods.all.values():
    thread.push(world, data)
  host.follow(batch, [world])


def keep(batch: Worlds, starts: list[tuple[Any, Any]], data: mujoco.MjData):
  """Lets worlds start in the state of an mjData; `starts` is what resets have of it."""
  d, organs = batch.d, batch.organs.values()
  for organ in organs:
    own, spans = _own(organ, batch.model, data)
    if organ.topology and organ.topology.is_cut(own, spans):
      raise ValueError(
        f"organ {organ.name!r}: data has cuts, which a batch on a GPU cannot start with; cut after "
        "a reset"
      )
  beside = (pair for organ in organs for pair in organ.host.kept.values())
  pairs = [*starts, *(pair for pair in beside if pair[0].size)]
  # The first world has it for a moment.
  changed = [array for array, _ in pairs] + [d.ctrl, d.time, d.qacc_warmstart]
  saved = [(array, wp.clone(array[:1])) for array in changed if array.size]
  push(batch, 0, data)
  for array, start in pairs:
    wp.copy(start.flatten(), array[:1].flatten())
  for array, row in saved:
    wp.copy(array[:1], row)


def _assign(array: wp.array, world: int, values: np.ndarray):
  if values.size:
    row = array[world]
    row.assign(wp.array(values, dtype=array.dtype, device=array.device))


def _push_organ(organ: Organ, world: int, model, data):
  declared, node = organ.declared, organ.body.shape.node.numpy()
  own, spans = _own(organ, model, data)
  motion = {name: np.zeros((declared.mesh.nvert, 3)) for name in _MOTION}
  force = np.zeros((declared.mesh.nvert, 3))
  if organ.topology:
    organ.topology.push(world, own, spans)
  if declared.windows is None:
    jointed = declared.jointed
    at = data.qpos[declared.qposs].reshape(-1, 3)
    motion["disp"][jointed] = at - _shift(organ, world)[jointed]
    motion["vel"][jointed] = data.qvel[declared.dofs].reshape(-1, 3)
    for name, which in _kept(declared):
      motion[name][which] = own[spans[name]].reshape(-1, 3)
    force[jointed] = own[spans["force"]].reshape(-1, 3)
    heavier, calm = float(own[spans["heavier"]][0]), 0.0
  else:
    for name in _MOTION:
      motion[name][:] = own[spans[name]].reshape(-1, 3)
    number = own[spans["slot"]].astype(int)
    slot_node = np.where(number == 0, declared.window.home, number - 1)
    used = slot_node >= 0
    force[slot_node[used]] = own[spans["force"]].reshape(-1, 3)[used]
    heavier, calm = (float(own[spans["tail"].start + k]) for k in (TAIL.heavier, TAIL.quiet))
  for name, array in organ.vectors.items():
    full = np.zeros((organ.body.shape.nnode, 3), np.float32)
    full[node] = motion[name]
    _assign(array, world, to_slices(full))
  full = np.zeros((organ.body.shape.nnode, 3))
  full[node] = force
  _assign(organ.patch.force, world, full)
  for array, value in ((organ.patch.heavier, heavier), (organ.patch.calm, calm)):
    array[world : world + 1].assign(np.array([value]))
  for block, (there, _) in organ.host.kept.items():
    _assign(there, world, own[spans[block]])
