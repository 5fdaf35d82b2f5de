"""Supports: geoms and organs that bear an organ by springs; see `forces/supports.h`."""

import dataclasses
import functools
from typing import Any, Optional

import numpy as np
import warp as wp
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import doubles, ints, struct

from ..engine import coupling
from ..engine.model import flexes, mjstruct
from .host import Bodies, Host, Input, Lists, Nodes, edited, kernels
from .passive import Force

# Stiffness of the springs, by area, in Young's moduli an edge: an organ of that size sinks in by a
# hundredth of what its own weight makes of it.
_FIRM = 10.0
_CELLS = 1024  # as in the header


@struct
class Supported:
  """An organ that rests on geoms, and on one other organ."""

  ngeom: int  # geoms that it rests on
  restless: int  # whether what it rests on may move while it sleeps
  skin: wp.float64  # distance from which it is borne [m]
  mu: wp.float64  # friction with the other organ
  row: ints("nworld")  # which row of what follows the meshes a world has
  nouter: ints("nrow", 1)  # vertices on the surface
  stiffness: doubles("nrow", "nouter")  # of each node's spring [N/m]
  cell: doubles("nrow", 1)  # length of a cell; farther apart no nodes meet [m]
  nother: ints("nrow", 1)  # vertices on the surface of the other organ
  elem: ints("nrow", "nelem", 3)  # its triangles
  near_adr: ints("nrow", "nvert + 1")  # first of a node's triangles in `near`
  near: ints("nrow", "nnear")  # triangles of its nodes
  own: Nodes
  solve: Input
  geom: ints("ngeom")  # geoms
  friction: doubles("ngeom")  # friction with each
  free: ints("nvert")  # whether a node moves
  slip: doubles("nworld", "nouter", 3)  # how far a node has slipped, in the plugin state [m]
  slipped: doubles("nworld", "nouter", 3)  # what it will be
  on: ints("nworld", "nouter")  # what a node rests on
  force: doubles("nworld", "nouter", 3)  # force on it, in the world [N]
  hardness: doubles("nworld", "nouter", 6)  # its spring on the change of its velocity [kg]
  corner: ints("nworld", "nouter", 3)  # nodes of the other organ that bear it
  weight: doubles("nworld", "nouter", 3)  # their shares
  other: Nodes
  below: Input
  where: doubles("nworld", "nvert", 3)  # where the other organ's nodes are in the world [m]
  next: ints("nworld", "nvert")  # next node in the same cell, -1 for none
  first: ints("nworld", _CELLS)  # first node of a cell
  mj: Bodies


_find_geoms, _find_organ, _press, _bear, _act, _feel, _keep = kernels(
  "forces/supports.h", Supported,
  *("find_geoms", "find_organ", "press", "bear", "act_supports", "feel_supports", "keep"),
)  # fmt: skip


@dataclasses.dataclass(eq=False)
class _Bed:
  """What the kernels take of the geoms, or of another organ that bears this one.

  Attributes:
    other: that organ's supports, None for geoms
    lists: what follows the meshes
    arrays: what the kernels write of that organ
    fields: what they take
  """

  other: Optional["Supports"]
  lists: Lists
  arrays: dict[str, wp.array]
  fields: Any = None


