"""What acts beside the tissue of an organ of `Worlds`; kernels are the plugin's."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
from typing import Any

import numpy as np
import warp as wp
from palpate.engine.forces import attachments, passive, relaxation, supports
from palpate.engine.forces import cohesive_bonds as engine_bonds
from palpate.engine.layout import BOND, FLAG
from palpate.engine.workspace import FORCES
from palpate.tissue import body as bodies
from palpate.tissue.kernels import Kernel
from palpate.tissue.step import SCHEMES
from palpate.tissue.types import doubles, fill, floats, ints, struct, vector

from ..kernels import show_damage, show_pull, weaken_bonds
from .base import Beside, WorldBodies, WorldNodes, in_worlds, input_of, kernels, nodes_of
from .bonds import Bonds

_PARTS = {"own": WorldNodes, "other": WorldNodes, "mj": WorldBodies}
_number = floats("nworld", "nnumber")
BOND_ROWS = "state", "next", "stretch", "force", "pull", "hardness"
WorldBonded = in_worlds(engine_bonds.Bonded, BOND_ROWS, _PARTS | {"number": _number})
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
  attachments.Tied, ("point", "force"), _PARTS | {"number": _number, "dvel_warm": vector}
)
WorldRest = in_worlds(supports.Rest, REST_ROWS, _PARTS)
WorldCreeping = in_worlds(relaxation.Creeping, ("own",), {})


@struct
class Aimed:
  """Ties to another organ."""

  npair: int  # number of them
  first: int  # the first among all ties
  pair: ints("npair")  # vertices of the other organ
  anchor: doubles("npair", 3)  # from there to the points, in the world [m]
  point: doubles("nworld", "ntie", 6)  # place and velocity of the points [m, m/s]
  other: WorldNodes
  mj: WorldBodies


_stretch, _enter, _bear, _act, _feel, _keep = kernels(
  "forces/cohesive_bonds.h", WorldBonded, *engine_bonds.KERNELS
)
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
    self.groups: list[tuple[Any, Any]] = []
    self.borne: list[tuple[Any, Any]] = []
    for group in organ.space.bonds.groups:
      other = organ.batch.organ(group.other.organ.name) if group.other else None
      self.groups.append((group, self._fill(group, other, numbers)))

  def bear(self, others: list["InBonds"]):
    """Finds the bonds that others have to it, once all have been made."""
    mine = self._organ.space.bonds.borne
    self.borne = [pair for each in others for pair in each.groups if pair[0] in mine]

  def _fill(self, group, other, numbers: np.ndarray):
    organ, n = self._organ, len(group.vert)
    scheme = SCHEMES[organ.config.integrator]
    shapes: dict[str, tuple] = {name: (n, 3) for name in ("stretch", "force", "pull")}
    shapes |= {"next": (n, len(BOND)), "hardness": (n,)}
    values: dict[str, Any] = dict(zip(("stiffness", "strength", "energy"), group.law, strict=True))
    of_group = "vert", "area", "anchor", "normal", "corner", "weight"
    values |= {name: getattr(group, name) for name in of_group}
    values |= {name: self._zeros(self._nworld, *shape) for name, shape in shapes.items()}
    values |= dict(
      nbond=n,
      body=int(numbers[group.body]) if group.body >= 0 else group.body,
      restless=group.bonded.restless,
      ahead=float(scheme.ahead),
      gain=scheme.gain(1.0, 0.0),
      live=np.ones(1),
      slot=np.arange(n),
      state=self._keep("bond", group.slot, len(BOND)),
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
      self._over(_stretch, b, b.nbond)
      self._over(_enter, b, b.nbond)
    for _, b in self.borne:
      self._over(_stretch, b, b.nbond)
      self._over(_bear, b, 1)

  def act(self):
    """See `Beside`."""
    for _, b in self.groups:
      self._over(_act, b, b.nbond)
      if b.body >= 0 and b.restless:
        self._over(_feel, b, 1)

  def end(self):
    """See `Beside`."""
    for _, b in self.groups:
      self._over(_keep, b, b.nbond)


class Grown(Bonds):
  """The bonds of an organ of `Worlds`, for those who ask.

  Args:
    organ: the organ
  """

  def __init__(self, organ):
    found = [each.groups for each in organ.beside if isinstance(each, InBonds)]
    self._groups = [pair for groups in found for pair in groups]
    made = [group for group, _ in self._groups]
    self.vertices = np.concatenate([np.zeros(0, int), *(group.vert for group in made)])
    self.area = np.concatenate([np.zeros(0), *(group.area for group in made)])
    super().__init__(organ.batch.nworld, organ.batch.device)

  def _over(self, what, name: str, values: wp.array):
    first = 0
    for _, b in self._groups:
      inputs = [getattr(b, name), first, values]
      dim = (self._share.shape[0], b.nbond)
      wp.launch(what, dim=dim, inputs=inputs, device=self._device)
      first += b.nbond

  def _tell(self):
    self._over(show_damage, "state", self._damage)
    self._over(show_pull, "pull", self._force)

  def _weaken(self, amount: wp.array):
    self._over(weaken_bonds, "state", amount)


class Ties(Beside):
  """What an organ is attached to; a thread has all ties of a world."""

  def __init__(self, organ, numbers: np.ndarray):
    super().__init__(organ)
    made, batch = organ.space.ties, organ.batch
    known: Any = made.fields
    self._count = int(known.count.numpy()[0])
    names = "vert", "leads", "stiffness", "anchor", "count", "owned", "restless"
    values = {name: getattr(known, name).numpy() for name in names}
    body = known.body.numpy()
    point = self._zeros(self._nworld, len(body), 6)
    values |= dict(
      ahead=known.ahead, gain=known.gain, body=np.where(body < 0, body, numbers[body]), point=point,
      force=self._zeros(self._nworld, len(body), 3), own=nodes_of(organ), solve=input_of(organ),
      number=organ.body.tissue.number, dvel_warm=organ.body.state.dvel_warm, mj=batch.bodies,
    )  # fmt: skip
    self._fields, self._aimed, first = fill(WorldTied, self._device, values), [], 0
    self._moves = bool(values["restless"][0] and (body >= 0).any())
    for group in made.groups:
      if group.other is not None:
        other = nodes_of(batch.organ(group.other.organ.name))
        own = {"npair": len(group.pair), "first": first, "pair": group.pair, "point": point}
        own |= {"anchor": group.anchor, "other": other, "mj": batch.bodies}
        self._aimed.append(fill(Aimed, self._device, own))
      first += len(group.vert)

  @property
  def aims(self) -> bool:
    """See `Beside`."""
    return self._moves

  def _alone(self, what: Kernel):
    what.launch(self._device, self._nworld, 1, 0, self._fields, 32)

  def enter(self):
    """See `Beside`."""
    for aimed in self._aimed:
      self._over(_aim, aimed, aimed.npair)
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
    alone: Any = organ.space.rests.alone
    n = alone.nouter
    shapes = {"slipped": (n, 3), "force": (n, 3), "hardness": (n, 6), "weight": (n, 3)}
    names = "ngeom", "nouter", "restless", "skin", "cell"
    values: dict[str, Any] = {name: getattr(alone, name) for name in names}
    same = "geom", "friction", "free", "stiffness"
    values |= {name: getattr(alone, name).numpy() for name in same}
    values |= {name: self._zeros(self._nworld, *shape) for name, shape in shapes.items()}
    values |= dict(
      corner=self._zeros(self._nworld, n, 3, dtype=int),
      on=self._zeros(self._nworld, n, dtype=int),
      slip=self._keep("slip", np.arange(n), 3),
      own=nodes_of(organ),
      solve=input_of(organ),
      mj=organ.batch.bodies,
    )
    nothing = self._other(alone) | {"other": WorldNodes(), "below": passive.Input()}
    self._fields = fill(WorldRest, self._device, values | nothing)
    self.on = []
    for known, below in zip(organ.space.rests.on, organ.space.rests.below, strict=True):
      theirs = organ.batch.organ(below.organ.name)
      own = self._other(known) | {"other": nodes_of(theirs), "below": input_of(theirs)}
      self.on.append((fill(WorldRest, self._device, values | own), theirs))

  def _other(self, known) -> dict[str, Any]:
    """Returns the fields of the plugin's other organ, in all worlds."""
    values: dict[str, Any] = {"mu": known.mu, "nother": known.nother}
    values |= {name: getattr(known, name).numpy() for name in ("elem", "near_adr", "near")}
    values["where"] = self._zeros(self._nworld, known.nother, 3)
    for name in ("next", "first"):
      values[name] = self._zeros(self._nworld, *getattr(known, name).shape, dtype=int)
    return values

  @property
  def aims(self) -> bool:
    """See `Beside`."""
    return bool(self._fields.restless)

  def _each(self, what: Kernel):
    self._over(what, self._fields, self._fields.nouter)

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
