"""What a page draws: the shapes of a scene once, and where they are sixty times a second."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco as mj
import numpy as np
import trimesh
from palpate import Organ, Thread
from palpate.engine.model.flexes import matrix
from palpate.models.situs import LIGHT
from palpate.organ import instances

from ..coupling import Link
from ..realtime_clock import Pace
from .surface import Surface, look, pack, paper

FPS = 60  # frames a second that free practice publishes, at most
# Numbers at the head of a frame, before the nodes, the bodies' places and the sites; `echo` is the
# page's own clock when it sent the movement that is shown, `clock` the loop's [s]; `current` is 1
# while a hook sends one through what it touches; from `eye_0` on is the camera's matrix, by rows.
HEAD = (
  "time", "progress", "force", "shaft", "felt", "push", "missed", "steps", "state", "echo", "clock",
  "current", "tip_x", "tip_y", "tip_z", "tip_qw", "tip_qx", "tip_qy", "tip_qz",
  "eye_x", "eye_y", "eye_z", *(f"eye_{k}" for k in range(9)),
)  # fmt: skip
STATES = ("waiting", "ready", "clutch", "lost", "paused")
_SENSORS = ("tip_force", "shaft_force", "tip_pos", "tip_quat")
HOOK = "hook/"  # prefix of the instrument that sends a current
_SHOWN = 2  # the last group of geoms, sites and skins that is drawn


class Camera:
  """Takes frames of one model; for the loop's thread, some tens of microseconds each.

  Attributes:
    model: that it takes them of
    peak: largest force of the tip so far [N]
  """

  def __init__(
    self, model: mj.MjModel, data: mj.MjData, organ: Organ, prefix: str, sites: Sequence[int] = ()
  ):
    """Takes the scene as it is now.

    Args:
      model: the scene
      data: its state
      organ: that is worked on; the model's others are drawn too
      prefix: of the instrument in the right hand
      sites: of targets
    """
    self.model, self._data, self._prefix = model, data, prefix
    others = [Organ(model, data, name) for name in instances(model) if name != organ.name]
    self._organs = [Surface(model, each) for each in (organ, *others)]
    self._targets = len(sites)
    others = np.flatnonzero(model.site_group <= _SHOWN)
    self._sites = [*sites, *(int(site) for site in others if site not in sites)]
    self._parts = _parts(model)
    self._eye = model.camera("laparoscope").id
    self._bodies = sorted({body for body, _ in self._parts})
    self._hooks = [s for s in range(model.nsite) if model.site(s).name.endswith(f"{HOOK}tip")]
    self._sensors = [self._sensor(prefix + name) for name in _SENSORS]
    self._burnt = [self._sensor(f"{model.site(s).name}_force") for s in self._hooks]
    self._threads = [Thread(model, data, name) for name in instances(model, dim=1)]
    self.peak = self._begun = 0.0
    self._since = self._felt = None  # largest force since the last frame, and before [N]

  def _sensor(self, name: str) -> np.ndarray:
    sensor = self.model.sensor(name)
    adr = int(sensor.adr[0])
    return self._data.sensordata[adr : adr + int(sensor.dim[0])]

  @classmethod
  def of(cls, env: Any) -> Camera:
    """Returns the camera of an exercise."""
    physics = env.physics
    args = physics.model.ptr, physics.data.ptr, physics.organ, physics.prefix
    return cls(*args, physics.target_sites)

  def shapes(self, **more: Any) -> dict[str, Any]:
    """Returns what is drawn, JSON: organs, parts, scenery, lights, and what the caller adds."""
    model, data = self.model, self._data
    eye = self._eye
    used = {*model.skin_matid.tolist(), *(each.material for each in self._organs)}
    textures = {t: _texture(model, t) for t in sorted({paper(model, m) for m in used}) if t >= 0}
    drawn = {each.organ.skin for each in self._organs}
    hooks = [self._bodies.index(int(model.site_bodyid[s])) for s in self._hooks]
    return {
      "type": "scene",
      "nodes": self._organs[0].organ.nvert,
      "organs": [each.shape() for each in self._organs],
      "parts": [
        {
          "body": self._bodies.index(body),
          "mine": self._mine(body),
          "shape": _shape(model, geoms),
          "look": look(model, *key),
        }
        for (body, key), geoms in self._parts.items()
      ],
      "threads": [self._thread(thread) for thread in self._threads],
      "bodies": len(self._bodies),
      "scenery": [
        _skin(model, data, s) for s in range(model.nskin)
        if s not in drawn and model.skin_group[s] <= _SHOWN
      ],
      "sites": [_FORMS.get(int(model.site_type[s]), "ball") for s in self._sites],
      "targets": self._targets,
      "tips": [
        [self._bodies.index(int(model.site_bodyid[s])), *model.site_pos[s].tolist()]
        for s in range(model.nsite)
        if model.site(s).name.endswith("/tip") and int(model.site_bodyid[s]) in self._bodies
      ],
      "hooks": [
        [body, *model.site_pos[s].tolist()] for body, s in zip(hooks, self._hooks, strict=True)
      ],
      "textures": textures,
      "lights": _lights(model, data),
      "camera": {
        "pos": data.cam_xpos[eye].tolist(),
        "mat": data.cam_xmat[eye].ravel().tolist(),
        "fovy": float(model.cam_fovy[eye]),
      },
      "head": HEAD,
      **more,
    }  # fmt: skip

  def _thread(self, thread: Thread) -> dict[str, Any]:
    """Returns a thread: how many nodes it has, its radius [m], its look."""
    model, flex = self.model, mj.mj_name2id(self.model, mj.mjtObj.mjOBJ_FLEX, thread.name)
    seen = look(model, int(np.ravel(model.flex_matid[flex])[0]), tuple(model.flex_rgba[flex]))
    radius = float(np.ravel(model.flex_radius[flex])[0])
    return {"nodes": len(thread.positions), "radius": radius, "look": seen}

  def cuts(self) -> list[dict[str, Any]]:
    """Returns the triangles of the organs that were cut since they were looked at, JSON."""
    return [
      {"type": "topology", "organ": k, **each.topology()}
      for k, each in enumerate(self._organs)
      if each.cut()
    ]

  def _mine(self, body: int) -> bool:
    """Whether a body goes where the tip goes: what hangs on the shaft's joint, not the port."""
    model = self.model
    shaft = int(model.joint(f"{self._prefix}insertion").bodyid[0])
    while body and body != shaft:
      body = int(model.body_parentid[body])
    return body == shaft

  def feel(self, force: float) -> None:
    """Takes the largest force in a control step: that which warnings go by."""
    self._since = self._felt = max(self._since or 0.0, force)

  def _nodes(self) -> list[np.ndarray]:
    first, *others = self._organs
    out = [first.places().ravel()]
    for each in others:
      places = each.places()
      out += [places.ravel(), np.zeros(3 * (len(each.organ.displacement) - len(places)))]
    return out

  def frame(self, link: Link, pace: Pace, progress: float = 0.0, powered: bool = False) -> bytes:
    """Returns a frame, float32: `HEAD`, nodes, threads, bodies (place, matrix), sites.

    Nodes are those of the organ that is worked on, then those of the others, which have room for
    all that cuts may add.
    A node of a thread has 4 numbers: place, and 1 where what follows it is whole, else 0. A site
    has 19: place, colour, size, matrix.
    """
    data, model, late = self._data, self.model, pace.lateness
    tip, shaft, pos, quat = self._sensors
    felt = self._felt if self._since is None else self._since
    force, self._since = float(np.linalg.norm(tip)) if felt is None else felt, None
    self.peak = max(self.peak, force)
    self._begun = self._begun or pace.now
    state = "paused" if pace.paused or link.paused else "waiting" if pace.waits else link.state
    hand = math.hypot(*link.force)
    current = powered and any(force.any() for force in self._burnt)
    head = (
      data.time, progress, force, float(np.linalg.norm(shaft)), hand, self.peak, late.missed,
      late.steps, STATES.index(state), link.device.stamp, pace.now - self._begun, float(current),
      *pos, *quat, *data.cam_xpos[self._eye], *data.cam_xmat[self._eye],
    )  # fmt: skip
    bodies, sites = self._bodies, self._sites
    parts = (
      head,
      *self._nodes(),
      *(np.column_stack([t.positions, np.r_[~t.broken, True]]).ravel() for t in self._threads),
      np.hstack([data.xpos[bodies], data.xmat[bodies]]).ravel(),
      np.hstack([
        data.site_xpos[sites], model.site_rgba[sites], model.site_size[sites], data.site_xmat[sites]
      ]).ravel(),
    )  # fmt: skip
    return np.concatenate(parts, dtype=np.float32, casting="unsafe").tobytes()


