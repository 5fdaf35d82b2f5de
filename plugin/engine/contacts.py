"""Contacts with an organ: weights of corners, stiffness, sliding; see `native/contact/`.

MuJoCo 3.17 weighs the corners of a touched triangle by inverse distance: forces are off and
flicker where a tool presses. MuJoCo 4.0 has it right. Both part what slides.
"""

import functools
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.config import Config, rigidity
from palpate.tissue.geometry.mesh import vertex_areas
from palpate.tissue.kernels import kernel
from palpate.tissue.solid import capsule
from palpate.tissue.types import Array, doubles, ints

from . import coupling, safe_calls
from .layout import FLAG, Numbers
from .model import mjstruct

if TYPE_CHECKING:
  from .model.declare import Declaration
  from .workspace import Workspace

_DATA = (
  *("contact", "ncon", "nefc", "nisland", "efc_type", "efc_id", "efc_J", "efc_J_rownnz"),
  *("efc_J_rowadr", "efc_J_colind", "efc_pos", "efc_margin", "efc_KBIP", "efc_diagA"),
  *("efc_R", "efc_D", "efc_force", "map_efc2iefc", "iefc_R", "iefc_D"),
)
_CONTACT = (
  *("dist", "pos", "frame", "friction", "solref", "solimp", "mu", "dim", "geom", "flex", "elem"),
  *("vert", "exclude", "efc_address"),
)
# What an organ's contacts follow, of each flex.
TISSUE = Numbers(
  "TISSUE",
  ("modulus", 1, "Pa", "young / (1 - poisson^2) of a solid without a skin, else 0"),
  ("bearing", 1, "Pa/m", "of a skin that has a foundation: what holds a patch of it, else 0"),
  ("plate", 1, "N/m", "sqrt(bearing * rigidity) of such a skin"),
  ("taut", 1, "N/m^2", "force under a point over its depth squared, where that only stretches"),
  ("asked", 1, "1/kg", "R of a contact that the tissue asks for"),
  ("share", 1, "1/kg", "R that the step can bear at least for each vertex that is touched"),
  ("stuck", 1, "-", "of the R that the step can bear, the most that friction has"),
  ("firm", 1, "-", "whether contacts are made so; 0 where the organ says itself how firm they are"),
)
# A contact: the steps in which it closes; of its tissue's compliance, how much it has; the least R
# in the inverse inertia of an organ and of a tool, since firmer ones chatter; of that, friction's.
SLOW, FIRM, SOFT, LIGHT, STUCK = 4.0, 0.03, 0.036, 0.0075, 0.2
# Least R of contacts between organs, in their nodes' inverse inertia; those are turned that go this
# much against both triangles, and are this deep, in their radii.
LOOSE, FACING, SUNK = 0.05, 0.3, 0.3
# Contacts are softer from a step on [s], and where a vertex has more times its mass than this.
LONG, STIFF = 5e-3, 1000.0
SKIN = 3.0  # times the least R of solids that skins have, for whose nodes MuJoCo answers
# How a triangle is looked at under the flat end of a cylinder: how level it is at least; points
# along an edge; in radii, how far in from the rim they count less, and how far off the end they
# count; the share of points that carries it in full.
FLAT = {"LEVEL": 0.85, "POINTS": 6, "RIM": 0.1, "SLACK": 0.01, "COVER": 0.25}
_USUAL = (0.02, 1, 0.9, 0.95, 0.001, 0.5, 2)  # MuJoCo's solref and solimp
# Those of `add_organ`, by which an organ does not say how firm its contacts are either.
SOLREF, SOLIMP = (0.004, 1), (0.95, 0.99, 0.001)
_tissue: dict[int, tuple] = {}  # by the address of an mjData, see `tell`
_lifted: dict[int, np.ndarray] = {}  # by that, see `lifted`
_SPARSE_FROM = 60  # dofs from which MuJoCo's rows are sparse where it may choose


@coupling.memory(
  *("jacobian", "timestep", "impratio", "integrator", "solver", "noslip_iterations"),
  *("enableflags", "body_dofadr", "body_dofnum", "body_parentid", "body_rootid", "dof_parentid"),
  *("body_invweight0", "geom_bodyid", "geom_type", "geom_size", "flex_radius", "flex_margin"),
  *("flex_dim", "flex_vertadr", "flex_vertbodyid", "flex_elem", "flex_elemdataadr", "qvel"),
  *("flexvert_xpos", "geom_xpos", "geom_xmat", "subtree_com", "cdof", "plugin_state"),
)
class Weights:
  """The organs' flexes and MuJoCo's memory under its own names."""

  nv: int  # dofs of the model
  wrong: int  # whether MuJoCo's weights are
  memory: Array(wp.uint64, ("nword",))  # the mjData itself
  mine: ints("nflex")  # 1 where a flex is an organ's, or a window of one; 2 where of the own one
  flags: ints(len(FLAG))  # see FLAG
  tissue: doubles("nflex", len(TISSUE))  # see TISSUE
  nflex: int
  ngeom: int  # geoms of the model
  lifted: ints("nlifted")  # see `lifted`
  force_adr: ints("nflexvert")  # where the plugin state has a vertex' contact force, or -1


