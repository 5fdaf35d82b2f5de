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
  adr, count = (
    int(mjstruct.view(each, m.nskin, np.int32)[k]) for each in (m.skin_vertadr, m.skin_vertnum)
  )
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
  first, faces = (
    int(mjstruct.view(each, m.nskin, np.int32)[k]) for each in (m.skin_faceadr, m.skin_facenum)
  )
  face = mjstruct.view(m.skin_face, (m.nskinface, 3), np.int32)[first : first + faces]
  if not np.array_equal(face, smooth.elem):
    raise ValueError(f"{who} has other triangles than the organ's divided in four")
  bones = int(mjstruct.view(m.skin_bonenum, m.nskin, np.int32)[k])
  bone = int(mjstruct.view(m.skin_boneadr, m.nskin, np.int32)[k])
  held = int(mjstruct.view(m.skin_bonevertnum, m.nskinbone, np.int32)[bone])
  if bones != 1 or held != count:
    raise ValueError(f"{who} has {bones} bones, expected one that has all vertices")
  group = int(mjstruct.view(m.skin_group, m.nskin, np.int32)[k])
  own = int(mjstruct.view(m.flex_group, m.nflex, np.int32)[organ.flex])
  rest = organ.mesh.rest[: organ.mesh.nouter]
  return Skin(k, smooth, _height(m, adr, smooth, rest), adr, bone, (group, own))


def _height(m: mjstruct.Struct, adr: int, smooth: Smooth, rest: np.ndarray) -> np.ndarray:
  """Returns how far the skin's vertices, as they are declared, lie above the smooth surface [m].

  Both are in the frame of the body that the organ is in; a skin is bound to that.
  """
  base = smooth(rest)
  declared = mjstruct.view(m.skin_vert, (m.nskinvert, 3), np.float32)[adr : adr + len(base)]
  return np.einsum("ij,ij->i", declared - base, topology.vertex_normals(base, smooth.elem))


def place(skin: Skin, vertices: np.ndarray) -> np.ndarray:
  """Returns where a skin's vertices are, of the organ's; both in the world [m]  (n, 3)."""
  base = skin.smooth(vertices)
  if not skin.height.any():
    return base
  return base + skin.height[:, None] * topology.vertex_normals(base, skin.smooth.elem)


def draw(w: Workspace, model: int, data: int):
  """Writes an organ's skin where renderers read it, from `flexvert_xpos`."""
  m, d = mjstruct.Model.from_address(model), mjstruct.Data.from_address(data)
  organ, skin = w.organ, w.skin
  assert skin is not None
  start = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[organ.flex])
  n = organ.mesh.nouter
  coarse = mjstruct.view(d.flexvert_xpos, (m.nflexvert, 3))[start : start + n]
  fine = place(skin, coarse)
  # MuJoCo moves the vertices from where they are bound to where the bone is: this takes it back.
  body = int(mjstruct.view(m.skin_bonebodyid, m.nskinbone, np.int32)[skin.bone])
  pos = mjstruct.view(d.xpos, (m.nbody, 3))[body]
  mat = mjstruct.view(d.xmat, (m.nbody, 9))[body].reshape(3, 3)
  turn = mjstruct.view(m.skin_bonebindquat, (m.nskinbone, 4), np.float32)[skin.bone]
  bound = (fine - pos) @ mat @ flexes.matrix(turn).T
  bound += mjstruct.view(m.skin_bonebindpos, (m.nskinbone, 3), np.float32)[skin.bone]
  out = mjstruct.view(m.skin_vert, (m.nskinvert, 3), np.float32)
  out[skin.adr : skin.adr + len(fine)] = bound


def show(w: Workspace, model: int, shown: bool):
  """Draws the skin, or the organ's own surface in its place, as where its triangles change."""
  assert w.skin is not None
  usual, hidden = w.skin.groups
  groups = (usual, hidden) if shown else (hidden, usual)
  prepare.group(mjstruct.Model.from_address(model), w.skin.index, w.organ.flex, groups)
