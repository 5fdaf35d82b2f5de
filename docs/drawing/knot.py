"""Draws an overhand knot in silk, loose and pulled tight with 0.5 N: docs/pictures/knot.webp."""

import pathlib

import mujoco
import numpy as np
import palpate
from PIL import Image

RADIUS = 1.125e-4  # of size 3-0 [m]

# Shastri's polynomial knot and straight ends, with edges of 2.5 radii.
t = np.linspace(-2.3, 2.3, 4001)
curve = 0.0012 * np.stack([t**3 - 3 * t, t**4 - 4 * t**2, (t**5 - 10 * t) / 5], axis=1)
along = np.append(0, np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1)))
at = np.arange(0, along[-1], 2.5 * RADIUS)
points = np.stack([np.interp(at, along, c) for c in curve.T], axis=1)
axis = (points[-1] - points[0]) / np.linalg.norm(points[-1] - points[0])

spec = mujoco.MjSpec()
spec.option.gravity = 0, 0, 0
spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 1280
spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.5] * 3, [0.7] * 3
sky = {"type": mujoco.mjtTexture.mjTEXTURE_SKYBOX, "builtin": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT}
spec.add_texture(name="sky", width=64, height=64, rgb1=[1, 1, 1], rgb2=[0.85, 0.88, 0.9], **sky)
palpate.add_thread(spec, points, "silk")
model = spec.compile()
data = mujoco.MjData(model)
thread = palpate.Thread(model, data, "silk")


def picture(renderer: mujoco.Renderer, distance: float) -> np.ndarray:
  """Returns the middle of the thread from a distance [m], (height, width, 3)."""
  mujoco.mj_forward(model, data)
  camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
  option.flags[mujoco.mjtVisFlag.mjVIS_FLEXVERT] = 1  # round joints
  bent = np.linalg.norm(np.diff(thread.positions, 2, axis=0), axis=1)
  camera.lookat = np.average(thread.positions[1:-1], axis=0, weights=bent**2)
  camera.distance, camera.elevation = distance, -20
  camera.azimuth = np.degrees(np.arctan2(axis[1], axis[0])) + 90
  renderer.update_scene(data, camera, option)
  return renderer.render().copy()


with mujoco.Renderer(model, 1280, 1280) as renderer:
  pictures = [picture(renderer, 0.012)]
  for k in range(130):
    pull = 0.5 * min(1.0, k / 50) * axis
    data.qfrc_applied[:3], data.qfrc_applied[-3:] = -pull, pull
    mujoco.mj_step(model, data)
  pictures.append(picture(renderer, 0.0045))
image = Image.fromarray(np.concatenate(pictures, axis=1))
image = image.resize((1280, 640), Image.Resampling.LANCZOS)
image.save(pathlib.Path(__file__).parents[1] / "pictures" / "knot.webp", quality=85)
