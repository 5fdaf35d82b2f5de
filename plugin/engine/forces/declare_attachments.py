"""What an organ is tied to, by its declaration or from Python, and how firm; see `attachments`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from palpate.tissue.config import OWN
from palpate.tissue.geometry import mesh as topology
from scipy.spatial import KDTree

from ..model import flexes, inertia, mjstruct
from . import supports
from .attachments import TO_OWN_MOTION, TO_POINT, Group, is_mocap, motion
from .transfer import Grip

if TYPE_CHECKING:
  from ..workspace import Workspace

# Times the mass of a vertex that its spring weighs in a step, where nothing else is said: it then
# follows to a hundredth of the way.
_FIRM = 100.0
# Share of a body's inertia that its springs may weigh in a step: it feels them a step late.
_LIGHT = 0.5


def declare(w: Workspace):
  """Ties an organ to the bodies that its configuration names."""
  made = carried(w)
  supports.check(mjstruct.Model.from_address(w.model), w)
  m = mjstruct.Model.from_address(w.model)
  flex_names = [flexes.name(m, f) for f in range(m.nflex)]
  for name, stiffness, vertices in w.config.attach:
    if flexes.resolve(name, w.organ.name, flex_names) is None:
      body = find_body(w, m, "attach", name)
      made.append(to_body(w, check_vertices(w, vertices), body, stiffness, now=False))
  w.ties.put(made)


def declare_between(spaces: list) -> list:
  """Ties the organs of an mjData to each other that name each other in their configuration.

  Args:
    spaces: workspaces of the organs that there are so far, the one that has come last

  Returns:
    those whose graphs have to be recorded anew
  """
  changed = []
  for w, other, row in flexes.named(spaces, lambda c: [(a[0], a) for a in c.attach]):
    if other is w:
      continue
    _, stiffness, vertices = row
    pair = to_organ(w, check_vertices(w, vertices), other, stiffness, now=False)
    for space, group in zip((w, other), pair, strict=True):
      space.ties.put([*space.ties.groups, group])
      changed.append(space)
  return changed


def to_body(
  w: Workspace, vert: np.ndarray, body: int, stiffness: float | None, now: bool = True
) -> Group:
  """Returns springs from vertices to the points of a body where they are, now or at rest.

  Args:
    w: the workspace of the organ
    vert: vertices
    body: the body
    stiffness: of all springs together [N/m], None for as firm as a step allows
    now: whether the points are where the vertices are now; else both are in their rest position

  Raises:
    ValueError: vertices or stiffness are not allowed.
  """
  m, d = mjstruct.Model.from_address(w.model), mjstruct.Data.from_address(w.data)
  each = _stiffness(w, vert, stiffness, most(w, m, body))
  if now:
    at = motion(w, vert)[0]
    turn = mjstruct.view(d.xmat, (m.nbody, 3, 3))[body]
    origin = mjstruct.view(d.xpos, (m.nbody, 3))[body]
  else:
    at = at_rest(w, vert)
    turn, origin = flexes.body_frame(m, body)
  made = {"stiffness": each, "anchor": (at - origin) @ turn, "turn": turn.T @ w.organ.frame}
  return Group(w, Grip(w.organ.mesh, vert), body, made, by="" if now else "attach")


def to_organ(w: Workspace, vert: np.ndarray, other, stiffness: float | None, now: bool = True):
  """Returns springs between vertices of two organs, each to the nearest one: of both organs.

  They keep the distances that there are, now or at rest. Arguments as for `to_body`.
  """
  outer = np.flatnonzero(other.organ.free[: other.organ.mesh.nouter])
  place = (lambda space, which: motion(space, which)[0]) if now else at_rest
  mine, theirs = place(w, vert), place(other, outer)
  pair = outer[KDTree(theirs).query(mine)[1]]
  gap = mine - place(other, pair)
  each = _stiffness(w, vert, stiffness, np.inf)
  grips = Grip(w.organ.mesh, vert), Grip(other.organ.mesh, pair)
  ends = (w, grips[0], gap, other, grips[1]), (other, grips[1], -gap, w, grips[0])
  return tuple(
    Group(
      space, grip, TO_POINT, {"stiffness": each, "anchor": off, "turn": space.organ.frame}, to,
      theirs, "" if now else "attach",
    )
    for space, grip, off, to, theirs in ends
  )  # fmt: skip


def carried(w: Workspace) -> list[Group]:
  """Returns the foundation and the pins of an organ that has a carrier, tied to it."""
  name, organ = w.config.carrier, w.organ
  if not name:
    return []
  mesh = organ.mesh.whole
  area = topology.vertex_areas(mesh.rest, mesh.elem)
  m = mjstruct.Model.from_address(w.model)
  body = TO_OWN_MOTION if name == OWN else find_body(w, m, "carrier", name)
  pins = np.array(sorted(w.config.pin), int)
  stiffness = w.config.foundation * area
  stiffness[pins] = _firm(w)[pins]
  vert = np.flatnonzero(stiffness > 0)
  if not len(vert):
    return []
  anchor, axes = np.zeros((len(vert), 3)), np.zeros((3, 3))
  if body >= 0:
    turn, origin = flexes.body_frame(m, body)
    place = organ.origin + mesh.rest[vert] @ organ.frame.T
    anchor, axes = (place - origin) @ turn, turn.T @ organ.frame
  made = {"stiffness": stiffness[vert], "anchor": anchor, "turn": axes}
  return [Group(w, Grip(mesh, vert), body, made, by="carrier")]


def find_body(w: Workspace, m, key: str, name: str) -> int:
  """Returns the body that an organ's configuration names, by its own name or with its prefix."""
  names = [mjstruct.name_of(m, m.name_bodyadr, b) for b in range(m.nbody)]
  found = flexes.resolve(name, w.organ.name, names)
  if found is None:
    raise ValueError(f"organ {w.organ.name!r}: {key} names {name!r}, which does not exist")
  return names.index(found)


