"""What flexes of a compiled mjModel are: names, vertices, triangles, places, and what they meet."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from . import mjstruct


def name(m, flex: int) -> str:
  """Returns the name of a flex, or what to call it."""
  return mjstruct.name_of(m, m.name_flexadr, flex) or f"flex {flex}"


def names(m, kind: str = "flex") -> list[str]:
  """Returns the names of all flexes, bodies, geoms, skins or actuators."""
  if kind == "flex":
    return [name(m, flex) for flex in range(m.nflex)]
  count = m.nu if kind == "actuator" else getattr(m, f"n{kind}")
  return [mjstruct.name_of(m, getattr(m, f"name_{kind}adr"), k) for k in range(count)]


def meeting_geoms(m, flex: int) -> np.ndarray:
  """Returns the geoms that collide with a flex."""
  contype = mjstruct.view(m.geom_contype, m.ngeom, np.int32)
  conaffinity = mjstruct.view(m.geom_conaffinity, m.ngeom, np.int32)
  mine = mjstruct.view(m.flex_contype, m.nflex, np.int32)[flex]
  meets = mjstruct.view(m.flex_conaffinity, m.nflex, np.int32)[flex]
  return np.flatnonzero((contype & meets) | (conaffinity & mine))


def rest_points(m, flex: int) -> np.ndarray:
  """Returns where the vertices of a flex are in the world in qpos0 [m], (n, 3)."""
  start, count = int(mjstruct.view(m.flex_vertadr, m.nflex, np.int32)[flex]), vertices(m, flex)
  body = mjstruct.view(m.flex_vertbodyid, m.nflexvert, np.int32)[start : start + count]
  if mjstruct.view(m.flex_rigid, m.nflex, np.bool_)[flex]:
    body = np.full(count, body[0])  # the first one tells it while an organ is hidden
  point = mjstruct.view(m.flex_vert, (m.nflexvert, 3))[start : start + count].copy()
  for each in np.unique(body):
    rotation, position = body_frame(m, int(each))
    point[body == each] = point[body == each] @ rotation.T + position
  return point


def vertices(m, flex: int) -> int:
  """Returns the number of a flex's vertices; MuJoCo's own is 0 while an organ is hidden."""
  return _extent(m.flex_vertadr, m.nflex, m.nflexvert, flex)


def _extent(addresses: int | None, nflex: int, total: int, flex: int) -> int:
  adr = mjstruct.view(addresses, nflex, np.int32)
  return int((adr[flex + 1] if flex + 1 < nflex else total) - adr[flex])


def elements(m, flex: int) -> np.ndarray:
  """Returns the triangles of a flex, (nelem, 3)."""
  return element_data(m, flex).copy()


def element_data(m, flex: int, corners: int = 3) -> np.ndarray:
  """Returns MuJoCo's own memory of the triangles of a flex, or edges, (nelem, corners)."""
  adr = int(mjstruct.view(m.flex_elemdataadr, m.nflex, np.int32)[flex])
  num = _extent(m.flex_elemadr, m.nflex, m.nflexelem, flex)
  elem = mjstruct.view(m.flex_elem, m.nflexelemdata, np.int32)
  return elem[adr : adr + corners * num].reshape(num, corners)


def rim_data(m, flex: int, count: int) -> np.ndarray:
  """Returns MuJoCo's own memory of the edges at the boundary of a flex, drawn as sides, (n, 2)."""
  adr = int(mjstruct.view(m.flex_shelldataadr, m.nflex, np.int32)[flex]) if count else 0
  shell = mjstruct.view(m.flex_shell, m.nflexshelldata, np.int32)
  return shell[adr : adr + 2 * count].reshape(-1, 2)


def marks(m, flex: int) -> np.ndarray:
  """Returns two numbers of a flex, copied and saved with it, that a step does not use; see `cuts`.

  They are inverse weights of edges that no equality holds. mj_setConst makes them anew.
  """
  edge = int(mjstruct.view(m.flex_edgeadr, m.nflex, np.int32)[flex])
  return mjstruct.view(m.flexedge_invweight0, m.nflexedge)[edge : edge + 2]


