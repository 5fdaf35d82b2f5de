"""Ties: springs from vertices of an organ to bodies, to other organs, or to its own rigid motion.

They hold what grows on to something that moves, what is stitched, clipped or held by an ideal
grasp, and what lies on a foundation that is carried. The organ's step has them in its matrix, and
the bodies feel what they have pulled; see `forces/attachments.h`.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import dataclasses
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.step import SCHEMES
from palpate.tissue.types import DIMS, doubles, fill, ints, struct, vector

from .. import coupling
from ..model import mjstruct
from .passive import Beside, Bodies, Input, Nodes, base, may_move, nodes, solver
from .transfer import Grip, Held, pairs

if TYPE_CHECKING:
  from ..workspace import Workspace

TO_POINT, TO_OWN_MOTION = -1, -2  # in place of a body
_LEAST = 64  # ties that there is room for at once
# Share of what they hold that springs may weigh in a step for the last steps to lead them.
_LEADS = 0.5


@struct
class Tied:
  """The ties of an organ, those to one body in a row."""

  ahead: wp.float64  # share of the step's way at which its scheme takes forces
  gain: wp.float64  # how much of a step's stiffness its scheme has on dv
  row: ints("nworld")  # which row of the lists below a world has, in a batch with cuts
  count: ints(1)  # number of ties
  vert: ints("ntie")  # vertex
  body: ints("ntie")  # body, or what `forces/attachments.h` has besides
  leads: ints("ntie")  # whether the last steps say how fast the point will be
  stiffness: doubles("ntie")  # [N/m]
  anchor: doubles("ntie", 3)  # the point in its body's frame [m]
  owned: ints(1)  # whether any leads to the organ's own motion
  restless: ints(1)  # whether one leads to what may move while the organ sleeps
  point: doubles("ntie", 6)  # place and velocity of another point, in the world [m, m/s]
  force: doubles("ntie", 3)  # on the node, in the organ's frame [N]
  own: Nodes
  solve: Input
  number: doubles("nnumber")  # see `NUMBERS`
  dvel_warm: vector
  mj: Bodies


KERNELS = "enter_ties", "act_ties"
_enter, _act = coupling.kernels("forces/attachments.h", Tied, *KERNELS)
LISTS = ("count", "vert", "body", "leads", "stiffness", "anchor")
_OWN = (*LISTS, "owned", "restless", "point", "force")


class Found(NamedTuple):
  """What became of ties on meshes that have been cut.

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
  """Ties that were made together.

  Attributes:
    own: workspace of the organ
    grip: its vertices that were tied
    body: body that they lead to, or a number below 0 for what `forces/attachments.h` has besides
    made: as they were made: stiffness of each [N/m] (n,), points in the body's frame, or for
      another organ what their vertices are off [m] (n, 3), and the axes of these in the organ's
      (3, 3)
    other: workspace of the other organ, or None
    theirs: its vertices
    by: key of the configuration that declares it, or "" where it was made while running
    now: what became of them
  """

  own: Any
  grip: Grip
  body: int
  made: dict[str, np.ndarray]
  other: Any = None
  theirs: Grip | None = None
  by: str = ""
  now: Found = dataclasses.field(init=False)

  def __post_init__(self):
    self.find()

  def find(self):
    """Finds what became of the vertices."""
    self.now = self.found(self.own.organ.mesh, self.other and self.other.organ.mesh)

  def found(self, mesh: Mesh, other: Mesh | None) -> Found:
    """Returns what became of the ties where their organ, and the other one, have these meshes."""
    made, held, pair = self.made, self.grip.now(mesh), None
    share, shift = held.share, held.shift @ made["turn"].T
    if self.theirs is not None and other is not None:
      far = self.theirs.now(other)
      k, j = pairs(held, far)
      held, pair = Held(held.row[k], held.vert[k], held.share[k], held.shift[k]), far.vert[j]
      share, shift = share[k] * far.share[j], shift[k] - far.shift[j] @ self.other.organ.frame.T
    elif self.by == "carrier":  # the bed lets go of what is cut free
      share = share * _held_share(mesh, held.vert, self.own.organ.config.pin)
    stiffness, anchor = made["stiffness"][held.row] * share, made["anchor"][held.row] + shift
    return Found(held.vert, stiffness, anchor, pair)


