"""Cuts: a path on the surface becomes edges of the mesh, and the mesh comes apart along them.

A chain of edges near the path is found, its vertices are moved onto the path in the rest shape, as
far as no triangle gets thin, and vertices on it are doubled: `cutting/cut.h`. Triangles keep their
numbers and none is added, so that what is stored by triangle stays, and so does the room that
arrays need.
"""

import dataclasses
from typing import Any, ClassVar

import numpy as np
import warp as wp

from .. import config as configuration
from ..config import Config
from ..geometry.mesh import Mesh, lengths
from ..kernels import Kernel, aim, kernel
from ..types import CONSTANTS, allocate, doubles, flags, ints, longs, struct
from .path import Finder
from .surface import Surface, WorkingCopy, host_views

_DONE, _NO_ROOM, _SHORT, _PINNED = range(4)  # why nothing was cut, as in cutting/path.h
_KINDS = {"membrane": 1, "spring": 2}  # of energy, as in cutting/snap.h
_FOUND = (
  "status", "moved", "near", "split", "changed", "edges", "nouter", "stopped", "apart",
)  # fmt: skip
_SIZE = ("bad", "deviation")
_LISTS = "near", "changed"  # of `Cut`, as long as `found` says


def numbers(**names: tuple[str, ...]) -> dict[str, int]:
  """Returns what native code calls the numbers of FOUND and SIZE."""
  return {f"{kind}_{name.upper()}": k for kind in names for k, name in enumerate(names[kind])}


@struct
class Cutting:
  """What a cut of a surface reads and writes; the surface is another one then."""

  surface: Surface
  npath: int  # samples of the path
  nint: int  # whole numbers of scratch
  nreal: int  # others
  kind: int  # of energy: 0 none, 1 membrane, 2 springs
  held: int  # whether springs hold vertices
  edge: wp.float64  # mean length of the whole's edges [m]
  thickness: wp.float64  # [m]
  tension: wp.float64  # [N/m]
  stiffness: wp.float64  # of an edge's spring [N/m]
  given: wp.float64  # by which the energy around a vertex may rise as it moves [J]
  home: longs("nelem")  # `Mesh.home`
  mass: doubles("nvert")  # of vertices, before and after [kg]
  disp: doubles("nvert", 3)  # displacement [m]
  vel: doubles("nvert", 3)  # velocity [m/s]
  pinned: flags("nvert")  # whether a vertex does not move
  lame: doubles("nelem")  # of triangles [Pa]
  shear: doubles("nelem")  # [Pa]
  whole: doubles("nvert")  # energy of springs at vertices [J]
  pull: doubles("nvert", 3)  # its gradient [N]
  hard: doubles("nvert")  # their stiffness [N/m]
  path: doubles("npath", 3)  # its samples at rest [m]
  spot: ints("npath")  # triangles that they are in
  found: ints(len(_FOUND))  # see _FOUND; nouter is read too
  size: doubles(len(_SIZE))  # see _SIZE
  near: ints("nvert")  # see `Cut`, these and what follows
  group: ints("nvert")
  member: ints("nvert")
  share: doubles("nvert")
  changed: ints("nelem")
  seam: ints("nvert", 2)  # edges that came apart
  ints: ints("nint")  # scratch
  reals: doubles("nreal")


_CONSTANTS = CONSTANTS | numbers(FOUND=_FOUND, SIZE=_SIZE)
_cut = kernel("cut_surface", "cutting/cut.h", Cutting, _CONSTANTS)


@dataclasses.dataclass(frozen=True)
class Springs:
  """What holds vertices.

  Attributes:
    energy: of those of each vertex [J]     (nvert,)
    force: its gradient [N]                 (nvert, 3)
    stiffness: of these together [N/m]      (nvert,)
  """

  energy: np.ndarray
  force: np.ndarray
  stiffness: np.ndarray


