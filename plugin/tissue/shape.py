"""Makes the constants of an organ: mesh and configuration to sliced arrays on a device."""

from __future__ import annotations

import dataclasses

import numpy as np
import warp as wp
from scipy import sparse

from . import config as configuration
from . import hierarchy, levels, simd
from . import mesh as topology
from .config import Config
from .mesh import Mesh
from .simd import LANES
from .types import Levels, Surface

# With fewer nodes the CPU solves a step before a GPU has met its barriers (benchmarks/solver.py).
_CUDA_FROM = 2000
COARSEST = 64  # nodes of the coarsest mesh of the multilevel preconditioner


def _pad(array: np.ndarray, fill=0, least=0) -> np.ndarray:
  """Returns `array` with its first axis padded to whole slices, by `least` rows or more."""
  count = least + -(len(array) + least) % LANES
  extra = np.full((count, *array.shape[1:]), fill, array.dtype)
  return np.concatenate([array, extra])


def to_slices(array: np.ndarray) -> np.ndarray:
  """Returns (n, ...) as (n / 8, ..., 8); n a multiple of 8."""
  split = array.reshape(len(array) // LANES, LANES, *array.shape[1:])
  return np.ascontiguousarray(np.moveaxis(split, 1, -1))


def from_slices(array: np.ndarray) -> np.ndarray:
  """Returns (n / 8, ..., 8) as (n, ...)."""
  moved = np.moveaxis(array, -1, 1)
  return moved.reshape(-1, *moved.shape[2:])


def _offset(index: np.ndarray, size: int = 3) -> np.ndarray:
  """Returns where the first of the `size` components of `index` starts, in floats."""
  return (index // LANES) * size * LANES + index % LANES


def make(
  mesh: Mesh, config: Config, pinned: np.ndarray, device: str, scale: float = 0.0
) -> Surface:
  """Returns the constants of an organ.

  Args:
    mesh: the surface
    config: its configuration
    pinned: vertices that do not move, (nvert,) bool
    device: Warp device, or `auto`
    scale: (h^2 + h damping) over the mean mass of a node [s^2/kg], by which coarser meshes are made
      for the multilevel preconditioner if it pays; infinity makes them anyway
  """
  target = resolve_device(device, mesh.nvert)
  finest = arrays(mesh, config, pinned, simd.patch(target, -(-mesh.nvert // LANES)))
  made = _surface(mesh, config, finest, target)
  threshold = levels.threshold(target)
  if not np.isinf(scale) and not levels.pay(finest, scale, threshold):
    return made
  coarse = hierarchy.build(mesh, COARSEST)
  if not coarse:
    return made
  young = levels.young(np.broadcast_to(config.young, mesh.nelem), mesh, coarse)
  masks = [pinned, *(pinned[level.vert] for level in coarse)]
  parts = [finest] + [
    arrays(level.mesh, dataclasses.replace(config, young=e), mask)
    for level, e, mask in zip(coarse, young, masks[1:], strict=True)
  ]
  put = _put(levels.transfer(coarse, parts, masks) | {"rate": levels.rates(parts)}, target)
  made.levels = Levels(
    nlevel=len(coarse),
    nodes=int((~pinned).sum()),
    threshold=threshold,
    surface=_surface(mesh, config, levels.join(parts[1:]), target),
    **put,
  )
  return made


def arrays(mesh: Mesh, config: Config, pinned: np.ndarray, patch: int = 0) -> dict:
  """Returns the arrays of `Surface` by name; for `patch` see `mesh.node_order`."""
  vert = topology.node_order(mesh, patch)
  node = np.empty(mesh.nvert, np.int64)
  node[vert[vert >= 0]] = np.flatnonzero(vert >= 0)
  return {
    **_fans(mesh, config, vert, node),
    **_bending(mesh, config, node, len(vert) // LANES),
    "vert": vert.astype(np.int32),
    "node": node.astype(np.int32),
    "area": _node_values(topology.vertex_areas(mesh.rest, mesh.elem), vert),
    "free": _node_values(np.where(pinned, 0.0, 1.0), vert),
  }


def _put(values: dict, device) -> dict:
  """Returns arrays on the device, of int or float."""
  put = {}
  for name, array in values.items():
    kind = wp.int32 if array.dtype.kind == "i" else wp.float32
    put[name] = wp.array(np.ascontiguousarray(array), dtype=kind, device=device)
  return put


def _surface(mesh: Mesh, config: Config, values: dict, target) -> Surface:
  return Surface(
    nvert=len(values["node"]),
    nnode=len(values["vert"]),
    nslice=len(values["area"]),
    nelemslice=len(values["elem_node"]),
    nhingeslice=len(values["hinge_node"]),
    nslot=int(values["slot_adr"][-1]),
    spring=config.stiffness if config.elements == "spring" else 0.0,
    foundation=config.foundation,
    bulk=config.bulk,
    pressure=config.pressure,
    volume0=topology.volume(mesh.rest, mesh.elem) if mesh.closed else 0.0,
    damping=config.damping,
    iterations=config.iterations,
    tolerance=config.tolerance,
    newton=config.newton,
    device=target,
    **_put(values, target),
  )


def resolve_device(name: str, nvert: int) -> wp.Device:
  """Returns the Warp device that `name` asks for; `auto` is the faster one for `nvert` nodes.

  Raises:
    ValueError: there is no such device.
  """
  if name == "auto":
    name = "cuda:0" if wp.is_cuda_available() and nvert >= _CUDA_FROM else "cpu"
  if name != "cpu":
    present = [device.alias for device in wp.get_cuda_devices()] if wp.is_cuda_available() else []
    if name not in present:
      have = ", ".join(present) or "no CUDA device"
      raise ValueError(f"device is {name!r}, but this machine has {have}; expected 'cpu' or 'auto'")
  return wp.get_device(name)


def _node_values(values: np.ndarray, vert: np.ndarray) -> np.ndarray:
  return to_slices(np.where(vert >= 0, values[vert], 0.0).astype(np.float32))


def _fans(mesh: Mesh, config: Config, vert: np.ndarray, node: np.ndarray) -> dict:
  """Returns the fan arrays; see `Surface`."""
  nslice = len(vert) // LANES
  real = vert >= 0
  degree = np.where(real, mesh.degree[vert], 0)
  width = degree.reshape(nslice, LANES).max(axis=1)
  slot_adr = np.concatenate([[0], np.cumsum(width)])
  most = int(width.max())
  # Dense fans, then rows picked slice by slice: entries 0 .. width + 1 of each node.
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
  neighbour = np.where(fan >= 0, node[fan], own[:, None])
  rest = mesh.rest - mesh.rest.mean(axis=0)
  here = rest[np.where(real, vert, 0)]
  toward = np.where((fan >= 0)[..., None], rest[fan] - here[:, None], 0.0)

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
  corner = np.where(has, half, 0)
  # Van Gelder 1998: springs like a triangle mesh of modulus E, E t area / length^2 on each side.
  young = np.broadcast_to(np.asarray(config.young), (mesh.nelem,))
  strength = np.where(has, young[elem] * volume, 0.0)
  length2 = (toward[:, 1:-1] ** 2).sum(-1)
  spring = (strength[:, :-1] + strength[:, 1:]) / np.where(length2 > 0, length2, 1.0)
  if config.elements == "spring":
    spring = np.full_like(spring, config.stiffness)
  spring[np.arange(most) >= degree[:, None]] = 0

  def rows(dense, extra):
    """Returns rows 0 .. width + extra - 1 of every slice, slice after slice."""
    sliced = to_slices(dense)  # (nslice, most + ., ..., 8)
    take = np.concatenate([np.arange(w + extra) for w in width])
    which = np.repeat(np.arange(nslice), width + extra)
    return sliced[which, take]

  return {
    "slot_adr": slot_adr.astype(np.int32),
    "fan_node": rows(_offset(neighbour), 2).astype(np.int32),
    "fan_rest": rows(toward, 2).astype(np.float32),
    "fan_metric": rows(metric, 1).astype(np.float32),
    "fan_spring": rows(spring, 0).astype(np.float32),
    "fan_corner": rows(_offset(corner // 3, 4), 1).astype(np.int32),
    # Corner forces are (nelemslice, 3, 8): component c of vector t.
    "fan_side": rows(_offset(corner // 3) + corner % 3 * LANES, 1).astype(np.int32),
    "degree": to_slices(degree.astype(np.float32)),
    "rest": to_slices(np.where(real[:, None], here, 0.0).astype(np.float32)),
  }


def _bending(mesh: Mesh, config: Config, node: np.ndarray, nslice: int) -> dict:
  """Returns the triangle, hinge and bending matrix arrays, empty where bending is off."""
  if config.bend == 0:
    empty = {
      "elem_node": (3, LANES),
      "elem_hinge": (3, LANES),
      "hinge_node": (4, LANES),
      "hinge_elem": (2, LANES),
      "hinge_near": (4, LANES),
      "bend_node": (LANES,),
    }
    out: dict[str, np.ndarray] = {
      name: np.zeros((0, *shape), np.int32) for name, shape in empty.items()
    }
    for name, shape in {"elem_rest": 6, "hinge_rest": 9, "hinge_gain": 5}.items():
      out[name] = np.zeros((0, shape, LANES), np.float32)
    for name in ("hinge_angle0", "bend_gain", "bend_diag"):
      out[name] = np.zeros((0, LANES), np.float32)
    out["bend_adr"] = np.zeros(nslice + 1, np.int32)
    return out
  rigidity = configuration.rigidity(config, mesh.nelem)
  hinge = topology.hinges(mesh, rigidity, config.poisson)
  rest = mesh.rest - mesh.rest.mean(axis=0)

  corner = rest[mesh.elem]
  arms = np.concatenate([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=1)
  # The hinge opposite corner c is that of the half-edge after it; a boundary edge gets the first
  # padding hinge, which has no gain.
  nhinge = len(hinge.vert)
  opposite = np.where(hinge.of_elem < 0, nhinge, hinge.of_elem)[:, [1, 2, 0]]

  at = rest[hinge.vert]
  hinge_rest = (at[:, 1:] - at[:, :1]).reshape(-1, 9)
  near, gain = _hinge_rows(hinge)
  out: dict[str, np.ndarray] = {
    "elem_node": to_slices(_pad(_offset(node[mesh.elem]))).astype(np.int32),
    "elem_rest": to_slices(_pad(arms, 0)).astype(np.float32),
    "elem_hinge": to_slices(_pad(opposite, nhinge)).astype(np.int32),
    "hinge_node": to_slices(_pad(_offset(node[hinge.vert]), least=1)).astype(np.int32),
    "hinge_rest": to_slices(_pad(hinge_rest, least=1)).astype(np.float32),
    "hinge_elem": to_slices(_pad(_offset(hinge.elem, 4), least=1)).astype(np.int32),
    "hinge_near": to_slices(_pad(near, least=1)).astype(np.int32),
    "hinge_gain": to_slices(_pad(gain, least=1)).astype(np.float32),
  }
  out["hinge_angle0"] = np.zeros((len(out["hinge_node"]), LANES), np.float32)
  out |= _ellpack(topology.bending_matrix(mesh, hinge), node, nslice)
  return out


def _hinge_rows(hinge: topology.Hinges) -> tuple[np.ndarray, np.ndarray]:
  """Returns each hinge's four neighbours in its two triangles, and the gains to itself and them."""
  nhinge = len(hinge.vert)
  near = np.zeros((nhinge, 4), np.int64)
  gain = np.zeros((nhinge, 5))
  own = np.arange(nhinge)
  for side in range(2):
    elem = hinge.elem[:, side]
    c = np.argmax(hinge.of_elem[elem] == own[:, None], axis=1)
    gain[:, 0] += hinge.gain[elem, c, c]
    for k in range(2):
      other = (c + 1 + k) % 3
      index = hinge.of_elem[elem, other]
      near[:, 2 * side + k] = np.where(index >= 0, index, own)
      gain[:, 1 + 2 * side + k] = np.where(index >= 0, hinge.gain[elem, c, other], 0.0)
  return near, gain


def _ellpack(matrix: sparse.csr_matrix, node: np.ndarray, nslice: int) -> dict:
  """Returns the bending matrix as sliced ELLPACK over nodes."""
  coo = matrix.tocoo()
  row, col = node[coo.row], node[coo.col]
  order = np.lexsort((col, row))
  row, col, value = row[order], col[order], coo.data[order]
  count = np.bincount(row, minlength=nslice * LANES)
  width = count.reshape(nslice, LANES).max(axis=1)
  adr = np.concatenate([[0], np.cumsum(width)])
  within = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
  index = np.tile(np.arange(nslice * LANES).reshape(nslice, 1, LANES), (1, 1, 1))
  bend_node = np.repeat(index[:, 0], width, axis=0)
  bend_gain = np.zeros((adr[-1], LANES))
  place = adr[row // LANES] + within
  bend_node[place, row % LANES] = col
  bend_gain[place, row % LANES] = value
  diag = np.zeros(nslice * LANES)
  diag[node] = matrix.diagonal()
  return {
    "bend_adr": adr.astype(np.int32),
    "bend_node": bend_node.astype(np.int32),
    "bend_gain": bend_gain.astype(np.float32),
    "bend_diag": diag.reshape(nslice, LANES).astype(np.float32),
  }
