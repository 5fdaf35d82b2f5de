"""Wrapping: any surface made into the even, closed mesh that a simulation needs.

The thesis (Kotamraju 2008, chapter 3) drops a sheet of cloth on the organ by hand. Here the surface
is first made into a shape with an inside (see repair.py), then meshed by one of

- `even`: marching cubes, collapsed to the number of nodes and relaxed to even triangles;
- `grid`: the thesis's regular sheet, folded without a seam, that clings and relaxes (see grid.py);
- `direct`: the mesh as it is, if it is good already.
"""

import dataclasses
import time

import numpy as np

from .field import Field
from .grid import shrink
from .quality import Quality, angles, normals, quality, volume
from .remesh import Edges, Project, guard, relax, remesh
from .repair import SHELL, Mesh, Solid, Target, cap, load, solidify

METHODS = ("even", "grid", "direct")
_REACHES = (0.65, 1.5, 3.5)  # of the grid's spacing
_LEAST_COVERED = 0.8  # of the surface; with less too much has no inside: it is open
_LEAST_ANGLE = 10.0  # [deg]; thinner triangles lock and need tiny steps
_MOST_VOXELS = 2e7


@dataclasses.dataclass(frozen=True)
class Report:
  """What wrapping did and how well.

  Attributes:
    method: even, grid or direct
    nodes: number of nodes
    triangles: number of triangles
    foldovers: triangles folded back over their neighbours; 0, anything else is an error
    min_angle: smallest angle [deg]
    area_distortion: standard deviation of the triangles' areas over their mean; 0 is an even sheet
    angle_distortion: mean difference of the angles from 60 degrees [deg]; 0 is an even sheet
    hausdorff: largest distance between wrap and target, both ways [% of the bounding diagonal]
    spacing: mean edge length [m]
    spacing_spread: standard deviation of the edge lengths over their mean
    covered: share of the target that lies on or in the shape; the rest is sheets without an inside
    pieces: separate pieces found in the target; the largest was wrapped
    gap: width of the widest gap that was bridged without being asked [m]
    seconds: time taken [s]
  """

  method: str
  nodes: int
  triangles: int
  foldovers: int
  min_angle: float
  area_distortion: float
  angle_distortion: float
  hausdorff: float
  spacing: float
  spacing_spread: float
  covered: float
  pieces: int
  gap: float
  seconds: float

  def __str__(self) -> str:
    return "\n".join(
      f"{field.name}: {getattr(self, field.name):.4g}"
      if field.type is float
      else f"{field.name}: {getattr(self, field.name)}"
      for field in dataclasses.fields(self)
    )


