# mujoco ships its bindings without type stubs:
# pyright: reportAttributeAccessIssue=false
"""What a page draws: the shapes of a scene once, and where they are thirty times a second."""

from __future__ import annotations

from typing import Any

import mujoco as mj
import numpy as np
import trimesh

# Numbers at the head of a frame, before the nodes, the geoms' places and the targets.
HEAD = (
  "time", "progress", "force", "shaft", "felt", "push", "missed", "steps", "state",
  "tip_x", "tip_y", "tip_z",
)  # fmt: skip
STATES = ("waiting", "ready", "clutch", "lost", "paused")


def shapes(env: Any) -> dict[str, Any]:
  """Returns what is drawn of an exercise, JSON: organ, geoms, targets, camera and limits."""
  physics, task = env.physics, env.task
  model = physics.model.ptr
  eye, turn, fovy = physics.camera()
  flex = mj.mj_name2id(model, mj.mjtObj.mjOBJ_FLEX, physics.organ_name)
  drawn = _drawn(model)
  return {
    "type": "scene",
    "task": task.name,
    "nodes": len(physics.nodes()),
    "triangles": physics.organ.elem.ravel().tolist(),
    "organ": [round(float(c), 3) for c in model.flex_rgba[flex]],
    "geoms": [_geom(model, g) for g in drawn],
    "targets": len(physics.target_sites),
    "camera": {"pos": eye.tolist(), "mat": turn.ravel().tolist(), "fovy": fovy},
    "force_limit": task.force_limit,
    "damage": task.damage,
    "time_limit": env.step_limit * env.control_timestep(),
    "jaws": task.jaws,
    "report": "report" in task.extra,
    "head": HEAD,
  }


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


class Camera:
  """Takes frames of one model; for the loop's thread, some tens of microseconds each."""

  def __init__(self, env: Any):
    """Takes the scene as it is now."""
    self._env, model = env, env.physics.model.ptr
    self.model = model
    self._geoms, self._sites = _drawn(model), env.physics.target_sites

  def frame(self, session: Any) -> bytes:
    """Returns a frame, float32: `HEAD`, nodes, geoms (place, matrix), targets (8 numbers each)."""
    env, physics = self._env, self._env.physics
    data, model, late = physics.data.ptr, self.model, session.pace.lateness
    wrench = physics.handle.wrench()
    tip, nodes = physics.tip_pos(), physics.nodes()
    state = "paused" if session.pace.paused or session.link.paused else session.link.state
    head = (
      data.time, env.task.progress, float(np.linalg.norm(physics.contact_force())),
      float(np.linalg.norm(physics.shaft_force())), float(np.linalg.norm(wrench[:3])),
      env.task.peak, late.missed, late.steps, STATES.index(state), *tip,
    )  # fmt: skip
    geoms, sites = self._geoms, self._sites
    parts = (
      head,
      nodes.ravel(),
      np.hstack([data.geom_xpos[geoms], data.geom_xmat[geoms]]).ravel(),
      np.hstack(
        [data.site_xpos[sites], model.site_rgba[sites], model.site_size[sites, :1]]
      ).ravel(),
    )
    return np.concatenate(parts, dtype=np.float32, casting="unsafe").tobytes()
