"""Rows of an organ's contacts: their stiffness, the gaps of sliding contacts, and their forces.

Contacts that slide stay closed, see `keep_closed` of contact/contact_weights.h, which widens the
gap of a contact by D mu |v| over its stiffness, D the damping of its rows. A gap is in the
normal's reference acceleration as stiffness times gap, and a row of friction has -D v there: so
what the gap adds follows from those rows.
"""

from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp
from palpate.engine import contacts, coupling
from palpate.engine.contacts import TISSUE
from palpate.tissue.kernels import kernel
from palpate.tissue.types import Array, also, doubles, floats, ints

from ..mjw.arrays import arrays_of, theirs
from ..mjw.private import contact_kbimp, vec5
from ..organ.patch import Patch, launch

if TYPE_CHECKING:
  from ..organ.organ import Organ

_ASKED, _SHARE, _FIRM = (wp.constant(k) for k in (TISSUE.asked, TISSUE.share, TISSUE.firm))
# Tools under which contacts yield by what the mesh cannot, see contact/series_compliance.h.
_SMALL = tuple(int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
               for name in ("SPHERE", "CAPSULE", "CYLINDER"))  # fmt: skip
# What of these fields are those of `Patch`.
_OF_PATCH = ("nnode", "nslice", "nslot", "ntool", "mesh", "rest", "force", "slot_node",
             "tool", "tool_geom", "geom_xpos", "geom_xmat")  # fmt: skip


@theirs(
  model="flex_elem",
  contact="dim dist pos frame friction solref solimp elem efc_address",
  efc="aref D",
)
@also(Patch, *_OF_PATCH)
class Pressed:
  """An organ's contacts in mujoco_warp's arrays, and what is told of them."""

  many: int  # contacts of a world
  paired: int  # whether the cone is a pyramid
  start: ints(1)  # the organ's first contact
  before: ints("nworld")  # its contacts in the worlds before
  count: ints("nworld")  # its contacts
  contact_geom: Array(wp.vec2i, ("naconmax",))
  disableflags: int  # of mjOption
  discrete: int  # whether the integrator is
  timestep: float  # [s]
  tissue: doubles("nworld", len(TISSUE))  # see `contacts.TISSUE`
  tools: floats("ngeom")  # R that the step can bear for each tool [1/kg]
  pairs: float  # times R, in a pyramid: 2 / impratio
  # What contacts yield by, a tool, and what that is found from; see also `Patch`:
  yields: int  # whether there is a tool that is small and round or flat, on tissue that yields so
  tool_of: ints("ngeom")  # which of the organ's tools a geom is, -1 for none
  yields_by: Array(wp.vec3, ("naconmax",))  # of a contact: `Stiff` [m/N], what is off its gap [m]
  elemadr: int  # where the slots of its triangles begin in `flex_elem`
  radius: float  # of its flex [m]
  disp: floats("nworld", "nslice", 3, 8)  # displacement [m]
  row_force: floats("nworld", "njmax")  # force of the rows [N]
  # See `Contacts`:
  geom: ints("nworld", "many")
  normal: Array(wp.vec3, ("nworld", "many"))
  pressed: floats("nworld", "many")


