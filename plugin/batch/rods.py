"""Threads in the worlds of a batch on a device: each world has a `Rod`, and kernels take them all.

mujoco_warp has a thread's nodes as bodies and finds its contacts with geoms. Between its rows of
constraints and its solver the thread takes its step (`coupling/world_rods.h`), and after it an
organ through which it goes.
"""

import functools
from typing import TYPE_CHECKING, Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from palpate.engine import layout, rods
from palpate.engine.coupling import Ties
from palpate.engine.rods import Rod
from palpate.thread import HELD, LOOSE, holds_of
from palpate.tissue.kernels import kernel
from palpate.tissue.types import DIMS, Array, also, doubles, fill, floats, ints

from . import kernels, thread
from .base import on_device
from .contact.contact_rows import Early, take_early
from .mjw.arrays import arrays_of, theirs

if TYPE_CHECKING:
  from .worlds import Worlds

_EACH = 2  # contacts of an edge with geoms, and as many more of a thread
_BEYOND = 16
_LANES = 32  # threads of a world
# What a state has for each dof.
_OF_DOFS = {name for name, dims in DIMS[layout.RodState.key].items() if dims == ("nv",)}
# What of these fields are those of `rods.Bound`.
_OF_BOUND = ("flex", "rest", "dofadr", "qposadr", "bodyid", "massadr", "own_dof", "dof_tree",
             "dof_first", "dof_vertex", "geom_tree", "frame", "nv")  # fmt: skip
_ITERATIONS = 60  # of a step, at most: all worlds wait for the one that takes longest


@theirs(
  "contact_",
  option="gravity",
  model="M_rowadr M_rownnz M_colind dof_damping flex_dim body_invweight0",
  data="qpos qvel qfrc_applied xfrc_applied qfrc_passive qfrc_actuator qfrc_smooth qacc "
  "qacc_warmstart M nefc",
  contact="dim flex elem geom friction",
  efc="type id J J_rownnz J_rowadr J_colind D aref force",
)
@also(rods.Bound, *_OF_BOUND)
class WorldRods:
  """A thread in all worlds, and mujoco_warp's arrays under their own names."""

  rods: Array(Rod, ("nworld",))
  sparse: int  # whether rows have the columns that they need alone
  falls: int  # whether there is gravity
  timestep: wp.float64
  impratio: wp.float64
  qpos0: floats("nq")
  # What worlds have of their own:
  now: doubles("nworld", "nnode", 3)  # place in the slides' axes [m]
  speed: doubles("nworld", "nnode", 3)  # velocity [m/s]
  bad: ints("nworld")  # whether a number is not finite


_CONSTANTS = rods.CONSTANTS | {"IS_CONTACT": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)}
_begin, _end, _find_bad = (
  kernel(name, "coupling/world_rods.h", WorldRods, _CONSTANTS, own=True)
  for name in ("begin_rods", "end_rods", "find_bad_rods")
)


def most_contacts(space: rods.Workspace) -> int:
  """Returns how many contacts with geoms a world has room for."""
  return _EACH * len(space.organ.rest) + _BEYOND


def bytes_of(space: rods.Workspace) -> float:
  """Returns about how many bytes a world takes of a thread."""
  return float(sum(8 * each.size for each in rods.scratch(space.organ, 0).values()))


