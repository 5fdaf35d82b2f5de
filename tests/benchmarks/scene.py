"""The scenes of the benches: shapes, MJCF of ours and of MuJoCo's native flex, scripted probes."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import mujoco
import numpy as np
from palpate.engine import contacts
from palpate.models import mjcf
from palpate.organ import Organ
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from scenes import RADIUS, flex, organ, windowed, world

PROBE = 0.006  # radius of the probe [m]
SHAPES = ("sphere", "liver", "lobed")
NATIVE = "native"

# Nearly hard and h-independent contacts: 20 ms is twice the largest time step of the error bench
# (MuJoCo raises a shorter time constant); an impedance near one keeps the surfaces together.
CONTACT = {"solref": "0.02 1", "solimp": "0.99 0.999 0.001"}


@functools.lru_cache(maxsize=32)
def shape(name: str, nodes: int) -> Mesh:
  """Returns a closed surface centred at the origin, its longest half-axis RADIUS [m].

  Args:
    name: `sphere` (icosphere: 162, 642, 2562, 10242 nodes), `octa` (octahedral sphere), `sliver`
      (icosphere with needle triangles), or a name in `palpate.models.shapes`
    nodes: how many, as near as the shape allows
  """
  if name in ("sphere", "sliver"):
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=round(np.log((nodes - 2) / 10) / np.log(4)))
    points, elem = np.array(made.vertices), np.array(made.faces)
    if name == "sliver":
      points = _squeeze(points, elem)
  else:
    from palpate.models import shapes
    from palpate.models.meshing import grid

    if name == "octa":
      points, elem = grid.octasphere(max(1, round(np.sqrt((nodes - 2) / 4))))
    else:
      points, elem = getattr(shapes, name)(nodes)
  points = points - points.mean(axis=0)
  points = points * (RADIUS / np.linalg.norm(points, axis=1).max())
  return topology.build(name, points, np.asarray(elem))


def _squeeze(points: np.ndarray, elem: np.ndarray, share: float = 0.01) -> np.ndarray:
  """Returns the points with every 20th pulled nearly onto a neighbour: triangles 1 % as high."""
  out = points.copy()
  taken = np.zeros(len(points), bool)
  for i in range(0, len(points), 20):
    around = np.unique(elem[(elem == i).any(axis=1)])
    if taken[around].any():
      continue
    taken[around] = True
    other = around[around != i][0]
    out[i] = share * points[i] + (1 - share) * points[other]
  return out


@dataclasses.dataclass(frozen=True)
class Tissue:
  """An organ of the benches; the same constants for ours and for the native flex.

  Attributes:
    young: Young's modulus [Pa]
    poisson: Poisson's ratio [-]
    thickness: [m]
    damping: Rayleigh coefficient [s]
    foundation: [Pa/m]; the native flex gets it as stiffness and damping of its joints
    bend: 1 with bending (native `elastic2d="both"`), 0 without (`stretch`)
    bulk: volume stiffness [Pa]; ours only
    mass: of the whole organ [kg]
    elements: `membrane`, `spring` or `solid`; ours only
    stiffness: of the springs [N/m]
  """

  young: float = 3e4
  poisson: float = 0.3
  thickness: float = 0.002
  damping: float = 0.002
  foundation: float = 2e5
  bend: int = 0
  bulk: float = 0.0
  mass: float = 0.1
  elements: str = "membrane"
  stiffness: float = 0.0

  def keys(self) -> dict:
    """Returns the plugin's configuration keys."""
    if self.elements == "solid":
      names = ("young", "poisson", "damping", "foundation", "elements")
      return {k: getattr(self, k) for k in names}
    keys = {k: getattr(self, k) for k in ("young", "poisson", "thickness", "damping")}
    keys |= {k: getattr(self, k) for k in ("foundation", "bend", "bulk", "elements")}
    return keys | ({"stiffness": self.stiffness} if self.elements == "spring" else {})


