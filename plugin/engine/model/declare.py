"""Reads the declaration of an organ from a compiled mjModel and checks it; writes nothing.

`declare_windows` reads that of an organ with windows; `prepare` makes the model fit.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib

import mujoco
import numpy as np
from palpate.tissue import config as configuration
from palpate.tissue import device as devices
from palpate.tissue import shape
from palpate.tissue.body import Body
from palpate.tissue.config import Config
from palpate.tissue.cutting import stamps
from palpate.tissue.geometry import diagonals, faces, fill, gmsh
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.step import SCHEMES

from .. import graphs
from . import flexes, mjstruct

NO_RK4 = (
  "integrator is RK4, which evaluates forces four times a step; expected Euler, implicit or "
  "implicitfast"
)
# Equalities of a flex's own edges.
_EDGES = [int(getattr(mujoco.mjtEq, f"mjEQ_{name}")) for name in ("FLEX", "FLEXVERT", "FLEXSTRAIN")]
_FLAT = 1e-6  # volume that counts as none, as a share of the area to the power of 1.5
_CACHED = 16
_made: dict[bytes, Declaration] = {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Vertices:
  """What a flexcomp of an organ or a thread declares, the same in every mjData of a model.

  Attributes:
    name: name of the flexcomp
    flex: index of the flex
    config: configuration
    free: whether a vertex moves            (nvert,) bool
    body: body of each vertex               (nvert,)
    dofadr: first dof, -1 if pinned         (nvert,)
    qposadr: first qpos, -1 if pinned       (nvert,)
    frame: rotation from the slides' axes to the world (3, 3)
    origin: position of the parent body [m] (3,)
    windows: the windows, or None where the vertices are MuJoCo's dofs
  """

  name: str
  flex: int
  config: Config
  free: np.ndarray
  body: np.ndarray
  dofadr: np.ndarray
  qposadr: np.ndarray
  frame: np.ndarray
  origin: np.ndarray
  windows: Windows | None = None

  @property
  def jointed(self) -> np.ndarray:
    """Vertices that are dofs of MuJoCo."""
    return np.flatnonzero(self.dofadr >= 0)

  @property
  def dofs(self) -> np.ndarray:
    """Degrees of freedom of the moving vertices, or of the windows' slots."""
    first = self.windows.dofadr if self.windows else self.dofadr[self.jointed]
    return (first[:, None] + np.arange(3)).ravel()

  @property
  def qposs(self) -> np.ndarray:
    """Where they are in qpos."""
    first = self.windows.qposadr if self.windows else self.qposadr[self.jointed]
    return (first[:, None] + np.arange(3)).ravel()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Declaration(Vertices):
  """An organ that a model declares.

  Attributes:
    mesh: topology and rest shape, in the frame of the parent body
    still: shape and tissue on the device, with no world
    stateadr: first own number in the plugin state, -1 if pinned (nvert,)
    nfree: three times the number of vertices that have dofs
    mass: mass of each vertex [kg]          (nvert,)
  """

  mesh: Mesh
  still: Body
  stateadr: np.ndarray
  nfree: int
  mass: np.ndarray

  @functools.cached_property
  def signature(self) -> float:
    """Marks plugin states of this organ: nodes, triangles, pins and slots; over 2^50."""
    digest = hashlib.sha256(repr((self.windows is None, self.mesh.rest.shape)).encode())
    whole = self.mesh.whole
    for part in (whole.rest, whole.elem, self.free, self.windows and self.windows.home):
      digest.update(np.ascontiguousarray(part if part is not None else 0).tobytes())
    return float(2**50 + int.from_bytes(digest.digest()[:6], "big"))

  def cut(self, mesh: Mesh, mass: np.ndarray) -> Declaration:
    """Returns the organ with another mesh of the same whole, and other masses [kg]."""
    out = dataclasses.replace(self, mesh=mesh, mass=mass)
    vars(out)["signature"] = self.signature
    return out

  @property
  def window(self) -> Windows:
    """The window of an organ that has one."""
    assert self.windows is not None
    return self.windows

  @property
  def flexes(self) -> list[int]:
    """Flexes that tools meet: the window's, or its own."""
    return [self.windows.flex if self.windows else self.flex]

  @property
  def inner(self) -> np.ndarray:
    """Vertices inside of a solid."""
    return np.arange(self.mesh.nskin if len(self.mesh.tet) else self.mesh.nvert, self.mesh.nvert)


