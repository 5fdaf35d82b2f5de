"""Ties: springs from vertices of an organ to bodies, to other organs, or to its own rigid motion.

They hold what grows on to something that moves, what is stitched, clipped or held by an ideal
grasp, and what lies on a foundation that is carried. The organ's step has them in its matrix, and
the bodies feel what they have pulled; see `forces/attachments.h`.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import dataclasses
from typing import TYPE_CHECKING, Any

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
  count: ints(1)  # number of ties
  owned: ints(1)  # whether any leads to the organ's own motion
  restless: ints(1)  # whether one leads to what may move while the organ sleeps
  vert: ints("ntie")  # vertex
  body: ints("ntie")  # body, or what `forces/attachments.h` has besides
  leads: ints("ntie")  # whether the last steps say how fast the point will be
  stiffness: doubles("ntie")  # [N/m]
  anchor: doubles("ntie", 3)  # the point in its body's frame [m]
  point: doubles("ntie", 6)  # place and velocity of another point, in the world [m, m/s]
  force: doubles("ntie", 3)  # on the node, in the organ's frame [N]
  own: Nodes
  solve: Input
  number: doubles("nnumber")  # see `NUMBERS`
  dvel_warm: vector
  mj: Bodies


KERNELS = "enter_ties", "act_ties"
_enter, _act = coupling.kernels("forces/attachments.h", Tied, *KERNELS)
_OF_COUNT = ("count", "owned", "restless")
_OF_TIE = ("vert", "body", "leads", "stiffness", "anchor", "point", "force")


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
    vert: vertices that they are on now                   (n,)
    stiffness: of each [N/m]                              (n,)
    anchor: as in `made`, now [m]                         (n, 3)
    pair: the other organ's vertices                      (n,)
  """

  own: Any
  grip: Grip
  body: int
  made: dict[str, np.ndarray]
  other: Any = None
  theirs: Grip | None = None
  by: str = ""
  vert: np.ndarray = dataclasses.field(init=False)
  stiffness: np.ndarray = dataclasses.field(init=False)
  anchor: np.ndarray = dataclasses.field(init=False)
  pair: np.ndarray | None = dataclasses.field(default=None, init=False)

  def __post_init__(self):
    self.find()

  def find(self):
    """Finds what became of the vertices."""
    organ, made = self.own.organ, self.made
    held = self.grip.now(organ.mesh)
    share, shift = held.share, held.shift @ made["turn"].T
    if self.other is not None and self.theirs is not None:
      other = self.other.organ
      far = self.theirs.now(other.mesh)
      k, j = pairs(held, far)
      held, self.pair = Held(held.row[k], held.vert[k], held.share[k], held.shift[k]), far.vert[j]
      share, shift = share[k] * far.share[j], shift[k] - far.shift[j] @ other.frame.T
    elif self.by == "carrier":  # the bed lets go of what is cut free
      share = share * _held_share(organ.mesh, held.vert, organ.config.pin)
    self.vert, self.stiffness = held.vert, made["stiffness"][held.row] * share
    self.anchor = made["anchor"][held.row] + shift


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
    total = sum(len(group.vert) for group in groups)
    grown = total > self._room
    if grown:
      self._room = max(_LEAST, 2 * total) + len(groups) * self._w.organ.mesh.spare
      self._allocate()
    if self._room:
      self._write(total)
    return grown

  def _allocate(self):
    sizes = {"ntie": self._room}
    for name in (*_OF_COUNT, *_OF_TIE):
      shape = [sizes[n] if isinstance(n, str) else n for n in DIMS[Tied.key][name]]
      self._arrays[name] = wp.zeros(shape, dtype=Tied.vars[name].type.dtype, device="cpu")
    self._w.hold.need()

  def _write(self, total: int):
    for name in ("vert", "body", "stiffness", "anchor"):
      parts = [np.broadcast_to(getattr(g, name), _rows(g, name)) for g in self.groups]
      if parts:
        self._arrays[name].numpy()[:total] = np.concatenate(parts)
    self._arrays["restless"].numpy()[0] = any(self._moves(group.body) for group in self.groups)
    self._arrays["owned"].numpy()[0] = any(g.body == TO_OWN_MOTION for g in self.groups)
    self._arrays["count"].numpy()[0] = total
    parts = [np.full(len(g.vert), self._leads(g.body)) for g in self.groups]
    if parts:
      self._arrays["leads"].numpy()[:total] = np.concatenate(parts)
    self._arrays["force"].zero_()

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
    out, start = [], 0
    for group in self.groups:
      stop = start + len(group.vert)
      stiff = np.maximum(group.stiffness, 1e-30)[:, None]
      out.append((group.vert, group.stiffness, -self._arrays["force"].numpy()[start:stop] / stiff))
      start = stop
    return out

  def bind(self, model: int):
    """See `Beside`."""
    if not self:
      return
    w = self._w
    scheme = SCHEMES[w.config.integrator]
    values = self._arrays | dict(
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
    weight = gain * sum(group.stiffness.sum() for group in self.groups if group.body == body)
    if body == TO_OWN_MOTION:
      return weight < _LEADS * w.organ.mass.sum()
    return body > 0 and weight * mjstruct.view(m.body_invweight0, (m.nbody, 2))[body, 0] < _LEADS

  def aim(self):
    """Finds where the points on other organs are."""
    start = 0
    for group in self.groups:
      stop = start + len(group.vert)
      if group.other is not None and group.pair is not None:
        at, vel = motion(group.other, group.pair)
        self._arrays["point"].numpy()[start:stop] = np.hstack([at + group.anchor, vel])
      start = stop

  @property
  def aims(self) -> bool:
    """Whether any lead to another organ."""
    return any(group.other is not None for group in self.groups)

  def force(self, group: Group) -> np.ndarray:
    """Returns the force of a group's ties on its vertices in the last step [N], (n, 3)."""
    start = 0
    for each in self.groups:
      stop = start + len(each.vert)
      if each is group:
        return self._arrays["force"].numpy()[start:stop] @ self._w.organ.frame.T
      start = stop
    return np.zeros((len(group.vert), 3))


def _rows(group: Group, name: str) -> tuple[int, ...]:
  return (len(group.vert), 3) if name == "anchor" else (len(group.vert),)


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