def _held_share(mesh: Mesh, vert: np.ndarray, pins: tuple[int, ...]) -> np.ndarray:
  """Returns the shares of vertices' areas that the foundation holds; all of those of pins."""
  if mesh.loose is None:
    return np.ones(len(vert))
  held = topology.areas_of(mesh, vert, held=True) / topology.areas_of(mesh, vert)
  return np.where(np.isin(vert, pins), 1.0, held)


class Ties(Beside):
  """The ties of a workspace's organ, none at first.

  Args:
    w: the workspace
  """

  KEYS = ("attach", "carrier")

  ENTER, ACT = _enter, _act

  def __init__(self, w: "Workspace"):
    super().__init__(w)
    self.groups: list[Group] = []
    self._room = 0
    self._arrays: dict[str, wp.array] = {}

  def __bool__(self) -> bool:
    return self._room > 0

  def put(self, groups: list[Group]) -> bool:
    """Makes these the ties; returns whether the step's graphs have to be recorded anew."""
    self.groups = sorted(groups, key=lambda group: group.body)
    total = sum(len(group.now.vert) for group in groups)
    grown = total > self._room
    if grown:
      self._room = max(_LEAST, 2 * total) + len(groups) * self._w.organ.mesh.spare
      self._allocate()
    if self._room:
      self._write(total)
    return grown

  def _allocate(self):
    sizes = {"ntie": self._room}
    for name in _OWN:
      shape = [sizes[n] if isinstance(n, str) else n for n in DIMS[Tied.key][name]]
      self._arrays[name] = wp.zeros(shape, dtype=Tied.vars[name].type.dtype, device="cpu")
    self._w.hold.need()

  def _write(self, total: int):
    for name, values in self.lists([group.now for group in self.groups]).items():
      self._arrays[name].numpy()[: len(values)] = values
    self._arrays["restless"].numpy()[0] = any(self._moves(group.body) for group in self.groups)
    self._arrays["owned"].numpy()[0] = any(g.body == TO_OWN_MOTION for g in self.groups)
    self._arrays["force"].zero_()

  def lists(self, found: list[Found]) -> dict[str, np.ndarray]:
    """Returns `LISTS` of what became of the groups."""
    count = [len(each.vert) for each in found]
    body = np.repeat([group.body for group in self.groups], count)
    leads = np.repeat([self._leads(group.body) for group in self.groups], count)
    out = {"count": np.array([sum(count)]), "body": body, "leads": leads}
    for name, wide in (("vert", ()), ("stiffness", ()), ("anchor", (3,))):
      parts = [np.broadcast_to(getattr(each, name), (len(each.vert), *wide)) for each in found]
      out[name] = np.concatenate([np.zeros((0, *wide)), *parts])
    return out

  def _moves(self, body: int) -> bool:
    return body < 0 or may_move(mjstruct.Model.from_address(self._w.model), body)

  def reshape(self) -> list:
    """See `Beside`."""
    if self.fields is not None:
      self.fields.own.rest.numpy()[:] = base(self._w.organ)
    spaces = [self._w, *{id(g.other): g.other for g in self.groups if g.other}.values()]
    grown = []
    for w in spaces:
      groups = [g for g in w.ties.groups if w is self._w or g.other is self._w]
      for group in groups:
        group.find()
      if groups and w.ties.put(w.ties.groups):
        grown.append(w)
    return grown

  def springs(self) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Returns vertices, stiffness [N/m], and last stretch in the organ's frame [m] of its ties."""
    if not self:
      return []
    count = sum(len(group.now.vert) for group in self.groups)
    vert, stiff, force = (
      self._arrays[name].numpy()[:count].copy() for name in ("vert", "stiffness", "force")
    )
    return [springs(vert, stiff, force)]

  def bind(self, model: int):
    """See `Beside`."""
    if not self:
      return
    w = self._w
    scheme = SCHEMES[w.config.integrator]
    values = self._arrays | dict(
      row=np.zeros(1),
      ahead=float(scheme.ahead),
      gain=scheme.gain(1.0, 0.0),
      own=nodes(w),
      solve=solver(w),
      number=w.body.numbers,
      dvel_warm=w.host["dvel_warm"],
      mj=coupling.mujoco_arrays(model, w.data, Bodies),
    )
    self.fields = fill(Tied, "cpu", values)

  def _leads(self, body: int) -> bool:
    """Returns whether it is stable that springs act where the last steps lead what they hold."""
    w = self._w
    m = mjstruct.Model.from_address(w.model)
    gain = float(m.opt.timestep) * (float(m.opt.timestep) + w.config.damping)
    weight = gain * sum(group.now.stiffness.sum() for group in self.groups if group.body == body)
    if body == TO_OWN_MOTION:
      return weight < _LEADS * w.organ.mass.sum()
    return body > 0 and weight * mjstruct.view(m.body_invweight0, (m.nbody, 2))[body, 0] < _LEADS

  def aim(self):
    """Finds where the points on other organs are."""
    start = 0
    for group in self.groups:
      stop = start + len(group.now.vert)
      now = group.now
      if group.other is not None and now.pair is not None:
        at, vel = motion(group.other, now.pair)
        self._arrays["point"].numpy()[start:stop] = np.hstack([at + now.anchor, vel])
      start = stop

  @property
  def aims(self) -> bool:
    """Whether any lead to another organ."""
    return any(group.other is not None for group in self.groups)

  def force(self, group: Group) -> np.ndarray:
    """Returns the force of a group's ties on its vertices in the last step [N], (n, 3)."""
    start = 0
    for each in self.groups:
      stop = start + len(each.now.vert)
      if each is group:
        return self._arrays["force"].numpy()[start:stop] @ self._w.organ.frame.T
      start = stop
    return np.zeros((len(group.now.vert), 3))