def _offsets(prefix: str, kind, names) -> dict[str, int]:
  return {f"{prefix}_{name.upper()}": getattr(kind, name).offset for name in names}


# What native code knows of contacts and their rows.
CONSTANTS = (
  coupling.CONSTANTS
  | TISSUE.constants()
  | _offsets("DATA", mjstruct.Data, _DATA)
  | _offsets("CONTACT", mjstruct.Contact, _CONTACT)
  | {
    "SLOW": SLOW,
    "LIGHT": LIGHT,
    "LOOSE": LOOSE,
    "FACING": FACING,
    "SUNK": SUNK,
    **FLAT,
    "CONTACT_LENGTH": mjstruct.size(mjstruct.Contact),
    "IS_EQUALITY": int(mujoco.mjtConstraint.mjCNSTR_EQUALITY),
    "IS_LIMIT": int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT),
    "CONTACT_PYRAMIDAL": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_PYRAMIDAL),
    "CONTACT_ELLIPTIC": int(mujoco.mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC),
    "JACOBIAN_DENSE": int(mujoco.mjtJacobian.mjJAC_DENSE),
    "JACOBIAN_AUTO": int(mujoco.mjtJacobian.mjJAC_AUTO),
    "SPARSE_FROM": _SPARSE_FROM,
    "INTEGRATOR_DISCRETE": int(getattr(mujoco.mjtIntegrator, "mjINT_DISCRETE", -1)),
    "SOLVER_PGS": int(mujoco.mjtSolver.mjSOL_PGS),
    "ENABLE_DIAGEXACT": int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT),
  }
)
weigh, lift = (
  kernel(name, "contact/contact_weights.h", Weights, CONSTANTS) for name in ("weigh", "lift")
)


@functools.cache
def are_wrong() -> bool:
  """Returns whether MuJoCo's weights are not barycentric, by one contact with a triangle."""
  slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
  corners = "".join(
    f'<body name="{name}" pos="{pos}"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    f"{slides}</body>"
    for name, pos in (("a", "0 0 0"), ("b", "1 0 0"), ("c", "0 1 0"))
  )
  model = mujoco.MjModel.from_xml_string(
    f"""<mujoco><option jacobian="dense"/><worldbody>{corners}
    <geom size=".1" pos=".15 .25 .1" condim="1"/></worldbody>
    <deformable><flex dim="2" body="a b c" element="0 1 2" radius=".01"><edge damping="1"/>
    <contact selfcollide="none" condim="1"/></flex></deformable></mujoco>"""
  )
  data = mujoco.MjData(model)
  mujoco.mj_fwdPosition(model, data)
  found = np.linalg.norm(data.efc_J.reshape(-1, 3, 3)[0], axis=1)
  at = data.contact.pos[0]
  return not np.allclose(found, [1 - at[0] - at[1], at[0], at[1]], atol=1e-3)