def _parts(model: mj.MjModel) -> dict[tuple[int, tuple], list[int]]:
  """Returns the geoms that are seen, by body and look; the handle would hide the tip."""
  found: dict[tuple[int, tuple], list[int]] = {}
  for g in range(model.ngeom):
    body, material = int(model.geom_bodyid[g]), int(model.geom_matid[g])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[g]
    hidden = model.geom_group[g] > _SHOWN or rgba[3] <= 0.05
    if hidden or model.body(body).name.endswith("handle"):
      continue
    if model.geom_type[g] in (mj.mjtGeom.mjGEOM_PLANE, mj.mjtGeom.mjGEOM_HFIELD):
      continue
    found.setdefault((body, (material, tuple(model.geom_rgba[g]))), []).append(g)
  return found


def _shape(model: mj.MjModel, geoms: Sequence[int]) -> dict[str, Any]:
  """Returns the triangles of some geoms in the frame of their body [m]."""
  vertices, triangles, count = [], [], 0
  for g in geoms:
    x, t = _geom(model, g)
    vertices.append(x @ matrix(model.geom_quat[g]).T + model.geom_pos[g])
    triangles.append(t + count)
    count += len(x)
  return {"vertices": pack(np.concatenate(vertices)), "triangles": pack(np.concatenate(triangles))}


