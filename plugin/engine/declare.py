"""Reads the declaration of an organ from a compiled mjModel and checks it."""

from __future__ import annotations

import dataclasses
import hashlib
import threading

import mujoco
import numpy as np
from palpate.tissue import config as configuration
from palpate.tissue import device as devices
from palpate.tissue import mesh as topology
from palpate.tissue import shape
from palpate.tissue.body import Body
from palpate.tissue.config import Config
from palpate.tissue.mesh import Mesh
from palpate.tissue.step import SCHEMES

from . import mjstruct
from .window_nodes import MAX_GEOMS, MAX_WINDOWS

_lock = threading.RLock()
_CACHED = 16
_made: dict[bytes, Organ] = {}


@dataclasses.dataclass(frozen=True)
class Organ:
  """What is the same in every mjData of a model.

  Attributes:
    name: name of the flexcomp
    flex: index of the flex
    mesh: topology and rest shape, in the frame of the parent body
    config: configuration
    still: shape and tissue on the device, with no world
    free: whether a vertex moves            (nvert,) bool
    body: body of each vertex               (nvert,)
    dofadr: first dof, -1 if pinned         (nvert,)
    qposadr: first qpos, -1 if pinned       (nvert,)
    stateadr: first own number in the plugin state, -1 if pinned (nvert,)
    nfree: three times the number of moving vertices
    frame: rotation from the slides' axes to the world (3, 3)
    origin: position of the parent body [m] (3,)
    mass: mass of each vertex [kg]          (nvert,)
    digest: identifies geometry, configuration and masses
    windows: the windows, or None where the vertices are MuJoCo's dofs
  """

  name: str
  flex: int
  mesh: Mesh
  config: Config
  still: Body
  free: np.ndarray
  body: np.ndarray
  dofadr: np.ndarray
  qposadr: np.ndarray
  stateadr: np.ndarray
  nfree: int
  frame: np.ndarray
  origin: np.ndarray
  mass: np.ndarray
  digest: bytes
  windows: Windows | None = None

  @property
  def dofs(self) -> np.ndarray:
    """Degrees of freedom of the moving vertices, or of the windows' slots."""
    first = self.windows.dofadr if self.windows else self.dofadr[self.free]
    return (first[:, None] + np.arange(3)).ravel()

  @property
  def qposs(self) -> np.ndarray:
    """Where they are in qpos."""
    first = self.windows.qposadr if self.windows else self.qposadr[self.free]
    return (first[:, None] + np.arange(3)).ravel()


@dataclasses.dataclass(frozen=True)
class Windows:
  """The windows of an organ; a slot is one of their vertices.

  Attributes:
    flex: flex of each window                                 (nwindow,)
    adr: first slot of each window                            (nwindow + 1,)
    body: body of each slot                                   (nslot,)
    dofadr: its first dof                                     (nslot,)
    qposadr: its first qpos                                   (nslot,)
    home: node of each slot after a reset, -1 for none        (nslot,)
    qhome: qpos less rest position and displacement [m]       (nslot, 3)
    elem_adr: where each window's triangles start in flex_elem(nwindow,)
    elem_num: how many it can hold                            (nwindow,)
    geom_adr: first geom of each window                       (nwindow + 1,)
    geom: geoms that the windows follow
    mass: mass of each node [kg]                              (nvert,)
  """

  flex: np.ndarray
  adr: np.ndarray
  body: np.ndarray
  dofadr: np.ndarray
  qposadr: np.ndarray
  home: np.ndarray
  qhome: np.ndarray
  elem_adr: np.ndarray
  elem_num: np.ndarray
  geom_adr: np.ndarray
  geom: np.ndarray
  mass: np.ndarray

  @property
  def nslot(self) -> int:
    """Number of slots of all windows."""
    return len(self.body)


