"""Attachments: springs from an organ's vertices to bodies, other organs, or its own rigid motion.

They hold what grows on to something that moves, what is stitched, clipped or held by an ideal
grasp, and what lies on a foundation that is carried. The organ's step has them in its matrix, and
the bodies feel what they have pulled; see `forces/attachments.h`.
"""

import dataclasses
from typing import Any, NamedTuple, Optional

import numpy as np
import warp as wp
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import doubles, ints, struct, vector

from .host import Bodies, Host, Input, Lists, Nodes, kernels, numbers
from .passive import Force, Springs
from .transfer import Grip, Held, pairs

TO_POINT, TO_OWN_MOTION = -1, -2  # in place of a body
_LEAST = 64  # attachments that there is room for at once, where they come and go
# Share of what they hold that springs may weigh in a step for the last steps to lead them.
_LEADS = 0.5


@struct
class Attached:
  """The attachments of an organ, those to one body in a row."""

  ahead: wp.float64  # see `Host.fill`
  gain: wp.float64
  owned: int  # whether any leads to the organ's own motion
  restless: int  # whether one leads to what may move while the organ sleeps
  row: ints("nworld")  # which row of the lists below a world has
  count: ints("nrow", 1)  # number of them
  vert: ints("nrow", "natt")  # vertex
  body: ints("nrow", "natt")  # body, or what `forces/attachments.h` has besides
  leads: ints("nrow", "natt")  # whether the last steps say how fast the point will be
  stiffness: doubles("nrow", "natt")  # [N/m]
  anchor: doubles("nrow", "natt", 3)  # the point in its body's frame, or from `pair` [m]
  whom: ints("nrow", "natt")  # which other organ, -1 for none
  pair: ints("nrow", "natt")  # its vertex
  point: doubles("nworld", "natt", 6)  # place and velocity of that point, in the world [m, m/s]
  force: doubles("nworld", "natt", 3)  # on the node, in the organ's frame [N]
  own: Nodes
  solve: Input
  number: numbers
  dvel_warm: vector
  mj: Bodies


@struct
class Aimed:
  """Attachments, and another organ to which some of them lead."""

  held: Attached
  other: Nodes


_enter, _act = kernels("forces/attachments.h", Attached, "enter_attachments", "act_attachments")
(_aim,) = kernels("forces/attachments.h", Aimed, "aim_attachments")


class Found(NamedTuple):
  """What became of attachments on meshes that have been cut.

  Attributes:
    vert: vertices that they are on                       (n,)
    stiffness: of each [N/m]                              (n,)
    anchor: as in `Group.made`, now [m]                   (n, 3)
    pair: the other organ's vertices, if there is one     (n,)
  """

  vert: np.ndarray
  stiffness: np.ndarray
  anchor: np.ndarray
  pair: np.ndarray | None


@dataclasses.dataclass(eq=False)
class Group:
  """Attachments that were made together.

  Attributes:
    grip: vertices of the organ
    body: body that they lead to, or a number below 0 for what `forces/attachments.h` has besides
    made: as they were made: stiffness of each [N/m] (n,), points in the body's frame, or for
      another organ what their vertices are off [m] (n, 3), and the axes of these in the organ's
      (3, 3)
    other: attachments of the other organ, or None
    theirs: its vertices
    by: key of the configuration that declares it, or "" where it was made while running
    now: what became of them; with many worlds, what they were at first
  """

  grip: Grip
  body: int
  made: dict[str, np.ndarray]
  other: Optional["Attachments"] = None
  theirs: Grip | None = None
  by: str = ""
  now: Any = dataclasses.field(default=None, init=False)

  def found(self, host: Host, world: int) -> Found:
    """Returns what became of the attachments of a host's organ in a world."""
    mesh, made = host.mesh(world), self.made
    held, pair = self.grip.now(mesh), None
    share, shift = held.share, held.shift @ made["turn"].T
    if self.theirs is not None and self.other is not None:
      there = self.other.host
      far = self.theirs.now(there.mesh(world))
      k, j = pairs(held, far)
      held, pair = Held(held.row[k], held.vert[k], held.share[k], held.shift[k]), far.vert[j]
      share, shift = share[k] * far.share[j], shift[k] - far.shift[j] @ there.organ.frame.T
    elif self.by == "carrier":  # the bed lets go of what is cut free
      share = share * _held_share(mesh, held.vert, host.organ.config.pin)
    stiffness, anchor = made["stiffness"][held.row] * share, made["anchor"][held.row] + shift
    return Found(held.vert, stiffness, anchor, pair)


def _held_share(mesh: Mesh, vert: np.ndarray, pins: tuple[int, ...]) -> np.ndarray:
  """Returns the shares of vertices' areas that the foundation holds; all of those of pins."""
  if mesh.loose is None:
    return np.ones(len(vert))
  held = topology.areas_of(mesh, vert, held=True) / topology.areas_of(mesh, vert)
  return np.where(np.isin(vert, pins), 1.0, held)