_known = coupling.CONSTANTS | TISSUE.constants()
_find_series = kernel("find_series", "coupling/world_contacts.h", Pressed, _known, own=True)


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
  """Makes a contact as firm as under the plugin, see contact/contact_stiffness.h.

  Rows of friction have the normal's R times what mujoco_warp says, so they yield with it. Returns
  what is off its gap, as an acceleration [m/s^2].
  """
  geom = p.contact_geom[c][0]
  rate = float(0.0)
  R = 1.0 / p.D[world, p.efc_address[c, 0]]
  now = R
  if p.tissue[world, _FIRM] > wp.float64(0.0):
    touched = float(p.count[world])
    if p.elem[c][1] >= 0:
      touched = touched / 3.0
    borne = touched * float(p.tissue[world, _SHARE]) + p.tools[geom]
    R = wp.max(float(p.tissue[world, _ASKED]), borne)
    if p.paired == 1 and p.dim[c] > 1:
      square = p.friction[c][0] * p.friction[c][0]
      R *= p.pairs * square * (1.0 + square)
  if p.yields == 1 and p.tool_of[geom] >= 0:
    spring = contact_kbimp(
      p.disableflags, p.timestep, p.solref[c], p.solimp[c], p.dist[c], p.discrete == 1
    )
    by, off = p.yields_by[c], p.yields_by[c][2]
    per = float(wp.where(p.paired == 1, _rows(p, c), 1)) * spring[0] * spring[2]
    R = wp.max(R, per * by[1])
    if R < per * by[0]:
      off -= (p.dist[c] + off) * (1.0 - R / (per * by[0]))
    rate = off * spring[0] * spring[2]
  if R != now:
    for r in range(_rows(p, c)):
      row = p.efc_address[c, r]
      p.D[world, row] = now / R * p.D[world, row]
  return rate


@wp.func
def parting(
  paired: int,
  n: int,
  c: int,
  world: int,
  friction: wp.array[vec5],
  row: wp.array2d[int],
  aref: wp.array2d[float],
):
  """Returns how fast a contact of n dimensions that slides is braked, times friction [m/s^2].

  See `parting` of contact/contact_rows.h.
  """
  square = float(0.0)
  for r in range(n - 1):
    if paired == 1:
      v = 0.5 * (aref[world, row[c, 2 * r]] - aref[world, row[c, 2 * r + 1]])
      square += v * v
    else:
      v = friction[c][r] * aref[world, row[c, r + 1]]
      square += v * v
  return wp.sqrt(square)


@wp.kernel(enable_backward=False)
def _closed(p: Pressed):
  """Makes contacts firm, and takes the parting of those that slide off their reference."""
  world, k = wp.tid()
  if k >= p.count[world]:
    return
  c = p.start[0] + p.before[world] + k
  n = p.dim[c]
  if not _has_rows(p, c):
    return
  off = _firm_up(p, world, c)
  part = parting(p.paired, n, c, world, p.friction, p.efc_address, p.aref)
  for r in range(wp.where(p.paired == 1, _rows(p, c), 1)):
    row = p.efc_address[c, r]
    p.aref[world, row] = p.aref[world, row] - part - off


def keep_closed(p, device):
  """Makes contacts firm, and keeps those that slide closed."""
  dim = p.geom.shape
  if p.yields:
    launch(_find_series, p, dim[0], p.ntool, device)
  wp.launch(_closed, dim=dim, inputs=[p], device=device)


@wp.kernel(enable_backward=False)
def press(p: Pressed):
  """Writes the geoms, normals and normal forces of contacts."""
  world, k = wp.tid()
  c = p.start[0] + p.before[world] + k
  p.geom[world, k] = -1
  p.pressed[world, k] = 0.0
  if k >= p.count[world] or not _has_rows(p, c):
    return
  total = float(0.0)
  for r in range(wp.where(p.paired == 1, _rows(p, c), 1)):
    total += p.row_force[world, p.efc_address[c, r]]
  p.geom[world, k] = p.contact_geom[c][0]
  p.normal[world, k] = wp.vec3(p.frame[c][0, 0], p.frame[c][0, 1], p.frame[c][0, 2])
  p.pressed[world, k] = total


@theirs(
  data="nacon",
  contact="dim flex geom worldid dist includemargin friction solref solimp efc_address",
  efc="aref",
)
class Early:
  """Contacts of threads in mujoco_warp's arrays, which are there before they touch."""

  nthread: int  # flexes that are threads, the first ones
  paired: int  # whether the cone is a pyramid
  disableflags: int  # of mjOption
  discrete: int  # whether the integrator is
  timestep: float  # [s]
  margin: floats("nthread")  # of each thread [m]