class Supports(Force):
  """What an organ rests on.

  Attributes:
    below: supports of the organs that it rests on
  """

  KEYS = ("support",)
  ENTER, END = _press, _keep

  def __init__(self, host: Host):
    super().__init__(host)
    self.count = coupling.outer(host.organ)
    self.below: list[Supports] = []
    self._arrays: dict[str, wp.array] = {}
    self._beds: list[_Bed] = []

  def __bool__(self) -> bool:
    return bool(self.host.organ.config.support)

  def take(self, declared: "Supports", twin: Any):
    """See `Force`."""
    for other in declared.below:
      self.put(twin(other))
    if self:
      self.host.need_springs()

  def put(self, other: "Supports"):
    """Lets it rest on another organ; the graphs of both have to be recorded anew."""
    self.below.append(other)
    self.follow(other)
    for each in (self, other):
      each.host.need_springs()

  def bind(self):
    """See `Force`."""
    if not self:
      return
    host, organ, m, n = self.host, self.host.organ, self.host.m, self.count
    flex, geoms = organ.window.flex, self._geoms()
    if not self._arrays:
      host.need_springs()
      wide = {"slipped": (n, 3), "force": (n, 3), "weight": (n, 3), "hardness": (n, 6)}
      self._arrays = {name: host.zeros(*shape) for name, shape in wide.items()}
      self._arrays |= {"on": host.zeros(n, dtype=int), "corner": host.zeros(n, 3, dtype=int)}
      self._arrays["on"].fill_(-1)
    on: list[Supports | None] = [None, *self.below]
    self._beds += [self._bed(other) for other in on[len(self._beds) :]]
    friction = m.geom_friction[geoms, 0]
    bodies = m.geom_bodyid[geoms]
    common = self._arrays | dict(
      ngeom=len(geoms),
      restless=int(bool(self.below) or host.may_move(bodies)),
      skin=float(m.flex_radius[flex]),
      geom=geoms,
      friction=np.maximum(friction, _friction(m, flex)),
      free=organ.free,
      slip=host.rows("slip", 3),
    )
    for bed in self._beds:
      there = None if bed.other is None else bed.other.host
      own = dict(
        mu=0.0 if there is None else max(_friction(m, h.organ.window.flex) for h in (host, there)),
        other=host.struct(Nodes)() if there is None else there.nodes,
        below=Input() if there is None else there.input,
      )
      values = common | own | bed.lists.arrays | bed.arrays
      bed.fields = host.fill(Supported, values, into=bed.fields)
    self.fields = self._beds[0].fields

  def _bed(self, other: Optional["Supports"]) -> _Bed:
    host, others, room, n = self.host, [], 0, 0
    if other is not None:  # a solid's cuts have triangles of their own
      there = other.host
      others, n = [there], coupling.outer(there.organ)
      room = max(0, coupling.sizes(there.organ)["ncorner"] - there.organ.mesh.nelem)
    arrays = {"where": host.zeros(n, 3), "next": host.zeros(n, dtype=int)}
    arrays["first"] = host.zeros(_CELLS, dtype=int)
    rooms = {"elem": room, "near": 3 * room}
    return _Bed(other, Lists(host, Supported, others, self._values(other, 0), rooms), arrays)

  def _values(self, other: Optional["Supports"], world: int) -> dict[str, np.ndarray]:
    """Returns the lists of `Supported` for the meshes of a world."""
    mesh = self.host.mesh(world)
    edge = mesh.rest[mesh.elem] - mesh.rest[mesh.elem[:, [1, 2, 0]]]
    area, length = topology.vertex_areas(mesh.rest, mesh.elem)[: self.count], topology.lengths(edge)
    firm = _FIRM * float(np.mean(self.host.config.young)) / float(length.mean())
    out = {"nouter": np.array([mesh.nouter]), "stiffness": firm * area}
    out["cell"] = np.array([2.0 * float(np.linalg.norm(edge, axis=2).max())])
    if other is None:
      none = {"nother": np.zeros(1), "elem": np.zeros((0, 3)), "near_adr": np.zeros(1)}
      return out | none | {"near": np.zeros(0)}
    below: Mesh = other.host.mesh(world)
    count = np.bincount(below.elem.ravel(), minlength=below.nskin)
    return out | {
      "nother": np.array([below.nouter]),
      "elem": below.elem,
      "near_adr": np.concatenate([[0], np.cumsum(count)]),
      "near": np.argsort(below.elem.ravel(), kind="stable") // 3,
    }

  def _geoms(self) -> np.ndarray:
    """Returns the geoms that its configuration names."""
    m, organ = self.host.m, self.host.organ
    found = [flexes.find(m, "geom", name, organ.name) for name in organ.config.support]
    return np.array([geom for geom in found if geom >= 0], int)

  @property
  def aims(self) -> bool:
    """See `Force`."""
    return bool(self.fields and self.fields.restless)

  def _find(self):
    """Finds what each node rests on."""
    for k, bed in enumerate(self._beds):
      if bed.other is None:
        self.host.launch(_find_geoms, bed.fields, self.count)
      else:
        self.host.launch(_find_organ, bed.fields, 1, k - 1)

  def enter(self):
    """See `Force`."""
    self._find()
    super().enter()

  def bear(self, other: Force):
    """See `Force`."""
    self._find()
    for k, bed in enumerate(self._beds):
      if bed.other is other:
        self.host.launch(_bear, bed.fields, 1, k - 1)

  def act(self):
    """See `Force`."""
    self._launch(_act)
    if self and self.fields.restless:
      self.host.launch(_feel, self.fields, 1)

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Force`."""
    if self:
      outer = group < self.count  # what was inside of a solid rested on nothing
      with edited(self.host.rows("slip", 3), world) as slip:
        slip[member[outer]] = slip[group[outer]]

  def reshape(self, world: int):
    """See `Force`."""
    for bed in self._beds:
      bed.lists.put(world, self._values(bed.other, world))

  def force(self) -> np.ndarray:
    """Returns the force on each vertex in the last step, of one world [N], (nouter, 3)."""
    out = np.zeros((self.host.organ.mesh.nouter, 3))
    if self._arrays:
      on, force = (self._arrays[name].numpy()[0, : len(out)] for name in ("on", "force"))
      out[on != -1] = force[on != -1]
    return out


def check(host: Host):
  """Looks at the names of what an organ rests on, and warns of what bears it by contacts too.

  Raises:
    ValueError: one does not exist.
  """
  m, organ = host.m, host.organ
  geoms = flexes.names(m, "geom")
  names = geoms + flexes.names(m)
  found = [flexes.resolve(name, organ.name, names) for name in organ.config.support]
  if None in found:
    raise ValueError(
      f"organ {organ.name!r}: support names {organ.config.support[found.index(None)]!r}, which "
      "does not exist, expected a geom or another organ"
    )
  if found:
    meets = flexes.meeting_geoms(m, organ.window.flex)
    for geom in meets:
      if geoms[geom] in found:
        _warn_twice(organ.name, geoms[geom])


@functools.cache
def _warn_twice(organ: str, geom: str):
  """Warns once, not with each mjData."""
  mjstruct.warn(
    f"organ {organ!r}: geom {geom!r} bears it by support and contact; give the geom contype "
    "and conaffinity that exclude contacts with the organ"
  )


def _friction(m: Any, flex: int) -> float:
  return float(m.flex_friction[flex, 0])