class Thread(thread.Thread):
  """A thread of `Worlds`.

  Attributes:
    ties: what organs hold it by
  """

  def __init__(self, batch: "Worlds", space: rods.Workspace):
    organ, bare, device, nworld = space.organ, batch.bare, batch.device, batch.nworld
    self.name, self.space, self.declared, self._batch = organ.name, space, organ, batch
    self.nworld, self.holds = nworld, holds_of(batch.model, organ.body)
    n, m, d = len(organ.rest), batch.m, batch.d
    kept_qpos, kept_dof = batch.kept
    dofadr = np.where(organ.free, np.searchsorted(kept_dof, organ.dofadr), -1)
    dofs = np.maximum(dofadr, 0)[:, None] + np.arange(3)
    own_dof = np.full(bare.nv, -1)
    moving = np.flatnonzero(organ.free)[:, None]
    own_dof[dofs[organ.free]] = 3 * moving + np.arange(3)
    mass = space.mass
    shared = space.constants | rods.settings(organ, space.friction) | {"mass": mass, "body": mass}
    shared["newton"] = min(shared["newton"], _ITERATIONS)
    spans = layout.spans(layout.RodState, organ.sizes(bare.nv))
    self.own = own = {
      name: wp.zeros((nworld, span.stop - span.start), dtype=wp.float64, device=device)
      for name, span in spans.items()
      if span.stop > span.start
    }
    widest = max(array.shape[1] for array in own.values())
    self._zero = wp.zeros((1, widest), dtype=wp.float64, device=device)
    self.ties = Ties(nworld, device)
    if organ.config.refine:
      self.ties.track(n)
    scratch = rods.scratch(organ, bare.nv).items()
    each = {name: _rows(Rod, name, start, nworld, device) for name, start in scratch}
    self.iterations = each["status"]
    each |= self.ties.arrays
    values: dict[str, Any] = dict(
      rods=_stack(shared | each | {"own": dict.fromkeys(spans, np.zeros(0)) | own}, nworld, device),
      nv=bare.nv,
      flex=mujoco.mj_name2id(bare, mujoco.mjtObj.mjOBJ_FLEX, organ.name),
      sparse=int(m.is_sparse),
      falls=int(not bare.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY),
      timestep=float(bare.opt.timestep),
      impratio=float(bare.opt.impratio),
      rest=organ.rest,
      frame=organ.frame,
      dofadr=dofadr,
      qposadr=np.where(organ.free, np.searchsorted(kept_qpos, organ.qposadr), -1),
      bodyid=batch.numbers[organ.body],
      massadr=np.where(organ.free[:, None], (bare.M_rowadr + bare.M_rownnz - 1)[dofs], -1),
      own_dof=own_dof,
      dof_tree=bare.dof_treeid,
      **rods.vertices(bare),
      geom_tree=bare.body_treeid[bare.geom_bodyid],
      qpos0=bare.qpos0,
      now=np.tile(organ.rest, (nworld, 1, 1)),
      speed=np.zeros((nworld, n, 3)),
      bad=batch.bad,
    )
    self.fields: Any = fill(WorldRods, device, arrays_of(WorldRods, m, d) | values)
    self._origin = wp.vec3(*organ.origin)
    springs = np.array([space.constants[name] for name in ("stretch", "length")])
    moved = own.get("moved", np.zeros((nworld, 0)))
    shown = {"now": self.fields.now, "springs": springs, "moved": moved, "broken": own["broken"]}
    self._shown = fill(kernels.Pulled, device, shown)

  def load(self):
    """Loads the kernels, compiling them where the cache has none."""
    for each in (_begin, _end, _find_bad):
      each.load(self._batch.device)

  def _over(self, each):
    device = self._batch.device
    each.launch(device, self._batch.nworld, _LANES if device.is_cuda else 1, 0, self.fields, _LANES)

  def begin(self):
    """Takes the thread's step and adds it to the passive forces."""
    self._over(_begin)

  def end(self):
    """Ends the step after mujoco_warp has moved."""
    self._over(_end)

  def find_bad(self):
    """Flags worlds that are not finite."""
    self._over(_find_bad)

  def _made(self, kind, count: int) -> wp.array:
    return wp.zeros((self._batch.nworld, count), dtype=kind, device=self._batch.device)

  @functools.cached_property
  def _xpos(self) -> wp.array:
    return self._made(wp.vec3, len(self.declared.rest))

  @functools.cached_property
  def _tension(self) -> wp.array:
    return self._made(float, len(self.declared.rest) - 1)

  @property
  def xpos(self) -> wp.array:
    """Positions of the nodes [m], (nworld, nnode, 3)."""
    inputs = [self.fields.now, self.fields.frame, self._origin, self._xpos]
    wp.launch(kernels.show_rod, dim=self._xpos.shape, inputs=inputs, device=self._batch.device)
    return self._xpos.view(float)

  @property
  def tension(self) -> wp.array:
    """Tension of each edge [N], (nworld, nnode - 1)."""
    inputs = [self._shown, self._tension]
    wp.launch(kernels.pull_rod, dim=self._tension.shape, inputs=inputs, device=self._batch.device)
    return self._tension

  @property
  def broken(self) -> wp.array:
    """1 where an edge has broken, of float64 (nworld, nnode); the last one is of no edge."""
    return self.own["broken"]

  def lay(self, places: np.ndarray, mask=None):
    """Puts the nodes of worlds at places, at rest; twist, breaks and kept bends are lost."""
    f, organ, batch = self.fields, self.declared, self._batch
    local = (np.asarray(places, float) - organ.origin) @ organ.frame
    laid: Any = kernels.Laid()
    laid.mask = batch.checked(mask)
    laid.places = wp.array(local, dtype=wp.float64, device=batch.device)
    for name in ("now", "speed", "rest", "qpos0", "qpos", "qvel", "qposadr", "dofadr"):
      setattr(laid, name, getattr(f, name))
    batch._fresh = False
    wp.launch(kernels.lay, dim=local.shape, inputs=[laid], device=batch.device)
    for array in self.own.values():
      inputs = [laid.mask, self._zero, array]
      wp.launch(kernels.put_back_rows, dim=array.shape, inputs=inputs, device=batch.device)

  @functools.cached_property
  def _holding(self) -> dict[str, Any]:
    """What `kernels.hold` takes, by the name of an equality of the scene."""
    batch, nnode = self._batch, len(self.declared.rest)
    node = batch.numbers[self.declared.body[0]]  # of the equalities that were added for it
    first = batch.model.neq + np.flatnonzero(batch.bare.eq_obj2id[batch.model.neq :] == node)
    (solref, impedance), (loose_solref, loose_impedance) = HELD, LOOSE
    shared = dict(
      nnode=nnode, solref=wp.vec2(*solref), impedance=impedance,
      loose_solref=wp.vec2(*loose_solref), loose_impedance=loose_impedance,
      **arrays_of(kernels.Holding, batch.m, batch.d),
    )  # fmt: skip
    out = {}
    for name, start in zip(self.holds, first, strict=True):
      out[name] = kernels.Holding()
      for field, value in (shared | {"first": int(start)}).items():
        setattr(out[name], field, value)
    return out

  def _hold(self, by: str, node, anchor, firm):
    h, device = self._holding[by], self._batch.device
    h.node, h.firm = on_device(node, wp.int32, device), on_device(firm, wp.bool, device)
    h.anchor = on_device(anchor, wp.float32, device)
    wp.launch(kernels.hold, dim=(self.nworld, h.nnode), inputs=[h], device=device)

  def pull(self, world: int, data: mujoco.MjData):
    """Writes its state in a world to an mjData."""
    organ = self.declared
    now, speed = (getattr(self.fields, name)[world].numpy() for name in ("now", "speed"))
    moved = (now - organ.rest)[organ.free].ravel()
    data.qpos[organ.qposs] = self._batch.model.qpos0[organ.qposs] + moved
    data.qvel[organ.dofs] = speed[organ.free].ravel()
    own = self._own(data)
    kept = self._batch.kept[1]
    for name, array in self.own.items():
      into, values = getattr(own, name), array[world].numpy()
      if name in _OF_DOFS:
        into[:] = 0.0
        into[kept] = values[: len(kept)]
      else:
        into[:] = values
    own.signature[:] = organ.signature

  def push(self, world: int, data: mujoco.MjData):
    """Gives a world its state in an mjData."""
    organ, own = self.declared, self._own(data)
    for name, at, adr in (("now", data.qpos, organ.qposs), ("speed", data.qvel, organ.dofs)):
      array = getattr(self.fields, name)
      row = array[world].numpy()
      row[organ.free] = at[adr].reshape(-1, 3)
      if name == "now":
        row[organ.free] -= self._batch.model.qpos0[adr].reshape(-1, 3) - organ.rest[organ.free]
      array[world].assign(row)
    kept = self._batch.kept[1]
    for name, array in self.own.items():
      values = getattr(own, name)
      if name in _OF_DOFS:
        values = np.append(values[kept], np.zeros(array.shape[1] - len(kept)))
      array[world].assign(values)

  def _own(self, data: mujoco.MjData):
    """Returns views of its part of the plugin state."""
    start = self._batch.model.plugin_stateadr[self.space.instance]
    return rods.state_of(data.plugin_state[start:], self.declared, self._batch.model.nv)


