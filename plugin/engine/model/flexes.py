"""What flexes of a compiled mjModel are: names, vertices, triangles, places, and what they meet."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import mujoco
import numpy as np

from . import mjstruct


def name(m, flex: int) -> str:
  """Returns the name of a flex, or what to call it."""
  return mjstruct.name_of(m, "flex", flex) or f"flex {flex}"


def names(m, kind: str = "flex") -> list[str]:
  """Returns the names of all flexes, bodies, geoms, skins or actuators."""
  if kind == "flex":
    return [name(m, flex) for flex in range(m.nflex)]
  count = m.nu if kind == "actuator" else getattr(m, f"n{kind}")
  return [mjstruct.name_of(m, kind, k) for k in range(count)]


def meeting_geoms(m, flex: int) -> np.ndarray:
  """Returns the geoms that collide with a flex."""
  mine, meets = m.flex_contype[flex], m.flex_conaffinity[flex]
  return np.flatnonzero((m.geom_contype & meets) | (m.geom_conaffinity & mine))


def rest_points(m, flex: int) -> np.ndarray:
  """Returns where the vertices of a flex are in the world in qpos0 [m], (n, 3)."""
  start, count = int(m.flex_vertadr[flex]), vertices(m, flex)
  body = m.flex_vertbodyid[start : start + count]
  if m.flex_rigid[flex]:
    body = np.full(count, body[0])  # the first one tells it while an organ is hidden
  point = m.flex_vert[start : start + count].copy()
  for each in np.unique(body):
    rotation, position = body_frame(m, int(each))
    point[body == each] = point[body == each] @ rotation.T + position
  return point


def vertices(m, flex: int) -> int:
  """Returns the number of a flex's vertices; MuJoCo's own is 0 while an organ is hidden."""
  return _extent(m.flex_vertadr, m.nflexvert, flex)


def _extent(adr: np.ndarray, total: int, flex: int) -> int:
  return int((adr[flex + 1] if flex + 1 < len(adr) else total) - adr[flex])


def elements(m, flex: int) -> np.ndarray:
  """Returns the triangles of a flex, (nelem, 3)."""
  return element_data(m, flex).copy()


def element_data(m, flex: int, corners: int = 3) -> np.ndarray:
  """Returns MuJoCo's own memory of the triangles of a flex, or edges, (nelem, corners)."""
  adr = int(m.flex_elemdataadr[flex])
  num = _extent(m.flex_elemadr, m.nflexelem, flex)
  return m.flex_elem[adr : adr + corners * num].reshape(num, corners)


def rim_data(m, flex: int, count: int) -> np.ndarray:
  """Returns MuJoCo's own memory of the edges at the boundary of a flex, drawn as sides, (n, 2)."""
  adr = int(m.flex_shelldataadr[flex]) if count else 0
  return m.flex_shell[adr : adr + 2 * count].reshape(-1, 2)


def marks(m, flex: int) -> np.ndarray:
  """Returns two numbers of a flex, copied and saved with it, that a step does not use; see `cuts`.

  They are inverse weights of edges that no equality holds. mj_setConst makes them anew.
  """
  edge = int(m.flex_edgeadr[flex])
  return m.flexedge_invweight0[edge : edge + 2]


def compiled_elements(m, flex: int) -> np.ndarray:
  """Returns the triangles that a flex was compiled with, (nelem, 3).

  Cuts leave MuJoCo's edges alone. Those of a triangle are its sides from corner 1 to 2, 2 to 0 and
  0 to 1.
  """
  adr = int(m.flex_elemedgeadr[flex])
  num = _extent(m.flex_elemadr, m.nflexelem, flex)
  side = m.flex_elemedge[adr : adr + 3 * num]
  ends = m.flex_edge[int(m.flex_edgeadr[flex]) :][side.reshape(num, 3)]
  here, there = ends[:, [1, 2, 0]], ends[:, [2, 0, 1]]  # the sides that meet at each corner
  shared = (here[..., :1] == there).any(axis=-1)
  return np.ascontiguousarray(np.where(shared, here[..., 0], here[..., 1]))


def body_frame(m, body: int) -> tuple[np.ndarray, np.ndarray]:
  """Returns rotation and position of a body in qpos0."""
  rotation, position = np.eye(3), np.zeros(3)
  parentid, quat, pos = m.body_parentid, m.body_quat, m.body_pos
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
