"""The scene of `tease`: a strip of tissue that has grown on to what is under it.

World: z is up, the strip lies along y; its near end, towards the trocar, stands up as a flap under
which an instrument gets, its far end does not move.
"""

import mujoco
import numpy as np
from palpate.models import catalog, mjcf, situs

from ...core import scenes
from ...core.scenes import BED, Scene

LENGTH, WIDTH, FLAP = 0.05, 0.024, 0.018  # of what lies, across, and of what stands [m]
# Radius of the bend [m], and how steep the flap then goes on [rad].
_BEND, _RISE = 0.01, 0.75
_SKIN = 0.001  # radius of the flex [m]
_NEAR = 0.0015  # distance from the bed at which it has grown on [m]
# Ours: a sheet of peritoneum with some fat, as soft as the exercises' organs, of 3 g.
_TISSUE = {"young": 1e5, "thickness": 0.002, "damping": 0.005}
_MASS = 0.003  # [kg]
_SLOTS = 100  # of its window: the expert's probe touches fewer, folds and all
_PLAIN = (0.5, 0.5, 0.5, 1.0)  # a geom's colour that leaves its material's
# What lies around: no ducts, and the fat below the bed; ours.
_HELD = situs.Arrangement(fat=-0.035, without=tuple(catalog.DUCTS))
_COLOUR, _UNDER = (0.85, 0.62, 0.5, 1.0), "0.52 0.17 0.13 1"


def strip(nodes: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns the strip of about so many nodes: vertices (nvert, 3) [m], triangles (nelem, 3)."""
  spacing = np.sqrt((LENGTH + FLAP) * WIDTH / nodes)
  ny, nx = round((LENGTH + FLAP) / spacing), max(2, round(WIDTH / spacing))
  along = np.linspace(-FLAP, LENGTH, ny + 1)
  angle = np.clip(-along / _BEND, 0.0, _RISE)
  rest = np.maximum(-along - _RISE * _BEND, 0.0)
  y = np.maximum(along, 0.0) - _BEND * np.sin(angle) - rest * np.cos(_RISE) - LENGTH / 2
  z = _BEND * (1 - np.cos(angle)) + rest * np.sin(_RISE)
  line = np.stack([0.0 * y, y, z], axis=1)
  across = np.linspace(-WIDTH / 2, WIDTH / 2, nx + 1)
  vertices = (line[:, None] + across[:, None] * np.array([1.0, 0.0, 0.0])).reshape(-1, 3)
  i, j = (k.ravel() for k in np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij"))
  a = i * (nx + 1) + j
  b, c, d = a + 1, a + nx + 2, a + nx + 1
  odd = ((i + j) % 2 == 1)[:, None]
  one = np.where(odd, np.stack([a, b, d], 1), np.stack([a, b, c], 1))
  two = np.where(odd, np.stack([b, c, d], 1), np.stack([a, c, d], 1))
  return vertices, np.concatenate([one, two])


def build(scene: Scene) -> mujoco.MjSpec:
  """Returns the scene, ready to be compiled; `scene.bonds` hold the strip."""
  vertices, triangles = strip(scene.nodes)
  config = _TISSUE | {"device": "cpu", "tolerance": scenes.TOLERANCE, "support": BED}
  config |= {"bonds": f"{BED} {mjcf.numbers(scene.bonds)} near {_NEAR}"}
  contact = scenes.CONTACT | {"contype": 0, "conaffinity": 1}  # with tools, not with the bed
  flex = mjcf.flexcomp(
    scenes.ORGAN,
    (vertices, triangles),
    config=config,
    contact=contact,
    pin=np.flatnonzero(vertices[:, 1] > LENGTH / 2 - 1e-6),
    digits=7,
    mass=_MASS,
    radius=_SKIN,
    rgba=_COLOUR,
  )
  bed = (
    f'<geom name="{BED}" type="ellipsoid" size="0.12 0.14 0.05" pos="0 0 {-0.05 - _SKIN}" '
    f'rgba="{_UNDER}" contype="0" conaffinity="1"/>'
  )
  spec = scenes.furnish(scene, flex, np.zeros(3), bed, slots=_SLOTS)
  spec.option.gravity = np.zeros(3)
  if scene.surroundings == "abdomen":
    _surround(spec, scene, vertices)
  if scene.surroundings != "none":
    situs.obstruct(spec, (), arrangement=_HELD)
  return spec


def _surround(spec: mujoco.MjSpec, scene: Scene, vertices: np.ndarray):
  """Makes a liver of the bed, with fat and the wall around it, and peritoneum of the strip."""
  liver = spec.geom(BED)
  liver.material, liver.rgba = situs.paint(spec, "liver"), _PLAIN
  situs.dress(spec, scenes.ORGAN, "fat", vertices[:, :2] / LENGTH)
  situs.furnish(spec, (), arrangement=_HELD)
  situs.light(spec, scene.camera, np.zeros(3))
