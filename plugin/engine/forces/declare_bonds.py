"""What an organ is bonded to, by its declaration or from Python; see `cohesive_bonds`."""

# Annotations here are objects, not text: no `from __future__ import annotations`.
# pyright: reportInvalidTypeForm=false
from typing import TYPE_CHECKING

import numpy as np
import warp as wp
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.reading import Law
from palpate.tissue.types import doubles, fill, ints, struct

from .. import coupling
from ..layout import GEOM
from ..model import flexes, mjstruct
from . import declare_attachments, transfer
from .attachments import motion
from .cohesive_bonds import ON_ORGAN, Group
from .transfer import Grip, Spots

if TYPE_CHECKING:
  from ..workspace import Workspace


@struct
class Search:
  """Points, and what they may be near to."""

  npoint: int
  ngeom: int
  nelem: int
  point: doubles("npoint", 3)  # [m]
  geom: doubles("ngeom", len(GEOM))  # see GEOM
  corner: doubles("nelem", 3, 3)  # corners of triangles [m]
  far: doubles("npoint")  # distance to the nearest [m]
  elem: ints("npoint")  # triangle that is nearest
  weight: doubles("npoint", 3)  # weights of its corners at the nearest point


_measure_geoms, _measure_triangles = coupling.kernels(
  "forces/cohesive_bonds.h", Search, "measure_geoms", "measure_triangles"
)


def declare(w: "Workspace"):
  """Bonds an organ to the bodies that its configuration names.

  Raises:
    ValueError: it names what does not exist, or no vertex is near it.
  """
  m = mjstruct.Model.from_address(w.model)
  flex_names = [flexes.name(m, f) for f in range(m.nflex)]
  for row in w.config.bonds or ():
    if flexes.resolve(row.to, w.organ.name, flex_names) is None:
      body = declare_attachments.find_body(w, m, "bonds", row.to)
      w.bonds.put(to_body(w, body, row.to, row.law, row.near, row.vertices, now=False))


def declare_between(spaces: list) -> list:
  """Bonds the organs of an mjData to each other that name each other in their configuration.

  Args:
    spaces: workspaces of the organs that there are so far, the one that has come last

  Returns:
    those whose graphs have to be recorded anew
  """
  changed = []
  for w, other, row in flexes.named(spaces, lambda c: [(b.to, b) for b in c.bonds or ()]):
    w.bonds.put(to_organ(w, other, row.law, row.near, row.vertices, now=False))
    changed += [w, other]
  return changed


def to_body(
  w: "Workspace", body: int, name: str, law: Law, near: float, vertices, now: bool = True
) -> Group:
  """Returns bonds from vertices to the points of a body where they are, now or at rest.

  Args:
    w: the workspace of the organ
    body: the body
    name: what messages call it
    law: how they hold and break
    near: distance from its geoms within which vertices are bonded [m], or 0 for those in `vertices`
    vertices: numbers of vertices
    now: whether the points are where the vertices are now; else both are in their rest position

  Raises:
    ValueError: vertices or stiffness are not allowed, or none is near.
  """
  m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
  turn, origin = flexes.body_frame(m, body)
  if now:
    turn = mjstruct.view(d.xmat, (m.nbody, 3, 3))[body]
    origin = mjstruct.view(d.xpos, (m.nbody, 3))[body]
  vert = _free(w) if near else declare_attachments.check_vertices(w, vertices)
  local = (_places(w, vert, now) - origin) @ turn
  if near:
    close = _far_from_geoms(m, body, local) <= near
    vert, local = vert[close], local[close]
    normal = _up(m, body, local, 0.1 * near)
  else:  # away from the bed is into the organ
    normal = -_normals(w, now)[vert] @ turn * w.organ.mesh.closed
  area = _areas(w, vert, name, near)
  most = declare_attachments.most(w, m, body)
  if law.stiffness * area.sum() > most:
    raise ValueError(
      f"organ {w.organ.name!r}: bonds to {name!r} have a stiffness of "
      f"{law.stiffness * area.sum():.3g} N/m together, expected at most {most:.3g} N/m for a body "
      "that is so light in a step of that length"
    )
  made = {"area": area, "anchor": local, "normal": normal}
  made["turn"] = np.tile(turn.T @ w.organ.frame, (len(vert), 1, 1))
  return _group(w, vert, made, law, body, not now)


def to_organ(w: "Workspace", other, law: Law, near: float, vertices, now: bool = True) -> Group:
  """Returns bonds from vertices to the nearest points of another organ; arguments as `to_body`."""
  name, mesh = other.organ.name, other.organ.mesh
  if other is w:
    raise ValueError(f"organ {name!r}: bonds name itself, expected a body or another organ")
  vert = _free(w) if near else declare_attachments.check_vertices(w, vertices)
  theirs = _places(other, np.arange(mesh.nouter), now)
  elem, weight, far = _on_triangles(_places(w, vert, now), theirs[mesh.elem])
  if near:
    vert, elem, weight = (each[far <= near] for each in (vert, elem, weight))
  area = _areas(w, vert, name, near)
  corner = mesh.elem[elem]
  x = theirs[corner]
  axes = transfer.axes(x)
  gap = _places(w, vert, now) - np.einsum("nc,ncd->nd", weight, x)
  side = np.ones(len(vert))
  if not mesh.closed:
    facing = -np.einsum("nd,nd->n", _normals(w, now)[vert], axes[:, 2])
    side = np.sign(facing) if w.organ.mesh.closed else np.zeros(len(vert))
  made = {"area": area, "anchor": np.einsum("nad,nd->na", axes, gap)}
  made |= {"normal": side[:, None] * [0.0, 0.0, 1.0], "turn": axes @ w.organ.frame}
  return _group(w, vert, made, law, ON_ORGAN, not now, other, Spots(mesh, elem, weight))


