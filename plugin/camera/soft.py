"""Organs as a camera sees them: surfaces whose vertices follow the organ's linearly.

A skin is the smooth surface through the organ's vertices. Without one, or once cuts have changed
the triangles, the organ's own surface is drawn, a flex's radius outside, as MuJoCo draws a flex; a
sheet has two sides, and so has a closed one that can be cut open.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.engine import layout
from palpate.engine.model import flexes, mjstruct
from palpate.engine.model.skin import Skin
from palpate.tissue.geometry import subdivide
from palpate.tissue.geometry.mesh import Mesh, corners, opened, vertex_normals
from palpate.tissue.types import fill
from scipy.sparse import csr_array, eye_array

from .host import Seen
from .scene import SEEN, Scene, repeat, skin
from .shapes import Triangles, smooth
from .view import Soft

_OBJ = mujoco.mjtObj
_FAINT = 1e-3  # weights of vertices that a smooth surface does without


@dataclasses.dataclass
class Sheet:
  """A side of an organ's surface.

  Attributes:
    base: vertices at rest [m]                                   (n, 3)
    weight: of the organ's vertices in the displacement of each  (n, nvert)
    texcoord: of the corners of its triangles                    (nface, 3, 2)
    above: how far the vertices lie outside [m]
    thing: number of the thing
  """

  base: np.ndarray
  weight: csr_array
  texcoord: np.ndarray
  above: float
  thing: int


class Surface:
  """An organ's surface in the rows of a camera.

  Its triangles are those of a skin, then those of the organ's own surface: its front, of a sheet
  its back and the rim between them; and room for the walls of cuts. Those that are not drawn have
  no area.

  Args:
    tissue: the organ in a batch
    model: the compiled scene
    scene: its things, to which those of the organ are added
    detail: the most levels of a skin's division

  Attributes:
    nvert: vertices of a row
    face: triangles of a row before the first cut, of these vertices  (nface, 3)
    thing: of each triangle
    lip: thing at the lips of cuts, -1 for none
    flat: whether the normal is the triangle's
    coord: texture coordinates of the corners  (nface, 3, 3)
    base: vertices at rest [m]                 (nvert, 3)
  """

  def __init__(self, tissue: Seen, model: mujoco.MjModel, scene: Scene, detail: int):
    self.tissue, space = tissue, tissue.space
    self._organ = organ = space.organ
    self._mesh: Mesh = organ.mesh
    self._rest = organ.origin + organ.mesh.rest @ organ.frame.T
    self._sheets, self._skin = list[Sheet](), np.zeros((0, 3), int)
    self._own, self._flat, self._walls, lip = np.zeros((0, 3), int), False, 0, -1
    seen = int(model.flex_group[organ.flex]) < SEEN
    if space.skin is not None and (space.skin.groups[0] < SEEN or not organ.mesh.spare):
      seen = organ.mesh.spare > 0
      self._add_skin(model, scene, space.skin, detail)
    if seen:
      self._add_flex(model, scene)
      lip = self._open(model, scene)
    self.face = self._faces(organ.mesh)
    self.nvert = sum(len(s.base) for s in self._sheets)
    if not self._sheets:
      return
    self.base = np.concatenate([s.base for s in self._sheets])
    counts = [len(s.texcoord) for s in self._sheets]
    self.thing = np.repeat([s.thing for s in self._sheets], counts)
    coord = [s.texcoord * repeat(scene.things[s.thing]) for s in self._sheets]
    self.coord = np.pad(np.concatenate(coord), ((0, 0), (0, 0), (0, 1)))
    self.flat = np.arange(len(self.face)) >= len(self.face) - self._walls
    self.thing[self.flat] = lip
    self.lip = np.where(self.flat, -1, lip)

  def _add_skin(self, model: mujoco.MjModel, scene: Scene, made: Skin, detail: int):
    """Adds the organ's skin, or the same with fewer triangles."""
    coarse, level = made.smooth.elem, 0
    while int(coarse.max()) + 1 > self._mesh.nouter:
      # `subdivide` has divided each triangle in four.
      coarse = np.stack([coarse[0::4, 0], coarse[1::4, 1], coarse[2::4, 2]], axis=1)
      level += 1
    fine, k = subdivide.smooth(coarse, min(level, detail)), made.index
    thing = scene.thing(_OBJ.mjOBJ_SKIN, k, int(model.skin_matid[k]))
    base, above = fine(self._rest[: self._mesh.nouter]), made.height[: fine.count]
    if above.any():
      base = base + above[:, None] * vertex_normals(base, fine.elem)
    texcoord = skin(model, k)[2]
    coord = np.zeros((*fine.elem.shape, 2)) if texcoord is None else texcoord[fine.elem]
    self._sheets.append(Sheet(base, fine.weights(_FAINT), coord, 0.0, thing))
    self._skin = fine.elem

  def _add_flex(self, model: mujoco.MjModel, scene: Scene):
    """Adds the organ's own surface."""
    mesh, flex = self._mesh, self._organ.flex
    self._own = elem = mesh.elem if mesh.spare else flexes.elements(model, flex)
    material, start = int(model.flex_matid[flex]), int(model.flex_texcoordadr[flex])
    thing = scene.thing(_OBJ.mjOBJ_FLEX, flex, material)
    coord = np.zeros((*elem.shape, 2))
    if start >= 0:
      data = int(model.flex_elemdataadr[flex])
      at = model.flex_elemtexcoord[data : data + elem.size].reshape(elem.shape)
      coord = model.flex_texcoord[start + at].astype(float)
    else:
      scene.things[thing].tex = -1
    count, radius = mesh.nskin, float(model.flex_radius[flex])
    one = csr_array(eye_array(count))
    front = Sheet(self._rest[:count], one, coord, radius, thing)
    self._sheets.append(front)
    self._flat = not len(mesh.tet) and (not mesh.closed or mesh.spare > 0)
    if self._flat:
      rim = np.flatnonzero(mesh.twin < 0)
      edge = np.repeat(coord.reshape(-1, 2)[rim][:, None], 3, axis=1)
      back = np.concatenate([coord[:, [0, 2, 1]], edge, edge])
      self._sheets.append(dataclasses.replace(front, texcoord=back))

  def _open(self, model: mujoco.MjModel, scene: Scene) -> int:
    """Makes room for what cuts open; returns the number of its thing, -1 for none."""
    m, organ = mjstruct.model(model._address), self._organ
    walls = organ.config.walls
    flex = flexes.find(m, "flex", walls, organ.name) if walls else -1
    if flex < 0:
      return -1
    if len(organ.mesh.tet) or self._flat:
      each = layout.WALLS if len(organ.mesh.tet) else 2 * layout.LIPS
      self._walls = each * organ.mesh.spare
      room = np.zeros((self._walls, 3, 2))
      own = self._sheets[-1]
      own.texcoord = np.concatenate([own.texcoord, room])
    return scene.thing(_OBJ.mjOBJ_FLEX, flex, -1)

  def _faces(self, mesh: Mesh, both: bool = False) -> np.ndarray:
    """Returns the triangles where the organ has a mesh; with `both` those of skin and organ."""
    fine, whole = self._skin, mesh.whole
    first = int(fine.max()) + 1 if len(fine) else 0
    if not len(self._own):
      return fine
    cut = mesh is not whole and not both
    elem = mesh.elem[: whole.nelem] if mesh.spare else self._own
    parts, walls = [fine * (not cut), elem + first], mesh.elem[whole.nelem :]
    if self._flat:
      parts.append(elem[:, [0, 2, 1]] + mesh.nskin + first)
      parts.append(_rim(mesh, np.flatnonzero(whole.twin < 0)) + first)
      walls = _rim(mesh, opened(mesh))
    if self._walls:
      room = np.zeros((self._walls, 3), int)
      room[: len(walls)] = walls[: self._walls] + first
      parts.append(room)
    if len(fine) and not cut and not both:
      parts[1:] = [0 * part for part in parts[1:]]
    return np.concatenate(parts)

  @property
  def _smooth(self) -> np.ndarray:
    """Which triangles normals follow, rather than rims and walls  (nface,)."""
    found, nelem, start = np.zeros(len(self.thing), bool), len(self._own), len(self._skin)
    found[: start + nelem * (1 + self._flat)] = True
    return found

  @property
  def triangles(self) -> Triangles:
    """The surface at rest."""
    return dataclasses.replace(smooth(self.base, self.face, None), coord=self.coord)

  def make(self, worlds: wp.array, first: int, start: int, shared: dict[str, Any]) -> Any:
    """Returns what the kernels take.

    Args:
      worlds: worlds of the rows
      first: number of its first vertex in a row
      start: of its first triangle
      shared: what all organs' surfaces have in one, by field of `Soft`
    """
    n, nrow, device = self.nvert, len(worlds), worlds.device
    weight = [s.weight for s in self._sheets]
    corner = np.where(self._smooth[:, None], self._faces(self._mesh, both=True), n).ravel()
    values = dict(
      first=first, stride=len(shared["point"]) // nrow, world=worlds, x=self.tissue.xpos,
      rest=self._rest[: self.tissue.nvert], base=self.base,
      adr=np.concatenate([[0], *(np.diff(w.indptr) for w in weight)]).cumsum(),
      col=np.concatenate([w.indices for w in weight]),
      weight=np.concatenate([w.data for w in weight]),
      ring_adr=np.concatenate([[0], np.bincount(corner, minlength=n)[:n].cumsum()]),
      ring=np.argsort(corner, kind="stable")[: (corner < n).sum()] // 3 + start,
      above=np.repeat([s.above for s in self._sheets], [len(s.base) for s in self._sheets]),
      source=np.tile(np.arange(n), (nrow if self._mesh.spare else 1, 1)),
      raw=wp.zeros((nrow, n), dtype=wp.vec3, device=device), **shared,
    )  # fmt: skip
    self._soft, self._start = fill(Soft, device, values), start
    self._known = [self._mesh] * nrow
    return self._soft

  def follow(self, worlds: Sequence[int], lips: wp.array):
    """Follows the cuts of worlds since the last call.

    Args:
      worlds: of the rows
      lips: see `View`
    """
    if not self._mesh.spare:
      return
    meshes = self.tissue.meshes()
    for row, world in enumerate(worlds):
      mesh = meshes[world]
      if mesh is not self._known[row]:
        self._known[row] = mesh
        self._become(row, mesh, lips)

  def _become(self, row: int, mesh: Mesh, lips: wp.array):
    """Writes the triangles of a row."""
    soft, whole = self._soft, mesh.whole
    face, before = self._faces(mesh), self._faces(whole, both=True)
    _write(soft.corner, row, self._start, face + row * soft.stride + soft.first)
    source = np.arange(self.nvert, dtype=np.int32)
    smooth = self._smooth & (face != face[:, :1]).any(axis=1)
    source[face[smooth]] = before[smooth]
    _write(soft.source, row, 0, source)
    lip, at_lip = np.zeros((6, len(self._own)), np.uint8), np.zeros(mesh.nvert, bool)
    half = opened(mesh)
    lip[half % 3, half // 3] = 1
    at_lip[corners(mesh, half, 0)] = at_lip[corners(mesh, half, 1)] = True
    lip[3:] = at_lip[mesh.elem[: len(self._own)]].T
    sides, first = np.zeros(len(face), np.uint8), len(self._skin)
    for k, weight in enumerate([(1, 2, 4, 8, 16, 32), (4, 2, 1, 8, 32, 16)][: 1 + self._flat]):
      at = slice(first + k * len(self._own), first + (k + 1) * len(self._own))
      sides[at] = np.dot(weight, lip)
    _write(lips, row, self._start, np.where(self.lip >= 0, sides, 0).astype(np.uint8))


def _write(out: wp.array, row: int, start: int, values: np.ndarray):
  """Writes values to a row of an array, from a place on."""
  source = wp.array(np.ascontiguousarray(values), dtype=out.dtype, device=out.device)
  wp.copy(out, source, row * (out.size // out.shape[0]) + start * values[0].size, 0, values.size)


def _rim(mesh: Mesh, half: np.ndarray) -> np.ndarray:
  """Returns the triangles between both sides of a sheet along half-edges  (2 n, 3)."""
  a, b = corners(mesh, half, 0), corners(mesh, half, 1)
  back = mesh.nskin
  return np.concatenate([np.stack([b, a, a + back], 1), np.stack([b, a + back, b + back], 1)])
