"""What acts beside the tissue of an organ of `Worlds`; kernels are the plugin's."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
from typing import Any

import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine.forces import attachments, passive, relaxation, supports
from palpate.engine.forces import cohesive_bonds as engine_bonds
from palpate.engine.layout import BOND, FLAG
from palpate.engine.workspace import FORCES
from palpate.tissue import body as bodies
from palpate.tissue.kernels import Kernel
from palpate.tissue.step import SCHEMES
from palpate.tissue.types import doubles, fill, floats, ints, struct, vector

from ..kernels import BondLists, show_bonds, weaken_bonds
from .base import (
  Beside,
  WorldBodies,
  WorldNodes,
  in_worlds,
  input_of,
  kernels,
  mesh_of,
  nodes_of,
)
from .bonds import Bonds

_PARTS = {"own": WorldNodes, "other": WorldNodes, "mj": WorldBodies}
_number = floats("nworld", "nnumber")
BOND_ROWS = "state", "next", "stretch", "force", "pull", "hardness"
WorldBonded = in_worlds(
  engine_bonds.Bonded, BOND_ROWS, _PARTS | {"number": _number}, ("count", *engine_bonds.LISTS)
)
WorldBurning = in_worlds(
  engine_bonds.Burning, (), {"bonds": WorldBonded, "ctrl": floats("nworld", "nu")}
)
REST_ROWS = (
  "slip",
  "slipped",
  "on",
  "force",
  "hardness",
  "corner",
  "weight",
  "where",
  "next",
  "first",
)
WorldTied = in_worlds(
  attachments.Tied,
  ("point", "force"),
  _PARTS | {"number": _number, "dvel_warm": vector},
  attachments.LISTS,
)
BELOW = "nother", "elem", "near_adr", "near"
WorldRest = in_worlds(supports.Rest, REST_ROWS, _PARTS, ("nouter", "stiffness", *BELOW))
WorldCreeping = in_worlds(relaxation.Creeping, ("own",), {})


@struct
class Aimed:
  """Ties to another organ."""

  row: ints("nworld")  # which row of the lists below a world has
  count: ints("nrow", 1)  # number of them
  first: ints("nrow", 1)  # the first among all ties
  pair: ints("nrow", "npair")  # vertices of the other organ
  anchor: doubles("nrow", "npair", 3)  # from there to the points, in the world [m]
  point: doubles("nworld", "ntie", 6)  # place and velocity of the points [m, m/s]
  other: WorldNodes
  mj: WorldBodies


_stretch, _enter, _bear, _act, _feel, _keep = kernels(
  "forces/cohesive_bonds.h", WorldBonded, *engine_bonds.KERNELS
)
(_burn,) = kernels("forces/cohesive_bonds.h", WorldBurning, "burn_bonds")
_enter_ties, _act_ties = kernels("forces/attachments.h", WorldTied, *attachments.KERNELS)
(_aim,) = kernels("forces/attachments.h", Aimed, "aim_ties")
_find, _press, _act_rest, _feel_rest, _keep_rest = kernels(
  "forces/supports.h", WorldRest, *supports.KERNELS
)
_find_organ, _bear_organ = kernels("forces/supports.h", WorldRest, *supports.BELOW)
_enter_creep, _end_creep = kernels("forces/relaxation.h", WorldCreeping, *relaxation.KERNELS)


class InBonds(Beside):
  """Bonds of an organ, and those that others have to it."""

  def __init__(self, organ, numbers: np.ndarray):
    super().__init__(organ)
    made, batch = organ.space.bonds.groups, organ.batch
    self._others = [group.other and batch.organ(group.other.organ.name) for group in made]
    self.follow([organ, *filter(None, self._others)])
    self.groups: list[tuple[Any, Any]] = []
    self.borne: list[tuple[Any, Any]] = []
    count = coupling.sizes(organ.declared)["nbond"]
    if made:
      self._state = self._keep("bond", np.arange(count), len(BOND))
    for group, other in zip(made, self._others, strict=True):
      self.groups.append((group, self._fill(group, other, numbers)))
    currents = organ.space.cutters.by_current.values()
    self._burning = [
      fill(WorldBurning, self._device, current.burning | {"bonds": b, "ctrl": batch.d.ctrl})
      for current in currents
      for _, b in self.groups
    ]

  def bear(self, others: list["InBonds"]):
    """Finds the bonds that others have to it, once all have been made."""
    mine = self._organ.space.bonds.borne
    self.borne = [pair for each in others for pair in each.groups if pair[0] in mine]

  def _fill(self, group, other, numbers: np.ndarray):
    organ = self._organ
    room = organ.declared.mesh.spare
    values: dict[str, Any] = self.lists(WorldBonded, _bonds_of(group.now), room)
    scheme, n = SCHEMES[organ.config.integrator], values["vert"].shape[1]
    shapes: dict[str, tuple] = {name: (n, 3) for name in ("stretch", "force", "pull")}
    shapes |= {"next": (n, len(BOND)), "hardness": (n,)}
    values |= dict(zip(("stiffness", "strength", "energy"), group.law, strict=True))
    values |= {name: self._zeros(self._nworld, *shape) for name, shape in shapes.items()}
    values |= dict(
      body=int(numbers[group.body]) if group.body >= 0 else group.body,
      restless=group.bonded.restless,
      ahead=float(scheme.ahead),
      gain=scheme.gain(1.0, 0.0),
      live=np.ones(1),
      state=self._state,
      own=nodes_of(organ),
      solve=input_of(organ),
      other=WorldNodes() if other is None else nodes_of(other),
      below=passive.Input() if other is None else input_of(other),
      number=organ.body.tissue.number,
      mj=organ.batch.bodies,
    )
    return fill(WorldBonded, self._device, values)

  @property
  def aims(self) -> bool:
    """See `Beside`."""
    return any(b.restless and b.body >= 0 for _, b in self.groups)

  def enter(self):
    """See `Beside`."""
    for _, b in self.groups:
      self._over(_stretch, b, _count(b))
      self._over(_enter, b, _count(b))
    for _, b in self.borne:
      self._over(_stretch, b, _count(b))
      self._over(_bear, b, 1)

  def act(self):
    """See `Beside`."""
    for _, b in self.groups:
      self._over(_act, b, _count(b))
      if b.body >= 0 and b.restless:
        self._over(_feel, b, 1)

  def end(self):
    """See `Beside`."""
    for _, b in self.groups:
      self._over(_keep, b, _count(b))
    for burning in self._burning:
      self._over(_burn, burning, 1)

  def found(self, world: int) -> list[dict[str, np.ndarray]]:
    """See `Beside`."""
    return [_bonds_of(each) for each in self._now(world)]

  def _now(self, world: int) -> list:
    pairs = zip(self.groups, self._others, strict=True)
    own = mesh_of(self._organ, world)
    return [group.found(own, other and mesh_of(other, world)) for (group, _), other in pairs]

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Beside`."""
    if self.groups:
      state = self._state[world].numpy()
      engine_bonds.carry(self._organ.declared, state, group, member, share)
      self._state[world].assign(state)

  def springs(self, world: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """See `Beside`."""
    state = self._state[world].numpy()
    return [
      group.springs(now, state, b.stretch[world].numpy())
      for (group, b), now in zip(self.groups, self._now(world), strict=True)
    ]


def _bonds_of(now: engine_bonds.Found) -> dict[str, np.ndarray]:
  out = {name: np.asarray(getattr(now, name)) for name in engine_bonds.LISTS}
  return out | {"count": np.array([len(now.vert)])}


def _count(b) -> int:
  """Returns how many bonds there is room for."""
  return b.hardness.shape[1]


class Grown(Bonds):
  """The bonds of an organ of `Worlds`, for those who ask.

  Args:
    organ: the organ
  """

  def __init__(self, organ):
    found = [each.groups for each in organ.beside if isinstance(each, InBonds)]
    groups = [pair for each in found for pair in each]
    made = [group.now for group, _ in groups]
    self.vertices = np.concatenate([np.zeros(0, int), *(now.vert for now in made)])
    self.area = np.concatenate([np.zeros(0), *(now.area for now in made)])
    first = np.cumsum([0, *(len(now.vert) for now in made)])
    names = "row", "count", "made", "slot", "state", "pull"
    self._groups = [
      fill(BondLists, b.row.device, {"before": int(k)} | {name: getattr(b, name) for name in names})
      for (_, b), k in zip(groups, first, strict=False)
    ]
    super().__init__(organ.batch.nworld, organ.batch.device)

  def _over(self, what, *values: wp.array):
    for lists in self._groups:
      dim = lists.pull.shape[:2]
      wp.launch(what, dim=dim, inputs=[lists, *values], device=self._device)

  def _tell(self):
    self._damage.fill_(1.0)
    self._force.zero_()
    self._over(show_bonds, self._damage, self._force)

  def _weaken(self, amount: wp.array):
    self._over(weaken_bonds, amount)


class Ties(Beside):
  """What an organ is attached to; a thread has all ties of a world."""

  def __init__(self, organ, numbers: np.ndarray):
    super().__init__(organ)
    made, batch = organ.space.ties, organ.batch
    known: Any = made.fields
    self._groups, self._numbers = made.groups, numbers
    self._others = [g.other and batch.organ(g.other.organ.name) for g in made.groups]
    organs = [organ, *{id(other): other for other in self._others if other}.values()]
    self.follow(organs)
    lists, *aims = self._lists_of([group.now for group in made.groups])
    room = len(made.groups) * sum(each.declared.mesh.spare for each in organs)
    values: dict[str, Any] = self.lists(WorldTied, lists, room)
    n = values["vert"].shape[1]
    values |= {name: getattr(known, name).numpy() for name in ("owned", "restless")}
    point = self._zeros(self._nworld, n, 6)
    values |= dict(
      ahead=known.ahead, gain=known.gain, point=point, force=self._zeros(self._nworld, n, 3),
      own=nodes_of(organ), solve=input_of(organ), number=organ.body.tissue.number,
      dvel_warm=organ.body.state.dvel_warm, mj=batch.bodies,
    )  # fmt: skip
    self._fields, self._aimed = fill(WorldTied, self._device, values), []
    self._moves = bool(values["restless"][0] and (lists["body"] >= 0).any())
    for other, aim in zip(filter(None, self._others), aims, strict=True):
      own = {"point": point, "other": nodes_of(other), "mj": batch.bodies}
      own |= self.lists(Aimed, aim, room)
      self._aimed.append(fill(Aimed, self._device, own))

  def _lists_of(self, found: list) -> list[dict[str, np.ndarray]]:
    """Returns what `WorldTied` has of groups that became this, and `Aimed` of those to organs."""
    lists, aims, first = self._organ.space.ties.lists(found), [], 0
    body = lists["body"]
    out = [lists | {"body": np.where(body < 0, body, self._numbers[body])}]
    for now, other in zip(found, self._others, strict=True):
      if other:
        numbers = {"count": np.array([len(now.vert)]), "first": np.array([first])}
        aims.append(numbers | {"pair": now.pair, "anchor": now.anchor})
      first += len(now.vert)
    return out + aims

  def found(self, world: int) -> list[dict[str, np.ndarray]]:
    """See `Beside`."""
    own = mesh_of(self._organ, world)
    pairs = zip(self._groups, self._others, strict=True)
    return self._lists_of([g.found(own, o and mesh_of(o, world)) for g, o in pairs])

  def springs(self, world: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """See `Beside`."""
    f, row = self._fields, self.at(world)
    count = int(f.count[row].numpy()[0])
    vert, stiff = (array[row].numpy()[:count] for array in (f.vert, f.stiffness))
    return [attachments.springs(vert, stiff, f.force[world].numpy()[:count])]

  @property
  def aims(self) -> bool:
    """See `Beside`."""
    return self._moves

  def _alone(self, what: Kernel):
    what.launch(self._device, self._nworld, 1, 0, self._fields, 32)

  def enter(self):
    """See `Beside`."""
    for aimed in self._aimed:
      self._over(_aim, aimed, aimed.pair.shape[1])
    self._alone(_enter_ties)

  def act(self):
    """See `Beside`."""
    self._alone(_act_ties)


class Rests(Beside):
  """The geoms and organs that an organ rests on.

  Attributes:
    on: what the kernels take of each organ below, and that organ
  """

  def __init__(self, organ, numbers: np.ndarray):
    super().__init__(organ)
    known: Any = organ.space.rests
    alone, n = known.alone, organ.nvert
    below = [organ.batch.organ(other.organ.name) for other in known.below]
    self._n, self._known, self._below = n, known, below
    self.follow([organ, *below])
    above = self._of_mesh(known.above_of(organ.declared.mesh))
    shapes = {"slipped": (n, 3), "force": (n, 3), "hardness": (n, 6), "weight": (n, 3)}
    values: dict[str, Any] = {name: getattr(alone, name) for name in ("ngeom", "restless", "skin")}
    values |= {name: getattr(alone, name).numpy() for name in ("geom", "friction", "free")}
    values |= {name: self._zeros(self._nworld, *shape) for name, shape in shapes.items()}
    self._slip = self._keep("slip", np.arange(n), 3)
    values |= dict(
      cell=alone.cell,
      corner=self._zeros(self._nworld, n, 3, dtype=int),
      on=self._zeros(self._nworld, n, dtype=int),
      slip=self._slip,
      own=nodes_of(organ),
      solve=input_of(organ),
      mj=organ.batch.bodies,
    )
    nothing = self._other(alone, 0) | {"other": WorldNodes(), "below": passive.Input()}
    none = {name: getattr(alone, name).numpy() for name in BELOW}
    nothing |= self.lists(WorldRest, above | none)
    self._fields = fill(WorldRest, self._device, values | nothing)
    self.on = []
    for fields, theirs in zip(known.on, below, strict=True):
      own = self._other(fields, theirs.nvert)
      own |= {"other": nodes_of(theirs), "below": input_of(theirs)}
      own |= self.lists(WorldRest, above | supports.below_of(theirs.declared.mesh))
      self.on.append((fill(WorldRest, self._device, values | own), theirs))

  def _of_mesh(self, above: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns the stiffness of the springs with that of all vertices."""
    stiffness = np.zeros(self._n)
    stiffness[: len(above["stiffness"])] = above["stiffness"]
    return above | {"stiffness": stiffness}

  def found(self, world: int) -> list[dict[str, np.ndarray]]:
    """See `Beside`."""
    above = self._of_mesh(self._known.above_of(mesh_of(self._organ, world)))
    below = [supports.below_of(mesh_of(other, world)) for other in self._below]
    return [above, *(above | each for each in below)]

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """See `Beside`."""
    slip = self._slip[world].numpy()
    supports.carry(slip, group, member)
    self._slip[world].assign(slip)

  def _other(self, known, n: int) -> dict[str, Any]:
    """Returns the fields of the plugin's other organ of n vertices, in all worlds."""
    zeros = {"next": (n,), "first": known.first.shape}
    out = {name: self._zeros(self._nworld, *shape, dtype=int) for name, shape in zeros.items()}
    return out | {"mu": known.mu, "where": self._zeros(self._nworld, n, 3)}

  @property
  def aims(self) -> bool:
    """See `Beside`."""
    return bool(self._fields.restless)

  def _each(self, what: Kernel):
    self._over(what, self._fields, self._n)

  def find(self):
    """Finds what each node rests on."""
    self._each(_find)
    for which, (fields, _) in enumerate(self.on):
      self._over(_find_organ, fields, 1, which)

  def enter(self):
    """See `Beside`."""
    self.find()
    self._each(_press)

  def act(self):
    """See `Beside`."""
    self._each(_act_rest)
    if self._fields.restless:
      self._over(_feel_rest, self._fields, 1)

  def end(self):
    """See `Beside`."""
    self._each(_keep_rest)


class Bears(Beside):
  """An organ that another rests on.

  Args:
    organ: the organ below
    rests: what the other rests on
    which: where it is among those
  """

  def __init__(self, organ, rests: Rests, which: int):
    super().__init__(organ)
    self._rests, self._which = rests, which

  def enter(self):
    """See `Beside`."""
    self._rests.find()
    self._over(_bear_organ, self._rests.on[self._which][0], 1, self._which)


class Creep(Beside):
  """Stress relaxation of an organ."""

  def __init__(self, organ, numbers: np.ndarray):
    super().__init__(organ)
    w, body, h = organ.space, organ.body, organ.batch.bare.opt.timestep
    bodies.hold(body)
    node = body.shape.node.numpy()[np.flatnonzero(organ.declared.free)]
    # Whether the step ended with the organ's answer, which is the same in all worlds.
    answered = np.zeros((2, len(FLAG)), np.int32)
    answered[1, FLAG.answered] = 1
    self._flags = [wp.array(row, dtype=int, device=self._device) for row in answered]
    values = dict(
      ncreep=len(node),
      node=node,
      own=self._keep("creep", np.arange(len(node)), 6),
      held=1,
      number=np.array([w.config.relax_share, w.config.relax_time]),
      flags=self._flags[0],
      quiet=organ.patch.calm,
      hold=body.state.hold,
      mj=fill(relaxation.Clock, self._device, {"timestep": np.array([h])}),
    )
    values |= {name: getattr(body.state, name) for name in ("mass", "force_ext", "dvel")}
    values |= {name: getattr(body.system, name) for name in ("sol", "rhs", "status")}
    self._fields = fill(WorldCreeping, self._device, values)

  def enter(self):
    """See `Beside`."""
    self._over(_enter_creep, self._fields, self._fields.ncreep)

  def end(self):
    """See `Beside`."""
    organ = self._organ
    self._fields.flags = self._flags[bool(organ.patch.stiff and organ.responds)]
    self._over(_end_creep, self._fields, self._fields.ncreep)


# What has a kind here, of `FORCES`; blades are in `batch.cutting`.
KINDS: dict[str, Any] = {"ties": Ties, "bonds": InBonds, "rests": Rests, "creep": Creep}
_KNOWN = {*KINDS, "cutters"}


def check(spaces: list):
  """Raises ValueError where workspaces have beside their tissue what a batch on a GPU cannot do."""
  for w in spaces:
    for name, kind in FORCES.items():
      if getattr(w, name) and name not in _KNOWN:
        raise ValueError(
          f"organ {w.organ.name!r}: {' or '.join(kind.KEYS)} is set, which a batch on a GPU cannot "
          "do; expected none"
        )


def meet(organs: list):
  """Lets organs know of what others have to them."""
  every = [each for organ in organs for each in organ.beside if isinstance(each, InBonds)]
  for each in every:
    each.bear(every)
  for rests in [each for organ in organs for each in organ.beside if isinstance(each, Rests)]:
    for which, (_, below) in enumerate(rests.on):
      below.beside += (Bears(below, rests, which),)


def make(organ, numbers: np.ndarray) -> tuple[Beside, ...]:
  """Returns what acts on an organ beside its tissue; it gets `State.hold` where something does.

  Args:
    organ: of `Worlds`, all of whose organs there are
    numbers: of the model's bodies in mujoco_warp's, (nbody,)
  """
  w = organ.space
  return tuple(kind(organ, numbers) for name, kind in KINDS.items() if getattr(w, name))
