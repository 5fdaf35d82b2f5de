"""Cohesive bonds: springs from an organ to what it has grown on to, which soften and break.

The kernels are in `forces/cohesive_bonds.h`; what is bonded to what is found in `declare_bonds`.
"""

import dataclasses
from typing import Any, Optional

import numpy as np
import warp as wp
from palpate.tissue.reading import Law
from palpate.tissue.types import doubles, ints, struct

from ..engine.layout import BOND
from .host import Bodies, Host, Input, Lists, Nodes, edited, kernels, numbers
from .passive import Force, Springs
from .transfer import Grip, Spots

ON_ORGAN = -1  # in place of a body


@struct
class Bonded:
  """Bonds of an organ that were made together, to one body or to one other organ."""

  body: int  # body, or ON_ORGAN
  restless: int  # whether what they lead to may move while the organ sleeps
  ahead: wp.float64  # see `Host.fill`
  gain: wp.float64
  stiffness: wp.float64  # by area [N/m^3]
  strength: wp.float64  # [Pa]
  energy: wp.float64  # by area, of a bond from whole to free [J/m^2]
  live: ints(1)  # whether there are any
  row: ints("nworld")  # which row of the lists below a world has
  count: ints("nrow", 1)  # number of bonds
  made: ints("nrow", "nbond")  # which of those that were made
  vert: ints("nrow", "nbond")  # vertex
  slot: ints("nrow", "nbond")  # its row in `state`
  area: doubles("nrow", "nbond")  # [m^2]
  anchor: doubles("nrow", "nbond", 3)  # what it leads to in the axes of body or triangle [m]
  normal: doubles("nrow", "nbond", 3)  # away from its bed there; 0 where pressing opens it too
  corner: ints("nrow", "nbond", 3)  # vertices of the other organ that hold it
  weight: doubles("nrow", "nbond", 3)  # their shares
  state: doubles("nworld", "nfree", len(BOND))  # see BOND
  next: doubles("nworld", "nbond", len(BOND))  # what it will be
  stretch: doubles("nworld", "nbond", 3)  # how far it is from what it leads to [m]
  force: doubles("nworld", "nbond", 3)  # on the vertex as a step begins, in the world [N]
  pull: doubles("nworld", "nbond", 3)  # on it, with what the step has changed of it [N]
  hardness: doubles("nworld", "nbond")  # what its spring weighs on the change of its velocity [kg]
  own: Nodes
  solve: Input
  other: Nodes
  below: Input
  number: numbers
  mj: Bodies


_WIDTHS = {"stretch": (3,), "force": (3,), "pull": (3,), "next": (len(BOND),), "hardness": ()}


@struct
class Burning:
  """A geom whose current frees bonds, see `engine.cutting.trails`."""

  bonds: Bonded
  geom: int
  axis: int  # along which it is long
  actuator: int  # whose control is its power [W]
  half: wp.float64  # of its length [m]
  reach: wp.float64  # from that line to a bond's strand [m]
  energy: wp.float64  # that an area takes [J/m^2]


_HEADER = "forces/cohesive_bonds.h"
_VERBS = "stretch", "enter", "bear", "act", "feel", "keep"
_stretch, _enter, _bear, _act, _feel, _keep = kernels(
  _HEADER, Bonded, *(f"{verb}_bonds" for verb in _VERBS)
)
(_burn,) = kernels(_HEADER, Burning, "burn_bonds")


@dataclasses.dataclass(eq=False)
class Group:
  """Bonds that were made together.

  Attributes:
    grip: vertices of the organ that were bonded
    made: as they were made: area of each [m^2] (n,), and in the axes of body or triangle what it
      leads to [m] (n, 3), away from its bed, or 0 (n, 3), and the organ's axes (n, 3, 3)
    law: how they hold and break
    body: body that they lead to, or ON_ORGAN
    other: bonds of the other organ, or None
    spots: the points of it that they lead to
    declared: whether the model has them, not somebody who made them while running
    now: what became of them, lists of `Bonded`; with many worlds, what they were at first
    lists: that of all worlds
    arrays: what the kernels write, with room for cuts
    fields: what they take
  """

  grip: Grip
  made: dict[str, np.ndarray]
  law: Law
  body: int
  other: Optional["Bonds"]
  spots: Spots | None
  declared: bool
  now: dict[str, np.ndarray] = dataclasses.field(default_factory=dict, init=False)
  lists: Any = dataclasses.field(default=None, init=False)
  arrays: dict[str, wp.array] = dataclasses.field(default_factory=dict, init=False)
  fields: Any = dataclasses.field(default=None, init=False)

  def found(self, host: Host, world: int) -> dict[str, np.ndarray]:
    """Returns what became of the bonds of a host's organ in a world, lists of `Bonded`."""
    made, held = self.made, self.grip.now(host.mesh(world))
    row = held.row
    anchor = made["anchor"][row] + np.einsum("nij,nj->ni", made["turn"][row], held.shift)
    corner = weight = np.zeros((len(row), 3))
    if self.spots is not None and self.other is not None:
      there = self.other.host.mesh(world)
      corner, weight, turn = (each[row] for each in self.spots.now(there))
      anchor = np.einsum("nij,nj->ni", turn, anchor)
    return {
      "count": np.array([len(row)]),
      "made": row,
      "vert": held.vert,
      "slot": (np.cumsum(host.organ.free) - 1)[held.vert],
      "area": made["area"][row] * held.share,
      "anchor": anchor,
      "normal": made["normal"][row],
      "corner": corner,
      "weight": weight,
    }

  def alike(self, other: "Group") -> bool:
    """Returns whether bonds of another mjData of the model are the same."""
    arrays = all(np.array_equal(self.made[name], other.made[name]) for name in self.made)
    arrays = arrays and np.array_equal(self.grip.vert, other.grip.vert)
    others = [group.other for group in (self, other)]
    names = {None if each is None else each.host.organ.name for each in others}
    return arrays and (self.body, self.law) == (other.body, other.law) and len(names) == 1


