"""An organ of `Worlds` as its passive forces see it, and what lets meshes of worlds come apart."""

from __future__ import annotations

import abc
import functools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine.layout import FLAG
from palpate.engine.workspace import Workspace
from palpate.forces import host
from palpate.forces.host import Input, Rows, Twin, WorldBodies, WorldNodes
from palpate.forces.passive import Force
from palpate.forces.table import FORCES
from palpate.tissue import body as bodies
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import fill

from .kernels import forget, put_back_rows
from .patch import launch

if TYPE_CHECKING:
  from .organs import Organ
  from .worlds import Worlds

_LOOK = 10  # steps after which the host looks, at most


class Kept(NamedTuple):
  """What worlds keep of a block of the plugin state.

  Attributes:
    array: in each world, (nworld, n, width)
    start: where worlds start, (1, n * width)
  """

  array: wp.array
  start: wp.array

  @property
  def flat(self) -> wp.array:
    """The array, (nworld, n * width)."""
    return self.array.reshape((self.array.shape[0], -1))


class Host(host.Host):
  """An organ in all worlds of a batch.

  Args:
    organ: the organ, whose patch is made

  Attributes:
    kept: blocks of the plugin state that forces have asked for, by name
  """

  alone = False

  def __init__(self, organ: Organ):
    self._organ, self._batch = organ, organ.batch
    self.nworld, self.device = organ.batch.nworld, organ.batch.device
    self.instance, self.model = organ.instance, organ.space.model
    self.organ, self.config = organ.declared, organ.config
    self.arrays = coupling.on_body(organ.body)
    self.kept: dict[str, Kept] = {}
    self._rows: list[Rows] = []
    # Whether the step ended with the organ's answer, which is the same in all worlds.
    answered = np.zeros((2, len(FLAG)), np.int32)
    answered[1, FLAG.answered] = 1
    self._flags = [wp.array(row, dtype=int, device=self.device) for row in answered]

  @property
  def bodies(self) -> Any:
    """See `Host`."""
    return self._batch.bodies

  @functools.cached_property
  def nodes(self) -> Any:
    """See `Host`."""
    return nodes_of(self._organ)

  @property
  def input(self) -> Any:
    """See `Host`."""
    return input_of(self._organ)

  @property
  def number(self) -> wp.array:
    """See `Host`."""
    return self._organ.body.tissue.number

  @property
  def flags(self) -> wp.array:
    """See `Host`."""
    return self._flags[bool(self._organ.patch.stiff and self._organ.responds)]

  @property
  def springs(self) -> wp.array | None:
    """See `Host`."""
    hold = self._organ.body.state.hold
    return hold if hold.size else None

  def need_springs(self):
    """See `Host`."""
    bodies.hold(self._organ.body)

  def rows(self, block: str, width: int) -> wp.array:
    """See `Host`."""
    if block not in self.kept:
      where = coupling.spans(self.organ)[block]
      n = (where.stop - where.start) // width
      start = wp.zeros((1, n * width), dtype=wp.float64, device=self.device)
      self.kept[block] = Kept(self.zeros(n, width), start)
    return self.kept[block].array

  def mesh(self, world: int) -> Mesh:
    """See `Host`; as it was when the topology's `follow` was called."""
    topology = self._organ.topology
    return topology.mesh_of(world) if topology else self.organ.mesh

  def which_rows(self, others: Iterable[host.Host] = ()) -> Rows:
    """See `Host`."""
    self._rows.append(Rows(self, any(each.organ.mesh.spare for each in (self, *others))))
    return self._rows[-1]

  def body_number(self, body: int) -> int:
    """See `Host`."""
    return int(self._batch.numbers[body])

  def load(self, kernel: Twin):
    """See `Host`."""
    kernel.many.load(self.device)

  def launch(self, kernel: Twin, fields: Any, count: int = 0, arg: int = 0):
    """See `Host`."""
    if count:
      launch(kernel.many, fields, self.nworld, count, self.device, arg)
    else:
      kernel.many.launch(self.device, self.nworld, 1, arg, fields, 32)

  def rest(self):
    """Puts what worlds keep where those of the mask start, and gives these the first lists."""
    mask = self._batch.mask
    for kept in self.kept.values():
      inputs = [mask, kept.start, kept.flat]
      wp.launch(put_back_rows, dim=kept.flat.shape, inputs=inputs, device=self.device)
    for rows in self._rows:
      if rows.count > 1:
        wp.launch(forget, dim=self.nworld, inputs=[mask, rows.which], device=self.device)


