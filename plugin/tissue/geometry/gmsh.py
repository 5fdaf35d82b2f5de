"""Tetrahedra of an organ from a Gmsh file, in place of those that `fill` makes."""

import itertools
import os
from collections.abc import Iterator

import numpy as np
import scipy

from . import fill
from .mesh import Mesh

_CLOSE = 1e-5  # of the organ's size, within which a node of the file is a vertex
_TETRAHEDRON = 4  # Gmsh's number of that kind of element


def read(organ: str, file: str, mesh: Mesh) -> Mesh:
  """Returns a surface with the inside that a file says.

  Args:
    organ: name of the organ, for messages
    file: path of a Gmsh file as text, version 2 or 4.1, in metres and in the surface's frame
    mesh: the surface

  Raises:
    ValueError: the file cannot be read, or its tetrahedra do not fit the surface.
  """
  where = f"organ {organ!r}: tetrahedra is {file!r}"
  if os.path.exists(file) and not os.path.isfile(file):
    raise ValueError(f"{where}, which is no regular file, expected a Gmsh file")
  try:
    with open(file, encoding="ascii") as stream:
      point, tet = _parse(stream.read().split())
  except OSError as error:
    raise ValueError(f"{where}: {error.strerror}, expected a Gmsh file") from None
  except (ValueError, KeyError):
    raise ValueError(
      f"{where}, which cannot be read: expected a Gmsh file as text, version 2 or 4.1"
    ) from None
  if not len(tet):
    raise ValueError(f"{where}, which has no tetrahedra")
  return _fitted(where, mesh, point, tet)


def _parse(words: list[str]) -> tuple[np.ndarray, np.ndarray]:
  """Returns nodes (n, 3) and tetrahedra (m, 4) of the words of a file."""
  version, kind = words[words.index("$MeshFormat") + 1 :][:2]
  if kind != "0" or version not in ("2", "2.1", "2.2", "4.1"):
    raise ValueError
  parts = (iter(words[words.index(f"${part}") + 1 :]) for part in ("Nodes", "Elements"))
  names, point, tet = (_blocks if version == "4.1" else _lines)(*parts)
  number = {name: k for k, name in enumerate(names)}
  corner = [[number[name] for name in four] for four in tet]
  return np.array(point, float).reshape(-1, 3), np.array(corner, np.int64).reshape(-1, 4)


def _lines(nodes: Iterator[str], elements: Iterator[str]) -> tuple[list, list, list]:
  """Returns names and places of nodes, and names of tetrahedra's corners, of version 2."""
  rows = [_take(nodes, 4) for _ in range(int(*_take(nodes, 1)))]
  tet = []
  for _ in range(int(*_take(elements, 1))):
    _, kind, tags = map(int, _take(elements, 3))
    corners = _take(elements, tags + _CORNERS[kind])[tags:]
    tet += [corners] if kind == _TETRAHEDRON else []
  return [row[0] for row in rows], [row[1:] for row in rows], tet


def _blocks(nodes: Iterator[str], elements: Iterator[str]) -> tuple[list, list, list]:
  """Returns the same of version 4.1, where both come in blocks."""
  names, point, tet = [], [], []
  for _ in range(int(_take(nodes, 4)[0])):
    _, _, parametric, count = map(int, _take(nodes, 4))
    if parametric:  # with parameters behind the places
      raise ValueError
    names += _take(nodes, count)
    point += _take(nodes, 3 * count)
  for _ in range(int(_take(elements, 4)[0])):
    _, _, kind, count = map(int, _take(elements, 4))
    step = 1 + _CORNERS[kind]
    flat = _take(elements, step * count)
    if kind == _TETRAHEDRON:
      tet += [flat[k + 1 : k + step] for k in range(0, len(flat), step)]
  return names, point, tet


def _take(words: Iterator[str], count: int) -> list[str]:
  """Returns the next words; ValueError where there are fewer, so that no count is believed."""
  taken = list(itertools.islice(words, count))
  if len(taken) < count:
    raise ValueError
  return taken


# Corners of Gmsh's elements of first order: line, triangle, quadrangle, tetrahedron and so on; 15
# is a point.
_CORNERS = {1: 2, 2: 3, 3: 4, _TETRAHEDRON: 4, 5: 8, 6: 6, 7: 5, 15: 1}


def _fitted(where: str, mesh: Mesh, point: np.ndarray, tet: np.ndarray) -> Mesh:
  """Returns the surface with tetrahedra between nodes of a file, which must end at it."""
  if not np.isfinite(point).all():
    raise ValueError(f"{where}, which has nodes that are not finite")
  size = float(np.ptp(mesh.rest, axis=0).max())
  far, node = scipy.spatial.KDTree(point).query(mesh.rest)
  worst = int(np.argmax(far))
  if far[worst] > _CLOSE * size:
    raise ValueError(
      f"{where}, whose nearest node to vertex {worst} is {far[worst]:.3g} m away; expected a node "
      "at each vertex of the surface, in metres and in its frame"
    )
  # The surface's vertices first, then what else tetrahedra use.
  place = np.full(len(point), -1)
  place[node] = np.arange(mesh.nvert)
  others = np.setdiff1d(tet, node)
  place[others] = mesh.nvert + np.arange(len(others))
  if len(others) > fill.MOST * mesh.nvert:
    raise ValueError(
      f"{where}, which has {len(others)} nodes inside, expected at most {fill.MOST * mesh.nvert}"
    )
  tet, rest = place[tet], np.concatenate([mesh.rest, point[others]])
  turned = fill.volumes(rest, tet) < 0
  tet[turned] = tet[turned][:, [0, 2, 1, 3]]
  flat = np.flatnonzero(fill.quality(rest, tet) <= fill.FLAT)
  if flat.size:
    raise ValueError(f"{where}, whose tetrahedron {flat[0]} is flat")
  _check_faces(where, mesh, tet)
  return fill.joined(mesh, point[others], tet)


def _check_faces(where: str, mesh: Mesh, tet: np.ndarray):
  """Makes sure that tetrahedra end at the surface's triangles and nowhere else."""
  face = np.sort(tet[:, fill.FACES].reshape(-1, 3), axis=1)
  face, count = np.unique(face, axis=0, return_counts=True)
  ends = {tuple(each) for each in face[count == 1].tolist()}
  for k, corner in enumerate(np.sort(mesh.elem, axis=1).tolist()):
    if tuple(corner) not in ends:
      raise ValueError(
        f"{where}, where triangle {k} (vertices {mesh.elem[k].tolist()}) is the face of no "
        "tetrahedron or of two"
      )
  if len(ends) > mesh.nelem or (count > 2).any():
    raise ValueError(
      f"{where}, whose tetrahedra end at {len(ends)} faces, expected the {mesh.nelem} triangles"
    )
