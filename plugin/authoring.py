"""Writing scenes: adds an organ to an `mujoco.MjSpec`, as a <flexcomp> does to MJCF."""

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from . import meshes, spares
from . import windows as author
from .attributes import CONTACT, text
from .engine import plugin as engine
from .tissue import config as configuration
from .tissue.geometry import mesh as topology

_DENSITY = 1060.0  # [kg/m^3], of most soft tissue
_BOX = 0.005  # [m]; half the side of the box whose inertia a node's body has, as in a flexcomp
_SELF = {
  word: getattr(mujoco.mjtFlexSelf, f"mjFLEXSELF_{word.upper()}")
  for word in ("none", "narrow", "bvh", "sap", "auto")
}
_SHARED = ("condim", "priority", "solmix", "margin", "gap", "contype", "conaffinity")
_LISTS = {"friction": (1.0, 0.005, 0.0001), "solref": (0.02, 1.0),
          "solimp": (0.9, 0.95, 0.001, 0.5, 2.0)}  # fmt: skip


def add_organ(
  spec: mujoco.MjSpec,
  mesh,
  name: str = "organ",
  *,
  parent: mujoco.MjsBody | str | None = None,
  pos: Sequence[float] = (0.0, 0.0, 0.0),
  quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
  scale: float | str = 1.0,
  mass: float | None = None,
  pin: Sequence[int] = (),
  radius: float = 0.001,
  rgba: Sequence[float] | None = None,
  contact: Mapping[str, object] | None = None,
  windows: bool | Mapping[str, object] = False,
  spare: int | str = 0,
  **config,
) -> mujoco.MjsFlex:
  """Adds an organ to a spec, in a body of its name; what a <flexcomp> with the plugin does in MJCF.

  The mesh is taken as it is: a manifold surface wound one way, its triangles not too thin, as
  `palpate wrap`, or `palpate.models.meshing.wrap`, makes them.

  Args:
    spec: changed in place, unless an error is raised
    mesh: a file (OBJ, STL, PLY, glTF), a trimesh, or (vertices, triangles); equal vertices merge
    name: of flex, body and plugin instance; the nodes' bodies are `<name>_<k>`
    parent: what the body is in, which must not move; None for the world
    pos: of the body in its parent [m]
    quat: orientation of the body in its parent
    scale: metres per unit of the mesh, or the unit: m, cm, mm or inch
    mass: [kg]; None for 1060 kg/m^3 of what a closed surface encloses
    pin: vertices that do not move
    radius: of the flex [m]
    rgba: colour
    contact: attributes of <contact> that are not as in CONTACT, which suits instruments
    windows: whether MuJoCo has dofs under the spec's tools alone; or `tools`, `nodes` as there
    spare: vertices for cuts; `auto`: for some eight across the organ, or one through a solid
    **config: the plugin's configuration keys: young, poisson, thickness, foundation, bulk, ...

  Returns:
    The flex, for instance to give it a material.

  Raises:
    ValueError: a key, value, name or the mesh is not allowed; the message says what is.
  """
  _, vertices, triangles = meshes.read(mesh, scale, sized=not isinstance(mesh, tuple | list))
  bare = _surface(name, *meshes.merge(vertices, triangles))
  surface = spares.with_spare(name, bare, spare, config)
  pins, mass = pinned(name, pin, bare.nvert), _mass(name, mass, surface)
  windowed, options = windows is not False, _windows(name, windows)
  texts = _texts(name, config, surface, mass if windowed else None)
  look = look_of(name, radius, rgba) | contact_of(name, {**CONTACT, **(contact or {})})
  where = parent_of(spec, name, parent)
  check_names(spec, name, 0 if windowed else surface.nvert)
  body = where.add_body(name=name, pos=pos, quat=quat)
  texts |= spares.add_walls(spec, body, name, surface, config)
  if windowed:
    return _add_windowed(spec, body, surface, pins, mass, texts, look, options)
  return _add_nodal(spec, body, surface, pins, mass, texts, look)


def _add_nodal(spec, body, surface: topology.Mesh, pins, mass: float, texts: dict, look: dict):
  """Adds plugin, nodes and flex of an organ whose nodes are MuJoCo's; returns the flex."""
  share = mass / (surface.nvert - surface.spare)
  return author.make_flex(
    spec, body.name, *add_nodes(spec, body, surface.rest, pins, share, texts), surface.elem, **look
  )


def add_nodes(
  spec, body, points: np.ndarray, pins: np.ndarray, mass: float, texts: dict[str, str]
) -> tuple[np.ndarray, list[str]]:
  """Adds a plugin instance and the nodes whose motion is MuJoCo's, each of a mass [kg].

  Returns:
    the vertices in their bodies [m] (n, 3), and these
  """
  _instance(spec, body.name, texts)
  points, bodies = points.copy(), [body.name] * len(points)
  for k in np.setdiff1d(np.arange(len(points)), pins):
    bodies[k] = f"{body.name}_{k}"
    node = author.add_node(body, bodies[k], points[k], mass, 2 / 3 * mass * _BOX**2)
    author.claim(node, body.name)
    points[k] = 0.0
  return points, bodies


def _add_windowed(spec, body, surface: topology.Mesh, pins, mass: float, texts, look, options):
  """Adds plugin, rigid flex and windows of an organ; returns the flex."""
  name = body.name
  plugin = _instance(spec, name, texts | {"mass": text(mass, 17), "pin": text(pins)})
  author.claim(body, name)
  bodies = [name] * surface.nvert
  flex = author.make_flex(spec, name, surface.rest, bodies, surface.elem, **look)
  flex.edgedamping = 0.0
  try:
    author.add_windows(spec, name, **options)
  except ValueError:
    for added in (flex, plugin, body):
      spec.delete(added)
    raise
  return flex


