"""What a camera sees of a compiled scene: things, and the surfaces that they have.

A thing is a geom, a site, a skin or a flex, as MuJoCo's renderer draws it: those of groups 0 to 2.
What belongs to the world is one surface; what belongs to another body is one surface that moves
with it; sites, and what one can look through, are surfaces of their own, of which a world may
change place, size and colour. Organs are in `soft`.
"""

import dataclasses
from collections.abc import Mapping

import mujoco
import numpy as np
from palpate.engine.model import flexes

from . import shapes, textures
from .shapes import Triangles

_OBJ = mujoco.mjtObj
_RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
SEEN = 3  # groups that are drawn
_OPAQUE = 0.995  # MuJoCo's
_PLAIN = np.array([0.5, 0.5, 0.5, 1.0], np.float32)  # a colour that leaves a material its own


@dataclasses.dataclass
class Thing:
  """A thing that is drawn.

  Attributes:
    kind: mjtObj
    id: number of that kind
    rgba: its colour as compiled                               (4,)
    where: where a model has its colour and texture: kind, number, its material as compiled or -1
    gloss: emission, specular share, exponent of the specular  (3,)
    tex: its texture, -1 for none
    repeat: of the texture                                     (2,)
    uniform: whether that is a metre
  """

  kind: int
  id: int
  rgba: np.ndarray
  where: tuple[int, int, int]
  gloss: np.ndarray
  tex: int
  repeat: np.ndarray
  uniform: bool


@dataclasses.dataclass
class Part:
  """A surface that moves with a body.

  Attributes:
    surface: in the frame of the part
    thing: of each triangle
    body: its body
    pos: in the frame of the body [m]
    mat: axes there                (3, 3)
    size: scale along its axes
    clear: whether one may look through it
    site: its number, -1 for none
  """

  surface: Triangles
  thing: np.ndarray
  body: int
  pos: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
  mat: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
  size: np.ndarray = dataclasses.field(default_factory=lambda: np.ones(3))
  clear: bool = False
  site: int = -1