@dataclasses.dataclass(frozen=True)
class Windows:
  """The window of an organ; a slot is one of its vertices.

  Attributes:
    flex: its flex
    body: body of each slot                                   (nslot,)
    dofadr: its first dof                                     (nslot,)
    qposadr: its first qpos                                   (nslot,)
    home: node of each slot after a reset, -1 for none        (nslot,)
    stand: where its body stands at rest, in its parent [m]   (nslot, 3)
    qhome: qpos less rest position and displacement [m]       (nslot, 3)
    elem_adr: where its triangles start in flex_elem
    elem_num: how many it can hold
    geom: geoms that it follows                               (ngeom,)
    line: first vertices of edges of threads that it follows  (nline,)
    mass: mass of each node [kg]                              (nvert,)
  """

  flex: int
  body: np.ndarray
  dofadr: np.ndarray
  qposadr: np.ndarray
  home: np.ndarray
  stand: np.ndarray
  qhome: np.ndarray
  elem_adr: int
  elem_num: int
  geom: np.ndarray
  line: np.ndarray
  mass: np.ndarray

  @property
  def nslot(self) -> int:
    """Number of slots."""
    return len(self.body)


def read(m: mjstruct.Struct, instance: int) -> Declaration:
  """Returns the organ that plugin instance `instance` of an mjModel declares.

  Raises:
    ValueError: the declaration is not one this plugin can run.
  """
  devices.init()
  flex = flex_of(m, instance)
  name = flexes.name(m, flex)
  check_surface(m, flex, name)
  check_flex(m, flex, name)
  body, rest, free, frame, origin = places(m, instance, flex, name)
  nvert, parent = len(rest), find_parent(m, name, body, free)
  config, mesh = read_mesh(m, name, keys(m, instance), rest, flex)
  check_volume(name, mesh, config)
  if config.carrier and not free.all():
    raise ValueError(f"organ {name!r}: carrier is set and vertices are pinned, expected no <pin>")
  dofadr, qposadr = addresses(m, name, body, free)
  mass = m.body_mass[body]
  if config.elements == "solid":
    mesh = fill_inside(name, mesh, config)
    share = fill.vertex_volumes(mesh)
    mass = float(mass[free].mean()) * (nvert - mesh.spare) * share / share.sum()
  # Those inside move, and MuJoCo knows nothing of them.
  absent = np.full(mesh.nvert - nvert, -1)
  free = np.concatenate([free, absent < 0])
  order = np.cumsum(free) - 1
  return cached(
    float(m.opt.timestep),
    name=name,
    flex=flex,
    mesh=mesh,
    config=config,
    free=free,
    body=np.concatenate([body, np.full_like(absent, parent)]),
    dofadr=np.concatenate([dofadr, absent]),
    qposadr=np.concatenate([qposadr, absent]),
    stateadr=np.where(free, 3 * order, -1),
    nfree=3 * int(free[:nvert].sum()),
    frame=frame,
    origin=origin,
    mass=mass,
  )


