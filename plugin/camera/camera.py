"""A camera of a batch: pictures of all worlds, or of some."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import warp as wp
from palpate.engine.model import flexes
from palpate.tissue.device import refuse_crowd, room_of
from palpate.tissue.types import DIMS, allocate, blank, fill

from . import filling, shading
from .host import Host
from .lens import Lens, lens, see
from .scene import Scene, colour, labelled, site_size, texture
from .soft import Surface
from .view import NOTHING, Pictures, View

if TYPE_CHECKING:
  from palpate.engine.model.declare import Declaration

_OBJ, _LIGHT = mujoco.mjtObj, mujoco.mjtLightType
OUTPUTS = tuple(Pictures.vars)
_MOVED = ("eye", "look", "to_eye", "from_eye")  # what a flow is found from, beside points
_OF_ROWS = ("lamp_pos", "lamp_dir", "ambient", "diffuse", "specular")
MOST = 1024  # height and width [pixels]
_VERTEX, _TRIANGLE = 36.0, 13.0  # bytes that a row has for those of organs
_BLOCK = 64  # threads of a block
_SOME = 2**22  # pixels whose nearest triangles are kept at a time
_LITTLE = 64  # pixels; a thread of a GPU goes through twice as many around a triangle
_TILE = 32  # pixels that are drawn side by side
_FINE = 128  # height of a picture from which skins are as fine as they are declared [pixels]


class Camera:
  """A camera in worlds of a batch; `Batch.camera` makes it.

  Attributes:
    pictures: arrays of the last `draw` by name, a row a world; they keep their place
    worlds: numbers of the worlds
    view: what the kernels read, a row a world, see `View`
    lens: what pictures are seen through, see `lens`; None for nothing
  """

  def __init__(
    self,
    batch: Host,
    name: str,
    height: int,
    width: int,
    outputs: Sequence[str] = ("pixels",),
    worlds: Sequence[int] | None = None,
    labels: Mapping[tuple[int, int], int] | None = None,
    shift: Sequence[float] | None = None,
    through: bool = False,
  ):
    """Makes the camera; what is not said here is as in `Batch.camera`.

    Args:
      batch: the worlds
      name: of the camera
      height: of a picture [pixels]
      width: the same
      outputs: some of OUTPUTS
      worlds: of each row, which may have one several times
      labels: of what has one in `labels`, by its `mjtObj` and number
      shift: of the lens of each row to the right [m]; None for none
      through: whether pictures are seen through a `lens`
    """
    model = batch.model
    self._batch, self.worlds = batch, [*range(batch.nworld)] if worlds is None else [*worlds]
    camera = _camera(model, name)
    size = _size(height, width)
    unknown = [each for each in outputs if each not in OUTPUTS]
    if unknown or not outputs:
      raise ValueError(f"outputs is {outputs!r}, expected some of {', '.join(OUTPUTS)}")
    if not self.worlds:
      raise ValueError(f"worlds is {worlds!r}, expected one or more")
    for world in self.worlds:
      batch.index(world)
    self._device, self._number, self._bodies = batch.device, camera, batch.poses()[2]
    organs = {
      (int(_OBJ.mjOBJ_FLEX), f) for tissue in batch.organs.values()
      for f in _flexes(tissue.space.organ, model)
    } | {
      (int(_OBJ.mjOBJ_SKIN), tissue.space.skin.index)
      for tissue in batch.organs.values() if tissue.space.skin is not None
    }  # fmt: skip
    self.scene = Scene(model, organs)
    detail = 4 if size[0] > _FINE else 1
    self._surfaces = [
      Surface(tissue, model, self.scene, detail) for tissue in batch.organs.values()
    ]
    self._surfaces = [each for each in self._surfaces if each.nvert]
    self._refuse_crowd(size, outputs, 2 if through else 1)
    values = self._allocate(size)
    values["out"] = self._pictures(size, outputs)
    values["shift"] = np.zeros(len(self.worlds)) if shift is None else np.array(shift, float)
    values |= self._things(labels) | self._parts() | self._organs(values)
    values |= self._view(model, camera)
    values |= {f"{n}_before": blank(View, f"{n}_before", self._device) for n in _MOVED}
    self.view: Any = fill(View, self._device, values)
    for name in _MOVED if "flow" in outputs else ():
      setattr(self.view, f"{name}_before", wp.zeros_like(getattr(self.view, name)))
    self.lens = self._through(size, outputs) if through else None
    shown = self.view.out if self.lens is None else self.lens.seen
    self.pictures: dict[str, Any] = {name: getattr(shown, name) for name in outputs}

  # Making.

  def _refuse_crowd(self, size: tuple[int, int], outputs: Sequence[str], times: int):
    """Raises ValueError where there is no room for so many pictures, each kept so many times."""
    pixel = times * sum(
      wp.types.type_size_in_bytes(Pictures.vars[name].type.dtype)
      * int(np.prod(DIMS[Pictures.key][name][3:]))
      for name in outputs
    )
    each = size[0] * size[1] * pixel + 160.0 * (len(self.scene.things) + len(self.scene.parts))
    each += sum(_VERTEX * s.nvert + _TRIANGLE * len(s.face) for s in self._surfaces)
    refuse_crowd(
      len(self.worlds), each, room_of(self._device), str(self._device), "worlds to draw are"
    )

  def _pictures(self, size: tuple[int, int], outputs: Sequence[str]) -> Any:
    sizes = {"nrow": len(self.worlds), "height": size[0], "width": size[1]}
    spare = tuple(name for name in OUTPUTS if name not in outputs)
    return allocate(Pictures, self._device, sizes, spare)

  def _allocate(self, size: tuple[int, int]) -> dict[str, Any]:
    n = len(self.worlds)
    values: dict[str, Any] = {"height": size[0], "width": size[1]}
    values["world"] = wp.array(self.worlds, dtype=int, device=self._device)
    values["chosen"] = wp.full(n, True, dtype=wp.bool, device=self._device)
    some = min(n, -(-_SOME // (size[0] * size[1])))
    through = some * any(part.clear for part in self.scene.parts)
    for name, rows in (("solid", some), ("clear", through)):
      values[name] = wp.full((rows, *size), NOTHING, dtype=wp.uint64, device=self._device)
    large = -(-size[0] * size[1] // _LITTLE) if self._device.is_cuda else 0
    values |= {"little": 2 * _LITTLE if large else MOST * MOST, "nlarge": np.zeros(n, np.int32)}
    values["large"] = np.zeros((some, large, 3), np.int32)
    return values

  def _rows(self, values: Any) -> np.ndarray:
    """Returns an array with a row for every world, all the same."""
    values = np.asarray(values, np.float32)
    return np.tile(values, (len(self.worlds), *[1] * values.ndim))

  def look(self, m: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Returns what a row has of its own of cameras, lamps and colours where a model has changed.

    Args:
      m: the batch's model, or another of the same scene; its colours, lamps and camera may differ

    Returns:
      values of fields of `View`, without their first axis
    """
    lamps, things = _lamps(m), self.scene.things
    return dict(
      cam_pos=m.cam_pos[self._number], cam_mat=flexes.matrix(m.cam_quat[self._number]),
      fovy=np.radians(m.cam_fovy[self._number]),
      rgba=np.array([colour(m, *thing.where) for thing in things]),
      tex=np.array([texture(m, *t.where) if t.tex >= 0 else -1 for t in things], np.int32),
      **{name: np.array([lamp[name] for lamp in lamps]) for name in _OF_ROWS},
    )  # fmt: skip

  def sites(self, m: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Returns where a model has its sites and how large they are, as `look` does."""
    parts = [each for each in self.scene.parts if len(each.surface.face)]
    pos, size = np.array([p.pos for p in parts]), np.array([p.size for p in parts])
    for site, part in self._sites.items():
      pos[part], size[part] = m.site_pos[site], site_size(m, site)
    return {"part_pos": pos, "part_size": size}

  def show(self, rows: np.ndarray, values: Mapping[str, np.ndarray]):
    """Gives rows camera, lamps, colours or a lens of their own.

    Args:
      rows: numbers of rows
      values: as `look` returns them, or of a `Lens`, a row for each of these
    """
    for name, value in values.items():
      array = getattr(self.view if name in View.vars else self.lens, name)
      whole = np.array(value, np.float32) if len(rows) == len(self.worlds) else array.numpy()
      whole[rows] = value
      array.assign(whole)

  def _through(self, size: tuple[int, int], outputs: Sequence[str]) -> Any:
    """Returns what pictures are seen through."""
    shared = ("chosen", "fovy", "seed", "far")
    values: dict[str, Any] = {name: getattr(self.view, name) for name in shared}
    values |= {"sent": self.view.out, "seen": self._pictures(size, outputs)}
    values |= {name: self._rows(value) for name, value in lens({}).items()}
    return fill(Lens, self._device, values)

  def _things(self, labels: Mapping[tuple[int, int], int] | None) -> dict[str, Any]:
    things, scene = self.scene.things, self.scene
    return dict(
      gloss=np.array([thing.gloss for thing in things]),
      kind=np.array([(thing.id, thing.kind) for thing in things], np.int32),
      label=labelled(things, labels or {}), texel=scene.texels, image=scene.images, sky=scene.sky,
    )  # fmt: skip

  def _parts(self) -> dict[str, Any]:
    parts, scene = [p for p in self.scene.parts if len(p.surface.face)], self.scene
    ball = []
    for part in parts:
      vert = part.surface.vert
      middle = 0.5 * (vert.min(axis=0) + vert.max(axis=0))
      ball.append([*middle, np.linalg.norm(vert - middle, axis=1).max()])
    self._sites = {part.site: k for k, part in enumerate(parts) if part.site >= 0}
    n, count = (len(self.worlds), len(parts)), [len(p.surface.face) for p in parts]
    soft = self._surfaces
    one = [scene.density(p.surface, p.thing) for p in parts]
    one += [scene.density(each.triangles, each.thing) for each in soft]
    return dict(
      thing=np.concatenate([p.thing for p in parts] + [each.thing for each in soft]),
      dense=np.concatenate(one),
      flat=np.concatenate([np.zeros(sum(count), int), *(each.flat for each in soft)]),
      coord=np.concatenate([p.surface.coord for p in parts] + [each.coord for each in soft]),
      corner_normal=np.concatenate([p.surface.normal for p in parts]),
      corner=np.concatenate([p.surface.vert[p.surface.face] for p in parts]),
      part=np.repeat(np.arange(len(parts), dtype=np.int32), count), soft_start=sum(count),
      part_body=self._bodies[[p.body for p in parts]].astype(np.int32),
      part_thing=np.array([p.thing[0] if p.clear else -1 for p in parts], np.int32),
      part_mat=np.array([p.mat for p in parts]), ball=np.array(ball),
      part_pos=self._rows([p.pos for p in parts]), part_size=self._rows([p.size for p in parts]),
      axes=np.zeros((*n, 3, 3)), to_eye=np.zeros((*n, 3, 3)), from_eye=np.zeros((*n, 3)),
      seen=np.zeros(n, np.int32),
    )  # fmt: skip

  def _organs(self, values: dict[str, Any]) -> dict[str, Any]:
    """Makes the mesh of all organs in all rows, a group of triangles a row."""
    n, device = len(self.worlds), self._device
    nvert, nface = (
      np.cumsum([0, *sizes])
      for sizes in ([s.nvert for s in self._surfaces], [len(s.face) for s in self._surfaces])
    )
    stride, count = int(nvert[-1]), int(nface[-1])
    self._soft = list[Any]()
    if not count:
      return dict(
        stride=0, soft_corner=np.zeros((n, 0, 3), np.int32),
        point=np.zeros((0, 3)), normal=np.zeros((0, 3)), lips=np.zeros((n, 0), np.uint8),
        lip_thing=np.zeros(0, np.int32), point_before=np.zeros((0, 3)),
      )  # fmt: skip
    face = np.concatenate([s.face + k for s, k in zip(self._surfaces, nvert, strict=False)])
    corner = (face[None] + stride * np.arange(n)[:, None, None]).astype(np.int32)
    base = np.concatenate([s.base for s in self._surfaces])
    with wp.ScopedDevice(device):
      point = wp.array(np.tile(base, (n, 1)), dtype=wp.vec3)
      normal = wp.zeros(len(point), dtype=wp.vec3)
      index = wp.array(corner.reshape(-1), dtype=int)
      shared = {"point": point, "normal": normal, "corner": index.reshape((n, count, 3))}
      flows = values["out"].flow.shape[0] > 0
      shared["before"] = wp.zeros_like(point) if flows else wp.zeros(0, dtype=wp.vec3)
      self._soft = [
        s.make(values["world"], int(a), int(b), shared)
        for s, a, b in zip(self._surfaces, nvert, nface, strict=False)
      ]
    return dict(
      stride=stride, soft_corner=shared["corner"], point=point,
      normal=normal, lips=np.zeros((n, count), np.uint8),
      lip_thing=np.concatenate([s.lip for s in self._surfaces]), point_before=shared["before"],
    )  # fmt: skip

  def _view(self, m: mujoco.MjModel, camera: int) -> dict[str, Any]:
    extent, lamps = float(m.stat.extent), _lamps(m)
    xpos, xmat, _ = self._batch.poses()
    body = [-1 if lamp["body"] < 0 else self._bodies[lamp["body"]] for lamp in lamps]
    zero = np.zeros((len(lamps), 3))
    return dict(
      near=float(m.vis.map.znear) * extent, far=float(m.vis.map.zfar) * extent, xpos=xpos,
      xmat=xmat, cam_body=int(self._bodies[m.cam_bodyid[camera]]),
      pixel=self._rows(0.0), eye=self._rows(np.zeros(3)), look=self._rows(np.eye(3)),
      seed=np.arange(len(self.worlds), dtype=np.int32),
      lamp_kind=np.array([lamp["kind"] for lamp in lamps], np.int32),
      lamp_body=np.array(body, np.int32), fade=np.array([lamp["fade"] for lamp in lamps]),
      spot=np.array([lamp["spot"] for lamp in lamps]), lamp_at=self._rows(zero),
      lamp_to=self._rows(zero),
      **{name: self._rows(value) for name, value in self.look(m).items()},
    )  # fmt: skip

  def part(self, site: int) -> int:
    """Returns the number of the part that a site is."""
    return self._sites[site]

  def thing(self, kind: int, number: int) -> int:
    """Returns the number of the thing that is an `mjtObj` of a number."""
    return [(each.kind, each.id) for each in self.scene.things].index((kind, number))

  def skin(self, organ: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns an organ's surface at rest as it is drawn: vertices [m] and triangles."""
    (found,) = (each for each in self._surfaces if each.tissue.name == organ)
    return found.base.copy(), found.face

  # Drawing.

  def draw(self) -> dict[str, wp.array]:
    """Draws all worlds as they are now; returns `pictures`."""
    self.follow()
    self.launch()
    return self.pictures

  def follow(self):
    """Follows cuts since the last picture."""
    for surface in self._surfaces:
      surface.follow(self.worlds, self.view.lips)

  def choose(self, mask: wp.array | None):
    """Lets the next pictures be of the worlds of a mask on the device alone, None for all.

    Where rows are the worlds several times, the mask is of these.
    """
    chosen = self.view.chosen
    if mask is None:
      chosen.fill_(True)
    else:
      for start in range(0, len(chosen), len(mask)):
        wp.copy(chosen, mask, start, 0, len(mask))

  def place(self):
    """Launches what finds where everything is now; `flow` is the way since the call before."""
    c, n = self.view, len(self.worlds)
    self._batch.poses()
    with wp.ScopedDevice(self._device):
      for name in _MOVED if "flow" in self.pictures else ():
        wp.copy(getattr(c, f"{name}_before"), getattr(c, name))
      for surface, soft in zip(self._surfaces, self._soft, strict=True):
        soft.x = surface.tissue.xpos
        if soft.before.shape[0] > 0:
          wp.launch(filling.remember, dim=(n, surface.nvert), inputs=[soft])
        wp.launch(filling.follow, dim=(n, surface.nvert), inputs=[soft])
        wp.launch(filling.lift, dim=(n, surface.nvert), inputs=[soft])
      wp.launch(filling.aim, dim=n, inputs=[c])
      wp.launch(filling.put, dim=(n, c.part_body.shape[0]), inputs=[c])

  def launch(self):
    """Launches what draws; it can be recorded in a graph."""
    c, n = self.view, len(self.worlds)
    self.place()
    with wp.ScopedDevice(self._device):
      tiles = -(-c.width // 8) * -(-c.height // 4)
      for start in range(0, n, c.solid.shape[0]):
        some = min(c.solid.shape[0], n - start)
        wp.launch(filling.fill, dim=(some, c.thing.shape[0]), inputs=[c, start])
        if c.large.shape[1] > 0:
          lanes = (some, c.large.shape[1], filling.LANES)
          wp.launch(filling.spread, dim=lanes, inputs=[c, start])
        wp.launch(shading.draw, dim=(some, tiles, _TILE), inputs=[c, start], block_dim=_BLOCK)
      if self.lens is not None:
        wp.launch(see, dim=(n, c.height, c.width), inputs=[self.lens, c.height, c.width])


def _lamps(m: mujoco.MjModel) -> list[dict[str, Any]]:
  """Returns the lamps that MuJoCo's renderer knows, that at the lens first, by field of `View`."""
  zero, out = np.zeros(3), []

  def add(kind: int, body: int, pos, way, colours, fade=zero, spot=(-1.0, 0.0)):
    places = {"lamp_pos": pos, "lamp_dir": way} | dict(zip(_OF_ROWS[2:], colours, strict=True))
    own = {name: np.array(value, float) for name, value in places.items()}
    out.append(own | {"kind": kind, "body": body, "fade": np.array(fade, float), "spot": spot})

  head, way = m.vis.headlight, int(_LIGHT.mjLIGHT_DIRECTIONAL)
  if head.active:
    add(way, -1, zero, zero, (head.ambient, head.diffuse, head.specular))
  for k in np.flatnonzero(m.light_active):
    if m.light_type[k] in (way, int(_LIGHT.mjLIGHT_SPOT)):
      cutoff = np.cos(np.radians(m.light_cutoff[k])) if m.light_cutoff[k] <= 90 else -1.0
      colours = m.light_ambient[k], m.light_diffuse[k], m.light_specular[k]
      add(
        int(m.light_type[k]), int(m.light_bodyid[k]), m.light_pos[k], m.light_dir[k], colours,
        m.light_attenuation[k], (cutoff, m.light_exponent[k]),
      )  # fmt: skip
  if not out:
    add(way, -1, zero, zero, (np.full(3, 0.3), zero, zero))
  return out


def _camera(model: mujoco.MjModel, name: str) -> int:
  names = [mujoco.mj_id2name(model, _OBJ.mjOBJ_CAMERA, k) for k in range(model.ncam)]
  if name not in names:
    have = ", ".join(map(repr, names)) or "none"
    raise ValueError(f"no camera {name!r} in the model, it has {have}")
  camera = names.index(name)
  if model.cam_mode[camera] != mujoco.mjtCamLight.mjCAMLIGHT_FIXED:
    raise ValueError(f"camera {name!r} follows something, expected mode fixed")
  return camera


def _flexes(organ: Declaration, model: mujoco.MjModel) -> list[int]:
  """Returns the flexes that an organ has, those that draw its cuts too."""
  walls = organ.config.walls
  names = [mujoco.mj_id2name(model, _OBJ.mjOBJ_FLEX, f) or "" for f in range(model.nflex)]
  found = walls and flexes.resolve(walls, organ.name, names)
  return [organ.flex, *map(int, organ.flexes), *([names.index(found)] if found else [])]


def _size(height: Any, width: Any) -> tuple[int, int]:
  for what, value in (("height", height), ("width", width)):
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not whole or not 1 <= value <= MOST:
      raise ValueError(f"{what} is {value!r}, expected a whole number in [1, {MOST}] [pixels]")
  return int(height), int(width)
