"""Steps of mujoco_warp that repeat to the bit, whatever the GPU does first.

mujoco_warp's threads ask for contacts and constraint rows, which are placed as they come, and add
up over them by atomics. Here contacts and rows are put in an order that depends on the state alone,
and the few sums over them are taken in it: J^T f and J^T D J of rows that are spread over all dofs.
Warp's own deterministic mode, which mujoco_warp has for all of its sums, writes down every addend
of every kernel and sorts them all.
"""

# pyright: reportIndexIssue=false, reportReturnType=false
# pyright: reportCallIssue=false, reportArgumentType=false, reportOperatorIssue=false
# pyright: reportAssignmentType=false, reportGeneralTypeIssues=false
import contextlib
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.kernels import meet_block
from palpate.tissue.types import Array, fill, floats, ints, struct

from ..mjw import private
from ..mjw.arrays import arrays_of, theirs
from ..mjw.private import ConstraintState, ConstraintType

# Columns of mujoco_warp's rows that move with them.
_COLUMNS = ("type", "id", "J_rownnz", "J_rowadr", "pos", "margin", "D", "vel", "aref",
            "frictionloss")  # fmt: skip
_TYPE, _ID, _ROWNNZ, _ROWADR = (wp.constant(k) for k in range(4))
_CONTACT = wp.constant(int(ConstraintType.CONTACT_FRICTIONLESS))  # and what comes after it
_FRICTION = wp.constant(int(ConstraintType.FRICTION_DOF))
_PAIR = wp.constant(64)  # contacts of two geoms, at most
# Contacts of a world's geoms that are put in order; more stay as they came.
_ROOM = wp.constant(64)
_LANES = wp.constant(8)  # threads that share a row
_SIDE = wp.constant(4)  # dofs of a block of the Hessian, which is a thread's
_TERMS = wp.constant(16)  # of a sum of the Hessian that are added up by themselves
_BLOCK = 256  # threads of a world
_SENSED = 32  # threads of a touch sensor
_CONE = wp.constant(int(ConstraintState.CONE))
_QUADRATIC = wp.constant(int(ConstraintState.QUADRATIC))


@struct
class Column:
  """A column of all rows, or of all contacts, in words of 32 bits."""

  words: ints("nworld", "njmax")


@theirs(data="nacon", contact="geom worldid geomcollisionid")
class Pairs:
  """The contacts that mujoco_warp has found between geoms, and room to put them in order."""

  ngeom: int
  moved: Array(Column, ("ncolumn",))  # what moves
  count: ints("nworld")  # contacts of a world, 0 between steps
  listed: ints("nworld", _ROOM)  # as they came
  place: ints("nworld", _ROOM)  # of the world's contacts, in ascending order
  to: ints("nworld", _ROOM)  # where a listed one goes
  kept: Array(Column, ("ncolumn",))  # of what is moved


@theirs(
  option="impratio_invsqrt",
  data="nefc dof_frictionadr",
  contact="dim friction efc_address",
  efc="type id D state force J J_colind",
)
class Rows:
  """The constraint rows of mujoco_warp, and room to put them in order."""

  moved: Array(Column, ("ncolumn",))  # what moves: `_COLUMNS`
  part: ints("nworld", "njmax")  # which of its contact's rows
  kept: Array(Column, ("ncolumn",))  # of what is moved
  # What sums over them need, of all dofs and some that pad the last block:
  whole: floats("nworld", "njmax", "npad")  # J
  weighed: floats("nworld", "njmax", "npad")  # D J, or the curvature of a cone times J


@theirs(
  model="sensor_touch_adr sensor_objid sensor_adr site_type site_bodyid site_size geom_bodyid",
  data="site_xpos site_xmat sensordata",
  contact="geom pos frame",
)
class Touches:
  """The touch sensors, and the contacts that they feel."""

  pyramids: int  # whether a contact's force is the sum of its rows


@wp.kernel(enable_backward=False)
def _list_contacts(p: Pairs):
  """Lists the contacts of each world."""
  c = wp.tid()
  if c < wp.min(p.nacon[0], p.worldid.shape[0]):
    w = p.worldid[c]
    k = wp.atomic_add(p.count, w, 1)
    if k < _ROOM:
      p.listed[w, k] = c


@wp.func
def _pair_key(p: Pairs, c: int):
  pair = p.geom[c]
  return wp.int64(pair[0] * p.ngeom + pair[1]) * wp.int64(_PAIR) + wp.int64(p.geomcollisionid[c])


