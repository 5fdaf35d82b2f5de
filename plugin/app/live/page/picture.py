# mujoco ships its bindings without type stubs:
# pyright: reportAttributeAccessIssue=false
"""What a page draws: the shapes of a scene once, and where they are thirty times a second."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco as mj
import numpy as np
import trimesh
from palpate import Organ

from ..coupling import Link
from ..realtime_clock import Pace

# Numbers at the head of a frame, before the nodes, the geoms' places and the targets; `echo` is the
# page's own clock when it sent the movement that is shown, `clock` the loop's [s].
HEAD = (
  "time", "progress", "force", "shaft", "felt", "push", "missed", "steps", "state", "echo", "clock",
  "tip_x", "tip_y", "tip_z", "tip_qw", "tip_qx", "tip_qy", "tip_qz",
)  # fmt: skip
STATES = ("waiting", "ready", "clutch", "lost", "paused")
_SENSORS = ("tip_force", "shaft_force", "tip_pos", "tip_quat")


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
      organ: that is drawn
      prefix: of the instrument in the right hand
      sites: of targets
    """
    self.model, self._data, self._organ = model, data, organ
    self._prefix, self._geoms, self._sites = prefix, _drawn(model), list(sites)
    self._sensors = []
    for name in _SENSORS:
      sensor = model.sensor(prefix + name)
      adr = int(sensor.adr[0])
      self._sensors.append(data.sensordata[adr : adr + int(sensor.dim[0])])
    self._rest, self.peak, self._begun = organ.xpos0, 0.0, 0.0
    self._since = 0.0  # largest force since the last frame [N]

  @classmethod
  def of(cls, env: Any) -> Camera:
    """Returns the camera of an exercise."""
    physics = env.physics
    args = physics.model.ptr, physics.data.ptr, physics.organ, physics.prefix
    return cls(*args, physics.target_sites)

  def shapes(self, **more: Any) -> dict[str, Any]:
    """Returns what is drawn, JSON: organ, geoms, targets, camera, and what the caller adds."""
    model, data = self.model, self._data
    eye = model.camera("laparoscope").id
    return {
      "type": "scene",
      "nodes": self._organ.nvert,
      "triangles": self._organ.elem.ravel().tolist(),
      "organ": _organ_colour(model, self._organ.name),
      "geoms": [_geom(model, g) | {"mine": self._mine(g)} for g in self._geoms],
      "targets": len(self._sites),
      "camera": {
        "pos": data.cam_xpos[eye].tolist(),
        "mat": data.cam_xmat[eye].ravel().tolist(),
        "fovy": float(model.cam_fovy[eye]),
      },
      "head": HEAD,
      **more,
    }

  def _mine(self, g: int) -> bool:
    """Whether a geom goes where the tip goes: what hangs on the shaft's joint, not the port."""
    model, body = self.model, int(self.model.geom_bodyid[g])
    shaft = int(model.joint(f"{self._prefix}insertion").bodyid[0])
    while body and body != shaft:
      body = int(model.body_parentid[body])
    return body == shaft

  def feel(self, force: float) -> None:
    """Takes the largest force of the tip in a control step, which lasts less long than a frame."""
    self._since = max(self._since, force)

  def frame(self, link: Link, pace: Pace, progress: float = 0.0) -> bytes:
    """Returns a frame, float32: `HEAD`, nodes, geoms (place, matrix), targets (8 numbers each)."""
    data, model, late = self._data, self.model, pace.lateness
    tip, shaft, pos, quat = self._sensors
    force, self._since = max(float(np.linalg.norm(tip)), self._since), 0.0
    self.peak = max(self.peak, force)
    self._begun = self._begun or pace.now
    state = "paused" if pace.paused or link.paused else link.state
    felt = math.hypot(*link.force)
    head = (
      data.time, progress, force, float(np.linalg.norm(shaft)), felt, self.peak, late.missed,
      late.steps, STATES.index(state), link.device.stamp, pace.now - self._begun,
      *pos, *quat,
    )  # fmt: skip
    geoms, sites = self._geoms, self._sites
    parts = (
      head,
      (self._rest + self._organ.displacement).ravel(),
      np.hstack([data.geom_xpos[geoms], data.geom_xmat[geoms]]).ravel(),
      np.hstack(
        [data.site_xpos[sites], model.site_rgba[sites], model.site_size[sites, :1]]
      ).ravel(),
    )
    return np.concatenate(parts, dtype=np.float32, casting="unsafe").tobytes()


def _organ_colour(model: mj.MjModel, name: str) -> list[float]:
  flex = mj.mj_name2id(model, mj.mjtObj.mjOBJ_FLEX, name)
  skin = int(model.flex_matid[flex])
  colour = model.mat_rgba[skin] if skin >= 0 else model.flex_rgba[flex]
  return [round(float(c), 3) for c in colour]


def _drawn(model: mj.MjModel) -> list[int]:
  """Returns the geoms that are seen; the handle would hide the tip."""
  handles = [model.body(b).name.endswith("handle") for b in range(model.nbody)]
  shown = ~np.array(handles)[model.geom_bodyid]
  shown &= (model.geom_group <= 2) & (_colours(model)[:, 3] > 0.05)
  return [int(g) for g in np.flatnonzero(shown)]


def _colours(model: mj.MjModel) -> np.ndarray:
  colours, skin = model.geom_rgba.copy(), model.geom_matid
  colours[skin >= 0] = model.mat_rgba[skin[skin >= 0]]
  return colours


def _geom(model: mj.MjModel, g: int) -> dict[str, Any]:
  """Returns a geom's triangles in its own frame [m]."""
  kind, size = model.geom_type[g], model.geom_size[g]
  make = trimesh.creation
  if kind == mj.mjtGeom.mjGEOM_MESH:
    k = model.geom_dataid[g]
    start, faces = model.mesh_vertadr[k], model.mesh_faceadr[k]
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[k]]
    triangles = model.mesh_face[faces : faces + model.mesh_facenum[k]]
  else:
    if kind == mj.mjtGeom.mjGEOM_CAPSULE:
      shape = make.capsule(2 * size[1], size[0], count=[12, 12])
    elif kind == mj.mjtGeom.mjGEOM_CYLINDER:
      shape = make.cylinder(size[0], 2 * size[1], sections=16)
    elif kind == mj.mjtGeom.mjGEOM_BOX:
      shape = make.box(2 * size)
    else:
      shape = make.icosphere(2, 1.0)
      shape.apply_scale(size if kind == mj.mjtGeom.mjGEOM_ELLIPSOID else size[0])
    vertices, triangles = shape.vertices, shape.faces
  return {
    "vertices": np.round(vertices, 6).ravel().tolist(),
    "triangles": np.asarray(triangles).ravel().tolist(),
    "rgba": [round(float(c), 3) for c in _colours(model)[g]],
  }
