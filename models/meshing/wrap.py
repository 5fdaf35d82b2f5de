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

from . import losses
from .losses import Loss
from .parts import Part, split
from .quality import Quality, angles, normals, quality, volume
from .repair import Mesh, Target, load
from .shrink_wrap import LEAST_ANGLE, LEAST_NODES, MOST_NODES, Fit, fit, foldovers

METHODS = ("even", "grid", "direct")


@dataclasses.dataclass(frozen=True)
class Report:
  """What wrapping did and how well.

  Attributes:
    method: even, grid or direct
    nodes: number of nodes
    triangles: number of triangles
    size: of the box around it [m]
    volume: enclosed [m^3]
    handles: holes that go through it, as through a ring
    foldovers: triangles folded back over their neighbours; 0, anything else is an error
    min_angle: smallest angle [deg]
    area_distortion: standard deviation of the triangles' areas over their mean; 0 is an even sheet
    angle_distortion: mean difference of the angles from 60 degrees [deg]; 0 is an even sheet
    hausdorff: largest distance between wrap and mesh, all of it, both ways [% of its diagonal]
    spacing: mean edge length [m]
    spacing_spread: standard deviation of the edge lengths over their mean
    covered: share of the mesh that lies on or in the shape; the rest is sheets without an inside
    pieces: separate bodies found in the mesh; this is a wrap of one
    gap: width of the widest gap that may have been bridged [m]
    seconds: time taken [s]
    losses: what of the mesh the wrap leaves out or fills, the largest first
  """

  method: str
  nodes: int
  triangles: int
  size: tuple[float, ...]
  volume: float
  handles: int
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
  losses: tuple[Loss, ...] = ()

  def rows(self) -> list[tuple[str, str]]:
    """Returns what and how much of it, with its unit."""
    extents = " x ".join(f"{1e3 * v:.3g}" for v in self.size)
    rows = [
      ("method", self.method),
      ("nodes", f"{self.nodes}"),
      ("triangles", f"{self.triangles}"),
      ("size", f"{extents} mm"),
      ("volume", f"{1e6 * self.volume:.4g} ml"),
      ("holes through it", f"{self.handles}"),
      ("foldovers", f"{self.foldovers}"),
      ("smallest angle", f"{self.min_angle:.3g} degrees"),
      ("spread of areas", f"{100 * self.area_distortion:.3g} % of their mean"),
      ("angles from 60 degrees", f"{self.angle_distortion:.3g} degrees in the mean"),
      ("farthest from the mesh", f"{self.hausdorff:.3g} % of its diagonal"),
      ("edges", f"{1e3 * self.spacing:.3g} mm in the mean"),
      ("spread of edges", f"{100 * self.spacing_spread:.3g} % of their mean"),
      ("mesh that has an inside", f"{100 * self.covered:.4g} %"),
      ("separate pieces in the mesh", f"{self.pieces}"),
      ("gaps bridged up to", f"{1e3 * self.gap:.3g} mm"),
      ("time", f"{self.seconds:.2g} s"),
    ]
    return rows + [("loss", str(loss)) for loss in self.losses]

  def __str__(self) -> str:
    return "\n".join(f"{name}: {value}" for name, value in self.rows())


def wrap(
  mesh, nodes: int | None = None, *, method: str = "even", scale: float | str = 1.0
) -> tuple[np.ndarray, np.ndarray, Report]:
  """Returns vertices (n, 3) [m], triangles (m, 3) and a report, of a mesh's largest body.

  What else there is in the mesh, and what of the body cannot be followed, is in `report.losses`.

  Args:
    mesh: a file that trimesh reads (OBJ, STL, PLY, glTF), a trimesh, or (vertices, triangles)
    nodes: number of nodes, 4096 by default; a grid takes the nearest side x side + 2, side even
    method: one of METHODS
    scale: metres per unit of the mesh, 0.001 for millimetres, or the unit: m, cm, mm or inch

  Raises:
    ValueError: the mesh cannot be wrapped; the message says why and what is allowed.
  """
  start = time.perf_counter()
  name, parts = _parts(mesh, nodes, method, scale)
  return _wrap(name, parts, nodes, method, start)


def wrap_pieces(
  mesh, nodes: int | None = None, *, method: str = "even", scale: float | str = 1.0
) -> list[tuple[np.ndarray, np.ndarray, Report]]:
  """Returns what `wrap` returns for every body of a mesh, the largest first.

  Args:
    mesh: as for `wrap`
    nodes: of the largest; the others get edges of the same length, and 64 nodes at least
    method: as for `wrap`
    scale: as for `wrap`
  """
  name, parts = _parts(mesh, nodes, method, scale)
  bodies = [part for part in parts if part.volume > losses.SPECK * parts[0].volume]
  specks = parts[len(bodies) :]
  out, edge = [], 0.0
  for k, part in enumerate(bodies):
    start = time.perf_counter()
    count, title = nodes, name
    if k and method != "direct":
      area = np.linalg.norm(normals(*part.mesh), axis=1).sum() / 2
      count = min(max(round(2 / np.sqrt(3) * area / edge**2), LEAST_NODES), MOST_NODES)
    if len(bodies) > 1:
      title = f"{name}, piece {k + 1}"
    out.append(_wrap(title, [part] if k else [part, *specks], count, method, start))
    edge = edge or out[0][2].spacing
  return out


