"""Procedural organs: smooth implicit shapes of anatomical size, meshed evenly.

Organ frame: x to the patient's right, y anterior, z superior (RAS), origin at the middle of the
organ, metres. An implicit shape is a function of points (n, 3) that is negative inside, positive
outside, and close to the distance near the surface.

Sizes: Gray's Anatomy, 41st ed. (2015): liver 15-17.5 cm high, 20-22.5 cm wide, 10-12.5 cm deep;
gallbladder 7-10 cm long, 3-4 cm wide, 30-50 ml; kidney 11 x 6 x 3 cm. Stomach: the model of Ferrua
and Singh, J. Food Sci. 75 (2010) R151: 34 cm along the greater curvature, 10 cm at its widest,
pylorus 1.2 cm.
"""

import dataclasses
import functools
import os
from collections.abc import Callable

import numpy as np
import scipy
from palpate.tissue import keep

from .meshing.field import Field, Implicit, project, tabulate
from .meshing.grid import shrink
from .meshing.quality import normals
from .meshing.remesh import guard, remesh

Mesh = tuple[np.ndarray, np.ndarray]
Seed = int | np.random.RandomState | None

_MIN_NODES = 100  # fewer cannot follow the organs' ducts


@dataclasses.dataclass(frozen=True)
class Anatomy:
  """An organ's shape and the places on it that have names.

  Attributes:
    implicit: the shape
    bounds: opposite corners of a box that holds it [m]  (2, 3)
    landmarks: points near the surface [m]  name -> (3,)
    patches: lines of points on the surface and a radius around them [m]  name -> ((k, 3), r)
  """

  implicit: Implicit
  bounds: np.ndarray
  landmarks: dict[str, np.ndarray]
  patches: dict[str, tuple[np.ndarray, float]]


def ellipsoid(center, radii) -> Implicit:
  """Returns an ellipsoid, to first order in the distance."""
  center, radii = np.asarray(center, float), np.asarray(radii, float)

  def implicit(x):
    scaled = (x - center) / radii
    k0 = _length(scaled)
    k1 = _length(scaled / radii)
    return k0 * (k0 - 1) / np.maximum(k1, 1e-12)

  return implicit


def tube(points, radii) -> Implicit:
  """Returns a tube of varying radius along a smooth curve through the points."""
  points, radii = np.asarray(points, float), np.asarray(radii, float)
  knots = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
  t = np.linspace(0, knots[-1], 400)
  curve, radius = (scipy.interpolate.CubicSpline(knots, of) for of in (points, radii))
  center, tangent, r, slope = curve(t), curve(t, 1), radius(t), radius(t, 1)
  tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
  tree, half = scipy.spatial.KDTree(center), (t[1] - t[0]) / 2

  def implicit(x):
    i = tree.query(x)[1]
    along = np.clip(np.einsum("nd,nd->n", x - center[i], tangent[i]), -half, half)
    nearest = center[i] + along[:, None] * tangent[i]
    return _length(x - nearest) - (r[i] + along * slope[i])

  return implicit


def _length(x: np.ndarray) -> np.ndarray:
  return np.sqrt(np.einsum("nd,nd->n", x, x))


def union(blend: float, *shapes: Implicit) -> Implicit:
  """Returns the union of shapes with creases filled over a width of `blend` [m]."""

  def implicit(x):
    out = shapes[0](x)
    for shape in shapes[1:]:
      other = shape(x)
      overlap = np.maximum(blend - np.abs(out - other), 0) / blend
      out = np.minimum(out, other) - overlap**3 * blend / 6
    return out

  return implicit


def carve(blend: float, shape: Implicit, *tools: Implicit) -> Implicit:
  """Returns the shape without the tools, with edges rounded over a width of `blend` [m]."""
  inverse = union(blend, lambda x: -shape(x), *tools)
  return lambda x: -inverse(x)


def mesh(shape: Anatomy, nodes: int) -> Mesh:
  """Returns an even mesh of the organ with the given number of nodes."""
  if nodes < _MIN_NODES:
    raise ValueError(f"nodes is {nodes}, expected {_MIN_NODES} or more")
  field = _tabulate(shape, nodes)
  vertices, triangles = remesh(*field.surface(), nodes, field.projector())
  return project(shape.implicit, vertices), triangles