def make(model: int, data: int, flexes, flags: np.ndarray | memoryview | None = None) -> Weights:
  """Returns `Weights` of an mjModel and mjData.

  Args:
    model: address of the mjModel
    data: address of the mjData
    flexes: the flexes whose contacts get their weights
    flags: where to report, see FLAG
  """
  m = mjstruct.model(model)
  mine = np.zeros(m.nflex, np.int32)
  mine[flexes] = 1
  out = coupling.mujoco_arrays(model, data, Weights)
  out.nv, out.ngeom, out.nflex = m.nv, m.ngeom, m.nflex
  out.wrong = are_wrong()
  tissue, adr = _tissues(model, data)
  out.tissue = wp.array(tissue, dtype=wp.float64, device="cpu", copy=False)
  out.force_adr = wp.array(adr, dtype=int, device="cpu", copy=False)
  out.lifted = wp.array(lifted(model, data).ravel(), dtype=int, device="cpu", copy=False)
  out.memory = coupling.wrap(data, mjstruct.size(mjstruct.Data) // 8, wp.uint64)
  out.mine = wp.array(mine, dtype=int, device="cpu")
  flags = np.zeros(len(FLAG), np.int32) if flags is None else flags
  out.flags = wp.array(np.asarray(flags), dtype=int, device="cpu", copy=False)
  return out


def lifted(model: int, data: int) -> np.ndarray:
  """Returns what does not touch each flex in an mjData, as needles say, (nflex, ngeom + 2 nflex).

  Geoms are 0 or 1, and of each flex that is a thread come the first edge and that after the last.
  """
  m = mjstruct.model(model)
  if data not in _lifted or _lifted[data].shape != (m.nflex, m.ngeom + 2 * m.nflex):
    _lifted[data] = np.zeros((m.nflex, m.ngeom + 2 * m.nflex), np.int32)
  return _lifted[data]


def _tissues(model: int, data: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns what the organs of an mjData tell of its flexes and their vertices."""
  m = mjstruct.model(model)
  found = _tissue.get(data)
  if found is None or (len(found[0]), len(found[1])) != (m.nflex, m.nflexvert):
    found = np.zeros((m.nflex, len(TISSUE))), np.full(m.nflexvert, -1, np.int32)
    _tissue[data] = found
  return found


def tell(w: "Workspace", model: int):
  """Tells contacts with an organ what its tissue is like, and where its contact forces are."""
  m, organ = mjstruct.model(model), w.organ
  found, adr = _tissues(model, w.data)
  start = int(m.plugin_stateadr[w.seen.instance])
  start += coupling.spans(organ)["force"].start
  first = m.flex_vertadr
  if organ.windows:
    slot = np.arange(organ.windows.nslot)
    adr[first[organ.windows.flex] + slot] = start + 3 * slot
  else:
    n = coupling.outer(organ)
    own = organ.dofadr[:n] >= 0
    adr[first[organ.flex] : first[organ.flex] + n] = np.where(own, start + organ.stateadr[:n], -1)
  found[organ.flexes] = tissue_of(m, organ, w.config)


def forget(data: int):
  """Forgets what organs have told of an mjData that is freed."""
  _tissue.pop(data, None)
  _lifted.pop(data, None)


def tissue_of(m, organ: "Declaration", config: Config | None = None, mass=1.0) -> np.ndarray:
  """Returns TISSUE of an organ, as compiled or with another configuration.

  Its compliance is that of an elastic half space, a membrane with bending (Winkler's plate under a
  point) and a foundation, side by side.

  Args:
    m: the model's struct
    organ: the organ's declaration
    config: its configuration, or None for the declared one; of many worlds its young is
      (1, nworld), and its other numbers may be (nworld,)
    mass: times the declared masses; may be (nworld,)

  Returns:
    (len(TISSUE),), or (nworld, len(TISSUE))
  """
  config, h = config or organ.config, float(m.opt.timestep)
  outside, plane, young = capsule(config), 1 - config.poisson**2, np.mean(config.young, axis=0)
  solid = config.elements == "solid"
  bare = young / plane if solid else 0.0
  skin = np.mean(outside.young, axis=0) * outside.thickness / plane
  kinds = {"spring": config.stiffness, "solid": 0.0, "membrane": skin}
  stretch = kinds[outside.elements]
  bend = rigidity(outside, len(outside.young)).mean(axis=0)
  corner = organ.mesh.rest[organ.mesh.elem]
  edge = np.linalg.norm(corner - corner[:, [1, 2, 0]], axis=2).mean()
  area = vertex_areas(organ.mesh.rest, organ.mesh.elem).sum()
  below = config.foundation
  stiffness = bare * edge + stretch + 8 * np.sqrt(bend * below) + below * edge**2
  masses = mass * organ.mass[organ.free].sum()
  each = mass * organ.mass[organ.free].mean()
  softer = max(1.0, (h / LONG) ** 2) * np.maximum(1.0, h**2 * stiffness / (STIFF * each))
  share = softer * SOFT / masses * (1.0 if solid else SKIN)
  asked = FIRM / (stiffness * (SLOW * h) ** 2)
  stuck = min(1.0, max(STUCK, h / LONG))
  modulus = np.where(np.asarray(stretch) != 0, 0.0, bare) * (config.subgrid != "false")
  # A shell's curvature holds it as a foundation would (Reissner 1946, doi:10.1002/sapm194625180):
  # that of a ball of the organ's area.
  curved = 4 * np.pi / area if organ.mesh.closed else 0.0
  held = below + plane * curved * stretch
  plates = config.subgrid == "true" and config.elements == "membrane"
  bearing = np.where(np.asarray(below) > 0, held, 0.0) * plates
  # The second is Foeppl's membrane on a foundation under a point, by least energy.
  plate, taut = np.sqrt(bend * bearing), 0.86 * np.sqrt(stretch * bearing)
  firm = not says(m, organ.flexes[0])
  rows = modulus, bearing, plate, taut, asked, share, stuck, firm
  return np.stack(np.broadcast_arrays(*(np.asarray(row, float) for row in rows)), axis=-1)


def says(m, flex: int) -> bool:
  """Returns whether an organ says itself how firm the contacts of a flex are."""
  given, usual = [*m.flex_solref[flex], *m.flex_solimp[flex]], [*SOLREF, *SOLIMP, 0.5, 2]
  return not (np.allclose(given, _USUAL, atol=1e-9) or np.allclose(given, usual, atol=1e-9))


def launch(weights):
  """Gives the contacts their weights, where MuJoCo's are wrong, and keeps sliding ones closed."""
  weigh.launch("cpu", 1, 1, 0, weights)


def project(model: int, data: int):
  """Computes again what MuJoCo's dual solvers and exact diagonals need of the rows."""
  safe_calls.run(mjstruct.library().mj_projectConstraint, model, data)