def _parts(mesh, nodes: int | None, method: str, scale: float | str) -> tuple[str, list[Part]]:
  """Returns a name for messages and the bodies of a mesh; checks the options."""
  check(nodes, method)
  name, vertices, triangles = load(mesh, scale)
  return name, split(vertices, triangles)


def check(nodes: int | None, method: str) -> None:
  """Raises a ValueError for options that no mesh can be wrapped with."""
  if method not in METHODS:
    raise ValueError(f"method is {method!r}, expected one of {', '.join(METHODS)}")
  if nodes is not None and not LEAST_NODES <= nodes <= MOST_NODES:
    raise ValueError(f"nodes is {nodes}, expected a number from {LEAST_NODES} to {MOST_NODES}")


def _wrap(
  name: str, parts: list[Part], nodes: int | None, method: str, start: float
) -> tuple[np.ndarray, np.ndarray, Report]:
  """Returns the wrap of the first of the parts of a mesh, and a report that has the others."""
  body, found = parts[0].mesh, None
  if method == "direct":
    mesh = _direct(name, *body, nodes)
  else:
    try:
      found = fit(name, body, nodes or 4096, method)
    except ValueError as error:
      if _wrong(quality(*body)):
        raise
      raise ValueError(f"{error}; method='direct' keeps the mesh as it is") from None
    mesh = found.mesh
  return *mesh, _report(method, mesh, parts, found, start)


def _direct(name: str, vertices: np.ndarray, triangles: np.ndarray, nodes: int | None) -> Mesh:
  """Returns the mesh itself, wound outward; raises a ValueError if it is not good enough."""
  if nodes not in (None, len(vertices)):
    raise ValueError(
      f"{name}: nodes is {nodes}, method='direct' keeps all {len(vertices)}: leave nodes out"
    )
  if volume(vertices, triangles) < 0:
    triangles = triangles[:, ::-1].copy()
  q = quality(vertices, triangles)
  wrong = _wrong(q)
  if wrong:
    raise ValueError(f"{name}: {wrong}")
  return vertices, triangles


def _wrong(q: Quality) -> str:
  """Returns what keeps a mesh from being simulated as it is and what helps, or nothing."""
  if not q.watertight:
    return (
      "the surface is not closed, or its triangles wind in different directions; method='even' "
      "makes a closed one around it"
    )
  if not q.manifold:
    return "a node joins several surfaces; method='even' makes one around them"
  if q.components != 1:
    return f"{q.components} pieces cross each other, expected 1; method='even' makes one of them"
  if q.min_angle < LEAST_ANGLE:
    return (
      f"the smallest angle is {q.min_angle:.2g} degrees, expected {LEAST_ANGLE} or more; "
      "method='even' makes even triangles"
    )
  return ""


def _report(
  method: str, wrapped: Mesh, parts: list[Part], found: Fit | None, start: float
) -> Report:
  """Returns the report of a wrap of the first of the parts of a mesh."""
  q = quality(*wrapped)
  area = np.linalg.norm(normals(*wrapped), axis=1)
  off = np.abs(np.degrees(angles(*wrapped)) - 60)
  away, lost = _against(wrapped, parts, found, q.spacing)
  points = np.concatenate([part.mesh[0] for part in parts])
  return Report(
    method=method,
    nodes=q.nodes,
    triangles=q.triangles,
    size=tuple(np.ptp(wrapped[0], axis=0).tolist()),
    volume=q.volume,
    handles=q.genus,
    foldovers=foldovers(*wrapped, found.solid.field if found else None),
    min_angle=q.min_angle,
    area_distortion=float(area.std() / area.mean()),
    angle_distortion=float(off.mean()),
    hausdorff=100 * away / float(np.linalg.norm(np.ptp(points, axis=0))),
    spacing=q.spacing,
    spacing_spread=q.spacing_spread,
    covered=found.solid.covered if found else 1.0,
    pieces=len(parts),
    gap=float(2 * found.solid.reach) if found else 0.0,
    seconds=time.perf_counter() - start,
    losses=losses.notable(lost, parts[0].volume),
  )


def _against(
  wrapped: Mesh, parts: list[Part], found: Fit | None, edge: float
) -> tuple[float, list[Loss]]:
  """Returns the largest distance [m] between a wrap and the whole mesh, and all losses."""
  away, within = 0.0, parts[0].within
  lost = [losses.of_part(part, "piece") for part in parts[1:]]
  lost += [losses.of_part(part, "inside") for part in within]
  if found:
    surface = found.target.vertices, found.target.triangles
    away, more = losses.compare(surface, found.found.field, wrapped, edge)
    lost += more + losses.open_ends(parts[0].mesh, max(2 * found.solid.reach, 2 * edge))
  others = [*parts[1:], *within]
  if others:
    points = np.concatenate([part.mesh[0] for part in others])
    own = Target(*wrapped, 0.5 * edge)
    away = max(away, float(np.linalg.norm(own.closest(points) - points, axis=1).max()))
  return away, lost
