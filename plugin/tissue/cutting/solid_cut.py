"""Cuts in solids: a path sweeps a sheet inward, and tetrahedra on its two sides come apart.

The sheet is found here, the rest is `cutting/solid/solid_cut.h`. Tetrahedra keep their numbers and
none is added, so that what is stored by tetrahedron stays, and so does the room that arrays need.
"""

import dataclasses

import numpy as np
import warp as wp

from .. import solid
from ..config import Config
from ..geometry import faces
from ..geometry.mesh import Mesh, distinct
from ..kernels import aim, kernel
from ..order import addresses
from ..step import OWN_SHARE
from ..types import CONSTANTS, allocate, also, doubles, flags, ints, longs, struct
from .cut import Cut, Cutting, Motion, Native, numbers
from .cut_surface import sweep
from .path import Finder

_APART, _NOTHING, _HELD, _FULL = range(4)  # how it went, as in cutting/solid/solid_cut.h
_FOUND = (
  "status", "stopped", "moved", "near", "split", "changed", "mouth", "triangles", "nouter",
)  # fmt: skip
_SIZE = ("bad", "area", "depth", "deviation")
_MESH = ("rest", "tet", "ring", "degree")  # of `Mesh` and of `Cleaving`, what a cut changes
_BY_TRIANGLE = ("elem", "of_tet")


# What of these fields are those of `Cutting`.
_OF_CUTTING = (
  *("npath", "nint", "nreal", "given", "home", "mass", "disp", "vel", "pinned", "path"),
  *("near", "group", "member", "share", "ints", "reals"),
)


@struct
@also(Cutting, *_OF_CUTTING)
class Cleaving:
  """What cuts of solids of one whole read and write; `Mesh` says what the first fields are."""

  nvert: int
  ntet: int
  nelem: int  # triangles of the skin
  nskin: int
  nspare: int
  most: int  # neighbours that a vertex has room for
  most_spare: int  # and those of a spare one
  most_elem: int  # triangles that there may be
  nouter: int
  ntriangle: int  # triangles before the cut
  nline: int
  closes: int
  energy: int  # whether moving vertices must not raise that of tetrahedra
  edge: wp.float64  # mean length of the skin's edges before the first cut [m]
  before: wp.float64  # see `sheet.Sheet.more` [m]
  after: wp.float64  # [m]
  foundation: wp.float64  # stiffness by area [N/m^3]
  rest: doubles("nvert", 3)
  tet: longs("ntet", 4)
  ring: longs("nvert", "most")
  degree: longs("nvert")
  elem: longs("most_elem", 3)
  of_tet: longs("most_elem", 3)
  loose: flags("most_elem")
  whole_tet: longs("ntet", 4)
  whole_degree: longs("nvert")
  mate: longs("nface")
  begin: ints("nvert + 1")  # of the corners around each vertex of the whole
  around: ints("nface")  # these
  seat: ints("nvert")  # a corner that each vertex has, -1 for none
  triangle: ints("nface")  # the triangle that a face is, -1 for none
  mu: doubles("ntet")  # of tetrahedra [Pa]
  lam: doubles("ntet")  # [Pa]
  begin_line: doubles("nline", 3)
  end_line: doubles("nline", 3)
  found: ints(len(_FOUND))  # see _FOUND
  size: doubles(len(_SIZE))  # see _SIZE
  changed: ints("ntet")
  sat: ints("nvert")
  mouth: ints("nmouth", 2)  # edges of the skin that came apart, some of them twice


_CONSTANTS = CONSTANTS | numbers(FOUND=_FOUND, SIZE=_SIZE) | {"OWN_SHARE": OWN_SHARE}
_cleave = kernel("cleave_solid", "cutting/solid/solid_cut.h", Cleaving, _CONSTANTS)


