"""What an organ rests on: geoms and organs that bear it by springs; see `forces/supports.h`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import functools
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import doubles, fill, ints, struct

from .. import coupling
from ..model import flexes, mjstruct
from .passive import Beside, Bodies, Input, Nodes, may_move, nodes, solver

if TYPE_CHECKING:
  from ..workspace import Workspace

# Stiffness of the springs, by area, in Young's moduli an edge: an organ of that size sinks in by a
# hundredth of what its own weight makes of it.
_FIRM = 10.0
_CELLS = 1024  # as in the header


@struct
class Rest:
  """An organ that rests on geoms, and on one other organ."""

  ngeom: int  # geoms that it rests on
  restless: int  # whether what it rests on may move while it sleeps
  skin: wp.float64  # distance from which it is borne [m]
  cell: wp.float64  # length of a cell; farther apart no nodes meet [m]
  mu: wp.float64  # friction with the other organ
  row: ints("nworld")  # which row of what follows the meshes a world has, in a batch with cuts
  nouter: ints(1)  # vertices on the surface
  nother: ints(1)  # vertices on that of the other organ
  own: Nodes
  solve: Input
  geom: ints("ngeom")  # geoms
  friction: doubles("ngeom")  # friction with each
  free: ints("nvert")  # whether a node moves
  stiffness: doubles("nouter")  # of each node's spring [N/m]
  slip: doubles("nouter", 3)  # how far a node has slipped, in the plugin state [m]
  slipped: doubles("nouter", 3)  # what it will be
  on: ints("nouter")  # what a node rests on
  force: doubles("nouter", 3)  # force on it, in the world [N]
  hardness: doubles("nouter", 6)  # what its spring weighs on the change of its velocity [kg]
  corner: ints("nouter", 3)  # nodes of the other organ that bear it
  weight: doubles("nouter", 3)  # their shares
  other: Nodes
  below: Input
  elem: ints("nelem", 3)  # triangles of the other organ
  near_adr: ints("nvert + 1")  # first of a node's triangles in `near`
  near: ints("nnear")  # triangles of its nodes
  where: doubles("nvert", 3)  # where they are in the world [m]
  next: ints("nvert")  # next node in the same cell, -1 for none
  first: ints(_CELLS)  # first node of a cell
  mj: Bodies


KERNELS = "find_geoms", "press", "act_rests", "feel_rests", "keep"
_find_geoms, _press, _act, _feel, _keep = coupling.kernels("forces/supports.h", Rest, *KERNELS)
BELOW = "find_organ", "bear"
_find_organ, _bear = coupling.kernels("forces/supports.h", Rest, *BELOW)


class Rests(Beside):
  """What a workspace's organ rests on, and what rests on it.

  Attributes:
    below, above: workspaces of organs that it rests on, and of those that rest on it
    alone, on: what the kernels take of geoms, and of each organ below

  Args:
    w: the workspace
  """

  KEYS = ("support",)

  def __init__(self, w: "Workspace"):
    super().__init__(w)
    self.below: list = []
    self.above: list = []
    self._arrays: dict[str, Any] = {}
    self.alone: Any = None
    self.on: list = []

  def __bool__(self) -> bool:
    return bool(self._w.organ.config.support)

  @property
  def any(self) -> bool:
    """Whether it rests on something, or something on it."""
    return bool(self) or bool(self.above)

  def load(self):
    """See `Beside`."""
    if self.any:
      _press.load(wp.get_device("cpu"))

  def bind(self, model: int):
    """See `Beside`; also of organs that rest on this one, whose forces its graphs find."""
    if self.any:
      self._w.hold.need()
    for rests in (self, *(each.rests for each in self.above)):
      if rests:
        rests._bind(model)

  def _bind(self, model: int):
    """Points what the kernels take at the arrays of a model, in place: both organs launch them."""
    w, organ = self._w, self._w.organ
    m = mjstruct.Model.from_address(model)
    corner = organ.mesh.rest[organ.mesh.elem]
    edge = np.linalg.norm(corner - corner[:, [1, 2, 0]], axis=2)
    n, geoms = coupling.outer(organ), self._geoms(m)
    flex = organ.window.flex
    if not self._arrays:
      shapes = {"slipped": (n, 3), "force": (n, 3), "weight": (n, 3), "hardness": (n, 6)}
      self._arrays = {k: wp.zeros(s, dtype=wp.float64, device="cpu") for k, s in shapes.items()}
      self._arrays |= {"on": wp.full(n, -1, dtype=int, device="cpu")}
      self._arrays |= {"corner": wp.zeros((n, 3), dtype=int, device="cpu")}
    common = self._arrays | self.above_of(organ.mesh) | dict(
      row=np.zeros(1),
      ngeom=len(geoms),
      restless=int(bool(self.below) or may_move(m, _body(m, geoms))),
      skin=float(mjstruct.view(m.flex_radius, m.nflex)[flex]),
      cell=2.0 * float(edge.max()),
      own=nodes(w),
      solve=solver(w),
      geom=geoms,
      friction=np.maximum(mjstruct.view(m.geom_friction, (m.ngeom, 3))[geoms, 0], _mu(m, flex)),
      free=organ.free,
      slip=w.boxes["own"].slip,
      mj=coupling.mujoco_arrays(model, w.data, Bodies),
    )
    alone = common | _nothing() | {"other": Nodes(), "below": Input()}
    self.alone = fill(Rest, "cpu", alone, into=self.alone)
    self.on += [None] * (len(self.below) - len(self.on))
    self.on = [
      fill(Rest, "cpu", common | self._other(m, other) | below_of(other.organ.mesh), into=on)
      for other, on in zip(self.below, self.on, strict=True)
    ]

  def above_of(self, mesh: Mesh) -> dict[str, np.ndarray]:
    """Returns what of `Rest` follows from the organ's mesh."""
    organ = self._w.organ
    edge = mesh.rest[mesh.elem] - mesh.rest[mesh.elem[:, [1, 2, 0]]]
    area = topology.vertex_areas(mesh.rest, mesh.elem)[: coupling.outer(organ)]
    firm = _FIRM * float(np.mean(self._w.config.young)) / float(topology.lengths(edge).mean())
    return {"nouter": np.array([mesh.nouter]), "stiffness": firm * area}

  def _geoms(self, m) -> np.ndarray:
    names, organ = _geom_names(m), self._w.organ
    found = [flexes.resolve(name, organ.name, names) for name in organ.config.support]
    return np.array([names.index(name) for name in found if name is not None], int)

  def _other(self, m, other) -> dict[str, Any]:
    """Returns the fields of an organ that this one rests on."""
    mesh = other.organ.mesh
    mine, theirs = (w.organ.window.flex for w in (self._w, other))
    return dict(
      mu=max(_mu(m, mine), _mu(m, theirs)),
      other=nodes(other),
      below=solver(other),
      where=np.zeros((mesh.nouter, 3)),
      next=np.zeros(mesh.nouter),
      first=np.zeros(_CELLS),
    )

  def carry(self, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Beside`."""
    if self:
      carry(self._w.boxes["own"].slip.numpy(), group, member)

  def reshape(self) -> list:
    """See `Beside`."""
    if self.any and self.alone is not None:
      for rests in (self, *(each.rests for each in self.above)):
        if rests:
          rests._bind(self._w.model)
    return []

  def find(self):
    """Finds what each node rests on."""
    _launch(_find_geoms, self.alone)
    for k, each in enumerate(self.on):
      _launch(_find_organ, each, k)

  def enter(self):
    """See `Beside`."""
    if self:
      self.find()
      _launch(_press, self.alone)
    for each in self.above:
      each.rests.find()
      which = each.rests.below.index(self._w)
      _launch(_bear, each.rests.on[which], which)

  def act(self):
    """Lets the bodies feel what rests on them."""
    if self:
      _launch(_act, self.alone)
      if self.alone.restless:
        _launch(_feel, self.alone)

  def end(self):
    """Keeps how far the nodes have slipped."""
    if self:
      _launch(_keep, self.alone)

  def force(self) -> np.ndarray:
    """Returns the force on each vertex in the last step, in the world [N], (nouter, 3)."""
    out = np.zeros((self._w.organ.mesh.nouter, 3))
    if self._arrays:
      on = np.flatnonzero(self._arrays["on"].numpy()[: len(out)] != -1)
      out[on] = self._arrays["force"].numpy()[on]
    return out


def carry(slip: np.ndarray, group: np.ndarray, member: np.ndarray):
  """Gives vertices that a cut has divided the slip of what they were, see `Beside.carry`."""
  outer = group < len(slip)  # what was inside of a solid rested on nothing
  slip[member[outer]] = slip[group[outer]]


def below_of(mesh: Mesh) -> dict[str, np.ndarray]:
  """Returns what of `Rest` follows from the mesh of an organ that it rests on."""
  count = np.bincount(mesh.elem.ravel(), minlength=mesh.nskin)
  return dict(
    nother=np.array([mesh.nouter]),
    elem=mesh.elem,
    near_adr=np.concatenate([[0], np.cumsum(count)]),
    near=np.argsort(mesh.elem.ravel(), kind="stable") // 3,
  )


def meet(spaces: list) -> list:
  """Lets the organs of an mjData meet that rest on each other.

  Args:
    spaces: workspaces of the organs that there are so far, the one that has come last

  Returns:
    those whose graphs have to be recorded anew, in this order
  """
  changed = []
  for w, other, _ in flexes.named(spaces, lambda c: [(name, None) for name in c.support]):
    if other is not w:
      w.rests.below.append(other)
      other.rests.above.append(w)
      other.hold.need()
      changed += [w, other]
  return changed


def check(m, w: "Workspace"):
  """Looks at the names of what an organ rests on, and warns of what bears it by contacts too.

  Raises:
    ValueError: one does not exist.
  """
  organ, geoms = w.organ, _geom_names(m)
  names = geoms + [flexes.name(m, f) for f in range(m.nflex)]
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
    f"organ {organ!r}: geom {geom!r} bears it by support and contact, so twice; give the geom "
    "contype and conaffinity that do not meet the organ's"
  )


def _geom_names(m) -> list[str]:
  return [mjstruct.name_of(m, m.name_geomadr, g) for g in range(m.ngeom)]


def _body(m, geoms: np.ndarray) -> np.ndarray:
  return mjstruct.view(m.geom_bodyid, m.ngeom, np.int32)[geoms]


def _launch(kernel, rest, arg: int = 0):
  kernel.launch("cpu", 1, 1, arg, rest)


def _mu(m, flex: int) -> float:
  return float(mjstruct.view(m.flex_friction, (m.nflex, 3))[flex, 0])


def _nothing() -> dict[str, Any]:
  """Returns the fields of no other organ."""
  none = {"elem": (0, 3), "near_adr": 1, "near": 0, "where": (0, 3), "next": 0, "first": _CELLS}
  none |= {"nother": 1}
  return {name: np.zeros(shape) for name, shape in none.items()} | {"mu": 0.0}
