"""The scene of `cut`, `drive` and `running`: a sheet of tissue in a frame.

World: z is up, the sheet lies in z = 0, or over an organ, and is held along its four sides.
"""

import mujoco
import numpy as np
import palpate
from palpate.models import catalog, mjcf, scenery, shapes, situs
from palpate.models.meshing import field

from ..core import scenes
from ..core.scenes import Scene

SIZE = 0.06  # of its sides [m]
ENERGY = 160.0  # that it takes to open an area [J/m^2]; catalogue and source: docs/cutting.md
_SPARE = 5.0  # times the square root of its nodes: room for a cut around and one astray
# Ours: a firm sheet on a centimetre of fat of 10 kPa, of 6 g. It is stretched by 4 %, so that a cut
# gapes: tension is E t 0.04 / (1 - nu).
_TISSUE = {"young": 1e6, "thickness": 0.0015, "tension": 110.0}
_TISSUE |= {"damping": 0.005, "foundation": 1e6}
_MASS, _SKIN = 0.006, 0.0005  # [kg], radius of the flex [m]
# What lies around: the wall, and fat of its own; ours.
_HELD = situs.Arrangement(without=(*catalog.DUCTS, "fat"))
_LOWERED = 30  # times that a sheet is lowered onto an organ
_COLOUR, _FRAME = (0.87, 0.62, 0.52, 1.0), "0.55 0.58 0.62"


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
  """Returns the scene of `cut`, ready to be compiled; what cuts is the instrument's `edge`."""
  tissue = _TISSUE | {"cutters": f"{scene.instrument}/edge {ENERGY}"}
  spec = stretched(scene, tissue, _MASS, spare=_SPARE)
  spec.option.gravity = np.zeros(3)
  return spec


