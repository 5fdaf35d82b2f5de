"""Rows of an organ's contacts: what slides stays closed, and how hard contacts press.

Contacts that slide stay closed, see `keep_closed` of coupling/contact_weights.h, which widens the
gap of a contact by D mu |v| over its stiffness, D the damping of its rows. A gap is in the
normal's reference acceleration as stiffness times gap, and a row of friction has -D v there: so
what the gap adds follows from those rows.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
from typing import TYPE_CHECKING

import mujoco
import warp as wp
from palpate.engine import contacts
from palpate.engine.contacts import TISSUE
from palpate.engine.model import mjstruct
from palpate.tissue.types import Array, floats, ints, struct

from ..private import vec5

if TYPE_CHECKING:
  from palpate.engine.model.declare import Declaration

  from ..worlds import Worlds


@struct
class Pressed:
  """An organ's contacts in mujoco_warp's arrays, and what is told of them."""

  many: int  # contacts of a world
  paired: int  # whether the cone is a pyramid
  start: ints(1)  # the organ's first contact
  before: ints("nworld")  # its contacts in the worlds before
  count: ints("nworld")  # its contacts
  dim: ints("naconmax")  # rows of a contact, or pairs of them and one
  contact_geom: Array(wp.vec2i, ("naconmax",))
  frame: Array(wp.mat33, ("naconmax",))
  friction: Array(vec5, ("naconmax",))
  elem: Array(wp.vec2i, ("naconmax",))
  efc_address: ints("naconmax", "nrow")  # -1 for none
  aref: floats("nworld", "njmax")  # reference acceleration of the rows [m/s^2]
  # See `contacts.TISSUE`:
  firm: int
  asked: float
  share: float
  tools: floats("ngeom")  # R that the step can bear for each tool [1/kg]
  pairs: float  # times R, in a pyramid: 2 / impratio
  D: floats("nworld", "njmax")  # inverse of the rows' R [kg]
  row_force: floats("nworld", "njmax")  # force of the rows [N]
  # See `Contacts`:
  geom: ints("nworld", "many")
  normal: Array(wp.vec3, ("nworld", "many"))
  force: floats("nworld", "many")


@wp.func
def _rows(p: Pressed, c: int):
  """Returns how many rows a contact has."""
  n = p.dim[c]
  return wp.where(p.paired == 1 and n > 1, 2 * (n - 1), n)


@wp.func
def _has_rows(p: Pressed, c: int):
  """Returns whether there was room for all rows of a contact."""
  for r in range(_rows(p, c)):
    if p.efc_address[c, r] < 0:
      return False
  return p.contact_geom[c][0] >= 0


@wp.func
def _firm_up(p: Pressed, world: int, c: int):
  """Makes a contact as firm as under the plugin, see coupling/contact_stiffness.h."""
  if p.firm == 0:
    return
  touched = float(p.count[world])
  if p.elem[c][1] >= 0:
    touched = touched / 3.0
  R = wp.max(p.asked, touched * p.share + p.tools[p.contact_geom[c][0]])
  if p.paired == 1 and p.dim[c] > 1:
    square = p.friction[c][0] * p.friction[c][0]
    R *= p.pairs * square * (1.0 + square)
  gain = 1.0 / (R * p.D[world, p.efc_address[c, 0]])
  for r in range(_rows(p, c)):
    row = p.efc_address[c, r]
    p.D[world, row] = gain * p.D[world, row]


@wp.kernel(enable_backward=False)
def keep_closed(p: Pressed):
  """Makes contacts firm, and takes the parting of those that slide off their reference."""
  world, k = wp.tid()
  if k >= p.count[world]:
    return
  c = p.start[0] + p.before[world] + k
  n = p.dim[c]
  if not _has_rows(p, c):
    return
  _firm_up(p, world, c)
  if n < 2:
    return
  square = float(0.0)  # noqa: UP018 - a variable to Warp
  for r in range(n - 1):
    if p.paired == 1:
      plus = p.aref[world, p.efc_address[c, 2 * r]]
      v = 0.5 * (plus - p.aref[world, p.efc_address[c, 2 * r + 1]])
      square += v * v
    else:
      v = p.friction[c][r] * p.aref[world, p.efc_address[c, r + 1]]
      square += v * v
  for r in range(wp.where(p.paired == 1, _rows(p, c), 1)):
    row = p.efc_address[c, r]
    p.aref[world, row] = p.aref[world, row] - wp.sqrt(square)


@wp.kernel(enable_backward=False)
def press(p: Pressed):
  """Writes the geoms, normals and normal forces of contacts."""
  world, k = wp.tid()
  c = p.start[0] + p.before[world] + k
  p.geom[world, k] = -1
  p.force[world, k] = 0.0
  if k >= p.count[world] or not _has_rows(p, c):
    return
  total = float(0.0)  # noqa: UP018 - a variable to Warp
  for r in range(wp.where(p.paired == 1, _rows(p, c), 1)):
    total += p.row_force[world, p.efc_address[c, r]]
  p.geom[world, k] = p.contact_geom[c][0]
  p.normal[world, k] = wp.vec3(p.frame[c][0, 0], p.frame[c][0, 1], p.frame[c][0, 2])
  p.force[world, k] = total


def make(batch: "Worlds", model: mujoco.MjModel, organ: "Declaration", touch):
  """Returns the contacts of an organ.

  Args:
    batch: the worlds, with mujoco_warp's data
    model: the compiled scene
    organ: the organ's declaration
    touch: how the organ touches its tools
  """
  out, d = Pressed(), batch.d
  out.many, out.paired = touch.most, int(batch.paired)
  out.start, out.before, out.count = touch.start, touch.before, touch.count
  for name in ("dim", "frame", "friction", "elem", "efc_address"):
    setattr(out, name, getattr(d.contact, name))
  out.D, out.pairs = d.efc.D, 2.0 / float(model.opt.impratio)
  tissue = contacts.tissue_of(mjstruct.Model.from_address(model._address), organ)
  out.firm = int(tissue[TISSUE.firm])
  out.asked, out.share = tissue[TISSUE.asked], tissue[TISSUE.share]
  tools = contacts.LIGHT * model.body_invweight0[model.geom_bodyid, 0]
  out.tools = wp.array(tools, dtype=float, device=batch.device)
  out.contact_geom, out.aref, out.row_force = d.contact.geom, d.efc.aref, d.efc.force
  shape = (batch.nworld, out.many)
  out.geom, out.normal, out.force = (
    wp.zeros(shape, dtype=kind, device=batch.device) for kind in (int, wp.vec3, float)
  )
  return out
