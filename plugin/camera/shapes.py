"""Triangles of what MuJoCo draws: geoms and sites of every shape, as its renderer divides them."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
from palpate.tissue.geometry.mesh import vertex_normals

_GEOM = mujoco.mjtGeom
_ROUND = 0.8  # a mesh is drawn with an edge where normals meet at a smaller cosine than this


@dataclasses.dataclass(frozen=True)
class Triangles:
  """A surface; corners are seen counter-clockwise from outside.

  Attributes:
    vert: vertices [m]                                    (nvert, 3)
    face: their corners                                   (nface, 3)
    normal: outward unit normals at the corners           (nface, 3, 3)
    coord: places on a 2D texture at the corners, or directions to a cube's   (nface, 3, 3)
  """

  vert: np.ndarray
  face: np.ndarray
  normal: np.ndarray
  coord: np.ndarray

  def moved(self, pos: np.ndarray, mat: np.ndarray) -> Triangles:
    """Returns the surface at a place, turned by a matrix (3, 3)."""
    return dataclasses.replace(
      self, vert=pos + self.vert @ mat.T, normal=self.normal @ mat.T
    )


def joined(parts: list[Triangles]) -> Triangles:
  """Returns surfaces as one."""
  first = np.cumsum([0, *(len(each.vert) for each in parts)])
  face = [each.face + k for each, k in zip(parts, first, strict=False)]
  return Triangles(
    np.concatenate([each.vert for each in parts]),
    np.concatenate(face),
    np.concatenate([each.normal for each in parts]),
    np.concatenate([each.coord for each in parts]),
  )


def primitive(model: mujoco.MjModel, kind: int, size: np.ndarray) -> Triangles:
  """Returns a primitive shape of a size as `geom_size` has it [m], textured where it is 2D."""
  nslice, nstack = model.vis.quality.numslices, model.vis.quality.numstacks
  if kind == _GEOM.mjGEOM_PLANE:
    return _plane(size, 1.05 * float(model.vis.map.zfar * model.stat.extent))
  if kind == _GEOM.mjGEOM_BOX:
    return _box(size)
  rise = np.linspace(-np.pi / 2, np.pi / 2, nstack + 1)
  ball = np.stack([np.cos(rise), np.sin(rise)], axis=1)
  if kind == _GEOM.mjGEOM_SPHERE:
    return _revolve([(size[0] * ball, ball, 0.5 - rise / np.pi)], nslice)
  if kind == _GEOM.mjGEOM_ELLIPSOID:
    unit = _revolve([(ball, ball, 0.5 - rise / np.pi)], nslice)
    normal = unit.normal / size
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    return dataclasses.replace(unit, vert=unit.vert * size, normal=normal)
  radius, half = size[:2]
  side = np.array([[radius, -half], [radius, half]])
  out = np.array([[1.0, 0.0], [1.0, 0.0]])
  strips: list[tuple] = [(side, out, np.array([1.0, 0.0]))]
  if kind == _GEOM.mjGEOM_CAPSULE:
    middle = nstack // 2
    for cap, end in ((ball[: middle + 1], -half), (ball[middle:], half)):
      v = np.abs(np.linspace(-1, 1, len(cap)) if end < 0 else np.linspace(1, 0, len(cap)))
      strips.append((radius * cap + [0.0, end], cap, v))
  elif kind == _GEOM.mjGEOM_CYLINDER:
    for end in (-half, half):
      disc = np.array([[0.0, end], [radius, end]])[:: -1 if end > 0 else 1]
      strips.append((disc, np.tile([0.0, np.sign(end)], (2, 1)), None))
  else:
    name = mujoco.mjtGeom(int(kind)).name.removeprefix("mjGEOM_").lower()
    raise ValueError(f"a camera of a batch does not draw shapes of type {name}")
  return _revolve(strips, nslice)


def mesh(model: mujoco.MjModel, k: int) -> Triangles:
  """Returns a mesh of the model; without texture coordinates these are x and y."""
  vert = _rows(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum, k).astype(float)
  face = _rows(model.mesh_face, model.mesh_faceadr, model.mesh_facenum, k)
  rows = slice(model.mesh_faceadr[k], model.mesh_faceadr[k] + model.mesh_facenum[k])
  at = model.mesh_facenormal[rows] + model.mesh_normaladr[k]
  normal = model.mesh_normal[at].astype(float)
  if model.mesh_texcoordadr[k] >= 0:
    at = model.mesh_facetexcoord[rows] + model.mesh_texcoordadr[k]
    coord = np.concatenate([model.mesh_texcoord[at], np.zeros((*face.shape, 1))], axis=2)
    return Triangles(vert, face, normal, coord)
  flat = _normals(vert, face)[:, None]
  normal = np.where((normal * flat).sum(2, keepdims=True) < _ROUND, flat, normal)
  return Triangles(vert, face, normal, vert[face])


def smooth(vert: np.ndarray, face: np.ndarray, texcoord: np.ndarray | None) -> Triangles:
  """Returns a surface with the normals of its vertices; texture coordinates (nvert, 2)."""
  coord = np.zeros((*face.shape, 3))
  if texcoord is not None:
    coord[..., :2] = texcoord[face]
  return Triangles(vert, face, vertex_normals(vert, face)[face], coord)


def _rows(values: np.ndarray, adr: np.ndarray, num: np.ndarray, k: int) -> np.ndarray:
  return values[adr[k] : adr[k] + num[k]]


def _normals(vert: np.ndarray, face: np.ndarray) -> np.ndarray:
  a, b, c = np.moveaxis(vert[face], 1, 0)
  normal = np.cross(b - a, c - a)
  return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)


def _revolve(strips, nslice: int) -> Triangles:
  """Returns strips turned around z: of each rows of radius and z, of normals, and of v or None."""
  angle = np.linspace(0, 2 * np.pi, nslice + 1)
  way = np.stack([np.cos(angle), np.sin(angle)], axis=1)
  parts = []
  for place, normal, v in strips:
    vert, normal = (
      np.concatenate(
        [rows[:, None, :1] * way, np.broadcast_to(rows[:, None, 1:], (len(rows), len(way), 1))], 2
      )
      for rows in (place, normal)
    )
    coord = np.zeros_like(vert)
    if v is None:
      coord[..., :2] = 0.5 + 0.5 * vert[..., :2] / place[:, 0].max()
    else:
      coord[..., 0], coord[..., 1] = angle / (2 * np.pi), v[:, None]
    face = _lattice(*vert.shape[:2])
    vert = vert.reshape(-1, 3)
    a, b, c = np.moveaxis(vert[face], 1, 0)
    face = face[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9 * np.ptp(vert) ** 2]
    parts.append(
      Triangles(vert, face, normal.reshape(-1, 3)[face], coord.reshape(-1, 3)[face])
    )
  return joined(parts)


def _lattice(rows: int, columns: int) -> np.ndarray:
  """Returns the triangles of a grid, whose columns go around the rows' axis."""
  i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
  a = (i * columns + j).ravel()
  b, c, d = a + 1, a + columns + 1, a + columns
  return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _quad(corners: np.ndarray, coord: np.ndarray) -> Triangles:
  """Returns a rectangle of corners (4, 3), counter-clockwise, with texture coordinates (4, 2)."""
  face = np.array([[0, 1, 2], [0, 2, 3]])
  normal = np.tile(_normals(corners, face)[:, None], (1, 3, 1))
  return Triangles(corners, face, normal, np.pad(coord, ((0, 0), (0, 1)))[face])


def _plane(size: np.ndarray, far: float) -> Triangles:
  unit = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
  endless = size[:2] <= 0
  corners = np.where(endless, far, size[:2]) * unit
  coord = np.where(endless, 0.5 * corners, (1 + unit) / 2)
  coord[:, 1] = np.where(endless[1], -coord[:, 1], 1 - coord[:, 1])
  return _quad(np.pad(corners, ((0, 0), (0, 1))), coord)


def _box(size: np.ndarray) -> Triangles:
  unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
  sides = []
  for across, (a, b) in ((2, (0, 1)), (0, (1, 2)), (1, (0, 2))):
    for sign in (1.0, -1.0):
      corners = np.zeros((4, 3))
      corners[:, across], corners[:, [a, b]] = sign, 2 * unit - 1
      turned = (sign > 0) != (across == 1)
      order = np.arange(4) if turned else np.arange(4)[::-1]
      coord = np.stack([unit[:, 0], 1 - unit[:, 1]], axis=1)
      sides.append(_quad((corners * size)[order], coord[order].astype(float)))
  return joined(sides)
