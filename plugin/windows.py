"""Writing scenes: gives an organ of an `mujoco.MjSpec` windows, so that nobody does it by hand."""

import itertools
import math
import warnings
from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from palpate.engine.model import flexes

from .engine import plugin as engine
from .tissue.config import holders

# Slots of a window: from so few up to so many, unless told.
_LEAST, _MOST = 16, 256
# Of a long thin geom, only so many radii of its length are taken to touch.
_LENGTH = 20.0
# A 5 mm instrument, for a window made before its tools are there: radius, length [m].
_TOOL = (0.0025, 0.02)
# Of a slot's body; it does not turn, and is lighter than any node.
_INERTIA, _SHARE = 1e-8, 0.01
_KEY_FIELDS = {"qpos": 0, "qvel": 1}  # columns of `_layout`
_WINDOW_GROUP = 4  # not drawn by default


def add_windows(
  spec: mujoco.MjSpec,
  organ: str,
  tools: Sequence[str | Sequence[str]] | None = None,
  nodes: int | None = None,
) -> tuple[str, ...]:
  """Gives an organ window coupling: MuJoCo then has dofs only under the tools.

  A nodal organ (a flexcomp with the plugin) becomes a rigid flex; mass, pins, look, contact
  parameters and configuration are carried over. A rigid organ that is declared with `mass`, and no
  `window` yet, keeps what it has. The spec can be saved as XML, compiled and attached to another.

  Args:
    spec: changed in place
    organ: name of the flexcomp
    tools: bodies that the window follows with all that hangs on them; of an entry with several,
      one has to collide; None for all that moves and collides, and what an organ may fall on that
      nothing holds
    nodes: most nodes in the window; None sizes it from the tools' geoms and the organ's edges

  Returns:
    The name of the window, alone.

  Raises:
    ValueError: there is no such organ or body, or it cannot have windows.
  """
  flex, plugin, bodies = find_organ(spec, organ)
  config = {key: value for key, value in plugin.config.items() if value}
  groups = _groups(organ, bodies, tools)
  name = f"{organ}_window"
  _check(spec, flex, config, name, nodes)
  nodal = len(set(flex.vertbody)) > 1 or "mass" not in config
  meets = (flex.contype, flex.conaffinity) if nodal or flex.contype or flex.conaffinity else (1, 1)
  colliding = [g for g in spec.geoms if (g.contype & meets[1]) | (g.conaffinity & meets[0])]
  own = own_bodies(flex, bodies) if nodal else []
  if nodal and (not own or len({body.name for body in own}) < len(own)):
    raise ValueError(f"organ {organ!r} has no vertices of its own, expected a <flexcomp>")
  pinned = nodal and len(own) < len(flex.vertbody)
  held = pinned or any(
    config.get(key, "").strip("0. ") for key in holders(config.get("carrier", ""))
  )
  followed = _followed(organ, groups, colliding, held)
  # From here on the spec changes.
  keys = _take_keys(spec)
  surface = _make_rigid(spec, flex, bodies, plugin, config) if nodal else bodies[flex.vertbody[0]]
  _add_window(spec, flex, surface, name, followed, nodes, meets, config)
  _warn_of_others(organ, colliding, groups, held, config.get("support", "").split())
  config["window"] = name
  if groups:
    config["follow"] = " ".join(dict.fromkeys(geom.parent.name for geom in followed))
  plugin.config = config
  flex.contype = flex.conaffinity = 0
  _fit_keys(spec, organ, keys)
  return (name,)


def find_organ(spec: mujoco.MjSpec, organ: str):
  """Returns flex and plugin of an organ, and the spec's bodies by name; it may name the plugin.

  Raises:
    ValueError: there is no such flex, or it is no organ.
  """
  flex = spec.flex(organ)
  if flex is None:
    have = ", ".join(repr(f.name) for f in spec.flexes) or "none"
    raise ValueError(f"no flexcomp {organ!r} in the spec, it has {have}")
  bodies = {body.name: body for body in spec.bodies}
  return flex, _plugin(spec, organ, [bodies[name] for name in dict.fromkeys(flex.vertbody)]), bodies