class Cleaver(Native):
  """Cuts solids of one whole, one after the other.

  Args:
    whole: the solid before the first cut, as `faces.cuttable` makes it
    finder: of its surfaces
    room: triangles that there may be
  """

  FOUND, SIZE = _FOUND, _SIZE

  def __init__(self, whole: Mesh, finder: Finder, room: int):
    self._whole, self._finder = whole, finder
    self._mesh: Mesh | None = None
    self._config: Config | None = None
    ntet, nvert = len(whole.tet), whole.nvert
    sizes = {"nvert": nvert, "ntet": ntet, "nelem": whole.nelem}
    sizes |= {"most": whole.ring.shape[1], "most_elem": room, "nface": 4 * ntet}
    # What cutting/solid/solid_cut.h takes of scratch, see there.
    sizes["nint"] = 92 * ntet + 40 * nvert + 8 * room
    sizes["nreal"] = 70 * nvert + 26 * ntet + 18 * room
    sizes |= {"nmouth": 3 * (room - whole.nelem), "npath": 0, "nline": 0}
    fields = allocate(Cleaving, "cpu", sizes)
    fields.nskin, fields.nspare = whole.nskin, whole.spare
    fields.most_spare, fields.edge = int(faces.room(whole).max()), whole.edge_length
    names = "nvert", "ntet", "nelem", "most", "most_elem", "nint", "nreal"
    self._aim(_cleave, fields, Cleaving, {name: sizes[name] for name in names})
    corner = whole.tet.ravel()
    fixed = {"whole_tet": whole.tet, "whole_degree": whole.degree, "home": whole.home}
    fixed |= {"around": np.argsort(corner, kind="stable"), "mate": whole.mate}
    fixed["begin"] = addresses(np.bincount(corner, minlength=nvert))
    for name, values in fixed.items():
      self._host[name][:] = values

  def cut(
    self,
    organ: str,
    mesh: Mesh,
    motion: Motion,
    points: np.ndarray,
    pinned: np.ndarray,
    depth: float | np.ndarray | None = None,
    direction: np.ndarray | None = None,
    config: Config | None = None,
    given: float = 0.0,
  ) -> Cut:
    """Returns the solid cut under the path on its skin that is nearest to points.

    Args:
      organ: its name, for messages
      mesh: the solid
      motion: what its vertices carry; mass, momentum and angular momentum are kept
      points: the path, in the organ's frame [m]   (n, 3)
      pinned: vertices that do not move            (nvert,) bool
      depth: of the cut, or None, see `sheet.sweep`
      direction: in which it goes, or None, see there
      config: material, whose energy in tetrahedra moving vertices must not raise, or None
      given: but by so much around each, since what cuts has brought it [J]

    Raises:
      ValueError: the path is off the skin or too short, goes through pinned tissue, or the depth is
        not allowed.
    """
    sheet = sweep(organ, mesh, self._finder, mesh.rest + motion.disp, points, depth, direction)
    self._put(mesh)
    fields, host = self._fields, self._host
    aim(fields, path=sheet.path, begin_line=sheet.begin, end_line=sheet.end)
    fields.npath, fields.nline, fields.closes = len(sheet.path), len(sheet.begin), int(sheet.closes)
    fields.before, fields.after = sheet.more
    fields.nouter, fields.ntriangle = mesh.nouter, mesh.nelem
    fields.energy, fields.given = int(config is not None), given
    fields.foundation = 0.0 if config is None or config.carrier else config.foundation
    if config is not None and config != self._config:
      host["mu"][:], host["lam"][:] = solid.moduli(mesh, config)
      self._config = config
    return self._answer(organ, mesh, motion, self._run(motion, pinned))

  def _put(self, mesh: Mesh):
    """Makes the arrays those of a mesh."""
    if mesh is self._mesh:
      return
    host, n = self._host, mesh.nelem
    for name in _MESH:
      host[name][:] = getattr(mesh, name)
    for name in _BY_TRIANGLE:
      host[name][:n] = getattr(mesh, name)
    host["loose"][:n] = 0 if mesh.loose is None else mesh.loose
    host["seat"][:] = host["triangle"][:] = -1
    host["seat"][mesh.tet.ravel()] = np.arange(mesh.tet.size)
    host["triangle"][faces.corner_face(mesh.of_tet)] = np.arange(n)
    self._mesh = mesh

  def _answer(self, organ: str, mesh: Mesh, motion: Motion, found: dict[str, int]) -> Cut:
    host = self._host
    bad, area, depth, _ = host["size"].tolist()
    status, stopped = found["status"], bool(found["stopped"])
    none = np.zeros(0, int)
    if status == _NOTHING and stopped:
      empty = dict.fromkeys(("near", "changed", "group", "member", "seat"), none)
      size = dict.fromkeys(("length", "area", "depth", "deviation"), 0.0)
      return Cut(mesh=mesh, motion=motion, moved=0, share=np.zeros(0), path=[], stopped=True,
                 **empty, **size)  # fmt: skip
    if status == _NOTHING:
      raise ValueError(
        f"organ {organ!r}: no tetrahedra come apart along the path, expected a longer or deeper "
        "one, or it was cut there before"
      )
    if status == _HELD:
      raise ValueError(
        f"organ {organ!r}: the cut goes through vertex {int(bad)}, which is pinned, expected "
        "tissue that moves"
      )
    assert status == _APART, "no scratch is left"
    ends = host["mouth"][: found["mouth"]].astype(int)
    key = distinct(ends[:, 0] * mesh.nvert + ends[:, 1])
    new = self._take(mesh, found["triangles"])
    path = new.rest[np.stack([key // mesh.nvert, key % mesh.nvert], axis=1)]
    seat = host["sat"][: found["split"]].astype(int)
    return self._cut(new, found, list(path), seat=seat, area=area, depth=depth)

  def _take(self, mesh: Mesh, n: int) -> Mesh:
    """Returns the mesh that native code has made of one, with so many triangles."""
    arrays = {name: self._host[name].copy() for name in _MESH}
    arrays |= {name: self._host[name][:n].copy() for name in _BY_TRIANGLE}
    loose = self._host["loose"][:n].astype(bool)
    self._mesh = dataclasses.replace(mesh, **arrays, loose=loose, uncut=self._whole)
    return self._mesh
