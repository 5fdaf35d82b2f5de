"""What a node, a triangle and a hinge have in `Shape` and `Tissue`, dense, for any of them.

`shape` makes the arrays of all of them, `refill` those that a cut has changed: both by these.
"""

from __future__ import annotations

import numpy as np

from . import config as configuration
from . import faces, plate
from .config import Config
from .mesh import Mesh
from .order import LANES, offset


def fans(
  mesh: Mesh, config: Config, vert: np.ndarray, own: np.ndarray, node: np.ndarray, most: int
) -> dict[str, np.ndarray]:
  """Returns what nodes have of the arrays of fans, their entries along the second axis.

  Args:
    mesh: the surface
    config: its configuration
    vert: vertices, -1 for padding    (n,)
    own: their nodes                  (n,)
    node: node of every vertex        (nvert,)
    most: neighbours that there is room for
  """
  real = vert >= 0
  degree = np.where(real, mesh.degree[vert], 0)
  fan, half = _rings(mesh, vert, degree, most)
  neighbour = np.where(fan >= 0, node[fan], own[:, None])
  here = mesh.rest[np.where(real, vert, 0)] - mesh.centre
  toward = mesh.rest[fan] - mesh.centre - here[:, None]
  toward[fan < 0] = 0.0
  metric, spring = _stiffness(mesh, config, toward, half, degree)
  corner = np.where(half >= 0, half, 0)
  return {
    "fan_node": offset(neighbour).astype(np.int32),
    "fan_rest": toward.astype(np.float32),
    "fan_metric": metric.astype(np.float32),
    "fan_spring": spring.astype(np.float32),
    "fan_corner": offset(corner // 3, 4).astype(np.int32),
    # Corner forces are (nelemslice, 3, 8): component c of vector t.
    "fan_side": (offset(corner // 3) + corner % 3 * LANES).astype(np.int32),
    "degree": degree.astype(np.float32),
    "rest": np.where(real[:, None], here, 0.0).astype(np.float32),
  }


# Rows of a fan's arrays beyond the number of its neighbours.
EXTRA = {"fan_node": 2, "fan_rest": 2, "fan_metric": 1, "fan_spring": 0, "fan_corner": 1,
         "fan_side": 1}  # fmt: skip


def room(mesh: Mesh) -> np.ndarray:
  """Returns the most neighbours that each vertex can have, cut or not, (nvert,).

  A cut takes triangles from a fan and adds none; an open one has a neighbour more than triangles.
  """
  mesh = mesh.whole
  if len(mesh.tet):
    return faces.room(mesh)
  closes = mesh.ring_elem[np.arange(mesh.nvert), np.maximum(mesh.degree - 1, 0)] >= 0
  most = mesh.degree + (closes & (mesh.degree > 0))
  most[mesh.spares] = most.max()
  return most


def _rings(
  mesh: Mesh, vert: np.ndarray, degree: np.ndarray, most: int
) -> tuple[np.ndarray, np.ndarray]:
  """Returns the vertices of each node's fan and the half-edges to them, -1 for none.

  Entry 0 is the last neighbour again where the fan closes, and the first one follows the last.
  """
  real = vert >= 0
  own = np.arange(len(vert))
  ring = np.where(real[:, None], mesh.ring[vert], -1)
  ring_elem = np.where(real[:, None], mesh.ring_elem[vert], -1)
  fan = np.full((len(vert), most + 2), -1, np.int64)
  half = np.full((len(vert), most + 1), -1, np.int64)
  across = min(most, ring.shape[1])
  fan[:, 1 : 1 + across] = ring[:, :across]
  half[:, 1 : 1 + across] = ring_elem[:, :across]
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
    spring = config.stiffness * np.where(_is_cut(mesh, half), 0.5, 1.0)  # a half for each side
  spring[np.arange(spring.shape[1]) >= degree[:, None]] = 0
  return metric, spring


def _is_cut(mesh: Mesh, half: np.ndarray) -> np.ndarray:
  """Returns whether the edges of fans, but for those that repeat, were cut, (n, most)."""
  before, after = half[:, :-1], half[:, 1:]
  alone = (before < 0) != (after < 0)
  own = np.where(after >= 0, after, before - before % 3 + (before + 2) % 3)
  return alone & (mesh.whole.twin[own] >= 0)


def elements(
  mesh: Mesh, which: np.ndarray, node: np.ndarray, hinge: np.ndarray, none: int
) -> dict[str, np.ndarray]:
  """Returns what triangles have where there is bending.

  Args:
    mesh: the surface
    which: triangles                                        (n,)
    node: node of every vertex                              (nvert,)
    hinge: number of the hinge of each of their half-edges, -1 on the boundary (n, 3)
    none: number of a hinge that has no gain
  """
  corner = mesh.rest[mesh.elem[which]] - mesh.centre
  arms = np.concatenate([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=1)
  # The hinge opposite corner c is that of the half-edge after it.
  opposite = np.where(hinge < 0, none, hinge)[:, [1, 2, 0]]
  return {
    "elem_node": offset(node[mesh.elem[which]]).astype(np.int32),
    "elem_rest": arms.astype(np.float32),
    "elem_hinge": opposite.astype(np.int32),
  }


def hinges(
  mesh: Mesh, hinge: plate.Hinges, node: np.ndarray, number: np.ndarray
) -> dict[str, np.ndarray]:
  """Returns what hinges have, those of `hinge` in its order; `number` has their numbers."""
  at = mesh.rest[hinge.vert] - mesh.centre
  near, gain = plate.neighbours(hinge)
  return {
    "hinge_node": offset(node[hinge.vert]).astype(np.int32),
    "hinge_rest": (at[:, 1:] - at[:, :1]).reshape(-1, 9).astype(np.float32),
    "hinge_elem": offset(hinge.elem, 4).astype(np.int32),
    "hinge_near": number[near].astype(np.int32),
    "hinge_gain": gain.astype(np.float32),
  }


def numbers(mesh: Mesh, half: np.ndarray) -> np.ndarray:
  """Returns the numbers of hinges by their half-edges: those of the mesh before the first cut."""
  return np.searchsorted(mesh.whole.interior, half)
