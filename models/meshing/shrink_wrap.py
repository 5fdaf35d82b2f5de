"""A mesh of so many nodes around a body: found, meshed, and drawn onto the body's surface."""

import dataclasses
import math

import numpy as np
import scipy
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from . import losses, raster
from .field import Field
from .grid import shrink
from .quality import normals, quality
from .remesh import Edges, Project, guard, relax, remesh
from .repair import Mesh, Solid, Target, cap, solidify

LEAST_NODES, MOST_NODES = 64, 200_000
LEAST_ANGLE = 10.0  # [deg]; thinner triangles lock and need tiny steps
_REACHES = (0.65, 1.5, 3.5)  # of the grid's spacing
_LEAST_COVERED = 0.8  # of the surface; with less too much has no inside: it is open
_MOST_VOXELS = 2e7
_EVEN = "method='even' makes an organ with them"
_THIN = 0.25  # volume over area of a tube, in edges; half of its radius
_LOST = 1.0  # of an edge: what sticks out so far of a mesh of so many nodes is too thin for them


@dataclasses.dataclass(frozen=True)
class Fit:
  """A mesh around a body, and what it was made from.

  Attributes:
    mesh: vertices and triangles
    target: the body's surface, small holes closed
    found: the shape that was found in it
    solid: the same without what the nodes cannot follow
  """

  mesh: Mesh
  target: Target
  found: Solid
  solid: Solid


