"""What an organ is bonded to, by its declaration or from Python; see `cohesive_bonds`."""

from typing import Any

import numpy as np
import warp as wp
from palpate.tissue.geometry import mesh as topology
from palpate.tissue.kernels import Kernel
from palpate.tissue.reading import BondRow, Law
from palpate.tissue.types import doubles, fill, ints, struct

from ..engine import coupling
from ..engine.host import Host
from ..engine.layout import GEOM
from ..engine.model import flexes, mjstruct
from . import transfer
from .cohesive_bonds import ON_ORGAN, Bonds, Group
from .declare_attachments import check_vertices, most
from .transfer import Grip, Spots


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


def declare(bonds: Bonds, host: Host):
  """Bonds an organ to the bodies that its configuration names.

  Raises:
    ValueError: it names a body that does not exist, or no vertex is near one.
  """
  m, organ = host.m, host.organ.name
  for row in host.config.bonds or ():
    if flexes.find(m, "flex", row.to, organ) < 0:
      body = flexes.need(m, "body", row.to, organ, "bonds")
      bonds.put(to_body(host, body, row.to, row.law, row.near, row.vertices, now=False))


def declare_between(one: Bonds, other: Bonds, row: BondRow):
  """Bonds an organ to another that it names, by a row of its key `bonds`."""
  one.put(to_organ(one, other, row.law, row.near, row.vertices, now=False))


def to_body(
  host: Host, body: int, name: str, law: Law, near: float, vertices: Any, now: bool = True
) -> Group:
  """Returns bonds from vertices to the points of a body where they are, now or at rest.

  Args:
    host: the organ
    body: the body
    name: what messages call it
    law: how they hold and break
    near: distance from its geoms within which vertices are bonded [m], or 0 for those in `vertices`
    vertices: numbers of vertices
    now: whether the points are where the vertices are now; else both are in their rest position

  Raises:
    ValueError: vertices or stiffness are not allowed, or none is near.
  """
  m = host.m
  turn, origin = host.body_frame(body) if now else flexes.body_frame(m, body)
  vert = _free(host) if near else check_vertices(host, vertices)
  local = (host.places(vert, now) - origin) @ turn
  if near:
    close = _far_from_geoms(m, body, local) <= near
    vert, local = vert[close], local[close]
    normal = _up(m, body, local, 0.1 * near)
  else:  # away from the bed is into the organ
    normal = -_normals(host, now)[vert] @ turn * host.organ.mesh.closed
  area, limit = _areas(host, vert, name, near), most(host, body)
  if law.stiffness * area.sum() > limit:
    raise ValueError(
      f"organ {host.organ.name!r}: bonds to {name!r} have a stiffness of "
      f"{law.stiffness * area.sum():.3g} N/m together, expected at most {limit:.3g} N/m for a body "
      "this light and this time step"
    )
  made = {"area": area, "anchor": local, "normal": normal}
  made["turn"] = np.tile(turn.T @ host.organ.frame, (len(vert), 1, 1))
  return Group(Grip(host.organ.mesh, vert), made, law, body, None, None, not now)


