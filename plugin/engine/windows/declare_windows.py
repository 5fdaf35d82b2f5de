"""Reads the declaration of an organ with windows from a compiled mjModel and checks it."""

import numpy as np
from palpate.tissue import device as devices
from palpate.tissue.config import Config
from palpate.tissue.geometry import fill
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh

from ..model import declare, flexes, mjstruct
from ..model.declare import Declaration, Windows

Frame = tuple[np.ndarray, np.ndarray]  # rotation to the world, and origin [m]
_NEAR = 0.1  # of its size: closer than that to an organ, a flex is beside it


def read(m: mjstruct.Struct, instance: int) -> Declaration:
  """Returns the organ that plugin instance `instance` declares: a rigid flex, with windows.

  Raises:
    ValueError: the declaration is not one this plugin can run.
  """
  devices.init()
  flex, parent = _surface(m, instance)
  name = flexes.name(m, flex)
  frame, origin = declare.static_frame(m, name, parent)
  nvert = flexes.vertices(m, flex)
  start = int(m.flex_vertadr[flex])
  rest = m.flex_vert[start : start + nvert].copy()
  config, mesh = declare.read_mesh(m, name, declare.keys(m, instance), rest, flex)
  declare.check_volume(name, mesh, config)
  if config.elements == "solid":
    mesh = declare.fill_inside(name, mesh, config)
  free = np.ones(mesh.nvert, bool)
  for vertex in config.pin:
    if vertex >= nvert:
      raise ValueError(f"organ {name!r}: pin has {vertex}, expected vertices in [0, {nvert})")
    free[vertex] = bool(config.carrier)  # which holds them by springs
  if not free.any():
    raise ValueError(f"organ {name!r}: all vertices are pinned, expected some that move")
  share = fill.vertex_volumes(mesh) if len(mesh.tet) else topology.vertex_areas(rest, mesh.elem)
  mass = config.mass * share / share.sum()
  windows = _windows(m, instance, name, config, mesh, mass, (frame, origin))
  _check_neighbours(m, instance, name, windows, frame, origin, rest)
  absent = np.full(mesh.nvert, -1)
  return declare.cached(
    float(m.opt.timestep),
    name=name, flex=flex, mesh=mesh, config=config, free=free, mass=mass, windows=windows,
    body=np.full(mesh.nvert, parent), dofadr=absent, qposadr=absent, stateadr=absent, nfree=0,
    frame=frame, origin=origin,
  )  # fmt: skip


def _surface(m: mjstruct.Struct, instance: int) -> tuple[int, int]:
  """Returns the rigid flex that is the organ and the body that it is in."""
  bodies, mine = _rigid_flexes(m, instance)
  who = mjstruct.name_of(m, "body", int(bodies[0]))
  if len(mine) != 1:
    raise ValueError(
      f"plugin palpate.organ with window on body {who!r}: {len(mine)} rigid flexcomps there, "
      "expected one <flexcomp rigid='true'> in the body that has the plugin"
    )
  flex = mine[0]
  name = flexes.name(m, flex)
  declare.check_surface(m, flex, name)
  for key in ("contype", "conaffinity"):
    value = getattr(m, f"flex_{key}")[flex]
    if value:
      raise ValueError(f"organ {name!r}: {key} is {value}, expected 0: its windows collide for it")
  return flex, int(bodies[0])


def _rigid_flexes(m: mjstruct.Struct, instance: int) -> tuple[np.ndarray, list[int]]:
  """Returns the bodies of a plugin instance and the rigid flexes in them."""
  bodies = np.flatnonzero(m.body_plugin == instance)
  mine = m.flex_rigid.astype(bool) & np.isin(m.flex_vertbodyid[m.flex_vertadr], bodies)
  return bodies, np.flatnonzero(mine).tolist()


