"""Writing scenes: gives an organ of an `mujoco.MjSpec` room for cuts."""

import math
from collections.abc import Mapping

import mujoco
import numpy as np

from .engine.cutting.walls import room
from .tissue.geometry import mesh as topology
from .windows import add_node, claim, find_organ, make_flex, own_bodies, rest_of

_INSIDE = (0.5, 0.13, 0.12, 1.0)  # colour of the walls of cuts in a solid
_LIPS = (0.36, 0.05, 0.045, 1.0)  # of cuts in a sheet
_THIN = 1e-5  # radius of the flex that draws them [m]
_CUTS = 8  # times the square root of its vertices is what "auto" gives an organ
_THROUGH = 4  # times their number to the power of 2/3 is what it gives a solid


def add_spare(spec: mujoco.MjSpec, organ: str, spare: int):
  """Gives an organ vertices without triangles, which cuts make use of.

  They wait in its middle. What `add_organ(..., spare=)` does to an organ that MJCF declares: the
  vertices of a <flexcomp> that no triangle has would be left out.

  Args:
    spec: changed in place
    organ: name of the flexcomp
    spare: how many

  Raises:
    ValueError: there is no such organ, or it has spare vertices already.
  """
  flex, plugin, bodies = find_organ(spec, organ)
  if plugin.config.get("spare") or isinstance(spare, bool) or int(spare) < 1:
    raise ValueError(f"organ {organ!r}: spare is {spare}, expected a number > 0 for one without")
  vertbody = list(flex.vertbody)
  if len(vertbody) == 1:  # MuJoCo's short form of a rigid flex
    flex.vertbody = vertbody = vertbody * (len(flex.vert) // 3)
  own, rest = own_bodies(flex, bodies), rest_of(flex, bodies)
  points = np.reshape(flex.vert, (-1, 3)) if len(flex.vert) else np.zeros_like(rest)
  middle = rest.mean(axis=0)
  for k in range(spare):
    if own:
      made = add_node(own[0].parent, f"{organ}_spare_{k}", middle, own[0].mass, own[0].inertia[0])
      claim(made, plugin.name)
    vertbody.append(f"{organ}_spare_{k}" if own else vertbody[0])
  more = np.zeros((spare, 3)) + (0.0 if own else middle)
  flex.vert, flex.vertbody = np.concatenate([points, more]).ravel(), vertbody
  config = {k: v for k, v in plugin.config.items() if v} | {"spare": str(spare)}
  above = own[0].parent if own else bodies[vertbody[0]]
  elem = np.reshape(flex.elem, (-1, 3))
  surface = topology.build(organ, np.concatenate([rest, more + middle]), elem, spare)
  plugin.config = config | add_walls(spec, above, organ, surface, config)


def add_walls(spec, body, organ: str, surface, config: Mapping) -> dict[str, str]:
  """Adds the flex that draws what cuts open, see `Walls`, to an organ with room for cuts.

  Args:
    spec: changed in place
    body: of the organ
    organ: its name
    surface: it, with its spare vertices
    config: its configuration

  Returns:
    what the configuration has of it
  """
  name = f"{organ}_inside"
  if not surface.spare:
    return {}
  solid = config.get("elements") == "solid"
  if spec.flex(name) is not None:
    raise ValueError(f"organ {organ!r}: the spec has a flex {name!r} already")
  body.add_body(name=name)
  count, triangles = room(surface.nvert, surface.spare, solid)
  elem = np.tile([0, 1, 2], (triangles, 1))  # others when there are some
  rgba = np.array(_INSIDE if solid else _LIPS)
  flex = make_flex(spec, name, np.zeros((count, 3)), [name] * count, elem, rgba=rgba)
  flex.contype = flex.conaffinity = 0
  flex.selfcollide = mujoco.mjtFlexSelf.mjFLEXSELF_NONE
  flex.radius, flex.edgedamping = _THIN, 0.0
  return {"walls": name}


def with_spare(
  name: str, surface: topology.Mesh, spare: int | str, config: Mapping
) -> topology.Mesh:
  """Returns a surface with vertices that wait for cuts, in its middle, where nothing meets them."""
  if spare == "auto":
    solid = config.get("elements") == "solid"
    many = _THROUGH * surface.nvert ** (2 / 3) if solid else _CUTS * math.sqrt(surface.nvert)
    spare = math.ceil(many)
  if not isinstance(spare, int) or isinstance(spare, bool) or spare < 0:
    raise ValueError(f"organ {name!r}: spare is {spare!r}, expected a whole number >= 0 or 'auto'")
  rest = np.concatenate([surface.rest, np.tile(surface.rest.mean(axis=0), (spare, 1))])
  return topology.build(name, rest, surface.elem, spare) if spare else surface