def _check(spec, flex, config: dict[str, str], name: str, nodes: int | None):
  """Raises ValueError where an organ cannot have a window of this name and so many nodes."""
  organ = flex.name
  if config.get("window"):
    raise ValueError(f"organ {organ!r} has window {config['window']!r} already, expected none")
  if flex.dim != 2:
    raise ValueError(f"organ {organ!r}: flexcomp dim is {flex.dim}, expected dim='2' (a surface)")
  if spec.flex(name) is not None:
    raise ValueError(f"organ {organ!r}: the spec has a flex {name!r} already")
  if nodes is not None and not 5 <= nodes:
    raise ValueError(f"organ {organ!r}: nodes is {nodes}, expected at least 5")


def _followed(organ: str, groups: list[set[str]], colliding: list, held: bool) -> list:
  """Returns the geoms that the window follows.

  Without tools, all that moves, and where nothing holds the organ all that it may fall on.
  """
  if not groups:
    return [geom for geom in colliding if _moves(geom) or not held]
  for group in groups:
    mine = [geom for geom in colliding if not group.isdisjoint(_ancestors(geom))]
    if not mine:
      raise ValueError(f"organ {organ!r}: nothing of {sorted(group)} collides with it")
    if not all(geom.parent.name for geom in mine):
      raise ValueError(f"organ {organ!r}: a body of {sorted(group)} has no name, expected one")
  tools = set().union(*groups)
  return [geom for geom in colliding if not tools.isdisjoint(_ancestors(geom))]


def organs(spec: mujoco.MjSpec) -> dict[str, bool]:
  """Returns the organs of a spec and whether each has windows."""
  bodies = {body.name: body for body in spec.bodies}
  configs = {plugin.name: plugin.config for plugin in spec.plugins}
  found = {}
  for flex in spec.flexes:
    plugins = [bodies[name].plugin for name in dict.fromkeys(flex.vertbody)]
    mine = [p for p in plugins if p.active and p.plugin_name == engine.NAME]
    if mine:
      config = configs[mine[0].name] if mine[0].name else mine[0].config
      found[flex.name] = bool(config.get("window"))
  return found


def _plugin(spec, organ: str, bodies: list):
  """Returns the instance of this plugin that the vertices' bodies have, and its name."""
  mine = [b for b in bodies if b.plugin.active and b.plugin.plugin_name == engine.NAME]
  instances = {body.plugin.name for body in mine}
  if len(instances) != 1:
    raise ValueError(f"flexcomp {organ!r} has {len(instances)} plugins {engine.NAME}, expected one")
  name = instances.pop()
  if name:
    return next(p for p in spec.plugins if p.name == name)
  # MuJoCo loses an instance without a name when it is attached to another spec.
  plugin = spec.add_plugin(name=organ, plugin_name=engine.NAME, active=True)
  plugin.config = dict(mine[0].plugin.config)
  mine[0].plugin.name = organ
  return plugin


def _ancestors(geom) -> Iterator[str]:
  """Yields the names of a geom's body and of those that it hangs on."""
  body = geom.parent
  while body is not None:
    yield body.name
    body = body.parent


def _moves(geom) -> bool:
  """Returns whether a geom's body or one that it hangs on has joints or is a mocap body."""
  body = geom.parent
  while body is not None:
    if body.first_joint() is not None or body.mocap:
      return True
    body = body.parent
  return False


def _groups(organ: str, bodies: dict, tools) -> list[set[str]]:
  """Returns the bodies that each tool may be; none for all that moves."""
  if tools is None:
    return []
  if isinstance(tools, str) or not len(tools):
    raise ValueError(f"tools is {tools!r}, expected a list of bodies")
  groups = [{tool} if isinstance(tool, str) else set(tool) for tool in tools]
  for name in itertools.chain(*groups):
    if name not in bodies:
      raise ValueError(f"organ {organ!r}: tools names body {name!r}, which does not exist")
  return groups


def own_bodies(flex, bodies: dict) -> list:
  """Returns the bodies of a nodal organ's moving vertices."""
  return [bodies[name] for name in flex.vertbody if bodies[name].first_joint() is not None]


def rest_of(flex, bodies: dict) -> np.ndarray:
  """Returns where vertices are in the body that an organ is in [m], (nvert, 3)."""
  names = list(flex.vertbody)
  rest = np.array(flex.vert).reshape(-1, 3) if len(flex.vert) else np.zeros((len(names), 3))
  own = [k for k, name in enumerate(names) if bodies[name].first_joint() is not None]
  rest[own] += np.reshape([bodies[names[k]].pos for k in own], (-1, 3))
  return rest