def _windows(
  m: mjstruct.Struct,
  instance: int,
  name: str,
  config: Config,
  mesh: Mesh,
  mass: np.ndarray,
  place: Frame,
) -> Windows:
  """Returns the window of an organ, and where it stands at rest."""
  flex = _claimed(m, instance, name, config)
  body, dofadr, qposadr, offset, turn = _slots(m, name, config.window, flex, place)
  elem_num = int(m.flex_elemnum[flex])
  # At rest the window stands on a patch of its own: its bodies move there, so that qpos0 fits.
  # The last slot stays free; a patch of n nodes has up to 2 n - 4 triangles: `windows/proxy.h`.
  room = min(len(body) - 1, elem_num // 2 + 2)
  home = _home_slots(mesh.elem, mesh.nouter, len(body), room)
  used = home >= 0
  stand = m.body_pos[body]
  stand[used] = np.einsum("kij,kj->ki", turn[used], offset[used] + mesh.rest[home[used]])
  return Windows(
    flex=flex,
    body=body,
    dofadr=dofadr,
    qposadr=qposadr,
    home=home,
    stand=stand,
    qhome=offset - np.einsum("kji,kj->ki", turn, stand),
    elem_adr=int(m.flex_elemdataadr[flex]),
    elem_num=elem_num,
    geom=_followed(m, name, config, flex),
    line=_lines(m, instance, config, flex),
    mass=mass,
  )


def _claimed(m: mjstruct.Struct, instance: int, name: str, config: Config) -> int:
  """Returns the flex that an organ names as its window and nobody else does."""
  names = flexes.names(m)
  surface = _surfaces(m, instance, without=instance)
  what = f"organ {name!r}: window {config.window!r}"
  found = flexes.resolve(config.window, name, names)
  if found is None:
    raise ValueError(f"{what} does not exist, expected a flexcomp; the model has {names}")
  flex = names.index(found)
  if flex in surface:
    raise ValueError(
      f"{what} is claimed by organ {names[surface[flex]]!r} too, expected one organ a window"
    )
  return flex


def _slots(
  m: mjstruct.Struct, name: str, window: str, flex: int, place: Frame
) -> tuple[np.ndarray, ...]:
  """Returns body, first dof, first qpos, offset from the organ and turn of each of its slots."""
  what = f"organ {name!r}: window {window!r}"
  start = int(m.flex_vertadr[flex])
  count = flexes.vertices(m, flex)
  own = m.flex_vertbodyid[start : start + count].copy()
  jointed = m.body_jntnum[own] > 0
  try:
    declare.check_surface(m, flex, window)
    declare.check_flex(m, flex, window)
    if not jointed.all():
      raise ValueError(f"organ {window!r}: vertices without joints, expected no pins")
    frame, origin = declare.static_frame(m, window, declare.find_parent(m, window, own, jointed))
    turn = declare.find_turn(m, window, own)
    frame = frame @ turn
    dofs, qposs = declare.addresses(m, window, own, jointed)
  except ValueError as error:
    raise ValueError(f"{what}: {str(error).partition(': ')[2]}") from None
  if np.abs(frame - place[0]).max() > 1e-9:
    raise ValueError(f"{what} is rotated against the organ, expected the same orientation")
  offset = np.tile(place[0].T @ (place[1] - origin), (count, 1))
  return own, dofs, qposs, offset, np.tile(turn, (count, 1, 1))


def _followed(m: mjstruct.Struct, name: str, config: Config, flex: int) -> np.ndarray:
  """Returns the geoms that a window follows: of the bodies named, or all that move and collide.

  An organ that nothing holds may fall on what stands still: its window follows that too. Tips of
  needles wake it, whether they collide or not.
  """
  tools, tips = _tools(m, name, config, flex), _tips(m, name, config)
  return np.array(tools + [g for g in tips if g not in tools], np.int64)


def _tips(m: mjstruct.Struct, name: str, config: Config) -> list[int]:
  """Returns the last geom of each needle that goes through an organ: that of its tip."""
  bodies = [flexes.find(m, "body", row.name, name) for row in config.needles]
  geoms = [np.flatnonzero(m.geom_bodyid == body) for body in bodies]
  return [int(each[-1]) for each in geoms if len(each)]


def _tools(m: mjstruct.Struct, name: str, config: Config, flex: int) -> list[int]:
  """Returns the geoms that collide with a window and that it follows."""
  bodyid, meets = m.geom_bodyid, flexes.meeting_geoms(m, flex)
  if not config.follow:
    moves = m.body_weldid[bodyid] > 0
    return [g for g in meets if moves[g] or not config.held]
  wanted = set()
  for body in config.follow:
    found = flexes.need(m, "body", body, name, "follow")
    if not any(bodyid[g] == found for g in meets):
      raise ValueError(
        f"organ {name!r}: follow names body {body!r}, which has no geoms that collide with its "
        "window, expected bodies with geoms"
      )
    wanted.add(found)
  return [g for g in meets if bodyid[g] in wanted]


def _lines(m: mjstruct.Struct, instance: int, config: Config, flex: int) -> np.ndarray:
  """Returns the first vertex of each edge that a window follows, of threads that it may touch."""
  kind, meets, start = m.flex_contype, m.flex_conaffinity, m.flex_vertadr
  moves = m.body_dofnum[m.flex_vertbodyid] > 0
  found = []
  for thread in _threads(m, instance):
    if not config.follow and (kind[thread] & meets[flex] or kind[flex] & meets[thread]):
      first = start[thread] + np.arange(flexes.vertices(m, thread) - 1)
      found.append(first[moves[first] | moves[first + 1]])
  return np.concatenate([np.zeros(0, np.int64), *found])


def _threads(m: mjstruct.Struct, instance: int) -> list[int]:
  """Returns the flexes that are threads of the plugin that has an instance."""
  mine = np.flatnonzero(m.plugin == m.plugin[instance]).tolist()
  return [declare.flex_of(m, k) for k in mine if declare.is_rod(m, k)]


def _check_neighbours(
  m: mjstruct.Struct,
  instance: int,
  name: str,
  windows: Windows,
  frame: np.ndarray,
  origin: np.ndarray,
  rest: np.ndarray,
):
  """Raises ValueError where a flex is beside the organ and collides with its windows.

  Windows follow geoms and edges of threads: they would not be there.
  """
  contype, conaffinity, own = m.flex_contype, m.flex_conaffinity, windows.flex
  surface = _surfaces(m, instance, without=instance)
  bearing = _bearing(m, name)
  points = origin + rest @ frame.T
  room = _NEAR * float(np.linalg.norm(np.ptp(points, axis=0)))
  low, high = points.min(axis=0) - room, points.max(axis=0) + room
  first = m.flex_vertadr
  for f in np.flatnonzero(np.arange(m.nflex) != own):
    if np.isin(first[f] + np.arange(flexes.vertices(m, int(f))), windows.line).any():
      continue
    if flexes.name(m, surface.get(int(f), int(f))) in bearing:
      continue
    meets = (contype[f] & conaffinity[own]) | (conaffinity[f] & contype[own])
    other = flexes.rest_points(m, surface.get(int(f), int(f)))
    if meets and (other.max(axis=0) > low).all() and (other.min(axis=0) < high).all():
      raise ValueError(
        f"organ {name!r}: its windows follow geoms and would not feel flex "
        f"{flexes.name(m, surface.get(int(f), int(f)))!r} beside it; use nodal coupling, or "
        "contype and conaffinity that do not meet"
      )


def _bearing(m: mjstruct.Struct, name: str) -> set[str]:
  """Returns the organs on which one rests, and those that rest on it."""
  names = flexes.names(m)
  found = {}
  for other in range(m.nplugin):
    for flex in _rigid_flexes(m, other)[1]:
      support = mjstruct.config(m, other, "support").split()
      found[names[flex]] = {flexes.resolve(each, names[flex], names) for each in support}
  return {each for each in names if name in found.get(each, ()) or each in found.get(name, ())}


def touching(model: int, instance: int) -> np.ndarray:
  """Returns the flexes that meet tools for this plugin's organs, of which one is an instance."""
  m = mjstruct.model(model)
  owner, plugin = m.body_plugin, m.plugin
  ours = np.flatnonzero((owner >= 0) & (plugin[owner] == plugin[instance]))
  rigid, start, body = m.flex_rigid, m.flex_vertadr, m.flex_vertbodyid
  own = [np.isin(body[start[f] : start[f] + flexes.vertices(m, f)], ours) for f in range(m.nflex)]
  nodal = [f for f in range(m.nflex) if not rigid[f] and own[f].any()]
  return np.array([*nodal, *_surfaces(m, instance)], int)


def _surfaces(m: mjstruct.Struct, instance: int, without: int = -1) -> dict[int, int]:
  """Returns the flex of the organ that each window is of, of all organs or without one."""
  names = flexes.names(m)
  plugin = m.plugin
  found = {}
  for other in range(m.nplugin):
    if other != without and plugin[other] == plugin[instance]:
      for flex in _rigid_flexes(m, other)[1]:
        window = mjstruct.config(m, other, "window").strip()
        resolved = flexes.resolve(window, names[flex], names)
        if resolved in names:
          found[names.index(resolved)] = flex
  return found


def _home_slots(elem: np.ndarray, nvert: int, size: int, most: int) -> np.ndarray:
  """Returns the default node of each slot: a patch grown over the surface, (size,)."""
  neighbours: list[set[int]] = [set() for _ in range(nvert)]
  for a, b, c in elem:
    neighbours[a] |= {b, c}
    neighbours[b] |= {a, c}
    neighbours[c] |= {a, b}
  patch, seen = [0], {0}
  for i in patch:
    fresh = sorted(neighbours[i] - seen)
    seen.update(fresh)
    patch += fresh
  patch = patch[: min(most, nvert)]
  return np.array(patch + [-1] * (size - len(patch)))