class Bonds(Force):
  """The bonds of an organ.

  Attributes:
    groups: bonds that were made together
    currents: what weakens them after each step, see `burn`
  """

  KEYS = ("bonds",)
  ENTER = _enter

  def __init__(self, host: Host):
    super().__init__(host)
    self.groups: list[Group] = []
    self.currents: list[dict[str, Any]] = []

  def __bool__(self) -> bool:
    return bool(self.groups)

  def take(self, declared: "Bonds", twin: Any):
    """See `Force`."""
    for group in declared.groups:
      other = None if group.other is None else twin(group.other)
      self.put(dataclasses.replace(group, other=other))

  def put(self, group: Group):
    """Adds bonds; the graphs of both organs have to be recorded anew.

    Raises:
      ValueError: a vertex is bonded already.
    """
    host, found = self.host, group.found(self.host, 0)
    bonded = [found["vert"][:0], *(each.now["vert"] for each in self.groups)]
    twice = np.intersect1d(found["vert"], np.concatenate(bonded))
    if twice.size:
      raise ValueError(
        f"organ {host.organ.name!r}: vertex {twice[0]} is bonded already, expected one bond per "
        "vertex"
      )
    room = len(group.grip.vert) + host.organ.mesh.spare
    others = [] if group.other is None else [group.other.host]
    group.now = found
    group.lists = Lists(host, Bonded, others, found, room - len(found["vert"]))
    group.arrays = {name: host.zeros(room, *wide) for name, wide in _WIDTHS.items()}
    group.arrays["live"] = wp.ones(1, dtype=int, device=host.device)
    self.groups.append(group)
    host.need_springs()
    if group.other is not None:
      self.follow(group.other)
      group.other.host.need_springs()

  def let_go(self):
    """Takes away what was made while running."""
    for group in [g for g in self.groups if not g.declared]:
      group.arrays["live"].zero_()
      self.groups.remove(group)

  @property
  def state(self) -> np.ndarray:
    """Damage and more of each vertex that moves, of one world, (nfree, len(BOND))."""
    return self.host.rows("bond", len(BOND)).numpy()[0]

  @property
  def aims(self) -> bool:
    """See `Force`."""
    return any(g.body >= 0 and self.host.may_move(g.body) for g in self.groups)

  def bind(self):
    """See `Force`."""
    host = self.host
    for group in self.groups:
      other = None if group.other is None else group.other.host
      values: dict[str, Any] = group.law._asdict() | group.lists.arrays | group.arrays
      values |= dict(
        body=host.body_number(group.body) if group.body >= 0 else group.body,
        restless=int(group.body < 0 or host.may_move(group.body)),
        state=host.rows("bond", len(BOND)),
        other=host.struct(Nodes)() if other is None else other.nodes,
        below=Input() if other is None else other.input,
      )
      group.fields = host.fill(Bonded, values, into=group.fields)

  def _over(self, group: Group, *which):
    for kernel in which:
      self.host.launch(kernel, group.fields, group.arrays["hardness"].shape[1])

  def enter(self):
    """See `Force`."""
    for group in self.groups:
      self._over(group, _stretch, _enter)

  def bear(self, other: Force):
    """See `Force`."""
    for group in self.groups:
      if group.other is other:
        self._over(group, _stretch)
        self.host.launch(_bear, group.fields, 1)

  def act(self):
    """See `Force`."""
    for group in self.groups:
      self._over(group, _act)
      if group.body != ON_ORGAN and group.fields.restless:
        self.host.launch(_feel, group.fields, 1)

  def end(self):
    """See `Force`."""
    for group in self.groups:
      self._over(group, _keep)
    for current in self.currents:
      self.burn(current)

  def burn(self, current: dict[str, Any]):
    """Weakens the bonds that a geom with a current touches; see `Burning`."""
    for group in self.groups:
      burning = self.host.fill(Burning, current | {"bonds": group.fields})
      self.host.launch(_burn, burning, 1)

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Force`."""
    organ = self.host.organ
    if not (self.groups or (self.host.alone and self.host.config.bonded)):
      return
    outer = group < organ.mesh.nskin  # what was inside of a solid had none
    group, member, share = group[outer], member[outer], share[outer]
    slot = np.cumsum(organ.free) - 1
    with edited(self.host.rows("bond", len(BOND)), world) as state:
      state[slot[member], BOND.damage] = state[slot[group], BOND.damage]
      state[slot[member], BOND.released] = share * state[slot[group], BOND.released]

  def reshape(self, world: int):
    """See `Force`."""
    for group in self.groups:
      found = group.found(self.host, world)
      group.lists.put(world, found)
      if self.host.alone:
        group.now = found

  def springs(self, world: int) -> list[Springs]:
    """See `Force`."""
    out = []
    for group in self.groups:
      self._over(group, _stretch)
      vert, slot, area = group.lists.of(world, "vert", "slot", "area")
      damage = group.fields.state[world].numpy()[slot, BOND.damage]
      stiffness = group.law.stiffness * area * (1.0 - damage.clip(0.0, 1.0))
      stretch = group.arrays["stretch"][world].numpy()[: len(vert)] @ self.host.organ.frame
      out.append((vert, stiffness, stretch))
    return out
