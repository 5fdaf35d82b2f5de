"""Bonds: springs from an organ to what it has grown on to, which soften and break.

The kernels are in `forces/cohesive_bonds.h`; what is bonded to what is found in `adhere`.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import dataclasses
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
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
_OF_GROUP = ("vert", "slot", "area", "anchor", "normal", "corner", "weight")


@struct
class Bonded:
  """Bonds of an organ that were made together, to one body or to one other organ."""

  nbond: int  # number of them
  body: int  # body, or ON_ORGAN
  restless: int  # whether what they lead to may move while the organ sleeps
  ahead: wp.float64  # share of the step's way at which its scheme takes forces
  gain: wp.float64  # how much of a step's stiffness its scheme has on dv
  stiffness: wp.float64  # by area [N/m^3]
  strength: wp.float64  # [Pa]
  energy: wp.float64  # by area, of a bond from whole to free [J/m^2]
  live: ints(1)  # whether there are any
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


KERNELS = tuple(f"{verb}_bonds" for verb in ("stretch", "enter", "bear", "act", "feel", "keep"))
_stretch, _enter, _bear, _act, _feel, _keep = coupling.kernels(
  "forces/cohesive_bonds.h", Bonded, *KERNELS
)


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
    vert: vertices that they are on now                   (n,)
    slot: their rows in the plugin state                  (n,)
    area: of each [m^2]                                   (n,)
    anchor: what each leads to in the axes of body or triangle [m] (n, 3)
    normal: away from its bed in these axes, or 0         (n, 3)
    corner: vertices of the other organ that hold each    (n, 3)
    weight: their shares                                  (n, 3)
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
  vert: np.ndarray = dataclasses.field(init=False)
  slot: np.ndarray = dataclasses.field(init=False)
  area: np.ndarray = dataclasses.field(init=False)
  anchor: np.ndarray = dataclasses.field(init=False)
  normal: np.ndarray = dataclasses.field(init=False)
  corner: np.ndarray = dataclasses.field(init=False)
  weight: np.ndarray = dataclasses.field(init=False)
  arrays: dict[str, wp.array] = dataclasses.field(init=False)
  bonded: Any = dataclasses.field(default=None, init=False)

  def __post_init__(self):
    n = len(self.grip.vert) + self.own.organ.mesh.spare
    shapes = {name: (n, 3) for name in ("stretch", "force", "pull")}
    shapes |= {"next": (n, len(BOND)), "hardness": n}
    self.arrays = {k: wp.zeros(s, dtype=wp.float64, device="cpu") for k, s in shapes.items()}
    self.arrays["live"] = wp.ones(1, dtype=int, device="cpu")
    self._find()

  def _find(self):
    """Finds what became of the vertices, and of what they lead to."""
    organ, made = self.own.organ, self.made
    held = self.grip.now(organ.mesh)
    row, self.vert = held.row, held.vert
    self.slot = (np.cumsum(organ.free) - 1)[self.vert]
    self.area, self.normal = made["area"][row] * held.share, made["normal"][row]
    self.anchor = made["anchor"][row] + np.einsum("nij,nj->ni", made["turn"][row], held.shift)
    self.corner = self.weight = np.zeros((len(row), 3))
    if self.spots is not None:
      corner, weight, turn = (each[row] for each in self.spots.now(self.other.organ.mesh))
      self.corner, self.weight = corner, weight
      self.anchor = np.einsum("nij,nj->ni", turn, self.anchor)

  def reshape(self):
    """Follows the organs, one of which was cut, in the arrays that graphs know."""
    self._find()
    bonded, n = self.bonded, len(self.vert)
    if bonded is None:
      return
    bonded.nbond = n
    for name in _OF_GROUP:
      getattr(bonded, name).numpy()[:n] = getattr(self, name)
    bonded.own.rest.numpy()[:] = base(self.own.organ)
    if self.other is not None:
      bonded.other.rest.numpy()[:] = base(self.other.organ)

  def bind(self, model: int):
    """Points what the kernels take at the arrays of a model, in place: both organs launch them."""
    w, other = self.own, self.other
    m, scheme = mjstruct.Model.from_address(model), SCHEMES[w.config.integrator]
    n, room = len(self.vert), self.arrays["hardness"].size
    values: dict[str, Any] = dict(zip(("stiffness", "strength", "energy"), self.law, strict=True))
    for name in _OF_GROUP:
      value = getattr(self, name)
      values[name] = np.concatenate([value, np.zeros((room - n, *value.shape[1:]))])
    values |= self.arrays
    values |= dict(
      nbond=n,
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

  def launch(self, kernel):
    """Launches one of the kernels above over it."""
    kernel.launch("cpu", 1, 1, 0, self.bonded)


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
      whole = 1.0 - self.state[group.slot, BOND.damage].clip(0.0, 1.0)
      stretch = group.arrays["stretch"].numpy()[: len(group.vert)] @ self._w.organ.frame
      out.append((group.vert, group.law.stiffness * group.area * whole, stretch))
    return out

  def reshape(self) -> list:
    """See `Beside`."""
    for group in (*self.groups, *self.borne):
      group.reshape()
    return []

  def carry(self, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Beside`."""
    if not self._w.config.bonded:
      return
    outer = group < self._w.organ.mesh.nskin  # what was inside of a solid had none
    group, member, share = group[outer], member[outer], share[outer]
    slot, state = np.cumsum(self._w.organ.free) - 1, self.state
    damage, released = BOND.damage, BOND.released
    state[slot[member], damage] = state[slot[group], damage]
    state[slot[member], released] = share * state[slot[group], released]

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