def places(
  m, instance: int, flex: int, name: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
  """Returns where the vertices of a flex with dofs are.

  Returns:
    body of each vertex (nvert,); rest positions in the slides' axes [m] (nvert, 3); whether it
    moves (nvert,); rotation from these axes to the world (3, 3); position of the parent body [m]

  Raises:
    ValueError: no vertex moves, or they have no parent body that stands still.
  """
  start = m.flex_vertadr[flex]
  nvert = flexes.vertices(m, flex)
  body = m.flex_vertbodyid[start : start + nvert].copy()
  local = m.flex_vert[start : start + nvert]
  free = np.isin(body, moving_bodies(m, instance))
  if not free.any():
    raise ValueError(f"organ {name!r}: all vertices are pinned, expected some that move")
  parent = find_parent(m, name, body, free)
  frame, origin = static_frame(m, name, parent)
  turn = find_turn(m, name, body[free])
  rest = np.where(free[:, None], m.body_pos[body] @ turn, 0.0)
  rest += np.where(free[:, None], local, local @ turn)
  return body, rest, free, frame @ turn, origin


def is_rod(m: mjstruct.Struct, instance: int) -> bool:
  """Returns whether a plugin instance is a thread's, see `rods`."""
  return mjstruct.config(m, instance, "elements").strip() == "rod"


def read_mesh(
  m, name: str, texts: dict[str, str], rest: np.ndarray, flex: int
) -> tuple[Config, Mesh]:
  """Returns configuration and mesh of an organ as compiled, from its keys and rest positions."""
  text = texts.get("spare", "").strip()
  elem = flexes.compiled_elements(m, flex) if text else flexes.elements(m, flex)
  spare = configuration.spare(name, text, len(rest) - int(elem.max(initial=-1)) - 1)
  if spare and len(rest) > stamps.MOST:
    raise ValueError(
      f"organ {name!r}: spare is {spare} and it has {len(rest)} vertices, expected at most "
      f"{stamps.MOST}"
    )
  mesh = topology.build(name, rest, elem, spare)
  config = configuration.parse(name, texts, len(elem), mesh.closed)
  if config.elements == "membrane" and config.bend and not spare:  # a cut goes along given edges
    mesh = diagonals.parallel(name, mesh, np.asarray(config.young))
  return config, mesh


def fill_inside(name: str, mesh: Mesh, config: Config) -> Mesh:
  """Returns the surface with its inside, of a file or made."""
  given, bare = config.tetrahedra, mesh.without_spare
  solid = gmsh.read(name, given, bare) if given else fill.fill(name, bare)
  if not mesh.spare:
    return solid
  try:
    return faces.cuttable(mesh, solid)
  except ValueError as error:
    raise ValueError(f"organ {name!r}: {error}") from None


def cached(
  h: float, name: str, mesh: Mesh, config: Config, free: np.ndarray, **fields
) -> Declaration:
  """Returns the organ with its constants on the device, the same object for the same content."""
  digest = hashlib.sha256(repr((h, name, fields["flex"], config)).encode())
  for part in (mesh.rest, mesh.elem, mesh.tet, free, *fields.values()):
    if isinstance(part, np.ndarray):
      digest.update(np.ascontiguousarray(part).tobytes())
    elif isinstance(part, Windows):
      for array in vars(part).values():
        digest.update(np.ascontiguousarray(array).tobytes())
  key = digest.digest()
  with graphs.lock:
    if key not in _made:
      try:
        scale = (h * h + h * config.damping) / max(float(fields["mass"][free].mean()), 1e-300)
        scale *= SCHEMES[config.integrator].levels
        still = shape.make(mesh, config, ~free, config.device, scale, nworld=0)
      except ValueError as error:
        raise ValueError(f"organ {name!r}: {error}") from None
      if len(_made) >= _CACHED:
        _made.pop(next(iter(_made)))
      _made[key] = Declaration(
        name=name, mesh=mesh, config=config, free=free, still=still, **fields
      )
    return _made[key]


def keys(m: mjstruct.Struct, instance: int) -> dict[str, str]:
  """Returns the configuration keys that are set."""
  texts = {key: mjstruct.config(m, instance, key) for key in configuration.KEYS}
  return {key: text for key, text in texts.items() if text}


def moving_bodies(m, instance: int) -> np.ndarray:
  """Returns the bodies of an organ's moving vertices.

  MuJoCo marks the parent body as the plugin's too where vertices are pinned to it.
  """
  bodies = np.flatnonzero((m.body_plugin == instance) & (m.body_jntnum > 0))
  return np.setdiff1d(bodies, m.body_parentid[bodies])


def flex_of(m, instance: int) -> int:
  """Returns the flex whose vertices a plugin instance owns."""
  bodies = moving_bodies(m, instance)
  if not bodies.size:
    bodies = np.flatnonzero(m.body_plugin == instance)
  mine = np.isin(m.flex_vertbodyid, bodies)
  spans = zip(m.flex_vertadr, m.flex_vertnum, strict=True)
  found = [f for f, (start, count) in enumerate(spans) if mine[start : start + count].any()]
  if not found:
    who = mjstruct.name_of(m, "body", int(bodies[0])) if bodies.size else "?"
    raise ValueError(
      f"plugin palpate.organ on body {who!r}: no flex has vertices there, expected the plugin "
      "inside a <flexcomp dim='2'>"
    )
  if len(found) > 1:
    names = " and ".join(repr(flexes.name(m, f)) for f in found)
    raise ValueError(f"one palpate.organ instance serves {names}, expected one instance each")
  return found[0]


def check_surface(m, flex: int, name: str):
  """Raises ValueError where a flex cannot be an organ's surface."""
  dim = m.flex_dim[flex]
  if dim != 2:
    raise ValueError(f"organ {name!r}: flexcomp dim is {dim}, expected dim='2' (a surface)")
  check_integrator(m, name)


def check_integrator(m, name: str):
  """Raises ValueError where MuJoCo's integrator is none that a step can be part of."""
  if m.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
    raise ValueError(f"organ {name!r}: {NO_RK4}")


def check_flex(m, flex: int, name: str):
  """Raises ValueError where a flex cannot give MuJoCo's dofs to an organ or a thread."""
  if m.flex_rigid[flex]:
    raise ValueError(
      f"organ {name!r}: flexcomp is rigid (or all its vertices are pinned), expected rigid='false'"
    )
  if m.flex_interp[flex]:
    raise ValueError(f"organ {name!r}: flexcomp dof is interpolated, expected dof='full'")
  adr = int(m.flex_stiffnessadr[flex])
  native = m.flex_stiffness[adr] if adr >= 0 and m.flex_stiffness.size else 0.0
  if m.flex_edgestiffness[flex] or native:
    raise ValueError(
      f"organ {name!r}: flexcomp has MuJoCo elasticity too, expected no <elasticity young='...'> "
      "and no <edge stiffness='...'>; use the plugin's keys"
    )
  if np.any(np.isin(m.eq_type, _EDGES) & (m.eq_obj1id == flex)):
    raise ValueError(
      f"organ {name!r}: an equality of MuJoCo holds the flex's edges, expected none and no "
      "<edge equality='...'>; use the plugin's keys"
    )


def check_volume(name: str, mesh: Mesh, config: Config):
  """Raises ValueError where a closed surface is inside out, or too flat for what acts inside."""
  if not mesh.closed:
    return
  volume = topology.volume(mesh.rest, mesh.elem)
  area = np.linalg.norm(topology.area_vectors(mesh.rest, mesh.elem), axis=1).sum()
  if volume < -_FLAT * area**1.5:
    raise ValueError(
      f"organ {name!r}: its surface is inside out and encloses {volume:.3g} m^3, expected "
      "triangles counter-clockwise from outside"
    )
  if config.bulk and volume < _FLAT * area**1.5:
    raise ValueError(
      f"organ {name!r}: bulk is {config.bulk:g}, expected 0 for a surface that encloses no volume "
      f"({volume:.3g} m^3)"
    )


def find_parent(m, name: str, body: np.ndarray, free: np.ndarray) -> int:
  """Returns the one body that the vertices' bodies hang on."""
  parents = np.unique(m.body_parentid[body[free]])
  if parents.size > 1:
    raise ValueError(
      f"organ {name!r}: its vertices have {parents.size} parent bodies, expected one"
    )
  elsewhere = np.setdiff1d(body[~free], parents)
  if elsewhere.size:
    who = mjstruct.name_of(m, "body", int(elsewhere[0]))
    raise ValueError(
      f"organ {name!r}: a vertex is attached to body {who!r}, expected free vertices or ones "
      "pinned to the parent body"
    )
  return int(parents[0])


def find_turn(m, name: str, body: np.ndarray) -> np.ndarray:
  """Returns the rotation of the vertices' bodies, and of their slides, against the parent body.

  A flexcomp has none, but `attach` turns the bodies of a world that it puts in a frame.
  """
  quats = m.body_quat[body]
  if np.abs(quats - quats[0]).max() > 1e-9:
    raise ValueError(f"organ {name!r}: its vertices' bodies are rotated, expected all alike")
  return flexes.matrix(quats[0])


def static_frame(m, name: str, parent: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns rotation and position of the organ's parent body, which must not move."""
  parentid, jntnum, mocap = m.body_parentid, m.body_jntnum, m.body_mocapid
  body = parent
  while body > 0:
    if jntnum[body] or mocap[body] >= 0:
      who = mjstruct.name_of(m, "body", body)
      what = "has joints" if jntnum[body] else "is a mocap body"
      raise ValueError(
        f"organ {name!r}: its parent body {who!r} {what}, expected a static frame (parent bodies "
        f"without joints); carrier={who!r} lets it carry the organ's foundation and pins"
      )
    body = int(parentid[body])
  return flexes.body_frame(m, parent)


def static_places(m, organ: Declaration) -> list[memoryview]:
  """Returns position and turn, as bytes, of each body that the organ or a window hangs on."""
  parentid = m.body_parentid
  start = [int(organ.body[0])] if organ.windows else parentid[organ.body[organ.jointed]]
  slots = parentid[organ.windows.body] if organ.windows else []
  found: set[int] = set()
  for body in {int(b) for b in (*start, *slots)}:
    while body > 0:
      found.add(body)
      body = int(parentid[body])
  bodies = np.array(sorted(found), int)
  runs = np.split(bodies, np.flatnonzero(np.diff(bodies) > 1) + 1) if len(bodies) else []
  return [
    each[run[0] : run[-1] + 1].view(np.uint8).reshape(-1).data
    for run in runs
    for each in (m.body_pos, m.body_quat)
  ]


def check_frame(m, organ: Declaration):
  """Raises ValueError where the organ's frame is not, or no longer, where it was declared."""
  parentid = m.body_parentid
  body = int(organ.body[0]) if organ.windows else int(parentid[organ.body[organ.jointed][0]])
  frame, origin = static_frame(m, organ.name, body)
  if not organ.windows:
    frame = frame @ find_turn(m, organ.name, organ.body[organ.jointed])
  if not (np.array_equal(frame, organ.frame) and np.array_equal(origin, organ.origin)):
    who = mjstruct.name_of(m, "body", body)
    raise ValueError(
      f"its parent body {who!r} was moved after its mjData was made, expected a static frame; make "
      "a new MjData"
    )


def addresses(m, name: str, body: np.ndarray, free: np.ndarray):
  """Returns first dof and first qpos of each vertex, -1 where pinned."""
  first = m.body_jntadr[body[free]]
  joints = np.minimum(first[:, None] + np.arange(3), m.njnt - 1)
  kind, axis = m.jnt_type[joints], m.jnt_axis[joints]
  slides = (m.body_jntnum[body[free]] == 3) & (kind == mujoco.mjtJoint.mjJNT_SLIDE).all(axis=1)
  if not (slides & (np.abs(axis - np.eye(3)).max(axis=(1, 2)) < 1e-9)).all():
    raise ValueError(
      f"organ {name!r}: its vertices do not have three slide joints along x, y, z, expected "
      "flexcomp dof='full'"
    )
  dofadr, qposadr = np.full(len(body), -1), np.full(len(body), -1)
  dofadr[free] = m.jnt_dofadr[first]
  qposadr[free] = m.jnt_qposadr[first]
  return dofadr, qposadr