def _group(
  w: "Workspace", vert, made, law, body: int, declared: bool, other=None, spots=None
) -> Group:
  bonded = [g.now.vert for g in w.bonds.groups]
  twice = np.intersect1d(vert, np.concatenate(bonded)) if bonded else vert[:0]
  if twice.size:
    raise ValueError(
      f"organ {w.organ.name!r}: vertex {twice[0]} is bonded already, expected one bond a vertex"
    )
  return Group(w, Grip(w.organ.mesh, vert), made, law, body, other, spots, declared)


def _free(w: "Workspace") -> np.ndarray:
  return np.flatnonzero(w.organ.free[: w.organ.mesh.nouter])


def _places(w: "Workspace", vert: np.ndarray, now: bool) -> np.ndarray:
  return motion(w, vert)[0] if now else declare_attachments.at_rest(w, vert)


def _areas(w: "Workspace", vert: np.ndarray, name: str, near: float) -> np.ndarray:
  """Returns the area of each vertex [m^2], (n,)."""
  if not len(vert):
    raise ValueError(
      f"organ {w.organ.name!r}: bonds find no free vertex within {near:g} m of {name!r}, expected "
      "some"
    )
  mesh = w.organ.mesh
  return topology.vertex_areas(mesh.rest, mesh.elem)[vert]


def _normals(w: "Workspace", now: bool) -> np.ndarray:
  """Returns the unit normals of an organ's vertices in the world, (nouter, 3)."""
  mesh = w.organ.mesh
  x = _places(w, np.arange(mesh.nouter), now)
  out = np.zeros((mesh.nouter, 3))
  np.add.at(out, mesh.elem, topology.area_vectors(x, mesh.elem)[:, None])
  return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)


def _far_from_geoms(m, body: int, points: np.ndarray) -> np.ndarray:
  """Returns the distance of points to a body's geoms, in its frame [m], (n,)."""
  geoms = np.flatnonzero(mjstruct.view(m.geom_bodyid, m.ngeom, np.int32) == body)
  geom = np.zeros((len(geoms), len(GEOM)))
  box = mjstruct.view(m.geom_aabb, (m.ngeom, 2, 3))[geoms]
  quat = mjstruct.view(m.geom_quat, (m.ngeom, 4))[geoms]
  for name, values in (
    ("pos", mjstruct.view(m.geom_pos, (m.ngeom, 3))[geoms]),
    ("axis", np.array([flexes.matrix(q).T.ravel() for q in quat]).reshape(-1, 9)),
    ("type", mjstruct.view(m.geom_type, m.ngeom, np.int32)[geoms, None]),
    ("size", mjstruct.view(m.geom_size, (m.ngeom, 3))[geoms]),
    ("box", box[:, 0]),
    ("half", box[:, 1]),
    ("bound2", np.full((len(geoms), 1), np.inf)),
  ):
    first = getattr(GEOM, name)
    geom[:, first : first + values.shape[1]] = values
  return _search(_measure_geoms, points, geom, np.zeros((0, 3, 3))).far.numpy()


def _up(m, body: int, points: np.ndarray, step: float) -> np.ndarray:
  """Returns the directions in which points get away from a body's geoms, in its frame, (n, 3)."""
  moved = points[:, None, None] + step * np.eye(3)[:, None] * np.array([[1.0], [-1.0]])
  far = _far_from_geoms(m, body, moved.reshape(-1, 3)).reshape(-1, 3, 2)
  out = far[..., 0] - far[..., 1]
  return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)


def _on_triangles(points: np.ndarray, corner: np.ndarray) -> tuple[np.ndarray, ...]:
  """Returns the triangle nearest to each point, the weights of its corners, and the distance."""
  found = _search(_measure_triangles, points, np.zeros((0, len(GEOM))), corner)
  return found.elem.numpy(), found.weight.numpy(), found.far.numpy()


def _search(kernel, points: np.ndarray, geom: np.ndarray, corner: np.ndarray):
  n = len(points)
  sizes = {"npoint": n, "ngeom": len(geom), "nelem": len(corner)}
  found = {"far": np.zeros(n), "elem": np.zeros(n), "weight": np.zeros((n, 3))}
  inputs = {"point": points, "geom": geom, "corner": corner}
  search = fill(Search, "cpu", sizes | inputs | found)
  kernel.load(wp.get_device("cpu"))
  kernel.launch("cpu", 1, 1, 0, search)
  return search