class Opens(Force):
  """What lets meshes come apart, for which the host looks now and then.

  Args:
    organ: the organ
  """

  def __init__(self, organ: Organ):
    super().__init__(organ.host)
    self._organ, self._steps = organ, 0
    batch = organ.batch
    self._nworld, self._device, self._mask = batch.nworld, batch.device, batch.mask

  def _zeros(self, *shape: int, dtype: Any = wp.float64) -> wp.array:
    return wp.zeros(shape, dtype=dtype, device=self._device)

  def _over(self, what, fields: Any, count: int, arg: int = 0):
    launch(what, fields, self._nworld, max(1, count), self._device, arg)

  def rest(self):
    """Forgets what worlds of the mask were about to open."""

  def configure(self, worlds: np.ndarray, rows: dict[str, np.ndarray]):
    """Follows the tissue of worlds, which has changed; `rows` as `Material.change` takes them."""

  def stepped(self, last: bool):
    """Looks after a step where it is time, or where that was the last step for now."""
    self._steps += 1
    if last or self._steps >= _LOOK:
      self.open(self._steps)
      self._steps = 0

  @abc.abstractmethod
  def open(self, steps: int):
    """Lets the meshes of worlds come apart where they have to, so many steps since the last."""


def check(spaces: Iterable[Workspace]):
  """Raises ValueError where workspaces have forces that a batch on a GPU cannot do."""
  for w in spaces:
    for kind in FORCES.values():
      if w.forces.of(kind) and not kind.WORLDS:
        raise ValueError(
          f"organ {w.organ.name!r}: {' or '.join(kind.KEYS)} is set, which a batch on a GPU cannot "
          "do; expected none"
        )


def bodies_of(batch: Worlds) -> Any:
  """Returns `WorldBodies` of a batch's worlds."""
  m, d, model = batch.m, batch.d, batch.bare
  own = {"timestep": np.array([model.opt.timestep])}
  own |= {"geom_size": model.geom_size, "geom_aabb": model.geom_aabb.reshape(-1, 6)}
  values = {}
  for name in WorldBodies.vars:
    if name in own:
      values[name] = np.asarray(own[name])
    elif hasattr(d, name):
      values[name] = _rows(getattr(d, name))
    else:
      values[name] = getattr(m, name)
  return fill(WorldBodies, batch.device, values)


def _rows(array: Any) -> Any:
  """Returns an array of mujoco_warp's as floats, a row a world, in its memory."""
  item = wp.types.type_size_in_bytes(array.dtype) // 4
  count = int(np.prod(array.shape[1:])) * item
  out: Any = wp.array(
    ptr=array.ptr, dtype=float, shape=(array.shape[0], count), strides=(array.strides[0], 4),
    device=array.device,
  )  # fmt: skip
  out.of = array
  return out


def nodes_of(organ: Organ) -> Any:
  """Returns `WorldNodes` of an organ."""
  declared, body, patch = organ.declared, organ.body, organ.patch
  values = dict(
    node=body.shape.node, mesh=patch.mesh, rest=patch.rest, disp=body.state.disp,
    vel=body.state.vel, frame=declared.frame, origin=declared.origin,
  )  # fmt: skip
  return fill(WorldNodes, organ.body.device, values)


def input_of(organ: Organ) -> Any:
  """Returns `Input` of an organ."""
  body = organ.body
  values = {name: getattr(body.state, name) for name in ("hold", "force_ext", "vel", "dvel")}
  values |= {"node": body.shape.node, "quiet": organ.patch.calm, "status": body.system.status}
  return fill(Input, body.device, values)


def numbers_of(batch: Worlds) -> np.ndarray:
  """Returns the numbers of bodies in mujoco_warp's model, -1 for nodes and slots, (nbody,)."""
  gone = np.zeros(batch.model.nbody, bool)
  for organ in (each.declared for each in batch.organs.values()):
    dofs = organ.dofs if organ.windows is None else organ.windows.dofadr
    gone[batch.model.dof_bodyid[dofs]] = True
  out = np.full(batch.model.nbody, -1)
  out[~gone] = np.arange(int((~gone).sum()))
  return out


def follow(batch: Worlds, worlds: list[int]):
  """Lets forces follow the meshes of worlds, which have changed."""
  organs = batch.organs.values()
  for organ in organs:
    if organ.topology:
      organ.topology.follow()
  for each in (each for organ in organs for each in organ.forces):
    for world in worlds:
      each.reshape(world)
