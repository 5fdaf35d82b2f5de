"""Geoms that cut an organ: blades, and the two of scissors; their forces are `cutting/blades.h`.

A blade's path grows step by step, in the plugin state or what a batch keeps of it; here the meshes
come apart along it, a few edges at a time, since they cannot do so by less.
"""

import dataclasses
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.tissue.cutting.facets import Path
from palpate.tissue.cutting.topology import Report
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import doubles, ints, struct

from ..engine.cutting import trails
from ..engine.layout import BLADE, LAW
from ..engine.model import flexes, mjstruct
from .declare_attachments import most
from .host import Bodies, Host, Input, Nodes, kernels, numbers
from .passive import Force, Opening

_SLACK = 0.1  # edges of the mesh by which a blade's spring is stretched where it cuts
_ROUND = (int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_CYLINDER))
_BOX = int(mujoco.mjtGeom.mjGEOM_BOX)


# As in the header: vertices that bear a blade.
_HELD = 19


@struct
class Blades:
  """The geoms that cut an organ."""

  nblade: int  # number of them
  nelem: int  # triangles of the organ
  ntet: int  # tetrahedra, of a solid
  ahead: wp.float64  # see `Host.fill`
  gain: wp.float64
  edge: wp.float64  # mean length of the mesh's edges [m]
  geom: ints("nblade", 2)  # its geoms, the second of scissors alone; else -1
  axis: ints("nblade", 2)  # axis of each along which its edge is
  half: doubles("nblade", 2)  # half the edge's length [m]
  law: doubles("nworld", "nblade", len(LAW))  # see LAW
  mesh: ints("nworld")  # which mesh a world has
  elem: ints("nmesh", "nelem", 3)  # triangles
  tet: ints("nmesh", "ntet", 4)  # tetrahedra
  flat: doubles("nmesh", "nvert", 3)  # rest positions as the cuts have them [m]
  state: doubles("nworld", "nblade", len(BLADE))  # see BLADE
  next: doubles("nworld", "nblade", len(BLADE))  # what it will be
  force: doubles("nworld", "nblade", 3)  # on the tissue, in the organ's frame [N]
  point: doubles("nworld", "nblade", 3)  # where it acts [m]
  held: ints("nworld", "nblade", _HELD)  # vertices that bear it
  share: doubles("nworld", "nblade", _HELD)  # of each of them
  hold: doubles("nworld", "nblade", 6)  # what weighs on the change of the seat's velocity [kg]
  due: ints("nworld", "nblade")  # whether the path is to come apart, and how
  own: Nodes
  solve: Input
  number: numbers
  mj: Bodies


