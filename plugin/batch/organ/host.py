"""An organ of `Worlds` as the host of its passive forces."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine.layout import FLAG
from palpate.forces import host
from palpate.forces.host import Input, Twin, WorldBodies, WorldNodes
from palpate.tissue import body as bodies
from palpate.tissue.geometry.mesh import Mesh
from palpate.tissue.types import DIMS, fill

from ..kernels import forget, put_back_rows

if TYPE_CHECKING:
  from ..worlds import Worlds
  from .organ import Organ

_BLOCK = 32  # threads of a block, a warp: with several sizes modules would be compiled for each


class Host(host.Host):
  """An organ in all worlds of a batch.

  Args:
    organ: the organ, whose patch is made

  Attributes:
    kept: what worlds keep of blocks of the plugin state that forces have asked for, by name, and
      where they start: (nworld, numbers) and (1, numbers)
  """

  alone = False

  def __init__(self, organ: Organ):
    self._organ, self._batch = organ, organ.batch
    self.nworld, self.device = organ.batch.nworld, organ.batch.device
    self.instance, self.model = organ.instance, organ.space.model
    self.organ, self.config = organ.declared, organ.config
    self.arrays, self.number = coupling.on_body(organ.body), organ.body.tissue.number
    self.kept: dict[str, tuple[wp.array, wp.array]] = {}
    self._which: list[wp.array] = []
    # Whether the step ended with the organ's answer, which is the same in all worlds.
    answered = np.zeros((2, len(FLAG)), np.int32)
    answered[1, FLAG.answered] = 1
    self._flags = [wp.array(row, dtype=int, device=self.device) for row in answered]
    self.nodes, self.input = nodes_of(organ), input_of(organ)

  def bind(self, model: int):
    """See `Host`."""
    self.bodies, self.input = self._batch.bodies, input_of(self._organ)

  def need_springs(self):
    """See `Host`."""
    self.springs = bodies.hold(self._organ.body)

  def need_pairs(self):
    """See `Host`."""
    self.arrays |= bodies.pairs(self._organ.body)

  def flags(self) -> wp.array:
    """See `Host`."""
    return self._flags[bool(self._organ.patch.stiff and self._organ.responds)]

  def rows(self, block: str, width: int) -> wp.array:
    """See `Host`."""
    if block not in self.kept:
      where = coupling.spans(self.organ)[block]
      n, kind = where.stop - where.start, {"dtype": wp.float64, "device": self.device}
      self.kept[block] = wp.zeros((self.nworld, n), **kind), wp.zeros((1, n), **kind)
    return self.kept[block][0].reshape((self.nworld, -1, width))

  def mesh(self, world: int) -> Mesh:
    """See `Host`; as it was when the topology's `follow` was called."""
    topology = self._organ.topology
    return topology.mesh(world) if topology else self.organ.mesh

  def which(self, others: Sequence[host.Host]) -> wp.array:
    """See `Host`."""
    self._which.append(super().which(others))
    return self._which[-1]

  def body_number(self, body: int) -> int:
    """See `Host`."""
    return int(self._batch.numbers[body])

  def surface(self) -> dict[str, Any]:
    """See `Host`: of nodes."""
    patch, mesh = self._organ.patch, self.organ.mesh
    own, solve = nodes_of(self._organ), input_of(self._organ)
    own.node = solve.node = wp.array(np.arange(patch.nnode), dtype=int, device=self.device)
    return dict(
      nelem=mesh.nelem, ntet=len(mesh.tet), mesh=patch.mesh, elem=patch.elem, tet=patch.tet,
      flat=patch.rest, own=own, solve=solve,
    )  # fmt: skip

  @functools.cached_property
  def _lifted(self) -> wp.array:
    return self.zeros(self.m.ngeom + 2 * self.m.nflex, dtype=int)

  def lifted(self) -> wp.array:
    """See `Host`."""
    return self._lifted

  def open_contacts(self):
    """See `Host`; worlds find theirs afterwards."""

  def ties(self, flex: int) -> coupling.Ties:
    """See `Host`."""
    return self._batch.rods.ties(flex)

  def tools(self, name: str) -> np.ndarray:
    """See `Host`."""
    return getattr(self._batch.d, name).numpy().astype(float)

  def load(self, kernel: Twin):
    """See `Host`; on CUDA all of a step are compiled at once, see `compile_ahead`."""
    if not self.device.is_cuda:
      kernel.many.load(self.device, _BLOCK)

  def launch(self, kernel: Twin, fields: Any, count: int = 0, arg: int = 0):
    """See `Host`."""
    nthread = -(-count // _BLOCK) * _BLOCK if count and self.device.is_cuda else 1
    kernel.many.launch(self.device, self.nworld, nthread, arg, fields, _BLOCK)

  def rest(self):
    """Puts what worlds keep where those of the mask start, and gives these the first lists."""
    mask, device = self._batch.mask, self.device
    for there, start in self.kept.values():
      wp.launch(put_back_rows, dim=there.shape, inputs=[mask, start, there], device=device)
    for which in self._which:
      wp.launch(forget, dim=self.nworld, inputs=[mask, which], device=device)


def bodies_of(batch: Worlds) -> Any:
  """Returns `WorldBodies` of a batch's worlds."""
  d, model, values = batch.d, batch.bare, {}
  for name in WorldBodies.vars:
    if hasattr(d, name):
      values[name] = float_rows(getattr(d, name))
    else:
      source = model.opt if hasattr(model.opt, name) else model
      values[name] = np.asarray(getattr(source, name)).reshape(-1, *DIMS["WorldBodies"][name][1:])
  return fill(WorldBodies, batch.device, values)


def float_rows(array: Any) -> Any:
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