@dataclasses.dataclass(frozen=True)
class Motion:
  """What vertices carry.

  Attributes:
    mass: [kg]                       (nvert,)
    disp: displacement from rest [m] (nvert, 3)
    vel: velocity [m/s]              (nvert, 3)
  """

  mass: np.ndarray
  disp: np.ndarray
  vel: np.ndarray


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cut:
  """What came of a path, of a sheet or a solid: elements are triangles or tetrahedra.

  Attributes:
    mesh: the mesh, cut
    motion: what its vertices carry, until the next cut
    moved: how many vertices lie elsewhere at rest
    near: vertices that move on otherwise; of a sheet without those that have come  (n,)
    changed: elements that are not as they were                (n,)
    group: vertices that were one, which                       (m,)
    member: those vertices, old and new                        (m,)
    share: their parts of its mass                             (m,)
    path: the edges that came apart at rest, on the skin [m]   list of (k, 3)
    length: of these [m]
    deviation: greatest distance of the path's vertices from it [m]
    stopped: whether there was too little room
    seat: in a solid, a corner of each member, see `faces.restored`      (m,)
    area: of the opened faces of a solid, one of each pair, at rest, else None [m^2]
    depth: how far these go below the skin, along the sheet, at most [m]
  """

  mesh: Mesh
  motion: Motion
  moved: int
  near: np.ndarray
  changed: np.ndarray
  group: np.ndarray
  member: np.ndarray
  share: np.ndarray
  path: list[np.ndarray]
  length: float
  deviation: float
  stopped: bool
  seat: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, np.int64))
  area: float | None = None
  depth: float = 0.0


class Native:
  """What native code takes for cuts of one whole, and what it writes.

  Attributes:
    FOUND, SIZE: whole numbers and others that it writes, by name
  """

  FOUND: ClassVar[tuple[str, ...]]
  SIZE: ClassVar[tuple[str, ...]]
  _fields: Any = None

  def _aim(self, kernel: Kernel, fields: Any, kind: Any, sizes: dict[str, int]):
    """Lets a kernel read and write a struct."""
    for name, size in sizes.items():
      setattr(fields, name, size)
    self._fields, self._host = fields, host_views(fields, kind)
    self._launch = kernel.command(fields).launch

  def _run(self, motion: Motion, pinned: np.ndarray) -> dict[str, int]:
    """Cuts; returns the numbers of FOUND."""
    host = self._host
    host["mass"][:], host["disp"][:], host["vel"][:] = motion.mass, motion.disp, motion.vel
    host["pinned"][:] = pinned
    self._launch()
    return dict(zip(self.FOUND, host["found"].tolist(), strict=True))

  def _cut(self, mesh: Mesh, found: dict[str, int], path: list[np.ndarray], **more: Any) -> Cut:
    """Returns what native code has written."""
    host, n = self._host, found["split"]
    lists: dict[str, Any] = {name: host[name][: found[name]].astype(int) for name in _LISTS}
    lists |= {name: host[name][:n].astype(int) for name in ("group", "member")}
    ways = [line[1:] - line[:-1] for line in path]
    return Cut(
      mesh=mesh,
      motion=Motion(host["mass"], host["disp"], host["vel"]),
      moved=found["moved"],
      share=host["share"][:n].copy(),
      path=path,
      length=float(lengths(np.concatenate(ways)).sum()) if ways else 0.0,
      deviation=float(host["size"][self.SIZE.index("deviation")]),
      stopped=bool(found["stopped"]),
      **lists,
      **more,
    )


