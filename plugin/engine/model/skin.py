"""An organ's skin: a fine surface that is drawn for it, a skin of MuJoCo's on a single bone.

Its triangles are the organ's divided in four, once or more. Whenever MuJoCo draws, `draw` writes
the smooth surface through the organ's vertices where `mjv_updateSkin` reads it. A step knows
nothing of it: there are no dofs, no contacts, and nothing in mjData.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry import subdivide
from palpate.tissue.geometry.subdivide import Smooth

from . import flexes, mjstruct, prepare

if TYPE_CHECKING:
  from ..workspace import Workspace
  from .declare import Declaration

HIDDEN = 4  # the group of an organ's own surface where a skin is drawn for it


@dataclasses.dataclass(frozen=True)
class Skin:
  """What draws an organ.

  Attributes:
    index: of the skin
    smooth: its surface, of the organ's vertices
    height: of each vertex over that surface [m]        (n,)
    adr: its first vertex
    bone: its only one
    groups: of the skin and of the organ's own surface, as compiled
  """

  index: int
  smooth: Smooth
  height: np.ndarray
  adr: int
  bone: int
  groups: tuple[int, int]


def read(m: mjstruct.Struct, organ: Declaration) -> Skin | None:
  """Returns the skin that an organ's configuration names, or None.

  Raises:
    ValueError: there is none of that name, or it is not the organ's surface divided.
  """
  if not organ.config.skin:
    return None
  names = flexes.names(m, "skin")
  name = flexes.resolve(organ.config.skin, organ.name, names)
  if name is None:
    have = ", ".join(repr(each) for each in names) or "none"
    raise ValueError(
      f"organ {organ.name!r}: skin is {organ.config.skin!r}, the model has {have}; see "
      "palpate.add_skin"
    )
  k, who = names.index(name), f"organ {organ.name!r}: skin {name!r}"
  adr, count = int(m.skin_vertadr[k]), int(m.skin_vertnum[k])
  # MuJoCo's triangles: those of the physics may have other diagonals.
  elem = organ.mesh.elem if organ.mesh.spare else flexes.elements(m, organ.flex)
  sizes = subdivide.counts(elem)
  if count not in sizes:
    choices = ", ".join(map(str, sizes))
    raise ValueError(
      f"{who} has {count} vertices, expected one of {choices}: the organ's triangles divided in "
      "four once, twice, ...; see palpate.add_skin"
    )
  smooth = subdivide.smooth(elem, subdivide.LEVELS[sizes.index(count)])
  first = int(m.skin_faceadr[k])
  face = m.skin_face[first : first + int(m.skin_facenum[k])]
  if not np.array_equal(face, smooth.elem):
    raise ValueError(f"{who} has other triangles than the organ's divided in four")
  bones, bone = int(m.skin_bonenum[k]), int(m.skin_boneadr[k])
  held = int(m.skin_bonevertnum[bone])
  if bones != 1 or held != count:
    raise ValueError(f"{who} has {bones} bones, expected one that has all vertices")
  groups = int(m.skin_group[k]), int(m.flex_group[organ.flex])
  rest = organ.mesh.rest[: organ.mesh.nouter]
  return Skin(k, smooth, _height(m, adr, smooth, rest), adr, bone, groups)


def _height(m: mjstruct.Struct, adr: int, smooth: Smooth, rest: np.ndarray) -> np.ndarray:
  """Returns how far the skin's vertices, as they are declared, lie above the smooth surface [m].

  Both are in the frame of the body that the organ is in; a skin is bound to that.
  """
  base = smooth(rest)
  declared = m.skin_vert[adr : adr + len(base)]
  return np.einsum("ij,ij->i", declared - base, topology.vertex_normals(base, smooth.elem))


def place(skin: Skin, vertices: np.ndarray) -> np.ndarray:
  """Returns where a skin's vertices are, of the organ's; both in the world [m]  (n, 3)."""
  base = skin.smooth(vertices)
  if not skin.height.any():
    return base
  return base + skin.height[:, None] * topology.vertex_normals(base, skin.smooth.elem)


def draw(w: Workspace, model: int, data: int):
  """Writes an organ's skin where renderers read it, from `flexvert_xpos`."""
  m, d = mjstruct.both(model, data)
  organ, skin = w.organ, w.skin
  assert skin is not None
  start = int(m.flex_vertadr[organ.flex])
  fine = place(skin, d.flexvert_xpos[start : start + organ.mesh.nouter])
  # MuJoCo moves the vertices from where they are bound to where the bone is: this takes it back.
  body = int(m.skin_bonebodyid[skin.bone])
  turn = flexes.matrix(m.skin_bonebindquat[skin.bone])
  bound = (fine - d.xpos[body]) @ d.xmat[body].reshape(3, 3) @ turn.T
  bound += m.skin_bonebindpos[skin.bone]
  m.skin_vert[skin.adr : skin.adr + len(fine)] = bound


def show(w: Workspace, model: int, shown: bool):
  """Draws the skin, or the organ's own surface in its place, as where its triangles change."""
  assert w.skin is not None
  usual, hidden = w.skin.groups
  groups = (usual, hidden) if shown else (hidden, usual)
  prepare.group(mjstruct.model(model), w.skin.index, w.organ.flex, groups)