class Attachments(Force):
  """The attachments of an organ, none at first."""

  KEYS = ("attach", "carrier")
  ENTER, ACT = _enter, _act

  def __init__(self, host: Host):
    super().__init__(host)
    self.groups: list[Group] = []
    self._others: list[Attachments] = []  # of other organs, to which these lead or have led
    self._lists: Lists | None = None
    self._own: dict[str, wp.array] = {}
    self._aimed: list = []

  def __bool__(self) -> bool:
    return self._lists is not None

  def take(self, declared: "Attachments", twin: Any):
    """See `Force`."""
    groups = declared.groups
    others = [None if group.other is None else twin(group.other) for group in groups]
    self.put([dataclasses.replace(g, other=o) for g, o in zip(groups, others, strict=True)])

  def put(self, groups: list[Group]) -> bool:
    """Makes these the attachments; returns whether the step's graphs have to be recorded anew."""
    self.groups = sorted(groups, key=lambda group: group.body)
    for group in groups:
      if group.now is None:
        group.now = group.found(self.host, 0)
    others = dict.fromkeys(g.other for g in self.groups if g.other is not None)
    new, first = [other for other in others if other not in self._others], self._lists is None
    self._others += new
    for other in new:
      self.follow(other)
    self._write(0, [group.now for group in self.groups])
    return bool(new) or (first and bool(self))

  def _write(self, world: int, found: list[Found]):
    """Writes what became of the groups in a world."""
    values = self._values(found)
    n = len(values["vert"])
    if self._lists is None or n > self._own["force"].shape[1]:
      if n:
        self._allocate(values)
    else:
      self._lists.put(world, values)
      self._own["force"][world].zero_()
      self._mark()

  def _allocate(self, values: dict[str, np.ndarray]):
    """Makes room, with some for cuts, and where there is one world for more of them."""
    host, n = self.host, len(values["vert"])
    others = [other.host for other in self._others]
    spare = sum(each.organ.mesh.spare for each in (host, *others))
    room = (max(_LEAST, 2 * n) if host.alone else n) + len(self.groups) * spare
    self._lists = Lists(host, Attached, others, values, room - n)
    self._own = {"point": host.zeros(room, 6), "force": host.zeros(room, 3)}
    host.need_springs()
    if self.fields is not None:
      self.bind()

  def _mark(self):
    """Says which of what they lead to there is."""
    if self.fields is not None:
      bodies = [group.body for group in self.groups]
      self.fields.owned = int(TO_OWN_MOTION in bodies)
      self.fields.restless = int(any(b < 0 or self.host.may_move(b) for b in bodies))

  def _values(self, found: list[Found]) -> dict[str, np.ndarray]:
    """Returns the lists of `Attached` of what became of the groups."""
    groups, count = self.groups, np.array([len(each.vert) for each in found], int)
    weight: dict[int, float] = {}
    for group, each in zip(groups, found, strict=True):
      weight[group.body] = weight.get(group.body, 0) + each.stiffness.sum()
    each_group = {
      "body": [self.host.body_number(g.body) if g.body >= 0 else g.body for g in groups],
      "leads": [self._leads(g.body, weight[g.body]) for g in groups],
      "whom": [-1 if g.other is None else self._others.index(g.other) for g in groups],
    }
    out = {name: np.repeat(np.array(values, int), count) for name, values in each_group.items()}
    none = np.zeros((0, 3))
    pair = [0 * each.vert if each.pair is None else each.pair for each in found]
    return out | {
      "count": np.array([count.sum()]),
      "vert": np.concatenate([none[:, 0], *(each.vert for each in found)]),
      "stiffness": np.concatenate([none[:, 0], *(each.stiffness for each in found)]),
      "anchor": np.concatenate([none, *(each.anchor for each in found)]),
      "pair": np.concatenate([none[:, 0], *pair]),
    }

  def _leads(self, body: int, stiffness: float) -> bool:
    """Returns whether it is stable that springs act where the last steps lead what they hold.

    Args:
      body: what they hold
      stiffness: of all springs to it [N/m]
    """
    host, m = self.host, self.host.m
    weight = float(m.opt.timestep) * (float(m.opt.timestep) + host.config.damping) * stiffness
    if body == TO_OWN_MOTION:
      return weight < _LEADS * host.organ.mass.sum()
    return body > 0 and weight * m.body_invweight0[body, 0] < _LEADS

  @property
  def aims(self) -> bool:
    """See `Force`."""
    return any(group.body >= 0 and self.host.may_move(group.body) for group in self.groups)

  def bind(self):
    """See `Force`."""
    if self._lists is None:
      return
    values = self._lists.arrays | self._own | {"owned": 0, "restless": 0}
    self.fields = self.host.fill(Attached, values, into=self.fields)
    self._mark()
    self._aimed += [None] * (len(self._others) - len(self._aimed))
    self._aimed = [
      self.host.fill(Aimed, {"held": self.fields, "other": other.host.nodes}, into=into)
      for other, into in zip(self._others, self._aimed, strict=True)
    ]

  def enter(self):
    """See `Force`."""
    for which, aimed in enumerate(self._aimed):
      self.host.launch(_aim, aimed, self._own["force"].shape[1], which)
    super().enter()

  def reshape(self, world: int):
    """See `Force`."""
    if self.groups:
      found = [group.found(self.host, world) for group in self.groups]
      if self.host.alone:
        for group, each in zip(self.groups, found, strict=True):
          group.now = each
      self._write(world, found)

  def springs(self, world: int) -> list[Springs]:
    """See `Force`; the stretch is that of the last step."""
    if self._lists is None:
      return []
    vert, stiff = self._lists.of(world, "vert", "stiffness")
    force = self._own["force"][world].numpy()[: len(vert)]
    return [(vert, stiff, -force / np.maximum(stiff, 1e-30)[:, None])]

  def force(self, group: Group) -> np.ndarray:
    """Returns the force of a group on its vertices in the last step, of one world [N], (n, 3)."""
    start = 0
    for each in self.groups:
      stop = start + len(each.now.vert)
      if each is group:
        return self._own["force"].numpy()[0, start:stop] @ self.host.organ.frame.T
      start = stop
    return np.zeros((len(group.now.vert), 3))