def slit(
  vertices: np.ndarray, triangles: np.ndarray, span: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
  """Returns a sheet turned by a right angle, with a slit along y, near the middle of x.

  Args:
    vertices: of `sheet`, whose rows run along x [m]  (nvert, 3)
    triangles: of it                                  (nelem, 3)
    span: where along y the vertices are that it divides [m]

  Returns:
    vertices and triangles, and the two vertices of each place of the slit, by y  (n, 2).
  """
  vertices = vertices[:, [1, 0, 2]] * (-1.0, 1.0, 1.0)
  row = vertices[np.abs(vertices[:, 0]).argmin(), 0]
  low, high = vertices[:, 1] > span[0], vertices[:, 1] < span[1]
  lips = np.flatnonzero((np.abs(vertices[:, 0] - row) < 1e-9) & low & high)
  other = np.arange(len(vertices))
  other[lips] = len(vertices) + np.arange(len(lips))
  right = vertices[triangles, 0].mean(axis=1) > row
  triangles = np.where(right[:, None], other[triangles], triangles)
  return np.concatenate([vertices, vertices[lips]]), triangles, np.stack([lips, other[lips]], 1)


def laid_over(vertices: np.ndarray, organ: str, landmark: str) -> np.ndarray:
  """Returns a flat sheet with the relief of an organ around a landmark, the middle in the origin.

  The sheet's z is the normal there, its y goes up the organ.
  """
  shape = shapes.anatomy(organ)
  at, ahead = shape.implicit, 1e-4 * np.eye(3)
  place = field.project(at, shape.landmarks[landmark][None])
  normal = at(place + ahead) - at(place - ahead)
  normal /= np.linalg.norm(normal)
  across = np.cross([0.0, 0.0, 1.0], normal)
  across /= np.linalg.norm(across)
  points = place + vertices[:, :2] @ [across, np.cross(normal, across)]
  high = np.zeros(len(points))
  for _ in range(_LOWERED):  # by no more than the distance from it
    high -= at(points + high[:, None] * normal)
  return np.column_stack([vertices[:, :2], high])


def stretched(
  scene: Scene,
  tissue: dict,
  mass: float,
  spare: float = 0.0,
  slots: int | None = None,
  span: tuple[float, float] | None = None,
  over: tuple[str, str] | None = None,
) -> mujoco.MjSpec:
  """Returns a sheet in its frame, with instruments, light and what is around.

  Args:
    scene: of the exercise
    tissue: keys of the organ
    mass: of the sheet [kg]
    spare: room for a cut, times the square root of the nodes
    slots: of the window, see `scenes.furnish`
    span: of a slit, see `slit`; None for none [m]
    over: organ and landmark whose relief it has, see `laid_over`; None for a flat one
  """
  vertices, triangles = sheet(scene.nodes)
  if span:
    vertices, triangles, _ = slit(vertices, triangles, span)
  rim = np.flatnonzero(np.abs(vertices).max(axis=1) > SIZE / 2 - 1e-6)
  if over:
    vertices = laid_over(vertices, *over)
  config = tissue | {"device": "cpu", "tolerance": scenes.TOLERANCE}
  flex = mjcf.flexcomp(
    scenes.ORGAN,
    (vertices, triangles),
    config=config,
    contact=scenes.CONTACT,
    pin=rim,
    digits=7,
    mass=mass,
    radius=_SKIN,
    rgba=_COLOUR,
  )
  bars = _frame(seen=scene.surroundings != "abdomen" and not over)
  spec = scenes.furnish(scene, flex, np.zeros(3), bars, slots)
  if spare:
    palpate.add_spare(spec, scenes.ORGAN, round(spare * np.sqrt(len(vertices))))
  if scene.surroundings == "abdomen":
    situs.dress(spec, scenes.ORGAN, over[0] if over else "wall", vertices[:, :2] / 0.15)
  lie_in_fat(spec, scene)
  return spec


def lie_in_fat(spec: mujoco.MjSpec, scene: Scene) -> None:
  """Puts fat under the organ and around it, and the abdomen around that."""
  if scene.surroundings == "abdomen":
    situs.draw(spec, "abdomen_border", _border(), situs.paint(spec, "fat"))
    situs.furnish(spec, (), arrangement=_HELD)
    situs.light(spec, scene.camera, np.zeros(3))
  if scene.surroundings != "none":
    situs.obstruct(spec, (), arrangement=_HELD, more=_border(12, 37))


def _frame(seen: bool) -> str:
  """Returns the bars around the sheet, which are seen where it is alone."""
  half, bar = SIZE / 2 + 0.003, 0.003
  sides = [(half, 0, bar, half + bar), (-half, 0, bar, half + bar)]
  sides += [(y, x, b, a) for x, y, a, b in sides]
  return "".join(
    f'<geom type="box" pos="{x} {y} 0" size="{a} {b} 0.002" rgba="{_FRAME} {seen:d}" contype="0" '
    'conaffinity="0"/>'
    for x, y, a, b in sides
  )


def _border(rings: int = 33, rays: int = 145) -> scenery.Surface:
  """Returns the fat that the sheet lies in: under it, over its sides, and in lumps around it."""
  out, around = np.meshgrid(
    np.r_[0, np.linspace(0, 1, rings)], np.linspace(0, 2 * np.pi, rays), indexing="ij"
  )
  square = (np.cos(around) ** 8 + np.sin(around) ** 8) ** (-1 / 8)  # with round corners
  far = SIZE / 2 * (0.95 + 5 * out**1.6)
  far[0] = 0.0
  x, y = far * square * np.cos(around), far * square * np.sin(around)
  lumps = scenery.bumps(3, 0.045, 0.004)(x, y) + scenery.bumps(4, 0.015, 0.001)(x, y)
  rise = np.minimum(1, 12 * out)
  z = (0.005 + lumps) * rise - 0.004 * (1 - rise)
  return scenery.lattice(np.stack([x, y, z], axis=-1), np.stack([x, y], axis=-1) / 0.14)