def compiled_elements(m, flex: int) -> np.ndarray:
  """Returns the triangles that a flex was compiled with, (nelem, 3).

  Cuts leave MuJoCo's edges alone. Those of a triangle are its sides from corner 1 to 2, 2 to 0 and
  0 to 1.
  """
  adr = int(mjstruct.view(m.flex_elemedgeadr, m.nflex, np.int32)[flex])
  num = _extent(m.flex_elemadr, m.nflex, m.nflexelem, flex)
  first = int(mjstruct.view(m.flex_edgeadr, m.nflex, np.int32)[flex])
  edge = mjstruct.view(m.flex_edge, (m.nflexedge, 2), np.int32)[first:]
  side = mjstruct.view(m.flex_elemedge, m.nflexelemedge, np.int32)[adr : adr + 3 * num]
  ends = edge[side.reshape(num, 3)]
  here, there = ends[:, [1, 2, 0]], ends[:, [2, 0, 1]]  # the sides that meet at each corner
  shared = (here[..., :1] == there).any(axis=-1)
  return np.ascontiguousarray(np.where(shared, here[..., 0], here[..., 1]))


def body_frame(m, body: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns rotation and position of a body in qpos0."""
  rotation, position = np.eye(3), np.zeros(3)
  parentid = mjstruct.view(m.body_parentid, m.nbody, np.int32)
  quat = mjstruct.view(m.body_quat, (m.nbody, 4))
  pos = mjstruct.view(m.body_pos, (m.nbody, 3))
  while body > 0:
    own = matrix(quat[body])
    rotation, position = own @ rotation, pos[body] + own @ position
    body = int(parentid[body])
  return rotation, position


def matrix(quat: np.ndarray) -> np.ndarray:
  """Returns the rotation of a quaternion, (3, 3)."""
  out = np.zeros(9)
  mujoco.mju_quat2Mat(out, np.array(quat, float))
  return out.reshape(3, 3)


def resolve(name: str, organ: str, names: list[str]) -> str | None:
  """Returns the name that an organ's configuration means, or None.

  `<attach prefix="...">` renames flexes and bodies and leaves configurations alone: the longest
  prefix that the organ has too counts.
  """
  prefixes = [other[: len(other) - len(name)] for other in names if other.endswith(name)]
  prefixes = [prefix for prefix in prefixes if organ.startswith(prefix)]
  return max(prefixes, key=len) + name if prefixes else None


def find(m, kind: str, name: str, organ: str) -> int:
  """Returns the index of what an organ's configuration names, -1 if there is none."""
  have = names(m, kind)
  found = resolve(name, organ, have)
  return -1 if found is None else have.index(found)


def need(m, kind: str, name: str, organ: str, key: str) -> int:
  """Returns the index of what a key of an organ's configuration names; ValueError if none."""
  found = find(m, kind, name, organ)
  if found < 0:
    raise ValueError(f"organ {organ!r}: {key} names {name!r}, which is no {kind} of the model")
  return found


def named(
  spaces: list, rows: Callable[[Any], Iterable[tuple[str, Any]]]
) -> Iterator[tuple[Any, Any, Any]]:
  """Yields where the configuration of an organ names an organ of the same mjData, maybe itself.

  Args:
    spaces: workspaces of the organs that there are so far; where the last one has no part is left
      out, since that was found before
    rows: returns the names in a configuration, each with what it says of them

  Yields:
    the workspace of the one, that of the other, and what is said
  """
  known = {w.organ.name: w for w in spaces}
  for w in spaces:
    for name, row in rows(w.config):
      other = known.get(resolve(name, w.organ.name, list(known)) or "")
      if other is not None and spaces[-1] in (w, other):
        yield w, other, row