@wp.kernel(enable_backward=False)
def take_early(f: Early):
  """Takes margin, and parting on organs, off threads' gaps, see `coupling/mujoco_rod.h`.

  Contacts of two geoms are told that they have no flex: mujoco_warp leaves what was there.
  """
  c = wp.tid()
  if c >= f.nacon[0]:
    return
  if f.geom[c][0] >= 0 and f.geom[c][1] >= 0:
    f.flex[c] = wp.vec2i(-1, -1)
    return
  thread = wp.max(f.flex[c][0], f.flex[c][1])
  if thread >= f.nthread:
    thread = wp.min(f.flex[c][0], f.flex[c][1])
  if thread < 0 or thread >= f.nthread:
    return
  n = f.dim[c]
  rows = wp.where(f.paired == 1 and n > 1, 2 * (n - 1), n)
  for r in range(rows):
    if f.efc_address[c, r] < 0:
      return
  gap = f.dist[c] - f.includemargin[c]
  spring = contact_kbimp(f.disableflags, f.timestep, f.solref[c], f.solimp[c], gap, f.discrete == 1)
  world = f.worldid[c]
  off = spring[0] * spring[2] * f.margin[thread]
  if f.flex[c][0] >= 0 and f.flex[c][1] >= 0:
    off += parting(f.paired, n, c, world, f.friction, f.efc_address, f.aref)
  for r in range(wp.where(f.paired == 1, rows, 1)):
    row = f.efc_address[c, r]
    f.aref[world, row] = f.aref[world, row] - off


def make(organ: "Organ", model: mujoco.MjModel, touch):
  """Returns the contacts of an organ.

  Args:
    organ: the organ in all worlds
    model: the compiled scene
    touch: how the organ touches its tools
  """
  batch, patch, place = organ.batch, organ.patch, organ.place
  out, d, bare, device = Pressed(), batch.d, batch.bare, batch.device
  out.many, out.paired = touch.most, int(batch.paired)
  out.start, out.before, out.count = touch.start, touch.before, touch.count
  for name, array in arrays_of(Pressed, batch.m, d).items():
    setattr(out, name, array)
  for name in _OF_PATCH:
    setattr(out, name, getattr(patch, name))
  out.pairs = 2.0 / float(model.opt.impratio)
  out.disableflags, out.timestep = bare.opt.disableflags, float(bare.opt.timestep)
  out.discrete = int(bare.opt.integrator == getattr(mujoco.mjtIntegrator, "mjINT_DISCRETE", -1))
  tissue = contacts.tissue_of(model, organ.declared)
  out.tissue = wp.array(np.tile(tissue, (batch.nworld, 1)), dtype=wp.float64, device=device)
  tools = contacts.LIGHT * model.body_invweight0[model.geom_bodyid, 0]
  out.tools = wp.array(tools, dtype=float, device=device)
  geoms, tool_of = patch.tool_geom.numpy(), np.full(model.ngeom, -1)
  geoms = geoms[geoms >= 0]
  tool_of[geoms] = np.arange(len(geoms))
  small = np.isin(model.geom_type[geoms], _SMALL).any()
  out.yields = int(tissue[TISSUE.modulus] + tissue[TISSUE.bearing] > 0 and small)
  out.tool_of = wp.array(tool_of, dtype=int, device=device)
  out.yields_by = wp.zeros(d.contact.dist.shape[0], dtype=wp.vec3, device=device)
  out.elemadr = int(bare.flex_elemdataadr[place.flex])
  out.radius, out.disp = touch.radius, patch.solve.disp
  out.contact_geom, out.row_force = d.contact.geom, d.efc.force
  shape = (batch.nworld, out.many)
  out.geom, out.normal, out.pressed = (
    wp.zeros(shape, dtype=kind, device=device) for kind in (int, wp.vec3, float)
  )
  return out
