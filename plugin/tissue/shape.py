"""Makes a body: mesh and configuration to sliced arrays on a device."""

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from . import body as bodies
from . import coarse as coarsening
from . import device as devices
from . import rows, solid, step
from .body import Body
from .config import Config
from .cutting.surface import WorkingCopy
from .geometry import mesh as topology
from .geometry.mesh import Mesh
from .order import LANES, addresses, banks, node_order, offset, to_slices
from .types import NUMBERS, empty, zeros

_BEND_MORE = 4  # entries that a cut may add to a row of the bending matrix


def make(
  mesh: Mesh, config: Config, pinned: np.ndarray, device: str, scale: float = 0.0, nworld: int = 1
) -> Body:
  """Returns the body of an organ, at rest.

  Args:
    mesh: the surface
    config: its configuration
    pinned: vertices that do not move, (nvert,) bool
    device: Warp device, or `auto`
    scale: (h^2 + h damping) over the mean mass of a node [s^2/kg], by which coarser meshes are made
      for the multilevel preconditioner if it pays; infinity makes them anyway
    nworld: number of worlds, 0 for what they share
  """
  target = devices.resolve(device, mesh.nvert)
  finest = arrays(mesh, config, pinned, _patch(mesh, target))
  below = None
  surface = len(mesh.tet) == 0
  if surface and (np.isinf(scale) or coarsening.pay(finest, scale, coarsening.threshold(target))):
    below = _below(mesh, config, pinned, finest, target)
  body = bodies.constants(finest, target, config.newton, below)
  with wp.ScopedDevice(target):
    step.calibrate(bodies.worlds(body))
  return bodies.worlds(body, nworld) if nworld else body


