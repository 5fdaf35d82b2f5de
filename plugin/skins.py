"""Smooth organs in pictures: gives an organ of an `mujoco.MjSpec` a skin."""

import mujoco
import numpy as np
from palpate.engine.model.skin import HIDDEN

from .tissue.geometry import subdivide
from .tissue.geometry.mesh import vertex_normals
from .windows import find_organ, own_bodies, rest_of

_ENOUGH = 3500  # vertices of a skin, unless told how many


def add_skin(
  spec: mujoco.MjSpec,
  organ: str,
  levels: int | None = None,
  *,
  material: str | None = None,
  texcoord: np.ndarray | None = None,
  height: np.ndarray | float = 0.0,
) -> str:
  """Lets an organ be drawn as a smooth surface through its vertices, in every way MuJoCo draws.

  The organ's triangles are divided in four `levels` times, by Loop's scheme. What a step computes
  and what it costs stay the same: the skin is made when a picture is. The organ's own surface goes
  to group 4, which nobody draws who does not ask for it.

  Args:
    spec: changed in place; afterwards it can be compiled, saved as XML and attached
    organ: name of the flexcomp
    levels: one of 1, 2, 3, 4; None for the first that makes 3500 vertices or more
    material: of the skin; None for the organ's material and colour
    texcoord: texture coordinates of the organ's vertices  (n, 2), or of the skin's (nskin, 2)
    height: of the skin's vertices over the smooth surface, such as grain [m]  (nskin,)

  Returns:
    The name of the skin.

  Raises:
    ValueError: there is no such organ, it has a skin, or an argument is not allowed.
  """
  flex, plugin, bodies = find_organ(spec, organ)
  config = {key: value for key, value in plugin.config.items() if value}
  name, have = f"{organ}_skin", config.get("skin")
  if have:
    raise ValueError(f"organ {organ!r} has skin {have!r} already, expected none")
  smooth = _smooth(organ, np.reshape(flex.elem, (-1, 3)), levels)
  count = smooth.count
  rest = rest_of(flex, bodies)[: np.max(flex.elem) + 1]  # without vertices that wait for cuts
  own = own_bodies(flex, bodies)  # none where it is rigid, and has windows
  parent = own[0].parent.name if own else next(iter(flex.vertbody))
  points = smooth(rest)
  above = np.broadcast_to(np.asarray(height, float), (count,))
  points = points + above[:, None] * vertex_normals(points, smooth.elem)
  look: dict = {"material": material or _material(flex)}
  if not material:  # a colour of its own would count, not the material's
    look["rgba"] = flex.rgba
  if texcoord is not None:
    look["texcoord"] = _fine(organ, texcoord, smooth, len(rest), count).ravel()
  skin = spec.add_skin(
    name=name, vert=points.ravel(), face=smooth.elem.ravel(), group=flex.group,
    bodyname=[parent], bindpos=[0.0, 0.0, 0.0], bindquat=[1.0, 0.0, 0.0, 0.0], **look,
  )  # fmt: skip
  skin.vertid, skin.vertweight = [np.arange(count)], [np.ones(count)]
  flex.group, config["skin"] = HIDDEN, name
  plugin.config = config
  return name


def _material(flex) -> str:
  """Returns the material of a flex, of which MuJoCo 4.0 has a list."""
  return flex.material if isinstance(flex.material, str) else next(iter(flex.material), "")


def _smooth(organ: str, elem: np.ndarray, levels: int | None) -> subdivide.Smooth:
  if levels is None:
    sizes = zip(subdivide.LEVELS, subdivide.counts(elem), strict=True)
    levels = next((level for level, size in sizes if size >= _ENOUGH), subdivide.LEVELS[-1])
  if levels not in subdivide.LEVELS:
    raise ValueError(f"organ {organ!r}: levels is {levels!r}, expected one of 1, 2, 3, 4")
  return subdivide.smooth(elem, levels)


def _fine(organ: str, texcoord, smooth, coarse: int, count: int) -> np.ndarray:
  texcoord = np.asarray(texcoord, float)
  if texcoord.shape == (count, 2):
    return texcoord
  if texcoord.shape != (coarse, 2):
    raise ValueError(
      f"organ {organ!r}: texcoord has shape {texcoord.shape}, expected ({coarse}, 2), one a vertex "
      f"of the organ, or ({count}, 2), one a vertex of its skin"
    )
  return smooth(texcoord)
