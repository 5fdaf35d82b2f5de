"""Steps of mujoco_warp that repeat to the bit, whatever the GPU does first.

mujoco_warp's threads ask for contacts and constraint rows, which are placed as they come, and add
up over them by atomics. Here contacts and rows are put in an order that depends on the state alone,
and the few sums over them are taken in it. Warp's own deterministic mode, which mujoco_warp has for
all of its sums, writes down every addend of every kernel and sorts them all.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false, reportIndexIssue=false, reportReturnType=false
# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false
import contextlib
import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.types import Array, fill, floats, ints, struct

from .. import private
from ..private import ConstraintType

# Columns of mujoco_warp's rows that move with them.
_INTS = ("type", "id", "J_rownnz", "J_rowadr")
_FLOATS = ("pos", "margin", "D", "vel", "aref", "frictionloss")
_CONTACT = wp.constant(int(ConstraintType.CONTACT_FRICTIONLESS))  # and what comes after it
_FRICTION = wp.constant(int(ConstraintType.FRICTION_DOF))
_PAIR = wp.constant(64)  # contacts of two geoms, at most
# Contacts of a world's geoms that are put in order; more stay as they came.
_ROOM = wp.constant(64)
_LANES = wp.constant(16)  # threads of a world that add up what rows do to dofs


@struct
class Ints:
  """A column of all rows, or one of all contacts in words of 32 bits."""

  column: ints("nworld", "njmax")


@struct
class Floats:
  """The same of numbers."""

  column: floats("nworld", "njmax")


@struct
class Pairs:
  """The contacts that mujoco_warp has found between geoms, and room to put them in order."""

  ngeom: int
  nacon: ints(1)
  geom: Array(wp.vec2i, ("naconmax",))
  number: ints("naconmax")  # among those of two geoms
  worldid: ints("naconmax")
  moved: Array(Ints, ("ncolumn",))  # what moves
  count: ints("nworld")  # contacts of a world
  before: ints("nworld")  # those of the worlds before it
  listed: ints("nworld", _ROOM)  # as they came
  place: ints("naconmax")  # where one goes among those of its world
  kept: ints("nword", "naconmax")  # what is moved


@struct
class Rows:
  """The constraint rows of mujoco_warp, and room to put them in order."""

  nefc: ints("nworld")
  nblock: ints("nworld")  # blocks of rows that share their dofs
  block_adr: ints("nworld", "njmax")  # their first row
  block_nrow: ints("nworld", "njmax")
  type: ints("nworld", "njmax")
  id: ints("nworld", "njmax")  # of the joint, the contact, ...
  moved: Array(Ints, ("nint",))  # what moves: `_INTS`, and `part`
  moved_float: Array(Floats, ("nfloat",))
  frictionadr: ints("nworld", "nv")  # row of a dof's friction
  contact_row: ints("naconmax", "nrow")
  key: Array(wp.int64, ("nworld", "njmax"))  # what rows are ordered by
  part: ints("nworld", "njmax")  # which of its contact's rows
  place: ints("nworld", "njmax")  # where a row goes
  kept: ints("nint", "nworld", "njmax")  # what is moved
  kept_float: floats("nfloat", "nworld", "njmax")
  kept_block: ints(2, "nworld", "njmax")


@wp.func
def _found(p: Pairs):
  return wp.min(p.nacon[0], p.place.shape[0])


@wp.kernel(enable_backward=False)
def _list_contacts(p: Pairs):
  """Lists the contacts of each world."""
  c = wp.tid()
  if c >= _found(p):
    return
  w = p.worldid[c]
  k = wp.atomic_add(p.count, w, 1)
  p.place[c] = k
  if k < _ROOM:
    p.listed[w, k] = c


@wp.func
def _pair_key(p: Pairs, c: int):
  pair = p.geom[c]
  return wp.int64(pair[0] * p.ngeom + pair[1]) * wp.int64(_PAIR) + wp.int64(p.number[c])


@wp.kernel(enable_backward=False)
def _place_contacts(p: Pairs):
  """Finds where contacts go among those of their world: by their geoms, then by their number."""
  w, k = wp.tid()
  n = wp.min(p.count[w], _ROOM)
  if k >= n:
    return
  c = p.listed[w, k]
  key = _pair_key(p, c)
  to = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  for q in range(n):
    if _pair_key(p, p.listed[w, q]) < key:
      to += 1
  p.place[c] = to


@wp.kernel(enable_backward=False)
def _keep_contacts(p: Pairs):
  """Keeps contacts at their places."""
  c = wp.tid()
  if c >= _found(p):
    return
  to = p.before[p.worldid[c]] + p.place[c]
  word = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  for f in range(p.moved.shape[0]):
    column = p.moved[f].column
    for k in range(column.shape[1]):
      p.kept[word, to] = column[c, k]
      word += 1


@wp.kernel(enable_backward=False)
def _move_contacts(p: Pairs):
  """Moves contacts to their places."""
  c = wp.tid()
  if c >= _found(p):
    return
  word = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  for f in range(p.moved.shape[0]):
    column = p.moved[f].column
    for k in range(column.shape[1]):
      column[c, k] = p.kept[word, c]
      word += 1


@wp.func
def _count(r: Rows, w: int):
  return wp.min(r.nefc[w], r.type.shape[1])


@wp.kernel(enable_backward=False)
def _find_keys(r: Rows):
  """Finds what rows are ordered by: the kind of constraint, and its number."""
  w, k = wp.tid()
  if k >= _count(r, w):
    return
  part = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  if r.type[w, k] >= _CONTACT:
    part = k - r.contact_row[r.id[w, k], 0]
  r.key[w, k] = wp.int64(r.id[w, k]) + (wp.int64(r.type[w, k]) << wp.int64(48))
  r.part[w, k] = part


@wp.kernel(enable_backward=False)
def _keep(r: Rows):
  """Finds where rows go, and keeps them."""
  w, k = wp.tid()
  n = _count(r, w)
  if k >= n:
    return
  key = r.key[w, k]
  to = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  for q in range(n):
    other = r.key[w, q]
    if other < key or (other == key and q < k):
      to += 1
  r.place[w, k] = to
  for f in range(r.moved.shape[0]):
    r.kept[f, w, to] = r.moved[f].column[w, k]
  for f in range(r.moved_float.shape[0]):
    r.kept_float[f, w, to] = r.moved_float[f].column[w, k]


@wp.kernel(enable_backward=False)
def _move(r: Rows):
  """Moves rows to their places, and finds those of blocks."""
  w, k = wp.tid()
  if k < _count(r, w):
    for f in range(r.moved.shape[0]):
      column = r.moved[f].column
      column[w, k] = r.kept[f, w, k]
    for f in range(r.moved_float.shape[0]):
      numbers = r.moved_float[f].column
      numbers[w, k] = r.kept_float[f, w, k]
    if r.type[w, k] >= _CONTACT:
      r.contact_row[r.id[w, k], r.part[w, k]] = k
    elif r.type[w, k] == _FRICTION:
      r.frictionadr[w, r.id[w, k]] = k
  if k < r.nblock[w]:
    adr = r.place[w, r.block_adr[w, k]]
    to = int(0)  # noqa: RUF046, UP018 - a variable to Warp
    for q in range(r.nblock[w]):
      to += wp.where(r.place[w, r.block_adr[w, q]] < adr, 1, 0)
    r.kept_block[0, w, to] = adr
    r.kept_block[1, w, to] = r.block_nrow[w, k]


@wp.kernel(enable_backward=False)
def _move_blocks(r: Rows):
  """Moves blocks to their places."""
  w, k = wp.tid()
  if k < r.nblock[w]:
    r.block_adr[w, k] = r.kept_block[0, w, k]
    r.block_nrow[w, k] = r.kept_block[1, w, k]


# In place of kernels of mujoco_warp's, with their arguments.


@functools.cache
def _gradient(stable_fast: bool, deterministic: bool) -> wp.Kernel:
  """Returns the kernel of the gradient, one thread adding up its square."""

  @wp.kernel(module="unique", enable_backward=False)
  def gradient(
    smooth: wp.array2d[float], constraint: wp.array2d[float], Ma: wp.array2d[float],
    changed: wp.array[int], done: wp.array[bool],
    out: wp.array2d[float], square: wp.array[float],
  ):  # fmt: skip
    w, i = wp.tid()
    if done[w]:
      return
    out[w, i] = Ma[w, i] - smooth[w, i] - constraint[w, i]
    if i == 0:
      total = float(0.0)  # noqa: UP018 - a variable to Warp
      for k in range(Ma.shape[1]):
        g = Ma[w, k] - smooth[w, k] - constraint[w, k]
        total += g * g
      square[w] = total

  return gradient


@functools.cache
def _constraint_force(compact: bool, nv: int, deterministic: bool) -> wp.Kernel:
  """Returns the kernel of J^T f: a thread has every 16th dof, and goes over the rows in order."""

  @wp.kernel(module="unique", enable_backward=False)
  def constraint_force(
    nefc: wp.array[int], rownnz: wp.array2d[int], rowadr: wp.array2d[int],
    colind: wp.array3d[int], J: wp.array3d[float], force: wp.array2d[float],
    cdof: wp.array2d[int], changed: wp.array[int], done: wp.array[bool], out: wp.array2d[float],
  ):  # fmt: skip
    w, lane = wp.tid()
    lanes = wp.min(_LANES, force.shape[1])
    if lane >= lanes or done[w] or changed[w] == 0:
      return
    for k in range(wp.min(nefc[w], force.shape[1])):
      f = force[w, k]
      if f != 0.0:
        for q in range(rowadr[w, k], rowadr[w, k] + rownnz[w, k]):
          i = colind[w, 0, q]
          if i % lanes == lane:
            out[w, i] = out[w, i] + J[w, 0, q] * f

  return constraint_force


@functools.cache
def _compensation(deterministic: bool) -> wp.Kernel:
  """Returns the kernel of gravity compensation, a thread a dof."""

  @wp.kernel(module="unique", enable_backward=False)
  def compensation(
    gravity: wp.array[wp.vec3], parentid: wp.array[int], rootid: wp.array[int],
    mass: wp.array2d[float], share: wp.array2d[float], dof_bodyid: wp.array[int],
    isdofancestor: wp.array2d[int], xipos: wp.array2d[wp.vec3], com: wp.array2d[wp.vec3],
    cdof: wp.array2d[wp.spatial_vector], out: wp.array2d[float],
  ):  # fmt: skip
    w, thread, i = wp.tid()
    if thread > 0:
      return
    total = float(0.0)  # noqa: UP018 - a variable to Warp
    for b in range(1, share.shape[1]):
      borne = share[w % share.shape[0], b] * mass[w % mass.shape[0], b]
      if borne != 0.0 and isdofancestor[b, i] != 0:
        jac, _turn = private.jac_dof(
          parentid, rootid, dof_bodyid, isdofancestor, com, cdof, xipos[w, b], b, i, w
        )
        total -= borne * wp.dot(jac, gravity[w % gravity.shape[0]])
    out[w, i] = total

  return compensation


@functools.cache
def sort_matches(most: int) -> wp.Kernel:
  """Returns the kernel that orders a sensor's contacts: by its criterion, then by their places."""

  @wp.func
  def before(a: int, b: int, of_a: float, of_b: float):
    if of_a != of_b:
      return of_a < of_b
    return wp.max(a, ~a) < wp.max(b, ~b)  # ~ where the sensor's body is the second

  @wp.kernel(module="unique", enable_backward=False)
  def sort_matches(
    intprm: wp.array2d[int], sensor: wp.array[int], count: wp.array2d[int],
    match: wp.array3d[int], criterion: wp.array3d[float], out: wp.array3d[int],
  ):  # fmt: skip
    w, s, lane = wp.tid()
    if lane > 0:
      return
    for k in range(1, wp.min(count[w, s], wp.static(most))):
      at = k
      mine = match[w, s, k]  # a copy: of two at once Warp keeps where they are
      own = criterion[w, s, k]
      while at > 0 and before(mine, match[w, s, wp.max(at - 1, 0)],
                              own, criterion[w, s, wp.max(at - 1, 0)]):  # fmt: skip
        match[w, s, at] = match[w, s, at - 1]
        criterion[w, s, at] = criterion[w, s, at - 1]
        at -= 1
      match[w, s, at] = mine
      criterion[w, s, at] = own

  return sort_matches