def claim(body, name: str):
  """Makes a body one of a plugin instance's."""
  body.plugin.name, body.plugin.plugin_name, body.plugin.active = name, engine.NAME, True


def _make_rigid(spec, flex, bodies: dict, plugin, config: dict[str, str]):
  """Makes a nodal organ's flex rigid; returns the body it is in."""
  vertbody, own = list(flex.vertbody), own_bodies(flex, bodies)
  free = np.isin(vertbody, [body.name for body in own])
  parent = own[0].parent
  rest = rest_of(flex, bodies)
  nvert = len(rest) - int(config.get("spare", 0))
  config["mass"] = f"{nvert * np.mean([body.mass for body in own]):.9g}"
  if not free.all():
    config["pin"] = " ".join(map(str, np.flatnonzero(~free)))
  surface = parent
  if parent.plugin.name != plugin.name:  # MuJoCo marks the parent where vertices are pinned to it
    surface = parent.add_body(name=f"{flex.name}_surface")
    if own[0].frame is not None:
      surface.set_frame(own[0].frame)
    claim(surface, plugin.name)
  flex.vert, flex.vertbody = rest.ravel(), [surface.name] * len(rest)  # MuJoCo 4 deletes it too
  flex.edgedamping = 0.0
  # One by one the vertices' bodies take MuJoCo quadratic time to delete.
  doomed = parent.add_frame()
  for body in own:
    body.set_frame(doomed)
  spec.delete(doomed)
  return surface


def _slots(geoms: list, edge: float, radius: float) -> int:
  """Returns how many nodes the geoms can touch: half their surface, an edge and more away."""
  area = 0.0
  sizes = []
  for geom in geoms:
    kind, size = geom.type, np.nan_to_num(np.array(geom.size))
    fromto = np.array(geom.fromto)
    half = np.linalg.norm(fromto[3:] - fromto[:3]) / 2 if np.isfinite(fromto).all() else size[1]
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
      sizes.append((size[0], 0.0))
    elif kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
      sizes.append((size[0], 2 * half))
    elif kind in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
      _, middle, large = np.sort(size)
      sizes.append((middle, 2 * (large - middle)))
    else:
      return _MOST  # what a mesh or a plane can touch is not known here
  for r, length in sizes or [_TOOL]:
    r, length = r + edge + radius, min(length, _LENGTH * r)
    area += math.pi * r * (2 * r + length)
  # A node has two equilateral triangles.
  return int(np.clip(math.ceil(area / (math.sqrt(3) / 2 * edge**2)), _LEAST, _MOST))


