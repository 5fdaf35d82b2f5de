"""Draws pictures/cut_liver.webp: a liver in the abdomen, cut 3 cm deep, its lips held apart.

python docs/cut_liver.py
"""

import pathlib

import imageio.v3 as imageio
import mujoco
import numpy as np
import palpate
from palpate import models
from palpate.models import organs, scenery, situs
from palpate.tissue.geometry.mesh import area_vectors
from scipy.interpolate import LinearNDInterpolator

NODES, DEPTH = 4000, 0.03  # [m]
APART, PULL = 0.02, 120.0  # how far the springs at a lip are pulled [m], and how firm [N/m]
ENDS = np.array([[-0.05, 0.024], [0.035, 0.022]])  # of the cut, in the camera's plane [m]
SIZE = 1280, 960


def scene() -> mujoco.MjModel:
  """Returns a solid liver with room for cuts, in the abdomen, and two bodies that pull."""
  spec = models.load("liver", nodes=NODES, instruments=(), interior="solid")
  build, lamp = organs.build("liver", NODES), spec.light(situs.CAMERA)
  uv = scenery.texcoord("liver", build.vertices, build.triangles)
  situs.dress(spec, "liver/liver", "liver", uv)
  palpate.add_spare(spec, "liver/liver", 2500)
  situs.furnish(spec, ("gallbladder", "stomach"), "liver", situs.ARRANGEMENTS["liver"])
  pos = np.array(lamp.pos)
  situs.light(spec, pos, pos + lamp.dir)
  for side in ("up", "down"):
    spec.worldbody.add_body(name=side, mocap=True)
  spec.visual.global_.offwidth, spec.visual.global_.offheight = SIZE
  return spec.compile()


def on_surface(organ: palpate.Organ, pos: np.ndarray, frame: np.ndarray) -> np.ndarray:
  """Returns points of the organ that a camera sees along a bow from end to end, (n, 3) [m]."""
  x, elem = organ.xpos, organ.elem
  normal = np.zeros_like(x)
  np.add.at(normal, elem, area_vectors(x, elem)[:, None])
  seen = (x - pos)[(normal * (pos - x)).sum(axis=1) > 0] @ frame
  s = np.linspace(0, 1, 30)[:, None]
  plane = ENDS[0] + s * (ENDS[1] - ENDS[0]) + [0, 0.008] * np.sin(np.pi * s)
  depth = LinearNDInterpolator(seen[:, :2], seen[:, 2])(plane)
  return pos + np.column_stack([plane, depth]) @ frame.T


def main():
  """Cuts, pulls for 0.3 s and draws."""
  model = scene()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  organ = palpate.Organ(model, data, "liver/liver")
  frame = data.cam_xmat[model.camera(situs.CAMERA).id].reshape(3, 3)
  path = on_surface(organ, data.cam_xpos[model.camera(situs.CAMERA).id], frame)
  skin = len(organ.elem)
  organ.cut(path, depth=DEPTH)
  # A vertex of a lip is above or below the path as its triangles are.
  x, elem = organ.xpos, organ.elem[:skin]
  middle = x[elem].mean(axis=1) @ frame
  above = middle[:, 1] - np.interp(middle[:, 0], *(path @ frame).T[:2])
  side = np.zeros(len(x))
  np.add.at(side, elem, above[:, None])
  near = np.linalg.norm(x[:, None] - path[None, 3:-3], axis=2).min(axis=1) < 0.0045
  for name, sign in (("up", 1), ("down", -1)):
    organ.attach(np.flatnonzero(near & (np.sign(side) == sign)), name, stiffness=PULL)
  for i in range(300):
    for name, sign in (("up", 1), ("down", -1)):
      data.mocap_pos[model.body(name).mocapid[0]] = min(i / 200, 1) * APART * sign * frame[:, 1]
    mujoco.mj_step(model, data)
  camera = mujoco.MjvCamera()
  camera.lookat[:], camera.distance = path.mean(axis=0) - [0, 0, 0.015], 0.19
  camera.azimuth, camera.elevation = -95, -42
  with mujoco.Renderer(model, SIZE[1], SIZE[0]) as renderer:
    renderer.update_scene(data, camera)
    out = pathlib.Path(__file__).parent / "pictures" / "cut_liver.webp"
    imageio.imwrite(out, renderer.render(), quality=85)


if __name__ == "__main__":
  main()