def wrap(
  mesh, nodes: int | None = None, *, method: str = "even", scale: float = 1.0
) -> tuple[np.ndarray, np.ndarray, Report]:
  """Returns vertices (n, 3) [m], triangles (m, 3) and a report.

  Args:
    mesh: a file that trimesh reads (OBJ, STL, PLY, glTF), a trimesh, or (vertices, triangles)
    nodes: number of nodes, 4096 by default; a grid takes the nearest side x side + 2, side even
    method: one of METHODS
    scale: metres per unit of the mesh, 0.001 for millimetres

  Raises:
    ValueError: the mesh cannot be wrapped; the message says why and what is allowed.
  """
  start = time.perf_counter()
  if method not in METHODS:
    raise ValueError(f"method is {method!r}, expected one of {', '.join(METHODS)}")
  if nodes is not None and not 64 <= nodes <= 200_000:
    raise ValueError(f"nodes is {nodes}, expected a number from 64 to 200000")
  name, vertices, triangles = load(mesh, scale)
  if method == "direct":
    vertices, triangles = _direct(name, vertices, triangles, nodes)
    return vertices, triangles, _report(method, vertices, triangles, start)
  nodes = nodes or 4096
  target, solid, fine = _solid(name, vertices, triangles, nodes)
  onto, clinging = solid.field.projector(), _clinging(target, solid)
  if method == "even":
    smooth = remesh(*fine, nodes, onto, iterations=25)
    vertices, triangles = relax(*smooth, clinging, 10)
  else:
    rough = remesh(*fine, min(2000, len(fine[0]) // 2), onto, iterations=15)
    vertices, triangles = smooth = shrink(*rough, round(np.sqrt(nodes / 4)), onto)
  vertices = guard(vertices, clinging(vertices), triangles)
  vertices, triangles = _stretch(vertices, triangles, solid, flips=method == "even")
  report = _report(method, vertices, triangles, start, target, solid)
  if _spoilt(report):  # clinging to crossing or repeated walls can fold: do without
    vertices, triangles = smooth
    report = _report(method, vertices, triangles, start, target, solid)
  if _spoilt(report):
    raise ValueError(f"{name}: {_spoilt(report)}; another number of nodes may follow it better")
  return vertices, triangles, report


def _spoilt(report: Report) -> str:
  """Returns what keeps a wrap from being simulated, or nothing."""
  if report.foldovers:
    return f"{report.foldovers} triangles are folded over, expected 0"
  if report.min_angle < _LEAST_ANGLE:
    return f"the smallest angle is {report.min_angle:.2g} degrees, expected {_LEAST_ANGLE} or more"
  return ""


def _direct(name: str, vertices: np.ndarray, triangles: np.ndarray, nodes: int | None) -> Mesh:
  """Returns the mesh itself, wound outward; raises a ValueError if it is not good enough."""
  if nodes not in (None, len(vertices)):
    raise ValueError(f"{name}: has {len(vertices)} nodes and method='direct' keeps them all")
  if volume(vertices, triangles) < 0:
    triangles = triangles[:, ::-1].copy()
  q = quality(vertices, triangles)
  wrong = _wrong(q)
  if wrong:
    raise ValueError(f"{name}: {wrong}; method='even' repairs it")
  return vertices, triangles


def _wrong(q: Quality) -> str:
  """Returns what keeps a mesh from being simulated as it is, or nothing."""
  if not q.watertight:
    return "the surface is not closed, or its triangles wind in different directions"
  if not q.manifold:
    return "a node joins several surfaces"
  if q.components != 1:
    return f"{q.components} separate pieces, expected 1"
  if q.genus:
    return f"{q.genus} handles, expected none"
  if q.min_angle < _LEAST_ANGLE:
    return f"the smallest angle is {q.min_angle:.2g} degrees, expected {_LEAST_ANGLE} or more"
  return ""


def _solid(
  name: str, vertices: np.ndarray, triangles: np.ndarray, nodes: int
) -> tuple[Target, Solid, Mesh]:
  """Returns the surface with its holes capped, the shape in it, and the shape's fine mesh."""
  size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
  vertices, triangles = cap(vertices, triangles)
  spacing = size / (50 + 1.25 * np.sqrt(nodes))
  for _ in range(3):
    if np.prod(np.ptp(vertices, axis=0) / spacing + 8) > _MOST_VOXELS:
      break
    target = Target(vertices, triangles, spacing / 2)
    solid, fine = _inside(name, target, spacing)
    if len(fine[0]) >= 2.2 * nodes:
      return target, solid, fine
    spacing /= max(1.05 * np.sqrt(2.2 * nodes / len(fine[0])), 1.2)
  raise ValueError(f"{name}: too small a surface for {nodes} nodes, expected fewer")


def _inside(name: str, target: Target, spacing: float) -> tuple[Solid, Mesh]:
  """Returns the shape in the surface and its fine mesh, keeping air out as little as it takes."""
  problem = ""
  for reach in _REACHES:
    solid = solidify(target, spacing, reach * spacing)
    if solid is None or solid.covered < _LEAST_COVERED:
      problem = (
        f"the surface is open (by a hole wider than {2 * reach * spacing:.2g} m) or thinner than "
        f"{SHELL * spacing:.2g} m, expected a surface around an inside"
      )
      continue
    fine = solid.field.surface(-solid.shell)
    handles = quality(*fine).genus
    if not handles:
      return solid, fine
    problem = f"the surface has {handles} handles (holes through it), expected none"
  raise ValueError(f"{name}: {problem}")


def _clinging(target: Target, solid: Solid) -> Project:
  """Returns a function that moves points onto the shape and from there onto the target."""
  field = solid.field
  onto, near = field.projector(), 0.5 * (solid.reach + field.spacing)

  def project(points):
    points = onto(points)
    gap = target.closest(points) - points
    normal = _gradient(field, points)
    step = np.einsum("nd,nd->n", gap, normal)
    step = np.where(np.linalg.norm(gap, axis=1) < near, step, 0.0)
    return points + step[:, None] * normal

  return project


def _stretch(vertices: np.ndarray, triangles: np.ndarray, solid: Solid, flips: bool) -> Mesh:
  """Returns the mesh with its nearest nodes moved out to corners and edges that it cuts off."""
  from scipy.spatial import KDTree

  spacing, points = solid.field.spacing, solid.exposed
  # The chords of a bend of radius s, the edge length, miss it by s / 8: that is no corner.
  fine = max(0.25 * spacing, 0.15 * quality(vertices, triangles).spacing)
  for _ in range(10):
    own = Target(vertices, triangles, spacing / 2)
    missed = np.linalg.norm(own.closest(points) - points, axis=1)
    far = np.flatnonzero(missed > fine)
    if not len(far):
      break
    points, missed = points[far], missed[far]  # the other nodes hardly move
    node = np.asarray(KDTree(vertices).query(points)[1])
    order = np.argsort(missed, kind="stable")
    worst, goal = np.zeros(len(vertices)), vertices.copy()
    worst[node[order]], goal[node[order]] = missed[order], points[order]
    # Neighbours would be in each other's way: the one that misses most goes first.
    first = (worst > 0) & (worst == -Edges(triangles, len(vertices)).lowest(-worst))
    moved = np.where(first[:, None], goal, vertices)
    moved = guard(vertices, moved, triangles, least_angle=21.0)
    if np.array_equal(moved, vertices):
      break
    vertices = moved
    if flips:
      vertices, triangles = relax(vertices, triangles, lambda x: x, iterations=0)
  return vertices, triangles


def _gradient(field: Field, points: np.ndarray) -> np.ndarray:
  """Returns the outward unit normals of the shape at points, (n, 3)."""
  step = field.spacing * np.eye(3)
  slope = np.stack([field.at(points + d) - field.at(points - d) for d in step], axis=1)
  return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)


def _report(
  method: str,
  vertices: np.ndarray,
  triangles: np.ndarray,
  start: float,
  target: Target | None = None,
  solid: Solid | None = None,
) -> Report:
  q = quality(vertices, triangles)
  area = np.linalg.norm(normals(vertices, triangles), axis=1)
  off = np.abs(np.degrees(angles(vertices, triangles)) - 60)
  return Report(
    method=method,
    nodes=q.nodes,
    triangles=q.triangles,
    foldovers=foldovers(vertices, triangles, solid.field if solid else None),
    min_angle=q.min_angle,
    area_distortion=float(area.std() / area.mean()),
    angle_distortion=float(off.mean()),
    hausdorff=_hausdorff(vertices, triangles, target, solid) if target and solid else 0.0,
    spacing=q.spacing,
    spacing_spread=q.spacing_spread,
    covered=solid.covered if solid else 1.0,
    pieces=solid.pieces if solid else 1,
    gap=2 * solid.reach if solid else 0.0,
    seconds=time.perf_counter() - start,
  )


def foldovers(vertices: np.ndarray, triangles: np.ndarray, field: Field | None = None) -> int:
  """Returns the number of triangles folded back on a neighbour by over 150 degrees.

  With the shape's field, only those that face into the shape: the two sides of a thin edge do not.
  """
  edges = Edges(triangles, len(vertices))
  normal = normals(vertices, triangles)
  normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
  bend = np.einsum("ed,ed->e", *normal[edges.tri].transpose(1, 0, 2))
  folded = np.unique(edges.tri[bend < np.cos(np.radians(150))])
  if field is None:
    return len(folded)
  outward = _gradient(field, vertices[triangles[folded]].mean(axis=1))
  return int((np.einsum("md,md->m", outward, normal[folded]) < 0).sum())


def _hausdorff(vertices: np.ndarray, triangles: np.ndarray, target: Target, solid: Solid) -> float:
  """Returns the two-sided Hausdorff distance in % of the target's bounding diagonal."""
  own = Target(vertices, triangles, solid.field.spacing / 2)
  there = np.linalg.norm(target.closest(own.points) - own.points, axis=1).max()
  back = np.linalg.norm(own.closest(solid.exposed) - solid.exposed, axis=1).max(initial=0)
  size = np.linalg.norm(np.ptp(solid.exposed, axis=0))
  return float(100 * max(there, back) / size)