def to_organ(
  one: Bonds, other: Bonds, law: Law, near: float, vertices: Any, now: bool = True
) -> Group:
  """Returns bonds from vertices to the nearest points of another organ; arguments as `to_body`."""
  host, there = one.host, other.host
  assert isinstance(host, Host) and isinstance(there, Host)
  name, mesh = there.organ.name, there.organ.mesh
  if other is one:
    raise ValueError(f"organ {name!r}: bonds name it too, expected a body or another organ")
  vert = _free(host) if near else check_vertices(host, vertices)
  theirs = there.places(np.arange(mesh.nouter), now)
  corner, no_geoms = theirs[mesh.elem], np.zeros((0, len(GEOM)))
  found = _search(_measure_triangles, host.places(vert, now), no_geoms, corner)
  elem, weight, far = found.elem.numpy(), found.weight.numpy(), found.far.numpy()
  if near:
    vert, elem, weight = (each[far <= near] for each in (vert, elem, weight))
  area = _areas(host, vert, name, near)
  corner = mesh.elem[elem]
  x = theirs[corner]
  axes = transfer.axes(x)
  gap = host.places(vert, now) - np.einsum("nc,ncd->nd", weight, x)
  side = np.ones(len(vert))
  if not mesh.closed:
    facing = -np.einsum("nd,nd->n", _normals(host, now)[vert], axes[:, 2])
    side = np.sign(facing) if host.organ.mesh.closed else np.zeros(len(vert))
  made = {"area": area, "anchor": np.einsum("nad,nd->na", axes, gap)}
  made |= {"normal": side[:, None] * [0.0, 0.0, 1.0], "turn": axes @ host.organ.frame}
  spots = Spots(mesh, elem, weight)
  return Group(Grip(host.organ.mesh, vert), made, law, ON_ORGAN, other, spots, not now)


def _free(host: Host) -> np.ndarray:
  return np.flatnonzero(host.organ.free[: host.organ.mesh.nouter])


def _areas(host: Host, vert: np.ndarray, name: str, near: float) -> np.ndarray:
  """Returns the area of each vertex [m^2], (n,)."""
  if not len(vert):
    raise ValueError(
      f"organ {host.organ.name!r}: bonds find no free vertex within {near:g} m of {name!r}, "
      "expected some"
    )
  mesh = host.organ.mesh
  return topology.vertex_areas(mesh.rest, mesh.elem)[vert]


def _normals(host: Host, now: bool) -> np.ndarray:
  """Returns the unit normals of an organ's vertices in the world, (nouter, 3)."""
  mesh = host.organ.mesh
  return topology.vertex_normals(host.places(np.arange(mesh.nouter), now), mesh.elem)


def _far_from_geoms(m: mjstruct.Struct, body: int, points: np.ndarray) -> np.ndarray:
  """Returns the distance of points to a body's geoms, in its frame [m], (n,)."""
  geoms = np.flatnonzero(m.geom_bodyid == body)
  geom = np.zeros((len(geoms), len(GEOM)))
  box = m.geom_aabb.reshape(-1, 2, 3)[geoms]
  quat = m.geom_quat[geoms]
  for name, values in (
    ("pos", m.geom_pos[geoms]),
    ("axis", np.array([flexes.matrix(q).T.ravel() for q in quat]).reshape(-1, 9)),
    ("type", m.geom_type[geoms, None]),
    ("size", m.geom_size[geoms]),
    ("box", box[:, 0]),
    ("half", box[:, 1]),
    ("bound2", np.full((len(geoms), 1), np.inf)),
  ):
    first = getattr(GEOM, name)
    geom[:, first : first + values.shape[1]] = values
  return _search(_measure_geoms, points, geom, np.zeros((0, 3, 3))).far.numpy()


def _up(m: mjstruct.Struct, body: int, points: np.ndarray, step: float) -> np.ndarray:
  """Returns the directions in which points get away from a body's geoms, in its frame, (n, 3)."""
  moved = points[:, None, None] + step * np.eye(3)[:, None] * np.array([[1.0], [-1.0]])
  far = _far_from_geoms(m, body, moved.reshape(-1, 3)).reshape(-1, 3, 2)
  out = far[..., 0] - far[..., 1]
  return out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-300)


def _search(kernel: Kernel, points: np.ndarray, geom: np.ndarray, corner: np.ndarray):
  n = len(points)
  sizes = {"npoint": n, "ngeom": len(geom), "nelem": len(corner)}
  found = {"far": np.zeros(n), "elem": np.zeros(n), "weight": np.zeros((n, 3))}
  inputs = {"point": points, "geom": geom, "corner": corner}
  search = fill(Search, "cpu", sizes | inputs | found)
  kernel.load(wp.get_device("cpu"))
  kernel.launch("cpu", 1, 1, 0, search)
  return search
