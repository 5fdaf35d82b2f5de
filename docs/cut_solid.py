"""Draws cut_solid.png: a liver that has come apart, its cut opened and its lobe taken aside.

python docs/cut_solid.py
"""

import pathlib

import imageio.v3 as imageio
import mujoco
import numpy as np
import palpate
from palpate import models
from scipy.interpolate import LinearNDInterpolator

LOBE, EDGE = -0.05, 0.0048  # where the lobe is cut off, and about an edge [m]
CUT, DEPTH, OPEN = ((-0.03, -0.03), (0.03, 0.0)), 0.02, 0.004  # ends (x, y), depth, half a gape [m]
ASIDE = np.array([-0.035, 0.0, -0.012])  # [m]
COLOURS = {"skin": (0.72, 0.27, 0.22, 1), "walls": (0.50, 0.10, 0.11, 1)}


def around(points: np.ndarray, x: float) -> np.ndarray:
  """Returns a closed path around an organ in a plane across x, (n, 3)."""
  near = points[np.abs(points[:, 0] - x) < 0.6 * EDGE]
  angle = np.arctan2(*(near - near.mean(axis=0))[:, [2, 1]].T)
  bins = np.digitize(angle, np.linspace(-np.pi, np.pi, 41))
  path = np.array([near[bins == k].mean(axis=0) for k in np.unique(bins)])
  path[:, 0] = x
  return np.vstack([path, path[:1]])


def along(points: np.ndarray, ends) -> np.ndarray:
  """Returns a path on the top of an organ over a line, (n, 3)."""
  line = np.linspace(*np.array(ends), 16)
  top = points[points[:, 2] > 0]
  return np.column_stack([line, LinearNDInterpolator(top[:, :2], top[:, 2])(line)])


def opened(points: np.ndarray, elem: np.ndarray, ends) -> np.ndarray:
  """Returns vertices that are pulled from a cut, each to the side of its triangles."""
  a, b = np.array(ends)
  way = (b - a) / np.linalg.norm(b - a)
  across = np.array([-way[1], way[0]])
  side = np.zeros(len(points))
  np.add.at(side, elem.ravel(), np.repeat((points[elem].mean(axis=1)[:, :2] - a) @ across, 3))
  s = np.clip(((points[:, :2] - a) @ way) / np.linalg.norm(b - a), 0, 1)
  gap = OPEN * np.sqrt(s * (1 - s)) * 2
  far = np.abs((points[:, :2] - a) @ across) / 0.02
  deep = np.clip((points[:, 2] - points[:, 2].max() + 0.045) / 0.03, 0, 1)
  return (np.sign(side) * gap * np.exp(-(far**2)) * deep)[:, None] * [*across, 0.0]


def picture(points: np.ndarray, parts: dict[str, np.ndarray]) -> np.ndarray:
  """Returns an image of triangles, flat where they are walls."""
  spec = mujoco.MjSpec()
  spec.visual.global_.offwidth, spec.visual.global_.offheight = 760, 560
  spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.35] * 3
  sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX)
  sky.width, sky.height, sky.builtin = 64, 64, mujoco.mjtBuiltin.mjBUILTIN_FLAT
  sky.rgb1 = sky.rgb2 = [0.86, 0.88, 0.9]
  light = spec.worldbody.add_light(pos=[-0.2, -0.3, 0.5], dir=[0.2, 0.3, -0.5], diffuse=[0.6] * 3)
  light.castshadow = True
  for name, elem in parts.items():
    used, index = np.unique(elem, return_inverse=True)
    mesh = spec.add_mesh(name=name, uservert=points[used].ravel(), userface=index.ravel())
    mesh.smoothnormal = int(name == "skin")
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, rgba=COLOURS[name])
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  camera = mujoco.MjvCamera()
  camera.lookat[:], camera.distance = [-0.025, 0, 0], 0.3
  camera.azimuth, camera.elevation = 35, -38
  with mujoco.Renderer(model, 560, 760) as renderer:
    renderer.update_scene(data, camera)
    return renderer.render()


def main():
  """Cuts, takes apart and draws."""
  shape = models.load("liver", nodes=4000).compile()
  rest = mujoco.MjData(shape)
  mujoco.mj_forward(shape, rest)
  liver = palpate.Organ(shape, rest, "liver/liver")
  points, elem = liver.xpos.copy(), liver.elem
  spec = mujoco.MjSpec()
  keys = {"elements": "solid", "mass": 1.7, "young": 5e3, "spare": 2500, "windows": True}
  palpate.add_organ(spec, (points, elem), "liver", **keys)
  model = spec.compile()
  data = mujoco.MjData(model)
  mujoco.mj_forward(model, data)
  organ = palpate.Organ(model, data, "liver")
  organ.cut(along(points, CUT), depth=DEPTH)
  organ.cut(around(points, LOBE))
  lobe = min(organ.pieces, key=lambda piece: piece.mass)
  drawn, nskin = organ.xpos.copy(), len(elem)
  drawn += opened(drawn, organ.elem, CUT)
  drawn[lobe.vertices] += ASIDE
  parts = {"skin": organ.elem[:nskin], "walls": organ.elem[nskin:]}
  parts["walls"] = parts["walls"][np.ptp(parts["walls"], axis=1) > 0]
  imageio.imwrite(pathlib.Path(__file__).with_name("cut_solid.png"), picture(drawn, parts))


if __name__ == "__main__":
  main()