def _add_window(spec, flex, surface, name: str, followed: list, nodes: int | None, meets, config):
  """Adds a window: a bipyramid, which has as many triangles as so many nodes can have."""
  rest = np.reshape(flex.vert, (-1, 3))
  elem = np.reshape(flex.elem, (-1, 3))
  edge = float(np.linalg.norm(rest[elem[:, [1, 2, 0]]] - rest[elem], axis=2).mean())
  most = nodes or _slots(followed, edge, flex.radius)
  size = max(1 + min(most, len(rest)), 5)  # one slot stays free
  angle = 2 * np.pi * np.arange(size - 2) / (size - 2)
  ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
  points = edge * np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]])
  a, pole = np.arange(size - 2), np.full(size - 2, size - 2)
  b = (a + 1) % (size - 2)
  triangles = np.concatenate([np.stack([a, b, pole], axis=1), np.stack([b, a, pole + 1], axis=1)])
  mass = _SHARE * float(config["mass"]) / len(rest)
  names = [f"{name}_{k}" for k in range(size)]
  # Next to the organ's own body, or in it, so that they turn alike.
  for own, point in zip(names, points, strict=True):
    add_node(surface, own, point, mass, _INERTIA)
  window = make_flex(spec, name, np.zeros((size, 3)), names, triangles)
  for key in ("condim", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap"):
    setattr(window, key, getattr(flex, key))
  window.contype, window.conaffinity = meets
  window.radius, window.group = flex.radius, _WINDOW_GROUP
  window.selfcollide = flex.selfcollide


def add_node(parent, name: str, pos: np.ndarray, mass: float, inertia: float):
  """Adds the body of a flex's vertex, with a slide along each axis, and returns it."""
  body = parent.add_body(name=name, pos=pos, ipos=np.zeros(3), mass=mass)
  body.inertia, body.explicitinertial = [inertia] * 3, True
  for axis in np.eye(3):
    body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
  return body


def make_flex(spec, name: str, points: np.ndarray, bodies: list[str], elem: np.ndarray, **look):
  """Adds a flex of triangles, or of edges, and returns it.

  Args:
    spec: changed in place
    name: of the flex
    points: vertices in their bodies [m]  (n, 3)
    bodies: of the vertices
    elem: triangles                       (m, 3), or edges (m, 2)
    **look: further attributes
  """
  # A flex without forces of its own makes MuJoCo warn; the plugin sets its damping to 0.
  return spec.add_flex(
    name=name, dim=elem.shape[1] - 1, vert=points.ravel(), vertbody=bodies, elem=elem.ravel(),
    edgedamping=1e-9, **look,
  )  # fmt: skip


def _warn_of_others(
  organ: str, colliding: list, groups: list[set[str]], held: bool, support: list[str]
):
  """Warns of geoms that the organ would collide with, that no window follows and do not bear it."""
  followed, names = set().union(*groups), [geom.name for geom in colliding]
  bearing = {flexes.resolve(each, organ, names) for each in support}
  alone = [
    _label(geom)
    for geom in colliding
    if followed.isdisjoint(_ancestors(geom)) and (groups or (held and not _moves(geom)))
    if geom.name not in bearing
  ]
  if alone:
    warnings.warn(
      f"organ {organ!r}: it can touch what no window follows: {', '.join(alone)}; name their "
      "bodies in tools or the geoms in support, or use nodal coupling",
      stacklevel=3,
    )


def _label(geom) -> str:
  """Returns a geom's name or kind, and its body."""
  kind = mujoco.mjtGeom(geom.type).name.removeprefix("mjGEOM_").lower()
  what = f"geom {geom.name!r}" if geom.name else f"a {kind}"
  return f"{what} of body {geom.parent.name!r}"


def _layout(spec) -> list[tuple[tuple[str, int], tuple[int, int]]]:
  """Returns body and index, positions and velocities of each joint, in the order of qpos."""
  sizes = {mujoco.mjtJoint.mjJNT_FREE: (7, 6), mujoco.mjtJoint.mjJNT_BALL: (4, 3)}
  return [
    ((body.name, k), sizes.get(joint.type, (1, 1)))
    for body in spec.bodies
    for k, joint in enumerate(body.joints)
  ]


def _take_keys(spec) -> list[tuple]:
  """Empties the keyframes, which MuJoCo wants to fit at every moment.

  Returns:
    Keyframe, field, and the numbers of each joint, for what they had.
  """
  joints = _layout(spec)
  found = []
  for key in spec.keys:
    for field, column in _KEY_FIELDS.items():
      values = np.array(getattr(key, field), dtype=float)
      cuts = np.cumsum([sizes[column] for _, sizes in joints])
      if values.size and values.size != cuts[-1]:
        raise ValueError(
          f"keyframe {key.name!r} has {values.size} numbers of {field}, expected {cuts[-1]}"
        )
      if values.size:
        names = [joint[0] for joint in joints]
        found.append((key, field, dict(zip(names, np.split(values, cuts[:-1]), strict=True))))
  for key, field, _ in found:
    setattr(key, field, [])
  return found


def _fit_keys(spec, organ: str, keys: list[tuple]):
  """Gives the keyframes the numbers of the joints that there are now, zero for the new ones."""
  joints = _layout(spec)
  now = {joint[0] for joint in joints}
  bent = {key.name for key, _, had in keys for name in had.keys() - now if np.any(had[name])}
  if bent:
    warnings.warn(
      f"organ {organ!r}: what keyframes {sorted(bent)} have of its motion is left out, because an "
      "organ with windows has it in plugin_state, which keyframes have not; set it with "
      "Organ.set_state",
      stacklevel=3,
    )
  for key, field, had in keys:
    sizes = [both[_KEY_FIELDS[field]] for _, both in joints]
    names = [joint[0] for joint in joints]
    new = [had.get(name, np.zeros(size)) for name, size in zip(names, sizes, strict=True)]
    setattr(key, field, np.concatenate(new))
