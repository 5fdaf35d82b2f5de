"""Surgical threads: `add_thread` adds one to an `mujoco.MjSpec`, `Thread` is the handle on it."""

import functools
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from . import authoring, windows
from .attributes import CONTACT, text
from .engine import plugin as engine
from .organ import instance_of
from .tissue import config as configuration
from .tissue import rod
from .tissue.sutures import DIAMETER, SUTURES

# Of what holds a node: time constant [s] and damping ratio, and impedance; of what holds it loosely
# stiffness and damping, and impedance, none to speak of.
HELD, LOOSE = ((0.004, 1.0), 0.9), ((-1e-10, -1e-10), 1e-4)
_RGBA = (0.35, 0.2, 0.5, 1.0)  # violet, as absorbable threads are dyed


def add_thread(
  spec: mujoco.MjSpec,
  points,
  name: str = "thread",
  *,
  material: str = "silk",
  size: str = "3-0",
  parent: mujoco.MjsBody | str | None = None,
  pos: Sequence[float] = (0.0, 0.0, 0.0),
  quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
  pin: Sequence[int] = (),
  rgba: Sequence[float] = _RGBA,
  contact: Mapping[str, object] | None = None,
  bead: float = 0.0,
  **config,
) -> mujoco.MjsFlex:
  """Adds a surgical thread to a spec, in a body of its name, as a <flexcomp> of dim 1 in MJCF.

  The thread is straight at rest, whatever line it starts on. A <connect> of a node's body,
  `<name>_<k>`, fixes an end to an instrument or a needle.

  Args:
    spec: changed in place, unless an error is raised
    points: its nodes, two or more, no closer than its radius [m]  (n, 3)
    name: of flex, body and plugin instance; the nodes' bodies are `<name>_<k>`
    material: `vicryl`, `silk` or `polypropylene`
    size: `3-0`, `4-0` or `5-0`
    parent: of the body, which must not move; None for the world
    pos: of the body in its parent [m]
    quat: orientation of the body in its parent
    pin: nodes that do not move; two next to each other hold the direction and turn of their edge
    rgba: colour
    contact: attributes of <contact> that differ from the defaults
    bead: radius of a bead at the last node, such as a clip or a knot, which has no contacts but
      does not pass a narrower hole of a needle; 0 for none [m]
    **config: keys of a rod, some of which replace the material's: young, poisson, bend, twist,
      strength, yield_strain, drag, refine

  Returns:
    The flex, for instance to give it a material.

  Raises:
    ValueError: a key, value, name or point is not allowed; the message says what is.
  """
  for what, value, known in (("material", material, SUTURES), ("size", size, DIAMETER)):
    if value not in known:
      raise ValueError(f"thread {name!r}: {what} is {value!r}, expected one of {', '.join(known)}")
  suture, radius = SUTURES[material], 0.5 * DIAMETER[size]
  nodes = np.asarray(points, dtype=float)
  if nodes.ndim != 2 or nodes.shape[1] != 3 or len(nodes) < 2 or not np.isfinite(nodes).all():
    raise ValueError(f"thread {name!r}: points is {nodes.shape}, expected (n, 3), n of 2 or more")
  length = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
  rod.check_edges(name, length, radius)
  own = {
    "young": suture.young,
    "bend": suture.bend,
    "twist": suture.twist,
    "strength": suture.strength[size],
  } | config
  texts = {key: text(value, 17) for key, value in own.items()} | {"elements": "rod"}
  given = {**CONTACT, "friction": suture.friction, **(contact or {})}
  try:
    pins = authoring.pinned(name, pin, len(nodes))
    configuration.parse(name, texts, len(length), closed=False)
    look = authoring.look_of(name, radius, rgba) | authoring.contact_of(name, given)
    where = authoring.parent_of(spec, name, parent)
    authoring.check_names(spec, name, len(nodes))
  except ValueError as error:
    raise ValueError(str(error).replace("organ ", "thread ", 1)) from None
  body = where.add_body(name=name, pos=pos, quat=quat)
  mass = suture.density * np.pi * radius**2 * length.sum() / len(nodes)
  placed = authoring.add_nodes(spec, body, nodes, pins, mass, texts)
  if bead:
    spec.body(f"{name}_{len(nodes) - 1}").add_geom(
      size=[bead, 0, 0], mass=0, contype=0, conaffinity=0, rgba=rgba
    )
  elem = np.arange(len(length))[:, None] + (0, 1)
  return windows.make_flex(spec, name, *placed, elem, **look)