def _instance(spec, name: str, texts: dict[str, str]):
  """Adds an instance of the plugin, which has a name so that it can be attached elsewhere."""
  spec.activate_plugin(engine.NAME)
  plugin = spec.add_plugin(name=name, plugin_name=engine.NAME, active=True)
  plugin.config = {key: value for key, value in texts.items() if value}
  return plugin


def _surface(name: str, vertices: np.ndarray, triangles: np.ndarray) -> topology.Mesh:
  try:
    made = topology.build(name, vertices, triangles)
  except ValueError as error:
    raise ValueError(f"{error}; `palpate wrap` makes an organ of it") from None
  if made.closed and topology.volume(made.rest, made.elem) < 0:  # wound inward
    return topology.build(name, vertices, triangles[:, ::-1].copy())
  return made


def pinned(name: str, pin: Sequence[int], nvert: int) -> np.ndarray:
  """Returns the vertices that do not move, of `nvert`; raises ValueError for others."""
  pins = np.unique(np.asarray(pin, dtype=float))
  bad = pins[(pins != np.floor(pins)) | (pins < 0) | (pins >= nvert)]
  if bad.size:
    raise ValueError(f"organ {name!r}: pin has {bad[0]:g}, expected vertices in [0, {nvert})")
  if len(pins) == nvert:
    raise ValueError(f"organ {name!r}: all vertices are pinned, expected some that move")
  return pins.astype(int)


def _mass(name: str, mass: float | None, surface: topology.Mesh) -> float:
  if mass is not None:
    if not (np.isfinite(mass) and mass > 0):
      raise ValueError(f"organ {name!r}: mass is {mass}, expected a number > 0")
    return float(mass)
  if not surface.closed:
    raise ValueError(f"organ {name!r}: mass is missing [kg], the surface is not closed")
  return _DENSITY * topology.volume(surface.rest, surface.elem)


def _texts(name: str, config: dict, surface: topology.Mesh, mass: float | None) -> dict[str, str]:
  """Returns the texts of the plugin's keys, checked; a mass is that of an organ with windows."""
  texts = {key: text(value, 17) for key, value in config.items()}
  texts |= {"spare": str(surface.spare)} if surface.spare else {}
  for key in ("window", "follow"):
    if key in texts:
      raise ValueError(f"organ {name!r}: {key} is set, expected windows=True or its options")
  given = texts if mass is None else {**texts, "window": name, "mass": text(mass)}
  configuration.parse(name, given, surface.nelem, surface.closed)
  return texts


def _windows(name: str, windows: bool | Mapping[str, object]) -> dict:
  """Returns the options for `add_windows`."""
  options = dict(windows) if isinstance(windows, Mapping) else {}
  for key in options:
    if key not in ("tools", "nodes"):
      raise ValueError(f"organ {name!r}: windows has {key!r}, expected tools and nodes")
  return options


def look_of(name: str, radius: float, rgba) -> dict:
  """Returns a flex's attributes of its look; raises ValueError for a wrong one."""
  if not (np.isfinite(radius) and radius > 0):
    raise ValueError(f"organ {name!r}: radius is {radius}, expected a number > 0")
  if rgba is None:
    return {"radius": radius}
  if np.shape(rgba) != (4,):
    raise ValueError(f"organ {name!r}: rgba is {rgba}, expected four numbers")
  return {"radius": radius, "rgba": np.asarray(rgba, dtype=float)}


def contact_of(name: str, given: dict) -> dict:
  """Returns a flex's attributes for those of <contact>."""
  made: dict = {}
  for key, value in given.items():
    if key in _SHARED:
      made[key] = value
    elif key in _LISTS:
      values = np.atleast_1d(np.asarray(value, dtype=float))
      made[key] = np.concatenate([values, _LISTS[key][len(values) :]])
    elif key == "selfcollide" and value in _SELF:
      made[key] = _SELF[value]
    elif key == "selfcollide":
      choices = ", ".join(_SELF)
      raise ValueError(f"organ {name!r}: selfcollide is {value!r}, expected one of {choices}")
    else:
      choices = ", ".join((*_SHARED, *_LISTS, "selfcollide"))
      raise ValueError(f"organ {name!r}: contact has {key!r}, expected one of {choices}")
  return made


def parent_of(spec, name: str, parent):
  """Returns the body that an organ is put in."""
  if parent is None:
    return spec.worldbody
  found = spec.body(parent) if isinstance(parent, str) else parent
  if found is None:
    have = ", ".join(repr(body.name) for body in spec.bodies)
    raise ValueError(f"organ {name!r}: no body {parent!r} in the spec, it has {have}")
  above = found
  while above is not None:
    if above.first_joint() is not None or above.mocap:
      raise ValueError(f"organ {name!r}: body {above.name!r} above it moves, expected a fixed one")
    above = above.parent
  return found


def check_names(spec, name: str, nodes: int):
  """Raises ValueError where the spec has the name of an organ or of its nodes already."""
  if not name:
    raise ValueError("name is '', expected the organ's")
  taken = {body.name for body in spec.bodies}
  wanted = [name, *(f"{name}_{k}" for k in range(nodes))]
  clash = next((each for each in wanted if each in taken), None)
  if clash:
    raise ValueError(f"organ {name!r}: the spec has a body {clash!r} already")
  for what, names in (("flex", spec.flexes), ("plugin instance", spec.plugins)):
    if name in {each.name for each in names}:
      raise ValueError(f"organ {name!r}: the spec has a {what} {name!r} already")