class Knife(Native):
  """Cuts surfaces of one whole, one after the other.

  Args:
    copy: where they are
    finder: of places on them
  """

  FOUND, SIZE = _FOUND, _SIZE

  def __init__(self, copy: WorkingCopy, finder: Finder):
    self._copy, self._whole, self._finder = copy, copy.whole, finder
    self._config: Config | None = None
    self._how: tuple = ()
    self._room = 0  # for samples of a path

  def cut(
    self,
    organ: str,
    mesh: Mesh,
    motion: Motion,
    points: np.ndarray,
    pinned: np.ndarray,
    config: Config | None = None,
    held: Springs | None = None,
    given: float = 0.0,
    at_rest: bool = False,
  ) -> Cut:
    """Returns the mesh cut along the path on the surface that is nearest to points.

    Args:
      organ: its name, for messages
      mesh: the surface
      motion: what its vertices carry; mass, momentum and angular momentum are kept
      points: the path, in the same frame [m]            (n, 3)
      pinned: vertices that do not move                  (nvert,) bool
      config: material, whose energy moving vertices must not raise, or None
      held: what holds vertices, for which the same is true, or None
      given: but by so much around each, since what cuts has brought it [J]
      at_rest: whether points are on the surface at rest, not where it is now

    Raises:
      ValueError: points are off the surface; the path goes through pinned vertices, or is too
        short.
    """
    position = mesh.rest if at_rest else mesh.rest + motion.disp
    traced = self._finder.trace(organ, mesh, position, points)
    self._make_room(len(traced.elem))
    self._copy.put(mesh)
    config = config if config and config.elements in _KINDS else None
    self._put_material(config, held, given)
    host, spot = self._host, traced.elem.astype(np.int32)
    aim(self._fields, path=traced.rest, spot=spot)
    self._fields.npath = len(spot)
    host["found"][:] = 0
    host["found"][_FOUND.index("nouter")] = mesh.nouter
    found = self._run(motion, pinned)
    self._check(organ, found["status"])
    if found["changed"]:
      closed = mesh.closed and not found["split"]
      mesh = self._copy.take(mesh, closed, bool(found["apart"]), found["nouter"])
    return self._cut(mesh, found, _lines(mesh.rest, host["seam"][: found["edges"]].tolist()))

  def _make_room(self, n: int):
    """Makes the arrays, and makes them larger for a path of more samples."""
    whole = self._whole
    if n <= self._room:
      return
    n, self._config, self._how = 2 * n, None, ()
    self._room, sizes = n, self._copy.sizes | {"npath": 0}
    # What cutting/cut.h takes of scratch, see there.
    sizes["nint"] = 29 * whole.nvert + 41 * whole.nelem + 20 * n + 8 * sizes["most"] + 100
    sizes["nreal"] = 48 * whole.nvert + 9 * whole.nelem + 13 * n
    fields = allocate(Cutting, "cpu", sizes)
    fields.surface, fields.edge = self._copy.fields, whole.edge_length
    self._aim(_cut, fields, Cutting, {name: sizes[name] for name in ("nint", "nreal")})
    self._host["home"][:] = whole.home

  def _put_material(self, config: Config | None, held: Springs | None, given: float):
    fields, host = self._fields, self._host
    how = _KINDS[config.elements] if config else 0, int(held is not None), given
    if how != self._how:
      fields.kind, fields.held, fields.given = self._how = how
    if config and config is not self._config and config != self._config:
      fields.thickness, fields.tension = config.thickness, config.tension
      fields.stiffness = config.stiffness
      host["lame"][:], host["shear"][:] = configuration.lame(config, self._whole.nelem)
      self._config = config
    if held is not None:
      host["whole"][:], host["pull"][:] = held.energy, held.force
      host["hard"][:] = held.stiffness

  def _check(self, organ: str, status: int):
    """Says why nothing was cut.

    Raises:
      ValueError: nothing was.
    """
    if status == _SHORT:
      raise ValueError(
        f"organ {organ!r}: the path is shorter than two edges of the mesh there, expected a longer "
        "one"
      )
    if status == _PINNED:
      raise ValueError(
        f"organ {organ!r}: the path goes through vertex {int(self._host['size'][0])}, which is "
        "pinned, expected tissue that moves"
      )
    if status == _NO_ROOM:
      self._copy.forget()
      raise ValueError(
        f"organ {organ!r}: the path goes to and fro too often, expected shorter cuts"
      )


def _lines(rest: np.ndarray, pairs: list[list[int]]) -> list[np.ndarray]:
  """Returns edges that follow one another as polylines."""
  lines: list[list[int]] = []
  for a, b in pairs:
    if lines and lines[-1][-1] == a:
      lines[-1].append(b)
    else:
      lines.append([a, b])
  return [rest[line] for line in lines]