def _patch(mesh: Mesh, device: wp.Device) -> int:
  return devices.patch(device, -(-mesh.nvert // LANES), devices.SPLIT if len(mesh.tet) else 1)


def change(body: Body, mesh: Mesh, config: Config, pinned: np.ndarray):
  """Gives a body the material and the numbers of a configuration, in the arrays that it has.

  Args:
    body: the body, made of `mesh` and `pinned`
    mesh: the surface
    config: configuration of the same elements, with bending as before on or off
    pinned: vertices that do not move, (nvert,) bool
  """
  width = np.diff(body.shape.bend_adr.numpy())
  finest = arrays(mesh, config, pinned, _patch(mesh, body.device), width)
  bodies.retissue(body, finest)
  below = _below(mesh, config, pinned, finest, body.device) if body.levels else None
  if body.levels and below:
    bodies.retissue(body.levels.body, below)
    body.levels.rate[:] = below["rate"]
    rerate(body.levels, mesh)
  renumber(body, config, mesh.closed)


def renumber(body: Body, config: Config, closed: bool = True):
  """Gives a body the numbers of a configuration that may change while running.

  Args:
    body: the body
    config: its configuration
    closed: whether its surface encloses a volume still
  """
  bodies.renumber(body, _numbers(config, closed))
  body.newton = config.newton


def _numbers(config: Config, closed: bool = True) -> dict[str, float]:
  values = {name: getattr(config, name, 1.0) for name in NUMBERS}
  if not closed:  # allowed only where it was, before a cut
    values["bulk"] = values["pressure"] = 0.0
  values["stiffness"] = config.stiffness if config.elements == "spring" else 0.0
  values["foundation"] = 0.0 if config.carrier else config.foundation  # its springs are held then
  values["eased"] = eased(config)
  return values


def eased(config: Config) -> float:
  """Returns what of its time step h a step takes off `damping`: as much as it damps by itself.

  Of solids alone, whose tissue has that much to take it off. Negative: the least damping over h.
  """
  damps = step.SCHEMES[config.integrator].damps
  return damps if config.elements == "solid" else min(damps, 0.0)


def gain(config: Config, h: float) -> float:
  """Returns the factor of K in the matrix of a step h [s^2], as `node.h` has it."""
  damping, less = config.damping, eased(config) * h
  damping = max(damping, -less) if less < 0 else damping - min(less, 0.5 * damping)
  return step.SCHEMES[config.integrator].gain(h, damping)


def rerate(levels: bodies.Levels, mesh: Mesh):
  """Lets coarser meshes serve the solve before the first cut; they know of none."""
  rate = levels.rate.copy()
  rate[:, 0] *= mesh.uncut is None
  levels.transfer.rate.assign(rate)


def _below(
  mesh: Mesh, config: Config, pinned: np.ndarray, finest: dict[str, Any], device: wp.Device
) -> dict[str, Any] | None:
  """Returns the fields of all coarser meshes together and of `Transfer`, None without such."""
  mesh = mesh.whole
  nvert = mesh.nvert
  mesh = mesh.without_spare
  levels = coarsening.build(mesh)
  if not levels:
    return None
  young = coarsening.young(np.broadcast_to(config.young, mesh.nelem), mesh, levels)
  masks = [pinned, *(pinned[level.vert] for level in levels)]
  parts = [finest] + [
    arrays(level.mesh, dataclasses.replace(config, young=e), mask, coarse=True)
    for level, e, mask in zip(levels, young, masks[1:], strict=True)
  ]
  levels[0].weight.resize((nvert, levels[0].mesh.nvert))
  masks[0] = pinned | (np.arange(nvert) >= mesh.nvert)
  joined = coarsening.join(parts[1:])
  joined |= solid.none(len(joined["area"]))
  return joined | counts(joined) | coarsening.transfer(levels, parts, masks, device)


def arrays(
  mesh: Mesh,
  config: Config,
  pinned: np.ndarray,
  patch: int = 0,
  bend_width: np.ndarray | None = None,
  coarse: bool = False,
) -> dict[str, Any]:
  """Returns the fields of `Shape` and `Tissue` by name.

  Args:
    mesh: the surface
    config: its configuration
    pinned: vertices that do not move, (nvert,) bool
    patch: see `order.node_order`
    bend_width: rows of each slice of the bending matrix, where it has room for cuts; None for new
    coarse: whether it is a mesh for preconditioning alone
  """
  vert = node_order(mesh, patch)
  nslice = len(vert) // LANES
  node = np.empty(mesh.nvert, np.int64)
  node[vert[vert >= 0]] = np.flatnonzero(vert >= 0)
  skin = dataclasses.replace(config, bend=0.0) if len(mesh.tet) else config
  out = _skin(solid.skin(mesh), skin, pinned, vert, node, bend_width, coarse)
  out |= _capsule(mesh.surface, config, pinned, vert, node)
  if len(mesh.tet):
    out |= solid.arrays(mesh, config, vert, node, out["slot_adr"])
  else:
    out |= solid.none(nslice)
  area = np.where(vert >= 0, topology.held_areas(mesh)[vert], 0.0).astype(np.float32)
  out |= {
    "vert": vert.astype(np.int32),
    "node": node.astype(np.int32),
    "area": to_slices(area),
    "closed": int(mesh.closed),
    "volume0": topology.volume(mesh.rest, mesh.elem) if mesh.closed else 0.0,
    "unheld": int(not (config.held or config.carrier or mesh.spare or pinned.any())),
    "stride": 0,
    "mesh": np.zeros(0, np.int32),
    "shortest": 0.0 if mesh.spare else topology.shortest(mesh),
    "number": np.array(list(_numbers(config, mesh.closed).values())),
  }
  return out | counts(out)


def counts(values: dict[str, Any]) -> dict[str, int]:
  """Returns the counts of `Shape` from its arrays."""
  return {
    "nvert": len(values["node"]),
    "nnode": len(values["vert"]),
    "nslice": len(values["area"]),
    "nused": len(values["area"]),
    "nelemslice": len(values["elem_node"]),
    "nhingeslice": len(values["hinge_node"]),
    "ntetslice": len(values["tet_node"]),
    "nedgeslice": len(values["edge_slot"]),
    "nslot": int(values["slot_adr"][-1]),
    "ncapsule": int(values["capsule_adr"][-1]),
  }


def _skin(
  mesh: Mesh,
  config: Config,
  pinned: np.ndarray,
  vert: np.ndarray,
  node: np.ndarray,
  bend_width: np.ndarray | None,
  coarse: bool = False,
) -> dict[str, np.ndarray]:
  """Returns the arrays of fans, nodes and bending of a surface."""
  nslice, writer = len(vert) // LANES, rows.Rows(WorkingCopy(mesh), {}, node, coarse)
  out = _fans(mesh, vert) | _no_bending(nslice)
  if config.bend:
    out |= _bending(mesh, node, nslice, writer.widths(mesh), bend_width)
  writer.put(out)
  assert writer.write(mesh, config, pinned)
  return out


def _fans(mesh: Mesh, vert: np.ndarray) -> dict[str, np.ndarray]:
  """Returns the arrays of fans and nodes, see `types.Shape`, as those of padding."""
  nslice = len(vert) // LANES
  degree = np.where(vert >= 0, rows.room(mesh)[vert] if mesh.spare else mesh.degree[vert], 0)
  width = degree.reshape(nslice, LANES).max(axis=1)
  sizes = {"nslice": nslice, "nslot": int(width.sum())}
  own = offset(np.arange(len(vert)).reshape(nslice, LANES)).astype(np.int32)
  return {
    "slot_adr": addresses(width),
    "held_adr": banks(width),
    **zeros(_FANS, sizes),
    "fan_node": np.repeat(own, width + 2, axis=0),
  }


_FANS = ("fan_rest", "fan_metric", "fan_spring", "fan_corner", "fan_side", "fan_width", "degree",
         "rest", "area", "free")  # fmt: skip
_PLATES = ("elem_node", "elem_rest", "elem_hinge", "hinge_node", "hinge_rest", "hinge_elem",
           "hinge_near", "hinge_gain", "hinge_angle0", "bend_gain", "bend_diag",
           "bend_width")  # fmt: skip


def _capsule(
  mesh: Mesh, config: Config, pinned: np.ndarray, vert: np.ndarray, node: np.ndarray
) -> dict[str, np.ndarray]:
  """Returns the skin of a solid, empty fans where there is none; `mesh` is its surface."""
  names = ("node", "rest", "corner", "side", "metric")
  if config.elements != "solid" or not config.capsule_young:
    counts = ("ncapsule + 2 ncapsuleslice", "ncapsule + ncapsuleslice", "ncapsuleslice")
    return {"capsule_adr": np.zeros(1, np.int32)} | empty(counts)
  skin = _skin(mesh, solid.capsule(config), pinned, vert, node, None)
  out = {f"capsule_{name}": skin[f"fan_{name}"] for name in names}
  out |= {name: skin[name] for name in (*_PLATES, "bend_adr", "bend_node")}
  return out | {"capsule_adr": skin["slot_adr"], "capsule_degree": skin["degree"]}


def _bending(
  mesh: Mesh, node: np.ndarray, nslice: int, entries: np.ndarray, width: np.ndarray | None
) -> dict[str, np.ndarray]:
  """Returns the arrays of triangles, hinges and the bending matrix, as those of padding.

  Args:
    mesh: the surface
    node: node of every vertex
    nslice: slices of nodes
    entries: of each vertex's row of the bending matrix
    width: rows of each slice of it, None for as many as are needed
  """
  count, nhinge = np.zeros(nslice * LANES, int), len(mesh.whole.interior)
  count[node] = entries
  needed = count.reshape(-1, LANES).max(axis=1)
  room = _bend_room(mesh, node, count) if mesh.spare else needed
  wide: np.ndarray = room if width is None else width
  # Padding has a hinge that has no gain; so have those that were cut.
  sizes = {"nslice": nslice, "nelemslice": -(-mesh.nelem // LANES), "nbendslice": nslice}
  sizes |= {"nhingeslice": -(-(nhinge + 1) // LANES), "nbend": int(wide.sum())}
  out = zeros(_PLATES, sizes)
  out["elem_hinge"][-1] = nhinge
  own = np.arange(nslice * LANES, dtype=np.int32).reshape(nslice, LANES)
  return out | {"bend_adr": addresses(wide), "bend_node": np.repeat(own, wide, axis=0)}


def _bend_room(mesh: Mesh, node: np.ndarray, entries: np.ndarray) -> np.ndarray:
  """Returns the rows of each slice of the bending matrix where cuts may come.

  A node near the end of a cut has vertices of both its sides around it.
  """
  room = entries + np.where(entries > 0, _BEND_MORE, 0)
  room[node[mesh.spares]] = room.max()
  return room.reshape(-1, LANES).max(axis=1)


def _no_bending(nslice: int) -> dict[str, np.ndarray]:
  """Returns the arrays of `_bending` for a surface without it."""
  sizes = ("nelemslice", "nhingeslice", "nbend", "nbendslice")
  return {"bend_adr": np.zeros(nslice + 1, np.int32)} | empty(sizes)