class Rods:
  """The threads of a batch, which may have none."""

  def __init__(self, batch: "Worlds", spaces: list[rods.Workspace]):
    self.all = {space.organ.name: Thread(batch, space) for space in spaces}
    self._batch = batch
    if not spaces:
      return
    bare = batch.bare
    self._early = fill(Early, batch.device, dict(
      nthread=len(spaces),
      paired=int(batch.paired),
      disableflags=bare.opt.disableflags,
      discrete=int(bare.opt.integrator == getattr(mujoco.mjtIntegrator, "mjINT_DISCRETE", -1)),
      timestep=float(bare.opt.timestep),
      margin=bare.flex_margin[: len(spaces)],
      **arrays_of(Early, batch.m, batch.d),
    ))  # fmt: skip

  def ties(self, flex: int) -> Ties:
    """Returns what holds the thread of a flex of the compiled model."""
    (found,) = (each.ties for each in self.all.values() if each.declared.flex == flex)
    return found

  def aim(self):
    """Lets threads know what holds them, as a step begins."""
    for each in self.all.values():
      if each.ties.moved is not None:
        wp.copy(each.ties.moved, each.own["moved"])
      each.ties.aim()

  def begin(self):
    """Takes the threads' steps, once there are rows of constraints."""
    if not self.all:
      return
    dim, device = self._early.dim.shape, self._batch.device
    wp.launch(take_early, dim=dim, inputs=[self._early], device=device)
    mjw.fwd_actuation(self._batch.m, self._batch.d)
    for each in self.all.values():
      each.begin()


