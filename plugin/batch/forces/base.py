"""What acts on an organ of `Worlds` beside its tissue: what all that does so shares.

The kernels and their structs are the plugin's, over rows of worlds: see `engine.forces.passive`.
"""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
import abc
import dataclasses
from typing import Any

import mujoco
import numpy as np
import warp as wp
from palpate.engine import coupling
from palpate.engine.forces import passive
from palpate.tissue import body as bodies
from palpate.tissue.kernels import Kernel, kernel
from palpate.tissue.types import DIMS, Array, doubles, fill, floats, ints, struct, vector

from ..kernels import forget, put_back_rows
from ..patch import launch

_COUNTS = ("count", "first", "nouter", "nother")  # of what follows meshes
_LOOK = 10  # steps after which the host looks, at most


@struct
class WorldBodies:
  """Bodies of mujoco_warp, a row a world; names as in `passive.Bodies`."""

  timestep: doubles(1)
  body_parentid: ints("nbody")
  body_rootid: ints("nbody")
  body_dofnum: ints("nbody")
  body_dofadr: ints("nbody")
  geom_bodyid: ints("ngeom")
  geom_type: ints("ngeom")
  geom_size: doubles("ngeom", 3)
  geom_aabb: doubles("ngeom", 6)
  xpos: floats("nworld", "3 nbody")
  xmat: floats("nworld", "9 nbody")
  cvel: floats("nworld", "6 nbody")
  cdof: floats("nworld", "6 nv")
  qacc_warmstart: floats("nworld", "nv")
  subtree_com: floats("nworld", "3 nbody")
  geom_xpos: floats("nworld", "3 ngeom")
  geom_xmat: floats("nworld", "9 ngeom")
  qfrc_passive: floats("nworld", "nv")


@struct
class WorldNodes:
  """Where an organ's vertices are: in the solver's own vectors."""

  node: ints("nvert")  # node of each vertex
  mesh: ints("nworld")  # which mesh each world has
  rest: doubles("nmesh", "nnode", 3)  # rest position of each node [m]
  disp: vector
  vel: vector
  frame: doubles(3, 3)  # rotation from the organ's axes to the world
  origin: doubles(3)  # position of its frame [m]


def in_worlds(
  kind, rows: tuple[str, ...], others: dict[str, Any], lists: tuple[str, ...] = ()
) -> Any:
  """Returns a struct of many worlds.

  Args:
    kind: that of one
    rows: its arrays that have one a world
    others: types of fields that are others
    lists: its arrays that follow meshes, see `Beside.lists`
  """
  fields = {}
  for name, var in kind.vars.items():
    dims = DIMS[kind.key].get(name)
    fields[name] = others.get(name, var.type)
    if dims is not None and name not in others:
      first = ("nworld",) if name in rows else ("nrow",) if name in lists else ()
      fields[name] = Array(var.type.dtype, (*first, *dims))
  own = {"__annotations__": fields, "__module__": __name__}
  return struct(type(f"{kind.key}InWorlds", (), own))


def kernels(header: str, kind, *names: str) -> list[Kernel]:
  """Returns the kernels of a header that take a struct of many worlds."""
  return [kernel(name, header, kind, coupling.CONSTANTS, tag=".worlds") for name in names]


@dataclasses.dataclass(frozen=True)
class Kept:
  """What worlds keep of a block of the plugin state.

  Attributes:
    block: its name, see `palpate.engine.layout`
    rows: those of its rows
    array: in each world, (nworld, len(rows), width)
    start: where worlds start, (1, len(rows) * width)
  """

  block: str
  rows: np.ndarray
  array: wp.array
  start: wp.array

  @property
  def flat(self) -> wp.array:
    """The array, (nworld, len(rows) * width)."""
    return self.array.reshape((self.array.shape[0], -1))

  def of(self, own: np.ndarray, spans: dict[str, slice]) -> np.ndarray:
    """Returns the block in an organ's part of the plugin state, a row each."""
    return own[spans[self.block]].reshape(-1, self.array.shape[2])


