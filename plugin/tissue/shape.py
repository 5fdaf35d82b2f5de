"""Makes a body: mesh and configuration to sliced arrays on a device."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from . import body as bodies
from . import coarse as coarsening
from . import config as configuration
from . import device as devices
from . import mesh as topology
from . import plate, solid, step
from .body import Body
from .config import Config
from .mesh import Mesh
from .order import LANES, addresses, banks, ellpack, node_order, offset, pad, to_slices
from .types import NUMBERS, empty


def make(
  mesh: Mesh,
  config: Config,
  pinned: np.ndarray,
  device: str,
  scale: float = 0.0,
  nworld: int = 1,
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
  finest = arrays(mesh, config, pinned, devices.patch(target, -(-mesh.nvert // LANES)))
  below = None
  surface = len(mesh.tet) == 0
  if surface and (np.isinf(scale) or coarsening.pay(finest, scale, coarsening.threshold(target))):
    below = _below(mesh, config, pinned, finest, target)
  body = bodies.constants(finest, target, config.newton, below)
  with wp.ScopedDevice(target):
    step.calibrate(bodies.worlds(body))
  return bodies.worlds(body, nworld) if nworld else body


def change(body: Body, mesh: Mesh, config: Config, pinned: np.ndarray):
  """Gives a body the material and the numbers of a configuration, in the arrays that it has.

  Args:
    body: the body, made of `mesh` and `pinned`
    mesh: the surface
    config: configuration of the same elements, with bending as before on or off
    pinned: vertices that do not move, (nvert,) bool
  """
  finest = arrays(mesh, config, pinned, devices.patch(body.device, body.shape.nslice))
  bodies.retissue(body, finest)
  below = _below(mesh, config, pinned, finest, body.device) if body.levels else None
  if body.levels and below:
    bodies.retissue(body.levels.body, below)
    body.levels.transfer.rate.assign(below["rate"])
  renumber(body, config)


def renumber(body: Body, config: Config):
  """Gives a body the numbers of a configuration that may change while running."""
  bodies.renumber(body, _numbers(config))
  body.newton = config.newton


def _numbers(config: Config) -> dict[str, float]:
  values = {name: getattr(config, name, 1.0) for name in NUMBERS}
  return values | {"stiffness": config.stiffness if config.elements == "spring" else 0.0}


def _below(
  mesh: Mesh, config: Config, pinned: np.ndarray, finest: dict[str, Any], device: wp.Device
) -> dict[str, Any] | None:
  """Returns the fields of all coarser meshes together and of `Transfer`, None without such."""
  levels = coarsening.build(mesh)
  if not levels:
    return None
  young = coarsening.young(np.broadcast_to(config.young, mesh.nelem), mesh, levels)
  masks = [pinned, *(pinned[level.vert] for level in levels)]
  parts = [finest] + [
    arrays(level.mesh, dataclasses.replace(config, young=e), mask)
    for level, e, mask in zip(levels, young, masks[1:], strict=True)
  ]
  joined = coarsening.join(parts[1:])
  joined |= solid.none(len(joined["area"]))
  return joined | counts(joined) | coarsening.transfer(levels, parts, masks, device)


def arrays(mesh: Mesh, config: Config, pinned: np.ndarray, patch: int = 0) -> dict[str, Any]:
  """Returns the fields of `Shape` and `Tissue` by name; for `patch` see `order.node_order`."""
  vert = node_order(mesh, patch)
  node = np.empty(mesh.nvert, np.int64)
  node[vert[vert >= 0]] = np.flatnonzero(vert >= 0)
  out = {
    **_fans(mesh, config, vert, node),
    **_bending(mesh, config, node, len(vert) // LANES),
    **(solid.arrays(mesh, config, vert, node) if len(mesh.tet) else solid.none(len(vert) // LANES)),
    "vert": vert.astype(np.int32),
    "node": node.astype(np.int32),
    "area": _node_values(topology.vertex_areas(mesh.rest, mesh.elem), vert),
    "free": _node_values(np.where(pinned, 0.0, 1.0), vert),
    "closed": int(mesh.closed),
    "volume0": topology.volume(mesh.rest, mesh.elem) if mesh.closed else 0.0,
    "number": np.array(list(_numbers(config).values())),
  }
  return out | counts(out)


def counts(values: dict[str, Any]) -> dict[str, int]:
  """Returns the counts of `Shape` from its arrays."""
  return {
    "nvert": len(values["node"]),
    "nnode": len(values["vert"]),
    "nslice": len(values["area"]),
    "nelemslice": len(values["elem_node"]),
    "nhingeslice": len(values["hinge_node"]),
    "ntetslice": len(values["tet_node"]),
    "nslot": int(values["slot_adr"][-1]),
  }


def _node_values(values: np.ndarray, vert: np.ndarray) -> np.ndarray:
  return to_slices(np.where(vert >= 0, values[vert], 0.0).astype(np.float32))


def _fans(mesh: Mesh, config: Config, vert: np.ndarray, node: np.ndarray) -> dict[str, np.ndarray]:
  """Returns the arrays of fans; see `types.Shape`."""
  nslice = len(vert) // LANES
  real = vert >= 0
  degree = np.where(real, mesh.degree[vert], 0)
  width = degree.reshape(nslice, LANES).max(axis=1)
  fan, half = _rings(mesh, vert, degree)
  neighbour = np.where(fan >= 0, node[fan], np.arange(len(vert))[:, None])
  rest = mesh.rest - mesh.rest.mean(axis=0)
  here = rest[np.where(real, vert, 0)]
  toward = np.where((fan >= 0)[..., None], rest[fan] - here[:, None], 0.0)
  metric, spring = _stiffness(mesh, config, toward, half, degree)
  corner = np.where(half >= 0, half, 0)

  def rows(dense, extra):
    """Returns rows 0 .. width + extra - 1 of every slice, slice after slice."""
    sliced = to_slices(dense)  # (nslice, most + ., ..., 8)
    take = np.concatenate([np.arange(w + extra) for w in width])
    which = np.repeat(np.arange(nslice), width + extra)
    return sliced[which, take]

  return {
    "slot_adr": addresses(width),
    "held_adr": banks(width),
    "fan_node": rows(offset(neighbour), 2).astype(np.int32),
    "fan_rest": rows(toward, 2).astype(np.float32),
    "fan_metric": rows(metric, 1).astype(np.float32),
    "fan_spring": rows(spring, 0).astype(np.float32),
    "fan_corner": rows(offset(corner // 3, 4), 1).astype(np.int32),
    # Corner forces are (nelemslice, 3, 8): component c of vector t.
    "fan_side": rows(offset(corner // 3) + corner % 3 * LANES, 1).astype(np.int32),
    "degree": to_slices(degree.astype(np.float32)),
    "rest": to_slices(np.where(real[:, None], here, 0.0).astype(np.float32)),
  }


def _rings(mesh: Mesh, vert: np.ndarray, degree: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
  """Returns the vertices of each node's fan and the half-edges to them, -1 for none.

  Entry 0 is the last neighbour again where the fan closes, and the first one follows the last.
  """
  real, most = vert >= 0, int(degree.max())
  own = np.arange(len(vert))
  ring = np.where(real[:, None], mesh.ring[vert], -1)
  ring_elem = np.where(real[:, None], mesh.ring_elem[vert], -1)
  fan = np.full((len(vert), most + 2), -1, np.int64)
  half = np.full((len(vert), most + 1), -1, np.int64)
  fan[:, 1 : 1 + ring.shape[1]] = ring[:, : most + 1]
  half[:, 1 : 1 + ring.shape[1]] = ring_elem[:, :most]
  last = np.maximum(degree - 1, 0)
  wraps = real & (ring_elem[own, last] >= 0)
  fan[:, 0] = np.where(wraps, ring[own, last], -1)
  half[:, 0] = np.where(wraps, ring_elem[own, last], -1)
  closing = np.where(wraps, degree + 1, 0)
  fan[own[wraps], closing[wraps]] = ring[wraps, 0]
  return fan, half


def _stiffness(
  mesh: Mesh, config: Config, toward: np.ndarray, half: np.ndarray, degree: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
  """Returns metric and moduli of each node's triangles, and the springs of its edges.

  Args:
    mesh: the surface
    config: its configuration
    toward: rest vector to each entry of a node's fan [m]    (nnode, most + 2, 3)
    half: half-edge to each, but the last one; -1 for none   (nnode, most + 1)
    degree: number of neighbours                             (nnode,)

  Returns:
    `fan_metric` (nnode, most + 1, 5), `fan_spring` (nnode, most)
  """
  # Contravariant metric of the triangle (i, fan[k], fan[k + 1]).
  has = half >= 0
  e1, e2 = toward[:, :-1], toward[:, 1:]
  g11, g12, g22 = (e1 * e1).sum(-1), (e1 * e2).sum(-1), (e2 * e2).sum(-1)
  det = np.where(has, g11 * g22 - g12 * g12, 1.0)
  volume = 0.5 * np.sqrt(det) * config.thickness
  lam, mu = configuration.lame(config, mesh.nelem)
  if config.elements == "spring":
    lam, mu = 0 * lam, 0 * mu
  elem = np.where(has, half // 3, 0)
  metric = np.stack([g22 / det, -g12 / det, g11 / det, mu[elem] * volume, lam[elem] * volume], -1)
  metric[~has] = 0
  # Van Gelder 1998: springs like a triangle mesh of modulus E, E t area / length^2 on each side.
  young = np.broadcast_to(np.asarray(config.young), (mesh.nelem,))
  strength = np.where(has, young[elem] * volume, 0.0)
  length2 = (toward[:, 1:-1] ** 2).sum(-1)
  spring = (strength[:, :-1] + strength[:, 1:]) / np.where(length2 > 0, length2, 1.0)
  if config.elements == "spring":
    spring = np.full_like(spring, config.stiffness)
  spring[np.arange(spring.shape[1]) >= degree[:, None]] = 0
  return metric, spring


def _bending(mesh: Mesh, config: Config, node: np.ndarray, nslice: int) -> dict[str, np.ndarray]:
  """Returns the arrays of triangles, hinges and the bending matrix, empty where bending is off."""
  if config.bend == 0:
    return _no_bending(nslice)
  rigidity = configuration.rigidity(config, mesh.nelem)
  hinge = plate.hinges(mesh, rigidity, config.poisson)
  rest = mesh.rest - mesh.rest.mean(axis=0)
  corner = rest[mesh.elem]
  arms = np.concatenate([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=1)
  # The hinge opposite corner c is that of the half-edge after it; a boundary edge gets the first
  # padding hinge, which has no gain.
  nhinge = len(hinge.vert)
  opposite = np.where(hinge.of_elem < 0, nhinge, hinge.of_elem)[:, [1, 2, 0]]
  at = rest[hinge.vert]
  hinge_rest = (at[:, 1:] - at[:, :1]).reshape(-1, 9)
  near, gain = plate.neighbours(hinge)
  matrix = plate.bending_matrix(mesh, hinge)
  coo = matrix.tocoo()
  own = np.arange(nslice * LANES).reshape(nslice, LANES)
  width, bend_node, bend_gain = ellpack(node[coo.row], node[coo.col], coo.data, own)
  diag = np.zeros(own.size)
  diag[node] = matrix.diagonal()

  def ints(values, fill=0, least=0):
    return to_slices(pad(values, fill, least)).astype(np.int32)

  def floats(values, least=0):
    return to_slices(pad(values, 0, least)).astype(np.float32)

  return {
    "elem_node": ints(offset(node[mesh.elem])),
    "elem_rest": floats(arms),
    "elem_hinge": ints(opposite, nhinge),
    "hinge_node": ints(offset(node[hinge.vert]), least=1),
    "hinge_rest": floats(hinge_rest, 1),
    "hinge_elem": ints(offset(hinge.elem, 4), least=1),
    "hinge_near": ints(near, least=1),
    "hinge_gain": floats(gain, 1),
    "hinge_angle0": floats(np.zeros(nhinge), 1),
    "bend_adr": addresses(width),
    "bend_node": bend_node,
    "bend_gain": bend_gain,
    "bend_diag": to_slices(diag).astype(np.float32),
  }


def _no_bending(nslice: int) -> dict[str, np.ndarray]:
  """Returns the arrays of `_bending` for a surface without it."""
  sizes = ("nelemslice", "nhingeslice", "nbend", "nbendslice")
  return {"bend_adr": np.zeros(nslice + 1, np.int32)} | empty(sizes)