@wp.kernel(enable_backward=False)
def _sort_contacts(p: Pairs):
  """Puts a world's contacts in order at their places: by their geoms, then by their number."""
  w, lane = wp.tid()
  lanes = wp.block_dim()
  n = wp.min(p.count[w], _ROOM)
  meet_block()
  if lane == 0:
    p.count[w] = 0
  if n <= 1:
    return
  for k in range(lane, n, lanes):
    c = p.listed[w, k]
    key = _pair_key(p, c)
    rank = int(0)
    at = int(0)
    for q in range(n):
      other = p.listed[w, q]
      at += wp.where(other < c, 1, 0)
      rank += wp.where(_pair_key(p, other) < key, 1, 0)
    p.place[w, at] = c
    p.to[w, k] = rank
  meet_block()
  for f in range(p.moved.shape[0]):
    kept = p.kept[f].words
    width = kept.shape[1]
    for q in range(lane, n * width, lanes):
      k = q / width
      kept[p.place[w, p.to[w, k]], q % width] = p.moved[f].words[p.listed[w, k], q % width]
  meet_block()
  for f in range(p.moved.shape[0]):
    moved = p.moved[f].words
    width = moved.shape[1]
    for q in range(lane, n * width, lanes):
      c = p.place[w, q / width]
      moved[c, q % width] = p.kept[f].words[c, q % width]


@wp.func
def _count(r: Rows, w: int):
  return wp.min(r.nefc[w], r.type.shape[1])


@wp.func
def _row_key(r: Rows, w: int, k: int):
  """Returns what rows are ordered by: the kind of constraint, and its number."""
  return wp.int64(r.id[w, k]) + (wp.int64(r.type[w, k]) << wp.int64(32))


@wp.kernel(enable_backward=False)
def _sort_rows(r: Rows):
  """Puts a world's rows in order, and spreads them over all dofs.

  Rows of one constraint stay in their order.
  """
  w, lane = wp.tid()
  lanes = wp.block_dim()
  n = _count(r, w)
  npad = r.whole.shape[2]
  for k in range(lane, n, lanes):
    key = _row_key(r, w, k)
    to = int(0)
    for q in range(n):
      other = _row_key(r, w, q)
      if other < key or (other == key and q < k):
        to += 1
    part = int(0)
    if r.type[w, k] >= _CONTACT:
      part = k - r.efc_address[r.id[w, k], 0]
    r.part[w, to] = part
    for f in range(r.moved.shape[0]):
      kept = r.kept[f].words
      kept[w, to] = r.moved[f].words[w, k]
  for q in range(lane, n * npad, lanes):
    r.whole[w, q / npad, q % npad] = 0.0
  meet_block()
  for k in range(lane, n, lanes):
    for f in range(r.moved.shape[0]):
      column = r.moved[f].words
      column[w, k] = r.kept[f].words[w, k]
    kind, number = r.kept[_TYPE].words[w, k], r.kept[_ID].words[w, k]
    if kind >= _CONTACT:
      r.efc_address[number, r.part[w, k]] = k
    elif kind == _FRICTION:
      r.dof_frictionadr[w, number] = k
    start = r.kept[_ROWADR].words[w, k]
    for q in range(start, start + r.kept[_ROWNNZ].words[w, k]):
      r.whole[w, k, r.J_colind[w, 0, q]] = r.J[w, 0, q]


@wp.func
def _bend(
  r: Rows, Jaref: wp.array2d[float], w: int, n: int, k: int, lane: int, lanes: int
):  # fmt: skip
  """Weighs a row of a contact whose force is on its cone, by mujoco_warp's curvature of that."""
  head = k - r.part[w, k]
  c = r.id[w, k]
  friction = r.friction[c]
  mu = friction[0] * r.impratio_invsqrt[w % r.impratio_invsqrt.shape[0]]
  dim = wp.min(r.dim[c], n - head)
  square = float(0.0)
  for d in range(1, dim):
    u = Jaref[w, head + d] * friction[d - 1]
    square += u * u
  t = wp.max(wp.sqrt(square), 1e-15)
  ratio = mu * Jaref[w, head] * mu / t
  curve = mu * mu - ratio
  scale = r.D[w, head] / wp.max(mu * mu * (1.0 + mu * mu), 1e-15)
  own = mu
  if k > head:
    own = friction[k - head - 1]
  for i in range(lane, r.whole.shape[2], lanes):
    normal = mu * r.whole[w, head, i]
    along = float(0.0)
    for d in range(1, dim):
      u = Jaref[w, head + d] * friction[d - 1] / t
      along += u * friction[d - 1] * r.whole[w, head + d, i]
    value = normal - mu * along
    if k > head:
      u = Jaref[w, k] * own / t
      value = u * (ratio * along - mu * normal) + curve * own * r.whole[w, k, i]
    r.weighed[w, k, i] = scale * own * value


