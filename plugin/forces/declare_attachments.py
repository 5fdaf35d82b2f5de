"""What an organ is attached to, by its declaration or from Python, and how firmly."""

import numpy as np
import numpy.typing as npt
import scipy
from palpate.tissue.config import OWN
from palpate.tissue.geometry import mesh as topology

from ..engine.host import Host
from ..engine.model import flexes, inertia, mjstruct
from . import host as base
from .attachments import TO_OWN_MOTION, TO_POINT, Attachments, Group
from .transfer import Grip

# Times the mass of a vertex that its spring weighs in a step, where nothing else is said: it then
# follows to a hundredth of the way.
_FIRM = 100.0
# Share of a body's inertia that its springs may weigh in a step: it feels them a step late.
_LIGHT = 0.5


def declare(held: Attachments, host: Host):
  """Attaches an organ to the bodies that its configuration names."""
  made, m = carried(host), host.m
  for name, stiffness, vertices in host.config.attach:
    if flexes.find(m, "flex", name, host.organ.name) < 0:
      body = flexes.need(m, "body", name, host.organ.name, "attach")
      made.append(to_body(host, check_vertices(host, vertices), body, stiffness, now=False))
  held.put(made)


def declare_between(one: Attachments, other: Attachments, row: tuple[str, float, tuple[int, ...]]):
  """Attaches organs to each other of which one names the other, by a row of its key `attach`."""
  if other is not one:
    _, stiffness, vertices = row
    for held, group in zip((one, other), to_organ(one, other, vertices, stiffness), strict=True):
      held.put([*held.groups, group])


def to_body(
  host: Host, vert: np.ndarray, body: int, stiffness: float | None, now: bool = True
) -> Group:
  """Returns springs from vertices to the points of a body where they are, now or at rest.

  Args:
    host: the organ
    vert: vertices
    body: the body
    stiffness: of all springs together [N/m], None for as firm as a step allows
    now: whether the points are where the vertices are now; else both are in their rest position

  Raises:
    ValueError: vertices or stiffness are not allowed.
  """
  each = _stiffness(host, vert, stiffness, most(host, body))
  at = host.places(vert, now)
  turn, origin = host.body_frame(body) if now else flexes.body_frame(host.m, body)
  made = {"stiffness": each, "anchor": (at - origin) @ turn, "turn": turn.T @ host.organ.frame}
  return Group(Grip(host.organ.mesh, vert), body, made, by="" if now else "attach")


def to_organ(
  one: Attachments, other: Attachments, vertices: npt.ArrayLike, stiffness: float | None,
  now: bool = False,
) -> tuple[Group, Group]:  # fmt: skip
  """Returns springs between vertices of two organs, each to the nearest one: of both organs.

  They keep the distances that there are, now or at rest. Arguments as for `to_body`.
  """
  hosts = one.host, other.host
  assert isinstance(hosts[0], Host) and isinstance(hosts[1], Host)
  vert = check_vertices(hosts[0], vertices)
  outer = np.flatnonzero(hosts[1].organ.free[: hosts[1].organ.mesh.nouter])
  mine, theirs = hosts[0].places(vert, now), hosts[1].places(outer, now)
  pair = outer[scipy.spatial.KDTree(theirs).query(mine)[1]]
  gap = mine - hosts[1].places(pair, now)
  each = _stiffness(hosts[0], vert, stiffness, np.inf)
  grips = [Grip(host.organ.mesh, held) for host, held in zip(hosts, (vert, pair), strict=True)]
  made = [
    {"stiffness": each, "anchor": off, "turn": host.organ.frame}
    for host, off in zip(hosts, (gap, -gap), strict=True)
  ]
  by = "" if now else "attach"
  return (
    Group(grips[0], TO_POINT, made[0], other, grips[1], by),
    Group(grips[1], TO_POINT, made[1], one, grips[0], by),
  )