def _rows(kind, name: str, start: np.ndarray, nworld: int, device) -> wp.array:
  """Returns an array of a field with a row a world."""
  dtype = kind.vars[name].type.dtype
  return wp.zeros((nworld, *start.shape), dtype=dtype, device=device)


def _stack(values: dict, nworld: int, device) -> wp.array:
  """Returns a `Rod` for each world: arrays with a row a world are its own, others shared."""
  each: dict[tuple[str, ...], wp.array] = {}

  def first(kind, values: dict, path: tuple[str, ...]):
    out = {}
    for name, var in kind.vars.items():
      value = values[name]
      if isinstance(value, dict):
        value = first(var.type, value, (*path, name))
      elif isinstance(value, wp.array):
        each[*path, name] = value
        value = value[0]
      out[name] = value
    return fill(kind, device, out)

  one = first(Rod, values, ())
  native = one.__ctype__()
  row = np.frombuffer(bytes(native), np.uint8)
  rows = np.tile(row, (nworld, 1))
  for path, array in each.items():
    kind, offset = type(native), 0
    for name in path:
      offset += getattr(kind, name).offset
      kind = dict(kind._fields_)[name]
    offset += kind.data.offset
    address: Any = array.ptr
    stride: Any = array.strides
    each_address = address + stride[0] * np.arange(nworld, dtype=np.uint64)
    rows[:, offset : offset + 8] = each_address[:, None].view(np.uint8)
  memory = wp.array(rows, dtype=wp.uint8, device=device)
  out: Any = wp.array(ptr=memory.ptr, dtype=Rod, shape=nworld, device=device)
  out.of = memory, one, each
  return out
