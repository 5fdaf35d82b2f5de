"""What a wrap leaves out of the mesh it was made from, and what it fills, each with its volume."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy

from . import raster
from .field import Field
from .parts import Part
from .repair import Target, rims

Mesh = tuple[np.ndarray, np.ndarray]

KINDS = {
  "piece": "a separate piece is left out",
  "inside": "a surface inside is left out, a cavity or tissue of its own",
  "part": "a part too thin for the nodes is left out",
  "filled": "a hole, tube or cleft is filled",
  "sheet": "a sheet without an inside is left out",
  "cap": "an open end is capped, and what it leads to is solid",
  "rest": "smaller places are left out or filled",
}
_MOST = 8  # losses that are named; the smaller ones are added up
_DEEP = 0.75  # of an edge; a mesh of such edges cuts off corners by as much
_SHALLOW = (0.4, 0.15)  # of an edge, where a hole must have been filled somewhere
SPECK = 1e-5  # of the whole's volume


@dataclasses.dataclass(frozen=True)
class Loss:
  """A place where wrap and mesh differ by more than the wrap's edges explain.

  Attributes:
    kind: one of KINDS
    volume: of the difference [m^3]
    middle: of its box [m]
    extent: the diagonal of its box [m]
  """

  kind: str
  volume: float
  middle: tuple[float, ...]
  extent: float

  def __str__(self) -> str:
    x, y, z = (f"{1e3 * v + 0.0:.0f}" for v in self.middle)
    volume = f"{1e6 * self.volume:.3g} ml" if self.volume else "no volume"
    extent = f"{1e3 * self.extent:.3g} mm across"
    return f"{KINDS[self.kind]}: {volume}, {extent}, around ({x}, {y}, {z}) mm"


def of_part(part: Part, kind: str) -> Loss:
  """Returns the loss of a whole body."""
  kind = kind if part.volume > 0 else "sheet"
  return Loss(kind, part.volume, tuple(part.middle.tolist()), part.extent)


def open_ends(mesh: Mesh, wide: float) -> list[Loss]:
  """Returns the rims of an open surface that are wider than a gap which is bridged [m]."""
  points, out = mesh[0], []
  rim, hole = rims(len(points), mesh[1])
  for k in range(hole.max(initial=-1) + 1):
    around = _loss("cap", points[rim[hole == k]].reshape(-1, 3), 0.0)
    out += [around] if around.extent > wide else []
  return out


def _loss(kind: str, points: np.ndarray, volume: float) -> Loss:
  low, high = points.min(axis=0), points.max(axis=0)
  middle = tuple(((low + high) / 2).tolist())
  return Loss(kind, volume, middle, float(np.linalg.norm(high - low)))


def notable(losses: Sequence[Loss], whole: float) -> tuple[Loss, ...]:
  """Returns the losses that are no specks beside a volume [m^3], the largest first."""
  kept = [loss for loss in losses if loss.kind in ("sheet", "cap") or loss.volume > SPECK * whole]
  kept.sort(key=lambda loss: -loss.volume)
  if len(kept) > _MOST:
    kept, rest = kept[:_MOST], kept[_MOST:]
    middle = np.mean([loss.middle for loss in rest], axis=0)
    volume, extent = sum(loss.volume for loss in rest), max(loss.extent for loss in rest)
    kept.append(Loss("rest", volume, tuple(middle.tolist()), extent))
  return tuple(kept)


def compare(surface: Mesh, shape: Field, wrapped: Mesh, edge: float) -> tuple[float, list[Loss]]:
  """Returns the largest distance between a body and its wrap, both ways [m], and the losses.

  Args:
    surface: of the body
    shape: what was found in it; it counts where the surface is not closed
    wrapped: the wrap
    edge: its mean edge [m]
  """
  nodes = len(wrapped[0])
  spacing = float(np.linalg.norm(np.ptp(surface[0], axis=0))) / (75 + 2 * np.sqrt(nodes))
  target, own = Target(*surface, spacing), Target(*wrapped, spacing)
  grid = raster.Grid.around(surface[0], spacing)
  is_closed = raster.closed(surface[1])
  if is_closed:
    given = raster.inside(surface, grid)
  else:
    index = np.indices(grid.shape).reshape(3, -1).T
    given = (shape.at(grid.place(index)) < 0).reshape(grid.shape)
  # Where bodies cross, their walls run through the inside, and are no surface.
  points = target.points[raster.depth(given)[grid.index(target.points)] <= 2]
  there = np.linalg.norm(target.closest(own.points) - own.points, axis=1)
  missed = np.linalg.norm(own.closest(points) - points, axis=1)
  made = raster.inside(wrapped, grid)
  cells, inner = edge / spacing, raster.depth(made)
  parts = regions(given & ~made, raster.depth(~made), _DEEP * cells)
  filled = regions(made & ~given, inner, _DEEP * cells)
  if not filled and is_closed and _handles(surface[1]) > _handles(wrapped[1]):
    tries = (regions(made & ~given, inner, share * cells) for share in _SHALLOW)
    filled = next((found for found in tries if found), [])
  reach = 2 * _DEEP * edge
  sheets = _sheets(grid, points[missed > reach], parts + filled, reach)
  out = []
  for kind, masks in (("part", parts), ("filled", filled), ("sheet", sheets)):
    size = 0.0 if kind == "sheet" else spacing**3
    out += [_loss(kind, grid.place(np.argwhere(m)), float(m.sum()) * size) for m in masks]
  return float(max(there.max(), missed.max(initial=0))), out


def _sheets(
  grid: raster.Grid, far: np.ndarray, known: list[np.ndarray], reach: float
) -> list[np.ndarray]:
  """Returns clusters of samples that are far from a wrap and from known losses, as masks."""
  if known:
    away = raster.depth(~np.logical_or.reduce(known)) * grid.spacing
    far = far[away[grid.index(far)] > reach]
  mask = np.zeros(grid.shape, dtype=bool)
  mask[grid.index(far)] = True
  label, count = raster.parts(_grow(mask, np.ones_like(mask), 2))
  return [mask & (label == k) for k in range(1, count + 1)]


def _handles(triangles: np.ndarray) -> int:
  """Returns how many holes go through a closed surface of one piece."""
  return 1 - (len(np.unique(triangles)) - len(triangles) // 2) // 2


def regions(only: np.ndarray, away: np.ndarray, reach: float) -> list[np.ndarray]:
  """Returns connected parts of a mask that lie somewhere further away than `reach`, as masks.

  Args:
    only: points of a grid                     (nx, ny, nz)
    away: how far away they are, in spacings   (nx, ny, nz)
    reach: in spacings
  """
  reach = max(reach, 1.5)
  label, count = raster.parts(only & (away > 0.4 * reach))
  deep = np.unique(label[only & (away > reach)])
  back = int(np.ceil(0.4 * reach)) + 1
  return [_grow(label == k, only, back) for k in range(1, count + 1) if k in deep]


def _grow(mask: np.ndarray, within: np.ndarray, times: int) -> np.ndarray:
  return np.asarray(scipy.ndimage.binary_dilation(mask, iterations=times, mask=within))
