"""What needles and their threads are, by their bodies in a model, and where they go through."""

from typing import Any

import mujoco
import numpy as np
from palpate.tissue import config as configuration
from palpate.tissue.geometry.mesh import Mesh, crossings

from ..engine import penetration
from ..engine.model import declare, flexes, mjstruct
from .host import Host

_ENDS = ("swage", "tip")
_BESIDE = 1.4  # how much farther than they reach a thread's contacts end before a hole


def is_free(m, body: int) -> bool:
  """Returns whether a body has a free joint."""
  joint = m.body_jntadr[body]
  return joint >= 0 and m.jnt_type[joint] == int(mujoco.mjtJoint.mjJNT_FREE)


def read(host: Host, name: str) -> dict[str, Any]:
  """Returns the arc, the tip and the geoms of a needle."""
  m, organ = host.m, host.organ
  body = flexes.need(m, "body", name, organ.name, "needles")
  mine = np.flatnonzero(m.site_bodyid == body)
  sites = {mjstruct.name_of(m, "site", int(site)): site for site in mine}
  ends = [next((sites[s] for s in sites if s.endswith(f"_{end}")), None) for end in _ENDS]
  geoms = np.flatnonzero(m.geom_bodyid == body)
  if None in ends or not len(geoms):
    raise ValueError(
      f"organ {organ.name!r}: needles names {name!r}, which has no geoms or no sites '_swage' and "
      "'_tip', expected a body that `palpate.add_needle` has made"
    )
  tip = m.site_pos[ends[1]]
  circle, half = float(np.hypot(*tip[:2])), float(np.arctan2(tip[1], tip[0]))
  size, middle = m.geom_size[geoms], m.geom_pos[geoms]
  place = (np.arctan2(middle[:, 1], middle[:, 0]) + half) * circle
  edge = organ.mesh.whole.edge_length
  if edge > circle:
    raise ValueError(
      f"organ {organ.name!r}: its mean edge is {1e3 * edge:.3g} mm, too long for a bite of needle "
      f"{name!r}, expected at most the radius of the needle's circle, {1e3 * circle:.3g} mm"
    )
  turn, origin = flexes.body_frame(m, body)
  angle = np.linspace(-half, half, 17)
  arc = origin + circle * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) @ turn.T
  if _goes_through((arc - organ.origin) @ organ.frame, organ.mesh):
    raise ValueError(f"organ {organ.name!r}: needle {name!r} starts inside, expected outside")
  return {
    "body": body, "circle": circle, "half": half, "radius": float(size[:, 0].max()),
    "strand": strand(host, body),
    "slit": 2 * float(m.site_size[ends[1], 0]),
    "parts": list(zip(geoms.tolist(), (place + size[:, 1]).tolist(), strict=True)),
  }  # fmt: skip


def strand(host: Host, needle: int) -> dict[str, Any]:
  """Returns the thread whose first node an equality joins to a needle, if there is one.

  Returns:
    flex, or -1; body of each node (n,) and its place there [m] (n, 3); rest length and stiffness of
    the edge to the next node (n, 2), and whether nodes move along it; frame (3, 3) and origin (3,)
    of its slides; friction; how far from a hole it touches nothing; radius of the largest geom at
    its end, and its own thickness [m]
  """
  m, none = host.m, np.zeros((0, 3))
  out = {"flex": -1, "node": none[:, 0], "local": none, "edges": none[:, :2], "refine": False,
         "friction": 0.0, "close": 0.0, "bead": 0.0, "thick": 0.0}  # fmt: skip
  first, body = m.flex_vertadr, m.flex_vertbodyid
  joined = {
    int(pair[1 - side])
    for *pair, kind in zip(m.eq_obj1id, m.eq_obj2id, m.eq_type, strict=True)
    for side in range(2)
    if pair[side] == needle and kind == int(mujoco.mjtEq.mjEQ_CONNECT)
  }
  for flex in np.flatnonzero(m.flex_dim == 1).tolist():
    if int(body[first[flex]]) not in joined:
      continue
    mine = slice(int(first[flex]), int(first[flex]) + flexes.vertices(m, flex))
    instance = int(m.body_plugin[body[mine][0]])
    texts = declare.keys(host.m, instance)
    where = declare.places(m, instance, flex, flexes.name(m, flex))
    rest, frame, origin = where[1], where[3], where[4]
    length = np.linalg.norm(np.diff(rest, axis=0), axis=1)
    config = configuration.parse(flexes.name(m, flex), texts, len(length), closed=False)
    thick = float(m.flex_radius[flex])
    section = np.pi * thick**2
    edges = np.stack([length, np.asarray(config.young) * section / length], axis=1)
    out = {
      "flex": flex,
      "node": body[mine].copy(),
      "local": m.flex_vert[mine].copy(),
      "edges": np.concatenate([edges, edges[-1:]]),
      "refine": config.refine > 0,
      "frame": frame,
      "origin": origin,
      "close": _BESIDE * (radius(host) + thick),
      "thick": 2.0 * thick,
      "bead": float(m.geom_size[m.geom_bodyid == body[mine][-1], 0].max(initial=0.0)),
      "friction": float(m.flex_friction[flex, 0]),
    }
  return out


def radius(host: Host) -> float:
  """Returns the radius of the flex that touches an organ's needles [m]."""
  return float(host.m.flex_radius[host.organ.flexes[-1]])


def _goes_through(line: np.ndarray, mesh: Mesh) -> bool:
  """Returns whether a line through points [m], (n, 3), goes through a surface or is inside."""
  if crossings(line, mesh.rest[mesh.elem]):
    return True
  return mesh.closed and bool(penetration.inside(line[:1], mesh.rest, mesh.elem).any())