def read(model: int, instance: int) -> Organ:
  """Returns the organ that plugin instance `instance` of an mjModel declares.

  Raises:
    ValueError: the declaration is not one this plugin can run.
  """
  devices.init()
  m = mjstruct.Model.from_address(model)
  if mjstruct.config(model, instance, "window"):
    return _read_windowed(model, m, instance)
  flex = _flex_of(m, instance)
  name = _flex_name(m, flex)
  _check_flex(m, flex, name)
  start = mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[flex]
  nvert = _vertices(m, flex)
  body = mjstruct.view(m.flex_vertbodyid, m.nflexvert, np.int32)[start : start + nvert].copy()
  local = mjstruct.view(m.flex_vert, (m.nflexvert, 3))[start : start + nvert]
  free = np.isin(body, moving_bodies(m, instance))
  if not free.any():
    raise ValueError(f"organ {name!r}: all vertices are pinned, expected some that move")
  parent = _parent(m, name, body, free)
  frame, origin = _static_frame(m, name, parent)
  turn = _turn(m, name, body[free])
  frame = frame @ turn
  rest = np.where(free[:, None], mjstruct.view(m.body_pos, (m.nbody, 3))[body] @ turn, 0.0)
  rest += np.where(free[:, None], local, local @ turn)
  elem = _elements(m, flex)
  mesh = topology.build(name, rest, elem)
  config = configuration.parse(name, _keys(model, instance), len(elem), mesh.closed)
  dofadr, qposadr = _addresses(m, name, body, free)
  order = np.cumsum(free) - 1
  mass = mjstruct.view(m.body_mass, m.nbody)[body]
  return _cached(
    float(m.opt.timestep),
    name=name,
    flex=flex,
    mesh=mesh,
    config=config,
    free=free,
    body=body,
    dofadr=dofadr,
    qposadr=qposadr,
    stateadr=np.where(free, 3 * order, -1),
    nfree=3 * int(free.sum()),
    frame=frame,
    origin=origin,
    mass=mass,
  )


def _cached(h: float, name: str, mesh: Mesh, config: Config, free: np.ndarray, **fields) -> Organ:
  """Returns the organ with its constants on the device, the same object for the same content."""
  digest = hashlib.sha256(repr((h, name, fields["flex"], config)).encode())
  for part in (mesh.rest, mesh.elem, free, *fields.values()):
    if isinstance(part, np.ndarray):
      digest.update(np.ascontiguousarray(part).tobytes())
    elif isinstance(part, Windows):
      for array in vars(part).values():
        digest.update(np.ascontiguousarray(array).tobytes())
  key = digest.digest()
  with _lock:
    if key not in _made:
      try:
        scale = (h * h + h * config.damping) / max(float(fields["mass"][free].mean()), 1e-300)
        scale *= SCHEMES[config.integrator].levels
        still = shape.make(mesh, config, ~free, config.device, scale, nworld=0)
      except ValueError as error:
        raise ValueError(f"organ {name!r}: {error}") from None
      if len(_made) >= _CACHED:
        _made.pop(next(iter(_made)))
      _made[key] = Organ(
        name=name, mesh=mesh, config=config, free=free, still=still, digest=key, **fields
      )
    return _made[key]


def _keys(model: int, instance: int) -> dict[str, str]:
  texts = {key: mjstruct.config(model, instance, key) for key in configuration.KEYS}
  return {key: text for key, text in texts.items() if text}


def _read_windowed(model: int, m, instance: int) -> Organ:
  """Returns an organ that MuJoCo knows as a rigid flex, with windows."""
  bodies, mine = _rigid_flexes(m, instance)
  who = mjstruct.name_of(m, m.name_bodyadr, int(bodies[0]))
  if len(mine) != 1:
    raise ValueError(
      f"plugin palpate.organ with window on body {who!r}: {len(mine)} rigid flexcomps there, "
      "expected one <flexcomp rigid='true'> in the body that has the plugin"
    )
  flex = mine[0]
  start = mjstruct.view(m.flex_vertadr, m.nflex, np.int32)
  name = _flex_name(m, flex)
  _check_surface(m, flex, name)
  for key in ("contype", "conaffinity"):
    value = mjstruct.view(getattr(m, f"flex_{key}"), m.nflex, np.int32)[flex]
    if value:
      raise ValueError(f"organ {name!r}: {key} is {value}, expected 0: its windows collide for it")
  frame, origin = _static_frame(m, name, int(bodies[0]))
  nvert = _vertices(m, flex)
  rest = mjstruct.view(m.flex_vert, (m.nflexvert, 3))[start[flex] : start[flex] + nvert].copy()
  elem = _elements(m, flex)
  mesh = topology.build(name, rest, elem)
  config = configuration.parse(name, _keys(model, instance), len(elem), mesh.closed)
  free = np.ones(nvert, bool)
  for vertex in config.pin:
    if vertex >= nvert:
      raise ValueError(f"organ {name!r}: pin has {vertex}, expected vertices in [0, {nvert})")
    free[vertex] = False
  if not free.any():
    raise ValueError(f"organ {name!r}: all vertices are pinned, expected some that move")
  area = topology.vertex_areas(rest, elem)
  mass = config.mass * area / area.sum()
  windows = _windows(model, m, instance, name, config, mesh, mass, (frame, origin))
  absent = np.full(nvert, -1)
  return _cached(
    float(m.opt.timestep),
    name=name,
    flex=flex,
    mesh=mesh,
    config=config,
    free=free,
    body=np.full(nvert, int(bodies[0])),
    dofadr=absent,
    qposadr=absent,
    stateadr=absent,
    nfree=0,
    frame=frame,
    origin=origin,
    mass=mass,
    windows=windows,
  )