def fit(name: str, body: Mesh, nodes: int, method: str) -> Fit:
  """Returns a mesh around a body, even or a grid.

  Raises:
    ValueError: there is none; the message says why and what helps.
  """
  made = _fit(name, body, nodes, method)
  wrong = _spoilt(*made.mesh, made.solid)
  if not wrong:
    return made
  for fewer in (nodes // 2, nodes // 4):
    if fewer >= LEAST_NODES and _follows(body, fewer, method):
      raise ValueError(f"{name}: {wrong} with {nodes} nodes; {fewer} can follow it")
  raise ValueError(f"{name}: {wrong}, nor with fewer nodes; expected smoother or thicker walls")


def _follows(body: Mesh, nodes: int, method: str) -> bool:
  """Returns whether so many nodes can be wrapped around a body."""
  try:
    made = _fit("", body, nodes, method)
  except ValueError:
    return False
  return not _spoilt(*made.mesh, made.solid)


def _fit(name: str, body: Mesh, nodes: int, method: str) -> Fit:
  """Returns a mesh around a body, which may be spoilt."""
  target, found, fine = _solid(name, *body, nodes)
  solid, fine, rough = _trim(found, fine, nodes)
  onto, clinging = solid.field.projector(), _clinging(target, solid)
  if method == "even":
    smooth = relax(*rough, onto, 20)
    vertices, triangles = relax(*smooth, clinging, 10)
  else:
    handles = quality(*fine).genus
    if handles:
      raise ValueError(f"{name}: {handles} holes go through it, expected none of a grid; {_EVEN}")
    rough = remesh(*fine, min(2000, len(fine[0]) // 2), onto, iterations=15)
    vertices, triangles = smooth = shrink(*rough, round(np.sqrt(nodes / 4)), onto)
  vertices = guard(vertices, clinging(vertices), triangles)
  mesh = _stretch(vertices, triangles, solid, flips=method == "even")
  if _spoilt(*mesh, solid):  # clinging to crossing or repeated walls can fold: do without
    mesh = smooth
  return Fit(mesh, target, found, solid)


def _solid(
  name: str, vertices: np.ndarray, triangles: np.ndarray, nodes: int
) -> tuple[Target, Solid, Mesh]:
  """Returns the surface with its holes capped, the shape in it, and the shape's fine mesh."""
  size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
  vertices, triangles = cap(vertices, triangles)
  finest = float(np.cbrt(np.prod(np.ptp(vertices, axis=0)) / _MOST_VOXELS))
  spacing = max(size / (50 + 1.25 * np.sqrt(nodes)), finest)
  # Marching cubes makes 1.5 nodes for every square of the grid on the surface.
  most = int(0.5 * np.linalg.norm(normals(vertices, triangles), axis=1).sum() / 2 / finest**2)
  for _ in range(3 if nodes <= most else 0):
    target = Target(vertices, triangles, spacing / 2)
    solid, fine = _inside(name, target, spacing)
    if len(fine[0]) >= 2.2 * nodes:
      return target, solid, fine
    most = int(len(fine[0]) / 2.2)
    spacing = max(spacing / max(1.05 * np.sqrt(2.2 * nodes / len(fine[0])), 1.2), finest)
  raise ValueError(f"{name}: nodes is {nodes}, expected at most {most} for so small a surface")


def _inside(name: str, target: Target, spacing: float) -> tuple[Solid, Mesh]:
  """Returns the shape in the surface and its fine mesh, keeping air out as little as it takes.

  A farther reach is tried for fewer holes through the shape: what it closes was narrow.
  """
  problem, found, least = "", None, math.inf
  for reach in _REACHES:
    solid = solidify(target, spacing, reach * spacing)
    if solid is None or solid.covered < _LEAST_COVERED:
      if raster.closed(target.triangles):
        problem = f"it is thinner than {1e3 * spacing:.2g} mm in most places, expected thicker"
      else:
        problem = (
          f"the surface is open, by a hole wider than {2e3 * reach * spacing:.2g} mm, or thinner "
          f"than {1e3 * spacing:.2g} mm, expected one around an inside: close it in a mesh editor"
        )
      continue
    fine = solid.field.surface(-solid.shell)
    handles = quality(*fine).genus
    if handles < least:
      found, least = (solid, fine), handles
    if not least:
      break
  if found is None:
    raise ValueError(f"{name}: {problem}")
  return found


def _trim(solid: Solid, fine: Mesh, nodes: int) -> tuple[Solid, Mesh, Mesh]:
  """Returns the shape without what so many nodes cannot follow, a fine mesh, and one of so many.

  A vessel thinner than the edges is gone from a mesh of so many nodes; left in the shape, it would
  draw single nodes out into spikes.
  """
  rough = remesh(*fine, nodes, solid.field.projector(), iterations=5)
  edge = quality(*rough).spacing
  made = raster.inside(rough, solid.grid)
  for tube in _tubes(*rough, edge):
    made &= ~raster.inside((rough[0], tube), solid.grid)
  lost = losses.regions(
    (solid.field.value < -solid.shell) & ~made,
    raster.depth(~made),
    _LOST * edge / solid.field.spacing,
  )
  if not lost:
    return solid, fine, rough
  trimmed = solid.without(np.logical_or.reduce(lost))
  cut = trimmed.field.surface(-trimmed.shell)
  if quality(*cut).genus > quality(*fine).genus or len(cut[0]) < nodes:
    return solid, fine, rough
  return trimmed, cut, remesh(*cut, nodes, trimmed.field.projector(), iterations=5)


def _tubes(vertices: np.ndarray, triangles: np.ndarray, edge: float) -> list[np.ndarray]:
  """Returns the triangles of tubes that are three nodes around, each with a lid.

  A loop of three edges that are no triangle's is a neck; what is behind it is a tube, if that is
  thin too: a vessel is, a lobe on a thin stalk is not.

  Args:
    vertices: nodes [m]           (n, 3)
    triangles: between them       (m, 3)
    edge: their mean edge [m]
  """
  edges, out = Edges(triangles, len(vertices)), []
  for neck in _loops(edges, triangles):
    behind = triangles[_behind(edges, neck, len(triangles))]
    area = np.linalg.norm(normals(vertices, behind), axis=1).sum() / 2
    a, b, c = (vertices[behind[:, k]] - vertices[neck[0]] for k in range(3))
    if abs((a * np.cross(b, c)).sum() / 6) < _THIN * edge * area:
      out.append(np.concatenate([behind, neck[None]]))
  return out


def _loops(edges: Edges, triangles: np.ndarray) -> np.ndarray:
  """Returns loops of three edges that are no triangle, (k, 3)."""
  (a, b), nodes = edges.vert.T, len(edges.valence)
  both = np.concatenate([a, b]), np.concatenate([b, a])
  joined = coo_array((np.ones(2 * len(a)), both), shape=(nodes, nodes)).tocsr()
  edge, third = joined[a].multiply(joined[b]).nonzero()
  loops = np.unique(np.sort(np.column_stack([edges.vert[edge], third]), axis=1), axis=0)
  own = {tuple(t) for t in np.sort(triangles, axis=1).tolist()}
  return np.array([t for t in loops.tolist() if tuple(t) not in own], dtype=int).reshape(-1, 3)


def _behind(edges: Edges, neck: np.ndarray, count: int) -> np.ndarray:
  """Returns which triangles are on the side of a loop that has fewer of them, if it has two."""
  open_ = ~np.isin(edges.vert, neck).all(axis=1)
  link = coo_array((np.ones(open_.sum()), edges.tri[open_].T), shape=(count, count))
  parts, label = connected_components(link, directed=False)
  return (label == np.bincount(label).argmin()) & (parts > 1)


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
    node = np.asarray(scipy.spatial.KDTree(vertices).query(points)[1])
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


def _spoilt(vertices: np.ndarray, triangles: np.ndarray, solid: Solid) -> str:
  """Returns what keeps a wrap from being simulated, or nothing."""
  folded = foldovers(vertices, triangles, solid.field)
  if folded:
    return f"{folded} triangles are folded over, expected 0"
  least = quality(vertices, triangles).min_angle
  if least < LEAST_ANGLE:
    return f"the smallest angle is {least:.2g} degrees, expected {LEAST_ANGLE} or more"
  return ""


def _gradient(field: Field, points: np.ndarray) -> np.ndarray:
  """Returns the outward unit normals of the shape at points, (n, 3)."""
  step = field.spacing * np.eye(3)
  slope = np.stack([field.at(points + d) - field.at(points - d) for d in step], axis=1)
  return slope / np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-300)


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
