"""What a wrap leaves out of the mesh it was made from, and what it fills, each with its volume."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from . import raster
from .field import Field
from .parts import Part
from .repair import Target

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
  points, triangles = mesh
  edges = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
  edges, count = np.unique(edges, axis=0, return_counts=True)
  rim = edges[count == 1]
  links = coo_array((np.ones(len(rim)), tuple(rim.T)), shape=(len(points), len(points)))
  _, which = connected_components(links, directed=False)
  out = []
  for k in np.unique(which[rim[:, 0]]):
    low, high = (f(points[which == k], axis=0) for f in (np.min, np.max))
    extent = float(np.linalg.norm(high - low))
    if extent > wide:
      out.append(Loss("cap", 0.0, tuple(((low + high) / 2).tolist()), extent))
  return out


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


class Comparison:
  """A body of a mesh, to compare a wrap of it with.

  Attributes:
    target: the body's surface
    grid: points all over it
    given: which of them lie in it  (nx, ny, nz)
  """

  def __init__(self, mesh: Mesh, shape: Field, nodes: int):
    """Samples a body.

    Args:
      mesh: its surface
      shape: what was found in it; it counts where the surface is not closed
      nodes: of the wraps to compare it with; samples are finer for more
    """
    spacing = float(np.linalg.norm(np.ptp(mesh[0], axis=0))) / (75 + 2 * np.sqrt(nodes))
    self.target = Target(*mesh, spacing)
    self.grid = raster.Grid.around(mesh[0], spacing)
    is_closed = raster.closed(mesh[1])
    self._handles = _handles(mesh[1]) if is_closed else 0
    if is_closed:
      self.given = raster.inside(mesh, self.grid)
    else:
      index = np.indices(self.grid.shape).reshape(3, -1).T
      self.given = (shape.at(self.grid.place(index)) < 0).reshape(self.grid.shape)
    # Where bodies cross, their walls run through the inside, and are no surface.
    exposed = _edt(self.given)[self.grid.index(self.target.points)] <= 2
    self._points = self.target.points[exposed]

  def of(self, wrapped: Mesh, edge: float) -> tuple[float, list[Loss]]:
    """Returns the largest distance between body and wrap, both ways [m], and the wrap's losses.

    Args:
      wrapped: the wrap
      edge: its mean edge [m]
    """
    own = Target(*wrapped, self.grid.spacing)
    there = np.linalg.norm(self.target.closest(own.points) - own.points, axis=1)
    missed = np.linalg.norm(own.closest(self._points) - self._points, axis=1)
    away = float(max(there.max(), missed.max(initial=0)))
    made = raster.inside(wrapped, self.grid)
    cells = edge / self.grid.spacing
    less, more = self.given & ~made, made & ~self.given
    parts = regions(less, _edt(~made), _DEEP * cells)
    depth = _edt(made)
    filled = regions(more, depth, _DEEP * cells)
    if not filled and self._handles > _handles(wrapped[1]):
      tries = (regions(more, depth, share * cells) for share in _SHALLOW)
      filled = next((found for found in tries if found), [])
    sheets = self._sheets(missed, parts + filled, 2 * _DEEP * edge)
    out = [self._loss("part", mask) for mask in parts]
    out += [self._loss("filled", mask) for mask in filled]
    return away, out + [self._loss("sheet", mask) for mask in sheets]

  def _sheets(self, missed: np.ndarray, known: list[np.ndarray], reach: float) -> list[np.ndarray]:
    """Returns clusters of samples, as masks, that are far from the wrap and from known losses."""
    far = self._points[missed > reach]
    if not len(far):
      return []
    if known:
      away = _edt(~np.logical_or.reduce(known)) * self.grid.spacing
      far = far[away[self.grid.index(far)] > reach]
    mask = np.zeros(self.given.shape, dtype=bool)
    mask[self.grid.index(far)] = True
    label, count = _label(_grow(mask, np.ones_like(mask), 2))
    return [mask & (label == k) for k in range(1, count + 1)]

  def _loss(self, kind: str, mask: np.ndarray) -> Loss:
    low, high = (self.grid.place(f(np.argwhere(mask), axis=0)) for f in (np.min, np.max))
    volume = 0.0 if kind == "sheet" else float(mask.sum()) * self.grid.spacing**3
    return Loss(kind, volume, tuple(((low + high) / 2).tolist()), float(np.linalg.norm(high - low)))


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
  label, count = _label(only & (away > 0.4 * reach))
  deep = np.unique(label[only & (away > reach)])
  back = int(np.ceil(0.4 * reach)) + 1
  return [_grow(label == k, only, back) for k in range(1, count + 1) if k in deep]


def _edt(mask: np.ndarray) -> np.ndarray:
  """Returns the distance of every true point to the nearest false one, in spacings."""
  return np.asarray(distance_transform_edt(mask))


def _label(mask: np.ndarray) -> tuple[np.ndarray, int]:
  return label(mask)  # pyright: ignore


def _grow(mask: np.ndarray, within: np.ndarray, times: int) -> np.ndarray:
  return np.asarray(binary_dilation(mask, iterations=times, mask=within))