def _rigid_flexes(m, instance: int) -> tuple[np.ndarray, list[int]]:
  """Returns the bodies of a plugin instance and the rigid flexes in them."""
  bodies = np.flatnonzero(mjstruct.view(m.body_plugin, m.nbody, np.int32) == instance)
  start = mjstruct.view(m.flex_vertadr, m.nflex, np.int32)
  vertbody = mjstruct.view(m.flex_vertbodyid, m.nflexvert, np.int32)
  rigid = mjstruct.view(m.flex_rigid, m.nflex, np.bool_)
  return bodies, [f for f in range(m.nflex) if rigid[f] and vertbody[start[f]] in bodies]


def _resolve(name: str, organ: str, names: list[str]) -> str | None:
  """Returns the name that an organ's configuration means, or None.

  `<attach prefix="...">` renames flexes and bodies and leaves configurations alone: the longest
  prefix that the organ has too counts.
  """
  prefixes = [other[: len(other) - len(name)] for other in names if other.endswith(name)]
  prefixes = [prefix for prefix in prefixes if organ.startswith(prefix)]
  return max(prefixes, key=len) + name if prefixes else None


def _claims(model, m, instance: int, names: list[str]) -> dict[str, str]:
  """Returns the windows of the other organs, and whose they are."""
  claimed: dict[str, str] = {}
  plugin = mjstruct.view(m.plugin, m.nplugin, np.int32)
  for other in range(m.nplugin):
    if other != instance and plugin[other] == plugin[instance]:
      for flex in _rigid_flexes(m, other)[1]:
        for window in mjstruct.config(model, other, "window").split():
          organ = _flex_name(m, flex)
          claimed[_resolve(window, organ, names) or window] = f"organ {organ!r}"
  return claimed