# Of the arrays that a step writes, a row for each.
_WIDTHS = {"force": 3, "point": 3, "share": _HELD, "hold": 6, "next": len(BLADE)}
_enter, _act, _keep = kernels(
  "cutting/blades.h", Blades, "enter_blades", "act_blades", "keep_blades"
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
  """What cuts an organ; false where nothing does.

  Attributes:
    names: of the geoms of each
    by_current: those that cut by a current, by their number
    geoms: fields of `Blades` that say which they are
  """

  KEYS = ("cutters",)
  ACT, END = _act, _keep

  def __init__(self, host: Host):
    super().__init__(host)
    self.count = 1  # a warp a world
    self.names: list[tuple[str, ...]] = []
    self.by_current: dict[int, trails.Current] = {}
    self.geoms: dict[str, np.ndarray] = {}
    self._width = np.zeros(0)
    self._due: Any = None  # of one world, looked at in every step
    self._said = False

  def __bool__(self) -> bool:
    return bool(self.names)

  def declare(self):
    """Finds the geoms that the configuration names.

    Raises:
      ValueError: one does not exist, has no edge, or collides with the organ.
    """
    host, m, rows = self.host, self.host.m, self.host.config.cutters
    if not rows:
      return
    found = [[_find(host, name, bool(row.current)) for name in row.geoms] for row in rows]
    n = len(found)
    geom, half, axis = np.full((n, 2), -1), np.zeros((n, 2)), np.zeros((n, 2), int)
    self._width = np.zeros(n)
    skin = float(m.flex_radius[host.organ.flexes[0]])
    for i, geoms in enumerate(found):
      for k, g in enumerate(geoms):
        geom[i, k] = g
        axis[i, k], half[i, k], width = _shape(host, g)
        self._width[i] = max(self._width[i], width)
      if rows[i].current:
        actuator = flexes.need(m, "actuator", rows[i].current, host.organ.name, "cutters")
        shape = _shape(host, geoms[0])
        self.by_current[i] = trails.current(geoms[0], actuator, rows[i].energy, shape, skin)
    self.names = [tuple(_name(m, g) for g in geoms) for geoms in found]
    self.geoms = {"geom": geom, "axis": axis, "half": half}
    host.need_springs()

  def take(self, declared: "Cutters", twin: Any):
    """See `Force`; without room for cuts only bonds feel currents, see `Bonds.currents`."""
    if declared and self.host.organ.mesh.spare:
      self.names, self.by_current = declared.names, declared.by_current
      self.geoms, self._width = declared.geoms, declared._width
      self.host.need_springs()

  def _law(self, thickness: float) -> np.ndarray:
    """Returns the rows of `Blades.law` where the wall has a thickness [m]."""
    host, rows, m = self.host, [], self.host.m
    solid, edge = host.config.elements == "solid", host.organ.mesh.whole.edge_length
    thickness = trails.PIERCED if solid else thickness
    for i, row in enumerate(host.config.cutters):
      force = row.energy * (1.0 if solid else thickness)  # of a solid by depth
      if row.current:
        rows.append((0.0, 0.0, 0.0, thickness, solid))
        continue
      stiff = force * (edge if solid else 1.0) / (_SLACK * edge)
      for g in self.geoms["geom"][i]:
        if g >= 0:
          body = int(m.geom_bodyid[g])
          stiff = min(stiff, most(host, body))
      rows.append((force, row.energy * self._width[i], stiff, thickness, solid))
    return np.array(rows)

  @property
  def currents(self) -> list[str]:
    """Names of the geoms that cut by a current."""
    return [self.names[i][0] for i in self.by_current]

  @property
  def aims(self) -> bool:
    """See `Force`."""
    return bool(self)

  def bind(self):
    """See `Force`."""
    if not self:
      return
    host, n = self.host, len(self.names)
    values: dict[str, Any] = {name: host.zeros(n, width) for name, width in _WIDTHS.items()}
    law = self._law(host.config.thickness)
    values |= self.geoms | host.surface() | dict(
      nblade=n,
      edge=float(host.organ.mesh.whole.edge_length),
      law=np.tile(law, (host.nworld, 1, 1)),
      state=host.rows("blade", len(BLADE)),
      held=host.zeros(n, _HELD, dtype=int),
      due=host.zeros(n, dtype=int),
    )
    self.fields = host.fill(Blades, values, into=self.fields)
    self._due = self.fields.due.numpy()[0].data if host.alone else None

  def refresh(self, thickness: Any, worlds: Any = (0,)):
    """Takes the thickness that the wall of worlds has now [m], one each."""
    if self.fields is not None:
      law = self.fields.law.numpy()
      for world, each in zip(worlds, thickness, strict=True):
        law[world] = self._law(float(each))
      self.fields.law.assign(law)

  def enter(self):
    """See `Force`; in a batch, what is due is kept until the host has looked."""
    if self:
      self.host.launch(_enter, self.fields, self.count, not self.host.alone)

  # The meshes come apart.

  def open(self, opening: Opening, steps: int = 1) -> bool:
    """See `Force`: along the paths that are long enough, or ended."""
    if not self or (self._due is not None and not self.by_current and not any(self._due)):
      return False
    fields, host = self.fields, self.host
    due, state, currents = fields.due.numpy(), fields.state.numpy(), self.by_current
    acts, power = due.any(axis=1), host.tools("ctrl") if currents else np.zeros(0)
    for i, current in currents.items():
      given = power[:, current.actuator]
      acts |= (given != 0 if host.alone else given > 0) | (state[:, i, BLADE.count] > 0)
    worlds = np.flatnonzero(acts).tolist()
    if not worlds:
      return False
    opening.begin(worlds)
    law, edge, opened = fields.law.numpy(), host.organ.mesh.whole.edge_length, False
    turn = host.tools("geom_xmat") if currents or fields.ntet else np.zeros(0)
    for i, current in currents.items():
      place, given = host.tools("geom_xpos"), steps * float(host.m.opt.timestep) * power  # [m], [J]
      for world in worlds:
        row, g = state[world, i], current.geom
        line = current.line(place[world, g], turn[world, g])
        how = line, float(given[world, current.actuator]), float(law[world, i, LAW.wall])
        burns = self._burn(current, row, opening, world, *how)
        due[world, i] = trails.lay(row, edge) if burns else trails.end(row)
    for world in worlds:
      for i in np.flatnonzero(due[world]).tolist():
        given, way = trails.GIVEN * float(law[world, i, LAW.force]) * edge, None
        if fields.ntet and i not in currents:
          way = trails.along(turn[world], self.geoms["geom"][i], self.geoms["axis"][i])
        ended = bool(due[world, i] == trails.ENDED)
        opened = self._open(state[world, i], ended, given, way, opening, world) or opened
        due[world, i] = 0
    opening.finish()
    if not host.alone:
      fields.state.assign(state)
      fields.due.assign(due)
    return opened

  def _burn(
    self, current: trails.Current, row: np.ndarray, opening: Opening, world: int,
    line: tuple[np.ndarray, np.ndarray], given: float, wall: float,
  ) -> bool:  # fmt: skip
    """Lets a path follow a current that has brought an energy [J]; returns whether it cuts."""
    organ = self.host.organ
    if given:
      opening.burn(current)
    if given <= 0 or not organ.mesh.spare:
      return False
    mesh = opening.mesh(world)
    x = mesh.rest + opening.disp(world)
    return current.burn(row, organ, mesh, x, opening.finder, line, given, wall)

  def _open(
    self, row: np.ndarray, ended: bool, given: float, way: np.ndarray | None, opening: Opening,
    world: int,
  ) -> bool:  # fmt: skip
    """Opens the path of a blade in a world; returns whether the mesh is another."""
    organ, finder = self.host.organ, opening.finder

    def cut(path: np.ndarray, depth: np.ndarray | None) -> tuple[Report, Mesh]:
      along = Path(path, given, at_rest=True)
      if depth is not None:
        where = organ, opening.mesh(world), opening.disp(world), finder, way
        along = trails.path_of(path, depth, given, *where)
      return opening.cut(world, along), opening.mesh(world)

    report, why = trails.open_path(row, organ, opening.mesh(world), ended, finder, cut)
    if "pinned" in why and self.host.alone and not self._said:
      self._said = True
      mjstruct.warn(why)
    return report is not None and report.nodes > 0

  def read(self) -> list[Cutter]:
    """Returns what the cutters do, of one world."""
    out = []
    if not self:
      return out
    organ, fields = self.host.organ, self.fields
    force = fields.force.numpy()[0] @ organ.frame.T
    for names, row, each in zip(self.names, fields.state.numpy()[0], force, strict=True):
      stage, energy, length = row[[BLADE.stage, BLADE.work, BLADE.opened]]
      seat = organ.origin + organ.frame @ row[BLADE.at : BLADE.at + 3]
      out.append(Cutter(names, stage == 2, each, float(energy), float(length), seat))
    return out


def _name(m, geom: int) -> str:
  return mjstruct.name_of(m, "geom", geom)


def _find(host: Host, name: str, current: bool) -> int:
  m, flex = host.m, host.organ.flexes
  geom = flexes.need(m, "geom", name, host.organ.name, "cutters")
  if not current and not host.organ.mesh.spare:
    raise ValueError(
      f"organ {host.organ.name!r}: cutters names {name!r}, which cuts with its edge, allowed only "
      "with spare"
    )
  if not current and any(geom in flexes.meeting_geoms(m, int(f)) for f in flex):
    raise ValueError(
      f"organ {host.organ.name!r}: cutters names {name!r}, which collides with it, expected a "
      "geom with contype='0' conaffinity='0', since cutters pass through the tissue"
    )
  return geom


def _shape(host: Host, geom: int) -> tuple[int, float, float]:
  """Returns the axis of a geom along which its edge is, half its length and its width [m]."""
  m = host.m
  kind = int(m.geom_type[geom])
  size = m.geom_size[geom]
  if kind == _BOX:
    order = np.argsort(size)
    return int(order[2]), float(size[order[2]]), 2 * float(size[order[1]])
  if kind not in _ROUND:
    raise ValueError(
      f"organ {host.organ.name!r}: cutters names {_name(m, geom)!r}, expected a capsule, cylinder "
      "or box, whose longest axis is the edge"
    )
  return 2, float(size[1]), 2 * float(size[0])