def holds_of(model: mujoco.MjModel, body: np.ndarray) -> dict[str, int]:
  """Returns the equalities by which bodies can hold a node, by name, see `Thread.hold`.

  Args:
    model: compiled
    body: of each node  (nnode,)
  """
  found = (
    (model.eq_type == mujoco.mjtEq.mjEQ_CONNECT) & (model.eq_objtype == mujoco.mjtObj.mjOBJ_BODY)
    & np.isin(model.eq_obj2id, body) & (model.eq_active0 == 0)
  )  # fmt: skip
  return {model.equality(int(k)).name: int(k) for k in np.flatnonzero(found)}


def no_hold(thread: str, name: str, holds: Mapping[str, int]) -> ValueError:
  """Returns the error that lists the equalities that can hold a thread."""
  have = ", ".join(map(repr, holds)) or "none"
  return ValueError(
    f"thread {thread!r}: {name!r} cannot hold it, expected a connect between a body and a node "
    f"with active='false'; the scene has {have}"
  )


class Thread:
  """Positions, tension and twist of a thread, in world coordinates and SI units.

  Args:
    model: the compiled model
    data: its data
    name: name of the flexcomp

  Raises:
    ValueError: the model has no thread of that name; the message lists those it has.
  """

  def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, name: str):
    self.model, self.data, self.name = model, data, name
    self._space = engine.find_thread(data._address, instance_of(model, "thread", name))

  @property
  def positions(self) -> np.ndarray:
    """Positions of the nodes [m], (nnode, 3)."""
    organ = self._space.organ
    return organ.origin + self._local() @ organ.frame.T

  def _local(self) -> np.ndarray:
    """Returns places in the slides' axes [m], (nnode, 3)."""
    organ = self._space.organ
    out, at = organ.rest.copy(), organ.qposs.reshape(-1, 3)
    out[organ.free] += self.data.qpos[at] - self.model.qpos0[at]
    return out

  def lay(self, points: np.ndarray, nodes: Sequence[int] | None = None, tension: float = 0.0):
    """Puts the thread, or a part of it, at rest along a line.

    Args:
      points: of the line, from the first of the nodes on, in the world [m]; beyond them the
        thread continues straight                                      (n, 3)
      nodes: consecutive nodes along the line, up to an end of the thread; the others stay. None
        for all nodes, which also resets twist and breaks; bends that it has kept are lost
      tension: of these edges [N]

    Raises:
      ValueError: the thread has pinned nodes, or the nodes are not consecutive.
    """
    organ, line = self._space.organ, np.asarray(points, dtype=float)
    if not organ.free.all():
      raise ValueError(f"thread {self.name!r} has pinned nodes, expected one without")
    which = np.arange(len(organ.rest)) if nodes is None else np.asarray(nodes)
    if abs(np.diff(which)).max(initial=1) != 1 or abs(which[-1] - which[0]) != len(which) - 1:
      raise ValueError(f"thread {self.name!r}: nodes is {nodes}, expected consecutive ones")
    if nodes is None:
      self._space.plugin_state[:] = 0.0
    self._own_rest()[which] = 0.0
    edge, measured = np.minimum(which[1:], which[:-1]), self._space.measured()
    length = measured["length"][edge] + tension / measured["stretch"][edge]
    last = line[-1] - line[-2]
    line = np.concatenate([line, line[-1:] + length.sum() / np.linalg.norm(last) * last])
    places, k = [line[0]], 0
    for far in length:  # each edge is a chord of the line
      while np.linalg.norm(line[k + 1] - places[-1]) < far:
        k += 1
      way, off = line[k + 1] - line[k], line[k] - places[-1]
      a, b, c = way @ way, way @ off, off @ off - far**2
      places.append(line[k] + (np.sqrt(b * b - a * c) - b) / a * way)
    at = organ.qposs.reshape(-1, 3)[which]
    local = (places - organ.origin) @ organ.frame - organ.rest[which]
    self.data.qpos[at] = self.model.qpos0[at] + local
    self.data.qvel[organ.dofs.reshape(-1, 3)[which]] = 0.0

  @functools.cached_property
  def holds(self) -> dict[str, int]:
    """Equalities by which bodies can hold a node, see `hold`: numbers by name."""
    return holds_of(self.model, self._space.organ.body)

  def hold(self, by: str, node: int, anchor: Sequence[float] = (0, 0, 0), firm: bool = True):
    """Lets a body hold a node, or release it.

    Near the node the thread has no contacts with that body.

    Args:
      by: name of a <connect> between the body and any node, with active="false" in MJCF
      node: number of the node to hold; -1 releases
      anchor: point of the body that holds it [m]  (3,)
      firm: whether the equality carries force; without it only the contacts stay off

    Raises:
      ValueError: an argument is not allowed.
    """
    organ, model = self._space.organ, self.model
    nnode = len(organ.rest)
    if by not in self.holds:
      raise no_hold(self.name, by, self.holds)
    if not -1 <= node < nnode:
      raise ValueError(f"thread {self.name!r}: node is {node}, expected one in [-1, {nnode})")
    which = self.holds[by]
    self.data.eq_active[which] = node >= 0
    if node >= 0:
      solref, impedance = HELD if firm else LOOSE
      model.eq_obj2id[which] = organ.body[node]
      model.eq_data[which, :6] = *anchor, 0.0, 0.0, 0.0
      model.eq_solref[which] = solref
      model.eq_solimp[which, :2] = impedance

  @property
  def length(self) -> float:
    """Present length [m]."""
    return float(np.linalg.norm(np.diff(self.positions, axis=0), axis=1).sum())

  @property
  def rest_lengths(self) -> np.ndarray:
    """Rest length of each edge [m], (nnode - 1,); the key `refine` changes it."""
    return self._space.measured()["length"][:-1].copy()

  @property
  def tension(self) -> np.ndarray:
    """Tension of each edge [N], (nnode - 1,); negative where it is compressed."""
    return rod.tension(self._space.measured(), self._local(), self.broken)

  @property
  def twist(self) -> np.ndarray:
    """Twist at each node between two edges, 0 at the ends [rad], (nnode,)."""
    return self._space.own.twist.numpy().copy()

  @property
  def rest_curvature(self) -> np.ndarray:
    """Bend that each node has kept, as the key `yield_strain` lets it, (nnode, 3).

    Along the axis of the bend, in the axes of the parent body, its length 2 tan(angle / 2).
    """
    return self._own_rest().copy()

  def _own_rest(self) -> np.ndarray:
    kept = self._space.own.rest_curvature.numpy()
    return kept.reshape(-1, 3) if len(kept) else np.zeros((len(self._space.organ.rest), 3))

  @property
  def energy(self) -> float:
    """Elastic energy [J]."""
    own = self.twist, self._own_rest(), self.broken
    return rod.energy(self._space.measured(), self._local(), *own)

  @property
  def broken(self) -> np.ndarray:
    """Whether each edge has broken, (nnode - 1,) bool: its tension was above `strength`."""
    return self._space.own.broken.numpy()[:-1] > 0

  def turn(self, edge: int, angle: float):
    """Turns a clamped edge about itself, from the first to the second of its nodes.

    Args:
      edge: number of an edge between two pinned nodes
      angle: by how much [rad]

    Raises:
      ValueError: the edge is not clamped.
    """
    clamped = np.flatnonzero(self._space.organ.clamped)
    if edge not in clamped:
      have = ", ".join(map(str, clamped)) or "none"
      raise ValueError(f"thread {self.name!r}: edge {edge} is not clamped, expected one of {have}")
    twist = self._space.own.twist.numpy()
    twist[edge] += angle * (edge > 0)
    twist[edge + 1] -= angle * (edge + 2 < len(twist))

  @property
  def error(self) -> str | None:
    """What went wrong since the last reset, or None."""
    return self._space.report.error
