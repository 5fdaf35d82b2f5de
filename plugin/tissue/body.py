"""A body: the structs of an organ on one device, allocated once."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from .device import WORDS, Plan
from .geometry.mesh import Mesh
from .order import LANES, offset
from .types import (
  DIMS,
  NUMBERS,
  Cycle,
  Fields,
  Lump,
  Shape,
  State,
  System,
  Tissue,
  Transfer,
  allocate,
  fill,
)

PAIRS = ("paired", "pair_node", "pair_hold")  # of `State`, see `pairs`


@dataclasses.dataclass
class Body:
  """An organ's arrays on one device, allocated once: what drivers take.

  Attributes:
    fields: what kernels take
    sizes: number of each thing that the arrays' shapes name, less nworld
    device: Warp device
    nworld: number of worlds; 0 for the constants alone
    numbers: those of `tissue.number` on the host, float64   (nnumber,)
    newton: Newton iterations a step
    levels: coarser meshes for the multilevel preconditioner, or None
    plan: how a block of threads takes a world's whole step, or None where kernels share it
  """

  fields: Any
  sizes: dict[str, int]
  device: wp.Device
  nworld: int
  numbers: wp.array
  newton: int
  levels: Levels | None = None
  plan: Plan | None = None

  @property
  def shape(self) -> Any:
    """Topology and rest shape."""
    return self.fields.shape

  @property
  def tissue(self) -> Any:
    """Material."""
    return self.fields.tissue

  @property
  def state(self) -> Any:
    """Motion, and what acts."""
    return self.fields.state

  @property
  def system(self) -> Any:
    """The linear system of a step."""
    return self.fields.system

  @property
  def is_solid(self) -> bool:
    """Whether there are tetrahedra in place of a skin."""
    return self.shape.ntetslice > 0

  @property
  def has_bending(self) -> bool:
    """Whether bending kernels run."""
    return self.shape.nhingeslice > 0

  def number(self, name: str) -> float:
    """Returns one of `NUMBERS`."""
    return float(self.numbers.numpy()[NUMBERS.index(name)])


@dataclasses.dataclass
class Levels:
  """Coarser meshes of a body.

  Attributes:
    body: these meshes one after the other; shares `number` and `step`
    cycle: what the kernels of the preconditioner take
    rate: `Transfer.rate` before the first cut, on the host
  """

  body: Body
  cycle: Any
  rate: np.ndarray

  @property
  def transfer(self) -> Any:
    """What lies between the meshes."""
    return self.cycle.transfer


def constants(
  values: dict[str, Any], device: wp.Device, newton: int, coarse: dict[str, Any] | None = None
) -> Body:
  """Returns a body of no world: what does not move.

  Args:
    values: fields of `Shape` and `Tissue`, arrays on the host
    device: where it is put
    newton: Newton iterations a step
    coarse: those of all coarser meshes, and the fields of `Transfer`, or None
  """
  sizes = _sizes(values)
  if coarse is None:
    return _at_rest(values, sizes, device, newton)
  sizes |= {"ncycleslice": sizes["nslice"], "ncyclebendslice": sizes["nbendslice"]}
  fewer = _sizes(coarse)
  fewer |= {"ncycleslice": fewer["nslice"], "ncyclebendslice": fewer["nbendslice"]}
  fewer["nquadslice"] = 0
  body = _at_rest(values, sizes, device, newton)
  below = _at_rest(coarse, fewer, device, newton)
  body.levels = _levels(body, below, fill(Transfer, device, coarse))
  return body


def _sizes(values: dict[str, Any]) -> dict[str, int]:
  """Returns the named sizes of a body from the fields of `Shape` and `Tissue`, but nworld."""
  shape = ("nvert", "nnode", "nslice", "nelemslice", "nhingeslice", "ntetslice", "nedgeslice")
  out = {name: values[name] for name in (*shape, "nslot")}
  bends, solid = out["nhingeslice"] > 0, out["ntetslice"] > 0
  return out | {
    "nsolidslice": out["nslice"] if solid else 0,
    "nskinslot": 0 if solid else out["nslot"],
    "nskinslice": 0 if solid else out["nslice"],
    "nmesh": 0,
    "nheld": len(values["held_adr"]),
    "nsolidslot": out["nslot"] if solid else 0,
    "naround": len(values["around_corner"]),
    "ncapsule": values["ncapsule"],
    "ncapsuleslice": out["nslice"] if values["ncapsule"] else 0,
    "nedge": len(values["edge_from"]),
    "nbend": len(values["bend_node"]),
    "nbendslice": out["nslice"] if bends else 0,
    "nareaslice": out["nslice"] if bends or values["closed"] else 0,
    "nquadslice": out["nslice"],
    "nholdslice": 0,
    "npairslice": 0,
    "ncycleslice": 0,
    "ncyclebendslice": 0,
    "nword": WORDS,
    "nnumber": len(NUMBERS),
  }


def _at_rest(values: dict[str, Any], sizes: dict[str, int], device: wp.Device, newton: int) -> Body:
  fields = Fields()
  fields.shape = fill(Shape, device, values, sizes)
  once = values | {"number": values["number"][None]}
  fields.tissue = fill(Tissue, device, once, sizes | {"nworld": 1})
  numbers = wp.array(values["number"], dtype=wp.float64, device="cpu")
  body = Body(fields, sizes, device, 0, numbers, newton)
  _put_state(body, 0)
  return body


def _levels(body: Body, coarse: Body, transfer: Any) -> Levels:
  coarse.tissue.number, coarse.numbers = body.tissue.number, body.numbers
  coarse.state.step = body.state.step
  cycle = Cycle()
  cycle.fine, cycle.coarse, cycle.transfer = body.fields, coarse.fields, transfer
  return Levels(coarse, cycle, transfer.rate.numpy().copy())


def _put_state(body: Body, nworld: int):
  body.nworld, sizes = nworld, body.sizes | {"nworld": nworld}
  body.fields.state = allocate(State, body.device, sizes)
  spared = spare(body)
  body.fields.system = allocate(System, body.device, sizes, spared)
  body.fields.lump = allocate(Lump, body.device, sizes | {"nlump": 0, "nhingeslice": 0})
  body.numbers = wp.clone(body.numbers)


def spare(body: Body) -> tuple[str, ...]:
  """Returns the fields of `System` that a body has no use for: what its blocks keep themselves."""
  plan = body.plan
  if plan is None or not plan.own:
    return ()
  whole = ("block",) if plan.whole else ()
  return ("diag", "inverse", "normal", "p", "q", "z", "t", "zn", "quad", *whole)


def worlds(body: Body, nworld: int = 1, plan: Plan | None = None) -> Body:
  """Returns a body of the same shape with a tissue of its own and zeroed states.

  Args:
    body: the body whose shape it has
    nworld: number of worlds
    plan: how a block of threads takes a world's whole step, or None
  """
  fields = Fields()
  fields.shape = body.shape
  for name in Tissue.vars:
    value = getattr(body.tissue, name)
    setattr(fields.tissue, name, wp.clone(value) if isinstance(value, wp.array) else value)
  number = np.repeat(body.tissue.number.numpy()[:1], max(nworld, 1), axis=0)
  fields.tissue.number = wp.array(number, device=body.device)
  out = dataclasses.replace(body, fields=fields, levels=None, plan=plan)
  _put_state(out, nworld)
  if body.levels is not None:
    out.levels = _levels(out, worlds(body.levels.body, nworld), body.levels.transfer)
  return out


def unshare(body: Body):
  """Gives a body arrays of its own for what a cut changes."""
  shape, own = body.shape, Shape()
  for name, var in Shape.vars.items():
    value = getattr(shape, name)
    setattr(own, name, wp.clone(value) if hasattr(var.type, "dtype") else value)
  body.fields.shape = own
  if body.levels is not None:
    old, transfer = body.levels.transfer, Transfer()
    for name in Transfer.vars:
      setattr(transfer, name, getattr(old, name))
    transfer.rate = wp.clone(old.rate)
    body.levels.cycle.fine, body.levels.cycle.transfer = body.fields, transfer


def occupy(body: Body, mesh: Mesh):
  """Lets steps leave out the slices of vertices that wait for a cut.

  Not on a device: launches that were recorded have their number, and threads do not wait there for
  those that have nothing to do.
  """
  if body.device.is_cuda:
    return
  nused, was = -(-(mesh.nvert - (mesh.nskin - mesh.nouter)) // LANES), body.shape.nused
  if nused == was:
    return
  for fields in (body.fields, *([body.levels.cycle.fine] if body.levels else [])):
    fields.shape.nused = nused
  for array in (body.state.dvel, body.system.sol) if nused < was else ():
    array.numpy()[:, nused:was] = 0.0


def hold(body: Body) -> wp.array:
  """Returns `state.hold`, a symmetric matrix a node, which a body gets when it is first asked."""
  if not body.state.hold.size:
    shape = (body.nworld, body.shape.nslice, 6, LANES)
    body.fields.state.hold = wp.zeros(shape, dtype=float, device=body.device)
    if body.levels is not None:
      body.levels.cycle.fine = body.fields
  return body.state.hold


def pairs(body: Body) -> dict[str, wp.array]:
  """Returns `state.paired` and so on, for springs between nodes, which a body gets when asked."""
  if not body.state.pair_hold.size:
    shape = (body.nworld, body.shape.nslice, 6, LANES)
    own = offset(np.arange(body.shape.nnode)).reshape(1, -1, LANES)  # which is always there
    body.fields.state.pair_node = wp.array(
      np.broadcast_to(own, (body.nworld, *own.shape[1:])), dtype=int, device=body.device
    )
    body.fields.state.pair_hold = wp.zeros(shape, dtype=float, device=body.device)
    if body.levels is not None:
      body.levels.cycle.fine = body.fields
  return {name: getattr(body.state, name) for name in PAIRS}


def arrays(body: Body) -> dict[str, Any]:
  """Returns the arrays of a body's shape and material by name."""
  kinds = ((body.shape, Shape), (body.tissue, Tissue))
  return {name: getattr(struct, name) for struct, kind in kinds for name in DIMS[kind.key]}


def nbytes(body: Body) -> int:
  """Returns how many bytes of memory the worlds of a body take, without what they share."""
  kinds = ((State, body.state), (System, body.system))
  names = [(each, name) for kind, each in kinds for name in DIMS[kind.key]]
  arrays = [getattr(each, name) for each, name in names if name not in spare(body)]
  total = sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays)
  return total + (nbytes(body.levels.body) if body.levels is not None else 0)


def renumber(body: Body, values: dict[str, float]):
  """Sets `NUMBERS`, in the device's memory too: graphs that are recorded go on with them."""
  numbers = np.array([values[name] for name in NUMBERS])
  body.numbers.numpy()[:] = numbers
  rows = np.broadcast_to(numbers.astype(np.float32), body.tissue.number.shape)
  body.tissue.number.assign(np.ascontiguousarray(rows))


def retissue(body: Body, values: dict[str, Any]):
  """Writes the arrays of `Tissue` into those that are there; `values` as for `constants`."""
  for name in Tissue.vars:
    if name != "number":
      getattr(body.tissue, name).assign(values[name])