def build(
  mesh: Mesh,
  tissue: Tissue,
  scheme: str,
  h: float,
  *,
  probe: np.ndarray | None = None,
  joined: np.ndarray | None = None,
  friction: float = 0.0,
  contact: dict | None = None,
  solver: str = "CG",
  mj_tolerance: float = 1e-8,
  window: bool = False,
  lumped: bool = False,
  heavy: bool = False,
  **keys,
) -> mujoco.MjModel:
  """Returns a scene: the organ and, if `probe` says where, a ball on three slides.

  Args:
    mesh: the organ
    tissue: its constants
    scheme: one of the plugin's; `native` for MuJoCo's flex; `passive` for a flex without any forces
    h: time step [s]
    probe: centre of the ball [m]; None for no ball
    joined: nodes that hang on the ball by connect equalities, which then touches nothing
    friction: of the contact; 0 for contacts without
    contact: MuJoCo's attributes of the contacts, for CONTACT
    solver: MuJoCo's constraint solver
    mj_tolerance: of that solver
    window: window coupling instead of nodal
    heavy: a probe of 10,000 times the organ's mass, which contacts do not move between the places
      that it is given, instead of half of it
    lumped: masses in proportion to the nodes' area, as a window has them, instead of even ones
    **keys: further configuration keys of the plugin
  """
  contact = CONTACT if contact is None else contact
  rubs = {"condim": 3 if friction else 1, "friction": friction or 1}
  bodies, ties = [_organ(mesh, tissue, scheme, window, contact | rubs, keys)], ""
  if probe is not None:
    mass = (1e4 if heavy else 0.5) * tissue.mass
    touches = {} if joined is None else {"contype": 0, "conaffinity": 0}
    bodies.append(_probe(probe, mass, contact | rubs | touches))
  if joined is not None:
    solver_of = _text(contact)
    ties = "".join(
      f'<connect body1="organ_{i}" body2="probe" anchor="0 0 0" {solver_of}/>' for i in joined
    )
    ties = f"<equality>{ties}</equality>"
  # MuJoCo's collision wants n^2 bytes and more [MB]
  memory = 200 if window else max(200, 3 * mesh.nvert**2 // 10**6)
  integrator = "discrete" if scheme == NATIVE else "Euler"
  xml = world(
    *bodies, h=h, integrator=integrator, solver=solver, tolerance=mj_tolerance, memory=memory,
    extra=ties,
  )  # fmt: skip
  model = mujoco.MjModel.from_xml_string(xml)
  if not window:
    _adjust(model, mesh, tissue, scheme, lumped)
  return model


def _adjust(model: mujoco.MjModel, mesh: Mesh, tissue: Tissue, scheme: str, lumped: bool):
  """Writes what MJCF has no words for: masses by area, and constants of the native flex."""
  if lumped:
    bodies = model.dof_bodyid[node_dofs(model, mesh.nvert)[:, 0]]
    model.body_mass[bodies] = masses(mesh, tissue)[: mesh.nvert]
    mujoco.mj_setConst(model, mujoco.MjData(model))
  if scheme == NATIVE:
    finish(model, mesh, tissue)


def finish(model: mujoco.MjModel, mesh: Mesh, tissue: Tissue):
  """Writes what MJCF has no words for into a model with a flex of MuJoCo's own.

  It gets the foundation as stiffness and damping of its joints. MuJoCo 3.17 bends with the shear
  modulus that `native` gives it for stretch, four times that of the tissue; it gets the rigidity of
  a plate, E t^3 / (12 (1 - nu^2)), which 4.0 has.
  """
  if mujoco.__version__ < "4":
    model.flex_bending[:] /= 3 * (1 - tissue.poisson)
  if tissue.foundation:
    dofs = node_dofs(model, mesh.nvert)
    gain = tissue.foundation * topology.vertex_areas(mesh.rest, mesh.elem)
    model.jnt_stiffness[model.dof_jntid[dofs]] = gain[:, None]
    model.dof_damping[dofs] = tissue.damping * gain[:, None]


def masses(mesh: Mesh, tissue: Tissue) -> np.ndarray:
  """Returns the mass of each node in windows, those inside a solid last [kg], (n,)."""
  solid = tissue.elements == "solid"
  share = (
    fill.vertex_volumes(fill.fill("organ", mesh))
    if solid
    else topology.vertex_areas(mesh.rest, mesh.elem)
  )
  return tissue.mass * share / share.sum()


def _organ(mesh: Mesh, tissue: Tissue, scheme: str, window: bool, contact: dict, keys: dict) -> str:
  """Returns the organ's MJCF, or that of a flex without the plugin."""
  shape = mesh.rest, mesh.elem
  if scheme == NATIVE:
    inside = native(tissue.young, tissue.poisson, tissue.thickness, tissue.damping, tissue.bend)
    return flex(*shape, inside, mass=tissue.mass, contact=contact)
  if scheme == "passive":
    return flex(*shape, mjcf.EDGE, mass=tissue.mass, contact=contact)
  same = {"integrator": None if scheme == "implicit" else scheme, "subgrid": "false"}
  keys = tissue.keys() | same | keys  # the reference is of the same mesh
  if not window:
    return organ(*shape, mass=tissue.mass, contact=contact, **keys)
  side = window_side(mesh)
  return windowed(*shape, count=f"{side} {side} 1", contact=contact, mass=tissue.mass, **keys)


def native(young: float, poisson: float, thickness: float, damping: float, bend: float) -> str:
  """Returns MuJoCo's elasticity of a flex with these constants.

  MuJoCo 3.17 stretches softer than documented: there others reach the documented ones, see 4.0;
  `finish` puts bending right.
  """
  if mujoco.__version__ < "4":
    young, poisson = 4 * young * (1 + poisson / 2) / (1 + poisson), poisson / 2
  return (
    f'<elasticity young="{young}" poisson="{poisson}" damping="{damping}" '
    f'thickness="{thickness}" elastic2d="{"both" if bend else "stretch"}"/>'
  )


def _probe(at: np.ndarray, mass: float, contact: dict) -> str:
  """Returns a ball on three slides."""
  slides = "".join(
    f'<joint name="{name}" type="slide" axis="{axis}"/>'
    for name, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))
  )
  ball = f'<geom size="{PROBE}" mass="{mass}" {_text(contact)}/>'
  return f'<body name="probe" pos="{mjcf.numbers(at)}">{slides}{ball}</body>'


