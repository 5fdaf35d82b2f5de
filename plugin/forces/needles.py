"""Needles that go through an organ: puncture, drive, and the holes that hold them.

A needle is a rigid body along an arc, see `palpate.add_needle`. Its tip is pressed on the tissue
until that gives way, and leaves holes in it, through which it slides; see `forces/needles.h`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import doubles, ints, struct

from ..engine import contacts
from ..engine.layout import HOLE, HOLES, NEEDLE, PIERCE, TIE
from ..engine.model import flexes, mjstruct
from . import declare_needles, transfer
from .declare_attachments import most
from .host import Bodies, Host, Input, Nodes, edited, kernels
from .passive import Force

# Stiffness of what ties a needle to a hole, over that of the tissue there.
_FIRM = 10.0
# How much farther than they reach contacts with a needle end before a hole, and the least, in a
# needle's lengths: that of its point.
_MARGIN, _POINT = 3.0, 0.1
_KNOT = 3  # width of an overhand knot, in thicknesses of its thread
_SAME = 1e-6  # edges of a thread within which two places where it goes through are one
# As in the header.
_POINTS = HOLES + 1
_TOUCHING, _INSIDE = 1, 2
_INTO, _WITHIN, _OUT, _THROUGH = range(4)


@struct
class Pierced:
  """The needles that an organ knows."""

  nneedle: int  # number of them
  nlisted: int  # their geoms
  nelem: int  # triangles of the organ
  ntet: int  # tetrahedra, of a solid
  ahead: float  # see `Host.fill`
  gain: float
  edge: float  # mean length of the mesh's edges [m]
  body: ints("nneedle")  # its body
  floats: ints("nneedle")  # whether that is free
  circle: doubles("nneedle")  # radius of its circle [m]
  half: doubles("nneedle")  # half the angle of its arc [rad]
  law: doubles("nworld", "nneedle", len(PIERCE))  # see PIERCE
  geom: ints("nlisted")  # geoms of needles
  whose: ints("nlisted")  # of which
  end: doubles("nlisted")  # where along it they end [m]
  strand: ints("nneedle", 2)  # first of the nodes below that are its thread's, and how many
  strand_flex: ints("nneedle")  # the thread's flex
  node: ints("nnode")  # body of a thread's node, from the swage on
  local: doubles("nnode", 3)  # place of the node there [m]
  edges: doubles("*", "nnode", 2)  # rest length [m] and stiffness [N/m] of the next edge
  ngeom: int  # geoms of the model
  lifted: ints("nworld", "nlift")  # what does not touch the organ, see `contacts.lifted`
  mesh: ints("nworld")  # which mesh a world has
  elem: ints("nmesh", "nelem", 3)  # triangles
  tet: ints("nmesh", "ntet", 4)  # tetrahedra
  flat: doubles("nmesh", "nvert", 3)  # rest positions as the cuts have them [m]
  state: doubles("nworld", "nneedle", len(NEEDLE))  # see NEEDLE
  next: doubles("nworld", "nneedle", len(NEEDLE))  # what it will be
  force: doubles("nworld", "nneedle", _POINTS, 3)  # on the tissue, in the organ's frame [N]
  point: doubles("nworld", "nneedle", _POINTS, 3)  # of the needle, where it acts [m]
  held: ints("nworld", "nneedle", _POINTS, 4)  # vertices that bear it
  share: doubles("nworld", "nneedle", _POINTS, 4)  # of each of them
  hold: doubles("nworld", "nneedle", _POINTS, 6)  # what weighs on the change of velocity there [kg]
  feels: ints("nworld", "nneedle", _POINTS)  # whether the needle feels the force
  pull: doubles("nworld", "nneedle", _POINTS, 3)  # of a thread, in the organ's frame [N]
  torn: doubles("nworld", "nneedle", _POINTS, 3)  # how far that has torn in its step, there [m]
  weight: doubles("nworld", "nneedle")  # what all of them weigh on the needle [kg]
  own: Nodes
  solve: Input
  mj: Bodies


@struct
class Held:
  """Needles, and what holds the thread of one."""

  pierced: Pierced
  frame: doubles(3, 3)  # rotation from the axes of the thread's slides to the world
  origin: doubles(3)  # position of its frame [m]
  first: ints("nworld")  # the first of these
  tie_count: ints("nworld", 1)  # see `coupling.Ties`
  tie_edge: ints("nworld", "ntie")
  tie_value: doubles("nworld", "ntie", len(TIE))
  span: doubles("nworld", 2)
  drawn: doubles("nstrand", 2)  # its `Pierced.edges` as these begin
  moved: doubles("nworld", "nstrand")  # how far its nodes have moved along it [m]


_enter, _act, _keep = kernels(
  "forces/needles.h", Pierced, "enter_needles", "act_needles", "keep_needles"
)
_measure, _aim, _lift, _feel = kernels(
  "forces/needles.h", Held, "measure_thread", "aim_thread", "lift_thread", "feel_thread"
)


@dataclasses.dataclass(frozen=True)
class Pinhole:
  """A hole of a needle or its thread, in an organ's surface or inside of a solid.

  Attributes:
    needle: name of its body
    inside: whether it is inside of a solid
    thread: whether the needle's thread is in it
    at: present position, in the world [m]                  (3,)
    rest: the same at rest                                  (3,)
    along: distance from the swage along the needle; on the thread negative [m]
    force: on the organ in the last step, in the world [N]  (3,)
    torn: how far it has torn through the tissue [m]
  """

  needle: str
  inside: bool
  thread: bool
  at: np.ndarray
  rest: np.ndarray
  along: float
  force: np.ndarray
  torn: float


@dataclasses.dataclass(frozen=True)
class Needle:
  """A needle of an organ's key `needles`.

  Attributes:
    name: of its body
    touches: whether its tip presses on a surface, from either side
    inside: whether its tip is in a solid
    force: of the whole needle on the organ in the last step, in the world [N]  (3,)
    tip_force: that of its tip                                                  (3,)
    energy: dissipated by piercing and cutting [J]
    holes: its holes, in the order in which they were made
  """

  name: str
  touches: bool
  inside: bool
  force: np.ndarray
  tip_force: np.ndarray
  energy: float
  holes: tuple[Pinhole, ...]


class Needles(Force):
  """What goes through an organ; false where nothing does.

  Attributes:
    names: of the needles' bodies
  """

  KEYS = ("needles",)
  ENTER, ACT, END = _enter, _act, _keep

  def __init__(self, host: Host):
    super().__init__(host)
    self.count = 1  # a warp a world
    self.names: list[str] = []
    self._shape: dict[str, np.ndarray] = {}
    self._threads: list[dict] = []  # see `declare_needles.strand`
    self._feel: dict[int, Callable[[], None]] = {}  # takes the force of a needle's thread
    self._slit = np.zeros(0)  # width of what a tip opens [m]
    self._margin = np.zeros(0)  # see `PIERCE.margin` [m]
    self._before: dict[int, Mesh] = {}  # meshes of worlds that are being cut

  def __bool__(self) -> bool:
    return bool(self.names)

  def declare(self):
    """Finds the needles that the configuration names.

    Raises:
      ValueError: one does not exist, is no needle, begins in the organ, or is short for its mesh.
    """
    host, m = self.host, self.host.m
    rows = host.config.needles
    found = [declare_needles.read(host, row.name) for row in rows]
    if not found:
      return
    radius = declare_needles.radius(host)
    parts = [part for each in found for part in each["parts"]]
    body = np.array([each["body"] for each in found])
    whose = np.repeat(np.arange(len(found)), [len(each["parts"]) for each in found])
    self._shape = {
      "body": body,
      "floats": np.array([declare_needles.is_free(m, b) for b in body], int),
      "circle": np.array([each["circle"] for each in found]),
      "half": np.array([each["half"] for each in found]),
      "geom": np.array([g for g, _ in parts]),
      "whose": whose,
      "end": np.array([end for _, end in parts]),
    }
    strands = [each["strand"] for each in found]
    count = np.array([len(each["node"]) for each in strands])
    self._shape |= {"strand": np.stack([np.cumsum(count) - count, count], axis=1)}
    self._shape |= {"strand_flex": np.array([each["flex"] for each in strands])}
    for name in ("node", "local", "edges"):
      self._shape[name] = np.concatenate([each[name] for each in strands])
    self._threads = strands
    self._slit = np.array([each["slit"] for each in found])
    thick = np.array([each["radius"] for each in found])
    length = 2 * self._shape["half"] * self._shape["circle"]
    self._margin = np.maximum(_MARGIN * (radius + thick), _POINT * length)
    self.names = [mjstruct.name_of(m, "body", int(b)) for b in body]
    host.need_springs()

  def take(self, declared: "Needles", twin: Any):
    """See `Force`."""
    if declared:
      self.names, self._shape = declared.names, dict(declared._shape)
      self._threads = declared._threads
      self._slit, self._margin = declared._slit, declared._margin
      for name in ("body", "node"):
        numbers = [self.host.body_number(int(b)) for b in self._shape[name]]
        self._shape[name] = np.array(numbers, int)
      self.host.need_springs()

  def _law(self, asked: np.ndarray, thickness: Any) -> np.ndarray:
    """Returns the rows of `Pierced.law`.

    Args:
      asked: R of a contact that the tissue of each world asks for, see `TISSUE` [1/kg]
      thickness: of the wall of each [m]
    """
    host, config = self.host, self.host.config
    m, out = host.m, np.zeros((len(asked), len(self.names), len(PIERCE)))
    stiffness = contacts.FIRM / (asked * (contacts.SLOW * float(m.opt.timestep)) ** 2)
    organ = host.organ.name
    bodies = [flexes.need(m, "body", row.name, organ, "needles") for row in config.needles]
    for k, row in enumerate(config.needles):
      free = bool(self._shape["floats"][k])
      out[:, k, PIERCE.force] = row.energy * self._slit[k]
      out[:, k, PIERCE.surface] = row.surface * self._slit[k]
      out[:, k, PIERCE.friction] = row.friction
      out[:, k, PIERCE.stiffness] = np.minimum(
        _FIRM * stiffness, np.inf if free else most(host, bodies[k])
      )
      out[:, k, PIERCE.tear] = row.energy
      out[:, k, PIERCE.capstan] = self._threads[k]["friction"]
      out[:, k, PIERCE.wall] = 0.0 if config.elements == "solid" else thickness
      out[:, k, PIERCE.clear] = self._slit[k]
      out[:, k, PIERCE.margin] = self._margin[k]
      out[:, k, PIERCE.close] = self._threads[k]["close"]
      out[:, k, PIERCE.stop] = 2 * self._threads[k]["bead"] > self._slit[k]
      thick = self._threads[k]["thick"]
      out[:, k, PIERCE.knot] = thick * (_KNOT * thick > self._slit[k])
    return out

  @property
  def _refines(self) -> bool:
    return any(each["refine"] for each in self._threads)

  @property
  def aims(self) -> bool:
    """See `Force`."""
    return bool(self)

  @property
  def weighs(self) -> bool:
    """See `Force`: free needles meet the holes' inertia."""
    return bool(self) and bool(self._shape["floats"].any())

  def bind(self):
    """See `Force`."""
    if not self:
      return
    host, n = self.host, len(self.names)
    widths = {"force": 3, "point": 3, "pull": 3, "torn": 3, "share": 4, "hold": 6}
    values: dict[str, Any] = {name: host.zeros(n, _POINTS, w) for name, w in widths.items()}
    values |= self._shape | host.surface() | dict(
      nneedle=n,
      nlisted=len(self._shape["geom"]),
      ngeom=host.m.ngeom,
      edge=float(host.organ.mesh.whole.edge_length),
      edges=np.tile(self._shape["edges"], (host.nworld if self._refines else 1, 1, 1)),
      law=np.zeros((host.nworld, n, len(PIERCE))),
      lifted=host.lifted(),
      state=host.rows("needle", len(NEEDLE)),
      next=host.zeros(n, len(NEEDLE)),
      held=host.zeros(n, _POINTS, 4, dtype=int),
      feels=host.zeros(n, _POINTS, dtype=int),
      weight=host.zeros(n),
    )  # fmt: skip
    self.fields = host.fill(Pierced, values, into=self.fields)
    self.refresh()
    for k, thread in enumerate(self._threads):
      if thread["flex"] >= 0:
        self._hold(k, thread)

  def _hold(self, k: int, thread: dict):
    """Lets the step of a thread know what holds it."""
    host = self.host
    ties, first = host.ties(thread["flex"]), host.zeros(dtype=int)
    frame = {"frame": thread["frame"], "origin": thread["origin"]}
    given = {"pierced": self.fields, "first": first, "span": ties.span, "drawn": thread["edges"]}
    refines = thread["refine"]
    given["moved"] = ties.track(len(thread["node"])) if refines else np.zeros((1, 0))
    held = host.fill(Held, given | frame | ties.arrays)
    host.load(_aim)
    measure, aim, lift, self._feel[k] = (
      host.command(each, held, self.count, k) for each in (_measure, _aim, _lift, _feel)
    )

    def aim_all():
      if refines:
        measure()
      aim()

    def lift_all():
      lift()
      host.open_contacts()

    ties.aims[host.instance, k] = aim_all, lift_all

  @property
  def sews(self) -> bool:
    """Whether it holds threads: these take their steps before the organ, which bears that."""
    return bool(self._feel)

  def lead(self):
    """Takes the forces of the threads' steps, which these take first."""
    for k, feel in self._feel.items():
      self.host.ties(self._threads[k]["flex"]).lead(self.host.instance)
      feel()

  def sew(self, name: str, x: np.ndarray):
    """Makes holes where a needle's thread goes through the surface, of one world.

    Args:
      name: of the needle's body
      x: places of the organ's vertices now, in the world [m]  (nvert, 3)

    Raises:
      ValueError: there is no such needle, it has no thread, or that goes through nowhere, or too
        often.
    """
    host, what = self.host, f"organ {self.host.organ.name!r}: needle {name!r}"
    if name not in self.names:
      raise ValueError(f"{what} is not in its needles, expected one of {', '.join(self.names)}")
    k = self.names.index(name)
    nodes = self._threads[k]["node"]
    if not len(nodes):
      raise ValueError(f"{what} has no thread, expected one joined by `add_needle`")
    line = np.stack([host.body_frame(int(body))[1] for body in nodes])
    found = sorted(topology.crossings(line, x[host.organ.mesh.elem]))
    # Through an edge or a corner it goes once.
    rows = [
      row for row, last in zip(found, [(-1.0,), *found], strict=False) if row[0] > last[0] + _SAME
    ]
    if not 0 < len(rows) <= HOLES:
      raise ValueError(
        f"{what} has a thread that crosses the surface {len(rows)} times, expected 1 to {HOLES}"
      )
    first, count = self._shape["strand"][k]
    length = self.fields.edges.numpy()[0, first : first + count - 1, 0]
    before = np.r_[0.0, np.cumsum(length)]
    along = np.interp([row[0] for row in rows], np.arange(len(before)), before)
    state = self.fields.state.numpy()[0, k]
    state[:] = 0.0
    state[NEEDLE.count] = len(rows)
    solid = host.config.elements == "solid"
    for h, (place, (_, *seat, against)) in enumerate(zip(along[::-1], rows[::-1], strict=True)):
      hole = state[NEEDLE.hole + len(HOLE) * h :][: len(HOLE)]
      hole[HOLE.kind] = (_INTO if against else _OUT) if solid else _THROUGH
      hole[HOLE.elem : HOLE.elem + 3] = seat
      hole[HOLE.thread] = place
    self.fields.solve.quiet.numpy()[0] = 0.0  # an organ that slept does so no longer

  def refresh(self, tissue: np.ndarray | None = None, thickness: Any = None):
    """Takes the material that there is now.

    Args:
      tissue: TISSUE of each world; None for the configuration's
      thickness: of the wall of each [m]; None for the configuration's
    """
    if self.fields is None:
      return
    host = self.host
    if tissue is None:
      tissue = np.atleast_2d(contacts.tissue_of(host.m, host.organ, host.config))
      thickness = host.config.thickness
    law = self._law(tissue[:, contacts.TISSUE.asked], thickness)
    self.fields.law.assign(np.broadcast_to(law, self.fields.law.shape))

  # Its holes follow cuts.

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Force`."""
    if self:
      self._before.setdefault(world, self.host.mesh(world))

  def reshape(self, world: int):
    """See `Force`: holes stay where they are in the tissue, those that a cut went through open."""
    was = self._before.pop(world, None)
    if was is None:  # a state that was set has holes of its mesh
      return
    mesh = self.host.mesh(world)
    with edited(self.fields.state, world) as state:
      for row, slit in zip(state, self._slit, strict=True):
        rows = row[NEEDLE.hole :].reshape(HOLES, len(HOLE))
        count = int(row[NEEDLE.count])
        kept = [h for h in range(count) if _stays(was, mesh, rows[h], slit)]
        rows[: len(kept)] = rows[kept]
        row[NEEDLE.count] = len(kept)
        if row[NEEDLE.stage]:
          _find_again(was, mesh, row[NEEDLE.elem :], bool(row[NEEDLE.stage] == _INSIDE))

  def read(self, x: np.ndarray) -> list[Needle]:
    """Returns what the needles do, of one world, with vertices at places [m], (nvert, 3)."""
    if not self:
      return []
    organ, out = self.host.organ, []
    mesh, turn = organ.mesh, organ.frame.T
    rest = organ.origin + mesh.rest @ turn
    force = self.fields.force.numpy()[0] @ turn
    state = self.fields.state.numpy()[0]
    for k, (name, row) in enumerate(zip(self.names, state, strict=True)):
      holes = []
      for h in range(int(row[NEEDLE.count])):
        hole = row[NEEDLE.hole + len(HOLE) * h :]
        within, thread = bool(hole[HOLE.kind] == _WITHIN), float(hole[HOLE.thread])
        vert, share = _corners(mesh, hole[HOLE.elem :], within)
        at = share @ x[vert]
        along = -thread if thread > 0 else self._along(k, at)
        place = at, share @ rest[vert], along
        holes.append(Pinhole(name, within, thread > 0, *place, force[k, h], float(hole[HOLE.torn])))
      stage, energy = row[[NEEDLE.stage, NEEDLE.work]]
      whole, tip = force[k].sum(axis=0), force[k, HOLES]
      told = stage == _TOUCHING, stage == _INSIDE, whole, tip, float(energy), tuple(holes)
      out.append(Needle(name, *told))
    return out

  def _along(self, k: int, at: np.ndarray) -> float:
    """Returns how far along a needle the point is that is nearest to a place [m]."""
    turn, origin = self.host.body_frame(int(self._shape["body"][k]))
    x, y, _ = (at - origin) @ turn
    half, circle = self._shape["half"][k], self._shape["circle"][k]
    return float((np.arctan2(y, x) + half) * circle)


def _corners(mesh: Mesh, seat: np.ndarray, inside: bool) -> tuple[np.ndarray, np.ndarray]:
  """Returns the vertices of a seat's triangle or tetrahedron, and their shares."""
  elem, share = int(seat[0]), seat[1:4]
  if not inside:
    return mesh.elem[elem], np.array([1 - share[:2].sum(), *share[:2]])
  return mesh.tet[elem], np.array([1 - share.sum(), *share])


def _find_again(was: Mesh, mesh: Mesh, seat: np.ndarray, inside: bool) -> np.ndarray:
  """Puts a seat where it was in the tissue before a cut; returns that place at rest [m]."""
  vert, share = _corners(was, seat, inside)
  at = share @ was.rest[vert]
  if not inside:
    elem = np.array([int(seat[0])])
    elem, weight = transfer.found_again(mesh, elem, share[None], was.rest[vert][None])
    seat[:3] = elem[0], *weight[0, 1:]
  elif (mesh.rest[mesh.tet[int(seat[0])]] != was.rest[vert]).any():
    x = mesh.rest[mesh.tet] - at
    edges = (x[:, 1:] - x[:, :1]).transpose(0, 2, 1)
    shares = np.linalg.solve(edges, -x[:, 0, :, None])[..., 0]
    tet = int(np.minimum(shares.min(axis=1), 1 - shares.sum(axis=1)).argmax())
    seat[:4] = tet, *shares[tet]
  return at


def _stays(was: Mesh, mesh: Mesh, hole: np.ndarray, slack: float) -> bool:
  """Puts a hole where it was; returns whether a sheet has not come apart within a slack."""
  inside = bool(hole[HOLE.kind] == _WITHIN)
  at = _find_again(was, mesh, hole[HOLE.elem :], inside)
  if len(mesh.tet):
    return True
  rim = np.flatnonzero((mesh.twin < 0) & (mesh.whole.twin >= 0))
  start, stop = (mesh.rest[topology.corners(mesh, rim, k)] for k in (0, 1))
  way, arm = stop - start, at - start
  share = np.clip((arm * way).sum(axis=1) / (way * way).sum(axis=1), 0, 1)
  return bool((np.linalg.norm(arm - share[:, None] * way, axis=1) > slack).all())