class Scene:
  """The things of a model and their surfaces.

  Args:
    model: the compiled scene
    organs: skins and flexes that are organs', by kind and number: they are left to `soft`

  Attributes:
    things: what is drawn
    parts: surfaces of bodies; the first is the world's, a triangle without area where it has none
    texels: textures, see `textures.pack`
    images: where these are
    sky: texture of the sky, -1 for none

  Raises:
    ValueError: the scene has a thing that a camera of a batch cannot draw.
  """

  def __init__(self, model: mujoco.MjModel, organs: set[tuple[int, int]]):
    self._model, self.things, self.parts = model, list[Thing](), list[Part]()
    self._solid: dict[int, list[tuple[Triangles, int]]] = {0: []}
    for g in range(model.ngeom):
      self._add_geom(g)
    for k in range(model.nskin):
      if (int(_OBJ.mjOBJ_SKIN), k) not in organs:
        self._add_skin(k)
    for f in range(model.nflex):
      if (int(_OBJ.mjOBJ_FLEX), f) not in organs and model.flex_group[f] < SEEN:
        name = mujoco.mj_id2name(model, _OBJ.mjOBJ_FLEX, f)
        raise ValueError(f"flex {name!r} is no organ's; a camera of a batch draws organs alone")
    clear = self.parts
    self._solid[0] = self._solid[0] or [(_NOTHING, 0)]
    self.parts = [
      Part(
        shapes.joined([s for s, _ in found]),
        np.repeat([k for _, k in found], [len(s.face) for s, _ in found]),
        body,
      )
      for body, found in self._solid.items()
    ] + clear
    for s in range(model.nsite):
      self._add_site(s)
    self.texels, self.images = textures.pack([textures.image(model, k) for k in range(model.ntex)])
    skies = np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    self.sky = int(skies[0]) if len(skies) else -1

  def thing(self, kind: int, number: int, material: int) -> int:
    """Returns the number of a thing that has a material, -1 for none."""
    m, where = self._model, (int(kind), number, material)
    gloss, tex, repeat, uniform = np.array([0.0, 0.5, 0.5]), -1, np.ones(2), False
    if material >= 0:
      gloss = np.array([m.mat_emission[material], m.mat_specular[material],
                        m.mat_shininess[material]])  # fmt: skip
      tex, uniform = texture(m, *where), bool(m.mat_texuniform[material])
      repeat = m.mat_texrepeat[material].astype(float)
    gloss[2] *= 128.0  # OpenGL's
    rgba = colour(m, *where)
    self.things.append(Thing(int(kind), number, rgba, where, gloss, tex, repeat, uniform))
    return len(self.things) - 1

  def _add_geom(self, g: int):
    m, kind = self._model, int(self._model.geom_type[g])
    if not 0 <= m.geom_group[g] < SEEN:
      return
    k = self.thing(_OBJ.mjOBJ_GEOM, g, int(m.geom_matid[g]))
    thing = self.things[k]
    if not thing.rgba[3]:
      return
    size = m.geom_size[g]
    if kind in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_SDF):
      surface = shapes.mesh(m, int(m.geom_dataid[g]))
      known = m.mesh_texcoordadr[m.geom_dataid[g]] >= 0
    else:
      try:
        surface, known = shapes.primitive(m, kind, size), True
      except ValueError as error:
        raise ValueError(f"{_name(m, _OBJ.mjOBJ_GEOM, g)}: {error}") from None
    surface = self._coords(thing, surface, size, known, kind)
    surface = surface.moved(m.geom_pos[g], flexes.matrix(m.geom_quat[g]))
    body = int(m.geom_bodyid[g])
    if thing.rgba[3] < _OPAQUE:
      self.parts.append(Part(surface, np.full(len(surface.face), k), body, clear=True))
    else:
      self._solid.setdefault(body, []).append((surface, k))

  def _coords(self, thing: Thing, surface: Triangles, size, known: bool, kind: int) -> Triangles:
    """Returns a surface whose texture coordinates are those of its material."""
    m, scale = self._model, repeat(thing)
    coord = surface.coord.copy()
    if thing.tex < 0:
      return surface
    if m.tex_type[thing.tex] != mujoco.mjtTexture.mjTEXTURE_2D:
      unit = np.ones(3) if kind == mujoco.mjtGeom.mjGEOM_MESH else _full(kind, size)
      coord = surface.vert[surface.face] / unit * (_full(kind, size) if thing.uniform else 1.0)
    elif known:
      scale = scale * np.where((size[:2] > 0) & thing.uniform, size[:2], 1.0)
      endless = kind == mujoco.mjtGeom.mjGEOM_PLANE and (size[:2] <= 0).any()
      coord[..., :2] = coord[..., :2] * scale - 0.5 * endless
    else:
      full = np.maximum(size[:2], 1e-15)
      scale = thing.repeat / full * (full if thing.uniform else 1.0)
      coord[..., :2] = coord[..., :2] * (0.5 * scale * [1, -1]) - 0.5
    return dataclasses.replace(surface, coord=coord)

  def _add_skin(self, k: int):
    """Adds a skin that moves with one body."""
    m = self._model
    if not 0 <= m.skin_group[k] < SEEN:
      return
    bone = int(m.skin_boneadr[k])
    if m.skin_bonenum[k] != 1 or m.skin_bonevertnum[bone] != m.skin_vertnum[k]:
      raise ValueError(
        f"{_name(m, _OBJ.mjOBJ_SKIN, k)} has {m.skin_bonenum[k]} bones; a camera of a batch draws "
        "skins of organs, and of one bone that has all vertices"
      )
    number = self.thing(_OBJ.mjOBJ_SKIN, k, int(m.skin_matid[k]))
    vert, face, texcoord = skin(m, k)
    vert = (vert - m.skin_bonebindpos[bone]) @ flexes.matrix(m.skin_bonebindquat[bone])
    if m.skin_inflate[k]:
      raise ValueError(f"{_name(m, _OBJ.mjOBJ_SKIN, k)} is inflated, expected inflate 0")
    if texcoord is not None:
      texcoord = texcoord * repeat(self.things[number])
    surface = shapes.smooth(vert, face, texcoord)
    body = int(m.skin_bonebodyid[bone])
    self._solid.setdefault(body, []).append((surface, number))

  def _add_site(self, s: int):
    m = self._model
    if not 0 <= m.site_group[s] < SEEN:
      return
    k = self.thing(_OBJ.mjOBJ_SITE, s, int(m.site_matid[s]))
    kind, size, full = int(m.site_type[s]), m.site_size[s], site_size(m, s)
    unit = size / full
    surface = shapes.primitive(m, kind, unit)
    self.parts.append(
      Part(
        self._coords(self.things[k], surface, unit, True, kind), np.full(len(surface.face), k),
        int(m.site_bodyid[s]), m.site_pos[s].copy(), flexes.matrix(m.site_quat[s]), full, True, s,
      )
    )  # fmt: skip

  def density(self, surface: Triangles, thing: np.ndarray) -> np.ndarray:
    """Returns texels a metre of each triangle, 0 where it has no texture  (nface,)."""
    tex = np.array([self.things[k].tex for k in thing], int).reshape(len(thing))
    a, b, c = np.moveaxis(surface.vert[surface.face], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    u, v, w = np.moveaxis(surface.coord, 1, 0)
    own = np.linalg.norm(np.cross(v - u, w - u), axis=1)
    if not len(self.images):
      return np.zeros(len(thing))
    kind, width, height = self.images[tex, :3].T
    own = np.where(kind == textures.CUBE, own / 4, own) * width * height
    return np.where(tex >= 0, np.sqrt(own / np.maximum(area, 1e-18)), 0.0)


_NOTHING = Triangles(
  np.zeros((3, 3)), np.array([[0, 1, 2]]), np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
)


def site_size(m: mujoco.MjModel, s: int) -> np.ndarray:
  """Returns the size of a site's part: of each axis, or one where its shape is kept  (3,)."""
  stretched = m.site_type[s] in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID)
  return np.array(m.site_size[s]) if stretched else np.full(3, m.site_size[s, 0])