def is_enough(m: Any, model: mujoco.MjModel) -> bool:
  """Returns whether what is here is all of a scene that depends on who comes first.

  Sums of two addends do not; else Warp's deterministic mode is to be asked.
  """
  driven = np.zeros(model.nv, int)
  for kind, number in zip(model.actuator_trntype, model.actuator_trnid[:, 0], strict=True):
    if kind == mujoco.mjtTrn.mjTRN_JOINT:
      driven[model.jnt_dofadr[number]] += 1
    elif kind == mujoco.mjtTrn.mjTRN_TENDON:
      start = model.tendon_adr[number]
      wraps = model.wrap_objid[start : start + model.tendon_num[number]]
      driven[model.jnt_dofadr[wraps]] += 1
    else:
      return False
  fixed = (model.wrap_type == mujoco.mjtWrap.mjWRAP_JOINT).all()
  return bool(
    m.is_sparse
    and model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    and model.opt.integrator in (mujoco.mjtIntegrator.mjINT_EULER,
                                 mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    and not (m.has_fluid or m.sensor_rne_postconstraint)
    and fixed
    and (model.tendon_num <= 2).all()
    and (driven <= 2).all()
  )  # fmt: skip


def _words(array: wp.array) -> wp.array:
  """Returns an array of numbers of 32 bits in words, a row an element."""
  count = wp.types.type_size_in_bytes(array.dtype) // 4
  shape = array.shape[0], count
  return wp.array(ptr=array.ptr, dtype=int, shape=shape, device=array.device)


def _columns(kind: Any, arrays: list[wp.array]) -> wp.array:
  """Returns an array of structs, each of which refers to one of the arrays."""
  device = arrays[0].device
  columns = [fill(kind, device, {"column": each}) for each in arrays]
  return wp.array(columns, dtype=kind, device=device)


class FixedOrder:
  """Puts mujoco_warp's contacts and rows in order, and lets its step add them up in that."""

  def __init__(self, m: Any, d: Any):
    """Makes room for contacts and rows on their way."""
    efc, contact, shape = d.efc, d.contact, (d.nworld, d.njmax)
    device = efc.type.device
    part = wp.zeros(shape, dtype=int, device=device)
    moved = [*(getattr(efc, name) for name in _INTS), part]
    numbers = [getattr(efc, name) for name in _FLOATS]
    values = dict(
      nefc=d.nefc,
      nblock=efc.jtdaj_nblock,
      block_adr=efc.jtdaj_adr,
      block_nrow=efc.jtdaj_nrow,
      type=efc.type,
      id=efc.id,
      frictionadr=d.dof_frictionadr,
      contact_row=contact.efc_address,
      moved=_columns(Ints, moved),
      moved_float=_columns(Floats, numbers),
      part=part,
    )
    rooms = {"place": (), "kept": (len(moved),), "kept_float": (len(numbers),), "kept_block": (2,)}
    values |= {name: np.zeros((*more, *shape)) for name, more in rooms.items()}
    self._rows = fill(Rows, device, values | {"key": np.zeros(shape, np.int64)})
    self._shape = shape
    each = [getattr(contact, name.name) for name in dataclasses.fields(contact)]
    words = [_words(array) for array in each if array.shape == contact.dist.shape]
    self._pairs = fill(Pairs, device, dict(
      ngeom=m.ngeom,
      nacon=d.nacon,
      geom=contact.geom,
      number=contact.geomcollisionid,
      worldid=contact.worldid,
      moved=_columns(Ints, words),
      count=np.zeros(d.nworld),
      before=np.zeros(d.nworld),
      listed=np.zeros((d.nworld, _ROOM)),
      place=np.zeros(d.naconmax),
      kept=np.zeros((sum(array.shape[1] for array in words), d.naconmax)),
    ))  # fmt: skip

  def sort_contacts(self) -> None:
    """Launches what puts contacts in order, once those of geoms are found and before others are."""
    p, device = self._pairs, self._pairs.nacon.device
    p.count.zero_()
    wp.launch(_list_contacts, dim=p.place.shape, inputs=[p], device=device)
    wp.launch(_place_contacts, dim=p.listed.shape, inputs=[p], device=device)
    wp.utils.array_scan(p.count, p.before, inclusive=False)
    wp.launch(_keep_contacts, dim=p.place.shape, inputs=[p], device=device)
    wp.launch(_move_contacts, dim=p.place.shape, inputs=[p], device=device)

  def sort(self) -> None:
    """Launches what puts the rows in order, once they are made and before they are used."""
    for kernel in (_find_keys, _keep, _move, _move_blocks):
      wp.launch(kernel, dim=self._shape, inputs=[self._rows], device=self._rows.nefc.device)

  @staticmethod
  @contextlib.contextmanager
  def adding() -> Iterator[None]:
    """Lets what mujoco_warp launches within add up in order."""
    solver, sensor = private.solver, private.sensor
    instead: dict[tuple[Any, str], Any] = {
      (solver, "_jtdaj_groups_per_world"): lambda *sizes: 1,  # who adds blocks up
      (solver, "_use_incremental"): lambda m: False,
      (solver, "_update_gradient_grad"): _gradient,
      (solver, "_update_constraint_init_qfrc_constraint_sparse"): _constraint_force,
      (private.passive, "_gravity_force"): _compensation,
      (sensor, "_contact_sort"): sort_matches,
      (sensor, "_sensor_touch"): lambda deterministic: kept[sensor, "_sensor_touch"](True),
    }
    kept = {(module, name): getattr(module, name) for module, name in instead}
    try:
      for (module, name), other in instead.items():
        setattr(module, name, other)
      yield
    finally:
      for (module, name), own in kept.items():
        setattr(module, name, own)
