"""The scene of `cut`: a sheet of tissue in a frame, and the line that is marked on it.

World: z is up, the sheet lies in z = 0 and is held along its four sides.
"""

import mujoco
import numpy as np
import palpate
from palpate.models import mjcf

from . import scenes
from .scenes import Scene

SIZE = 0.06  # of its sides [m]
ENERGY = 160.0  # that it takes to open an area [J/m^2]; catalogue and source: docs/cutting.md
_SPARE = 5.0  # times the square root of its nodes: room for a cut around and one astray
# Ours: a firm sheet on a centimetre of fat of 10 kPa, of 6 g.
_TISSUE = {"young": 1e6, "thickness": 0.0015, "damping": 0.005, "foundation": 1e6}
_MASS, _SKIN = 0.006, 0.0005  # [kg], radius of the flex [m]
_COLOUR, _FRAME = (0.87, 0.62, 0.52, 1.0), "0.55 0.58 0.62 1"


def sheet(nodes: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns the sheet of about so many nodes: vertices (nvert, 3) [m], triangles (nelem, 3).

  Rows of triangles that are nearly equilateral, every other one moved by half an edge.
  """
  across = round(np.sqrt(nodes * 0.866)) - 1
  rows = round(across / 0.866)
  vertices, start = [], [0]
  for j in range(rows + 1):
    x = np.linspace(0.0, 1.0, across + 1)
    x = np.concatenate([[0.0], 0.5 * (x[1:] + x[:-1]), [1.0]]) if j % 2 else x
    vertices.append(np.stack([x - 0.5, np.full(len(x), j / rows - 0.5), 0.0 * x], axis=1))
    start.append(start[-1] + len(x))
  triangles = []
  for j in range(rows):
    low, high = vertices[j][:, 0], vertices[j + 1][:, 0]
    a, b = 0, 0
    while a + 1 < len(low) or b + 1 < len(high):
      corner = [start[j] + a, start[j + 1] + b]
      if b + 1 == len(high) or (a + 1 < len(low) and low[a + 1] <= high[b + 1]):
        a += 1
        triangles.append([corner[0], start[j] + a, corner[1]])
      else:
        b += 1
        triangles.append([corner[0], start[j + 1] + b, corner[1]])
  return SIZE * np.concatenate(vertices), np.array(triangles)


def build(scene: Scene) -> mujoco.MjSpec:
  """Returns the scene, ready to be compiled; what cuts is the instrument's `edge`."""
  vertices, triangles = sheet(scene.nodes)
  spare = round(_SPARE * np.sqrt(len(vertices)))
  config = _TISSUE | {"device": "cpu", "tolerance": scenes.TOLERANCE}
  config |= {"cutters": f"{scene.instrument}/edge {ENERGY}"}
  flex = mjcf.flexcomp(
    scenes.ORGAN,
    (vertices, triangles),
    config=config,
    contact=scenes.CONTACT,
    pin=np.flatnonzero(np.abs(vertices).max(axis=1) > SIZE / 2 - 1e-6),
    digits=7,
    mass=_MASS,
    radius=_SKIN,
    rgba=_COLOUR,
  )
  half, bar = SIZE / 2 + 0.003, 0.003
  sides = [(half, 0, bar, half + bar), (-half, 0, bar, half + bar)]
  sides += [(y, x, b, a) for x, y, a, b in sides]
  frame = "".join(
    f'<geom type="box" pos="{x} {y} 0" size="{a} {b} 0.002" rgba="{_FRAME}" contype="0" '
    'conaffinity="0"/>'
    for x, y, a, b in sides
  )
  spec = scenes.furnish(scene, flex, np.zeros(3), frame)
  palpate.add_spare(spec, scenes.ORGAN, spare)
  spec.option.gravity = np.zeros(3)
  return spec