def _geom(model: mj.MjModel, g: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns a geom's vertices (n, 3) and triangles (m, 3) in its own frame [m]."""
  kind, size = model.geom_type[g], model.geom_size[g]
  make = trimesh.creation
  if kind == mj.mjtGeom.mjGEOM_MESH:
    k = model.geom_dataid[g]
    start, faces = model.mesh_vertadr[k], model.mesh_faceadr[k]
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[k]]
    return vertices, model.mesh_face[faces : faces + model.mesh_facenum[k]]
  if kind == mj.mjtGeom.mjGEOM_CAPSULE:
    shape = make.capsule(2 * size[1], size[0], count=[16, 16])
  elif kind == mj.mjtGeom.mjGEOM_CYLINDER:
    shape = make.cylinder(size[0], 2 * size[1], sections=24)
  elif kind == mj.mjtGeom.mjGEOM_BOX:
    shape = make.box(2 * size)
  else:
    shape = make.icosphere(3, 1.0)
    shape.apply_scale(size if kind == mj.mjtGeom.mjGEOM_ELLIPSOID else size[0])
  return np.asarray(shape.vertices), np.asarray(shape.faces)


# What a site is drawn as, where that is no ball.
_FORMS = {
  int(mj.mjtGeom.mjGEOM_BOX): "box",
  int(mj.mjtGeom.mjGEOM_CYLINDER): "cylinder",
  int(mj.mjtGeom.mjGEOM_CAPSULE): "cylinder",
  int(mj.mjtGeom.mjGEOM_ELLIPSOID): "ellipsoid",
}


def _texture(model: mj.MjModel, texture: int) -> dict[str, Any]:
  height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
  channels, adr = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
  pixels = model.tex_data[adr : adr + height * width * channels].reshape(-1, channels)
  rgb = pixels[:, :3] if channels > 2 else np.repeat(pixels[:, :1], 3, axis=1)
  return {"width": width, "height": height, "pixels": pack(rgb)}


def _skin(model: mj.MjModel, data: mj.MjData, skin: int) -> dict[str, Any]:
  """Returns scenery where it lies; a skin's first bone carries all of it."""
  first, count = int(model.skin_vertadr[skin]), int(model.skin_vertnum[skin])
  face, faces = int(model.skin_faceadr[skin]), int(model.skin_facenum[skin])
  bone = int(model.skin_boneadr[skin])
  body, bind = int(model.skin_bonebodyid[bone]), matrix(model.skin_bonebindquat[bone])
  own = (model.skin_vert[first : first + count] - model.skin_bonebindpos[bone]) @ bind
  at = int(model.skin_texcoordadr[skin])
  return {
    "vertices": pack(own @ data.xmat[body].reshape(3, 3).T + data.xpos[body]),
    "triangles": pack(model.skin_face[face : face + faces]),
    "uv": pack(model.skin_texcoord[at : at + count]) if at >= 0 else None,
    "look": look(model, int(model.skin_matid[skin]), model.skin_rgba[skin]),
  }


def _lights(model: mj.MjModel, data: mj.MjData) -> list[dict[str, Any]]:
  """Returns the lights; `around` is what all of them and the headlight give to every surface.

  Where no lamp is at the lens, the headlight is that lamp.
  """
  head, every = model.vis.headlight, []
  lit = any(model.light(k).name == LIGHT for k in range(model.nlight))
  if head.active:
    eye = model.camera("laparoscope").id
    every.append({
      "pos": None if lit else data.cam_xpos[eye],
      "dir": -data.cam_xmat[eye].reshape(3, 3)[:, 2],
      "directed": True,
      "lens": True,
      "colour": np.array(head.diffuse),
      "around": np.array(head.ambient),
    })
  for k in range(model.nlight):
    directed = model.light_type[k] == mj.mjtLightType.mjLIGHT_DIRECTIONAL
    every.append({
      "pos": data.light_xpos[k],
      "dir": data.light_xdir[k],
      "directed": bool(directed),
      "lens": model.light(k).name == LIGHT,
      "cutoff": float(model.light_cutoff[k]),
      "fade": model.light_attenuation[k],
      "colour": model.light_diffuse[k],
      "around": model.light_ambient[k],
    })  # fmt: skip
  return [
    {name: v.tolist() if isinstance(v, np.ndarray) else v for name, v in light.items()}
    for light in every
  ]