def _windows(model, m, instance, name, config, mesh, mass, place) -> Windows:
  names = [_flex_name(m, f) for f in range(m.nflex)]
  claimed = _claims(model, m, instance, names)
  if len(config.window) > MAX_WINDOWS:
    raise ValueError(
      f"organ {name!r}: window has {len(config.window)} names, expected at most {MAX_WINDOWS}"
    )
  body, dofadr, qposadr, offsets, turns, sizes = [], [], [], [], [], []
  flex, elem_adr, elem_num = [], [], []
  for window in config.window:
    what = f"organ {name!r}: window {window!r}"
    found = _resolve(window, name, names)
    if found is None:
      raise ValueError(f"{what} does not exist, expected a flexcomp; the model has {names}")
    if found in claimed:
      raise ValueError(f"{what} is claimed by {claimed[found]} too, expected one organ a window")
    claimed[found] = "this organ"
    f = names.index(found)
    start = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[f])
    count = _vertices(m, f)
    own = mjstruct.view(m.flex_vertbodyid, m.nflexvert, np.int32)[start : start + count].copy()
    jointed = mjstruct.view(m.body_jntnum, m.nbody, np.int32)[own] > 0
    try:
      _check_flex(m, f, window)
      if not jointed.all():
        raise ValueError(f"organ {window!r}: vertices without joints, expected no pins")
      frame, origin = _static_frame(m, window, _parent(m, window, own, jointed))
      turn = _turn(m, window, own)
      frame = frame @ turn
      dofs, qposs = _addresses(m, window, own, jointed)
    except ValueError as error:
      raise ValueError(f"{what}: {str(error).partition(': ')[2]}") from None
    if np.abs(frame - place[0]).max() > 1e-9:
      raise ValueError(f"{what} is rotated against the organ, expected the same orientation")
    turns.append(np.tile(turn, (count, 1, 1)))
    offsets.append(np.tile(place[0].T @ (place[1] - origin), (count, 1)))
    body.append(own)
    dofadr.append(dofs)
    qposadr.append(qposs)
    sizes.append(count)
    flex.append(f)
    elem_adr.append(int(mjstruct.view(m.flex_elemdataadr, m.nflex, np.int32)[f]))
    elem_num.append(int(mjstruct.view(m.flex_elemnum, m.nflex, np.int32)[f]))
  # At rest the windows stand on patches of their own: their bodies move there, so that qpos0 fits.
  # The last slot stays free; a patch of n nodes has up to 2 n - 4 triangles: see `window_slots`.
  room = [min(n - 1, t // 2 + 2) for n, t in zip(sizes, elem_num, strict=True)]
  home = _home_slots(mesh.elem, mesh.nvert, sizes, room)
  used = home >= 0
  body, offset, turn = (np.concatenate(parts) for parts in (body, offsets, turns))
  body_pos = mjstruct.view(m.body_pos, (m.nbody, 3))
  stand = offset[used] + mesh.rest[home[used]]
  body_pos[body[used]] = np.einsum("kij,kj->ki", turn[used], stand)
  qhome = offset - np.einsum("kji,kj->ki", turn, body_pos[body])
  geom_adr, geom = _followed(m, name, config, flex)
  return Windows(
    flex=np.array(flex),
    adr=np.concatenate([[0], np.cumsum(sizes)]),
    body=body,
    dofadr=np.concatenate(dofadr),
    qposadr=np.concatenate(qposadr),
    home=home,
    qhome=qhome,
    elem_adr=np.array(elem_adr),
    elem_num=np.array(elem_num),
    geom_adr=geom_adr,
    geom=geom,
    mass=mass,
  )


def _followed(m, name: str, config: Config, flex: list[int]) -> tuple[np.ndarray, np.ndarray]:
  """Returns the geoms of each window: those of the bodies named, or all that move and collide."""
  bodyid = mjstruct.view(m.geom_bodyid, m.ngeom, np.int32)
  weld = mjstruct.view(m.body_weldid, m.nbody, np.int32)
  names = [mjstruct.name_of(m, m.name_bodyadr, b) for b in range(m.nbody)]
  groups: list[list[int]] = []
  for k, f in enumerate(flex):
    meets = meeting_geoms(m, f)
    if config.follow:
      if len(config.follow) != len(flex):
        raise ValueError(
          f"organ {name!r}: follow has {len(config.follow)} groups, expected {len(flex)}, "
          "one a window"
        )
      wanted = []
      for body in config.follow[k]:
        found = _resolve(body, name, names)
        if found is None:
          raise ValueError(f"organ {name!r}: follow names body {body!r}, which does not exist")
        wanted.append(names.index(found))
      mine = [g for g in meets if bodyid[g] in wanted]
    else:
      mine = [g for g in meets if weld[bodyid[g]] != 0]
    groups.append(mine)
  if not config.follow and len(flex) > 1:
    # A tree of bodies is one tool: a triangle between two windows would touch neither jaw.
    root = mjstruct.view(m.body_treeid, m.nbody, np.int32)[bodyid]
    trees = sorted({root[g] for group in groups for g in group})
    turn = {tree: k % len(flex) for k, tree in enumerate(trees)}
    groups = [[g for g in group if turn[root[g]] == k] for k, group in enumerate(groups)]
  for k, group in enumerate(groups):
    if len(group) > MAX_GEOMS:
      raise ValueError(
        f"organ {name!r}: window {config.window[k]!r} follows {len(group)} geoms, expected at most "
        f"{MAX_GEOMS}; name bodies in follow"
      )
  adr = np.concatenate([[0], np.cumsum([len(group) for group in groups])])
  return adr, np.array([g for group in groups for g in group], np.int64)


def meeting_geoms(m, flex: int) -> np.ndarray:
  """Returns the geoms that collide with a flex."""
  contype = mjstruct.view(m.geom_contype, m.ngeom, np.int32)
  conaffinity = mjstruct.view(m.geom_conaffinity, m.ngeom, np.int32)
  mine = mjstruct.view(m.flex_contype, m.nflex, np.int32)[flex]
  meets = mjstruct.view(m.flex_conaffinity, m.nflex, np.int32)[flex]
  return np.flatnonzero((contype & meets) | (conaffinity & mine))


def moving_bodies(m, instance: int) -> np.ndarray:
  """Returns the bodies of an organ's moving vertices.

  MuJoCo marks the parent body as the plugin's too where vertices are pinned to it.
  """
  owner = mjstruct.view(m.body_plugin, m.nbody, np.int32)
  jointed = mjstruct.view(m.body_jntnum, m.nbody, np.int32) > 0
  bodies = np.flatnonzero((owner == instance) & jointed)
  return np.setdiff1d(bodies, mjstruct.view(m.body_parentid, m.nbody, np.int32)[bodies])


def _flex_of(m, instance: int) -> int:
  owner = mjstruct.view(m.body_plugin, m.nbody, np.int32)
  bodies = moving_bodies(m, instance)
  if not bodies.size:
    bodies = np.flatnonzero(owner == instance)
  vertbody = mjstruct.view(m.flex_vertbodyid, m.nflexvert, np.int32)
  vertadr = mjstruct.view(m.flex_vertadr, m.nflex, np.int32)
  vertnum = mjstruct.view(m.flex_vertnum, m.nflex, np.int32)
  mine = np.isin(vertbody, bodies)
  found = [f for f in range(m.nflex) if mine[vertadr[f] : vertadr[f] + vertnum[f]].any()]
  if not found:
    who = mjstruct.name_of(m, m.name_bodyadr, int(bodies[0])) if bodies.size else "?"
    raise ValueError(
      f"plugin palpate.organ on body {who!r}: no flex has vertices there, expected the plugin "
      "inside a <flexcomp dim='2'>"
    )
  if len(found) > 1:
    names = " and ".join(repr(_flex_name(m, f)) for f in found)
    raise ValueError(f"one palpate.organ instance serves {names}, expected one instance each")
  return found[0]


def _flex_name(m, flex: int) -> str:
  return mjstruct.name_of(m, m.name_flexadr, flex) or f"flex {flex}"


def _check_surface(m, flex: int, name: str):
  dim = mjstruct.view(m.flex_dim, m.nflex, np.int32)[flex]
  if dim != 2:
    raise ValueError(f"organ {name!r}: flexcomp dim is {dim}, expected dim='2' (a surface)")
  if m.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
    raise ValueError(
      f"organ {name!r}: integrator is RK4, which evaluates forces four times a step; "
      "expected Euler, implicit or implicitfast"
    )


def _check_flex(m, flex: int, name: str):
  _check_surface(m, flex, name)
  if mjstruct.view(m.flex_rigid, m.nflex, np.bool_)[flex]:
    raise ValueError(
      f"organ {name!r}: flexcomp is rigid (or all its vertices are pinned), expected rigid='false'"
    )
  if mjstruct.view(m.flex_interp, m.nflex, np.int32)[flex]:
    raise ValueError(f"organ {name!r}: flexcomp dof is interpolated, expected dof='full'")
  stiffness = mjstruct.view(m.flex_edgestiffness, m.nflex)[flex]
  adr = int(mjstruct.view(m.flex_stiffnessadr, m.nflex, np.int32)[flex])
  native = mjstruct.view(m.flex_stiffness, adr + 1)[adr] if adr >= 0 and m.flex_stiffness else 0.0
  if stiffness or native:
    raise ValueError(
      f"organ {name!r}: flexcomp has MuJoCo elasticity too, expected no <elasticity young='...'> "
      "and no <edge stiffness='...'>; use the plugin's keys"
    )
  # MuJoCo warns of a flex without forces of its own; an <edge damping> silences it and, zero here,
  # costs nothing while running. The plugin's own damping acts instead.
  mjstruct.view(m.flex_edgedamping, m.nflex)[flex] = 0.0


def _parent(m, name: str, body: np.ndarray, free: np.ndarray) -> int:
  parents = np.unique(mjstruct.view(m.body_parentid, m.nbody, np.int32)[body[free]])
  if parents.size > 1:
    raise ValueError(
      f"organ {name!r}: its vertices have {parents.size} parent bodies, expected one"
    )
  elsewhere = np.setdiff1d(body[~free], parents)
  if elsewhere.size:
    who = mjstruct.name_of(m, m.name_bodyadr, int(elsewhere[0]))
    raise ValueError(
      f"organ {name!r}: a vertex is attached to body {who!r}, expected free vertices or ones "
      "pinned to the parent body"
    )
  return int(parents[0])


def _turn(m, name: str, body: np.ndarray) -> np.ndarray:
  """Returns the rotation of the vertices' bodies, and of their slides, against the parent body.

  A flexcomp has none, but `attach` turns the bodies of a world that it puts in a frame.
  """
  quats = mjstruct.view(m.body_quat, (m.nbody, 4))[body]
  if np.abs(quats - quats[0]).max() > 1e-9:
    raise ValueError(f"organ {name!r}: its vertices' bodies are rotated, expected all alike")
  turn = np.zeros(9)
  mujoco.mju_quat2Mat(turn, quats[0].copy())
  return turn.reshape(3, 3)


def _static_frame(m, name: str, parent: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns rotation and position of the organ's parent body, which must not move."""
  rotation, position = np.eye(3), np.zeros(3)
  parentid = mjstruct.view(m.body_parentid, m.nbody, np.int32)
  jntnum = mjstruct.view(m.body_jntnum, m.nbody, np.int32)
  mocap = mjstruct.view(m.body_mocapid, m.nbody, np.int32)
  quat = mjstruct.view(m.body_quat, (m.nbody, 4))
  pos = mjstruct.view(m.body_pos, (m.nbody, 3))
  while parent > 0:
    if jntnum[parent] or mocap[parent] >= 0:
      who = mjstruct.name_of(m, m.name_bodyadr, parent)
      what = "has joints" if jntnum[parent] else "is a mocap body"
      raise ValueError(
        f"organ {name!r}: its parent body {who!r} {what}, expected a static frame "
        "(parent bodies without joints)"
      )
    own = np.zeros(9)
    mujoco.mju_quat2Mat(own, quat[parent].copy())
    own = own.reshape(3, 3)
    rotation, position = own @ rotation, pos[parent] + own @ position
    parent = int(parentid[parent])
  return rotation, position


def _vertices(m, flex: int) -> int:
  """Returns the number of a flex's vertices; MuJoCo's own is 0 while an organ is hidden."""
  return _extent(m.flex_vertadr, m.nflex, m.nflexvert, flex)


def _extent(addresses: int | None, nflex: int, total: int, flex: int) -> int:
  adr = mjstruct.view(addresses, nflex, np.int32)
  return int((adr[flex + 1] if flex + 1 < nflex else total) - adr[flex])


def _elements(m, flex: int) -> np.ndarray:
  adr = int(mjstruct.view(m.flex_elemdataadr, m.nflex, np.int32)[flex])
  num = _extent(m.flex_elemadr, m.nflex, m.nflexelem, flex)
  data = mjstruct.view(m.flex_elem, m.nflexelemdata, np.int32)
  return data[adr : adr + 3 * num].reshape(num, 3).copy()


def _addresses(m, name: str, body: np.ndarray, free: np.ndarray):
  """Returns first dof and first qpos of each vertex, -1 where pinned."""
  jntadr = mjstruct.view(m.body_jntadr, m.nbody, np.int32)[body]
  jntnum = mjstruct.view(m.body_jntnum, m.nbody, np.int32)[body]
  first = jntadr[free]
  joints = np.minimum(first[:, None] + np.arange(3), m.njnt - 1)
  kind = mjstruct.view(m.jnt_type, m.njnt, np.int32)[joints]
  axis = mjstruct.view(m.jnt_axis, (m.njnt, 3))[joints]
  slides = (jntnum[free] == 3) & (kind == mujoco.mjtJoint.mjJNT_SLIDE).all(axis=1)
  if not (slides & (np.abs(axis - np.eye(3)).max(axis=(1, 2)) < 1e-9)).all():
    raise ValueError(
      f"organ {name!r}: its vertices do not have three slide joints along x, y, z, expected "
      "flexcomp dof='full'"
    )
  dofadr, qposadr = np.full(len(body), -1), np.full(len(body), -1)
  dofadr[free] = mjstruct.view(m.jnt_dofadr, m.njnt, np.int32)[first]
  qposadr[free] = mjstruct.view(m.jnt_qposadr, m.njnt, np.int32)[first]
  return dofadr, qposadr


def _home_slots(elem: np.ndarray, nvert: int, sizes: list[int], room: list[int]) -> np.ndarray:
  """Returns the default node of each slot: disjoint patches grown over the surface, (W,)."""
  neighbours: list[set[int]] = [set() for _ in range(nvert)]
  for a, b, c in elem:
    neighbours[a] |= {b, c}
    neighbours[b] |= {a, c}
    neighbours[c] |= {a, b}
  used: set[int] = set()
  out = []
  for size, most in zip(sizes, room, strict=True):
    seed = next(i for i in range(nvert) if i not in used)
    patch, queue = [], [seed]
    used.add(seed)
    while queue and len(patch) < most:
      i = queue.pop(0)
      patch.append(i)
      for j in sorted(neighbours[i] - used):
        used.add(j)
        queue.append(j)
    used -= set(queue)
    out += patch + [-1] * (size - len(patch))
  return np.array(out)
