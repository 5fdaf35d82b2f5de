"""Bonds: springs from an organ to what it has grown on to, which soften and break.

The kernels are in `forces/cohesive_bonds.h`; what is bonded to what is found in `adhere`.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.reading import Law
from palpate.tissue.step import SCHEMES
from palpate.tissue.types import doubles, fill, ints, struct

from .. import coupling
from ..layout import BOND
from ..model import mjstruct
from .passive import Beside, Bodies, Input, Nodes, base, may_move, nodes, solver
from .transfer import Grip, Spots

if TYPE_CHECKING:
  from ..workspace import Workspace

ON_ORGAN = -1  # in place of a body
LISTS = ("made", "vert", "slot", "area", "anchor", "normal", "corner", "weight")


@struct
class Bonded:
  """Bonds of an organ that were made together, to one body or to one other organ."""

  body: int  # body, or ON_ORGAN
  restless: int  # whether what they lead to may move while the organ sleeps
  ahead: wp.float64  # share of the step's way at which its scheme takes forces
  gain: wp.float64  # how much of a step's stiffness its scheme has on dv
  stiffness: wp.float64  # by area [N/m^3]
  strength: wp.float64  # [Pa]
  energy: wp.float64  # by area, of a bond from whole to free [J/m^2]
  live: ints(1)  # whether there are any
  row: ints("nworld")  # which row of the lists up to `weight` a world has, in a batch with cuts
  count: ints(1)  # number of bonds
  made: ints("nbond")  # which of those that were made
  vert: ints("nbond")  # vertex
  slot: ints("nbond")  # its row in `state`
  area: doubles("nbond")  # [m^2]
  anchor: doubles("nbond", 3)  # what it leads to in the axes of body or triangle [m]
  normal: doubles("nbond", 3)  # away from its bed in these axes; 0 where pressing opens it too
  corner: ints("nbond", 3)  # vertices of the other organ that hold it
  weight: doubles("nbond", 3)  # their shares
  state: doubles("nfree", len(BOND))  # see BOND
  next: doubles("nbond", len(BOND))  # what it will be
  stretch: doubles("nbond", 3)  # how far it is from what it leads to [m]
  force: doubles("nbond", 3)  # on the vertex as a step begins, in the world [N]
  pull: doubles("nbond", 3)  # on the vertex, with what the step has changed of it [N]
  hardness: doubles("nbond")  # what its spring weighs on the change of its velocity [kg]
  own: Nodes
  solve: Input
  other: Nodes
  below: Input
  number: doubles("nnumber")  # see `NUMBERS`
  mj: Bodies


@struct
class Burning:
  """A geom whose current frees bonds, see `engine.cutting.trails`."""

  bonds: Bonded
  geom: int
  axis: int  # along which it is long
  actuator: int  # whose control is its power [W]
  half: wp.float64  # of its length [m]
  reach: wp.float64  # from that line [m]
  energy: wp.float64  # that an area takes [J/m^2]
  ctrl: doubles("nu")  # controls


KERNELS = tuple(f"{verb}_bonds" for verb in ("stretch", "enter", "bear", "act", "feel", "keep"))
_stretch, _enter, _bear, _act, _feel, _keep = coupling.kernels(
  "forces/cohesive_bonds.h", Bonded, *KERNELS
)


(_burn,) = coupling.kernels("forces/cohesive_bonds.h", Burning, "burn_bonds")


@dataclasses.dataclass(frozen=True)
class Found:
  """What became of bonds on meshes that have been cut.

  Attributes:
    made: which of those that were made                   (n,)
    vert: vertices that they are on                       (n,)
    slot: their rows in the plugin state                  (n,)
    area: of each [m^2]                                   (n,)
    anchor: what each leads to in the axes of body or triangle [m] (n, 3)
    normal: away from its bed in these axes, or 0         (n, 3)
    corner: vertices of the other organ that hold each    (n, 3)
    weight: their shares                                  (n, 3)
  """

  made: np.ndarray
  vert: np.ndarray
  slot: np.ndarray
  area: np.ndarray
  anchor: np.ndarray
  normal: np.ndarray
  corner: np.ndarray
  weight: np.ndarray


@dataclasses.dataclass(eq=False)
class Group:
  """Bonds that were made together.

  Attributes:
    own: workspace of the organ
    grip: its vertices that were bonded
    made: as they were made: area of each [m^2] (n,), and in the axes of body or triangle what it
      leads to [m] (n, 3), away from its bed, or 0 (n, 3), and the organ's axes (n, 3, 3)
    law: how they hold and break
    body: body that they lead to, or ON_ORGAN
    other: workspace of the other organ, or None
    spots: the points of it that they lead to
    declared: whether the model has them, not somebody who made them while running
    now: what became of them
    arrays: what the kernels write, with room for cuts
    bonded: what they take
  """

  own: Any
  grip: Grip
  made: dict[str, np.ndarray]
  law: Law
  body: int
  other: Any
  spots: Spots | None
  declared: bool
  now: Found = dataclasses.field(init=False)
  arrays: dict[str, wp.array] = dataclasses.field(init=False)
  bonded: Any = dataclasses.field(default=None, init=False)

  def __post_init__(self):
    n = len(self.grip.vert) + self.own.organ.mesh.spare
    shapes = {name: (n, 3) for name in ("stretch", "force", "pull")}
    shapes |= {"next": (n, len(BOND)), "hardness": n}
    self.arrays = {k: wp.zeros(s, dtype=wp.float64, device="cpu") for k, s in shapes.items()}
    self.arrays |= {name: wp.ones(1, dtype=int, device="cpu") for name in ("live", "count")}
    self.arrays["row"] = wp.zeros(1, dtype=int, device="cpu")
    self._find()

  def _find(self):
    self.now = self.found(self.own.organ.mesh, self.other and self.other.organ.mesh)

  def found(self, mesh: Mesh, other: Mesh | None) -> Found:
    """Returns what became of the bonds where their organ, and the other one, have these meshes."""
    made, held = self.made, self.grip.now(mesh)
    row = held.row
    anchor = made["anchor"][row] + np.einsum("nij,nj->ni", made["turn"][row], held.shift)
    corner = weight = np.zeros((len(row), 3))
    if self.spots is not None and other is not None:
      corner, weight, turn = (each[row] for each in self.spots.now(other))
      anchor = np.einsum("nij,nj->ni", turn, anchor)
    slot = (np.cumsum(self.own.organ.free) - 1)[held.vert]
    area, normal = made["area"][row] * held.share, made["normal"][row]
    return Found(row, held.vert, slot, area, anchor, normal, corner, weight)

  def reshape(self):
    """Follows the organs, one of which was cut, in the arrays that graphs know."""
    self._find()
    bonded, n = self.bonded, len(self.now.vert)
    if bonded is None:
      return
    bonded.count.numpy()[0] = n
    for name in LISTS:
      getattr(bonded, name).numpy()[:n] = getattr(self.now, name)
    bonded.own.rest.numpy()[:] = base(self.own.organ)
    if self.other is not None:
      bonded.other.rest.numpy()[:] = base(self.other.organ)

  def bind(self, model: int):
    """Points what the kernels take at the arrays of a model, in place: both organs launch them."""
    w, other = self.own, self.other
    m, scheme = mjstruct.Model.from_address(model), SCHEMES[w.config.integrator]
    n, room = len(self.now.vert), self.arrays["hardness"].size
    self.arrays["count"].numpy()[0] = n
    values: dict[str, Any] = dict(zip(("stiffness", "strength", "energy"), self.law, strict=True))
    for name in LISTS:
      value = getattr(self.now, name)
      values[name] = np.concatenate([value, np.zeros((room - n, *value.shape[1:]))])
    values |= self.arrays
    values |= dict(
      body=self.body,
      restless=int(other is not None or may_move(m, self.body)),
      ahead=float(scheme.ahead),
      gain=scheme.gain(1.0, 0.0),
      state=w.bonds.rows("bond", len(BOND)),
      own=nodes(w),
      solve=solver(w),
      other=Nodes() if other is None else nodes(other),
      below=Input() if other is None else solver(other),
      number=w.body.numbers,
      mj=coupling.mujoco_arrays(model, w.data, Bodies),
    )
    self.bonded = fill(Bonded, "cpu", values, into=self.bonded)

  def springs(self, now: Found, state: np.ndarray, stretch: np.ndarray) -> tuple:
    """Returns vertices, stiffness [N/m], and stretch in the organ's frame [m] of the bonds.

    Args:
      now: what became of them
      state: damage and more of the organ's vertices, as in the plugin state
      stretch: of each in the world [m]  (n, 3), and more
    """
    whole = 1.0 - state[now.slot, BOND.damage].clip(0.0, 1.0)
    stretch = stretch[: len(now.vert)] @ self.own.organ.frame
    return now.vert, self.law.stiffness * now.area * whole, stretch

  def launch(self, kernel):
    """Launches one of the kernels above over it."""
    kernel.launch("cpu", 1, 1, 0, self.bonded)


def carry(organ, state: np.ndarray, group, member, share):
  """Gives vertices of an organ that a cut has divided their part, see `Beside.carry`."""
  outer = group < organ.mesh.nskin  # what was inside of a solid had none
  group, member, share = group[outer], member[outer], share[outer]
  slot = np.cumsum(organ.free) - 1
  damage, released = BOND.damage, BOND.released
  state[slot[member], damage] = state[slot[group], damage]
  state[slot[member], released] = share * state[slot[group], released]


def alike(a: Group, b: Group) -> bool:
  """Returns whether bonds of two mjData of a model are the same."""
  arrays = all(np.array_equal(a.made[name], b.made[name]) for name in a.made)
  arrays = arrays and np.array_equal(a.grip.vert, b.grip.vert)
  others = (group.other and group.other.organ.name for group in (a, b))
  return arrays and (a.body, a.law) == (b.body, b.law) and len(set(others)) == 1


class Bonds(Beside):
  """The bonds of a workspace's organ, and those that others have to it.

  Args:
    w: the workspace
  """

  KEYS = ("bonds",)

  ENTER = _enter

  def __init__(self, w: "Workspace"):
    super().__init__(w)
    self.groups: list[Group] = []
    self.borne: list[Group] = []  # of other organs, which lead to this one

  def __bool__(self) -> bool:
    return bool(self.groups or self.borne)

  def put(self, group: Group):
    """Adds bonds; the graphs of both organs have to be recorded anew."""
    self.groups.append(group)
    self._w.hold.need()
    if group.other is not None:
      group.other.bonds.borne.append(group)
      group.other.hold.need()

  def let_go(self):
    """Takes away what was made while running."""
    for group in [g for g in self.groups if not g.declared]:
      group.arrays["live"].zero_()
      self.groups.remove(group)
      if group.other is not None:
        group.other.bonds.borne.remove(group)

  def springs(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Returns vertices, stiffness [N/m], and stretch in the organ's frame now [m] of its bonds."""
    out = []
    for group in self.groups:
      group.launch(_stretch)
      now, stretch = group.now, group.arrays["stretch"].numpy()
      out.append(group.springs(now, self.state, stretch))
    return out

  def reshape(self) -> list:
    """See `Beside`."""
    for group in (*self.groups, *self.borne):
      group.reshape()
    return []

  def carry(self, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Beside`."""
    if self._w.config.bonded:
      carry(self._w.organ, self.state, group, member, share)

  def burn(self, current: dict[str, Any]):
    """Weakens the bonds near a geom with a current; see `Burning`."""
    ctrl = coupling.mujoco_arrays(self._w.model, self._w.data, Burning).ctrl
    for group in self.groups:
      fields = fill(Burning, "cpu", current | {"bonds": group.bonded, "ctrl": ctrl})
      _burn.launch("cpu", 1, 1, 0, fields)

  @property
  def state(self) -> np.ndarray:
    """Damage and more of each vertex that moves, in the plugin state, (nfree, len(BOND))."""
    return self.rows("bond", len(BOND)).numpy()

  def bind(self, model: int):
    """See `Beside`; also those of other organs, which this one's graphs launch."""
    for group in (*self.groups, *self.borne):
      group.bind(model)

  def enter(self):
    """See `Beside`."""
    for group in self.groups:
      group.launch(_stretch)
      group.launch(_enter)
    for group in self.borne:
      group.launch(_stretch)
      group.launch(_bear)

  def act(self):
    """See `Beside`."""
    for group in self.groups:
      group.launch(_act)
      if group.body != ON_ORGAN and group.bonded.restless:
        group.launch(_feel)

  def end(self):
    """See `Beside`."""
    for group in self.groups:
      group.launch(_keep)