class Beside:
  """What acts beside the tissue of an organ in all worlds.

  Args:
    organ: the organ
  """

  def __init__(self, organ):
    self._organ = organ
    batch = organ.batch
    self._nworld, self._device, self._mask = batch.nworld, batch.device, batch.mask
    self.kept: list[Kept] = []
    # Which row of the lists that follow meshes each world has: 0 until it is cut.
    self._row = wp.zeros(self._nworld, dtype=int, device=self._device)
    self._parts = False
    self._lists: list[dict[str, wp.array]] = []

  @property
  def aims(self) -> bool:
    """Whether it has to know where bodies are as a step begins: they may move."""
    return False

  def enter(self):
    """Adds to the solver's input."""

  def act(self):
    """Lets bodies feel what has acted."""

  def end(self):
    """Keeps what the step has made of it."""

  def rest(self):
    """Puts it where the worlds of the mask start."""
    for kept in self.kept:
      inputs = [self._mask, kept.start, kept.flat]
      wp.launch(put_back_rows, dim=kept.flat.shape, inputs=inputs, device=self._device)
    if self._lists:
      inputs = [self._mask, self._row]
      wp.launch(forget, dim=self._nworld, inputs=inputs, device=self._device)

  def _keep(self, block: str, rows: np.ndarray, width: int) -> wp.array:
    """Returns an array of what worlds keep in rows of a block of the plugin state."""
    start = self._zeros(1, len(rows) * width)
    self.kept.append(Kept(block, rows, self._zeros(self._nworld, len(rows), width), start))
    return self.kept[-1].array

  def _zeros(self, *shape: int, dtype: Any = wp.float64) -> wp.array:
    return wp.zeros(shape, dtype=dtype, device=self._device)

  def configure(self, worlds: np.ndarray, rows: dict[str, np.ndarray]):
    """Follows the tissue of worlds, which has changed; `rows` as `Material.change` takes them."""

  # What follows the meshes of worlds.

  def carry(self, world: int, group: np.ndarray, member: np.ndarray, share: np.ndarray):
    """Gives vertices of a world that a cut has divided their part, see the plugin's `Beside`."""

  def springs(self, world: int) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Returns vertices, stiffness [N/m] and stretch in the organ's frame [m], see the plugin's."""
    return []

  def reshape(self, world: int):
    """Follows the meshes of a world, which was cut."""
    if self._lists:
      for arrays, values in zip(self._lists, self.found(world), strict=True):
        for name, value in values.items():
          row = arrays[name][1 + world].numpy()
          row[: len(value)] = value
          arrays[name][1 + world].assign(row)
      which = self._row.numpy()
      which[world] = 1 + world
      self._row.assign(which)

  def found(self, world: int) -> list[dict[str, np.ndarray]]:
    """Returns what a world's lists are with the meshes that it has now."""
    return []

  def follow(self, organs: list):
    """Says which organs' meshes its lists follow; with no room for cuts they have one row."""
    self._parts = any(organ.topology for organ in organs)

  def lists(self, kind: Any, values: dict[str, np.ndarray], room: int = 0) -> dict[str, wp.array]:
    """Returns arrays of what follows meshes: a row for the first ones, and one for each world.

    Args:
      kind: the struct that they are of
      values: the first row
      room: for how many more entries there is room, where there may be cuts
    """
    out = {}
    for name, value in values.items():
      more = room if self._parts and name not in _COUNTS else 0
      whole = np.zeros((1 + self._nworld * self._parts, len(value) + more, *value.shape[1:]))
      whole[0, : len(value)] = value
      out[name] = wp.array(whole, dtype=kind.vars[name].type.dtype, device=self._device)
    if self._parts:
      self._lists.append(out)
    return out | {"row": self._row}

  def at(self, world: int) -> int:
    """Returns which row of the lists a world has."""
    return int(self._row.numpy()[world])

  def stepped(self, last: bool):
    """Does what the host has to do after a step; `last`: it was the last one for now."""

  def _over(self, what: Kernel, fields, count: int, arg: int = 0):
    launch(what, fields, self._nworld, max(1, count), self._device, arg)


class Opens(Beside):
  """What lets meshes come apart, for which the host looks now and then."""

  def __init__(self, organ):
    super().__init__(organ)
    self._steps = 0

  def stepped(self, last: bool):
    """See `Beside`: looks where it is time, or it was the last step for now."""
    self._steps += 1
    if last or self._steps >= _LOOK:
      self.open(self._steps)
      self._steps = 0

  @abc.abstractmethod
  def open(self, steps: int):
    """Lets the meshes of worlds come apart where they have to, so many steps since the last."""


def bodies_of(batch):
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


def mesh_of(organ, world: int):
  """Returns the mesh of an organ in a world, as `Cuts.mesh_of`."""
  return organ.topology.mesh_of(world) if organ.topology else organ.declared.mesh


def follow(batch, worlds: list[int]):
  """Lets what lies beside organs follow their meshes in worlds, which have changed."""
  organs = batch.organs.values()
  for organ in organs:
    if organ.topology:
      organ.topology.follow()
  for each in (each for organ in organs for each in organ.beside):
    for world in worlds:
      each.reshape(world)


def nodes_of(organ):
  """Returns `WorldNodes` of an organ."""
  declared, body, patch = organ.declared, organ.body, organ.patch
  values = dict(
    node=body.shape.node, mesh=patch.mesh, rest=patch.rest, disp=body.state.disp,
    vel=body.state.vel, frame=declared.frame, origin=declared.origin,
  )  # fmt: skip
  return fill(WorldNodes, organ.body.device, values)


def input_of(organ):
  """Returns `passive.Input` of an organ."""
  body = organ.body
  bodies.hold(body)
  values = {name: getattr(body.state, name) for name in ("hold", "force_ext", "vel", "dvel")}
  values |= {"node": body.shape.node, "quiet": organ.patch.calm, "status": body.system.status}
  return fill(passive.Input, body.device, values)


def numbers_of(model: mujoco.MjModel, bare: mujoco.MjModel, organs: list) -> np.ndarray:
  """Returns the numbers of a model's bodies in mujoco_warp's, -1 for nodes and slots, (nbody,)."""
  gone = np.zeros(model.nbody, bool)
  for organ in organs:
    dofs = organ.dofs if organ.windows is None else organ.windows.dofadr
    gone[model.dof_bodyid[dofs]] = True
  out = np.full(model.nbody, -1)
  out[~gone] = np.arange(int((~gone).sum()))
  return out
