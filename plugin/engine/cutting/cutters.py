"""Geoms that cut an organ: blades, and the two of scissors; their forces are `cutting/blades.h`.

A blade's path grows in the plugin state, step by step; here the mesh comes apart along it, a few
edges at a time, since the mesh cannot do so by less.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import dataclasses
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.cutting.topology import Report
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.step import SCHEMES
from palpate.tissue.types import Views, doubles, fill, ints, struct

from ...forces.declare_attachments import most
from ...forces.host import Bodies, Input, Nodes, Twin
from ...forces.passive import Force
from .. import coupling
from ..layout import BLADE, LAW
from ..model import flexes, mjstruct
from . import cuts, trails

if TYPE_CHECKING:
  from ..workspace import Workspace

_SLACK = 0.1  # edges of the mesh by which a blade's spring is stretched where it cuts
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


# As in the header: vertices that bear a blade.
HELD = 19


@struct
class Blades:
  """The geoms that cut an organ."""

  nblade: int  # number of them
  nelem: int  # triangles of the organ
  ntet: int  # tetrahedra, of a solid
  ahead: wp.float64  # share of the step's way at which its scheme takes forces
  gain: wp.float64  # how much of a step's stiffness its scheme has on dv
  edge: wp.float64  # mean length of the mesh's edges [m]
  geom: ints("nblade", 2)  # its geoms, the second of scissors alone; else -1
  axis: ints("nblade", 2)  # axis of each along which its edge is
  half: doubles("nblade", 2)  # half the edge's length [m]
  law: doubles("nblade", len(LAW))  # see LAW
  mesh: ints("nworld")  # which mesh a world has
  elem: ints("nelem", 3)  # triangles
  tet: ints("ntet", 4)  # tetrahedra
  flat: doubles("nvert", 3)  # rest positions as the cuts have them [m]
  state: doubles("nblade", len(BLADE))  # see BLADE
  next: doubles("nblade", len(BLADE))  # what it will be
  force: doubles("nblade", 3)  # on the tissue, in the organ's frame [N]
  point: doubles("nblade", 3)  # where it acts [m]
  held: ints("nblade", HELD)  # vertices that bear it
  share: doubles("nblade", HELD)  # of each of them
  hold: doubles("nblade", 6)  # what weighs on the change of the seat's velocity [kg]
  due: ints("nblade")  # whether the path is to come apart, and how
  own: Nodes
  solve: Input
  number: doubles("nnumber")  # see `NUMBERS`
  mj: Bodies


# Of the arrays that a step writes, a row for each.
WIDTHS = {"force": 3, "point": 3, "held": HELD, "share": HELD, "hold": 6, "next": len(BLADE)}
KERNELS = "enter_blades", "act_blades", "keep_blades"
_enter, _act, _keep = (
  Twin(each, each) for each in coupling.kernels("cutting/blades.h", Blades, *KERNELS)
)


@dataclasses.dataclass(frozen=True)
class Cutter:
  """A geom, or two, that cut an organ.

  Attributes:
    geoms: their names
    inside: whether it has gone through the wall and is there
    force: on the tissue in the last step, in the world [N]  (3,)
    energy: that opening the tissue has taken [J]
    length: of its paths so far, at rest [m]
    seat: where it is in the tissue at rest, in the world [m]  (3,)
  """

  geoms: tuple[str, ...]
  inside: bool
  force: np.ndarray
  energy: float
  length: float
  seat: np.ndarray


class Cutters(Force):
  """What cuts a workspace's organ; false where nothing does.

  Args:
    w: the workspace
  """

  KEYS = ("cutters",)

  ENTER, ACT, END = _enter, _act, _keep

  def __init__(self, w: "Workspace"):
    super().__init__(w.host)
    self._w = w
    self.names: list[tuple[str, ...]] = []
    self._arrays: dict[str, np.ndarray] = {}
    self._width = np.zeros(0)
    self.by_current: dict[int, trails.Current] = {}
    self._due: Any = ()
    self._here: Any = None  # the arrays of `fields`
    self._said = False

  def __bool__(self) -> bool:
    return bool(self.names)

  def declare(self):
    """Finds the geoms that the configuration names.

    Raises:
      ValueError: one does not exist, has no edge, or collides with the organ.
    """
    w = self._w
    if not w.config.cutters:
      return
    m = mjstruct.Model.from_address(w.model)
    rows = w.config.cutters
    found = [[_find(w, m, name, bool(row.current)) for name in row.geoms] for row in rows]
    n = len(found)
    geom, half, axis = np.full((n, 2), -1), np.zeros((n, 2)), np.zeros((n, 2), int)
    self._width = np.zeros(n)
    for i, geoms in enumerate(found):
      for k, g in enumerate(geoms):
        geom[i, k] = g
        axis[i, k], half[i, k], width = _shape(w, m, g)
        self._width[i] = max(self._width[i], width)
      if rows[i].current:
        actuator, shape = _find_actuator(w, m, rows[i].current), _shape(w, m, geoms[0])
        self.by_current[i] = trails.current(geoms[0], actuator, rows[i].energy, shape)
    self.names = [tuple(_name(m, g) for g in geoms) for geoms in found]
    self._arrays = {"geom": geom, "axis": axis, "half": half}
    w.host.need_springs()

  def law(self, m, thickness: float) -> np.ndarray:
    """Returns the rows of `Blades.law` where the wall has a thickness [m]."""
    w, rows = self._w, []
    solid, edge = w.config.elements == "solid", w.organ.mesh.whole.edge_length
    thickness = trails.PIERCED if solid else thickness
    for i, row in enumerate(w.config.cutters):
      force = row.energy * (1.0 if solid else thickness)  # of a solid by depth
      if row.current:
        rows.append((0.0, 0.0, 0.0, thickness, solid))
        continue
      stiff = force * (edge if solid else 1.0) / (_SLACK * edge)
      for g in self._arrays["geom"][i]:
        if g >= 0:
          body = int(mjstruct.view(m.geom_bodyid, m.ngeom, np.int32)[g])
          stiff = min(stiff, most(w.host, body))
      rows.append((force, row.energy * self._width[i], stiff, thickness, solid))
    return np.array(rows)

  @property
  def currents(self) -> list[str]:
    """Names of the geoms that cut by a current."""
    return [self.names[i][0] for i in self.by_current]

  def constants(self) -> dict[str, Any]:
    """Returns the fields of `Blades` that say which geoms they are and what they meet."""
    mesh, scheme = self._w.organ.mesh, SCHEMES[self._w.config.integrator]
    return self._arrays | dict(
      nblade=len(self.names),
      nelem=mesh.whole.nelem,
      ntet=len(mesh.tet),
      ahead=float(scheme.ahead),
      gain=scheme.gain(1.0, 0.0),
      edge=float(mesh.whole.edge_length),
    )

  @property
  def state(self) -> np.ndarray:
    """Where each is in the tissue, in the plugin state, (nblade, len(BLADE))."""
    return self._here.state

  def bind(self):
    """See `Force`."""
    if not self:
      return
    w, n, mesh = self._w, len(self.names), self._w.organ.mesh
    m = w.host.m
    values = {name: np.zeros((n, width)) for name, width in WIDTHS.items()}
    values |= self.constants() | dict(
      law=self.law(m, w.config.thickness),
      mesh=np.zeros(1),
      elem=mesh.elem[: mesh.whole.nelem],
      tet=mesh.tet,
      flat=mesh.rest,
      state=w.host.own.blade,
      due=np.zeros(n),
      own=w.host.nodes,
      solve=w.host.input,
      number=w.body.numbers,
      mj=w.host.bodies,
    )
    self.fields = fill(Blades, "cpu", values)
    self._here = Views(self.fields)
    self._due = self._here.due.data

  def refresh(self):
    """Takes the thickness that the wall has now."""
    if self.fields is not None:
      m = mjstruct.Model.from_address(self._w.model)
      self.fields.law.assign(self.law(m, self._w.config.thickness))

  def reshape(self, world: int):
    """See `Force`."""
    if self.fields is not None:
      mesh = self._w.organ.mesh
      self._here.elem[:] = mesh.elem[: mesh.whole.nelem]
      self._here.tet[:] = mesh.tet
      self._here.flat[:] = mesh.rest

  def open(self) -> bool:
    """Lets the mesh come apart along the paths that are long enough, or ended; returns whether."""
    opened, edge = False, self._w.organ.mesh.whole.edge_length
    for i, current in self.by_current.items():
      row = self.state[i]
      self._due[i] = trails.lay(row, edge) if self._burn(current, row) else trails.end(row)
    for i, due in enumerate(self._due):
      if due:
        given = trails.GIVEN * self._here.law[i, LAW.force] * edge
        opened = self._open(i, due == trails.ENDED, given) or opened
        self._due[i] = 0
    return opened

  def _burn(self, current: trails.Current, row: np.ndarray) -> bool:
    """Does what a step's current does; returns whether it cuts."""
    w = self._w
    m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
    power = float(mjstruct.view(d.ctrl, m.nu)[current.actuator])
    given = abs(power) * float(m.opt.timestep)  # [J]
    if given:
      w.bonds.burn(current.burning)
    if power <= 0 or not w.cuts:
      return False
    mesh, place = w.organ.mesh, mjstruct.view(d.geom_xpos, (m.ngeom, 3))[current.geom]
    line = current.line(place, mjstruct.view(d.geom_xmat, (m.ngeom, 3, 3))[current.geom])
    x, thickness = mesh.rest + w.motion()[0], w.config.thickness
    return current.burn(row, w.organ, mesh, x, w.cuts.finder, line, given, thickness)

  def _open(self, i: int, ended: bool, given: float) -> bool:
    """Opens the path of a blade; returns whether the mesh is another."""
    w, finder, way = self._w, self._w.cuts.finder, None
    if len(w.organ.mesh.tet) and i not in self.by_current:
      m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
      turn = mjstruct.view(d.geom_xmat, (m.ngeom, 3, 3))
      way = trails.along(turn, self._arrays["geom"][i], self._arrays["axis"][i])

    def cut(path: np.ndarray, depth: np.ndarray | None) -> tuple[Report, Mesh]:
      where = w.organ, w.organ.mesh, w.motion()[0], finder, way
      return cuts.cut_path(w, trails.path_of(path, depth, given, *where)), w.organ.mesh

    report, why = trails.open_path(self.state[i], w.organ, w.organ.mesh, ended, finder, cut)
    if "pinned" in why and not self._said:
      self._said = True
      mjstruct.warn(why)
    return report is not None and report.nodes > 0

  def read(self) -> list[Cutter]:
    """Returns what the cutters do."""
    out = []
    if not self:
      return out
    for names, row, force in zip(self.names, self.state, self._forces(), strict=True):
      stage, energy, length = row[[BLADE.stage, BLADE.work, BLADE.opened]]
      organ = self._w.organ
      seat = organ.origin + organ.frame @ row[BLADE.at : BLADE.at + 3]
      out.append(Cutter(names, stage == 2, force, float(energy), float(length), seat))
    return out

  def _forces(self) -> np.ndarray:
    return self._here.force @ self._w.organ.frame.T