@wp.func
def _weigh(r: Rows, Jaref: wp.array2d[float], w: int, n: int, k: int, lane: int, lanes: int):
  """Finds a row of W in J^T W, the constraints' part of the Hessian.

  It is D J where the cost is quadratic. On a contact's cone it is C J, with the curvature C of the
  contact's rows; those of a dof's friction have been added to the Hessian's diagonal.
  """
  weight = float(0.0)
  if r.state[w, k] == _QUADRATIC and r.type[w, k] != _FRICTION:
    weight = r.D[w, k]
  if r.state[w, k - r.part[w, k]] == _CONE:
    _bend(r, Jaref, w, n, k, lane, lanes)
  else:
    for i in range(lane, r.whole.shape[2], lanes):
      r.weighed[w, k, i] = weight * r.whole[w, k, i]


@wp.func
def _four(rows: wp.array3d[float], w: int, k: int, i: int):
  """Returns what a row has at the dofs of a block."""
  return wp.vec4(rows[w, k, i], rows[w, k, i + 1], rows[w, k, i + 2], rows[w, k, i + 3])


@wp.kernel(enable_backward=False)
def _update(
  r: Rows, Jaref: wp.array2d[float], smooth: wp.array2d[float], Ma: wp.array2d[float],
  done: wp.array[bool], qfrc: wp.array2d[float], grad: wp.array2d[float], square: wp.array[float],
  decrement: wp.array[float], scale: wp.array[float], unchanged: wp.array[bool],
  h: wp.array3d[float],
):  # fmt: skip
  """Finds J^T f, the gradient and its square; adds J^T W to the Hessian's upper triangle."""
  w, thread = wp.tid()
  unchanged[w] = False
  if done[w]:
    return
  n = _count(r, w)
  nv = qfrc.shape[1]
  lanes = wp.min(_LANES, wp.block_dim())
  for k in range(thread / lanes, n, wp.block_dim() / lanes):
    _weigh(r, Jaref, w, n, k, thread % lanes, lanes)
  meet_block()
  mine = float(0.0)
  side = r.whole.shape[2] / _SIDE
  for block in range(thread, side * (side + 1) // 2, wp.block_dim()):
    column = int((wp.sqrt(float(8 * block + 1)) - 1.0) * 0.5)
    row = block - column * (column + 1) // 2
    i, j = _SIDE * row, _SIDE * column
    curve = wp.mat44()
    total = wp.vec4()
    for first in range(0, n, _TERMS):
      terms = wp.mat44()
      for k in range(first, wp.min(first + _TERMS, n)):
        own = _four(r.whole, w, k, i)
        terms += wp.outer(own, _four(r.weighed, w, k, j))
        total += r.force[w, k] * own
      curve += terms
    for a in range(_SIDE):
      if row == column and i + a < nv:
        g = Ma[w, i + a] - smooth[w, i + a] - total[a]
        qfrc[w, i + a] = total[a]
        grad[w, i + a] = g
        mine += g * g
      for b in range(_SIDE):
        if i + a <= j + b and j + b < nv:
          h[w, i + a, j + b] = h[w, i + a, j + b] + curve[a, b]
  whole = wp.tile_reduce(wp.add, wp.tile(mine, preserve_type=True))
  if thread == 0:
    square[w] = whole[0]
    decrement[w] = 0.0
    scale[w] = 1.0


@wp.kernel(enable_backward=False)
def _touch(r: Rows, t: Touches):
  """Adds up the normal forces of contacts of a touch sensor's body that its site sees."""
  w, s, lane = wp.tid()
  sensor = t.sensor_touch_adr[s]
  site = t.sensor_objid[sensor]
  body = t.site_bodyid[site]
  n = _count(r, w)
  mine = float(0.0)
  for k in range(lane, n, wp.block_dim()):
    if r.type[w, k] >= _CONTACT and r.part[w, k] == 0:
      c = r.id[w, k]
      geom = t.geom[c]
      second = t.geom_bodyid[geom[1]] == body
      if second or t.geom_bodyid[geom[0]] == body:
        force = r.force[w, k]
        q = k + 1
        while t.pyramids != 0 and q < n and r.part[w, q] == q - k:
          force += r.force[w, q]
          q += 1
        frame = t.frame[c]
        way = wp.normalize(wp.vec3(frame[0, 0], frame[0, 1], frame[0, 2]))
        if second:
          way = -way
        at, turn, size = t.site_xpos[w, site], t.site_xmat[w, site], t.site_size[site]
        far, _normal = private.ray_geom(at, turn, size, t.pos[c], way, t.site_type[site])
        if force > 0.0 and far >= 0.0:
          mine += force
  total = wp.tile_reduce(wp.add, wp.tile(mine, preserve_type=True))
  if lane == 0:
    t.sensordata[w, t.sensor_adr[sensor]] = total[0]


# In place of kernels of mujoco_warp's, with their arguments.


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
    total = float(0.0)
    for b in range(1, share.shape[1]):
      borne = share[w % share.shape[0], b] * mass[w % mass.shape[0], b]
      if borne != 0.0 and isdofancestor[b, i] != 0:
        jac, _turn = private.jac_dof(
          parentid, rootid, dof_bodyid, isdofancestor, com, cdof, xipos[w, b], b, i, w
        )
        total -= borne * wp.dot(jac, gravity[w % gravity.shape[0]])
    out[w, i] = total

  return compensation


@wp.func
def _in_order(a: int, b: int, of_a: float, of_b: float):
  if of_a != of_b:
    return of_a < of_b
  return wp.max(a, ~a) < wp.max(b, ~b)  # ~ where the sensor's body is the second


@functools.cache
def sort_matches(most: int) -> wp.Kernel:
  """Returns the kernel that orders a sensor's contacts: by its criterion, then by their places."""

  @wp.kernel(module="unique", enable_backward=False)
  def sort_matches(
    intprm: wp.array2d[int], sensor: wp.array[int], count: wp.array2d[int],
    match: wp.array3d[int], criterion: wp.array3d[float], out: wp.array3d[int],
  ):  # fmt: skip
    w, s, lane = wp.tid()
    n = wp.min(count[w, s], wp.static(most))
    for turn in range(n):  # of neighbours, those that begin at even places and those at odd ones
      for k in range(turn % 2 + 2 * lane, n - 1, 2 * wp.block_dim()):
        a = match[w, s, k]  # a copy: of two at once Warp keeps where they are
        of_a = criterion[w, s, k]
        if _in_order(match[w, s, k + 1], a, criterion[w, s, k + 1], of_a):
          match[w, s, k] = match[w, s, k + 1]
          match[w, s, k + 1] = a
          criterion[w, s, k] = criterion[w, s, k + 1]
          criterion[w, s, k + 1] = of_a
      meet_block()

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
  """Returns an array of numbers of 32 bits as words, in two dimensions."""
  width = wp.types.type_size_in_bytes(array.dtype) // 4
  shape = array.shape if array.ndim == 2 else (array.shape[0], width)
  return wp.array(ptr=array.ptr, dtype=int, shape=shape, device=array.device)


def _columns(arrays: list[wp.array]) -> wp.array:
  """Returns an array of structs, each of which refers to one of the arrays."""
  columns = [fill(Column, array.device, {"words": array}) for array in arrays]
  return wp.array(columns, dtype=Column, device=arrays[0].device)


class FixedOrder:
  """Puts mujoco_warp's contacts and rows in order, and lets its step add them up in that."""

  def __init__(self, m: Any, d: Any):
    """Makes room for contacts and rows on their way."""
    efc, contact, shape = d.efc, d.contact, (d.nworld, d.njmax)
    self._model, self._none = m, wp.empty(0, dtype=int, device=efc.type.device)
    self._kept: list[wp.array] = []
    device = efc.type.device
    values = dict(
      **arrays_of(Rows, m, d),
      part=np.zeros(shape),
    )
    npad = -(-m.nv // _SIDE) * _SIDE
    values |= {name: np.zeros((*shape, npad)) for name in ("whole", "weighed")}
    values |= self._room_for([getattr(efc, name) for name in _COLUMNS])
    self._rows = fill(Rows, device, values)
    each = [getattr(contact, name.name) for name in dataclasses.fields(contact)]
    columns = self._room_for([array for array in each if array.shape == contact.dist.shape])
    self._pairs = fill(Pairs, device, dict(
      ngeom=m.ngeom,
      **arrays_of(Pairs, m, d),
      **columns,
      count=np.zeros(d.nworld),
      **{name: np.zeros((d.nworld, _ROOM)) for name in ("listed", "place", "to")},
    ))  # fmt: skip
    pyramids = int(m.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL)
    self._touches = fill(Touches, device, {"pyramids": pyramids} | arrays_of(Touches, m, d))

  def _room_for(self, arrays: list[wp.array]) -> dict[str, wp.array]:
    """Returns the columns of arrays that move, and of others that keep them meanwhile."""
    words = [_words(array) for array in arrays]
    kept = [wp.empty_like(array) for array in words]
    self._kept += kept
    return {"moved": _columns(words), "kept": _columns(kept)}

  def sort_contacts(self) -> None:
    """Launches what puts contacts in order, once those of geoms are found and before others are."""
    p = self._pairs
    wp.launch(_list_contacts, dim=p.worldid.shape, inputs=[p], device=p.nacon.device)
    self._launch(_sort_contacts, [p])

  def sort(self) -> None:
    """Launches what puts the rows in order, once they are made and before they are used."""
    self._launch(_sort_rows, [self._rows])

  def _launch(self, kernel: wp.Kernel, inputs: list, outputs: Sequence[wp.array] = ()) -> None:
    """Launches a kernel, a block a world."""
    count = self._rows.nefc
    wp.launch_tiled(
      kernel, dim=count.shape, inputs=inputs, outputs=outputs, device=count.device, block_dim=_BLOCK
    )

  def _update_constraint(self, m, d, ctx, track_changes=False, stable_fast=False) -> None:
    """Launches what finds forces of rows, in place of mujoco_warp's; J^T f is the gradient's."""
    contact, efc = d.contact, d.efc
    wp.launch(
      private.solver._update_constraint_efc(False),
      dim=(d.nworld, d.njmax),
      inputs=[
        m.opt.impratio_invsqrt, d.ne, d.nf, d.nefc, contact.friction, contact.dim,
        contact.efc_address, efc.type, efc.id, efc.D, efc.frictionloss, d.nacon, ctx.Jaref,
        ctx.ls_exhausted, ctx.done,
      ],
      outputs=[efc.force, efc.state, ctx.quad_changed_ids, ctx.quad_changed_count,
               ctx.state_changed_count],
    )  # fmt: skip

  def _update_gradient(self, m, d, ctx, compact=False) -> None:
    """Launches what finds the gradient, the Hessian and the search, in place of mujoco_warp's."""
    solver = private.solver
    wp.launch(
      solver._update_gradient_init_h_sparse(False),
      dim=(d.nworld, m.nv_pad, solver._INIT_H_LANES),
      inputs=[m.nv, m.M_elemid, d.nf, d.M, d.efc.D, d.efc.state, d.dof_frictionadr, d.cdof_dof,
              ctx.done],
      outputs=[ctx.h],
    )  # fmt: skip
    self._launch(
      _update,
      [self._rows, ctx.Jaref, d.qfrc_smooth, d.efc.Ma, ctx.done],
      [d.qfrc_constraint, ctx.grad, ctx.grad_dot, ctx.newton_decrement, ctx.grad_scale,
       ctx.search_unchanged, ctx.h],
    )  # fmt: skip
    solver._cholesky_factorize_solve(m, d, ctx)

  def adding(self) -> contextlib.AbstractContextManager[None]:
    """Lets what mujoco_warp launches within add up in order."""
    solver, sensor = private.solver, private.sensor
    evaluate = sensor.sensor_acc

    def feel(m, d, *args, **kwargs):
      dim = d.nworld, self._touches.sensor_touch_adr.size
      inputs = [self._rows, self._touches]
      wp.launch_tiled(_touch, dim=dim, inputs=inputs, block_dim=_SENSED)
      evaluate(m, d, *args, **kwargs)

    return private.instead([
      (solver, "_use_incremental", lambda m: False),
      (solver, "_update_constraint", self._update_constraint),
      (solver, "_update_gradient", self._update_gradient),
      (private.passive, "_gravity_force", _compensation),
      (sensor, "_contact_sort", sort_matches),
      (sensor, "sensor_acc", feel),
      (self._model, "sensor_touch_adr", self._none),
    ])  # fmt: skip