def grid(name: str, side: int, seed: Seed = None) -> Mesh:
  """Returns an organ as a regular closed grid of side x side (+ 2) nodes; side is even.

  The sheet of the thesis (16 x 16 to 256 x 256), folded without a seam: see grid.octasphere.
  """
  if side < 16 or side % 2:
    raise ValueError(f"side is {side}, expected an even number of 16 or more")
  shape = anatomy(name, seed)
  field = _tabulate(shape, side * side)
  vertices, triangles = shrink(*mesh(shape, 2000), side // 2, field.projector())
  return guard(vertices, project(shape.implicit, vertices), triangles), triangles


def _tabulate(shape: Anatomy, nodes: int) -> Field:
  """Returns the shape on a grid fine enough for a number of nodes."""
  size = float((shape.bounds[1] - shape.bounds[0]).max())
  coarse = tabulate(shape.implicit, shape.bounds, size / 40).surface()
  area = np.linalg.norm(normals(*coarse), axis=1).sum() / 2
  # Marching cubes makes 1.5 nodes for every square of the grid on the surface.
  spacing = float(np.sqrt(1.5 * area / max(2.5 * nodes, 6000)))
  return tabulate(shape.implicit, shape.bounds, spacing)


def organ(name: str, nodes: int = 1000, seed: Seed = None) -> Mesh:
  """Returns an organ's mesh; seed None is the mean shape, a number a variant of it.

  Args:
    name: liver; stomach, moderately filled; gallbladder, down to its neck; kidney, the right one
      with its pelvis; or lobed, a test shape: a ball of 5 cm radius with lobes placed by the seed
    nodes: their number
    seed: of the variant
  """
  if isinstance(seed, np.random.RandomState):
    return mesh(anatomy(name, seed), nodes)

  def make() -> dict[str, np.ndarray]:
    return dict(zip(("vertices", "triangles"), mesh(anatomy(name, seed), nodes), strict=True))

  what = f"{name} {nodes} {seed}".encode() + keep.source(os.path.dirname(__file__))
  made = keep.arrays("organ", what, make)
  return made["vertices"], made["triangles"]


liver, stomach, gallbladder, kidney, lobed = (
  functools.partial(organ, name) for name in ("liver", "stomach", "gallbladder", "kidney", "lobed")
)


def anatomy(name: str, seed: Seed = None) -> Anatomy:
  """Returns the shape of an organ and its named places."""
  if name not in _SHAPES:
    raise ValueError(f"unknown organ {name!r}, expected one of {', '.join(sorted(_SHAPES))}")
  random = np.random.RandomState(seed) if isinstance(seed, int | np.integer) else seed
  if name == "lobed":
    return _lobed(random if random is not None else np.random.RandomState(0))
  mean = _SHAPES[name]()
  return mean if random is None else _vary(mean, random)


def landmarks(name: str, seed: Seed = None) -> dict[str, np.ndarray]:
  """Returns the organ's named points on the surface [m], name -> (3,); seed as for the mesh."""
  shape = anatomy(name, seed)
  names, points = list(shape.landmarks), np.array(list(shape.landmarks.values())).reshape(-1, 3)
  return dict(zip(names, project(shape.implicit, points, steps=20), strict=True))


def patches(name: str, vertices: np.ndarray, seed: Seed = None) -> dict[str, np.ndarray]:
  """Returns the nodes where the organ is attached (ligaments, vessels), name -> indices.

  Every patch has three nodes at least. The seed is the one the mesh was made with.
  """
  shape, out = anatomy(name, seed), {}
  for patch, (line, radius) in shape.patches.items():
    at = np.linspace(0, len(line) - 1, 40)
    points = np.stack([np.interp(at, np.arange(len(line)), x) for x in line.T], axis=1)
    distance = scipy.spatial.KDTree(project(shape.implicit, points, steps=20)).query(vertices)[0]
    third = np.sort(distance)[2]
    out[patch] = np.flatnonzero(distance <= max(radius, third))
  return out


def inclusion_young(
  vertices: np.ndarray,
  triangles: np.ndarray,
  center: np.ndarray,
  radius: float,
  young: float,
  young_inclusion: float,
) -> np.ndarray:
  """Returns Young's modulus of every triangle [Pa], (m,), over a hidden stiff inclusion.

  A bell of the distance d to the inclusion, young + (young_inclusion - young) exp(-(d/radius)^2):
  the surface feels stiffer the closer it is to what lies under it.
  """
  middle = vertices[triangles].mean(axis=1)
  distance = np.linalg.norm(middle - np.asarray(center), axis=1)
  return young + (young_inclusion - young) * np.exp(-((distance / radius) ** 2))


def _cm(shape: Implicit, low, high, marks: dict, lines: dict) -> Anatomy:
  """Returns an organ from a shape, a box and places in centimetres."""
  return Anatomy(
    implicit=lambda x: shape(x * 100) / 100,
    bounds=np.array([low, high]) / 100,
    landmarks={name: np.array(point) / 100 for name, point in marks.items()},
    patches={name: (np.array(line) / 100, r / 100) for name, (line, r) in lines.items()},
  )


def _liver() -> Anatomy:
  # The dome under the diaphragm, cut from below by what the liver lies on.
  right = ellipsoid([3.2, 0, -0.3], [7.8, 6.2, 8.0])
  left = ellipsoid([-4.0, 1.4, 2.4], [7.2, 4.6, 4.0])
  down = np.array([-0.42, -0.48, -0.77]) / np.linalg.norm([0.42, 0.48, 0.77])
  viscera = ellipsoid(np.array([1.0, 0, -3.2]) + 20 * down, [20, 20, 20])
  stomach = ellipsoid([-7.2, -3.4, -1.0], [5.6, 5.0, 4.4])
  body = carve(1.6, union(4.5, right, left), viscera, stomach)
  caudate_lobe = ellipsoid([-0.4, -3.2, 0.4], [1.5, 1.7, 2.8])
  kidney = ellipsoid([6.2, -6.6, -4.6], [3.0, 3.0, 4.4])
  vena_cava = ellipsoid([1.4, -6.5, 2.0], [1.3, 1.8, 9.0])
  round_ligament = ellipsoid([-1.6, 3.4, -3.6], [0.5, 3.0, 2.0])
  gallbladder = tube([[2.8, 4.6, -8.0], [2.6, 1.5, -5.7], [2.0, -1.2, -4.0]], [1.4, 1.3, 0.8])
  shape = carve(1.5, union(1.2, body, caudate_lobe), kidney, vena_cava, round_ligament, gallbladder)
  marks = {
    "dome": [4, 0, 8],
    "right_lobe": [6, 5, 0],
    "left_lobe": [-5, 5, 3],
    "left_tip": [-11, 1.6, 2.6],
    "inferior_tip": [8, 1, -8],
  }
  lines = {
    "coronary_ligament": ([[7, -4, 4.5], [3.5, -4, 6], [0, -3.5, 5.5], [-4, -2, 4.5]], 0.8),
    "falciform_ligament": ([[-1.2, -1, 6.5], [-1.2, 3, 5], [-1.4, 5, 1.5]], 0.6),
    "vena_cava": ([[0.9, -5, 4], [0.9, -5, 0]], 1.0),
    "porta_hepatis": ([[1.5, -1.5, -3], [-1, -1.5, -2]], 0.8),
  }
  return _cm(shape, [-12, -9, -10], [13, 9, 10], marks, lines)


def _stomach() -> Anatomy:
  axis = [
    [-6.2, -0.9, 6.0], [-6.3, -0.3, 3.0], [-5.7, 0.6, -0.5], [-4.3, 1.6, -4.0],
    [-1.2, 2.2, -6.6], [2.6, 2.0, -6.4], [5.6, 0.8, -4.6], [7.4, -0.4, -3.4],
  ]  # fmt: skip
  body = tube(axis, [3.6, 4.4, 4.3, 3.8, 3.2, 2.5, 1.4, 1.3])
  fundus = ellipsoid([-6.6, -1.1, 6.6], [4.4, 4.0, 4.6])
  esophagus = tube([[-0.4, -1.2, 8.6], [-1.4, -1.0, 6.2], [-4.0, -0.6, 3.0]], [1.1, 1.1, 1.4])
  shape = union(2.0, union(3.0, body, fundus), esophagus)
  marks = {
    "fundus": [-7, -1.1, 10.8],
    "body": [-6, 4.5, 2],
    "greater_curvature": [-9.5, 0.5, -1.5],
    "lesser_curvature": [-1.8, 0.5, 0],
    "angular_notch": [0, 1.5, -3.2],
    "antrum": [2.6, 4.6, -6.4],
  }
  lines = {
    "cardia": ([[-0.1, -1.2, 9.7], [-0.4, -1.2, 8.6]], 1.3),
    "pylorus": ([[8.6, -1, -2.8], [7.6, -0.5, -3.4]], 1.5),
    "greater_omentum": ([[-10, 0, 2], [-9, 1, -3], [-5, 2, -8], [1, 2.3, -9.8]], 0.5),
    "lesser_omentum": ([[-1.9, -0.2, 4], [-1.6, 0.5, 0], [0.3, 1.5, -3.3], [4, 1, -3]], 0.5),
  }
  return _cm(shape, [-12.5, -7, -12], [10.5, 8, 12.5], marks, lines)


def _gallbladder() -> Anatomy:
  axis = [
    [1.3, 2.4, -1.7], [0.7, 0.8, -0.7], [0.1, -1.1, 0.5], [-0.6, -2.5, 1.5], [-1.5, -3.4, 1.7],
  ]  # fmt: skip
  pear = tube(axis, [1.5, 1.65, 1.2, 0.62, 0.42])
  pouch = ellipsoid([0.5, -1.5, 0.2], [0.8, 0.9, 0.8])  # Hartmann's pouch
  shape = union(0.6, pear, pouch)
  marks = {"fundus": [1.9, 3.6, -2.5], "body": [0.7, 1.8, -2.2], "infundibulum": [1.2, -1.6, -0.4]}
  lines = {
    "neck": ([[-1.9, -3.8, 1.8], [-1.5, -3.4, 1.7]], 0.6),
    "bed": ([[1.0, 2.0, 0.4], [0.7, 0.8, 0.9], [0.1, -1.0, 1.7]], 0.6),
  }
  return _cm(shape, [-3, -5, -4.5], [4, 5, 3.5], marks, lines)


def _kidney() -> Anatomy:
  straight = union(
    4.0, ellipsoid([0.5, 0, 1.6], [2.7, 1.65, 3.9]), ellipsoid([0.5, 0, -1.6], [2.5, 1.55, 3.9])
  )

  def bean(x):  # the poles lean to the spine
    return straight(x + np.array([0.035, 0, 0]) * x[:, 2:] ** 2)

  sinus = ellipsoid([-3.0, 0.1, 0], [1.9, 1.0, 1.9])
  pelvis = tube([[-1.0, 0, 0], [-2.6, -0.1, -0.1], [-3.8, -0.2, -0.7]], [1.0, 0.8, 0.6])
  shape = union(0.9, carve(1.0, bean, sinus), pelvis)
  marks = {
    "upper_pole": [-0.4, 0, 5.5],
    "lower_pole": [-0.4, 0, -5.5],
    "lateral_border": [3.4, 0, 0],
    "anterior": [0.5, 2, 0],
  }
  lines = {
    "hilum": ([[-4.4, -0.2, -0.9], [-3.8, -0.2, -0.7]], 0.9),
    "back": ([[0.3, -2, 3], [0.5, -2, 0], [0.3, -2, -3]], 0.6),
  }
  return _cm(shape, [-5, -3.5, -7], [5, 3.5, 7], marks, lines)


def _lobed(random: np.random.RandomState) -> Anatomy:
  toward = random.normal(size=(6, 3))
  toward /= np.linalg.norm(toward, axis=1, keepdims=True)
  height = random.uniform(-0.2, 0.4, size=6)

  def ball(x):
    r = np.maximum(_length(x), 1e-9)
    bump = np.exp(6 * (np.einsum("nd,kd->nk", x / r[:, None], toward) - 1))
    return r - 5 * (1 + np.einsum("nk,k->n", bump, height))

  return _cm(ball, [-9.5] * 3, [9.5] * 3, {"top": [0, 0, 5]}, {"bottom": ([[0, 0, -5]], 1.5)})


def _vary(mean: Anatomy, random: np.random.RandomState) -> Anatomy:
  """Returns a variant: lengths within 8 %, and slow waves of 2 % of the size."""
  size = float((mean.bounds[1] - mean.bounds[0]).max())
  scale = random.uniform(0.92, 1.08, size=3)
  wave = random.normal(size=(3, 3))
  wave *= 2 * np.pi / size / np.linalg.norm(wave, axis=1, keepdims=True)
  phase = random.uniform(0, 2 * np.pi, size=3)
  height = random.normal(size=(3, 3)) * 0.02 * size / np.sqrt(3)

  def to_mean(x):
    angle = np.einsum("nd,kd->nk", x, wave) + phase
    return x / scale + np.einsum("nk,kd->nd", np.sin(angle), height)

  def from_mean(y):
    x = y * scale
    for _ in range(50):
      x = x - (to_mean(x) - y) * scale
    return x

  return Anatomy(
    implicit=lambda x: mean.implicit(to_mean(x)),
    bounds=mean.bounds * 1.15,
    landmarks={name: from_mean(point[None])[0] for name, point in mean.landmarks.items()},
    patches={name: (from_mean(line), r) for name, (line, r) in mean.patches.items()},
  )


_SHAPES: dict[str, Callable[..., Anatomy]] = {
  "liver": _liver,
  "stomach": _stomach,
  "gallbladder": _gallbladder,
  "kidney": _kidney,
  "lobed": _lobed,
}
