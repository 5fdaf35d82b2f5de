"""Reads the declaration of an organ with windows from a compiled mjModel and checks it."""

from __future__ import annotations

import numpy as np
from palpate.tissue import config as configuration
from palpate.tissue import device as devices
from palpate.tissue import mesh as topology
from palpate.tissue.config import Config

from . import declare, mjstruct
from .declare import Declaration, Windows
from .layout import MAX_GEOMS, MAX_WINDOWS


def read(model: int, instance: int) -> Declaration:
  """Returns the organ that plugin instance `instance` declares: a rigid flex, with windows.

  Raises:
    ValueError: the declaration is not one this plugin can run.
  """
  devices.init()
  m = mjstruct.Model.from_address(model)
  flex, parent = _surface(m, instance)
  name = declare.flex_name(m, flex)
  frame, origin = declare.static_frame(m, name, parent)
  nvert = declare.vertices(m, flex)
  start = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[flex])
  rest = mjstruct.view(m.flex_vert, (m.nflexvert, 3))[start : start + nvert].copy()
  elem = declare.elements(m, flex)
  mesh = topology.build(name, rest, elem)
  config = configuration.parse(name, declare.keys(model, instance), len(elem), mesh.closed)
  declare.check_volume(name, mesh, config)
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
  return declare.cached(
    float(m.opt.timestep),
    name=name,
    flex=flex,
    mesh=mesh,
    config=config,
    free=free,
    body=np.full(nvert, parent),
    dofadr=absent,
    qposadr=absent,
    stateadr=absent,
    nfree=0,
    frame=frame,
    origin=origin,
    mass=mass,
    windows=windows,
  )


def _surface(m, instance: int) -> tuple[int, int]:
  """Returns the rigid flex that is the organ and the body that it is in."""
  bodies, mine = _rigid_flexes(m, instance)
  who = mjstruct.name_of(m, m.name_bodyadr, int(bodies[0]))
  if len(mine) != 1:
    raise ValueError(
      f"plugin palpate.organ with window on body {who!r}: {len(mine)} rigid flexcomps there, "
      "expected one <flexcomp rigid='true'> in the body that has the plugin"
    )
  flex = mine[0]
  name = declare.flex_name(m, flex)
  declare.check_surface(m, flex, name)
  for key in ("contype", "conaffinity"):
    value = mjstruct.view(getattr(m, f"flex_{key}"), m.nflex, np.int32)[flex]
    if value:
      raise ValueError(f"organ {name!r}: {key} is {value}, expected 0: its windows collide for it")
  return flex, int(bodies[0])


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
          organ = declare.flex_name(m, flex)
          claimed[_resolve(window, organ, names) or window] = f"organ {organ!r}"
  return claimed


def _windows(model, m, instance, name, config, mesh, mass, place) -> Windows:
  """Returns the windows of an organ, and where they stand at rest."""
  found = _claimed(model, m, instance, name, config)
  slots = [
    _slots(m, f"organ {name!r}: window {window!r}", window, flex, place)
    for window, flex in zip(config.window, found, strict=True)
  ]
  sizes = [len(each[0]) for each in slots]
  body, dofadr, qposadr, offset, turn = (
    np.concatenate(parts) for parts in zip(*slots, strict=True)
  )
  elem_num = mjstruct.view(m.flex_elemnum, m.nflex, np.int32)[found]
  # At rest the windows stand on patches of their own: their bodies move there, so that qpos0 fits.
  # The last slot stays free; a patch of n nodes has up to 2 n - 4 triangles: see `native/slot.h`.
  room = [min(n - 1, int(t) // 2 + 2) for n, t in zip(sizes, elem_num, strict=True)]
  home = _home_slots(mesh.elem, mesh.nvert, sizes, room)
  used = home >= 0
  stand = mjstruct.view(m.body_pos, (m.nbody, 3))[body]
  stand[used] = np.einsum("kij,kj->ki", turn[used], offset[used] + mesh.rest[home[used]])
  geom_adr, geom = _followed(m, name, config, found)
  return Windows(
    flex=np.array(found),
    adr=np.concatenate([[0], np.cumsum(sizes)]),
    body=body,
    dofadr=dofadr,
    qposadr=qposadr,
    home=home,
    stand=stand,
    qhome=offset - np.einsum("kji,kj->ki", turn, stand),
    elem_adr=mjstruct.view(m.flex_elemdataadr, m.nflex, np.int32)[found],
    elem_num=elem_num,
    geom_adr=geom_adr,
    geom=geom,
    mass=mass,
  )


def _claimed(model, m, instance: int, name: str, config: Config) -> list[int]:
  """Returns the flexes that an organ names as its windows and nobody else does."""
  names = [declare.flex_name(m, f) for f in range(m.nflex)]
  claimed = _claims(model, m, instance, names)
  if len(config.window) > MAX_WINDOWS:
    raise ValueError(
      f"organ {name!r}: window has {len(config.window)} names, expected at most {MAX_WINDOWS}"
    )
  out = []
  for window in config.window:
    what = f"organ {name!r}: window {window!r}"
    found = _resolve(window, name, names)
    if found is None:
      raise ValueError(f"{what} does not exist, expected a flexcomp; the model has {names}")
    if found in claimed:
      raise ValueError(f"{what} is claimed by {claimed[found]} too, expected one organ a window")
    claimed[found] = "this organ"
    out.append(names.index(found))
  return out


def _slots(m, what: str, window: str, flex: int, place) -> tuple[np.ndarray, ...]:
  """Returns body, first dof, first qpos, offset from the organ and turn of each of its slots."""
  start = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[flex])
  count = declare.vertices(m, flex)
  own = mjstruct.view(m.flex_vertbodyid, m.nflexvert, np.int32)[start : start + count].copy()
  jointed = mjstruct.view(m.body_jntnum, m.nbody, np.int32)[own] > 0
  try:
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


def _followed(m, name: str, config: Config, flex: list[int]) -> tuple[np.ndarray, np.ndarray]:
  """Returns the geoms of each window: those of the bodies named, or all that move and collide."""
  bodyid = mjstruct.view(m.geom_bodyid, m.ngeom, np.int32)
  weld = mjstruct.view(m.body_weldid, m.nbody, np.int32)
  names = [mjstruct.name_of(m, m.name_bodyadr, b) for b in range(m.nbody)]
  groups: list[list[int]] = []
  for k, f in enumerate(flex):
    meets = declare.meeting_geoms(m, f)
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