def _name(m, geom: int) -> str:
  return mjstruct.name_of(m, m.name_geomadr, geom)


def _find_actuator(w: "Workspace", m, name: str) -> int:
  names = [mjstruct.name_of(m, m.name_actuatoradr, a) for a in range(m.nu)]
  found = flexes.resolve(name, w.organ.name, names)
  if found is None:
    raise ValueError(
      f"organ {w.organ.name!r}: cutters names {name!r}, which is no actuator of the model"
    )
  return names.index(found)


def _find(w: "Workspace", m, name: str, current: bool) -> int:
  names = [_name(m, g) for g in range(m.ngeom)]
  found = flexes.resolve(name, w.organ.name, names)
  if found is None:
    raise ValueError(
      f"organ {w.organ.name!r}: cutters names {name!r}, which is no geom of the model"
    )
  geom = names.index(found)
  flex = w.organ.flexes
  if not current and not w.cuts:
    raise ValueError(
      f"organ {w.organ.name!r}: cutters names {name!r}, which cuts by its edge, allowed only with "
      "spare"
    )
  if not current and any(geom in flexes.meeting_geoms(m, int(f)) for f in flex):
    raise ValueError(
      f"organ {w.organ.name!r}: cutters names {name!r}, which collides with it, expected a geom "
      "with contype='0' conaffinity='0': what cuts goes through"
    )
  return geom


def _shape(w: "Workspace", m, geom: int) -> tuple[int, float, float]:
  """Returns the axis of a geom along which its edge is, half its length and its width [m]."""
  kind = int(mjstruct.view(m.geom_type, m.ngeom, np.int32)[geom])
  size = mjstruct.view(m.geom_size, (m.ngeom, 3))[geom]
  if kind == _BOX:
    order = np.argsort(size)
    return int(order[2]), float(size[order[2]]), 2 * float(size[order[1]])
  if kind not in _ROUND:
    raise ValueError(
      f"organ {w.organ.name!r}: cutters names {_name(m, geom)!r}, expected a capsule, cylinder or "
      "box, whose longest axis is the edge"
    )
  return 2, float(size[1]), 2 * float(size[0])