def springs(vert: np.ndarray, stiff: np.ndarray, force: np.ndarray) -> tuple:
  """Returns vertices, stiffness [N/m], and last stretch [m] of ties that had forces [N]."""
  return vert, stiff, -force / np.maximum(stiff, 1e-30)[:, None]


def motion(w: "Workspace", vert: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns places and velocities of an organ's vertices in the world [m, m/s], (n, 3) each."""
  organ = w.organ
  if organ.windows:
    own = w.boxes["own"].motion
    u, v = own.disp.numpy()[vert], own.vel.numpy()[vert]
  else:
    m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
    free = (organ.dofadr[vert] >= 0)[:, None]
    qpos = np.maximum(organ.qposadr[vert], 0)[:, None] + np.arange(3)
    dofs = np.maximum(organ.dofadr[vert], 0)[:, None] + np.arange(3)
    u = mjstruct.view(d.qpos, m.nq)[qpos] - mjstruct.view(m.qpos0, m.nq)[qpos]
    u, v = free * u, free * mjstruct.view(d.qvel, m.nv)[dofs]
  return organ.origin + (base(organ)[vert] + u) @ organ.frame.T, v @ organ.frame.T


def is_mocap(m, body: int) -> bool:
  """Returns whether a body or one above it is a mocap body."""
  mocap = mjstruct.view(m.body_mocapid, m.nbody, np.int32)
  parent = mjstruct.view(m.body_parentid, m.nbody, np.int32)
  while body > 0:
    if mocap[body] >= 0:
      return True
    body = int(parent[body])
  return False