def carried(host: Host) -> list[Group]:
  """Returns the foundation and the pins of an organ that has a carrier, attached to it."""
  name, organ = host.config.carrier, host.organ
  if not name:
    return []
  mesh = organ.mesh.whole
  area = topology.vertex_areas(mesh.rest, mesh.elem)
  body = TO_OWN_MOTION
  if name != OWN:
    body = flexes.need(host.m, "body", name, organ.name, "carrier")
  pins = np.array(sorted(host.config.pin), int)
  stiffness = host.config.foundation * area
  stiffness[pins] = _firm(host)[pins]
  vert = np.flatnonzero(stiffness > 0)
  if not len(vert):
    return []
  anchor, axes = np.zeros((len(vert), 3)), np.zeros((3, 3))
  if body >= 0:
    turn, origin = flexes.body_frame(host.m, body)
    place = organ.origin + mesh.rest[vert] @ organ.frame.T
    anchor, axes = (place - origin) @ turn, turn.T @ organ.frame
  made = {"stiffness": stiffness[vert], "anchor": anchor, "turn": axes}
  return [Group(Grip(mesh, vert), body, made, by="carrier")]


def check_vertices(host: Host, vertices: npt.ArrayLike) -> np.ndarray:
  """Returns vertices that springs may hold, each once.

  Raises:
    ValueError: one does not exist or is pinned, or there is none.
  """
  name, count = host.organ.name, host.organ.mesh.nouter
  vert = np.unique(np.asarray(vertices, dtype=float).ravel())
  bad = vert[(vert != np.floor(vert)) | (vert < 0) | (vert >= count)]
  if bad.size or not vert.size:
    what = f"{bad[0]:g}" if bad.size else "none"
    raise ValueError(f"organ {name!r}: vertices have {what}, expected in [0, {count})")
  vert = vert.astype(int)
  held = vert[~host.organ.free[vert]]
  if held.size:
    raise ValueError(f"organ {name!r}: vertex {held[0]} is pinned, expected free ones")
  return vert


def _gain(host: base.Host) -> float:
  """Returns h^2 + h damping [s^2]."""
  h = float(host.m.opt.timestep)
  return h * (h + host.config.damping)


def _firm(host: Host) -> np.ndarray:
  """Returns the stiffness with which a spring weighs much more than its vertex [N/m], (nvert,)."""
  return _FIRM * inertia.masses(host.m, host.organ) / _gain(host)


def most(host: base.Host, body: int) -> float:
  """Returns the most that springs to a body may have together [N/m]."""
  m = host.m
  if _is_mocap(m, body) or not m.body_weldid[body]:
    return np.inf
  weight = m.body_invweight0[body, 0]
  return _LIGHT / (_gain(host) * max(weight, 1e-12))


def _is_mocap(m: mjstruct.Struct, body: int) -> bool:
  """Returns whether a body or one above it is a mocap body."""
  mocap, parent = m.body_mocapid, m.body_parentid
  while body > 0:
    if mocap[body] >= 0:
      return True
    body = int(parent[body])
  return False


def _stiffness(host: Host, vert: np.ndarray, stiffness: float | None, most: float) -> np.ndarray:
  """Returns the stiffness of each spring, by the area of its vertex [N/m], (n,)."""
  name = host.organ.name
  mesh = host.organ.mesh
  area = topology.vertex_areas(mesh.rest, mesh.elem)[vert]
  share = area / area.sum()
  if stiffness is None:
    return share * min(float(_firm(host)[vert].sum()), most)
  if not (np.isfinite(stiffness) and stiffness > 0):
    raise ValueError(f"organ {name!r}: stiffness is {stiffness}, expected a number > 0 [N/m]")
  if stiffness > most:
    raise ValueError(
      f"organ {name!r}: stiffness is {stiffness:g}, expected at most {most:.3g} N/m for a body "
      "this light and this time step"
    )
  return stiffness * share
