"""Rows of constraints in an order of their own.

Threads reserve rows in the order in which they come, and sums over them would differ in the last
digit from run to run. A world's rows are ranked by what they are: limits and friction by type and
joint, contacts of tools with each other by their geoms, those of organs by their places, which
slots decide.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import warp as wp
from mujoco_warp._src.types import ConstraintType
from palpate.tissue.types import Array, floats, ints, struct

_CONTACT = wp.constant(int(ConstraintType.CONTACT_FRICTIONLESS))  # the first type of these
_GEOMS = wp.constant(65536)
_FLOATS = ("pos", "margin", "D", "vel", "aref", "frictionloss", "Jqvel")
_INTS = ("type", "id")
_WHERE = ("J_rownnz", "J_rowadr")  # of a sparse Jacobian


@struct
class Rows:
  """Constraint rows of all worlds, in mujoco_warp's arrays, and room for them in another order."""

  sparse: int  # whether the Jacobian is
  njmax: int
  ncolumn: int  # of a dense Jacobian
  start: ints(1)  # first contact of the organs
  nacon: ints(1)
  nefc: ints("nworld")
  worldid: ints("naconmax")
  geom: Array(wp.vec2i, ("naconmax",))
  geomcollisionid: ints("naconmax")
  efc_address: ints("naconmax", "nrow")
  type: ints("nworld", "njmax")
  id: ints("nworld", "njmax")
  J_rownnz: ints("nworld", "njmax")
  J_rowadr: ints("nworld", "njmax")
  J: floats("nworld", "njmax", "ncolumn")
  pos: floats("nworld", "njmax")
  margin: floats("nworld", "njmax")
  D: floats("nworld", "njmax")
  vel: floats("nworld", "njmax")
  aref: floats("nworld", "njmax")
  frictionloss: floats("nworld", "njmax")
  Jqvel: floats("nworld", "njmax")
  rank: ints("nworld", "njmax")
  J_kept: floats("nworld", "njmax", "ncolumn")
  kept: floats("nworld", "njmax", 7)
  kept_int: ints("nworld", "njmax", 4)


@wp.func
def _key(r: Rows, w: int, k: int):
  """Returns what a row is ranked by."""
  c = r.id[w, k]
  if r.type[w, k] < _CONTACT:
    return wp.vec3i(0, r.type[w, k], c)
  if c < r.start[0]:
    return wp.vec3i(1, r.geom[c][0] * _GEOMS + r.geom[c][1], r.geomcollisionid[c])
  return wp.vec3i(2, c - r.start[0], 0)


@wp.func
def _count(r: Rows, w: int):
  return wp.min(r.nefc[w], r.njmax)


@wp.kernel(enable_backward=False)
def rank(r: Rows):
  """Finds the place of each row."""
  w, k = wp.tid()
  n = _count(r, w)
  if k >= n:
    return
  mine = _key(r, w, k)
  before = int(0)  # noqa: RUF046, UP018 - a variable to Warp
  for s in range(n):
    other = _key(r, w, s)
    less = other[0] < mine[0]
    if other[0] == mine[0]:
      less = other[1] < mine[1]
      if other[1] == mine[1]:
        less = other[2] < mine[2]
        if other[2] == mine[2]:
          less = s < k
    if less:
      before += 1
  r.rank[w, k] = before


@wp.kernel(enable_backward=False)
def take(r: Rows):
  """Copies the rows to their places."""
  w, k, i = wp.tid()
  if k >= _count(r, w):
    return
  to = r.rank[w, k]
  if i < r.ncolumn:
    r.J_kept[w, to, i] = r.J[w, k, i]
  if i > 0:
    return
  r.kept[w, to, 0] = r.pos[w, k]
  r.kept[w, to, 1] = r.margin[w, k]
  r.kept[w, to, 2] = r.D[w, k]
  r.kept[w, to, 3] = r.vel[w, k]
  r.kept[w, to, 4] = r.aref[w, k]
  r.kept[w, to, 5] = r.frictionloss[w, k]
  r.kept[w, to, 6] = r.Jqvel[w, k]
  r.kept_int[w, to, 0] = r.type[w, k]
  r.kept_int[w, to, 1] = r.id[w, k]
  if r.sparse == 1:
    r.kept_int[w, to, 2] = r.J_rownnz[w, k]
    r.kept_int[w, to, 3] = r.J_rowadr[w, k]


@wp.kernel(enable_backward=False)
def put(r: Rows):
  """Copies them back."""
  w, k, i = wp.tid()
  if k >= _count(r, w):
    return
  if i < r.ncolumn:
    r.J[w, k, i] = r.J_kept[w, k, i]
  if i > 0:
    return
  r.pos[w, k] = r.kept[w, k, 0]
  r.margin[w, k] = r.kept[w, k, 1]
  r.D[w, k] = r.kept[w, k, 2]
  r.vel[w, k] = r.kept[w, k, 3]
  r.aref[w, k] = r.kept[w, k, 4]
  r.frictionloss[w, k] = r.kept[w, k, 5]
  r.Jqvel[w, k] = r.kept[w, k, 6]
  r.type[w, k] = r.kept_int[w, k, 0]
  r.id[w, k] = r.kept_int[w, k, 1]
  if r.sparse == 1:
    r.J_rownnz[w, k] = r.kept_int[w, k, 2]
    r.J_rowadr[w, k] = r.kept_int[w, k, 3]


@wp.kernel(enable_backward=False)
def tell(r: Rows):
  """Tells contacts where their rows are now."""
  c, d = wp.tid()
  if c >= r.nacon[0]:
    return
  row = r.efc_address[c, d]
  w = r.worldid[c]
  if row >= 0 and row < _count(r, w):
    r.efc_address[c, d] = r.rank[w, row]


class Order:
  """The order of rows in all worlds.

  Args:
    batch: the worlds, with mujoco_warp's model and data
    start: first contact of the organs
  """

  def __init__(self, batch, start: wp.array):
    d, out = batch.d, Rows()
    nworld, self._device = batch.nworld, batch.device
    out.sparse, out.njmax, out.start = int(batch.m.is_sparse), d.njmax, start
    out.ncolumn = 0 if out.sparse else d.efc.J.shape[2]
    out.nacon, out.nefc = d.nacon, d.nefc
    for name in ("worldid", "geom", "geomcollisionid", "efc_address"):
      setattr(out, name, getattr(d.contact, name))
    for name in (*_INTS, *_WHERE, *_FLOATS, "J"):
      setattr(out, name, getattr(d.efc, name))

    def room(kind, *dims):
      return wp.zeros((nworld, d.njmax, *dims), dtype=kind, device=batch.device)

    out.rank, out.J_kept = room(int), room(float, out.ncolumn)
    out.kept, out.kept_int = room(float, len(_FLOATS)), room(int, len(_INTS) + len(_WHERE))
    self._rows, self._dim = out, (nworld, d.njmax)

  def launch(self):
    """Puts the rows in order, after they are made and before they are solved."""
    r = self._rows
    whole = (*self._dim, max(1, r.ncolumn))
    told = r.efc_address.shape
    for kernel, dim in ((rank, self._dim), (take, whole), (put, whole), (tell, told)):
      wp.launch(kernel, dim=dim, inputs=[r], device=self._device)