def skin(m: mujoco.MjModel, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
  """Returns vertices as declared [m], triangles and texture coordinates of a skin."""
  vert, face = (
    values[adr[k] : adr[k] + num[k]]
    for values, adr, num in (
      (m.skin_vert, m.skin_vertadr, m.skin_vertnum), (m.skin_face, m.skin_faceadr, m.skin_facenum)
    )
  )  # fmt: skip
  start = m.skin_texcoordadr[k]
  texcoord = m.skin_texcoord[start : start + len(vert)].astype(float) if start >= 0 else None
  return vert.astype(float), face, texcoord


def _material(m: mujoco.MjModel, kind: int, number: int, material: int) -> int:
  """Returns the material that a thing has in a model, -1 for none."""
  now = {
    int(_OBJ.mjOBJ_GEOM): m.geom_matid, int(_OBJ.mjOBJ_SITE): m.site_matid,
    int(_OBJ.mjOBJ_SKIN): m.skin_matid, int(_OBJ.mjOBJ_FLEX): m.flex_matid,
  }[kind]  # fmt: skip
  return int(now[number]) if material >= 0 else -1


def texture(m: mujoco.MjModel, kind: int, number: int, material: int) -> int:
  """Returns the texture that a thing has in a model, -1 for none."""
  material = _material(m, kind, number, material)
  return int(m.mat_texid[material, _RGB]) if material >= 0 else -1


def colour(m: mujoco.MjModel, kind: int, number: int, material: int) -> np.ndarray:
  """Returns the colour that a thing has in a model: its own, or that of its material  (4,)."""
  material = _material(m, kind, number, material)
  own = {
    int(_OBJ.mjOBJ_GEOM): m.geom_rgba, int(_OBJ.mjOBJ_SITE): m.site_rgba,
    int(_OBJ.mjOBJ_SKIN): m.skin_rgba, int(_OBJ.mjOBJ_FLEX): m.flex_rgba,
  }[kind][number]  # fmt: skip
  return np.array(m.mat_rgba[material] if material >= 0 and (own == _PLAIN).all() else own)


def labelled(things: list[Thing], labels: Mapping[tuple[int, int], int]) -> np.ndarray:
  """Returns the label of each thing, 0 for those without one."""
  return np.array([labels.get((thing.kind, thing.id), 0) for thing in things], np.int32)


def repeat(thing: Thing) -> np.ndarray:
  """Returns how often a thing's texture repeats along its coordinates  (2,)."""
  return np.where(thing.repeat > 0, thing.repeat, 1.0)


def _full(kind: int, size: np.ndarray) -> np.ndarray:
  """Returns the half sizes that a shape's unit one is drawn with."""
  if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
    return np.full(3, size[0])
  if kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
    return np.array([size[0], size[0], size[1]])
  return np.where(size > 0, size, 1.0)


def _name(m: mujoco.MjModel, kind, k: int) -> str:
  what = mujoco.mjtObj(int(kind)).name.removeprefix("mjOBJ_").lower()
  return f"{what} {mujoco.mj_id2name(m, kind, k) or k!r}"