def check_vertices(w: Workspace, vertices) -> np.ndarray:
  """Returns vertices that springs may hold, each once.

  Raises:
    ValueError: one does not exist or is pinned, or there is none.
  """
  name, count = w.organ.name, w.organ.mesh.nouter
  vert = np.unique(np.asarray(vertices, dtype=float).ravel())
  bad = vert[(vert != np.floor(vert)) | (vert < 0) | (vert >= count)]
  if bad.size or not vert.size:
    what = f"{bad[0]:g}" if bad.size else "none"
    raise ValueError(f"organ {name!r}: vertices have {what}, expected in [0, {count})")
  vert = vert.astype(int)
  held = vert[~w.organ.free[vert]]
  if held.size:
    raise ValueError(f"organ {name!r}: vertex {held[0]} is pinned, expected free ones")
  return vert


def at_rest(w: Workspace, vert: np.ndarray) -> np.ndarray:
  """Returns where vertices are in the world at rest [m], (n, 3)."""
  return w.organ.origin + w.organ.mesh.rest[vert] @ w.organ.frame.T


def _gain(w: Workspace) -> float:
  """Returns h^2 + h damping [s^2]."""
  h = float(mjstruct.Model.from_address(w.model).opt.timestep)
  return h * (h + w.config.damping)


def _firm(w: Workspace) -> np.ndarray:
  """Returns the stiffness with which a spring weighs much more than its vertex [N/m], (nvert,)."""
  m = mjstruct.Model.from_address(w.model)
  return _FIRM * inertia.masses(m, w.organ) / _gain(w)


def most(w: Workspace, m, body: int) -> float:
  """Returns the most that springs to a body may have together [N/m]."""
  if is_mocap(m, body) or not mjstruct.view(m.body_weldid, m.nbody, np.int32)[body]:
    return np.inf
  weight = mjstruct.view(m.body_invweight0, (m.nbody, 2))[body, 0]
  return _LIGHT / (_gain(w) * max(weight, 1e-12))


def _stiffness(w: Workspace, vert: np.ndarray, stiffness: float | None, most: float) -> np.ndarray:
  """Returns the stiffness of each spring, by the area of its vertex [N/m], (n,)."""
  name = w.organ.name
  mesh = w.organ.mesh
  area = topology.vertex_areas(mesh.rest, mesh.elem)[vert]
  share = area / area.sum()
  if stiffness is None:
    return share * min(float(_firm(w)[vert].sum()), most)
  if not (np.isfinite(stiffness) and stiffness > 0):
    raise ValueError(f"organ {name!r}: stiffness is {stiffness}, expected a number > 0 [N/m]")
  if stiffness > most:
    raise ValueError(
      f"organ {name!r}: stiffness is {stiffness:g}, expected at most {most:.3g} N/m for a body that"
      " is so light in a step of that length"
    )
  return stiffness * share