def _text(attributes: dict) -> str:
  return " ".join(f'{key}="{value}"' for key, value in attributes.items())


def window_side(mesh: Mesh) -> int:
  """Returns the side of a square window with room for what the probe may touch."""
  edge = np.linalg.norm(mesh.rest[mesh.elem[:, 1]] - mesh.rest[mesh.elem[:, 0]], axis=1).mean()
  area = topology.vertex_areas(mesh.rest, mesh.elem).mean()
  reach = 1.5 * PROBE + 3 * edge
  return int(np.ceil(np.sqrt(min(1.3 * np.pi * reach**2 / area, mesh.nvert)))) + 1


class Nodes:
  """Displacements and velocities of an organ's or a flex's nodes, whatever their coupling.

  Args:
    model: a scene of `build`
    data: its data
    mesh: its mesh
    organ: the organ's handle; None for MuJoCo's own flex
  """

  def __init__(
    self, model: mujoco.MjModel, data: mujoco.MjData, mesh: Mesh, organ: Organ | None = None
  ):
    self.data = data
    self.organ = organ if organ is not None and organ.config.window else None
    self.dofs = None if self.organ else node_dofs(model, mesh.nvert)
    self.rest = mesh.rest

  def state(self) -> tuple[np.ndarray, np.ndarray]:
    """Returns displacement [m] and velocity [m/s], (nvert, 3) each."""
    if self.organ:
      return self.organ.displacement, self.organ.xvel
    return self.data.qpos[self.dofs], self.data.qvel[self.dofs]

  def contact_force(self) -> np.ndarray:
    """Returns the force of constraints on each node in the last step [N], (nvert, 3)."""
    return self.organ.contact_force if self.organ else self.data.qfrc_constraint[self.dofs]

  def put(self, u: np.ndarray):
    """Sets the displacement [m], (nvert, 3)."""
    if self.organ:
      self.organ.set_state(self.organ.xpos0 + u)
    else:
      self.data.qpos[self.dofs] = u


def node_dofs(model: mujoco.MjModel, nvert: int) -> np.ndarray:
  """Returns the degrees of freedom of the nodes, which are also their qpos, (nvert, 3)."""
  first = [int(model.body(f"organ_{i}").dofadr[0]) for i in range(nvert)]
  return np.array(first)[:, None] + np.arange(3)


def probe_dofs(model: mujoco.MjModel) -> np.ndarray:
  """Returns the degrees of freedom of the probe, (3,)."""
  return model.joint("x").dofadr[0] + np.arange(3)


def handle(model: mujoco.MjModel, data: mujoco.MjData) -> Organ:
  """Returns the organ's handle."""
  return Organ(model, data, "organ")


def weigher(model: mujoco.MjModel, data: mujoco.MjData) -> Callable[[], None]:
  """Returns what gives contacts with MuJoCo's own flexes the right weights of corners.

  Where MuJoCo's are wrong, organs get them from the plugin; call this in `mjcb_passive` for others.
  """
  touched = contacts.make(model._address, data._address, slice(None))
  return lambda: contacts.launch(touched)


def put(data: mujoco.MjData, dofs: np.ndarray, position: np.ndarray, velocity: np.ndarray):
  """Moves what hangs on `dofs` to a displacement and velocity: a probe whose motion is given."""
  data.qpos[dofs] = position
  data.qvel[dofs] = velocity


def ramp(time: float, duration: float) -> tuple[float, float]:
  """Returns a smooth 0 to 1 over `duration` and its rate [1/s]."""
  s = min(max(time / duration, 0.0), 1.0)
  rate = 0.5 * np.pi / duration * np.sin(np.pi * s) if 0 < s < 1 else 0.0
  return 0.5 * (1 - np.cos(np.pi * s)), rate


def bad(data: mujoco.MjData) -> bool:
  """Returns whether MuJoCo found numbers that are not finite, and reset."""
  kind = mujoco.mjtWarning
  return any(
    data.warning[k].number for k in (kind.mjWARN_BADQPOS, kind.mjWARN_BADQVEL, kind.mjWARN_BADQACC)
  )
