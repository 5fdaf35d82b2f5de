"""The surface along which a solid is cut: lines from a path on its skin inward, side by side."""

import dataclasses

import numpy as np

from ..geometry.mesh import Mesh, area_vectors, lengths
from .path import SAMPLE, Finder, check_points

_LEVEL = 0.25  # least cosine of the normals of a path's triangles to their mean for one direction
_AROUND = 0.5  # length of the mean of the normals up to which a path goes around the organ
_SMOOTH = 2.0  # edges along the path over which directions are averaged otherwise
# Edges by which a sheet right through goes on beyond the end of a path where the skin falls away,
# and the greatest cosine between direction and normal there.
_RIM, _FALLS = 1.0, 0.5


@dataclasses.dataclass(frozen=True)
class Sheet:
  """A surface of lines, at rest; `cutting/solid/cut_surface.h` says where points are beside it.

  Attributes:
    path: samples of the path on the skin [m]           (n, 3)
    begin, end: of each line [m]                        (m, 3)
    closes: whether the last line is the first one
    more: how far the sheet goes on beyond both ends of the path [m]
  """

  path: np.ndarray
  begin: np.ndarray
  end: np.ndarray
  closes: bool
  more: tuple[float, float]


def sweep(
  organ: str,
  mesh: Mesh,
  finder: Finder,
  position: np.ndarray,
  points: np.ndarray,
  depth: float | np.ndarray | None,
  direction: np.ndarray | None = None,
) -> Sheet:
  """Returns the sheet under a path on the skin.

  Args:
    organ: its name, for messages
    mesh: the solid
    finder: of its surfaces
    position: where its vertices are now [m]    (nvert, 3)
    points: the path, in the same frame [m]     (n, 3)
    depth: of the cut at rest, one or one a point; None: right through [m]
    direction: which way it goes from the skin; None: inward

  Raises:
    ValueError: the path is off the skin, or it and the depth are not allowed.
  """
  edge = mesh.whole.edge_length
  reach = _check(organ, points, depth)
  at, path, elem, inward = finder.trace(organ, mesh, position, points, normals=True)
  reach = np.interp(at, np.arange(len(points)), reach)
  new = np.flatnonzero(lengths(path[1:] - path[:-1]) > 2 * edge) + 1  # it leaps
  part = max(np.split(np.arange(len(path)), new), key=len)
  path, elem, reach = path[part], elem[part], reach[part]
  if len(path) < 2 or lengths(path[1:] - path[:-1]).sum() < SAMPLE * edge:
    raise ValueError(f"organ {organ!r}: the path is shorter than an edge of the mesh")
  inward = inward[part]
  if direction is not None:
    direction = _at_rest(organ, mesh, position, elem, direction)
  skin = mesh.rest[: mesh.whole.nouter]
  size = 2 * float(lengths(np.array([np.ptp(x) for x in skin.T])))  # by columns, which is quicker
  through = bool(np.isinf(reach).any())
  way, reach = _ways(organ, path, inward, direction, reach, edge)
  return _lines(path, way, np.minimum(reach, size), inward if through else way, edge)


def _check(organ: str, points: np.ndarray, depth) -> np.ndarray:
  check_points(organ, points)
  depth = np.inf if depth is None else np.asarray(depth, float)
  if np.ndim(depth) and np.shape(depth) != (len(points),):
    raise ValueError(
      f"organ {organ!r}: depth has shape {np.shape(depth)}, expected one number, or "
      f"({len(points)},)"
    )
  if not (depth > 0 if np.ndim(depth) == 0 else (depth > 0).all()):
    raise ValueError(f"organ {organ!r}: depth is {np.min(depth):g}, expected a number > 0 [m]")
  return np.broadcast_to(depth, len(points))


def _at_rest(organ: str, mesh: Mesh, position, elem: np.ndarray, direction) -> np.ndarray:
  """Returns a direction as it is at rest: turned back as the skin there has turned."""
  direction = np.asarray(direction, float)
  size = np.linalg.norm(direction)
  if direction.shape != (3,) or not (np.isfinite(size) and size > 0):
    raise ValueError(
      f"organ {organ!r}: direction is {direction}, expected three numbers, not all 0"
    )
  now, rest = (area_vectors(x, mesh.elem[elem]) for x in (position, mesh.rest))
  vert = mesh.elem[elem]
  arms = []
  for x, area in ((position, now), (mesh.rest, rest)):
    flat = x[vert] - x[vert].mean(axis=1, keepdims=True)
    arms.append(np.concatenate([flat.reshape(-1, 3), area / lengths(area).mean() ** 0.5]))
  u, _, vt = np.linalg.svd(arms[0].T @ arms[1])
  turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
  return direction / size @ turn


def _ways(organ: str, path, inward, direction, depth, edge: float):
  """Returns the direction of each sample's line and how far it goes, (n, 3) and (n,)."""
  if direction is not None:
    return np.broadcast_to(direction, path.shape), depth
  mean = inward.mean(axis=0)
  size = np.linalg.norm(mean)
  through = not np.isfinite(depth).all()
  if size > 0 and ((inward @ mean).min() > _LEVEL * size or (through and size > _AROUND)):
    return np.broadcast_to(mean / size, path.shape), depth
  if through:  # from all around to the middle of the path
    if np.linalg.norm(path[-1] - path[0]) > 2 * edge:
      raise ValueError(
        f"organ {organ!r}: the path goes around the organ and has no depth, expected a depth, a "
        "direction, or a path that ends where it begins"
      )
    way = path[:-1].mean(axis=0) - path
    return way / lengths(way)[:, None], lengths(way)
  gap = np.append(0.0, np.cumsum(lengths(path[1:] - path[:-1])))
  weight = np.exp(-0.5 * ((gap[:, None] - gap) / (_SMOOTH * edge)) ** 2)
  way = weight @ inward
  return way / lengths(way)[:, None], depth


def _lines(path, way, depth, inward, edge: float) -> Sheet:
  """Returns the sheet, its lines evenly spaced across themselves."""
  step = path[1:] - path[:-1]
  mid = 0.5 * (way[1:] + way[:-1])
  step = step - (step * mid).sum(1, keepdims=True) * mid / (mid * mid).sum(1, keepdims=True)
  arc = np.append(0.0, np.cumsum(lengths(step)))
  count = max(2, round(arc[-1] / (SAMPLE * edge)) + 1)
  goal = np.linspace(0, arc[-1], count)

  def spread(values):
    return np.stack([np.interp(goal, arc, column) for column in values.T], axis=1)

  begin, end = spread(path), spread(path + depth[:, None] * way)
  closes = np.linalg.norm(path[-1] - path[0]) < SAMPLE * edge and arc[-1] > 3 * edge
  if closes:
    begin[-1], end[-1] = begin[0], end[0]
  falls = [(inward[k] * way[k]).sum() < _FALLS for k in (0, -1)]
  first, last = (_RIM * edge if each and not closes else 0.0 for each in falls)
  return Sheet(path, begin, end, bool(closes), (first, last))
